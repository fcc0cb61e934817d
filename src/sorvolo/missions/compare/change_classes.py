"""What a change is, before and after: people, cars and small objects that the flights saw there."""

from collections.abc import Sequence
from dataclasses import replace

from sorvolo.change.classes import (
    LENIENT,
    can_show,
    class_of_change,
    enlarged,
    object_at,
    seen_at,
    stands_in,
)
from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.survey.findings import Change, ChangeKind
from sorvolo.survey.map_objects import MapObject
from sorvolo.survey.objects import Sighting

_HAS_BEFORE = (ChangeKind.DISAPPEARED, ChangeKind.REPLACED)
_HAS_AFTER = (ChangeKind.APPEARED, ChangeKind.REPLACED, ChangeKind.MOVING)


class ChangeClasses:
    """Names what changes are. `known` are the objects that stood on the map before the flight.

    A change's own pictures are searched for `classes`; without any, for all that the model knows, also those that it
    reports on request alone: there the ground itself shows that something changed.
    """

    def __init__(
        self, detector: ObjectDetector, known: Sequence[MapObject], classes: Sequence[str] = ()
    ) -> None:
        self._detector, self._known, self._wanted = detector, known, tuple(classes) or None

    def preliminary(self, change: Change) -> Change:
        """The change with its classes by its own pictures and the known objects alone: while the flight goes on."""
        return self.final(change, (), ())

    def final(
        self, change: Change, found: Sequence[MapObject], sightings: Sequence[Sighting]
    ) -> Change:
        """The change with its classes, "" where nothing is recognised: of the objects that were there before or after;
        else of the flight's sightings there; else of what the detector finds in the change's own pictures.

        `found` and `sightings` are those of the flight, by its frames' final places. Where something left and a found
        object of about its size stands in its outline, or something came where a known one stood, it was replaced.
        """
        others = {ChangeKind.DISAPPEARED: found, ChangeKind.APPEARED: self._known}.get(
            change.kind, ()
        )
        if any(stands_in(change, each) for each in others):
            change = replace(change, kind=ChangeKind.REPLACED)
        before = after = ""
        if change.kind in _HAS_BEFORE:
            before = object_at(change, self._known) or self._in_picture(change, change.patch.before)
        if change.kind in _HAS_AFTER:
            after = "" if change.kind is ChangeKind.MOVING else object_at(change, found)
            after = (
                after or seen_at(change, sightings) or self._in_picture(change, change.patch.after)
            )
        return replace(change, class_before=before, class_after=after)

    def _in_picture(self, change: Change, rgba: ImageRGBA) -> str:
        """The class that the detector finds where a picture of the change shows it; "" where it finds none."""
        if not can_show(change.patch, rgba):
            return ""
        picture, offset_px = enlarged(rgba)
        thresholds = self._detector.thresholds_for(picture)
        seen = self._detector.detect(
            picture,
            tiles="auto",
            m_per_px=change.patch.m_per_px,
            least_score=LENIENT * min(thresholds.values(), default=0.5),
            classes=self._wanted,
            is_part=True,
        )
        return class_of_change(change.patch, seen, thresholds, offset_px)
