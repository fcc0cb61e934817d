"""Everything that is measured of one model on one labelled set, and of several models side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.detection.intervals import (
    DRAWS,
    Difference,
    GroupTables,
    Interval,
    differences,
    group_tables,
    intervals,
)
from sorvolo.detection.metrics import (
    SIZES_M,
    SIZES_PX,
    CocoNumbers,
    Mistake,
    SizeRow,
    Threshold,
    best_threshold,
    confusion,
    counts_at,
    judged_classes,
    match_pictures,
    precision_recall,
    recall_by_size,
    right_by_score,
    thesis_ap,
    thesis_map,
)
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Counts, Floats, Rows
from sorvolo.geometry.calibration_bins import CalibrationBin
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import Detections

_CURVE_POINTS = 200  # of a curve that a page draws some hundred pixels wide


@dataclass(frozen=True, eq=False)
class ClassScores:
    """One class: COCO's numbers, what reporting at the model's own threshold gives, the best threshold in hindsight.

    `curve` (N, 3) is score, precision and recall at IoU 0.5, thinned; `by_score` has what share of each tenth of the
    score is right. `thesis_ap` is eq. 4.3 at `reported.score`.
    """

    label: str
    labels: int
    coco: CocoNumbers
    reported: Threshold
    thesis_ap: float
    best: Threshold
    curve: Floats
    by_score: tuple[CalibrationBin, ...]


@dataclass(frozen=True, eq=False)
class SetScores:
    """One model on one set. `groups` counts videos or flights; `left_out` names the model's classes that the set does
    not label. `confusion` (C + 1, C + 1) is true by reported, the last being background.

    `by_size_px` and `by_size_m` hold each class's recall by its labels' longer side; the latter is of the pictures
    whose ground sampling distance is known.
    """

    name: str
    pictures: int
    groups: int
    ignored_regions: int
    left_out: tuple[str, ...]
    coco: CocoNumbers
    thesis_map: float
    intervals: Mapping[str, Interval]
    classes: tuple[ClassScores, ...]
    confusion: Counts
    by_size_px: Mapping[str, tuple[SizeRow, ...]]
    by_size_m: Mapping[str, tuple[SizeRow, ...]]
    mistakes: tuple[Mistake, ...]
    remarks: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Arm:
    """One side of a comparison: a model's detections in a set, one entry for each seed that it was trained with."""

    name: str
    classes: tuple[str, ...]
    found: tuple[Sequence[Detections], ...]
    thresholds: tuple[Mapping[str, float], ...]


@dataclass(frozen=True)
class ArmScores:
    """An arm's measures: the mean over its seeds, the lowest and the highest."""

    name: str
    seeds: int
    mean: Mapping[str, float]
    lowest: Mapping[str, float]
    highest: Mapping[str, float]


@dataclass(frozen=True)
class SetComparison:
    """Arms side by side on one set; `differences` are of each later arm against the first, by its place."""

    name: str
    pictures: int
    groups: int
    labels: Mapping[str, int]
    arms: tuple[ArmScores, ...]
    differences: tuple[Mapping[str, Difference], ...]


