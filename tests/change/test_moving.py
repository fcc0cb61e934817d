"""People and cars that move while they are seen: reported once as moving, never as changes of the ground."""

import numpy as np
import pytest
from blob_world import CAMERA_HEIGHT_M, M_PER_PX, Thing, flight, view_of
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.change.blobs import Blob
from sorvolo.change.evidence import EvidenceMap, EvidenceSettings
from sorvolo.change.motion import (
    BlobTracker,
    TrackPoint,
    motion,
)
from sorvolo.survey.findings import ChangeKind


def events(views):
    evidence = EvidenceMap(M_PER_PX, EvidenceSettings(), "f")
    announced = [change for view in views for change in evidence.add(view)]
    return announced, evidence.conclude()


def point(time_s, place_m, camera_m):
    blob = Blob(0, np.array(place_m, float), 0.5, 0.2, np.zeros(3), 1.0)
    return TrackPoint(round(time_s * 1e9), blob, np.array(camera_m, float))


@pytest.mark.parametrize(
    ("thing", "velocity"),
    [
        (Thing(-2, -2, (0.5, 0.5), velocity_m_s=(0.5, 1.2)), (0.5, 1.2)),
        (Thing(-6, 2, (4.5, 1.8), velocity_m_s=(5, 0)), (5, 0)),
        (Thing(0, 3, (0.5, 0.5), velocity_m_s=(0, -1.3)), (0, -1.3)),
    ],
    ids=["walker", "car ahead", "walker across"],
)
def test_what_moves_is_one_event_of_its_own_kind(thing, velocity):
    announced, final = events(flight([thing]))
    assert [each.kind for each in announced] == [ChangeKind.MOVING]
    (change,) = final
    assert change.kind == ChangeKind.MOVING and change.id == announced[0].id
    assert np.abs(change.velocity_m_s - velocity).max() < 0.2
    assert change.views >= 5 and change.announced_ns > 0
    way = thing.outline_m((change.last_seen_ns - flight_start_ns()) * 1e-9).mean(axis=0)
    assert np.hypot(*(change.outline_m.mean(axis=0) - way)) < 0.3


def flight_start_ns() -> int:
    return next(iter(flight([]))).time_ns


def test_a_walker_straight_against_the_drone_keeps_its_size_and_so_is_no_ghost():
    _, final = events(flight([Thing(4, 3, (0.5, 0.5), velocity_m_s=(-1.4, 0))]))
    assert [each.kind for each in final] == [ChangeKind.MOVING]


def test_what_stays_where_somebody_walks_by_is_kept():
    walks, stays = (
        Thing(0, -2, (0.5, 0.5), velocity_m_s=(0.2, 1.4)),
        Thing(0.7, 0, (0.6, 0.6), colour=(40, 40, 200)),
    )
    _, final = events(flight([walks, stays]))
    assert sorted(each.kind for each in final) == [ChangeKind.APPEARED, ChangeKind.MOVING]


def test_a_fast_thing_that_looks_like_a_ghost_is_at_least_no_change_of_the_ground():
    _, final = events(flight([Thing(6, 2, (4.5, 1.8), velocity_m_s=(-5, 0))]))
    assert final == ()


def test_where_a_walker_stood_on_the_map_something_disappeared():
    stood = Thing(0, 2, (0.5, 0.5), on_map=True, in_flight=False)
    walks = Thing(-2, -2, (0.5, 0.5), velocity_m_s=(0.3, 0.9))
    _, final = events(flight([stood, walks], seconds=3))
    assert sorted(each.kind for each in final) == [ChangeKind.DISAPPEARED, ChangeKind.MOVING]


def test_a_car_faster_than_the_drone_is_one_mover():
    announced, final = events(
        flight([Thing(-6, 2, (4.5, 1.8), velocity_m_s=(13, 0))], seconds=2.4, speed_m_s=9)
    )
    assert len(announced) == 1
    assert [each.kind for each in final] == [ChangeKind.MOVING]
    assert final[0].velocity_m_s == pytest.approx((13, 0), abs=0.5)


def test_a_thing_that_stands_is_not_moving_though_its_head_slides_over_the_ground():
    _, final = events(flight([Thing(0, 1, (0.6, 0.6), height_m=1.8)]))
    assert [each.kind for each in final] == [ChangeKind.APPEARED]


def test_a_walker_lost_for_a_while_is_the_same_one():
    thing = Thing(-3, -2, (0.5, 0.5), velocity_m_s=(0.9, 0.8))
    views = [
        view_of(i, i / 5, (-4 + 0.5 * i / 5, 0, CAMERA_HEIGHT_M), [] if 9 <= i < 24 else [thing])
        for i in range(34)
    ]
    announced, final = events(views)
    assert len(announced) == 1
    assert [each.kind for each in final] == [ChangeKind.MOVING]


def test_a_walker_seen_now_with_the_shadow_and_now_without_is_one():
    things = [Thing(-3, -2, (side, side), velocity_m_s=(0.9, 0.8)) for side in (0.9, 0.5)]
    views = [
        view_of(i, i / 5, (-4 + 0.5 * i / 5, 0, CAMERA_HEIGHT_M), [things[i % 2]])
        for i in range(24)
    ]
    announced, final = events(views)
    assert len(announced) == len(final) == 1 and final[0].kind == ChangeKind.MOVING


