"""The true heights of a simulated day at each pixel of a view from above."""

from collections.abc import Mapping, Sequence

import numpy as np

from sorvolo.geometry.arrays import Floats32
from sorvolo.lab.simulation.world import LEVEL, Relief
from sorvolo.search.drawing.objects import Body, Thing
from sorvolo.search.drawing.view import DrawnView, sample_patches


def surface_heights(
    things: Sequence[Thing], bodies: Mapping[int, Body], view: DrawnView, relief: Relief = LEVEL
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


def ground_heights(view: DrawnView, relief: Relief) -> Floats32:
    """(H, W) the bare ground's height at each pixel of a map view, m."""
    if relief.is_level:
        return np.zeros((view.camera.height_px, view.camera.width_px), np.float32)
    rays = view.rays_in((0, 0, view.camera.width_px, view.camera.height_px))
    east, north = rays[..., 0] - view.ray_from_site[0, 3], view.ray_from_site[1, 3] - rays[..., 1]
    return relief.up_m(np.dstack([east, north])).astype(np.float32)
