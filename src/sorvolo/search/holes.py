"""Ground where little would have been found, and why."""

from collections.abc import Sequence
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, Mask, PointsM
from sorvolo.geometry.polygons import points_inside
from sorvolo.search.cells import Cells
from sorvolo.search.conditions import CONDITIONS, Conditions
from sorvolo.search.recall import Chances, Recall

Holes = NDArray[np.uint8]
"""(N,) numbers of REASONS, 0 for none."""

POD_EDGES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""The classes of probability that polygons are drawn of."""


_DARK = 45.0  # grey levels: below, people and ground are alike in most pictures
_BLURRED_SHARE = 0.25  # of a body's longest side: blurred so far along, it is a smear
_LEAST_PULL = 0.35  # of log odds: a smaller one is no reason


class HoleReason(StrEnum):
    """Why little would have been found."""

    NONE = ""
    NOT_SEEN = "not seen"
    TREES = "under trees"
    COARSE = "too coarse"
    BLUR = "motion blur"
    DARK = "dark"
    TEXTURE = "rough ground"
    FEW_VIEWS = "too few views"
    SLANT = "seen aslant"
    DETECTOR = "rarely found anywhere"
    ROOF = "under a roof"
    UNMEASURED = "not measured"

    @property
    def can_be_flown_again(self) -> bool:
        """Whether another flight may see what this one did not."""
        return self not in (
            HoleReason.NONE,
            HoleReason.TREES,
            HoleReason.ROOF,
            HoleReason.DETECTOR,
            HoleReason.UNMEASURED,
        )


REASONS = tuple(HoleReason)
"""The reasons by the numbers that `hole_reasons` gives."""

_BY_CONDITION = {
    "resolution": HoleReason.COARSE,
    "views": HoleReason.FEW_VIEWS,
    "single view": HoleReason.FEW_VIEWS,
    "blur": HoleReason.BLUR,
    "texture": HoleReason.TEXTURE,
    "light": HoleReason.DARK,
    "slant": HoleReason.SLANT,
    "trees": HoleReason.TREES,
}


def hole_reasons(
    cells: Cells,
    seen: Conditions,
    chances: Chances,
    recall: Recall | None,
    *,
    enough: float,
    needed_m_per_px: float,
    length_m: float,
) -> Holes:
    """(N,) the number in REASONS of why each wanted cell has less than `enough` of a chance; 0 where it has it.

    Pixels coarser than `needed_m_per_px`, blur over a quarter of `length_m` and darkness are reasons by themselves;
    else it is the condition that lowers the fitted chance most, or the detector where none does by much. Without a
    regression, since no plant of the class found room, nothing was measured.
    """
    numbers = np.zeros(len(cells), np.uint8)
    poor = cells.wanted & ~(np.nan_to_num(chances.mean, nan=-1.0) >= enough)
    blur_m = np.exp(seen.columns[:, CONDITIONS.index("blur")])
    light = seen.columns[:, CONDITIONS.index("light")]
    with np.errstate(invalid="ignore"):
        rules: list[tuple[HoleReason, Mask]] = [
            (HoleReason.NOT_SEEN, ~seen.seen),
            (HoleReason.ROOF, seen.roofs),
            (HoleReason.TREES, seen.under_trees),
            (HoleReason.COARSE, seen.m_per_px() > needed_m_per_px),
            (HoleReason.BLUR, blur_m > _BLURRED_SHARE * length_m),
            (HoleReason.DARK, light < _DARK),
        ]
    worst = _worst_condition(seen.columns, recall, _LEAST_PULL)
    for reason, holds in (*rules, *worst):
        numbers[poor & holds & (numbers == 0)] = REASONS.index(reason)
    return numbers


def _worst_condition(
    columns: Floats, recall: Recall | None, least_pull: float
) -> list[tuple[HoleReason, Mask]]:
    """The condition that lowers the chance of each cell most, by reasons; the detector where none does."""
    everything = np.ones(len(columns), bool)
    if recall is None:
        return [(HoleReason.UNMEASURED, everything)]
    pulls = np.nan_to_num(recall.pulls(columns))
    is_lowest = pulls.argmin(axis=1)
    is_strong = pulls.min(axis=1) < -least_pull
    found = [
        (_BY_CONDITION[name], is_strong & (is_lowest == k)) for k, name in enumerate(CONDITIONS)
    ]
    return [*found, (HoleReason.DETECTOR, everything)]


def reasons_together(
    reasons: Sequence[Holes],
    flights: Sequence[Chances],
    total: Chances,
    cells: Cells,
    enough: float,
) -> Holes:
    """(N,) the reasons of several flights: of each cell, the reason of the flight that had the best chance there."""
    chances = np.array([np.nan_to_num(each.mean, nan=-1.0) for each in flights])
    best = np.take_along_axis(np.array(reasons), chances.argmax(axis=0)[None], axis=0)[0]
    poor = cells.wanted & ~(np.nan_to_num(total.mean, nan=-1.0) >= enough)
    return np.where(poor, best, 0).astype(np.uint8)


def hole_areas_m2(numbers: Holes, cell_m: float) -> dict[str, float]:
    """The area of the holes of each reason, the largest first."""
    areas = {
        reason.value: float((numbers == k).sum()) * cell_m**2
        for k, reason in enumerate(REASONS)
        if k
    }
    return dict(
        sorted(((name, area) for name, area in areas.items() if area), key=lambda item: -item[1])
    )


def flyable(numbers: Holes) -> Holes:
    """(N,) 1 where another flight may see what these did not."""
    again = [k for k, reason in enumerate(REASONS) if reason.can_be_flown_again]
    return np.isin(numbers, again).astype(np.uint8)


def without_seen(numbers: Holes, cells: Cells, outlines_m: Sequence[PointsM]) -> Holes:
    """(N,) the holes but for those that frames of these outlines, (4, 2) site metres each, show."""
    seen = np.zeros(len(cells), bool)
    for outline_m in outlines_m:
        seen |= points_inside([outline_m], cells.centres_m)
    return np.where(seen, 0, numbers).astype(np.uint8)


def pod_classes(chances: Chances, wanted: Mask) -> Holes:
    """(N,) 1 for the lowest of POD_EDGES' classes, 2 for the next ...; 0 for what is not wanted or was not seen."""
    known = wanted & np.isfinite(chances.mean)
    numbers = np.clip(
        np.digitize(np.nan_to_num(chances.mean), POD_EDGES[1:-1]) + 1, 1, len(POD_EDGES) - 1
    )
    return np.where(known, numbers, 0).astype(np.uint8)
