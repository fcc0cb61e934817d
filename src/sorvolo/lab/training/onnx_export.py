"""A trained model as one ONNX file that `detection` runs without torch, checked against torch's answers."""

import io
import json
import warnings
from collections.abc import Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, ImageRGB
from sorvolo.lab.training.faster_rcnn import FasterRCNN

OPSET = 17  # of ONNX, that of 2021, which all runtimes know
_TRACED_PX = (256, 320)  # rows, columns; the model takes any size, different sides show a mix-up
_SAME_PX, _SAME_SCORE = 0.5, 1e-3
_ROUNDING, _SHAKES = 1e-4, 4  # of scores before the sigmoid; how often they are changed by that

_Found = tuple[Floats, Floats, Floats]  # boxes, scores, labels


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


def export_onnx(model: FasterRCNN, info: dict[str, Any], *, regions: int | None = None) -> bytes:
    """The model as an ONNX file's bytes, with `info` as its "sorvolo" metadata (docs/model-file.md has the fields).

    `regions`: how many the head looks at in a picture, None for as many as the model's own `Reach` has. The file
    finds no more objects than that. Raises SettingsError when `info` names no classes or `regions` is below 1.
    """
    if not info.get("classes"):
        raise SettingsError("an exported model needs the names of its classes")
    if regions is not None and regions < 1:
        raise SettingsError(f"a head looks at one region or more, not {regions}")
    own = _reaching(deepcopy(model).eval().cpu(), regions or model.reach.regions)
    full = {
        "stride": model.stride,
        "least_score": model.reach.least_score,
        "regions": own.reach.regions,
        **info,
    }
    return onnx_from_module(own, full)


def onnx_from_module(model: nn.Module, info: dict[str, Any]) -> bytes:
    """A module that takes a picture and gives boxes, scores and labels, as the bytes of an ONNX file."""
    for weight in model.parameters():
        weight.data = weight.data.contiguous()
    picture = torch.randint(0, 255, (1, 3, *_TRACED_PX), dtype=torch.uint8)
    buffer = io.BytesIO()
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            model,
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
    graph = onnx.load_model_from_string(buffer.getvalue())
    for output in graph.graph.output:  # rows vary, whatever the traced picture had
        output.type.tensor_type.shape.dim[0].dim_param = "count"
    entry = graph.metadata_props.add()
    entry.key, entry.value = "sorvolo", json.dumps({"format": 1, **info})
    onnx.checker.check_model(graph)
    return graph.SerializeToString()


def check_export(model: FasterRCNN, exported: bytes, pictures: Sequence[ImageRGB]) -> ExportCheck:
    """Run torch and the exported file on pictures (H, W, 3), cut to multiples of the model's stride, and compare."""
    import onnxruntime

    session = onnxruntime.InferenceSession(exported, providers=["CPUExecutionProvider"])
    info = json.loads(session.get_modelmeta().custom_metadata_map["sorvolo"])
    model = _reaching(model.eval(), info["regions"])
    worst_px, worst_score, alone, count, undecided = 0.0, 0.0, 0, 0, 0
    for picture in pictures:
        height, width = (side // model.stride * model.stride for side in picture.shape[:2])
        planes = np.ascontiguousarray(picture[:height, :width].transpose(2, 0, 1))[None]
        found, *others = _seen_and_shaken(model, planes)
        other_boxes, other_scores, other_labels = session.run(None, {"image": planes})
        for box, score, label in zip(*found):
            if not all(_holds(other, box, score, label) for other in others):
                undecided += 1
                continue
            count += 1
            same = other_labels == label
            if not same.any():
                alone += 1
                continue
            off_px = np.abs(other_boxes[same] - box).max(1)
            # of a graph's many alike boxes the one whose score is nearest as well
            best = int(np.argmin(off_px + 100 * np.abs(other_scores[same] - score)))
            # at the lowest score that is reported a rounding decides
            if off_px[best] > 4 and score < model.reach.least_score + 1e-3:
                continue
            worst_px = max(worst_px, float(off_px[best]))
            worst_score = max(worst_score, float(abs(other_scores[same][best] - score)))
    return ExportCheck(worst_px, worst_score, alone, count, undecided)


@torch.no_grad()
def _seen_and_shaken(model: FasterRCNN, planes: NDArray[np.uint8]) -> list[_Found]:
    """The model's answer, and those when the scores of anchors and regions change by what a rounding may.

    Where many are equal, as after a few steps of training, it is that which decides whose regions are looked at and
    whose boxes stay.
    """
    random = torch.Generator().manual_seed(0)

    def shaken(scores: Tensor) -> Tensor:
        return scores + _ROUNDING * torch.randn(scores.shape, generator=random)

    levels = model.features(torch.from_numpy(planes))
    proposed, size_px = model.proposals(levels), (planes.shape[2], planes.shape[3])
    found = [model.detect(levels, proposed, size_px)]
    hook = model.head.register_forward_hook(lambda _, __, out: (shaken(out[0]), out[1]))
    try:
        for _ in range(_SHAKES):
            found.append(
                model.detect(levels, replace(proposed, scores=shaken(proposed.scores)), size_px)
            )
    finally:
        hook.remove()
    return [(boxes.numpy(), scores.numpy(), labels.numpy()) for boxes, scores, labels in found]


def _holds(found: _Found, box: Floats, score: float, label: int) -> bool:
    """Whether the same detection is there."""
    boxes, scores, labels = found
    near = (np.abs(boxes - box).max(1) <= _SAME_PX) & (np.abs(scores - score) <= _SAME_SCORE)
    return bool((near & (labels == label)).any())


def _reaching(model: FasterRCNN, regions: int) -> FasterRCNN:
    """The same layers, looking at this many regions."""
    own = copy(model)
    own.reach = replace(model.reach, regions=regions)
    return own
