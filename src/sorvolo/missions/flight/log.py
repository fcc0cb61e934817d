"""A flight's log while it is mapped or compared: how its frames ended, and where the time went."""

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum

from sorvolo.errors import InputError
from sorvolo.survey.mosaic import Status


class Stage(StrEnum):
    """What time is spent on; reading is what the other stages leave.

    Some work goes on beside them: the detector's stage is the time waited for it, and that of laying its detections on
    the ground; the stage of comparing is the time waited for views.
    """

    UNDISTORT = "undistort"
    REGISTER = "register"
    COMPARE = "compare"
    EVIDENCE = "evidence"
    DETECT = "detect"
    HEIGHTS = "heights"
    PAINT = "paint"
    STORE = "store"
    REPORT = "report"


@dataclass(frozen=True)
class Ending:
    """How one selected frame ended, for now."""

    index: int
    name: str
    time_ns: int
    status: Status
    reason: str


class FlightLog:
    """Endings and times of one flight as they happen."""

    def __init__(self) -> None:
        self.endings: dict[int, Ending] = {}
        self.wall_s: dict[str, float] = {}
        self.cpu_s: dict[str, float] = {}
        self.offset_applied_s = 0.0
        self.delays_s: list[float] = []
        """Of each key frame of a stream: from when it came until its pixels were in the map's tiles."""
        self._started_cpu_s = time.process_time()

    def end(self, index: int, name: str, time_ns: int, status: Status, reason: str) -> None:
        """Note how a frame ended; a later note replaces an earlier one."""
        self.endings[index] = Ending(index, name, time_ns, status, reason)

    def count(self, status: Status) -> int:
        """Frames that ended so."""
        return sum(each.status is status for each in self.endings.values())

    def commonest_reason(self) -> str:
        """The reason that most rejected frames share; "" without any."""
        reasons = Counter(
            each.reason for each in self.endings.values() if each.status is Status.REJECTED
        )
        return reasons.most_common(1)[0][0] if reasons else ""

    @contextmanager
    def stage(self, stage: Stage) -> Iterator[None]:
        """Count the wall and CPU seconds of a block."""
        wall_s, cpu_s = time.monotonic(), time.process_time()
        try:
            yield
        finally:
            self.wall_s[stage.value] = self.wall_s.get(stage.value, 0.0) + time.monotonic() - wall_s
            self.cpu_s[stage.value] = self.cpu_s.get(stage.value, 0.0) + time.process_time() - cpu_s

    def total_cpu_s(self) -> float:
        """CPU seconds of the process since the flight began."""
        return time.process_time() - self._started_cpu_s


def nothing_placed(name: str, log: FlightLog) -> InputError:
    """The error for a flight none of whose frames has a place on the ground."""
    reason = log.commonest_reason() or "none was selected"
    return InputError(
        f"no frame of {name} could be placed: {reason}; `sorvolo inspect` shows what the flight holds and what to do"
    )
