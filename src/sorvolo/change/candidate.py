"""A candidate for a change while views come in: its ground, its tally, its pictures and the things in it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sorvolo.change.announcing import Tally
from sorvolo.change.ground import (
    CellEvidence,
    CellReport,
    CellWindow,
    EvidenceGrid,
    LaidView,
    pieces,
)
from sorvolo.change.kinds import kind_of
from sorvolo.change.outlines import aside_of, measures, outline_of, overlap, place_sigma_m
from sorvolo.change.patches import Cut, PatchWindow, cut, moved, patch_of, quality
from sorvolo.change.things import things_of
from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Bytes, Floats, Mask, PointsM, square
from sorvolo.geometry.homography import shifted
from sorvolo.survey.findings import Change, ChangeKind, ComparedView, Patch

_MOST_VOTES = 250  # a byte counts them


# Which views' pictures a candidate keeps, and how masks make its outline.
BETTER = 1.15  # times as good a view's pictures must be to replace older ones
_GOOD = 0.75  # quality, 0 to 1, beyond which no better pictures are searched for
_MOST_PX = 512  # longest side of a picture
_ENOUGH_VOTES = 40  # masks; more hardly move the outline
_LEAST_MAJORITY = 0.3  # of the area of its cells: if masks agree on less, the cells are the outline
_A_VIEW = 6  # cut anew at most, which bounds the time a view takes ...
_MOST_A_VIEW = 30  # ... and as many where views are seldom: there is more time
_VIEWS_S = 5.0  # views a second up to which there is time for more than `a_view`


def pictures_for(waited_s: float) -> int:
    """Return how many pictures there is time for, so long after the last view."""
    often = _A_VIEW * _VIEWS_S * waited_s
    return int(np.clip(often, _A_VIEW, _MOST_A_VIEW))


class Pictures:
    """The ground of a candidate on both dates. Only `show` and `vote` change it."""

    def __init__(self) -> None:
        self._window: PatchWindow | None = None
        self._best: Cut | None = None
        self._quality = 0.0
        self._votes = 0
        self._yes: Bytes = np.zeros((0, 0), np.uint8)
        self._asked: Bytes = np.zeros((0, 0), np.uint8)

    @property
    def size_px(self) -> int:
        """Pixels of a picture."""
        return 0 if self._window is None else self._window.width_px * self._window.height_px

    def gain(self, low_m: Floats, high_m: Floats, view: ComparedView) -> float:
        """How much better, as a factor, the view shows a box of ground; infinite if the pictures have to grow."""
        if self._window is None or self._best is None or not self._window.holds(low_m, high_m):
            return np.inf
        if self._quality > _GOOD:
            return 0.0
        return quality(view, low_m, high_m) / max(self._quality, 1e-9)

    @property
    def wants_votes(self) -> bool:
        """Whether more masks would make the outline better."""
        return self._votes < _ENOUGH_VOTES

    def show(self, view: ComparedView, low_m: Floats, high_m: Floats, m_per_px: float) -> None:
        """Take the view's pictures of the box of ground if they are better, or wherever there were none."""
        window = self._grow(low_m, high_m, m_per_px)
        new, good = cut(view, window), quality(view, low_m, high_m)
        if self._best is None:
            self._best, self._quality = new, good
        elif good > BETTER * self._quality:
            self._best, self._quality = new.over(self._best), good
        else:
            self._best = self._best.over(new)

    def vote(self, view: ComparedView) -> None:
        """Count one view's mask, pixel by pixel, towards the outline."""
        if self._window is None or self._votes >= _MOST_VOTES:
            return
        self._votes += 1
        patch_from_image = np.linalg.inv(self._window.site_from_patch) @ view.site_from_image
        size = self._window.size_px
        self._yes += (
            cv2.warpPerspective(view.changed, patch_from_image, size, flags=cv2.INTER_LINEAR) >= 128
        )
        self._asked += (
            cv2.warpPerspective(
                view.valid.view(np.uint8), patch_from_image, size, flags=cv2.INTER_NEAREST
            )
            > 0
        )

    def outline_m(
        self, window: CellWindow, cells: Mask, cell_m: float, join_m: float
    ) -> PointsM | None:
        """(N, 2) the outline: what most masks call changed, on or beside the candidate's `cells` in a window; that of
        the cells alone if masks agree on too little."""
        majority = self._majority(window, cells, cell_m)
        if majority is not None and self._window is not None:
            own = self._window
            tolerance_px = max(0.5 * cell_m / own.m_per_px, 0.5)
            return outline_of(majority, own.site_from_patch, tolerance_px, join_m / own.m_per_px)
        return outline_of(cells, window.site_from_cell(cell_m), 0.5, join_m / cell_m)

    def patch(self, outline_m: PointsM) -> Patch:
        """The record of the pictures. Raises GeometryError if no view showed any."""
        if self._window is None or self._best is None:
            raise GeometryError("a candidate without pictures has no record")
        return patch_of(self._window, self._best, outline_m)

    def parted(
        self, whole: Change, window: CellWindow, cells: Mask, cell_m: float, join_m: float
    ) -> list[Change]:
        """The records of the things that `whole` holds, the largest first, all under its id; `whole` if it is one."""
        majority = self._majority(window, cells, cell_m)
        own, best = self._window, self._best
        if majority is None or own is None or best is None:
            return [whole]
        things = things_of(whole.patch, whole.kind, majority)
        tolerance_px = max(0.5 * cell_m / own.m_per_px, 0.5)
        parts = []
        for mask, kind in things:
            outline_m = outline_of(mask, own.site_from_patch, tolerance_px, join_m / own.m_per_px)
            if len(things) < 2 or outline_m is None:
                return [whole]
            low_m, high_m = outline_m.min(axis=0), outline_m.max(axis=0)
            around = PatchWindow.around(low_m, high_m, own.m_per_px, _MOST_PX)
            near = best.moved(around, own)
            size = measures(outline_m)
            parts.append(
                replace(
                    whole,
                    kind=kind,
                    outline_m=outline_m,
                    area_m2=size.area_m2,
                    length_m=size.length_m,
                    patch=patch_of(around, near, outline_m),
                )
            )
        return parts

    def _grow(self, low_m: Floats, high_m: Floats, m_per_px: float) -> PatchWindow:
        """The window, large enough for a box of ground; what is known moves along."""
        old = self._window
        if old is not None and old.holds(low_m, high_m):
            return old
        window = self._window = PatchWindow.around(low_m, high_m, m_per_px, _MOST_PX)
        if old is None or self._best is None:
            self._yes = np.zeros((window.height_px, window.width_px), np.uint8)
            self._asked = np.zeros_like(self._yes)
        else:
            self._yes, self._asked = moved(self._yes, window, old), moved(self._asked, window, old)
            self._best = self._best.moved(window, old)
        return window

    def _majority(self, cell_window: CellWindow, cells: Mask, cell_m: float) -> Mask | None:
        """What most masks call changed, on or beside the cells, in the pictures; None if that is hardly anything."""
        window = self._window
        if window is None or not self._votes:
            return None
        padded = np.pad(cells.astype(np.uint8), 1)
        grown = cv2.dilate(padded, square(3))
        cells_from_padded = shifted(-1, -1)
        site_from_padded = cell_window.site_from_cell(cell_m) @ cells_from_padded
        patch_from_cells = np.linalg.inv(window.site_from_patch) @ site_from_padded
        near = (
            cv2.warpAffine(grown, patch_from_cells[:2], window.size_px, flags=cv2.INTER_NEAREST) > 0
        )
        majority = (2 * self._yes.astype(np.int16) > self._asked) & near
        least_m2 = _LEAST_MAJORITY * np.count_nonzero(cells) * cell_m**2
        return majority if np.count_nonzero(majority) * window.m_per_px**2 >= least_m2 else None


