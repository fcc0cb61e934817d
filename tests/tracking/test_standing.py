"""What stands on a map, from sightings whose truth is known: each once, in its place, walkers as walkers."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.survey.mosaic import PlacedFrame, Status
from sorvolo.survey.objects import CLASSES, TYPICAL_SIZE_M, Detections
from sorvolo.tracking.laying import LaidSighting, lay_on_ground, shows
from sorvolo.tracking.standing import Fused, _line, fitted_size_m, fuse

CAMERA = Camera(960, 540, 800.0, 800.0, 479.5, 269.5, np.array([-0.1, 0.02, 0.0, 0.0, 0.0]))
SECOND_NS = 10**9


Thing = tuple[str, float, float, float, tuple[float, float]]
"""Class, east, north, yaw, velocity."""


def placed(
    index: int, east_m: float, north_m: float, *, yaw_deg: float = 90.0, pitch_deg: float = -88.0
) -> PlacedFrame:
    """A frame taken 30 m up, a second after the one before."""
    pose = Pose(
        site_from_gimbal_rotation(yaw_deg, pitch_deg, 0.0), np.array([east_m, north_m, 30.0])
    )
    return PlacedFrame(
        str(index),
        index,
        index * SECOND_NS,
        Status.VISION,
        "",
        CAMERA,
        pose,
        site_from_image_homography(CAMERA, pose),
        footprint(CAMERA, pose),
        0.2,
        0.5,
    )


def survey() -> list[PlacedFrame]:
    """Two strips there and back, 4 m from frame to frame."""
    there = [placed(k, 4.0 * k, 0.0) for k in range(10)]
    return there + [placed(10 + k, 36.0 - 4.0 * k, 8.0, yaw_deg=270.0) for k in range(10)]


def box_of(
    frame: PlacedFrame,
    label: str,
    east_m: float,
    north_m: float,
    yaw_deg: float,
    *,
    least_shown: float = 1.0,
    ground_m: float = 0.0,
) -> np.ndarray | None:
    """The box around a body of its class's usual size, as far as the picture shows it; None where that is less of
    either side than `least_shown`."""
    length, width, height = TYPICAL_SIZE_M[label]
    turn = np.radians(yaw_deg)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 1)]) * [
        length / 2,
        width / 2,
        height,
    ]
    rotation = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    points = corners @ rotation.T + [east_m, north_m, ground_m]
    pose = frame.site_from_camera
    assert pose is not None
    image = CAMERA.pixels_from_points((points - pose.translation_m) @ pose.rotation) + 0.5
    low, high = image.min(axis=0), image.max(axis=0)
    size_px = np.array([CAMERA.width_px, CAMERA.height_px])
    if least_shown == 1.0 and ((low < 2).any() or (high > size_px - 2).any()):
        return None
    inside = np.clip([low, high], 0, size_px)
    return (
        None if ((inside[1] - inside[0]) < least_shown * (high - low)).any() else inside.reshape(4)
    )


def _surely(hills, places_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return hills(places_m), np.full(len(places_m), 0.1)


def sightings(
    frames: list[PlacedFrame],
    things: list[Thing],
    *,
    misses: float = 0.2,
    false_alarms: float = 0.0,
    seed: int = 1,
    least_shown: float = 1.0,
    hills: Callable[[np.ndarray], np.ndarray] | None = None,
    knows_hills: bool = True,
) -> list[LaidSighting]:
    """What a detector sees of things, on level ground or `hills`, whose boxes' edges err by a pixel."""
    random = np.random.default_rng(seed)
    result: list[LaidSighting] = []
    for frame in frames:
        seconds = frame.time_ns / SECOND_NS
        boxes, labels = [], []
        for label, east_m, north_m, yaw_deg, (east_m_s, north_m_s) in things:
            box = box_of(
                frame,
                label,
                east_m + east_m_s * seconds,
                north_m + north_m_s * seconds,
                yaw_deg,
                least_shown=least_shown,
                ground_m=0.0 if hills is None else float(hills(np.array([[east_m, north_m]]))[0]),
            )
            if box is not None and random.random() >= misses:
                boxes.append(box + random.normal(0, 1.0, 4))
                labels.append(CLASSES.index(label))
        for _ in range(random.poisson(false_alarms)):
            x, y = random.uniform(0, 900), random.uniform(0, 500)
            boxes.append(np.array([x, y, x + 20, y + 20]))
            labels.append(int(random.integers(3)))
        scores = random.uniform(0.4, 0.95, len(boxes))
        seen = Detections(np.array(boxes).reshape(-1, 4), scores, np.array(labels), CLASSES)
        ground = None if hills is None or not knows_hills else partial(_surely, hills)
        laid = lay_on_ground(seen, frame, ground=ground)
        result += [each for each in laid if each is not None]
    return result


