"""The way of Cursor on Target events to a TAK server or a team's phones: UDP datagrams, a TCP stream or TLS."""

import selectors
import socket
import ssl
import time
from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from sorvolo.errors import InputError, SettingsError
from sorvolo.survey.wording import counted

Transport = Literal["udp", "tcp", "tls"]

_DEFAULT_PORTS: dict[Transport, int] = {"udp": 6969, "tcp": 8087, "tls": 8089}
_TIMEOUT_S = 3.0  # for a connection and a message, which wait meanwhile; by choice
_VERDICT_S = (
    1.0  # for a server's answer to one's certificate: a satellite's way and back; by choice
)
_END_S = 1.0  # for the other side to end its half of a stream; by choice


@dataclass(frozen=True)
class CotPlace:
    """Where events are sent to."""

    transport: Transport
    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.transport}://{self.host}:{self.port}"


def trusting(authority: Path | None, option: str) -> ssl.SSLContext:
    """TLS that trusts the authority in a PEM file, else the system's. Raises SettingsError, naming the option."""
    try:
        return ssl.create_default_context(cafile=authority)
    except (OSError, ssl.SSLError, ValueError) as error:
        raise SettingsError(
            f"{option} {authority}: no usable certificate ({error}); give a PEM file"
        ) from error


@dataclass(frozen=True)
class CotTls:
    """What a TLS connection needs besides the system's authorities: PEM files of the server's authority (`ca`), and of
    one's own certificate with its key, without a password (`certificate`)."""

    ca: Path | None = None
    certificate: Path | None = None

    def context(self) -> ssl.SSLContext:
        """Ready to connect: the server's certificate and its name are checked. Raises InputError or SettingsError for unusable files."""
        made = trusting(self.ca, "--cot-ca")
        if self.certificate is None:
            return made
        try:
            made.load_cert_chain(str(self.certificate), password=lambda: "")
        except (OSError, ssl.SSLError, ValueError) as error:
            raise InputError(
                f"--cot-cert {self.certificate}: no usable certificate ({error}); give a PEM file with it and its key, "
                "the key without a password (openssl pkcs12 -in FILE.p12 -out FILE.pem -nodes)"
            ) from error
        return made


def cot_place(url: str) -> CotPlace:
    """The place that `udp://host[:port]`, `tcp://...` or `tls://...` names; ports 6969, 8087, 8089 where none is given.

    A multicast group (udp://239.2.3.1:6969 is the one that ATAK listens to) is a host as any other. Raises
    SettingsError for anything else.
    """
    wanted = (
        "give udp://host:port, tcp://host:port or tls://host:port, such as udp://239.2.3.1:6969"
    )
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise SettingsError(f"--cot {url}: {error}; {wanted}") from error
    transport = next((each for each in _DEFAULT_PORTS if each == parts.scheme), None)
    if transport is None or not parts.hostname or parts.path.strip("/") or port == 0:
        raise SettingsError(f"--cot {url} is no place to send events to; {wanted}")
    return CotPlace(transport, parts.hostname, port or _DEFAULT_PORTS[transport])


