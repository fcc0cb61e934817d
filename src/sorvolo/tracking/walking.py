"""What moves on a map whose frames are seconds apart: sightings at changing places that one walker or car explains."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, Rows
from sorvolo.tracking.laying import LaidSighting

_MOST_M_S = {"person": 4.0, "car": 20.0}  # a runner; a car in town; what is neither walks
_OTHER_M_S = 4.0  # of a class of a user's own model, as a person's


@dataclass(frozen=True)
class WalkSettings:
    """Which sightings one walk explains."""

    least_m_s: float = 0.25  # slower is a place badly known
    longest_gap_s: float = 6.0  # between two sightings of a way
    least_views: int = (
        3  # two sightings lie on a straight line whatever they are: these must be whole and ...
    )
    sure_score: float = 0.5  # ... of this score
    again_s: float = 60.0  # what walks on as it did is known again after so long ...
    swerve: float = 0.35  # ... within so much of the way that it goes meanwhile
    most_off: float = 3.0  # sigmas, rms, from even motion along a line
    wobble_m_s2: float = 0.4  # how much walkers turn and change their pace


@dataclass(frozen=True, eq=False)
class Walk:
    """Something that moved: the indices of its sightings in order of time, and where it was at the last of them."""

    members: tuple[int, ...]
    position_m: Floats
    velocity_m_s: Floats
    sigma_m: float
    possible_views: int


def walks(laid: Sequence[LaidSighting], settings: WalkSettings = WalkSettings()) -> list[Walk]:
    """The walks among these sightings, none of which stands; each sighting is in one walk at most.

    A walk needs three sightings of one class on an even way, or two sure ones, no faster than its class moves and fast
    enough to be seen. The longest, then the straightest, are taken first; a walk that goes on as another one ended is
    part of it.
    """
    times_s = np.array([each.sighting.time_ns for each in laid], np.int64) / 1e9
    order: Rows = np.argsort(times_s, kind="stable")
    candidates = []
    for at, first in enumerate(order):
        for second in order[at + 1 :]:
            gap_s = times_s[second] - times_s[first]
            if gap_s > settings.longest_gap_s:
                break
            found = _followed(int(first), int(second), laid, times_s, order, settings)
            if found is not None:
                candidates.append(found)
    candidates.sort(key=lambda found: (-len(found[0]), found[1]))
    taken: set[int] = set()
    result: list[list[int]] = []
    for members, _ in candidates:
        if taken.isdisjoint(members):
            taken.update(members)
            result.append(members)
    return [_walk(members, laid, times_s) for members in _joined(result, laid, times_s, settings)]


def _followed(
    first: int,
    second: int,
    laid: Sequence[LaidSighting],
    times_s: Floats,
    order: Rows,
    settings: WalkSettings,
) -> tuple[list[int], float] | None:
    """The sightings on the way that two begin, and how far they lie off it, rms in sigmas; None where it is no way."""
    one, two = laid[first].sighting, laid[second].sighting
    gap_s = float(times_s[second] - times_s[first])
    fastest_m_s = _MOST_M_S.get(one.label, _OTHER_M_S)
    if one.label != two.label or gap_s <= 0:
        return None
    speed_m_s = float(np.hypot(*(two.position_m - one.position_m))) / gap_s
    if not settings.least_m_s <= speed_m_s <= fastest_m_s:
        return None
    members = _prolonged([first, second], laid, times_s, order, settings)
    if len(members) < settings.least_views:
        is_sure = all(
            laid[k].sighting.score >= settings.sure_score and not laid[k].is_cut for k in members
        )
        return (members, 0.0) if is_sure else None
    _, velocity_m_s, _ = _line(members, laid, times_s, float(times_s[members[-1]]))
    off = _off(members, laid, times_s, settings.wobble_m_s2)
    if off > settings.most_off or not settings.least_m_s <= np.hypot(*velocity_m_s) <= fastest_m_s:
        return None
    return members, off


def _prolonged(
    way: list[int],
    laid: Sequence[LaidSighting],
    times_s: Floats,
    order: Rows,
    settings: WalkSettings,
) -> list[int]:
    """A way with the later sightings of its class that lie on it."""
    members, label = list(way), laid[way[0]].sighting.label
    for k in order[np.searchsorted(times_s[order], times_s[way[-1]], side="right") :]:
        after_s = float(times_s[k] - times_s[members[-1]])
        if after_s > settings.longest_gap_s:
            break
        if after_s <= 0 or laid[k].sighting.label != label:
            continue
        expected_m, _, spread = _line(members, laid, times_s, float(times_s[k]))
        sigma_m = np.hypot(
            np.hypot(spread, _sigma_m(laid[k])), 0.5 * settings.wobble_m_s2 * after_s**2
        )
        if np.hypot(*(laid[k].sighting.position_m - expected_m)) < settings.most_off * sigma_m:
            members.append(int(k))
    return members


def _joined(
    found: list[list[int]], laid: Sequence[LaidSighting], times_s: Floats, settings: WalkSettings
) -> list[list[int]]:
    """The same walks, those in one that show one walker out of view for a while."""
    rest = sorted(found, key=lambda members: times_s[members[0]])
    result: list[list[int]] = []
    for later in rest:
        begins_s = float(times_s[later[0]])
        best, best_m = None, np.inf
        for earlier in result:
            gap_s = begins_s - float(times_s[earlier[-1]])
            one, other = laid[earlier[-1]].sighting, laid[later[0]].sighting
            if one.label != other.label or not 0 < gap_s <= settings.again_s:
                continue
            expected_m, before_m_s, spread = _line(earlier, laid, times_s, begins_s)
            _, after_m_s, _ = _line(later, laid, times_s, begins_s)
            speed_m_s = float(np.hypot(*before_m_s))
            apart_m = float(np.hypot(*(other.position_m - expected_m)))
            turned_m_s = float(np.hypot(*(after_m_s - before_m_s)))
            reach_m = 1.0 + min(2 * spread, 3.0) + settings.swerve * speed_m_s * gap_s
            if apart_m <= reach_m and turned_m_s <= max(speed_m_s, 0.5):
                best, best_m = (earlier, apart_m) if apart_m < best_m else (best, best_m)
        if best is None:
            result.append(later)
        else:
            best += later
    return result


def _line(
    members: Sequence[int], laid: Sequence[LaidSighting], times_s: Floats, at_s: float
) -> tuple[Floats, Floats, float]:
    """Even motion through the last sightings: the place at a time, the velocity, and the place's sigma per axis."""
    last = members[-4:]  # people turn: what is long ago shows little of where they go
    since_s = times_s[last] - at_s
    places_m = np.array([laid[k].sighting.position_m for k in last])
    weights = 1.0 / np.array([_sigma_m(laid[k]) for k in last])
    matrix = np.column_stack([np.ones(len(last)), since_s]) * weights[:, None]
    solution, _, _, _ = np.linalg.lstsq(matrix, places_m * weights[:, None], rcond=None)
    covariance = np.linalg.pinv(matrix.T @ matrix)
    return solution[0], solution[1], float(np.sqrt(max(covariance[0, 0], 0.0)))