THINGS = [
    ("car", 12.0, 3.0, 30.0, (0.0, 0.0)),
    ("car", 12.8, 5.6, 30.0, (0.0, 0.0)),
    ("person", 20.0, 1.0, 0.0, (0.0, 0.0)),
    ("person", 21.2, 1.0, 0.0, (0.0, 0.0)),
    ("small object", 26.0, 6.0, 60.0, (0.0, 0.0)),
]


def test_on_a_slope_whose_heights_are_known_each_is_there_once_in_its_place() -> None:
    """Laid on level ground, one of the cars is two."""

    def hills(places_m: np.ndarray) -> np.ndarray:
        return -4.0 + 0.1 * (places_m[:, 0] - 12.0)

    cars = [("car", 12.0, 3.0, 30.0, (0.0, 0.0)), ("car", 24.0, 5.0, 30.0, (0.0, 0.0))]
    frames, objects = survey(), {}
    for knows_hills in (True, False):
        laid = sightings(
            frames, cars, misses=0.0, least_shown=0.5, hills=hills, knows_hills=knows_hills
        )
        objects[knows_hills] = fuse(laid, frames).objects
    assert len(objects[True]) == 2 and len(objects[False]) == 3
    for car in cars:
        assert min(np.hypot(*(each.position_m - car[1:3])) for each in objects[True]) < 0.05


def test_a_terrace_is_shown_by_fewer_frames_than_level_ground() -> None:
    """Six metres up, what a picture shows is narrower: a frame past its edge is none that failed to see a car."""
    frames = survey()
    laid = sightings(
        frames,
        [("car", 12.0, 3.0, 30.0, (0.0, 0.0))],
        misses=0.0,
        least_shown=0.5,
        hills=lambda places_m: np.full(len(places_m), 6.0),
    )
    (car,) = fuse(laid, frames).objects
    assert car.possible_views == len(car.members)


def nearest(fused: Fused, east_m: float, north_m: float) -> tuple[str, float]:
    """Class and distance of the object nearest to a place."""
    distances_m = [
        float(np.hypot(*(each.position_m - [east_m, north_m]))) for each in fused.objects
    ]
    best = int(np.argmin(distances_m))
    return fused.objects[best].label, distances_m[best]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_each_thing_once_in_its_place(seed: int) -> None:
    """Cars side by side and people 1.2 m apart, from two strips in opposite directions, one view in ten missing."""
    frames = survey()
    fused = fuse(sightings(frames, THINGS, misses=0.1, seed=seed), frames)
    assert len(fused.objects) == len(THINGS)
    assert not any(each.moves for each in fused.objects)
    for label, east_m, north_m, _, _ in THINGS:
        found, distance_m = nearest(fused, east_m, north_m)
        assert found == label
        assert distance_m < 0.15


@pytest.mark.parametrize(
    ("label", "apart_m", "count"), [("person", 0.2, 1), ("person", 0.7, 2), ("car", 0.8, 1)]
)
def test_no_two_bodies_stand_in_one_place(label: str, apart_m: float, count: int) -> None:
    """A detector that boxes a body twice in every frame has seen one: two of a class are half its width apart or more."""
    frames = survey()
    places_m = (18.0, 18.0 + apart_m)
    things: list[Thing] = [(label, east_m, 2.0, 0.0, (0.0, 0.0)) for east_m in places_m]
    assert len(fuse(sightings(frames, things, misses=0.0), frames).objects) == count


