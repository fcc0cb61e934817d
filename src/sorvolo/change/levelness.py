"""Whether ground is level by pictures of one date: laid on level ground they agree there, and only there.

What stands h high lies apart in two pictures laid on level ground by h / (H - h) times the way between their cameras,
H above the ground. So two pictures of one date that agree at a place, and agree nowhere that a height would lead to,
show level ground. Where all ground is level on which something tall could hide a place from a camera of the other date,
nothing hides it: that camera sees the same ground there, and what differs has changed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import NamedTuple

import cv2
import numpy as np

from sorvolo.change.outlines import mask_of
from sorvolo.change.patches import PatchWindow
from sorvolo.geometry.arrays import Floats, Floats32, ImageGray, ImageRGB, Mask, PointsM, Vector3
from sorvolo.survey.findings import ComparedView

MOST_PICTURES = 3  # of a place and a date


# When two pictures of one date show that a place is level.
TALLEST_M = 6.0  # what stands so high (eaves of two storeys) may be anywhere
_APART_HEIGHTS = 0.15  # flying heights at least between pictures of a place and a date
# around a place that is kept: what a camera of the other date could see in its place
_REACH_M = 6.0
_MOST_PX = 192  # longest side of a kept picture, which is made coarser for that ...
_COARSEST = 4.0  # ... up to so many times; what is larger is not asked for
_WINDOW_PX = (7, 15)  # least and largest side of what is compared; between them a thing's width
# of a thing's width, from one date to the other: lower relief does not explain it
_LEAST_MOVE = 1 / 3
_OFF_PX = 4  # pictures of one date may lie off each other, where that is not taken for a height
_LEAST_PX = 1.5  # what moves by less cannot be distinguished from that
_DETAIL = 5  # windows: what varies more slowly is light
_LEAST_LIKENESS = 0.5  # of what agrees ...
_TIMES = 1.5  # ... and it differs so many times as much at any height ...
_NOISE = 2.0  # ... as it does, or as so many gray levels of noise do
_PARTS = 5  # heights up to the tallest, the ground among them
_LEVEL_SHARE = 0.85  # of what might hide a place at each height that has to be level


@dataclass(frozen=True, eq=False)
class LaidPicture:
    """A picture laid on level ground: `gray` (h, w) uint8 of a window, 0 where it shows nothing, where its camera
    was, (3,), and when, UTC."""

    window: PatchWindow
    gray: ImageGray
    camera_m: Vector3
    time_ns: int = 0

    @classmethod
    def of(
        cls, rgb: ImageRGB, known: Mask, window: PatchWindow, camera_m: Vector3, time_ns: int = 0
    ) -> "LaidPicture":
        """A picture (h, w, 3) of the window, and where (h, w) it shows anything."""
        gray = np.maximum(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), 1)
        return cls(window, np.where(known, gray, 0).astype(np.uint8), camera_m, time_ns)


class Sights:
    """One date's pictures of a candidate, laid on level ground: those from nearest above it, of places apart.

    Only `show` changes them.
    """

    def __init__(self) -> None:
        self._pictures: list[LaidPicture] = []

    @property
    def pictures(self) -> tuple[LaidPicture, ...]:
        """They have one window; the one from nearest above comes first."""
        return tuple(self._pictures)

    def show(self, view: ComparedView, low_m: Floats, high_m: Floats, m_per_px: float) -> None:
        """Take a view's picture of a box of ground and of what is around it, if it is one of those; all anew where the
        box has grown."""
        kept = self._pictures
        if kept and not kept[0].window.holds(low_m, high_m):
            kept.clear()
        window = kept[0].window if kept else surroundings(low_m, high_m, m_per_px)
        if window is None:
            return
        cameras_m = np.array([*(each.camera_m for each in kept), view.camera_m])
        order = np.argsort(np.hypot(*(cameras_m[:, :2] - (low_m + high_m) / 2).T), kind="stable")
        chosen = apart(cameras_m, [int(each) for each in order])
        if len(kept) in chosen:
            kept.append(_laid(view, window))
            self._pictures = [kept[each] for each in chosen]


def apart(cameras_m: PointsM, order: Sequence[int], most: int = MOST_PICTURES) -> list[int]:
    """Of cameras, (N, 3), in an order, the first few that lie apart from each other."""
    found: list[int] = []
    for each in order:
        ways_m = np.hypot(*(cameras_m[found, :2] - cameras_m[each, :2]).T)
        if len(found) < most and (ways_m >= _APART_HEIGHTS * cameras_m[each, 2]).all():
            found.append(each)
    return found


def _laid(view: ComparedView, window: PatchWindow) -> LaidPicture:
    patch_from_image = np.linalg.inv(window.site_from_patch) @ view.site_from_image
    rgb = cv2.warpPerspective(view.image, patch_from_image, window.size_px, flags=cv2.INTER_LINEAR)
    valid = cv2.warpPerspective(
        view.valid.view(np.uint8), patch_from_image, window.size_px, flags=cv2.INTER_NEAREST
    )
    return LaidPicture.of(
        np.asarray(rgb, np.uint8), np.asarray(valid > 0), window, view.camera_m, view.time_ns
    )


def surroundings(low_m: Floats, high_m: Floats, m_per_px: float) -> PatchWindow | None:
    """The window of a box of ground and of what a camera of the other date could see in its place, coarser than asked
    for where that would be too large; None where it would be far too large."""
    wide_m = float((high_m - low_m).max()) + 2 * _REACH_M
    s = max(m_per_px, wide_m / (_MOST_PX - 2))
    if s > _COARSEST * m_per_px:
        return None
    west, south = np.floor((low_m - _REACH_M) / s)
    east, north = np.ceil((high_m + _REACH_M) / s)
    return PatchWindow(float(west * s), float(north * s), s, int(east - west), int(north - south))


def is_level(pictures: Sequence[LaidPicture], outline_m: PointsM, other_m: Vector3) -> bool:
    """Whether pictures of one date, all of one window, show that a camera of the other date at `other_m` sees the
    ground in an outline, (N, 2)."""
    return any(
        level_share(first, second, outline_m, other_m) >= _LEVEL_SHARE
        for first, second in permutations(pictures, 2)
    )


def level_share(
    first: LaidPicture, second: LaidPicture, outline_m: PointsM, other_m: Vector3
) -> float:
    """The share that two pictures of one date show to be level of what hides an outline from a camera at `other_m`,
    at the least of the heights that this might have."""
    s, middle_m = first.window.m_per_px, outline_m.mean(axis=0)
    tallest_m = min(TALLEST_M, float(first.camera_m[2]) / 2)
    # where the first camera sees what hides the outline, and where the second sees what the first sees there
    hides_m = seen_at_m(middle_m, other_m, tallest_m, first.camera_m) - middle_m
    there_m = middle_m + hides_m
    moves_px = (
        (seen_at_m(there_m, first.camera_m, tallest_m, second.camera_m) - there_m) * [1, -1] / s
    )
    wide_m = width_m(outline_m)
    # relief that moves by less from one date to the other makes no difference so wide, both of its rims together
    low = _LEAST_MOVE * wide_m / max(float(np.linalg.norm(hides_m)), 1e-6)
    if low * np.linalg.norm(moves_px) < _LEAST_PX:
        return 0.0
    site_from_patch, shape = first.window.site_from_patch, first.gray.shape
    parts = np.array(
        [
            mask_of(outline_m + share * hides_m, site_from_patch, shape)
            for share in np.linspace(0, 1, _PARTS)
        ]
    )
    pair = _Pair.around(
        np.asarray(parts.any(axis=0)), first.gray, second.gray, wide_m / s, moves_px
    )
    if pair is None:
        return 0.0
    level = _level(pair, moves_px, low)
    whole_px = max((wide_m / s) ** 2, 1.0)  # a part may reach out of the pictures
    return min(float(np.count_nonzero(level & part[pair.box])) / whole_px for part in parts)


def width_m(outline_m: PointsM) -> float:
    """The side of a square as large as an outline, (N, 2)."""
    return float(np.sqrt(cv2.contourArea(outline_m.astype(np.float32))))


def seen_at_m(place_m: PointsM, camera_m: Vector3, up_m: float, other_m: Vector3) -> PointsM:
    """(2,) where on level ground one camera sees what another camera sees at a place of it, (2,), if that is `up_m`
    above it."""
    on_ray_m = place_m + (camera_m[:2] - place_m) * up_m / camera_m[2]
    share = up_m / other_m[2]
    return np.asarray((on_ray_m - other_m[:2] * share) / (1 - share))


class _Texture(NamedTuple):
    """The detail of a gray picture, (h, w), and where it is unknown, 0, or within half a window of that."""

    detail: Floats32
    unknown: Mask

    @classmethod
    def of(cls, gray: ImageGray, side: int) -> "_Texture":
        known = (gray > 0).astype(np.float32)
        around = _DETAIL * side, _DETAIL * side
        mean = cv2.blur(gray.astype(np.float32), around) / np.maximum(cv2.blur(known, around), 1e-3)
        unknown = cv2.dilate(1 - known.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        return cls(np.asarray((gray - mean) * known, np.float32), unknown)


class _Pair(NamedTuple):
    """Two textures that are compared in windows of a `side`, px: the first one's part in a `box`, the second one with
    `reach` unknown pixels all around it, and the `region`, a mask of the box, that is asked for."""

    first: _Texture
    second: _Texture
    side: int
    box: tuple[slice, slice]
    reach: int
    region: Mask

    @classmethod
    def around(
        cls, region: Mask, first: ImageGray, second: ImageGray, wide_px: float, moves_px: Floats
    ) -> "_Pair | None":
        """The pair around a region of two pictures; None where that lies outside."""
        rows, columns = (np.flatnonzero(region.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return None
        side = int(np.clip(wide_px, *_WINDOW_PX)) | 1
        low, high = (
            np.array([rows[0], columns[0]]) - side,
            np.array([rows[-1], columns[-1]]) + side + 1,
        )
        low, high = np.maximum(low, 0), np.minimum(high, region.shape)
        box = slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))
        detail, unknown = _Texture.of(first, side)
        reach = _OFF_PX + 1 + int(np.ceil(np.abs(moves_px).max()))
        other = _Texture.of(second, side)
        beyond = _Texture(
            np.asarray(
                cv2.copyMakeBorder(other.detail, *(reach,) * 4, cv2.BORDER_CONSTANT, value=0.0),
                np.float32,
            ),
            cv2.copyMakeBorder(
                other.unknown.view(np.uint8), *(reach,) * 4, cv2.BORDER_CONSTANT, value=1
            )
            > 0,
        )
        return cls(_Texture(detail[box], unknown[box]), beyond, side, box, reach, region[box])

    def differs(self, x: int, y: int) -> tuple[Floats32, Mask]:
        """(h, w) the mean square of what the second, pixel (x, y) of which comes to (0, 0), differs by around each
        pixel, and where that is unknown."""
        there = self._there(x, y)
        return self._mean(
            (self.first.detail - there.detail) ** 2
        ), there.unknown | self.first.unknown

    def power(self, x: int, y: int) -> Floats32:
        """(h, w) the mean square by which two such textures would differ that have nothing to do with each other."""
        return self._mean(self.first.detail**2 + self._there(x, y).detail ** 2)

    def _there(self, x: int, y: int) -> _Texture:
        rows, columns = self.box
        part = (
            slice(rows.start + y + self.reach, rows.stop + y + self.reach),
            slice(columns.start + x + self.reach, columns.stop + x + self.reach),
        )
        return _Texture(self.second.detail[part], self.second.unknown[part])

    def _mean(self, raster: Floats32) -> Floats32:
        return np.asarray(cv2.blur(raster, (self.side, self.side)), np.float32)


def _level(pair: _Pair, moves_px: Floats, low: float) -> Mask:
    """(h, w) where two textures agree as they lie, and better than at any height above the share `low` of the
    tallest, whose top would move by `moves_px`."""
    x0, y0 = _offset(pair, low * float(np.linalg.norm(moves_px)))
    best, others = (np.full(pair.region.shape, np.inf, np.float32) for _ in range(2))
    for x, y in np.ndindex(3, 3):
        differs, unknown = pair.differs(x0 + x - 1, y0 + y - 1)
        best = np.where(unknown, best, np.minimum(best, differs))
    for x, y in _steps(moves_px, low):
        differs, unknown = pair.differs(x0 + x, y0 + y)
        others = np.where(unknown, others, np.minimum(others, differs))
    agrees = best <= (1 - _LEAST_LIKENESS) * pair.power(x0, y0)
    is_surer = _TIMES * np.maximum(best, 2 * _NOISE**2) <= others
    return np.asarray(agrees & is_surer & np.isfinite(others))


def _offset(pair: _Pair, most_px: float) -> tuple[int, int]:
    """How far the second picture lies off the first one, whole pixels: less than a height would move it."""
    most = int(min(_OFF_PX, most_px))
    found = {}
    for y in range(-most, most + 1):
        for x in range(-most, most + 1):
            differs, unknown = pair.differs(x, y)
            known = pair.region & ~unknown
            found[x, y] = float(differs[known].mean()) if known.any() else np.inf
    return min(found, key=lambda each: found[each])


def _steps(moves_px: Floats, low: float) -> Iterator[tuple[int, int]]:
    """The whole pixels on a way, from the share `low` of it to its end."""
    count = max(int(np.ceil(np.abs(moves_px).max())), 1)
    shares = (
        np.linspace(low, 1.0, max(int(np.ceil((1 - low) * count)), 1) + 1)
        if low < 1
        else np.array([low])
    )
    yield from dict.fromkeys(
        (round(each * moves_px[0]), round(each * moves_px[1])) for each in shares.tolist()
    )
