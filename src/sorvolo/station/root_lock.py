"""One station for a root: the lock that it holds while it runs; the system lets go of it however the station ends."""

import os
from pathlib import Path

from sorvolo.errors import StoreError
from sorvolo.store.atomic import writing
from sorvolo.store.locks import take_lock

_FILE = "station.lock"


class RootLock:
    """The lock of a station's folder, held until `close`. A file that a killed station left locks nobody out."""

    def __init__(self, folder: Path) -> None:
        """Raises StoreError where another station holds it, or it cannot be written."""
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._file = os.open(folder / _FILE, os.O_RDWR | os.O_CREAT, 0o600)
        if not take_lock(self._file):
            holder = os.pread(self._file, 20, 0).decode("ascii", "replace").strip()
            self.close()
            raise StoreError(
                f"{folder.parent}: another station serves this folder already (process {holder or 'unknown'}); end "
                "that one first, or serve another folder"
            )
        with writing(folder):
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, f"{os.getpid()}\n".encode(), 0)

    def close(self) -> None:
        """Let another station in; again: nothing."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
