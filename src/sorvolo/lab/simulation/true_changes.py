"""The list that a later flight should come back with: what appeared, disappeared, was replaced, or moves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.polygons import convex_hull, points_inside
from sorvolo.lab.simulation.flight import SimulatedFlight, has_changed
from sorvolo.lab.simulation.rendering import render_labels
from sorvolo.lab.simulation.truth import DEGREE_DECIMALS, iso_time, polygon_geometry
from sorvolo.search.drawing.objects import Body, Thing

VIEW_STEP_S = 0.2
"""Clear views of a video's object are counted this far apart at least; of photos each one counts."""

CLEAR_SHARE = 0.5
"""In a clear view an object lies wholly within the picture and more than this share of it is not hidden."""

JOINED_GAP_M = 0.3
"""What came within this distance of what left is one event, `replaced`."""


@dataclass(frozen=True, eq=False)
class TruthEvent:
    """One true event between the first flight and a later one.

    `kind` is appeared, disappeared, replaced or moving. `footprint_m` (N, 2) is the object's base in the site frame,
    of something that moves at the middle of its clear views, of a replacement the hull of both. `clear_views` are
    the frames that show it well; `path_m` (V, 2) is where it was in each of them.
    """

    kind: str
    before: Thing | None
    after: Thing | None
    footprint_m: PointsM
    clear_views: tuple[int, ...]
    path_m: PointsM


def true_events(flight: SimulatedFlight) -> list[TruthEvent]:
    """What changed since flight 1, as this flight sees it; empty for flight 1 itself.

    What moved from one place to another disappeared here and appeared there. What moves during the flight is
    `moving`; where it stood in the first flight it disappeared. Views of an old place in which something that moves
    stands there do not count as clear.
    """
    if flight.number == 1:
        return []
    came, left = _came_and_left(flight)
    events = [
        _arrival(flight, thing, None if thing.is_moving else _take_near(thing, left))
        for thing in came
    ]
    movers = [thing for thing in flight.day.things if thing.is_moving]
    return events + [_departure(flight, thing, movers) for thing in left]


def _came_and_left(flight: SimulatedFlight) -> tuple[list[Thing], list[Thing]]:
    """The flight's things that are not where they were on the first, and the first flight's that are not there now."""
    first, _ = flight.before
    today = {thing.id: thing for thing in flight.day.things}
    known = {thing.id: thing for thing in first}
    left = [thing for thing in first if has_changed(thing, today.get(thing.id))]
    came = [
        thing
        for thing in flight.day.things
        if thing.id not in known or has_changed(known[thing.id], thing)
    ]
    return came, left


