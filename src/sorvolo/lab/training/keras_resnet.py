"""Keras' ResNet-50 under torchvision's names: the same function, so that its weights can be learnt on from."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sorvolo.geometry.arrays import Numbers

_MEAN_RGB = (123.68, 116.779, 103.939)  # Keras' "caffe" input: BGR 0 to 255 minus these
_EPSILON = 1e-5  # of our batch norms
_REPEATS = {2: 3, 3: 4, 4: 6, 5: 3}
_BRANCHES = {
    "branch2a": ("conv1", "bn1"),
    "branch2b": ("conv2", "bn2"),
    "branch2c": ("conv3", "bn3"),
}
_SHORT = ("downsample.0", "downsample.1")


def resnet50_from_keras(
    layers: Mapping[str, Numbers], places: Mapping[str, Mapping[str, Any]]
) -> dict[str, Tensor]:
    """The state dict of `resnet.ResNet50(original=True)` from Keras' arrays ("res2a_branch2a/kernel", ...).

    `places` gives each layer's settings, of which the batch norms' epsilon is used: it is folded into their variance,
    the convolutions' biases into their means, and BGR input becomes RGB. Raises KeyError where a layer is missing.
    """
    out = {"mean": torch.tensor(_MEAN_RGB)}

    def take(conv: str, norm: str, ours: str, own_norm: str) -> None:
        epsilon = float(places[norm]["epsilon"])
        out[f"{ours}.weight"] = _tensor(layers[f"{conv}/kernel"].transpose(3, 2, 0, 1))
        out[f"{own_norm}.weight"] = _tensor(layers[f"{norm}/gamma"])
        out[f"{own_norm}.bias"] = _tensor(layers[f"{norm}/beta"])
        out[f"{own_norm}.running_mean"] = _tensor(
            layers[f"{norm}/moving_mean"] - layers[f"{conv}/bias"]
        )
        out[f"{own_norm}.running_var"] = _tensor(
            layers[f"{norm}/moving_variance"] + np.float32(epsilon - _EPSILON)
        )

    take("conv1", "bn_conv1", "conv1", "bn1")
    out["conv1.weight"] = out["conv1.weight"].flip(1).contiguous()
    for stage, repeats in _REPEATS.items():
        for repeat in range(repeats):
            place = f"layer{stage - 1}.{repeat}"
            branches = _BRANCHES | ({"branch1": _SHORT} if repeat == 0 else {})
            for branch, (conv, norm) in branches.items():
                keras = f"{stage}{'abcdef'[repeat]}_{branch}"
                take(f"res{keras}", f"bn{keras}", f"{place}.{conv}", f"{place}.{norm}")
    out["fc.weight"] = _tensor(layers["fc1000/kernel"].T)
    out["fc.bias"] = _tensor(layers["fc1000/bias"])
    return out


def _tensor(values: Numbers) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32).copy())
