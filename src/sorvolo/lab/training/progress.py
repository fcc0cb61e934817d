"""How a training goes: what every learner can do, its losses over time, and what is left."""

import json
import pickle
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from io import BytesIO
from typing import Any, Protocol

import numpy as np
import safetensors.torch
import torch

from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.training.boxes import Finder
from sorvolo.lab.training.samples import TrainingSample


@dataclass(frozen=True)
class LossRow:
    """The losses of `step` by name, or their means over the steps since the row before; seconds of learning so far."""

    step: int
    losses: Mapping[str, float]
    seconds: float

    @property
    def loss(self) -> float:
        """Their sum, which is minimised."""
        return sum(self.losses.values())


@dataclass(frozen=True)
class Progress(LossRow):
    """Where training stands after a step of `steps`; the losses are this step's, the seconds this run's."""

    steps: int


class Learner(Protocol):
    """A model on its way; only `learn` changes it."""

    step: int

    @property
    def average(self) -> Finder:
        """The model that would be kept if training ended now."""

    @property
    def phase(self) -> str:
        """What it learns now, in words."""

    @property
    def is_whole(self) -> bool:
        """Whether the model's parts fit together already, so that it can be checked."""

    def learn(self, batch: Sequence[TrainingSample]) -> Progress:
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
        pending = (*self.pending, LossRow(done.step, done.losses, seconds))
        if done.step % every and done.step != done.steps:
            return History(self.rows, self.checks, pending)
        means = {
            name: float(np.mean([row.losses[name] for row in pending])) for name in done.losses
        }
        row = LossRow(done.step, means, seconds)
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


def seconds_left(step: int, steps: int, steps_here: int, seconds_here: float) -> float:
    """How long the rest takes at the pace of this run's `steps_here` steps; NaN before the first."""
    return (steps - step) * seconds_here / steps_here if steps_here else float("nan")


_UNREADABLE = (
    pickle.UnpicklingError,
    struct.error,
    RuntimeError,
    EOFError,
    ValueError,
    LookupError,
    AttributeError,
    AssertionError,
)
"""What `torch.load(weights_only=True)` raises on damaged files: its reader of pickles trusts their bytes."""
_FORMAT = 1


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """What a file held: the learner's state, the run's settings and its history."""

    state: dict[str, Any]
    settings: Mapping[str, Any]
    history: History


def checkpoint_bytes(learner: Learner, settings: Mapping[str, Any], history: History) -> bytes:
    """All of a run at this step; `settings` are plain values (JSON), those that another run must share to go on."""
    content = {
        "format": _FORMAT,
        "state": learner.state(),
        "torch_random": torch.get_rng_state(),
        "about": json.dumps({"settings": dict(settings), "history": history.plain()}),
    }
    out = BytesIO()
    torch.save(content, out)
    return out.getvalue()


def read_checkpoint(data: bytes, name: str) -> Checkpoint:
    """The checkpoint in a file's bytes; nothing in it is run. Raises InputError, naming `name`, when it is none."""
    try:
        content = torch.load(BytesIO(data), map_location="cpu", weights_only=True)
        if content["format"] > _FORMAT:
            raise InputError(
                f"{name} is a checkpoint of a newer sorvolo (format {content['format']}); update sorvolo"
            )
        about = json.loads(content["about"])
        history = History.from_plain(about["history"])
        state = {**content["state"], "torch_random": content["torch_random"]}
    except (*_UNREADABLE, TypeError) as error:
        first = str(error).strip().split("\n")[0][:120]
        raise InputError(
            f"{name} is no checkpoint of sorvolo, or damaged ({first}); start anew without --resume"
        ) from error
    return Checkpoint(state, about["settings"], history)


def restore(learner: Learner, checkpoint: Checkpoint, settings: Mapping[str, Any]) -> None:
    """Bring a freshly built learner to where the checkpoint's was.

    Raises SettingsError, naming each difference, when the run that wrote it had other settings, and InputError when its
    weights do not fit the network.
    """
    now = json.loads(json.dumps(dict(settings)))
    differing = [
        f"{name} was {checkpoint.settings.get(name)!r}, is {now.get(name)!r}"
        for name in sorted({*now, *checkpoint.settings})
        if now.get(name) != checkpoint.settings.get(name)
    ]
    if differing:
        raise SettingsError(
            f"a run cannot continue with other settings: {'; '.join(differing)}; give the earlier ones, or a new --out"
        )
    try:
        learner.load_state(checkpoint.state)
    except (RuntimeError, KeyError, ValueError) as error:
        first = str(error).strip().split("\n")[0][:160]
        raise InputError(
            f"the checkpoint does not fit this network ({first}); start anew without --resume"
        ) from error
    torch.set_rng_state(checkpoint.state["torch_random"])


def weights_bytes(model: Finder) -> bytes:
    """The network's weights alone, as a safetensors file."""
    return safetensors.torch.save(
        {name: value.cpu().contiguous() for name, value in model.state_dict().items()}
    )


def load_weights_bytes(model: Finder, data: bytes, name: str) -> None:
    """Take what `weights_bytes` gave. Raises InputError, naming `name`, when it is damaged or of another network."""
    try:
        model.load_state_dict(safetensors.torch.load(data))
    except (safetensors.SafetensorError, RuntimeError) as error:
        first = str(error).strip().split("\n")[0][:160]
        raise InputError(
            f"{name} does not hold this network's weights, or is damaged ({first}); train anew"
        ) from error
