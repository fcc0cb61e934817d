"""The moving things of a flight as they are announced: one change each, brought up to date while it is seen."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sorvolo.change.motion.blob_tracker import BlobTrack, MovingBlobs
from sorvolo.change.motion.blobs import standing_outline_m
from sorvolo.change.shape.outlines import measures
from sorvolo.change.shape.patches import PatchWindow, cut, patch_of
from sorvolo.change.shape.place_sigma import aside_of, place_sigma_m
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.survey.findings import Change, ChangeKind, ComparedView


class Movers:
    """What moved during one flight. `see` changes it.

    `id_prefix` begins every change's id, `m_per_px` is a pixel of changes' pictures, `cell_m` a side of the evidence's
    cells.
    """

    def __init__(self, id_prefix: str, m_per_px: float, cell_m: float) -> None:
        self._prefix, self._m_per_px, self._cell_m = id_prefix, m_per_px, cell_m
        self._known: dict[int, Change] = {}  # by the tracker's number
        self._legs: set[int] = set()

    @property
    def changes(self) -> tuple[Change, ...]:
        """All of them as they were seen last."""
        return tuple(self._known.values())

    def knows(self, leg: int) -> bool:
        """Whether something was seen to move on a leg of its track."""
        return leg in self._legs

    def see(
        self,
        view: ComparedView,
        moving: MovingBlobs,
        named: Callable[[int], tuple[int, int | None]],
    ) -> list[Change]:
        """Bring what moves in this view up to date; those announced first. `named` gives the number of the change that
        a leg of a track becomes, and when that was announced already; None if it was not."""
        announced = []
        for gone, kept in moving.merged.items():
            twice = self._known.pop(gone, None)
            if twice is not None:
                self._known.setdefault(kept, twice)
        for track in moving.movers:
            self._legs.add(track.leg)
            known = self._known.get(track.number)
            if known is None:
                number, announced_ns = named(track.leg)
                change = self._change(view, track, f"{self._prefix}-{number}")
                if announced_ns is None:
                    announced.append(change)
                else:
                    change = replace(change, announced_ns=announced_ns)
            else:
                change = self._change(view, track, known.id)
                change = replace(
                    change,
                    first_seen_ns=known.first_seen_ns,
                    views=max(change.views, known.views + 1),
                    announced_ns=known.announced_ns,
                )
            self._known[track.number] = change
        return announced

    def _change(self, view: ComparedView, track: BlobTrack, change_id: str) -> Change:
        """A moving thing as this view shows it."""
        m_per_px = view.m_per_px
        outline_m = standing_outline_m(view, track.last.blob)
        if outline_m is None:
            outline_m = _square(track.last.blob.place_m, self._cell_m)
        window = PatchWindow.around(
            outline_m.min(axis=0), outline_m.max(axis=0), self._m_per_px, 512
        )
        size = measures(outline_m)
        residual_m = view.residual_px * m_per_px if np.isfinite(view.residual_px) else 0.0
        score = track.score_sum / track.count * (track.count + 1) / (track.count + 2)
        return Change(
            change_id,
            ChangeKind.MOVING,
            float(np.clip(score, 0, 1)),
            outline_m,
            track.first.time_ns,
            track.last.time_ns,
            track.count,
            size.area_m2,
            size.length_m,
            place_sigma_m(residual_m, self._cell_m, aside_of(outline_m, view.camera_m[None])),
            patch_of(window, cut(view, window), outline_m),
            track.velocity_m_s,
            announced_ns=view.time_ns,
        )


def _square(place_m: Floats, side_m: float) -> PointsM:
    return place_m + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side_m / 2
