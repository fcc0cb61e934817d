"""Logs of autopilots: PX4's .ulg (pyulog), ArduPilot's .bin, a ground station's .tlog and MAVLink live (pymavlink)."""

import contextlib
import io
import struct
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np

from sorvolo.capture.telemetry.cleaning import clean, notice, sigma_from_hdop_m
from sorvolo.capture.telemetry.nmea import Epoch
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.pose import body_angles_deg
from sorvolo.survey.flight import Notice, Telemetry

_ULOG = b"ULog\x01\x12\x35"  # PX4's developer guide, "ULog File Format"
_ULOG_HEAD, _MOST_AGAIN = 3, 1000  # bytes before each message; reads of one at a place again
_DATAFLASH = b"\xa3\x95\x80"  # the first message describes its own format
_MARKERS = {0xFE: (8, 0), 0xFD: (12, 13)}  # MAVLink 1, 2: bytes but the payload, and of a signature
_DATED_US = 946_684_800_000_000, 4_102_444_800_000_000  # a ground station's clock, 2000 to 2100
_FIX_3D = 3  # of both autopilots
_NEAR_S = 0.5  # from a fix to the attitude and height beside it
_TIMED_MS = 3000  # of positions without a date, then the vehicle states none: autopilots send it each second

_Sender = tuple[int, int]
"""A MAVLink system and its component: beside an autopilot, a gimbal or a computer may be of its system."""


@dataclass
class _Rows:
    """One kind of message: times, s, and values by column."""

    time_s: list[float] = field(default_factory=list)
    columns: dict[str, list[float]] = field(default_factory=dict)

    def add(self, time_s: float, **values: float) -> None:
        self.time_s.append(time_s)
        for name, value in values.items():
            self.columns.setdefault(name, []).append(float(value))

    def near(self, time_s: Floats) -> dict[str, Floats]:
        """The values of the nearest message to each moment, (N,) s; NaN where none is near."""
        if not self.time_s:
            return {}
        order = np.argsort(self.time_s, kind="stable")
        own_s = np.array(self.time_s)[order]
        after = np.clip(np.searchsorted(own_s, time_s), 1, max(1, len(own_s) - 1))
        before = np.maximum(after - 1, 0)
        after = np.minimum(after, len(own_s) - 1)
        row = np.where(time_s - own_s[before] <= own_s[after] - time_s, before, after)
        is_near = np.abs(own_s[row] - time_s) <= _NEAR_S
        return {
            name: np.where(is_near, np.array(values)[order][row], np.nan)
            for name, values in self.columns.items()
        }


def _telemetry(
    reader: str,
    name: str,
    fixes: _Rows,
    *beside: _Rows,
    dated: bool,
    notices: Sequence[Notice] = (),
) -> Telemetry:
    """The fixes with attitudes and heights of the same moments."""
    if not fixes.time_s:
        raise InputError(
            f"{name}: the log has no 3D fix of a GPS receiver; give another log with --telemetry, or map without"
        )
    time_s = np.array(fixes.time_s)
    columns = {key: np.array(values) for key, values in fixes.columns.items()}
    for rows in beside:
        columns |= rows.near(time_s)
    words = "the log has no date: the video dates the {} samples, else they count from 1970-01-01"
    undated = notice("no_date", 0 if dated else len(time_s), words)
    return clean(
        reader, name, np.round(time_s * 1e9).astype(np.int64), columns, notices=[*undated, *notices]
    )


def _needed(name: str, kind: str) -> InputError:
    return InputError(f"{name} is {kind}, which needs an extra: pip install 'sorvolo[logs]'")


class _OnwardBytes(io.BytesIO):
    """A file that ends a reading which does not get on: pyulog goes round for ever at the end of some cut logs."""

    farthest = again = 0

    def read(self, size: int | None = -1, /) -> bytes:
        if size == _ULOG_HEAD:
            self.again += self.tell() <= self.farthest
            self.farthest = max(self.farthest, self.tell())
            if self.again > _MOST_AGAIN:
                raise EOFError("it ends within a message")
        return super().read(size)


