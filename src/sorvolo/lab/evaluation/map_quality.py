"""How good a map is: against known truth, against its own frames (thesis 4.1.1), against another map (eq.
4.1).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from sorvolo.geometry.arrays import (
    Floats,
    ImageGray,
    ImageRGB,
    ImageRGBA,
    Mask,
    Matrix3,
    PointsM,
    frozen,
    square,
)
from sorvolo.geometry.grid import SiteGrid, TileIndex, gather_tiles
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.mosaic.canvas_frame import CanvasFrame, coverage, warp
from sorvolo.registration.features import gray_from_rgb

DEVIATION_BINS = 32
"""Bins of a deviation's histogram; each is 8 gray levels wide."""


@dataclass(frozen=True)
class Spread:
    """Distances summed up: root mean square, 95th percentile and the largest, in metres and in ground
    pixels.
    """

    rms_m: float
    p95_m: float
    max_m: float
    rms_px: float
    p95_px: float
    max_px: float
    count: int


@dataclass(frozen=True)
class CornerErrors:
    """Errors of the frames' corners on the ground.

    `absolute` is as they lie; `shape` what remains after the best similarity of all estimated corners onto
    the true ones; `floor` is what GPS noise alone costs: the true corners moved by the best similarity of the
    true camera positions onto the fixes. `over_floor` is absolute rms over floor rms. Both are NaN without
    fixes.
    """

    absolute: Spread
    shape: Spread
    floor: Spread
    over_floor: float


@dataclass(frozen=True, eq=False)
class Deviation:
    """The thesis's 4.1.1 for one frame: `share` is the mean absolute gray difference over 255.

    `histogram` (DEVIATION_BINS,) are the shares of pixels by absolute difference; they add up to 1. `count`
    is the number of pixels compared.
    """

    share: float
    histogram: Floats
    count: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "histogram", frozen(self.histogram))


@dataclass(frozen=True)
class Shift:
    """How far b lies from a, px right and down, and the peak's sharpness (0-1) as confidence."""

    x_px: float
    y_px: float
    response: float


def spread_of(distances_m: Floats, gsd_m: float) -> Spread:
    """Sum up distances, any shape; NaN everywhere when there is none."""
    distances_m = np.asarray(distances_m, dtype=np.float64).ravel()
    if not len(distances_m):
        nan = float("nan")
        return Spread(nan, nan, nan, nan, nan, nan, 0)
    rms, p95 = float(np.sqrt((distances_m**2).mean())), float(np.percentile(distances_m, 95))
    most = float(distances_m.max())
    return Spread(rms, p95, most, rms / gsd_m, p95 / gsd_m, most / gsd_m, len(distances_m))


def corner_errors(
    estimated_m: Floats,
    true_m: Floats,
    gsd_m: float,
    true_cameras_m: PointsM | None = None,
    fixes_m: PointsM | None = None,
) -> CornerErrors:
    """Compare estimated and true outlines, (N, 4, 2) m each, of the same frames.

    `true_cameras_m` and `fixes_m`, (M, 2) each, give the floor; the fixes may be of more frames than were
    placed, because the floor is a property of the flight.
    """
    estimated = np.asarray(estimated_m, dtype=np.float64)
    true = np.asarray(true_m, dtype=np.float64)
    estimated, true = estimated.reshape(-1, 2), true.reshape(-1, 2)
    none = spread_of(np.zeros(0), gsd_m)
    if not len(true):
        return CornerErrors(none, none, none, float("nan"))
    absolute = spread_of(np.linalg.norm(estimated - true, axis=1), gsd_m)
    aligned = apply_homography(fit_similarity(true, estimated), estimated)
    shape = spread_of(np.linalg.norm(aligned - true, axis=1), gsd_m)
    if true_cameras_m is None or fixes_m is None or len(fixes_m) < 2:
        return CornerErrors(absolute, shape, none, float("nan"))
    fixed_from_true = fit_similarity(fixes_m, true_cameras_m)
    floor = spread_of(np.linalg.norm(apply_homography(fixed_from_true, true) - true, axis=1), gsd_m)
    over_floor = absolute.rms_m / floor.rms_m if floor.rms_m > 0 else float("nan")
    return CornerErrors(absolute, shape, floor, over_floor)


