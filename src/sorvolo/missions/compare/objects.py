"""Objects beside a comparison: frames that fit the map are searched for them, and they name what changes are."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from sorvolo.capture.source import LiveSource
from sorvolo.change.views import ViewMaker, ViewOutcome
from sorvolo.findings.register import (
    GroundFinding,
    MissionSighting,
    SearchedDate,
    associate,
    begun_and_ended,
)
from sorvolo.missions.compare.classes import ChangeClasses, class_at, object_of
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.looked_at import searched_document
from sorvolo.missions.flight.map_objects import ObjectFinder, search_summary, why_not_searched
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.flight.settings import CompareSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.mosaic.selection import StretchSelection
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.change_records import stored_changes
from sorvolo.store.site.register import sighting_of, sightings_of_change
from sorvolo.survey.findings import Change, ChangeKind
from sorvolo.survey.flight import Notice, PosedFrame, Site
from sorvolo.survey.map_objects import ObjectSearch
from sorvolo.survey.mosaic import PlacedFrame

_OVERLAP = 0.75  # of frames that are searched


class ComparisonObjects:
    """A detector's part in one comparison; without a detector nothing is searched and no change has a class."""

    def __init__(
        self,
        detector: ObjectDetector | None,
        setup: FlightSetup,
        archive: Archive,
        base_version: int,
        settings: CompareSettings,
        memo: ResultCache,
    ) -> None:
        """`settings.classes` are looked for, in frames as in the changes' own pictures."""
        self._name, self._settings = setup.source.name, settings
        self._selection = StretchSelection(_OVERLAP, keep_all=setup.source.kind != "video")
        self._finder: ObjectFinder | None = None
        self._classes: ChangeClasses | None = None
        self._archive = archive
        made = archive.versions()
        self._before = {each.flight_id for each in made if each.id <= base_version} - {self._name}
        is_new = self._before == {each.flight_id for each in made}
        self._known_by = None if is_new else self._before
        if detector is not None:
            known = [each.thing for each in archive.newest_objects(self._known_by)]
            self._classes = ChangeClasses(detector, known, settings.classes)
            live_folder = archive.folder if isinstance(setup.source, LiveSource) else None
            self._finder = ObjectFinder(
                detector,
                setup.source.camera.camera,
                settings.classes,
                live_folder=live_folder,
                memo=memo,
            )

    def close(self) -> None:
        """End the detector's thread."""
        if self._finder is not None:
            self._finder.close()

    @property
    def notices(self) -> tuple[Notice, ...]:
        """What the detector would have a user know of the frames."""
        return () if self._finder is None else self._finder.notices

    def search(self, posed: PosedFrame, outcome: ViewOutcome, views: ViewMaker) -> None:
        """Have a frame that fits the map searched, each stretch of ground in a few of them."""
        if self._finder is None or outcome.site_from_image is None:
            return
        outline_m = views.pixels.ground_m(posed, outcome.site_from_image)
        if outline_m is not None and self._selection.take(outline_m):
            self._finder.look(posed)

    def named(self, announced: Sequence[Change]) -> Sequence[Change]:
        """The changes with their classes so far: by their own pictures and the known objects alone."""
        if self._classes is None:
            return announced
        return [self._classes.final(each, (), ()) for each in announced]

    def conclude(self, placed: Sequence[PlacedFrame]) -> ObjectSearch | None:
        """The flight's objects by its frames' final places; None: nobody searched."""
        if self._finder is None:
            return None
        return self._finder.conclude(placed, self._name, has_metres=True)

    def on_one_date(self, search: ObjectSearch | None) -> list[tuple[ChangeKind, GroundFinding]]:
        """The objects that this flight or those before it found on ground where the other found none; what has no
        known size is left out."""
        if search is None:
            return []
        look = SearchedDate(self._name, math.inf, search.frames)
        register = self._archive.register(_sightings(search, self._name), [look], self._known_by)
        return [
            (kind, each)
            for kind, each in begun_and_ended(register, self._before, self._name)
            if math.isfinite(each.newest.length_m)
        ]

    def classified(
        self, changes: list[Change], search: ObjectSearch | None
    ) -> tuple[list[Change], ObjectSearch | None]:
        """The changes with their classes, after `conclude`, and the search, as both agree."""
        if self._finder is None or self._classes is None or search is None:
            return changes, search
        named = [
            self._classes.final(each, search.objects, self._finder.sightings) for each in changes
        ]
        return settled(named, search, self._name)

    def summary(
        self, search: ObjectSearch | None, placed: Sequence[PlacedFrame], site: Site
    ) -> tuple[dict[str, Any], dict[str, bytes]]:
        """The report's part on objects, and the outlines of the ground that was looked at."""
        if self._finder is None:
            return search_summary(None, None, 0.0, why_not_searched(self._settings.model)), {}
        # without metres pictures are counted, and each stretch of ground is in a few that are searched
        enough = 0.0 if site.is_local else self._settings.enough_looked_at
        looked, ground = self._finder.looked_at(placed, site, enough)
        return search_summary(search, looked, self._finder.seconds), searched_document(ground, site)


def settled(
    changes: Sequence[Change], search: ObjectSearch, flight: str
) -> tuple[list[Change], ObjectSearch]:
    """A flight's changes, with their classes, and its search, as one list of things: what left by a change and is found
    there has not left, and what came or moves by a change alone, of a class that was looked for, is found."""
    seen, detected = _sightings(search, flight), {each.id for each in search.objects}
    for change in stored_changes(flight, changes):
        seen += sightings_of_change(change, math.inf, "before", None)
    findings = associate(seen).findings
    still = {
        each.id for found in findings if not found.gone for each in found.sightings if each.gone
    }
    alone = {
        each.id
        for found in findings
        if detected.isdisjoint(each.id for each in found.sightings)
        for each in found.sightings
        if each.label in search.classes and not each.gone
    }
    kept = [each for each in changes if each.kind is ChangeKind.REPLACED or each.id not in still]
    others = [
        object_of(each) for each in kept if each.id in alone and not class_at(each, search.objects)
    ]
    return kept, replace(search, objects=(*search.objects, *others))


def _sightings(search: ObjectSearch, flight: str) -> list[MissionSighting]:
    return [sighting_of(each, flight, math.inf) for each in search.objects]
