"""Where two pictures in the same light differ: regions, with measures that set changes apart from the rest."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.pair.scratch import Scratch
from sorvolo.geometry.arrays import Floats, Mask
from sorvolo.kernels import (
    core_regions,
    differences,
    match_regions,
    measure_regions,
    rim_balance,
    tint,
)

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

_LOG = np.clip(np.rint(np.log2((np.arange(256) + 8) / 8) * 50), 0, 255).astype(np.uint8)
Image = NDArray[np.uint8]
"""uint8, (h, w) or (h, w, 3)."""


@dataclass(frozen=True)
class MeasureSettings:
    """Where a region's features are measured. The trees of `region_score` learnt from these: another value, new trees.

    Lengths in px of the (half size) pictures.
    """

    ring_px: int = 4  # around a region, where its ground is measured
    wide_px: int = 20  # what the ground does around a region and its neighbours, wind among it
    neighbour_px: float = 100.0  # regions nearer to each other are neighbours
    green_cell_px: int = 4  # side of the cell in a region's middle whose green is measured
    match_margin_px: int = (
        3  # around a region's box, when its details are looked for in the other picture ...
    )
    match_reach_px: int = 6  # ... so far away
    detail_px: int = 11  # details are what is smaller

    @property
    def looked_at_px(self) -> int:
        """Around regions: what is farther away changes nothing in what is measured of them."""
        return self.wide_px + self.detail_px


@dataclass(frozen=True)
class RegionSettings:
    """What is looked at as a possible change. Lengths in px of the (half size) pictures."""

    reach_px: int = 2  # a value counts as known where it occurs this near in the other picture
    chroma_weight: int = 2  # times a gray difference: ground that changes differs less in colour
    least_difference: float = 9.0  # grey levels, weak threshold where nothing disturbs
    noise_factor: float = 0.8  # of the frame's own 95 % quantile of differences
    activity_factor: float = 1.4  # of the mean difference around
    strong_factor: float = 1.5  # strong over weak threshold
    core: float = 0.45  # a region keeps what exceeds this part of its own height
    least_area_px: int = 6  # smaller ones are noise
    least_noise: float = (
        0.0  # what the flight shows elsewhere: a frame is not taken for quieter than this
    )
    speck_px: int = 9  # small differences are clutter, which raises thresholds around; a large thing's inside is none
    most_clutter: float = 48.0  # grey levels that a small difference counts as clutter at most
    around_px: int = 41  # side of the window that clutter is averaged over


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions 1 .. N of `labels` (h, w) uint8: `boxes` (N, 4) int32 x, y, w, h and `features` (N, len(FEATURES)).

    `strength` (h, w) uint8 is how much the pictures differ; `weak` (h, w) uint8 is
    255 wherever they differ at all, `noise` the 95 % quantile of small differences.
    Outside of `known` (h, w), None where everything is, nothing is found. `came` (N,) is positive where the query shows
    a thing on the reference's ground, negative where it is the other way round.
    """

    labels: NDArray[np.uint8]
    boxes: NDArray[np.int32]
    features: Floats
    strength: Image
    weak: Image
    noise: float
    known: Mask | None
    came: Floats

    @cached_property
    def nearest(self) -> NDArray[np.uint8]:
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
    settings: RegionSettings,
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
        settings.reach_px,
        settings.chroma_weight,
        scratch.stack("planes", size, 6),
    )
    difference, chroma, came, went, light_before, light_after = planes
    spare, specks, smooth, threshold = scratch.stack("thresholds", size, 4)
    # a large thing's inside is no clutter: only what is small among the differences raises the thresholds around it
    window = np.ones((settings.speck_px, settings.speck_px), np.uint8)
    cv2.subtract(
        difference, cv2.morphologyEx(difference, cv2.MORPH_OPEN, window, dst=spare), dst=specks
    )
    some = np.asarray(
        cv2.calcHist([np.ascontiguousarray(specks[::4, ::4])], [0], None, [256], [0, 256])
    )
    counts = some.ravel().cumsum(dtype=np.float64)
    noise = float(np.searchsorted(counts, 0.95 * counts[-1]))
    cv2.blur(difference, (3, 3), dst=smooth)
    cv2.threshold(
        specks, settings.most_clutter, settings.most_clutter, cv2.THRESH_TRUNC, dst=specks
    )
    activity = cv2.blur(specks, (settings.around_px, settings.around_px), dst=spare)
    base = settings.least_difference + settings.noise_factor * max(noise, settings.least_noise)
    cv2.addWeighted(activity, settings.activity_factor, activity, 0.0, base, dst=threshold)
    weak = np.asarray(cv2.compare(smooth, threshold, cv2.CMP_GT), np.uint8)
    labels, boxes = core_regions(
        smooth,
        threshold,
        settings.strong_factor,
        settings.core,
        settings.least_area_px,
        MOST_REGIONS,
    )
    if len(boxes) == 0:
        return Regions(
            labels, boxes, np.zeros((0, len(FEATURES))), smooth, weak, noise, known, np.zeros(0)
        )
    # a shadow takes from all colours alike: red over blue stays
    measures = MeasureSettings()
    colour = tint(reference, query, _LOG, boxes, measures.ring_px, scratch.take("tint", size))
    channels = [difference, chroma, activity, light_before, light_after, came, went, colour]
    frame = np.array([noise, rest_px, unevenness, np.log1p(len(boxes))])
    green = (
        _green(reference, boxes, measures.green_cell_px),
        _green(query, boxes, measures.green_cell_px),
    )
    features = _measured(labels, boxes, channels, green, frame, scratch, measures)
    # along its outline a thing's values are new, while the ground's are still to be seen near
    balance = rim_balance(labels, boxes, came, went).astype(np.float64)
    return Regions(labels, boxes, features, smooth, weak, noise, known, balance)


