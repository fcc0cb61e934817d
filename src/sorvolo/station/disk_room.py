"""Whether the disk has room above the station's floor of free space, and a little of it held back for a full disk."""

import os
import shutil
from contextlib import suppress
from pathlib import Path

_RESERVE_BYTES = 8_000_000  # some hundred runs' last states, with SQLite's journal


def shortage(folder: Path, floor_gb: float) -> str:
    """How little of the folder's disk is free where that is less than the floor; "" where there is room."""
    free_gb = shutil.disk_usage(folder).free / 1e9
    return (
        ""
        if free_gb >= floor_gb
        else f"{free_gb:.2f} GB are free, and {floor_gb:.2f} GB must stay so"
    )


class Reserve:
    """A file that holds some room on the disk, so that what a full disk did can still be written down."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def hold(self) -> None:
        """Take the room, where it is not held and the disk has it."""
        if self._path.exists() or shutil.disk_usage(self._path.parent).free < 2 * _RESERVE_BYTES:
            return
        with suppress(OSError), self._path.open("wb") as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, _RESERVE_BYTES)
            else:
                file.write(bytes(_RESERVE_BYTES))

    def give(self) -> bool:
        """Give the room back to the disk; whether there was any."""
        was_held = self._path.exists()
        self._path.unlink(missing_ok=True)
        return was_held
