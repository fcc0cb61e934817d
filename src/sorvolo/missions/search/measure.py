"""One flight measured: plants into its own frames, the detector over them, and what a map would have reported."""

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from sorvolo.canopy.integral import LEAST_VIEWS
from sorvolo.detection.fusing import is_from_above
from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import BoxesPx, Floats, ImageRGB, PointsM, Vector3
from sorvolo.geometry.sun import direction_from_angles
from sorvolo.heights.field import HeightField
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.map_objects import check_classes
from sorvolo.missions.flight.setup import sun_over
from sorvolo.missions.search.settings import SearchSettings
from sorvolo.search.cells import Cells, cells_of
from sorvolo.search.conditions import AboveGround, Conditions, FrameLook, gather, look_at
from sorvolo.search.drawing.cut_outs import CutOut, CutThing
from sorvolo.search.drawing.objects import Thing
from sorvolo.search.drawing.planted import FrameLight, frame_light, new_plant, plant
from sorvolo.search.outcomes import Outcomes, any_of, every_label, found_rows, near_any, rows_of
from sorvolo.search.plant_places import PlantField, PlantPlace, plant_places, seeded
from sorvolo.search.recall import Chances, Recall, fit_recall, map_chances
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame
from sorvolo.survey.objects import CLASSES, PERSON, TYPICAL_SIZE_M
from sorvolo.tracking.laying import LaidSighting, lay_on_ground, pose_of
from sorvolo.tracking.map_objects import reported_plants
from sorvolo.tracking.view_evidence import least_seen

Planted: TypeAlias = tuple[PlantPlace, bool]
"""Where one plant stood, and whether a map would report it."""

KEEP_OFF_M = 4.0  # plants from what a map shows already
_LEAST_FREE = 0.1  # of the views of a floor: a roof leaves none, few chance levels; by choice
_MOST_DETECTIONS = 60  # of one frame beside its plants, as maps take them


@dataclass(frozen=True, eq=False)
class SearchFrame:
    """A frame on its final place, and how to get its picture."""

    placed: PlacedFrame
    image: Callable[[], ImageRGB]


@dataclass(frozen=True, eq=False)
class SearchedPlants:
    """All that was planted into a flight; `looked` counts the planted pictures that the detector searched."""

    looked: int
    rounds: int
    seconds: float
    plants: tuple[Planted, ...]


@dataclass(frozen=True, eq=False)
class MeasuredClass:
    """What was measured of one class: its plants, the regression on them, the chances of all cells."""

    label: str
    seen: Conditions
    outcomes: Outcomes
    recall: Recall | None
    chances: Chances


@dataclass(frozen=True, eq=False)
class MeasuredFlight:
    """One flight as it was measured; `is_earlier`: what was planted was searched for by an earlier run.

    `floor` has `pod`, `pod_low`, `pod_high` and `area_m2` of the floor that a look through the trees adds.
    """

    name: str
    frames: int
    searched: SearchedPlants
    has_shadows: bool
    has_heights: bool
    is_thermal: bool
    blur_px: float
    classes: tuple[MeasuredClass, ...]
    is_earlier: bool = False
    floor: Mapping[str, float] | None = None

    def with_floor(self, floor: "SeenFloor", cells: Cells) -> "MeasuredFlight":
        """The flight with a person's chance on the floor below what hides the ground from single pictures."""
        views, free = floor.shows.at(cells.centres_m)
        with np.errstate(invalid="ignore"):
            shown = (views >= LEAST_VIEWS) & (free >= _LEAST_FREE)
        classes, area_m2 = [], 0.0
        for own in self.classes:
            if own.label == PERSON:
                below = shown & (own.seen.under_trees | own.seen.roofs)
                area_m2 = float((below & cells.wanted).sum()) * cells.cell_m**2
                before = own.chances.mean, own.chances.low, own.chances.high
                chances = (
                    np.where(below, new, old) for new, old in zip(floor.pod.values(), before)
                )
                own = replace(own, chances=Chances(*chances))
            classes.append(own)
        return replace(self, classes=tuple(classes), floor=floor.pod | {"area_m2": area_m2})


@dataclass(frozen=True, eq=False)
class SeenFloor:
    """A look through a flight's trees: the chance of a person on the floor with a 90 % interval (`pod`, `pod_low`,
    `pod_high`), and how many views show the floor (`up_m`) and the share of them that crowns leave free (`sigma_m`)."""

    pod: dict[str, float]
    shows: HeightField


@dataclass(frozen=True)
class SearchProgress:
    """How far a measurement is: pictures searched, of so many."""

    flight: str
    done: int
    total: int
    found: int
    planted: int


