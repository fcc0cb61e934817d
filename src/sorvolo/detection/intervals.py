"""How sure a measured accuracy is: bootstrap intervals over groups of pictures that belong together, and over seeds.

Pictures of one video or flight resemble each other, so that whole groups are drawn, with replacement (Efron and
Tibshirani 1993, the percentile interval). Two models are compared on the same draws: what is hard is hard for both.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.detection.metrics import IOUS, ClassMatch
from sorvolo.geometry.arrays import Floats, Rows

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
class Difference:
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

    @property
    def label_counts(self) -> dict[str, int]:
        """How many labels each class has."""
        return {table.label: int(table.labels.sum()) for table in self.tables}

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
    if tables.groups < 2:
        return {name: Interval(float(value[0]), np.nan, np.nan) for name, value in exact.items()}
    drawn = tables.measure(draw_groups(tables.groups, draws, seed))
    return {name: Interval(float(value[0]), *_bounds(drawn[name])) for name, value in exact.items()}


def differences(
    a: Sequence[GroupTables], b: Sequence[GroupTables], *, draws: int = DRAWS, seed: int = 0
) -> dict[str, Difference]:
    """How much higher B measures than A on the same pictures; an arm is a model, or one trained with several seeds.

    Values are means over an arm's seeds; every draw draws groups, the same for both, and seeds of each arm. With one
    group and one seed an arm there is nothing to draw: the bounds are NaN.
    """
    groups = a[0].groups
    exact = [_means(arm) for arm in (a, b)]
    values = {
        name: float(exact[1][name][0] - exact[0][name][0]) for name in exact[0] if name in exact[1]
    }
    if groups < 2 and len(a) < 2 and len(b) < 2:
        return {name: Difference(value, np.nan, np.nan, np.nan) for name, value in values.items()}
    weights = draw_groups(groups, draws, seed)
    rng = np.random.default_rng([seed, 4302])
    of_a, of_b = (_drawn_means(arm, weights, values, rng) for arm in (a, b))
    return {name: _difference(value, of_b[name] - of_a[name]) for name, value in values.items()}


def _difference(value: float, drawn: Floats) -> Difference:
    known = drawn[~np.isnan(drawn)]
    return Difference(value, *_bounds(drawn), float((known > 0).mean()) if len(known) else np.nan)


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


def _means(arm: Sequence[GroupTables]) -> dict[str, Floats]:
    """Each measure (1,) of an arm on all groups: the mean over its seeds."""
    measured = [each.measure(np.ones((1, each.groups))) for each in arm]
    return {name: np.mean([each[name] for each in measured], axis=0) for name in measured[0]}


def _bounds(values: Floats) -> tuple[float, float]:
    known = values[~np.isnan(values)]
    if not len(known):
        return np.nan, np.nan
    low, high = np.percentile(known, (2.5, 97.5))
    return float(low), float(high)
