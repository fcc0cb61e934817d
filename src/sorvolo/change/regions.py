"""Where two pictures in the same light differ: regions, with measures that set changes apart from the rest."""

import threading
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Bytes, Floats, Ints32, Labels, Mask, square
from sorvolo.kernels import (
    core_regions,
    differences,
    match_regions,
    measure_regions,
    rim_balance,
    tint,
)

MOST_KEPT_PX = 1 << 20  # of a picture: what is larger is given back


class Scratch:
    """Arrays by name, for one size of pictures at a time. Only `take` and `stack` change it.

    An array lasts until its name is asked for again. So whoever makes a `Scratch` owns what is in it: a result that
    outlives the comparison must hold arrays of its own, or come from a `Scratch` that nobody uses again.
    """

    def __init__(self) -> None:
        self._size: tuple[int, int] = (0, 0)
        self._kept: dict[tuple[str, tuple[int, ...]], Bytes] = {}

    def take(
        self, name: str, size: tuple[int, int], bands: tuple[int, ...] = (), margin_px: int = 0
    ) -> Bytes:
        """The uint8 array `name` for pictures of `size` (h, w), grown by a margin; with `bands` (h, w, ...)."""
        return self._taken(name, size, (size[0] + 2 * margin_px, size[1] + 2 * margin_px, *bands))

    def stack(self, name: str, size: tuple[int, int], planes: int) -> Bytes:
        """The uint8 array `name` of shape (planes, h, w), holding anything."""
        return self._taken(name, size, (planes, *size))

    def _taken(self, name: str, size: tuple[int, int], shape: tuple[int, ...]) -> Bytes:
        if size[0] * size[1] > MOST_KEPT_PX:
            return np.empty(shape, np.uint8)
        if size != self._size:
            self._kept.clear()
            self._size = size
        key = name, shape
        if key not in self._kept:
            self._kept[key] = np.empty(shape, np.uint8)
        return self._kept[key]


class _OfThread(threading.local):
    def __init__(self) -> None:
        self.scratch = Scratch()


_OF_THREAD = _OfThread()


def scratch_of_thread() -> Scratch:
    """The one `Scratch` of this thread, for a function that returns nothing out of it."""
    return _OF_THREAD.scratch


MOST_REGIONS = 250  # a byte holds their labels

FEATURES = (
    "log area",
    "log length",
    "aspect",
    "fill",
    "difference",
    "difference spread",
    "chroma share",
    "sharpness",
    "difference over activity",
    "difference over noise",
    "ratio",
    "ratio step",
    "ratio spread",
    "ratio spread outside",
    "edges after",
    "edges before",
    "edges outside",
    "edge contrast",
    "detail difference",
    "detail outside",
    "alike in place",
    "alike best",
    "alike gain",
    "match length",
    "match rest",
    "match gain",
    "level",
    "activity",
    "came",
    "colour step",
    "colour spread",
    "structure kept",
    "structure kept outside",
    "structure before",
    "structure after",
    "rim light",
    "rim difference",
    "wide ratio",
    "wide ratio spread",
    "wide detail",
    "green before",
    "green after",
    "part of strongest",
    "part of neighbours",
    "neighbours",
    "noise",
    "rest",
    "unevenness",
    "regions",
)

LOGARITHMS = np.clip(np.rint(np.log2((np.arange(256) + 8) / 8) * 50), 0, 255).astype(np.uint8)
Image = NDArray[np.uint8]
"""uint8, (h, w) or (h, w, 3)."""


# Where a region's features are measured. The trees of `region_score` learnt from these: another
# value, new trees. Lengths in px of the (half size) pictures.
_RING_PX = 4  # around a region, where its ground is measured
_WIDE_PX = 20  # what the ground does around a region and its neighbours, wind among it
_NEIGHBOUR_PX = 100.0  # regions nearer to each other are neighbours
_GREEN_CELL_PX = 4  # side of the cell in a region's middle whose green is measured
# around a region's box, when its details are looked for in the other picture ...
_MATCH_MARGIN_PX = 3
_MATCH_REACH_PX = 6  # ... so far away
_DETAIL_PX = 11  # details are what is smaller


