"""The ground under a flight's views: which of it was compared with the map, why the rest was not, what could be found.

Ground is counted in square cells. A cell is compared when enough views compared it well; else the record names what
kept them from it. What no view was over is not part of it.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np

from sorvolo.change.ground import CHUNK, CellWindow, chunk_parts, window_around
from sorvolo.change.outlines import opened
from sorvolo.change.planting import (
    CONTRASTS,
    Planted,
    Sensitivity,
    are_enough,
    sensitivities,
    texture,
)
from sorvolo.geometry.arrays import Bytes, Floats, ImageRGB, Ints32, Mask, PointsM
from sorvolo.geometry.homography import apply_homography, resized
from sorvolo.geometry.polygons import union_of_boxes
from sorvolo.registration.features import sharpness
from sorvolo.survey.coverage import CoveredGround, Gap
from sorvolo.survey.findings import ComparedView

_MOST_REASONS = 250  # a byte holds which one


# When a view's ground counts as compared.
_CELL_M = 1.0  # a reader of coverage.geojson needs no finer
_LEAST_VIEWS = 2  # as the evidence: what one view alone shows is not announced
_BLACK = 14.0  # mean grey level of ground in whose shadow nothing can be seen
_LEAST_SHARPNESS = 0.5  # of the flight's usual one: a view with less is blurred
_BLACK_PX = 15  # over how many pixels that mean is taken
_DIFFERS = 0.5  # of the views that compared a cell flag it: it is changed, or not explained
_WIDENS = 1.0  # cells around a reported change that it explains: outlines are good to about one
# over which the roughness of ground is averaged: what differs from cell to cell is luck
_SMOOTH_CELLS = 7
_STEPS_M = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)  # in which sizes are written


class _Chunk:
    def __init__(self) -> None:
        self.clean = np.zeros((CHUNK, CHUNK), np.uint16)
        self.gaps = {gap: np.zeros((CHUNK, CHUNK), np.uint16) for gap in _COUNTED}
        self.differs = np.zeros((CHUNK, CHUNK), np.uint16)  # of the clean views
        self.rejected = np.zeros((CHUNK, CHUNK), np.uint8)  # which reason; 0 none
        self.texture = np.zeros((CHUNK, CHUNK), np.float32)  # summed over the clean views
        self.finest = np.full((CHUNK, CHUNK), np.inf, np.float32)  # m of a pixel


_COUNTED = (Gap.NO_MAP, Gap.DARK, Gap.LEANING, Gap.BLURRED)
_CLEAN = 255  # marks of a view's pixels: this, or 1 + the place in _COUNTED


class GroundCoverage:
    """The ground that a flight's views were over. `compare` and `reject` change it."""

    def __init__(self) -> None:
        self._chunks: dict[tuple[int, int], _Chunk] = {}
        self._reasons: list[str] = []
        self._sharpness: list[float] = []
        self._unknown: list[float] = []
        self._planted: list[Planted] = []
        self.unplaced = 0  # views that nobody knows the ground of

    def compare(
        self,
        view: ComparedView,
        *,
        is_dark: bool = False,
        doubted: Mask | None = None,
        planted: Sequence[Planted] = (),
    ) -> None:
        """Count a compared view. `doubted` (h, w) is what differs from the map and is contradicted by earlier pictures;
        `is_dark` that the whole flight is; `planted` what was found of things drawn into it."""
        self._planted.extend(planted)
        self._unknown.append(1.0 - float(view.valid.mean()))
        height, width = view.valid.shape
        window = window_around(view.outline_m, _CELL_M)
        cell_from_image = np.linalg.inv(window.site_from_cell(_CELL_M)) @ view.site_from_image
        size = window.shape[::-1]
        marks = self._marks(view, is_dark=is_dark, doubted=doubted)
        laid = cv2.warpPerspective(marks, cell_from_image, size, flags=cv2.INTER_NEAREST)
        changed = cv2.warpPerspective(view.changed, cell_from_image, size, flags=cv2.INTER_NEAREST)
        rough = texture(view)
        image_from_rough = resized(width / rough.shape[1], height / rough.shape[0])
        rough_laid = cv2.warpPerspective(
            rough,
            cell_from_image @ image_from_rough,
            size,
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for chunk, inside, part in self._pieces(window):
            mine = laid[part]
            is_clean = mine == _CLEAN
            chunk.clean[inside] += is_clean
            chunk.differs[inside] += is_clean & (changed[part] > 0)
            chunk.texture[inside] += np.where(is_clean, rough_laid[part], 0)
            finest = chunk.finest[inside]
            np.minimum(finest, view.m_per_px, out=finest, where=is_clean)
            for place, gap in enumerate(_COUNTED, 1):
                chunk.gaps[gap][inside] += mine == place

    def reject(self, outline_m: PointsM | None, gap: Gap, why: str) -> None:
        """Count a view that was not compared, with the ground (N, 2) under it as far as anyone knows."""
        if outline_m is None or not np.isfinite(outline_m).all():
            self.unplaced += 1
            return
        window = window_around(outline_m, _CELL_M)
        site_from_cell = window.site_from_cell(_CELL_M)
        under = np.zeros(window.shape, np.uint8)
        cells = apply_homography(np.linalg.inv(site_from_cell), outline_m)
        cv2.fillPoly(under, [np.rint(cells).astype(np.int32)], 1)
        number = 0 if gap in _COUNTED else self._number_of(why)
        for chunk, inside, part in self._pieces(window):
            if gap in _COUNTED:
                chunk.gaps[gap][inside] += under[part]
            else:
                chunk.rejected[inside][under[part] > 0] = number

    @property
    def unknown_share(self) -> float | None:
        """The mean share of a view that lay on unknown ground; None before the first view."""
        return float(np.mean(self._unknown)) if self._unknown else None

    @property
    def planted(self) -> Sequence[Planted]:
        """Everything that was drawn into the views."""
        return self._planted

    def parts(self, changes_m: Sequence[PointsM] = ()) -> list[CoveredGround]:
        """The ground in parts that were treated alike, compared ones first, each as large as it is. `changes_m` are the
        outlines, (N, 2) each, of what is reported: other ground that differs is not explained."""
        plain, faint = sensitivities(self._planted)[:2]
        runs: dict[tuple[int, int, int], list[tuple[float, float, float, float]]] = {}
        for (column, row), chunk in self._chunks.items():
            # (rows, columns) which cells of a chunk lie in a reported change, or beside it.
            cells = np.zeros((CHUNK, CHUNK), np.uint8)
            wide = 1 + 2 * round(_WIDENS)
            for outline_m in changes_m:
                at = outline_m * [1, -1] / _CELL_M - [column * CHUNK, row * CHUNK] - 0.5
                if (at.max(axis=0) > -wide).all() and (at.min(axis=0) < CHUNK + wide).all():
                    corners = np.rint(at).astype(np.int32)
                    cv2.fillPoly(cells, [corners], 1)
                    cv2.polylines(cells, [corners], isClosed=True, color=1, thickness=wide)
            explained = cells > 0
            labels = self._labels(chunk, explained, plain, faint)
            for label, x0, x1, y in _runs(labels):
                west, north = (column * CHUNK + x0) * _CELL_M, -(row * CHUNK + y) * _CELL_M
                east = (column * CHUNK + x1) * _CELL_M
                runs.setdefault(label, []).append((west, north - _CELL_M, east, north))
        parts = [self._part(label, np.array(boxes)) for label, boxes in runs.items()]
        return sorted(parts, key=lambda each: (each.gap is not None, str(each.gap), -each.area_m2))

    # ---- inside -----------------------------------------------------------------------------------------------

    def _part(self, label: tuple[int, int, int], boxes: Floats) -> CoveredGround:
        kind, first, second = label
        area_m2 = float(((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])).sum())
        polygons = tuple(tuple(rings) for rings in union_of_boxes(boxes))
        if kind == _CLEAN:
            return CoveredGround(
                polygons, area_m2, None, "", self._step_m(first), self._step_m(second)
            )
        gap = list(Gap)[kind]
        why = self._reasons[first - 1] if gap is Gap.REJECTED else ""
        return CoveredGround(polygons, area_m2, gap, why, np.nan, np.nan)

    def _labels(
        self, chunk: _Chunk, explained: Mask, plain: Sensitivity, faint: Sensitivity
    ) -> Ints32:
        """(rows, columns, 3): the class, and of compared ground the steps of both sizes, of rejected the reason."""
        classes = self._classes(chunk, explained)
        labels = np.zeros((*classes.shape, 3), np.int32)
        labels[..., 0] = classes
        labels[classes == list(Gap).index(Gap.REJECTED), 1] = chunk.rejected[
            classes == list(Gap).index(Gap.REJECTED)
        ]
        clean = classes == _CLEAN
        if clean.any() and self._planted:
            near = np.dstack([chunk.texture * clean, chunk.clean * clean]).astype(np.float32)
            rough = np.divide(*cv2.blur(near, (_SMOOTH_CELLS,) * 2)[clean].T)
            sizes_m = [each.smallest_px(rough) * chunk.finest[clean] for each in (plain, faint)]
            labels[clean, 1], labels[clean, 2] = (self._step_of(each) for each in sizes_m)
            labels[clean, 0] = np.where(
                plain.is_blind(rough), list(Gap).index(Gap.INSENSITIVE), _CLEAN
            )
            labels[labels[..., 0] == list(Gap).index(Gap.INSENSITIVE), 1:] = 0
        return labels

    def _step_of(self, sizes_m: Floats) -> Ints32:
        """1 + the place of the next larger step; 0 where the size is not known or larger than all."""
        place = np.searchsorted(_STEPS_M, np.nan_to_num(sizes_m, nan=np.inf))
        return np.where(place < len(_STEPS_M), place + 1, 0).astype(np.int32)

    def _step_m(self, number: int) -> float:
        return _STEPS_M[number - 1] if number else float("nan")

    def _classes(self, chunk: _Chunk, explained: Mask) -> Ints32:
        """(rows, columns): `_CLEAN`, the place of a gap among all, or -1 where no view was."""
        names = list(Gap)
        clean = chunk.clean.astype(np.int32)
        hidden = np.stack([chunk.gaps[gap] for gap in (Gap.DARK, Gap.LEANING, Gap.BLURRED)]).astype(
            np.int32
        )
        classes = np.full(clean.shape, -1, np.int32)
        classes[chunk.rejected > 0] = names.index(Gap.REJECTED)
        classes[chunk.gaps[Gap.NO_MAP] > 0] = names.index(Gap.NO_MAP)
        classes[clean > 0] = names.index(Gap.ONE_VIEW)
        most = np.array([names.index(gap) for gap in (Gap.DARK, Gap.LEANING, Gap.BLURRED)])[
            hidden.argmax(axis=0)
        ]
        classes = np.where(hidden.sum(axis=0) > 0, most, classes)
        is_compared = (clean >= _LEAST_VIEWS) & (clean >= hidden.sum(axis=0))
        classes = np.where(is_compared, _CLEAN, classes)
        differs = is_compared & ~explained & (chunk.differs >= _DIFFERS * clean)
        return np.where(opened(differs), names.index(Gap.UNEXPLAINED), classes)

    def _marks(self, view: ComparedView, *, is_dark: bool, doubted: Mask | None) -> Bytes:
        """A view's pixels, (h, w): 255 compared, else 1 + the place of what kept it from that; 0 where it sees nothing."""

        def mark(gap: Gap) -> int:
            return 1 + _COUNTED.index(gap)

        marks = np.full(view.valid.shape, _CLEAN, np.uint8)
        gray = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
        is_black = np.minimum(*(_mean_grey(each) for each in (view.image, view.reference)))
        marks[is_black < _BLACK] = mark(Gap.DARK)
        if doubted is not None:
            marks[doubted] = mark(Gap.LEANING)
        self._sharpness.append(sharpness(np.asarray(gray, np.uint8)))
        if self._sharpness[-1] < _LEAST_SHARPNESS * float(np.median(self._sharpness)):
            marks[:] = mark(Gap.BLURRED)
        if is_dark:
            marks[:] = mark(Gap.DARK)
        marks[~view.valid] = mark(Gap.NO_MAP)
        if doubted is not None:
            marks[doubted & ~view.valid] = mark(Gap.LEANING)
        return marks

    def _number_of(self, why: str) -> int:
        if why not in self._reasons and len(self._reasons) < _MOST_REASONS:
            self._reasons.append(why)
        return 1 + self._reasons.index(why) if why in self._reasons else _MOST_REASONS

    def _pieces(
        self, window: CellWindow
    ) -> Iterator[tuple[_Chunk, tuple[slice, slice], tuple[slice, slice]]]:
        """Chunks, what of them lies in a window, and where that is in the window's raster."""
        for key, inside, part in chunk_parts(window):
            yield self._chunks.setdefault(key, _Chunk()), inside, part


