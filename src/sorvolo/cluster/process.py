"""A worker's process, watched from outside: what it answers, when it stands still, and what it took."""

import os
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from sorvolo.child_process import python_command
from sorvolo.cluster.orders import FINISH, WORKER, Ending, Order, Outcome, ScoutOrder, answer_of

_LOOK_EVERY_S = 1.0  # at what a worker uses; by choice
_LIVELY = 0.01  # seconds of processor time a second, below which a process does nothing
_LOG_TAIL_BYTES = 4000  # some forty lines, enough for an error's trace
_MB = 1024.0  # kilobytes, as ru_maxrss counts on Linux
_MB_BYTES = 1024.0**2  # bytes, as it counts on macOS


class WorkerProcess:
    """One process that does one order. `answers` gives what it sends; `end` waits for it.

    `held` are descriptors that it keeps open until it ends, such as the batch's lock. It is no member of the batch's
    terminal, so that Ctrl-C does not reach it, and ends when this object's process does.
    """

    def __init__(self, order: Order | ScoutOrder, held: Sequence[int] = ()) -> None:
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 (until `end`)
        self._started_s = time.monotonic()
        self._process = subprocess.Popen(
            python_command(WORKER),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            start_new_session=True,
            pass_fds=tuple(held),
        )
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(order.line())
            self._process.stdin.flush()
        except BrokenPipeError:  # it is gone already; `end` states how
            pass
        self._stalled_s = 0.0

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._process.pid

    @property
    def seconds(self) -> float:
        """How long ago it was started."""
        return time.monotonic() - self._started_s

    def kill(self) -> None:
        """End it at once; a mapping goes on from its journal when it is asked for again."""
        self._process.kill()

    def finish(self) -> None:
        """Have it end a live flight and finish its map."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(FINISH)
            self._process.stdin.flush()
        except (BrokenPipeError, ValueError):  # it has ended
            pass

    def answers(self, stall_s: float) -> Iterator[tuple[str, dict[str, Any]]]:
        """Its answers until it ends. A process that neither answers nor computes for `stall_s` is killed.

        Where the system does not state a process's own time (there is no /proc), none is taken to stand still.
        """
        assert self._process.stdout is not None
        pipe, rest = self._process.stdout.fileno(), b""
        life = _Life(self._process.pid, stall_s)
        with selectors.DefaultSelector() as waiting:
            waiting.register(pipe, selectors.EVENT_READ)
            while True:
                if waiting.select(min(_LOOK_EVERY_S, stall_s / 4)):
                    data = os.read(pipe, 65_536)
                    if not data:
                        return
                    life.show()
                    *lines, rest = (rest + data).split(b"\n")
                    yield from filter(None, map(answer_of, lines))
                elif life.is_over():
                    self._stalled_s = stall_s
                    self.kill()

    def end(self, last: tuple[str, dict[str, Any]] | None) -> Ending:
        """How the order ended, by the worker's `last` answer; waits for the process."""
        assert self._process.stdin is not None and self._process.stdout is not None
        _, status, usage = os.wait4(self._process.pid, 0)
        code = os.waitstatus_to_exitcode(status)
        self._process.returncode = code
        self._process.stdin.close()
        self._process.stdout.close()
        with self._log:
            ending = self._ending(last, code)
        return ending.with_effort(
            round(self.seconds, 3),
            round(usage.ru_utime + usage.ru_stime, 3),
            round(usage.ru_maxrss / (_MB_BYTES if sys.platform == "darwin" else _MB), 1),
            socket.gethostname(),
        )

    def _ending(self, last: tuple[str, dict[str, Any]] | None, code: int) -> Ending:
        if last is not None and last[0] == "ended":
            answer = last[1]
            return Ending(
                Outcome(answer["outcome"]), str(answer["words"]), str(answer.get("flight", ""))
            )
        if self._stalled_s:
            words = f"its process hung for {self._stalled_s:.0f} s and was killed"
        elif code == -signal.SIGKILL:
            words = "its process was killed, perhaps because memory ran out"
        elif code < 0:
            words = f"its process ended by signal {-code} ({signal.Signals(-code).name})"
        else:
            words = f"its process exited with code {code} and no answer"
        tail = self._tail()
        return Ending(Outcome.CRASHED, f"{words}: {tail}" if tail else words)

    def _tail(self) -> str:
        """The last line that it printed."""
        size = self._log.seek(0, os.SEEK_END)
        self._log.seek(max(0, size - _LOG_TAIL_BYTES))
        lines = self._log.read().decode("utf-8", "replace").split("\n")
        return next((each.strip()[:300] for each in reversed(lines) if each.strip()), "")


class _Life:
    """Whether a process does anything: it answered within `stall_s`, or computed. `show` and `is_over` change it."""

    def __init__(self, pid: int, stall_s: float) -> None:
        self._pid, self._stall_s = pid, stall_s
        self._shown_s, self._cpu_s = time.monotonic(), 0.0

    def show(self) -> None:
        """It answered."""
        self._shown_s = time.monotonic()

    def is_over(self) -> bool:
        """Whether it stands still."""
        cpu_s = _cpu_seconds(self._pid)
        if cpu_s is None or cpu_s - self._cpu_s > _LIVELY * self._stall_s:
            self._shown_s, self._cpu_s = time.monotonic(), cpu_s or 0.0
        return time.monotonic() - self._shown_s > self._stall_s


def run_order(
    worker: WorkerProcess, stall_s: float, found: Callable[[str], None] = lambda _: None
) -> Ending:
    """Wait until a worker has done its order; `found` gets what a watch found, in words."""
    last = None
    for answer in worker.answers(stall_s):
        last = answer
        if answer[0] == "found":
            found(str(answer[1]["words"]))
    return worker.end(last)


def most_memory_mb(pid: int) -> float:
    """The most memory that a running process has had, MB; 0 where the system does not state it."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0.0
    fields = dict(line.partition(":")[::2] for line in status.splitlines())
    return int(fields.get("VmHWM", "0 kB").split()[0]) / 1000


def _cpu_seconds(pid: int) -> float | None:
    """Processor time that a process has used, s; None where the system does not state it."""
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            fields = file.read().rpartition(b")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return None
