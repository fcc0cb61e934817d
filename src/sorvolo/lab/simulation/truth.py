"""The answers: where every frame lies, what stands where, and which pixels show it; plain values for files."""

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, Floats32, ImageGray, ImageRGBA, PointsM
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.geometry.level_ground import footprint
from sorvolo.geometry.pose import Pose, gimbal_angles_from_rotation
from sorvolo.lab.simulation.flight import SimulatedFlight, has_changed
from sorvolo.lab.simulation.ground_painting import GroundRaster
from sorvolo.lab.simulation.relief import LEVEL, Relief
from sorvolo.lab.simulation.rendering import Labels, render_labels
from sorvolo.lab.simulation.world import World
from sorvolo.search.drawing.objects import Body, Label, Thing
from sorvolo.search.drawing.view import View, sample_patches

CATEGORIES = (Label.PERSON, Label.CAR, Label.SMALL)
"""The COCO categories; their ids count from 1."""

DEGREE_DECIMALS = 11
"""Of longitudes and latitudes in truth files: a micrometre."""

_FEWEST_PX = 4  # less of an object is no answer to anything


def frame_features(flight: SimulatedFlight) -> list[dict[str, Any]]:
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
            "time": iso_time(int(flight.frame_times_ns[index])),
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
        features.append(
            {
                "type": "Feature",
                "geometry": polygon_geometry(outline, flight.site),
                "properties": properties,
            }
        )
    return features


def _outline_m(flight: SimulatedFlight, pose: Pose) -> PointsM:
    """(4, 2) the ground under the picture's outer corners; NaN beyond the horizon."""
    if flight.world.relief.is_level:
        return footprint(flight.camera, pose)
    rays = flight.camera.rays_from_pixels(flight.camera.corners_px) @ pose.rotation.T
    return flight.world.relief.met(pose.translation_m, rays)[:, :2]