class FlightLooks:
    """A flight's frames as they were looked at, and what they show of places. Only `add` changes it.

    `above` has how high things stand, where the flight has heights.
    """

    def __init__(self, above: AboveGround | None) -> None:
        self.above = above
        self.frames: list[SearchFrame] = []
        self.lights: list[FrameLight] = []
        self.looks: list[FrameLook] = []
        self.has_shadows = False

    def add(self, frame: SearchFrame, sun: Vector3 | None) -> ImageRGB:
        """Look at the next frame; its picture."""
        image, pose = frame.image(), pose_of(frame.placed)
        assert pose is not None  # frames without a place are none of these
        self.frames.append(frame)
        self.lights.append(frame_light(image))
        blur_px = self.lights[-1].blur_px
        self.looks.append(look_at(image, frame.placed.camera, pose, blur_px, sun))
        self.has_shadows |= sun is not None
        return image

    def at(self, places_m: PointsM | Sequence[Floats], reach_m: float) -> Conditions:
        """Return the conditions of places, (2,) each, that reach so far, m."""
        return gather(self.looks, places_m, reach_m, self.above)

    def of_cells(self, cells: Cells, labels: Sequence[str]) -> dict[str, Conditions]:
        """Return the conditions of all cells for each class."""
        return {label: self.at(cells.centres_m, reach_m(label)) for label in labels}

    def measured(
        self,
        name: str,
        seen: Mapping[str, Conditions],
        searched: "SearchedPlants",
        *,
        is_earlier: bool = False,
    ) -> "MeasuredFlight":
        """Return what plants state of all cells, which were `seen` under their conditions for each class."""
        classes = []
        for label, conditions in seen.items():
            own = [(place.place_m, hit) for place, hit in searched.plants if place.label == label]
            places_m = [place_m for place_m, _ in own]
            outcomes = found_rows(
                places_m, self.at(places_m, reach_m(label)), [hit for _, hit in own]
            )
            recall = fit_recall(outcomes.columns, outcomes.found) if len(outcomes) else None
            hidden = conditions.roofs | conditions.under_trees
            chances = map_chances(recall, conditions.columns, hidden)
            classes.append(MeasuredClass(label, conditions, outcomes, recall, chances))
        return MeasuredFlight(
            name,
            len(self.frames),
            searched,
            self.has_shadows,
            self.above is not None,
            any(each.is_thermal for each in self.lights),
            max((each.blur_px for each in self.lights), default=0.0),
            tuple(classes),
            is_earlier,
        )


