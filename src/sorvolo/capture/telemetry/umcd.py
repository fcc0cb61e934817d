"""The UMCD dataset's telemetry table (thesis Table 2.2) and other flight logs with named columns."""

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sorvolo.capture.telemetry.quality import (
    NO_TIME_NS,
    SECOND_NS,
    clean,
    decimals_of,
    fill_stamps,
    increasing,
    notice,
    refine_clock,
    text_from_bytes,
    time_ns_from_text,
)
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, Mask, TimesNs
from sorvolo.survey.flight import Notice, Telemetry

_HEADER_LINES = 40  # some programs write a preamble before the header
_DATASET_RATE_HZ = 10.0  # thesis, section 2.2
_LONGEST_HEADER = 20_000
_LARGEST_S = 1e9  # a counter beyond thirty years is broken
_EPOCH_S = (3e8, 7e9)  # 1979 to 2191: what a number must be to count as a time since 1970
_ODD = re.compile(r"[\s_#:.\-]+")
_UNKNOWN_WORDS = {"", "nan", "na", "n/a", "null", "none", "-", "--"}

# what each column may be called: lower case without blanks and punctuation, best first
_NAMES: Mapping[str, tuple[str, ...]] = {
    "latitude": ("latitude", "lat", "gpslat", "gpslatitude"),
    "longitude": ("longitude", "lon", "long", "lng", "gpslon", "gpslong", "gpslongitude"),
    "altitude": ("gpsaltitude", "altitudeabovesealevel", "altitudemsl", "abvsealevel"),
    "relative_height": ("relativeheight", "heightabovetakeoff", "relativealtitude", "relalt"),
    "barometer": ("baroalt",),
    "camera_yaw": ("gimbalyaw", "gimbalheading"),
    "camera_pitch": ("gimbalpitch",),
    "camera_roll": ("gimbalroll",),
    "body_yaw": ("yaw", "compassheading"),
    "body_pitch": ("pitch",),
    "body_roll": ("roll",),
    "velocity_north": ("veln", "velocitynorth"),
    "velocity_east": ("vele", "velocityeast"),
    "speed": ("groundspeed", "speed"),
    "course": ("course", "directionoftravel"),
    "quaternion_w": ("quatw",),
    "quaternion_x": ("quatx",),
    "quaternion_y": ("quaty",),
    "quaternion_z": ("quatz",),
    "offset_time": ("offsettime",),
    "flight_time": ("flighttime",),
    "time": ("time", "elapsedtime"),
    "tick": ("tick", "ticks"),
    "utc": ("gpsdatetimestamp", "datetimestamp", "datetimeutc", "utcdatetime", "datetime", "utc", "utctime",
            "gpstime", "timestamp"),
}
_COUNTERS = ("offset_time", "flight_time", "time", "tick")
# factors to deg, m, m/s and s of the units that headers print, lower case
_DEGREES = {"": 1.0, "degrees": 1.0, "degree": 1.0, "deg": 1.0, "°": 1.0,
            "radians": 180 / np.pi, "radian": 180 / np.pi, "rad": 180 / np.pi}
_METRES = {"": 1.0, "m": 1.0, "meters": 1.0, "metres": 1.0, "meter": 1.0, "metre": 1.0,
           "feet": 0.3048, "foot": 0.3048, "ft": 0.3048, "cm": 0.01, "centimeters": 0.01, "mm": 0.001,
           "km": 1000.0, "kilometers": 1000.0}
_METRES_A_SECOND = {"": 1.0, "m/s": 1.0, "mps": 1.0, "meters/s": 1.0, "km/h": 1 / 3.6, "kmh": 1 / 3.6,
                    "kph": 1 / 3.6, "mph": 0.44704, "knots": 1852 / 3600, "kn": 1852 / 3600,
                    "kt": 1852 / 3600, "feet/s": 0.3048, "ft/s": 0.3048, "cm/s": 0.01}
_SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "second": 1.0, "msec": 1e-3, "ms": 1e-3,
            "millisecond": 1e-3, "milliseconds": 1e-3, "usec": 1e-6, "us": 1e-6,
            "microseconds": 1e-6, "nsec": 1e-9, "ns": 1e-9, "minutes": 60.0, "min": 60.0}