def check_cot(url: str, tls: CotTls) -> None:
    """Raise SettingsError for a place, "" for none, that `cot_place` refuses, and for certificates of another."""
    if tls != CotTls() and not url.startswith("tls://"):
        raise SettingsError("--cot-ca and --cot-cert are for --cot tls://host:port")
    if url:
        cot_place(url)


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

    A connection that breaks after an event was sent is made anew; the first one that cannot be made, and a second
    failure in a row, end it, for a receiver that is not there would be waited for with each event. Raises
    InputError where nothing can be sent at all, where a host refuses datagrams because nothing listens there, and where
    the receiver breaks the connection at the end.
    """
    sender, sent, first, is_refused, was_sent = CotSender(place, tls), 0, "", False, False
    advice = "; check the address, the port and the network"
    try:
        for event in events:
            try:
                sender.send(event)
                sent, was_sent = sent + 1, True
            except OSError as error:
                first = first or str(error)
                is_refused = isinstance(error, ConnectionRefusedError)
                advice = "" if isinstance(error, ssl.SSLCertVerificationError) else advice
                if not was_sent or (is_refused and place.transport == "udp"):
                    break
                was_sent = False
        sender.finish()
    except OSError as error:
        raise InputError(
            f"--cot {place}: the receiver broke the connection at the end ({error}), so that how many of "
            f"{counted(len(events), 'event')} arrived is not known; check the receiver, and send them again"
        ) from error
    finally:
        sender.close()
    if is_refused and place.transport == "udp":
        raise InputError(
            f"--cot {place}: nothing listens there ({first}), so that how many of {counted(len(events), 'event')} "
            "arrived is not known; check the address and the port, start the receiver, and send them again"
        )
    if events and not sent:
        raise InputError(f"--cot {place}: nothing could be sent ({first}){advice}")
    return sent


class CotSender:
    """Sends events to one place; a connection that broke is made anew with the next event."""

    def __init__(self, place: CotPlace, tls: CotTls = CotTls()) -> None:
        self._place = place
        self._tls = tls.context() if place.transport == "tls" else None
        self._advice = (
            "it may ask clients for a certificate: give --cot-cert"
            if tls.certificate is None
            else "check that it knows the certificate of --cot-cert"
        )
        self._socket: socket.socket | None = None

    def send(self, event: bytes) -> None:
        """Send one event: a datagram, or a piece of the stream.

        Raises OSError when that fails, or when an earlier datagram was refused (this one is then sent all the same);
        ConnectionRefusedError where a TLS server refuses this client.
        """
        try:
            if (
                self._socket is not None
                and self._place.transport != "udp"
                and not _is_open(self._socket)
            ):
                self.close()
            if self._socket is None:
                self._socket = _connected(self._place, self._tls)
            self._socket.sendall(event)
        except OSError as error:
            self.close()
            if self._place.transport == "udp":
                with _connected(self._place) as once_more:
                    once_more.send(event)
            self._raise_refusal(error)
            raise

    def finish(self) -> None:
        """End the connection once the other side has taken what was sent, or has had a second for it.

        Raises OSError where the other side breaks the connection instead.
        """
        if self._socket is not None and self._place.transport != "udp":
            try:
                _end(self._socket)
            except OSError as error:
                self._raise_refusal(error)
                raise
            finally:
                self.close()
        self.close()

    def close(self) -> None:
        """End the connection at once, if there is one."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _raise_refusal(self, error: OSError) -> None:
        """Raise ConnectionRefusedError, which names --cot-cert, for an error by which a TLS server refuses a client,
        and ssl.SSLCertVerificationError, which names --cot-ca, for a server that is not trusted."""
        if isinstance(error, ssl.SSLCertVerificationError):
            raise ssl.SSLCertVerificationError(
                error.errno,
                (
                    f"the server's certificate is not trusted ({error.verify_message.rstrip('.')}): give the certificate "
                    "of the authority that signed it as --cot-ca, and the server by the name that is in it"
                ),
            ) from error
        if isinstance(error, ssl.SSLError) and "ALERT" in (error.reason or ""):
            words = (error.reason or "").lower().replace("_", " ")
            raise ConnectionRefusedError(
                f"the server refuses this client ({words}); {self._advice}"
            ) from error
        if isinstance(error, _ClosedAtOnceError):
            raise ConnectionRefusedError(
                f"the server closed the connection at once; {self._advice}"
            ) from error


class _ClosedAtOnceError(ConnectionError):
    """A TLS server ended a connection before anything was sent."""


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


def _end(stream: socket.socket) -> None:
    """End one's own half and wait for the other's, at most `_END_S`. Raises OSError where that is broken off.

    A stream that is closed while bytes of the other side wait unread is reset, and may lose what was sent.
    """
    if not _is_open(stream):
        return
    stream.settimeout(_END_S)
    until_s = time.monotonic() + _END_S
    try:
        if isinstance(stream, ssl.SSLSocket):
            stream.unwrap()
            return
        stream.shutdown(socket.SHUT_WR)
        while time.monotonic() < until_s and stream.recv(65_536):
            pass
    except TimeoutError:  # the other side holds its half open
        return
    except ssl.SSLError as error:
        if "ALERT" in (error.reason or ""):
            raise  # others are of servers that end without TLS's own farewell, or still send


def _connected(place: CotPlace, tls: ssl.SSLContext | None = None) -> socket.socket:
    if place.transport != "udp":
        plain = socket.create_connection((place.host, place.port), timeout=_TIMEOUT_S)
        if tls is None:
            return plain
        try:
            stream = tls.wrap_socket(plain, server_hostname=place.host)
        except OSError:
            plain.close()
            raise
        try:
            _await_verdict(stream)
        except OSError:
            stream.close()
            raise
        return stream
    family, kind, protocol, _, address = socket.getaddrinfo(
        place.host, place.port, type=socket.SOCK_DGRAM
    )[0]
    made = socket.socket(family, kind, protocol)
    try:
        if ip_address(address[0]).is_multicast and family == socket.AF_INET:
            made.setsockopt(
                socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 4
            )  # a few routers of one's own network
        made.settimeout(_TIMEOUT_S)
        made.connect(address)
    except OSError:
        made.close()
        raise
    return made


def _await_verdict(stream: ssl.SSLSocket) -> None:
    """Wait until a server has judged the client's certificate. Raises OSError where it refuses the client.

    In TLS 1.3 the handshake ends for the client before that. A server that takes the client mostly sends session
    tickets at once; of one that sends nothing in `_VERDICT_S` no refusal is expected.
    """
    if stream.version() != "TLSv1.3":
        return
    with selectors.DefaultSelector() as waiting:
        waiting.register(stream, selectors.EVENT_READ)
        has_answered = bool(waiting.select(_VERDICT_S))
    if has_answered and not _is_open(stream):
        raise _ClosedAtOnceError("the server closed the connection at once")
