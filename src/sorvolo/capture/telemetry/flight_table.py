"""Flight tables with named columns: DatCon's, which the UMCD dataset has (thesis Table 2.2), Airdata's, DJI's logs."""

import csv
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from itertools import islice

import numpy as np

from sorvolo.capture.telemetry.cleaning import (
    NO_TIME_NS,
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
from sorvolo.geometry.pose import body_angles_deg
from sorvolo.geometry.summary import median_or_nan
from sorvolo.geometry.units import SECOND_NS
from sorvolo.survey.flight import Notice, Telemetry

_STORED = tomllib.loads(
    files("sorvolo.capture.telemetry").joinpath("flight_table.toml").read_text(encoding="utf-8")
)
COLUMN_NAMES: Mapping[str, list[str]] = _STORED["names"]
"""What each quantity's column may be called: lower case without blanks and punctuation, best first."""

COUNTERS = ("offset_time", "flight_time", "flown_time", "time", "tick")
"""The columns that count time from some moment, the most trusted first."""

_UNITS = {
    quantity: {**_STORED["units"].get(kind, {}), **own}
    for quantity, (kind, own) in _STORED["units_of"].items()
}
_HEIGHT_OR_GIMBAL = re.compile(
    r"(?!.*(max|home|limit|valid|mode|speed)).*(altitude|height|ascent|elevation)"
    r"|gimbal(?!is).*(pitch|roll|yaw|heading|tilt)(?!atlimit)"
)
_PUNCTUATION = re.compile(r"[\s_#:.\-\xa0]+")


def plain_name(cell: str) -> tuple[str, str]:
    """A header's cell as plain name and unit: "velN(M/S)" and "velN [m/s]" are ("veln", "m/s")."""
    label, _, rest = cell.replace("[", "(").replace("]", ")").partition("(")
    return _PUNCTUATION.sub("", label).lower(), rest.partition(")")[0].strip().lower()


_HEADER_LINES = 40  # some programs write a preamble before the header
_DATASET_RATE_HZ = 10.0  # thesis, section 2.2
# DatCon's Tick# is the flight controller's counter, of later drones or of the Phantom 3. DatCon writes 200 rows a
# second at most: the step between rows shows which it is, and a smaller one counts rows.
_TICK_RATES_HZ = ((20_000.0, 4_500_000.0), (3.0, 600.0))
# DJI's apps write the height above take-off into the column of altitudes as well
_SAME_HEIGHT_M = 1.5
_LONGEST_HEADER = 20_000  # characters; a log of hundreds of columns has thousands; by choice
_LARGEST_S = 1e9  # a counter beyond thirty years is broken
_EPOCH_S = (3e8, 7e9)  # 1979 to 2191: what a number must be to count as a time since 1970
_LINE = re.compile(r"[^\r\n]+")
_DAY = re.compile(r"(\d{1,4})[/.-](\d{1,2})[/.-](\d{1,4})")
_CLOCK = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})([.,]\d{1,9})?\s*([AP]M)?", re.IGNORECASE)
_CLOCK_NAME = re.compile(r"time|date|utc|stamp|clock|second|tick", re.IGNORECASE)
_SLOWEST_S = 20.0  # between the rows of a log: counts of more are of milliseconds
_UNKNOWN_WORDS = {"", "nan", "na", "n/a", "null", "none", "-", "--"}

_DIRECT_COLUMNS = {
    "latitude": "latitude_deg",
    "longitude": "longitude_deg",
    "altitude": "orthometric_height_m",
    "relative_height": "height_above_takeoff_m",
    "speed": "speed_m_s",
    "course": "course_deg",
    **{key: f"{key}_deg" for key in COLUMN_NAMES if key.startswith(("camera_", "body_"))},
}


@dataclass(frozen=True)
class _Table:
    """The table as texts: which cell of a row holds each quantity, its factor to our unit, and the rows.

    Rows hold the wanted columns only: a log has up to 230. `clocks` are the names of all columns that may hold times.
    """

    name: str
    clocks: list[str]
    cells: Mapping[str, int]
    factors: Mapping[str, float]
    is_utc: bool
    rows: list[list[str]]
    notices: list[Notice]


