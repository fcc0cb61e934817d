"""Tiles and scale, and a tiled picture that gives what the whole one gives."""

import math
from itertools import pairwise, product

import numpy as np
import pytest
from toy_models import draw, rectangle_model

from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.detector import Detector
from sorvolo.detection.tiling import (
    MOST_AT_ONCE_PX,
    MOST_WHOLE_PX,
    TASK,
    looks_for,
    plan_tiles,
    scale_for,
    whole_m_per_px,
)
from sorvolo.errors import SettingsError
from sorvolo.geometry.planning import BOTTOM_CRITICAL_M, required_px_per_m
from sorvolo.survey.objects import CLASSES

_BEST_PX = {"person": (6.0, 120.0), "car": (16.0, 200.0), "small object": (8.0, 80.0)}
_INFO = ModelInfo("m", CLASSES, dict.fromkeys(CLASSES, 0.5), _BEST_PX)


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    return Detector.load(
        rectangle_model(tmp_path_factory.mktemp("m") / "toy.onnx"), provider="cpu", threads=1
    )


def _rows(boxes: np.ndarray, labels: object) -> list[tuple[int, ...]]:
    return sorted(
        (*np.rint(box).astype(int).tolist(), int(label))
        for box, label in zip(boxes, np.asarray(labels))
    )


class TestScale:
    def test_a_person_always_covers_what_the_task_asks(self) -> None:
        """Johnson's criteria, as `sorvolo plan` has them: where the picture shows too few pixels, it is magnified."""
        needed = required_px_per_m(TASK, BOTTOM_CRITICAL_M)
        for m_per_px in (0.11, 0.15, 0.25):
            scale = scale_for(_INFO, m_per_px, CLASSES)
            assert scale > 1 and scale / m_per_px >= needed - 1e-9
            assert 0.6 * scale / m_per_px >= _BEST_PX["person"][0] - 1e-9

    def test_good_pictures_stay_as_they_are(self) -> None:
        for m_per_px in (0.015, 0.03, 0.08):
            assert scale_for(_INFO, m_per_px, CLASSES) == 1

    def test_very_low_flights_are_made_smaller(self) -> None:
        m_per_px = 1.7 / 300  # a person of 300 px
        scale = scale_for(_INFO, m_per_px, CLASSES)
        assert 300 * scale == pytest.approx(_BEST_PX["person"][1])

    def test_no_more_than_three_times(self) -> None:
        assert scale_for(_INFO, 1.0, CLASSES) == 3

    @pytest.mark.parametrize(
        ("size_px", "shown"), [((540, 960), 2.15), ((1080, 1920), 1.08), ((2160, 3840), 1.0)]
    )
    def test_frames_of_a_video_are_magnified_to_one_tile_at_most(
        self, size_px: tuple[int, int], shown: float
    ) -> None:
        m_per_px = whole_m_per_px(_INFO, CLASSES, 0.25, size_px)
        assert scale_for(_INFO, m_per_px, CLASSES) == pytest.approx(shown, abs=0.01)
        assert (
            len(plan_tiles(size_px, _INFO, CLASSES, m_per_px=m_per_px).places_px) == 1
            or shown == 1.0
        )
        assert whole_m_per_px(_INFO, CLASSES, 0.01, size_px) == 0.01

    def test_cars_alone_need_less(self) -> None:
        assert scale_for(_INFO, 0.2, ["car"]) == 1 < scale_for(_INFO, 0.2, CLASSES)
        other = ModelInfo("m", ("boat",), {"boat": 0.5}, {"boat": (9.0, 90.0)})
        assert scale_for(other, 0.5, other.classes) == 1

    def test_cars_much_longer_than_the_model_knows_get_a_look_of_their_own(self) -> None:
        assert (
            looks_for(_INFO, 4.4 / 250, CLASSES)
            == looks_for(_INFO, math.nan, CLASSES)
            == (CLASSES,)
        )
        people, cars = looks_for(_INFO, 4.4 / 300, CLASSES)
        assert (people, cars) == (("person", "small object"), ("car",))
        assert scale_for(_INFO, 4.4 / 300, people) == 1
        assert 300 * scale_for(_INFO, 4.4 / 300, cars) == pytest.approx(_BEST_PX["car"][1])
        assert looks_for(_INFO, 4.4 / 300, ["car"]) == (("car",),)  # alone it decides the only look

    def test_a_person_in_a_thermal_frame_has_twice_the_pixels(self) -> None:
        for m_per_px in (0.08, 0.12):
            by_day, by_night = (
                scale_for(_INFO, 2 * m_per_px, CLASSES),
                scale_for(_INFO, m_per_px, CLASSES, True),
            )
            assert by_night == pytest.approx(by_day) and by_night > 1
        assert scale_for(_INFO, 0.02, CLASSES, True) == 1
        assert scale_for(_INFO, 0.08, ["car"], True) == 1


