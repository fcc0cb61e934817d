"""What runs a batch's missions, a process each: this machine, or the machines of a Ray cluster."""

import importlib.util
import json
import os
import queue
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

from sorvolo.build import build
from sorvolo.child_process import python_command
from sorvolo.errors import SettingsError, StoreError
from sorvolo.missions.worker import FINISHED, TO_CHECK, Order
from sorvolo.paths import Json, JsonView

LOCK = "batch.lock"
STALL_S = 300.0  # a process that neither writes nor computes for so long is killed
_LIVELY = 0.01  # seconds of processor time a second, below which a process does nothing
_REACH_S = 8.0  # for a connection to a cluster's head, which takes milliseconds


@dataclass(frozen=True)
class TryEnding:
    """How a mission's process ended, and what it took: `outcome` is "done", "doubtful", "failed" or "crashed"."""

    outcome: str
    words: str
    flight: str = ""
    seconds: float = 0.0
    cpu_s: float = 0.0
    peak_memory_mb: float = 0.0
    host: str = ""
    inspected: JsonView = field(default_factory=dict)


class Executor(Protocol):
    """Where missions run; `slots` is how many run at once."""

    slots: int

    def start(self, key: str, order: Order) -> None:
        """Start a mission."""

    def next_ended(self) -> tuple[str, TryEnding]:
        """Wait for a mission to end. Raises SorvoloError where the executor is gone."""


def run_order(
    order: Order,
    stall_s: float = STALL_S,
    lock: int | None = None,
    started: Callable[["subprocess.Popen[bytes]"], None] = lambda _: None,
) -> TryEnding:
    """Do an order in a process of its own, which keeps the descriptor `lock` open, and wait for its end."""
    began_s, last = time.monotonic(), Json()
    inspected: JsonView = {}
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            python_command("sorvolo.missions.worker"),
            bufsize=0,  # a process that died with its order unread leaves nothing to flush
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            start_new_session=True,  # Ctrl-C is for the batch alone
            pass_fds=() if lock is None else (lock,),
        )
        started(process)
        assert process.stdin is not None and process.stdout is not None
        with suppress(BrokenPipeError):  # it is gone already; its exit code states how
            process.stdin.write(order.line())
        why = ""
        for line in _lines(process, stall_s):
            if line is None:
                why = f"its process hung for {stall_s:.0f} s and was killed"
            elif line["type"] == "flight.inspected":
                inspected = line["data"]
            else:
                last = line
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        process.stdin.close()
        process.stdout.close()
        outcome, words = _outcome(last, process.returncode, why, log)
    kilobytes = usage.ru_maxrss / (1024.0 if sys.platform == "darwin" else 1.0)
    return TryEnding(
        outcome,
        words,
        str(last.get("data", {}).get("flight", "")),
        round(time.monotonic() - began_s, 3),
        round(usage.ru_utime + usage.ru_stime, 3),
        round(kilobytes / 1024.0, 1),
        socket.gethostname(),
        inspected,
    )


def _lines(process: "subprocess.Popen[bytes]", stall_s: float) -> Iterator[Json | None]:
    """What a process writes until it ends; None once it has done nothing for `stall_s` and was killed."""
    assert process.stdout is not None
    pipe, rest = process.stdout.fileno(), b""
    alive_s, used_s = time.monotonic(), 0.0
    while True:
        if select.select([pipe], [], [], min(1.0, stall_s / 4))[0]:
            if not (data := os.read(pipe, 65_536)):
                return
            alive_s = time.monotonic()
            *lines, rest = (rest + data).split(b"\n")
            yield from map(json.loads, lines)
            continue
        try:
            numbers = Path(f"/proc/{process.pid}/stat").read_bytes().rpartition(b")")[2].split()
            cpu_s = (int(numbers[11]) + int(numbers[12])) / os.sysconf("SC_CLK_TCK")
        except OSError:  # no /proc: nothing counts as hanging
            continue
        if cpu_s - used_s > _LIVELY * stall_s:
            alive_s, used_s = time.monotonic(), cpu_s
        if time.monotonic() - alive_s > stall_s:
            # `process.kill()` may reap it, and `run_order` does
            os.kill(process.pid, signal.SIGKILL)
            yield None
            return


