"""Telemetry files: the content decides which reader a file needs, and where a video's telemetry lies."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, cast

from sorvolo.build import added
from sorvolo.capture.telemetry import dji_srt, flight_table, gpx, mcap_log, nmea
from sorvolo.capture.telemetry.autopilot_logs import AUTOPILOT_READERS
from sorvolo.errors import InputError, SorvoloWarning
from sorvolo.survey.flight import Telemetry

LARGEST_FILE_BYTES = 500_000_000
"""A telemetry file beyond this is some other file; a day at 10 Hz with 60 columns is a tenth of it."""

# of a file, by which its format is recognised; a flight table's header has thousands
_HEAD_BYTES = 65_536
_SUFFIXES = (
    ".srt",
    ".ass",
    ".csv",
    ".nmea",
    ".gpx",
    ".log",
    ".txt",
    ".tsv",
    ".gps",
    ".dat",
    ".ulg",
    ".bin",
    ".tlog",
    ".mcap",
)
_UNREAD_SUFFIXES = (".kml", ".fit", ".tcx", ".bag")  # of logs
_VIDEO_SUFFIXES = frozenset(
    (".mp4", ".mov", ".mkv", ".avi", ".ts", ".m2ts", ".mts", ".m4v", ".webm", ".mpg", ".mpeg")
)
_BESIDE = (
    "{}_telemetry",
    "{}-telemetry",
    "{}.telemetry",
    "{}_gps",
    "{}-gps",
    "{}_nmea",
    "telemetry_{}",
)


class Reader(Protocol):
    """One telemetry format; the modules of this package are such objects."""

    def recognises(self, head: bytes) -> bool:
        """Whether a file that starts with these bytes is of this format."""

    def read(self, data: bytes, name: str) -> Telemetry:
        """The file's samples; raises InputError, which calls the file `name`, when there are none."""


# Order matters where a file fits two: a table may hold NMEA sentences in one of its columns.
TELEMETRY_READERS: dict[str, Reader] = {
    **AUTOPILOT_READERS,
    "mcap": mcap_log,
    "dji_srt": dji_srt,
    "gpx": gpx,
    "table": flight_table,
    "nmea": nmea,
}
"""Every format that is read, by the name that `Telemetry.format` carries; packages add to `sorvolo.telemetry`."""