# When ground is parted anew, and what is the same thing as before.
_MORE_VIEWS = 1.2  # re-split a change once its view count grew by this factor
_SAME = 0.4  # of the union of two outlines of one thing lies in both


class Parts:
    """Neighbours that lie so near to each other that their ground is one. `take` and `join` change it."""

    def __init__(self) -> None:
        self.things: tuple[Change, ...] = ()
        self._announced: dict[str, Change] = {}  # by id, also those that do not show any more
        self._seen: tuple[Change, ...] = ()  # when last parted, announced or not
        self._views = 0

    def is_due(self, views: int) -> bool:
        """Whether, with this many views, it is time to look again for things to part."""
        return views >= _MORE_VIEWS * self._views

    def join(self, announced: Sequence[Change]) -> None:
        """Remember what was announced of a change that has become one with this: its things keep their ids."""
        self._announced |= {each.id: each for each in announced}
        self._views = 0

    def take(
        self, things: Sequence[Change], views: int, now_ns: int, next_id: Callable[[], str]
    ) -> list[Change]:
        """The things as they are seen after `views` views, the largest first; those announced for the first time, now.

        All come under the id of the whole. Each keeps the id of what was announced there; the largest of the
        others keeps that of the whole. Any more are new and get ids from `next_id`, if they were there already when
        last looked at: pictures of few views may show anything. At the end, `now_ns` = -1, all of them do.
        """
        self._views = views
        named = dict(enumerate(things[:1])) if len(things) == 1 else self._known_again(things)
        for row, thing in enumerate(things):
            if row not in named:
                named |= self._new_at(row, thing, named, now_ns, next_id)
        self._seen = tuple(things)
        self.things = tuple(named[row] for row in sorted(named))
        new = [each for each in self.things if each.id not in self._announced]
        self._announced |= {each.id: each for each in self.things}
        return new

    def _new_at(
        self,
        row: int,
        thing: Change,
        named: dict[int, Change],
        now_ns: int,
        next_id: Callable[[], str],
    ) -> dict[int, Change]:
        """A thing without a known id, by its row: under the whole's id where none of the `named` has it, else under a
        new one; nothing where it was not there when last looked at."""
        if all(each.id != thing.id for each in named.values()):
            return {row: thing}
        if now_ns < 0 or any(self._is_same(thing, each) for each in self._seen):
            return {row: replace(thing, id=next_id(), announced_ns=now_ns)}
        return {}

    def _known_again(self, things: Sequence[Change]) -> dict[int, Change]:
        """Those things, by row, that lie where something was announced already, under its id; each id once."""
        found: dict[int, Change] = {}
        free = dict(self._announced)
        for row, thing in enumerate(things):
            same = next((each for each in free.values() if self._is_same(thing, each)), None)
            if same is not None:
                found[row] = replace(thing, id=same.id, announced_ns=free.pop(same.id).announced_ns)
        return found

    def _is_same(self, a: Change, b: Change) -> bool:
        return overlap(a.outline_m, b.outline_m)[0] > _SAME


