"""Flights of a batch in processes of this machine."""

import os
import queue
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Self

from sorvolo.cluster.cost import Cost, CostSettings
from sorvolo.cluster.orders import Ending, Order
from sorvolo.cluster.process import WorkerProcess, run_order
from sorvolo.cluster.shared_detector import SharedDetector, searches
from sorvolo.missions.flight.memory import MemorySettings, available_bytes, memory_budget_bytes

Key = tuple[str, str]


class LocalExecutor:
    """At most `workers` processes at once, and no more than the memory holds. A context manager: leaving ends them.

    `lock` is the batch's, which the processes keep until they are gone. With `shares_detector` one process holds the
    detector for all of them.
    """

    def __init__(
        self, workers: int, stall_s: float, lock: int, costs: CostSettings = CostSettings(), *,  # noqa: B008
        shares_detector: bool = False,
    ) -> None:
        self.workers, self._share = workers, costs.machine_share
        self._detector = SharedDetector() if shares_detector else None
        self._stall_s, self._lock = stall_s, lock
        self._running: dict[Key, tuple[WorkerProcess, Cost]] = {}
        self._ended: queue.SimpleQueue[tuple[Key, Ending]] = queue.SimpleQueue()
        self._found: queue.SimpleQueue[tuple[Key, str]] = queue.SimpleQueue()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for worker, _cost in self._running.values():
            worker.kill()
        while self._running:  # each is waited for by its thread
            self.next_ended()
        if self._detector is not None:
            self._detector.end()

    @property
    def running(self) -> Mapping[Key, object]:
        """What runs, by key."""
        return self._running

    def has_room(self, cost: Cost) -> bool:
        """Whether another try may start."""
        if not self._running:
            return True
        taken_mb = sum(each.memory_mb for _, each in self._running.values())
        most_mb = self._share * available_bytes() / 1e6
        return len(self._running) < self.workers and taken_mb + cost.memory_mb <= most_mb

    @property
    def cache_mb(self) -> float:
        """Memory for what a worker could also read again: the machine's share of it, divided among the workers."""
        return max(MemorySettings().least_mb, memory_budget_bytes(None) / 1e6 / self.workers)

    def start(self, key: Key, order: Order, cost: Cost) -> None:
        """Start a try."""
        if self._detector is not None and searches(order):
            order = replace(order, detector=self._detector.address)
        worker = WorkerProcess(order, [self._lock])
        self._running[key] = (worker, cost)
        threading.Thread(target=self._wait, args=(key, worker), daemon=True, name=f"flight {key[1][:8]}").start()

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
        return key, ending

    def _wait(self, key: Key, worker: WorkerProcess) -> None:
        ending = run_order(worker, self._stall_s, lambda words: self._found.put((key, words)))
        self._ended.put((key, ending))


def default_workers() -> int:
    """A worker for each core: a mission's decoding and detecting overlap on little more than one."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