def coverage_summary(
    parts: Sequence[CoveredGround], unplaced: int, planted: Sequence[Planted] = ()
) -> dict[str, Any]:
    """The areas as a report has them; `smallest_m` is what is found on half of the compared ground, `faint_m` too.

    `large_found` is the share found of plain things of the largest size that was drawn, None where too few were drawn
    to know; `faint_known` whether enough faint ones were.
    """
    plain_known, faint_known = (are_enough(planted, contrast) for contrast in CONTRASTS[:2])
    compared = [each for each in parts if each.gap is None]
    gaps_m2 = _gaps_m2(parts)
    compared_m2, missing_m2 = sum(each.area_m2 for each in compared), sum(gaps_m2.values())
    on_map_m2 = compared_m2 + missing_m2 - gaps_m2.get(Gap.NO_MAP.value, 0.0)
    return {
        "compared_m2": compared_m2,
        "not_compared_m2": missing_m2,
        "gaps_m2": gaps_m2,
        "views_without_a_place": unplaced,
        "smallest_m": _middle([(each.smallest_m, each.area_m2) for each in compared]),
        "faint_m": _middle([(each.faint_m, each.area_m2) for each in compared]),
        "large_found": _large_found(planted) if plain_known else None,
        "faint_known": faint_known,
        "is_enough": compared_m2 >= 0.5 * on_map_m2 and compared_m2 > 0,
    }


