"""A Ray cluster on this machine for a benchmark whose machines, actors and processes are struck at random.

The head has no core; each of two machines has one. Struck are, in random order, each kind once before the first comes
again: a machine (killed, another takes its place), Ray's own worker process (killed), the process of a mission (killed,
crashed or stopped), the actor of a machine's detector and the detector's process (killed). Flights that crashed twice
are spared: a third time would set them aside. The missions of flights named poisoned-* are killed every time.
"""

import json
import os
import random
import signal
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest import mock

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "cluster"))

from batch_flights import descendants, written_sites

from sorvolo.cluster.table import TABLE

MISSION, DETECTOR = b"sorvolo.cluster.worker", b"sorvolo.detection.shared_process"
RAYS_WORKER, ACTOR = b"ray::sorvolo", b"ray::_Detector"  # as Ray names its processes
KINDS = {
    "machine killed": (b"", signal.SIGKILL),
    "Ray's worker killed": (RAYS_WORKER, signal.SIGKILL),
    "mission killed": (MISSION, signal.SIGKILL),
    "mission crashed": (MISSION, signal.SIGSEGV),
    "mission stopped": (MISSION, signal.SIGSTOP),
    "detector's actor killed": (ACTOR, signal.SIGKILL),
    "detector killed": (DETECTOR, signal.SIGKILL),
}
POISON_EVERY_S = 0.25
MOST_STARTS = 5  # of one machine
PATIENCE_MS = (
    60_000  # before Ray counts a machine as dead that does not answer: it may only be busy
)


class NodeFaults:
    """Strikes from threads of its own until `end`; a batch works in `root` meanwhile."""

    def __init__(self, cluster: Any, root: Path, seed: int) -> None:
        self.counts: Counter[str] = Counter()
        self._cluster, self._root = cluster, root
        self._draw, self._is_over = random.Random(seed), threading.Event()
        self._threads = [
            threading.Thread(target=each, daemon=True) for each in (self._strike_all, self._poison)
        ]
        for each in self._threads:
            each.start()

    def end(self) -> None:
        """Strike no more."""
        self._is_over.set()
        for each in self._threads:
            each.join()

    def _strike_all(self) -> None:
        waiting: list[str] = []
        while not self._is_over.wait(self._draw.uniform(2.0, 8.0)):
            waiting = waiting or self._draw.sample(list(KINDS), len(KINDS))
            if self._may_strike() and self._strike(waiting[-1]):
                self.counts[waiting[-1]] += 1
                print(waiting.pop(), flush=True)

    def _may_strike(self) -> bool:
        """Whether something runs, and nothing that has crashed twice."""
        table = self._root / TABLE
        lines = table.read_text().splitlines()[1:] if table.exists() else []
        rows = {}
        for line in lines:
            with suppress(ValueError):  # it is just being written
                row = json.loads(line)
                rows[row["source"]] = row
        running = [each for each in rows.values() if each["state"] == "running"]
        ours = [each for each in running if not Path(each["source"]).name.startswith("poisoned")]
        return bool(ours) and all(each["crashes"] < 2 for each in ours)

    def _strike(self, kind: str) -> bool:
        """Do it to one that there is; False where there is none."""
        name, fault = KINDS[kind]
        if not name:
            self._cluster.remove_node(
                self._draw.choice(sorted(self._cluster.worker_nodes, key=id)), False
            )
            self._add_machine()
            return True
        found = sorted(self._processes(name))
        if not found:
            return False
        with suppress(ProcessLookupError):
            os.kill(self._draw.choice(found), fault)
        return True

    def _add_machine(self) -> None:
        """One more machine. On a busy computer Ray may give one up that does not answer within 30 s."""
        with mock.patch.object(signal, "signal"):  # which Ray would set, and cannot from a thread
            for _ in range(MOST_STARTS):
                try:
                    self._cluster.add_node(num_cpus=1)
                    return
                except Exception as error:  # Ray raises no class of its own
                    print(f"a machine did not start: {error}", flush=True)
        raise RuntimeError("no machine starts here")

    def _poison(self) -> None:
        while not self._is_over.wait(POISON_EVERY_S):
            for pid in self._processes(MISSION):
                if any(site.name.startswith("poisoned") for site in written_sites(pid, self._root)):
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                    self.counts["poisoned mission killed"] += 1

    def _processes(self, name: bytes) -> set[int]:
        """The cluster's processes with this in their command lines."""
        nodes = [
            each.all_processes["raylet"][0].process.pid for each in list(self._cluster.worker_nodes)
        ]
        found = set()
        for pid in descendants(set(nodes)):
            with suppress(OSError):  # it has ended
                if name in Path(f"/proc/{pid}/cmdline").read_bytes():
                    found.add(pid)
        return found


@contextmanager
def node_faults(root: Path, seed: int) -> Iterator[NodeFaults]:
    """The cluster, which the environment names meanwhile, and what strikes it."""
    settings = {
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_AUTH_MODE": "disabled",
        "RAY_health_check_timeout_ms": str(PATIENCE_MS),
    }
    with mock.patch.dict(os.environ, settings):
        from ray.cluster_utils import Cluster

        cluster = Cluster(
            initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False}
        )
        os.environ["RAY_ADDRESS"] = cluster.address
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        made = NodeFaults(cluster, root, seed)
        try:
            yield made
        finally:
            made.end()
            cluster.shutdown()
