"""Outlines of changed ground: made from masks, measured, compared with each other."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import Bytes, Ints32, Mask, Matrix3, PointsM, square
from sorvolo.geometry.homography import apply_homography
from sorvolo.geometry.polygons import signed_area
from sorvolo.survey.findings import ChangeKind

_LEAST_PART = 0.1  # of the largest piece: smaller ones do not stretch an outline


@dataclass(frozen=True, eq=False)
class KnownPlace:
    """A place on the ground, `outline_m` (N, 2) in site metres, where one kind of change is known already."""

    outline_m: PointsM
    kind: ChangeKind


@dataclass(frozen=True)
class Measures:
    """The size of an outline, and its middle (east, north) in site metres."""

    area_m2: float
    length_m: float
    centre_m: tuple[float, float]


def measures(outline_m: PointsM) -> Measures:
    """Area, longer side of the smallest rectangle around, and middle of that rectangle."""
    origin = outline_m.mean(axis=0)
    centre, size, _ = cv2.minAreaRect((outline_m - origin).astype(np.float32))
    return Measures(
        abs(signed_area(outline_m)),
        float(max(size)),
        (float(centre[0] + origin[0]), float(centre[1] + origin[1])),
    )


def outline_of(
    mask: Mask, site_from_mask: Matrix3, tolerance_px: float, join_px: float
) -> PointsM | None:
    """The outline, (N, 2) in site metres, of the changed pixels; None when there are none.

    It runs along the pixels' outer edges, simplified by at most `tolerance_px`. Pieces less than `join_px` apart are
    joined; if several remain, the outline is the hull of those that are not tiny beside the largest. Holes are filled.
    """
    found = np.argwhere(mask)
    if not len(found):
        return None
    (y0, x0), (y1, x1) = found.min(axis=0), found.max(axis=0) + 1
    pad = int(np.ceil(join_px)) + 1
    framed = np.pad(mask[y0:y1, x0:x1].astype(np.uint8), pad)
    part = cv2.resize(framed, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    if join_px >= 1:
        size = 2 * round(join_px) + 1
        part = cv2.morphologyEx(
            part, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        )
    ring = _ring_around(np.asarray(part, np.uint8))
    simple = cv2.approxPolyDP(ring, max(2 * tolerance_px, 0.5), True).reshape(-1, 2)
    points = simple.astype(np.float64) / 2 - 0.25 - pad + np.array([x0, y0])
    outline_m = apply_homography(site_from_mask, points) if len(points) >= 3 else None
    if outline_m is None or not np.isfinite(outline_m).all() or abs(signed_area(outline_m)) <= 0:
        box = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], np.float64) - 0.5
        outline_m = apply_homography(site_from_mask, box)
    return outline_m


def hull_of(mask: Mask | Bytes) -> Ints32:
    """(N, 2) the corners, x and y, of the convex hull of the pixels of a mask (h, w) that are not 0, one at least."""
    rows = np.flatnonzero(mask.any(axis=1))
    part = mask[rows] != 0
    left, right = part.argmax(axis=1), part.shape[1] - 1 - part[:, ::-1].argmax(axis=1)
    ends = np.column_stack(
        [np.concatenate([left, right]), np.concatenate([rows, rows])]
    )  # no others can be corners
    return np.asarray(cv2.convexHull(ends.astype(np.int32)).reshape(-1, 2), np.int32)


def _ring_around(part: Bytes) -> Ints32:
    """The contour of the one piece of a mask, or the hull of those that are not tiny beside the largest."""
    contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    areas = [float(cv2.contourArea(each)) for each in contours]
    large = [each for each, area in zip(contours, areas) if area >= _LEAST_PART * max(areas)]
    return np.asarray(large[0] if len(large) == 1 else cv2.convexHull(np.vstack(large)), np.int32)


def mask_of(outline_m: PointsM, site_from_mask: Matrix3, shape: tuple[int, int]) -> Mask:
    """The pixels of a raster that lie inside an outline, (N, 2) in site metres."""
    points = apply_homography(np.linalg.inv(site_from_mask), outline_m)
    mask: Bytes = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [np.round(points * 16).astype(np.int32).reshape(-1, 1, 2)], 1, shift=4)
    return mask.view(bool)


def overlap(a_m: PointsM, b_m: PointsM) -> tuple[float, float]:
    """How far two outlines cover the same ground: the intersection over the union, and over a's own area."""
    low = np.minimum(a_m.min(axis=0), b_m.min(axis=0))
    high = np.maximum(a_m.max(axis=0), b_m.max(axis=0))
    if (a_m.min(axis=0) > b_m.max(axis=0)).any() or (b_m.min(axis=0) > a_m.max(axis=0)).any():
        return 0.0, 0.0
    step_m = max(float((high - low).max()), 1e-6) / 200
    site_from_mask = np.array([[step_m, 0, low[0]], [0, step_m, low[1]], [0, 0, 1.0]])
    a, b = mask_of(a_m, site_from_mask, (202, 202)), mask_of(b_m, site_from_mask, (202, 202))
    both = int(np.count_nonzero(a & b))
    return both / max(int(np.count_nonzero(a | b)), 1), both / max(int(np.count_nonzero(a)), 1)


