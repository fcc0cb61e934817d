"""How a training goes: what every schedule can do, its losses over time, and what is left."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np

from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.lab.training.joint import Progress
from sorvolo.lab.training.losses import LossRow
from sorvolo.lab.training.samples import Sample


class Learner(Protocol):
    """A model on its way, by one schedule or another; only `learn` changes it."""

    model: FasterRCNN
    step: int

    @property
    def average(self) -> FasterRCNN:
        """The model that would be kept if training ended now."""

    @property
    def phase(self) -> str:
        """What it learns now, in words."""

    @property
    def is_whole(self) -> bool:
        """Whether the model's parts fit together already, so that it can be checked."""

    def learn(self, batch: Sequence[Sample]) -> Progress:
        """One step."""

    def state(self) -> dict[str, object]:
        """All that is needed to go on."""

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from there."""


@dataclass(frozen=True)
class Check:
    """Accuracy on the validation pictures after `step`: COCO's AP50 and AP, AP50 of each class; NaN if unknown."""

    step: int
    ap50: float
    ap: float
    classes: Mapping[str, float]


@dataclass(frozen=True)
class History:
    """All rows of losses and all checks, in order; `pending` are steps that are in no row yet."""

    rows: tuple[LossRow, ...] = ()
    checks: tuple[Check, ...] = ()
    pending: tuple[LossRow, ...] = ()

    def after(self, done: Progress, seconds: float, *, every: int) -> "History":
        """With one step more; a row is closed after each `every` steps and the last. `seconds` are of all runs."""
        pending = (
            *self.pending,
            LossRow(
                done.step,
                done.proposal_score,
                done.proposal_box,
                done.region_score,
                done.region_box,
                seconds,
            ),
        )
        if done.step % every and done.step != done.steps:
            return History(self.rows, self.checks, pending)
        row = LossRow(
            done.step,
            _mean(r.proposal_score for r in pending),
            _mean(r.proposal_box for r in pending),
            _mean(r.region_score for r in pending),
            _mean(r.region_box for r in pending),
            seconds,
        )
        return History((*self.rows, row), self.checks)

    def checked(self, check: Check) -> "History":
        """With one check more."""
        return History(self.rows, (*self.checks, check), self.pending)

    @property
    def best(self) -> Check | None:
        """The check with the highest AP50, the first of equals; None where none knows it."""
        known = [each for each in self.checks if not np.isnan(each.ap50)]
        return max(known, key=lambda each: each.ap50) if known else None

    def is_worth_going_on(self, patience: int) -> bool:
        """Whether the best check is among the last `patience` ones; 0 never gives up."""
        best = self.best
        return patience == 0 or best is None or best in self.checks[-patience:]

    @property
    def seconds(self) -> float:
        """Seconds of learning so far."""
        rows = (*self.rows, *self.pending)
        return rows[-1].seconds if rows else 0.0

    def plain(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self)

    @staticmethod
    def from_plain(plain: Mapping[str, Any]) -> "History":
        """The inverse of `plain`. Raises TypeError or KeyError for anything else."""
        return History(
            tuple(LossRow(**each) for each in plain["rows"]),
            tuple(Check(**each) for each in plain["checks"]),
            tuple(LossRow(**each) for each in plain["pending"]),
        )


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def seconds_left(step: int, steps: int, steps_here: int, seconds_here: float) -> float:
    """How long the rest takes at the pace of this run's `steps_here` steps; NaN before the first."""
    return (steps - step) * seconds_here / steps_here if steps_here else float("nan")
