"""A trained model as one ONNX file that `detection` runs without torch, checked against torch's answers."""

import io
import json
import warnings
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import onnx
import torch
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from numpy.typing import NDArray
from onnx import numpy_helper
from torch import Tensor, nn

from sorvolo.detection.contract import ModelInfo, ScoreCalibration
from sorvolo.errors import InputError, SettingsError
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


def export_onnx(model: FasterRCNN, info: dict[str, Any]) -> bytes:
    """The model as an ONNX file's bytes, with `info` as its "sorvolo" metadata (docs/model-file.md has the fields).

    The file finds no more objects than the model's `Reach` has regions. Raises SettingsError when `info` names no classes.
    """
    if not info.get("classes"):
        raise SettingsError("an exported model needs the names of its classes")
    full = {
        "stride": model.stride,
        "least_score": model.reach.least_score,
        "regions": model.reach.regions,
        **info,
    }
    return onnx_from_module(deepcopy(model).eval().cpu(), full)


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
    model = model.eval()
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


_WEIGHTED = ("Conv", "Gemm")
_AERIAL = "/aerial/"  # of a model of two networks, such as the packaged one, the part that can be learnt on from
_OTHER_PARTS = {
    "backbone": "NanoDet's network",
    "coco": "NanoDet's network",
    "judge": "the judge of cars",
    "softened": "the softening of sharp pictures",
}
_OF_CLASSES = "head.scores"  # the one layer with a row for each class; the background's comes last


@dataclass(frozen=True, eq=False)
class ExportedModel:
    """A model file of ours to learn on from, and what it states about itself.

    `thresholds` are those of the network that is learnt on from, in its own scale, and `calibration` what that scale
    means. `left` names in words what else the file joins with it and a training does not carry on.
    """

    content: bytes
    info: ModelInfo
    sha256: str
    thresholds: Mapping[str, float]
    calibration: Mapping[str, ScoreCalibration]
    left: tuple[str, ...] = ()

    @property
    def origin(self) -> str:
        """The model in words."""
        return f"the model {self.info.name}"


def load_exported(
    model: FasterRCNN, exported: bytes, pictures: Tensor, classes: Sequence[str] | None = None
) -> None:
    """Give `model` the weights of an ONNX file that `export_onnx` made of one of its shape.

    An export folds each batch norm into the convolution before it. Here the norms are opened again: their means and
    variances are those that `pictures` (N, 3, H, W), RGB 0 to 255, give them, so that they fit the pictures which are
    to be learnt from; what the model sees in a picture stays the same. `classes` are the model's: those that the file
    names too keep what it knows of them, the others start as `model` has them; None: the same ones in the same order.
    Of a file that joins several networks, as the packaged one does, it is the aerial one.
    Raises InputError where the file's layers are not the model's, as those of a model in eight bits are not, and for a
    model with batch norms that do not learn (ResNet-50's of the preset `thesis`).
    """
    graph, known = _read(exported)
    layers = {
        name: each
        for name, each in model.named_modules()
        if isinstance(each, nn.Conv2d | nn.Linear)
    }
    # Of each convolution without a bias of its own the batch norm that follows it, which the export folded into it
    leaves = [(name, each) for name, each in model.named_modules() if not any(each.children())]
    norms = {
        name: following
        for (name, each), (_, following) in pairwise(leaves)
        if isinstance(each, nn.Conv2d)
        and each.bias is None
        and isinstance(following, nn.BatchNorm2d)
    }
    loaded = _loaded(graph, list(layers))
    if foreign := [name for name in loaded if name not in layers]:
        raise _unfitting(f"the network has no layer {foreign[0]}, as the file has")
    for name, layer in layers.items():
        found = loaded.get(name, [])
        if name == _OF_CLASSES and classes is not None and len(found) == 2:
            found = _rows_of(layer, found, known, classes)
        # Raise InputError unless `found` is a weight of the layer's shape, and a bias
        if len(found) != 2 or found[0].shape != layer.weight.shape:
            shape = " x ".join(map(str, found[0].shape)) if found else "nothing"
            raise _unfitting(
                f"its layer {name} should be {' x '.join(map(str, layer.weight.shape))}, and is {shape}"
            )
        _fill(name, layer, norms.get(name), *found)
    _settle(model, list(norms.values()), pictures)


def other_networks(exported: bytes) -> tuple[str, ...]:
    """What a file joins with its aerial network, in words; nothing for a file of one network.

    Raises InputError where the file is damaged.
    """
    names = [node.name for node in _read(exported)[0].node]
    if not any(name.startswith(_AERIAL) for name in names):
        return ()
    found = (
        words
        for part, words in _OTHER_PARTS.items()
        if any(name.startswith(f"/{part}/") for name in names)
    )
    return tuple(dict.fromkeys(found))