@dataclass(frozen=True)
class _Header:
    """The line with the columns' names: where the rows begin, the delimiter, each column's name as it is written, and
    its plain name and unit."""

    rows_from: int
    delimiter: str
    cells: list[str]
    columns: list[tuple[str, str]]


def recognises(head: bytes) -> bool:
    """Whether one of the file's first lines names a latitude and a longitude column."""
    return _header(text_from_bytes(head)) is not None


def read(data: bytes, name: str) -> Telemetry:
    """The samples of a table with named columns, in any order; unknown columns are ignored.

    Units printed in the header are converted; without one they are deg, m, m/s and s (ms for flightTime).
    gpsAltitude is stored as orthometric, relativeHeight as above take-off; a column of altitudes that repeats the
    height above take-off is left out. Times: a column of dates where there is one, else offsetTime, flightTime or
    Tick# (600 a second, DatCon's) from 1970-01-01, the first sample at the video's first frame. `name` is for
    messages. Raises InputError when there is no such table or no usable row.
    """
    table = _table(text_from_bytes(data), name)
    numbers = {
        key: _numbers(table, key) for key in table.cells if key not in ("utc", "time", "date")
    }
    if "time" in table.cells:
        numbers["time"] = _numbers(table, "time", is_text_allowed=True)
    unreadable = np.zeros(len(table.rows), dtype=np.bool_)
    for _, bad in numbers.values():
        unreadable |= bad
    columns, notices = _columns({key: values for key, (values, _) in numbers.items()})
    times_ns, video_ns, clock = _times(
        table, {key: numbers[key][0] for key in COUNTERS if key in numbers}
    )
    return clean(
        "table",
        name,
        times_ns,
        columns,
        video_ns,
        notices=[
            *table.notices,
            *notice(
                "unreadable_line", int(unreadable.sum()), "{} rows have cells that are no numbers"
            ),
            *clock,
            *notices,
        ],
        position_decimals=_position_decimals(table),
    )


def _split(line: str, delimiter: str) -> list[str]:
    """The cells of one line; line by line, so that a stray quote cannot swallow the rest of the file."""
    if '"' not in line:
        return line.split(delimiter)
    try:
        return next(csv.reader([line], delimiter=delimiter), [])
    except csv.Error:
        return line.split(delimiter)


def _header(text: str) -> _Header | None:
    """The header; None without one."""
    for line in islice(_LINE.finditer(text), _HEADER_LINES):
        for delimiter in (",", ";", "\t"):
            if delimiter not in line[0] or len(line[0]) > _LONGEST_HEADER:
                continue
            cells = _split(line[0], delimiter)
            columns = [plain_name(cell) for cell in cells]
            plain = {column for column, _ in columns}
            if plain.intersection(COLUMN_NAMES["latitude"]) and plain.intersection(
                COLUMN_NAMES["longitude"]
            ):
                return _Header(line.end(), delimiter, cells, columns)
    return None


def _table(text: str, name: str) -> _Table:
    header = _header(text)
    if header is None:
        raise InputError(
            f"{name}: no header line with Latitude and Longitude columns; add one, "
            "separated by commas, semicolons or tabs"
        )
    places, factors, notices = _known_columns(header)
    if "latitude" not in places or "longitude" not in places:
        raise InputError(
            f"{name}: {notices[0].text}; latitude and longitude must be in degrees or radians"
        )
    is_utc = "utc" in places and bool(re.search("utc|gps", " ".join(header.columns[places["utc"]])))
    rows, found = _rows(text, header, places, name)
    clocks = [cell.strip() for cell in header.cells if _CLOCK_NAME.search(cell)]
    cells = {key: index for index, key in enumerate(places)}
    return _Table(name, clocks, cells, factors, is_utc, rows, notices + found)


