"""Flights of a batch in processes of this machine."""

import os
import queue
import threading
from collections.abc import Mapping, Sequence
from typing import Self

from sorvolo.capture.live.addresses import is_live_address
from sorvolo.cluster.cost import Cost, CostSettings
from sorvolo.cluster.orders import Ending, Order
from sorvolo.cluster.process import WorkerProcess, most_memory_mb, run_order
from sorvolo.missions.flight.memory import MemorySettings, available_bytes, memory_budget_bytes

Key = tuple[str, str]


class LocalExecutor:
    """At most `workers` processes at once, and no more than the memory holds. A context manager: leaving ends them.

    `lock` is the batch's, which the processes keep until they are gone.
    """

    def __init__(
        self,
        workers: int,
        stall_s: float,
        lock: int,
        costs: CostSettings = CostSettings(),
    ) -> None:
        self.workers, self._costs = workers, costs
        self._stall_s, self._lock = stall_s, lock
        self._running: dict[Key, tuple[WorkerProcess, Cost]] = {}
        self._live: set[Key] = set()
        self._ended: queue.SimpleQueue[tuple[Key, Ending]] = queue.SimpleQueue()
        self._found: queue.SimpleQueue[tuple[Key, str]] = queue.SimpleQueue()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for worker, _cost in self._running.values():
            worker.kill()
        while self._running:  # each is waited for by its thread
            self.next_ended()

    @property
    def running(self) -> Mapping[Key, object]:
        """What runs, by key."""
        return self._running

    def has_room(self, cost: Cost) -> bool:
        """Whether another try may start."""
        if not self._running:
            return True
        taken_mb = sum(map(self._memory_mb, self._running))
        most_mb = self._costs.machine_share * available_bytes() / 1e6
        return len(self._running) < self.workers and taken_mb + cost.memory_mb <= most_mb

    def _memory_mb(self, key: Key) -> float:
        """What a running try is budgeted: what it was given; a live one, which may never end, what it needs if known."""
        worker, cost = self._running[key]
        if key not in self._live or worker.seconds < self._costs.settled_s:
            return cost.memory_mb
        return self._costs.reserve * most_memory_mb(worker.pid) or cost.memory_mb

    @property
    def cache_mb(self) -> float:
        """Memory for what a worker could also read again: the machine's share of it, divided among the workers."""
        return max(MemorySettings().least_mb, memory_budget_bytes(None) / 1e6 / self.workers)

    def start(self, key: Key, order: Order, cost: Cost) -> None:
        """Start a try."""
        worker = WorkerProcess(order, [self._lock])
        self._running[key] = (worker, cost)
        if is_live_address(order.source):
            self._live.add(key)
        threading.Thread(
            target=self._wait, args=(key, worker), daemon=True, name=f"flight {key[1][:8]}"
        ).start()

    def finish(self, key: Key) -> None:
        """End a live flight, and have its map or watch finished."""
        self._running[key][0].finish()

    def take_found(self) -> Sequence[tuple[Key, str]]:
        """What watches found since this was last asked, in words."""
        return [self._found.get() for _ in range(self._found.qsize())]

    def next_ended(self, timeout_s: float | None = None) -> tuple[Key, Ending] | None:
        """Wait until a try has ended; None where none did for so long."""
        try:
            key, ending = self._ended.get(timeout=timeout_s)
        except queue.Empty:
            return None
        del self._running[key]
        self._live.discard(key)
        return key, ending

    def _wait(self, key: Key, worker: WorkerProcess) -> None:
        ending = run_order(worker, self._stall_s, lambda words: self._found.put((key, words)))
        self._ended.put((key, ending))


def default_workers() -> int:
    """A worker for each core: a mission's decoding and detecting overlap on little more than one."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
