"""How good a map is: against known truth, against its own frames (thesis 4.1.1), against another map (eq.
4.1).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, ImageGray, ImageRGB, Mask, PointsM, frozen
from sorvolo.geometry.homography import apply_homography, fit_similarity
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
    """Sum up distances, any shape; NaN everywhere when there is none. Raises GeometryError for a gsd not
    above 0.
    """
    if not gsd_m > 0:
        raise GeometryError(f"the ground sampling distance must be positive, got {gsd_m}")
    distances_m = np.asarray(distances_m, dtype=np.float64).ravel()
    if not len(distances_m):
        nan = float("nan")
        return Spread(nan, nan, nan, nan, nan, nan, 0)
    rms, p95, most = (
        np.sqrt((distances_m**2).mean()),
        np.percentile(distances_m, 95),
        distances_m.max(),
    )
    return Spread(
        float(rms),
        float(p95),
        float(most),
        float(rms / gsd_m),
        float(p95 / gsd_m),
        float(most / gsd_m),
        len(distances_m),
    )


def corner_errors(
    estimated_m: Floats,
    true_m: Floats,
    gsd_m: float,
    true_cameras_m: PointsM | None = None,
    fixes_m: PointsM | None = None,
) -> CornerErrors:
    """Compare estimated and true outlines, (N, 4, 2) m each, of the same frames.

    `true_cameras_m` and `fixes_m`, (M, 2) each, give the floor; the fixes may be of more frames than were
    placed, because the floor is a property of the flight. Raises GeometryError when shapes differ.
    """
    estimated, true = (
        np.asarray(estimated_m, dtype=np.float64),
        np.asarray(true_m, dtype=np.float64),
    )
    if estimated.shape != true.shape or estimated.shape[1:] != (4, 2):
        raise GeometryError(
            f"outlines must be (N, 4, 2) both, got {estimated.shape} and {true.shape}"
        )
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

    The similarity acts on east and north only and needs three cameras; heights stay as they are. Raises
    GeometryError when shapes differ.
    """
    estimated = np.asarray(estimated_m, dtype=np.float64)
    reference = np.asarray(reference_m, dtype=np.float64)
    if estimated.shape != reference.shape or estimated.ndim != 2:
        raise GeometryError(f"positions differ in shape: {estimated.shape} and {reference.shape}")
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
    if mosaic.shape != frame.shape or mosaic.shape[:2] != mask.shape:
        raise GeometryError(f"cannot compare {mosaic.shape}, {frame.shape} and mask {mask.shape}")
    difference = cv2.absdiff(gray_from_rgb(mosaic), gray_from_rgb(frame))[mask]
    if not len(difference):
        return Deviation(float("nan"), np.zeros(DEVIATION_BINS), 0)
    counts = np.bincount(difference // (256 // DEVIATION_BINS), minlength=DEVIATION_BINS)
    return Deviation(float(difference.mean() / 255), counts / len(difference), len(difference))


def correlation(a: Floats | ImageGray, b: Floats | ImageGray, mask: Mask) -> float:
    """Eq. 4.1 of two gray pictures, (height, width), over the pixels in `mask`; NaN where one has no
    contrast.
    """
    if a.shape != b.shape or a.shape != mask.shape:
        raise GeometryError(f"cannot correlate {a.shape} and {b.shape} under mask {mask.shape}")
    if not mask.any():
        return float("nan")
    da, db = a[mask].astype(np.float64), b[mask].astype(np.float64)
    da, db = da - da.mean(), db - db.mean()
    scale = np.sqrt((da**2).sum() * (db**2).sum())
    return float((da * db).sum() / scale) if scale > 0 else float("nan")


def residual_shift(a: Floats | ImageGray, b: Floats | ImageGray, mask: Mask) -> Shift:
    """How far picture b lies from picture a, both (height, width) and compared where `mask` is True.

    Phase correlation (Kuglin and Hines 1975) of the gradients, so that light and shade weigh little; to a
    fraction of a pixel, and for shifts up to a quarter of the picture's side.
    """
    if a.shape != b.shape or a.shape != mask.shape:
        raise GeometryError(f"cannot compare {a.shape} and {b.shape} under mask {mask.shape}")
    if min(a.shape) < 16 or not mask.any():
        return Shift(float("nan"), float("nan"), 0.0)
    inner = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(np.float64)
    edges: list[Floats] = []
    for picture in (a, b):
        smooth = cv2.GaussianBlur(picture.astype(np.float64), (0, 0), 1.0)
        slope = np.hypot(cv2.Sobel(smooth, cv2.CV_64F, 1, 0), cv2.Sobel(smooth, cv2.CV_64F, 0, 1))
        mean = (slope * inner).sum() / max(1.0, inner.sum())
        edges.append((slope - mean) * inner)
    window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_64F)
    (x, y), response = cv2.phaseCorrelate(edges[0], edges[1], window)
    return Shift(float(x), float(y), float(response))