# When a view counts for a candidate, in shares of its cells, and what is kept.
# a view that flags less of what it sees misses it: from above a person covers few cells
_SHOWS = 0.12
_SEEN = 0.5  # a view that sees less is not asked
_MOST_CAMERAS = 256  # of views that show it; of more every second one is kept
_MOST_LEGS = 64  # of followed blobs that showed it; the oldest are forgotten


@dataclass(frozen=True, eq=False)
class KeptView:
    """One of the last views; it `counts` if the camera had moved on since the one before."""

    view: ComparedView
    laid: LaidView
    counts: bool

    @property
    def residual_m(self) -> float:
        """Of its alignment with the map, 0 where that is not known."""
        residual_px = self.view.residual_px
        return residual_px * self.view.m_per_px if np.isfinite(residual_px) else 0.0


class Candidate:
    """All that views reported of one possible change.

    `recall`, `see`, `ask` and `miss` take views in; `extend`, `recount` and `joined` follow its ground, the window
    `cells`. `tally` is what the views reported so far; a seed has the number 0.
    """

    def __init__(self, number: int, cells: CellWindow, first_seen_ns: int) -> None:
        self.number = number
        self.pictures = Pictures()
        self.cells = cells
        self.tally = Tally(first_seen_ns, first_seen_ns)
        self._cameras: list[Floats] = []
        self._shown_by: dict[
            int, Tally
        ] = {}  # the views in which a followed blob showed it, by its leg
        self._kind: ChangeKind | None = None
        self._kind_outline: PointsM | None = None

    def shown_by(self, which: Callable[[int], bool]) -> list[Tally]:
        """The views in which blobs showed it that were followed, on `which` legs: one tally for each of these."""
        return [each for leg, each in self._shown_by.items() if which(leg)]

    @property
    def cameras_m(self) -> PointsM:
        """(N, 3) where views that show it were taken, of many a part."""
        return np.array(self._cameras).reshape(-1, 3)

    def extend(self, window: CellWindow) -> None:
        """It reaches into this window, too."""
        self.cells = self.cells.joined(window)

    def recall(self, kept: KeptView, cells: Mask) -> None:
        """Count a view from before the candidate was found, whose `cells` lie in its window, and its mask."""
        report = kept.laid.report(self.cells, cells)
        if report.seen < _SEEN:
            return
        if report.flagged < _SHOWS * report.seen:
            self.miss()
            return
        self._count(kept, report, cells, residual_m=0.0)
        self.pictures.vote(kept.view)

    def see(self, kept: KeptView, cells: Mask) -> bool:
        """Count this view; whether it shows the candidate. One that sees less than half of it does not count, unless
        the candidate is as large as the view."""
        report = kept.laid.report(self.cells, cells)
        is_large = max(self.cells.shape) > 0.5 * max(kept.laid.window.shape)
        if report.seen < _SEEN and not (is_large and report.flagged > 0):
            return False
        if report.flagged < _SHOWS * report.seen:
            self.miss()
            return False
        leg = self._count(kept, report, cells, kept.residual_m)
        self._note_rim(kept, cells, leg)
        return True

    def ask(self, kept: KeptView, cells: Mask) -> bool:
        """Count this view as for a seed: whatever shows some of it shows it; and its mask. Whether it does."""
        report = kept.laid.report(self.cells, cells)
        if report.flagged >= max(_SHOWS * report.seen, 1e-9):
            leg = self._count(kept, report, cells, kept.residual_m)
            self.pictures.vote(kept.view)
            self._note_rim(kept, cells, leg)
            return True
        if report.seen >= _SEEN:
            self.miss()
        return False

    def miss(self, times: int = 1) -> None:
        """One more view that could have shown it, or several, do not."""
        self.tally = self.tally.without_view(times)

    def recount(self, views: int, asked: int) -> None:
        """Count anew what views reported: `views` of `asked` flagged what is left of it."""
        self.tally = self.tally.recounted(views, asked)
        self._shown_by.clear()

    def note_restlessness(self, restless: float) -> None:
        """The share of the views of the ground around that flag it for nothing, as measured last."""
        self.tally = replace(self.tally, restless=restless)

    def record(
        self, id_prefix: str, outline_m: PointsM, cell_m: float, score: float, announced_ns: int
    ) -> Change:
        """What is known of it.

        `sigma_m` is that of `place_sigma_m`. Raises GeometryError if it has no pictures.
        """
        patch, tally = self.pictures.patch(outline_m), self.tally
        if self._kind is None or self._kind_outline is not outline_m:
            self._kind, self._kind_outline = kind_of(patch), outline_m
        size = measures(outline_m)
        residual_m = tally.residual_m_sum / max(tally.views, 1)
        sigma_m = place_sigma_m(residual_m, cell_m, aside_of(outline_m, self.cameras_m))
        return Change(
            f"{id_prefix}-{self.number}",
            self._kind,
            score,
            outline_m,
            tally.first_seen_ns,
            tally.last_seen_ns,
            tally.views,
            size.area_m2,
            size.length_m,
            sigma_m,
            patch,
            announced_ns=announced_ns,
        )

    def joined(self, other: "Candidate", number: int) -> "Candidate":
        """This candidate and another that became one with it, under a number; the other is not to be used any more.

        What the views reported of this one, and its pictures, count.
        """
        self.number = number
        self.tally = replace(
            self.tally,
            first_seen_ns=min(self.tally.first_seen_ns, other.tally.first_seen_ns),
            last_seen_ns=max(self.tally.last_seen_ns, other.tally.last_seen_ns),
        )
        self.extend(other.cells)
        return self

    def _count(self, kept: KeptView, report: CellReport, cells: Mask, residual_m: float) -> int:
        """Count a view that shows it; the leg of the followed blob that shows it there, 0 for none."""
        view = kept.view
        seen = view.time_ns, report.score, residual_m, view.camera_m
        self.tally = self.tally.with_view(*seen)
        leg = kept.laid.leg_of(self.cells, cells)
        if leg:
            known = self._shown_by.get(leg, Tally(view.time_ns, view.time_ns))
            self._shown_by[leg] = known.with_view(*seen)
            if len(self._shown_by) > _MOST_LEGS:
                del self._shown_by[next(iter(self._shown_by))]
        self._cameras.append(view.camera_m)
        if len(self._cameras) > _MOST_CAMERAS:
            del self._cameras[1::2]
        return leg

    def _note_rim(self, kept: KeptView, cells: Mask, leg: int) -> None:
        if kept.laid.part_of(kept.laid.at_rim, self.cells, cells).any():
            return
        self.tally = replace(self.tally, whole=self.tally.whole + 1)
        if leg in self._shown_by:
            self._shown_by[leg] = replace(self._shown_by[leg], whole=self._shown_by[leg].whole + 1)