class UlogReader:
    """PX4's log: the receiver's fixes, the estimator's attitude and its height above where it began."""

    def recognises(self, head: bytes) -> bool:
        """Whether the file begins as a ULog does."""
        return head.startswith(_ULOG)

    def read(self, data: bytes, name: str) -> Telemetry:
        """One sample a fix. Raises InputError without the extra `logs`, for a damaged log and one without fixes."""
        try:
            from pyulog.core import ULog
        except ImportError as error:
            raise _needed(name, "a PX4 log (.ulg)") from error
        topics = ["vehicle_gps_position", "vehicle_attitude", "vehicle_local_position"]
        try:
            with _quiet():
                log = ULog(_OnwardBytes(data), topics)
        except Exception as error:  # it raises whatever damaged bytes lead to
            raise InputError(f"{name}: a damaged PX4 log ({error}); copy it again") from error
        found: dict[str, Mapping[str, Floats]] = {}
        for topic in log.data_list:
            found.setdefault(topic.name, topic.data)
        gps = found.get("vehicle_gps_position", {})
        boot_us = np.asarray(gps.get("timestamp", ()), np.float64)
        utc_us = np.asarray(gps.get("time_utc_usec", np.zeros(len(boot_us))), np.float64)
        is_dated = bool((utc_us > _DATED_US[0]).any())
        zero_us = -float(log.start_timestamp)
        if is_dated:
            known = utc_us > _DATED_US[0]
            zero_us = float(np.median((utc_us - boot_us)[known]))
        fixes, attitude, height = _Rows(), _Rows(), _Rows()
        for row in np.flatnonzero(np.asarray(gps.get("fix_type", ())) >= _FIX_3D).tolist():
            fixes.add((boot_us[row] + zero_us) / 1e6, **_ulog_fix(gps, row))
        turned = found.get("vehicle_attitude", {})
        for row, time_us in enumerate(turned.get("timestamp", ())):
            turn = (float(turned[f"q[{each}]"][row]) for each in range(4))
            attitude.add((time_us + zero_us) / 1e6, **body_angles_deg(*turn))
        local = found.get("vehicle_local_position", {})
        for row, time_us in enumerate(local.get("timestamp", ())):
            above_m = float(local["z"][0] - local["z"][row])
            height.add((time_us + zero_us) / 1e6, height_above_takeoff_m=above_m)
        return _telemetry("ulog", name, fixes, attitude, height, dated=is_dated)


def _ulog_fix(gps: Mapping[str, Floats], row: int) -> dict[str, float]:
    """A fix in degrees and metres; logs before PX4 1.14 count in 1e-7 deg and mm."""

    def value(new: str, old: str, unit: float) -> float:
        if new in gps:
            return float(gps[new][row])
        return float(gps[old][row]) * unit if old in gps else float("nan")

    return {
        "latitude_deg": value("latitude_deg", "lat", 1e-7),
        "longitude_deg": value("longitude_deg", "lon", 1e-7),
        "orthometric_height_m": value("altitude_msl_m", "alt", 1e-3),
        "ellipsoidal_height_m": value("altitude_ellipsoid_m", "alt_ellipsoid", 1e-3),
        "horizontal_sigma_m": value("eph", "", 1.0),
        "vertical_sigma_m": value("epv", "", 1.0),
        "speed_m_s": value("vel_m_s", "", 1.0),
    }


class DataflashReader:
    """ArduPilot's log on board: the first receiver's fixes, attitude, and height above home."""

    def recognises(self, head: bytes) -> bool:
        """Whether the file begins as a DataFlash log does."""
        return head.startswith(_DATAFLASH)

    def read(self, data: bytes, name: str) -> Telemetry:
        """One sample a fix. Raises InputError without the extra `logs`, for a damaged log and one without fixes."""
        try:
            from pymavlink.DFReader import DFReader_binary
        except ImportError as error:
            raise _needed(name, "an ArduPilot log (.bin)") from error
        fixes, attitude, height = _Rows(), _Rows(), _Rows()
        with tempfile.NamedTemporaryFile(suffix=".bin") as file, _quiet():
            file.write(data)  # the library reads files alone
            file.flush()
            try:
                log = DFReader_binary(file.name)
                while (message := log.recv_match(type=["GPS", "ATT", "POS"])) is not None:
                    # add a message where it belongs; `_timestamp` is UTC by the receiver's
                    # clock
                    time_s, kind = float(message._timestamp), message.get_type()
                    if kind == "GPS" and message.Status >= _FIX_3D and not getattr(message, "I", 0):
                        fixes.add(
                            time_s,
                            latitude_deg=message.Lat,
                            longitude_deg=message.Lng,
                            orthometric_height_m=message.Alt,
                            horizontal_sigma_m=sigma_from_hdop_m(message.HDop),
                            speed_m_s=message.Spd,
                            course_deg=message.GCrs,
                        )
                    elif kind == "ATT":
                        attitude.add(
                            time_s,
                            body_yaw_deg=message.Yaw,
                            body_pitch_deg=message.Pitch,
                            body_roll_deg=message.Roll,
                        )
                    elif kind == "POS" and hasattr(message, "RelHomeAlt"):
                        height.add(time_s, height_above_takeoff_m=message.RelHomeAlt)
            except Exception as error:  # it raises whatever damaged bytes lead to
                raise InputError(f"{name}: a damaged ArduPilot log; copy it again") from error
            finally:
                with contextlib.suppress(Exception):
                    log.close()
        is_dated = bool(fixes.time_s) and fixes.time_s[0] * 1e6 > _DATED_US[0]
        return _telemetry("dataflash", name, fixes, attitude, height, dated=is_dated)