def is_known(outline_m: PointsM, kind: ChangeKind, places: Sequence[KnownPlace]) -> bool:
    """Whether a change of this kind at this place is among those not to be announced again.

    It is where the outlines' intersection is more than half of the change's own area or of their union.
    """
    return any(
        max(overlap(outline_m, each.outline_m)) > 0.5 for each in places if each.kind == kind
    )


# What the middle of an outline errs by; fitted to 60 changes of five simulated flights.
_MAP_M = 0.05  # the map's own local error, its shift as a whole left out
_MIDDLE_UP_M = 0.6  # a thing's middle stands so high: from aside it lies behind its place
_LONGEST = 2.5  # times as long as wide: a longer outline holds a part of a shadow ...
_OF_SHADOW = 0.4  # ... and its middle lies off by so much of what it is too long
_OF_AREA = 0.03  # of an area's length: its outline is one of cells


def place_sigma_m(residual_m: float, cell_m: float, aside: float) -> float:
    """The root of the sum of squares of: the views' alignment residual on the ground; a cell's rounding, its side /
    sqrt(12); the map's local error; and the thing's lean, `aside` (tangent of the angle by which the views together
    look at it from one side) times the height of its middle, per axis. What the outline errs by comes to it when that
    is final (`reported`)."""
    lean_m = _MIDDLE_UP_M * aside / np.sqrt(2)
    return float(np.linalg.norm([residual_m, cell_m / np.sqrt(12), _MAP_M, lean_m]))


def thing_sigma_m(size: Measures) -> float:
    """What a thing's outline errs by: the part of a shadow that is left in it."""
    wide_m = size.area_m2 / max(size.length_m, 1e-6)
    return _OF_SHADOW * max(size.length_m - _LONGEST * wide_m, 0.0)


def area_sigma_m(size: Measures) -> float:
    """What an area's outline errs by."""
    return _OF_AREA * size.length_m


def aside_of(outline_m: PointsM, cameras_m: PointsM) -> float:
    """From how far aside cameras, (N, 3) site metres, look at an outline, (M, 2), together: their mean way off over
    their height. Cameras all around it cancel out; 0 without any."""
    if not len(cameras_m):
        return 0.0
    off = (outline_m.mean(axis=0) - cameras_m[:, :2]) / np.maximum(cameras_m[:, 2:], 1e-6)
    return float(np.hypot(*off.mean(axis=0)))


def dilated(mask: Mask | Bytes, side_px: int) -> Mask:
    """Where (h, w) a window of this side, around the pixel, holds some of a mask."""
    return cv2.dilate(mask.view(np.uint8), square(side_px)) > 0


def opened(mask: Mask, side_px: int = 3) -> Mask:
    """A mask without what is narrower than a window of this side."""
    window = square(side_px)
    return cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_OPEN, window) > 0
