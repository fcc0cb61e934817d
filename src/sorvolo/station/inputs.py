"""What missions may be started on: files below the root, uploads, streams - each named by an id, never by a path."""

import hashlib
import ipaddress
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, urlsplit, urlunsplit

from sorvolo.capture.live.growing import ENDED_SUFFIX
from sorvolo.station.messages import check_stream
from sorvolo.station.orders import InputWish, without_password
from sorvolo.station.problems import Problem
from sorvolo.station.settings import StationSettings
from sorvolo.station.sites import Folder, folders_below
from sorvolo.station.uploads import VIDEO_ENDINGS, Uploads

_PHOTO_ENDINGS = (".jpg", ".jpeg", ".dng", ".tif", ".tiff", ".heic")
_SIDE_ENDINGS = (
    *(".csv", ".srt", ".ass", ".gpx", ".txt", ".mrk", ".nmea", ".log"),
    *(".xml", ".yaml", ".yml", ".json"),
)
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


CALLED = ("rtsp", "rtsps", "rtmp", "rtmps")
"""Schemes of streams that are called; HTTP is none: a playlist could name any other address."""

_LISTENED = ("udp", "rtp", "rtmp", "tcp")
_LOWEST_PORT = 1024  # below lie the system's

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network


def checked_stream(
    url: str, ranges: Sequence[str], resolve: Callable[[str, int], Sequence[str]] | None = None
) -> str:
    """The address of a stream as a mission may open it, its host's name replaced by the address that was checked.

    A stream without a host (`udp://:5600`) is one that is waited for. Addresses of this machine, of private and of
    special networks are refused unless `ranges` (CIDR) name them: a client must not reach the station's own network
    through it. `resolve` gives the addresses of a name. Raises Problem (400), with no password in its words.
    """
    parts, port = _parts(url)
    scheme, host = parts.scheme.lower(), parts.hostname
    if not host and scheme in _LISTENED:
        if port is None or port < _LOWEST_PORT:
            raise _refused(
                "a stream without a host is waited for: udp, rtp, tcp or rtmp with a port from 1024 on"
            )
        if urlsplit(url).query:
            raise _refused("options behind a ? are not taken")
        return url
    if scheme not in CALLED:
        raise _refused(f"streams of {scheme[:20] or 'no scheme'} are not called from here")
    if not host:
        raise _refused("this address names no host")
    found = (resolve or _resolved)(host, port or 554)
    if not found:
        raise _refused(f"the host {host[:100]} is not known")
    allowed = [ipaddress.ip_network(each, strict=False) for each in ranges]
    for text in found:
        address = _plain(ipaddress.ip_address(text.partition("%")[0]))
        named = any(address.version == each.version and address in each for each in allowed)
        is_ours = address.is_multicast or address.is_reserved or address.is_unspecified
        if not named and (is_ours or not address.is_global):
            raise _refused(
                f"{host[:100]} lies in this machine's own or a private network; whoever runs the station may allow it "
                f"with --stream-from {ipaddress.ip_network(address)}"
            )
    return urlunsplit(parts._replace(netloc=_netloc(parts.netloc, found[0], port)))


def _parts(url: str) -> tuple[SplitResult, int | None]:
    """The parts of an address, and its port. Raises Problem (400) for what is none."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise _refused("this is no address of a stream") from error
    if any(each in url for each in "\r\n\t\\ \0") or not url.isascii():
        raise _refused("this is no address of a stream")
    return parts, port


def _resolved(host: str, port: int) -> list[str]:
    try:
        return list(
            dict.fromkeys(
                str(each[4][0]) for each in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
            )
        )
    except (OSError, UnicodeError):
        return []


def _plain(address: Address) -> Address:
    """An IPv4 address that is written as an IPv6 one, as IPv4."""
    if isinstance(address, ipaddress.IPv6Address):
        return address.ipv4_mapped or address.sixtofour or address
    return address


def _netloc(netloc: str, address: str, port: int | None) -> str:
    user, at, _ = netloc.rpartition("@")
    host = f"[{address}]" if ":" in address else address
    return f"{user}{at}{host}{f':{port}' if port else ''}"


def _refused(found: str) -> Problem:
    return Problem(
        400,
        f"{found}; give an address such as rtsp://HOST:554/live, or udp://:5600 to wait for a sender",
    )