def read_telemetry(path: Path) -> Telemetry:
    """The telemetry in the file, whatever its name; the first reader that recognises its content reads it.

    Raises InputError for a file that is missing, a folder, empty, too large, binary, of no known format, or
    without any usable sample.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path}: a folder, not a telemetry file; name the file in it")
        size = path.stat().st_size
        if size > LARGEST_FILE_BYTES:
            raise InputError(
                f"{path}: {size / 1e6:.0f} MB is too large for telemetry (at most "
                f"{LARGEST_FILE_BYTES / 1e6:.0f} MB); is it the video?"
            )
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such telemetry file; check the name") from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check its permissions"
        ) from error
    if not data:
        raise InputError(f"{path}: an empty file (0 bytes); copy it from the drone again")
    reader = _reader_for(data[:_HEAD_BYTES])
    if reader is None and path.name.lower().startswith("djiflightrecord"):
        raise InputError(
            f"{path}: DJI's own flight record, which is encrypted and not read; export it as CSV (Airdata, DJI log viewers) "
            "and give that"
        )
    if reader is None:
        raise InputError(
            f"{path}: {_unknown(data)}; read are DJI's and Autel's subtitles (.SRT, .ass), GPX tracks with times, tables with Latitude and "
            "Longitude columns (DatCon, Airdata, DJI logs as .csv), NMEA 0183 with GGA or RMC sentences, logs of PX4 "
            "(.ulg) and ArduPilot (.bin, .tlog), and fixes in MCAP recordings"
        )
    return reader.read(data, str(path))


def is_telemetry(path: Path) -> bool:
    """Whether a reader recognises the file by its content; what cannot be opened is none."""
    try:
        with path.open("rb") as stream:
            return _reader_for(stream.read(_HEAD_BYTES)) is not None
    except OSError:
        return False


def find_telemetry_beside(video: Path, same_flight: Sequence[Path] = ()) -> Path | None:
    """The telemetry file that belongs to a video or to a folder of photos; None where there is no clear one.

    First a file of the video's name with another suffix (any case), then one called like
    "<name>_telemetry", then, where the folder holds no other video but chapters and copies of the `same_flight`, the
    only telemetry file in it. Only files that a reader recognises count.
    """
    files = _files_beside(video)
    candidates = [each for each in files if each.suffix.lower() in _SUFFIXES]
    if named := _named_like(video, candidates):
        return named
    videos = {each.name for each in files if each.suffix.lower() in _VIDEO_SUFFIXES}
    if videos - {each.name for each in same_flight}:
        return None
    # The only file, or the only one with "telemetry" in its name.
    known = logs_beside(video)
    for group in ([each for each in known if "telemetry" in each.stem.lower()], known):
        if len(group) == 1:
            return group[0]
    return None


def logs_beside(video: Path) -> list[Path]:
    """The telemetry files that may belong to a video or to a folder of photos: none is named as another video there."""
    files = _files_beside(video)
    others = {each.stem.lower() for each in files if each.suffix.lower() in _VIDEO_SUFFIXES}
    taken = {name for stem in others for name in (stem, *(each.format(stem) for each in _BESIDE))}
    return [
        each
        for each in files
        if each.suffix.lower() in _SUFFIXES
        and each.stem.lower() not in taken
        and is_telemetry(each)
    ]


def _files_beside(video: Path) -> list[Path]:
    """The files in a video's folder but itself, or in a folder of photos; telemetry's usual endings first."""
    folder = video if video.is_dir() else video.parent
    if not folder.is_dir():
        return []
    files = (each for each in folder.iterdir() if each.is_file() and each != video)
    order = {suffix: place for place, suffix in enumerate(_SUFFIXES)}
    return sorted(files, key=lambda each: (order.get(each.suffix.lower(), len(order)), each.name))


def _named_like(video: Path, candidates: Sequence[Path]) -> Path | None:
    stem = video.stem.lower()
    for wanted in (stem, *(pattern.format(stem) for pattern in _BESIDE)):
        # "path1.mp4.csv" belongs to path1.mp4 too
        alike = (each for each in candidates if each.stem.lower() in (wanted, video.name.lower()))
        if found := next(filter(is_telemetry, alike), None):
            return found
    return None


def unusable_files_beside(video: Path) -> list[Path]:
    """Files named as the video's telemetry would be that no reader recognises, empty ones of failed cards included."""
    stem = video.stem.lower()
    names = {stem, video.name.lower(), *(pattern.format(stem) for pattern in _BESIDE)}
    return sorted(
        each
        for each in _files_beside(video)
        if each.suffix.lower() in (*_SUFFIXES, *_UNREAD_SUFFIXES)
        and each.stem.lower() in names
        and not is_telemetry(each)
    )


def _reader_for(head: bytes) -> Reader | None:
    for name, load in added("telemetry").items():
        try:
            if (reader := load()).recognises(head):
                return cast(Reader, reader)
        except Exception as error:  # a file of another format is read, whatever others make of it
            text = f"the telemetry reader {name!r} is left out: {type(error).__name__}: {error}"
            warnings.warn(text, SorvoloWarning, stacklevel=2)
    return next((each for each in TELEMETRY_READERS.values() if each.recognises(head)), None)


def _unknown(data: bytes) -> str:
    """What a file that no reader recognises is, in words."""
    if data[4:8] == b"ftyp":
        return "a video, no log (telemetry inside a GoPro video is used where that video itself is the flight)"
    if b"\0" in data[:_HEAD_BYTES] and data[:2] not in (b"\xff\xfe", b"\xfe\xff"):
        return "a binary file, not a log in text"
    begins = data[:40].decode("utf-8", "replace").split("\n")[0].strip()
    return f"text of no known telemetry format, it begins with {begins!r}"
