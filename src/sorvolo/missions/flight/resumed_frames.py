"""A killed run's frames, handed out again one by one as the input comes to them."""

from collections.abc import Iterator
from typing import Generic, Protocol, TypeVar


class Indexed(Protocol):
    """What is known of a frame, by its index."""

    @property
    def index(self) -> int:
        """The frame's index in its flight."""


_Frame = TypeVar("_Frame", bound=Indexed)


class ResumedFrames(Generic[_Frame]):
    """Frames in the order in which they were worked on; each is handed out once."""

    def __init__(self, frames: Iterator[_Frame]) -> None:
        self._frames = frames
        self._next: _Frame | None = None

    def take(self, index: int) -> _Frame | None:
        """The next frame, if it is the one of this index."""
        if self._next is None:
            self._next = next(self._frames, None)
        if self._next is None or self._next.index != index:
            return None
        frame, self._next = self._next, None
        return frame
