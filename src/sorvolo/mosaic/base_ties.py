"""Frames found on a base map, as ties of a flight to its ground."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, ImageRGBA, Matrix3, PointsM, Vector3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.homography import apply_homography
from sorvolo.mosaic.ground_ties import GroundTies
from sorvolo.mosaic.overview import Overview
from sorvolo.mosaic.planar import PlanarMapper
from sorvolo.registration.features import gray_from_rgb
from sorvolo.registration.place_search import find_place, scale_steps
from sorvolo.survey.flight import CameraPrior

_MOST_FRAMES = 150  # looked for on the base map
_LOWEST_M = 8.0  # heights of flights that state none: from here ...
_HIGHEST_M = 250.0  # ... to here
_POINTS = (4, 3)  # across and down: they stand for a frame
_INDEPENDENT = 3.0  # of them: they err together
_WILD = 6.0  # times as far off as most: a frame that was laid on other ground
_ROUNDS = 3  # of leaving wild ones out


@dataclass(frozen=True, eq=False)
class FoundFrame:
    """A keyframe on the base map: site_from_image (3, 3) of its undistorted picture, of `camera`'s size; its misfit."""

    keyframe_id: int
    camera: Camera
    site_from_image: Matrix3
    residual_m: float

    @classmethod
    def of(
        cls, keyframe_id: int, camera: Camera, site_from_image: Matrix3, residual_px: float
    ) -> "FoundFrame":
        """The frame with its misfit given in pixels of `camera`, by how large the one in its middle is."""
        pixel = np.array([[camera.cx_px, camera.cy_px], [camera.cx_px + 1, camera.cy_px]])
        m_per_px = float(np.linalg.norm(np.diff(apply_homography(site_from_image, pixel), axis=0)))
        return cls(keyframe_id, camera, site_from_image, residual_px * m_per_px)


@dataclass(frozen=True)
class BaseReport:
    """How a flight was tied to a base map. `moved_m` is how far that moved it (median), NaN where it had no place."""

    name: str
    m_per_px: float
    sought: int
    found: int
    left_out: int
    residual_m: float
    moved_m: float


