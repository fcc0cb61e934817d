"""What a live source does when nothing comes: how long it waits, when it tries again, and what it remembers of it."""

import logging
import random
import threading
import time
from dataclasses import dataclass

from sorvolo.capture.telemetry.cleaning import notice
from sorvolo.errors import SettingsError
from sorvolo.survey.flight import Notice

_LOG = logging.getLogger("sorvolo.live")


@dataclass(frozen=True)
class LiveSettings:
    """How a live source is read."""

    # (mapping); else a slow computer leaves out what it cannot decode in time (watching)
    keeps_all: bool = False
    # without a packet: the source counts as silent, which is reported, and is opened anew
    silent_s: float = 3.0
    first_s: float = 20.0  # to wait for the first frame before giving up
    give_up_s: float = 30.0  # a source that was silent for so long has ended
    # a frame waits so long for the fix that follows it, if every frame is kept
    fix_wait_s: float = 1.0
    most_bytes: int = 256_000_000  # of decoded frames that wait
    # the same of a growing file, which itself keeps what nobody has read yet
    most_bytes_of_file: int = 32_000_000
    # a run that was killed goes on with a stream that returns within so long
    same_flight_s: float = 900.0

    follows_redirects: bool = True  # of an RTSP camera; else it is read over its connection alone

    def __post_init__(self) -> None:
        for name in ("silent_s", "first_s", "give_up_s"):
            if not 0.05 <= getattr(self, name) <= 86_400:
                raise SettingsError(
                    f"{name} must lie in 0.05 to 86400 s, got {getattr(self, name)}"
                )


class Outages:
    """The times in which a source was silent. `lost` and `back` change it; safe to use from several threads."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._since_s: float | None = None
        self._reason = ""
        self._lengths_s: list[float] = []
        self._lock = threading.Lock()

    def lost(self, since_s: float, reason: str) -> None:
        """Nothing came since that moment (monotonic clock); logged once for each outage."""
        with self._lock:
            if self._since_s is not None:
                return
            self._since_s, self._reason = since_s, reason
        _LOG.warning("%s: %s; trying again", self._what, reason)

    def back(self) -> None:
        """Something came again."""
        with self._lock:
            if self._since_s is None:
                return
            length_s = time.monotonic() - self._since_s
            self._lengths_s.append(length_s)
            self._since_s = None
        _LOG.warning("%s: back after %.1f s", self._what, length_s)

    @property
    def silent_s(self) -> float:
        """How long the source has been silent now; 0 while it speaks."""
        with self._lock:
            return 0.0 if self._since_s is None else time.monotonic() - self._since_s

    @property
    def reason(self) -> str:
        """Why it was silent last, in words."""
        return self._reason

    @property
    def lengths_s(self) -> tuple[float, ...]:
        """How long each outage lasted that is over, s."""
        with self._lock:
            return tuple(self._lengths_s)

    def notices(self, code: str = "outage") -> list[Notice]:
        """The outages that ended with the source speaking again."""
        lengths_s = self.lengths_s
        longest_s = max(lengths_s, default=0.0)
        words = f"{self._what}: {{}} outages, {sum(lengths_s):.1f} s in all, the longest {longest_s:.1f} s"
        return notice(code, len(lengths_s), words)


class Backoff:
    """Growing pauses between attempts: 0.5 s doubling to 10 s, each up to a quarter longer or shorter."""

    def __init__(self, first_s: float = 0.5, most_s: float = 10.0) -> None:
        self._first_s, self._most_s = first_s, most_s
        self._next_s = first_s

    def next_s(self) -> float:
        """The pause before the next attempt."""
        # so that many ground stations do not knock at once
        pause_s = self._next_s * random.uniform(0.75, 1.25)
        self._next_s = min(2 * self._next_s, self._most_s)
        return pause_s

    def reset(self) -> None:
        """An attempt succeeded."""
        self._next_s = self._first_s