def _read(exported: bytes) -> tuple[Any, tuple[str, ...]]:
    """The file's graph, and the names of its classes."""
    try:
        file = onnx.load_model_from_string(exported)
        about = next(each.value for each in file.metadata_props if each.key == "sorvolo")
        return file.graph, tuple(map(str, json.loads(about)["classes"]))
    except (DecodeError, StopIteration, ValueError, LookupError, TypeError) as error:
        raise InputError(
            "the model file is damaged, or none that `sorvolo train` wrote; give one of those"
        ) from error


def _loaded(graph: Any, names: Sequence[str]) -> dict[str, list[Tensor]]:
    """The weight and bias of each of the file's layers, by which of the network's `names` it is; of a file of two
    networks those of the aerial one. A layer that the network does not have comes under its own name."""
    values = _values(graph)
    part = _AERIAL if any(node.name.startswith(_AERIAL) for node in graph.node) else ""
    loaded: dict[str, list[Tensor]] = {}
    for node in (
        each for each in graph.node if each.op_type in _WEIGHTED and each.name.startswith(part)
    ):
        if own := _tensors(node, values):
            name = _module_of(node.name.removeprefix(part.rstrip("/")), names) or node.name
            loaded[name] = own
    return loaded


def _tensors(node: Any, values: Mapping[str, Any]) -> list[Tensor]:
    """The constants among a node's inputs, the features left out."""
    own = [values[name] for name in node.input[1:] if name in values]
    return [torch.from_numpy(numpy_helper.to_array(each).copy()) for each in own]


def _values(graph: Any) -> dict[str, Any]:
    """The graph's constants by every name that they go by: an export keeps values that are the same once."""
    values = {each.name: each for each in graph.initializer}
    return values | {
        node.output[0]: values[node.input[0]]
        for node in graph.node
        if node.op_type == "Identity" and node.input[0] in values
    }


def _unfitting(reason: str) -> InputError:
    return InputError(
        f"the model file does not fit the network: {reason}; give a float32 model of the same preset, rpn and number "
        "of classes"
    )


def _rows_of(
    layer: nn.Module, found: Sequence[Tensor], known: Sequence[str], classes: Sequence[str]
) -> list[Tensor]:
    """The class layer's weights and bias: rows of classes of the same name and of the background are the file's."""
    if len(found[0]) != len(known) + 1 or found[0].shape[1:] != layer.weight.shape[1:]:  # type: ignore[index]
        raise _unfitting(
            f"its {len(found[0])} rows of classes are not those of {', '.join(known)} and the background"
        )
    theirs = [*(known.index(name) for name in classes if name in known), len(known)]
    own = [*(row for row, name in enumerate(classes) if name in known), len(classes)]
    filled = [layer.weight.detach().clone(), layer.bias.detach().clone()]  # type: ignore[operator]
    for to, given in zip(filled, found):
        to[own] = given[theirs]
    return filled


@torch.no_grad()
def _fill(
    name: str, layer: nn.Module, norm: nn.BatchNorm2d | None, weight: Tensor, bias: Tensor
) -> None:
    """The layer's weight, and its bias: of one without a bias the shift of the norm, which else changes nothing."""
    layer.weight.copy_(weight)  # type: ignore[operator]
    if layer.bias is not None:
        layer.bias.copy_(bias)  # type: ignore[operator]
        return
    if norm is None:
        raise InputError(
            f"no model file can be learnt on from in this network: the batch norm behind {name} stays as ImageNet "
            "taught it, and the file does not hold it by itself; start with --weights auto, or take the preset fast"
        )
    norm.running_mean.zero_()
    norm.running_var.fill_(1 - norm.eps)
    norm.weight.fill_(1)
    norm.bias.copy_(bias)


def _module_of(node: str, names: Sequence[str]) -> str | None:
    """Whose node it is: "/neck/smooth.0/smooth.0.1/Conv" comes from neck.smooth.0.1, its scopes one after the other."""
    scopes = node.strip("/").split("/")[:-1]
    for name in names:
        dotted, start = f".{name}.", 0
        for scope in scopes:
            start = dotted.find(f".{scope}.", start)
            if start < 0:
                break
        else:
            if dotted.endswith(f".{scopes[-1]}."):
                return name
    return None


@torch.no_grad()
def _settle(model: FasterRCNN, norms: Sequence[nn.BatchNorm2d], pictures: Tensor) -> None:
    """Give each norm the mean and variance of what reaches it, and the gain and shift that take them out again."""

    def settle(norm: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        mean, variance = inputs[0].mean((0, 2, 3)), inputs[0].var((0, 2, 3), correction=0)
        norm.running_mean.copy_(mean)  # type: ignore[operator]
        norm.running_var.copy_(variance)  # type: ignore[operator]
        norm.weight.copy_(torch.sqrt(variance + norm.eps))  # type: ignore[operator]
        norm.bias.add_(mean)  # type: ignore[operator]

    was_training = model.training
    model.eval()
    hooks = [norm.register_forward_pre_hook(settle) for norm in norms]
    try:
        model.proposals(model.features(pictures))
    finally:
        for hook in hooks:
            hook.remove()
        model.train(was_training)
