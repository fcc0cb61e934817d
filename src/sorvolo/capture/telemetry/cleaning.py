"""What every telemetry reader shares: text from bytes, clocks, honest sigmas, and the one cleaning step."""

import re
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TypeAlias

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, Mask, Rows, TimesNs
from sorvolo.geometry.summary import median_or_nan
from sorvolo.geometry.units import M_PER_DEG_LATITUDE, SECOND_NS
from sorvolo.survey.flight import Notice, Telemetry

M_PER_HDOP = 1.5
"""Horizontal sigma (m, per axis) of one unit of HDOP: a receiver's range error without corrections."""

SMALLEST_HDOP_SIGMA_M = 0.5
"""What remains of a receiver's error however good its satellites stand."""

NO_TIME_NS = -(2**62)
"""Stands for a time that is not known while a file is read; no such sample leaves a reader."""

FASTEST_M_S = 80.0
"""No small drone flies faster over ground (the fastest in a storm reach about 60 m/s)."""

_Table: TypeAlias = dict[str, Floats]

_JUMP_SLACK_M = 10.0  # receivers step this far when their set of satellites changes
_HELD_FIX_S = 1.0  # a receiver that repeats its fix made it at most this long ago
_COARSE_DECIMALS = 4  # at five decimals the rounding (1.1 m) is below the receiver's own noise
_MIRRORED_DEG = (
    0.02  # that positions lie about the mirror of the others, whose signs are then in question ...
)
_MANY_MIRRORED = 0.1  # ... if they are more than this share: a few are glitches
_SEGMENTS_BACK = 200  # of a track that jumps: bounds the time that a hostile file takes
_TIME = re.compile(
    r"(\d{4})[-./](\d{1,2})[-./](\d{1,2})[ T]+(\d{1,2}):(\d{2}):(\d{2})"
    r"(?:[.,](\d{1,9})(?:,(\d{1,3}))?)?\s*(Z|UTC|[+-]\d{2}:?\d{2})?",
    re.IGNORECASE,
)
# lowest and highest believable value; what lies outside is a broken sensor or a broken line
_LIMITS: Mapping[str, tuple[float, float]] = {
    "latitude_deg": (-90, 90),
    "longitude_deg": (-360, 360),
    "ellipsoidal_height_m": (-1000, 50_000),
    "orthometric_height_m": (-1000, 50_000),
    "height_above_takeoff_m": (-10_000, 50_000),
    "horizontal_sigma_m": (0, 1e6),
    "vertical_sigma_m": (0, 1e6),
    "camera_yaw_deg": (-720, 720),
    "camera_pitch_deg": (-360, 360),
    "camera_roll_deg": (-360, 360),
    "body_yaw_deg": (-720, 720),
    "body_pitch_deg": (-360, 360),
    "body_roll_deg": (-360, 360),
    "tilt_sigma_deg": (0, 180),
    "heading_sigma_deg": (0, 180),
    "course_deg": (-720, 720),
    "speed_m_s": (0, 1000),
}


def clean(
    reader: str,
    name: str,
    time_ns: Sequence[int] | TimesNs,
    columns: Mapping[str, Sequence[float] | Floats],
    video_time_ns: Sequence[int] | TimesNs | None = None,
    notices: Sequence[Notice] = (),
    position_decimals: int | None = None,
) -> Telemetry:
    """The samples of one file as Telemetry, with what is wrong in them removed, counted and reported.

    `reader` is the format's name, `name` the file's (for messages). `time_ns` (N,) may hold NO_TIME_NS. The
    steps: values outside any believable range, 0/0 fixes and half positions become NaN; samples whose clock
    runs backward or stands still are dropped; fixes that imply more than FASTEST_M_S become NaN; gaps are
    counted. `notices` are the reader's own and come first. `position_decimals`, the decimals of a degree
    that the file prints, keeps `horizontal_sigma_m` at least as large as their rounding. Raises InputError
    when no sample has any value.
    """
    found = list(notices)
    times = np.asarray(time_ns, dtype=np.int64)
    table = {key: np.array(value, dtype=np.float64) for key, value in columns.items()}
    video = np.asarray(
        np.full(len(times), -1) if video_time_ns is None else video_time_ns, dtype=np.int64
    )

    keep = increasing(times)
    if 2 * keep.sum() < len(keep) and (flipped := increasing(times[::-1])).sum() > keep.sum():
        # the newest sample first
        times, video, keep = times[::-1], video[::-1], flipped
        table = {key: value[::-1] for key, value in table.items()}
    found += _clock_notices(times, keep)
    times, video = times[keep], video[keep]
    table = {key: value[keep] for key, value in table.items()}

    count, kept = 0, {}
    for key, values in table.items():
        low, high = _LIMITS[key]
        bad = ~np.isnan(values) & ~((values >= low) & (values <= high))
        count += int(bad.sum())
        kept[key] = np.where(bad, np.nan, values)
    if "longitude_deg" in kept:
        longitude = kept["longitude_deg"]
        kept["longitude_deg"] = np.where(
            np.abs(longitude) > 180, (longitude + 180) % 360 - 180, longitude
        )
    table = kept
    reported = notice(
        "out_of_range",
        count,
        "{} values lie outside any possible range and are taken as unknown",
    )
    found += reported
    if "latitude_deg" in table and "longitude_deg" in table:
        table, reported = _cleaned_fixes(times, table, position_decimals, name)
        found += reported
    if not any(np.isfinite(value).any() for key, value in table.items() if "_sigma_" not in key):
        found_text = "; ".join(notice.text for notice in found) or "it holds no samples"
        raise InputError(
            f"{name}: no usable {reader} telemetry sample ({found_text}); "
            "give another file with --telemetry, or map without telemetry"
        )
    found += _gaps(times, table.get("latitude_deg"))
    return Telemetry(reader, times, table, video, tuple(found))


