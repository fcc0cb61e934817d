"""Changes of the ground collected over views: what persists at one place on the ground is told, once.

The ground is divided into small cells; each keeps what the last n views that saw it said. A ghost of something tall
lies elsewhere on the ground from each place of the camera, moving leaves flicker, noise does not come back: none of
them gathers k votes out of n in the same cell. Unknown ground says nothing, neither for nor against.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sorvolo.change.evidence.candidate import GatheredChange, joined
from sorvolo.change.evidence.cells import (
    CellEvidence,
    CellGrid,
    CellWindow,
    lay,
    pieces,
)
from sorvolo.change.evidence.restlessness import calmness, restlessness
from sorvolo.change.evidence.seeds import SHOWS, KeptView, Seeds
from sorvolo.change.motion.blob_tracker import BlobTracker, MovingSettings
from sorvolo.change.motion.moving_changes import Movers
from sorvolo.change.shape.parts import Parts
from sorvolo.change.shape.shadows import is_of_shade
from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, Mask
from sorvolo.survey.findings import Change, ComparedView

_CELL_PX = 3
_LEAST_CELL_M = 0.05
_LASTING = 0.3  # share of all views that must flag a cell
_PICTURES_A_VIEW, _MOST_PICTURES = 6, 30  # cut anew at most, which bounds the time a view takes ...
_VIEWS_S = 5.0  # ... where so many come in a second; where they are seldom there is more time
_FEW_VIEWS_SCORE = 0.62  # of what fewer than k views show: two views of a tree often agree
_LARGE_M2, _LARGE_SCORE = 2.0, 0.52  # what is larger and less sure is a wall that leans, unless it is snow
_DOUBT = 2.0  # restless ground counts in full where half of the score is missing
_MOSTLY_THERE = 0.45  # of the views that see it, whatever they count, must show a change: else something passed by
_MANY_VIEWS = 16  # that agree: no chance, whatever the ground around does
_CALM = 0.9  # of the score is left on calm ground
_MOVED_HEIGHTS = 0.01  # the camera's way, in flying heights, after which a view is a new witness
_ALL_CHANGED = 0.5  # share of the frame beyond which nothing in it can be followed
_PASSING, _PASSING_VIEWS = 0.5, 8  # flagged in so much smaller a share of at least so many views than ...
_SUREST = 97  # ... the surest of a change's cells, in per cent of them, cells are no part of it
_NEARLY_ALL, _MOST_STAY = 0.8, 0.6  # of the views that see a cell; of the cells that any view flagged
_GONE_VIEWS = 2  # that saw the ground without it
_STANDS_S = 2.0  # what the same ground shows for so long stands there, however unsteady its blobs look


@dataclass(frozen=True)
class EvidenceSettings:
    """When a change is told."""

    k: int = 3  # views that must show it ...
    n: int = 5  # ... of the last ones that saw its ground
    least_views: int = 2  # where fewer than n ever see it
    least_views_apart_s: float = 0.1  # frames nearer in time see the same thing and say nothing new
    least_share: float = 0.4  # of all views of its ground must show it, those from above counting most
    least_score: float = 0.38  # less sure, it is kept but not told
    least_area_m2: float = 0.02
    join_m: float = 0.3  # a smaller gap does not make two things of one
    single_view_score: float = 2.0  # a single view's change this sure is told at the end; above 1: never
    moving: MovingSettings = field(default_factory=MovingSettings)

    def __post_init__(self) -> None:
        if not 1 <= self.k <= self.n <= 8:
            raise SettingsError(f"evidence needs 1 <= k <= n <= 8 views, got k = {self.k}, n = {self.n}")
        if not 1 <= self.least_views <= self.k:
            raise SettingsError(f"least_views must lie in 1 to k = {self.k}, got {self.least_views}")
        if not (0 <= self.least_share <= 1 and 0 <= self.least_score <= 1):
            raise SettingsError(
                f"least_share and least_score must lie in 0 to 1, got {self.least_share} and {self.least_score}"
            )
        if min(self.least_views_apart_s, self.least_area_m2, self.join_m) < 0:
            raise SettingsError("times, areas and gaps of the evidence must not be negative")


class EvidenceMap:
    """The changes of one flight while its views come in. `add` changes it; `conclude` says the last word.

    `m_per_px` is a pixel of changes' pictures, `id_prefix` begins every change's id: the flight's name. Views must come
    in order of time; the same views give the same changes and ids.
    """

    def __init__(self, m_per_px: float, settings: EvidenceSettings, id_prefix: str) -> None:
        self._settings, self._prefix = settings, id_prefix
        self._m_per_px = m_per_px
        self._cell_m = max(_LEAST_CELL_M, _CELL_PX * m_per_px)
        self._join_m = max(settings.join_m, 3 * self._cell_m) if settings.join_m else 0.0
        self._gap = int(np.ceil(self._join_m / self._cell_m))
        self._grid = CellGrid(settings.n)
        self._tracker = BlobTracker(settings.moving)
        self._found: dict[int, GatheredChange] = {}  # by number, in order
        self._merged: dict[int, int] = {}
        self._parts: dict[int, Parts] = {}  # the things that a told change holds, by its number
        self._movers = Movers(id_prefix, m_per_px, self._cell_m)
        self._least_cells = max(2, settings.least_area_m2 / self._cell_m**2)
        self._seeds = Seeds(self._grid, self._cell_m, self._gap, self._least_cells, m_per_px)
        self._recent: deque[KeptView] = deque(maxlen=settings.n)
        self._number = 0
        self._last: tuple[int, int, Floats] | None = None  # index, time, camera of the last view that counted
        self._tallied_at_m: Floats | None = None

    def add(self, view: ComparedView) -> tuple[Change, ...]:
        """Take in one view; the changes that it makes certain enough to be told, each once in a flight."""
        if self._is_repeat(view):
            return ()
        budget = [self._pictures_for(view)]
        self._last = (view.index, view.time_ns, view.camera_m)
        known = int(np.count_nonzero(view.valid))
        may_follow = np.count_nonzero(view.changed) < _ALL_CHANGED * known
        followed = self._tracker.follow(view if may_follow else replace(
            view, boxes=view.boxes[:0], scores=view.scores[:0]
        ))
        nothing = np.zeros(len(view.boxes), bool)
        moving, held = (followed.is_moving, followed.may_move) if may_follow else (nothing, nothing)
        laid = lay(view, self._cell_m, moving, held)
        counts = self._is_new_place(view)
        evidence = self._grid.record(laid, counts)
        kept_view = KeptView(
            view.time_ns, laid, view.camera_m, view.site_from_image, view.changed, view.valid, counts
        )
        earlier = list(self._recent)
        self._recent.append(kept_view)
        new = self._gather(view, kept_view, earlier, evidence, budget)
        shown = self._update(view, kept_view, evidence.owner, {each.number for each in new}, budget)
        announced: list[Change] = []
        for each in shown:
            announced += self._told(each, view.time_ns)
        announced += self._movers.see(view, followed.movers, self._next_number)
        self._seeds.keep(view, kept_view, evidence, budget[0])
        return tuple(announced)

    def changes(self) -> tuple[Change, ...]:
        """All changes told so far as they are known now, in the order of their numbers."""
        known = list(self._movers.changes)
        for change in self._found.values():
            if change.is_told and not change.is_taken_back:
                known += self._records(change)
        return tuple(sorted(known, key=_number_of))

    def conclude(self) -> tuple[Change, ...]:
        """The last word, after the last view: all changes, with those that fewer than n views could see.

        A change that too small a share of all views of its ground showed is taken back. A change that only one view
        saw, and no other could, is told if that view was very sure, with half the score.
        """
        for seed in self._seeds:
            self._grow_late(seed)
        for change in self._found.values():
            if not change.is_told:
                self._told(change, -1)
                continue
            whole = self._change(change) if self._is_sure(change) else None
            if whole is None or not self._is_thing(change, whole) or self._passed(change):
                change.is_taken_back = True
            else:
                self._part(change, -1, whole)
        return self.changes()

    def _passed(self, change: GatheredChange) -> bool:
        """Whether a change is what a moving thing left in the evidence before it was known to move."""
        is_gone = change.asked >= change.views + _GONE_VIEWS
        if change.cells is None or not is_gone:
            return False
        return self._movers.were_at(*change.cells.box_m(self._cell_m), change.first_seen_ns, change.last_seen_ns)

    def _part(self, change: GatheredChange, now_ns: int, whole: Change | None) -> list[Change]:
        """Tell the things in a change, whose record is `whole`, from each other as its pictures now show them; those
        told for the first time."""
        if whole is None:
            return []
        things = change.parted(whole, self._cells_of(change), self._cell_m, self._join_m)
        parts = self._parts.setdefault(change.number, Parts())
        return parts.take(things, change.views, now_ns, lambda: f"{self._prefix}-{self._next_number()}")

    def _records(self, change: GatheredChange) -> list[Change]:
        """A told change as it is known now: its things, where it holds several."""
        parts = self._parts.get(change.number)
        if parts is not None and len(parts.things) > 1:
            return list(parts.things)
        whole = self._change(change)
        return [] if whole is None else [whole]

    def _is_repeat(self, view: ComparedView) -> bool:
        if self._last is None:
            return False
        index, time_ns, camera_m = self._last
        # photos may carry whole seconds only: what was taken elsewhere is no repeat, whatever its time
        has_moved = np.linalg.norm(view.camera_m - camera_m) >= 2 * _MOVED_HEIGHTS * float(view.camera_m[2])
        is_too_soon = (view.time_ns - time_ns) * 1e-9 < self._settings.least_views_apart_s
        return view.index == index or (is_too_soon and not bool(has_moved))

    def _pictures_for(self, view: ComparedView) -> int:
        """How many pictures there is time for since the last view."""
        waited_s = np.inf if self._last is None else (view.time_ns - self._last[1]) * 1e-9
        return int(np.clip(_PICTURES_A_VIEW * _VIEWS_S * waited_s, _PICTURES_A_VIEW, _MOST_PICTURES))

    def _is_new_place(self, view: ComparedView) -> bool:
        last = self._tallied_at_m
        if last is None or np.linalg.norm(view.camera_m - last) >= _MOVED_HEIGHTS * float(view.camera_m[2]):
            self._tallied_at_m = np.array(view.camera_m)
            return True
        return False

    def _next_number(self) -> int:
        self._number += 1
        return self._number

    def _gather(
        self, view: ComparedView, kept_view: KeptView, earlier: Sequence[KeptView], evidence: CellEvidence,
        budget: list[int],
    ) -> list[GatheredChange]:
        """Give the cells that are certain to the changes that they belong to; the changes that begin with this."""
        laid, settings = kept_view.laid, self._settings
        lasting = evidence.changed >= _LASTING * evidence.seen
        sure = (evidence.votes >= settings.k) & lasting & laid.flagged
        if not (sure & (evidence.owner == 0)).any():
            return []
        new = []
        for piece, part in pieces(sure | (evidence.owner > 0), self._gap):
            cells = sure[part] & piece
            owner = evidence.owner[part]
            owners = sorted({self._current(int(each)) for each in np.unique(owner[piece & (owner > 0)])})
            fresh = cells & (owner == 0)
            if not fresh.any():
                continue
            if owners and self._is_passing(evidence, part, piece & (owner > 0), fresh):
                continue
            if not owners:
                if np.count_nonzero(cells) < self._least_cells:
                    continue
                if np.mean(laid.held[part][cells]) > 0.5 and not self._stands(kept_view, earlier, part, cells):
                    continue
                if (cells & laid.cut_off[part]).any() and int(evidence.votes[part][cells].max()) < settings.n:
                    continue  # more of it will come into view soon
                known = self._known_at(laid.window, part, cells)
                change = self._found[known] if known else self._begin(view, earlier, kept_view, part, cells, budget)
                if not known:
                    new.append(change)
            else:
                change = self._found[owners[0]]
                for younger in owners[1:]:
                    change = self._merge(change, self._found[younger])
            window = laid.window.part(part)
            change.cells = window if change.cells is None else change.cells.joined(window)
            self._grid.own(window, cells, change.number)
            owner[cells] = change.number
        return [each for each in new if self._current(each.number) == each.number]

    @staticmethod
    def _is_passing(evidence: CellEvidence, part: tuple[slice, slice], own: Mask, fresh: Mask) -> bool:
        """Whether `fresh` cells are flagged so much more seldom than those that changes `own` that they are no part."""
        seen, changed = np.maximum(evidence.seen[part], 1), evidence.changed[part]
        of_own, of_fresh = changed[own] / seen[own], changed[fresh] / seen[fresh]
        surest = np.percentile(of_own, _SUREST)
        return bool(np.median(seen[fresh]) >= _PASSING_VIEWS and np.median(of_fresh) < _PASSING * surest)

    def _stands(
        self, kept_view: KeptView, earlier: Sequence[KeptView], part: tuple[slice, slice], cells: Mask
    ) -> bool:
        """Whether views over a long enough time show these very cells."""
        window = kept_view.laid.window.part(part)
        for each in earlier:
            if (kept_view.time_ns - each.time_ns) * 1e-9 < _STANDS_S:
                return False  # and so are all later ones
            _, flagged, _, _ = each.laid.answer(window, cells, self._cell_m)
            if flagged > 0.5:
                return True
        return False

    def _begin(
        self, view: ComparedView, earlier: Sequence[KeptView], kept_view: KeptView, part: tuple[slice, slice],
        cells: Mask, budget: list[int],
    ) -> GatheredChange:
        change = GatheredChange(self._next_number(), view.time_ns)
        change.cells = kept_view.laid.window.part(part)
        self._found[change.number] = change
        box = change.cells.box_m(self._cell_m)
        change.show(view, *box, self._m_per_px)
        budget[0] -= 1
        for each in earlier:
            seen, flagged, score, place_m = each.laid.answer(change.cells, cells, self._cell_m)
            if seen >= 0.5 and flagged >= SHOWS * seen:
                change.see(each.time_ns, score, place_m, None, each.weight(change.cells, self._cell_m))
                change.from_camera(each.camera_m)
                change.vote(each.site_from_image, each.changed, each.valid)
            elif seen >= 0.5:
                change.miss(each.weight(change.cells, self._cell_m))
        return change

    def _told(self, change: GatheredChange, now_ns: int) -> list[Change]:
        """What is to be told of the change now: all its things once it is sure enough, later those that join it."""
        if change.is_told:
            parts = self._parts.get(change.number)
            is_due = now_ns >= 0 and (parts is None or parts.is_due(change.views))
            return self._part(change, now_ns, self._change(change)) if is_due else []
        whole = self._change(change) if self._is_sure(change) else None
        if whole is None or not self._is_thing(change, whole):
            return []
        change.is_told, change.announced_ns = True, now_ns
        return self._part(change, now_ns, replace(whole, announced_ns=now_ns))

    @staticmethod
    def _is_thing(change: GatheredChange, whole: Change) -> bool:
        """Whether the record of a change is of a thing: neither of shade nor large and unsure."""
        if is_of_shade(whole):
            return False
        may_be_a_wall = whole.area_m2 >= _LARGE_M2 and whole.length_m < change.flying_height_m
        return not may_be_a_wall or change.score >= _LARGE_SCORE or change.is_from_one_place

    def _is_sure(self, change: GatheredChange) -> bool:
        calm = change.calmness = 1.0
        if change.cells is not None and change.score >= self._settings.least_score:
            own = self._cells_of(change)
            calm = calmness(restlessness(self._grid, change.cells, own, self._cell_m))
            # views agree by chance now and then, not nearly all of them, many or surely
            agree = (change.views + 1) / (change.asked + 2) if change.views >= _MANY_VIEWS else 0.0
            change.calmness = calm ** min(1.0, _DOUBT * (1 - max(change.score, agree)))
        # nothing tall leans over calm ground: there views from aside say as much as those from above
        share = max(change.share, change.views / change.asked) if calm > _CALM else change.share
        is_of_few = 1 < change.views < self._settings.k
        least_score = _FEW_VIEWS_SCORE if is_of_few else self._settings.least_score
        is_mostly_there = change.views >= _MOSTLY_THERE * change.asked
        return change.score >= least_score and share >= self._settings.least_share and is_mostly_there

    def _update(
        self, view: ComparedView, kept_view: KeptView, owner: NDArray[np.int32], new: set[int], budget: list[int]
    ) -> list[GatheredChange]:
        """Bring the known changes up to date with this view; those that it shows, in the order of their numbers."""
        if not owner.any():
            return []
        laid = kept_view.laid
        shown = []
        wishes = []
        for number in sorted({self._current(int(each)) for each in np.unique(owner[owner > 0])}):
            change = self._found[number]
            if change.cells is None:
                continue
            cells = self._without_passing(change, kept_view)
            seen, flagged, score, place_m = laid.answer(change.cells, cells, self._cell_m)
            is_large = max(change.cells.shape) * self._cell_m > 0.5 * max(laid.window.shape) * self._cell_m
            if seen < 0.5 and not (is_large and flagged > 0):
                continue
            if flagged < SHOWS * seen:
                change.miss(kept_view.weight(change.cells, self._cell_m))
                continue
            weight = kept_view.weight(change.cells, self._cell_m)
            change.see(view.time_ns, score, place_m if seen > 0.99 else None, view, weight)
            change.from_camera(view.camera_m)
            change.whole += not laid.part_of(laid.cut_off, change.cells, cells).any()
            if change.still_votes and number not in new:
                change.vote(view.site_from_image, view.changed, view.valid)
            shown.append(change)
            wishes.append((change.wants(*change.cells.box_m(self._cell_m), view), -number))
        for gain, minus_number in sorted(wishes, reverse=True):
            if gain <= 1.15 or budget[0] <= 0:
                break
            change = self._found[-minus_number]
            if change.cells is not None:
                change.show(view, *change.cells.box_m(self._cell_m), self._m_per_px)
                budget[0] -= 1
        for number in new:
            change = self._found[number]
            change.vote(view.site_from_image, view.changed, view.valid)
        return shown

    def _without_passing(self, change: GatheredChange, kept_view: KeptView) -> Mask:
        """The change's own cells, (rows, columns) of its window, less those that it loses now.

        What leaned over a thing's place for a few views joined it and is gone from most later ones, while the thing is
        not: it is no part of it. The views that are counted then are those that its own cells had.
        """
        if change.cells is None:
            return np.zeros((1, 1), bool)
        evidence = self._grid.read(change.cells)
        own = evidence.owner == change.number
        share = evidence.changed[own] / np.maximum(evidence.seen[own], 1)
        if not share.size:
            return own
        passing = (share < _PASSING * np.percentile(share, _SUREST)) & (evidence.seen[own] >= _PASSING_VIEWS)
        lost = int(np.count_nonzero(passing))
        if not lost or len(share) - lost < self._least_cells:
            return own
        loses = np.zeros_like(own)
        loses[own] = passing
        self._grid.own(change.cells, loses, 0)
        own &= ~loses
        if lost > len(share) / 2:
            now = int(kept_view.counts)  # this view is counted apart
            change.recount(int(np.median(evidence.changed[own])) - now, int(np.median(evidence.seen[own])) - now)
            if change.number in self._parts:
                self._parts[change.number].join(())  # with fewer views: look for its things again
        return own

    def _merge(self, older: GatheredChange, younger: GatheredChange) -> GatheredChange:
        number, gone = older.number, younger.number
        if younger.is_told:
            self._parts.setdefault(number, Parts()).join(self._records(younger))
        if younger.cells is not None:
            self._grid.own(younger.cells, self._cells_of(younger), number)
        self._parts.pop(gone, None)
        self._merged[gone] = number
        del self._found[gone]
        self._found[number] = joined(older, younger)
        return self._found[number]

    def _current(self, number: int) -> int:
        while number in self._merged:
            number = self._merged[number]
        return number

    def _known_at(self, window: CellWindow, part: tuple[slice, slice], cells: Mask) -> int:
        """The change already told here whose cells were forgotten since; 0 if there is none."""
        here = window.part(part)
        rows, columns = np.nonzero(cells)
        x, y = int(columns.mean()) + here.x0, int(rows.mean()) + here.y0
        for number, change in self._found.items():
            box = change.cells
            if box and box.x0 <= x < box.x1 and box.y0 <= y < box.y1 and not self._cells_of(change).any():
                return number
        return 0

    def _cells_of(self, change: GatheredChange) -> Mask:
        if change.cells is None:
            return np.zeros((1, 1), bool)
        return self._grid.read(change.cells).owner == change.number

    def _change(self, change: GatheredChange) -> Change | None:
        cells = self._cells_of(change)
        outline_m = change.outline_m(cells, self._cell_m, self._join_m)
        return None if outline_m is None else change.change(self._prefix, outline_m, self._cell_m)

    def _grow_late(self, seed: GatheredChange) -> None:
        """Tell what fewer than n views could see: the same share of them must show it as k of n."""
        settings = self._settings
        if seed.cells is None:
            return
        evidence = self._grid.read(seed.cells)
        seen, changed = evidence.seen.astype(float), evidence.changed
        is_short = (seed.last_seen_ns - seed.first_seen_ns) * 1e-9 < _STANDS_S
        if seed.held > 2 and is_short and not _stays(evidence):
            return
        needed = np.maximum(settings.least_views, np.ceil(settings.k * np.minimum(seen, settings.n) / settings.n))
        free = evidence.owner == 0
        late = free & (((changed >= needed) & (seen < settings.n)) | (evidence.votes >= settings.k))
        single = free & (changed == 1) & (seen == 1)
        if np.count_nonzero(late) >= self._least_cells:
            cells = late
        elif np.count_nonzero(single) >= self._least_cells and seed.score * 1.5 >= settings.single_view_score:
            cells, seed.weakness = single, 0.5
        else:
            return
        for piece, part in pieces(cells, self._gap):
            window = seed.cells.part(part)
            beside = self._grid.read(window.grown(self._gap + 1)).owner
            change = self._found[self._current(int(beside[beside > 0].min()))] if beside.any() else None
            if change is not None and change.cells is not None:
                fresh = piece & cells[part]
                whole = change.cells.joined(window)
                evidence, there = self._grid.read(whole), np.zeros(whole.shape, bool)
                there[window.within(whole)] = fresh
                if not self._is_passing(evidence, np.s_[:, :], evidence.owner == change.number, there):
                    self._grid.own(window, fresh, change.number)
                    change.cells = whole
                cells[part] &= ~piece
        if np.count_nonzero(cells) < self._least_cells:
            return
        for _ in range(int(seen[cells].max()) - seed.asked):
            seed.miss(1.0)
        seed.number = self._next_number()
        self._grid.own(seed.cells, cells, seed.number)
        self._found[seed.number] = seed


def _stays(evidence: CellEvidence) -> bool:
    """Whether most cells that any view flagged were flagged by nearly all views: what moves leaves them."""
    ever = evidence.changed > 0
    steady = np.count_nonzero(evidence.changed[ever] >= _NEARLY_ALL * evidence.seen[ever])
    return bool(steady >= _MOST_STAY * np.count_nonzero(ever))


def _number_of(change: Change) -> int:
    return int(change.id.rsplit("-", 1)[1])