_MOST_SEEDS = 256  # uncertain candidates that are kept in any case ...
_MOST_SEEDS_PX = 8_000_000  # ... and while their pictures have no more pixels (110 MB)


class Seeds:
    """The uncertain candidates of the last views, the oldest first. `keep` changes them.

    `grid` holds the evidence; seeds are at least `least_cells` cells of `cell_m` and `gap` cells apart.
    """

    def __init__(
        self,
        grid: EvidenceGrid,
        cell_m: float,
        gap: int,
        least_cells: float,
        m_per_px: float,
    ) -> None:
        self._grid, self._cell_m, self._gap, self._least_cells = grid, cell_m, gap, least_cells
        self._m_per_px = m_per_px
        self._seeds: list[Candidate] = []

    def __iter__(self) -> Iterator[Candidate]:
        return iter(self._seeds)

    def keep(self, last: KeptView, evidence: CellEvidence, most_pictures: int) -> None:
        """Ask the view about the seeds, forget those that no view flags any more or that a candidate owns by now, and
        keep what the view flags besides, the surest first, with at most `most_pictures`."""
        view, laid = last.view, last.laid
        weak = laid.flagged & (evidence.owner == 0)
        kept = []
        for seed in self._seeds:
            here = seed.cells.within(laid.window)
            votes, owner = evidence.votes[here], evidence.owner[here]
            if not votes.size:
                kept.append(seed)
            elif (votes > 0).any() and not (owner > 0).any():
                kept.append(seed)
                self._ask(seed, last)
                weak[here] = False
        self._seeds = kept
        if most_pictures <= 0 or not weak.any():
            return
        for window in self._new(laid, weak)[:most_pictures]:
            seed = Candidate(0, window, view.time_ns)
            seed.pictures.show(view, *window.box_m(self._cell_m), self._m_per_px)
            self._ask(seed, last)
            self._seeds.append(seed)
        # Let the oldest go where there are too many: a large site has hundreds that only its
        # first photos show.
        sizes = [each.pictures.size_px for each in self._seeds]
        while len(sizes) > _MOST_SEEDS and sum(sizes) > _MOST_SEEDS_PX:
            del sizes[0], self._seeds[0]

    def _ask(self, seed: Candidate, kept: KeptView) -> None:
        seed.ask(kept, self._grid.read(seed.cells).changed > 0)

    def _new(self, laid: LaidView, weak: Mask) -> list[CellWindow]:
        """The windows of large enough `weak` pieces, the surest first."""
        found = [
            (
                float(laid.score[part][piece & weak[part]].max(initial=0)) / 255,
                laid.window.part(part),
            )
            for piece, part in pieces(weak, self._gap)
            if np.count_nonzero(piece & weak[part]) >= self._least_cells
        ]
        return [window for _, window in sorted(found, key=lambda each: -each[0])]
