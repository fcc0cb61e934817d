"""Decoded frames between the thread that reads a stream and the mission that looks at them."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import av


@dataclass(frozen=True, eq=False)
class Arrived:
    """A decoded frame with its number in the stream, its UTC, and when it was there (monotonic clock)."""

    index: int
    time_ns: int
    arrived_s: float
    decoded: av.VideoFrame

    @property
    def size_bytes(self) -> int:
        """What the frame takes in memory, about."""
        return self.decoded.width * self.decoded.height * 3 // 2


class FrameQueue:
    """A bounded queue. `put` and `take` change it, from one thread each; `skipped` counts what nobody looked at.

    `holds_all`: frames wait for their turn until `most_bytes` are held; else only the newest waits. Where `blocks`
    is set (a file that can wait), a full queue holds up the reader instead of dropping the oldest frame.
    """

    def __init__(self, *, holds_all: bool, most_bytes: int, blocks: bool) -> None:
        self._holds_all, self._most_bytes, self._blocks = (
            holds_all,
            most_bytes,
            blocks and holds_all,
        )
        self._waiting: deque[Arrived] = deque()
        self._held_bytes = 0
        self._changed = threading.Condition()
        self._is_over = False
        self.skipped = 0

    def put(self, arrived: Arrived) -> None:
        """Let a frame wait for its turn; frames that must give way for it are counted."""
        with self._changed:
            if self._blocks:
                self._changed.wait_for(lambda: self._is_over or self._fits(arrived))
            while self._waiting and not (self._holds_all and self._fits(arrived)):
                self._drop_oldest()
            self._waiting.append(arrived)
            self._held_bytes += arrived.size_bytes
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Arrived | None:
        """The frame whose turn it is; None when none came in time, or none will come."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_over, timeout_s)
            if not self._waiting:
                return None
            arrived = self._waiting.popleft()
            self._held_bytes -= arrived.size_bytes
            self._changed.notify_all()
            return arrived

    def sift(self, wanted: Callable[[Arrived], bool]) -> None:
        """Leave out the frames in waiting that are not wanted; they do not count as skipped."""
        with self._changed:
            kept = [each for each in self._waiting if wanted(each)]
            self._waiting = deque(kept)
            self._held_bytes = sum(each.size_bytes for each in kept)
            self._changed.notify_all()

    def end(self) -> None:
        """No more frames come; those that wait can still be taken."""
        with self._changed:
            self._is_over = True
            self._changed.notify_all()

    @property
    def holds_any(self) -> bool:
        """Whether a frame waits for its turn."""
        with self._changed:
            return bool(self._waiting)

    @property
    def is_over(self) -> bool:
        """Whether nothing waits and nothing will come."""
        with self._changed:
            return self._is_over and not self._waiting

    def _fits(self, arrived: Arrived) -> bool:
        return not self._waiting or self._held_bytes + arrived.size_bytes <= self._most_bytes

    def _drop_oldest(self) -> None:
        self._held_bytes -= self._waiting.popleft().size_bytes
        self.skipped += 1
