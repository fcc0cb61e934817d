"""Events passed on to other people's systems: each receiver gets every event once it can, in order, across restarts."""

import json
import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sorvolo.capture.live.reconnect import Backoff
from sorvolo.errors import StoreError
from sorvolo.station.events import EventLog
from sorvolo.store.atomic import atomic_write_bytes

PASSED_ON = frozenset(
    {
        "object.found",
        "change.announced",
        "change.withdrawn",
        "review.changed",
        "run.started",
        "run.finished",
        "run.failed",
    }
)
"""The events that other systems get: what was found, what became of it, which missions ran."""

_LOG = logging.getLogger("sorvolo.station.relays")
_TURN_S = 0.2  # at what waits to be sent; by choice
_OLDEST_S = 86_400.0  # an event that could not be delivered for a day is given up


class NotTaken(Exception):
    """A receiver's answer that stays the same however often an event is sent to it."""


Send = Callable[[Mapping[str, Any]], None]
"""Sends one event. Raises NotTaken where the receiver will never have it, any other error where it may later."""


@dataclass(frozen=True)
class RelayFigures:
    """How a receiver is served: delivered, refused or given up, still waiting, and why not, in words."""

    name: str
    delivered: int
    lost: int
    waiting: int
    words: str


class Relay:
    """One receiver, served in a thread of its own. Its place in the events is kept in a file.

    An event is delivered at least once: a station that ends between sending and noting sends it again, with the same
    `seq`. `wanted` are the types of events; the first run begins with the events that come from then on.
    """

    def __init__(
        self,
        name: str,
        send: Send,
        events: EventLog,
        path: Path,
        *,
        wanted: frozenset[str] = PASSED_ON,
        pause_s: float = 0.5,
    ) -> None:
        self.name, self._send, self._events, self._path = name, send, events, path
        self._wanted, self._backoff = wanted, Backoff(first_s=pause_s, most_s=60.0)
        self._seq = _place_in(path, events.last)
        self._delivered = self._lost = 0
        self._words = ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"relay {name}", daemon=True)

    def start(self) -> None:
        """Begin to pass events on."""
        self._thread.start()

    def close(self) -> None:
        """End; what was not delivered is, when the station runs again."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(5.0)

    def figures(self) -> RelayFigures:
        """How it goes."""
        waiting = self._events.last - self._seq
        return RelayFigures(self.name, self._delivered, self._lost, waiting, self._words)

    def _run(self) -> None:
        while not self._stop.is_set():
            events = self._events.after(self._seq) if self._events.last > self._seq else []
            for event in events:
                if event["type"] in self._wanted and not self._deliver(event):
                    return
                self._seq = event["seq"]
            if events:
                self._keep_place()
            else:
                self._stop.wait(_TURN_S)

    def _deliver(self, event: Mapping[str, Any]) -> bool:
        """Send until it is taken, refused or too old; False where the station ends meanwhile."""
        while not self._stop.is_set():
            try:
                self._send(event)
            except NotTaken as error:
                self._lose(event, str(error))
                return True
            except Exception as error:  # whatever a receiver does must not end the relay
                self._note(str(error) or type(error).__name__)
                if _age_s(event) > _OLDEST_S:
                    self._lose(event, self._words)
                    return True
                self._keep_place()
                self._stop.wait(self._backoff.next_s())
            else:
                self._delivered += 1
                self._words = ""
                self._backoff.reset()
                return True
        return False

    def _lose(self, event: Mapping[str, Any], why: str) -> None:
        self._lost += 1
        self._words = why
        _LOG.warning(
            "%s does not take event %s (%s): %s", self.name, event["seq"], event["type"], why
        )

    def _note(self, why: str) -> None:
        words = " ".join(why.split())[:200]
        if words != self._words:
            _LOG.warning("%s cannot be reached: %s; trying again", self.name, words)
        self._words = words

    def _keep_place(self) -> None:
        try:
            atomic_write_bytes(
                self._path, json.dumps({"name": self.name, "seq": self._seq}).encode()
            )
        except (
            OSError,
            StoreError,
        ) as error:  # a full disk costs events that are sent twice, not events
            _LOG.warning("cannot note what %s got: %s", self.name, error)


def features_of(event: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The GeoJSON features in an event's data."""
    data = event.get("data") or {}
    for each in (data.get("feature"), *(data.get("features") or ())):
        if isinstance(each, Mapping):
            yield each


def _place_in(path: Path, last: int) -> int:
    try:
        seq = int(json.loads(path.read_bytes())["seq"])
    except (OSError, ValueError, KeyError, TypeError):
        return last
    return min(seq, last)


def _age_s(event: Mapping[str, Any]) -> float:
    try:
        at = datetime.fromisoformat(str(event["at"]))
    except (KeyError, ValueError):
        return 0.0
    return time.time() - (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()