def _cleaned_fixes(
    times: TimesNs, table: _Table, decimals: int | None, name: str
) -> tuple[_Table, list[Notice]]:
    """The table with only the fixes that the flight made, their sigma no smaller than their rounding."""
    latitude, longitude = table["latitude_deg"], table["longitude_deg"]
    unknown = np.isnan(latitude) | np.isnan(longitude)
    null = (np.abs(latitude) < 1e-6) & (np.abs(longitude) < 1e-6)
    table = _without_fixes(table, unknown | null)
    found = [
        *notice("no_fix", int(unknown.sum()), "{} samples have no position"),
        *notice(
            "null_fix",
            int(null.sum()),
            "{} positions are 0/0, written before the receiver's first fix",
        ),
    ]
    if decimals is not None and decimals <= _COARSE_DECIMALS:
        # per axis: the step of the last decimal of a degree / sqrt 12
        rounding = float(10.0**-decimals * M_PER_DEG_LATITUDE / np.sqrt(12))
        placed = np.isfinite(table["latitude_deg"])
        sigma = table.get("horizontal_sigma_m", np.full(len(placed), np.nan))
        widened = {**table, "horizontal_sigma_m": np.where(placed, np.fmax(sigma, rounding), sigma)}
        text = (
            f"positions are printed with {decimals} decimals of a degree, in steps of "
            f"{10.0**-decimals * M_PER_DEG_LATITUDE:.3g} m; their uncertainty is set to at least {rounding:.2g} m"
        )
        table, rounded = widened, notice("coarse_position", int(placed.sum()), text)
        found += rounded
    cleaned, jumps = _without_jumps(times, table)
    # a sign that is lost on the way: which half of the world is right, the longer part does not decide
    kept = np.isfinite(cleaned["latitude_deg"])
    lost = np.isfinite(table["latitude_deg"]) & ~kept
    for column in ("latitude_deg", "longitude_deg"):
        middle = median_or_nan(table[column][kept])
        mirrored = int((np.abs(table[column][lost] + middle) < _MIRRORED_DEG).sum())
        if abs(middle) > _MIRRORED_DEG and mirrored > _MANY_MIRRORED * len(kept):
            raise InputError(
                f"{name}: {mirrored} of {len(kept)} positions have the other sign of {column.removesuffix('_deg')}, "
                f"{-middle:+.3f} where the rest have {middle:+.3f}; correct the sign, or leave these positions out"
            )
    return cleaned, found + jumps


def increasing(times_ns: TimesNs) -> Mask:
    """Which of the times, shape (N,), form the longest strictly increasing run; NO_TIME_NS never does.

    Unlike comparing with the time before, one wrong clock far in the future does not cost all that follows.
    """
    known = np.flatnonzero(times_ns != NO_TIME_NS)
    keep = np.zeros(len(times_ns), dtype=np.bool_)
    values = times_ns[known]
    if (np.diff(values) > 0).all():
        keep[known] = True
        return keep
    tails: list[int] = []  # tails[k]: smallest last time of an increasing run of k + 1 samples
    last: list[int] = []  # the sample where that run ends
    before = np.full(len(values), -1)
    for index, value in enumerate(values.tolist()):
        place = bisect_left(tails, value)
        before[index] = last[place - 1] if place else -1
        if place == len(tails):
            tails.append(value)
            last.append(index)
        elif tails[place] != value:  # of equal times the first sample stays
            tails[place], last[place] = value, index
    index = last[-1] if last else -1
    while index >= 0:
        keep[known[index]] = True
        index = int(before[index])
    return keep