def measure_flight(
    name: str,
    frames: Sequence[SearchFrame],
    cells: Cells,
    site: Site,
    detector: ObjectDetector,
    settings: SearchSettings,
    keep_off_m: Sequence[Floats],
    above: AboveGround | None = None,
    before: SearchedPlants | None = None,
    cut_outs: Sequence[CutOut] = (),
) -> Generator[SearchProgress, None, MeasuredFlight]:
    """Measure one flight over a site with metres, yielding progress.

    `keep_off_m` are places, (2,) each, of what stands on the map already: no plant is put beside it.
    `above` has how high things stand, where the flight has heights. With plants that were searched for `before` nothing
    is planted, only the cells' conditions are looked at. `cut_outs` are planted in place of drawn people. Raises
    SettingsError as `planted_classes` does, and for cut-outs of another light than the flight's.
    """
    wanted = planted_classes(detector, settings)
    sun, looks = sun_at(frames[len(frames) // 2], site, settings), FlightLooks(above)
    for frame in frames:
        looks.add(frame, sun)
    own_cut_outs = _of_light(cut_outs, looks.lights[-1], name)
    seen = looks.of_cells(cells, wanted)
    searched = before
    if searched is None:
        first = seen[wanted[0]]
        usable = cells.wanted & first.seen & ~first.roofs & ~first.beside_trees
        rounds = plant_places(
            cells,
            first,
            wanted,
            settings.plants,
            keep_off_m=keep_off_m,
            free_m=KEEP_OFF_M,
            rng=seeded(settings.seed),
            usable=usable,
        )
        searched = yield from _searched(
            name, looks, rounds, sun, detector, wanted, settings, own_cut_outs
        )
    return looks.measured(name, seen, searched, is_earlier=before is not None)


def _searched(
    name: str,
    flight: FlightLooks,
    rounds: Sequence[Sequence[PlantPlace]],
    sun: Vector3 | None,
    detector: ObjectDetector,
    wanted: Sequence[str],
    settings: SearchSettings,
    cut_outs: Sequence[CutOut],
) -> Generator[SearchProgress, None, SearchedPlants]:
    """Plant one round after the other into all frames that show some of it, and search these."""
    started_s, frames = time.monotonic(), flight.frames
    gathered: list[Planted] = []
    looked = 0
    for places in rounds:
        things = [
            _planted(len(gathered) + k, each, settings.seed, cut_outs)
            for k, each in enumerate(places)
        ]
        laid: list[LaidSighting] = []
        boxes_px: dict[int, BoxesPx] = {}
        least: dict[str, float] = {}
        hits, is_again = sum(hit for _, hit in gathered), looked > 0
        for number, (frame, light) in enumerate(zip(frames, flight.lights)):
            seen = search_planted(
                frame,
                frame.image(),
                light,
                things,
                sun,
                settings.seed + number,
                detector,
                wanted,
                is_again=is_again,
            )
            if seen is not None:
                least = strictest(least, seen.least)
                boxes_px[frame.placed.index] = seen.boxes_px
                laid += seen.laid
                looked += 1
            yield SearchProgress(name, looked, len(rounds) * len(frames), hits, len(gathered))
        labels = [str(each.label) for each in things]
        placed = [each.placed for each in frames]
        reported = reported_plants(laid, placed, boxes_px, labels, least)
        gathered += [(place, k in reported) for k, place in enumerate(places)]
    return SearchedPlants(looked, len(rounds), time.monotonic() - started_s, tuple(gathered))


def _planted(number: int, place: PlantPlace, seed: int, cut_outs: Sequence[CutOut]) -> Thing:
    """What stands at a place: one of the cut-outs, or something drawn."""
    if cut_outs and place.label == PERSON:
        return CutThing.new(number, place.place_m, cut_outs, seed)
    return new_plant(number, place.label, place.place_m, seed)


def _of_light(cut_outs: Sequence[CutOut], light: FrameLight, name: str) -> Sequence[CutOut]:
    """The cut-outs that were taken in such light. Raises SettingsError where all are of another."""
    own = [each for each in cut_outs if each.is_thermal == light.is_thermal]
    if cut_outs and not own:
        kinds = ("thermal", "in colour") if light.is_thermal else ("in colour", "thermal")
        raise SettingsError(
            "--plant: the pictures of {} are {}, all cut-outs are {}; cut them out of pictures by the same camera".format(
                name, *kinds
            )
        )
    return own


def planted_classes(detector: ObjectDetector, settings: SearchSettings) -> tuple[str, ...]:
    """The classes that are planted and searched for: those asked for, else what the detector usually reports.

    Raises SettingsError for a class that the detector does not know or of which nothing can be drawn, and for a
    detector that knows none that can be drawn.
    """
    check_classes(detector, settings.classes)
    usual = detector.info.usual_classes
    wanted = tuple(dict.fromkeys(settings.classes)) or every_label(usual)
    if undrawn := sorted(set(wanted) - set(CLASSES)):
        raise SettingsError(
            f"no {undrawn[0]!r} can be drawn into pictures; a search measures {', '.join(CLASSES)}"
        )
    if not wanted:
        raise SettingsError(
            f"a search measures {', '.join(CLASSES)}, and the model {detector.info.name} reports "
            f"{', '.join(usual) or 'nothing'}; give another --model"
        )
    return wanted


def reach_m(label: str) -> float:
    """Half the length of a class's usual member as it shows from above or aslant."""
    return max(TYPICAL_SIZE_M[label][:2]) / 2 if label in TYPICAL_SIZE_M else 0.5


@dataclass(frozen=True, eq=False)
class SearchedPicture:
    """A planted picture that a detector searched: each plant's box (N, 4), NaN out of sight; the sightings on the
    ground; from which score on each class is reported."""

    boxes_px: BoxesPx
    laid: Sequence[LaidSighting]
    least: Mapping[str, float]


def search_planted(
    frame: SearchFrame,
    image: ImageRGB,
    light: FrameLight,
    things: Sequence[Thing],
    sun: Vector3 | None,
    seed: int,
    detector: ObjectDetector,
    wanted: Sequence[str],
    *,
    is_again: bool = False,
) -> SearchedPicture | None:
    """Plant things into a frame's picture and have it searched as a map's is; None where it shows none of them.

    `light` is the picture's; `sun` and `seed` as `plant` takes them. `is_again`: the frame was searched with
    other plants in it, and the detector's notices count it once.
    """
    pose = pose_of(frame.placed)
    assert pose is not None  # frames without a place are none of these
    camera = frame.placed.camera
    planted = plant(image, camera, pose, things, light, sun, seed)
    if not any_of(planted.boxes_px):
        return None
    from_above = is_from_above(pose.rotation)
    least = detector.thresholds_for(planted.image, from_above=from_above)
    found = detector.detect(
        planted.image,
        tiles="auto",
        m_per_px=float(pose.translation_m[2]) / camera.fx_px,
        classes=wanted,
        from_above=from_above,
        least_score=least_seen(least),
        is_part=is_again,
    ).surest(_MOST_DETECTIONS + len(things))
    laid = [each for each in lay_on_ground(found, frame.placed) if each is not None]
    return SearchedPicture(planted.boxes_px, laid, least)


def strictest(one: Mapping[str, float], other: Mapping[str, float]) -> dict[str, float]:
    """The higher of the two thresholds of each class: what frames of two lights are reported by."""
    return {name: max(score, one.get(name, 0.0)) for name, score in other.items()}


def sun_at(frame: SearchFrame, site: Site, settings: SearchSettings) -> Vector3 | None:
    """The direction to the sun as a frame was taken; None where no clock knows the date."""
    if settings.sun_deg is not None:
        return direction_from_angles(*settings.sun_deg)
    return sun_over(site, frame.placed.time_ns)


_AROUND_M = 6.0  # of a plant: sightings farther away are of other things; more than its own length
_REACH_M = 5.0  # beside a frame's ground: what stands there leans or throws its shadow in


class GrowingMeasure:
    """The measure of a flight that goes on, over a site with metres.

    `add` takes one frame after another, `measured` gives what all of them state together. Plants stand in a field that
    was sown before anybody saw it (`PlantField`), so that all frames of a place show the same; a frame is planted on
    the place that it has when it is added, and its sightings are laid by that. What turns out to be under trees or
    roofs does not count as planted. `keep_off_m`, `above` and `cut_outs` as `measure_flight` takes them. A flight that climbs shows
    too many plants at once: a wider field is sown then, and what was measured from below is forgotten.
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
        cut_outs: Sequence[CutOut] = (),
    ) -> None:
        self._cut_outs = cut_outs
        self._name, self._site, self._detector, self._settings = name, site, detector, settings
        self._area_m, self._keep_off_m = area_m, keep_off_m
        self._wanted = planted_classes(detector, settings)
        self._field: PlantField | None = None
        self._things: list[Thing] = []
        self._looks = FlightLooks(above)
        self._pictures: dict[int, tuple[PlacedFrame, Sequence[int], SearchedPicture]] = {}
        self._fresh: set[int] = (
            set()
        )  # plants that were shown since it was last asked which are reported
        self._reported: set[int] = set()
        self._least: dict[str, float] = {}
        self._seconds = 0.0

    @property
    def frames(self) -> list[SearchFrame]:
        """The frames that were added."""
        return self._looks.frames

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
        sun = sun_at(frame, self._site, self._settings)
        image = self._looks.add(frame, sun)
        light = self._looks.lights[-1]
        self._cut_outs = _of_light(self._cut_outs, light, self._name)
        numbers = self._field.near(outline_m, _REACH_M)
        for number in range(len(self._things), len(self._field.places)):
            self._things.append(
                _planted(number, self._field.places[number], self._settings.seed, self._cut_outs)
            )
        things = [self._things[each] for each in numbers]
        seed = self._settings.seed + frame.placed.index
        seen = search_planted(frame, image, light, things, sun, seed, self._detector, self._wanted)
        if seen is not None:
            self._pictures[frame.placed.index] = frame.placed, numbers, seen
            self._fresh.update(numbers)
            self._least = strictest(self._least, seen.least)
        self._seconds += time.monotonic() - started_s

    def measured(self, beside_m: Sequence[PointsM] = ()) -> tuple[Cells, MeasuredFlight]:
        """The cells of the ground by now, and what the frames so far state of them. At least one was added.

        The ground of other flights' frames, (4, 2) site metres each, counts as flown as well.
        """
        outlines_m = [*beside_m, *(each.placed.outline_m for each in self.frames)]
        cells = cells_of(outlines_m, self._site, self._area_m)
        places = [] if self._field is None else self._field.places
        self._judge_fresh(places)
        at = self._looks.at([each.place_m for each in places], 0.5)
        gathered = [
            (place, number in self._reported)
            for number, (place, hidden) in enumerate(zip(places, at.roofs | at.beside_trees))
            if not hidden
        ]
        searched = SearchedPlants(len(self._pictures), 1, self._seconds, tuple(gathered))
        seen = self._looks.of_cells(cells, self._wanted)
        return cells, self._looks.measured(self._name, seen, searched)

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
        self._looks = FlightLooks(self._looks.above)
        self._pictures.clear()
        self._fresh.clear()
        self._reported.clear()
