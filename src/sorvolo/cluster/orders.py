"""What goes to a worker's process and what comes back: an order as one line of JSON, lines of answers, an ending."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Any, Literal, Self

from sorvolo.errors import SorvoloError, UnavailableError

WORKER = "sorvolo.cluster.worker"
"""The module that a worker's process runs."""

FINISH = b"finish\n"
"""What a worker is sent to end a live flight, which is then finished like any other's."""


class Mission(StrEnum):
    """What is done with each flight of a batch."""

    MAP = "map"
    COMPARE = "compare"
    SEARCH = "search"
    WATCH = "watch"


class Outcome(StrEnum):
    """How one try at a flight ended."""

    DONE = "done"
    DOUBTFUL = (
        "doubtful"  # the flight was used, its result is to be checked: exit code 3 of the mission
    )
    FAILED = "failed"  # the flight cannot be used as it is; another try would end alike
    CRASHED = "crashed"  # its process was killed, ran out of memory, stood still or broke
    WAITS = "waits"  # its database, store or site was out of reach: another try may end well

    @classmethod
    def of(cls, error: SorvoloError) -> Self:
        """How a try ended that an error ended."""
        return cls.WAITS if isinstance(error, UnavailableError) else cls.FAILED


@dataclass(frozen=True)
class WatchWish:
    """What is asked for of watches: what is searched for in how many frames a second, what is kept, who is alerted.

    As `WatchSettings` and `WatchOutputs` have it; "" is nobody, and no file.
    """

    classes: tuple[str, ...] = ()
    least_score: float | None = None
    frames_per_second: float | None = None
    save: Literal["none", "video", "pictures"] = "none"
    cot: str = ""
    cot_ca: str = ""
    cot_cert: str = ""
    alert_command: str = ""
    alert_url: str = ""


@dataclass(frozen=True)
class FlightWish:
    """What a batch asks for of each flight; everything else is as the mission's own defaults.

    `camera` is what --camera takes ("" for none), `m_per_px` the ground resolution of a new map (None: the frames'
    own); a live source has ended when nothing came for `give_up_s`. `watch` is for watches alone. `copy_to` is the
    folder, or the place in an object store, below which the site of each flight is copied ("": nowhere).
    """

    mission: Mission = Mission.MAP
    camera: str = ""
    model: str = "default"
    m_per_px: float | None = None
    give_up_s: float = 30.0
    watch: WatchWish = WatchWish()
    copy_to: str = ""

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Self:
        """The wish that a worker received."""
        watch = WatchWish(**{**plain["watch"], "classes": tuple(plain["watch"]["classes"])})
        return cls(**{**plain, "mission": Mission(plain["mission"]), "watch": watch})


@dataclass(frozen=True)
class Order:
    """One try at one flight: the file, folder or address, the folder of the site, or of a watch's results, and how much
    its caches may take, MB. `telemetry` is the receiver's address of a live source; "" for none."""

    source: str
    site: str
    wish: FlightWish
    memory_mb: float | None = None
    telemetry: str = ""

    def line(self) -> bytes:
        """The order as it goes to the worker."""
        return _line({"order": asdict(self)})

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Self:
        """The order that a worker received."""
        return cls(**{**plain, "wish": FlightWish.of(plain["wish"])})


@dataclass(frozen=True)
class ScoutOrder:
    """Files and folders to be looked into, not mapped: what flights they hold, one answer for each, in order."""

    sources: tuple[str, ...]
    camera: str = ""

    def line(self) -> bytes:
        """The order as it goes to the worker."""
        return _line({"scout": asdict(self)})


@dataclass(frozen=True)
class Scouted:
    """What is known of a flight before it is mapped.

    `start_ns` is UTC of its first frame, 0 if unknown; `box` the south, west, north and east of its fixes in degrees,
    None where it has none.
    """

    fingerprint: str
    frames: int
    start_ns: int
    box: tuple[float, float, float, float] | None


@dataclass(frozen=True)
class Ending:
    """How one try at a flight ended: what came of it, or why it did not, and what it took of which machine."""

    outcome: Outcome
    words: str
    flight: str = ""  # its name in the site
    seconds: float = 0.0
    cpu_s: float = 0.0
    peak_memory_mb: float = 0.0
    host: str = ""

    def with_effort(self, seconds: float, cpu_s: float, peak_memory_mb: float, host: str) -> Self:
        """The same, with what it took."""
        return replace(self, seconds=seconds, cpu_s=cpu_s, peak_memory_mb=peak_memory_mb, host=host)


def answer_line(kind: str, data: Mapping[str, Any]) -> bytes:
    """One answer of a worker: "alive", "found", "scouted", "unreadable", "ended" or "failed"."""
    return _line({kind: dict(data)})


def answer_of(line: bytes) -> tuple[str, dict[str, Any]] | None:
    """Kind and data of a worker's line; None for what a library printed."""
    try:
        content = json.loads(line)
    except ValueError:
        return None
    if not isinstance(content, dict) or len(content) != 1:
        return None
    kind, data = next(iter(content.items()))
    return (kind, data) if isinstance(data, dict) else None


def _line(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, ensure_ascii=False).encode("utf-8", "surrogateescape") + b"\n"
