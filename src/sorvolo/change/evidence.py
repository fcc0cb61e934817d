"""Changes of the ground collected over views: what persists at one place of the ground is announced, once.

The ground is divided into small cells; each keeps whether the last n views that saw it flagged it. A ghost of something
tall lies elsewhere on the ground from each place of the camera, moving leaves flicker, noise does not come back: none
of them gathers k votes out of n in the same cell. Unknown ground counts neither for nor against.
"""

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sorvolo.change.announcing import (
    LEAST_SCORE,
    Look,
    Objection,
    Tally,
    judge,
    sureness,
    views_score,
)
from sorvolo.change.candidate import (
    BETTER,
    Candidate,
    KeptView,
    Parts,
    Seeds,
    pictures_for,
)
from sorvolo.change.ground import (
    CellEvidence,
    CellWindow,
    EvidenceGrid,
    cell_side_m,
    lay,
    pieces,
)
from sorvolo.change.motion import BlobTracker, Movers, MovingBlobs
from sorvolo.change.outlines import mask_of
from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, Ints32, Mask, PointsM
from sorvolo.survey.findings import Change, ComparedView

# Which cells are no part of a change: what leaned over its place for a few views.
_PASSING_SHARE = 0.5  # flagged in a share of views so many times as large as the surest cells' ...
_PASSING_VIEWS = 8  # ... of at least this many views
_SUREST_PERCENT = 97  # percentile of its cells' shares that is that of the surest


# Which ground around a change shows how restless it is there.
_AROUND_M = 5.0  # a crown's width
_APART_M = 0.5  # nearer lies the change's own rim
_CHANGED_ITSELF = 0.5  # of its views: ground that more of them flag is changed itself, not restless


# How views become cells, and cells candidates.
_MOVED_HEIGHTS = 0.01  # flying heights that the camera moves until a view counts anew
_ALL_CHANGED = 0.5  # share of a frame beyond which nothing in it can be followed
# what the same ground shows for so long stands there, however unsteady its blobs are
_STANDS_S = 2.0


_LEAST_VIEWS = 2  # where fewer than n ever see it
_LEAST_VIEWS_APART_S = 0.1  # frames closer in time add nothing
_LEAST_AREA_M2 = 0.02  # 14 cm a side: smaller things are not looked for
_JOIN_M = 0.3  # a smaller gap does not make two things of one
# what one view shows, and no other could, must be so sure, and confirmed
_SINGLE_VIEW_SCORE = 0.9


@dataclass(frozen=True)
class EvidenceSettings:
    """What is gathered of the views; `announcing` decides on it."""

    k: int = 3  # views that must show it ...
    n: int = 5  # ... of the last ones that saw its ground

    def __post_init__(self) -> None:
        if not 1 <= self.k <= self.n <= 8:
            raise SettingsError(
                f"evidence needs 1 <= k <= n <= 8 views, got k = {self.k}, n = {self.n}"
            )


