"""Networks of other makers: told by their outputs, decoded as their makers do, installed under a name."""

import json
from pathlib import Path

import numpy as np
import pytest
from toy_models import onnx, rectangle_model, write_model

from sorvolo.cli.main import main
from sorvolo.detection.detector import Detector
from sorvolo.detection.layouts import COCO, _columns
from sorvolo.detection.models import FOLDER_VARIABLE, find_model, installed_model, integrity
from sorvolo.detection.session import Session, adopted, read_info
from sorvolo.errors import InputError

SIDE_PX = 128
CELLS = sum((SIDE_PX // stride) ** 2 for stride in (8, 16, 32))
RED = np.tile(np.array([255, 0, 0], np.uint8), (SIDE_PX, SIDE_PX, 1))


def network(path: Path, metadata: dict[str, str] | None = None, **outputs: np.ndarray) -> Path:
    """A network of one input size that gives these arrays, each times one plus a thousandth of its input's first band's
    mean: what it is shown matters, and how colours are given."""
    ports = ", ".join(
        f"{'int64' if each.dtype.kind == 'i' else 'float'}[{', '.join(map(str, each.shape))}] {name}"
        for name, each in outputs.items()
    )
    lines = "".join(
        f"{name} = Identity (raw_{name})\n"
        if each.dtype.kind == "i"
        else f"{name} = Mul (raw_{name}, factor)\n"
        for name, each in outputs.items()
    )
    text = f"""<ir_version: 8, opset_import: ["" : 17]>
    net (float[1, 3, {SIDE_PX}, {SIDE_PX}] images) => ({ports}) {{
      first = Constant <value_ints = [0]> ()
      thousandth = Constant <value_float = 0.001> ()
      unit = Constant <value_float = 1.0> ()
      band = Gather <axis = 1> (images, first)
      mean = ReduceMean <keepdims = 0> (band)
      part = Mul (mean, thousandth)
      factor = Add (unit, part)
      {lines} }}"""
    model = onnx.parser.parse_model(text)
    for name, each in outputs.items():
        kind = np.int64 if each.dtype.kind == "i" else np.float32
        model.graph.initializer.append(
            onnx.numpy_helper.from_array(each.astype(kind), f"raw_{name}")
        )
    if metadata:
        onnx.helper.set_model_props(model, metadata)
    return write_model(model, path, None)


def seen(path: Path, layout: str = "auto", classes: tuple[str, ...] | None = None) -> Session:
    return Session(path, "cpu", 1, adopted(path, layout, classes))


def yolov8_rows(*found: tuple[float, float, float, float, int, float]) -> np.ndarray:
    """(1, 84, CELLS) of boxes by centre, sides, class and score; the rest scores nothing."""
    raw = np.zeros((1, 84, CELLS))
    for column, (x, y, width, height, label, score) in enumerate(found):
        raw[0, :4, 3 * column], raw[0, 4 + label, 3 * column] = (x, y, width, height), score
    return raw


def test_yolov8_boxes_are_suppressed_and_named_as_coco(tmp_path: Path) -> None:
    raw = yolov8_rows((40, 50, 20, 30, 0, 0.8), (41, 50, 20, 30, 0, 0.6), (90, 80, 40, 20, 2, 0.7))
    session = seen(network(tmp_path / "y8.onnx", output0=raw))
    assert session.info.layout == "yolov8" and session.info.columns == tuple(
        name.replace("_", " ") for name in COCO
    )
    assert session.info.usual_classes == (
        "person", "bicycle", "car", "motorcycle", "bus", "truck", "boat",
    )  # fmt: skip
    found, factor = session.see(RED), 1.001  # red is band 0, of 1 where it is full
    assert [session.info.classes[label] for label in found.labels] == ["person", "car"]
    assert found.scores == pytest.approx([0.8 * factor, 0.7 * factor], abs=1e-5)
    wanted = np.array([[30, 35, 50, 65], [70, 70, 110, 90]]) * factor
    assert np.abs(found.boxes_px - wanted).max() < 0.01


def test_yolov5_and_yolox_weigh_a_class_by_whether_anything_is_there(tmp_path: Path) -> None:
    raw = np.zeros((1, 3 * CELLS, 7))
    raw[0, 11] = [64, 32, 20, 10, 0.5, 0.2, 0.9]
    session = seen(network(tmp_path / "y5.onnx", output=raw), classes=("pedestrian", "van"))
    assert (session.info.layout, session.info.classes) == ("yolov5", ("person", "car"))
    found = session.see(np.zeros_like(RED))
    assert found.labels[0] == 1 and found.scores[0] == pytest.approx(0.45)
    assert found.boxes_px[0] == pytest.approx([54, 27, 74, 37], abs=0.01)
    raw = np.zeros((1, CELLS, 7))
    cell = (SIDE_PX // 8) ** 2 + 2 * (SIDE_PX // 16) + 3  # level of 16 px, row 2, column 3
    raw[0, cell] = [0.5, 0.25, np.log(2.0), np.log(1.5), 0.8, 0.9, 0.0]
    path = network(tmp_path / "x.onnx", output=raw)
    session = seen(path, classes=("person", "car"))
    assert session.info.layout == "yolox"
    found = session.see(np.zeros_like(RED))
    middle, half = np.array([3.5 * 16, 2.25 * 16]), np.array([16.0, 12.0])
    assert found.boxes_px[0] == pytest.approx([*(middle - half), *(middle + half)], abs=0.01)
    blue = RED[:, :, ::-1].copy()  # band 0 of YOLOX is blue, as it is
    assert session.see(blue).scores[0] == pytest.approx(0.72 * 1.255**2, rel=1e-4)


def test_nanodet_boxes_are_means_of_distances(tmp_path: Path) -> None:
    cells = CELLS + (SIDE_PX // 64) ** 2
    raw = np.full((1, cells, 2 + 32), -50.0)
    raw[0, :, :2] = 0.0
    row, column, stride = 1, 1, 32
    at = (SIDE_PX // 8) ** 2 + (SIDE_PX // 16) ** 2 + row * (SIDE_PX // 32) + column
    raw[0, at, 1] = 0.9
    for side, bins in enumerate(((1,), (0, 1), (2, 3), (0,))):  # equal shares of these bins
        raw[0, at, [2 + 8 * side + each for each in bins]] = 10.0
    session = seen(network(tmp_path / "n.onnx", output=raw), classes=("person", "car"))
    assert session.info.layout == "nanodet"
    found = session.see(np.zeros_like(RED))
    x, y = column * stride, row * stride
    wanted = [x - 1.0 * stride, y - 0.5 * stride, x + 2.5 * stride, y]
    assert session.info.classes[found.labels[0]] == "car"
    assert found.boxes_px[0] == pytest.approx(wanted, abs=0.01)
    # band 0 is blue, less its mean
    assert found.scores[0] == pytest.approx(0.9 * (1 - 0.001 * 103.53 / 57.375), rel=1e-5)


@pytest.mark.parametrize("form", ["one output", "logits", "labels", "rfdetr"])
def test_detr_boxes_are_shares_of_the_picture(tmp_path: Path, form: str) -> None:
    boxes, scores = np.zeros((1, 50, 4)), np.full((1, 50, 3), 0.001)
    boxes[0, 7], scores[0, 7, 2] = (0.5, 0.25, 0.25, 0.125), 0.75
    logits = np.log(scores / (1 - scores))
    wanted = np.array([0.375, 0.1875, 0.625, 0.3125]) * SIDE_PX
    path, classes = tmp_path / "d.onnx", ("deer", "person", "car")
    if form == "one output":
        session = seen(network(path, output0=np.concatenate([boxes, scores], 2)), classes=classes)
    elif form == "labels":
        labels = np.zeros((1, 50), np.int64)
        labels[0, 7] = 2
        pixels = np.zeros((1, 50, 4))
        pixels[0, 7] = wanted
        sure = scores.max(axis=2)
        session = seen(network(path, labels=labels, boxes=pixels, scores=sure), classes=classes)
    else:
        names = ("dets", "labels") if form == "rfdetr" else ("pred_boxes", "logits")
        session = seen(network(path, **dict(zip(names, (boxes, logits)))), classes=classes)
    assert session.info.layout == ("rfdetr" if form == "rfdetr" else "rtdetr")
    assert session.info.usual_classes == ("person", "car")  # deer on request
    found = session.see(np.zeros_like(RED))
    assert [session.info.classes[label] for label in found.labels] == ["car"]
    assert np.abs(found.boxes_px[0] - wanted).max() < 1
    assert found.scores[0] == pytest.approx(0.75, abs=0.01)


def test_a_network_that_suppresses_itself(tmp_path: Path) -> None:
    raw = np.zeros((1, 300, 6))
    raw[0, 0] = [10, 20, 50, 60, 0.9, 2]
    names = {"names": str(dict(enumerate(COCO)))}
    found = seen(network(tmp_path / "e.onnx", names, output0=raw)).see(np.zeros_like(RED))
    assert len(found.scores) == 1 and found.boxes_px[0] == pytest.approx([10, 20, 50, 60])


def test_what_cannot_be_told_is_refused_with_what_to_give(tmp_path: Path) -> None:
    two = network(tmp_path / "two.onnx", output0=np.zeros((1, 300, 6)))
    with pytest.raises(InputError, match="layout"):
        adopted(two)
    assert read_layout(two, "yolov10") == "yolov10"
    three = network(tmp_path / "three.onnx", output0=np.zeros((1, 7, CELLS)))
    with pytest.raises(InputError, match=r"tells 3 classes apart and it names none; .*classes"):
        adopted(three)
    with pytest.raises(InputError, match=r"tells 3 classes apart and 2 are named"):
        adopted(three, "yolov8", ("person", "car"))
    with pytest.raises(InputError, match="which is no nanodet"):
        adopted(three, "nanodet")
    with pytest.raises(InputError, match="no layout 'ssd'"):
        adopted(three, "ssd")
    odd = network(tmp_path / "odd.onnx", scores=np.zeros((1, 10)))
    with pytest.raises(InputError, match=r"scores \[1, 10\]"):
        adopted(odd)
    with pytest.raises(InputError, match="sorvolo models import"):
        Session(two)


def read_layout(path: Path, layout: str) -> str:
    return json.loads(adopted(path, layout).rpartition(b"sorvolo\x12")[2][2:])["layout"]


def test_an_imported_network_is_a_model_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "models"))
    raw = yolov8_rows((40, 50, 20, 30, 0, 0.8))
    path = network(tmp_path / "yolo11n.onnx", output0=raw)
    assert main(["models", "import", str(path), "--name", "field"]) == 0
    assert "finds person, bicycle, car" in capsys.readouterr().out
    assert integrity(installed_model("field")).value == "good"
    assert read_info(find_model("field")).name == "field"
    assert main(["models", "import", str(path), "--name", "field"]) == 1
    assert "installed already" in capsys.readouterr().err
    kept, direct = (
        maker.detect(RED, tiles=None)
        for maker in (Detector.load("field"), Detector.from_onnx(path))
    )
    assert kept.names == direct.names == ["person"]
    assert (kept.boxes_px == direct.boxes_px).all()


def test_our_own_model_is_not_imported_again(tmp_path: Path) -> None:
    path = rectangle_model(tmp_path / "own.onnx")
    with pytest.raises(InputError, match="is a model of Sorvolo already"):
        adopted(path)


def test_networks_of_91_classes_have_cocos_ids() -> None:
    names = _columns((), 91, "net.onnx")
    assert [names.index(each) for each in ("person", "bottle", "wine glass", "toothbrush")] == [
        1,
        44,
        46,
        90,
    ]
    assert len([each for each in names if each]) == len(COCO)