def _off(
    members: Sequence[int], laid: Sequence[LaidSighting], times_s: Floats, wobble_m_s2: float
) -> float:
    """How far the sightings lie from even motion through their neighbours in time, rms in sigmas."""
    squares = []
    for before, k, after in zip(members, members[1:], members[2:]):
        share = (times_s[k] - times_s[before]) / (times_s[after] - times_s[before])
        expected_m = (1 - share) * laid[before].sighting.position_m + share * laid[
            after
        ].sighting.position_m
        wobble_m = 0.5 * wobble_m_s2 * (times_s[after] - times_s[before]) ** 2 / 4
        sigma_m = np.hypot(1.5 * _sigma_m(laid[k]), wobble_m)
        squares.append(
            float(((laid[k].sighting.position_m - expected_m) ** 2).sum()) / sigma_m**2 / 2
        )
    return float(np.sqrt(np.mean(squares)))


def _walk(members: Sequence[int], laid: Sequence[LaidSighting], times_s: Floats) -> Walk:
    place_m, velocity_m_s, sigma_m = _line(members, laid, times_s, float(times_s[members[-1]]))
    last = laid[members[-1]]
    if last.is_cut:
        sigma_m = max(sigma_m, last.own_sigma_m)
    return Walk(tuple(members), place_m, velocity_m_s, sigma_m, len(members))


def _sigma_m(each: LaidSighting) -> float:
    return float(np.hypot(each.sighting.sigma_m, 0.1))