@pytest.mark.parametrize("yaw_deg", [0.0, 40.0, 90.0])
def test_what_one_strip_only_cuts_is_no_second_object(yaw_deg: float) -> None:
    """The first strip's edge cuts two cars in all its frames, by a half and a third; the second shows them whole."""
    frames = survey()
    half, third = ("car", 14.0, 17.7, yaw_deg, (0.0, 0.0)), ("car", 24.0, 17.0, yaw_deg, (0.0, 0.0))
    laid = sightings(frames, [half, third], misses=0.0, least_shown=0.15)
    cut = [each.is_cut for each in laid]
    assert min(cut.count(True), cut.count(False)) > 5
    fused = fuse(laid, frames)
    assert len(fused.objects) == 2 and not any(each.moves for each in fused.objects)
    for _, east_m, north_m, _, _ in (half, third):
        assert nearest(fused, east_m, north_m)[1] < 0.2
    assert all(abs(each.size_m[0] - 4.4) < 0.8 for each in fused.objects)


def test_what_every_frame_cuts_has_no_size_and_a_place_with_its_error() -> None:
    """A car beyond the rim of what was flown: reported once, its place within the stated sigma, its length unknown."""
    frames = survey()
    fused = fuse(
        sightings(frames, [("car", 16.0, -18.0, 90.0, (0.0, 0.0))], misses=0.0, least_shown=0.2),
        frames,
    )
    (car,) = fused.objects
    assert np.isnan(car.size_m).all() and not car.moves
    assert car.sigma_m > 0.3
    assert np.abs(car.position_m - [16.0, -18.0]).max() < 2 * car.sigma_m


def test_pieces_at_the_edge_that_others_show_to_be_nothing() -> None:
    """Twice a piece of a car at the edge, where several frames would show the whole car and see none."""
    frames = survey()
    boxes = {0: [300.0, 0.0, 360.0, 50.0], 1: [300.0, 0.0, 350.0, 60.0]}
    laid = []
    for index, box in boxes.items():
        seen = Detections(
            np.array([box]), np.array([0.8]), np.array([CLASSES.index("car")]), CLASSES
        )
        laid += [each for each in lay_on_ground(seen, frames[index]) if each is not None]
    assert len(laid) == 2
    assert fuse(laid, frames).objects == ()


def test_what_is_far_too_short_for_its_class_is_not_laid() -> None:
    """A box of 1 m is no car, however sure the detector is, but a thing; at the edge it may be a part of a car."""
    frame = placed(0, 0.0, 0.0, pitch_deg=-90.0)
    boxes = np.array([[400.0, 200.0, 427.0, 220.0]] * 2 + [[400.0, 0.0, 427.0, 20.0]])
    seen = Detections(boxes, np.full(3, 0.9), np.array([1, 2, 1]), CLASSES)
    assert [each is None for each in lay_on_ground(seen, frame)] == [
        CLASSES[1] == "car",
        False,
        False,
    ]


@pytest.mark.parametrize(("score", "count"), [(0.95, 1), (0.6, 1), (0.5, 0)])
def test_what_one_frame_alone_shows_counts_as_in_that_frame(score: float, count: int) -> None:
    frames = [placed(0, 0.0, 0.0), placed(1, 60.0, 0.0)]
    seen = Detections(
        np.array([[400.0, 200.0, 416.0, 215.0]]), np.array([score]), np.array([2]), CLASSES
    )
    laid = [each for each in lay_on_ground(seen, frames[0]) if each is not None]
    assert len(fuse(laid, frames, {"small object": 0.55}).objects) == count


def seen_with(scores: list[float]) -> list[LaidSighting]:
    """A car in the middle of the survey's first strip, seen with these scores by the frames that show it."""
    laid: list[LaidSighting] = []
    for frame in survey()[:10]:
        box = box_of(frame, "car", 18.0, 2.0, 90.0, least_shown=0.5)
        if box is not None:
            seen = Detections(
                box[None], np.array([scores[len(laid) % len(scores)]]), np.array([1]), CLASSES
            )
            laid += [each for each in lay_on_ground(seen, frame) if each is not None]
    assert len(laid) >= 4
    return laid


