"""What all views of a flight together show, things and areas: learned differences gathered over its views."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np

from sorvolo.change.ground import GroundSums
from sorvolo.change.kinds import kind_of
from sorvolo.change.learned import learned_difference
from sorvolo.change.outlines import mask_of, measures, outline_of, overlap, place_sigma_m
from sorvolo.geometry.arrays import Bytes, Floats, Floats32, Mask, PointsM
from sorvolo.geometry.homography import apply_homography, resized
from sorvolo.survey.findings import Change, ChangeKind, ComparedView, Shade

_SUMS = ("seen", "apart", "agree", "came", "left")
_SHADES = {
    "came": Shade.LATER_DARK,
    "left": Shade.EARLIER_DARK,
}  # shade of the later date alone, of the earlier alone
_APART = (
    ChangeKind.MOVING,
    ChangeKind.AREA,
)  # what moves is no thing of the ground, and an area is more than one
_HIGHEST = 95.0  # percentile of what lies farthest apart
_CIRCLE = np.column_stack(
    [wave(np.linspace(0, 2 * np.pi, 24, endpoint=False)) for wave in (np.cos, np.sin)]
)


# Which gathered ground is a thing. Spreads: see `learned_difference`.
_CELL_PX = 3  # a cell's side, in pixels of the views
# of the raster, which bounds its memory (190 MB): views beyond are left out
_MOST_CELLS = 12_000_000
_LEAST_VIEWS = 2  # what one view alone shows is not announced
_SPREADS = 1.0  # by which the views of a cell lie apart on the mean
_IN_AREA = 0.7  # the same of a thing that stands out within an area, and is a region already
_OF_HEIGHT = 0.6  # its outline runs where this part of what lies farthest apart in it is left
_OWN_SPREADS = 0.5  # from which on a view by itself agrees
_LEAST_CELLS = 44  # smaller things are found by their outline
_MOST_OF_CELLS = 2000  # larger ground is an area
_MOST_DARK = 0.7  # share of it that is darker on one date as in a shadow: it may be one
_IS_MOVED = 0.6  # share of an outline that is shade, and of it that lies on the other date's, moved
# what may throw a moved shadow; of higher things too many shades lie along the way
_TALLEST_M = 5.0
_SURE_SPREADS = 1.8  # what lies so far apart is sure
_HELD = 0.3  # share of another change that things hold: it is reported as they are
_LEAST_APART = 0.4  # spreads; ground of another change that lies less apart is the same
_LEAST_OF_OBJECT = 0.2  # spreads; an object that one date alone shows is evidence of its own


# Which gathered ground is an area. Lengths in cells of views of the small size.
_SMALL_PX = 384  # longest side at which views are looked at for areas alone: areas are large
_AREA_SPREADS = 0.6  # by which the views of a cell lie apart on the mean
_GAP_CELLS = 5  # a square of so many cells closes gaps, and cuts bridges
# an area's size: of a view 140 m wide 85 m2; smaller things are found by their outline
_LEAST_AREA_CELLS = 70
# nor smaller, however low the flight: a car has 8 m2, what leans beside a roof 5 to 10
_LEAST_AREA_M2 = 25.0
_AGREEING_VIEWS = 2.5  # on the mean that show an area by themselves: two may lean alike
_AGREEING_SHARE = 0.5  # of the views of an area's ground, each by itself
_LEAST_AREA_SCORE = 0.3  # 0 to 1


class GatheredGround:
    """What a flight's views show together. Only `add` changes it.

    Views are looked at `larger` times as large; at a small size, where areas alone are asked, with `larger` None.
    """

    def __init__(self, larger: float | None = None) -> None:
        self._larger = larger
        self._ground = GroundSums(_SUMS, _MOST_CELLS)
        self._cells_of_area = 1

    def add(self, view: ComparedView, leans: Mask | None = None) -> None:
        """Take in one view, of which earlier pictures show that some ground `leans` (h, w)."""
        height, width = view.valid.shape
        small = min(1.0, _SMALL_PX / max(height, width))
        times = small if self._larger is None else self._larger
        if self._ground.is_empty:
            self._cells_of_area = max(1, round(times / small))
        m_per_px = view.m_per_px / times
        window = self._ground.window_of(view, _CELL_PX * m_per_px, min(m_per_px, view.m_per_px))
        if window is None:
            return
        size = round(width * times), round(height * times)
        known = _laid(view.valid.view(np.uint8), size, cv2.INTER_NEAREST) > 0
        before, after = (
            np.ascontiguousarray(
                _laid(each, size, cv2.INTER_CUBIC if times > 1 else cv2.INTER_AREA)[..., ::-1]
            )
            for each in (view.reference, view.image)
        )
        apart = learned_difference(before, after, known)
        if leans is not None:
            leaning = _laid(leans.view(np.uint8), size, cv2.INTER_NEAREST) > 0
            apart[leaning] = np.minimum(apart[leaning], 0)
        shade = _laid(view.shade, size, cv2.INTER_NEAREST)
        planes = {
            "apart": apart,
            "agree": (apart > _OWN_SPREADS).astype(np.float32),
            **{
                name: ((shade & np.uint8(bit)) > 0).astype(np.float32)
                for name, bit in _SHADES.items()
            },
        }
        site_from_planes = view.site_from_image @ resized(width / size[0], height / size[1])
        laid = self._ground.add(view, window, site_from_planes, planes, known.astype(np.float32))
        self._ground.show(view, window, laid["apart"] > _AREA_SPREADS)

    def shows_once(self, outline_m: PointsM) -> bool:
        """Whether one view alone saw most of an outline's ground, (N, 2), and lies as far apart there as a view must
        to agree by itself, and not as in a shadow."""
        sums = self._ground.sums
        if self._ground.is_empty:
            return False
        site_from_cell = self._ground.window.site_from_cell(self._ground.cell_m)
        own = mask_of(outline_m, site_from_cell, self._ground.window.shape) & (sums["seen"] > 0)
        if not own.any() or np.median(sums["seen"][own]) > 1:
            return False
        apart, came, left = (
            float((sums[name][own] / sums["seen"][own]).mean()) for name in ("apart", *_SHADES)
        )
        return apart >= _OWN_SPREADS and came + left <= _MOST_DARK

    def lies_apart(self, outline_m: PointsM) -> bool:
        """Whether an outline's ground, (N, 2), differs on the mean as much as a thing within an area must."""
        return self._mean_apart(*self._around(outline_m)) > _IN_AREA

    def standing_at(
        self, place_m: Floats, length_m: float, others: Sequence[Change]
    ) -> Change | None:
        """What an object of this length at a place (2,) changed, a change without an id: the ground within half
        a length that lies farthest apart. None where `others` hold it, or two views did not see it, or its ground is
        the same by its features."""
        around_m = place_m + 0.5 * length_m * _CIRCLE
        part, own = self._around(around_m)
        own &= self._ground.sums["seen"][part] >= _LEAST_VIEWS
        if not self._mean_apart(part, own) >= _LEAST_OF_OBJECT:
            return None
        standing = [each.outline_m for each in others if each.kind not in _APART]
        if any(
            max(overlap(around_m, each)[1], overlap(each, around_m)[1]) >= _HELD
            for each in standing
        ):
            return None
        apart = self._ground.sums["apart"][part] / np.maximum(self._ground.sums["seen"][part], 1)
        own &= apart > _OF_HEIGHT * float(np.percentile(apart[own], _HIGHEST))
        change = self._record(own, (part[1].start, part[0].start), 1.0)
        if change is None:
            return None
        lit = np.zeros_like(
            change.patch.shade
        )  # what is dark in its outline is the object, not its shadow
        return replace(change, patch=replace(change.patch, shade=lit))

    def is_moved_shadow(self, outline_m: PointsM, earlier: Floats, later: Floats) -> bool:
        """Whether an outline's ground, (N, 2), is shade of one date, and shade of the other lies where what stays
        threw it; the shadow of a point 1 m up lies (2,) off, east and north: `earlier` and `later`."""
        slide = earlier - later
        part, own = self._around(outline_m, float(np.abs(slide).max()) * _TALLEST_M)
        if not own.any():
            return False
        step = slide * [1, -1] / self._ground.cell_m
        seen = np.maximum(self._ground.sums["seen"][part], 1)
        shades = {name: self._ground.sums[name][part] > 0.5 * seen for name in _SHADES}
        for name, other, along in (("came", "left", step), ("left", "came", -step)):
            shade = own & shades[name]
            if np.count_nonzero(shade) > _IS_MOVED * np.count_nonzero(own):
                return _share_moved(shade, shades[other], along) > _IS_MOVED
        return False

    def _around(
        self, outline_m: PointsM, margin_m: float = 0.0
    ) -> tuple[tuple[slice, slice], Mask]:
        """The part of the raster around an outline, (N, 2), and which cells of it are the outline's and were seen."""
        if self._ground.is_empty:
            return np.s_[:0, :0], np.zeros((0, 0), bool)
        site_from_cell = self._ground.window.site_from_cell(self._ground.cell_m)
        at, margin = (
            apply_homography(np.linalg.inv(site_from_cell), outline_m),
            margin_m / self._ground.cell_m + 1,
        )
        (left, top), (right, low) = (
            (at.min(axis=0) - margin).astype(int).clip(0),
            (at.max(axis=0) + margin).astype(int),
        )
        part = np.s_[top : max(low, top), left : max(right, left)]
        seen = self._ground.sums["seen"][part] > 0
        if not seen.any():
            return part, seen
        own = mask_of(
            outline_m,
            site_from_cell @ np.array([[1, 0, left], [0, 1, top], [0, 0, 1.0]]),
            seen.shape,
        )
        return part, own & seen

    def conclude(
        self, id_prefix: str, numbers: Iterator[int], others: Sequence[Change]
    ) -> list[Change]:
        """After the last view: the things that all views together show, and those of `others` that they do not hold.

        A change inherits id and times of the one it overlaps most; others get the next of `numbers`. Left out is also, of `others`, what lies on ground that is the same by its features.
        What moves and areas are left as they are.
        """
        if self._ground.is_empty:
            return list(others)
        things = list(self._things())
        holders = np.zeros(self._ground.window.shape, np.int32)
        for place, thing in enumerate(things, 1):
            part, own = self._around(thing.outline_m)
            holders[part][own] = place
        kept: list[Change] = []
        held: dict[int, tuple[int, Change]] = {}
        for each in others:
            part, own = self._around(each.outline_m)
            cells = holders[part][own]
            in_things = cells[cells > 0]
            if each.kind in _APART or not len(cells):
                kept.append(each)
            elif len(in_things) >= _HELD * len(cells):
                place = int(np.bincount(in_things).argmax())
                held[place] = max(
                    held.get(place, (0, each)), (len(in_things), each), key=lambda of: of[0]
                )
            elif self._mean_apart(part, own) >= _LEAST_APART:
                kept.append(each)
        return kept + [
            _going_on(thing, held[place][1])
            if place in held
            else replace(thing, id=f"{id_prefix}-{next(numbers)}")
            for place, thing in enumerate(things, 1)
        ]

    def _mean_apart(self, part: tuple[slice, slice], own: Mask) -> float:
        """By how much some cells of a part of the raster lie apart on the mean, in spreads; NaN for no cells."""
        seen, apart = (self._ground.sums[name][part][own] for name in ("seen", "apart"))
        return float((apart / seen).mean()) if len(seen) else float("nan")

    def _things(self) -> Iterator[Change]:
        """Connected ground that lies apart, without an id."""
        mean = self._means(1)
        for own, corner in _pieces_of(mean["apart"] > _SPREADS, 1, 3, _LEAST_CELLS):
            part = _part_at(corner, own)
            height = _OF_HEIGHT * float(np.percentile(mean["apart"][part][own], _HIGHEST))
            own &= mean["apart"][part] > height
            if not _LEAST_CELLS <= np.count_nonzero(own) <= _MOST_OF_CELLS:
                continue
            apart, agree, came, left = (float(mean[name][part][own].mean()) for name in _SUMS[1:])
            change = self._record(own, corner, agree * min(1.0, apart / _SURE_SPREADS))
            if change is not None and came + left <= _MOST_DARK:
                yield change

    def areas(self, id_prefix: str, first_number: int) -> tuple[Change, ...]:
        """After the last view: all areas, the largest first, numbered from `first_number` on."""
        if self._ground.is_empty:
            return ()
        times = self._cells_of_area
        mean, cell_m = self._means(times), self._ground.cell_m * times
        least = max(_LEAST_AREA_CELLS, _LEAST_AREA_M2 / cell_m**2)
        found = []
        for own, corner in _pieces_of(mean["apart"] > _AREA_SPREADS, _GAP_CELLS, _GAP_CELLS, least):
            part = _part_at(corner, own)
            apart, agree = (float(mean[name][part][own].mean()) for name in ("apart", "agree"))
            score = agree * min(1.0, apart / _SURE_SPREADS)
            views = agree * float(mean["seen"][part][own].mean())
            change = self._record(own, corner, score, times)
            is_shown = agree >= _AGREEING_SHARE and views >= _AGREEING_VIEWS
            if change is not None and is_shown and score >= _LEAST_AREA_SCORE:
                area_m2 = float(np.count_nonzero(own)) * cell_m**2
                found.append(replace(change, kind=ChangeKind.AREA, area_m2=area_m2))
        found.sort(key=lambda each: -each.area_m2)
        return tuple(
            replace(each, id=f"{id_prefix}-{first_number + place}")
            for place, each in enumerate(found)
        )

    def _means(self, times: int) -> dict[str, Floats32]:
        """How many views saw the cells, each `times` times as wide as the raster's, and the means of the other sums;
        of ground that too few saw, nothing."""
        rows, columns = (side // times for side in self._ground.window.shape)
        sums = {
            name: np.asarray(
                cv2.resize(
                    each[: rows * times, : columns * times],
                    (columns, rows),
                    interpolation=cv2.INTER_AREA,
                ),
                np.float32,
            )
            for name, each in self._ground.sums.items()
        }
        seen = sums.pop("seen")
        return {"seen": seen} | {
            name: np.where(seen >= _LEAST_VIEWS, each / np.maximum(seen, 1), 0)
            for name, each in sums.items()
        }

    def _record(
        self, cells: Mask, corner: tuple[int, int], score: float, times: int = 1
    ) -> Change | None:
        """The record of some cells, (h, w) from a corner on, each `times` times as wide as the raster's."""
        cell_m = self._ground.cell_m * times
        own_from_cells = np.array([[1, 0, corner[0]], [0, 1, corner[1]], [0, 0, 1.0]])
        site_from_cell = self._ground.window.site_from_cell(self._ground.cell_m)
        outline_m = outline_of(
            cells, site_from_cell @ resized(times, times) @ own_from_cells, 0.5, 1.0
        )
        if outline_m is None:
            return None
        patch, size = self._ground.patch(outline_m), measures(outline_m)
        sigma_m = place_sigma_m(self._ground.residual_m, np.sqrt(12) * cell_m, 0.0)
        rows, columns = ((np.array(np.nonzero(cells)).T + corner[::-1]) * times).T
        views = float(self._ground.sums["agree"][rows, columns].mean())
        return Change(
            "",
            kind_of(patch),
            score,
            outline_m,
            *self._ground.span_ns,
            max(round(views), 1),
            size.area_m2,
            size.length_m,
            sigma_m,
            patch,
        )


def _laid(picture: Bytes, size: tuple[int, int], how: int) -> Bytes:
    return np.asarray(cv2.resize(picture, size, interpolation=how), np.uint8)


def _going_on(thing: Change, known: Change) -> Change:
    """A thing as the change that is known already, perhaps to those who follow the flight."""
    return replace(
        thing,
        id=known.id,
        first_seen_ns=known.first_seen_ns,
        last_seen_ns=known.last_seen_ns,
        announced_ns=known.announced_ns,
    )


def _share_moved(own: Mask, other: Mask, step: Floats) -> float:
    """The greatest share of a shade, `own` (h, w), that lies on the `other` date's shade when it is moved by a multiple
    up to `most` of `step`, (2,) columns and rows."""
    rows, columns = np.nonzero(own)
    longest = float(np.abs(step).max()) * _TALLEST_M
    if not len(rows) or longest < 1:
        return 0.0
    best = 0
    for times in np.arange(1.0, longest + 1) / longest * _TALLEST_M:
        x, y = (
            np.rint(each + times * along).astype(int)
            for each, along in ((columns, step[0]), (rows, step[1]))
        )
        inside = (x >= 0) & (y >= 0) & (x < other.shape[1]) & (y < other.shape[0])
        best = max(best, int(np.count_nonzero(other[y[inside], x[inside]])))
    return best / len(rows)


def _pieces_of(
    differs: Mask, gap: int, bridge: int, least: float
) -> Iterator[tuple[Mask, tuple[int, int]]]:
    """The connected pieces of cells, and the corner, column and row, of each: gaps as wide as `gap` cells closed,
    bridges as wide as `bridge` cut, of `least` cells."""
    closed = cv2.morphologyEx(
        differs.view(np.uint8), cv2.MORPH_CLOSE, np.ones((gap, gap), np.uint8)
    )
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((bridge, bridge), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    for label in range(1, count):
        x, y, wide, high, cells = (int(each) for each in stats[label])
        if cells >= least:
            yield labels[y : y + high, x : x + wide] == label, (x, y)


def _part_at(corner: tuple[int, int], cells: Mask) -> tuple[slice, slice]:
    (x, y), (high, wide) = corner, cells.shape
    return slice(y, y + high), slice(x, x + wide)
