"""Measure detectors on labelled pictures, each by itself and side by side: Table 4.6 of the thesis and more."""

import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sorvolo.capture.photos import read_picture
from sorvolo.detection.detector import Detector
from sorvolo.detection.intervals import DRAWS
from sorvolo.detection.metrics import Mistake, judged_classes
from sorvolo.detection.scores import Arm, SetComparison, SetScores, compare_arms, score_set
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import BoxesPx, ImageRGB
from sorvolo.missions.holding_out import hold_out
from sorvolo.store.atomic import atomic_write_bytes, writing
from sorvolo.store.datasets import read_dataset
from sorvolo.store.detector_files import FoundSets, mistake_picture, read_found, write_found
from sorvolo.store.detector_page import detector_page
from sorvolo.store.exports import json_bytes
from sorvolo.survey.flight import Notice
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import Detections

LEAST_SCORE = 0.02
"""Candidates from this score on are measured: average precision needs the doubtful ones too."""

PAGE, NUMBERS, FOUND = "detector.html", "detector.json", "detections.json"

_KINDS = ("false alarm", "miss", "confusion")
_SHOWN = 12  # mistakes of a kind
_SHOWN_OF_ONE = 2  # of them from one picture


@dataclass(frozen=True)
class EvaluationSettings:
    """`tiles` as Detector.detect takes it; `draws` of the bootstrap; `seed` of whatever is random."""

    tiles: Literal["auto"] | int | None = None
    draws: int = DRAWS
    seed: int = 1


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

    `found` are the first model's detections; `worst` each set's worst mistakes with their pictures.
    """

    found: FoundSets
    sets: tuple[SetScores, ...]
    comparisons: tuple[SetComparison, ...]
    worst: Mapping[str, tuple[tuple[Mistake, str, ImageRGB], ...]]


def read_sets(
    places: Sequence[Path], *, form: str | None = None, classes: Mapping[str, str] | None = None,
    ignore: Iterable[str] = (), unlabelled: Iterable[str] = (), group_pattern: str | None = None, videos: str = "",
    held_out: float = 0.0, seed: int = 1,
) -> tuple[LabelledSet, ...]:
    """The labelled sets in these files and folders, all read with the same options (those of `read_dataset`).

    `videos` is a regular expression: only pictures whose video or flight it fits (from its start) are kept. With
    `held_out` only the share that a training with this share and seed holds out. Raises InputError as `read_dataset`,
    and for a set of which none is kept; SettingsError for a broken expression and a share that cannot be.
    """
    try:
        kept = re.compile(videos)
    except re.error as error:
        raise SettingsError(f"--videos {videos!r} is no regular expression: {error}") from error
    sets = []
    for place in places:
        whole = read_dataset(
            place, form=form, classes=classes, ignore=ignore, unlabelled=unlabelled, group_pattern=group_pattern
        )
        chosen = whole.only([each for each in whole.pictures if kept.match(each.group)])
        if not len(chosen):
            groups = sorted({each.group for each in whole.pictures})
            raise InputError(f"{place}: no video or flight fits {videos!r}; there are {', '.join(groups[:8])}")
        sets.append(_held_out(chosen, held_out, seed) if held_out else chosen)
    return tuple(sets)


def evaluate_detector(
    arms: Sequence[Sequence[str]],
    labelled: Sequence[LabelledSet],
    settings: EvaluationSettings | None = None,
    told: Callable[[EvaluationProgress], None] = lambda _: None,
) -> DetectorEvaluation:
    """Measure `arms[0]` on each set, and the other arms beside it.

    An arm is one model, or the same one trained with several seeds: names or files of models, or detections.json of
    earlier evaluations, which were made on the same pictures. Raises InputError for models and files that cannot be
    used, for sets that label none of a model's classes, and for pictures that cannot be read.
    """
    settings = settings or EvaluationSettings()
    names = [each.name for each in labelled]
    if len(set(names)) < len(names):
        raise InputError(f"two data sets have one name ({', '.join(names)}); rename a folder")
    seen = [[_found(place, labelled, settings, told) for place in arm] for arm in arms]
    first = seen[0][0]
    scores = tuple(
        score_set(each, first.sets[each.name][1], first.classes, first.thresholds, draws=settings.draws,
                  seed=settings.seed)
        for each in labelled
    )
    comparisons: tuple[SetComparison, ...] = ()
    if len(seen) > 1:
        comparisons = tuple(_side_by_side(each, seen, settings) for each in labelled)
    worst = {
        each.name: tuple(_worst(each, score, first.sets[each.name][1], first.thresholds))
        for each, score in zip(labelled, scores)
    }
    return DetectorEvaluation(first, scores, comparisons, worst)


def write_evaluation(evaluation: DetectorEvaluation, folder: Path, description: Mapping[str, Any]) -> None:
    """Write detector.html, detector.json and detections.json; `description` says what was measured on what.

    Raises StoreError on a full disk.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    write_found(folder / FOUND, evaluation.found)
    atomic_write_bytes(folder / NUMBERS, json_bytes(evaluation_numbers(evaluation, description)))
    page = detector_page(
        evaluation.found.name, evaluation.sets, evaluation.comparisons, evaluation.worst, description
    )
    atomic_write_bytes(folder / PAGE, page.encode())


