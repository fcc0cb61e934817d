"""An exported model read back into torch, to learn on: the way to tune the packaged model to one's own pictures."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import onnx
import torch
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from onnx import numpy_helper
from torch import Tensor, nn

from sorvolo.errors import InputError
from sorvolo.lab.training.faster_rcnn import FasterRCNN

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
    """A model file of ours to learn on from, and what it states about itself; `origin` names it in words.

    `thresholds` are those of the network that is learnt on from, in its own scale, and `calibration` (slope and shift)
    what that scale means. `left` names in words what else the file joins with it and a training does not carry on,
    `cost` what that costs, by the model's card. `on_request`, `thermal_by` and `best_px` are those of
    `detection.contract.ModelInfo`.
    """

    content: bytes
    classes: tuple[str, ...]
    origin: str
    sha256: str
    licence: str
    trained_on: str
    thresholds: Mapping[str, float] = field(default_factory=dict)
    calibration: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    left: tuple[str, ...] = ()
    cost: tuple[str, ...] = ()
    on_request: tuple[str, ...] = ()
    thermal_by: str = ""
    best_px: Mapping[str, tuple[float, float]] = field(default_factory=dict)


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
    model with batch norms that do not learn (ResNet-50's of the presets `accurate` and `thesis`).
    """
    graph, known = _read(exported)
    layers = {
        name: each
        for name, each in model.named_modules()
        if isinstance(each, nn.Conv2d | nn.Linear)
    }
    norms = _norms_after(model)
    loaded = _loaded(graph, list(layers))
    if foreign := [name for name in loaded if name not in layers]:
        raise _unfitting(f"the network has no layer {foreign[0]}, as the file has")
    for name, layer in layers.items():
        found = loaded.get(name, [])
        if name == _OF_CLASSES and classes is not None and len(found) == 2:
            found = _rows_of(layer, found, known, classes)
        _demand_fitting(name, layer, found)
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


def _demand_fitting(name: str, layer: nn.Conv2d | nn.Linear, found: Sequence[Tensor]) -> None:
    """Raise InputError unless `found` is a weight of the layer's shape, and a bias."""
    if len(found) != 2 or found[0].shape != layer.weight.shape:
        shape = " x ".join(map(str, found[0].shape)) if found else "nothing"
        raise _unfitting(
            f"its layer {name} should be {' x '.join(map(str, layer.weight.shape))}, and is {shape}"
        )


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


def _norms_after(model: nn.Module) -> dict[str, nn.BatchNorm2d]:
    """Of each convolution without a bias of its own the batch norm that follows it, which the export folded into it."""
    leaves = [(name, each) for name, each in model.named_modules() if not any(each.children())]
    return {
        name: following
        for (name, each), (_, following) in pairwise(leaves)
        if isinstance(each, nn.Conv2d)
        and each.bias is None
        and isinstance(following, nn.BatchNorm2d)
    }


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
