"""The heading of a camera whose telemetry does not have it, on ways that are known."""

from collections.abc import Callable

import numpy as np
import pytest

from sorvolo.geometry.pose import site_from_gimbal_rotation
from sorvolo.survey.flight import CameraPrior, Frame
from sorvolo.survey.objects import no_detections
from sorvolo.tracking.headings import (
    CompassError,
    HeadingCheck,
    HeadingFromMotion,
    HeadingTurn,
    Way,
    contradiction,
    heading_deg,
    is_uniform,
    righted,
)

_M_PER_PX = 0.05


def _fly(
    headings_deg: np.ndarray,
    way_m: np.ndarray,
    *,
    gps_m: float = 0.0,
    wobble_px: float = 0.0,
    seed: int = 1,
) -> list[Way]:
    """What is reported along a way (N, 2) of a camera with these headings, ten frames a second."""
    rng = np.random.default_rng(seed)
    drift_m = gps_m * np.cumsum(rng.normal(0, 1, way_m.shape), axis=0) / np.sqrt(len(way_m))
    finder, reported = HeadingFromMotion(), []
    for number, place_m in enumerate(way_m):
        outline_px = _outline(headings_deg[number], place_m, headings_deg[0], way_m[0])
        reported.append(
            finder.add(
                number / 10, outline_px + rng.normal(0, wobble_px, 2), place_m + drift_m[number]
            )
        )
    return reported


def _outline(
    heading_deg: float, place_m: np.ndarray, first_deg: float, first_m: np.ndarray
) -> np.ndarray:
    """A picture of 400 x 300 px on the ground, in the pixels of the first one."""
    corners = (
        np.array([[-200.0, 150.0], [200.0, 150.0], [200.0, -150.0], [-200.0, -150.0]]) * _M_PER_PX
    )
    ground_m = corners @ _north_up(heading_deg).T + place_m
    seen = (ground_m - first_m) @ _north_up(first_deg) / _M_PER_PX
    return np.column_stack([200 + seen[:, 0], 150 - seen[:, 1]])


def _north_up(heading_deg: float) -> np.ndarray:
    """East and north of a picture's right and up."""
    angle = np.radians(heading_deg)
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def _apart_deg(one: float, other: float) -> float:
    return abs((one - other + 180) % 360 - 180)


@pytest.mark.parametrize("heading_deg", [0.0, 37.0, 90.0, 181.0, 359.0])
def test_a_straight_way_in_any_direction(heading_deg: float) -> None:
    way_m = np.outer(np.arange(60) * 0.5, [0.6, -0.8])  # the camera need not look where it flies
    reported = _fly(np.full(60, heading_deg), way_m)
    assert reported[3].sigma_deg == np.inf  # two metres are no way yet
    assert _apart_deg(reported[-1].heading_deg, heading_deg) < 0.01
    assert 4.0 < reported[-1].sigma_deg < 8.0  # fixes that wander by a metre on a way of 30 m


def test_turns_are_followed() -> None:
    headings_deg = np.concatenate([np.full(80, 90.0), np.linspace(90, 270, 40), np.full(40, 270.0)])
    steps = (
        np.column_stack([np.sin(np.radians(headings_deg)), np.cos(np.radians(headings_deg))]) * 0.6
    )
    reported = _fly(headings_deg, np.cumsum(steps, axis=0))
    assert all(
        _apart_deg(each.heading_deg, true) < 0.1
        for each, true in zip(reported[40:], headings_deg[40:])
    )


def test_noise_is_within_the_stated_sigma() -> None:
    misses = []
    for seed in range(40):
        headings_deg = 45 + np.cumsum(np.random.default_rng(seed).normal(0, 1, 150))
        way_m = np.outer(np.arange(150) * 0.6, [np.sin(1.0), np.cos(1.0)])
        last = _fly(headings_deg, way_m, gps_m=2.0, wobble_px=8.0, seed=seed)[-1]
        misses.append(_apart_deg(last.heading_deg, headings_deg[-1]) / last.sigma_deg)
    assert np.mean(np.array(misses) < 2) >= 0.9


