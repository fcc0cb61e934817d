"""Measure detectors on labelled pictures, each by itself and side by side: Table 4.6 of the thesis and more."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias, Unpack

import cv2
import numpy as np

from sorvolo.capture.photos import read_picture
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.detection.session import read_info
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import BoxesPx, ImageRGB
from sorvolo.geometry.homography import resized, shifted
from sorvolo.lab.datasets import LabelOptions, read_datasets
from sorvolo.lab.datasets.splits import hold_out
from sorvolo.lab.evaluation.detection_metrics import Mistake, judged_classes
from sorvolo.lab.evaluation.detection_scores import (
    DRAWS,
    Arm,
    SetComparison,
    SetScores,
    compare_arms,
    score_set,
)
from sorvolo.lab.evaluation.detector_page import detector_page
from sorvolo.missions.flight.detector_protocol import FindsObjects, as_detector
from sorvolo.paths import AnyPath, Inputs, Json, JsonView, listed
from sorvolo.store.atomic import atomic_write_bytes, make_folder
from sorvolo.store.exports.plain import json_bytes
from sorvolo.survey.flight import Notice
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import Detections
from sorvolo.survey.wording import counted

Models: TypeAlias = AnyPath | FindsObjects | Sequence[AnyPath | FindsObjects]
"""One model, or the same one trained with several seeds."""

_CROP_PX = 220  # side of a picture on a page
_LABEL_COLOUR, _FOUND_COLOUR = (40, 220, 90), (255, 150, 30)


@dataclass(frozen=True, eq=False)
class FoundSet:
    """What a model found in one set: one Detections a picture, and from which score on each class is reported there;
    a model may have other thresholds for thermal frames."""

    detections: tuple[Detections, ...]
    thresholds: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class FoundSets:
    """What one model found, by the sets' names.

    `notices` are the detector's own notices.
    """

    name: str
    classes: tuple[str, ...]
    sets: Mapping[str, FoundSet]
    seconds_per_picture: float
    notices: tuple[str, ...]


def mistake_picture(
    image: ImageRGB, box_px: Sequence[float], labels_px: BoxesPx, found_px: BoxesPx
) -> ImageRGB:
    """A square crop around a box, enlarged, with the labels in it (green) and what was reported (orange)."""
    left, top, right, bottom = box_px
    side = max(3.0 * max(right - left, bottom - top), 48.0)
    x0, y0 = (left + right - side) / 2, (top + bottom - side) / 2
    scale = _CROP_PX / side
    matrix = resized(scale, scale) @ shifted(-x0, -y0)
    crop = cv2.warpAffine(image, matrix[:2], (_CROP_PX, _CROP_PX), borderValue=(60, 60, 60))
    for boxes, colour in ((labels_px, _LABEL_COLOUR), (found_px, _FOUND_COLOUR)):
        for edges in boxes:
            low, high = (
                np.round((edges[k : k + 2] - [x0, y0]) * scale).astype(int).tolist() for k in (0, 2)
            )
            cv2.rectangle(crop, low, high, colour, 2, cv2.LINE_AA)
    return np.asarray(crop, np.uint8)


LEAST_SCORE = 1e-4
"""Candidates from this score on are measured: average precision needs the doubtful ones, which packaged models score
0.0002 and more."""

PAGE, NUMBERS = "detector.html", "detector.json"

_KINDS = ("false alarm", "miss", "confusion")
_SHOWN = 12  # mistakes of a kind
_SHOWN_OF_ONE = 2  # of them from one picture
_NAMED = 5  # damaged pictures


@dataclass(frozen=True)
class EvaluationSettings:
    """`tiles`, `from_above` as Detector.detect takes them; `draws` of the bootstrap; `seed` of whatever is random."""

    tiles: Literal["auto"] | int | None = "auto"
    draws: int = DRAWS
    seed: int = 1
    from_above: bool = False


@dataclass(frozen=True)
class EvaluationProgress:
    """How many pictures of a set a model has looked at."""

    model: str
    set_name: str
    pictures_done: int
    pictures_total: int


@dataclass(frozen=True, eq=False)
class DetectorEvaluation:
    """One model's scores on each set, and, with rivals, all of them side by side; of several seeds the first is scored.

    `found` are the first model's detections; `worst` each set's worst mistakes with their pictures; `notices` name what
    was left out, and what the models report about the pictures.
    """

    found: FoundSets
    sets: tuple[SetScores, ...]
    comparisons: tuple[SetComparison, ...]
    worst: Mapping[str, tuple[tuple[Mistake, str, ImageRGB], ...]]
    notices: tuple[str, ...] = ()


def read_sets(
    places: Inputs,
    *,
    held_out: float = 0.0,
    seed: int = 1,
    known: Iterable[str] = (),
    **options: Unpack[LabelOptions],
) -> tuple[LabelledSet, ...]:
    """The labelled sets in these files and folders, all read with the same options.

    With `held_out` only the share that a training with this share and seed holds out. Raises InputError and
    SettingsError as `read_datasets`, SettingsError for a share that cannot be.
    """
    folders = [Path(each) for each in listed(places)]
    read = read_datasets(folders, known=known, **options)
    return tuple(_held_out(part, held_out, seed) if held_out else part for part in read)


def known_classes(arms: Iterable[Iterable[str]]) -> tuple[str, ...]:
    """All classes that any model of the arms detects. Raises InputError as `evaluate_detector`."""
    found = (read_info(find_model(place)).classes for arm in arms for place in arm)
    return tuple(dict.fromkeys(name for classes in found for name in classes))


def evaluate_detector(
    arms: Models | Iterable[Models],
    labelled: LabelledSet | Iterable[LabelledSet],
    settings: EvaluationSettings | None = None,
    progress: Callable[[EvaluationProgress], None] = lambda _: None,
) -> DetectorEvaluation:
    """Measure `arms[0]` on each set, and the other arms beside it.

    An arm is one model, or the same one trained with several seeds: detectors, or names or files of models. Measured is the model that was asked for, with the one
    that it names for thermal frames, if any. Raises InputError for models and files that cannot be
    used, for sets that label none of a model's classes, and for those of which no picture can be read; one picture
    that cannot be read is left out for all models, and named in `notices`.
    """
    settings = settings or EvaluationSettings()
    rows, labelled = [listed(each) for each in listed(arms)], listed(labelled)
    if not all([rows, *rows, labelled]):
        raise InputError("nothing to measure; give a model, and labelled pictures")
    names = [each.name for each in labelled]
    if len(set(names)) < len(names):
        raise InputError(f"two data sets have one name ({', '.join(names)}); rename a folder")
    damaged: dict[str, str] = {}  # by path, with the reason
    # what every model of every arm finds in the pictures that can be read
    seen = [[_found(place, labelled, settings, progress, damaged) for place in arm] for arm in rows]
    labelled = [_readable(each, damaged) for each in labelled]
    first = seen[0][0]
    scores = tuple(
        score_set(
            each,
            (mine := first.sets[each.name]).detections,
            first.classes,
            mine.thresholds,
            draws=settings.draws,
            seed=settings.seed,
        )
        for each in labelled
    )
    comparisons = tuple(_side_by_side(each, seen, settings) for each in labelled if len(seen) > 1)
    worst = {
        each.name: tuple(_worst(each, score, first.sets[each.name]))
        for each, score in zip(labelled, scores)
    }
    # What the models note, each once
    notices = (
        *_damage_notices(damaged),
        *dict.fromkeys(text for arm in seen for each in arm for text in each.notices),
    )
    return DetectorEvaluation(first, scores, comparisons, worst, notices)


def write_evaluation(
    evaluation: DetectorEvaluation, folder: AnyPath, description: JsonView
) -> None:
    """Write detector.html and detector.json; `description` is what was measured on what.

    Raises StoreError on a full disk.
    """
    folder = Path(folder)
    make_folder(folder)
    atomic_write_bytes(folder / NUMBERS, json_bytes(evaluation_numbers(evaluation, description)))
    page = detector_page(evaluation, description)
    atomic_write_bytes(folder / PAGE, page.encode())


def evaluation_numbers(evaluation: DetectorEvaluation, description: JsonView) -> Json:
    """The content of detector.json: all numbers, without the list of every mistake."""
    return {
        "made_by": "sorvolo evaluate detector",
        "format": 1,
        **description,
        "model": evaluation.found.name,
        "classes": list(evaluation.found.classes),
        "seconds_per_picture": evaluation.found.seconds_per_picture,
        "sets": [
            {key: value for key, value in asdict(each).items() if key != "mistakes"}
            | {"thresholds": dict(evaluation.found.sets[each.name].thresholds)}
            | {
                "mistakes": {
                    kind: sum(row.kind == kind for row in each.mistakes) for kind in _KINDS
                }
            }
            for each in evaluation.sets
        ],
        "comparisons": list(evaluation.comparisons),
    }


def _held_out(labelled: LabelledSet, share: float, seed: int) -> LabelledSet:
    _, kept, remarks = hold_out(labelled, share, seed)
    if not len(kept):
        raise InputError("; ".join(remarks))
    notices = (*labelled.notices, *(Notice("held_out", len(kept), text) for text in remarks))
    return replace(kept, name=labelled.name, notices=notices)


def _found(
    place: str | FindsObjects,
    labelled: Sequence[LabelledSet],
    settings: EvaluationSettings,
    progress: Callable[[EvaluationProgress], None],
    damaged: dict[str, str],
) -> FoundSets:
    """What the model of this name or file finds in the pictures that can be read; the others join the `damaged`."""
    loaded = Detector.load(place, stand_in=False) if isinstance(place, str) else place
    detector = as_detector(loaded)
    name = place if isinstance(place, str) else detector.info.name
    for each in labelled:
        judged_classes(each, detector.classes)  # before an hour of looking
    sets: dict[str, FoundSet] = {}
    mixed: list[str] = []
    seconds = 0.0
    for each in labelled:
        detections = []
        lights: list[Mapping[str, float]] = []
        for number, picture in enumerate(each.pictures, start=1):
            try:
                image = read_picture(Path(picture.path))
            except (InputError, OSError) as error:
                damaged[picture.path] = f"{error}"
            else:
                started = time.perf_counter()
                detections.append(
                    detector.detect(
                        image,
                        tiles=settings.tiles,
                        m_per_px=picture.m_per_px,
                        least_score=LEAST_SCORE,
                        from_above=settings.from_above,
                    )
                )
                seconds += time.perf_counter() - started
                least = detector.thresholds_for(image, from_above=settings.from_above)
                lights.append({**detector.info.thresholds, **least})
            progress(EvaluationProgress(detector.info.name, each.name, number, len(each)))
        usual = max(lights, key=lights.count, default=detector.info.thresholds)
        if others := len(lights) - lights.count(usual):
            mixed.append(
                f"{each.name}: {others} of {len(lights)} pictures are of another light than most and are reported from "
                "other scores on; what is reported is counted by the thresholds of most"
            )
        sets[each.name] = FoundSet(tuple(detections), usual)
    return FoundSets(
        Path(name).stem if Path(name).suffix == ".onnx" else name,
        detector.classes,
        sets,
        seconds / max(sum(len(each.detections) for each in sets.values()), 1),
        (*(notice.text for notice in detector.notices), *mixed),
    )


def _readable(labelled: LabelledSet, damaged: Mapping[str, str]) -> LabelledSet:
    """The set without damaged pictures. Raises InputError where none is left."""
    kept = [each for each in labelled.pictures if each.path not in damaged]
    if not kept:
        first = labelled.pictures[0].path
        raise InputError(
            f"none of the {len(labelled)} pictures of {labelled.name} can be read (first: {first}: {damaged[first]})"
        )
    return labelled.only(kept)


def _damage_notices(damaged: Mapping[str, str]) -> tuple[str, ...]:
    if not damaged:
        return ()
    some = "; ".join(f"{path}: {reason}" for path, reason in list(damaged.items())[:_NAMED])
    return (f"{counted(len(damaged), 'picture')} left out that cannot be read: {some}",)


def _side_by_side(
    labelled: LabelledSet, seen: Sequence[Sequence[FoundSets]], settings: EvaluationSettings
) -> SetComparison:
    names = [
        arm[0].name + (f" and {counted(len(arm) - 1, 'more seed')}" if arm[1:] else "")
        for arm in seen
    ]
    arms = []
    for place, (name, arm) in enumerate(zip(names, seen), start=1):
        seeds = [each.sets[labelled.name] for each in arm]
        arms.append(
            Arm(
                name if names.count(name) == 1 else f"{name} ({place})",
                arm[0].classes,
                tuple(each.detections for each in seeds),
                tuple(each.thresholds for each in seeds),
            )
        )
    return compare_arms(labelled, arms, draws=settings.draws, seed=settings.seed)


def _worst(
    labelled: LabelledSet, scores: SetScores, found: FoundSet
) -> Iterator[tuple[Mistake, str, ImageRGB]]:
    """The surest false alarms and confusions and the largest misses, with the picture's name and a crop."""
    for kind in _KINDS:
        mistakes = [each for each in scores.mistakes if each.kind == kind]
        mistakes.sort(key=_area_px if kind == "miss" else lambda each: each.score, reverse=True)
        for mistake in _few_of_each_picture(mistakes):
            picture = labelled.pictures[mistake.picture]
            seen = found.detections[mistake.picture]
            reported = seen.boxes_px[
                [score >= found.thresholds[name] for score, name in zip(seen.scores, seen.names)]
            ]
            judged = {labelled.classes.index(each.label) for each in scores.classes}
            judged_boxes = picture.boxes_px[[label in judged for label in picture.labels.tolist()]]
            image = read_picture(Path(picture.path))
            crop = mistake_picture(image, mistake.box_px, judged_boxes, reported)
            yield mistake, Path(picture.path).name, crop


def _area_px(mistake: Mistake) -> float:
    left, top, right, bottom = mistake.box_px
    return (right - left) * (bottom - top)


def _few_of_each_picture(mistakes: Iterable[Mistake]) -> Iterator[Mistake]:
    shown: dict[int, int] = {}
    for mistake in mistakes:
        shown[mistake.picture] = shown.get(mistake.picture, 0) + 1
        if shown[mistake.picture] <= _SHOWN_OF_ONE:
            yield mistake
        if sum(min(count, _SHOWN_OF_ONE) for count in shown.values()) >= _SHOWN:
            return
