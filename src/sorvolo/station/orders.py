"""What a mission of the station is asked to do: its options within bounds, its inputs by ids, its order on the disk."""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from sorvolo.capture.live.addresses import shown_address
from sorvolo.missions.worker import Order
from sorvolo.store.atomic import atomic_write_bytes

ORDER_FILE = "order.json"
JOURNAL_FILE = "journal.jsonl"
LOG_FILE = "log.txt"
LOCK_FILE = "running.lock"
"""The files of a run's folder: what it is to do, what it did line by line, what it printed, who is at it."""

LOCK_VARIABLE = "SORVOLO_RUN_LOCK"
"""Of the environment of a run's process: the number of its lock's descriptor, which its own children must not have."""

SOURCE_VARIABLE = "SORVOLO_RUN_SOURCE"
"""Of the same: the input, whose password no file is to hold."""

Mission = Literal["map", "compare", "watch", "search", "demo"]


def writes(mission: str, has_input: bool, options: Mapping[str, Any]) -> bool:
    """Whether a mission writes into its site, as one at a time may; a search does that maps a flight first, or keeps
    whom it finds below crowns."""
    is_writing_search = has_input or bool(options.get("through_trees"))
    return mission in ("map", "compare", "demo") or (mission == "search" and is_writing_search)


_CAMERA = r"^(aov=[0-9.]{1,8}|focal_px=[0-9.]{1,10}|[A-Za-z0-9 .+-]+)$"  # a preset's name: no path


class Wish(BaseModel):
    """What a request asks for: exactly of the types that it states, so that true is no number."""

    model_config = ConfigDict(strict=True)


class InputWish(Wish, extra="forbid"):
    """Where a flight comes from: exactly one of an upload's id, an id of GET /api/inputs, a stream's URL, the name of a
    stream that a drone sends here."""

    upload: Annotated[str | None, Field(min_length=1, max_length=64)] = None
    input: Annotated[str | None, Field(min_length=1, max_length=64)] = None
    stream_url: Annotated[str | None, Field(min_length=1, max_length=2000)] = None
    stream: Annotated[str | None, Field(min_length=1, max_length=80)] = None

    @model_validator(mode="after")
    def _one_of_them(self) -> "InputWish":
        given = [name for name, value in self if value is not None]
        if len(given) != 1:
            raise ValueError(
                f"one of upload, input, stream_url and stream was needed, got {len(given)}"
            )
        return self


class MissionOptions(Wish, extra="forbid"):
    """What may be chosen from outside; everything else is as the command line's defaults."""

    camera: Annotated[str | None, Field(max_length=80, pattern=_CAMERA)] = None
    camera_file: InputWish | None = None
    telemetry: InputWish | None = None
    model: Annotated[str | None, Field(max_length=80, pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")] = (
        None
    )
    classes: Annotated[
        list[Annotated[str, Field(min_length=1, max_length=60)]], Field(max_length=40)
    ] = []
    overlap: Annotated[float, Field(gt=0, lt=1)] = 0.7
    m_per_px: Annotated[float | None, Field(ge=1e-3, le=100)] = None
    votes: Annotated[int, Field(ge=1, le=6)] = 3
    updates_map: bool = True
    least_score: Annotated[float | None, Field(ge=0, le=1)] = None
    frames_per_second: Annotated[float | None, Field(ge=0.01, le=240)] = None
    plants: Annotated[int, Field(ge=10, le=5000)] = 80
    through_trees: bool = False  # a search looks below the newest flight's crowns instead
    ground_elevation_m: Annotated[float | None, Field(ge=-1000, le=9000)] = None


class RunWish(Wish, extra="forbid"):
    """A mission to start."""

    mission: Mission
    site: str = Field(min_length=1, max_length=200)
    input: InputWish | None = None
    options: MissionOptions = MissionOptions()

    @model_validator(mode="after")
    def _input_where_needed(self) -> "RunWish":
        if self.input is None and self.mission not in ("search", "demo"):
            raise ValueError(
                "map, compare and watch need an input; search without one measures the site's flights"
            )
        if self.options.through_trees and (self.input is not None or self.mission != "search"):
            raise ValueError(
                "through_trees is for a search of a mapped flight; leave it out, or the input"
            )
        return self


@dataclass(frozen=True, kw_only=True)
class RunOrder(Order):
    """What the process of a run does.

    `source` is a path or an address with its password, which the order's file leaves out. `stream` is the name of the
    stream behind it, if any: a drone's, or the one as which the station keeps a camera's in `streams`, taken at the
    socket `door`. A disk with less than `floor_gb` free is full.
    """

    run: str
    door: str = ""
    streams: str = ""
    floor_gb: float = 0.0

    def write(self, folder: Path) -> None:
        """Put it into a run's folder, without a stream's password. Raises StoreError on a full disk."""
        kept = asdict(self) | {"source": without_password(self.source)}
        atomic_write_bytes(folder / ORDER_FILE, json.dumps(kept).encode())
        (folder / ORDER_FILE).chmod(0o600)

    @classmethod
    def read(cls, folder: Path) -> "RunOrder":
        """The order in a run's folder; the whole address of a stream comes from the process's environment."""
        order = cls(**json.loads((folder / ORDER_FILE).read_bytes()))
        source = os.environ.pop(SOURCE_VARIABLE, order.source)
        return replace(order, source=source) if without_password(source) == order.source else order


def without_password(source: str) -> str:
    """A path as it is; a stream's address without user, password and what stands behind its `?`."""
    return shown_address(source).partition("?")[0] if "://" in source else source
