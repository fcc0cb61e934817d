"""Whether a thing came, left, or was replaced, from the pictures of the ground before and after, without a detector.

A thing stands out from the ground around it, by its colours and by edges along its outline. Where only the later
picture stands out it appeared, where only the earlier one does it disappeared, where both do one took the other's
place. How much each sign counts was fitted (logistic regression) to changes of simulated flights.
"""

from typing import NamedTuple

import cv2
import numpy as np

from sorvolo.change.outlines import dilated
from sorvolo.geometry.arrays import Bytes, Floats, Floats32, ImageRGB, ImageRGBA, Labels, Mask
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.survey.findings import ChangeKind, Patch

_SIGNS = 6  # that are measured of each date's picture, see `_signs`
_REPLACED_PRIOR = (
    0.5  # seldom does one thing leave where another comes; else snow is a hundred things
)
# seeds 241 and 242 of the presets compare, compare-urban and compare-dirt with 44 changes each: as they are, in another
# light, with the thing's contrast shrunk to 45 %, and replaced by a thing of other colours
_OWN = np.array([0.88, 0.39, 0.61, 1.53, 1.5, 0.17])  # of the date's own signs
_OTHER = np.array([-0.32, -0.12, -0.3, -0.36, -0.4, 0.11])  # of the other date's
_BIAS = 0.55  # of the same fit
_LEVELS = np.arange(256, dtype=np.float32)


def kind_of(patch: Patch) -> ChangeKind:
    """What happened inside the patch's changed region; never `moving`."""
    region = _Region.of(patch.changed)
    before, after = _signs(patch.before, region), _signs(patch.after, region)
    was_there, is_there = _chance(before, after), _chance(after, before)
    chances = {
        ChangeKind.APPEARED: is_there * (1 - was_there),
        ChangeKind.DISAPPEARED: was_there * (1 - is_there),
        ChangeKind.REPLACED: was_there * is_there * _REPLACED_PRIOR,
    }
    return max(chances, key=lambda kind: chances[kind])


def stands_out(picture: ImageRGBA, changed: Mask) -> Floats:
    """(6,) signs of something that stands in the changed region, as logarithms, in colours of CIE Lab.

    How far its pixels, their median, and the share of far pixels lie from the ground around, in the ground's own
    spread; the gradient along the outline and across it, and inside, against the ground's gradient.
    """
    return _signs(picture, _Region.of(changed))


class _Region(NamedTuple):
    """A changed region, which both dates have: the `part` of the pictures that holds it and the ground around it, and
    masks of that, (h, w): `changed`, the ground `around`, the `rim` along the outline, and unit vectors outwards."""

    part: tuple[slice, slice]
    changed: Mask
    around: Mask
    rim: Mask
    outwards: tuple[Floats32, Floats32]

    @classmethod
    def of(cls, changed: Mask) -> "_Region | None":
        """The region of a mask (h, w); None of nothing."""
        if not changed.any():
            return None
        # How far around a changed region the ground is looked at.
        reach = int(np.clip(0.35 * np.sqrt(np.count_nonzero(changed)), 4, 40))
        part = _near(changed, reach + 8)
        changed = changed[part]
        marked = changed.astype(np.uint8)
        near = dilated(changed, 7)
        around = dilated(changed, 2 * reach + 7) & ~near
        rim = near & dilated(~changed, 5)
        return cls(part, changed, around, rim, _outwards(marked))


