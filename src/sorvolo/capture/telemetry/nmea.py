"""NMEA 0183: the GGA and RMC sentences of a GPS receiver, alone or embedded in another log."""

import re
from collections import Counter
from dataclasses import dataclass, field
from datetime import date, time
from functools import reduce
from operator import xor
from typing import Any

from pynmeagps import VALNONE, NMEAReader
from pynmeagps.exceptions import NMEAMessageError, NMEAParseError, NMEATypeError

from sorvolo.capture.telemetry.cleaning import clean, decimals_of, notice, sigma_from_hdop_m
from sorvolo.errors import InputError
from sorvolo.geometry.units import DAY_NS, KNOT_M_S, SECOND_NS
from sorvolo.survey.flight import Telemetry

# talkers differ by satellite system (GP, GN, GL, GA ...); a log may write anything before the dollar
_SENTENCE = re.compile(rb"\$([A-Z][A-Z0-9])(GGA|RMC),([^$*\r\n]*)(?:\*([0-9A-Fa-f]{2}))?")
_FINISHED = re.compile(rb"[\r\n]|\*[0-9A-Fa-f]{2}")
_LONGEST_TAIL = 200  # a sentence has at most 82 characters


@dataclass
class Epoch:
    """One moment's sentences as telemetry columns; no `values` where there was no fix."""

    time_ns: int
    values: dict[str, float] = field(default_factory=dict)
    kinds: set[str] = field(default_factory=set)
    has_fix: bool = True


def recognises(head: bytes) -> bool:
    """Whether the file's first bytes hold the start of a GGA or RMC sentence."""
    return _SENTENCE.search(head) is not None


def read(data: bytes, name: str) -> Telemetry:
    """The samples of a file of NMEA sentences; GGA and RMC of the same time make one sample.

    Altitude in GGA is above the geoid; with the geoid's separation it also gives the ellipsoidal height.
    HDOP becomes `horizontal_sigma_m` = max(HDOP * 1.5, 0.5). Quality 0 or status V is no fix. GGA has no
    date: the nearest one of RMC is used, across midnight. `name` is for messages. Raises InputError when no
    sentence is usable.
    """
    counts: Counter[str] = Counter()
    messages = messages_in(data, counts)
    if not messages:
        raise InputError(
            f"{name}: no intact GGA or RMC sentence ({counts['bad_checksum']} with a bad checksum, "
            f"{counts['no_time']} without a time, "
            f"{counts['unreadable_line'] + counts['truncated']} unreadable); "
            "record the receiver's output again, checksums included"
        )
    epochs, dated = epochs_of(messages)
    names = sorted({key for epoch in epochs for key in epoch.values})
    # Decimals of a degree that the positions' minutes amount to: 4 of a minute are about 6 of a
    # degree.
    printed = 0
    for message in messages[:1000]:
        place = 1 if message.msgID == "GGA" else 2
        printed = max([printed, *map(decimals_of, message.payload[place : place + 1])])
    return clean(
        "nmea",
        name,
        [epoch.time_ns for epoch in epochs],
        {key: [epoch.values.get(key, float("nan")) for epoch in epochs] for key in names},
        notices=[
            *notice(
                "bad_checksum",
                counts["bad_checksum"],
                "{} sentences dropped: bad or missing checksum",
            ),
            *notice(
                "unreadable_line", counts["unreadable_line"], "{} sentences dropped: not readable"
            ),
            *notice("truncated", counts["truncated"], "the last sentence is cut off"),
            *notice("no_time", counts["no_time"], "{} sentences dropped: no readable time"),
            *notice(
                "no_date",
                0 if dated else len(epochs),
                "no sentence states the date: the video dates the {} samples, else they count from 1970-01-01",
            ),
        ],
        position_decimals=printed + 2 if printed else None,
    )


