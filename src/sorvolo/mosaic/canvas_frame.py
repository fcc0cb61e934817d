"""One frame on the grid: the ground that it covers, how well it shows each part of it, and its picture there."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Bytes, Floats, ImageRGB, Mask, Matrix3, PointsPx, frozen, square
from sorvolo.geometry.homography import apply_homography, shifted
from sorvolo.mosaic.blending import FILL_PX, WINDOW_APRON_PX, coarse_fill
from sorvolo.mosaic.exposure import corrected

CELL_PX = 8
"""Side of the cells, in grid pixels, that are shown by one frame each."""


@dataclass(frozen=True, eq=False)
class CanvasFrame:
    """One keyframe as the canvas needs it.

    `rank` is the order of its flight on the site: ground that an earlier flight covers stays that flight's.
    `gains` (3,) multiply the undistorted image's channels; `vignette` (2,) is undone first (see
    `exposure.corrected`). `valid` marks the undistorted image's pixels that exist, None = all.
    Raises GeometryError when not all of the image lies in front of the camera's horizon.
    """

    id: int
    rank: int
    width_px: int
    height_px: int
    grid_from_image: Matrix3
    gains: Floats = field(default_factory=lambda: np.ones(3))
    vignette: Floats = field(default_factory=lambda: np.zeros(2))
    valid: Mask | None = None

    def __post_init__(self) -> None:
        for name, shape in (("grid_from_image", (3, 3)), ("gains", (3,)), ("vignette", (2,))):
            object.__setattr__(self, name, frozen(getattr(self, name)))
            if getattr(self, name).shape != shape or not np.isfinite(getattr(self, name)).all():
                raise GeometryError(f"frame {self.id}: {name} needs {shape} finite numbers")
        if self.id < 0:
            raise GeometryError(f"frame ids count up from 0, got {self.id}")
        if self.valid is not None and self.valid.shape != (self.height_px, self.width_px):
            raise GeometryError(
                f"frame {self.id}: valid mask {self.valid.shape} is not of the image's size"
            )
        if (
            not np.isfinite(self.outline_px).all()
            or abs(np.linalg.det(self.grid_from_image)) < 1e-12
        ):
            raise GeometryError(
                f"frame {self.id}: a corner of the image lies at or beyond the horizon"
            )

    @property
    def outline_px(self) -> PointsPx:
        """(4, 2) the image's outer corners on the grid: top-left, top-right, bottom-right, bottom-left."""
        w, h = self.width_px - 0.5, self.height_px - 0.5
        return apply_homography(
            self.grid_from_image, np.array([[-0.5, -0.5], [w, -0.5], [w, h], [-0.5, h]])
        )


def warp(
    image: ImageRGB,
    frame: CanvasFrame,
    window: tuple[int, int, int, int],
    beyond: ImageRGB | None = None,
) -> ImageRGB:
    """A frame's image, its exposure corrected, in a window of grid pixels (x0, y0, x1, y1, ends exclusive).

    Beyond its border the image is reflected as far as blending looks, and black from there on. Only the part of the
    image that the window shows is looked at, and, but for rounding, no pixel depends on which window that is. `beyond`
    is what `blending.coarse_fill` gives of an image with invalid pixels, where the caller has it. Raises GeometryError
    when the image is not of the frame's size.
    """
    if image.shape[:2] != (frame.height_px, frame.width_px):
        raise GeometryError(
            f"frame {frame.id}: image {image.shape[1]}x{image.shape[0]}, "
            f"expected {frame.width_px}x{frame.height_px}"
        )
    grid_px_per_px = float(np.sqrt(np.prod(_stretch(frame))))
    halvings = 0  # a mere interpolation would skip source pixels and shimmer
    while grid_px_per_px * 2**halvings < 0.5 and min(image.shape[:2]) >> halvings > 32:
        halvings += 1
    pad = int(np.ceil(1.5 * WINDOW_APRON_PX / (grid_px_per_px * 2**halvings)))
    part = _part_shown(frame, window, halvings, pad)
    if part is None:
        return np.zeros((window[3] - window[1], window[2] - window[0], 3), np.uint8)
    source = _filled(image, frame, part, beyond)
    for _ in range(halvings):
        source = cv2.pyrDown(source)  # type: ignore[assignment]
    x0, y0, x1, y1 = part
    place = (
        x0 >> halvings,
        y0 >> halvings,
        -(-frame.width_px >> halvings),
        -(-frame.height_px >> halvings),
    )
    # four channels and a constant border are OpenCV's fast path: three times faster than RGB and reflection
    rgba = cv2.cvtColor(corrected(source, frame.gains, frame.vignette, place), cv2.COLOR_RGB2RGBA)
    left, top = pad * (x0 == 0), pad * (y0 == 0)
    right, bottom = pad * (x1 == frame.width_px), pad * (y1 == frame.height_px)
    window_from_source = (
        shifted(-window[0], -window[1])
        @ frame.grid_from_image
        @ shifted(x0, y0)
        @ np.diag([2.0**halvings] * 2 + [1.0])
    )
    framed = cv2.copyMakeBorder(rgba, top, bottom, left, right, cv2.BORDER_REFLECT)
    size = window[2] - window[0], window[3] - window[1]
    warped = cv2.warpPerspective(
        framed, window_from_source @ shifted(-left, -top), size, flags=cv2.INTER_LINEAR
    )
    return cv2.cvtColor(warped, cv2.COLOR_RGBA2RGB)  # type: ignore[return-value]