def position_errors(
    estimated_m: PointsM, reference_m: PointsM, gsd_m: float
) -> tuple[Spread, Spread]:
    """Camera positions, (N, 2) or (N, 3) m, against a reference: as they lie, and after the best similarity.

    The similarity acts on east and north only and needs three cameras; heights stay as they are.
    """
    estimated = np.asarray(estimated_m, dtype=np.float64)
    reference = np.asarray(reference_m, dtype=np.float64)
    absolute = spread_of(np.linalg.norm(estimated - reference, axis=1), gsd_m)
    if len(reference) < 3:
        return absolute, spread_of(np.zeros(0), gsd_m)
    moved = estimated.copy()
    moved[:, :2] = apply_homography(
        fit_similarity(reference[:, :2], estimated[:, :2]), estimated[:, :2]
    )
    return absolute, spread_of(np.linalg.norm(moved - reference, axis=1), gsd_m)


def deviation(mosaic: ImageRGB, frame: ImageRGB, mask: Mask) -> Deviation:
    """How much a piece of the mosaic differs from the frame that was warped onto it, where `mask` is True.

    The thesis names "a deviation of about 15 %" of difference images and a histogram, and no formula. Here
    the deviation is the mean of |gray(mosaic) - gray(frame)| / 255 over the pixels that both show, and the
    histogram is of the same differences. The frame is compared as it was taken, without the gain that the
    mosaic gave it.
    """
    difference = cv2.absdiff(gray_from_rgb(mosaic), gray_from_rgb(frame))[mask]
    if not len(difference):
        return Deviation(float("nan"), np.zeros(DEVIATION_BINS), 0)
    counts = np.bincount(difference // (256 // DEVIATION_BINS), minlength=DEVIATION_BINS)
    return Deviation(float(difference.mean() / 255), counts / len(difference), len(difference))


def correlation(a: Floats | ImageGray, b: Floats | ImageGray, mask: Mask) -> float:
    """Eq. 4.1 of two gray pictures, (height, width), over the pixels in `mask`; NaN where one has no
    contrast.
    """
    if not mask.any():
        return float("nan")
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(np.corrcoef(a[mask], b[mask])[0, 1])


def residual_shift(a: Floats | ImageGray, b: Floats | ImageGray, mask: Mask) -> Shift:
    """How far picture b lies from picture a, both (height, width) and compared where `mask` is True.

    Phase correlation (Kuglin and Hines 1975) of the gradients, so that light and shade weigh little; to a
    fraction of a pixel, and for shifts up to a quarter of the picture's side.
    """
    if min(a.shape) < 16 or not mask.any():
        return Shift(float("nan"), float("nan"), 0.0)
    inner = cv2.erode(mask.astype(np.uint8), square(5)).astype(np.float64)
    edges: list[Floats] = []
    for picture in (a, b):
        smooth = cv2.GaussianBlur(picture.astype(np.float64), (0, 0), 1.0)
        slope = np.hypot(cv2.Sobel(smooth, cv2.CV_64F, 1, 0), cv2.Sobel(smooth, cv2.CV_64F, 0, 1))
        mean = (slope * inner).sum() / max(1.0, inner.sum())
        edges.append((slope - mean) * inner)
    window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_64F)
    (x, y), response = cv2.phaseCorrelate(edges[0], edges[1], window)
    return Shift(float(x), float(y), float(response))


_UNSEEN = 236  # a light grey
_RECENT = 64  # tiles remembered: neighbouring frames share most


@dataclass(frozen=True, eq=False)
class DeviationSummary:
    """The thesis's deviation over frames: mean, median and worst share, and the mean histogram."""

    mean: float
    median: float
    worst: float
    histogram: Floats
    frames: int