def text_from_bytes(data: bytes) -> str:
    """The file's text: UTF-8 or UTF-16 by its byte order mark, else Latin-1, which reads any byte."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1").removeprefix("ï»¿")


def time_ns_from_text(text: str) -> tuple[int, bool] | None:
    """The first "2021-12-25 12:27:52.373" in the text, and whether it names its zone; None if there is none.

    Also with dots or slashes, `T`, a comma before the fraction or within it ("08,438,904"), `Z` or an
    offset. Without a zone the time is taken as UTC. A date outside 1970-2200 is a broken clock and counts
    as none.
    """
    match = _TIME.search(text)
    if match is None:
        return None
    try:
        moment = datetime(*(int(match[group]) for group in range(1, 7)), tzinfo=UTC)  # type: ignore[arg-type,misc]
    except ValueError:
        return None
    if not 1970 <= moment.year <= 2200:
        return None
    fraction = ((match[7] or "") + (match[8] or ""))[:9].ljust(9, "0")
    time_ns = int(moment.timestamp()) * SECOND_NS + int(fraction)
    zone = (match[9] or "").upper()
    if zone[:1] in ("+", "-"):
        offset_min = int(zone[1:3]) * 60 + int(zone[-2:])
        time_ns -= (1 if zone[0] == "+" else -1) * offset_min * 60 * SECOND_NS
    return time_ns, bool(zone)


def fill_stamps(stamps_ns: TimesNs, counter_ns: TimesNs) -> TimesNs:
    """The stamps, shape (N,), with missing ones placed by the counter after the stamped sample before them.

    Samples before the first stamp are placed before it; without any stamp the counter itself comes back.
    """
    stamped = np.flatnonzero((stamps_ns != NO_TIME_NS) & (counter_ns != NO_TIME_NS))
    if not len(stamped):
        return np.where(stamps_ns == NO_TIME_NS, counter_ns, stamps_ns)
    near = stamped[
        np.clip(np.searchsorted(stamped, np.arange(len(stamps_ns)), side="right") - 1, 0, None)
    ]
    filled = stamps_ns[near] - counter_ns[near] + counter_ns
    return np.where((stamps_ns == NO_TIME_NS) & (counter_ns != NO_TIME_NS), filled, stamps_ns)


def refine_clock(stamps_ns: TimesNs, counter_ns: TimesNs) -> tuple[TimesNs, bool]:
    """Times of samples whose clock prints whole seconds, from a finer counter; and whether that was possible.

    A sample a frame with the time in whole seconds would leave one sample a second. Where clock and
    counter, both (N,), run together to within 1.5 s over the whole file, the counter is set to the clock's
    median; else, or where the clock is finer than seconds, the stamps come back as they are.
    """
    known = (stamps_ns != NO_TIME_NS) & (counter_ns != NO_TIME_NS)
    if not known.all() or not len(known) or (stamps_ns % SECOND_NS != 0).any():
        return stamps_ns, False
    offsets = stamps_ns - counter_ns
    middle = int(np.sort(offsets)[len(offsets) // 2])
    if (np.abs(offsets - middle) > 1.5 * SECOND_NS).any() or (offsets == middle).all():
        return stamps_ns, False
    return counter_ns + middle, True


def decimals_of(text: str) -> int:
    """How many digits the number prints after its decimal point."""
    return len(text.partition(".")[2].rstrip())


def sigma_from_hdop_m(hdop: float) -> float:
    """Horizontal standard deviation in m, per axis, for a dilution of precision; NaN where it is unknown."""
    return max(hdop * M_PER_HDOP, SMALLEST_HDOP_SIGMA_M) if hdop > 0 else float("nan")


def notice(code: str, count: int, text: str) -> list[Notice]:
    """The notice in a list, or an empty list when the count is 0; "{}" in the text becomes the count."""
    return [Notice(code, count, text.replace("{}", str(count)))] if count else []


def _clock_notices(times: TimesNs, keep: Mask) -> list[Notice]:
    dropped = times[~keep & (times != NO_TIME_NS)]
    if not len(dropped):
        return []
    twice = int(np.isin(dropped, times[keep]).sum())
    return [
        *notice("duplicate_time", twice, "{} samples dropped: another one has the same time"),
        *notice(
            "backward_time", len(dropped) - twice, "{} samples dropped: their clock runs backward"
        ),
    ]


def _without_fixes(table: _Table, rows: Mask | Rows) -> _Table:
    """The table with the positions of some rows unknown."""
    latitude, longitude = table["latitude_deg"].copy(), table["longitude_deg"].copy()
    latitude[rows] = longitude[rows] = np.nan
    return {**table, "latitude_deg": latitude, "longitude_deg": longitude}


def _without_jumps(times: TimesNs, table: _Table) -> tuple[_Table, list[Notice]]:
    """The table without the fixes that do not belong to the largest set of fixes that one flight can have made.

    Fixes that follow each other at less than FASTEST_M_S form segments; segments chain when the last fix of
    one and the first of the other fit the same way. The chain with most fixes is the flight, wherever it
    starts, and however long the run of bad fixes within it.
    """
    latitude, longitude = table["latitude_deg"], table["longitude_deg"]
    fixes = np.flatnonzero(np.isfinite(latitude))
    if len(fixes) < 2:
        return table, []
    lat = latitude[fixes]
    lon = longitude[fixes]
    seconds = (times[fixes] - times[fixes[0]]) / SECOND_NS
    sigma = np.nan_to_num(table.get("horizontal_sigma_m", np.zeros(len(times)))[fixes])
    fresh = np.concatenate([[True], (np.diff(lat) != 0) | (np.diff(lon) != 0)])
    starts = np.flatnonzero(fresh)  # one run per distinct fix, from its first sample to its last
    ends = np.concatenate([starts[1:], [len(fixes)]]) - 1
    repeats = len(fixes) - len(starts)
    found = notice(
        "repeated_fix",
        repeats if 10 * repeats > len(fixes) else 0,
        f"{{}} samples repeat the position before; distinct fixes: {len(starts)}",
    )

    def fits(old: Rows, new: Rows) -> Mask:
        turn = (lon[starts[new]] - lon[starts[old]] + 180) % 360 - 180
        scale = np.cos(np.radians((lat[starts[new]] + lat[starts[old]]) / 2))
        distance_m = (
            np.hypot(lat[starts[new]] - lat[starts[old]], turn * scale) * M_PER_DEG_LATITUDE
        )
        made = np.maximum(seconds[starts[old]], seconds[ends[old]] - _HELD_FIX_S)
        slack_m = _JUMP_SLACK_M + 3 * (sigma[starts[new]] + sigma[starts[old]])
        return distance_m <= FASTEST_M_S * (seconds[starts[new]] - made) + slack_m

    runs = np.arange(len(starts))
    broken = np.flatnonzero(~fits(runs[:-1], runs[1:])) + 1
    if not len(broken):
        return table, found
    first = np.concatenate([[0], broken])  # of each segment: its first and last run
    final = np.concatenate([broken, [len(starts)]]) - 1
    size = ends[final] - starts[first] + 1
    best, before = size.copy(), np.full(len(first), -1)
    for segment in range(1, len(first)):
        earlier = np.arange(max(0, segment - _SEGMENTS_BACK), segment)
        reach = np.where(fits(final[earlier], first[segment]), best[earlier], 0)
        if reach.max() > 0:
            before[segment] = earlier[int(np.argmax(reach))]
            best[segment] += reach.max()
    flight = np.zeros(len(fixes), dtype=np.bool_)
    segment = int(np.argmax(best))
    while segment >= 0:
        flight[starts[first[segment]] : ends[final[segment]] + 1] = True
        segment = int(before[segment])
    text = f"{{}} positions jump away faster than {FASTEST_M_S:g} m/s and are not used"
    return _without_fixes(table, fixes[~flight]), found + notice("jump", int((~flight).sum()), text)


def _gaps(times: TimesNs, latitude: Floats | None) -> list[Notice]:
    placed = (
        times
        if latitude is None or not np.isfinite(latitude).any()
        else times[np.isfinite(latitude)]
    )
    steps_s = np.diff(placed) / SECOND_NS
    if not len(steps_s):
        return []
    gaps = steps_s[steps_s > max(3 * float(np.median(steps_s)), 2.0)]
    text = f"gaps in the positions: {{}}, the longest {gaps.max(initial=0.0):.1f} s"
    return notice("gap", len(gaps), text)
