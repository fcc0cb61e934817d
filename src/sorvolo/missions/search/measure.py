"""One flight measured: plants into its own frames, the detector over them, and what a map would have reported."""

import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

from sorvolo.detection.fusing import is_from_above
from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import BoxesPx, Floats, ImageRGB, Mask, Vector3
from sorvolo.geometry.sun import direction_from_angles
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.map_objects import check_classes
from sorvolo.missions.flight.sunlight import sun_over
from sorvolo.missions.search.settings import SearchSettings
from sorvolo.search.cells import Cells
from sorvolo.search.conditions import AboveGround, Conditions, FrameLook, gather, look_at
from sorvolo.search.drawing.frame_light import FrameLight, frame_light
from sorvolo.search.drawing.objects import Thing
from sorvolo.search.drawing.planted import new_plant, plant
from sorvolo.search.outcomes import Outcomes, any_of, every_label, found_rows
from sorvolo.search.plant_places import PlantPlace, plant_places, seeded
from sorvolo.search.recall import Chances, Recall, fit_recall, map_chances
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame
from sorvolo.survey.objects import CLASSES, TYPICAL_SIZE_M
from sorvolo.tracking.laying import LaidSighting, lay_on_ground, pose_of
from sorvolo.tracking.map_objects import reported_plants
from sorvolo.tracking.view_evidence import least_seen

ConditionsAt: TypeAlias = Callable[[Sequence[Floats], float], Conditions]
"""The conditions of places, (2,) each, that reach so far, m."""

Planted: TypeAlias = tuple[PlantPlace, bool]
"""Where one plant stood, and whether a map would report it."""

KEEP_OFF_M = 4.0  # plants from what a map shows already
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
    """One flight as it was measured; `is_earlier`: what was planted was searched for by an earlier run."""

    name: str
    frames: int
    searched: SearchedPlants
    has_shadows: bool
    has_heights: bool
    is_thermal: bool
    blur_px: float
    classes: tuple[MeasuredClass, ...]
    is_earlier: bool = False