class TlogReader:
    """What a ground station recorded of MAVLink: positions and attitudes on the autopilot's own clock."""

    def recognises(self, head: bytes) -> bool:
        """Whether the file begins with three packets, each after a ground station's time."""
        starts = [start for start, _, _ in _packets(head, limit=3)]
        return starts[:1] == [0] and len(starts) == 3

    def read(self, data: bytes, name: str) -> Telemetry:
        """One sample a position. Raises InputError without the extra `logs` and for a log without positions."""
        try:
            from pymavlink.dialects.v20 import ardupilotmega
        except ImportError as error:
            raise _needed(name, "a MAVLink log (.tlog)") from error
        fixes, attitude = _Rows(), _Rows()
        clocks_s: dict[_Sender, list[float]] = {}
        vehicle = _Vehicle()  # one log may hold several
        for message in _messages(data, ardupilotmega):
            kind, is_own = message.get_type(), vehicle.owns(message)
            if kind == "SYSTEM_TIME" and message.time_unix_usec > _DATED_US[0]:
                ahead_s = message.time_unix_usec / 1e6 - message.time_boot_ms / 1e3
                clocks_s.setdefault(_sender(message), []).append(ahead_s)
            elif not is_own:
                continue
            elif kind == "GLOBAL_POSITION_INT":
                fixes.add(message.time_boot_ms / 1e3, **_position(message))
            elif kind == "ATTITUDE":
                attitude.add(message.time_boot_ms / 1e3, **_attitude(message))
        own_s = clocks_s.get(vehicle.sender) if vehicle.sender else None
        zero_s = float(np.median(own_s)) if own_s else 0.0
        for rows in (fixes, attitude):
            rows.time_s = [each + zero_s for each in rows.time_s]
        words = "other vehicles in the log, not used: {}"
        more = notice("other_vehicle", len(vehicle.others), words)
        return _telemetry("tlog", name, fixes, attitude, dated=bool(own_s), notices=more)


def _sender(message: Any) -> _Sender:
    return message.get_srcSystem(), message.get_srcComponent()


class _Vehicle:
    """The first sender of a position; `owns` finds it, and counts others that send positions as well."""

    def __init__(self) -> None:
        self.sender: _Sender | None = None
        self.others: set[_Sender] = set()

    def owns(self, message: Any) -> bool:
        """Whether it sent this message."""
        sender, is_position = _sender(message), message.get_type() == "GLOBAL_POSITION_INT"
        if is_position and self.sender is None and message.lat:
            self.sender = sender
        if is_position and self.sender not in (None, sender):
            self.others.add(sender)
        return sender == self.sender


def _position(message: Any) -> dict[str, float]:
    """The columns of a GLOBAL_POSITION_INT."""
    return {
        "latitude_deg": message.lat * 1e-7 or float("nan"),
        "longitude_deg": message.lon * 1e-7 or float("nan"),
        "orthometric_height_m": message.alt * 1e-3,
        "height_above_takeoff_m": message.relative_alt * 1e-3,
        "speed_m_s": float(np.hypot(message.vx, message.vy)) * 1e-2,
    }


def _attitude(message: Any) -> dict[str, float]:
    """The columns of an ATTITUDE."""
    angles = np.degrees([message.yaw, message.pitch, message.roll]).tolist()
    return dict(zip(("body_yaw_deg", "body_pitch_deg", "body_roll_deg"), angles))