class TestPlan:
    def test_a_small_thermal_frame_of_unknown_ground_is_magnified(self) -> None:
        frame = plan_tiles((512, 640), _INFO, CLASSES, thermal=True)
        assert frame.scale == 1.5 and frame.places_px == ((0, 0, 640, 512),)
        assert plan_tiles((512, 640), _INFO, CLASSES).scale == 1
        assert plan_tiles((512, 640), _INFO, CLASSES, tiles=None, thermal=True).scale == 1
        assert plan_tiles((512, 640), _INFO, CLASSES, tiles=256, thermal=True).scale == 1
        assert plan_tiles((1080, 1920), _INFO, CLASSES, thermal=True).scale == 1, (
            "a monochrome camera's, rather"
        )

    @pytest.mark.parametrize(
        "size", [(1080, 1920), (3000, 4000), (2250, 4000), (1500, 2000), (700, 9000)]
    )
    @pytest.mark.parametrize("m_per_px", [math.nan, 0.02, 0.05, 0.2, 0.004])
    def test_tiles_cover_the_picture_and_overlap_by_an_object(
        self, size: tuple[int, int], m_per_px: float
    ) -> None:
        plan = plan_tiles(size, _INFO, CLASSES, m_per_px=m_per_px)
        places = np.array(plan.places_px)
        assert places.min() == 0 and places[:, 2].max() == size[1] and places[:, 3].max() == size[0]
        sides = (places[:, 2:] - places[:, :2]) * plan.scale
        assert sides.prod(axis=1).max() <= MOST_WHOLE_PX
        if len(places) == 1:
            return
        assert sides.max() <= 1.5 * math.sqrt(MOST_WHOLE_PX)
        longest = 200 / plan.scale if math.isnan(m_per_px) else 4.75 / m_per_px
        for low, high in ((0, 2), (1, 3)):
            spans = sorted({(span[low], span[high]) for span in plan.places_px})
            for (_, end), (start, _) in pairwise(spans):
                assert end - start >= min(longest, 0.5 * sides[0, low] / plan.scale) - 3

    def test_little_is_shown_twice(self) -> None:
        """Of a photo of 4000 x 2250 px from 40 m, whose tiles overlap by 5.5 m, a third (two thirds with tiles of 1280
        px); of a 4K frame less."""
        for size, m_per_px, most in (
            ((2250, 4000), 0.017, 1.4),
            ((2160, 3840), 0.02, 1.3),
            ((1500, 2000), 0.03, 1.15),
        ):
            places = np.array(
                plan_tiles(size, _INFO, ("person", "car"), m_per_px=m_per_px).places_px
            )
            assert (places[:, 2:] - places[:, :2]).prod(axis=1).sum() < most * size[0] * size[1]

    def test_whole_means_whole_unless_memory_forbids(self) -> None:
        assert plan_tiles((2160, 3840), _INFO, CLASSES, tiles=None, m_per_px=0.3).places_px == (
            (0, 0, 3840, 2160),
        )
        huge = plan_tiles((9000, 9000), _INFO, CLASSES, tiles=None)
        assert len(huge.places_px) > 1 and huge.scale == 1
        assert MOST_AT_ONCE_PX < 9000**2

    @pytest.mark.parametrize("tiles", [0, -5, 63, "all", 2.5, True])
    def test_tiles_that_cannot_be(self, tiles: object) -> None:
        with pytest.raises(SettingsError, match="tiles must be"):
            plan_tiles((100, 100), _INFO, CLASSES, tiles=tiles)  # type: ignore[arg-type]


