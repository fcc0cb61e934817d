"""The answers: where every frame lies, what stands where, and which pixels show it; plain values for files."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageGray, ImageRGBA, PointsM
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import shifted
from sorvolo.geometry.polygons import convex_hull, gap
from sorvolo.geometry.pose import Pose, gimbal_angles_from_rotation
from sorvolo.lab.simulation.flight import SimulatedFlight, has_changed
from sorvolo.lab.simulation.ground_painting import GroundRaster
from sorvolo.lab.simulation.rendering import Labels, render_labels
from sorvolo.lab.simulation.world import World
from sorvolo.paths import Json
from sorvolo.search.drawing.objects import Body, Thing, ThingLabel
from sorvolo.store.exports.plain import feature, utc_text

CATEGORIES = (ThingLabel.PERSON, ThingLabel.CAR, ThingLabel.SMALL)
"""The COCO categories; their ids count from 1."""

DEGREE_DECIMALS = 11
"""Of longitudes and latitudes in truth files: a micrometre."""

_FEWEST_PX = 4  # less of an object is no answer to anything


def frame_features(flight: SimulatedFlight) -> list[Json]:
    """One GeoJSON feature per frame: its image's corners on the ground and its camera's pose."""
    observation = flight.observation()
    if observation is None:
        fixes = np.full((len(flight), 2), np.nan)
    else:
        fixes = np.column_stack(observation.fix_at(flight.frame_times_s))
    positions = np.array([pose.translation_m for pose in flight.true_poses])
    latitudes, longitudes, heights = flight.site.wgs84_from_site(positions)
    features = []
    for index, pose in enumerate(flight.true_poses):
        yaw, pitch, roll = gimbal_angles_from_rotation(pose.rotation)
        properties = {
            "flight": flight.name,
            "frame": flight.frame_name(index) if flight.settings.output.photos else index,
            "time": utc_text(int(flight.frame_times_ns[index]) // 1000 * 1000),
            "camera_longitude_deg": round(float(longitudes[index]), DEGREE_DECIMALS),
            "camera_latitude_deg": round(float(latitudes[index]), DEGREE_DECIMALS),
            "camera_height_m": round(float(heights[index]), 6),
            "height_above_ground_m": round(float(pose.translation_m[2]), 6),
            "camera_yaw_deg": round(yaw, 6),
            "camera_pitch_deg": round(pitch, 6),
            "camera_roll_deg": round(roll, 6),
            "rotation": [round(float(number), 10) for number in pose.rotation.ravel()],
            "fix_longitude_deg": _degrees_or_null(fixes[index, 1]),
            "fix_latitude_deg": _degrees_or_null(fixes[index, 0]),
        }
        outline = _outline_m(flight, pose)
        features.append(feature(polygon_geometry(outline, flight.site), properties))
    return features


def _outline_m(flight: SimulatedFlight, pose: Pose) -> PointsM:
    """(4, 2) the ground under the picture's outer corners; NaN beyond the horizon."""
    if flight.world.relief.is_level:
        return footprint(flight.camera, pose)
    rays = flight.camera.rays_from_pixels(flight.camera.corners_px) @ pose.rotation.T
    return flight.world.relief.met(pose.translation_m, rays)[:, :2]


def object_features(world: World, site: LocalFrame) -> list[Json]:
    """One GeoJSON feature per object and place: what moved between flights has a feature for each place."""
    features = []
    first_seen: dict[tuple[object, ...], tuple[Thing, list[int]]] = {}
    for number, day in enumerate(world.days, start=1):
        for thing in day:
            place = (thing.id, thing.east_m, thing.north_m, thing.yaw_deg, thing.velocity_m_s)
            first_seen.setdefault(place, (thing, []))[1].append(number)
    for thing, flights in first_seen.values():
        features.append(
            feature(
                polygon_geometry(thing.footprint_m(), site),
                {
                    "id": thing.id,
                    "class": str(thing.label),
                    "subtype": thing.kind,
                    "height_m": round(thing.size_m[2], 4),
                    "length_m": round(thing.size_m[0], 4),
                    "width_m": round(thing.size_m[1], 4),
                    "east_m": round(thing.east_m, 4),
                    "north_m": round(thing.north_m, 4),
                    "flights": flights,
                    "moving": thing.is_moving,
                    "velocity_m_s": [round(speed, 4) for speed in thing.velocity_m_s],
                },
            )
        )
    return features


def feature_collection(features: Iterable[Json], site: LocalFrame) -> Json:
    """A GeoJSON collection with the site's origin as foreign member."""
    origin = site.origin
    return {
        "type": "FeatureCollection",
        "site": {
            "latitude_deg": origin.latitude_deg,
            "longitude_deg": origin.longitude_deg,
            "height_m": origin.height_m,
        },
        "features": list(features),
    }


def coco_boxes(flight: SimulatedFlight, frames: Iterable[int]) -> Json:
    """COCO annotations of these frames. A box holds the pixels that show the object; `visibility` is the
    share of the object that nothing hides within the picture, `area` its visible pixels."""
    images: list[Json] = []
    annotations: list[Json] = []
    for index in frames:
        images.append(
            {
                "id": index,
                "file_name": flight.frame_name(index)
                if flight.settings.output.photos
                else f"{flight.name}_{index:06d}.png",
                "width": flight.camera.width_px,
                "height": flight.camera.height_px,
                "frame": index,
            }
        )
        labels, totals = _labels(flight, flight.day.things, flight.day.bodies, index)
        annotations += box_rows(flight.day.things, labels, totals, index, len(annotations) + 1)
    return {
        "info": {"description": f"simulated {flight.name}"},
        "categories": coco_categories(),
        "images": images,
        "annotations": annotations,
    }


