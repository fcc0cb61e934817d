"""Sums over a flight's views in cells of the ground: a raster that grows with the ground that they show."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.evidence.cells import CellWindow, window_around
from sorvolo.geometry.arrays import Floats32, Matrix3
from sorvolo.geometry.homography import apply_homography
from sorvolo.survey.findings import ComparedView

_ALL = 0.99  # of a cell must be seen for it to count


class GroundSums:
    """Sums by name, (rows, columns) float32 each, in cells of `cell_m`. `make_room` and `add` change it."""

    def __init__(self, names: tuple[str, ...], cell_m: float, most_cells: int) -> None:
        self.cell_m, self.window = cell_m, CellWindow(0, 0, 0, 0)
        self.sums: dict[str, NDArray[np.float32]] = {name: np.zeros((0, 0), np.float32) for name in names}
        self._most_cells = most_cells

    def window_of(self, view: ComparedView) -> CellWindow:
        """The cells that a view shows."""
        height, width = view.valid.shape
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
        return window_around(apply_homography(view.site_from_image, corners), self.cell_m)

    def make_room(self, window: CellWindow) -> bool:
        """Make the raster hold a window; whether it does."""
        old = self.window
        new = window if 0 in old.shape else old.joined(window)
        if new == old:
            return True
        spare = max(new.shape) // 4
        new = CellWindow(
            *(min(new.x0, old.x0 - spare if new.x0 < old.x0 else new.x0),
              min(new.y0, old.y0 - spare if new.y0 < old.y0 else new.y0)),
            *(max(new.x1, old.x1 + spare if new.x1 > old.x1 else new.x1),
              max(new.y1, old.y1 + spare if new.y1 > old.y1 else new.y1)),
        )
        if new.shape[0] * new.shape[1] > self._most_cells:
            return False
        part = old.within(new)
        for name, values in self.sums.items():
            self.sums[name] = np.zeros(new.shape, np.float32)
            if values.size:
                self.sums[name][part] = values
        self.window = new
        return True

    def add(
        self, window: CellWindow, site_from_planes: Matrix3, planes: dict[str, Floats32], known: Floats32
    ) -> dict[str, Floats32]:
        """Add planes (h, w) by name where they are `known` (h, w, 1 or 0), and to `seen` how often each cell was; what
        was added, in the window's cells."""
        cell_from_planes = np.linalg.inv(window.site_from_cell(self.cell_m)) @ site_from_planes

        def laid(values: Floats32) -> Floats32:
            return np.asarray(cv2.warpPerspective(
                values, cell_from_planes, window.shape[::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
            ), np.float32)

        seen = (laid(known) > _ALL).astype(np.float32)
        added = {"seen": seen, **{name: laid(values) * seen for name, values in planes.items()}}
        part = window.within(self.window)
        for name, values in added.items():
            self.sums[name][part] += values
        return added