def _arrival(flight: SimulatedFlight, thing: Thing, old: Thing | None) -> TruthEvent:
    """Something that came, in place of an old one or not, or that moves."""
    views = _clear_views(flight, thing, flight.day.things, flight.day.bodies)
    places = np.array(
        [thing.place_m(float(flight.from_middle_s[index]))[:2] for index in views]
    ).reshape(-1, 2)
    if thing.is_moving:
        middle_s = float(flight.from_middle_s[views[len(views) // 2]]) if views else 0.0
        return TruthEvent("moving", None, thing, thing.footprint_m(middle_s), views, places)
    if old is None:
        return TruthEvent("appeared", None, thing, thing.footprint_m(), views, places)
    both = convex_hull(np.concatenate([old.footprint_m(), thing.footprint_m()]))
    return TruthEvent("replaced", old, thing, both, views, places)


def _departure(flight: SimulatedFlight, thing: Thing, movers: Sequence[Thing]) -> TruthEvent:
    """Something that is gone."""
    first, bodies = flight.before
    views = tuple(
        index
        for index in _clear_views(flight, thing, first, bodies)
        if not _is_trodden(thing, movers, float(flight.from_middle_s[index]))
    )
    places = np.tile(thing.place_m(0.0)[:2], (len(views), 1))
    return TruthEvent("disappeared", thing, None, thing.footprint_m(), views, places)


def event_features(flight: SimulatedFlight) -> list[dict[str, Any]]:
    """`true_events` as GeoJSON features, numbered from 1."""
    return [
        _feature(number, event, flight) for number, event in enumerate(true_events(flight), start=1)
    ]


def _feature(number: int, event: TruthEvent, flight: SimulatedFlight) -> dict[str, Any]:
    thing = event.after or event.before
    assert thing is not None
    times_ns = flight.frame_times_ns
    middle = event.footprint_m.mean(axis=0)
    return {
        "type": "Feature",
        "geometry": polygon_geometry(event.footprint_m, flight.site),
        "properties": {
            "number": number,
            "flight": flight.name,
            "since": "flight1",
            "kind": event.kind,
            "class_before": "" if event.before is None else str(event.before.label),
            "class_after": "" if event.after is None else str(event.after.label),
            "objects": sorted(
                {each.id for each in (event.before, event.after) if each is not None}
            ),
            "east_m": round(float(middle[0]), 4),
            "north_m": round(float(middle[1]), 4),
            "length_m": round(thing.size_m[0], 4),
            "width_m": round(thing.size_m[1], 4),
            "height_m": round(thing.size_m[2], 4),
            "velocity_m_s": [round(speed, 4) for speed in thing.velocity_m_s],
            "clear_views": [iso_time(int(times_ns[index])) for index in event.clear_views],
            "path": _degrees(event.path_m, flight.site) if event.kind == "moving" else [],
        },
    }


def _degrees(points_m: PointsM, site: LocalFrame) -> list[list[float]]:
    if not len(points_m):
        return []
    latitude, longitude, _ = site.wgs84_from_site(
        np.column_stack([points_m, np.zeros(len(points_m))])
    )
    return [
        [round(float(x), DEGREE_DECIMALS), round(float(y), DEGREE_DECIMALS)]
        for x, y in zip(longitude, latitude)
    ]


def _clear_views(
    flight: SimulatedFlight, thing: Thing, things: Sequence[Thing], bodies: dict[int, Body]
) -> tuple[int, ...]:
    """The frames that show the thing whole and at least half unhidden, `VIEW_STEP_S` apart at least."""
    is_video = not flight.settings.output.photos
    step = max(1, int(np.ceil(VIEW_STEP_S * flight.settings.imaging.fps - 1e-9))) if is_video else 1
    size_px = np.array([flight.camera.width_px, flight.camera.height_px])
    clear = []
    for index in range(0, len(flight), step):
        from_middle_s = float(flight.from_middle_s[index])
        base = thing.footprint_m(from_middle_s)
        box = np.concatenate(
            [np.column_stack([base, np.full(len(base), z)]) for z in (0.0, thing.size_m[2])]
        )
        pixels = flight.view(index).project(box)
        with np.errstate(invalid="ignore"):
            is_whole = bool(((pixels >= 0) & (pixels <= size_px - 1)).all())
        if is_whole and _visible_share(flight, thing, things, bodies, index) > CLEAR_SHARE:
            clear.append(index)
    return tuple(clear)


def _visible_share(
    flight: SimulatedFlight,
    thing: Thing,
    things: Sequence[Thing],
    bodies: dict[int, Body],
    index: int,
) -> float:
    from_middle_s = float(flight.from_middle_s[index])
    place = thing.place_m(from_middle_s)
    # nothing hides what lies farther from its foot than its own height, in a picture that looks down steeply
    near = [
        other
        for other in things
        if other is thing
        or np.hypot(*(other.place_m(from_middle_s) - place)[:2])
        < thing.reach_m + other.reach_m + other.size_m[2]
    ]
    labels, totals = render_labels(
        near, bodies, flight.view(index), flight.true_poses[index], from_middle_s
    )
    total = totals.get(thing.id, 0)
    return float(np.count_nonzero(labels == thing.id)) / total if total else 0.0


def _take_near(thing: Thing, left: list[Thing]) -> Thing | None:
    """Take out of `left` what stood where the thing stands now, the nearest first."""
    near = [
        (_gap_m(thing.footprint_m(), old.footprint_m()), number) for number, old in enumerate(left)
    ]
    gap_m, number = min(near, default=(np.inf, -1))
    return left.pop(number) if gap_m < JOINED_GAP_M else None


def _is_trodden(thing: Thing, movers: Sequence[Thing], from_middle_s: float) -> bool:
    place = thing.place_m(0.0)
    return any(
        np.hypot(*(mover.place_m(from_middle_s) - place)[:2])
        < thing.reach_m + mover.reach_m + JOINED_GAP_M
        for mover in movers
    )


def _gap_m(a: PointsM, b: PointsM) -> float:
    """The distance of two convex rings, (N, 2) each; 0 where they overlap."""
    if points_inside([a], b).any() or points_inside([b], a).any():
        return 0.0
    return min(float(_to_ring_m(a, b).min()), float(_to_ring_m(b, a).min()))


def _to_ring_m(points: PointsM, ring: PointsM) -> Floats:
    """(N,) the distance of points from a ring's edges."""
    start, along = ring, np.roll(ring, -1, axis=0) - ring
    offset = points[:, None] - start
    share = np.clip((offset * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-12), 0, 1)
    return np.asarray(np.linalg.norm(offset - share[..., None] * along, axis=2).min(axis=1))