def _known_columns(header: _Header) -> tuple[dict[str, int], dict[str, float], list[Notice]]:
    """Where each known quantity stands and its factor to our unit; columns of unknown units are named."""
    places: dict[str, int] = {}
    factors: dict[str, float] = {}
    notices: list[Notice] = []
    labels = [column for column, _ in header.columns]
    for key, names in COLUMN_NAMES.items():
        label = next((each for each in names if each in labels), None)
        if label is None:
            continue
        unit = header.columns[labels.index(label)][1]
        factor = _UNITS.get(key, _STORED["units"]["degrees"]).get(unit)
        if factor is None:
            notices += notice(
                "unknown_unit", 1, f"column {label} is not used: its unit ({unit}) is unknown"
            )
        else:
            places[key], factors[key] = labels.index(label), factor
    # names columns of heights and of the gimbal that nothing reads, where what they may
    # hold is not read either
    known = {name for names in COLUMN_NAMES.values() for name in names}
    has_heights = "relative_height" in places and "altitude" in places
    has_gimbal = "camera_pitch" in places
    names = [
        cell.strip()
        for cell, (label, _) in zip(header.cells, header.columns)
        if label not in known
        and _HEIGHT_OR_GIMBAL.match(label)
        and not (has_gimbal if label.startswith("gimbal") else has_heights)
    ]
    words = "columns that seem to hold heights or the gimbal's angles are not understood: "
    return (
        places,
        factors,
        notices + notice("unknown_column", len(names), words + ", ".join(names[:6])),
    )


def _rows(
    text: str, header: _Header, places: Mapping[str, int], name: str
) -> tuple[list[list[str]], list[Notice]]:
    """The cells at `places` of the rows that reach the position's columns, decimal commas made points."""
    rows: list[list[str]] = []
    position = [places["latitude"], places["longitude"]]
    needed = 1 + max(position)
    short = split = width = 0
    for line in _LINE.finditer(text, header.rows_from):
        if not line[0].strip():
            continue
        cells = [each.strip().replace(",", ".") for each in _split(line[0], header.delimiter)]
        width = len(cells)
        if width < needed:
            short += 1
        elif width > len(header.columns) and not any("." in cells[place] for place in position):
            split += 1
        else:
            rows.append([cells[place] if place < width else "" for place in places.values()])
    if split > len(rows):
        raise InputError(
            f"{name}: {split} rows have more cells than the header has names, and no decimals in their positions: decimal "
            "commas in a table separated by commas; save it with semicolons or decimal points"
        )
    # a last line without its end that lacks cells was being written when the recording stopped
    is_cut = 0 < width < len(header.columns) and text[-1] not in "\r\n"
    if is_cut and width >= needed:
        rows.pop()
    return rows, [
        *notice("truncated", int(is_cut), "the last row is cut off"),
        *notice(
            "short_row",
            short - (is_cut and width < needed),
            "{} rows dropped: they end before the position",
        ),
    ]


def _texts(table: _Table, key: str) -> list[str]:
    place = table.cells[key]
    return [row[place] for row in table.rows]


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
    columns = {
        _DIRECT_COLUMNS[key]: values for key, values in numbers.items() if key in _DIRECT_COLUMNS
    }
    if _repeats_height(columns):
        del columns["orthometric_height_m"]
    notices: list[Notice] = []
    if not _has_numbers(columns, "height_above_takeoff_m") and _has_numbers(numbers, "barometer"):
        barometer = numbers["barometer"]
        known = np.flatnonzero(np.isfinite(barometer))
        columns["height_above_takeoff_m"] = barometer - barometer[known[0]]
        notices += notice(
            "height_from_barometer",
            len(known),
            "no relativeHeight: heights are baroAlt above the first sample, perhaps not above take-off",
        )
    if "velocity_north" in numbers and "velocity_east" in numbers:
        north, east = numbers["velocity_north"], numbers["velocity_east"]
        columns["speed_m_s"] = np.hypot(north, east)
        columns["course_deg"] = np.degrees(np.arctan2(east, north)) % 360
    stated = {key: values for key, values in columns.items() if _has_numbers(columns, key)}
    return _attitude_of(numbers) | stated, notices