def _outcome(last: JsonView, code: int, why: str, log: Any) -> tuple[str, str]:
    """How a mission ended, by its last line and its process's exit code, and the words for it."""
    data = last.get("data", {})
    if not why and last.get("type") == FINISHED:
        return "doubtful" if data["exit_code"] == TO_CHECK else "done", str(data["headline"])
    if not why and data.get("error"):
        return "crashed" if data["may_pass"] else "failed", str(data["error"])
    if not why:
        why = f"its process ended by signal {-code}" if code < 0 else f"it exited with code {code}"
        why += ", perhaps because memory ran out" if code == -9 else ""
    log.seek(max(0, log.seek(0, os.SEEK_END) - 4000))
    printed = log.read().decode("utf-8", "replace").strip().split("\n")
    return "crashed", f"{why}: {printed[-1][:300]}" if printed[-1] else why


class LocalExecutor:
    """Processes of this machine, `slots` at once. A context manager: leaving ends them."""

    def __init__(self, slots: int, lock: int, stall_s: float = STALL_S) -> None:
        self.slots, self._lock, self._stall_s = slots, lock, stall_s
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._threads: dict[str, threading.Thread] = {}
        self._ended: queue.SimpleQueue[tuple[str, TryEnding]] = queue.SimpleQueue()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for key, thread in self._threads.items():
            if key in self.processes:
                self.processes[key].kill()
            thread.join()

    def start(self, key: str, order: Order) -> None:
        """Start a mission."""
        has_begun = threading.Event()

        def begun(process: "subprocess.Popen[bytes]") -> None:
            self.processes[key] = process
            has_begun.set()

        def run() -> None:
            try:
                ending = run_order(order, self._stall_s, self._lock, begun)
            except Exception as error:  # else the batch would wait for it without end
                ending = TryEnding("crashed", f"{type(error).__name__}: {error}")
            has_begun.set()
            self._ended.put((key, ending))

        # the process ends with this thread, its parent
        self._threads[key] = threading.Thread(target=run, daemon=True)
        self._threads[key].start()
        has_begun.wait()

    def next_ended(self) -> tuple[str, TryEnding]:
        """Wait for a mission to end."""
        key, ending = self._ended.get()
        del self._threads[key]
        self.processes.pop(key, None)
        return key, ending


class RayExecutor:
    """Tasks of a Ray cluster whose machines share the disk of the batch; made by `ray_executor`."""

    def __init__(self, name: str, slots: int | None, root: Path) -> None:
        import ray

        self._ray: Any = ray
        self._name, self._root = name, str(root.resolve())
        self.slots = slots or max(1, int(ray.cluster_resources().get("CPU", 1)))
        self._running: Json = {}

    def start(self, key: str, order: Order) -> None:
        """Start a mission on a machine with a free core."""
        with self._cluster():
            task = self._ray.remote(_run_there).options(
                num_cpus=1, max_retries=0, scheduling_strategy="SPREAD"
            )
            self._running[key] = task.remote(order, self._root, build())

    def next_ended(self) -> tuple[str, TryEnding]:
        """Wait for a mission to end. Raises SettingsError where the cluster is gone."""
        with self._cluster():
            ended, _ = self._ray.wait(list(self._running.values()), num_returns=1)
            key = next(key for key, task in self._running.items() if task == ended[0])
            del self._running[key]
            try:
                return key, self._ray.get(ended[0])
            except self._ray.exceptions.RayTaskError as error:
                if isinstance(error.cause, StoreError):  # what every flight would meet there
                    raise error.cause from None
                words = f"{type(error.cause).__name__}: {error.cause}"
                return key, TryEnding("crashed", f"its task failed ({words[:300]})")
            except (
                self._ray.exceptions.WorkerCrashedError,
                self._ray.exceptions.NodeDiedError,
            ) as error:
                return key, TryEnding("crashed", f"its machine was lost ({type(error).__name__})")

    def end(self) -> None:
        """End what runs; a mission continues from its journal when it is asked for again."""
        with suppress(Exception):  # of a cluster that is gone, nothing runs
            for task in self._running.values():
                self._ray.cancel(task, force=True)
            self._ray.wait(list(self._running.values()), num_returns=len(self._running), timeout=10)

    @contextmanager
    def _cluster(self) -> Iterator[None]:
        import grpc

        errors = self._ray.exceptions
        try:
            yield
        except (ConnectionError, grpc.RpcError, errors.RaySystemError, errors.RpcError) as error:
            raise SettingsError(
                f"--executor {self._name}: the cluster is gone ({str(error).strip()[:200]}); "
                "when it is back, the same command goes on"
            ) from error


