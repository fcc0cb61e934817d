"""What a later flight's views show to have changed: things, areas, and what only all its views together show."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from sorvolo.capture.source import LiveSource, Source
from sorvolo.change.areas import AreaMap
from sorvolo.change.evidence import EvidenceMap, EvidenceSettings
from sorvolo.change.gathered import GatheredThings
from sorvolo.change.reconcile import reconcile
from sorvolo.change.views import ViewMaker
from sorvolo.findings.register import GroundFinding
from sorvolo.geometry.arrays import Mask
from sorvolo.missions.compare.extension import NIGHT
from sorvolo.missions.flight.settings import CompareSettings
from sorvolo.mosaic.selection import StretchSelection
from sorvolo.survey.findings import Change, ChangeKind, ComparedView

# longest side of a compared picture; a video's frames come faster, and show a place more often
_VIDEO_PX, _PHOTO_PX = 1280, 1600
_FINER = 2.0  # times a photo's and the map's own pixels, at most: half of the pixels are compared
_OVERLAP = 0.8  # of a video's frames of which learned differences are gathered, as photos overlap
_FINE_M_PER_PX = 0.07  # a car has 60 px: finer gains nothing, and large smooth ground loses


@dataclass(frozen=True)
class ComparePlan:
    """At which scale a flight's frames are compared, and of which of them learned differences are gathered."""

    side_px: int  # longest side of a compared picture
    finer: float  # times as fine as frame and map a compared picture may be
    gathers: bool  # learned differences: where the map shows things with few pixels
    overlap: float | None  # of the frames that they are gathered of; None: of all
    larger: float  # times as large as they are compared, frames are looked at for them

    @classmethod
    def of(cls, source: Source, map_m_per_px: float, settings: CompareSettings) -> "ComparePlan":
        """Plan a comparison; a stream leaves no time for learned differences."""
        is_photos = source.kind == "photos"
        fine = 1.0
        if settings.method is None:
            fine = min(max(map_m_per_px / _FINE_M_PER_PX, 1.0), _FINER)
        return cls(
            _VIDEO_PX if source.kind == "video" else _PHOTO_PX,
            fine if is_photos else 1.0,
            fine > 1.0 and (is_photos or not isinstance(source, LiveSource)),
            None if is_photos else _OVERLAP,
            1.0 if is_photos else fine,
        )


class FlightChanges:
    """The changes of a flight. `add` takes a view in, `conclude` follows the last one.

    `plan` says whether learned differences are gathered too.
    """

    def __init__(
        self,
        flight: str,
        views: ViewMaker,
        settings: CompareSettings,
        plan: ComparePlan,
    ) -> None:
        self._flight, self._views, self._settings = flight, views, settings
        self._evidence: EvidenceMap | None = None
        self._areas = AreaMap()
        self._gathered = GatheredThings(plan.larger) if plan.gathers else None
        self._selection = StretchSelection(plan.overlap or 0.0, keep_all=plan.overlap is None)
        self._numbers = itertools.count(
            1
        )  # of the changes' ids that are still free, after `conclude`

    def add(self, view: ComparedView, leans: Mask | None) -> Sequence[Change]:
        """Add a compared view to the evidence; the changes announced by it."""
        if self._evidence is None:
            self._evidence = EvidenceMap(
                self._views.change_m_per_px(view),
                EvidenceSettings(k=self._settings.votes, n=self._settings.voters),
                self._flight,
            )
        announced = self._evidence.add(view)
        if self._settings.method is None:
            self._areas.add(view, leans)
        if self._gathered is not None and self._selection.take(view.outline_m):
            self._gathered.add(view, leans)
        return announced

    def conclude(self) -> Sequence[Change]:
        """All changes of the flight, after its last view."""
        if self._evidence is None:
            return ()
        evidence, gathered = self._evidence, self._gathered
        things = evidence.conclude() if gathered is None else evidence.conclude(gathered.shows_once)
        first = evidence.next_number
        # in the dark the ground has neither its structure nor its colour
        areas = () if self._views.brightness < NIGHT else self._areas.conclude(self._flight, first)
        self._numbers = itertools.count(first + len(areas))
        return reconcile(things, areas, gathered, self._flight, self._numbers)

    def of_objects(
        self, changes: Sequence[Change], objects: Sequence[tuple[ChangeKind, GroundFinding]]
    ) -> list[Change]:
        """After `conclude`: those objects, found on one date alone, that none of `changes`, as they are reported,
        holds, on ground that differs as well. Only where learned differences are gathered."""
        result: list[Change] = []
        if self._gathered is None:
            return result
        for kind, each in objects:
            newest, others = each.newest, [*changes, *result]
            change = self._gathered.standing_at(each.position_m, newest.length_m, others)
            if change is not None:
                own_id = f"{self._flight}-{next(self._numbers)}"
                result.append(replace(change, id=own_id, kind=kind, score=newest.score))
        return result

    def candidates(self) -> dict[str, Any] | None:
        """What became of all candidates, for the report; None if no view was compared."""
        return None if self._evidence is None else self._evidence.outcomes()
