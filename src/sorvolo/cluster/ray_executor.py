"""Flights of a batch on a Ray cluster whose machines share a disk.

Ray places tasks and notices machines that die. The batch itself counts tries and keeps results: Ray's own retries are
off.
"""

import importlib.util
import os
import secrets
import shutil
import socket
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import sorvolo
from sorvolo.capture.live.addresses import is_live_address
from sorvolo.cluster.cost import Cost
from sorvolo.cluster.orders import Ending, Order, Outcome
from sorvolo.cluster.process import WorkerProcess, run_order
from sorvolo.cluster.ray_cluster import (
    SCHEME,
    WAITS,
    check_machines,
    connect,
    demand_head,
    first_line,
    kill_process,
    started_cluster,
    unshared,
    working_machines,
)
from sorvolo.cluster.signs_of_life import SignOfLife, shown_alive
from sorvolo.cluster.table import LOCK
from sorvolo.errors import InputError, SettingsError, StoreError
from sorvolo.missions.flight.memory import MemorySettings
from sorvolo.store.atomic import TEMPORARY_PREFIX

T = TypeVar("T")
Key = tuple[str, str]


@contextmanager
def ray_executor(
    name: str,
    workers: int | None,
    stall_s: float,
    root: Path,
) -> "Iterator[RayExecutor]":
    """The executor on the cluster at `ray://HOST:PORT`, or for "ray" on this machine's, which is started if need be.

    At most `workers` flights at once (None: as many as the cluster's cores hold). Leaving ends what runs. Raises
    SettingsError where Ray is not installed, no cluster of this version answers, or the token is wrong, and StoreError
    where a machine of the cluster does not share `root`.
    """
    if importlib.util.find_spec("ray") is None or importlib.util.find_spec("grpc") is None:
        raise SettingsError(
            f"--executor {name} needs Ray; install it: pip install 'sorvolo[fleet]'"
        )
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would report to its makers
    os.environ.setdefault(
        "RAY_ENABLE_AUTO_CONNECT", "0"
    )  # what asks a cluster that is gone would start another one
    os.environ.setdefault("RAY_CLIENT_MAX_CONNECTION_TIMEOUT_S", "5")  # thrice: it listens
    if name == "ray" and not started_cluster():
        os.environ.setdefault(
            "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0"
        )  # its own listens on loopback alone
    connect(name, workers)
    import ray

    try:
        check_machines(root)
        executor = RayExecutor(name, workers, stall_s, root)
        try:
            yield executor
        finally:
            executor.end()
    finally:
        ray.shutdown()


