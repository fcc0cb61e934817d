"""Pictures of unknown scale searched in several sizes: which look is believed, and when one look is enough."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toy_models import draw, info_of, rectangle_model

from sorvolo.detection.contract import Pyramid
from sorvolo.detection.detector import Detector
from sorvolo.detection.fusing import agreed_in_sizes, trust
from sorvolo.detection.session import Seen, Session
from sorvolo.detection.tiling import MOST_MAGNIFIED_PX, closer_for
from sorvolo.errors import InputError

_BOXES = [(20, 40, 60, 80), (140, 60, 170, 90)]
_SIZES = {"times": [0.5, 2], "known_px": 32, "octaves": 1, "shift": 0}


def _seen(*rows: tuple[tuple[float, float, float, float], float, int]) -> Seen:
    return Seen(
        np.array([box for box, _, _ in rows], np.float32).reshape(-1, 4),
        np.array([score for _, score, _ in rows]),
        np.array([label for _, _, label in rows], np.int64),
    )


def test_the_look_that_shows_an_object_at_the_known_size_counts_most() -> None:
    pyramid = Pyramid((2.0, 4.0), 32.0, 1.0, 0.0)
    boxes = np.array([[0, 0, 16, 16], [0, 0, 8, 8], [0, 0, 4000, 4000]], np.float32)
    shares = trust(boxes, np.array([1.0, 2.0, 4.0]), pyramid)
    np.testing.assert_allclose(shares.sum(axis=1), 1)
    curve = np.exp([-0.5, 0, -0.5])
    np.testing.assert_allclose(shares[0], curve / curve.sum(), rtol=1e-5)
    assert shares[1].argmax() == 2 and shares[2].argmax() == 0
    assert shares[2, 0] > 0.99 and (shares > 0).all()


def test_log_odds_are_averaged_by_trust_and_what_a_look_does_not_show_counts_against() -> None:
    pyramid = Pyramid((2.0,), 32.0, 1.0, 0.0)
    small = (
        100.0,
        100.0,
        116.0,
        116.0,
    )  # 16 px: the look that shows it twice as large knows it best
    shares = trust(np.array([small], np.float32), np.array([1.0, 2.0]), pyramid)[0]
    both = agreed_in_sizes([_seen((small, 0.5, 0)), _seen((small, 0.9, 0))], (1.0, 2.0), 0, pyramid)
    assert len(both.scores) == 1
    assert both.scores[0] == pytest.approx(1 / (1 + math.exp(-shares[1] * math.log(9))), rel=1e-6)
    more = agreed_in_sizes(
        [_seen((small, 0.5, 0)), _seen((small, 0.9, 0))], (1.0, 2.0), 0, replace(pyramid, shift=0.6)
    )
    assert np.log(more.scores / (1 - more.scores)) == pytest.approx(
        shares[1] * math.log(9) + 0.6, rel=1e-6
    )
    one = agreed_in_sizes([_seen(), _seen((small, 0.9, 0))], (1.0, 2.0), 0, pyramid)
    other = agreed_in_sizes([_seen((small, 0.9, 0)), _seen()], (1.0, 2.0), 0, pyramid)
    assert both.scores[0] > one.scores[0] > other.scores[0]
    np.testing.assert_allclose(one.boxes_px, [small])


def test_objects_of_one_class_stay_apart_and_other_classes_are_left_out() -> None:
    pyramid = Pyramid((2.0,), 32.0, 1.0, 0.0)
    near, far = (0.0, 0.0, 20.0, 20.0), (200.0, 0.0, 220.0, 20.0)
    looks = [_seen((near, 0.8, 0), (far, 0.6, 1)), _seen((far, 0.9, 0), (near, 0.7, 0))]
    people = agreed_in_sizes(looks, (1.0, 2.0), 0, pyramid)
    assert people.labels.tolist() == [0, 0]
    assert people.scores[0] > people.scores[1], "best first: both looks show the near one"
    np.testing.assert_allclose(people.boxes_px, [near, far])
    assert len(agreed_in_sizes([_seen(), _seen()], (1.0, 2.0), 0, pyramid).scores) == 0


@pytest.mark.parametrize(
    ("asked", "sizes"),
    [
        ({}, {1.0}),
        ({"tiles": "auto"}, {0.5, 1.0, 2.0}),
        ({"tiles": "auto", "overlapping": True}, {1.0}),
        ({"tiles": "auto", "classes": ["car"]}, {1.0}),
        ({"tiles": 128}, {1.0}),
    ],
)
def test_only_a_picture_by_itself_of_unknown_scale_is_searched_in_several_sizes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: dict[str, Any], sizes: set[float]
) -> None:
    shown = _shown_sizes(monkeypatch)
    detector = Detector.load(
        rectangle_model(tmp_path / "toy.onnx", pyramid={"person": _SIZES}),
        provider="cpu",
        threads=1,
    )
    picture = draw((120, 200), _BOXES, labels=[0, 1], scores=[200, 200])
    found = detector.detect(picture, **asked)
    assert set(shown) == sizes
    assert set(found.names) <= {"person", "car"} and "car" in found.names
    np.testing.assert_allclose(found.boxes_px[found.names.index("car")], _BOXES[1])


def test_a_closer_look_counts_only_for_what_it_knows_best() -> None:
    pyramid = Pyramid((2.0,), 32.0, 1.0, 0.0, closer=(4.0,))
    boxes, times = np.array([[0, 0, 9, 9], [0, 0, 14, 14]], np.float32), np.array([1.0, 2.0, 4.0])
    small, large = trust(boxes, times, pyramid)
    assert small.argmax() == 2 and small[1] > 0.3
    assert large[2] < 1e-5
    np.testing.assert_allclose(large[:2], trust(boxes, times[:2], pyramid)[1], rtol=1e-4)


@pytest.mark.parametrize(
    ("side_px", "label", "score", "closer"),
    [
        (8, 0, 0.8, {4.0: ("person",)}),
        (14, 0, 0.8, {}),
        (8, 0, 0.2, {}),
        (8, 1, 0.8, {}),
    ],
)
def test_a_closer_look_is_taken_where_a_class_of_it_is_surely_seen_and_small(
    tmp_path: Path, side_px: int, label: int, score: float, closer: dict[float, tuple[str, ...]]
) -> None:
    """Twice and four times as large are as good for 11.3 px, the one for what is larger, the other for what is not."""
    sizes = {"person": _SIZES | {"closer": [4]}, "car": _SIZES}
    info = Detector.load(
        rectangle_model(tmp_path / "toy.onnx", pyramid=sizes), provider="cpu", threads=1
    ).info
    seen = _seen(((10.0, 10.0, 10.0 + side_px, 10.0 + side_px), score, label))
    looks, times = [_seen(), _seen(), seen], (1.0, 0.5, 2.0)
    assert closer_for((120, 200), info, info.classes, "auto", math.nan, looks, times) == closer
    assert not closer_for((120, 200), info, info.classes, "auto", 0.1, looks, times)
    assert not closer_for((3000, 4000), info, info.classes, "auto", math.nan, looks, times)


def test_a_picture_with_small_people_is_shown_once_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = _shown_sizes(monkeypatch)
    sizes = {"person": _SIZES | {"closer": [4]}}
    detector = Detector.load(
        rectangle_model(tmp_path / "toy.onnx", pyramid=sizes), provider="cpu", threads=1
    )
    small, car = (60, 40, 68, 48), _BOXES[1]
    detector.detect(draw((120, 200), [small, car], labels=[0, 1], scores=[200, 200]), tiles="auto")
    assert shown == [1.0, 0.5, 2.0, 4.0]


def test_a_known_scale_needs_no_other_sizes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = _shown_sizes(monkeypatch)
    detector = Detector.load(
        rectangle_model(tmp_path / "toy.onnx", pyramid={"person": _SIZES}),
        provider="cpu",
        threads=1,
    )
    picture = draw((120, 200), _BOXES, labels=[0, 1], scores=[200, 200])
    assert "person" in detector.detect(picture, tiles="auto", m_per_px=0.03).names
    assert len(set(shown)) == 1


def test_a_small_thermal_frame_is_shown_larger_in_every_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = _shown_sizes(monkeypatch)
    detector = Detector.load(
        rectangle_model(tmp_path / "toy.onnx", pyramid={"person": _SIZES}),
        provider="cpu",
        threads=1,
    )
    detector.detect(np.zeros((120, 200), np.uint8), tiles="auto")
    assert set(shown) == {0.75, 1.5, 3.0}


def test_a_large_picture_is_not_magnified(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = _shown_sizes(monkeypatch)
    detector = Detector.load(
        rectangle_model(tmp_path / "toy.onnx", pyramid={"person": _SIZES}),
        provider="cpu",
        threads=1,
    )
    side_px = math.isqrt(MOST_MAGNIFIED_PX // 4) + 8
    detector.detect(np.zeros((side_px, side_px, 3), np.uint8), tiles="auto")
    assert set(shown) == {0.5, 1.0}


def test_a_class_of_which_no_other_size_is_left_keeps_its_scores(tmp_path: Path) -> None:
    magnified, smaller = _SIZES | {"times": [3], "shift": 2}, _SIZES | {"times": [0.5], "shift": 2}
    model = rectangle_model(tmp_path / "toy.onnx", pyramid={"person": magnified, "car": smaller})
    detector = Detector.load(model, provider="cpu", threads=1)
    side_px = math.isqrt(MOST_MAGNIFIED_PX // 9) + 8
    picture = draw((side_px, side_px), _BOXES, labels=[0, 1], scores=[200, 200])
    once, found = (detector.detect(picture, tiles=tiles) for tiles in (None, "auto"))
    person, car = (found.names.index(name) for name in ("person", "car"))
    assert found.scores[person] == once.scores[once.names.index("person")]
    assert found.scores[car] > once.scores[once.names.index("car")]


@pytest.mark.parametrize(
    "wrong",
    [
        {"times": []},
        {"times": [9]},
        {"times": [-1]},
        {"times": [1]},
        {"known_px": 0},
        {"octaves": math.inf},
        {"shift": math.nan},
        {"closer": [2]},
        {"closer": [5]},
        {"closer": [0.5]},
    ],
)
def test_a_pyramid_that_cannot_be_is_an_error(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match="its pyramid must"):
        info_of(pyramid={"person": _SIZES | wrong})


def _shown_sizes(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The scales at which pictures are shown to models from now on."""
    shown: list[float] = []
    sees = Session.see

    def see(self: Session, picture: Any, scale: float = 1.0) -> Seen:
        shown.append(scale)
        return sees(self, picture, scale)

    monkeypatch.setattr(Session, "see", see)
    return shown
