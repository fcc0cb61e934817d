"""Model files that are foreign, damaged or of another contract are refused in words; where models run."""

import json
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from toy_models import METADATA, draw, info_of, onnx, rectangle_model, write_model

from sorvolo.detection.models import find_model
from sorvolo.detection.session import Session, read_info, usable_cores
from sorvolo.errors import InputError, SettingsError


def _identity(
    path: Path, text: str, metadata: dict[str, Any] | None = METADATA, opset: int = 17
) -> Path:
    return write_model(
        onnx.parser.parse_model(f'<ir_version: 8, opset_import: ["" : {opset}]> {text}'),
        path,
        metadata,
    )


def _changed(path: Path, **fields: Any) -> Path:
    """The toy model with some fields of the file itself changed, unchecked."""
    model = onnx.load_model(rectangle_model(path))
    for name, value in fields.items():
        if name == "opset":
            model.opset_import[0].version = value
        else:
            setattr(model, name, value)
    path.write_bytes(model.SerializeToString())
    return path


def test_a_missing_or_other_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no model file"):
        Session(tmp_path / "gone.onnx")
    (tmp_path / "folder.onnx").mkdir()
    with pytest.raises(InputError, match="cannot be read"):
        Session(tmp_path / "folder.onnx")
    (tmp_path / "weights.pt").write_bytes(b"\x80\x04")
    with pytest.raises(InputError, match="run code"):
        Session(tmp_path / "weights.pt")


@pytest.mark.parametrize("provider", ["cpu", "openvino", "auto"])
def test_damaged_files(tmp_path: Path, provider: Any) -> None:
    if provider == "openvino":
        pytest.importorskip("openvino")
    whole = rectangle_model(tmp_path / "whole.onnx").read_bytes()
    for name, data in (
        ("empty", b""),
        ("cut", whole[: len(whole) // 2]),
        ("text", b"<html>not found</html>" * 20),
    ):
        path = tmp_path / f"{name}.onnx"
        path.write_bytes(data)
        with pytest.raises(InputError, match=f"{name}.onnx"):
            Session(path, provider)


def test_newer_files_than_the_runtime(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="update onnxruntime"):
        Session(_changed(tmp_path / "ir.onnx", ir_version=99), "cpu")
    with pytest.raises(InputError, match="update onnxruntime"):
        Session(_changed(tmp_path / "opset.onnx", opset=99), "cpu")


def test_a_foreign_model(tmp_path: Path) -> None:
    text = "other (float[1, 3, H, W] images) => (float[1, 3, H, W] output0) { output0 = Relu (images) }"
    with pytest.raises(InputError, match="sorvolo models import"):
        Session(_identity(tmp_path / "yolo.onnx", text, None), "cpu")
    with pytest.raises(InputError, match="takes images tensor\\(float\\)"):
        Session(_identity(tmp_path / "named.onnx", text), "cpu")


@pytest.mark.parametrize(
    ("shape", "reason"), [("4, 3, H, W", "1, 3, H, W"), ("1, 1, H, W", "1, 3, H, W"), ("1, 3, 64, W", "both free"),
                        ("1, 3, 50, 64", "stride is 32"), ("1, 3, H", "1, 3, H, W")],
)  # fmt: skip
def test_other_inputs(tmp_path: Path, shape: str, reason: str) -> None:
    text = f"""m (uint8[{shape}] image) => (float[K, 4] boxes, float[K] scores, int64[K] labels) {{
      boxes = Constant <value = float[1, 4] {{0, 0, 1, 1}}> ()
      scores = Constant <value_floats = [0.5]> ()
      labels = Constant <value_ints = [0]> () }}"""
    with pytest.raises(InputError, match=reason):
        read_info(_identity(tmp_path / "m.onnx", text))


def test_missing_outputs_and_answers_that_break_the_contract(tmp_path: Path) -> None:
    start = "m (uint8[1, 3, H, W] image) => "
    with pytest.raises(InputError, match="gives no labels, scores"):
        Session(
            _identity(tmp_path / "a.onnx", start + "(int64[4] boxes) { boxes = Shape (image) }"),
            "cpu",
        )
    wrong = (
        start
        + """(float[K, 4] boxes, float[K] scores, int64[K] labels) {
      boxes = Constant <value = float[1, 4] {0, 0, 1, 1}> ()
      scores = Constant <value_floats = [0.5]> ()
      labels = Constant <value_ints = [7]> () }"""
    )
    with pytest.raises(InputError, match="label 7"):
        Session(_identity(tmp_path / "b.onnx", wrong), "cpu").see(np.zeros((8, 8, 3), np.uint8))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"format": 4}, "update sorvolo"),
        ({"classes": []}, "classes"),
        ({"classes": ["person", "person"]}, "classes"),
        ({"thresholds": {"person": 0.5}}, "it lacks 'car'"),
        ({"best_px": {"person": [9, 3], "car": [1, 2], "small object": [1, 2]}}, "best_px"),
        ({"stride": 0}, "stride"),
        ({"on_request": ["dog"]}, "on_request must be some of its classes"),
        ({"on_request": ["person", "car", "small object"]}, "on_request must be some"),
        ({"thresholds": None}, "cannot be used"),
    ],
)
def test_metadata_that_contradicts_itself(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        info_of(**fields)


def test_metadata_that_is_no_json(tmp_path: Path) -> None:
    path = rectangle_model(tmp_path / "toy.onnx")
    model = onnx.load_model(path)
    for text in ("{", json.dumps([1])):
        onnx.helper.set_model_props(model, {"sorvolo": text})
        path.write_bytes(model.SerializeToString())
        with pytest.raises(InputError, match="cannot be used"):
            Session(path, "cpu")


def test_providers_and_threads(tmp_path: Path) -> None:
    path = rectangle_model(tmp_path / "toy.onnx")
    with pytest.raises(SettingsError, match="there are auto, cpu"):
        Session(path, "tpu")  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="thread"):
        Session(path, "cpu", 0)
    if "CUDAExecutionProvider" not in onnxruntime.get_available_providers():
        with pytest.raises(SettingsError, match="onnxruntime-gpu"):
            Session(path, "cuda")
    assert 1 <= usable_cores() <= 4096