class MapDeviation:
    """Compares frames with the map one after another; remembers the map's last tiles."""

    def __init__(self, tiles: Mapping[TileIndex, ImageRGBA], site_grid: SiteGrid) -> None:
        self._site_grid = site_grid
        self._tile = lru_cache(_RECENT)(tiles.get)

    def of(self, image: ImageRGB, site_from_image: Matrix3) -> Deviation:
        """The deviation of one undistorted frame, (H, W, 3), from the map under it."""
        return deviation(*self._both(image, site_from_image))

    def shown(self, image: ImageRGB, site_from_image: Matrix3) -> dict[str, ImageRGB]:
        """The thesis's Figure 4.1: a part of the map, the undistorted frame that it was made of, and how they differ,
        (H, W, 3) each; grey where unknown."""
        mosaic, frame, mask = self._both(image, site_from_image)
        mosaic[~mask], frame[~mask] = _UNSEEN, _UNSEEN
        difference = np.abs(mosaic.astype(np.int16) - frame).astype(np.uint8)
        difference[~mask] = _UNSEEN
        return {"mosaic": mosaic, "frame": frame, "difference": difference}

    def under(self, outline_m: Floats, width_px: int, height_px: int) -> ImageRGB:
        """(height, width, 3) the map as a frame sees it whose corners lie at `outline_m`, (4, 2) in the site frame.

        The corners are those of the top left pixel, the top right, the bottom right and the bottom left.
        """
        grid_from_site = self._site_grid.grid_from_site_affine(np.mean(outline_m, axis=0), 100.0)
        corners = apply_homography(grid_from_site, np.asarray(outline_m, np.float64))
        low, high = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0)) + 1
        window = int(low[0]), int(low[1]), int(high[0]), int(high[1])
        ends = np.array(
            [[0, 0], [width_px - 1, 0], [width_px - 1, height_px - 1], [0, height_px - 1]],
            np.float32,
        )
        frame_from_window = cv2.getPerspectiveTransform((corners - low).astype(np.float32), ends)
        found = cv2.warpPerspective(
            gather_tiles(window, self._site_grid.grid.tile_px, self._tile),
            frame_from_window,
            (width_px, height_px),
        )
        found[found[..., 3] == 0] = _UNSEEN
        return np.ascontiguousarray(found[..., :3])

    def _both(self, image: ImageRGB, site_from_image: Matrix3) -> tuple[ImageRGB, ImageRGB, Mask]:
        """The map and the frame in one window of the grid, and where both are known."""
        height, width = image.shape[:2]
        x, y, z = site_from_image @ np.array([width / 2, height / 2, 1.0])
        grid_from_site = self._site_grid.grid_from_site_affine(np.array([x / z, y / z]), 100.0)
        frame = CanvasFrame(0, 0, width, height, grid_from_site @ site_from_image)
        low = np.floor(frame.outline_px.min(axis=0))
        high = np.ceil(frame.outline_px.max(axis=0)) + 1
        window = int(low[0]), int(low[1]), int(high[0]), int(high[1])
        mosaic = gather_tiles(window, self._site_grid.grid.tile_px, self._tile)
        mask = (coverage(frame, window) > 0) & (mosaic[..., 3] > 0)
        return np.ascontiguousarray(mosaic[..., :3]), warp(image, frame, window), mask


def frames_to_compare(count: int, most: int) -> list[int]:
    """At most this many of a flight's frames, by number, evenly chosen."""
    return (
        list(range(count))
        if count <= most
        else np.linspace(0, count - 1, most).astype(int).tolist()
    )


def summed_up(deviations: Sequence[Deviation]) -> DeviationSummary:
    """The deviations of frames together; those that show none of the map are left out."""
    found = [each for each in deviations if each.count]
    if not found:
        nan = float("nan")
        return DeviationSummary(nan, nan, nan, np.zeros(DEVIATION_BINS), 0)
    shares = np.array([each.share for each in found])
    return DeviationSummary(
        float(shares.mean()),
        float(np.median(shares)),
        float(shares.max()),
        np.mean([each.histogram for each in found], axis=0),
        len(found),
    )