_CHROMA_WEIGHT = 2  # times a gray difference: ground that changes differs less in colour
# a value counts as known where it occurs this near in the other picture ...
_REACH_PX = 2
_CALM_REACH_PX = 1  # ... and this near where hardly anything moves: less is hidden by it ...
_CALM_PX = 0.4  # ... where so much is left of the flow
_LEAST_DIFFERENCE = 9.0  # grey levels, weak threshold where nothing disturbs
_NOISE_FACTOR = 0.8  # of the frame's own 95 % quantile of differences
_ACTIVITY_FACTOR = 1.4  # of the mean difference around
_STRONG_FACTOR = 1.5  # strong over weak threshold
_CORE = 0.45  # a region keeps what exceeds this part of its own height
_LEAST_AREA_PX = 6  # smaller ones are noise
# small differences are clutter, which raises thresholds around; a large thing's inside is none
_SPECK_PX = 9
_MOST_CLUTTER = 48.0  # grey levels that a small difference counts as clutter at most
_AROUND_PX = 41  # side of the window that clutter is averaged over


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions 1 .. N of `labels` (h, w) uint8: `boxes` (N, 4) int32 x, y, w, h and `features` (N, len(FEATURES)).

    `strength` (h, w) uint8 is how much the pictures differ; `weak` (h, w) uint8 is
    255 wherever they differ at all, `noise` the 95 % quantile of small differences.
    Outside of `known` (h, w), None where everything is, nothing is found. `came` (N,) is positive where the query shows
    a thing on the reference's ground, negative where it is the other way round.
    """

    labels: Bytes
    boxes: Ints32
    features: Floats
    strength: Image
    weak: Image
    noise: float
    known: Mask | None
    came: Floats

    @cached_property
    def nearest(self) -> Bytes:
        """(h, w) the label of the region that is nearest to each pixel, 0 where there is no region; made once."""
        inside = self.labels > 0
        _, places = cv2.distanceTransformWithLabels(
            np.logical_not(inside).view(np.uint8),
            cv2.DIST_L2,
            cv2.DIST_MASK_5,
            labelType=cv2.DIST_LABEL_PIXEL,
        )
        label_at = np.zeros(int(places.max()) + 1, np.uint8)
        label_at[places[inside]] = self.labels[inside]
        return np.asarray(label_at[places])


def find_regions(
    reference: Image,
    query: Image,
    known: Mask | None,
    rest_px: float,
    unevenness: float,
    scratch: Scratch | None = None,
) -> Regions:
    """Regions that differ between two pictures (h, w, 3) uint8 BGR in the same light; none where not `known`.

    The result's `strength` lies in `scratch`, in memory of its own without it.
    """
    scratch = scratch or Scratch()
    size = reference.shape[0], reference.shape[1]
    planes = differences(
        reference,
        query,
        known,
        _CALM_REACH_PX if rest_px < _CALM_PX else _REACH_PX,
        _CHROMA_WEIGHT,
        scratch.stack("planes", size, 6),
    )
    difference, chroma, came, went, light_before, light_after = planes
    spare, specks, smooth, threshold = scratch.stack("thresholds", size, 4)
    # a large thing's inside is no clutter: only what is small among the differences raises the thresholds around it
    window = square(_SPECK_PX)
    cv2.subtract(
        difference, cv2.morphologyEx(difference, cv2.MORPH_OPEN, window, dst=spare), dst=specks
    )
    some = np.asarray(
        cv2.calcHist([np.ascontiguousarray(specks[::4, ::4])], [0], None, [256], [0, 256])
    )
    counts = some.ravel().cumsum(dtype=np.float64)
    noise = float(np.searchsorted(counts, 0.95 * counts[-1]))
    cv2.blur(difference, (3, 3), dst=smooth)
    cv2.threshold(specks, _MOST_CLUTTER, _MOST_CLUTTER, cv2.THRESH_TRUNC, dst=specks)
    activity = cv2.blur(specks, (_AROUND_PX, _AROUND_PX), dst=spare)
    base = _LEAST_DIFFERENCE + _NOISE_FACTOR * noise
    cv2.addWeighted(activity, _ACTIVITY_FACTOR, activity, 0.0, base, dst=threshold)
    weak = np.asarray(cv2.compare(smooth, threshold, cv2.CMP_GT), np.uint8)
    labels, boxes = core_regions(
        smooth,
        threshold,
        _STRONG_FACTOR,
        _CORE,
        _LEAST_AREA_PX,
        MOST_REGIONS,
    )
    if len(boxes) == 0:
        return Regions(
            labels, boxes, np.zeros((0, len(FEATURES))), smooth, weak, noise, known, np.zeros(0)
        )
    # a shadow takes from all colours alike: red over blue stays
    colour = tint(reference, query, LOGARITHMS, boxes, _RING_PX, scratch.take("tint", size))
    channels = [difference, chroma, activity, light_before, light_after, came, went, colour]
    frame = np.array([noise, rest_px, unevenness, np.log1p(len(boxes))])
    green = (
        _green(reference, boxes),
        _green(query, boxes),
    )
    features = _measured(labels, boxes, channels, green, frame, scratch)
    # along its outline a thing's values are new, while the ground's are still to be seen near
    balance = rim_balance(labels, boxes, came, went).astype(np.float64)
    return Regions(labels, boxes, features, smooth, weak, noise, known, balance)


def _measured(
    labels: Bytes,
    boxes: Ints32,
    channels: list[Image],
    green: tuple[Floats, Floats],
    frame: Floats,
    scratch: Scratch,
) -> Floats:
    planes = scratch.stack("measured", (labels.shape[0], labels.shape[1]), 10)
    searched = scratch.take(
        "searched", (labels.shape[0], labels.shape[1]), margin_px=_MATCH_REACH_PX
    )
    part, corner = _looked_at(boxes, labels.shape)
    labels, *channels = (np.ascontiguousarray(each[part]) for each in (labels, *channels))
    difference, chroma, activity, light_before, level, came, went, colour = channels
    boxes = boxes - corner
    height, width = labels.shape
    (
        log_before,
        log_after,
        detail_before,
        detail_after,
        ratio,
        edges_after,
        edges_before,
        detail,
        sharp,
        steep,
    ) = planes.reshape(-1)[: 10 * labels.size].reshape(10, height, width)
    cv2.LUT(light_before, LOGARITHMS, dst=log_before)
    cv2.LUT(level, LOGARITHMS, dst=log_after)
    _details(log_before, detail_before)
    _details(log_after, detail_after)
    window = square(3)
    cv2.addWeighted(log_after, 0.5, log_before, -0.5, 128, dst=ratio)
    cv2.morphologyEx(log_after, cv2.MORPH_GRADIENT, window, dst=edges_after)
    cv2.morphologyEx(log_before, cv2.MORPH_GRADIENT, window, dst=edges_before)
    cv2.absdiff(detail_after, detail_before, dst=detail)
    stack = [
        difference,
        chroma,
        activity,
        level,
        ratio,
        edges_after,
        edges_before,
        detail,
        came,
        went,
        colour,
    ]
    sums = measure_regions(labels, boxes, [*stack, detail_before, detail_after], _RING_PX)
    means, spreads = _moments(sums)
    within, around = means[:, 0], means[:, 1]
    kept, had, has = _structure(means[..., (7, 11, 12)], spreads[..., (7, 11, 12)])
    cv2.morphologyEx(ratio, cv2.MORPH_GRADIENT, window, dst=sharp)
    cv2.morphologyEx(difference, cv2.MORPH_GRADIENT, window, dst=steep)
    rim = _moments(measure_regions(_rims(labels), boxes, [sharp, steep], 0))[0][:, 0]
    around_wide = measure_regions(labels, boxes, [ratio, detail], _WIDE_PX)
    wide, wide_spreads = (each[:, 1] for each in _moments(around_wide))
    reach = _MATCH_REACH_PX
    searched = searched.reshape(-1)[: (height + 2 * reach) * (width + 2 * reach)].reshape(
        height + 2 * reach, -1
    )
    cv2.copyMakeBorder(detail_before, reach, reach, reach, reach, cv2.BORDER_REFLECT, dst=searched)
    matched = match_regions(detail_after, searched, _grown(boxes, labels.shape), reach)
    long, short = boxes[:, 2:].max(axis=1), boxes[:, 2:].min(axis=1)
    area = sums[:, 0, 0].astype(np.float64)
    difference_in, noise = within[:, 0], frame[0]
    step = within[:, 4] - wide[:, 0]
    columns = [
        np.log(area),
        np.log(long),
        short / long,
        area / (boxes[:, 2] * boxes[:, 3]),
        difference_in,
        spreads[:, 0, 0],
        2 * within[:, 1] / np.maximum(difference_in, 1),
        around[:, 0] / np.maximum(difference_in, 1),
        difference_in / (within[:, 2] + 2),
        difference_in / (noise + 4),
        within[:, 4] - 128,
        within[:, 4] - around[:, 4],
        spreads[:, 0, 4],
        spreads[:, 1, 4],
        within[:, 5],
        within[:, 6],
        np.maximum(around[:, 5], around[:, 6]),
        (within[:, 5] - within[:, 6]) / (within[:, 5] + within[:, 6] + 4),
        within[:, 7],
        around[:, 7],
        matched[:, 0],
        matched[:, 1],
        matched[:, 1] - matched[:, 0],
        np.hypot(matched[:, 2], matched[:, 3]),
        matched[:, 5],
        matched[:, 5] / np.maximum(matched[:, 4], 1),
        within[:, 3],
        within[:, 2],
        (within[:, 8] - within[:, 9]) / np.maximum(difference_in, 1),
        within[:, 10] - around[:, 10],
        spreads[:, 0, 10],
        kept[:, 0],
        kept[:, 1],
        had[:, 0],
        has[:, 0],
        rim[:, 0] / (np.abs(step) + 4),
        rim[:, 1] / (difference_in + 4),
        step / (wide_spreads[:, 0] + 2),
        wide_spreads[:, 0],
        wide[:, 1],
        *green,
        *_standing_out(boxes, area * difference_in),
    ]
    return np.column_stack(columns + [np.full(len(boxes), value) for value in frame])


def _moments(sums: Labels) -> tuple[Floats, Floats]:
    """Means and standard deviations (N, 2, C) of channels within regions and around them, 0 where there is no pixel."""
    channels = sums.shape[2] // 2
    count = np.maximum(sums[:, :, :1], 1).astype(np.float64)
    means = sums[:, :, 1 : 1 + channels] / count
    return means, np.sqrt(np.maximum(sums[:, :, 1 + channels :] / count - means**2, 0))


def _structure(means: Floats, spreads: Floats) -> tuple[Floats, Floats, Floats]:
    """How alike (N, 2) the details before and after are, -1 to 1, within and around; and how strong before and after.

    From the moments (N, 2, 3) of what they are apart, of the details before and after: a correlation.
    """
    apart = spreads[..., 0] ** 2 + means[..., 0] ** 2 - (means[..., 2] - means[..., 1]) ** 2
    before, after = spreads[..., 1] ** 2, spreads[..., 2] ** 2
    alike = (before + after - apart) / (2 * np.sqrt((before + 1) * (after + 1)))
    return alike, spreads[..., 1], spreads[..., 2]


def _standing_out(boxes: Ints32, strength: Floats) -> tuple[Floats, Floats, Floats]:
    """Each region's strength (N,) against the strongest, and against all near, in logarithms; how many are near."""
    middles = boxes[:, :2] + boxes[:, 2:] / 2
    near = np.abs(middles[:, None] - middles[None]).max(axis=2) < _NEIGHBOUR_PX
    strength = strength + 1.0
    return (
        np.log(strength / strength.max()),
        np.log(strength / (near @ strength)),
        np.log(near.sum(axis=1)),
    )