def test_a_model_that_openvino_refuses_runs_all_the_same(tmp_path: Path) -> None:
    pytest.importorskip("openvino")
    text = """m (uint8[1, 3, H, W] image) => (float[K, 4] boxes, float[K] scores, int64[K] labels) {
      boxes = Constant <value = float[1, 4] {0, 0, 1, 1}> ()
      half = Constant <value = float[1, 1, 1] {0.5}> ()
      scores = Det (half)
      labels = Constant <value_ints = [0]> () }"""
    path = _identity(tmp_path / "det.onnx", text)
    with pytest.raises(InputError, match="OpenVINO refuses it"):
        Session(path, "openvino", 1)
    opened = Session(path, "auto", 1)
    assert opened.provider == "ONNX Runtime on the CPU, 1 thread, since OpenVINO refuses the model"
    assert opened.see(np.zeros((8, 8, 3), np.uint8)).scores.tolist() == [0.5]


def test_padding_is_what_training_fills_with(tmp_path: Path) -> None:
    opened = Session(rectangle_model(tmp_path / "toy.onnx"), "cpu")
    rng = np.random.default_rng(0)
    for size in ((33, 65), (5, 7), (64, 32)):
        picture = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
        batch = opened._padded(opened._shown(picture, 1.0))
        assert batch.shape[2] % 32 == batch.shape[3] % 32 == 0
        expected = np.full((*batch.shape[2:], 3), 114)
        expected[: size[0], : size[1]] = picture
        np.testing.assert_array_equal(batch[0], expected.transpose(2, 0, 1))


def test_seen_from_several_threads(tmp_path: Path) -> None:
    from concurrent.futures import ThreadPoolExecutor

    opened = Session(rectangle_model(tmp_path / "toy.onnx"), "cpu")
    boxes = [(x, x, x + 10, x + 10) for x in range(0, 60, 3)]
    with ThreadPoolExecutor(4) as pool:
        seen = list(
            pool.map(opened.see, [draw((80 + x % 7, 90), [box]) for x, box in enumerate(boxes)])
        )
    np.testing.assert_allclose(np.concatenate([each.boxes_px for each in seen]), boxes)


def test_a_session_that_rests_gives_memory_back_and_sees_as_before(tmp_path: Path) -> None:
    with ProcessPoolExecutor(
        1, get_context("spawn")
    ) as alone:  # what others left in this process hides it
        full_mb, rested_mb, is_same = alone.submit(_rested).result()
    assert rested_mb < full_mb - 30 and is_same
    fixed = Session(rectangle_model(tmp_path / "fixed.onnx", fixed=(64, 96)), "cpu", 1)
    fixed.rest()
    assert len(fixed.see(draw((64, 96), [(10, 20, 30, 50)])).scores) == 1


def _rested() -> tuple[float, float, bool]:
    """Memory after a look and after a rest, and whether the next look shows the same."""
    session = Session(find_model("default"), "cpu", 1)
    picture = np.random.default_rng(5).integers(0, 255, (960, 1280, 3), np.uint8)
    before = session.see(picture)
    full_mb = _resident_mb()
    session.rest()
    rested_mb = _resident_mb()
    after = session.see(picture)
    is_same = (
        after.boxes_px.tolist() == before.boxes_px.tolist()
        and after.scores.tolist() == before.scores.tolist()
    )
    return full_mb, rested_mb, is_same


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
