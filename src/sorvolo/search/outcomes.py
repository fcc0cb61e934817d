"""What became of the plants: where each stood, under which conditions, and whether it was reported."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sorvolo.geometry.arrays import BoxesPx, Floats, Mask, PointsM, frozen
from sorvolo.search.conditions import Conditions
from sorvolo.survey.objects import CLASSES


@dataclass(frozen=True, eq=False)
class Outcomes:
    """N plants of a class: places (N, 2), conditions (N, K) as CONDITIONS, whether found (N,), and views (N,)."""

    places_m: PointsM
    columns: Floats
    found: Mask
    views: Floats

    def __post_init__(self) -> None:
        for name in ("places_m", "columns", "views"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        object.__setattr__(self, "found", frozen(self.found, np.bool_))

    def __len__(self) -> int:
        return len(self.found)


def found_rows(places_m: Sequence[Floats], seen: Conditions, hits: Sequence[bool]) -> Outcomes:
    """The outcomes of plants that at least one frame shows whole."""
    keep = seen.seen
    return Outcomes(
        np.reshape(places_m, (-1, 2))[keep],
        seen.columns[keep],
        np.array(hits, bool).reshape(-1)[keep],
        seen.views[keep],
    )


def any_of(boxes_px: BoxesPx) -> bool:
    """Whether any of the boxes (N, 4) is known."""
    return bool(np.isfinite(boxes_px).any())


def every_label(names: Sequence[str]) -> tuple[str, ...]:
    """Those classes that can be planted, people first."""
    return tuple(name for name in CLASSES if name in names)


def rows_of(boxes_px: BoxesPx, numbers: Sequence[int], wanted: Sequence[int]) -> BoxesPx:
    """(W, 4): of the boxes (N, 4) of these numbers those of the `wanted` ones, in their order; NaN where none is."""
    row_of = {number: row for row, number in enumerate(wanted)}
    rows = np.full((len(wanted), 4), np.nan, np.float32)
    for number, box_px in zip(numbers, boxes_px):
        if number in row_of:
            rows[row_of[number]] = box_px
    return rows


def near_any(places_m: Sequence[Floats], others_m: Sequence[Floats], reach_m: float) -> list[int]:
    """Which of the places, (2,) each, lie within `reach_m` of any of the others: their numbers, in order."""
    if not len(places_m) or not len(others_m):
        return []
    distances_m, _ = cKDTree(np.reshape(others_m, (-1, 2))).query(np.reshape(places_m, (-1, 2)))
    return np.flatnonzero(distances_m <= reach_m).tolist()
