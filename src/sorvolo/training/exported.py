"""An exported model taken back into torch, to learn on: the way to tune the packaged model to one's own pictures."""

from collections.abc import Sequence
from itertools import pairwise

import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from sorvolo.errors import InputError
from sorvolo.training.faster_rcnn import FasterRCNN

_WEIGHTED = ("Conv", "Gemm")


def load_exported(model: FasterRCNN, exported: bytes, pictures: Tensor) -> None:
    """Give `model` the weights of an ONNX file that `export_onnx` made of one of its shape.

    An export folds each batch norm into the convolution before it. Here the norms are opened again: their means and
    variances are those that `pictures` (N, 3, H, W), RGB 0 to 255, give them, so that they fit the pictures which are
    to be learnt from; what the model sees in a picture stays the same. Raises InputError where the file's layers are
    not the model's, as those of a model in eight bits are not.
    """
    graph = onnx.load_model_from_string(exported).graph
    values = {each.name: each for each in graph.initializer}
    layers = {name: each for name, each in model.named_modules() if isinstance(each, nn.Conv2d | nn.Linear)}
    loaded: dict[str | None, list[Tensor]] = {}
    for node in graph.node:
        own = [values[name] for name in node.input[1:] if name in values]
        if node.op_type in _WEIGHTED and own:
            name = _module_of(node.name, list(layers))
            loaded[name] = [torch.from_numpy(numpy_helper.to_array(each).copy()) for each in own]
    norms = _norms_after(model)
    for name, layer in layers.items():
        weights = loaded.get(name)
        if weights is None or len(weights) != 2 or weights[0].shape != layer.weight.shape:
            found = "nothing" if weights is None else " x ".join(map(str, weights[0].shape))
            wanted = " x ".join(map(str, layer.weight.shape))
            raise InputError(
                f"the model file does not fit the network: its layer {name} should be {wanted}, and is {found}; give a "
                "float32 model of the same preset, --rpn and number of classes"
            )
        with torch.no_grad():
            layer.weight.copy_(weights[0])
            if layer.bias is not None:
                layer.bias.copy_(weights[1])
            else:
                norm = norms[name]
                norm.running_mean.zero_()  # type: ignore[operator, union-attr]
                norm.running_var.fill_(1 - norm.eps)  # type: ignore[operator, union-attr]
                norm.weight.fill_(1)
                norm.bias.copy_(weights[1])
    _settle(model, list(norms.values()), pictures)


def _norms_after(model: nn.Module) -> dict[str, nn.BatchNorm2d]:
    """Of each convolution without a bias of its own the batch norm that follows it, which the export folded into it."""
    leaves = [(name, each) for name, each in model.named_modules() if not any(each.children())]
    return {
        name: following
        for (name, each), (_, following) in pairwise(leaves)
        if isinstance(each, nn.Conv2d) and each.bias is None and isinstance(following, nn.BatchNorm2d)
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
        norm.running_mean.copy_(mean)  # type: ignore[operator, union-attr]
        norm.running_var.copy_(variance)  # type: ignore[operator, union-attr]
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