def test_weak_views_are_evidence() -> None:
    """Half of the views score 0.85: with 0.8 in the others it is a car, with 0.1 nothing; neither is a mover."""
    least = {"car": 0.72}
    (car,) = fuse(seen_with([0.8, 0.85]), survey()[:10], least).objects
    assert 0.85 < car.score < 0.96 and car.possible_views == len(car.members)
    doubtful = fuse(seen_with([0.1, 0.85]), survey()[:10], least)
    assert doubtful.objects == ()
    strong = [each for each in seen_with([0.1, 0.85]) if each.sighting.score >= 0.72]
    assert doubtful.dropped == len(strong)
    assert fuse(seen_with([0.6]), survey()[:10], least) == Fused((), 0)


@pytest.mark.parametrize(("length_m", "count"), [(4.4, 1), (3.9, 1), (2.6, 0)])
def test_a_bench_is_no_car(length_m: float, count: int) -> None:
    """Four views of 0.85: as long as a car it is one, as long as a bench not, nor does it walk."""
    laid: list[LaidSighting] = []
    for frame in survey()[:10]:
        box = box_of(frame, "car", 18.0, 2.0, 90.0)
        if box is not None:
            middle, half = (box[:2] + box[2:]) / 2, (box[2:] - box[:2]) / 2 * length_m / 4.4
            boxes = np.concatenate([middle - half, middle + half])[None]
            seen = Detections(boxes, np.array([0.85]), np.array([CLASSES.index("car")]), CLASSES)
            laid += [each for each in lay_on_ground(seen, frame) if each is not None]
    assert len(fuse(laid, survey()[:10], {"car": 0.72}).objects) == count


@pytest.mark.parametrize(
    ("label", "score", "box", "count"),
    [
        ("car", 0.88, [300.0, 0.0, 420.0, 50.0], 1),
        ("car", 0.88, [300.0, 0.0, 326.0, 12.0], 0),
        ("person", 0.62, [300.0, 0.0, 322.0, 14.0], 1),
        ("person", 0.62, [300.0, 0.0, 380.0, 60.0], 0),
    ],
)
def test_a_piece_at_the_edge_counts_by_its_size(
    label: str, score: float, box: list[float], count: int
) -> None:
    """Half a car is one, and half a person; a stone of half a metre is no car, three metres of a digger no person."""
    frame = placed(0, 0.0, 0.0)
    seen = Detections(np.array([box]), np.array([score]), np.array([CLASSES.index(label)]), CLASSES)
    laid = [each for each in lay_on_ground(seen, frame) if each is not None]
    assert len(laid) == 1 and laid[0].is_cut
    assert len(fuse(laid, [frame], {"car": 0.7, "person": 0.5}).objects) == count


def test_a_frame_that_shows_half_of_it_has_looked() -> None:
    """Seen whole, and surely, by one frame; each of the others that shows its middle and saw nothing makes it less so."""
    box = box_of(placed(0, 0.0, 0.0), "car", 0.0, 0.0, 90.0)
    assert box is not None
    seen = Detections(box[None], np.array([0.85]), np.array([CLASSES.index("car")]), CLASSES)
    (sighting,) = lay_on_ground(seen, placed(0, 0.0, 0.0))
    assert sighting is not None
    for east_m, count in ((10.0, 1), (8.0, 0)):  # shown: its end; its middle
        frames = [placed(0, 0.0, 0.0), *(placed(k, east_m, 0.0) for k in (1, 2))]
        assert len(fuse([sighting], frames, {"car": 0.7}).objects) == count


def test_what_few_frames_saw_is_left_out() -> None:
    """Boxes around nothing, two in three frames, leave hardly any object behind."""
    frames = survey()
    laid = sightings(frames, THINGS, false_alarms=0.67)
    fused = fuse(laid, frames)
    assert len(THINGS) <= len(fused.objects) <= len(THINGS) + 2
    assert fused.dropped >= 5
    assert sum(len(each.members) for each in fused.objects) + fused.dropped == len(laid)