class RayExecutor:
    """Tries as tasks of the cluster that this process is connected to; see `ray_executor`."""

    def __init__(
        self,
        name: str,
        workers: int | None,
        stall_s: float,
        root: Path,
    ) -> None:
        import ray

        self._ray: Any = ray
        self._name, self._workers, self._stall_s, self._root = (
            name,
            workers,
            stall_s,
            str(root.resolve()),
        )
        self._running: dict[Key, Any] = {}
        self._begun = (
            root.resolve() / f"{TEMPORARY_PREFIX}{secrets.token_hex(6)}-begun"
        )  # on the shared disk
        self._begun.mkdir()
        self._signs: dict[Key, SignOfLife] = {}  # there: of Ray's workers
        self._hung: set[Key] = set()  # whose worker was killed because it hung
        self._actors: dict[Key, Any] = {}  # of those that are live
        self._asked_found: dict[Key, Any] = {}  # answers of theirs that are on their way
        self._taken: dict[Key, int] = {}  # how much of what they found was taken
        self._last_found: list[tuple[Key, str]] = []  # by those that have ended since `take_found`
        self._is_gone = False
        # through ray:// the head's own client server is asked, and raises what `_cluster` knows
        self._head = "" if name.startswith(SCHEME) else str(ray.get_runtime_context().gcs_address)

    @property
    def running(self) -> Mapping[Key, object]:
        """What runs, by key."""
        return self._running

    @property
    def cache_mb(self) -> float:
        """Memory that a try may take for what it could also read again: of the smallest machine, a core's share."""
        shares = [each["memory"] / each["CPU"] for each in self._asked(self._machines)]
        memory = MemorySettings()
        return max(memory.least_mb, memory.share * min(shares) / 1e6)

    def has_room(self, cost: Cost) -> bool:
        """Whether another try may start."""
        if self._workers is not None and len(self._running) >= self._workers:
            return False
        machines = self._asked(self._machines)
        slots = sum(
            int(each["CPU"] / min(cost.cpus, each["CPU"]) + 1e-6) for each in machines
        )  # 1.0 // 0.2 is 4
        return len(self._running) < slots

    def start(self, key: Key, order: Order, cost: Cost) -> None:
        """Begin a try, on a machine with so many cores and so much memory; no more than the largest one has."""
        self._asked(lambda: self._submit(key, order, cost))

    def finish(self, key: Key) -> None:
        """End a live flight, and have its map or watch finished."""
        self._asked(lambda: self._actors[key].finish.remote())

    def take_found(self) -> Sequence[tuple[Key, str]]:
        """What live watches found since this was last asked, in words."""
        last, self._last_found = self._last_found, []
        return [*last, *(self._asked(self._taken_found) if self._actors else ())]

    def next_ended(self, timeout_s: float | None = None) -> tuple[Key, Ending] | None:
        """Wait until a try has ended; None where none did for so long. Raises SettingsError if the cluster is gone."""
        ended: list[Any] = []
        with self._cluster():
            while not ended:
                wait_s = timeout_s or WAITS.ending_s
                demand_head(self._head)
                ended, _ = self._ray.wait(
                    list(self._running.values()), num_returns=1, timeout=wait_s
                )
                if not ended and (lost := self._asked(self._lost)) is not None:
                    self._forget(lost, [])
                    return lost, Ending(Outcome.CRASHED, "its machine does not answer any more")
                if not ended and timeout_s is not None:
                    return None
            key = next(each for each, task in self._running.items() if task == ended[0])
        ending, found = self._asked(lambda: self._ending(ended[0]))
        if key in self._hung and ending.outcome is Outcome.CRASHED:
            ending = replace(
                ending, words=f"Ray's worker hung for {self._stall_s:g} s and was killed"
            )
        self._forget(key, found)
        return key, ending

    def _forget(self, key: Key, found: list[str]) -> None:
        """What is kept of a try that has ended; `found` is all that its watch found."""
        del self._running[key]
        self._hung.discard(key)
        if (sign := self._signs.pop(key, None)) is not None:
            sign.path.unlink(missing_ok=True)
        if (actor := self._actors.pop(key, None)) is not None:
            self._asked_found.pop(key, None)
            self._last_found += [(key, words) for words in found[self._taken.pop(key) :]]
            self._ray.kill(actor)

    def end(self) -> None:
        """End what runs; a mapping goes on from its journal when it is asked for again.

        What a cluster ran that is gone ends with its machines' Ray, at the latest a minute after the head.
        """
        shutil.rmtree(self._begun, ignore_errors=True)
        if self._is_gone:
            return
        with suppress(Exception):  # of a cluster that is gone, nothing runs
            for actor in self._actors.values():
                self._ray.kill(actor)
            for key, task in self._running.items():
                if key not in self._actors:
                    self._ray.cancel(task, force=True)
            self._ray.wait(
                list(self._running.values()), num_returns=len(self._running), timeout=WAITS.cancel_s
            )

    def _submit(self, key: Key, order: Order, cost: Cost) -> None:
        machines = self._machines()
        most = max(each["memory"] for each in machines)
        asked = {
            "num_cpus": min(cost.cpus, max(each["CPU"] for each in machines)),
            "memory": int(min(cost.memory_mb * 1e6, most)),
            "scheduling_strategy": "SPREAD",
        }
        sign = self._begun / secrets.token_hex(6)
        self._signs[key] = SignOfLife(sign)
        given = (order, self._stall_s, self._root, sorvolo.__version__, str(sign))
        if is_live_address(order.source):
            actor = (
                self._ray.remote(_LiveTry)
                .options(max_concurrency=3, max_restarts=0, **asked)
                .remote()
            )
            self._actors[key], self._running[key], self._taken[key] = (
                actor,
                actor.run.remote(*given),
                0,
            )
            return
        name = f"sorvolo {Path(order.source).name}"
        self._running[key] = (
            self._ray.remote(_try).options(max_retries=0, name=name, **asked).remote(*given)
        )

    def _lost(self) -> Key | None:
        """A try on a machine that Ray counts as dead; workers that hang are killed, and then noticed by Ray.

        Ray ends it by itself only when the connection to it breaks: where a cable was cut, not for minutes.
        """
        there = {each["NodeID"] for each in working_machines(self._ray)}
        for key, sign in self._signs.items():
            if (look := sign.look()) is None:  # it has not begun
                continue
            node, pid, silent_s = look
            if node not in there:
                return key
            if silent_s > self._stall_s and key not in self._hung:
                self._hung.add(key)
                kill_process(self._ray, node, pid)
        return None

    def _taken_found(self) -> list[tuple[Key, str]]:
        found: list[tuple[Key, str]] = []
        for key, actor in self._actors.items():
            if key not in self._asked_found:
                self._asked_found[key] = actor.found_after.remote(self._taken[key])
            task = self._asked_found[key]
            if self._ray.wait([task], timeout=0)[0]:
                del self._asked_found[key]
                with suppress(self._ray.exceptions.RayActorError):  # its end is another's to state
                    words = self._ray.get(task)
                    self._taken[key] += len(words)
                    found += [(key, each) for each in words]
        return found

    def _ending(self, task: Any) -> tuple[Ending, list[str]]:
        """How a try ended, and all that its watch found; of one whose machine died, nothing."""
        try:
            ending, found = self._ray.get(task)
        except (StoreError, InputError) as error:  # what every flight would meet on that machine
            raise getattr(error, "cause", error) from None  # Ray's own holds a whole traceback
        except (
            self._ray.exceptions.RayTaskError
        ) as error:  # raised by the task itself, before or after its process
            cause = f"{type(error.cause).__name__}: {first_line(error.cause)}"
            return Ending(Outcome.CRASHED, f"its task could not be run ({cause})"), []
        except self._ray.exceptions.RayError as error:
            words = str(error).strip().split("\n")[0]
            lost = f"its machine or Ray's worker was lost ({type(error).__name__}): {words}"
            return Ending(Outcome.CRASHED, lost), []
        assert isinstance(ending, Ending)
        return ending, found

    def _machines(self) -> list[dict[str, float]]:
        """What the machines have that are there; those without cores run nothing."""
        found = [each["Resources"] for each in working_machines(self._ray)]
        machines = [{"CPU": each["CPU"], "memory": each.get("memory", 0.0)} for each in found]
        if not machines:
            raise ConnectionError("no machine with a core is left")
        return machines

    def _asked(self, call: Callable[[], T]) -> T:
        """What the cluster answers to a call, which is given up where the head dies meanwhile: see `demand_head`."""
        answer: Future[T] = Future()

        def ask() -> None:
            try:
                answer.set_result(call())
            except BaseException as error:  # whoever waits is to have it
                answer.set_exception(error)

        with self._cluster():
            threading.Thread(target=ask, daemon=True, name="ray").start()
            while True:
                try:
                    return answer.result(timeout=WAITS.ending_s)
                except TimeoutError:
                    if answer.done():
                        raise
                    demand_head(self._head)

    @contextmanager
    def _cluster(self) -> Iterator[None]:
        """Turn what Ray raises of a cluster that is gone into an error that states what to do."""
        import grpc

        errors = self._ray.exceptions
        try:
            demand_head(self._head)
            yield
        except (ConnectionError, grpc.RpcError, errors.RaySystemError, errors.RpcError) as error:
            self._is_gone = True
            raise SettingsError(
                f"--executor {self._name}: the cluster is gone ({first_line(error)}); when it is back, the same "
                "command goes on"
            ) from error


