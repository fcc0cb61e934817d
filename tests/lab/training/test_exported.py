"""An exported model goes back into torch and sees the same; what does not fit is reported."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import onnx
import onnxruntime

from sorvolo.detection.models import find_model
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.thesis.network import thesis_network
from sorvolo.lab.training.backbones import ResNet50
from sorvolo.lab.training.faster_rcnn import FasterRCNN, Stem, fast
from sorvolo.lab.training.onnx_export import check_export, export_onnx, load_exported

_CLASSES = ("person", "car")

torch.set_num_threads(1)


def _pictures(count: int, side_px: int = 96) -> list[ImageRGB]:
    rng = np.random.default_rng(4)
    coarse = rng.integers(0, 255, (count, side_px // 8, side_px // 8, 3), np.uint8)
    return [np.asarray(each.repeat(8, 0).repeat(8, 1), np.uint8) for each in coarse]


def _batch(count: int = 4) -> "torch.Tensor":
    return torch.from_numpy(np.stack(_pictures(count))).permute(0, 3, 1, 2).float()


def _model(rpn: Stem = "extended-residual", classes: tuple[str, ...] = _CLASSES) -> FasterRCNN:
    """A network whose norms are as little alike as those of a trained one, and that is sure of its answers."""
    torch.manual_seed(5)
    model = fast(classes, rpn)
    for each in model.modules():
        if isinstance(each, torch.nn.BatchNorm2d):
            for value, low, high in (
                (each.running_mean, -0.3, 0.3),
                (each.running_var, 0.5, 2.0),
                (each.weight, 0.5, 1.5),
                (each.bias, -0.2, 0.2),
            ):
                torch.nn.init.uniform_(value, low, high)
    torch.nn.init.normal_(model.head.scores.weight, std=3.0)
    return model.eval()


def _export(model: FasterRCNN, classes: tuple[str, ...] = _CLASSES) -> bytes:
    reported = {
        "thresholds": dict.fromkeys(classes, 0.5),
        "best_px": dict.fromkeys(classes, (8, 90)),
    }
    return export_onnx(
        model, {"name": "own", "classes": list(classes), "preset": "fast", **reported}
    )


@pytest.fixture(scope="module")
def exported() -> bytes:
    return _export(_model())


def _printed(exported: bytes, picture: ImageRGB) -> list[np.ndarray]:
    session = onnxruntime.InferenceSession(exported, providers=["CPUExecutionProvider"])
    return session.run(None, {"image": np.ascontiguousarray(picture.transpose(2, 0, 1))[None]})


def test_a_model_that_went_through_its_file_sees_the_same(exported: bytes) -> None:
    torch.manual_seed(6)
    back = fast(_CLASSES)
    load_exported(back, exported, _batch())
    check = check_export(back, exported, _pictures(6))
    assert check.is_good and check.detections > 20, check
    again = _export(back)
    for picture in _pictures(3):
        for found, wanted in zip(_printed(again, picture), _printed(exported, picture)):
            np.testing.assert_allclose(found, wanted, atol=2e-2)


@pytest.mark.parametrize("rpn", ["standard", "extended"])
def test_other_proposal_networks_come_back_too(rpn: Stem) -> None:
    model = _model(rpn)
    torch.manual_seed(6)
    back = fast(_CLASSES, rpn)
    load_exported(back, _export(model), _batch())
    with torch.no_grad():
        wanted = model.proposals(model.features(_batch()))
        found = back.eval().proposals(back.features(_batch()))
    torch.testing.assert_close(found.scores, wanted.scores, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(found.offsets, wanted.offsets, atol=1e-3, rtol=1e-3)


def test_on_the_pictures_that_settled_its_norms_it_sees_the_same_while_it_learns(
    exported: bytes,
) -> None:
    back = fast(_CLASSES)
    was_training = back.train().training
    load_exported(back, exported, _batch())
    assert back.training == was_training
    with torch.no_grad():
        at_rest = back.eval().proposals(back.features(_batch()))
        learning = back.train().proposals(back.features(_batch()))
        unsettled = _model().train()
        other = unsettled.proposals(unsettled.features(_batch()))
    spread = at_rest.scores.std()
    assert (learning.scores - at_rest.scores).abs().max() < 1e-3 * spread
    assert (
        other.scores - at_rest.scores
    ).abs().max() > 0.1 * spread  # norms that were not settled see something else


def test_classes_of_the_same_name_keep_their_rows_and_others_start_anew(exported: bytes) -> None:
    source = _model()
    classes = ("boat", "car")
    torch.manual_seed(6)
    fresh, back = fast(classes), fast(classes)
    back.load_state_dict(fresh.state_dict())
    load_exported(back, exported, _batch(), classes)
    of_file, of_fresh, now = source.head.scores, fresh.head.scores, back.head.scores
    for kind in ("weight", "bias"):
        mine, theirs, new = (getattr(each, kind).detach() for each in (now, of_file, of_fresh))
        torch.testing.assert_close(mine[1:], theirs[1:])  # car and the background
        assert torch.equal(mine[0], new[0])
    torch.testing.assert_close(back.head.offsets.weight, source.head.offsets.weight)
    with pytest.raises(InputError, match=r"head\.scores should be 2 x 160, and is 3 x 160"):
        load_exported(fast(("car",)), exported, _batch())


def test_another_proposal_network_is_reported(exported: bytes) -> None:
    for rpn in ("standard", "extended"):
        torch.manual_seed(6)
        with pytest.raises(
            InputError, match=r"does not fit the network: .*proposals.stems.*same preset, rpn"
        ):
            load_exported(fast(_CLASSES, rpn), exported, _batch())
    with pytest.raises(InputError, match=r"does not fit the network: .*same preset, rpn"):
        load_exported(fast(_CLASSES), _export(_model("standard")), _batch())


def test_another_preset_is_reported(exported: bytes) -> None:
    with pytest.raises(InputError, match="does not fit the network"):
        load_exported(thesis_network(_CLASSES), exported, _batch())


def test_norms_that_do_not_learn_are_reported() -> None:
    torch.manual_seed(5)
    model = _model()
    model.backbone = ResNet50()
    with pytest.raises(InputError, match=r"batch norm behind backbone\.conv1 stays.*weights auto"):
        _load_layers_of(model)


def _load_layers_of(model: FasterRCNN) -> None:
    """Load a file that has every layer of the model, in its shape and by its name."""
    nodes, values = [], []
    for name, layer in model.named_modules():
        if isinstance(layer, torch.nn.Conv2d | torch.nn.Linear):
            scopes, dotted = [], name.split(".")
            for index in range(len(dotted)):
                scopes.append(".".join(dotted[: index + 1]))
            for part, shape in (("weight", layer.weight.shape), ("bias", layer.weight.shape[:1])):
                values.append(
                    onnx.numpy_helper.from_array(np.zeros(shape, np.float32), f"{name}.{part}")
                )
            kind = "Conv" if isinstance(layer, torch.nn.Conv2d) else "Gemm"
            inputs = ["image", f"{name}.weight", f"{name}.bias"]
            nodes.append(
                onnx.helper.make_node(kind, inputs, [name], "/" + "/".join([*scopes, kind]))
            )
    file = onnx.helper.make_model(onnx.helper.make_graph(nodes, "own", [], [], values))
    entry = file.metadata_props.add()
    entry.key, entry.value = "sorvolo", json.dumps({"classes": _CLASSES})
    load_exported(model, file.SerializeToString(), _batch())


@pytest.mark.long
def test_a_model_in_eight_bits_is_reported() -> None:
    small = find_model("default-int8").read_bytes()
    with pytest.raises(InputError, match="float32 model of the same preset"):
        load_exported(fast(_CLASSES), small, _batch())


@pytest.mark.parametrize("data", [b"", b"no model", b"\x08\x07"])
def test_what_is_no_model_of_ours_is_reported(data: bytes) -> None:
    with pytest.raises(InputError, match="damaged, or none that `sorvolo train` wrote"):
        load_exported(fast(_CLASSES), data, _batch())
