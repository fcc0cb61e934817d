"""Which streams a client may have the station call: by scheme and by the network that the address lies in."""

import ipaddress
import socket
from collections.abc import Callable, Sequence
from urllib.parse import SplitResult, urlsplit, urlunsplit

from sorvolo.station.problems import Problem

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
        return _waited_for(url, scheme, port)
    if scheme not in CALLED:
        raise _refused(f"streams of {scheme[:20] or 'no scheme'} are not called from here")
    if not host:
        raise _refused("this address names no host")
    found = (resolve or _resolved)(host, port or 554)
    if not found:
        raise _refused(f"the host {host[:100]} is not known")
    _demand_allowed(host, found, [ipaddress.ip_network(each, strict=False) for each in ranges])
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


def _demand_allowed(host: str, found: Sequence[str], allowed: Sequence[Network]) -> None:
    """Raise Problem (400) unless every address of a host is public, or in a network that the station may call."""
    for text in found:
        address = _plain(ipaddress.ip_address(text.partition("%")[0]))
        named = any(address.version == each.version and address in each for each in allowed)
        if not (named or _is_public(address)):
            raise _refused(
                f"{host[:100]} lies in this machine's own or a private network; whoever runs the station may allow it "
                f"with --stream-from {ipaddress.ip_network(address)}"
            )


def _waited_for(url: str, scheme: str, port: int | None) -> str:
    if port is None or port < _LOWEST_PORT:
        raise _refused(
            "a stream without a host is waited for: udp, rtp, tcp or rtmp with a port from 1024 on"
        )
    if urlsplit(url).query:
        raise _refused("options behind a ? are not taken")
    return url


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


def _is_public(address: Address) -> bool:
    return address.is_global and not (
        address.is_multicast or address.is_reserved or address.is_unspecified
    )


def _netloc(netloc: str, address: str, port: int | None) -> str:
    user, at, _ = netloc.rpartition("@")
    host = f"[{address}]" if ":" in address else address
    return f"{user}{at}{host}{f':{port}' if port else ''}"


def _refused(found: str) -> Problem:
    return Problem(
        400,
        f"{found}; give an address such as rtsp://HOST:554/live, or udp://:5600 to wait for a sender",
    )