_UNITS: Mapping[str, Mapping[str, float]] = {
    **dict.fromkeys(("altitude", "relative_height", "barometer"), _METRES),
    **dict.fromkeys(("velocity_north", "velocity_east", "speed"), _METRES_A_SECOND),
    **{f"quaternion_{axis}": {"": 1.0} for axis in "wxyz"},
    "tick": {"": 1.0},
    "offset_time": {"": 1.0, **_SECONDS},
    "flight_time": {"": 1e-3, **_SECONDS},
    "time": {"": 1.0, **_SECONDS},
    "utc": {"": 1.0, "utc": 1.0, "gps": 1.0, **_SECONDS},
}


@dataclass(frozen=True)
class _Table:
    """The table as texts: which cell of a row holds each quantity, its factor to our unit, and the rows."""

    cells: Mapping[str, int]
    factors: Mapping[str, float]
    is_utc: bool
    rows: list[list[str]]
    notices: list[Notice]


def recognises(head: bytes) -> bool:
    """Whether one of the file's first lines names a latitude and a longitude column."""
    return _header(_lines(text_from_bytes(head))) is not None


def read(data: bytes, name: str) -> Telemetry:
    """The samples of a table with named columns, in any order; unknown columns are ignored.

    Units printed in the header are converted; without one they are deg, m, m/s and s (ms for flightTime).
    gpsAltitude is stored as orthometric, relativeHeight as above take-off. Times: a column of dates where
    there is one, else offsetTime, flightTime or Tick# from 1970-01-01, the first sample at the video's
    first frame. `name` is for messages. Raises InputError when there is no such table or no usable row.
    """
    table = _table(text_from_bytes(data), name)
    numbers = {key: _numbers(table, key) for key in table.cells if key not in ("utc", "time")}
    if "time" in table.cells:
        numbers["time"] = _numbers(table, "time", is_text_allowed=True)
    unreadable = np.zeros(len(table.rows), dtype=np.bool_)
    for _, bad in numbers.values():
        unreadable |= bad
    columns, notices = _columns({key: values for key, (values, _) in numbers.items()})
    times_ns, video_ns, clock = _times(table, {key: numbers[key][0] for key in _COUNTERS if key in numbers})
    return clean(
        "umcd", name, times_ns, columns, video_ns,
        notices=[
            *table.notices,
            *notice("unreadable_line", int(unreadable.sum()), "{} rows have cells that are no numbers"),
            *clock,
            *notices,
        ],
        position_decimals=_position_decimals(table),
    )


def _lines(text: str) -> list[str]:
    return re.split(r"\r\n|\r|\n", text)


def _split(line: str, delimiter: str) -> list[str]:
    """The cells of one line; line by line, so that a stray quote cannot swallow the rest of the file."""
    if '"' not in line:
        return line.split(delimiter)
    try:
        return next(csv.reader([line], delimiter=delimiter), [])
    except csv.Error:
        return line.split(delimiter)


def _header(lines: list[str]) -> tuple[int, str, list[tuple[str, str]]] | None:
    """The header's line number, its delimiter, and each column's plain name and unit; None without one."""
    for number, line in enumerate(lines[:_HEADER_LINES]):
        for delimiter in (",", ";", "\t"):
            if delimiter not in line or len(line) > _LONGEST_HEADER:
                continue
            columns = [_plain(cell) for cell in _split(line, delimiter)]
            plain = {column for column, _ in columns}
            if plain.intersection(_NAMES["latitude"]) and plain.intersection(_NAMES["longitude"]):
                return number, delimiter, columns
    return None


def _plain(cell: str) -> tuple[str, str]:
    """("velN(M/S)") -> ("veln", "m/s")."""
    label, _, rest = cell.replace("[", "(").replace("]", ")").partition("(")
    return _ODD.sub("", label).lower(), rest.partition(")")[0].strip().lower()


