"""What a user writes for a live source, and FFmpeg's options to open it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from urllib.parse import parse_qsl, urlsplit, urlunsplit

import av

from sorvolo.errors import InputError

STREAM_SCHEMES = ("rtsp", "rtsps", "rtmp", "rtmps", "udp", "rtp", "tcp", "srt", "http", "https")
"""Addresses of streams, as `scheme://...`."""

ADDRESS_FORMS = "rtsp://HOST/live, rtmp://HOST/live, udp://:PORT, tcp://:PORT, http://HOST/live, webcam:0, follow:PATH"
"""What a live source looks like, for messages."""

_WAITING = frozenset({"udp", "rtp"})  # a sender may begin at any time; nothing has to be dialled
_OPEN_S = 6.0  # for the other side's first answer and pictures; by choice
# a listener that nobody calls is opened anew so often, so that it can be stopped; by choice
_LISTEN_S = 3
# without a host: the usual port, and FFmpeg's options to be the server that a drone pushes its video to; what ends is
# the wait for a call, not a call that has come
_LISTENING: Mapping[str, tuple[int, Mapping[str, str]]] = {
    "rtmp": (1935, {"listen": "1", "timeout": f"{_LISTEN_S}"}),
    "tcp": (0, {"listen": "1", "listen_timeout": f"{1000 * _LISTEN_S}"}),
    "rtsp": (554, {"rtsp_flags": "listen", "listen_timeout": f"{_LISTEN_S}"}),
}
# live: nothing is held back for a smoother picture, and a damaged packet does not end the stream; not `nobuffer`, which
# throws away what came while the stream was looked at, and makes what comes later no sooner; twenty pictures for the
# frame rate alone, FFmpeg's own choice, took 3 s at two a second: it is right from a few on
_COMMON = {
    "fflags": "discardcorrupt",
    "flags": "low_delay",
    "analyzeduration": "1000000",
    "probesize": "5000000",
    "fpsprobesize": "2",
}
_BY_SCHEME: Mapping[str, Mapping[str, str]] = {
    "rtsp": {"rtsp_transport": "tcp"},
    "rtsps": {"rtsp_transport": "tcp"},
    "rtmp": {"rtmp_live": "live"},
    "http": {"protocol_whitelist": "http,https,tls,tcp"},  # whatever a playlist may name
    "https": {"protocol_whitelist": "http,https,tls,tcp"},
    "tcp": {"protocol_whitelist": "tcp"},
    "udp": {"fifo_size": "57344", "overrun_nonfatal": "1"},  # 188-byte packets: 10 MB
}


@dataclass(frozen=True)
class StreamAddress:
    """A stream that can be opened. `shown` has no password in it; `waits`: it is listened to rather than called.

    `opens_s`: how long one attempt to open it may take.
    """

    url: str
    shown: str
    container: str | None
    options: Mapping[str, str]
    waits: bool = False
    opens_s: float = _OPEN_S


@dataclass(frozen=True)
class FollowedPath:
    """A file or folder that is still being written (`follow:PATH`)."""

    path: Path


def is_live_address(text: str) -> bool:
    """Whether an input is a live source rather than a file or folder."""
    scheme, colon, _ = text.partition(":")
    has_scheme = bool(colon) and scheme.lower() in (*STREAM_SCHEMES, "webcam", "follow")
    return has_scheme or text.startswith("/dev/video")


def live_address(text: str) -> StreamAddress | FollowedPath:
    """What `rtsp://...`, `udp://:5000`, `webcam:0`, `/dev/video0`, `follow:PATH` and the like name.

    Without a host (`rtmp://:1935/live`, `tcp://:5000`) a stream is waited for, as drones push theirs.
    `webcam:0?size=1280x720&rate=30` asks a webcam for a size and rate; what stands behind the `?` of a stream's
    address is FFmpeg's. Raises InputError for an address that cannot be, or a protocol that this FFmpeg lacks.
    """
    scheme, _, rest = text.partition(":")
    if scheme == "follow":
        return FollowedPath(
            _existing(rest, "follow:PATH names a file or folder that is being written")
        )
    if text.startswith("/dev/video"):
        return _webcam(text, "")
    if scheme == "webcam":
        number, _, query = rest.partition("?")
        return _webcam(number if number.startswith("/") else f"/dev/video{number or 0}", query)
    return _stream(text)


def shown_address(url: str) -> str:
    """The address without the user's name and password."""
    parts = urlsplit(url)
    return urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))


def without_secret(words: str, source: str) -> str:
    """The words of an error without a stream's name and password, and what stands behind its `?`.

    FFmpeg's errors hold the whole address; others may read those of a mission.
    """
    if "://" not in source:
        return words
    parts = urlsplit(source)
    for secret in (parts.netloc.rpartition("@")[0], parts.password, parts.query):
        if secret:
            words = words.replace(secret, "***")
    return words


def _stream(text: str) -> StreamAddress:
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError as error:
        raise InputError(
            f"{text}: no address ({error}); give for instance rtsp://192.168.1.10:554/live"
        ) from error
    scheme = parts.scheme.lower()
    # Raises InputError for an address that lacks a part which its scheme needs, or whose scheme
    # is not built in.
    if scheme in ("udp", "rtp", "tcp") and port is None:
        raise InputError(f"{shown_address(text)} has no port; give for instance {scheme}://:5000")
    if not parts.hostname and scheme not in (*_WAITING, *_LISTENING):
        raise InputError(
            f"{shown_address(text)} has no host; give for instance {scheme}://192.168.1.10/live"
        )
    if scheme == "srt" and not _has_srt():
        raise InputError(
            "this PyAV was built without SRT; receive it with another program and pass it on, for instance: "
            "srt-live-transmit srt://HOST:PORT udp://127.0.0.1:5000, then give udp://:5000"
        )
    options = {**_COMMON, **_BY_SCHEME.get(scheme, {})}
    url = text
    if not parts.hostname:  # the sender calls us, at whichever address of this machine
        url = urlunsplit(parts._replace(netloc=f"0.0.0.0:{port or _LISTENING[scheme][0]}"))
        options |= _LISTENING[scheme][1] if scheme in _LISTENING else {}
    container = "mpegts" if scheme == "udp" else None
    waits = not parts.hostname or scheme in _WAITING
    opens_s = (_LISTEN_S if waits else 0) + (0 if scheme in _WAITING else _OPEN_S)
    return StreamAddress(url, shown_address(text), container, options, waits, opens_s)


def _webcam(device: str, query: str) -> StreamAddress:
    wanted = dict(parse_qsl(query))
    if unknown := set(wanted) - {"size", "rate"}:
        raise InputError(f"webcam option {sorted(unknown)[0]}: give size=1280x720 or rate=30")
    _existing(device, "no such camera; those there are /dev/video*, and Linux is needed")
    options = {"video_size": wanted.get("size", ""), "framerate": wanted.get("rate", "")}
    return StreamAddress(
        device, device, "v4l2", MappingProxyType({k: v for k, v in options.items() if v})
    )


def _existing(text: str, words: str) -> Path:
    path = Path(text)
    if not text or not path.exists():
        raise InputError(f"no such file or folder: {text or '(nothing)'}; {words}")
    return path


def _has_srt() -> bool:
    try:
        av.open("srt://127.0.0.1:1?mode=listener", timeout=0.01)
    except av.error.ProtocolNotFoundError:
        return False
    except (av.FFmpegError, OSError):
        pass
    return True
