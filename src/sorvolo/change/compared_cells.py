"""The ground that was compared so far, counted view by view in cells of the site."""

import numpy as np

from sorvolo.geometry.homography import apply_homography
from sorvolo.survey.findings import ComparedView

_CELL_M = 1.0
_STEP_PX = 16  # between the pixels of a view that are asked


class ComparedCells:
    """Cells of ground that views compared with the map, and how much under the views was not known. Only `add` changes
    it."""

    def __init__(self) -> None:
        self._cells: set[int] = set()  # each as one number
        self._unknown: list[float] = []  # share of each view

    def add(self, view: ComparedView) -> None:
        """Count the ground of one view."""
        height, width = view.valid.shape
        self._unknown.append(1.0 - float(view.valid.mean()))
        ys, xs = np.mgrid[_STEP_PX // 2:height:_STEP_PX, _STEP_PX // 2:width:_STEP_PX]
        seen = view.valid[ys, xs]
        points_m = apply_homography(view.site_from_image, np.column_stack([xs[seen], ys[seen]]).astype(float))
        cells = np.floor(points_m / _CELL_M).astype(np.int64)
        self._cells.update(np.unique(cells @ [1 << 32, 1]).tolist())  # unique rows would take ten times as long

    @property
    def area_m2(self) -> float:
        """The area of all cells that any view compared."""
        return len(self._cells) * _CELL_M**2

    @property
    def unknown_share(self) -> float | None:
        """The mean share of a view that lay on unknown ground; None before the first view."""
        return float(np.mean(self._unknown)) if self._unknown else None
