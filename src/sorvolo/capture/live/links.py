"""NMEA 0183 from a receiver that is on, or MAVLink from an autopilot: by serial port, TCP, UDP, or a growing log."""

import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import parse_qsl, urlsplit

from sorvolo.capture.live.reconnect import Backoff, LiveSettings, Outages
from sorvolo.capture.telemetry.autopilot_logs import MavlinkBuffer
from sorvolo.capture.telemetry.cleaning import notice
from sorvolo.capture.telemetry.nmea import Epoch, epochs_of, messages_in, nearest_ns
from sorvolo.errors import InputError, SettingsError
from sorvolo.survey.flight import Notice

LINK_FORMS = (
    "serial:/dev/ttyUSB0?baud=9600, tcp://HOST:PORT, udp://:PORT or follow:LOG for NMEA; "
    "mavlink:udp://:14550 and the like for MAVLink"
)
"""What a link looks like, for messages."""

_MAVLINK = "mavlink:"
_DEFAULT_BAUD = 9600  # of many receivers; NMEA 0183 itself has 4800
_POLL_S = 0.1  # a sentence that nothing follows for so long ends its moment
_CALL_S = 3.0  # for a connection to be made; by choice
_LONGEST_LINE = 4096  # bytes; NMEA 0183 has 82 at most, receivers a few hundred; by choice


class Wire(Protocol):
    """An open connection to a receiver."""

    def read(self) -> bytes | None:
        """What came within a tenth of a second, maybe nothing; None when the other side has closed."""

    def close(self) -> None:
        """Let go of it."""


class TelemetryLink:
    """A receiver's sentences or an autopilot's packets, read in a thread of their own, given on moment by moment.

    `heard(arrived_utc_ns, epoch)` is called in that thread; the epoch's time is UTC, its day the one nearest to this
    computer's clock. A link that is silent for `silent_s` is reported, and one that breaks is opened anew.
    """

    def __init__(
        self, address: str, settings: LiveSettings, heard: Callable[[int, Epoch], None]
    ) -> None:
        self._open = _opener(address)
        self._address, self._settings, self._heard = address, settings, heard
        self.outages = Outages(address)
        self.failure = ""
        self._counts: Counter[str] = Counter()
        is_mavlink = address.startswith(_MAVLINK)
        # a link that breaks stays with the vehicle and the clock that it had
        self._packets = MavlinkBuffer(self._counts) if is_mavlink else None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"reading {address}", daemon=True)

    def start(self) -> None:
        """Begin to listen."""
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(_CALL_S + 1.0)

    def notices(self) -> list[Notice]:
        """What was wrong with the sentences, and when the link was silent."""
        counts = self._counts
        return [
            *notice(
                "bad_checksum",
                counts["bad_checksum"],
                "{} sentences dropped: bad or missing checksum",
            ),
            *notice(
                "unreadable_line", counts["unreadable_line"], "{} sentences dropped: not readable"
            ),
            *notice("no_time", counts["no_time"], "{} sentences dropped: no readable time"),
            *notice("bad_packet", counts["bad_packet"], "{} packets dropped: damaged"),
            *notice(
                "other_vehicle", counts["other_vehicle"], "other vehicles on the link, not used: {}"
            ),
            *self.outages.notices("telemetry_outage"),
        ]

    def _run(self) -> None:
        backoff = Backoff()
        while not self._stop.is_set():
            heard_s = time.monotonic()
            try:
                with closing(self._open()) as wire:
                    # read until the wire ends; when something came last (monotonic clock)
                    buffer = self._packets or SentenceBuffer(self._counts)
                    heard_s, arrived_ns = time.monotonic(), time.time_ns()
                    while not self._stop.is_set() and (data := wire.read()) is not None:
                        if data:
                            heard_s, arrived_ns = time.monotonic(), time.time_ns()
                            self.outages.back()
                            backoff.reset()
                        elif time.monotonic() - heard_s > self._settings.silent_s:
                            self.outages.lost(
                                heard_s, f"silent for {time.monotonic() - heard_s:.1f} s"
                            )
                        for epoch in buffer.take(data, arrived_ns):
                            self._heard(arrived_ns, epoch)
                self.failure = "the other side closed the link"
            except OSError as error:
                self.failure = str(error)
            if not self._stop.is_set():
                self.outages.lost(heard_s, self.failure)
                self._stop.wait(backoff.next_s())