class EvidenceMap:
    """The changes of one flight while its views come in. `add` changes it; `conclude` settles what is left.

    `m_per_px` is a pixel of changes' pictures, `id_prefix` begins every change's id: the flight's name. Views must come
    in order of time; the same views give the same changes and ids.
    """

    def __init__(
        self,
        m_per_px: float,
        settings: EvidenceSettings,
        id_prefix: str,
    ) -> None:
        self._settings, self._prefix = settings, id_prefix
        self._m_per_px = m_per_px
        self._cell_m = cell_side_m(m_per_px)
        self._join_m = max(_JOIN_M, 3 * self._cell_m)
        self._gap = int(np.ceil(self._join_m / self._cell_m))
        self._grid = EvidenceGrid(settings.n)
        self._tracker = BlobTracker()
        self._found: dict[int, Candidate] = {}  # by number, in order
        self._merged: dict[int, int] = {}
        self._announced_ns: dict[int, int] = {}  # by the number of the candidate
        self._parts: dict[
            int, Parts
        ] = {}  # the things that an announced change holds, by its number
        self._stopped: dict[int, Objection | None] = {}  # at the flight's end, by number
        self._seen_once: set[int] = (
            set()
        )  # the numbers of those with ground that one view alone shows
        self._movers = Movers(id_prefix, m_per_px, self._cell_m)
        self._least_cells = max(2, _LEAST_AREA_M2 / self._cell_m**2)
        self._seeds = Seeds(
            self._grid,
            self._cell_m,
            self._gap,
            self._least_cells,
            m_per_px,
        )
        self._recent: deque[KeptView] = deque(maxlen=settings.n)
        self._number = 0
        self._last: tuple[int, int, Floats] | None = (
            None  # index, time, camera of the last view that counted
        )
        self._counted_at_m: Floats | None = None

    def add(self, view: ComparedView) -> tuple[Change, ...]:
        """Take in one view; the changes that it makes certain enough to be announced, each once in a flight."""
        if self._is_repeat(view):
            return ()
        # How many pictures there is time for since the last view.
        waited_s = np.inf if self._last is None else (view.time_ns - self._last[1]) * 1e-9
        most_pictures = pictures_for(waited_s)
        self._last = (view.index, view.time_ns, view.camera_m)
        kept, moving = self._lay(view)
        evidence = self._grid.record(kept.laid, kept.counts)
        begun = self._gather(kept, evidence)
        self._recent.append(kept)
        new = {each for each in begun if self._current(each) == each}
        shown, pictures = self._update(kept, evidence.owner, new, most_pictures - len(begun))
        announced = [change for each in shown for change in self._announce(each, view.time_ns)]
        announced += self._movers.see(view, moving, self._named)
        self._seeds.keep(kept, evidence, most_pictures - len(begun) - pictures)
        return tuple(announced)

    def changes(self) -> tuple[Change, ...]:
        """All changes announced so far as they are known now, in the order of their numbers."""
        known = list(self._movers.changes)
        for number, candidate in self._found.items():
            if number in self._announced_ns and number not in self._stopped:
                known += self._records(candidate)
        return tuple(sorted(known, key=_number_of))

    def conclude(self, confirms: Callable[[PointsM], bool] = lambda _: False) -> tuple[Change, ...]:
        """After the last view: all changes, with those that fewer than n views could see.

        A change that the views of its ground did not confirm is withdrawn. One that a single view shows whole, and
        no other could, is announced if that view was very sure and evidence of another kind `confirms` its outline,
        (N, 2).
        """
        for seed in sorted(
            self._seeds, key=self._score, reverse=True
        ):  # one piece of ground may have several
            self._grow_late(seed, confirms)
        for number, candidate in self._found.items():
            if number not in self._announced_ns:
                self._announce(candidate, -1)
                continue
            objection, whole = self._judged(candidate)
            if whole is not None and objection is None:
                self._part(candidate, -1, whole)
            else:
                self._stopped[number] = objection
        return self.changes()

    @property
    def next_number(self) -> int:
        """The first number that no change of the flight has."""
        return self._number + 1

    def outcomes(self) -> dict[str, dict[str, int]]:
        """What became of the candidates, for a report after `conclude`: how many changes are `announced`, those that
        stay in place and those that move; by reason how many candidates were `withdrawn`, or `never_announced`."""
        reasons = {
            number: objection.value
            for number, objection in self._stopped.items()
            if objection is not None
        }
        withdrawn = Counter(
            each for number, each in reasons.items() if number in self._announced_ns
        )
        never = Counter(
            each for number, each in reasons.items() if number not in self._announced_ns
        )
        never[Objection.TOO_FEW_VIEWS.value] += sum(each.number == 0 for each in self._seeds)
        moving = len(self._movers.changes)
        announced = {"still": len(self.changes()) - moving, "moving": moving}
        return {
            "announced": announced,
            "withdrawn": dict(withdrawn.most_common()),
            "never_announced": {name: count for name, count in never.most_common() if count},
        }

    # ---- one view ---------------------------------------------------------------------------------------------

    def _is_repeat(self, view: ComparedView) -> bool:
        if self._last is None:
            return False
        index, time_ns, camera_m = self._last
        # photos may carry whole seconds only: what was taken elsewhere is no repeat, whatever its time
        least_m = 2 * _MOVED_HEIGHTS * float(view.camera_m[2])
        has_moved = np.linalg.norm(view.camera_m - camera_m) >= least_m
        is_too_soon = (view.time_ns - time_ns) * 1e-9 < _LEAST_VIEWS_APART_S
        return view.index == index or (is_too_soon and not bool(has_moved))

    def _lay(self, view: ComparedView) -> tuple[KeptView, MovingBlobs]:
        """The view as cells, without what moves, and what moves in it."""
        most = _ALL_CHANGED * int(np.count_nonzero(view.valid))
        may_follow = np.count_nonzero(view.changed) < most
        followed = self._tracker.follow(
            view if may_follow else replace(view, boxes=view.boxes[:0], scores=view.scores[:0])
        )
        nothing = np.zeros(len(view.boxes), bool)
        moving, held = (followed.is_moving, followed.may_move) if may_follow else (nothing, nothing)
        legs = followed.legs if may_follow else np.zeros(len(view.boxes), np.int64)
        laid = lay(view, self._cell_m, moving, held, legs)
        return KeptView(view, laid, self._is_new_place(view)), followed

    def _is_new_place(self, view: ComparedView) -> bool:
        last, least_m = self._counted_at_m, _MOVED_HEIGHTS * float(view.camera_m[2])
        if last is None or np.linalg.norm(view.camera_m - last) >= least_m:
            self._counted_at_m = np.array(view.camera_m)
            return True
        return False

    # ---- from cells to candidates -----------------------------------------------------------------------------

    def _gather(self, kept: KeptView, evidence: CellEvidence) -> list[int]:
        """Give the cells that are certain to the candidates that they belong to, in `evidence` as well; the numbers of
        the candidates that begin with this view."""
        laid = kept.laid
        sure = (evidence.votes >= self._settings.k) & laid.flagged
        if not (sure & (evidence.owner == 0)).any():
            return []
        begun = []
        for piece, part in pieces(sure | (evidence.owner > 0), self._gap):
            cells = sure[part] & piece
            owner = evidence.owner[part]
            owners = sorted(
                {self._current(int(each)) for each in np.unique(owner[piece & (owner > 0)])}
            )
            fresh = cells & (owner == 0)
            owned = piece & (owner > 0)
            if not fresh.any() or (owners and _is_passing(evidence, part, owned, fresh)):
                continue
            window = laid.window.part(part)
            if owners:
                # several whose ground has become one are one candidate, the oldest
                for younger in owners[1:]:
                    self._merge(owners[0], younger)
                number = owners[0]
            elif self._may_begin(kept, evidence, part, cells):
                number = self._forgotten_at(window, cells)
                if not number:
                    number = self._begin(kept.view, window, cells)
                    begun.append(number)
            else:
                continue
            self._found[number].extend(window)
            self._grid.own(window, cells, number)
            owner[cells] = number
        return begun

    def _may_begin(
        self, kept: KeptView, evidence: CellEvidence, part: tuple[slice, slice], cells: Mask
    ) -> bool:
        """Whether certain cells that nobody owns are a new candidate: large enough, standing, and all of it in view."""
        if np.count_nonzero(cells) < self._least_cells:
            return False
        if np.mean(kept.laid.held[part][cells]) > 0.5 and not self._stands(kept, part, cells):
            return False
        # of what ends at a rim more will come into view soon
        is_at_rim = (cells & kept.laid.at_rim[part]).any()
        return not is_at_rim or int(evidence.votes[part][cells].max()) >= self._settings.n

    def _stands(self, kept: KeptView, part: tuple[slice, slice], cells: Mask) -> bool:
        """Whether views over a long enough time show these very cells."""
        window = kept.laid.window.part(part)
        return any(
            each.laid.report(window, cells).flagged > 0.5
            for each in self._recent
            if (kept.view.time_ns - each.view.time_ns) * 1e-9 >= _STANDS_S
        )

    def _begin(self, view: ComparedView, window: CellWindow, cells: Mask) -> int:
        candidate = Candidate(self._next_number(), window, view.time_ns)
        self._found[candidate.number] = candidate
        candidate.pictures.show(view, *window.box_m(self._cell_m), self._m_per_px)
        for each in self._recent:
            candidate.recall(each, cells)
        return candidate.number

    def _merge(self, number: int, gone: int) -> None:
        older, younger = self._found[number], self._found[gone]
        if gone in self._announced_ns:
            self._parts.setdefault(number, Parts()).join(self._records(younger))
        self._grid.own(younger.cells, self._cells_of(younger), number)
        self._parts.pop(gone, None)
        announced_ns = self._announced_ns.pop(gone, None)
        if announced_ns is not None:
            self._announced_ns.setdefault(number, announced_ns)
        self._merged[gone] = number
        del self._found[gone]
        surer, other = (
            (younger, older) if self._score(younger) > self._score(older) else (older, younger)
        )
        self._found[number] = surer.joined(other, number)

    def _current(self, number: int) -> int:
        while number in self._merged:
            number = self._merged[number]
        return number

    def _forgotten_at(self, here: CellWindow, cells: Mask) -> int:
        """The number of the candidate whose cells here were forgotten since; 0 if there is none."""
        rows, columns = np.nonzero(cells)
        x, y = int(columns.mean()) + here.x0, int(rows.mean()) + here.y0
        for number, candidate in self._found.items():
            box = candidate.cells
            if (
                box.x0 <= x < box.x1
                and box.y0 <= y < box.y1
                and not self._cells_of(candidate).any()
            ):
                return number
        return 0

    # ---- candidates brought up to date ------------------------------------------------------------------------

    def _update(
        self, kept: KeptView, owner: Ints32, new: set[int], most_pictures: int
    ) -> tuple[list[Candidate], int]:
        """Bring the candidates in view up to date; those that it shows, in the order of their numbers, and how many
        pictures were cut."""
        shown = []
        for number in sorted({self._current(int(each)) for each in np.unique(owner[owner > 0])}):
            candidate = self._found[number]
            evidence = self._grid.read(candidate.cells)
            own = evidence.owner == candidate.number
            if (passing := self._passing(evidence, own)) is not None:
                own &= ~passing
                self._give_up(candidate, passing, evidence, own, kept)
            if candidate.see(kept, own):
                shown.append(candidate)
                if candidate.pictures.wants_votes and number not in new:
                    candidate.pictures.vote(kept.view)
        pictures = self._cut_pictures(kept.view, shown, most_pictures)
        for number in new:
            self._found[number].pictures.vote(kept.view)
        return shown, pictures

    def _cut_pictures(
        self, view: ComparedView, shown: Sequence[Candidate], most_pictures: int
    ) -> int:
        """Take the view's pictures of those candidates that gain most by it; how many."""
        gains = [
            (each.pictures.gain(*each.cells.box_m(self._cell_m), view), -each.number)
            for each in shown
        ]
        wanted = [-number for gain, number in sorted(gains, reverse=True) if gain > BETTER][
            : max(most_pictures, 0)
        ]
        for number in wanted:
            candidate = self._found[number]
            candidate.pictures.show(view, *candidate.cells.box_m(self._cell_m), self._m_per_px)
        return len(wanted)

    def _passing(self, evidence: CellEvidence, own: Mask) -> Mask | None:
        """Which of a candidate's own cells only passed by, (rows, columns) of its window; None if too few would stay.

        What leaned over a thing's place for a few views joined it and is gone from most later ones, while the thing is
        not: it is no part of it.
        """
        passing = _passing_cells(evidence, own)
        lost, held = int(np.count_nonzero(passing)), int(np.count_nonzero(own))
        return passing if lost and held - lost >= self._least_cells else None

    def _give_up(
        self,
        candidate: Candidate,
        passing: Mask,
        evidence: CellEvidence,
        own: Mask,
        kept: KeptView,
    ) -> None:
        """Take cells from a candidate whose `own` ones stay. The views that are counted then are those that its own
        cells had, if it lost most."""
        self._grid.own(candidate.cells, passing, 0)
        if np.count_nonzero(passing) <= np.count_nonzero(own):
            return
        now = int(kept.counts)  # this view is counted apart
        changed, seen = (
            int(np.median(each[own])) - now for each in (evidence.changed, evidence.seen)
        )
        candidate.recount(changed, seen)
        if candidate.number in self._parts:
            self._parts[candidate.number].join(())  # with fewer views: search for its things again

    # ---- announcing -------------------------------------------------------------------------------------------

    def _announce(self, candidate: Candidate, now_ns: int) -> list[Change]:
        """What is to be announced of the candidate now: all its things once it is sure enough, later those that join
        it. `now_ns` is -1 after the last view."""
        number = candidate.number
        if number in self._announced_ns:
            parts = self._parts.get(number)
            is_due = now_ns >= 0 and (parts is None or parts.is_due(candidate.tally.views))
            return self._part(candidate, now_ns, self._record(candidate)) if is_due else []
        objection, whole = self._judged(candidate)
        if whole is None or objection is not None:
            if now_ns < 0:
                self._stopped[number] = objection
            return []
        self._announced_ns[number] = now_ns
        return self._part(candidate, now_ns, replace(whole, announced_ns=now_ns))

    def _judged(self, candidate: Candidate) -> tuple[Objection | None, Change | None]:
        """Why a candidate is no change, if so, and its record if its views alone make it one."""
        is_worth_it = views_score(self._tally_of(candidate)) >= LEAST_SCORE
        candidate.note_restlessness(self._restlessness(candidate) if is_worth_it else 0.0)
        tally = self._tally_of(candidate)
        objection = judge(tally)
        whole = self._record(candidate) if objection is None else None
        if whole is None:
            return objection, None
        return judge(replace(tally, look=Look(whole.area_m2, whole.length_m))), whole

    def _restlessness(self, candidate: Candidate) -> float:
        return restlessness(self._grid, candidate.cells, self._cells_of(candidate), self._cell_m)

    def _part(self, candidate: Candidate, now_ns: int, whole: Change | None) -> list[Change]:
        """Part a candidate, whose record is `whole`, into its things; those announced for the first time."""
        if whole is None:
            return []
        things = candidate.pictures.parted(
            whole, candidate.cells, self._cells_of(candidate), self._cell_m, self._join_m
        )
        parts = self._parts.setdefault(candidate.number, Parts())
        return parts.take(
            things, candidate.tally.views, now_ns, lambda: f"{self._prefix}-{self._next_number()}"
        )

    def _records(self, candidate: Candidate) -> list[Change]:
        """An announced change as it is known now: its things, where it holds several."""
        parts = self._parts.get(candidate.number)
        things = list(parts.things) if parts is not None and len(parts.things) > 1 else []
        if not things:
            whole = self._record(candidate)
            things = [] if whole is None else [whole]
        return (
            [self._as_seen(candidate, each) for each in things]
            if candidate.number in self._seen_once
            else things
        )

    def _as_seen(self, candidate: Candidate, thing: Change) -> Change:
        """A thing of a candidate that several views show, with one view and the score of one, where no other saw it."""
        evidence = self._grid.read(candidate.cells)
        own = mask_of(
            thing.outline_m, candidate.cells.site_from_cell(self._cell_m), candidate.cells.shape
        )
        own &= evidence.owner == candidate.number
        if own.any() and np.median(evidence.seen[own]) > 1:
            return thing
        once = replace(self._tally_of(candidate).recounted(1, 1), whole=1)
        return replace(thing, views=1, score=sureness(once))

    def _record(self, candidate: Candidate) -> Change | None:
        outline_m = candidate.pictures.outline_m(
            candidate.cells, self._cells_of(candidate), self._cell_m, self._join_m
        )
        if outline_m is None:
            return None
        announced_ns = self._announced_ns.get(candidate.number, -1)
        return candidate.record(
            self._prefix, outline_m, self._cell_m, self._score(candidate), announced_ns
        )

    def _score(self, candidate: Candidate) -> float:
        return sureness(self._tally_of(candidate))

    def _tally_of(self, candidate: Candidate) -> Tally:
        """What the views reported of a candidate, less those in which something shows it that moves: where that was
        before it was seen to move, nothing stands."""
        return candidate.tally.less(candidate.shown_by(self._movers.knows))

    def _named(self, leg: int) -> tuple[int, int | None]:
        """The number of the change that a blob becomes which was seen to move, and when that was announced: those of a
        change that it was taken for while it was not known to move, else a new one and None."""
        for number, announced_ns in self._announced_ns.items():
            candidate, parts = self._found[number], self._parts.get(number)
            shown = sum(each.views for each in candidate.shown_by(lambda each: each == leg))
            if 2 * shown > candidate.tally.views and (parts is None or len(parts.things) < 2):
                self._grid.own(candidate.cells, self._cells_of(candidate), 0)
                del self._found[number], self._announced_ns[number]
                self._parts.pop(number, None)
                return number, announced_ns
        return self._next_number(), None

    def _cells_of(self, candidate: Candidate) -> Mask:
        return self._grid.read(candidate.cells).owner == candidate.number

    def _next_number(self) -> int:
        self._number += 1
        return self._number

    # ---- after the last view ----------------------------------------------------------------------------------

    def _grow_late(self, seed: Candidate, confirms: Callable[[PointsM], bool]) -> None:
        """Make a candidate of what fewer than n views could see: the same share of them must show it as k of n."""
        evidence = self._grid.read(seed.cells)
        if seed.number:
            return
        cells, single = self._late_cells(evidence), self._single_cells(seed, evidence)
        is_seen_once = np.count_nonzero(single) >= self._least_cells and self._is_confirmed(
            seed, single, confirms
        )
        if is_seen_once:
            cells |= single
        if np.count_nonzero(cells) < self._least_cells:
            return
        missed = int(evidence.seen[cells].max()) - seed.tally.asked
        if missed > 0:
            seed.miss(missed)
        seed.number = self._next_number()
        if is_seen_once:
            self._seen_once.add(seed.number)
        self._grid.own(seed.cells, cells, seed.number)
        self._found[seed.number] = seed

    def _late_cells(self, evidence: CellEvidence) -> Mask:
        """The cells that enough of the few views show."""
        settings, seen = self._settings, evidence.seen.astype(float)
        needed = np.maximum(
            _LEAST_VIEWS, np.ceil(settings.k * np.minimum(seen, settings.n) / settings.n)
        )
        enough = ((evidence.changed >= needed) & (seen < settings.n)) | (
            evidence.votes >= settings.k
        )
        return enough & (evidence.owner == 0)

    def _single_cells(self, seed: Candidate, evidence: CellEvidence) -> Mask:
        """The cells of a seed that one view shows, where no other saw them; none unless it is very sure and shows all
        of it: at a rim walls lean in whole."""
        tally = seed.tally
        is_sure = tally.score_sum >= _SINGLE_VIEW_SCORE * tally.views and tally.whole > 0
        return (evidence.owner == 0) & (evidence.changed == 1) & (evidence.seen == 1) & is_sure

    def _is_confirmed(
        self, seed: Candidate, cells: Mask, confirms: Callable[[PointsM], bool]
    ) -> bool:
        outline_m = seed.pictures.outline_m(seed.cells, cells, self._cell_m, self._join_m)
        return outline_m is not None and confirms(outline_m)