class TestTiledPictures:
    def test_objects_on_every_border_and_corner(self, detector: Detector) -> None:
        """Centred on, just before and just after each border of each tile, and over the corners where four meet."""
        size = (500, 620)
        plan = plan_tiles(size, detector.info, detector.classes, tiles=160)
        for side_x, side_y in product((0, 2), (1, 3)):
            columns = {place[side_x] for place in plan.places_px} - {0, size[1]}
            rows = {place[side_y] for place in plan.places_px} - {0, size[0]}
            assert len(columns) >= 5 and len(rows) >= 4
            for left, top in ((-30, -9), (-1, -18), (-15, 0)):
                boxes = [
                    (x + left, y + top, x + left + 30, y + top + 18) for x in columns for y in rows
                ]
                found = detector.detect(draw(size, boxes), tiles=160)
                assert _rows(found.boxes_px, found.labels) == _rows(
                    np.array(boxes), [0] * len(boxes)
                )

    @pytest.mark.parametrize("longest", [30, 90, 300])
    def test_random_pictures_with_objects_longer_than_the_overlap(
        self, detector: Detector, longest: int
    ) -> None:
        rng = np.random.default_rng(longest)
        for _ in range(6):
            size = (int(rng.integers(200, 420)), int(rng.integers(200, 420)))
            boxes, labels = _scatter(rng, size, longest)
            found = detector.detect(
                draw(size, boxes, labels=labels), tiles=int(rng.integers(64, 200))
            )
            assert _rows(found.boxes_px, found.labels) == _rows(np.array(boxes), labels)

    def test_magnified_tiles_give_boxes_in_the_picture(self, detector: Detector) -> None:
        boxes = [(40, 30, 60, 44), (900, 700, 930, 760), (600, 300, 612, 318)]
        picture = draw((1100, 1400), boxes)
        for m_per_px in (
            0.075,
            1.7 / 240,
        ):  # grey, so taken for thermal: 1.5 times as large, in tiles; half as large
            found = detector.detect(picture, tiles="auto", m_per_px=m_per_px, least_score=0.3)
            assert len(found) == 3
            order = np.argsort(found.boxes_px[:, 0])
            np.testing.assert_allclose(found.boxes_px[order], sorted(boxes), atol=0.01)

    def test_grey_and_deep_pictures_are_tiled_too(self, detector: Detector) -> None:
        heat = np.full((400, 400), 7300, np.uint16)
        heat[180:220, 100:160] = 7800
        found = detector.detect(heat, tiles=128)
        np.testing.assert_allclose(found.boxes_px, [(100, 180, 160, 220)])


def _scatter(
    rng: np.random.Generator, size: tuple[int, int], longest: int
) -> tuple[list[tuple[int, int, int, int]], list[int]]:
    taken, boxes = np.zeros(size, bool), []
    for _ in range(60):
        width, height = np.exp(rng.uniform(np.log(4), np.log(longest), 2)).astype(int).tolist()
        x, y = int(rng.integers(-width // 2, size[1])), int(rng.integers(-height // 2, size[0]))
        left, top, right, bottom = (
            max(0, x),
            max(0, y),
            min(size[1], x + width),
            min(size[0], y + height),
        )
        around = taken[max(0, top - 2) : bottom + 2, max(0, left - 2) : right + 2]
        if min(right - left, bottom - top) < 3 or around.any():
            continue
        taken[top:bottom, left:right] = True
        boxes.append((left, top, right, bottom))
    return boxes, rng.integers(0, 3, len(boxes)).tolist()
