"""A flight's heights in its report: figures, and what a user should know before using them."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, Floats32, ImageRGBA, Mask, shrunk, size_within
from sorvolo.heights.cameras import FEATURES_SIDE_PX, Cameras3D
from sorvolo.heights.field import HeightField
from sorvolo.heights.surface import Surface

_SHARES = (0.6827, 0.9545)  # of a Gaussian, within one and two sigma
_ROUNDS = 30  # in which the factor settles


# see a point that judges: where two do, a wrong match along their line goes unseen
_LEAST_VIEWS = 3
_LEAST_POINTS = 100  # fewer judge nothing: five of them would be the share beyond two sigma


@dataclass(frozen=True)
class PointJudgement:
    """The heights at points: how many of them, their median distance, the shares within one and two of the sigma of
    the match as it was, and the factor that this sigma was raised by; 1 where the points found it large enough.

    The figures are NaN without points.
    """

    points: int
    median_m: float = float("nan")
    within_1_sigma: float = float("nan")
    within_2_sigma: float = float("nan")
    factor: float = 1.0


def judged_by_points(surface: Surface, solved: Cameras3D) -> tuple[Surface, PointJudgement]:
    """The surface with its sigma raised to what the flight's own points in space show, and their judgement.

    A point and the cell there have the cameras in common: what these err is left out of the comparison, and stays in
    the sigma as it is. The sigma is never lowered: points lie where the ground has texture, and show nothing for the
    heights of ground that has none.
    """
    judges = solved.point_views >= _LEAST_VIEWS
    points_m, sigma_m = solved.points_m[judges], solved.point_sigma_m[judges]
    at_m, stated_m = HeightField(surface.lattice, surface.up_m, surface.sigma_m).at(points_m[:, :2])
    known = np.isfinite(at_m)
    if known.sum() < _LEAST_POINTS:
        return surface, PointJudgement(int(known.sum()))
    off_m, points_m, sigma_m = np.abs(at_m - points_m[:, 2])[known], points_m[known], sigma_m[known]
    match_m = _without(stated_m[known], solved.height_sigma.at(points_m[:, :2]))
    times = off_m / np.hypot(match_m, sigma_m)
    factor = _factor(off_m, match_m, sigma_m)
    judgement = PointJudgement(
        len(off_m),
        float(np.median(off_m)),
        float((times < 1).mean()),
        float((times < 2).mean()),
        factor,
    )
    if factor <= 1:
        return surface, judgement
    camera_m = solved.height_sigma.on(surface.lattice)
    raised_m = np.hypot(factor * _without(surface.sigma_m, camera_m), camera_m).astype(np.float32)
    return replace(surface, sigma_m=raised_m), judgement


def _without(sigma: Floats | Floats32, part: Floats) -> Floats:
    """A sigma less an independent part of it; NaN stays."""
    return np.sqrt(np.maximum(sigma.astype(np.float64) ** 2 - part**2, 1e-12))


def _factor(off_m: Floats, match_m: Floats, point_m: Floats) -> float:
    """By how much the match's sigma is to be raised so that as many errors lie within one and two sigma as of a
    Gaussian; at least 1. The points' own sigma is not raised."""
    factor = 1.0
    for _ in range(_ROUNDS):
        times = off_m / np.hypot(factor * match_m, point_m)
        short = max(float(np.quantile(times, share)) / (k + 1) for k, share in enumerate(_SHARES))
        factor = max(1.0, factor * short)
    return factor


_WARN_OBLIQUE_DEG = 25.0  # off the vertical, the median photo
_WARN_ONE_STRIP = 0.08  # how wide a path is, as a share of its length, below which it is one strip
_WARN_MOST_HOLES = 0.1  # share of the ground that two photos see
# rms, of pictures no larger than `fit_side_px`: level and hilly flights have 0.1 to 0.3
_WARN_BAD_FIT_PX = 0.45
_WARN_FIT_SIDE_PX = FEATURES_SIDE_PX  # larger ones are matched at this size


def camera_figures(solved: Cameras3D) -> Mapping[str, Any]:
    """The solution of the cameras in 3D, as plain values."""
    return {
        "views": len(solved.views),
        "lost": list(solved.lost),
        "points": len(solved.points_m),
        "observations": solved.observations,
        "residual_rms_px": solved.residual_px,
        "focal_px": solved.views[0].camera.fx_px,
        "focal_scale": solved.focal_scale,
        "radial": solved.radial,
        "fix_rms_m": {
            axis: float(each) for axis, each in zip(("east", "north", "up"), solved.fix_rms_m)
        },
        "optical_centre_px": [solved.views[0].camera.cx_px, solved.views[0].camera.cy_px],
        "places": [
            {
                "frame": view.name,
                "east_m": float(e),
                "north_m": float(n),
                "up_m": float(u),
                "rotation": view.site_from_camera.rotation.ravel(),
            }
            for view in solved.views
            for e, n, u in [view.site_from_camera.translation_m]
        ],
    }


