"""A flight measured while it goes on: each frame is planted and searched once, as it gets its place."""

import time
from collections.abc import Sequence
from functools import partial

from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.search.measure import (
    KEEP_OFF_M,
    MeasuredFlight,
    SearchedPicture,
    SearchedPlants,
    SearchFrame,
    measured_class,
    planted_classes,
    reach_m,
    search_planted,
    strictest,
    sun_at,
)
from sorvolo.missions.search.settings import SearchSettings
from sorvolo.search.cells import Cells, cells_of
from sorvolo.search.conditions import AboveGround, FrameLook, gather, look_at
from sorvolo.search.drawing.frame_light import frame_light
from sorvolo.search.drawing.objects import Thing
from sorvolo.search.drawing.planted import new_plant
from sorvolo.search.outcomes import near_any, rows_of
from sorvolo.search.plant_places import PlantField, PlantPlace
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame
from sorvolo.tracking.laying import pose_of
from sorvolo.tracking.map_objects import reported_plants

_AROUND_M = 6.0  # of a plant: sightings farther away are of other things; more than its own length
_REACH_M = 5.0  # beside a frame's ground: what stands there leans or throws its shadow in


class GrowingMeasure:
    """The measure of a flight that goes on, over a site with metres.

    `add` takes one frame after another, `measured` gives what all of them state together. Plants stand in a field that
    was sown before anybody saw it (`PlantField`), so that all frames of a place show the same; a frame is planted on
    the place that it has when it is added, and its sightings are laid by that. What turns out to be under trees or
    roofs does not count as planted, but where `through_crowns` is given. `keep_off_m` and `above` as `measure_flight`
    takes them. A flight that climbs shows too many plants at once: a wider field is sown then, and what was measured
    from below is forgotten.
    """

    def __init__(
        self,
        name: str,
        site: Site,
        detector: ObjectDetector,
        settings: SearchSettings,
        *,
        area_m: Sequence[Sequence[PointsM]] | None,
        keep_off_m: Sequence[Floats],
        above: AboveGround | None,
    ) -> None:
        self._name, self._site, self._detector, self._settings = name, site, detector, settings
        self._area_m, self._keep_off_m, self._above = area_m, keep_off_m, above
        self._wanted = planted_classes(detector, settings)
        self._field: PlantField | None = None
        self._things: list[Thing] = []
        self._looks: list[FrameLook] = []
        self._pictures: dict[int, tuple[PlacedFrame, Sequence[int], SearchedPicture]] = {}
        self._fresh: set[int] = (
            set()
        )  # plants that were shown since it was last asked which are reported
        self._reported: set[int] = set()
        self._least: dict[str, float] = {}
        self._has_shadows = self._is_thermal = False
        self._blur_px = self._seconds = 0.0
        self.frames: list[SearchFrame] = []
        """The frames that were added."""

    def add(self, frame: SearchFrame) -> None:
        """Plant into a frame and search it."""
        started_s, outline_m = time.monotonic(), frame.placed.outline_m
        if self._field is None or not self._field.fits(outline_m):
            self._forget()
            self._field = PlantField(
                self._wanted,
                outline_m,
                keep_off_m=self._keep_off_m,
                free_m=KEEP_OFF_M,
                seed=self._settings.seed,
            )
        pose, image = pose_of(frame.placed), frame.image()
        assert pose is not None  # frames without a place are none of these
        light, sun = frame_light(image), sun_at(frame, self._site, self._settings)
        look = look_at(image, frame.placed.camera, pose, light.blur_px, sun)
        numbers = self._field.near(outline_m, _REACH_M)
        self._grow(self._field)
        things = [self._things[each] for each in numbers]
        under = gather(
            [look], [each.place_m(0)[:2] for each in things], 0.5, self._above
        ).under_trees
        shown = [
            self._settings.through_crowns if hidden and self._settings.through_crowns else 1.0
            for hidden in under
        ]
        seed = self._settings.seed + frame.placed.index
        seen = search_planted(
            frame, image, light, things, sun, shown, seed, self._detector, self._wanted
        )
        if seen is not None:
            self._pictures[frame.placed.index] = frame.placed, numbers, seen
            self._fresh.update(numbers)
            self._least = strictest(self._least, seen.least)
        self._looks.append(look)
        self.frames.append(frame)
        self._has_shadows |= sun is not None
        self._is_thermal |= light.is_thermal
        self._blur_px = max(self._blur_px, light.blur_px)
        self._seconds += time.monotonic() - started_s

    def measured(self, beside_m: Sequence[PointsM] = ()) -> tuple[Cells, MeasuredFlight]:
        """The cells of the ground by now, and what the frames so far state of them. At least one was added.

        The ground of other flights' frames, (4, 2) site metres each, counts as flown as well.
        """
        outlines_m = [*beside_m, *(each.placed.outline_m for each in self.frames)]
        cells = cells_of(outlines_m, self._site, self._area_m)
        places = [] if self._field is None else self._field.places
        self._judge_fresh(places)
        conditions_at = partial(gather, self._looks, above=self._above)
        at = conditions_at([each.place_m for each in places], 0.5)
        hides = at.roofs if self._settings.through_crowns > 0 else at.roofs | at.beside_trees
        gathered = [
            (place, number in self._reported)
            for number, (place, hidden) in enumerate(zip(places, hides))
            if not hidden
        ]
        classes = tuple(
            measured_class(
                label,
                conditions_at(cells.centres_m, reach_m(label)),
                gathered,
                conditions_at,
                self._settings,
            )
            for label in self._wanted
        )
        searched = SearchedPlants(len(self._pictures), 1, self._seconds, tuple(gathered))
        return cells, MeasuredFlight(
            self._name,
            len(self.frames),
            searched,
            self._has_shadows,
            self._above is not None,
            self._is_thermal,
            self._blur_px,
            classes,
        )

    def _judge_fresh(self, places: Sequence[PlantPlace]) -> None:
        """Find out anew which plants are reported, of those that were shown since: what is far from them stays."""
        if not self._fresh:
            return
        fresh_m = [places[each].place_m for each in self._fresh]
        known = near_any([each.place_m for each in places], fresh_m, 2 * _AROUND_M)
        wanted = set(known)
        pictures = [each for each in self._pictures.values() if not wanted.isdisjoint(each[1])]
        boxes = {
            placed.index: rows_of(seen.boxes_px, numbers, known)
            for placed, numbers, seen in pictures
        }
        laid = [each for _, _, seen in pictures for each in seen.laid]
        near = near_any([each.sighting.position_m for each in laid], fresh_m, _AROUND_M)
        labels = [places[each].label for each in known]
        frames = [placed for placed, _, _ in pictures]
        reported = reported_plants(
            [laid[each] for each in near], frames, boxes, labels, self._least
        )
        self._reported -= self._fresh
        self._reported |= {known[row] for row in reported} & self._fresh
        self._fresh.clear()

    def _forget(self) -> None:
        """Begin anew with another field: the flight has climbed, and its first pictures show little."""
        self._things.clear()
        self._looks.clear()
        self._pictures.clear()
        self._fresh.clear()
        self._reported.clear()
        self.frames.clear()

    def _grow(self, field: PlantField) -> None:
        """Make the things that stand at the field's new places."""
        for number in range(len(self._things), len(field.places)):
            place = field.places[number]
            self._things.append(new_plant(number, place.label, place.place_m, self._settings.seed))