def _measured(
    labels: NDArray[np.uint8],
    boxes: NDArray[np.int32],
    channels: list[Image],
    green: tuple[Floats, Floats],
    frame: NDArray[np.float64],
    scratch: Scratch,
    settings: MeasureSettings,
) -> Floats:
    planes = scratch.stack("measured", (labels.shape[0], labels.shape[1]), 10)
    searched = scratch.take(
        "searched", (labels.shape[0], labels.shape[1]), margin_px=settings.match_reach_px
    )
    part, corner = _looked_at(boxes, labels.shape, settings.looked_at_px)
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
    cv2.LUT(light_before, _LOG, dst=log_before)
    cv2.LUT(level, _LOG, dst=log_after)
    _details(log_before, detail_before, settings.detail_px)
    _details(log_after, detail_after, settings.detail_px)
    window = np.ones((3, 3), np.uint8)
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
    sums = measure_regions(labels, boxes, [*stack, detail_before, detail_after], settings.ring_px)
    means, spreads = _moments(sums)
    within, around = means[:, 0], means[:, 1]
    kept, had, has = _structure(means[..., (7, 11, 12)], spreads[..., (7, 11, 12)])
    cv2.morphologyEx(ratio, cv2.MORPH_GRADIENT, window, dst=sharp)
    cv2.morphologyEx(difference, cv2.MORPH_GRADIENT, window, dst=steep)
    rim = _moments(measure_regions(_rims(labels), boxes, [sharp, steep], 0))[0][:, 0]
    around_wide = measure_regions(labels, boxes, [ratio, detail], settings.wide_px)
    wide, wide_spreads = (each[:, 1] for each in _moments(around_wide))
    reach = settings.match_reach_px
    searched = searched.reshape(-1)[: (height + 2 * reach) * (width + 2 * reach)].reshape(
        height + 2 * reach, -1
    )
    cv2.copyMakeBorder(detail_before, reach, reach, reach, reach, cv2.BORDER_REFLECT, dst=searched)
    matched = match_regions(
        detail_after, searched, _grown(boxes, labels.shape, settings.match_margin_px), reach
    )
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
        *_standing_out(boxes, area * difference_in, settings.neighbour_px),
    ]
    return np.column_stack(columns + [np.full(len(boxes), value) for value in frame])


def _moments(sums: NDArray[np.int64]) -> tuple[Floats, Floats]:
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


def _standing_out(
    boxes: NDArray[np.int32], strength: Floats, neighbour_px: float
) -> tuple[Floats, Floats, Floats]:
    """Each region's strength (N,) against the strongest, and against all near, in logarithms; how many are near."""
    middles = boxes[:, :2] + boxes[:, 2:] / 2
    near = np.abs(middles[:, None] - middles[None]).max(axis=2) < neighbour_px
    strength = strength + 1.0
    return (
        np.log(strength / strength.max()),
        np.log(strength / (near @ strength)),
        np.log(near.sum(axis=1)),
    )


def _looked_at(
    boxes: NDArray[np.int32], shape: tuple[int, ...], margin_px: int
) -> tuple[tuple[slice, slice], NDArray[np.int32]]:
    """The part of a picture of `shape` (h, w) that determines the measures of regions in boxes (N, 4); its corner."""
    corner = np.maximum(boxes[:, :2].min(axis=0) - margin_px, 0)
    right, bottom = (boxes[:, :2] + boxes[:, 2:]).max(axis=0) + margin_px
    part = np.s_[
        int(corner[1]) : min(int(bottom), shape[0]), int(corner[0]) : min(int(right), shape[1])
    ]
    return part, np.array([*corner, 0, 0], np.int32)


def _rims(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The labels (h, w) of pixels next to pixels of no region, 0 elsewhere."""
    return labels * (cv2.erode(labels, np.ones((3, 3), np.uint8)) == 0)


def _green(image: Image, boxes: NDArray[np.int32], cell_px: int) -> Floats:
    """How much greener (N,) than red and blue a BGR picture (h, w, 3) is in the middle of boxes, grey levels."""
    columns, rows = ((boxes[:, :2] + boxes[:, 2:] // 2) // cell_px * cell_px).T
    y, x = np.mgrid[:cell_px, :cell_px]
    y, x = (
        np.minimum(start[:, None, None] + step, side - 1)
        for start, step, side in ((rows, y, image.shape[0]), (columns, x, image.shape[1]))
    )
    blue, green, red = image[y, x].mean(axis=(1, 2)).T
    return np.asarray(green - (red + blue) / 2)


def _details(logarithm: Image, to: Image, detail_px: int) -> None:
    cv2.blur(logarithm, (detail_px, detail_px), dst=to)
    cv2.addWeighted(logarithm, 1, to, -1, 128, dst=to)


def _grown(boxes: NDArray[np.int32], shape: tuple[int, ...], margin_px: int) -> NDArray[np.int32]:
    """Boxes with a margin, inside the picture."""
    low = np.maximum(boxes[:, :2] - margin_px, 0)
    high = np.minimum(boxes[:, :2] + boxes[:, 2:] + margin_px, [shape[1], shape[0]])
    return np.ascontiguousarray(np.hstack([low, high - low]), np.int32)
