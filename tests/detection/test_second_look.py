"""A second look at reports: what stands it, what falls, what it costs, and who gets it."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toy_models import draw, info_of, rectangle_model

from sorvolo.detection.contract import SecondLook
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.detection.second_look import (
    CELL_PX,
    SAME_IOU,
    SHARE,
    SUREST,
    UNSEEN,
    cut_out,
    opinions,
    rescore,
)
from sorvolo.detection.session import Seen, Session, read_info
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.box_overlap import iou_matrix

HOW = {"looks_px": [34, 68], "own": 0.5, "again": 0.5, "shift": 0.0, "least": 0.5, "enlarged": 1.5}
_PERSON, _BOULDER = (40, 60, 160, 200), (240, 40, 400, 220)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rectangle_model(
        tmp_path_factory.mktemp("models") / "toy.onnx", second_look={"person": HOW}
    )


@pytest.fixture(scope="module")
def detector(model: Path) -> Detector:
    return Detector.load(model, provider="cpu", threads=1)


def pictured(labels: tuple[int, int] = (0, 0), score: int = 230) -> ImageRGB:
    """A filled rectangle, which is found at any size, and the outline of one, which is found as it is alone: shrunk,
    its edge of one pixel is too dim."""
    picture = draw((300, 480), [_PERSON, _BOULDER], labels=list(labels), scores=[score, score])
    left, top, right, bottom = _BOULDER
    picture[top + 1 : bottom - 1, left + 1 : right - 1] = 20
    return picture


def test_a_boulder_falls_and_a_person_stays(detector: Detector, tmp_path: Path) -> None:
    plain = Detector.load(rectangle_model(tmp_path / "plain.onnx"), provider="cpu", threads=1)
    assert len(plain.detect(pictured())) == 2, "at first both look like people"
    found = detector.detect(pictured())
    np.testing.assert_allclose(found.boxes_px, [_PERSON])
    assert found.scores[0] > 0.8
    own, unseen = math.log(230 / 25), math.log(0.02 / 0.98)
    fallen = 1 / (1 + math.exp(-0.5 * (own + unseen)))
    both = detector.detect(pictured(), least_score=0.0)
    np.testing.assert_allclose(both.boxes_px, [_PERSON, _BOULDER], err_msg="best first")
    assert both.scores[1] == pytest.approx(fallen, abs=0.01)


def test_other_classes_keep_their_score(detector: Detector) -> None:
    cars = detector.detect(pictured((1, 1)), least_score=0.0)
    np.testing.assert_allclose(cars.scores, [230 / 255] * 2, atol=1e-6)


def test_weak_reports_stay_behind_those_that_were_looked_at() -> None:
    """Nothing sees any of them again: their order is that of their first scores, on both sides of `least`."""
    count = 12
    boxes = np.array([[20 * n, 10, 20 * n + 15, 40] for n in range(count)], np.float32)
    seen = Seen(boxes, np.linspace(0.9, 0.1, count), np.zeros(count, np.int64))
    none = Seen(np.zeros((0, 4), np.float32), np.zeros(0), np.zeros(0, np.int64))
    how = SecondLook((34.0,), own=1.2, again=0.7, shift=-0.1, least=0.5, enlarged=9.0)
    after = rescore(seen, np.zeros((800, 800, 3), np.uint8), lambda sheet: none, {0: how})
    np.testing.assert_array_equal(after.boxes_px, boxes)
    assert (np.diff(after.scores) < 0).all() and after.scores[0] < seen.scores[0]


def test_no_report_is_so_sure_that_the_second_look_cannot_overrule_it() -> None:
    boxes = np.array([[20, 10, 40, 60], [80, 10, 100, 60], [140, 10, 160, 60]], np.float32)
    seen = Seen(boxes, np.array([0.9999, 0.99, 0.9]), np.zeros(3, np.int64))
    how = SecondLook((34.0,), own=1.0, again=1.0, shift=0.0, least=0.5, enlarged=9.0)
    none = Seen(np.zeros((0, 4), np.float32), np.zeros(0), np.zeros(0, np.int64))
    after = rescore(seen, np.zeros((300, 300, 3), np.uint8), lambda sheet: none, {0: how})
    unseen = math.log(UNSEEN / (1 - UNSEEN))
    most = 1 / (1 + math.exp(-math.log(SUREST / (1 - SUREST)) - unseen))
    np.testing.assert_allclose(after.scores[:2], most)
    assert after.scores[2] < most, "below that, the first look's order stays"


def test_the_packaged_opinion_answers_for_each_cut_out_in_its_cell() -> None:
    """A report of any shape overlaps one of its cell's boxes enough, and each cell has an answer of its own."""
    session = Session(find_model("second-opinion"), "cpu", 1)
    (look_px,) = read_info(find_model("default")).second_look["person"].looks_px
    rng = np.random.default_rng(3)
    picture = rng.integers(0, 255, (400, 500, 3), np.uint8)
    for rows, columns in ((1, 1), (1, 8), (3, 8)):
        cuts = []
        for _ in range(rows * columns):
            longer, aspect, is_wide = rng.uniform(10, 90), rng.uniform(0.15, 1), rng.random() < 0.5
            size = np.array([longer, longer * aspect] if is_wide else [longer * aspect, longer])
            corner = rng.uniform(0, np.array([500, 400]) - size)
            cuts.append(cut_out(picture, np.concatenate([corner, corner + size]), look_px))
        cells = np.stack([shown for shown, _ in cuts]).reshape(rows, columns, CELL_PX, CELL_PX, 3)
        seen = session.see(np.concatenate(np.concatenate(cells, axis=1), axis=1))
        for number, (_, box_px) in enumerate(cuts):
            row, column = divmod(number, columns)
            there = box_px + CELL_PX * np.array([column, row, column, row])
            overlaps = iou_matrix(there.astype(np.float32)[None], seen.boxes_px)[0]
            answers = set(seen.scores[overlaps >= SAME_IOU].tolist())
            assert len(answers) == 1, "one answer, its own"
        assert len(set(seen.scores.tolist())) == rows * columns


