"""The way of Cursor on Target events to a TAK server or a team's phones: UDP datagrams, a TCP stream or TLS."""

import socket
import ssl
from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from sorvolo.errors import InputError, SettingsError

Transport = Literal["udp", "tcp", "tls"]

_DEFAULT_PORTS: dict[Transport, int] = {"udp": 6969, "tcp": 8087, "tls": 8089}
_TIMEOUT_S = 3.0  # for a connection and a message, which wait meanwhile; by choice


@dataclass(frozen=True)
class CotPlace:
    """Where events are sent to."""

    transport: Transport
    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.transport}://{self.host}:{self.port}"


@dataclass(frozen=True)
class CotTls:
    """What a TLS connection needs besides the system's authorities: PEM files of the server's authority (`ca`), and of
    one's own certificate with its key, without a password (`certificate`)."""

    ca: Path | None = None
    certificate: Path | None = None

    def context(self) -> ssl.SSLContext:
        """Ready to connect: the server's certificate and its name are checked. Raises InputError for unusable files."""
        try:
            made = ssl.create_default_context(cafile=None if self.ca is None else str(self.ca))
            if self.certificate is not None:
                made.load_cert_chain(str(self.certificate), password=lambda: "")
        except (OSError, ssl.SSLError, ValueError) as error:
            named = " and ".join(str(each) for each in (self.ca, self.certificate) if each is not None)
            raise InputError(
                f"{named}: no usable certificate ({error}); give PEM files, --cot-cert with the certificate and its "
                "key, the key without a password (openssl pkcs12 -in FILE.p12 -out FILE.pem -nodes)"
            ) from error
        return made


def cot_place(url: str) -> CotPlace:
    """The place that `udp://host[:port]`, `tcp://...` or `tls://...` names; ports 6969, 8087, 8089 where none is given.

    A multicast group (udp://239.2.3.1:6969 is the one that ATAK listens to) is a host as any other. Raises
    SettingsError for anything else.
    """
    wanted = "give udp://host:port, tcp://host:port or tls://host:port, such as udp://239.2.3.1:6969"
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise SettingsError(f"--cot {url}: {error}; {wanted}") from error
    transport = next((each for each in _DEFAULT_PORTS if each == parts.scheme), None)
    if transport is None or not parts.hostname or parts.path.strip("/") or port == 0:
        raise SettingsError(f"--cot {url} is no place to send events to; {wanted}")
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


def send_all(events: Sequence[bytes], place: CotPlace, tls: CotTls = CotTls()) -> int:
    """Send recorded events one after the other; how many arrived as far as the sender can know.

    Raises InputError where nothing can be sent at all.
    """
    sender, sent, last = CotSender(place, tls), 0, ""
    try:
        for event in events:
            try:
                sender.send(event)
                sent += 1
            except OSError as error:
                last = str(error)
    finally:
        sender.close()
    if events and not sent:
        raise InputError(f"--cot {place}: nothing could be sent ({last}); check the address, the port and the network")
    return sent


class CotSender:
    """Sends events to one place; a connection that broke is made anew with the next event."""

    def __init__(self, place: CotPlace, tls: CotTls = CotTls()) -> None:
        self._place = place
        self._tls = tls.context() if place.transport == "tls" else None
        self._socket: socket.socket | None = None

    def send(self, event: bytes) -> None:
        """Send one event: a datagram, or a piece of the stream.

        Raises OSError when that fails, or when an earlier datagram was refused (this one is then sent all the same).
        """
        try:
            if self._socket is not None and self._place.transport != "udp" and not _is_open(self._socket):
                self.close()
            if self._socket is None:
                self._socket = _connected(self._place, self._tls)
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


def _is_open(stream: socket.socket) -> bool:
    """Whether the other side still holds the connection; what it sent, as servers do, is read and dropped."""
    stream.setblocking(False)
    try:
        while stream.recv(65_536):
            pass
        return False
    except (BlockingIOError, ssl.SSLWantReadError):
        return True
    finally:
        stream.settimeout(_TIMEOUT_S)


def _connected(place: CotPlace, tls: ssl.SSLContext | None = None) -> socket.socket:
    if place.transport != "udp":
        plain = socket.create_connection((place.host, place.port), timeout=_TIMEOUT_S)
        if tls is None:
            return plain
        try:
            return tls.wrap_socket(plain, server_hostname=place.host)
        except OSError:
            plain.close()
            raise
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
