"""DJI's and Autel's subtitles: one cue a frame or a second, in the dialects that a dozen drones have written."""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sorvolo.capture.telemetry.cleaning import (
    NO_TIME_NS,
    clean,
    decimals_of,
    fill_stamps,
    notice,
    refine_clock,
    text_from_bytes,
    time_ns_from_text,
)
from sorvolo.errors import InputError
from sorvolo.geometry.units import SECOND_NS
from sorvolo.survey.flight import Telemetry

SMALLEST_SIGMA_M = 1.5
"""Horizontal sigma of a consumer drone's GPS in hover, which no number of printed decimals improves."""

_MOST_CUES = 1_000_000  # four and a half hours at 60 frames a second
_LONGEST_CUE = 4000  # characters; drones write up to 600

_CUE = re.compile(r"(\d{1,3}):(\d{2}):(\d{2})[,.](\d{1,3})[ \t]*-->")
# a line of an .ass file: layer, start, end, style, name, three margins, effect, text
_DIALOGUE = re.compile(
    r"^Dialogue:[^,\n]*,\s*(\d:\d{2}:\d{2}\.\d{2}),(?:[^,\n]*,){7}", re.MULTILINE
)
_TELEMETRY = re.compile(
    r"\b(?:(?:GPS|HOME)\s*\(|(?:latitude|FrameCnt|SrtCnt)\s*:|BAROMETER\s*[:(])", re.IGNORECASE
)
# Every pattern wants something behind its last digit: the last cue of a half-written file may end within a
# number.
_PAIR = re.compile(r"[\[\s]([A-Za-z_]+)\s?:\s?([-+]?\d+(?:\.\d+)?)(?=[^\d.])")
_GPS = re.compile(r"\bGPS\s*\(([^()\n]{0,80})\)")
_COORDINATE = re.compile(r"(?:([NSEW])\s*:?\s*)?([-+]?\d+(?:\.\d*)?)\s*([mM]?)")
_BAROMETER = re.compile(r"\bBAROMETER\s*\(\s*([-+]?\d+(?:\.\d+)?)\s*[mM]?\s*\)")
_HEIGHT = re.compile(r"(?<![\w.])H\s([-+]?\d+(?:\.\d+)?)m\b")
_SPEED = re.compile(r"\bH\.S\s([-+]?\d+(?:\.\d+)?)m/s")
_ANGLES = re.compile(r"\b([FG])\.PRY\s*\(([^()\n]{0,60})\)")
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
_COLUMN_OF_KEY = {
    "latitude": "latitude_deg",
    "longitude": "longitude_deg",
    "longtitude": "longitude_deg",  # sic, in the Mavic 2's firmware
    "rel_alt": "height_above_takeoff_m",
    "barometer": "height_above_takeoff_m",
    "hb": "height_above_takeoff_m",
    "reh": "height_above_takeoff_m",
    "abs_alt": "orthometric_height_m",
    "altitude": "orthometric_height_m",
    "gb_yaw": "camera_yaw_deg",
    "gb_pitch": "camera_pitch_deg",
    "gb_roll": "camera_roll_deg",
    "drone_yaw": "body_yaw_deg",
    "drone_pitch": "body_pitch_deg",
    "drone_roll": "body_roll_deg",
}


class _Place(NamedTuple):
    """One GPS(...) group: its first three values, and how they are ordered."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    decimals: int
    is_latitude_first: bool


@dataclass
class _Cue:
    """One subtitle: when it shows, when it was taken, and its numbers."""

    video_time_ns: int
    stamp_ns: int
    values: dict[str, float]


def recognises(head: bytes) -> bool:
    """Whether the file's first bytes hold a subtitle's times and any of DJI's keys."""
    text = _subtitles(head)
    return _CUE.search(text) is not None and _TELEMETRY.search(text) is not None


def read(data: bytes, name: str) -> Telemetry:
    """The samples of a subtitle file, .srt or .ass, one per cue; `video_time_ns` is the cue's start.

    rel_alt, BAROMETER, Hb and H are heights above take-off; abs_alt and altitude, which DJI calls absolute,
    are stored as orthometric. Dates name no time zone and are taken as UTC. `name` is for messages. Raises
    InputError when no cue states a position or an attitude.
    """
    text = _subtitles(data)
    counts: Counter[str] = Counter()
    decimals = [0]
    cues = [_cue(match, body, counts, decimals) for match, body in _cues_in(text, name)]
    if not cues:
        raise InputError(f"{name}: no subtitle times (00:00:01,000 --> 00:00:02,000) in it")
    if not cues[-1].values and any(cue.values for cue in cues):
        counts["truncated"] = 1
        cues.pop()
    # the Matrice 300 and the Mavic 2 print an absolute height of 0.0 throughout when they have none
    if not any(cue.values.get("orthometric_height_m") for cue in cues):
        for cue in cues:
            cue.values.pop("orthometric_height_m", None)
    video_ns = np.array([cue.video_time_ns for cue in cues], dtype=np.int64)
    stamps_ns = np.array([cue.stamp_ns for cue in cues], dtype=np.int64)
    times_ns, refined = refine_clock(fill_stamps(stamps_ns, video_ns), video_ns)
    dated = int((stamps_ns != NO_TIME_NS).sum())
    names = sorted({key for cue in cues for key in cue.values})
    columns = {key: np.array([cue.values.get(key, np.nan) for cue in cues]) for key in names}
    if "latitude_deg" in columns:
        placed = np.isfinite(columns["latitude_deg"])
        columns["horizontal_sigma_m"] = np.where(placed, SMALLEST_SIGMA_M, np.nan)
    return clean(
        "dji_srt",
        name,
        times_ns,
        columns,
        video_ns,
        notices=[
            *notice("truncated", counts["truncated"], "the last cue is cut off"),
            *notice(
                "time_zone_unknown",
                dated - counts["zoned"],
                "{} cues print a time without its zone; it is taken as UTC and may be hours off",
            ),
            *notice(
                "no_date",
                len(cues) - dated,
                "{} cues print no date; they are stamped by their place in the video"
                + ("" if dated else ", which dates them, else they count from 1970-01-01"),
            ),
            *notice(
                "clock_refined",
                len(cues) if refined else 0,
                "times are printed in whole seconds; the {} samples are timed by their cues instead",
            ),
            *notice(
                "latitude_first",
                counts["latitude_first"],
                "{} positions are followed by a height: such files put latitude before longitude",
            ),
        ],
        position_decimals=max(decimals) or None,
    )