def score_set(
    labelled: LabelledSet,
    found: Sequence[Detections],
    classes: Sequence[str],
    thresholds: Mapping[str, float],
    *,
    draws: int = DRAWS,
    seed: int = 0,
) -> SetScores:
    """Measure one Detections a picture against the set's labels; each class is reported from `thresholds` on.

    Raises InputError when the set labels none of the model's classes, or the numbers of pictures differ.
    """
    judged = judged_classes(labelled, classes)
    matches, coco, by_class = match_pictures(labelled, found, judged)
    table, mistakes = confusion(matches, thresholds)
    tables = group_tables(matches, _groups(labelled), thresholds)
    scores = []
    for match in matches:
        right, wrong, missed = counts_at(match, thresholds[match.label])
        precision = right / (right + wrong) if right + wrong else float("nan")
        recall = right / (right + missed) if right + missed else float("nan")
        f1 = 2 * right / (2 * right + wrong + missed) if right + wrong + missed else float("nan")
        scores.append(
            ClassScores(
                match.label,
                len(match.true_scores),
                by_class[match.label],
                Threshold(thresholds[match.label], precision, recall, f1),
                thesis_ap(match, thresholds[match.label]),
                best_threshold(match),
                _thinned(np.column_stack(precision_recall(match))),
                tuple(right_by_score(match)),
            )
        )
    m_per_px = np.array([picture.m_per_px for picture in labelled.pictures])
    return SetScores(
        labelled.name,
        len(labelled),
        tables.groups,
        sum(len(each.ignored_px) for each in labelled.pictures),
        tuple(name for name in classes if name not in judged),
        coco,
        thesis_map(matches, thresholds),
        intervals(tables, draws=draws, seed=seed),
        tuple(scores),
        table,
        recall_by_size(matches, thresholds, np.ones(len(labelled)), SIZES_PX),
        recall_by_size(matches, thresholds, m_per_px, SIZES_M),
        mistakes,
        _remarks(scores, tables, len(labelled)),
    )


def compare_arms(
    labelled: LabelledSet, arms: Sequence[Arm], *, draws: int = DRAWS, seed: int = 0
) -> SetComparison:
    """Arms side by side on the same pictures, in the classes that all of them know (Table 4.6 of the thesis).

    Raises InputError when they share no class with the set, or two arms are of one name.
    """
    if len({arm.name for arm in arms}) < len(arms):
        raise InputError(
            f"arms must have different names, got {', '.join(arm.name for arm in arms)}"
        )
    shared = [name for name in arms[0].classes if all(name in arm.classes for arm in arms)]
    judged = judged_classes(labelled, shared)
    groups = _groups(labelled)
    tables = [_arm_tables(labelled, arm, judged, groups) for arm in arms]
    first = tables[0][0]
    return SetComparison(
        labelled.name,
        len(labelled),
        first.groups,
        first.label_counts,
        tuple(_arm_scores(arm.name, each) for arm, each in zip(arms, tables)),
        tuple(differences(tables[0], each, draws=draws, seed=seed) for each in tables[1:]),
    )


def _arm_tables(
    labelled: LabelledSet, arm: Arm, judged: Sequence[str], groups: Rows
) -> list[GroupTables]:
    """The tables of each of an arm's seeds."""
    return [
        group_tables(match_pictures(labelled, found, judged)[0], groups, thresholds)
        for found, thresholds in zip(arm.found, arm.thresholds)
    ]


def _arm_scores(name: str, tables: Sequence[GroupTables]) -> ArmScores:
    measured = [each.measure(np.ones((1, each.groups))) for each in tables]
    values = {key: np.array([each[key][0] for each in measured]) for key in measured[0]}
    summed = [
        {key: float(how(value)) for key, value in values.items()}
        for how in (np.mean, np.min, np.max)
    ]
    return ArmScores(name, len(tables), *summed)


def _groups(labelled: LabelledSet) -> Rows:
    """(P,) the index of each picture's video or flight."""
    names = [picture.group for picture in labelled.pictures]
    return np.asarray(np.unique(names, return_inverse=True)[1], np.int64)


def _thinned(rows: Floats) -> Floats:
    if len(rows) <= _CURVE_POINTS:
        return rows
    return rows[np.unique(np.linspace(0, len(rows) - 1, _CURVE_POINTS).round().astype(int))]


def _remarks(scores: Sequence[ClassScores], tables: GroupTables, pictures: int) -> tuple[str, ...]:
    remarks = [
        f"only {each.labels} labels of {each.label}: read its numbers with their intervals"
        for each in scores
        if 0 < each.labels < 100
    ]
    remarks += [f"no label of {each.label}: it is not scored" for each in scores if not each.labels]
    if tables.groups == 1 and pictures > 1:
        remarks.append("all pictures are of one video or flight: no interval can be given")
    elif tables.groups < 10:
        remarks.append(
            f"only {tables.groups} videos or flights: the intervals themselves are rough"
        )
    return tuple(remarks)
