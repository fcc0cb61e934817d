"""What views flag that is not certain yet, kept with its pictures: it may never be seen often enough for k of n."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sorvolo.change.evidence.candidate import GatheredChange, upright_weight
from sorvolo.change.evidence.cells import CellEvidence, CellGrid, CellWindow, LaidView, pieces
from sorvolo.geometry.arrays import Floats, ImageGray, Mask, Matrix3
from sorvolo.survey.findings import ComparedView

SHOWS = 0.12
"""Share of a change's cells that a view must flag to show it: from above a person covers few of them."""

_MOST_SEEDS = 256


@dataclass(frozen=True, eq=False)
class KeptView:
    """What is kept of one of the last views; it `counts` if the camera had moved on since the one before."""

    time_ns: int
    laid: LaidView
    camera_m: Floats
    site_from_image: Matrix3
    changed: ImageGray
    valid: Mask
    counts: bool

    def weight(self, window: CellWindow, cell_m: float) -> float:
        """What it counts in the share of a change there; nothing if the camera stands where it stood before."""
        return upright_weight(self.camera_m, np.mean(window.box_m(cell_m), axis=0)) * self.counts


class Seeds:
    """The uncertain changes of the last views, the oldest first. `keep` changes them.

    `grid` holds the evidence; seeds are at least `least_cells` cells of `cell_m` and `gap` cells apart.
    """

    def __init__(self, grid: CellGrid, cell_m: float, gap: int, least_cells: float, m_per_px: float) -> None:
        self._grid, self._cell_m, self._gap, self._least_cells = grid, cell_m, gap, least_cells
        self._m_per_px = m_per_px
        self._seeds: list[GatheredChange] = []

    def __iter__(self) -> Iterator[GatheredChange]:
        return iter(self._seeds)

    def keep(self, view: ComparedView, kept_view: KeptView, evidence: CellEvidence, budget: int) -> None:
        """Ask the view about what is kept, forget what no view flags any more or a change owns by now, and keep what
        the view flags besides, the surest first, with at most `budget` pictures."""
        laid = kept_view.laid
        weak = laid.flagged & (evidence.owner == 0)
        kept = []
        for seed in self._seeds:
            if seed.cells is None:
                continue
            here = seed.cells.within(laid.window)
            votes, owner = evidence.votes[here], evidence.owner[here]
            if not votes.size:
                kept.append(seed)
            elif (votes > 0).any() and not (owner > 0).any():
                kept.append(seed)
                self._ask(seed, view, kept_view)
                weak[here] = False
        self._seeds = kept
        if budget <= 0 or not weak.any():
            return
        candidates = [
            (float(laid.score[part][piece & weak[part]].max(initial=0)) / 255, laid.window.part(part))
            for piece, part in pieces(weak, self._gap)
            if np.count_nonzero(piece & weak[part]) >= self._least_cells
        ]
        for _, window in sorted(candidates, key=lambda each: -each[0])[:budget]:
            seed = GatheredChange(0, view.time_ns)
            seed.cells = window
            seed.show(view, *window.box_m(self._cell_m), self._m_per_px)
            self._ask(seed, view, kept_view)
            self._seeds.append(seed)
        del self._seeds[:-_MOST_SEEDS]

    def _ask(self, seed: GatheredChange, view: ComparedView, kept_view: KeptView) -> None:
        """Count what a view says of a seed's ground."""
        assert seed.cells is not None
        laid, cells = kept_view.laid, self._grid.read(seed.cells).changed > 0
        seen, flagged, score, place_m = laid.answer(seed.cells, cells, self._cell_m)
        weight = kept_view.weight(seed.cells, self._cell_m)
        if flagged >= max(SHOWS * seen, 1e-9):
            seed.see(view.time_ns, score, place_m if seen > 0.99 else None, view, weight)
            seed.from_camera(view.camera_m)
            seed.vote(view.site_from_image, view.changed, view.valid)
            seed.whole += not laid.part_of(laid.cut_off, seed.cells, cells).any()
            shown = laid.part_of(laid.flagged, seed.cells, cells)
            seed.held += bool(np.mean(laid.part_of(laid.held, seed.cells, cells)[shown]) > 0.5)
        elif seen >= 0.5:
            seed.miss(weight)