def _subtitles(data: bytes) -> str:
    """The file's text, the cues of an .ass written as those of an .srt."""
    text = text_from_bytes(data)
    if "Dialogue:" not in text:
        return text
    return _DIALOGUE.sub(r"\1 -->\n", text).replace("\\N", "\n")


def _cues_in(text: str, name: str) -> Iterator[tuple[re.Match[str], str]]:
    """Each cue's times and the text behind them, as far as any drone's reaches."""
    before = None
    for count, match in enumerate(_CUE.finditer(text)):
        if count >= _MOST_CUES:
            raise InputError(
                f"{name}: more than {_MOST_CUES} subtitles; no flight has so many, cut the file"
            )
        if before is not None:
            yield before, text[before.end() : min(match.start(), before.end() + _LONGEST_CUE)]
        before = match
    if before is not None:
        yield before, text[before.end() : before.end() + _LONGEST_CUE]


def _cue(match: re.Match[str], body: str, counts: Counter[str], decimals: list[int]) -> _Cue:
    hours, minutes, seconds, fraction = match.groups()
    start_s = int(hours) * 3600 + int(minutes) * 60 + int(seconds)
    stamp = time_ns_from_text(body)
    counts["zoned"] += bool(stamp and stamp[1])
    values: dict[str, float] = {}
    for key, number in _PAIR.findall(body):
        column = _COLUMN_OF_KEY.get(key.lower())
        if column is None:
            continue
        values[column] = float(number)
        if column == "longitude_deg":
            decimals[0] = max(decimals[0], decimals_of(number))
    group = _GPS.search(body) if "GPS" in body else None
    if group:
        values |= _values_in_words(body)
    if group and (place := _place(group[1])):
        values |= {"latitude_deg": place.latitude_deg, "longitude_deg": place.longitude_deg}
        if np.isfinite(place.height_m):
            values.setdefault("orthometric_height_m", place.height_m)
        decimals[0] = max(decimals[0], place.decimals)
        counts["latitude_first"] += place.is_latitude_first
    video_ns = start_s * SECOND_NS + int(fraction.ljust(3, "0")) * 1_000_000
    return _Cue(video_ns, stamp[0] if stamp else NO_TIME_NS, values)


def _values_in_words(body: str) -> dict[str, float]:
    """What stands without a colon: "BAROMETER(91.2)", "H 200.70m, H.S 2.1m/s, F.PRY (2.7, -7.0, 110.1)"."""
    values = {}
    if height := _HEIGHT.search(body) or _BAROMETER.search(body):
        values["height_above_takeoff_m"] = float(height[1])
    if speed := _SPEED.search(body):
        values["speed_m_s"] = float(speed[1])
    for which, angles in _ANGLES.findall(body):
        numbers = _NUMBER.findall(angles)
        if len(numbers) == 3:
            part = "body" if which == "F" else "camera"
            for axis, number in zip(("pitch", "roll", "yaw"), numbers):
                values[f"{part}_{axis}_deg"] = float(number)
    return values


def _place(group: str) -> _Place | None:
    """The place in GPS(...); None where it is N/A.

    Letters decide the order, then a value beyond 90, which is a longitude. Else the third value does: a whole
    number is the count of satellites, in files that put longitude first; a height ("0.0M", the Matrice 300)
    comes after latitude and longitude.
    """
    parts = [
        match for match in map(_COORDINATE.fullmatch, map(str.strip, group.split(","))) if match
    ]
    if len(parts) < 2 or len(parts) != group.count(",") + 1:
        return None
    first, second = parts[0], parts[1]
    has_height = len(parts) > 2 and bool(parts[2][3] or "." in parts[2][2])
    has_letters = bool(first[1] or second[1])
    is_latitude_first = _latitude_comes_first(first, second, has_height=has_height)
    latitude, longitude = (first, second) if is_latitude_first else (second, first)
    return _Place(
        _signed(latitude),
        _signed(longitude),
        height_m=float(parts[2][2]) if has_height else float("nan"),
        decimals=max(decimals_of(first[2]), decimals_of(second[2])),
        is_latitude_first=is_latitude_first and not has_letters,
    )


def _latitude_comes_first(first: re.Match[str], second: re.Match[str], *, has_height: bool) -> bool:
    if first[1] or second[1]:
        return first[1] in ("N", "S") or second[1] in ("E", "W")
    if max(abs(float(first[2])), abs(float(second[2]))) > 90:
        return abs(float(first[2])) <= 90
    return has_height


def _signed(part: re.Match[str]) -> float:
    return -float(part[2]) if part[1] in ("S", "W") else float(part[2])
