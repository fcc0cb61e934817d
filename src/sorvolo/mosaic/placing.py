"""Placed frames as the canvas and the records need them, whichever method placed them."""

from collections.abc import Sequence

import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, Mask, Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid
from sorvolo.mosaic.canvas_frame import CanvasFrame
from sorvolo.survey.flight import CameraPrior

_CLIMBING = 1.5  # times the usual height of the first frames: they show the climb
_HORIZON_MARGIN_DEG = 5.0  # below the horizon: ground there lies eleven heights away; by choice
_KNOWN_ATTITUDE_DEG = 4.0  # one sigma of a gimbal's tilt


def canvas_frame(
    keyframe_id: int,
    rank: int,
    stored: Camera,
    site_from_image: Matrix3,
    site_grid: SiteGrid,
    gains: Floats,
    vignette: Floats,
    valid: Mask | None,
) -> CanvasFrame | None:
    """A stored picture laid on the grid; None when part of it lies at or beyond the horizon."""
    centre = site_from_image @ np.array([stored.cx_px, stored.cy_px, 1.0])
    corner = site_from_image @ np.array([0.0, 0.0, 1.0])
    reach_m = float(np.linalg.norm(centre[:2] / centre[2] - corner[:2] / corner[2]))
    grid_from_site = site_grid.grid_from_site_affine(centre[:2] / centre[2], min(reach_m, 1000.0))
    try:
        return CanvasFrame(
            keyframe_id,
            rank,
            stored.width_px,
            stored.height_px,
            grid_from_site @ site_from_image,
            gains,
            vignette,
            valid,
        )
    except GeometryError:
        return None


def sees_horizon(camera: Camera, prior: CameraPrior) -> bool:
    """Whether a picture's corners look to the horizon or nearly, by telemetry that knows where the camera looks."""
    if prior.attitude_sigma_deg[:2].max() > _KNOWN_ATTITUDE_DEG:
        return False
    rays = camera.rays_from_pixels(camera.corners_px) @ prior.rotation.T
    down = -rays[:, 2] / np.linalg.norm(rays, axis=1)
    return bool(np.degrees(np.arcsin(down.min())) < _HORIZON_MARGIN_DEG)


def map_m_per_px(heights_m: Sequence[float], focal_px: float, climb_m: float = 0.0) -> float:
    """The ground sampling distance of pictures taken from these heights, to three digits: a new map's.

    The first pictures may show the climb from the ground. Then the flight's height counts: `climb_m` above that of
    these pictures, as far as telemetry states it, or else that of the highest so far.
    """
    usual_m, high_m = np.percentile(heights_m, [50, 90])
    high_m = max(high_m, usual_m + climb_m)
    return float(f"{(high_m if high_m > _CLIMBING * usual_m else usual_m) / focal_px:.3g}")
