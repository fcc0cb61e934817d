"""What missions may be started on: files below the root, uploads, streams - each named by an id, never by a path."""

import hashlib
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sorvolo.station.messages import check_stream
from sorvolo.station.orders import InputWish, without_password
from sorvolo.station.problems import Problem
from sorvolo.station.settings import STATE_FOLDER, STREAMS_FOLDER, StationSettings
from sorvolo.station.stream_addresses import checked_stream
from sorvolo.station.uploads import VIDEO_ENDINGS, Uploads
from sorvolo.store.site.files import CATALOGUE

_PHOTO_ENDINGS = (".jpg", ".jpeg", ".dng", ".tif", ".tiff", ".heic")
_SIDE_ENDINGS = (".csv", ".srt", ".gpx", ".txt", ".nmea", ".log", ".xml", ".yaml", ".yml", ".json")
_DEEPEST, _MOST_FOLDERS, _MOST = 4, 3000, 2000
_LOOK_EVERY_S = 5.0


@dataclass(frozen=True)
class FoundInput:
    """A file or a folder of photos below the root."""

    id: str
    name: str
    kind: str  # video | photos | telemetry or camera
    path: Path
    megabytes: float


class Inputs:
    """What can be flown through a mission. Threads may share it."""

    def __init__(
        self, settings: StationSettings, uploads: Uploads, newest_of_stream: Callable[[str], Path | None]
    ) -> None:
        self._settings, self._uploads, self._newest_of_stream = settings, uploads, newest_of_stream
        self._lock = threading.Lock()
        self._found: dict[str, FoundInput] = {}
        self._looked_s = -_LOOK_EVERY_S

    def all(self) -> list[FoundInput]:
        """The files below the root that a mission can use, by name."""
        with self._lock:
            if time.monotonic() - self._looked_s >= _LOOK_EVERY_S:
                self._found = {each.id: each for each in _inputs_below(self._settings.root)}
                self._looked_s = time.monotonic()
            return sorted(self._found.values(), key=lambda each: each.name)

    def videos(self) -> list[Path]:
        """The videos below the root, those that were uploaded included."""
        return [each.path for each in self.all() if each.kind == "video"] + self._uploads.videos()

    def source(self, wish: InputWish) -> str:
        """The path or address that a mission opens. Raises Problem (400, 404)."""
        if wish.upload is not None:
            return str(self._uploads.finished_path(wish.upload))
        if wish.input is not None:
            found = next((each for each in self.all() if each.id == wish.input), None)
            if found is None:
                raise Problem(404, f"no input {wish.input[:64]!r}; /api/inputs lists those there are")
            return str(found.path)
        if wish.stream is not None:
            check_stream(wish.stream)
            newest = self._newest_of_stream(wish.stream)
            if newest is None:
                raise Problem(404, f"no drone sent a stream {wish.stream[:80]!r} yet; /api/streams lists them")
            return f"follow:{newest.resolve()}"
        return checked_stream(wish.stream_url or "", self._settings.stream_ranges)

    def shown(self, wish: InputWish | None) -> dict[str, Any] | None:
        """An input as everybody may see it: without a stream's password."""
        if wish is None:
            return None
        plain = wish.model_dump(exclude_none=True)
        if wish.stream_url is not None:
            plain["stream_url"] = without_password(wish.stream_url)
        if wish.input is not None:
            plain["name"] = next((each.name for each in self.all() if each.id == wish.input), wish.input)
        if wish.upload is not None:
            plain["name"] = self._uploads.name_of(wish.upload)
        return plain


def input_row(found: FoundInput) -> dict[str, Any]:
    """An input as it is listed."""
    return {"id": found.id, "name": found.name, "kind": found.kind, "megabytes": round(found.megabytes, 1)}


def _inputs_below(root: Path) -> list[FoundInput]:
    found: list[FoundInput] = []
    waiting, seen = [(root, 0)], 0
    while waiting and seen < _MOST_FOLDERS and len(found) < _MOST:
        folder, depth = waiting.pop(0)
        seen += 1
        try:
            entries = sorted(os.scandir(folder), key=lambda each: each.name)
        except OSError:  # unreadable, or taken away meanwhile
            continue
        if any(each.name == CATALOGUE for each in entries):
            continue
        files = [each for each in entries if each.is_file(follow_symlinks=False)]
        found += [each for file in files if (each := _input_of(Path(file.path), root, file.stat().st_size)) is not None]
        photos = [each for each in files if each.name.lower().endswith(_PHOTO_ENDINGS)]
        if len(photos) >= 2 and folder != root:
            size = sum(each.stat().st_size for each in photos)
            found.append(FoundInput(_id_of(folder, root), _name(folder, root), "photos", folder, size / 1e6))
        if depth < _DEEPEST:
            waiting += [
                (Path(each.path), depth + 1) for each in entries
                if each.is_dir(follow_symlinks=False) and not each.name.startswith(".")
                and not (depth == 0 and each.name in (STATE_FOLDER, STREAMS_FOLDER))
            ]
    return found


def _input_of(path: Path, root: Path, size: int) -> FoundInput | None:
    ending = path.suffix.lower()
    kind = "video" if ending in VIDEO_ENDINGS else "telemetry or camera" if ending in _SIDE_ENDINGS else ""
    if not kind or path.name.startswith("."):
        return None
    return FoundInput(_id_of(path, root), _name(path, root), kind, path, size / 1e6)


def _name(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix()


def _id_of(path: Path, root: Path) -> str:
    return hashlib.sha256(_name(path, root).encode("utf-8", "surrogateescape")).hexdigest()[:16]