def _looked_at(boxes: Ints32, shape: tuple[int, ...]) -> tuple[tuple[slice, slice], Ints32]:
    """The part of a picture of `shape` (h, w) that determines the measures of regions in boxes (N, 4); its corner."""
    corner = np.maximum(boxes[:, :2].min(axis=0) - (_WIDE_PX + _DETAIL_PX), 0)
    right, bottom = (boxes[:, :2] + boxes[:, 2:]).max(axis=0) + (_WIDE_PX + _DETAIL_PX)
    part = np.s_[
        int(corner[1]) : min(int(bottom), shape[0]), int(corner[0]) : min(int(right), shape[1])
    ]
    return part, np.array([*corner, 0, 0], np.int32)


def _rims(labels: Bytes) -> Bytes:
    """The labels (h, w) of pixels next to pixels of no region, 0 elsewhere."""
    return labels * (cv2.erode(labels, square(3)) == 0)


def _green(image: Image, boxes: Ints32) -> Floats:
    """How much greener (N,) than red and blue a BGR picture (h, w, 3) is in the middle of boxes, grey levels."""
    columns, rows = ((boxes[:, :2] + boxes[:, 2:] // 2) // _GREEN_CELL_PX * _GREEN_CELL_PX).T
    y, x = np.mgrid[:_GREEN_CELL_PX, :_GREEN_CELL_PX]
    y, x = (
        np.minimum(start[:, None, None] + step, side - 1)
        for start, step, side in ((rows, y, image.shape[0]), (columns, x, image.shape[1]))
    )
    blue, green, red = image[y, x].mean(axis=(1, 2)).T
    return green - (red + blue) / 2


def _details(logarithm: Image, to: Image) -> None:
    cv2.blur(logarithm, (_DETAIL_PX, _DETAIL_PX), dst=to)
    cv2.addWeighted(logarithm, 1, to, -1, 128, dst=to)


def _grown(boxes: Ints32, shape: tuple[int, ...]) -> Ints32:
    """Boxes with a margin, inside the picture."""
    low = np.maximum(boxes[:, :2] - _MATCH_MARGIN_PX, 0)
    high = np.minimum(boxes[:, :2] + boxes[:, 2:] + _MATCH_MARGIN_PX, [shape[1], shape[0]])
    return np.ascontiguousarray(np.hstack([low, high - low]), np.int32)