class MavlinkBuffer:
    """A vehicle's MAVLink as it comes, to moments. `take` changes it; what is damaged is counted in `counts`.

    The first vehicle that states a position is the one; others are counted. Its own clock counts the time, tied once:
    by its SYSTEM_TIME or, where none comes with its first positions, by when one of these came.
    """

    def __init__(self, counts: Counter[str]) -> None:
        try:
            from pymavlink.dialects.v20 import ardupilotmega
        except ImportError as error:
            raise _needed("mavlink:...", "a MAVLink link") from error
        self._counts, self._link = counts, ardupilotmega.MAVLink(None)
        self._link.robust_parsing = True
        self._vehicle = _Vehicle()
        self._first_ms, self._last_ms = 0, 2**32  # of the vehicle's clock, since it was switched on
        self._zero_ns: int | None = None  # UTC of that moment
        self._attitude: tuple[int, dict[str, float]] = (-(10**6), {})  # ms of the vehicle

    def take(self, data: bytes, utc_ns: int) -> list[Epoch]:
        """The positions in the bytes that came at about `utc_ns`, each with the attitude beside it."""
        epochs: list[Epoch] = []
        for message in self._link.parse_buffer(data) or ():
            kind = message.get_type()
            if kind == "BAD_DATA":
                self._counts["bad_packet"] += 1
                continue
            if not self._vehicle.owns(message):
                self._counts["other_vehicle"] = len(self._vehicle.others)
            elif kind == "SYSTEM_TIME" and message.time_unix_usec > _DATED_US[0]:
                if self._zero_ns is None:
                    self._zero_ns = message.time_unix_usec * 1000 - message.time_boot_ms * 10**6
            elif kind == "ATTITUDE":
                self._attitude = message.time_boot_ms, _attitude(message)
            elif kind == "GLOBAL_POSITION_INT":
                epochs += self._epoch(message, utc_ns)
        return epochs

    def _epoch(self, message: Any, utc_ns: int) -> list[Epoch]:
        """A position with its time; none while its clock is not tied yet."""
        boot_ms, (at_ms, angles) = message.time_boot_ms, self._attitude
        if boot_ms < self._last_ms - 1000 * _NEAR_S:  # its first position, or switched on anew
            self._zero_ns, self._first_ms = None, boot_ms
        self._last_ms = boot_ms
        if self._zero_ns is None:
            if boot_ms - self._first_ms < _TIMED_MS:
                return []
            self._zero_ns = utc_ns - boot_ms * 10**6
        is_near = abs(boot_ms - at_ms) <= _NEAR_S * 1e3
        values = _position(message) | (angles if is_near else {})
        return [Epoch(self._zero_ns + boot_ms * 10**6, values)]


def _packets(data: bytes, limit: int | None = None) -> Iterator[tuple[int, int, int]]:
    """Where each record begins, and its packet begins and ends; bytes that are none are passed over."""
    start = count = 0
    while start + 9 < len(data) and (limit is None or count < limit):
        (time_us,) = struct.unpack_from(">Q", data, start)
        sizes = _MARKERS.get(data[start + 8])
        end = len(data) + 1
        if sizes is not None and _DATED_US[0] < time_us < _DATED_US[1]:
            is_signed = sizes[1] and data[start + 10 : start + 11] > b"\0"
            end = start + 8 + data[start + 9] + sizes[0] + (sizes[1] if is_signed else 0)
        if end <= len(data):
            yield start, start + 8, end
            start, count = end, count + 1
        elif limit is not None:
            return
        else:
            start += 1


def _messages(data: bytes, dialect: ModuleType) -> Iterator[Any]:
    """The messages that are wanted of a ground station's record; a packet that does not check is left out."""
    link = dialect.MAVLink(None)
    wanted = {
        dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        dialect.MAVLINK_MSG_ID_ATTITUDE,
        dialect.MAVLINK_MSG_ID_SYSTEM_TIME,
    }
    for _, begin, end in _packets(data):
        number = (
            data[begin + 5]
            if data[begin] == 0xFE
            else int.from_bytes(data[begin + 7 : begin + 10], "little")
        )
        if number not in wanted:
            continue
        with contextlib.suppress(dialect.MAVError, struct.error):
            yield link.decode(bytearray(data[begin:end]))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Nothing of what the library prints about odd bytes reaches the user."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield


AUTOPILOT_READERS: Mapping[str, UlogReader | DataflashReader | TlogReader] = {
    "ulog": UlogReader(),
    "dataflash": DataflashReader(),
    "tlog": TlogReader(),
}
"""The readers by the name that `Telemetry.format` carries."""
