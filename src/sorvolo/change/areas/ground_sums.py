"""A flight's views gathered in cells of the ground: sums in a raster that grows with it, pictures, times, residuals."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.areas.ground_pictures import GroundPictures, GroundPictureSettings
from sorvolo.change.evidence.cells import CellWindow, window_around
from sorvolo.geometry.arrays import Floats32, Mask, Matrix3, PointsM
from sorvolo.geometry.homography import apply_homography
from sorvolo.survey.findings import ComparedView, Patch

_ALL = 0.99  # of a cell must be seen for it to count


class GroundSums:
    """Sums by name, (rows, columns) float32 each, in cells of `cell_m`, and pictures of the ground that views show.

    `window_of`, `add` and `show` change it. `cell_m` is 0 before the first view.
    """

    def __init__(
        self, names: tuple[str, ...], most_cells: int, pictures: GroundPictureSettings
    ) -> None:
        self.cell_m, self.window = 0.0, CellWindow(0, 0, 0, 0)
        self.sums: dict[str, NDArray[np.float32]] = {
            name: np.zeros((0, 0), np.float32) for name in names
        }
        self._most_cells = most_cells
        self._picture_settings = pictures
        self._pictures = GroundPictures(1.0, pictures)
        self._times_ns: list[int] = []
        self._residuals_m: list[float] = []

    @property
    def is_empty(self) -> bool:
        """Whether no view was added."""
        return not self._times_ns

    @property
    def span_ns(self) -> tuple[int, int]:
        """Times of the first and of the last view."""
        return min(self._times_ns), max(self._times_ns)

    @property
    def residual_m(self) -> float:
        """How far views lay off the map in the mean, 0 where none states it."""
        return float(np.mean(self._residuals_m)) if self._residuals_m else 0.0

    def window_of(self, view: ComparedView, cell_m: float, picture_m: float) -> CellWindow | None:
        """The cells that a view shows, for which the raster has room now; None where it would be too large.

        The first view decides how wide cells, and pixels of the pictures, are: `cell_m` and `picture_m`.
        """
        if not self.cell_m:
            self.cell_m, self._pictures = cell_m, GroundPictures(picture_m, self._picture_settings)
        window = window_around(view.outline_m, self.cell_m)
        return window if self._make_room(window) else None

    def add(
        self,
        view: ComparedView,
        window: CellWindow,
        site_from_planes: Matrix3,
        planes: dict[str, Floats32],
        known: Floats32,
    ) -> dict[str, Floats32]:
        """Add a view's planes (h, w) by name where they are `known` (h, w, 1 or 0), and to `seen` how often each cell
        was; what was added, in the window's cells."""
        cell_from_planes = np.linalg.inv(window.site_from_cell(self.cell_m)) @ site_from_planes

        def laid(values: Floats32) -> Floats32:
            return np.asarray(
                cv2.warpPerspective(
                    values,
                    cell_from_planes,
                    window.shape[::-1],
                    flags=cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_CONSTANT,
                ),
                np.float32,
            )

        seen = (laid(known) > _ALL).astype(np.float32)
        added = {"seen": seen, **{name: laid(values) * seen for name, values in planes.items()}}
        part = window.within(self.window)
        for name, values in added.items():
            self.sums[name][part] += values
        self._times_ns.append(view.time_ns)
        if np.isfinite(view.residual_px):
            self._residuals_m.append(view.residual_px * view.m_per_px)
        return added

    def show(self, view: ComparedView, window: CellWindow, cells: Mask) -> None:
        """Keep the view's pictures of some of its cells, (rows, columns) of the window."""
        rows, columns = np.nonzero(cells)
        if len(rows):
            places = np.column_stack([columns, rows]).astype(float)
            self._pictures.show(view, apply_homography(window.site_from_cell(self.cell_m), places))

    def patch(self, outline_m: PointsM) -> Patch:
        """The pictures of an outline, (N, 2)."""
        return self._pictures.patch(outline_m)

    def _make_room(self, window: CellWindow) -> bool:
        """Make the raster hold a window; whether it does."""
        old = self.window
        new = window if 0 in old.shape else old.joined(window)
        if new == old:
            return True
        spare = max(new.shape) // 4
        new = CellWindow(
            *(
                min(new.x0, old.x0 - spare if new.x0 < old.x0 else new.x0),
                min(new.y0, old.y0 - spare if new.y0 < old.y0 else new.y0),
            ),
            *(
                max(new.x1, old.x1 + spare if new.x1 > old.x1 else new.x1),
                max(new.y1, old.y1 + spare if new.y1 > old.y1 else new.y1),
            ),
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