def _table(text: str, name: str) -> _Table:
    lines = _lines(text)
    header = _header(lines)
    if header is None:
        raise InputError(
            f"{name}: no header line with Latitude and Longitude columns; add one, "
            "separated by commas, semicolons or tabs"
        )
    number, delimiter, columns = header
    cells: dict[str, int] = {}
    factors: dict[str, float] = {}
    notices: list[Notice] = []
    labels = [column for column, _ in columns]
    for key, names in _NAMES.items():
        label = next((each for each in names if each in labels), None)
        if label is None:
            continue
        unit = columns[labels.index(label)][1]
        factor = _UNITS.get(key, _DEGREES).get(unit)
        if factor is None:
            notices += notice("unknown_unit", 1, f"column {label} is ignored: its unit ({unit}) is not known")
            continue
        cells[key], factors[key] = labels.index(label), factor
    if "latitude" not in cells or "longitude" not in cells:
        raise InputError(f"{name}: {notices[0].text}; latitude and longitude must be in degrees or radians")
    is_utc = "utc" in cells and bool(re.search("utc|gps", " ".join(columns[cells["utc"]])))
    needed = 1 + max(cells["latitude"], cells["longitude"])
    rows, found = _rows(lines[number + 1:], delimiter, len(columns), needed)
    return _Table(cells, factors, is_utc, rows, notices + found)


def _rows(lines: list[str], delimiter: str, width: int, needed: int) -> tuple[list[list[str]], list[Notice]]:
    """The rows that reach the position's columns, decimal commas made points, and what was dropped."""
    rows = [(number, _split(line, delimiter)) for number, line in enumerate(lines) if line.strip()]
    notices: list[Notice] = []
    # a last line without its end that lacks cells was being written when the recording stopped
    if rows and rows[-1][0] == len(lines) - 1 and len(rows[-1][1]) < width:
        rows.pop()
        notices += notice("truncated", 1, "the last row is cut off")
    whole = [row for _, row in rows if len(row) >= needed]
    notices += notice("short_row", len(rows) - len(whole), "{} rows dropped: they end before the position")
    if delimiter != ",":
        whole = [[cell.replace(",", ".") for cell in row] for row in whole]
    return whole, notices


def _texts(table: _Table, key: str) -> list[str]:
    place = table.cells[key]
    return [row[place].strip() if place < len(row) else "" for row in table.rows]


def _numbers(table: _Table, key: str, is_text_allowed: bool = False) -> tuple[Floats, Mask]:
    """A column in our unit, NaN where unknown, and the rows whose cell is neither number nor "n/a"."""
    texts = _texts(table, key)
    bad = np.zeros(len(texts), dtype=np.bool_)
    values = np.full(len(texts), np.nan)
    for row, text in enumerate(texts):
        try:
            values[row] = float(text)
        except ValueError:
            bad[row] = not is_text_allowed and text.lower() not in _UNKNOWN_WORDS
    return values * table.factors[key], bad


def _columns(numbers: Mapping[str, Floats]) -> tuple[dict[str, Floats], list[Notice]]:
    """The telemetry's columns from the table's."""
    notices: list[Notice] = []
    direct = {
        "latitude": "latitude_deg", "longitude": "longitude_deg", "altitude": "orthometric_height_m",
        "relative_height": "height_above_takeoff_m", "speed": "speed_m_s", "course": "course_deg",
        **{key: f"{key}_deg" for key in _NAMES if key.startswith(("camera_", "body_"))},
    }
    columns = {direct[key]: values for key, values in numbers.items() if key in direct}
    if not np.isfinite(columns.get("height_above_takeoff_m", np.nan)).any() and "barometer" in numbers:
        barometer = numbers["barometer"]
        known = np.flatnonzero(np.isfinite(barometer))
        if len(known):
            columns["height_above_takeoff_m"] = barometer - barometer[known[0]]
            notices += notice(
                "height_from_barometer", len(known),
                "no relativeHeight: heights are baroAlt above the first sample, perhaps not above take-off",
            )
    if "velocity_north" in numbers and "velocity_east" in numbers:
        north, east = numbers["velocity_north"], numbers["velocity_east"]
        columns["speed_m_s"] = np.hypot(north, east)
        columns["course_deg"] = np.degrees(np.arctan2(east, north)) % 360
    quaternion = [numbers[f"quaternion_{axis}"] for axis in "wxyz" if f"quaternion_{axis}" in numbers]
    if len(quaternion) == 4:
        for key, values in zip(("body_yaw_deg", "body_pitch_deg", "body_roll_deg"), _angles(*quaternion)):
            if not np.isfinite(columns.get(key, np.nan)).any():
                columns[key] = values
    return columns, notices


