"""Whether a difference is the moved shadow of something that stays, by where the sun stood on both dates.

A thing of known width and height throws a shadow on level ground of which the sun gives direction and length. Where it
stays and the sun does not, ground is brighter along the one date's direction and darker along the other's, from one and
the same foot. What came or left has one of both shadows, and its own pixels differ.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from cv2.typing import MatLike

from sorvolo.change.earlier_pictures import EarlierPictures
from sorvolo.change.levelness import LaidPicture, Sights
from sorvolo.change.outlines import mask_of
from sorvolo.change.patches import PatchWindow
from sorvolo.geometry.arrays import Floats, Floats32, ImageGray, Mask, PointsM, Vector3
from sorvolo.geometry.sun import slide_of


def share_moved(own: Mask, other: Mask, step: Floats, most: float) -> float:
    """The greatest share of a shade, `own` (h, w), that lies on the `other` date's shade when it is moved by a multiple
    up to `most` of `step`, (2,) columns and rows."""
    rows, columns = np.nonzero(own)
    longest = float(np.abs(step).max()) * most
    if not len(rows) or longest < 1:
        return 0.0
    best = 0
    for times in np.arange(1.0, longest + 1) / longest * most:
        x, y = (
            np.rint(each + times * along).astype(int)
            for each, along in ((columns, step[0]), (rows, step[1]))
        )
        inside = (x >= 0) & (y >= 0) & (x < other.shape[1]) & (y < other.shape[0])
        best = max(best, int(np.count_nonzero(other[y[inside], x[inside]])))
    return best / len(rows)


SunAt = Callable[[int], Vector3 | None]
"""The unit vector to the sun (east, north, up) at a UTC time; None where it is not known."""


# What may throw a shadow: people, boxes, bushes; and how far shadows are followed.
_RADII_M = (0.15, 0.25, 0.4, 0.6)  # half widths
_HEIGHTS_M = (0.3, 0.5, 0.8, 1.2, 1.7, 2.4)
_LONGEST_M = 4.5  # longer shadows leave the pictures that are kept
_MARGIN_M = 0.25  # around a shadow, where nothing else may differ


# How pictures of two dates are compared, in octaves of brightness.
_SIDE_M = 0.15  # of the cells that are compared, where pixels are no coarser
_BLACK = 8.0  # gray levels added before logarithms: below, a camera shows noise
_MOST_OCTAVES = 1.5  # no shadow is deeper
_LIGHT_M = 4.0  # what varies more slowly is light; of it what differs by less than ...
_CALM = 0.5  # ... this


# When moved shadows explain a difference.
_LIKENESS = 0.7  # correlation of what differs with both shadows: one of them alone has 0.71 at most
_COVERED = 0.8  # share of what differs in the outline that the shadows, and the thing itself, cover
_LEAST_DEPTH = 0.25  # octaves: of the shadow on either date, and ...
_LEAST_PART = 0.5  # ... of the fainter one as a part of the deeper one
# flying heights by which a later picture is taken nearer above the place: it is asked anew
_NEARER = 0.15


class ShadowMatch(NamedTuple):
    """How well the shadows of a thing that stays, `radius_m` wide to each side and `height_m` tall, explain a
    difference: the correlation, how much brighter (octaves) ground is that the earlier shadow left, how much darker
    where the later one came, and the share of the difference that they cover. What is brighter than the ground around
    it was not in a shadow, but something came."""

    likeness: float
    brighter: float
    darker: float
    covered: float
    radius_m: float
    height_m: float


class ShadowDoubt:
    """What pictures of both dates show of shadows where candidates lie. `explains` keeps what it found out."""

    def __init__(self, earlier: EarlierPictures, sun_at: SunAt) -> None:
        self._earlier, self._sun_at = earlier, sun_at
        self._known: dict[tuple[int, PatchWindow, int, int], bool] = {}

    def explains(self, number: int, outline_m: PointsM, cameras_m: PointsM, sights: Sights) -> bool:
        """Whether the moved shadow of something that stays is all that differs in an outline, (N, 2), that later
        cameras, (V, 3), show. Where no sun or no picture of either date is known, it is not."""
        vantage = self._earlier.vantage(outline_m, cameras_m)
        if vantage is None or not sights.pictures:
            return False
        later = sights.pictures[0]
        aside = float(np.hypot(*(outline_m.mean(axis=0) - later.camera_m[:2]))) / float(
            later.camera_m[2]
        )
        asked = number, later.window, vantage.shows[0], int(aside / _NEARER)
        if asked not in self._known:
            pictures = self._earlier.laid(vantage, later.window, most=1)
            self._known[asked] = any(
                is_shadow(match)
                for each in pictures
                for match in shadow_matches(each, later, outline_m, self._sun_at)
            )
        return self._known[asked]


def is_shadow(match: ShadowMatch) -> bool:
    """Whether a match is good enough on both dates."""
    fainter, deeper = sorted((match.brighter, match.darker))
    return bool(
        match.likeness >= _LIKENESS
        and match.covered >= _COVERED
        and fainter >= max(_LEAST_DEPTH, _LEAST_PART * deeper)
    )


def shadow_matches(
    earlier: LaidPicture, later: LaidPicture, outline_m: PointsM, sun_at: SunAt
) -> Iterator[ShadowMatch]:
    """For each width and height the best match of two pictures of one window, of what differs in an outline, (N, 2)."""
    one, other = (slide_of(sun_at(each.time_ns)) for each in (earlier, later))
    if one is None or other is None:
        return
    step = max(1, int(_SIDE_M / later.window.m_per_px))
    difference = _Difference.of(earlier, later, outline_m, step)
    for radius_m, height_m, pattern in _patterns(one, other, later.window.m_per_px * step):
        match = difference.match(pattern, _COVERED)
        if match is not None:
            yield ShadowMatch(*match, radius_m, height_m)


def _patterns(
    one: Floats, other: Floats, m_per_px: float
) -> Iterator[tuple[float, float, "_Pattern"]]:
    """The half width, the height and the pattern of all that may stay; a point 1 m up throws its shadow `one`, (2,),
    off on the earlier date and `other` on the later one."""
    for height_m, radius_m in product(_HEIGHTS_M, _RADII_M):
        if max(np.hypot(*one), np.hypot(*other)) * height_m > _LONGEST_M:
            return
        ends_px = one * height_m / m_per_px, other * height_m / m_per_px
        pattern = _Pattern.of(*ends_px, radius_m / m_per_px, _MARGIN_M / m_per_px)
        if pattern is not None:
            yield radius_m, height_m, pattern


class _Pattern(NamedTuple):
    """What a thing that stays differs by, (h, w) each, it standing in the middle: 1 where the earlier shadow `left`
    the ground, where the later one `came`, and where nothing but them differs (`around`); and a little wider, with
    the thing itself, where ground may be `brighter` or `darker`."""

    left: Floats32
    came: Floats32
    around: Floats32
    brighter: Floats32
    darker: Floats32

    @classmethod
    def of(
        cls, earlier_px: Floats, later_px: Floats, radius_px: float, margin_px: float
    ) -> "_Pattern | None":
        """The shadows end at (east, north) pixels from the foot; None where they hide each other."""
        half = (
            int(
                np.ceil(
                    max(np.abs(earlier_px).max(), np.abs(later_px).max()) + radius_px + margin_px
                )
            )
            + 1
        )
        one, other = (_shadow(each, radius_px, half) for each in (earlier_px, later_px))
        thing = _shadow(np.zeros(2), radius_px + 0.5, half)
        left, came = (
            np.where(each & ~hides & ~thing, 1.0, 0.0)
            for each, hides in ((one, other), (other, one))
        )
        if min(left.sum(), came.sum()) < max(4.0, 0.2 * one.sum()):
            return None
        size = 2 * round(margin_px) + 1
        around = np.where(_grown(one | other | thing, size) & ~thing, 1.0, 0.0)
        brighter, darker = (_grown(each | thing, 3) for each in (one, other))
        return cls(
            *(np.asarray(each, np.float32) for each in (left, came, around, brighter, darker))
        )


def _grown(mask: Mask, size: int) -> Mask:
    return np.asarray(cv2.dilate(mask.view(np.uint8), np.ones((size, size), np.uint8)) > 0)


def _shadow(end_px: Floats, radius_px: float, half: int) -> Mask:
    """(2 half + 1, 2 half + 1) a disc in the middle, moved to where the shadow of its top lies, (2,) east and north."""
    raster = np.zeros((2 * half + 1,) * 2, np.uint8)
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    along = np.clip((x * end_px[0] - y * end_px[1]) / max(float(end_px @ end_px), 1e-9), 0, 1)
    off = np.hypot(x - along * end_px[0], y + along * end_px[1])
    raster[off <= max(radius_px, 0.7)] = 1
    return np.asarray(raster > 0)


class _Difference(NamedTuple):
    """By how many octaves ground is brighter on the later date, (h, w), and how much of that shadows may do: what an
    earlier one took of the ground's light (above 0), and what a later one takes (below 0). `known`, 1 or 0, is where
    both dates show ground; `brighter` and `darker` where it differs in the outline that is asked about."""

    octaves: Floats32
    shaded: Floats32
    known: Floats32
    brighter: Floats32
    darker: Floats32

    @classmethod
    def of(
        cls, earlier: LaidPicture, later: LaidPicture, outline_m: PointsM, step: int
    ) -> "_Difference":
        """Of two pictures of one window, `step` pixels of it taken together."""
        both = (earlier.gray > 0) & (later.gray > 0)
        known = _shrunk(both.astype(np.float32), step) > 0.5
        cell_m = later.window.m_per_px * step
        one, other = _beside_ground(
            [_octaves(each.gray, both, step) for each in (earlier, later)], known, cell_m
        )
        octaves = np.where(known, np.clip(other - one, -_MOST_OCTAVES, _MOST_OCTAVES), 0)
        left = np.minimum(np.maximum(octaves, 0), np.maximum(-one, 0))
        came = np.minimum(np.maximum(-octaves, 0), np.maximum(-other, 0))
        inside = _shrunk(
            mask_of(outline_m, later.window.site_from_patch, both.shape).astype(np.float32), step
        )
        brighter, darker = ((inside > 0.5) & (each > _LEAST_DEPTH) for each in (octaves, -octaves))
        return cls(
            *(
                np.asarray(each, np.float32)
                for each in (octaves, left - came, known, brighter, darker)
            )
        )

    def match(self, pattern: _Pattern, enough: float) -> tuple[float, float, float, float] | None:
        """Likeness, how much brighter, how much darker, and the covered share, at the foot where the pattern fits best
        and covers `enough`, or most; None where nothing is asked for."""
        covered = self._covered(pattern)
        if covered is None:
            return None
        left_px, came_px = (_sums(self.known, each) for each in (pattern.left, pattern.came))
        power = _sums(self.octaves**2, pattern.around) * np.maximum(left_px + came_px, 1.0)
        likeness = _sums(self.octaves, pattern.left - pattern.came) / np.sqrt(
            np.maximum(power, 1e-6)
        )
        shown = (left_px > 0.6 * pattern.left.sum()) & (came_px > 0.6 * pattern.came.sum())
        worth = np.where(shown, np.minimum(covered, enough) + likeness, -1.0)
        at = np.unravel_index(int(worth.argmax()), worth.shape)
        if not shown[at]:
            return None
        left, came = (_sums(self.shaded, each)[at] for each in (pattern.left, pattern.came))
        return (
            float(likeness[at]),
            float(left / left_px[at]),
            float(-came / came_px[at]),
            float(covered[at]),
        )

    def _covered(self, pattern: _Pattern) -> Floats32 | None:
        """(h, w) the share that a pattern there covers of what is brighter, or of what is darker, the lesser one; what
        is but a few cells does not count."""
        parts = [(self.brighter, pattern.brighter), (self.darker, pattern.darker)]
        cells = [float(each.sum()) for each, _ in parts]
        shares = [
            _sums(asked, covers) / count
            for (asked, covers), count in zip(parts, cells)
            if count > 0.1 * sum(cells)
        ]
        return np.asarray(np.min(shares, axis=0), np.float32) if shares else None


def _octaves(gray: ImageGray, known: Mask, step: int) -> Floats32:
    """The mean logarithms of a picture, (h, w), where it is known, `step` pixels taken together."""
    octaves = np.where(known, np.log2(gray.astype(np.float32) + np.float32(_BLACK)), 0).astype(
        np.float32
    )
    share = np.maximum(_shrunk(known.astype(np.float32), step), np.float32(1e-3))
    return np.asarray(_shrunk(octaves, step) / share, np.float32)


def _beside_ground(octaves: Sequence[Floats32], known: Mask, cell_m: float) -> list[Floats]:
    """By how many octaves cells, (h, w) of either date, are brighter than the unchanged ground around them."""
    change = octaves[1] - octaves[0]
    middle = np.median(change[known]) if known.any() else 0.0
    calm = (known & (np.abs(change - middle) < _CALM)).astype(np.float32)
    side = 2 * round(_LIGHT_M / cell_m / 2) + 1
    share = np.maximum(cv2.blur(calm, (side, side)), 0.05)
    return [each - cv2.blur(each * calm, (side, side)) / share for each in octaves]


def _sums(raster: Floats32, pattern: Floats32) -> Floats32:
    """(h, w) the sums of a raster times a pattern around each cell, nothing being outside."""
    return np.asarray(
        cv2.filter2D(raster, cv2.CV_32F, pattern, borderType=cv2.BORDER_CONSTANT), np.float32
    )


def _shrunk(raster: MatLike, step: int) -> Floats32:
    rows, columns = raster.shape[0] // step, raster.shape[1] // step
    return np.asarray(
        cv2.resize(
            raster[: rows * step, : columns * step], (columns, rows), interpolation=cv2.INTER_AREA
        ),
        np.float32,
    )