def test_tiles_judge_alike(detector: Detector) -> None:
    alone = detector.detect(pictured(), least_score=0.0)
    tiled = detector.detect(pictured(), least_score=0.0, tiles=320)
    np.testing.assert_allclose(tiled.boxes_px, alone.boxes_px)
    np.testing.assert_allclose(tiled.scores, alone.scores)


def test_a_model_of_one_size_looks_once(tmp_path: Path) -> None:
    path = rectangle_model(tmp_path / "fixed.onnx", fixed=(320, 480), second_look={"person": HOW})
    assert len(Detector.load(path, provider="cpu", threads=1).detect(pictured())) == 2


def test_a_crowd_costs_no_more_than_its_share() -> None:
    shown = []

    def sees(sheet: ImageRGB) -> Seen:
        shown.append(sheet.shape)
        return Seen(np.zeros((0, 4), np.float32), np.zeros(0), np.zeros(0, np.int64))

    how = {0: SecondLook((34.0, 17.0), 0.5, 0.5, 0.0, 0.5, 9.0)}
    boxes = np.array([[10 * n, 10, 10 * n + 8, 30] for n in range(60)], np.float32)
    crowd = Seen(boxes, np.linspace(0.99, 0.6, 60), np.zeros(60, np.int64))
    for size, cuts in {(640, 640): 8, (720, 1280): 14, (1500, 2000): 45, (3000, 4000): 96}.items():
        again = opinions(crowd, np.zeros((*size, 3), np.uint8), sees, how)
        assert sorted(again) == list(range(cuts // 2)), "the best reports"
        height, width, _ = shown.pop()
        assert height * width <= max(SHARE * size[0] * size[1], 8 * 128**2) + 8 * 128**2
    lone = rescore(crowd, np.zeros((640, 640, 3), np.uint8), sees, how)
    assert len(lone.scores) == 60 and (np.diff(lone.scores) <= 0).all()
    none = Seen(boxes[:0], np.zeros(0), np.zeros(0, np.int64))
    shown.clear()
    assert opinions(none, np.zeros((640, 640, 3), np.uint8), sees, how) == {} and not shown, (
        "nothing to look at"
    )


def test_each_position_shows_the_report_where_it_is_said_to_be_and_all_count_alike() -> None:
    """A bar with a mark at one end: upright, turned by a quarter, by two and mirrored, by three and mirrored."""
    picture = np.zeros((300, 300, 3), np.uint8)
    picture[100:180, 140:160] = 255
    picture[100:110, 140:145] = (255, 0, 0)
    bar = Seen(np.array([[140, 100, 160, 180]], np.float32), np.array([0.9]), np.zeros(1, np.int64))
    sheets: list[ImageRGB] = []

    def sees(sheet: ImageRGB) -> Seen:
        sheets.append(sheet)
        rows, columns = np.nonzero(sheet[..., 0] > 200)
        box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        return Seen(
            np.array([box], np.float32), np.array([0.1 * len(sheets)]), np.zeros(1, np.int64)
        )

    how = SecondLook((60.0,), own=0.0, again=1.0, shift=0.0, least=0.5, enlarged=9.0, positions=4)
    np.testing.assert_allclose(opinions(bar, picture, sees, {0: how})[0], [0.1, 0.2, 0.3, 0.4])
    upright, quarter, mirrored_half, mirrored_quarter = sheets
    np.testing.assert_array_equal(quarter, np.rot90(upright))
    np.testing.assert_array_equal(
        mirrored_half, upright[::-1], err_msg="half a turn, mirrored, is upside down"
    )
    np.testing.assert_array_equal(mirrored_quarter, np.rot90(upright, 3)[:, ::-1])
    sheets.clear()
    odds = np.log(np.array([0.1, 0.2, 0.3, 0.4]) / np.array([0.9, 0.8, 0.7, 0.6]))
    after = rescore(bar, picture, sees, {0: how})
    assert after.scores[0] == pytest.approx(1 / (1 + math.exp(-odds.mean()))), (
        "the mean of the positions' log-odds"
    )


def test_looks_that_would_only_blur_are_left_out() -> None:
    how = SecondLook((34.0, 68.0), 0.5, 0.5, 0.0, 0.5, enlarged=1.5)
    assert how.sides_px(10) == (34.0,), "the smallest stays"
    assert how.sides_px(40) == (34.0,) and how.sides_px(46) == (34.0, 68.0)


@pytest.mark.parametrize(
    "box", [(0, 0, 30, 20), (100, 70, 120, 80), (0, 0, 120, 80), (115, 75, 120, 80)]
)
def test_cut_outs_at_the_edge_show_the_report_where_it_is_said_to_be(
    box: tuple[int, int, int, int],
) -> None:
    picture = draw((80, 120), [box])
    for side_px in (34.0, 68.0):
        shown, there = cut_out(picture, np.array(box, float), side_px)
        assert shown.shape == (128, 128, 3)
        assert max(there[2:] - there[:2]) == pytest.approx(side_px, rel=0.15)
        rows, columns = np.nonzero((shown[..., 0] > 150) & (shown[..., 1] < 60))
        seen = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        assert np.abs(seen - there).max() <= 0.04 * 128


@pytest.mark.parametrize(
    "wrong",
    [
        {"dog": HOW},
        {"person": HOW | {"looks_px": []}},
        {"person": HOW | {"looks_px": [0]}},
        {"person": HOW | {"positions": 0}},
        {"person": HOW | {"positions": 5}},
        {"person": HOW | {"least": 1.5}},
        {"person": HOW | {"own": float("nan")}},
        {"person": {}},
        ["person"],
    ],
)
def test_weights_that_cannot_be(wrong: Any) -> None:
    with pytest.raises(InputError, match="cannot be used"):
        info_of(second_look=wrong)


def test_another_model_may_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its labels are its own; what it does not see falls, and what it sees by another name does not count."""
    monkeypatch.setenv("SORVOLO_MODELS", str(tmp_path))
    rectangle_model(tmp_path / "stranger.onnx", classes=("car", "person", "small object"))
    how = HOW | {"by": "stranger"}
    first = rectangle_model(tmp_path / "first.onnx", second_look={"person": how})
    alone = rectangle_model(tmp_path / "alone.onnx", second_look={"person": HOW})
    asked, self_asked = (Detector.load(each, provider="cpu", threads=1) for each in (first, alone))
    assert (
        asked.info.second_look["person"].by == "stranger"
        and self_asked.info.second_look["person"].by == ""
    )
    picture = pictured()
    by_itself = self_asked.detect(picture, least_score=0.0)
    by_another = asked.detect(picture, least_score=0.0)
    assert by_itself.scores[0] > 0.8
    # the stranger calls label 0 a car: it sees no person at all
    fallen = 1 / (1 + math.exp(-0.5 * (math.log(230 / 25) + math.log(0.02 / 0.98))))
    np.testing.assert_allclose(by_another.scores, [fallen] * 2, atol=0.01)
    asked.rest()
    np.testing.assert_allclose(asked.detect(picture, least_score=0.0).scores, by_another.scores)


def test_a_second_model_that_is_not_installed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SORVOLO_MODELS", str(tmp_path))
    path = rectangle_model(tmp_path / "first.onnx", second_look={"person": HOW | {"by": "nowhere"}})
    with pytest.raises(InputError, match="there is no model 'nowhere'; installed are"):
        Detector.load(path, provider="cpu", threads=1).detect(pictured())
