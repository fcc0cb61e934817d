"""A camera from pictures of a checkerboard: Zhang's method ([114] of the thesis), soberly judged."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.capture.intrinsics import check_lens
from sorvolo.errors import GeometryError, InputError, SettingsError
from sorvolo.geometry.arrays import Floats, ImageRGB, PointsM, PointsPx
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION

FEWEST_VIEWS = 8  # views of the board; all six by choice
MOST_VIEWS = 40  # views: more cost time alone
# between the boards' tilts: boards that all lie alike fix no focal length
LEAST_TILT_SPREAD_DEG = 10.0
# share of the picture that the boards fill together: distortion shows at its rim
LEAST_COVERAGE = 0.4
LARGEST_ERROR_PX = 2.0  # rms of the corners
LARGEST_FOCAL_SIGMA = 0.02  # relative

_SEARCH_PX = 1600
"""Longer side of the picture in which the board is searched; its corners are then refined at full size."""

_SAME_VIEW = 0.03
"""Views whose corners differ less, in parts of the picture's diagonal, add nothing."""

_ADVICE = (
    "take 15-30 sharp pictures with the board near and far, in every part of the picture, and tilted "
    "20-45 deg to all "
    "sides"
)


@dataclass(frozen=True)
class Board:
    """A checkerboard by its inner corners; `square_mm` scales the board's poses, not the camera."""

    columns: int
    rows: int
    square_mm: float = 25.0

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3 or self.columns > 60 or self.rows > 60:
            raise SettingsError(
                f"a board needs 3 to 60 inner corners a side, got {self.columns}x{self.rows}"
            )
        if not (np.isfinite(self.square_mm) and self.square_mm > 0):
            raise SettingsError(f"the side of a square must be positive, got {self.square_mm} mm")

    @property
    def corners_mm(self) -> PointsM:
        """(columns * rows, 3) inner corners on the board, row by row."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return self.square_mm * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(
            np.float64
        )


@dataclass(frozen=True, eq=False)
class BoardView:
    """One picture's corners, (columns * rows, 2) px, row by row; `blur_px` is how wide edges are."""

    name: str
    corners_px: PointsPx
    blur_px: float


@dataclass(frozen=True)
class NoBoard:
    """A picture in which the board was not found whole."""

    name: str


@dataclass(frozen=True, eq=False)
class Calibration:
    """A camera with the evidence for it.

    `view_errors_px` is each used view's rms reprojection error by name; `dropped` names the views that did
    not fit the others; `tilt_spread_deg` the largest angle between two of the board's normals; `coverage`
    the part of the picture that boards filled; `focal_sigma` relative, three times the formal deviation.
    """

    camera: Camera
    reprojection_error_px: float
    focal_sigma: float
    view_errors_px: dict[str, float]
    dropped: tuple[str, ...]
    tilt_spread_deg: float
    coverage: float


def find_board(name: str, image: ImageRGB, board: Board) -> BoardView | NoBoard:
    """The board's inner corners in a picture, to a fraction of a pixel (Duda and Frese 2018)."""
    gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    scale = min(1.0, _SEARCH_PX / max(gray.shape))
    small = (
        cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        if scale < 1
        else gray
    )
    size = (board.columns, board.rows)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(small, size, flags=flags)
    if not found:
        return NoBoard(name)
    corners_px = (corners.reshape(-1, 2).astype(np.float64) + 0.5) / scale - 0.5
    # on drawn boards the search alone is 0.10-0.16 px rms off, refined 0.03 px
    grid = corners_px.reshape(board.rows, board.columns, 2)
    step_px = min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1))
    window = int(np.clip(0.3 * step_px, 2, 15))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 0.01)
    points = corners_px.astype(np.float32).reshape(-1, 1, 2)
    corners_px = np.asarray(
        cv2.cornerSubPix(gray, points, (window, window), (-1, -1), stop).reshape(-1, 2),
        dtype=np.float64,
    )
    sharpness = cv2.estimateChessboardSharpness(
        gray, size, corners_px.astype(np.float32).reshape(-1, 1, 2)
    )
    return BoardView(name, corners_px, float(np.ravel(sharpness[0])[0]))


def _rounded_down(value: float) -> str:
    """To a tenth, so that too little never reads as enough."""
    return f"{np.floor(10 * value) / 10:.1f}"


