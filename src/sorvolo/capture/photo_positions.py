"""Positions by photo from a file beside the photos: ODM's geo.txt, or the Timestamp.MRK of DJI's RTK drones."""

import re
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from math import hypot, isfinite, nan
from pathlib import Path

import numpy as np

from sorvolo.capture.photo_metadata import PhotoMetadata
from sorvolo.capture.small_files import read_small_file, text_of
from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.crs import crs_from_words, transformer, vertical_name
from sorvolo.geometry.pose import gimbal_angles_from_rotation, site_from_body_nadir_rotation
from sorvolo.geometry.units import SECOND_NS

_KIND, _NEEDED = "file of positions", "ODM's geo.txt or DJI's Timestamp.MRK"
_HEAD_BYTES = 4_096
_SUFFIXES = (".txt", ".mrk")
# number, second of the week, [week], three offsets of the antenna in mm, place, three sigmas, quality
_MRK_LINE = re.compile(
    r"^\s*(\d+)\s+(\d+(?:\.\d+)?)\s+\[(\d+)\]\s[^\n]*?(-?\d[\d.]*),Lat\s+(-?\d[\d.]*),Lon\s+(-?\d[\d.]*),Ellh"
    r"\s+(\d[\d.]*),\s*(\d[\d.]*),\s*(\d[\d.]*)\s+(\d+),Q",
    re.MULTILINE,
)
_CRS = re.compile(r"EPSG:|WGS ?84|\+proj", re.IGNORECASE)
_NUMBER_OF_PHOTO = re.compile(r"(\d{3,5})(?:_[A-Za-z]+)?$")
_GPS_EPOCH_NS = int(datetime(1980, 1, 6, tzinfo=UTC).timestamp()) * SECOND_NS
_WEEK_NS = 7 * 86_400 * SECOND_NS
_LEAP_NS = 18 * SECOND_NS  # GPS time is ahead of UTC by this since 2017
_SAME_TIME_NS = 3 * SECOND_NS  # EXIF's clock has whole seconds

Columns = dict[str, float]


def is_position_file(path: Path) -> bool:
    """Whether a file holds positions of photos, by its content; what cannot be opened does not."""
    if path.suffix.lower() not in _SUFFIXES:
        return False
    try:
        with path.open("rb") as file:
            text = file.read(_HEAD_BYTES).decode("utf-8-sig", "replace")
    except OSError:
        return False
    lines = list(_lines(text))
    if lines and path.name.lower() == "geo.txt":  # if it cannot be read, that is said
        return True
    return _MRK_LINE.search(text) is not None or (
        len(lines) > 1 and _CRS.match(lines[0][1]) is not None and _is_geo_row(lines[1][1])
    )


def read_positions(
    path: Path, photos: Mapping[str, PhotoMetadata]
) -> tuple[dict[str, Columns], str]:
    """The telemetry columns of each photo, by its file name, that the file places; and words about them.

    `photos` are the flight's, by file name. A geo.txt names its photos; a Timestamp.MRK counts them: a photo is taken
    whose name ends in the number and whose clock runs with the file's. Raises InputError for what cannot be read, and
    where no photo is placed.
    """
    text = text_of(path, read_small_file(path, _KIND), _KIND, _NEEDED)
    is_mrk = _MRK_LINE.search(text) is not None
    found, words = (_of_mrk(text, photos), "") if is_mrk else _of_geo(path, text, photos)
    if not found:
        why = (
            "none of these photos ends in one of its numbers and was taken at its time"
            if is_mrk
            else "it names none of these photos"
        )
        raise InputError(f"{path}: {why}; give the file of this flight")
    return found, words


