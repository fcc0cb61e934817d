"""Pictures of the ground on both dates, kept in squares where a flight's views show that an area may have changed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.change.evidence.candidate_pictures import PictureSettings, quality
from sorvolo.change.shape.patches import Cut, PatchWindow, cut, patch_of
from sorvolo.geometry.arrays import PointsM
from sorvolo.survey.findings import ComparedView, Patch


@dataclass(frozen=True)
class GroundPictureSettings:
    """How pictures of areas are kept (0025)."""

    side_px: int = 256  # of a square
    most_squares: int = 400  # 200 MB; further squares have no pictures
    most_patch_px: int = 2048  # longest side of an area's picture
    margin: float = 0.1  # of an area's length is shown around it
    better: float = (
        PictureSettings.better
    )  # times as good a view's pictures must be to replace older ones


class GroundPictures:
    """The best pictures of squares of ground, `m_per_px` a pixel. Only `show` changes it."""

    def __init__(
        self, m_per_px: float, settings: GroundPictureSettings = GroundPictureSettings()
    ) -> None:
        self._m_per_px, self._settings = m_per_px, settings
        self._side_m = settings.side_px * m_per_px
        self._squares: dict[tuple[int, int], tuple[Cut, float]] = {}

    def show(self, view: ComparedView, places_m: PointsM) -> None:
        """Take the view's pictures of the squares that hold any of these places, (N, 2), where they are better."""
        side_m = self._side_m
        for key in _squares_at(places_m / side_m):
            if key not in self._squares and len(self._squares) >= self._settings.most_squares:
                continue
            low_m = np.array(key) * side_m
            good = quality(view, low_m, low_m + side_m)
            old = self._squares.get(key)
            if (
                old is not None
                and good <= self._settings.better * old[1]
                and (old[0].after[..., 3] > 0).all()
            ):
                continue
            new = cut(view, self._window(key))
            if old is None:
                self._squares[key] = new, good
            elif good > self._settings.better * old[1]:
                self._squares[key] = new.over(old[0]), good
            else:
                self._squares[key] = old[0].over(new), old[1]

    def patch(self, outline_m: PointsM) -> Patch:
        """The pictures of an outline, (N, 2), and of a little ground around it; nothing is known beyond the squares."""
        low_m, high_m = outline_m.min(axis=0), outline_m.max(axis=0)
        margin_m = self._settings.margin * float((high_m - low_m).max())
        coarse = self._m_per_px
        while (
            float((high_m - low_m).max() + 2 * margin_m) / coarse > self._settings.most_patch_px - 2
        ):
            coarse *= 2
        (west, south), (east, north) = (
            np.floor((low_m - margin_m) / coarse),
            np.ceil((high_m + margin_m) / coarse),
        )
        window = PatchWindow(
            west * coarse, north * coarse, coarse, int(east - west), int(north - south)
        )
        size = window.height_px, window.width_px
        whole = Cut(
            np.zeros((*size, 4), np.uint8), np.zeros((*size, 4), np.uint8), np.zeros(size, np.uint8)
        )
        for key in self._around(low_m - margin_m, high_m + margin_m):
            own = self._window(key)
            rows, columns, part = window.part(own)
            if part.width_px > 0 and part.height_px > 0:
                there = Cut(
                    whole.before[rows, columns],
                    whole.after[rows, columns],
                    whole.shade[rows, columns],
                )
                joined = there.over(self._squares[key][0].moved(part, own))
                there.before[:], there.after[:], there.shade[:] = (
                    joined.before,
                    joined.after,
                    joined.shade,
                )
        return patch_of(window, whole, outline_m)

    def _window(self, key: tuple[int, int]) -> PatchWindow:
        side_m = self._side_m
        return PatchWindow(
            key[0] * side_m, (key[1] + 1) * side_m, self._m_per_px, *(self._settings.side_px,) * 2
        )

    def _around(self, low_m: PointsM, high_m: PointsM) -> Sequence[tuple[int, int]]:
        side_m = self._side_m
        first, last = np.floor(low_m / side_m), np.floor(high_m / side_m)
        return [
            key
            for key in sorted(self._squares)
            if first[0] <= key[0] <= last[0] and first[1] <= key[1] <= last[1]
        ]


def _squares_at(places: PointsM) -> list[tuple[int, int]]:
    """The squares, column and row, that hold any of these places, (N, 2) in sides of a square, column by column."""
    squares = np.floor(places).astype(int)
    first = squares.min(axis=0)
    columns, rows = (squares - first).T
    across = int(rows.max()) + 1
    found = np.divmod(
        np.unique(columns * across + rows), across
    )  # in a fraction of the time that pairs would take
    return [(int(column) + int(first[0]), int(row) + int(first[1])) for column, row in zip(*found)]
