"""What runs the tries of a batch: this machine's processes, or a cluster's."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from sorvolo.cluster.cost import Cost
from sorvolo.cluster.orders import Ending, Order

Key = tuple[str, str]
"""Of a try: the mission, and the flight or the part of one."""


class Executor(Protocol):
    """Where tries at flights run."""

    @property
    def running(self) -> Mapping[Key, object]:
        """What runs, by key."""

    @property
    def cache_mb(self) -> float:
        """Memory that a try may take for what it could also read again."""

    def has_room(self, cost: Cost) -> bool:
        """Whether another try may start."""

    def start(self, key: Key, order: Order, cost: Cost) -> None:
        """Start a try."""

    def finish(self, key: Key) -> None:
        """End a live flight, and have its map or watch finished."""

    def take_found(self) -> Sequence[tuple[Key, str]]:
        """What live watches found since this was last asked, in words."""

    def next_ended(self, timeout_s: float | None = None) -> tuple[Key, Ending] | None:
        """Wait until a try has ended; None where none did for so long. Raises SorvoloError if the executor is gone."""