def _attitude_of(numbers: Mapping[str, Floats]) -> dict[str, Floats]:
    """The body's angles from its quaternion, where there is a whole one."""
    parts = [numbers[f"quaternion_{axis}"] for axis in "wxyz" if f"quaternion_{axis}" in numbers]
    if len(parts) < 4:
        return {}
    norm = np.sqrt(sum(each * each for each in parts))
    with np.errstate(divide="ignore", invalid="ignore"):  # NaN for no rotation
        parts = [np.where(np.abs(norm - 1) < 0.1, each / norm, np.nan) for each in parts]
    angles_deg = body_angles_deg(*parts)
    return {**angles_deg, "body_yaw_deg": angles_deg["body_yaw_deg"] % 360}


def _has_numbers(columns: Mapping[str, Floats], key: str) -> bool:
    return key in columns and bool(np.isfinite(columns[key]).any())


def _repeats_height(columns: Mapping[str, Floats]) -> bool:
    """Whether the altitudes are the heights above take-off once more."""
    if "orthometric_height_m" not in columns or "height_above_takeoff_m" not in columns:
        return False
    apart_m = np.abs(columns["orthometric_height_m"] - columns["height_above_takeoff_m"])
    known = np.isfinite(apart_m)
    return bool(known.any() and (apart_m[known] <= _SAME_HEIGHT_M).all())


def _times(
    table: _Table, counters: Mapping[str, Floats]
) -> tuple[TimesNs, TimesNs | None, list[Notice]]:
    """Each row's time, its time in the video where the table is tied to one, and the notices."""
    rows, zoned = len(table.rows), 0
    unknown_ns = np.full(rows, NO_TIME_NS)
    stamps_ns, of_day_ns = unknown_ns.copy(), unknown_ns
    for key in ("utc", "time"):
        if key not in table.cells or (stamps_ns != NO_TIME_NS).any():
            continue
        days = _texts(table, "date") if "date" in table.cells else [""] * rows
        clock_s = np.full(rows, np.nan)
        for row, (day, text) in enumerate(zip(days, _texts(table, key))):
            clock_s[row] = _of_day_s(text)
            if dated_ns := _dated_ns(f"{day} {text}".strip()):
                stamps_ns[row] = dated_ns
            elif stamp := time_ns_from_text(text):
                stamps_ns[row] = stamp[0]
                zoned += stamp[1]
            elif epoch_ns := _epoch_ns(text, table.factors[key]):
                stamps_ns[row] = epoch_ns
                zoned += 1
        known = np.isfinite(clock_s)
        if known.any():  # it goes on past midnight
            of_day_ns = unknown_ns.copy()
            of_day_ns[known] = np.round(np.unwrap(clock_s[known], period=86_400) * SECOND_NS)
    counter_ns = _counter(counters, rows)
    known = counter_ns != NO_TIME_NS
    if median_or_nan(np.diff(counter_ns[known])) > _SLOWEST_S * SECOND_NS:
        raise InputError(
            f"{table.name}: its times are more than {_SLOWEST_S:g} s apart; if a column counts milliseconds, name it "
            "time(ms)"
        )
    stamped = int((stamps_ns != NO_TIME_NS).sum())
    if stamped:
        times_ns, refined = refine_clock(fill_stamps(stamps_ns, counter_ns), counter_ns)
        return (
            times_ns,
            None,
            [
                *notice(
                    "time_zone_unknown",
                    0 if table.is_utc else stamped - zoned,
                    "{} rows print a time without its zone; it is taken as UTC and may be hours off",
                ),
                *notice(
                    "clock_refined",
                    rows if refined else 0,
                    "times are printed in whole seconds; the {} rows are timed by the finer counter instead",
                ),
                *_untimed(times_ns),
            ],
        )
    notices = notice(
        "no_date",
        rows,
        "the table has no date: its {} rows take the video's if it has one, else 1970",
    )
    if known.any():
        first_ns = counter_ns[increasing(counter_ns)][0]
        relative_ns = np.where(known, counter_ns - first_ns, NO_TIME_NS)
        notices += _untimed(relative_ns)
    elif of_day_ns is not unknown_ns:
        return of_day_ns, None, notices + _untimed(of_day_ns)
    elif table.clocks and rows:
        raise InputError(
            f"{table.name}: no time can be read in {', '.join(table.clocks[:5])}; name the column time(s) or time(ms), or "
            "datetime with texts such as 2026-04-02 12:44:00.5"
        )
    else:
        relative_ns = np.round(np.arange(rows) * (SECOND_NS / _DATASET_RATE_HZ)).astype(np.int64)
        notices += notice(
            "assumed_rate",
            rows,
            f"the table has no column of times: its {{}} rows are taken as {_DATASET_RATE_HZ:g} a second",
        )
    return relative_ns, relative_ns, notices