def test_hovering_gives_nothing_and_a_cut_begins_anew() -> None:
    reported = _fly(np.full(100, 10.0), np.zeros((100, 2)), gps_m=1.0, wobble_px=5.0)
    assert all(each.sigma_deg == np.inf for each in reported)
    finder = HeadingFromMotion()
    for number in range(60):
        place_m = np.array([0.0, 0.5 * number])
        last = finder.add(number / 10, _outline(0.0, place_m, 0.0, np.zeros(2)), place_m)
    assert last.sigma_deg < 8
    finder.lose()
    assert (
        finder.add(
            6.0, _outline(0.0, np.zeros(2), 0.0, np.zeros(2)), np.array([0.0, 30.0])
        ).sigma_deg
        == np.inf
    )


@pytest.mark.parametrize("off_deg", [-12.0, 2.0, 8.0, 175.0])
def test_a_wrong_compass_is_corrected_by_what_is_sure(off_deg: float) -> None:
    """Noise of the stated size about a small error corrects less than it, about a large one nearly all."""
    error, random = CompassError(), np.random.default_rng(4)
    for _ in range(300):
        error.add(HeadingTurn(-off_deg + random.normal(0, 2), 2.0), 0.2, anew=False)
    prior = CameraPrior(np.zeros(3), np.ones(3), np.diag([1.0, -1.0, -1.0]), np.full(3, 5.0))
    left_deg = off_deg + heading_deg(error.corrected(prior))
    assert abs(left_deg) < (2.01 if abs(off_deg) <= 2 else 1.2)
    assert error.sigma_deg == pytest.approx(2.0)


def test_a_compass_that_jumps_is_followed_at_once() -> None:
    error = CompassError()
    for turn_deg, anew in ((3.0, False), (4.0, False), (170.0, True)):
        error.add(HeadingTurn(turn_deg, 2.0), 0.2, anew=anew)
    assert error.turn.turn_deg == pytest.approx(170.0)


@pytest.mark.parametrize("tilt_deg", [0.0, 5.0])
@pytest.mark.parametrize("told_share", [1.0, 0.8])
def test_a_tilt_and_a_height_that_are_off_show_on_the_way_back(
    tilt_deg: float, told_share: float
) -> None:
    """Two strips, 50 m up; telemetry's axis meets the ground too far towards the picture's top by its tilt's error."""
    headings_deg = np.concatenate([np.full(90, 90.0), np.linspace(90, 270, 30), np.full(90, 270.0)])
    forward = np.column_stack([np.sin(np.radians(headings_deg)), np.cos(np.radians(headings_deg))])
    way_m = np.cumsum(0.8 * forward, axis=0)
    told_m = 50 * told_share
    finder, way = HeadingFromMotion(), Way()
    for number, place_m in enumerate(way_m):
        outline_px = _outline(headings_deg[number], place_m, headings_deg[0], way_m[0])
        middle_m = place_m + told_m * np.tan(np.radians(tilt_deg)) * forward[number]
        way = finder.add(number / 5, outline_px, middle_m, told_m, 50 / _M_PER_PX)
    assert way.scale == pytest.approx(1 / told_share, abs=0.02)
    assert way.sure_scale == pytest.approx(1 / told_share, abs=0.03)
    rotation = site_from_gimbal_rotation(270.0, -90.0 + tilt_deg, 0.0)
    prior = CameraPrior(np.array([*way_m[-1], told_m]), np.ones(3), rotation, np.full(3, 2.0))
    right = righted(prior, way, 0.0)
    assert right.position_m[2] == pytest.approx(50, abs=1.0)
    off_deg = np.degrees(np.arccos(np.clip(-right.rotation[2, 2], -1, 1)))
    assert off_deg < 0.3 + 0.35 * tilt_deg  # of 5 degrees what is sure
    assert np.linalg.norm(right.rotation[:2, 2]) < np.linalg.norm(rotation[:2, 2]) + 0.01
    assert right.position_sigma_m[2] == 1.0