def messages_in(data: bytes, counts: Counter[str]) -> list[Any]:
    """The intact GGA and RMC sentences in the bytes that state a time; what is wrong with others is counted."""
    messages = []
    tail = data[data.rfind(b"$") :]
    is_cut = tail.startswith(b"$") and len(tail) < _LONGEST_TAIL and not _FINISHED.search(tail)
    counts["truncated"] += is_cut
    for match in _SENTENCE.finditer(data[: len(data) - len(tail)] if is_cut else data):
        talker, kind, body, checksum = match.groups()
        content = talker + kind + b"," + body
        if checksum is None or reduce(xor, content) != int(checksum, 16):
            counts["bad_checksum"] += 1
            continue
        try:
            message = NMEAReader.parse(b"$" + content + b"*" + checksum + b"\r\n", validate=VALNONE)
        except (NMEAMessageError, NMEAParseError, NMEATypeError):
            message = None
        if message is None or not body.isascii():
            counts["unreadable_line"] += 1
        elif isinstance(getattr(message, "time", None), time):
            messages.append(message)
        else:
            counts["no_time"] += 1  # a receiver that has just been switched on
    return messages


def epochs_of(messages: list[Any]) -> tuple[list[Epoch], bool]:
    """The sentences by moment, in the file's order, and whether any of them states the date."""
    # The sentences whose date can be trusted: a receiver without a fix often invents its date.
    dated = [message for message in messages if isinstance(getattr(message, "date", None), date)]
    trusted = [message for message in dated if _is_valid(message)] or dated
    days = {id(message) for message in trusted}
    now_ns = _stamp(trusted[0]) if trusted else _time_of_day_ns(messages[0])
    epochs: list[Epoch] = []
    for message in messages:
        now_ns = (
            _stamp(message) if id(message) in days else nearest_ns(_time_of_day_ns(message), now_ns)
        )
        if not epochs or epochs[-1].time_ns != now_ns or message.msgID in epochs[-1].kinds:
            epochs.append(Epoch(now_ns))
        epochs[-1].kinds.add(message.msgID)
        # add a sentence's values to its moment; a GGA's position goes before an RMC's
        epoch = epochs[-1]
        if message.msgID == "GGA":
            epoch.has_fix &= getattr(message, "quality", 0) != 0
            altitude_m, separation_m = _number(message, "alt"), _number(message, "sep")
            values = {
                "latitude_deg": _degrees(message, "lat", "NS"),
                "longitude_deg": _degrees(message, "lon", "EW"),
                "orthometric_height_m": altitude_m,
                "ellipsoidal_height_m": altitude_m + separation_m,
                "horizontal_sigma_m": sigma_from_hdop_m(_number(message, "HDOP")),
            }
        else:
            epoch.has_fix &= _is_valid(message)
            values = {
                "speed_m_s": _number(message, "spd") * KNOT_M_S,
                "course_deg": _number(message, "cog"),
            }
            if "GGA" not in epoch.kinds:
                values |= {
                    "latitude_deg": _degrees(message, "lat", "NS"),
                    "longitude_deg": _degrees(message, "lon", "EW"),
                }
        epoch.values |= values
    for epoch in epochs:
        if not epoch.has_fix:
            epoch.values = {}
    return epochs, bool(trusted)


def _is_valid(message: Any) -> bool:
    """Whether an RMC sentence states a fix; one that was cut before its status states none."""
    return getattr(message, "status", "") == "A"


def _number(message: Any, attribute: str) -> float:
    value = getattr(message, attribute, "")  # fields that are empty or not sent come as ""
    return float(value) if isinstance(value, int | float) else float("nan")


def _degrees(message: Any, attribute: str, letter: str) -> float:
    """A coordinate; NaN for one without its N, S, E or W, whose sign nobody knows."""
    return _number(message, attribute) if getattr(message, letter, "") else float("nan")


def _time_of_day_ns(message: Any) -> int:
    moment: time = message.time
    seconds = moment.hour * 3600 + moment.minute * 60 + moment.second
    return seconds * SECOND_NS + moment.microsecond * 1000


def _stamp(message: Any) -> int:
    days = message.date.toordinal() - date(1970, 1, 1).toordinal()
    return int(days * DAY_NS + _time_of_day_ns(message))


def nearest_ns(time_of_day_ns: int, reference_ns: int) -> int:
    """The moment with this time of day that lies nearest to the reference: right across midnight."""
    ahead_ns = (time_of_day_ns - reference_ns + DAY_NS // 2) % DAY_NS - DAY_NS // 2
    return reference_ns + ahead_ns
