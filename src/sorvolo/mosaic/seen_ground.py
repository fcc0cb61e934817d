"""The ground that a flight's pictures show: how many of them, how finely, and the holes that none shows."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, Mask, PointsM
from sorvolo.geometry.polygons import points_inside, union_of_boxes
from sorvolo.survey.coverage import SeenGround

_CELLS_ACROSS = 24  # of a picture's shorter side on the ground
_MOST_CELLS = 1500  # along a side of the whole flight: then they are larger
# numbers of pictures that are distinguished: heights need 3, better 5
_STEPS = (
    1,
    2,
    3,
    5,
)
# of a picture's shorter side: gaps between strips up to this wide are amid what was seen
_BRIDGED = 1.0
_LEAST_HOLE = 0.05  # of a picture's area: notches at its corners are smaller


@dataclass(frozen=True, eq=False)
class PictureOnGround:
    """Where a picture lies, (4, 2) site metres, and the ground sampling distance there."""

    outline_m: PointsM
    m_per_px: float


def seen_ground(
    pictures: Sequence[PictureOnGround],
    area_m: Sequence[Sequence[PointsM]] = (),
) -> list[SeenGround]:
    """The ground in parts by the number of pictures that show it, then the holes, each in its own part.

    `area_m` are polygons, (N, 2) rings each, that were to be covered: what of them no picture shows is a hole. Without
    it, holes are what lies amid the ground that was seen, gaps between strips included. Empty without pictures.
    """
    if not pictures:
        return []
    raster = _Raster(pictures, area_m)
    views, finest = raster.count(pictures)
    parts = []
    for least, below in zip(_STEPS, (*_STEPS[1:], np.iinfo(np.int32).max)):
        part = (views >= least) & (views < below)
        if part.any():
            parts.append(raster.part(part, least, float(np.median(finest[part]))))
    wanted = raster.inside(area_m) if area_m else raster.amid(views > 0)
    least_cells = _LEAST_HOLE * raster.picture_m2 / raster.cell_m**2
    for hole in _regions(wanted & (views == 0), least_cells):
        parts.append(raster.part(hole, 0, float("nan")))
    return parts


def coverage_figures(ground: Sequence[SeenGround]) -> dict[str, float | int | None]:
    """The figures of a report: areas seen, seen in one picture only, of the holes, and their number; the resolution
    that half of the ground has or a finer one."""
    seen = [each for each in ground if each.views]
    holes = [each for each in ground if not each.views]
    total_m2, coarser_m2, middle = sum(each.area_m2 for each in seen), 0.0, None
    for each in sorted(seen, key=lambda part: part.m_per_px):
        coarser_m2 += each.area_m2
        if middle is None and 2 * coarser_m2 >= total_m2:
            middle = each.m_per_px
    return {
        "seen_m2": total_m2,
        "one_view_m2": sum(each.area_m2 for each in seen if each.views == 1),
        "holes": len(holes),
        "holes_m2": sum(each.area_m2 for each in holes),
        "m_per_px": middle,
    }


class _Raster:
    """Cells over a flight, row 0 in the north; one picture's side is kept free around it."""

    def __init__(
        self,
        pictures: Sequence[PictureOnGround],
        area_m: Sequence[Sequence[PointsM]],
    ) -> None:
        sides_m = np.array(
            [
                np.linalg.norm(np.diff(each.outline_m[[0, 1, 2]], axis=0), axis=1)
                for each in pictures
            ]
        )
        self._side_m = float(np.median(sides_m.min(axis=1)))
        self.picture_m2 = float(np.median(sides_m.prod(axis=1)))
        outlines = [
            *(each.outline_m for each in pictures),
            *(ring for rings in area_m for ring in rings),
        ]
        corners = np.concatenate(outlines)
        self._reach_m = _BRIDGED * self._side_m / 2
        low, high = corners.min(axis=0) - 2 * self._reach_m, corners.max(axis=0) + 2 * self._reach_m
        self.cell_m = max(
            self._side_m / _CELLS_ACROSS,
            float((high - low).max()) / _MOST_CELLS,
            1e-3,
        )
        self._west_m, self._north_m = float(low[0]), float(high[1])
        self._shape = tuple(np.ceil((high - low) / self.cell_m).astype(int)[::-1])

    def count(self, pictures: Sequence[PictureOnGround]) -> tuple[NDArray[np.int32], Floats]:
        """How many pictures show each cell, and the finest one's ground sampling distance; infinite where none does."""
        views, finest = np.zeros(self._shape, np.int32), np.full(self._shape, np.inf)
        for each in pictures:
            middle_m = each.outline_m.mean(axis=0)
            # OpenCV fills what an outline only touches as well: half a cell on each side
            cells = self._cells(
                middle_m + (each.outline_m - middle_m) * (1 - self.cell_m / self._side_m)
            )
            low = np.clip(cells.min(axis=0), 0, None)
            high = cells.max(axis=0) + 1
            part = np.s_[low[1] : high[1], low[0] : high[0]]
            under = np.zeros(views[part].shape, np.uint8)
            cv2.fillConvexPoly(under, (cells - low).astype(np.int32), 1)
            views[part] += under
            np.minimum(finest[part], each.m_per_px, out=finest[part], where=under > 0)
        return views, finest

    def inside(self, area_m: Sequence[Sequence[PointsM]]) -> Mask:
        """The cells in these polygons."""
        found = np.zeros(self._shape, np.uint8)
        for rings in area_m:
            own = np.zeros(self._shape, np.uint8)
            corners = [self._cells(ring).astype(np.int32) for ring in rings]
            cv2.fillPoly(own, corners, 1)
            edge = np.zeros(self._shape, np.uint8)
            cv2.polylines(edge, corners, True, 1)
            rows, columns = np.nonzero(edge)  # of those some have their centre outside
            centres_m = np.column_stack([columns + 0.5, -rows - 0.5]) * self.cell_m + [
                self._west_m,
                self._north_m,
            ]
            own[rows, columns] = points_inside(rings, centres_m)
            found |= own
        return found > 0

    def amid(self, seen: Mask) -> Mask:
        """Ground seen, gaps that are narrower than a picture, and all that these enclose."""
        reach = max(1, round(self._reach_m / self.cell_m))
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        closed = cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
        outside = np.pad(closed, 1)
        cv2.floodFill(outside, None, (0, 0), 2)
        return outside[1:-1, 1:-1] != 2

    def part(self, cells: Mask, views: int, m_per_px: float) -> SeenGround:
        """These cells as polygons."""
        boxes = np.array(
            [
                (
                    self._west_m + x0 * self.cell_m,
                    self._north_m - (y + 1) * self.cell_m,
                    self._west_m + x1 * self.cell_m,
                    self._north_m - y * self.cell_m,
                )
                for y, x0, x1 in _runs(cells)
            ]
        )
        polygons = tuple(tuple(rings) for rings in union_of_boxes(boxes))
        return SeenGround(polygons, float(cells.sum()) * self.cell_m**2, views, m_per_px)

    def _cells(self, points_m: PointsM) -> NDArray[np.intp]:
        return np.floor((points_m - [self._west_m, self._north_m]) * [1, -1] / self.cell_m).astype(
            int
        )


def _runs(cells: Mask) -> Iterator[tuple[int, int, int]]:
    """Row, first column, last column + 1 of each run."""
    edges = np.diff(np.pad(cells.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, starts = np.nonzero(edges == 1)
    ends = np.nonzero(edges == -1)[1]
    yield from zip(rows.tolist(), starts.tolist(), ends.tolist(), strict=True)


def _regions(cells: Mask, least: float) -> Iterator[Mask]:
    """Connected regions of this many cells at least, the largest first."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(cells.astype(np.uint8), connectivity=4)
    sizes = stats[:, cv2.CC_STAT_AREA]
    for number in np.argsort(-sizes, kind="stable").tolist():
        if number and sizes[number] >= least:
            yield labels == number
