"""Pictures from straight above looked at twice: boxes come back to their place, and both looks must agree."""

from pathlib import Path

import numpy as np
import pytest
from toy_models import draw, rectangle_model

from sorvolo.detection.detector import Detector
from sorvolo.detection.fusing import agreed, is_from_above, turned, turned_back
from sorvolo.detection.session import Seen
from sorvolo.errors import InputError
from sorvolo.geometry.pose import site_from_gimbal_rotation

_BOXES = [(10, 20, 50, 80), (170, 60, 200, 90)]
_TURNED = {"person": 0.9, "car": 0.4, "small object": 0.6}


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_boxes_of_a_turned_picture_lie_where_the_things_are(quarters: int) -> None:
    picture = np.zeros((60, 100, 3), np.uint8)
    picture[5:15, 70:90] = 255
    rows, columns = np.nonzero(turned(picture, quarters)[..., 0])
    box = np.array([[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]], np.float32)
    np.testing.assert_array_equal(turned_back(box, quarters, (60, 100)), [[70, 5, 90, 15]])


def _seen(*rows: tuple[tuple[int, int, int, int], float, int]) -> Seen:
    return Seen(
        np.array([box for box, _, _ in rows], np.float32).reshape(-1, 4),
        np.array([score for _, score, _ in rows]),
        np.array([label for _, _, label in rows], np.int64),
    )


def test_what_both_looks_show_counts_more_than_what_one_shows() -> None:
    one = _seen(((0, 0, 20, 20), 0.9, 0), ((100, 0, 120, 20), 0.6, 0), ((50, 50, 60, 60), 0.3, 1))
    other = _seen(((101, 0, 121, 20), 0.8, 0), ((50, 50, 60, 60), 0.7, 0))
    both = agreed([one, other])
    np.testing.assert_allclose(both.scores, [0.7, 0.46, 0.36, 0.16], atol=1e-9)
    assert both.labels.tolist() == [0, 0, 0, 1], "classes stay apart"
    np.testing.assert_allclose(
        both.boxes_px[0], [100 + 0.8 / 1.4, 0, 120 + 0.8 / 1.4, 20], rtol=1e-5
    )
    assert len(agreed([_seen(), _seen()]).scores) == 0


def test_a_model_that_asks_for_it_looks_twice_from_above(tmp_path: Path) -> None:
    detector = Detector.load(
        rectangle_model(tmp_path / "toy.onnx", turned=_TURNED), provider="cpu", threads=1
    )
    picture = draw((120, 200), _BOXES, labels=[0, 1], scores=[200, 200])
    assert detector.detect(picture).names == ["person", "car"]
    found = detector.detect(picture, from_above=True)
    assert found.names == ["car"], "0.78 is below the turned threshold of people"
    np.testing.assert_allclose(found.boxes_px, [_BOXES[1]])
    assert detector.thresholds_for(picture, from_above=True)["person"] == 0.9
    assert detector.thresholds_for(picture)["person"] == 0.5
    once = Detector.load(rectangle_model(tmp_path / "once.onnx"), provider="cpu", threads=1)
    assert once.detect(picture, from_above=True).names == ["person", "car"]


def test_turned_thresholds_must_name_every_class(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="lacks 'small object'"):
        Detector.load(
            rectangle_model(tmp_path / "toy.onnx", turned={"person": 0.5, "car": 0.5}),
            provider="cpu",
        )


@pytest.mark.parametrize(
    ("pitch_deg", "above"), [(-90, True), (-60, True), (-45, False), (0, False)]
)
def test_which_cameras_look_down(pitch_deg: float, above: bool) -> None:
    assert is_from_above(site_from_gimbal_rotation(30.0, pitch_deg, 0.0)) == above