def _gaps_m2(parts: Sequence[CoveredGround]) -> dict[str, float]:
    """The ground that was not compared by reason, the largest part first."""
    areas_m2 = {gap.value: sum(each.area_m2 for each in parts if each.gap is gap) for gap in Gap}
    return {
        name: area for name, area in sorted(areas_m2.items(), key=lambda item: -item[1]) if area
    }


def _large_found(planted: Sequence[Planted]) -> float | None:
    """The share found of the largest and plainest things; None where nothing was planted."""
    largest = max(((each.contrast, each.size_px) for each in planted), default=None)
    found = [each.found for each in planted if (each.contrast, each.size_px) == largest]
    return float(np.mean(found)) if found else None


def _middle(sizes: Sequence[tuple[float, float]]) -> float | None:
    """The size that half of the ground has or a smaller one; None where half of the ground has none."""
    total, covered = sum(area for _, area in sizes), 0.0
    for size_m, area in sorted(each for each in sizes if np.isfinite(each[0])):
        covered += area
        if 2 * covered >= total:
            return size_m
    return None


def _runs(labels: Ints32) -> Iterator[tuple[tuple[int, int, int], int, int, int]]:
    """The label, first column, last column + 1 and row of each run of cells that are alike; not where no view was."""
    for y, row in enumerate(labels):
        starts = np.flatnonzero(np.r_[True, (row[1:] != row[:-1]).any(axis=1)])
        for start, end in zip(starts, np.r_[starts[1:], len(row)]):
            if row[start, 0] >= 0:
                kind, first, second = (int(each) for each in row[start])
                yield (kind, first, second), int(start), int(end), y


def _mean_grey(image: ImageRGB) -> Bytes:
    return np.asarray(
        cv2.blur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (_BLACK_PX, _BLACK_PX)), np.uint8
    )