def test_a_walker_in_a_long_shadow_is_one_event_though_the_shadow_seems_to_stay():
    walks = [
        Thing(2, 1, (0.5, 0.5), velocity_m_s=(0.6, 0)),
        Thing(
            0.25, 1, (3, 0.4), colour=(50, 50, 55), velocity_m_s=(0.6, 0)
        ),  # low sun, along the way
    ]
    announced, final = events(flight(walks, seconds=6, speed_m_s=1.5, start_m=(-3, 0)))
    assert [each.kind for each in final] == [ChangeKind.MOVING]
    assert (
        len(announced) == 1
        and final[0].id == announced[0].id
        and final[0].announced_ns == announced[0].announced_ns
    )


def test_a_mover_seen_again_for_one_view_stays_where_it_was_seen_to_move():
    walks, last = Thing(-3, -2, (0.5, 0.5), velocity_m_s=(0.9, 0.3)), 20
    shown = {*range(last), 45}
    views = [
        view_of(i, i / 5, (-4 + 0.5 * i / 5, 0, CAMERA_HEIGHT_M), [walks] if i in shown else [])
        for i in range(46)
    ]
    _, (change,) = events(views)
    assert change.last_seen_ns == views[last - 1].time_ns


def test_two_who_walk_side_by_side_are_two():
    pair = [Thing(-3, north_m, (0.5, 0.5), velocity_m_s=(0.9, 0.8)) for north_m in (-2, -1)]
    _, final = events(flight(pair))
    assert [each.kind for each in final] == [ChangeKind.MOVING] * 2


def test_noise_is_not_moving():
    rng = np.random.default_rng(11)
    tracker = BlobTracker()
    for view in flight([]):
        things = [Thing(*rng.uniform([-12, -4], [8, 4]), (0.5, 0.5)) for _ in range(3)]
        assert (
            tracker.follow(view_of(view.index, view.index / 5, view.camera_m, things)).movers == ()
        )


@given(
    st.floats(0.05, 0.55),
    st.floats(0, 2 * np.pi),
    st.floats(1, 10),
    st.floats(8, 60),
)
def test_the_ghost_of_something_tall_has_no_motion_of_its_own(
    height_share, heading, speed, camera_height_m
):
    height_m = height_share * camera_height_m
    lean = height_m / (camera_height_m - height_m)
    foot, way = np.array([3.0, -2.0]), speed * np.array([np.cos(heading), np.sin(heading)])
    cameras = [way * t for t in np.arange(6) / 5]
    moved = motion(
        [point(i / 5, foot + (foot - camera) * lean, camera) for i, camera in enumerate(cameras)]
    )
    assert moved.path_m < 1e-6 and moved.error_m < 1e-6
    assert np.allclose(moved.velocity_m_s, -lean * way)


@settings(max_examples=30)
@given(st.floats(-3, 3), st.floats(0.5, 3), st.floats(1, 8))
def test_motion_across_the_drones_way_counts_in_full(along, across, speed):
    moved = motion(
        [point(t, (along * t, across * t), (speed * t, 0)) for t in (0.0, 0.2, 0.4, 0.8)]
    )
    assert abs(moved.own_m_s[1] - across) < 1e-9
    assert moved.path_m >= 0.8 * across - 1e-9


def test_a_walker_in_three_photos_moves_and_a_standing_thing_beside_does_not():
    things = [
        Thing(-5, 1, (0.5, 0.5), velocity_m_s=(0.9, 0.5)),
        Thing(-1, -2, (0.5, 0.5), colour=(40, 60, 220)),
    ]
    photos = [view_of(i, 1.4 * i, (-6 + 3 * i, 0, CAMERA_HEIGHT_M), things) for i in range(3)]
    _, final = events(photos)
    assert sorted(each.kind for each in final) == [ChangeKind.APPEARED, ChangeKind.MOVING]


def test_a_walker_straight_against_three_photos_way_moves_and_what_leans_does_not():
    walks, leans = (
        Thing(3, 4, (0.5, 0.5), velocity_m_s=(-0.9, 0)),
        Thing(2, -3, (0.5, 0.5), 5, (40, 60, 220)),
    )
    photos = [
        view_of(i, 1.4 * i, (-3 + 2.5 * i, 0, CAMERA_HEIGHT_M), [walks, leans]) for i in range(3)
    ]
    _, final = events(photos)
    (mover,) = [each for each in final if each.kind is ChangeKind.MOVING]
    assert mover.velocity_m_s[0] == pytest.approx(-0.9, abs=0.2)
    assert mover.outline_m[:, 1].mean() > 3


@pytest.mark.parametrize("north_m", [-3.5, -3])
def test_a_walker_seen_from_aside_is_placed_where_the_feet_are(north_m):
    thing = Thing(-2, north_m, (0.5, 0.5), height_m=1.7, velocity_m_s=(1.2, 0.1))
    _, (change,) = events(flight([thing], seconds=4))
    assert change.kind == ChangeKind.MOVING
    feet_m = thing.outline_m((change.last_seen_ns - flight_start_ns()) * 1e-9).mean(axis=0)
    assert np.hypot(*(change.outline_m.mean(axis=0) - feet_m)) < 0.12
    assert change.length_m < 1.0