def sought_keyframes(mapper: PlanarMapper) -> list[int]:
    """The keyframes to look for: all, or some evenly spread."""
    placed = mapper.placed()
    return placed[:: -(-len(placed) // _MOST_FRAMES)]


def prior_on_map(mapper: PlanarMapper, keyframe_id: int, sigma_m: float) -> CameraPrior:
    """Where a keyframe's camera is by the map so far, as good as `sigma_m`."""
    pose = mapper.pose(keyframe_id)
    sigma: Vector3 = np.array([sigma_m, sigma_m, 1.0 + 0.05 * pose.translation_m[2]])
    return CameraPrior(pose.translation_m, sigma, pose.rotation, np.full(3, 3.0))


def tie_to_base(
    mapper: PlanarMapper,
    frames: Sequence[FoundFrame],
    full: Camera,
    m_per_px: float,
    *,
    is_datum: bool,
) -> tuple[int, float]:
    """Tie the map to the base map; how many frames were left out as laid on other ground, and the median misfit, m."""
    kept = list(frames)
    misfit: Floats = np.zeros(0)
    for _ in range(_ROUNDS):
        parts = [_ties(mapper, each, full, m_per_px) for each in kept]
        ids, ideal, place_m, sigma_px, sigma_m = (
            np.concatenate([getattr(each, name) for each in parts])
            for name in ("keyframe_ids", "ideal", "place_m", "sigma_px", "sigma_m")
        )
        common_m = max(each.common_m for each in parts)
        ties = GroundTies(ids, ideal, place_m, sigma_px, sigma_m, common_m)
        mapper.tie_to_ground(ties, is_datum=is_datum)
        misfit = np.array(
            [
                np.median(
                    np.linalg.norm(mapper.ground_places_m(each) - each.place_m[:, :2], axis=1)
                )
                for each in parts
            ]
        )
        good = misfit <= max(_WILD * float(np.median(misfit)), 3 * m_per_px)
        if good.all():
            break
        kept = [each for each, is_good in zip(kept, good, strict=True) if is_good]
    return len(frames) - len(kept), float(np.median(misfit))


def _ties(
    mapper: PlanarMapper,
    frame: FoundFrame,
    full: Camera,
    m_per_px: float,
) -> GroundTies:
    camera = frame.camera
    x, y = (
        np.linspace(0.12, 0.88, count) * size
        for count, size in zip(_POINTS, (camera.width_px, camera.height_px), strict=True)
    )
    pixels = np.column_stack([each.ravel() for each in np.meshgrid(x, y)])
    ground_m = apply_homography(frame.site_from_image, pixels)
    seen = np.isfinite(ground_m).all(axis=1)
    count = int(seen.sum())
    scale = mapper.registration_scale(frame.keyframe_id, full)
    sigma_m = np.hypot(m_per_px, frame.residual_m) * np.sqrt(count / _INDEPENDENT)
    return GroundTies(
        np.full(count, frame.keyframe_id),
        (pixels[seen] - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px],
        np.column_stack([ground_m[seen], np.zeros(count)]),
        np.full(count, scale),
        np.full(count, sigma_m),
        common_m=m_per_px,
    )


def find_flight(
    mapper: PlanarMapper,
    overview: Overview,
    ground: Overview,
    full: Camera,
) -> bool:
    """Bring a flight of unknown place, scale and north to where its overview lies on the base map's; whether it is."""
    unit = overview.unit_per_px / ground.unit_per_px / full.fx_px
    scales = scale_steps(unit * _LOWEST_M, unit * _HIGHEST_M)
    found = find_place((overview.gray, overview.known), (ground.gray, ground.known), scales)
    if found is None:
        return False
    site_from_local = ground.site_from_image @ found @ np.linalg.inv(overview.site_from_image)
    ids = mapper.placed()
    local_m = np.array([mapper.pose(each).translation_m[:2] for each in ids])
    # the point straight below a camera, in its picture
    ideal = np.array([_nadir(mapper.pose(each).rotation) for each in ids])
    below_m = apply_homography(site_from_local, local_m)
    mapper.tie_to_ground(
        GroundTies(
            np.array(ids),
            ideal,
            np.column_stack([below_m, np.zeros(len(ids))]),
            np.full(len(ids), 3.0),
            np.full(len(ids), 3 * ground.unit_per_px),
        ),
        is_datum=True,
    )
    return True


def _nadir(rotation: Matrix3) -> Floats:
    down = rotation.T @ np.array([0.0, 0.0, -1.0])
    return down[:2] / max(float(down[2]), 0.1)


def base_grid(
    frame: LocalFrame, crs: str, base_m_per_px: float, native_m_per_px: float, width_px: int
) -> SiteGrid:
    """The grid in which a flight is laid over its base map: no finer than either needs it."""
    return SiteGrid.at(
        frame.origin, max(base_m_per_px, native_m_per_px * max(1.0, width_px / 900)), crs
    )


def as_overview(rgba: ImageRGBA, first_m: PointsM, site_grid: SiteGrid) -> Overview:
    """A base map in a grid's pixels, (H, W, 4), that of easting, northing `first_m` the first, as an overview."""
    grid_from_image = np.eye(3)
    grid_from_image[:2, 2] = np.rint(site_grid.grid.grid_from_projected(first_m[None])[0])
    site_from_grid = np.linalg.inv(site_grid.grid_from_site_affine(np.zeros(2), 50.0))
    return Overview(
        gray_from_rgb(np.ascontiguousarray(rgba[..., :3])),
        rgba[..., 3] == 255,
        site_from_grid @ grid_from_image,
    )


def around(mapper: PlanarMapper, margin: float) -> PointsM:
    """(4, 2) corners of a box around all cameras, larger on each side by `margin` times their height."""
    places_m = np.array([mapper.pose(each).translation_m for each in mapper.placed()])
    spare_m = margin * float(np.median(places_m[:, 2]))
    low, high = places_m[:, :2].min(axis=0) - spare_m, places_m[:, :2].max(axis=0) + spare_m
    return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
