"""The scale of a scene without telemetry: from its cars, whose size is known, else at least from its people."""

from collections.abc import Sequence

import numpy as np
import pytest

from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.scene import SceneMagnifier
from sorvolo.detection.tiling import scale_for
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.survey.flight import Frame
from sorvolo.survey.objects import CLASSES, Detections
from sorvolo.tracking.following import PictureFollower
from sorvolo.tracking.sizes import SceneScale, impossible_beside_cars
from sorvolo.tracking.tracker import TrackerSettings

SIZE_PX = (480, 640)
INFO = ModelInfo("toy", CLASSES, dict.fromkeys(CLASSES, 0.5), dict.fromkeys(CLASSES, (16.0, 200.0)))


def found(rows: Sequence[tuple[str, float, float, float, float]], score: float = 0.9) -> Detections:
    """Boxes by class, middle x and y, width and height."""
    boxes = [[x - w / 2, y - h / 2, x + w / 2, y + h / 2] for _, x, y, w, h in rows]
    labels = [CLASSES.index(name) for name, *_ in rows]
    return Detections(
        np.reshape(boxes, (-1, 4)), np.full(len(rows), score), np.array(labels, np.int64), CLASSES
    )


def street(px_per_m: float, growth: float = 0.0, seed: int = 1, count: int = 12) -> Detections:
    """Cars seen from above, turned any way; `growth` is by how much, in logarithms, they grow from top to bottom."""
    rng = np.random.default_rng(seed)
    rows = []
    for x, y, turn in zip(
        rng.uniform(60, 580, count), rng.uniform(60, 420, count), rng.uniform(0, np.pi, count)
    ):
        scale = px_per_m * np.exp(growth * (y / SIZE_PX[0] - 0.5))
        across, along = abs(np.cos(turn)), abs(np.sin(turn))
        rows.append(
            (
                "car",
                x,
                y,
                scale * (4.4 * across + 1.8 * along),
                scale * (1.8 * across + 4.4 * along),
            )
        )
    return found(rows)


def test_cars_give_the_scale_and_show_what_is_no_car() -> None:
    scene = SceneScale()
    assert scene.m_per_px() is None
    scene.see(street(10.0), SIZE_PX)
    assert scene.m_per_px() == pytest.approx(0.1, rel=0.1)
    odd = found(
        [
            ("car", 300, 200, 12, 10),
            ("car", 300, 200, 44, 20),
            ("car", 300, 200, 200, 190),
            ("person", 300, 200, 7, 9),
            ("person", 300, 200, 75, 70),
            ("car", 6, 200, 12, 10),
        ]
    )
    assert scene.impossible(odd, SIZE_PX).tolist() == [
        True,
        False,
        True,
        False,
        True,
        False,
    ]  # the last one is cut


def test_an_aslant_view_shows_far_cars_smaller() -> None:
    scene = SceneScale()
    scene.see(street(10.0, growth=1.6, count=30), SIZE_PX)
    far, near = 10 * np.exp(-0.6), 10 * np.exp(0.6)
    seen = found(
        [
            ("car", 300, 60, 4.4 * far, 20),
            ("car", 300, 420, 4.4 * near, 30),
            ("car", 300, 420, 12, 12),
        ]
    )
    assert scene.impossible(seen, SIZE_PX).tolist() == [False, False, True]


def test_too_few_cars_or_sizes_of_all_kinds_show_nothing() -> None:
    few, mixed = SceneScale(), SceneScale()
    few.see(street(10.0, count=5), SIZE_PX)
    mixed.see(found([("car", 300, 200, 2.0**k, 2.0**k) for k in range(1, 8)] * 2), SIZE_PX)
    for scene in (few, mixed):
        assert scene.m_per_px() is None
        assert not scene.impossible(found([("car", 300, 200, 3, 3)]), SIZE_PX).any()


class FromSize:
    """Sees cars that are shown `least_px` long; they stand in a picture whose columns are numbered by its red."""

    def __init__(self, least_px: float) -> None:
        self._least_px, self.looks = least_px, 0

    def __call__(self, picture: ImageRGB) -> Detections:
        self.looks += 1
        times = picture.shape[0] / SIZE_PX[0]
        cars = street(3.0)
        side = (cars.boxes_px[:, 2:] - cars.boxes_px[:, :2]).max(axis=1) * times
        boxes = cars.boxes_px[side >= self._least_px] * np.float32(times)
        return Detections(boxes, np.full(len(boxes), 0.9), np.ones(len(boxes), np.int64), CLASSES)


def test_things_too_small_as_they_are_are_found_in_the_enlarged_middle() -> None:
    picture = np.zeros((*SIZE_PX, 3), np.uint8)
    look = FromSize(24.0)
    assert not len(look(picture))
    magnifier = SceneMagnifier(INFO, CLASSES[:2])
    look.looks = 0
    m_per_px = magnifier.m_per_px(picture, look)
    assert m_per_px == pytest.approx(1 / 3, rel=0.15)
    assert scale_for(INFO, m_per_px, CLASSES[:2]) == 3.0
    for _ in range(30):
        magnifier.m_per_px(picture, look)
    assert look.looks == 6  # three when the flight begins, three some frames later


def test_people_alone_magnify_and_never_shrink() -> None:
    picture = np.zeros((*SIZE_PX, 3), np.uint8)

    def shown(side_px: float) -> SceneMagnifier:
        magnifier = SceneMagnifier(INFO, CLASSES[:2])
        magnifier.m_per_px(picture, lambda part: found([]))
        magnifier.see(found([("person", 300, 200, side_px / 2, side_px)] * 8), picture)
        return magnifier

    small = shown(8.0).m_per_px(picture, lambda part: found([]))
    assert small is not None and scale_for(INFO, small, CLASSES[:2]) == pytest.approx(2.0)
    assert shown(150.0).m_per_px(picture, lambda part: found([])) is None


def test_a_watch_without_telemetry_sets_aside_what_its_cars_contradict() -> None:
    rng = np.random.default_rng(3)
    picture = rng.integers(0, 255, (*SIZE_PX, 3), np.uint8)
    follower = PictureFollower(TrackerSettings(sure_score=0.3))
    cars = street(10.0)
    window = found([("car", 320, 240, 9, 9)])
    both = Detections(
        np.vstack([cars.boxes_px, window.boxes_px]),
        np.full(len(cars) + 1, 0.9),
        np.ones(len(cars) + 1, np.int64),
        CLASSES,
    )
    taken = [follower.take(Frame(k, str(k), k * 10**8, picture), k * 10**8, both) for k in range(4)]
    assert follower.impossible_size == 4
    assert all(each.sightings[-1] is None and each.track_ids[-1] == 0 for each in taken)
    assert sum(each.confirmed for each in follower.finish()) == len(cars)


def test_a_map_without_metres_knows_its_scale_by_its_cars() -> None:
    sides = np.array([[0.44, 0.2]] * 9 + [[0.1, 0.08]])
    no_cut = np.zeros(10, bool)
    assert impossible_beside_cars(["car"] * 10, sides, no_cut).tolist() == [False] * 9 + [True]
    assert not impossible_beside_cars(["car"] * 10, sides, np.ones(10, bool)).any()
    assert not impossible_beside_cars(["car"] * 5, sides[5:], no_cut[5:]).any()