def calibrate(
    views: Sequence[BoardView], board: Board, width_px: int, height_px: int
) -> Calibration:
    """The camera that explains the views, or an InputError that names what is missing.

    Refused are fewer than 8 views that differ, boards that leave most of the picture empty, boards without a
    variety of tilts (the focal length is then not determined), and a fit that is bad or uncertain.
    """
    # the views worth using: of nearly equal ones the sharpest, at most `MOST_VIEWS`, far
    # from each other
    same_px = _SAME_VIEW * float(np.hypot(width_px, height_px))
    distinct: list[BoardView] = []
    for view in sorted(views, key=lambda each: each.blur_px):
        if all(_distance_px(view, other) >= same_px for other in distinct):
            distinct.append(view)
    used, rest = distinct[:1], distinct[1:]
    while rest and len(used) < MOST_VIEWS:
        farthest = max(rest, key=lambda each: min(_distance_px(each, other) for other in used))
        rest.remove(farthest)
        used.append(farthest)
    _need(
        len(used) >= FEWEST_VIEWS,
        f"{len(used)} different views of the board, {FEWEST_VIEWS} are needed",
    )
    # the part of the picture that lies inside the corners of at least one board
    scale = 200 / max(width_px, height_px)
    seen = np.zeros((round(height_px * scale), round(width_px * scale)), np.uint8)
    count = board.columns * board.rows
    outline = np.array([0, board.columns - 1, count - 1, count - board.columns])
    for view in used:
        cv2.fillConvexPoly(seen, np.rint(view.corners_px[outline] * scale).astype(np.int32), 1)
    coverage = float(seen.mean())
    _need(
        coverage >= LEAST_COVERAGE,
        f"the boards fill {_rounded_down(100 * coverage)} % of the picture, {LEAST_COVERAGE:.0%} are needed",
    )
    dropped: list[str] = []
    fit = _fit(used, board, width_px, height_px)
    while len(bad := _outliers(fit.view_errors_px)) > 0 and len(used) - len(bad) >= FEWEST_VIEWS:
        dropped += [used[index].name for index in bad]
        used = [view for index, view in enumerate(used) if index not in bad]
        fit = _fit(used, board, width_px, height_px)
    normals = np.array([cv2.Rodrigues(vector)[0][:, 2] for vector in fit.rotation_vectors_rad])
    spread_deg = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))).max())
    _need(
        spread_deg >= LEAST_TILT_SPREAD_DEG,
        f"the boards are tilted by no more than {_rounded_down(spread_deg)} deg against each other, "
        f"{LEAST_TILT_SPREAD_DEG:.0f} deg are needed",
    )
    _need(
        fit.error_px <= LARGEST_ERROR_PX,
        f"the corners miss the camera by {fit.error_px:.1f} px rms",
    )
    _need(
        fit.focal_sigma <= LARGEST_FOCAL_SIGMA,
        f"the focal length is uncertain by {fit.focal_sigma:.1%}",
    )
    check_lens("these views", fit.camera)
    errors_px = {view.name: float(error) for view, error in zip(used, fit.view_errors_px)}
    return Calibration(
        fit.camera, fit.error_px, fit.focal_sigma, errors_px, tuple(dropped), spread_deg, coverage
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    camera: Camera
    error_px: float
    focal_sigma: float
    view_errors_px: Floats
    rotation_vectors_rad: Floats


def _fit(views: Sequence[BoardView], board: Board, width_px: int, height_px: int) -> _Fit:
    """Zhang's closed form refined by least squares; k3 only where the views determine it."""
    board_points = [board.corners_mm.astype(np.float32)] * len(views)
    image_points = [view.corners_px.astype(np.float32).reshape(-1, 1, 2) for view in views]
    for flags in (0, cv2.CALIB_FIX_K3):
        try:
            error_px, matrix, distortion, turns, _, deviations, _, view_errors = (
                cv2.calibrateCameraExtended(
                    board_points,
                    image_points,
                    (width_px, height_px),
                    np.eye(3),
                    np.zeros(5),
                    flags=flags,
                )
            )
        except cv2.error as error:
            raise InputError(f"the views determine no camera; {_ADVICE}") from error
        k3, k3_sigma = float(distortion.ravel()[4]), float(deviations.ravel()[8])
        if flags or abs(k3) > 3 * k3_sigma:
            break
    (fx, _, cx), (_, fy, cy), _ = matrix
    try:
        camera = Camera(
            width_px, height_px, fx, fy, cx, cy, np.ravel(distortion).astype(np.float64)[:5]
        )
    except GeometryError as error:
        raise InputError(f"the views determine no plausible camera ({error}); {_ADVICE}") from error
    sigma = max(0.001, 3 * float(np.max(deviations.ravel()[:2] / (fx, fy))))
    turns_rad = np.array(turns, dtype=np.float64).reshape(-1, 3)
    return _Fit(camera, float(error_px), sigma, np.ravel(view_errors).astype(np.float64), turns_rad)


def _outliers(view_errors_px: Floats) -> list[int]:
    """Views that fit far worse than the usual one: a bent board, motion blur, a wrong corner."""
    middle = float(np.median(view_errors_px))
    spread = SIGMA_PER_MEDIAN_DEVIATION * float(np.median(np.abs(view_errors_px - middle)))
    return [
        int(index) for index in np.flatnonzero(view_errors_px > middle + max(4 * spread, middle))
    ]


def _distance_px(a: BoardView, b: BoardView) -> float:
    """Mean way of the corners from one view to the other; the same board may be found upside down."""
    orders = (b.corners_px, b.corners_px[::-1])
    return min(float(np.linalg.norm(a.corners_px - order, axis=1).mean()) for order in orders)


def _need(is_met: bool, found: str) -> None:
    if not is_met:
        raise InputError(f"not enough for a calibration: {found}; {_ADVICE}")
