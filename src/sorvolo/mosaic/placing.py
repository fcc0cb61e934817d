"""Placed frames as the canvas and the records need them, whichever method placed them."""

import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, Mask, Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid
from sorvolo.mosaic.canvas_frame import CanvasFrame


def canvas_frame(
    keyframe_id: int, rank: int, stored: Camera, site_from_image: Matrix3, site_grid: SiteGrid, gains: Floats,
    vignette: Floats, valid: Mask | None,
) -> CanvasFrame | None:
    """A stored picture laid on the grid; None when part of it lies at or beyond the horizon."""
    centre = site_from_image @ np.array([stored.cx_px, stored.cy_px, 1.0])
    corner = site_from_image @ np.array([0.0, 0.0, 1.0])
    reach_m = float(np.linalg.norm(centre[:2] / centre[2] - corner[:2] / corner[2]))
    grid_from_site = site_grid.grid_from_site_affine(centre[:2] / centre[2], min(reach_m, 1000.0))
    try:
        return CanvasFrame(
            keyframe_id, rank, stored.width_px, stored.height_px, grid_from_site @ site_from_image, gains, vignette,
            valid,
        )
    except GeometryError:
        return None
