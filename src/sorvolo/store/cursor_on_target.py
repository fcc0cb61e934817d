"""Tracks as Cursor on Target events, version 2.0, and their way to a TAK server or a team's phones."""

import socket
from collections.abc import Mapping
from dataclasses import dataclass
from ipaddress import ip_address
from types import MappingProxyType
from typing import Literal
from urllib.parse import urlsplit
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np

from sorvolo.errors import InputError, SettingsError
from sorvolo.store.exports import longitude_latitude, utc_text
from sorvolo.survey.flight import Site
from sorvolo.survey.objects import Track

COT_TYPES: Mapping[str, str] = MappingProxyType({
    "person": "a-u-G", "car": "a-u-G-E-V-C", "small object": "b-m-p-s-m",
})
"""The event type of each class: unknown on the ground, unknown civilian vehicle, a spot on the map."""

_OTHER_TYPE = "a-u-G"
_UNKNOWN_M = "9999999.0"  # what the schema wants where a height or an error is not known
_DEFAULT_PORTS = {"udp": 6969, "tcp": 8087}
_TIMEOUT_S = 3.0


@dataclass(frozen=True)
class CotPlace:
    """Where events are sent to."""

    transport: Literal["udp", "tcp"]
    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.transport}://{self.host}:{self.port}"


def cot_place(url: str) -> CotPlace:
    """The place that `udp://host[:port]` or `tcp://host[:port]` names; ports 6969 and 8087 where none is given.

    A multicast group (udp://239.2.3.1:6969 is the one that ATAK listens to) is a host as any other. Raises
    SettingsError for anything else.
    """
    wanted = "give udp://host:port or tcp://host:port, such as udp://239.2.3.1:6969"
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise SettingsError(f"--cot {url}: {error}; {wanted}") from error
    if parts.scheme not in ("udp", "tcp") or not parts.hostname or parts.path.strip("/") or port == 0:
        raise SettingsError(f"--cot {url} is no place to send events to; {wanted}")
    transport: Literal["udp", "tcp"] = "udp" if parts.scheme == "udp" else "tcp"
    return CotPlace(transport, parts.hostname, port or _DEFAULT_PORTS[transport])


def check_host(place: CotPlace) -> None:
    """Ask for the host's address. Raises InputError where nothing knows it."""
    try:
        socket.getaddrinfo(place.host, place.port)
    except (OSError, UnicodeError) as error:
        raise InputError(
            f"--cot {place}: the host {place.host!r} has no address ({error}); check its name and the network, or give "
            "its IP address"
        ) from error


def cot_type(label: str, types: Mapping[str, str] = COT_TYPES) -> str:
    """The event type of a class; something unknown on the ground for one that is not named."""
    return types.get(label, _OTHER_TYPE)


def cot_event(
    track: Track, site: Site, *, uid: str, now_ns: int, stale_s: float, types: Mapping[str, str] = COT_TYPES
) -> bytes:
    """One track as one event: an XML element without a declaration, as streams of events want it.

    `uid` is the same for the same object in every event. `now_ns` is the UTC time of sending, and `stale_s` later the
    event is stale. `ce` is one sigma of the place along its worst direction, as the schema has it; `hae` is the
    ground's height above the ellipsoid where the site knows it. Speed and course are told of what moves. The site must
    be geo-referenced.
    """
    longitude, latitude = (float(each[0]) for each in longitude_latitude(track.position_m[None], site))
    now = _milliseconds(now_ns)
    event = Element("event", {
        "version": "2.0", "uid": uid, "type": cot_type(track.label, types), "how": "m-g",
        "time": now, "start": now, "stale": _milliseconds(now_ns + round(stale_s * 1e9)),
    })
    error_m = float(np.sqrt(np.linalg.eigvalsh(track.covariance_m2)[-1]))
    SubElement(event, "point", {
        "lat": f"{latitude:.7f}", "lon": f"{(longitude + 180) % 360 - 180:.7f}",
        "hae": f"{site.origin.height_m:.1f}" if site.height_reference == "ellipsoidal" else _UNKNOWN_M,
        "ce": f"{error_m:.1f}", "le": _UNKNOWN_M,
    })
    detail = SubElement(event, "detail")
    label = "".join(letter for letter in track.label if letter.isprintable())  # another's model may name anything
    SubElement(detail, "contact", {"callsign": f"{label} {track.id}"})
    east, north = track.velocity_m_s
    if track.moving:
        course_deg = float(np.degrees(np.arctan2(east, north))) % 360
        SubElement(detail, "track", {"course": f"{course_deg:.0f}", "speed": f"{float(np.hypot(east, north)):.1f}"})
    seen = utc_text(track.last_seen_ns)[:19] + "Z"
    SubElement(detail, "remarks").text = (
        f"{label}, score {track.score:.2f}, {track.views} views, last seen {seen}, found by Sorvolo"
    )
    return bytes(tostring(event, encoding="utf-8"))


def cot_removal(uid: str, *, type_: str, now_ns: int) -> bytes:
    """The event that takes another one, of this `uid` and type, off everyone's map: it turned out to be none."""
    now = _milliseconds(now_ns)
    event = Element("event", {
        "version": "2.0", "uid": f"{uid}.removed", "type": "t-x-d-d", "how": "m-g", "time": now, "start": now,
        "stale": _milliseconds(now_ns + 60_000_000_000),
    })
    SubElement(event, "point", {"lat": "0", "lon": "0", "hae": _UNKNOWN_M, "ce": _UNKNOWN_M, "le": _UNKNOWN_M})
    detail = SubElement(event, "detail")
    SubElement(detail, "link", {"uid": uid, "relation": "p-p", "type": type_})
    SubElement(detail, "__forcedelete")
    return bytes(tostring(event, encoding="utf-8"))


class CotSender:
    """Sends events to one place; a connection that broke is made anew with the next event."""

    def __init__(self, place: CotPlace) -> None:
        self._place = place
        self._socket: socket.socket | None = None

    def send(self, event: bytes) -> None:
        """Send one event: a datagram, or a piece of the stream.

        Raises OSError when that fails, or when an earlier datagram was refused (this one is then sent all the same).
        """
        try:
            if self._socket is not None and self._place.transport == "tcp" and not _is_open(self._socket):
                self.close()
            if self._socket is None:
                self._socket = _connected(self._place)
            self._socket.sendall(event)
        except OSError:
            self.close()
            if self._place.transport == "udp":
                with _connected(self._place) as once_more:
                    once_more.send(event)
            raise

    def close(self) -> None:
        """End the connection, if there is one."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _milliseconds(time_ns: int) -> str:
    return utc_text(time_ns)[:23] + "Z"


def _is_open(stream: socket.socket) -> bool:
    """Whether the other side still holds the connection; what it sent, as servers do, is read and dropped."""
    stream.setblocking(False)
    try:
        while stream.recv(65_536):
            pass
        return False
    except BlockingIOError:
        return True
    finally:
        stream.settimeout(_TIMEOUT_S)


def _connected(place: CotPlace) -> socket.socket:
    if place.transport == "tcp":
        return socket.create_connection((place.host, place.port), timeout=_TIMEOUT_S)
    family, kind, protocol, _, address = socket.getaddrinfo(place.host, place.port, type=socket.SOCK_DGRAM)[0]
    made = socket.socket(family, kind, protocol)
    try:
        if ip_address(address[0]).is_multicast and family == socket.AF_INET:
            made.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 4)  # a few routers of one's own network
        made.settimeout(_TIMEOUT_S)
        made.connect(address)
    except OSError:
        made.close()
        raise
    return made