def evaluation_numbers(evaluation: DetectorEvaluation, description: Mapping[str, Any]) -> dict[str, Any]:
    """The content of detector.json: all numbers, without the list of every mistake."""
    return {
        "made_by": "sorvolo evaluate detector", "format": 1, **description, "model": evaluation.found.name,
        "classes": list(evaluation.found.classes), "thresholds": dict(evaluation.found.thresholds),
        "seconds_per_picture": evaluation.found.seconds_per_picture,
        "sets": [
            {key: value for key, value in asdict(each).items() if key != "mistakes"}
            | {"mistakes": {kind: sum(row.kind == kind for row in each.mistakes) for kind in _KINDS}}
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
    place: str, labelled: Sequence[LabelledSet], settings: EvaluationSettings,
    told: Callable[[EvaluationProgress], None],
) -> FoundSets:
    """What the model of this name or file finds, or what a file says that it found."""
    if Path(place).suffix == ".json":
        found = read_found(Path(place))
        return replace(found, sets={each.name: _same_pictures(place, found, each) for each in labelled})
    detector = Detector.load(place)
    for each in labelled:
        judged_classes(each, detector.classes)  # before an hour of looking
    sets: dict[str, tuple[tuple[str, ...], tuple[Detections, ...]]] = {}
    seconds, count = 0.0, 0
    for each in labelled:
        detections = []
        for picture in each.pictures:
            image = read_picture(Path(picture.path))
            started = time.perf_counter()
            m_per_px = None if np.isnan(picture.m_per_px) else picture.m_per_px
            detections.append(
                detector.detect(image, tiles=settings.tiles, m_per_px=m_per_px, least_score=LEAST_SCORE)
            )
            seconds += time.perf_counter() - started
            count += 1
            told(EvaluationProgress(detector.info.name, each.name, len(detections), len(each)))
        sets[each.name] = _names(each), tuple(detections)
    return FoundSets(
        _arm_name(place), detector.classes, dict(detector.info.thresholds), sets, seconds / max(count, 1),
        tuple(notice.text for notice in detector.notices),
    )


def _arm_name(place: str) -> str:
    return Path(place).stem if Path(place).suffix == ".onnx" else place


def _names(labelled: LabelledSet) -> tuple[str, ...]:
    return tuple(Path(picture.path).name for picture in labelled.pictures)


def _same_pictures(
    place: str, found: FoundSets, labelled: LabelledSet
) -> tuple[tuple[str, ...], tuple[Detections, ...]]:
    """The file's detections in the order of the set's pictures."""
    if labelled.name not in found.sets:
        raise InputError(f"{place}: holds detections of {', '.join(found.sets)}, none of {labelled.name}")
    files, detections = found.sets[labelled.name]
    wanted = _names(labelled)
    if files == wanted:
        return files, detections
    by_name = dict(zip(files, detections))
    missing = [name for name in wanted if name not in by_name]
    if missing or len(by_name) < len(files) or len(set(wanted)) < len(wanted):
        raise InputError(
            f"{place}: made on other pictures of {labelled.name}"
            + (f"; {len(missing)} are missing, such as {missing[0]}" if missing else "")
        )
    return wanted, tuple(by_name[name] for name in wanted)


def _side_by_side(
    labelled: LabelledSet, seen: Sequence[Sequence[FoundSets]], settings: EvaluationSettings
) -> SetComparison:
    names = [arm[0].name + (f" and {len(arm) - 1} more seeds" if len(arm) > 1 else "") for arm in seen]
    arms = [
        Arm(
            name if names.count(name) == 1 else f"{name} ({place})", arm[0].classes,
            tuple(each.sets[labelled.name][1] for each in arm), tuple(each.thresholds for each in arm),
        )
        for place, (name, arm) in enumerate(zip(names, seen), start=1)
    ]
    return compare_arms(labelled, arms, draws=settings.draws, seed=settings.seed)


def _worst(
    labelled: LabelledSet, scores: SetScores, found: Sequence[Detections], thresholds: Mapping[str, float]
) -> Iterator[tuple[Mistake, str, ImageRGB]]:
    """The surest false alarms and confusions and the largest misses, with the picture's name and a crop."""
    for kind in _KINDS:
        mistakes = [each for each in scores.mistakes if each.kind == kind]
        mistakes.sort(key=_area_px if kind == "miss" else lambda each: each.score, reverse=True)
        for mistake in _few_of_each_picture(mistakes):
            picture = labelled.pictures[mistake.picture]
            reported = _reported(found[mistake.picture], thresholds)
            crop = mistake_picture(
                read_picture(Path(picture.path)), mistake.box_px, _judged_boxes(picture, labelled, scores), reported
            )
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


def _judged_boxes(picture: LabelledPicture, labelled: LabelledSet, scores: SetScores) -> BoxesPx:
    judged = {labelled.classes.index(each.label) for each in scores.classes}
    return picture.boxes_px[[label in judged for label in picture.labels.tolist()]]


def _reported(found: Detections, thresholds: Mapping[str, float]) -> BoxesPx:
    return found.boxes_px[[score >= thresholds[name] for score, name in zip(found.scores, found.names)]]