@pytest.mark.parametrize(("sigma_m", "least_deg"), [(0.4, 4.4), (4.0, 0.0)])
def test_by_how_much_tilts_are_corrected_is_told(sigma_m: float, least_deg: float) -> None:
    """4 m of 50 m are 4.6 degrees, of which what is sure counts."""
    check = HeadingCheck(1000.0, knows_heading=True)
    check.shown = Way(beside_m=4j, beside_sigma_m=sigma_m)
    frame = Frame(0, "0", 0, np.zeros((240, 320, 3), np.uint8))
    prior = CameraPrior(np.array([0.0, 0.0, 50.0]), np.ones(3), np.diag([1.0, -1, -1]), np.ones(3))
    check.take(frame, 0, no_detections(()), prior, 0.0)
    assert least_deg <= check.tilt_deg <= least_deg + 0.2


def test_a_strip_without_a_turn_shows_no_tilt() -> None:
    """There a tilt is the same as a shift of all fixes."""
    finder, way = HeadingFromMotion(), Way()
    for number in range(100):
        place_m = np.array([0.8 * number, 0.0])
        outline_px = _outline(90.0, place_m, 90.0, np.zeros(2))
        way = finder.add(
            number / 5, outline_px, place_m + np.array([4.0, 0.0]), 50.0, 50 / _M_PER_PX
        )
    assert way.beside_sigma_m > 4
    prior = CameraPrior(np.array([80.0, 0.0, 50.0]), np.ones(3), np.diag([1.0, -1, -1]), np.ones(3))
    assert np.allclose(righted(prior, way, 0.0).rotation, prior.rotation, atol=0.01)


@pytest.mark.parametrize(
    ("ahead_s", "strip_m", "words"),
    [
        (3, 60, "about -3.0 s more"),
        (8, 60, "about -8.0 s more"),
        (-8, 60, "about +8.0 s more"),
        (15, 60, "about -15.0 or +15.0 s more"),  # strips to and fro repeat themselves
        (
            8,
            30,
            "mirror image: latitude and longitude swapped, or a sign lost, or its clock is off: about -8.0",
        ),  # and half a lap on they are each other's mirror image
        (0, 60, ""),
    ],
)
def test_a_clock_that_is_off_is_named_with_every_offset_that_fits(
    ahead_s: float, strip_m: float, words: str
) -> None:
    """Four seconds were searched, and "about -4.0" or a mirror image was said of clocks that are farther off."""
    rng, times_s = np.random.default_rng(1), np.arange(5.0, 65.0, 0.5)
    corners = np.cumsum([0, *[strip_m, 15j, -strip_m, 15j] * 4])
    passed_s = np.append(0.0, np.cumsum(np.abs(np.diff(corners)))) / 5
    told_m = np.interp(times_s + ahead_s, passed_s, corners)
    told_m = told_m + 0.2 * (rng.normal(size=(2, len(times_s))) * [[1], [1j]]).sum(axis=0)
    seen_px = np.interp(times_s, passed_s, corners) * np.exp(0.4j) * 400 / 30
    places = [
        (1, round(time_s * 1e9), seen, told, 30.0)
        for time_s, seen, told in zip(times_s, seen_px, told_m)
    ]
    found = contradiction(places, 400.0, knows_tilt=True)
    assert words in found and bool(found) is bool(words)


@pytest.mark.parametrize(
    ("passed_m", "fits_any_moment"),
    [
        (lambda times_s: 5 * times_s, True),
        (lambda times_s: 5 * np.minimum(times_s, 60 - times_s), False),
        (lambda times_s: 5 * np.maximum(times_s - 20, 0), False),
        (lambda times_s: 0 * times_s, False),
    ],
    ids=["one way", "and back", "hovers first", "hovers"],
)
def test_a_way_at_one_velocity_fits_the_log_of_any_moment(
    passed_m: Callable[[np.ndarray], np.ndarray], *, fits_any_moment: bool
) -> None:
    """To and fro on one line was taken for such a way, though its turn shows when it was."""
    times_s = np.arange(0.0, 60.0, 0.5)
    seen_px = passed_m(times_s) * np.exp(0.4j) * 400 / 30
    places = [(1, round(at * 1e9), seen, 0j, 30.0) for at, seen in zip(times_s, seen_px)]
    assert is_uniform(places, 400.0) is fits_any_moment
