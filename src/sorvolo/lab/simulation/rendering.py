"""A day of the site as one view sees it: the ground, then everything that stands on it, far to near."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, ImageRGB
from sorvolo.geometry.homography import shifted
from sorvolo.geometry.pose import Pose
from sorvolo.lab.simulation.ground_painting import GroundRaster
from sorvolo.lab.simulation.world import Day, Relief
from sorvolo.search.drawing.objects import Body, Thing
from sorvolo.search.drawing.view import DrawnView, blend, remapped, sample_patches

Labels = NDArray[np.int32]
"""(height, width) int32: the id of the thing that a pixel shows, 0 for ground."""


def render(day: Day, view: DrawnView, site_from_camera: Pose, from_middle_s: float) -> ImageRGB:
    """The picture before the camera's own faults, this long after the middle of the flight."""
    image = (
        render_ground(day.ground, view)
        if day.relief.is_level
        else render_hills(day.ground, day.relief, view)
    )
    seen = _in_sight(day.things, view, site_from_camera, from_middle_s)
    patches = [
        day.shadows[thing.id].moved(np.eye(3), thing.place_m(from_middle_s))
        for thing in seen
        if thing.id in day.shadows
    ]
    for thing in seen:
        patches += day.bodies[thing.id].placed(thing.turn, thing.place_m(from_middle_s), view.eye_m)
    for window, sample in sample_patches(view, patches):
        blend(image, window, sample)
    return image


def render_ground(ground: GroundRaster, view: DrawnView) -> ImageRGB:
    """The bare ground through the view's own lens."""
    site_from_ray = np.linalg.inv(
        view.ray_from_plane(np.zeros(3), np.array([1.0, 0, 0]), np.array([0.0, 1, 0]))
    )
    raster_from_ray = ground.raster_from_site_matrix @ site_from_ray
    width, height = view.camera.width_px, view.camera.height_px
    rays = view.rays_in((0, 0, width, height))
    rim = np.concatenate([rays[0], rays[-1], rays[:, 0], rays[:, -1]]).reshape(-1, 1, 2)
    reach = cv2.perspectiveTransform(rim, raster_from_ray)[:, 0]
    rows, columns = ground.rgb.shape[:2]
    # only this window is handed on: remap takes no picture of more than 32767 pixels a side
    x0, y0 = np.clip(np.floor(reach.min(axis=0)) - 2, 0, [columns - 2, rows - 2]).astype(int)
    x1, y1 = np.clip(np.ceil(reach.max(axis=0)) + 3, [x0 + 2, y0 + 2], [columns, rows]).astype(int)
    where = cv2.perspectiveTransform(
        np.ascontiguousarray(rays).reshape(-1, 1, 2), shifted(-x0, -y0) @ raster_from_ray
    )
    return remapped(ground.rgb[y0:y1, x0:x1], where.reshape(height, width, 2), cv2.BORDER_REPLICATE)


def render_hills(ground: GroundRaster, relief: Relief, view: DrawnView) -> ImageRGB:
    """The bare ground laid over hills, through the view's own lens."""
    matrix = ground.raster_from_site_matrix
    per_m, first_px = matrix.diagonal()[:2].astype(np.float32), matrix[:2, 2].astype(np.float32)
    where = relief.seen(view) * per_m + first_px
    rows, columns = ground.rgb.shape[:2]
    # only this window is handed on: remap takes no picture of more than 32767 pixels a side
    low = np.clip(np.floor(where.min(axis=(0, 1))) - 2, 0, [columns - 2, rows - 2]).astype(int)
    high = np.clip(np.ceil(where.max(axis=(0, 1))) + 3, low + 2, [columns, rows]).astype(int)
    return remapped(
        ground.rgb[low[1] : high[1], low[0] : high[0]],
        where - low.astype(np.float32),
        cv2.BORDER_REPLICATE,
    )


def render_labels(
    things: Sequence[Thing],
    bodies: Mapping[int, Body],
    view: DrawnView,
    site_from_camera: Pose,
    from_middle_s: float,
) -> tuple[Labels, dict[int, int]]:
    """Which thing every pixel shows, and how many pixels each thing in sight would show if nothing hid it."""
    height, width = view.camera.height_px, view.camera.width_px
    labels, alone = np.zeros((height, width), np.int32), np.zeros((height, width), bool)
    totals: dict[int, int] = {}
    for thing in _in_sight(things, view, site_from_camera, from_middle_s):
        windows = []
        patches = bodies[thing.id].placed(thing.turn, thing.place_m(from_middle_s), view.eye_m)
        for (x0, y0, x1, y1), rgba in sample_patches(view, patches):
            alone[y0:y1, x0:x1] |= rgba[..., 3] > 127
            windows.append((x0, y0, x1, y1))
        if not windows:
            continue
        x0, y0 = np.min(windows, axis=0)[:2]
        x1, y1 = np.max(windows, axis=0)[2:]
        mine = alone[y0:y1, x0:x1]
        totals[thing.id] = int(np.count_nonzero(mine))
        labels[y0:y1, x0:x1][mine] = thing.id
        mine[:] = False
    return labels, totals


def _in_sight(
    things: Sequence[Thing], view: DrawnView, site_from_camera: Pose, from_middle_s: float
) -> list[Thing]:
    """The things that may be in the picture, in painting order.

    Seen from above, whatever stands nearer to the point below the camera hides what stands behind it; a crown
    reaches over what stands under it, so the outline's nearest point decides.
    """
    if not things:
        return []
    eye_m, camera = site_from_camera.translation_m, view.camera
    places = np.array([thing.place_m(from_middle_s) for thing in things])
    half_heights = np.array([0.0, 0.0, 0.5]) * np.array([[thing.size_m[2]] for thing in things])
    reach_m = np.array([thing.reach_m + thing.size_m[2] / 2 for thing in things])
    middles_px = view.project(places + half_heights)
    # the ball around a thing, at the distance of its nearest point, and a little for the lens
    nearest_m = np.maximum(np.linalg.norm(places + half_heights - eye_m, axis=1) - reach_m, 0.5)
    reach_px = (1.3 * camera.fx_px * reach_m / nearest_m + 8)[:, None]
    size = np.array([camera.width_px, camera.height_px])
    near = ((middles_px > -reach_px) & (middles_px < size + reach_px)).all(axis=1)
    nearest = [
        (_distance_to_outline(thing.footprint_m(from_middle_s), eye_m[:2]), thing)
        for thing, keep in zip(things, near)
        if keep
    ]
    return [
        thing
        for _, thing in sorted(nearest, key=lambda pair: (-pair[0], pair[1].size_m[2], pair[1].id))
    ]


def _distance_to_outline(outline_m: Floats, point_m: Floats) -> float:
    inside = cv2.pointPolygonTest(
        outline_m.astype(np.float32).reshape(-1, 1, 2), (float(point_m[0]), float(point_m[1])), True
    )
    return max(0.0, -float(inside))