def object_features(world: World, site: LocalFrame) -> list[dict[str, Any]]:
    """One GeoJSON feature per object and place: what moved between flights has a feature for each place."""
    features = []
    first_seen: dict[tuple[object, ...], tuple[Thing, list[int]]] = {}
    for number, day in enumerate(world.days, start=1):
        for thing in day:
            place = (thing.id, thing.east_m, thing.north_m, thing.yaw_deg, thing.velocity_m_s)
            first_seen.setdefault(place, (thing, []))[1].append(number)
    for thing, flights in first_seen.values():
        features.append(
            {
                "type": "Feature",
                "geometry": polygon_geometry(thing.footprint_m(), site),
                "properties": {
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
            }
        )
    return features


def feature_collection(features: Iterable[dict[str, Any]], site: LocalFrame) -> dict[str, Any]:
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


def coco_boxes(flight: SimulatedFlight, frames: Iterable[int]) -> dict[str, Any]:
    """COCO annotations of these frames. A box holds the pixels that show the object; `visibility` is the
    share of the object that nothing hides within the picture, `area` its visible pixels."""
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for index in frames:
        images.append(
            {
                "id": index,
                "file_name": _picture_name(flight, index),
                "width": flight.camera.width_px,
                "height": flight.camera.height_px,
                "frame": index,
            }
        )
        labels, totals = render_labels(
            flight.day.things,
            flight.day.bodies,
            flight.view(index),
            flight.true_poses[index],
            float(flight.from_middle_s[index]),
        )
        annotations += box_rows(flight.day.things, labels, totals, index, len(annotations) + 1)
    return {
        "info": {"description": f"simulated {flight.name}"},
        "categories": coco_categories(),
        "images": images,
        "annotations": annotations,
    }


def coco_categories() -> list[dict[str, Any]]:
    """COCO's rows of the classes."""
    return [{"id": i, "name": str(label)} for i, label in enumerate(CATEGORIES, start=1)]


def box_rows(
    things: Iterable[Thing], labels: Labels, totals: Mapping[int, int], image_id: int, first_id: int
) -> list[dict[str, Any]]:
    """COCO's annotations of one picture whose `labels` and `totals` are those of `render_labels`."""
    rows: list[dict[str, Any]] = []
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


def change_mask(flight: SimulatedFlight, index: int) -> ImageGray:
    """(height, width) 255 where the frame shows an object that came, or a place that one left, since
    flight 1.

    What moves counts at both places. Shadows, light and plants in the wind are no changes.
    """
    first, bodies = flight.before
    today = {thing.id: thing for thing in flight.day.things}
    before = {thing.id: thing for thing in first}
    left = [thing.id for thing in first if has_changed(thing, today.get(thing.id))]
    came = [
        thing.id
        for thing in flight.day.things
        if thing.id not in before or has_changed(before[thing.id], thing)
    ]
    view, pose = flight.view(index), flight.true_poses[index]
    from_middle_s = float(flight.from_middle_s[index])
    now, _ = render_labels(flight.day.things, flight.day.bodies, view, pose, from_middle_s)
    then, _ = render_labels(first, bodies, view, pose, 0.0)
    changed = np.isin(now, came) | np.isin(then, left)
    return np.where(changed, 255, 0).astype(np.uint8)


def map_tiles(ground: GroundRaster, site_grid: SiteGrid) -> dict[TileIndex, ImageRGBA]:
    """The ground's picture on a map grid, as tiles; transparent outside of it."""
    area = ground.area
    centre = np.array([(area.west_m + area.east_m) / 2, (area.south_m + area.north_m) / 2])
    grid_from_site = site_grid.grid_from_site_affine(centre, max(area.size_m) / 2)
    grid_from_raster = grid_from_site @ np.linalg.inv(ground.raster_from_site_matrix)
    corners = np.array(
        [
            [area.west_m, area.south_m],
            [area.east_m, area.south_m],
            [area.east_m, area.north_m],
            [area.west_m, area.north_m],
        ]
    )
    rgba = np.dstack([ground.rgb, np.full(ground.rgb.shape[:2], 255, np.uint8)])
    tiles: dict[TileIndex, ImageRGBA] = {}
    for tile in sorted(site_grid.grid.tiles_touched(site_grid.grid_from_site(corners))):
        x0, y0, x1, y1 = site_grid.grid.tile_window(tile)
        shift = np.array([[1.0, 0, -x0], [0, 1, -y0], [0, 0, 1]])
        picture = cv2.warpAffine(
            rgba,
            (shift @ grid_from_raster)[:2],
            (x1 - x0, y1 - y0),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(0, 0, 0, 0),
        )
        if picture[..., 3].any():
            picture[picture[..., 3] < 255] = 0
            tiles[tile] = np.asarray(picture, np.uint8)
    return tiles


def iso_time(time_ns: int) -> str:
    """UTC with microseconds and a Z."""
    moment = datetime.fromtimestamp(time_ns // 10**9, UTC).replace(
        microsecond=time_ns % 10**9 // 1000
    )
    return moment.isoformat(timespec="microseconds").replace("+00:00", "Z")


def _picture_name(flight: SimulatedFlight, index: int) -> str:
    return (
        flight.frame_name(index)
        if flight.settings.output.photos
        else f"{flight.name}_{index:06d}.png"
    )


def _degrees_or_null(value: float) -> float | None:
    return round(float(value), DEGREE_DECIMALS) if np.isfinite(value) else None


def polygon_geometry(outline_m: PointsM, site: LocalFrame) -> dict[str, Any] | None:
    """A ring of ground points, (N, 2), as a GeoJSON polygon in WGS84; None where a point is not known."""
    if not np.isfinite(outline_m).all():
        return None
    latitude, longitude, _ = site.wgs84_from_site(outline_m)
    ring: Floats = np.column_stack([longitude, latitude])
    closed = np.vstack([ring, ring[:1]])
    return {
        "type": "Polygon",
        "coordinates": [[[round(float(c), DEGREE_DECIMALS) for c in p] for p in closed]],
    }


def surface_heights(
    things: Sequence[Thing], bodies: Mapping[int, Body], view: View, relief: Relief = LEVEL
) -> Floats32:
    """(H, W) the height of the topmost surface at each pixel of a map view, m; that of level ground is 0.

    What looks like a leaf (crowns, silhouettes) counts where it is opaque.
    """
    heights = ground_heights(view, relief)
    for thing in things:
        for patch in bodies[thing.id].placed(thing.turn, thing.place_m(0.0), view.eye_m):
            corners = patch.corners_m
            normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
            if abs(normal[2]) < 1e-3 * np.linalg.norm(normal):
                continue  # a wall has no ground of its own
            for (x0, y0, x1, y1), rgba in sample_patches(view, [patch]):
                rays = view.rays_in((x0, y0, x1, y1))
                east, north = (
                    rays[..., 0] - view.ray_from_site[0, 3],
                    view.ray_from_site[1, 3] - rays[..., 1],
                )
                slope = (
                    normal[0] * (east - corners[0, 0]) + normal[1] * (north - corners[0, 1])
                ) / normal[2]
                up = np.clip(corners[0, 2] - slope, corners[:, 2].min(), corners[:, 2].max())
                here = heights[y0:y1, x0:x1]
                np.maximum(here, up, out=here, where=rgba[..., 3] > 127, casting="same_kind")
    return heights


def ground_heights(view: View, relief: Relief) -> Floats32:
    """(H, W) the bare ground's height at each pixel of a map view, m."""
    if relief.is_level:
        return np.zeros((view.camera.height_px, view.camera.width_px), np.float32)
    rays = view.rays_in((0, 0, view.camera.width_px, view.camera.height_px))
    east, north = rays[..., 0] - view.ray_from_site[0, 3], view.ray_from_site[1, 3] - rays[..., 1]
    return relief.up_m(np.dstack([east, north])).astype(np.float32)