def _angles(w: Floats, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
    """Yaw, pitch, roll (deg, z-y-x) of quaternions from body to north-east-down; NaN for no rotation."""
    norm = np.sqrt(w * w + x * x + y * y + z * z)
    with np.errstate(divide="ignore", invalid="ignore"):
        w, x, y, z = (np.where(np.abs(norm - 1) < 0.1, each / norm, np.nan) for each in (w, x, y, z))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return np.degrees(yaw) % 360, np.degrees(pitch), np.degrees(roll)


def _times(table: _Table, counters: Mapping[str, Floats]) -> tuple[TimesNs, TimesNs | None, list[Notice]]:
    """Each row's time, its time in the video where the table is tied to one, and what there is to say."""
    rows = len(table.rows)
    stamps_ns, zoned = _stamps(table)
    counter_ns = _counter(counters, rows)
    stamped = int((stamps_ns != NO_TIME_NS).sum())
    if stamped:
        times_ns, refined = refine_clock(fill_stamps(stamps_ns, counter_ns), counter_ns)
        return times_ns, None, [
            *notice(
                "time_zone_unknown", 0 if table.is_utc else stamped - zoned,
                "{} rows print a time without its zone; it is taken as UTC and may be hours off",
            ),
            *notice(
                "clock_refined", rows if refined else 0,
                "times are printed in whole seconds; the {} rows are timed by the finer counter instead",
            ),
            *notice("no_time", int((times_ns == NO_TIME_NS).sum()), "{} rows dropped: no readable time"),
        ]
    known = counter_ns != NO_TIME_NS
    notices = notice(
        "no_date", rows, "the table has no date: the video dates its {} rows, else they count from 1970-01-01"
    )
    if known.any():
        relative_ns = np.where(known, counter_ns - counter_ns[increasing(counter_ns)][0], NO_TIME_NS)
        notices += notice("no_time", int((~known).sum()), "{} rows dropped: no readable time")
    else:
        relative_ns = np.round(np.arange(rows) * (SECOND_NS / _DATASET_RATE_HZ)).astype(np.int64)
        notices += notice(
            "assumed_rate", rows,
            f"the table has no column of times: its {{}} rows are taken as {_DATASET_RATE_HZ:g} a second",
        )
    return relative_ns, relative_ns, notices


def _stamps(table: _Table) -> tuple[TimesNs, int]:
    """The rows' dates as UTC, NO_TIME_NS where there is none, and how many name their time zone."""
    zoned = 0
    stamps_ns = np.full(len(table.rows), NO_TIME_NS)
    for key in ("utc", "time"):
        if key not in table.cells or (stamps_ns != NO_TIME_NS).any():
            continue
        for row, text in enumerate(_texts(table, key)):
            if stamp := time_ns_from_text(text):
                stamps_ns[row] = stamp[0]
                zoned += stamp[1]
            elif epoch_ns := _epoch_ns(text, table.factors[key]):
                stamps_ns[row] = epoch_ns
                zoned += 1
    return stamps_ns, zoned


def _epoch_ns(text: str, factor: float) -> int:
    """Nanoseconds of a number since 1970, in the header's unit or the one its size tells; 0 if it is none."""
    try:
        seconds = float(text) * factor
    except ValueError:
        return 0
    for scale in (1.0, 1e-3, 1e-6, 1e-9):
        if _EPOCH_S[0] <= seconds * scale <= _EPOCH_S[1]:
            return round(seconds * scale * SECOND_NS)
    return 0


def _counter(counters: Mapping[str, Floats], rows: int) -> TimesNs:
    """The column that tells most rows apart, in ns; ticks have no known rate and get the dataset's."""
    best, most = np.full(rows, NO_TIME_NS), 0
    for key, values in counters.items():
        seconds = values
        if key == "tick":
            steps = np.diff(values[np.isfinite(values)])
            step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
            seconds = values / (step * _DATASET_RATE_HZ)
        known = np.isfinite(seconds) & (np.abs(seconds) < _LARGEST_S)
        counter_ns = np.full(rows, NO_TIME_NS)
        counter_ns[known] = np.round(seconds[known] * 1e6).astype(np.int64) * 1000
        rising = int(increasing(counter_ns).sum())
        if rising > most:
            best, most = counter_ns, rising
    return best


def _position_decimals(table: _Table) -> int | None:
    if table.factors["latitude"] != 1 or not table.rows:
        return None
    printed = max(decimals_of(text) for key in ("latitude", "longitude") for text in _texts(table, key))
    return printed or None
