"""Everything that is measured of one model on one labelled set, and of several models side by side."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Counts, Floats, Rows
from sorvolo.geometry.summary import CalibrationBin
from sorvolo.lab.evaluation.detection_metrics import (
    IOUS,
    SIZES_M,
    SIZES_PX,
    ClassMatch,
    CocoNumbers,
    Mistake,
    SizeRow,
    Threshold,
    at_score,
    best_threshold,
    confusion,
    judged_classes,
    match_pictures,
    precision_recall,
    recall_by_size,
    right_by_score,
)
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import Detections

DRAWS = 1000  # resamplings, the usual number for limits of 95 % (Efron and Tibshirani 1993)
_RECALLS = np.linspace(0.0, 1.0, 101)
_AT_ONCE = 200  # draws: the tables of all at once would be large


@dataclass(frozen=True)
class Interval:
    """A measured value and the interval that holds it with 95 %; NaN bounds where one group is all there is."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class ScoreDifference:
    """How much higher B measures than A: the value, its 95 % interval, the share of draws in which it is above 0."""

    value: float
    low: float
    high: float
    share_above: float

    @property
    def is_clear(self) -> bool:
        """Whether the interval leaves zero out."""
        return bool(self.low > 0 or self.high < 0)


@dataclass(frozen=True, eq=False)
class _ClassTable:
    """What average precision needs of one class, by group: at each IoU the true positives, best first, their groups
    (N,), and the false positives of every group before each of them (N, groups)."""

    label: str
    true_groups: tuple[Rows, ...]
    false_before: tuple[Floats, ...]
    labels: Floats  # (groups,)
    reported_right: Floats  # (groups,) at the reporting threshold, IoU 0.5
    reported_wrong: Floats


@dataclass(frozen=True, eq=False)
class GroupTables:
    """One model's results on one set, ready to be measured on any draw of its groups."""

    tables: tuple[_ClassTable, ...]
    groups: int

    def measure(self, weights: Floats) -> dict[str, Floats]:
        """Each measure (draws,) for weights (draws, groups): how often each group was drawn.

        "AP", "AP50", "AP75" and "thesis_map" are means over the classes with labels; "AP50 person" and the like, a
        class's own. All weights one gives COCO's own numbers.
        """
        parts = [
            self._measure(weights[start : start + _AT_ONCE])
            for start in range(0, len(weights), _AT_ONCE)
        ]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _measure(self, weights: Floats) -> dict[str, Floats]:
        every: list[Floats] = []
        single: dict[str, Floats] = {}
        for table in self.tables:
            aps = np.stack(
                [
                    _average_precision(table.labels, groups, before, weights)
                    for groups, before in zip(table.true_groups, table.false_before)
                ]
            )
            right, wrong = weights @ table.reported_right, weights @ table.reported_wrong
            precision = np.where(right + wrong > 0, right / np.maximum(right + wrong, 1), 0.0)
            precision[weights @ table.labels == 0] = np.nan
            every.append(np.stack([aps.mean(axis=0), aps[0], aps[5], precision]))
            single |= {f"AP {table.label}": aps.mean(axis=0), f"AP50 {table.label}": aps[0]}
        known = ~np.isnan(every)
        means = np.where(known, every, 0).sum(axis=0) / np.where(
            known.any(axis=0), known.sum(axis=0), np.nan
        )
        return dict(zip(("AP", "AP50", "AP75", "thesis_map"), means)) | single


def group_tables(
    matches: Sequence[ClassMatch], groups: Rows, thresholds: Mapping[str, float]
) -> GroupTables:
    """The tables of a set's matches; `groups` (P,) is the index of each picture's group, from 0 without gaps."""
    count = int(groups.max()) + 1 if len(groups) else 0
    tables = []
    for match in matches:
        of_found, of_true = groups[match.pictures], groups[match.true_pictures]
        right, before = [], []
        for k in range(len(IOUS)):
            right.append(of_found[match.right[k]])
            wrong = ~match.right[k] & ~match.ignored[k]
            # each false positive lowers the precision from the next true one on
            steps = np.zeros((len(right[-1]) + 1, count))
            np.add.at(steps, (np.cumsum(match.right[k])[wrong], of_found[wrong]), 1)
            before.append(np.cumsum(steps[:-1], axis=0))
        reported = match.scores >= thresholds[match.label]
        tables.append(
            _ClassTable(
                match.label,
                tuple(right),
                tuple(before),
                _counted(of_true, count),
                _counted(of_found[reported & match.right[0]], count),
                _counted(of_found[reported & ~match.right[0] & ~match.ignored[0]], count),
            )
        )
    return GroupTables(tuple(tables), count)


def draw_groups(count: int, draws: int, seed: int) -> Floats:
    """(draws, count) how often each of `count` groups was drawn when `count` are drawn with replacement."""
    rng = np.random.default_rng([seed, 4301])
    return rng.multinomial(count, np.full(count, 1 / count), draws).astype(np.float64)


def intervals(tables: GroupTables, *, draws: int = DRAWS, seed: int = 0) -> dict[str, Interval]:
    """Every measure with its interval."""
    exact = tables.measure(np.ones((1, tables.groups)))
    # one group is all there is: nothing can be drawn
    drawn = {} if tables.groups < 2 else tables.measure(draw_groups(tables.groups, draws, seed))
    return {
        name: Interval(float(value[0]), *_bounds(drawn.get(name, np.zeros(0))))
        for name, value in exact.items()
    }