def _signs(picture: ImageRGBA, region: "_Region | None") -> Floats:
    if region is None:
        return np.zeros(_SIGNS)
    picture = picture[region.part]
    known = picture[..., 3] > 0
    inside, around, rim = (each & known for each in (region.changed, region.around, region.rim))
    if not inside.any() or not around.any():
        return np.zeros(_SIGNS)
    rgb = cv2.blur(_rgb(picture), (3, 3))
    lab8 = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB), np.uint8)
    middle, spread = _middle_and_spread(lab8, around)
    lab = lab8.astype(np.float32)
    far = np.minimum(_length((lab[inside] - middle) / spread), 12.0)
    shift = float(np.linalg.norm((middle_and_deviation(lab8, inside)[0] - middle) / spread))
    slope_x, slope_y = (
        cv2.Sobel(lab, cv2.CV_32F, 1, 0, scale=0.25),
        cv2.Sobel(lab, cv2.CV_32F, 0, 1, scale=0.25),
    )
    slope = _length(np.asarray(cv2.magnitude(slope_x, slope_y), np.float32))
    across_x, across_y = (each[rim, None] for each in region.outwards)
    outward = _length(slope_x[rim] * across_x + slope_y[rim] * across_y)
    rest = float(np.mean(slope[around])) + 1.0
    signs = [
        float(np.mean(far)),
        shift,
        float(np.mean(far > 3.0)) + 0.02,
        float(np.mean(slope[rim])) / rest,
        float(np.mean(outward)) / rest,
        float(np.mean(slope[inside])) / rest,
    ]
    return np.log(np.array(signs) + 0.05)


def _rgb(picture: ImageRGBA) -> ImageRGB:
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGBA2RGB), np.uint8)


def _middle_and_spread(lab: Bytes, around: Mask) -> tuple[Floats32, Floats32]:
    """The median (3,) of the ground's colours `around` in a picture (h, w, 3), and how far they stray from it, (3,)."""
    middle, deviation = middle_and_deviation(lab, around)
    return middle, np.float32(SIGMA_PER_MEDIAN_DEVIATION) * deviation + np.float32(3)


def _near(changed: Mask, margin_px: int) -> tuple[slice, slice]:
    """The part of a mask that lies at most `margin_px` around what changed, something."""
    x, y, wide, high = cv2.boundingRect(changed.view(np.uint8))
    return np.s_[
        max(0, y - margin_px) : y + high + margin_px, max(0, x - margin_px) : x + wide + margin_px
    ]


def _length(vectors: Floats32) -> Floats32:
    """(...) of vectors (..., 3): as np.linalg.norm along the last axis, in a tenth of the time."""
    a, b, c = np.moveaxis(vectors, -1, 0)
    return np.sqrt(a * a + b * b + c * c)


def _chance(own: Floats, other: Floats) -> float:
    return float(1 / (1 + np.exp(-(own @ _OWN + other @ _OTHER + _BIAS))))


def _outwards(marked: Bytes) -> tuple[Floats32, Floats32]:
    """Unit vectors away from the region: the gradient of the distance to it, inside and outside."""
    distance = cv2.distanceTransform(1 - marked, cv2.DIST_L2, 3) - cv2.distanceTransform(
        marked, cv2.DIST_L2, 3
    )
    x, y = cv2.Sobel(distance, cv2.CV_32F, 1, 0), cv2.Sobel(distance, cv2.CV_32F, 0, 1)
    length = np.hypot(x, y) + 1e-6
    return np.asarray(x / length, np.float32), np.asarray(y / length, np.float32)


def middle_and_deviation(picture: Bytes, where: Mask) -> tuple[Floats32, Floats32]:
    """Medians (3,) of a picture's channels, (h, w, 3), and of how far they stray from these, in some pixels.

    `where` (h, w) marks the pixels that count, in one at least.
    """
    middles, deviations = np.zeros(3, np.float32), np.zeros(3, np.float32)
    mask = where.view(np.uint8)
    for channel in range(3):
        counts = cv2.calcHist([picture], [channel], mask, [256], [0, 256]).ravel().astype(np.int64)
        middles[channel] = _weighted(_LEVELS, counts)
        away = np.abs(_LEVELS - middles[channel])
        order = np.argsort(away)
        deviations[channel] = _weighted(away[order], counts[order])
    return middles, deviations


def _weighted(values: Floats32, counts: Labels) -> float:
    """The median of `values` (N,), in order, that occur so often."""
    sums = counts.cumsum()
    low, high = np.searchsorted(sums, ((sums[-1] - 1) // 2, sums[-1] // 2), side="right")
    return float(values[low] + values[high]) / 2
