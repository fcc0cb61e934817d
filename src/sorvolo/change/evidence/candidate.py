"""A candidate for a change while views come in: its ground, what views reported of it, and its pictures.

Seeds are candidates that are not certain yet: they may never be seen often enough for k of n views.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from sorvolo.change.evidence.announcing import Tally
from sorvolo.change.evidence.candidate_pictures import Pictures, PictureSettings
from sorvolo.change.evidence.cells import (
    CellEvidence,
    CellGrid,
    CellReport,
    CellWindow,
    LaidView,
    pieces,
)
from sorvolo.change.evidence.levelness import Sights
from sorvolo.change.shape.kinds import kind_of
from sorvolo.change.shape.outlines import measures
from sorvolo.change.shape.place_sigma import aside_of, place_sigma_m
from sorvolo.geometry.arrays import Floats, ImageGray, Mask, Matrix3, PointsM
from sorvolo.survey.findings import Change, ChangeKind, ComparedView


@dataclass(frozen=True)
class CandidateSettings:
    """When a view counts for a candidate, in shares of its cells, and what is kept (before 0014)."""

    shows: float = 0.12  # a view that flags less of what it sees misses it: from above a person covers few cells
    seen: float = 0.5  # a view that sees less is not asked
    all_seen: float = 0.99  # a view that sees more knows its place
    most_places: int = 64  # of views, for the spread of its place
    most_cameras: int = 256  # of views that show it; of more every second one is kept
    most_legs: int = 64  # of followed blobs that showed it; the oldest are forgotten
    most_seeds: int = 256  # uncertain candidates that are kept in any case ...
    most_seeds_px: int = (
        8_000_000  # ... and while their pictures have no more pixels (110 MB); the oldest go first
    )


@dataclass(frozen=True, eq=False)
class KeptView:
    """What is kept of one of the last views; it `counts` if the camera had moved on since the one before."""

    time_ns: int
    laid: LaidView
    camera_m: Floats
    site_from_image: Matrix3
    changed: ImageGray
    valid: Mask
    residual_m: float  # of its alignment with the map
    counts: bool


class Candidate:
    """All that views reported of one possible change.

    `recall`, `see`, `ask` and `miss` take views in; `extend`, `recount` and `joined` follow its ground; `become` gives
    a seed a number.
    """

    def __init__(
        self,
        number: int,
        cells: CellWindow,
        first_seen_ns: int,
        settings: CandidateSettings = CandidateSettings(),
        pictures: PictureSettings = PictureSettings(),
    ) -> None:
        self.number = number
        self.pictures = Pictures(pictures)
        self.sights = Sights()
        self._settings = settings
        self._cells = cells
        self._tally = Tally(first_seen_ns, first_seen_ns)
        self._places: list[Floats] = []
        self._cameras: list[Floats] = []
        self._shown_by: dict[
            int, Tally
        ] = {}  # the views in which a followed blob showed it, by its leg
        self._kind: ChangeKind | None = None
        self._kind_outline: PointsM | None = None

    @property
    def cells(self) -> CellWindow:
        """The window of its cells."""
        return self._cells

    @property
    def tally(self) -> Tally:
        """What the views reported so far."""
        return self._tally

    def shown_by(self, which: Callable[[int], bool]) -> list[Tally]:
        """The views in which blobs showed it that were followed, on `which` legs: one tally for each of these."""
        return [each for leg, each in self._shown_by.items() if which(leg)]

    @property
    def cameras_m(self) -> PointsM:
        """(N, 3) where views that show it were taken, of many a part."""
        return np.array(self._cameras).reshape(-1, 3)

    def extend(self, window: CellWindow) -> None:
        """It reaches into this window, too."""
        self._cells = self._cells.joined(window)

    def recall(self, view: KeptView, cells: Mask, cell_m: float) -> None:
        """Count a view from before the candidate was found, whose `cells` lie in its window, and its mask."""
        report = view.laid.report(self._cells, cells, cell_m)
        if report.seen < self._settings.seen:
            return
        if report.flagged < self._settings.shows * report.seen:
            self.miss()
            return
        self._count(view, report, cells, residual_m=0.0, knows_place=True)
        self.pictures.vote(view.site_from_image, view.changed, view.valid)

    def see(self, view: KeptView, cells: Mask, cell_m: float) -> bool:
        """Count this view; whether it shows the candidate. One that sees less than half of it does not count, unless
        the candidate is as large as the view."""
        report = view.laid.report(self._cells, cells, cell_m)
        is_large = max(self._cells.shape) > 0.5 * max(view.laid.window.shape)
        if report.seen < self._settings.seen and not (is_large and report.flagged > 0):
            return False
        if report.flagged < self._settings.shows * report.seen:
            self.miss()
            return False
        leg = self._count(
            view, report, cells, view.residual_m, knows_place=report.seen > self._settings.all_seen
        )
        self._note_rim(view, cells, leg)
        return True

    def ask(self, view: KeptView, cells: Mask, cell_m: float) -> bool:
        """Count this view as for a seed: whatever shows some of it shows it; and its mask. Whether it does."""
        report = view.laid.report(self._cells, cells, cell_m)
        if report.flagged >= max(self._settings.shows * report.seen, 1e-9):
            leg = self._count(
                view,
                report,
                cells,
                view.residual_m,
                knows_place=report.seen > self._settings.all_seen,
            )
            self.pictures.vote(view.site_from_image, view.changed, view.valid)
            self._note_rim(view, cells, leg)
            return True
        if report.seen >= self._settings.seen:
            self.miss()
        return False

    def miss(self, times: int = 1) -> None:
        """One more view that could have shown it, or several, do not."""
        self._tally = self._tally.without_view(times)

    def recount(self, views: int, asked: int) -> None:
        """Count anew what views reported: `views` of `asked` flagged what is left of it."""
        self._tally = self._tally.recounted(views, asked)
        self._shown_by.clear()

    def become(self, number: int) -> None:
        """A seed grows up."""
        self.number = number

    def note_restlessness(self, restless: float) -> None:
        """The share of the views of the ground around that flag it for nothing, as measured last."""
        self._tally = replace(self._tally, restless=restless)

    def outline_m(self, cells: Mask, cell_m: float, join_m: float) -> PointsM | None:
        """(N, 2) its outline; `cells` is the raster of its own cells in its window."""
        return self.pictures.outline_m(self._cells, cells, cell_m, join_m)

    def record(
        self, id_prefix: str, outline_m: PointsM, cell_m: float, score: float, announced_ns: int
    ) -> Change:
        """What is known of it.

        `sigma_m` is that of `place_sigma_m`, and the spread of its middle over the views, per axis, / sqrt(views).
        Raises GeometryError if it has no pictures.
        """
        patch, tally = self.pictures.patch(outline_m), self._tally
        if self._kind is None or self._kind_outline is not outline_m:
            self._kind, self._kind_outline = kind_of(patch), outline_m
        size = measures(outline_m)
        residual_m = tally.residual_m_sum / max(tally.views, 1)
        spread_m = (
            float(np.sqrt(np.mean(np.var(self._places, axis=0)))) if len(self._places) > 1 else 0.0
        )
        placed_m = place_sigma_m(residual_m, cell_m, aside_of(outline_m, self.cameras_m))
        sigma_m = np.hypot(placed_m, spread_m / np.sqrt(max(len(self._places), 1)))
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
            float(sigma_m),
            patch,
            announced_ns=announced_ns,
        )

    def joined(self, other: "Candidate", number: int) -> "Candidate":
        """This candidate and another that became one with it, under a number; the other is not to be used any more.

        What the views reported of this one, and its pictures, count.
        """
        self.number = number
        self._tally = replace(
            self._tally,
            first_seen_ns=min(self._tally.first_seen_ns, other.tally.first_seen_ns),
            last_seen_ns=max(self._tally.last_seen_ns, other.tally.last_seen_ns),
        )
        self.extend(other.cells)
        return self

    def _count(
        self,
        view: KeptView,
        report: CellReport,
        cells: Mask,
        residual_m: float,
        *,
        knows_place: bool,
    ) -> int:
        """Count a view that shows it; the leg of the followed blob that shows it there, 0 for none."""
        seen = view.time_ns, report.score, residual_m, view.camera_m
        self._tally = self._tally.with_view(*seen)
        leg = view.laid.leg_of(self._cells, cells)
        if leg:
            known = self._shown_by.get(leg, Tally(view.time_ns, view.time_ns))
            self._shown_by[leg] = known.with_view(*seen)
            if len(self._shown_by) > self._settings.most_legs:
                del self._shown_by[next(iter(self._shown_by))]
        self._cameras.append(view.camera_m)
        if len(self._cameras) > self._settings.most_cameras:
            del self._cameras[1::2]
        if knows_place and len(self._places) < self._settings.most_places:
            self._places.append(report.place_m)
        return leg

    def _note_rim(self, view: KeptView, cells: Mask, leg: int) -> None:
        if view.laid.part_of(view.laid.cut_off, self._cells, cells).any():
            return
        self._tally = replace(self._tally, whole=self._tally.whole + 1)
        if leg in self._shown_by:
            self._shown_by[leg] = replace(self._shown_by[leg], whole=self._shown_by[leg].whole + 1)


class Seeds:
    """The uncertain candidates of the last views, the oldest first. `keep` changes them.

    `grid` holds the evidence; seeds are at least `least_cells` cells of `cell_m` and `gap` cells apart.
    """

    def __init__(
        self,
        grid: CellGrid,
        cell_m: float,
        gap: int,
        least_cells: float,
        m_per_px: float,
        settings: CandidateSettings,
        pictures: PictureSettings,
    ) -> None:
        self._grid, self._cell_m, self._gap, self._least_cells = grid, cell_m, gap, least_cells
        self._m_per_px, self._settings, self._pictures = m_per_px, settings, pictures
        self._seeds: list[Candidate] = []

    def __iter__(self) -> Iterator[Candidate]:
        return iter(self._seeds)

    def sights_at(self, window: CellWindow) -> Sights | None:
        """The pictures of the surroundings that a seed in a window has, of several the most; None where there is no
        seed."""
        there = (each.sights for each in self._seeds if 0 not in each.cells.overlap(window).shape)
        return max(there, key=lambda each: len(each.pictures), default=None)

    def keep(
        self, view: ComparedView, kept_view: KeptView, evidence: CellEvidence, most_pictures: int
    ) -> None:
        """Ask the view about the seeds, forget those that no view flags any more or that a candidate owns by now, and
        keep what the view flags besides, the surest first, with at most `most_pictures`."""
        laid = kept_view.laid
        weak = laid.flagged & (evidence.owner == 0)
        kept = []
        for seed in self._seeds:
            here = seed.cells.within(laid.window)
            votes, owner = evidence.votes[here], evidence.owner[here]
            if not votes.size:
                kept.append(seed)
            elif (votes > 0).any() and not (owner > 0).any():
                kept.append(seed)
                self._ask(seed, view, kept_view)
                weak[here] = False
        self._seeds = kept
        if most_pictures <= 0 or not weak.any():
            return
        for window in self._new(laid, weak)[:most_pictures]:
            seed = Candidate(0, window, view.time_ns, self._settings, self._pictures)
            seed.pictures.show(view, *window.box_m(self._cell_m), self._m_per_px)
            self._ask(seed, view, kept_view)
            self._seeds.append(seed)
        self._forget()

    def _ask(self, seed: Candidate, view: ComparedView, kept_view: KeptView) -> None:
        if seed.ask(kept_view, self._grid.read(seed.cells).changed > 0, self._cell_m):
            seed.sights.show(view, *seed.cells.box_m(self._cell_m), self._m_per_px)

    def _forget(self) -> None:
        """Let the oldest go where there are too many: a large site has hundreds that only its first photos show."""
        settings = self._settings
        sizes = [each.pictures.size_px for each in self._seeds]
        while len(sizes) > settings.most_seeds and sum(sizes) > settings.most_seeds_px:
            del sizes[0], self._seeds[0]

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