class _LiveTry:
    """On a machine of the cluster: a try at a live flight, which `finish` ends. Ray calls its methods in threads."""

    def __init__(self) -> None:
        self._worker: WorkerProcess | None = None
        self._found: list[str] = []  # grows only

    def run(
        self,
        order: Order,
        stall_s: float,
        root: str,
        version: str,
        sign: str,
    ) -> tuple[Ending, list[str]]:
        """The try in a process of its own, which ends with this one: how it ended, and all that its watch found."""
        import ray

        _demand_fit(root, version)
        with shown_alive(Path(sign), ray.get_runtime_context().get_node_id(), stall_s):
            self._worker = WorkerProcess(order)
            return run_order(self._worker, stall_s, self._found.append), self._found

    def found_after(self, taken: int) -> list[str]:
        """What its watch found after the first so many. An answer that gets lost loses nothing: ask again."""
        return self._found[taken:]

    def finish(self) -> None:
        """Have the flight end."""
        if self._worker is not None:
            self._worker.finish()


def _try(
    order: Order, stall_s: float, root: str, version: str, sign: str
) -> tuple[Ending, list[str]]:
    """On a machine of the cluster: a try in a process of its own, which ends with Ray's worker, as of `_LiveTry`.

    The file `sign` then shows that the worker lives.
    """
    import ray

    _demand_fit(root, version)
    if not Path(order.source).exists():
        host = socket.gethostname()
        raise StoreError(
            f"the machine {host} does not have {order.source}; flights need the same path on all machines"
        )
    with shown_alive(Path(sign), ray.get_runtime_context().get_node_id(), stall_s):
        return run_order(WorkerProcess(order), stall_s), []


def _demand_fit(root: str, version: str) -> None:
    """Raise SettingsError or StoreError on a machine that joined later and cannot take part."""
    host = socket.gethostname()
    if sorvolo.__version__ != version:
        raise InputError(
            f"the machine {host} has Sorvolo {sorvolo.__version__}, the batch {version}; install the same one"
        )
    if not (Path(root) / LOCK).exists():
        raise StoreError(unshared(host, root))