class SentenceBuffer:
    """Bytes as they come to whole moments. `take` changes it; what is damaged is counted in `counts`."""

    def __init__(self, counts: Counter[str]) -> None:
        self._counts = counts
        self._rest = b""
        self._pending: list[Any] = []

    def take(self, data: bytes, utc_ns: int) -> list[Epoch]:
        """The moments that are complete: a later sentence has another time, or nothing came (`data` is empty).

        `utc_ns` is about now: sentences state the time of day, and a receiver without a fix invents its date.
        """
        whole, newline, self._rest = (self._rest + data).rpartition(b"\n")
        if len(self._rest) > _LONGEST_LINE:  # no receiver's: a wrong baud rate
            self._counts["unreadable_line"] += 1
            self._rest = b""
        self._pending += messages_in(whole + newline, self._counts) if newline else []
        is_open = data and self._pending  # more of the last moment may come
        held = (
            [each for each in self._pending if each.time == self._pending[-1].time]
            if is_open
            else []
        )
        done, self._pending = self._pending[: len(self._pending) - len(held)], held
        epochs = epochs_of(done)[0] if done else []
        for epoch in epochs:
            epoch.time_ns = nearest_ns(epoch.time_ns, utc_ns)
        return epochs


def is_link(text: str) -> bool:
    """Whether `--telemetry` names a link rather than a file."""
    return text.startswith("follow:") or text.removeprefix(_MAVLINK).startswith(
        ("serial:", "tcp:", "udp:")
    )


def link_format(text: str) -> str:
    """What a link sends, as `Telemetry.format` names it."""
    return "mavlink" if text.startswith(_MAVLINK) else "nmea"


# ---- inside: the wires ----------------------------------------------------------------------------------------


def _opener(address: str) -> Callable[[], Wire]:
    """How to open a link; the address is checked at once."""
    wire = address.removeprefix(_MAVLINK)
    scheme, _, rest = wire.partition(":")
    if scheme == "serial":
        device, _, query = rest.partition("?")
        return _serial_opener(device, dict(parse_qsl(query)))
    if scheme == "follow":
        path = Path(rest)
        if not path.is_file():
            raise InputError(
                f"--telemetry {address}: no such file; give the log that is being written"
            )
        return lambda: _FollowedLog(path)
    try:
        parts = urlsplit(wire)
        host, port = parts.hostname or "", parts.port
    except ValueError as error:
        raise InputError(
            f"--telemetry {address}: no address ({error}); give {LINK_FORMS}"
        ) from error
    if port is None or scheme not in ("tcp", "udp") or (scheme == "tcp" and not host):
        raise InputError(f"--telemetry {address}: no link; give {LINK_FORMS}")
    if scheme == "udp":
        end = b"" if wire is not address else b"\r\n"  # which a datagram of sentences may lack
        return lambda: _Socket(_bound(host, port), end)
    return lambda: _Socket(socket.create_connection((host, port), timeout=_CALL_S))


def _serial_opener(device: str, options: Mapping[str, str]) -> Callable[[], Wire]:
    try:
        import serial
    except ImportError as error:
        raise SettingsError(
            "reading a serial port needs pyserial: pip install 'sorvolo[serial]'"
        ) from error
    try:
        baud = int(options.get("baud", _DEFAULT_BAUD))
    except ValueError as error:
        raise InputError(
            f"serial:{device}: baud={options['baud']} is no number; give for instance 9600"
        ) from error
    if unknown := set(options) - {"baud"}:
        raise InputError(f"serial:{device}: unknown option {sorted(unknown)[0]}; give ?baud=9600")
    if not Path(device).exists():
        raise InputError(
            f"no such serial port: {device or '(nothing)'}; plug the receiver in, or give another"
        )
    return lambda: _Serial(serial.Serial(device, baud, timeout=_POLL_S))  # its errors are OSError


def _bound(host: str, port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError:
        listener.close()
        raise
    return listener


class _Socket:
    def __init__(self, wire: socket.socket, datagram_end: bytes | None = None) -> None:
        self._wire, self._end = wire, datagram_end
        self.close = wire.close

    def read(self) -> bytes | None:
        if not select.select([self._wire], [], [], _POLL_S)[0]:
            return b""
        data = self._wire.recv(65_536)
        if not data:
            return None if self._end is None else b""
        return data + (self._end or b"")


class _Serial:
    def __init__(self, port: Any) -> None:
        self._port, self.close = port, port.close

    def read(self) -> bytes | None:
        return bytes(self._port.read(max(1, self._port.in_waiting)))


class _FollowedLog:
    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self.close = self._file.close

    def read(self) -> bytes | None:
        data = self._file.read(65_536)
        if not data:
            time.sleep(_POLL_S)
        return data