def _of_geo(
    path: Path, text: str, photos: Mapping[str, PhotoMetadata]
) -> tuple[dict[str, Columns], str]:
    """ODM's rows: name x y [z] [yaw pitch roll] [horizontal and vertical accuracy]."""
    (_, first), *rows = _lines(text)
    try:
        crs = crs_from_words(first)
    except GeometryError as error:
        raise InputError(f"{path}: its first line: {error}") from error
    to_wgs84, reference = transformer(crs.to_wkt()), vertical_name(crs)
    is_ellipsoidal = reference.lower().startswith("ellips")
    by_stem: dict[str, Columns] = {}
    for number, row in rows:
        fields = row.split()
        if not _is_geo_row(row):
            raise InputError(f"{path}, line {number}: {row[:60]!r}; expected: name x y [z ...]")
        x, y, z, *more = (*map(_float, fields[1:9]), *[nan] * (9 - len(fields)))
        longitude_deg, latitude_deg = to_wgs84.transform(x, y)
        if not (abs(latitude_deg) <= 90 and abs(longitude_deg) <= 360):
            raise InputError(
                f"{path}, line {number}: {x:g} {y:g} is no place in {first}; name the CRS of x and y in the first line"
            )
        by_stem[_plain_stem(fields[0])] = {
            "latitude_deg": latitude_deg,
            "longitude_deg": longitude_deg,
            "ellipsoidal_height_m" if is_ellipsoidal else "orthometric_height_m": z,
            "horizontal_sigma_m": more[3] or nan,
            "vertical_sigma_m": more[4] or nan,
            **_angles(*more[:3]),
        }
    named = {name: by_stem[stem] for name in photos if (stem := _plain_stem(name)) in by_stem}
    has_heights = any(isfinite(each.get("orthometric_height_m", nan)) for each in named.values())
    words = "; its heights state no reference and are taken as above sea level"
    return named, words if has_heights and not reference else ""


def _angles(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Columns:
    """ODM's angles, 0 0 0 where there are none, as a gimbal's."""
    if (
        not any((yaw_deg, pitch_deg, roll_deg))
        or not np.isfinite([yaw_deg, pitch_deg, roll_deg]).all()
    ):
        return {}
    found = gimbal_angles_from_rotation(site_from_body_nadir_rotation(yaw_deg, pitch_deg, roll_deg))
    return dict(zip(("camera_yaw_deg", "camera_pitch_deg", "camera_roll_deg"), found))


def _of_mrk(text: str, photos: Mapping[str, PhotoMetadata]) -> dict[str, Columns]:
    """DJI's rows: the camera's place at the exposure, with its sigmas; quality 0 is none."""
    rows: dict[int, tuple[int, Columns]] = {}
    for match in _MRK_LINE.finditer(text):
        number, seconds, week, *numbers, quality = match.groups()
        latitude_deg, longitude_deg, height_m, north_m, east_m, up_m = map(_float, numbers)
        if int(quality) and abs(latitude_deg) <= 90 and abs(longitude_deg) <= 180:
            time_ns = int(week) * _WEEK_NS + round(float(seconds) * SECOND_NS)
            rows[int(number)] = (
                _GPS_EPOCH_NS + time_ns - _LEAP_NS,
                {
                    "latitude_deg": latitude_deg,
                    "longitude_deg": longitude_deg,
                    "ellipsoidal_height_m": height_m,
                    "horizontal_sigma_m": hypot(north_m, east_m) / 2**0.5 or nan,
                    "vertical_sigma_m": up_m or nan,
                },
            )
    found: dict[str, Columns] = {}
    apart_ns: dict[str, int] = {}
    for name, metadata in photos.items():
        ends = _NUMBER_OF_PHOTO.search(Path(name).stem)
        if ends and int(ends[1]) in rows:
            time_ns, found[name] = rows[int(ends[1])]
            if clock_ns := metadata.utc_ns or metadata.local_ns:
                apart_ns[name] = clock_ns - time_ns
    # another flight's photos have the same numbers, but not the same times, whatever the camera's time zone is
    usual_ns = sorted(apart_ns.values())[len(apart_ns) // 2] if apart_ns else 0
    near = {name for name, each in apart_ns.items() if abs(each - usual_ns) <= _SAME_TIME_NS}
    if 2 * len(near) < len(apart_ns):
        return {}
    return {name: each for name, each in found.items() if name in near or not apart_ns}


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """The lines with something in them, with their numbers."""
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line.strip()


def _is_geo_row(row: str) -> bool:
    """Whether a row is a name and two numbers; a control point's begins with numbers."""
    fields = row.split()
    return (
        len(fields) >= 3
        and not isfinite(_float(fields[0]))
        and all(isfinite(_float(each)) for each in fields[1:3])
    )


def _plain_stem(name: str) -> str:
    """A photo's name without folder, ending, case and blanks, which geo.txt cannot hold."""
    return re.sub(r"\s", "_", Path(name.replace("\\", "/")).stem).casefold()


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return nan