@contextmanager
def ray_executor(name: str, slots: int | None, root: Path) -> Iterator[RayExecutor]:
    """The executor on the cluster at ray://HOST:PORT, or for "ray" on this machine's, started if need be.

    Leaving ends what runs. Raises SettingsError where Ray is not installed or no cluster of this version answers.
    """
    if importlib.util.find_spec("ray") is None or importlib.util.find_spec("grpc") is None:
        raise SettingsError(
            f"--executor {name} needs Ray; install it: pip install 'sorvolo[fleet]'"
        )
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would report to its makers
    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")  # else not on loopback alone
    import ray

    address = name
    if name == "ray":
        # Whether `ray start` noted a cluster that this machine is part of
        address = os.environ.get(
            "RAY_ADDRESS",
            "auto"
            if (Path(os.environ.get("RAY_TMPDIR", "/tmp"), "ray", "ray_current_cluster").is_file())
            else "local",
        )
    if ":" in address:  # Ray waits for minutes where nothing listens
        host, _, port = address.removeprefix("ray://").rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), _REACH_S).close()
        except (OSError, OverflowError, ValueError) as error:
            raise SettingsError(
                f"--executor {name}: no Ray cluster answers at {address} ({error}); start one there: "
                "ray start --head, and give ray://HOST:10001 (docs/batch.md)"
            ) from None
    options: Json = {"logging_level": "ERROR", "log_to_driver": False}
    if address == "local":
        options |= {"num_cpus": slots, "include_dashboard": False}
    try:
        ray.init(address=address, **options)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise SettingsError(
            f"--executor {name}: {str(error).strip()[:300]}; all machines need the same versions of "
            "Ray and Python, and the cluster's token (RAY_AUTH_MODE=token, RAY_AUTH_TOKEN_PATH)"
        ) from error
    executor = RayExecutor(name, slots, root)
    try:
        yield executor
    finally:
        executor.end()
        ray.shutdown()


def _run_there(order: Order, root: str, version: str) -> TryEnding:
    """On a machine of the cluster: the mission in a process of its own, which ends with Ray's worker.

    Raises StoreError on a machine with another Sorvolo, or without the batch's disk.
    """
    host = socket.gethostname()
    if build() != version:
        raise StoreError(
            f"the machine {host} has Sorvolo {build()}, the batch {version}; install "
            "the same one on all machines"
        )
    if not (Path(root) / LOCK).exists() or not Path(order.source).exists():
        raise StoreError(
            f"the machine {host} does not see {root} or {order.source}; flights and ROOT need a disk "
            "that all machines have under the same path (NFS, for example)"
        )
    return run_order(order)


def default_slots() -> int:
    """A mission for each core, and for each GB of four fifths of the memory: most flights take less."""
    from sorvolo.missions.flight.settings import available_bytes

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, min(cores or 1, int(0.8e-9 * available_bytes())))