def test_a_car_that_sure_views_show_at_many_places_drives() -> None:
    """Each place seen once, so surely that it alone would be reported: one car that moves, not five that stand."""
    frames, laid = survey()[:5], list[LaidSighting]()
    for frame, score in zip(frames, [0.6, 0.99, 0.99, 0.99, 0.6]):
        box = box_of(frame, "car", 1.0 + 4.0 * frame.time_ns / SECOND_NS, 2.0, 90.0)
        assert box is not None
        seen = Detections(box[None], np.array([score]), np.array([CLASSES.index("car")]), CLASSES)
        laid += [each for each in lay_on_ground(seen, frame) if each is not None]
    assert len(fuse(laid[1:2], frames, {"car": 0.3}).objects) == 1
    (car,) = fuse(laid, frames, {"car": 0.3}).objects
    assert car.moves and len(car.members) == 5


def test_a_car_that_most_frames_cut_stands_and_drives_nowhere() -> None:
    """Four frames of one strip show it whole, those of three others a part each; the height is a tenth too low, so
    that it slips as the drone flies on."""
    frames = survey() + [placed(20 + k, 4.0 * (k % 10), 0.5 * (k // 10)) for k in range(20)]
    laid = list[LaidSighting]()
    for number, frame in enumerate(frames):
        box = box_of(frame, "car", 18.0, 17.5, 90.0, least_shown=0.3)
        pose = frame.site_from_camera
        if box is None or pose is None:
            continue
        lower = Pose(pose.rotation, pose.translation_m * [1.0, 1.0, 0.9])
        frames[number] = replace(
            frame,
            site_from_camera=lower,
            site_from_image=site_from_image_homography(CAMERA, lower),
            outline_m=footprint(CAMERA, lower),
        )
        seen = Detections(box[None], np.array([0.9]), np.array([CLASSES.index("car")]), CLASSES)
        laid += [each for each in lay_on_ground(seen, frames[number]) if each is not None]
    assert sum(each.is_cut for each in laid) > 2 * sum(not each.is_cut for each in laid)
    (car,) = fuse(laid, frames).objects
    assert not car.moves


def test_who_stands_is_not_lost_where_another_walks_by() -> None:
    """Seen by two of seven frames; the walk goes through one of the two."""
    laid = list[LaidSighting]()
    frames = [placed(k, float(k), 0.0) for k in range(7)]
    for number, frame in enumerate(frames):
        people = [(5.0, 2.6, 0.98)] if number in (3, 5) else []
        people += [(5.0 + 1.3 * (number - 5), 2.0, 0.6)] if number != 5 else []
        boxes = [box_of(frame, "person", east_m, north_m, 90.0) for east_m, north_m, _ in people]
        seen = Detections(
            np.array(boxes),
            np.array([score for *_, score in people]),
            np.full(len(people), CLASSES.index("person")),
            CLASSES,
        )
        laid += [each for each in lay_on_ground(seen, frame) if each is not None]
    fused = fuse(laid, frames, {"person": 0.3})
    assert sorted(each.moves for each in fused.objects) == [False, True] and fused.dropped == 0


def test_a_walker_is_one_and_moves() -> None:
    """1.3 m/s along the strip: seen at many places, reported once, with its velocity and where it was last."""
    frames = survey()[:10]
    fused = fuse(sightings(frames, [("person", 8.0, 2.0, 0.0, (1.3, -0.3))], misses=0.0), frames)
    (walker,) = fused.objects
    assert walker.moves
    assert np.hypot(*(walker.velocity_m_s - [1.3, -0.3])) < 0.3
    last_s = (
        max(
            frames[k].time_ns
            for k in range(10)
            if box_of(frames[k], "person", 8.0 + 1.3 * k, 2.0 - 0.3 * k, 0.0) is not None
        )
        / SECOND_NS
    )
    assert np.hypot(*(walker.position_m - [8.0 + 1.3 * last_s, 2.0 - 0.3 * last_s])) < 0.5


def test_a_walk_does_not_go_on_as_a_car() -> None:
    """Where a walker would be again after some seconds out of view comes a car: both are there."""
    frames = survey()[:10]
    walker = sightings(frames[1:5], [("person", 8.0, 2.0, 0.0, (2.5, 0.0))], misses=0.0)
    car = sightings(frames[6:], [("car", 8.0, 2.0, 0.0, (2.5, 0.0))], misses=0.0)
    objects = fuse([*walker, *car], frames).objects
    assert sorted(each.label for each in objects) == ["car", "person"]
    same = sightings(frames[6:], [("person", 8.0, 2.0, 0.0, (2.5, 0.0))], misses=0.0)
    assert len(fuse([*walker, *same], frames).objects) == 1


@pytest.mark.parametrize("together, people", [(3, 2), (1, 1)])
def test_what_frames_show_beside_each_other_is_two(together: int, people: int) -> None:
    """Two people half a metre apart, each seen by five frames: by so many of them, both."""
    frames = [placed(k, 2.0 * k, 0.0) for k in range(10)]
    one, other = ("person", 9.0, 1.0, 0.0, (0.0, 0.0)), ("person", 9.3, 1.0, 0.0, (0.0, 0.0))
    first = sightings(frames[:5], [one], misses=0.0)
    second = sightings(frames[5 - together : 10 - together], [other], misses=0.0)
    assert len(fuse([*first, *second], frames).objects) == people


def test_two_boxes_of_one_walker_are_one_step() -> None:
    """A tall box around the usual one, in each frame, ends no walk and makes no second walker."""
    frames = survey()[:10]
    once = sightings(frames, [("person", 8.0, 2.0, 0.0, (1.3, -0.3))], misses=0.0)
    tall = [
        replace(
            each,
            sighting=replace(each.sighting, box_px=each.sighting.box_px - [0, 20, 0, 0], score=0.9),
        )
        for each in once
    ]
    (walker,) = fuse([*once, *tall], frames).objects
    assert walker.moves and walker.possible_views == len(once)


def test_cars_that_cross_after_a_gap_keep_to_their_ways() -> None:
    """One leaves the picture as another is seen far from where the first would be."""
    frames = [placed(k, 16.0, 0.0) for k in range(12)]
    laid = list[LaidSighting]()
    for number, frame in enumerate(frames):
        cars = [(10.5 + 2.0 * number, 6.0)] if number < 6 else []
        cars += [(20.0, 36.0 - 3.0 * number)] if number in (8, 10, 11) else []
        boxes = [box_of(frame, "car", east_m, north_m, 90.0) for east_m, north_m in cars]
        shown = [each for each in boxes if each is not None]
        seen = Detections(
            np.array(shown).reshape(-1, 4),
            np.full(len(shown), 0.95),
            np.full(len(shown), CLASSES.index("car")),
            CLASSES,
        )
        laid += [each for each in lay_on_ground(seen, frame) if each is not None]
    ways = fuse(laid, frames).objects
    assert all(each.moves for each in ways) and len(ways) == 2
    assert sorted(round(float(np.hypot(*each.velocity_m_s)), 1) for each in ways) == [2.0, 3.0]


def test_its_own_sigma_is_honest() -> None:
    """Errors against the truth lie within twice the stated sigma about as often as they should."""
    frames = survey()
    inside = []
    for seed in range(12):
        for each in fuse(sightings(frames, THINGS, seed=10 + seed), frames).objects:
            offsets_m = np.array([each.position_m - np.array(thing[1:3]) for thing in THINGS])
            nearest_m = offsets_m[np.argmin(np.hypot(*offsets_m.T))]
            inside += [abs(error_m) < 2 * each.sigma_m for error_m in nearest_m]
    assert np.mean(inside) > 0.9


def test_a_turned_cars_size() -> None:
    """A box around a car that stands askew is larger than the car: the fit finds its sides."""
    frames = survey()
    for yaw_deg in (0.0, 30.0, 75.0):
        laid = sightings(frames, [("car", 15.0, 3.0, yaw_deg, (0.0, 0.0))], misses=0.0)
        length_m, width_m = fitted_size_m(laid, "car", TYPICAL_SIZE_M["car"][2])
        assert abs(length_m - 4.4) < 0.5
        assert abs(width_m - 1.8) < 0.5


def test_two_classes_for_one_thing() -> None:
    """Two boxes of one frame on one place, of two classes, are one object, named by the higher sum."""
    frames = survey()[:4]
    laid = []
    for frame in frames:
        box = box_of(frame, "small object", 8.0, 1.0, 0.0)
        if box is not None:
            seen = Detections(
                np.array([box, box + 1]), np.array([0.8, 0.5]), np.array([2, 0]), CLASSES
            )
            laid += [each for each in lay_on_ground(seen, frame) if each is not None]
    (only,) = fuse(laid, frames).objects
    assert only.label == "small object"
    assert 0.3 < only.class_scores["person"] < 0.5


def test_a_loose_outline_around_a_thing_is_no_second_one() -> None:
    """Of two boxes of one class and frame, one around the other, one object comes; of two side by side, two."""
    for apart_px, count in (
        (np.array([-6.0, -6.0, 10.0, 24.0]), 1),
        (np.array([26.0, 0.0, 26.0, 0.0]), 2),
    ):
        laid = []
        for frame in survey()[:4]:
            box = box_of(frame, "small object", 8.0, 1.0, 0.0)
            if box is not None:
                seen = Detections(
                    np.array([box, box + apart_px]), np.array([0.8, 0.6]), np.array([2, 2]), CLASSES
                )
                laid += [each for each in lay_on_ground(seen, frame) if each is not None]
        assert len(fuse(laid, survey()[:4]).objects) == count


def test_nothing_seen_and_no_place() -> None:
    """No sighting makes no object; a rejected frame lays nothing; above the horizon nothing lies on the ground."""
    assert fuse([], survey()).objects == ()
    level = placed(0, 0.0, 0.0, pitch_deg=0.0)
    sky = Detections(
        np.array([[400.0, 10.0, 420.0, 30.0]]), np.array([0.9]), np.array([0]), CLASSES
    )
    assert lay_on_ground(sky, level) == [None]


def test_shows_only_what_is_whole_in_the_picture() -> None:
    """A place under the camera is shown, one at the picture's edge only if what stands there is small."""
    frame = placed(0, 0.0, 0.0, pitch_deg=-90.0)
    edge_m = 30.0 * 270 / 800 - 0.3
    places_m = np.array([[0.0, 0.0], [edge_m, 0.0], [edge_m, 0.0], [40.0, 0.0]])
    assert shows(frame, places_m, np.zeros(4), np.array([2.0, 0.05, 2.0, 0.1])).tolist() == [
        True,
        True,
        False,
        False,
    ]


@pytest.mark.parametrize(("pitch_deg", "is_laid"), [(-11.0, True), (-8.0, False)])
def test_what_lies_farther_than_six_heights_is_not_laid(pitch_deg: float, is_laid: bool) -> None:
    middle_px = np.array([CAMERA.width_px, CAMERA.height_px]) / 2
    box = np.concatenate([middle_px - 3, middle_px + 3])[None]
    seen = Detections(box, np.array([0.9]), np.array([0]), ("sheep",))
    (laid,) = lay_on_ground(seen, placed(0, 0.0, 0.0, pitch_deg=pitch_deg))
    assert (laid is not None) == is_laid


def test_a_walker_goes_on_as_the_last_sightings_show() -> None:
    places = [(1.0 * k, 0.0) for k in range(5)] + [(4.0, 1.0 * k) for k in range(1, 5)]
    frames = [placed(k, east_m, north_m) for k, (east_m, north_m) in enumerate(places)]
    middle_px = np.array([CAMERA.width_px, CAMERA.height_px]) / 2
    box = np.concatenate([middle_px - 6, middle_px + 6])[None]
    seen = Detections(box, np.array([0.9]), np.array([0]), ("person",))
    laid = [lay_on_ground(seen, frame)[0] for frame in frames]
    times_s = np.arange(len(places), dtype=float)
    _, velocity_m_s, _ = _line(range(len(places)), laid, times_s, times_s[-1])  # type: ignore[arg-type]
    np.testing.assert_allclose(velocity_m_s, [0, 1], atol=1e-6)