def _untimed(times_ns: TimesNs) -> list[Notice]:
    lost = int((times_ns == NO_TIME_NS).sum())
    return notice("no_time", lost, "{} rows dropped: no readable time")


def _of_day_s(clock: str) -> float:
    """Seconds since midnight of "9:19:31.7 PM", NaN for another text."""
    match = _CLOCK.fullmatch(clock)
    if match is None:
        return float("nan")
    hour, half = int(match[1]), (match[5] or "").upper()
    if half:
        hour = hour % 12 + (12 if half == "PM" else 0)
    return hour * 3600 + int(match[2]) * 60 + float(match[3] + (match[4] or ""))


def _dated_ns(text: str) -> int:
    """The moment of a date and a clock, "7/4/2018" (month first) or "4.7.2018" and "9:19:31.7 PM"; 0 for another text."""
    day, _, clock = text.partition(" ")
    date, clock_s = _DAY.fullmatch(day), _of_day_s(clock)
    if date is None or np.isnan(clock_s):
        return 0
    year, month, of_month = (
        (date[3], date[2], date[1]) if "." in day else (date[3], date[1], date[2])
    )
    if len(date[1]) == 4:
        year, month, of_month = date.groups()
    midnight = time_ns_from_text(f"{year}-{month}-{of_month} 00:00:00")
    return midnight[0] + round(clock_s * SECOND_NS) if midnight else 0


def _epoch_ns(text: str, factor: float) -> int:
    """Nanoseconds of a number since 1970, in the header's unit or the one that fits its size; 0 if it is none."""
    try:
        seconds = float(text) * factor
    except ValueError:
        return 0
    for scale in (1.0, 1e-3, 1e-6, 1e-9):
        if _EPOCH_S[0] <= seconds * scale <= _EPOCH_S[1]:
            return round(seconds * scale * SECOND_NS)
    return 0


def _counter(counters: Mapping[str, Floats], rows: int) -> TimesNs:
    """The counter with most distinct times in order, in ns."""
    best, most = np.full(rows, NO_TIME_NS), 0
    for key, values in counters.items():
        seconds = values / _tick_rate_hz(values) if key == "tick" else values
        known = np.isfinite(seconds) & (np.abs(seconds) < _LARGEST_S)
        counter_ns = np.full(rows, NO_TIME_NS)
        counter_ns[known] = np.round(seconds[known] * 1e6).astype(np.int64) * 1000
        rising = int(increasing(counter_ns).sum())
        if rising > most:
            best, most = counter_ns, rising
    return best


def _tick_rate_hz(ticks: Floats) -> float:
    """DatCon's rate, or, where ticks count rows, the dataset's."""
    steps = np.diff(ticks[np.isfinite(ticks)])
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    return next((rate for least, rate in _TICK_RATES_HZ if step >= least), step * _DATASET_RATE_HZ)


def _position_decimals(table: _Table) -> int | None:
    if table.factors["latitude"] != 1 or not table.rows:
        return None
    printed = max(
        decimals_of(text) for key in ("latitude", "longitude") for text in _texts(table, key)
    )
    return printed or None