def coco_categories() -> list[Json]:
    """COCO's rows of the classes."""
    return [{"id": i, "name": str(label)} for i, label in enumerate(CATEGORIES, start=1)]


def box_rows(
    things: Iterable[Thing], labels: Labels, totals: Mapping[int, int], image_id: int, first_id: int
) -> list[Json]:
    """COCO's annotations of one picture whose `labels` and `totals` are those of `render_labels`."""
    rows: list[Json] = []
    targets = {thing.id: thing for thing in things if thing.label.is_target}
    for thing_id in np.unique(labels):
        thing = targets.get(int(thing_id))
        if thing is None:
            continue
        y, x = np.nonzero(labels == thing_id)
        if len(y) < _FEWEST_PX:
            continue
        left, top = int(x.min()), int(y.min())
        rows.append(
            {
                "id": first_id + len(rows),
                "image_id": image_id,
                "category_id": CATEGORIES.index(thing.label) + 1,
                "bbox": [left, top, int(x.max()) - left + 1, int(y.max()) - top + 1],
                "area": len(y),
                "iscrowd": 0,
                "object_id": thing.id,
                "visibility": round(len(y) / totals[thing.id], 4),
            }
        )
    return rows


def _labels(
    flight: SimulatedFlight, things: Sequence[Thing], bodies: Mapping[int, Body], index: int
) -> tuple[Labels, dict[int, int]]:
    """`render_labels` of things as a frame shows them."""
    pose, from_middle_s = flight.true_poses[index], float(flight.from_middle_s[index])
    return render_labels(things, bodies, flight.view(index), pose, from_middle_s)


def change_mask(flight: SimulatedFlight, index: int) -> ImageGray:
    """(height, width) 255 where the frame shows an object that came, or a place that one left, since
    flight 1.

    What moves counts at both places. Shadows, light and plants in the wind are no changes.
    """
    first, bodies = flight.before
    came, left = ([thing.id for thing in things] for things in _came_and_left(flight))
    now, _ = _labels(flight, flight.day.things, flight.day.bodies, index)
    then, _ = render_labels(first, bodies, flight.view(index), flight.true_poses[index], 0.0)
    changed = np.isin(now, came) | np.isin(then, left)
    return np.where(changed, 255, 0).astype(np.uint8)


def map_tiles(ground: GroundRaster, site_grid: SiteGrid) -> dict[TileIndex, ImageRGBA]:
    """The ground's picture on a map grid, as tiles; transparent outside of it."""
    area = ground.area
    centre = np.array([(area.west_m + area.east_m) / 2, (area.south_m + area.north_m) / 2])
    grid_from_site = site_grid.grid_from_site_affine(centre, max(area.size_m) / 2)
    grid_from_raster = grid_from_site @ np.linalg.inv(ground.raster_from_site_matrix)
    rgba = np.dstack([ground.rgb, np.full(ground.rgb.shape[:2], 255, np.uint8)])
    tiles: dict[TileIndex, ImageRGBA] = {}
    for tile in sorted(site_grid.grid.tiles_touched(site_grid.grid_from_site(area.corners_m))):
        x0, y0, x1, y1 = site_grid.grid.tile_window(tile)
        picture = cv2.warpAffine(
            rgba,
            (shifted(-x0, -y0) @ grid_from_raster)[:2],
            (x1 - x0, y1 - y0),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(0, 0, 0, 0),
        )
        if picture[..., 3].any():
            picture[picture[..., 3] < 255] = 0
            tiles[tile] = np.asarray(picture, np.uint8)
    return tiles


def _degrees_or_null(value: float) -> float | None:
    return round(float(value), DEGREE_DECIMALS) if np.isfinite(value) else None


def polygon_geometry(outline_m: PointsM, site: LocalFrame) -> Json | None:
    """A ring of ground points, (N, 2), as a GeoJSON polygon in WGS84; None where a point is not known."""
    if not np.isfinite(outline_m).all():
        return None
    ring = _degrees(outline_m, site)
    return {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}


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


def event_features(flight: SimulatedFlight) -> list[Json]:
    """`true_events` as GeoJSON features, numbered from 1."""
    return [_feature(*each, flight) for each in enumerate(true_events(flight), start=1)]


def _feature(number: int, event: TruthEvent, flight: SimulatedFlight) -> Json:
    thing = event.after or event.before
    assert thing is not None
    times_ns = flight.frame_times_ns
    middle = event.footprint_m.mean(axis=0)
    return feature(
        polygon_geometry(event.footprint_m, flight.site),
        {
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
            "clear_views": [
                utc_text(int(times_ns[index]) // 1000 * 1000) for index in event.clear_views
            ],
            "path": _degrees(event.path_m, flight.site) if event.kind == "moving" else [],
        },
    )


def _degrees(points_m: PointsM, site: LocalFrame) -> list[list[float]]:
    latitude, longitude, _ = site.wgs84_from_site(points_m)
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
    labels, totals = _labels(flight, near, bodies, index)
    total = totals.get(thing.id, 0)
    return float(np.count_nonzero(labels == thing.id)) / total if total else 0.0


def _take_near(thing: Thing, left: list[Thing]) -> Thing | None:
    """Take out of `left` what stood where the thing stands now, the nearest first."""
    near = [
        (gap(thing.footprint_m(), old.footprint_m()), number) for number, old in enumerate(left)
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
