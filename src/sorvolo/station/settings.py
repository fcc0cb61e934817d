"""What a person may choose for a station, checked: where it listens, to whom, and what it takes in."""

import ipaddress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from sorvolo.errors import SettingsError

STATE_FOLDER = "station"
"""The folder below the root that holds the station's own files: state, uploads, runs."""

STREAMS_FOLDER = "streams"
"""The folder below the root that holds what drones send, a folder for each stream."""

RUNS_FOLDER = "runs"
"""The folder below the station's own that holds what missions leave, a folder for each run."""


DELETED_FOLDER = "deleted"
"""The folder below the station's own into which deleted sites are moved, to be removed there."""

RESERVE_FILE = "reserve"
"""The file below the station's own folder that holds some room for what must be written on a full disk."""


@dataclass(frozen=True)
class StationLimits:
    """How much a station does at the same time, and how long it waits for missions that are to end."""

    most_connections: int = 1000  # of all clients; a browser opens six and a few live ones
    # event and video channels: a crew behind one router is one address
    most_live_per_address: int = 64
    most_missions: int = 4  # at the same time; each takes a core and a gigabyte or more
    most_streams: int = 16  # of drones that send at the same time
    most_uploads: int = 1000  # that are kept
    stop_within_s: float = 30.0  # a mission that was stopped is killed then
    finish_within_s: float = 3600.0  # a live flight that was stopped is finished first
    away_s: float = 900.0  # a mission waits so long for a drone or camera of which nothing comes


@dataclass(frozen=True)
class StationSettings:
    """A station over the sites below `root`.

    `host` and `port` are where it listens; `tls_cert` and `tls_key` PEM files. `names` are further host names under
    which browsers reach it, `public_url` the address of a TLS proxy on this machine that passes requests on to it.
    `stream_ranges` are networks (CIDR) that a stream may be called from although they are private. `free_floor_gb` is
    the disk space below which nothing new is taken in. `base_map` is a PMTiles file that pages show below the maps.
    """

    root: Path
    host: str = "127.0.0.1"
    port: int = 8750
    tls_cert: Path | None = None
    tls_key: Path | None = None
    insecure_lan: bool = False
    names: tuple[str, ...] = ()
    stream_ranges: tuple[str, ...] = ()
    free_floor_gb: float = 2.0  # of the disk, which stay free
    public_url: str = ""
    base_map: Path | None = None
    limits: StationLimits = StationLimits()

    def __post_init__(self) -> None:
        # missions run in folders of their own
        object.__setattr__(self, "root", self.root.absolute())
        if not 0 < self.port < 65536:
            raise SettingsError(f"--port {self.port}: a port from 1 to 65535 was needed")
        if not self.free_floor_gb >= 0:
            raise SettingsError(f"free_floor_gb is not below 0, got {self.free_floor_gb}")
        # raise SettingsError unless both files are there, or neither was given
        if (self.tls_cert is None) != (self.tls_key is None):
            raise SettingsError("--tls-cert and --tls-key belong together; give both, or neither")
        for each in (self.tls_cert, self.tls_key):
            if each is not None and not each.is_file():
                raise SettingsError(f"no such file: {each}; a PEM file was needed")
        for text in self.stream_ranges:
            try:
                ipaddress.ip_network(text, strict=False)
            except ValueError as error:
                raise SettingsError(
                    f"--stream-from {text!r}: a network such as 192.168.1.0/24 was needed"
                ) from error
        if self.public_url:
            # raise SettingsError unless it is the address of a proxy that passes a whole
            # host on
            try:
                parts = urlsplit(self.public_url)
                is_right = (
                    parts.scheme == "https" and bool(parts.hostname) and (parts.port or 1) > 0
                )
            except ValueError:
                is_right = False
            if (
                not is_right
                or parts.path not in ("", "/")
                or parts.query
                or parts.fragment
                or "@" in parts.netloc
            ):
                raise SettingsError(
                    f"--public-url {self.public_url!r}: the address of a TLS proxy was needed, without a path: https://maps.example"
                )
        if self.base_map is not None and not _is_pmtiles(self.base_map):
            raise SettingsError(
                f"--base-map {self.base_map}: a PMTiles file (version 3) was needed"
            )

    @property
    def state_folder(self) -> Path:
        """Where the station keeps its own files."""
        return self.root / STATE_FOLDER

    @property
    def camera_door(self) -> Path:
        """The socket of its own cameras, in a folder of its own, which only the station's user may enter."""
        return self.state_folder / "cameras" / "station.sock"

    @property
    def is_loopback(self) -> bool:
        """Whether only programs of this machine can reach it."""
        return is_loopback(self.host)

    @property
    def is_private(self) -> bool:
        """Whether only programs of this machine reach it, under this machine's own names: nobody needs a token."""
        return self.is_loopback and not self.names and not self.public_url

    @property
    def is_secure(self) -> bool:
        """Whether browsers reach it by TLS, its own or a proxy's."""
        return self.tls_cert is not None or self.public_url.startswith("https://")

    @property
    def public_origin(self) -> str:
        """The origin of pages that a proxy passes on, as browsers write it; "" without a proxy."""
        parts = urlsplit(self.public_url.lower())
        return f"https://{parts.netloc.removesuffix(':443')}" if parts.netloc else ""

    @property
    def address(self) -> str:
        """What a browser on this machine opens."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)
        scheme = "http" if self.tls_cert is None else "https"
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{self.port}/"


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
    if settings.is_private:
        return
    where = f"{settings.public_url or settings.host} can be reached from other machines"
    if settings.is_loopback and not settings.public_url:
        where = (
            f"this station answers to {', '.join(settings.names)}, names that others may point here"
        )
    if not has_tokens:
        raise SettingsError(
            f"{where}, and no token was made; make one first: sorvolo token {settings.root} NAME --role operate"
        )
    if not (settings.is_loopback or settings.tls_cert or settings.insecure_lan):
        raise SettingsError(
            f"{where}, and without TLS tokens could be read on the way; give --tls-cert and --tls-key, or "
            "--insecure-lan in a network that you trust"
        )


def _is_pmtiles(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(8) == b"PMTiles\x03"
    except OSError:
        return False
