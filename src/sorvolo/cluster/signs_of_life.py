"""Signs of life of Ray's workers, as files on the disk that the machines share: one that hangs writes none.

Ray itself notices workers and machines that are gone, and waits without end for a worker that stands still.
"""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sorvolo.errors import StoreError
from sorvolo.store.atomic import atomic_write_bytes

_SIGNS = 6  # in the time after which a worker counts as hanging; by choice


@contextmanager
def shown_alive(path: Path, node: str, stall_s: float) -> Iterator[None]:
    """Write the machine, this process and a count that grows into the file at `path`, until leaving."""
    is_over = threading.Event()

    def show() -> None:
        count = 0
        while True:
            with suppress(
                OSError, StoreError
            ):  # of a batch that has ended, or of a disk that is away for a moment
                atomic_write_bytes(path, f"{node} {os.getpid()} {count}".encode(), durable=False)
            count += 1
            if is_over.wait(stall_s / _SIGNS):
                return

    showing = threading.Thread(target=show, daemon=True, name="signs of life")
    showing.start()
    try:
        yield
    finally:
        is_over.set()
        showing.join()


class SignOfLife:
    """What the batch sees of one such file. `look` changes it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._seen, self._since_s = "", time.monotonic()

    def look(self) -> tuple[str, int, float] | None:
        """The machine, the process, and how long nothing has changed there, s; None where the try has not begun."""
        with suppress(FileNotFoundError):
            seen = self.path.read_text()
            if seen != self._seen:
                self._seen, self._since_s = seen, time.monotonic()
            node, pid, _ = seen.split()
            return node, int(pid), time.monotonic() - self._since_s
        return None