def restlessness(grid: EvidenceGrid, window: CellWindow, own: Mask, cell_m: float) -> float:
    """The share of the views of the ground around a change that flag it although most others do not, 0 to 1.

    Crowns, walls that lean into view and wind make views differ from the map all around, now here, now there: where
    much comes and goes, views agree by chance. What really came or left stands out on calm ground. `own` (rows,
    columns) are the change's cells in `window`. Where no other ground was seen twice, nothing is known: 0.
    """
    reach = int(np.ceil((_APART_M + _AROUND_M) / cell_m))
    evidence = grid.read(window.grown(reach))
    free = np.pad((~own).view(np.uint8), reach, constant_values=1)
    away_m = cv2.distanceTransform(free, cv2.DIST_L2, 5) * cell_m
    around = (away_m > _APART_M) & (away_m <= _APART_M + _AROUND_M) & (evidence.seen >= 2)
    seen, changed = evidence.seen[around].astype(float), evidence.changed[around]
    if not seen.size:
        return 0.0
    return float(np.where(changed <= _CHANGED_ITSELF * seen, changed / seen, 0.0).mean())


def _is_passing(evidence: CellEvidence, part: tuple[slice, slice], own: Mask, fresh: Mask) -> bool:
    """Whether `fresh` cells are flagged so much more seldom than those that candidates `own` that they are no part."""
    seen, changed = np.maximum(evidence.seen[part], 1), evidence.changed[part]
    of_own, of_fresh = changed[own] / seen[own], changed[fresh] / seen[fresh]
    least = _PASSING_SHARE * np.percentile(of_own, _SUREST_PERCENT)
    return bool(np.median(seen[fresh]) >= _PASSING_VIEWS and np.median(of_fresh) < least)


def _passing_cells(evidence: CellEvidence, own: Mask) -> Mask:
    """Which of a candidate's `own` cells are flagged so much more seldom than its surest that they are no part."""
    share = evidence.changed[own] / np.maximum(evidence.seen[own], 1)
    passing = np.zeros_like(own)
    if share.size:
        least = _PASSING_SHARE * np.percentile(share, _SUREST_PERCENT)
        passing[own] = (share < least) & (evidence.seen[own] >= _PASSING_VIEWS)
    return passing


def _number_of(change: Change) -> int:
    return int(change.id.rsplit("-", 1)[1])
