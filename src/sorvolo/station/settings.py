"""What a person may choose for a station, checked: where it listens, to whom, and what it takes in."""

import ipaddress
from dataclasses import dataclass
from pathlib import Path

from sorvolo.errors import SettingsError

STATE_FOLDER = "station"
"""The folder below the root that holds the station's own files: state, uploads, runs."""

STREAMS_FOLDER = "streams"
"""The folder below the root that holds what drones send, a folder for each stream."""


@dataclass(frozen=True)
class StationSettings:
    """A station over the sites below `root`.

    `host` and `port` are where it listens; `tls_cert` and `tls_key` PEM files. `names` are further host names under
    which browsers reach it. `stream_ranges` are networks (CIDR) that a stream may be called from although they are
    private. `free_floor_gb` is the disk space below which nothing new is taken in, `upload_most_gb` the largest upload.
    """

    root: Path
    host: str = "127.0.0.1"
    port: int = 8750
    tls_cert: Path | None = None
    tls_key: Path | None = None
    insecure_lan: bool = False
    names: tuple[str, ...] = ()
    stream_ranges: tuple[str, ...] = ()
    free_floor_gb: float = 2.0
    upload_most_gb: float = 64.0

    def __post_init__(self) -> None:
        if not 0 < self.port < 65536:
            raise SettingsError(f"--port {self.port}: a port from 1 to 65535 was needed")
        if (self.tls_cert is None) != (self.tls_key is None):
            raise SettingsError("--tls-cert and --tls-key belong together; give both, or neither")
        for each in (self.tls_cert, self.tls_key):
            if each is not None and not each.is_file():
                raise SettingsError(f"no such file: {each}; a PEM file was needed")
        for text in self.stream_ranges:
            try:
                ipaddress.ip_network(text, strict=False)
            except ValueError as error:
                raise SettingsError(f"--stream-from {text!r}: a network such as 192.168.1.0/24 was needed") from error
        if not (self.free_floor_gb >= 0 and self.upload_most_gb > 0):
            raise SettingsError("--free-floor and --upload-most are gigabytes: not below 0")

    @property
    def state_folder(self) -> Path:
        """Where the station keeps its own files."""
        return self.root / STATE_FOLDER

    @property
    def is_loopback(self) -> bool:
        """Whether only programs of this machine can reach it."""
        return is_loopback(self.host)

    @property
    def is_secure(self) -> bool:
        """Whether it speaks TLS."""
        return self.tls_cert is not None

    @property
    def address(self) -> str:
        """What a browser on this machine opens."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)
        return f"{'https' if self.is_secure else 'http'}://{f'[{host}]' if ':' in host else host}:{self.port}/"


def is_loopback(host: str) -> bool:
    """Whether the name or address is this machine's own, unreachable from others."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def check_exposure(settings: StationSettings, *, has_tokens: bool) -> None:
    """Raise SettingsError where others could reach the station without a password, or read it on the way."""
    if settings.is_loopback:
        return
    where = f"{settings.host} can be reached from other machines"
    if not has_tokens:
        raise SettingsError(
            f"{where}, and no token was made; make one first: sorvolo token {settings.root} NAME --role operate"
        )
    if not (settings.is_secure or settings.insecure_lan):
        raise SettingsError(
            f"{where}, and without TLS tokens could be read on the way; give --tls-cert and --tls-key, or "
            "--insecure-lan in a network that you trust"
        )