def _part_shown(
    frame: CanvasFrame, window: tuple[int, int, int, int], halvings: int, pad: int
) -> tuple[int, int, int, int] | None:
    """The part of an image (x0, y0, x1, y1, ends exclusive) that a window shows, with what is reflected into it.

    It begins at multiples of what is halved away. All of it where the window reaches the image's horizon, None where
    none is shown.
    """
    x0, y0, x1, y1 = window
    width, height, step = frame.width_px, frame.height_px, 1 << halvings
    corners = np.linalg.inv(frame.grid_from_image) @ [[x0, x1, x1, x0], [y0, y0, y1, y1], [1.0] * 4]
    depth = corners[2] * np.sign((np.linalg.inv(frame.grid_from_image) @ _centre_px(frame))[2])
    if depth.min() <= 1e-3 * depth.max():
        return 0, 0, width, height
    low, high = (each(corners[:2] / corners[2], axis=1) for each in (np.min, np.max))
    reach = pad * step
    if (high < -reach).any() or (low > [width + reach, height + reach]).any():
        return None
    margin = 4 * step + 2  # of interpolation, and of the filter that halves
    deep = reach + margin  # what is reflected beyond a border lies so deep within it
    sides = []
    for first, last, side in zip(low, high, (width, height), strict=True):
        begin, end = int(np.floor(first)) - margin, int(np.ceil(last)) + margin + 1
        begin = begin if end < side else min(begin, side - deep)
        end = end if begin > 0 else max(end, deep)
        begin, end = max(0, begin) // step * step, min(side, -(-end // step) * step)
        if end < side and side - end < step:
            end = side
        sides.append((begin, end))
    return sides[0][0], sides[1][0], sides[0][1], sides[1][1]


