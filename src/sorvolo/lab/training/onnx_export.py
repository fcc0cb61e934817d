"""A trained model as one ONNX file that `detection` runs without torch, checked against torch's answers."""

import io
import json
import warnings
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from sorvolo.detection.contract import METADATA_KEY
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.training.boxes import Finder

OPSET = 17  # of ONNX, that of 2021, which all runtimes know
_TRACED_PX = (256, 320)  # rows, columns; the model takes any size, different sides show a mix-up
_BYTES, _STEP = (
    "_quantized",
    "_scale",
)  # end the names of what is stored in eight bits, and of its steps
_LEAST_WEIGHT = 1e-30  # of an output with no others but zeros
_STORED_VALUES = 256  # of an array, at least, for eight bits to pay
_SAME_PX, _SAME_SCORE = 0.5, 1e-3
_GRAIN, _SHAKES = (
    0.01,
    4,
)  # by how much a picture is changed to see what a rounding may do; how often


@dataclass(frozen=True)
class ExportCheck:
    """How far the exported graph is from torch: over the detections of all pictures, and how many found no partner.

    `undecided` more depend on rounding in torch itself and are not compared.
    """

    box_px: float
    score: float
    unmatched: int
    detections: int
    undecided: int = 0

    @property
    def is_good(self) -> bool:
        """Boxes within half a pixel, scores within a thousandth, none without a partner."""
        return self.box_px <= _SAME_PX and self.score <= _SAME_SCORE and self.unmatched == 0


def round_weights(model: Finder) -> Finder:
    """The same model, its weights changed to the nearest that eight bits hold, in steps of each output's own, a power of two."""
    for weight in model.parameters():
        if weight.ndim > 1:
            most = weight.data.abs().flatten(1).amax(1).clamp(min=_LEAST_WEIGHT)
            step = (most / 127).log2().ceil().exp2().reshape(-1, *[1] * (weight.ndim - 1))
            weight.data = (weight.data / step).round() * step
    return model


def export_onnx(model: Finder, info: dict[str, Any]) -> bytes:
    """The model as an ONNX file's bytes, with `info` as its "sorvolo" metadata (docs/model-file.md has the fields)."""
    buffer = io.BytesIO()
    picture = torch.randint(0, 255, (1, 3, *_TRACED_PX), dtype=torch.uint8)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            deepcopy(model).eval().cpu().to(memory_format=torch.contiguous_format),  # type: ignore[call-overload]
            (picture,),
            buffer,  # type: ignore[arg-type]
            dynamo=False,
            opset_version=OPSET,
            input_names=["image"],
            output_names=["boxes", "scores", "labels"],
            dynamic_axes={
                "image": {2: "height", 3: "width"},
                "boxes": {0: "count"},
                "scores": {0: "count"},
                "labels": {0: "count"},
            },
        )
    file = onnx.load_model_from_string(buffer.getvalue())
    for output in file.graph.output:  # rows vary, whatever the traced picture had
        output.type.tensor_type.shape.dim[0].dim_param = "count"
    entry = file.metadata_props.add()
    entry.key = METADATA_KEY
    entry.value = json.dumps({"format": 1, "stride": model.stride, **info})
    _store_bytes(file.graph)
    onnx.checker.check_model(file)
    return file.SerializeToString()


def _store_bytes(graph: Any) -> None:
    """Store weights that eight bits hold exactly so: a quarter of the bytes, the same values once it is opened."""
    kept, nodes = [], []
    for each in graph.initializer:
        values, name = numpy_helper.to_array(each), each.name
        if values.dtype == np.float32 and values.ndim > 1 and values.size >= _STORED_VALUES:
            most = np.abs(values).max(tuple(range(1, values.ndim)), keepdims=True)
            step = np.exp2(np.ceil(np.log2(np.maximum(most, _LEAST_WEIGHT) / 127)), dtype="f4")
            steps = np.rint(values / step).astype(np.int8)
            if np.array_equal(steps * step, values):
                kept.append(numpy_helper.from_array(steps, name + _BYTES))
                kept.append(numpy_helper.from_array(step, name + _STEP))
                nodes.append(
                    helper.make_node(
                        "Cast", [name + _BYTES], [name + "_cast"], to=TensorProto.FLOAT
                    )
                )
                nodes.append(helper.make_node("Mul", [name + "_cast", name + _STEP], [name]))
                continue
        kept.append(each)
    nodes.extend(graph.node)
    for field, rows in ((graph.initializer, kept), (graph.node, nodes)):
        del field[:]
        field.extend(rows)


def read_layers(exported: bytes) -> dict[str, Tensor]:
    """A model file's weights in float32, by their names in the network."""
    graph = onnx.load_model_from_string(exported).graph
    layers = {
        each.name: torch.from_numpy(numpy_helper.to_array(each).astype("f4"))
        for each in graph.initializer
    }
    for name in [each for each in layers if each.endswith(_BYTES)]:
        own, steps = name.removesuffix(_BYTES), layers[name]
        step = layers[name + _STEP] if name + _STEP in layers else layers[own + _STEP]
        layers[own] = steps * step.reshape(-1, *[1] * (steps.ndim - 1))
    for node in graph.node:  # an export keeps values that are the same once
        if node.op_type == "Identity" and node.input[0] in layers:
            layers[node.output[0]] = layers[node.input[0]]
    return layers


@torch.no_grad()
def check_export(model: Finder, exported: bytes, pictures: Sequence[ImageRGB]) -> ExportCheck:
    """Run torch and the exported file on pictures (H, W, 3), cut to multiples of the model's stride, and compare.

    What torch itself answers otherwise when a picture changes by a hundredth of a gray value is left out.
    """
    import onnxruntime

    session = onnxruntime.InferenceSession(exported, providers=["CPUExecutionProvider"])
    model, random = model.eval().cpu(), torch.Generator().manual_seed(0)
    worst_px, worst_score, alone, count, undecided = 0.0, 0.0, 0, 0, 0
    for picture in pictures:
        height, width = (side // model.stride * model.stride for side in picture.shape[:2])
        planes = np.ascontiguousarray(picture[:height, :width].transpose(2, 0, 1))[None]
        image = torch.from_numpy(planes)
        theirs = [torch.from_numpy(each) for each in session.run(None, {"image": planes})]
        shaken = [
            model(image + _GRAIN * torch.randn(image.shape, generator=random))
            for _ in range(_SHAKES)
        ]
        for found in zip(*model(image)):
            if any(max(_distance(other, found)) > 1 for other in shaken):
                undecided += 1
                continue
            count += 1
            off_px, off_score = _distance(theirs, found)
            if off_px == np.inf:
                alone += 1
                continue
            worst_px = max(worst_px, off_px * _SAME_PX)
            worst_score = max(worst_score, off_score * _SAME_SCORE)
    return ExportCheck(worst_px, worst_score, alone, count, undecided)


def _distance(
    found: Sequence[Tensor], sought: tuple[Tensor, Tensor, Tensor]
) -> tuple[float, float]:
    """How far the most alike detection is from the sought one: its box and its score, in units of what is the same."""
    boxes, scores, labels = found
    box, score, label = sought
    same = labels == label
    if not bool(same.any()):
        return np.inf, np.inf
    off_px = (boxes[same] - box).abs().amax(1) / _SAME_PX
    off_score = (scores[same] - score).abs() / _SAME_SCORE
    best = int((off_px + off_score).argmin())
    return float(off_px[best]), float(off_score[best])
