"""How like another map of the same ground a map is: eq. 4.1, and how far they lie apart."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import ImageGray, ImageRGBA, Mask, PointsPx
from sorvolo.geometry.geodesy import Projection
from sorvolo.mosaic.map_quality import Shift, correlation, residual_shift
from sorvolo.registration.features import gray_from_rgb

_LEAST_PX = 1000  # of common ground
_LATTICE_PX = 64  # between the points that are taken from CRS to CRS


@dataclass(frozen=True, eq=False)
class MapPicture:
    """A north-up map: `rgba` (H, W, 4), the centre of pixel (0, 0) at `origin_m` in `crs`."""

    rgba: ImageRGBA
    origin_m: tuple[float, float]
    m_per_px: float
    crs: str


@dataclass(frozen=True)
class ReferenceMatch:
    """Likeness with another map: eq. 4.1, at `m_per_px`, over `area_m2`; how far this map lies from it."""

    correlation: float
    correlation_after_shift: float
    shift: Shift
    shift_east_m: float
    shift_north_m: float
    m_per_px: float
    area_m2: float


def match_reference(mine: MapPicture, other: MapPicture) -> ReferenceMatch | None:
    """A map beside a reference; None where they show hardly any common ground."""
    gray, known = _resampled(other, mine)
    mask = known & (mine.rgba[..., 3] > 0)
    if mask.sum() < _LEAST_PX:
        return None
    own = gray_from_rgb(np.ascontiguousarray(mine.rgba[..., :3]))
    shift = residual_shift(gray, own, mask)
    moved = np.array([[1, 0, -shift.x_px], [0, 1, -shift.y_px]])
    size = own.shape[1], own.shape[0]
    back = np.asarray(cv2.warpAffine(own, moved, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)
    still = mask & (cv2.warpAffine(mask.astype(np.uint8), moved, size, flags=cv2.INTER_NEAREST) > 0)
    return ReferenceMatch(
        correlation(gray, own, mask),
        correlation(gray, back, still),
        shift,
        shift.x_px * mine.m_per_px,
        -shift.y_px * mine.m_per_px,
        mine.m_per_px,
        float(mask.sum()) * mine.m_per_px**2,
    )


def _resampled(raster: MapPicture, onto: MapPicture) -> tuple[ImageGray, Mask]:
    """A raster's gray in the pixels of another, and where it knows them; CRS to CRS by a lattice of points."""
    places = _places(raster, onto)
    source, m_per_px = raster.rgba, raster.m_per_px
    while onto.m_per_px > 2 * m_per_px and min(source.shape[:2]) > 32:
        source = cv2.pyrDown(source)  # type: ignore[assignment]
        places = np.asarray(places / 2, np.float32)
        m_per_px *= 2
    moved = cv2.remap(  # type: ignore[call-overload]
        source, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    return gray_from_rgb(np.ascontiguousarray(moved[..., :3])), moved[..., 3] > 254


def _places(raster: MapPicture, onto: MapPicture) -> NDArray[np.float32]:
    """(H, W, 2) where the pixels of `onto` lie in the raster."""
    height, width = onto.rgba.shape[:2]
    step = _LATTICE_PX
    columns, rows = np.arange(0, width + step, step), np.arange(0, height + step, step)
    x, y = (each.ravel().astype(np.float64) for each in np.meshgrid(columns, rows))
    points_m = np.column_stack([x, -y]) * onto.m_per_px + onto.origin_m
    if raster.crs != onto.crs:
        latitude_deg, longitude_deg = Projection(onto.crs).wgs84_from_projected(points_m)
        points_m = Projection(raster.crs).projected_from_wgs84(latitude_deg, longitude_deg)
    lattice: PointsPx = (points_m - raster.origin_m) / raster.m_per_px * [1.0, -1.0]
    # OpenCV's own enlargements round places to 1/32 of the lattice's step, which is pixels here
    down = np.maximum(0.0, 1 - abs(np.arange(height)[:, None] - rows) / step)
    across = np.maximum(0.0, 1 - abs(np.arange(width)[:, None] - columns) / step)
    places = np.einsum("hr,rcd->hcd", down, lattice.reshape(len(rows), len(columns), 2))
    return np.einsum("wc,hcd->hwd", across, places, optimize=True).astype(np.float32)
