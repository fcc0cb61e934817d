"""Things that all views of a flight together show: learned differences gathered over its views."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np

from sorvolo.change.ground import GroundSums
from sorvolo.change.kinds import kind_of
from sorvolo.change.learned import learned_difference
from sorvolo.change.outlines import mask_of, measures, opened, outline_of, overlap, place_sigma_m
from sorvolo.geometry.arrays import Floats, ImageGray, ImageRGB, Mask, PointsM
from sorvolo.geometry.homography import apply_homography, resized, shifted
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
_SURE_SPREADS = 1.8  # what lies so far apart is sure
_HELD = 0.3  # share of another change that things hold: it is reported as they are
_LEAST_APART = 0.4  # spreads; ground of another change that lies less apart is the same
_LEAST_OF_OBJECT = 0.2  # spreads; an object that one date alone shows is evidence of its own


class GatheredThings:
    """What a flight's views show together. Only `add` changes it. Views are looked at `larger` times as large."""

    def __init__(self, larger: float = 1.0) -> None:
        self._larger = larger
        self._ground = GroundSums(_SUMS, _MOST_CELLS)

    def add(self, view: ComparedView, leans: Mask | None = None) -> None:
        """Take in one view, of which earlier pictures show that some ground `leans` (h, w)."""
        m_per_px = view.m_per_px / self._larger
        window = self._ground.window_of(view, _CELL_PX * m_per_px, m_per_px)
        if window is None:
            return
        if self._larger > 1:
            view, leans = _enlarged(view, leans, self._larger)
        before, after = (
            np.ascontiguousarray(each[..., ::-1]) for each in (view.reference, view.image)
        )
        apart = learned_difference(before, after, view.valid)
        if leans is not None:
            apart[leans] = np.minimum(apart[leans], 0)
        planes = {
            "apart": apart,
            "agree": (apart > _OWN_SPREADS).astype(np.float32),
            **{
                name: ((view.shade & np.uint8(bit)) > 0).astype(np.float32)
                for name, bit in _SHADES.items()
            },
        }
        laid = self._ground.add(
            view, window, view.site_from_image, planes, view.valid.astype(np.float32)
        )
        self._ground.show(view, window, laid["apart"] > _SPREADS)

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

    def _around(self, outline_m: PointsM) -> tuple[tuple[slice, slice], Mask]:
        """The part of the raster around an outline, (N, 2), and which cells of it are the outline's and were seen."""
        if self._ground.is_empty:
            return np.s_[:0, :0], np.zeros((0, 0), bool)
        site_from_cell = self._ground.window.site_from_cell(self._ground.cell_m)
        at = apply_homography(np.linalg.inv(site_from_cell), outline_m)
        (left, top), (right, low) = (
            (at.min(axis=0) - 1).astype(int).clip(0),
            (at.max(axis=0) + 1).astype(int),
        )
        part = np.s_[top : max(low, top), left : max(right, left)]
        seen = self._ground.sums["seen"][part] > 0
        if not seen.any():
            return part, seen
        own = mask_of(
            outline_m,
            site_from_cell @ shifted(left, top),
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
        sums = self._ground.sums
        seen = np.maximum(sums["seen"], 1)
        mean = {name: sums[name] / seen for name in _SUMS[1:]}
        differs = (sums["seen"] >= _LEAST_VIEWS) & (mean["apart"] > _SPREADS)
        whole = opened(differs).view(np.uint8)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(whole, connectivity=4)
        for label in range(1, count):
            x, y, wide, high, cells = (int(each) for each in stats[label])
            if cells < _LEAST_CELLS:
                continue
            part = np.s_[y : y + high, x : x + wide]
            own = labels[part] == label
            height = _OF_HEIGHT * float(np.percentile(mean["apart"][part][own], _HIGHEST))
            own &= mean["apart"][part] > height
            if not _LEAST_CELLS <= np.count_nonzero(own) <= _MOST_OF_CELLS:
                continue
            apart, agree, came, left = (float(mean[name][part][own].mean()) for name in _SUMS[1:])
            change = self._record(own, (x, y), agree * min(1.0, apart / _SURE_SPREADS))
            if change is not None and came + left <= _MOST_DARK:
                yield change

    def _record(self, cells: Mask, corner: tuple[int, int], score: float) -> Change | None:
        cell_m = self._ground.cell_m
        cell_from_own = shifted(*corner)
        outline_m = outline_of(
            cells, self._ground.window.site_from_cell(cell_m) @ cell_from_own, 0.5, 1.0
        )
        if outline_m is None:
            return None
        patch, size = self._ground.patch(outline_m), measures(outline_m)
        rows, columns = np.nonzero(cells)
        sigma_m = place_sigma_m(self._ground.residual_m, np.sqrt(12) * cell_m, 0.0)
        views = float(self._ground.sums["agree"][rows + corner[1], columns + corner[0]].mean())
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


def _enlarged(
    view: ComparedView, leans: Mask | None, times: float
) -> tuple[ComparedView, Mask | None]:
    """A view, and what leans in it, with more pixels."""
    height, width = view.valid.shape
    size = round(width * times), round(height * times)
    x, y = size[0] / width, size[1] / height

    def picture(image: ImageRGB) -> ImageRGB:
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)

    def mask(values: Mask) -> Mask:
        return cv2.resize(values.view(np.uint8), size, interpolation=cv2.INTER_NEAREST).view(bool)

    def levels(values: ImageGray) -> ImageGray:
        return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_NEAREST), np.uint8)

    large = replace(
        view,
        site_from_image=view.site_from_image @ resized(1 / x, 1 / y),
        image=picture(view.image),
        reference=picture(view.reference),
        valid=mask(view.valid),
        changed=levels(view.changed),
        boxes=np.rint(view.boxes * np.array([x, y, x, y])).astype(view.boxes.dtype),
        residual_px=view.residual_px * times,
        shade=levels(view.shade),
    )
    return large, None if leans is None else mask(leans)


def _going_on(thing: Change, known: Change) -> Change:
    """A thing as the change that is known already, perhaps to those who follow the flight."""
    return replace(
        thing,
        id=known.id,
        first_seen_ns=known.first_seen_ns,
        last_seen_ns=known.last_seen_ns,
        announced_ns=known.announced_ns,
    )
