"""The sites of an object store, kept in step with it in a folder of working copies while they are served."""

import hashlib
import logging
import os
import re
import tempfile
import threading
from collections.abc import Generator
from pathlib import Path

from sorvolo.errors import SorvoloError
from sorvolo.missions.mission import Mission
from sorvolo.store.copies.bucket import OvertakenError, sites_at
from sorvolo.store.copies.object_store import open_objects
from sorvolo.store.copies.transfer import CopyUpdate
from sorvolo.store.copies.working import WorkingCopy
from sorvolo.store.site.catalogue_place import catalogue_file
from sorvolo.store.site.files import BusyError, cache_folder, is_plain_name

_LOG = logging.getLogger("sorvolo.station.store_root")
_EVERY_S = 20.0  # a store is asked for what is new; by choice: each question costs


class StoreRoot:
    """The sites at `s3://BUCKET/PREFIX`, or the one that lies there itself, in `folder`. One thread may use it.

    `step` brings both sides up to date: what other writers did comes, what was added here goes.
    """

    def __init__(self, address: str) -> None:
        """Raises SettingsError for an address that names no place."""
        self._objects = open_objects(address)
        store = f"{os.environ.get('AWS_ENDPOINT_URL', '')} {self._objects.name}"
        name = re.sub(r"[^A-Za-z0-9._-]", "-", self._objects.name.removeprefix("s3://"))
        self.folder = (
            cache_folder() / "roots" / f"{name}-{hashlib.sha256(store.encode()).hexdigest()[:12]}"
        )
        self.folder.mkdir(parents=True, exist_ok=True)
        self._sent: dict[
            str, tuple[int, int]
        ] = {}  # by site, the state of its catalogue's files when it was in step

    def step(self) -> Generator[CopyUpdate, None, dict[str, str]]:
        """Bring every site up to date; by name those that could not be, and why. Raises StoreError without a store."""
        found = sites_at(self._objects)
        is_one = found == ["."]
        here = (
            []
            if is_one
            else [each.name for each in self.folder.iterdir() if catalogue_file(each) is not None]
        )
        faults = {}
        for name in sorted({*found, *here}):
            if name != "." and (not is_plain_name(name) or "-kept-" in name):
                continue
            working = WorkingCopy.of(
                self._objects.name if is_one else f"{self._objects.name}/{name}", self.folder
            )
            try:
                with tempfile.TemporaryDirectory(prefix="sorvolo-") as scratch:
                    mark = _mark(working.folder)
                    if mark != (0, 0) and mark != self._sent.get(name) and working.is_ahead():
                        working.begin_writing()
                    try:
                        yield from working.fetch(Path(scratch))
                    except OvertakenError:
                        kept = working.set_aside()
                        _LOG.warning(
                            "another writer has changed %s; what this station had added is kept in %s",
                            name,
                            kept,
                        )
                        yield from working.fetch(Path(scratch))
                    self._sent[name] = _mark(working.folder) if mark == (0, 0) else mark
            except BusyError:
                continue  # a mission writes it: later
            except SorvoloError as error:
                faults[name] = str(error)
        return faults

    def keep(self, until: threading.Event) -> None:
        """Step again and again until the event is set, and once more; what fails is logged, once for each reason."""
        reported: dict[str, str] = {}
        is_last = False
        while not is_last:
            is_last = until.wait(_EVERY_S)
            try:
                faults = Mission(self.step()).result()
            except SorvoloError as error:
                faults = {self._objects.name: str(error)}
            for name, fault in faults.items():
                if reported.get(name) != fault:
                    _LOG.warning("%s is not in step with its store: %s", name, fault)
            reported = faults


def _mark(folder: Path) -> tuple[int, int]:
    """Another one after each change of a site's catalogue; (0, 0) where there is none."""
    file = catalogue_file(folder)
    if file is None:
        return 0, 0
    log = file.with_name(f"{file.name}-wal")
    return file.stat().st_mtime_ns, log.stat().st_mtime_ns if log.exists() else 0