def surface_figures(
    surface: Surface, shows_ground: Mask, judgement: PointJudgement
) -> Mapping[str, Any]:
    """The height model and how its points judge it, as plain values; shares are of the ground that two photos see."""
    known = np.isfinite(surface.up_m)
    low, middle, high = (
        np.nanpercentile(surface.up_m, [1, 50, 99]) if known.any() else (np.nan,) * 3
    )
    covered = max(int(surface.covered.sum()), 1)
    return {
        "columns": surface.lattice.width,
        "rows": surface.lattice.height,
        "covered_m2": covered * surface.lattice.cell_m**2,
        "holes_share": 1 - known.sum() / covered,
        "ground_share": float((shows_ground & known).sum() / max(int(known.sum()), 1)),
        "up_m": {"p01": float(low), "median": float(middle), "p99": float(high)},
        "sigma_median_m": float(np.nanmedian(surface.sigma_m)) if known.any() else None,
        "sigma_p95_m": float(np.nanpercentile(surface.sigma_m, 95)) if known.any() else None,
        "own_points": {
            name: value if np.isfinite(value) else None
            for name, value in dataclasses.asdict(judgement).items()
        },
    }


def camera_warnings(solved: Cameras3D) -> list[str]:
    """What in the flight makes its heights weak."""
    remarks = []
    if solved.lost:
        remarks.append(
            f"{len(solved.lost)} of {len(solved.lost) + len(solved.views)} photos share too few points with others "
            "and are not part of the heights"
        )
    places = np.array([view.site_from_camera.translation_m for view in solved.views])
    spread = np.linalg.svd(places[:, :2] - places[:, :2].mean(axis=0), compute_uv=False)
    if spread[1] < _WARN_ONE_STRIP * spread[0]:
        remarks.append(
            "the photos lie along one strip: the tilt of the ground across it is known from the drone's attitude "
            "alone (about 3 degrees); fly at least two strips, or one across, for heights"
        )
    tilt = np.degrees(
        np.arccos(np.clip([-view.site_from_camera.rotation[2, 2] for view in solved.views], -1, 1))
    )
    if np.median(tilt) > _WARN_OBLIQUE_DEG:
        remarks.append(
            f"the photos look {np.median(tilt):.0f} degrees off the vertical: walls and what lies behind things have "
            "heights of their surroundings"
        )
    camera = solved.views[0].camera
    fit_px = solved.residual_px * min(
        1.0, _WARN_FIT_SIDE_PX / max(camera.width_px, camera.height_px)
    )
    if fit_px > _WARN_BAD_FIT_PX:
        remarks.append(
            f"the photos fit each other in space to {solved.residual_px:.2f} px only: a rolling shutter, blur, things "
            "that move or a zoomed lens; the heights may be off by several times their stated error"
        )
    if not np.isfinite(solved.fix_rms_m).all():
        remarks.append("no GPS position: the heights have the map's own scale")
    return remarks


def surface_warnings(surface: Surface) -> list[str]:
    """What in the height model is weak."""
    covered = max(int(surface.covered.sum()), 1)
    holes = 1 - np.isfinite(surface.up_m).sum() / covered
    if holes > _WARN_MOST_HOLES:
        return [
            f"{holes:.0%} of the ground that two photos see has no height: water, bare ground without texture, or "
            "things that move"
        ]
    return []


_LONGEST_PX = 1600  # a screen's width; by choice
_SUN = np.array([-0.5, 0.5, 0.7]) / np.linalg.norm([-0.5, 0.5, 0.7])


def relief_picture(surface: Surface) -> ImageRGBA:
    """(H, W, 4) the shaded heights; holes are transparent."""
    known = np.isfinite(surface.up_m)
    if not known.any():
        return np.zeros((1, 1, 4), np.uint8)
    scale = min(1.0, _LONGEST_PX / max(surface.up_m.shape))
    up_m: Floats32 = np.where(known, surface.up_m, np.nanmedian(surface.up_m)).astype(np.float32)
    size = size_within(up_m, _LONGEST_PX)
    up_m = np.asarray(shrunk(up_m, size), np.float32)
    seen = shrunk(known.astype(np.float32), size) > 0.5
    down, across = (
        np.gradient(up_m, surface.lattice.cell_m / scale)
        if min(up_m.shape) > 1
        else (up_m * 0, up_m * 0)
    )
    light = (-across * _SUN[0] + down * _SUN[1] + _SUN[2]) / np.sqrt(1 + across**2 + down**2)
    low, high = np.percentile(up_m[seen], [1, 99]) if seen.any() else (0.0, 1.0)
    level = np.clip((up_m - low) / max(high - low, 0.1) * 255, 0, 255).astype(np.uint8)
    colours = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    shaded = np.clip(colours * (0.3 + 0.9 * np.clip(light, 0, 1)[..., None]), 0, 255).astype(
        np.uint8
    )
    return np.dstack([shaded, np.where(seen, 255, 0).astype(np.uint8)])