def differences(
    a: Sequence[GroupTables], b: Sequence[GroupTables], *, draws: int = DRAWS, seed: int = 0
) -> dict[str, ScoreDifference]:
    """How much higher B measures than A on the same pictures; an arm is a model, or one trained with several seeds.

    Values are means over an arm's seeds; every draw draws groups, the same for both, and seeds of each arm. With one
    group and one seed an arm there is nothing to draw: the bounds are NaN.
    """
    groups = a[0].groups
    of_a, of_b = (_arm_scores("", arm).mean for arm in (a, b))
    values = {name: of_b[name] - of_a[name] for name in of_a if name in of_b}
    is_drawn = groups > 1 or len(a) > 1 or len(b) > 1
    weights = draw_groups(groups, draws if is_drawn else 1, seed)
    rng = np.random.default_rng([seed, 4302])
    drawn_a, drawn_b = (_drawn_means(arm, weights, values, rng) for arm in (a, b))
    result = {}
    for name, value in values.items():
        drawn = (drawn_b[name] - drawn_a[name])[: len(weights) * is_drawn]
        known = drawn[~np.isnan(drawn)]
        share_above = float((known > 0).mean()) if len(known) else np.nan
        result[name] = ScoreDifference(value, *_bounds(drawn), share_above)
    return result


def _drawn_means(
    arm: Sequence[GroupTables], weights: Floats, names: Iterable[str], rng: np.random.Generator
) -> dict[str, Floats]:
    """Each measure (draws,) of an arm: in every draw the mean over as many of its seeds, drawn with replacement."""
    measured = [each.measure(weights) for each in arm]
    draws = len(weights)
    chosen = rng.integers(len(arm), size=(len(arm), draws))
    return {
        name: np.stack([each[name] for each in measured])[chosen, np.arange(draws)].mean(axis=0)
        for name in names
    }


def _average_precision(labels: Floats, groups: Rows, before: Floats, weights: Floats) -> Floats:
    """(draws,) COCO's average of precision at 101 recalls; NaN where the draw has no label."""
    total = weights @ labels
    result = np.where(total > 0, 0.0, np.nan)
    if not len(groups):
        return result
    right = np.cumsum(weights[:, groups], axis=1)
    precision = right / np.maximum(right + weights @ before.T, 1e-12)
    envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
    for draw in np.flatnonzero(total > 0):
        first = np.searchsorted(right[draw] / total[draw], _RECALLS, side="left")
        reached = first < len(groups)
        result[draw] = envelope[draw, first[reached]].sum() / len(_RECALLS)
    return result


def _counted(groups: Rows, count: int) -> Floats:
    return np.bincount(groups, minlength=count).astype(np.float64)


def _bounds(values: Floats) -> tuple[float, float]:
    known = values[~np.isnan(values)]
    if not len(known):
        return np.nan, np.nan
    low, high = np.percentile(known, (2.5, 97.5))
    return float(low), float(high)


_CURVE_POINTS = 200  # of a curve that a page draws some hundred pixels wide


@dataclass(frozen=True, eq=False)
class ClassScores:
    """One class: COCO's numbers, what reporting at the model's own threshold gives, the best threshold in hindsight.

    `curve` (N, 3) is score, precision and recall at IoU 0.5, thinned; `by_score` has what share of each tenth of the
    score is right. The thesis's AP (eq. 4.3) is `reported.precision`.
    """

    label: str
    labels: int
    coco: CocoNumbers
    reported: Threshold
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
    differences: tuple[Mapping[str, ScoreDifference], ...]


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
    scores = [
        ClassScores(
            match.label,
            len(match.true_scores),
            by_class[match.label],
            at_score(match, thresholds[match.label]),
            best_threshold(match),
            _thinned(np.column_stack(precision_recall(match))),
            tuple(right_by_score(match)),
        )
        for match in matches
    ]
    m_per_px = np.array([picture.m_per_px for picture in labelled.pictures])
    pictures = len(labelled)
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
    return SetScores(
        labelled.name,
        len(labelled),
        tables.groups,
        sum(len(each.ignored_px) for each in labelled.pictures),
        tuple(name for name in classes if name not in judged),
        coco,
        intervals(tables, draws=draws, seed=seed),
        tuple(scores),
        table,
        recall_by_size(matches, thresholds, np.ones(len(labelled)), SIZES_PX),
        recall_by_size(matches, thresholds, m_per_px, SIZES_M),
        mistakes,
        tuple(remarks),
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
    # The tables of each of an arm's seeds
    tables = [
        [
            group_tables(match_pictures(labelled, found, judged)[0], groups, thresholds)
            for found, thresholds in zip(arm.found, arm.thresholds)
        ]
        for arm in arms
    ]
    first = tables[0][0]
    return SetComparison(
        labelled.name,
        len(labelled),
        first.groups,
        {table.label: int(table.labels.sum()) for table in first.tables},
        tuple(_arm_scores(arm.name, each) for arm, each in zip(arms, tables)),
        tuple(differences(tables[0], each, draws=draws, seed=seed) for each in tables[1:]),
    )


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
