"""What missions may be started on: files below the root, uploads, streams - each named by an id, never by a path."""

import hashlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sorvolo.capture.live.growing import ENDED_SUFFIX
from sorvolo.station.folders import Folder, folders_below
from sorvolo.station.messages import check_stream
from sorvolo.station.orders import InputWish, without_password
from sorvolo.station.problems import Problem
from sorvolo.station.settings import StationSettings
from sorvolo.station.stream_addresses import checked_stream
from sorvolo.station.uploads import VIDEO_ENDINGS, Uploads

_PHOTO_ENDINGS = (".jpg", ".jpeg", ".dng", ".tif", ".tiff", ".heic")
_SIDE_ENDINGS = (".csv", ".srt", ".gpx", ".txt", ".nmea", ".log", ".xml", ".yaml", ".yml", ".json")
_DEEPEST, _MOST_FOLDERS, _MOST = 4, 3000, 2000
_LOOK_EVERY_S = 5.0  # through the folders; by choice


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
        self,
        settings: StationSettings,
        uploads: Uploads,
        newest_of_stream: Callable[[str], Path | None],
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
        """The path or address that a mission opens; of a stream, its newest flight, followed unless it has ended.

        Raises Problem (400, 404).
        """
        if wish.upload is not None:
            return str(self._uploads.finished_path(wish.upload))
        if wish.input is not None:
            found = next((each for each in self.all() if each.id == wish.input), None)
            if found is None:
                raise Problem(
                    404, f"no input {wish.input[:64]!r}; /api/inputs lists those there are"
                )
            return str(found.path)
        if wish.stream is not None:
            check_stream(wish.stream)
            newest = self._newest_of_stream(wish.stream)
            if newest is None:
                raise Problem(
                    404, f"no drone sent a stream {wish.stream[:80]!r} yet; /api/streams lists them"
                )
            path = newest.resolve()
            return (
                str(path) if path.with_name(path.name + ENDED_SUFFIX).exists() else f"follow:{path}"
            )
        return checked_stream(wish.stream_url or "", self._settings.stream_ranges)

    def shown(self, wish: InputWish | None) -> dict[str, Any] | None:
        """An input as everybody may see it: without a stream's password."""
        if wish is None:
            return None
        plain = wish.model_dump(exclude_none=True)
        if wish.stream_url is not None:
            plain["stream_url"] = without_password(wish.stream_url)
        if wish.input is not None:
            plain["name"] = next(
                (each.name for each in self.all() if each.id == wish.input), wish.input
            )
        if wish.upload is not None:
            plain["name"] = self._uploads.name_of(wish.upload)
        return plain


def input_row(found: FoundInput) -> dict[str, Any]:
    """An input as it is listed."""
    return {
        "id": found.id,
        "name": found.name,
        "kind": found.kind,
        "megabytes": round(found.megabytes, 1),
    }


def _inputs_below(root: Path) -> list[FoundInput]:
    found: list[FoundInput] = []
    for folder in folders_below(root, deepest=_DEEPEST, most=_MOST_FOLDERS):
        if len(found) >= _MOST:
            break
        if not folder.is_site:
            found += _inputs_in(folder, root)
    return found


def _inputs_in(folder: Folder, root: Path) -> list[FoundInput]:
    """The files of a folder that a mission can use, and the folder itself where it holds photos."""
    files = [each for each in folder.entries if each.is_file(follow_symlinks=False)]
    known = (_input_of(Path(each.path), root, each.stat().st_size) for each in files)
    found = [each for each in known if each is not None]
    sizes = [each.stat().st_size for each in files if each.name.lower().endswith(_PHOTO_ENDINGS)]
    if len(sizes) >= 2 and folder.path != root:
        name = _name(folder.path, root)
        found.append(
            FoundInput(_id_of(folder.path, root), name, "photos", folder.path, sum(sizes) / 1e6)
        )
    return found


def _input_of(path: Path, root: Path, size: int) -> FoundInput | None:
    ending = path.suffix.lower()
    kind = (
        "video"
        if ending in VIDEO_ENDINGS
        else "telemetry or camera"
        if ending in _SIDE_ENDINGS
        else ""
    )
    if not kind or path.name.startswith("."):
        return None
    return FoundInput(_id_of(path, root), _name(path, root), kind, path, size / 1e6)


def _name(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix()


def _id_of(path: Path, root: Path) -> str:
    return hashlib.sha256(_name(path, root).encode("utf-8", "surrogateescape")).hexdigest()[:16]
