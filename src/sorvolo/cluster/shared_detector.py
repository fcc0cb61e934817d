"""The process that holds the detector of a machine's flights, as the batch sees it: started when needed, and again."""

import subprocess
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from sorvolo.child_process import python_command
from sorvolo.cluster.orders import Order
from sorvolo.cluster.process import most_memory_mb
from sorvolo.detection.sharing import READY, answers
from sorvolo.errors import SettingsError, StoreError


@dataclass(frozen=True)
class SharingSettings:
    """Whether the flights of a machine share one detector, and the share of a graphics card that it asks for."""

    is_shared: bool = False
    gpus: float = 0.0
    silent_s: float = (
        60.0  # without an answer of its process, which takes milliseconds: it hangs. By choice
    )

    def __post_init__(self) -> None:
        if not 0 <= self.gpus <= 1:
            raise SettingsError(f"--gpus {self.gpus:g}: give a share of one graphics card, 0 to 1")
        if self.gpus and not self.is_shared:
            raise SettingsError(
                "--gpus is for the detector that flights share: give --share-detector as well"
            )


def searches(order: Order) -> bool:
    """Whether a try shows pictures to a detector. Parts of a flight have their own: they are on any machine."""
    return order.part is None and order.wish.model != "none"


class SharedDetector:
    """One such process. `address` starts it; a context manager: leaving ends it.

    One that hangs is killed after `silent_s`, so that those who wait for it learn that it is gone.
    """

    def __init__(self, silent_s: float = SharingSettings.silent_s) -> None:
        self._silent_s = silent_s
        self._folder = tempfile.TemporaryDirectory(prefix="sorvolo-")  # readable by this user alone
        self._process: subprocess.Popen[bytes] | None = None
        self._starts = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def address(self) -> str:
        """Its socket. Raises StoreError where it cannot listen."""
        if self._process is None or self._process.poll() is not None:
            self._stop()
            self._start()
        return self._socket()

    @property
    def pid(self) -> int:
        """The process's number; 0 before it is asked for."""
        return 0 if self._process is None else self._process.pid

    @property
    def memory_mb(self) -> float:
        """The most memory that it has had, MB; 0 before it is asked for, and where the system does not state it."""
        return most_memory_mb(self.pid)

    def end(self) -> None:
        """End it, and whoever still asks it."""
        self._stop()
        self._folder.cleanup()

    def _socket(self) -> str:
        return str(Path(self._folder.name, str(self._starts)))

    def _start(self) -> None:
        self._starts += 1
        self._process = subprocess.Popen(
            python_command("sorvolo.detection.shared_process", self._socket()),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        assert self._process.stdout is not None
        if self._process.stdout.readline() != READY:
            self._stop()
            raise StoreError(
                f"the detector that flights share could not be started (its socket: {self._socket()}); set TMPDIR to a "
                "folder of this machine with a short path, or give --own-detectors"
            )
        threading.Thread(
            target=_end_where_it_hangs,
            args=(self._process, self._socket(), self._silent_s),
            daemon=True,
        ).start()

    def _stop(self) -> None:
        if (process := self._process) is None:
            return
        process.kill()
        process.communicate()
        self._process = None


def _end_where_it_hangs(process: "subprocess.Popen[bytes]", address: str, silent_s: float) -> None:
    """Kill the process where it gives no answer at its socket for so long; ends with it."""
    heard_s, look_s = time.monotonic(), silent_s / 6
    while process.poll() is None:
        if answers(address, look_s):
            heard_s = time.monotonic()
        elif time.monotonic() - heard_s > silent_s:
            process.kill()
        time.sleep(look_s)