@dataclass(frozen=True)
class SearchProgress:
    """How far a measurement is: pictures searched, of so many."""

    flight: str
    done: int
    total: int
    found: int
    planted: int


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
) -> Iterator[SearchProgress | MeasuredFlight]:
    """Measure one flight over a site with metres; yields progress and, at last, what was measured.

    `keep_off_m` are places, (2,) each, of what stands on the map already: no plant is put beside it.
    `above` has how high things stand, where the flight has heights. With plants that were searched for `before` nothing
    is planted, only the cells' conditions are looked at. Raises SettingsError as `planted_classes` does.
    """
    wanted = planted_classes(detector, settings)
    sun = sun_at(frames[len(frames) // 2], site, settings)
    lights, looks = _looks(frames, sun)
    conditions_at = partial(gather, looks, above=above)
    seen = {label: conditions_at(cells.centres_m, reach_m(label)) for label in wanted}
    if before is None:
        places = plant_places(
            cells,
            seen[wanted[0]],
            wanted,
            settings.plants,
            keep_off_m=keep_off_m,
            free_m=KEEP_OFF_M,
            rng=seeded(settings.seed),
            usable=_usable(seen[wanted[0]], cells, settings),
        )
        searched = yield from _searched(
            name, frames, lights, conditions_at, places, sun, detector, wanted, settings
        )
    else:
        searched = before
    classes = tuple(
        measured_class(label, seen[label], searched.plants, conditions_at, settings)
        for label in wanted
    )
    yield MeasuredFlight(
        name,
        len(frames),
        searched,
        sun is not None,
        above is not None,
        any(each.is_thermal for each in lights),
        max((each.blur_px for each in lights), default=0.0),
        classes,
        is_earlier=before is not None,
    )


def _searched(
    name: str,
    frames: Sequence[SearchFrame],
    lights: Sequence[FrameLight],
    conditions_at: ConditionsAt,
    rounds: Sequence[Sequence[PlantPlace]],
    sun: Vector3 | None,
    detector: ObjectDetector,
    wanted: Sequence[str],
    settings: SearchSettings,
) -> Generator[SearchProgress, None, SearchedPlants]:
    """Plant one round after the other and search the frames."""
    started_s = time.monotonic()
    gathered: list[Planted] = []
    number = looked = 0
    for place_round in rounds:
        things = [
            new_plant(number + k, each.label, each.place_m, settings.seed)
            for k, each in enumerate(place_round)
        ]
        number += len(things)
        run = _Round(frames, lights, conditions_at, things, sun, settings)
        yield from run.search(name, detector, wanted, looked, len(rounds) * len(frames), gathered)
        looked += run.looked
        reported = run.reported()
        gathered += [(place, k in reported) for k, place in enumerate(place_round)]
    return SearchedPlants(looked, len(rounds), time.monotonic() - started_s, tuple(gathered))


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
    shown: Sequence[float],
    seed: int,
    detector: ObjectDetector,
    wanted: Sequence[str],
    *,
    is_again: bool = False,
) -> SearchedPicture | None:
    """Plant things into a frame's picture and have it searched as a map's is; None where it shows none of them.

    `light` is the picture's; `sun`, `shown` and `seed` as `plant` takes them. `is_again`: the frame was searched with
    other plants in it, and the detector's notices count it once.
    """
    pose = pose_of(frame.placed)
    assert pose is not None  # frames without a place are none of these
    camera = frame.placed.camera
    planted = plant(image, camera, pose, things, light, sun, shown, seed)
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


class _Round:
    """Plants that stand at once, in all frames that show them."""

    def __init__(
        self,
        frames: Sequence[SearchFrame],
        lights: Sequence[FrameLight],
        conditions_at: ConditionsAt,
        things: Sequence[Thing],
        sun: Vector3 | None,
        settings: SearchSettings,
    ) -> None:
        self._frames, self._lights, self._things, self._sun, self._settings = (
            frames,
            lights,
            things,
            sun,
            settings,
        )
        under = conditions_at([each.place_m(0)[:2] for each in things], 0.5).under_trees
        self._shown = [settings.through_crowns if hidden else 1.0 for hidden in under]
        self._laid: list[LaidSighting] = []
        self._boxes_px: dict[int, BoxesPx] = {}
        self._least: dict[str, float] = {}
        self.looked = 0

    def search(
        self,
        name: str,
        detector: ObjectDetector,
        wanted: Sequence[str],
        before: int,
        total: int,
        gathered: Sequence[Planted],
    ) -> Iterator[SearchProgress]:
        """Plant into one frame after the other and search it; those that show no plant are left out."""
        for number, (each, light) in enumerate(zip(self._frames, self._lights)):
            seen = search_planted(
                each,
                each.image(),
                light,
                self._things,
                self._sun,
                self._shown,
                self._settings.seed + number,
                detector,
                wanted,
                is_again=before > 0,
            )
            if seen is not None:
                self._least = strictest(self._least, seen.least)
                self._boxes_px[each.placed.index] = seen.boxes_px
                self._laid += seen.laid
                self.looked += 1
            hits = sum(hit for _, hit in gathered)
            yield SearchProgress(name, before + self.looked, total, hits, len(gathered))

    def reported(self) -> set[int]:
        """Which of the plants a map of these frames would report."""
        placed = [each.placed for each in self._frames]
        labels = [str(each.label) for each in self._things]
        return reported_plants(self._laid, placed, self._boxes_px, labels, self._least)


def _looks(
    frames: Sequence[SearchFrame], sun: Vector3 | None
) -> tuple[list[FrameLight], list[FrameLook]]:
    lights, looks = [], []
    for each in frames:
        light, look = look_of(each, sun)
        lights.append(light)
        looks.append(look)
    return lights, looks


def look_of(frame: SearchFrame, sun: Vector3 | None) -> tuple[FrameLight, FrameLook]:
    """A frame's light, and its small maps."""
    image, pose = frame.image(), pose_of(frame.placed)
    assert pose is not None  # frames without a place are none of these
    light = frame_light(image)
    return light, look_at(image, frame.placed.camera, pose, light.blur_px, sun)


def _usable(seen: Conditions, cells: Cells, settings: SearchSettings) -> Mask:
    """Where plants may stand: wanted ground that was seen, under trees only where some of them would show."""
    usable = cells.wanted & seen.seen & ~seen.roofs
    return usable if settings.through_crowns > 0 else usable & ~seen.beside_trees


def sun_at(frame: SearchFrame, site: Site, settings: SearchSettings) -> Vector3 | None:
    """The direction to the sun as a frame was taken; None where no clock knows the date."""
    if settings.sun_deg is not None:
        return direction_from_angles(*settings.sun_deg)
    return sun_over(site, frame.placed.time_ns)


def measured_class(
    label: str,
    seen: Conditions,
    planted: Sequence[Planted],
    conditions_at: ConditionsAt,
    settings: SearchSettings,
) -> MeasuredClass:
    """What plants of a class state of all cells, which were `seen` under their conditions; others are left out.

    `conditions_at` is asked for the places of these plants alone.
    """
    places_m, hits = plants_of(label, planted)
    outcomes = found_rows(places_m, conditions_at(places_m, reach_m(label)), hits)
    recall = fit_recall(outcomes.columns, outcomes.found) if len(outcomes) else None
    hidden = seen.roofs | seen.under_trees if settings.through_crowns == 0 else seen.roofs
    return MeasuredClass(label, seen, outcomes, recall, map_chances(recall, seen.columns, hidden))


def plants_of(label: str, planted: Sequence[Planted]) -> tuple[list[Floats], list[bool]]:
    """Where the plants of a class stand, (2,) each, and whether each was found."""
    own = [(place.place_m, hit) for place, hit in planted if place.label == label]
    return [place_m for place_m, _ in own], [hit for _, hit in own]
