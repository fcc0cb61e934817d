"""A training run as bytes, to go on from after a kill: weights, optimiser, random numbers, settings, losses so far."""

import json
import pickle
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import safetensors.torch
import torch

from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.lab.training.progress import History, Learner

_FORMAT = 1

UNREADABLE = (
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
    except (*UNREADABLE, TypeError) as error:
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


def weights_bytes(model: FasterRCNN) -> bytes:
    """The network's weights alone, as a safetensors file."""
    return safetensors.torch.save(
        {name: value.cpu().contiguous() for name, value in model.state_dict().items()}
    )


def load_weights_bytes(model: FasterRCNN, data: bytes, name: str) -> None:
    """Take what `weights_bytes` gave. Raises InputError, naming `name`, when it is damaged or of another network."""
    try:
        model.load_state_dict(safetensors.torch.load(data))
    except (safetensors.SafetensorError, RuntimeError) as error:
        first = str(error).strip().split("\n")[0][:160]
        raise InputError(
            f"{name} does not hold this network's weights, or is damaged ({first}); train anew"
        ) from error