def _filled(
    image: ImageRGB, frame: CanvasFrame, part: tuple[int, int, int, int], beyond: ImageRGB | None
) -> ImageRGB:
    """A part of a frame's image, its invalid pixels continued from the valid ones around them."""
    x0, y0, x1, y1 = part
    source = image[y0:y1, x0:x1]
    if frame.valid is None:
        return source
    valid = frame.valid[y0:y1, x0:x1]
    if valid.all():
        return source
    small = coarse_fill(image, frame.valid) if beyond is None else beyond
    rows, columns = np.nonzero(~valid)
    filled = source.copy()
    filled[rows, columns] = small[(rows + y0) // FILL_PX, (columns + x0) // FILL_PX]
    return filled


def _centre_px(frame: CanvasFrame) -> Floats:
    return np.array([(frame.width_px - 1) / 2, (frame.height_px - 1) / 2, 1.0])


def coverage(frame: CanvasFrame, window: tuple[int, int, int, int]) -> Bytes:
    """255 where a frame has pixels in a window of grid pixels (x0, y0, x1, y1, ends exclusive), else 0."""
    size = window[2] - window[0], window[3] - window[1]
    window_from_image = shifted(-window[0], -window[1]) @ frame.grid_from_image
    if frame.valid is not None:
        valid = cv2.erode(frame.valid.astype(np.uint8) * 255, square(3))
        return cv2.warpPerspective(valid, window_from_image, size, flags=cv2.INTER_NEAREST)  # type: ignore[return-value]
    left, right = _spans(frame.outline_px, np.arange(window[1], window[3]))
    first = np.clip(np.ceil(left) - window[0], 0, size[0]).astype(np.int32)[:, None]
    end = np.clip(np.floor(right) - window[0] + 1, 0, size[0]).astype(np.int32)[:, None]
    columns = np.arange(size[0], dtype=np.int32)
    return ((columns >= first) & (columns < end)).view(np.uint8) * np.uint8(255)


def _spans(outline_px: PointsPx, rows: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Where each row of grid pixels enters and leaves a convex outline; entry beyond exit where it misses it.

    Drawn by half planes in grid coordinates, a frame's border is the same pixels whatever window it is drawn
    in.
    """
    left, right = np.full(len(rows), -1e9), np.full(len(rows), 1e9)
    edges = np.roll(outline_px, -1, axis=0) - outline_px
    turn = np.sign(edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0])
    for corner, edge in zip(outline_px, edges * turn):
        # inside lies where edge x (point - corner) >= 0
        if abs(edge[1]) < 1e-12:
            left[edge[0] * (rows - corner[1]) < 0] = np.inf
        else:
            crossing = corner[0] + edge[0] / edge[1] * (rows - corner[1])
            if edge[1] > 0:
                right = np.minimum(right, crossing)
            else:
                left = np.maximum(left, crossing)
    return np.minimum(left, 1e9), right


def cell_merits(frame: CanvasFrame, column: int, row: int, width: int, height: int) -> Floats:
    """(height, width) how well a frame shows each cell of CELL_PX grid pixels; -inf where it does not.

    Within the image merit falls from its centre to its border and with the ground area of a pixel, and is
    lower for oblique views; the flight's rank outweighs it. Just outside, where a cell may still be partly
    covered, it is very low, the lower the farther.
    """
    xs = (np.arange(column, column + width) + 0.5) * CELL_PX - 0.5
    ys = (np.arange(row, row + height) + 0.5) * CELL_PX - 0.5
    image_from_grid = np.linalg.inv(frame.grid_from_image)
    centre = _centre_px(frame)
    image_from_grid *= np.sign((frame.grid_from_image @ centre)[2])
    u, v, z = (a * xs[None, :] + b * ys[:, None] + c for a, b, c in image_from_grid)
    seen = z > 1e-9
    z = np.where(seen, z, 1.0)
    u, v = u / z, v / z
    across = (u - centre[0]) / (frame.width_px / 2)
    down = (v - centre[1]) / (frame.height_px / 2)
    # grid pixels per image pixel: the smaller, the finer the image sees this ground
    coarseness = np.sqrt(z**3 / abs(np.linalg.det(image_from_grid)))
    inner_px = np.minimum((1 - abs(across)) * frame.width_px, (1 - abs(down)) * frame.height_px) / 2
    inner_px = inner_px * coarseness
    inside = seen & (inner_px > 0)
    if frame.valid is not None:
        ui = np.clip(np.rint(u), 0, frame.width_px - 1).astype(int)
        vi = np.clip(np.rint(v), 0, frame.height_px - 1).astype(int)
        inside &= frame.valid[vi, ui]
    small, large = _stretch(frame)
    # small / large is the cosine of the angle of view at the centre: a tilted camera foreshortens the ground
    quality = (1 - across**2) * (1 - down**2) * (small / large) ** 2 / coarseness**2
    near = seen & (inner_px > -1.5 * CELL_PX)
    outside = np.where(near, np.minimum(inner_px, 0.0) - 1e6, -np.inf)
    return np.where(inside, quality / (1 + quality) - frame.rank, outside)


def _stretch(frame: CanvasFrame) -> tuple[float, float]:
    """How many grid pixels an image pixel spans at the image's centre, on its least and its most stretched
    axis.
    """
    u, v = (frame.width_px - 1) / 2, (frame.height_px - 1) / 2
    x, y, z = frame.grid_from_image @ np.array([u, v, 1.0])
    linear = (
        frame.grid_from_image[:2, :2] / z - np.outer([x, y], frame.grid_from_image[2, :2]) / z**2
    )
    large, small = np.linalg.svd(linear, compute_uv=False)
    return float(small), float(large)
