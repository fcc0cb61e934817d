"""A photo's metadata: size, camera, time, place and attitude from its EXIF and XMP."""

import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from itertools import pairwise
from math import copysign, cos, hypot, isfinite, nan, radians
from pathlib import Path
from typing import Any, TypeAlias

from defusedxml import ElementTree
from PIL import ExifTags, Image

from sorvolo.capture import photo_xmp
from sorvolo.capture.decoding import (
    BROKEN_PICTURE,
    check_size,
    dng_size_px,
    is_dng,
    open_picture,
    reason_in_words,
    reduced_size_px,
    reduction_of,
)
from sorvolo.capture.telemetry.cleaning import notice, sigma_from_hdop_m
from sorvolo.errors import InputError
from sorvolo.geometry.units import (
    KM_AN_HOUR_M_S,
    KNOT_M_S,
    M_PER_DEG_LATITUDE,
    MILE_AN_HOUR_M_S,
)
from sorvolo.survey.flight import Notice

_Tags: TypeAlias = Mapping[int, Any]
_XMP_TAG = 700  # TIFF's number (XMP specification, part 3)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
# the EXIF FocalPlaneResolutionUnit: inch, centimetre, millimetre, micrometre
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_SIGN_OF_LETTER = ({"N": 1, "S": -1}, {"E": 1, "W": -1})  # of latitude, of longitude
APART_M = 10.0
"""Positions of one photo contradict each other from here on: rounding and corrections stay below; by choice."""

_M_S_PER_SPEED_UNIT = {"K": KM_AN_HOUR_M_S, "M": MILE_AN_HOUR_M_S, "N": KNOT_M_S}


class PlaceDoubt(StrEnum):
    """What was to be decided about a photo's position; the value is the notice's code."""

    VOID = "void_fix"
    VOID_BY_XMP = "void_fix_by_xmp"
    SIGN_ASSUMED = "sign_assumed"
    SIGN_BY_XMP = "sign_by_xmp"
    CONTRADICTED = "position_contradicted"


_DOUBTS = {
    PlaceDoubt.VOID: "photos whose position is there, but marked void (V) by the camera, and not used: {}; if it "
    "is right, mark it valid (exiftool -GPSStatus=A FOLDER) or give it in a geo.txt",
    PlaceDoubt.VOID_BY_XMP: "photos whose EXIF position is marked void (V), placed by their XMP: {}",
    PlaceDoubt.SIGN_ASSUMED: "photos whose position lacks its N or S, E or W, taken as north and east: {}; if it was "
    "south or west, write the references (exiftool -GPSLatitudeRef=S FOLDER)",
    PlaceDoubt.SIGN_BY_XMP: "photos whose EXIF position has another sign than their XMP's, which is taken: {}",
    PlaceDoubt.CONTRADICTED: "photos whose XMP position is more than 10 m from that in EXIF, which is taken: {}",
}


def doubt_notices(doubts: Mapping[PlaceDoubt | None, int]) -> list[Notice]:
    """The notices of so many photos with each doubt."""
    return [
        each
        for doubt, words in _DOUBTS.items()
        for each in notice(doubt, doubts.get(doubt, 0), words)
    ]


@dataclass(frozen=True)
class PhotoMetadata:
    """One photo's metadata. Numbers are NaN, texts empty and times 0 where it states none.

    `width_px` and `height_px` are as stored, before EXIF `orientation` (1-8) is applied. `utc_ns` is known to
    be UTC; `local_ns` is the camera's clock, read as though it showed UTC. `full_width_px` is
    the width that the camera wrote, to which `focal_plane_px_per_mm` belongs. `columns` are telemetry columns
    (survey.flight.TELEMETRY_COLUMNS); `unreadable` names the parts (EXIF, XMP) that are there but damaged.
    """

    width_px: int
    height_px: int
    orientation: int = 1
    make: str = ""
    model: str = ""
    focal_length_mm: float = nan
    focal_length_35mm: float = nan
    focal_plane_px_per_mm: float = nan
    full_width_px: int = 0
    utc_ns: int = 0
    local_ns: int = 0
    columns: Mapping[str, float] = field(default_factory=dict)
    unreadable: tuple[str, ...] = ()
    lens: photo_xmp.StatedLens = field(default_factory=photo_xmp.StatedLens)
    place_doubt: PlaceDoubt | None = None
    is_thermal: bool = False  # as its XMP or its maker's name states

    @property
    def shown_size_px(self) -> tuple[int, int]:
        """Width and height as every viewer shows the photo: after its orientation was applied."""
        if self.orientation >= 5:
            return self.height_px, self.width_px
        return self.width_px, self.height_px

    @property
    def reduction(self) -> int:
        """By which divisor the photo's size is used: 1, but for the largest."""
        return reduction_of(self.width_px, self.height_px)

    @property
    def used_size_px(self) -> tuple[int, int]:
        """Width and height as missions get the photo: as shown, the largest ones reduced."""
        return reduced_size_px(*self.shown_size_px)


def read_photo_metadata(path: Path) -> PhotoMetadata:
    """Read a picture's metadata without decoding its pixels.

    Raises InputError when the file is no picture at all, larger than any mission can use, or of a kind whose extra is
    not installed; damaged EXIF or XMP is named in `unreadable`.
    """
    header = _dng_header(path) if is_dng(path) else _picture_header(path)
    unreadable = header.unreadable
    properties: dict[str, str] = {}
    if header.xmp:
        try:
            properties = photo_xmp.read_properties(header.xmp)
        except (ElementTree.ParseError, ValueError, RecursionError):
            unreadable = (*unreadable, "XMP")
    main, detail, gps = header.tags
    full_width_px = _whole(detail.get(ExifTags.Base.ExifImageWidth)) or max(
        header.width_px, header.height_px
    )
    full_height_px = round(full_width_px * header.height_px / header.width_px)
    place, place_doubt = _place(gps, properties)
    orientation = _whole(main.get(ExifTags.Base.Orientation))
    unit = _whole(detail.get(ExifTags.Base.FocalPlaneResolutionUnit)) or 2
    # UTC of the exposure: the drone's stamp, else the GPS receiver's, else a clock with its zone;
    # else 0.
    written = properties.get("dji:UTCAtExposure", properties.get("sensefly:UTCTime", ""))
    written = written.replace("-", ":").replace("T", " ").rstrip("Z")
    stamp_ns = _parse_ns(written if "." in written else f"{written}.0", "%Y:%m:%d %H:%M:%S.%f")
    altitude_m, is_ellipsoidal = _altitude(gps)
    # The receiver's own estimate, else one from its dilution of precision.
    stated_m = _positive(gps.get(ExifTags.GPS.GPSHPositioningError))
    columns = {
        "horizontal_sigma_m": stated_m
        if isfinite(stated_m)
        else sigma_from_hdop_m(_positive(gps.get(ExifTags.GPS.GPSDOP))),
        "course_deg": _number(gps.get(ExifTags.GPS.GPSTrack)),
        "speed_m_s": _number(gps.get(ExifTags.GPS.GPSSpeed))
        * _M_S_PER_SPEED_UNIT.get(_text(gps.get(ExifTags.GPS.GPSSpeedRef)) or "K", nan),
        **photo_xmp.height_columns(properties, altitude_m, exif_is_ellipsoidal=is_ellipsoidal),
    }
    columns |= _finite(photo_xmp.telemetry_columns(properties))
    if "sensefly:Heading" in properties:
        columns["course_deg"] = (
            nan  # its GPSTrack repeats the heading, from which wind turns the course
        )
    return PhotoMetadata(
        header.width_px,
        header.height_px,
        orientation if 1 <= orientation <= 8 else 1,
        _text(main.get(ExifTags.Base.Make)),
        _text(main.get(ExifTags.Base.Model)),
        _positive(detail.get(ExifTags.Base.FocalLength)),
        _positive(detail.get(ExifTags.Base.FocalLengthIn35mmFilm)),
        _positive(detail.get(ExifTags.Base.FocalPlaneXResolution)) / _MM_PER_UNIT.get(unit, nan),
        full_width_px,
        stamp_ns or _receiver_utc_ns(gps) or _zoned_clock_ns(main, detail),
        _camera_clock_ns(main, detail),
        _finite(columns) | place,
        unreadable,
        photo_xmp.stated_lens(properties, full_width_px, full_height_px),
        place_doubt,
        photo_xmp.is_thermal(properties) or "flir" in _text(main.get(ExifTags.Base.Make)).lower(),
    )


@dataclass(frozen=True)
class _Header:
    """What stands before a picture's pixels: size, EXIF's main, Exif and GPS directories, the XMP packet."""

    width_px: int
    height_px: int
    tags: tuple[_Tags, _Tags, _Tags]
    xmp: bytes
    unreadable: tuple[str, ...]


def _picture_header(path: Path) -> _Header:
    try:
        with (
            warnings.catch_warnings(record=True) as caught,
            open_picture(path, path.name) as picture,
        ):
            warnings.simplefilter("always")
            (width_px, height_px), mode = picture.size, picture.mode
            # first: for EXIF that stands behind a PNG's pixels, Pillow decodes them
            check_size(path.name, width_px, height_px, is_jpeg=picture.format in ("JPEG", "MPO"))
            tags, unreadable = _exif_of(picture.getexif)
            xmp = picture.info.get("xmp") or picture.info.get("XML:com.adobe.xmp") or b""
    except BROKEN_PICTURE as error:
        raise InputError(
            f"{path.name} is not a readable picture: {reason_in_words(error)}; copy it again"
        ) from error
    if mode == "F":
        raise InputError(
            f"{path.name} holds floating-point numbers (an elevation map?), not a photo"
        )
    if caught and not unreadable:  # Pillow leaves damaged tags out and warns
        unreadable = ("EXIF",)
    packet = xmp if isinstance(xmp, bytes) else str(xmp).encode()
    return _Header(width_px, height_px, tags, packet, unreadable)


def _dng_header(path: Path) -> _Header:
    """A raw picture is a TIFF whose pixels Pillow does not know: its directories are read without them."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path.name} is not a readable picture: {reason_in_words(error)}"
        ) from error
    width_px, height_px = dng_size_px(data, path.name)
    check_size(path.name, width_px, height_px, is_jpeg=False)

    def loaded() -> Image.Exif:
        exif = Image.Exif()
        exif.load(data)
        return exif

    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        tags, unreadable = _exif_of(loaded)
    xmp = tags[0].get(_XMP_TAG, b"")
    return _Header(width_px, height_px, tags, xmp if isinstance(xmp, bytes) else b"", unreadable)


def _exif_of(load: Callable[[], Image.Exif]) -> tuple[tuple[_Tags, _Tags, _Tags], tuple[str, ...]]:
    """The main, Exif and GPS directories as plain dicts; what is damaged comes back empty and is named."""
    empty: _Tags = {}
    try:
        exif = load()
        main = dict(exif)
    except BROKEN_PICTURE:
        return (empty, empty, empty), ("EXIF",)
    directories: list[_Tags] = []
    damaged = False
    for pointer in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):
        try:
            directories.append(dict(exif.get_ifd(pointer)))
        except BROKEN_PICTURE:
            directories.append(empty)
            damaged = True
    return (main, directories[0], directories[1]), ("EXIF",) if damaged else ()


def _number(value: Any) -> float:
    """A finite float of an EXIF rational, or NaN; a zero denominator is NaN."""
    if isinstance(value, (tuple, list)) and len(value) == 1:
        value = value[0]
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return nan
    return number if isfinite(number) else nan


def _positive(value: Any) -> float:
    number = _number(value)
    return number if number > 0 else nan


def _whole(value: Any) -> int:
    number = _number(value)
    return int(number) if 0 < number < 1e6 else 0


def _text(value: Any) -> str:
    """Text without the NULs and blanks that cameras pad it with."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return value.split("\0")[0].strip() if isinstance(value, str) else ""


def _parse_ns(text: str, pattern: str) -> int:
    """Nanoseconds since 1970 of a date as written, read as UTC; 0 for none and outside 1990-2200."""
    try:
        moment = datetime.strptime(text, pattern).replace(tzinfo=UTC)
    except ValueError:
        return 0
    return (
        (moment - _EPOCH) // timedelta(microseconds=1) * 1000 if 1990 <= moment.year <= 2200 else 0
    )


def _camera_clock_ns(main: _Tags, detail: _Tags) -> int:
    """The camera's clock with its parts of a second, read as though it showed UTC."""
    for tag, fraction_tag in (
        (ExifTags.Base.DateTimeOriginal, ExifTags.Base.SubsecTimeOriginal),
        (ExifTags.Base.DateTimeDigitized, ExifTags.Base.SubsecTimeDigitized),
        (ExifTags.Base.DateTime, ExifTags.Base.SubsecTime),
    ):
        text = _text(detail.get(tag) or main.get(tag)).replace("-", ":").replace("T", " ")
        if time_ns := _parse_ns(text[:19], "%Y:%m:%d %H:%M:%S"):
            fraction = re.match(r"\d{1,9}", _text(detail.get(fraction_tag)))
            return time_ns + (int(fraction[0].ljust(9, "0")) if fraction else 0)
    return 0


def _receiver_utc_ns(gps: _Tags) -> int:
    day_ns = _parse_ns(_text(gps.get(ExifTags.GPS.GPSDateStamp)).replace("-", ":"), "%Y:%m:%d")
    clock = gps.get(ExifTags.GPS.GPSTimeStamp)
    if not day_ns or not isinstance(clock, (tuple, list)) or len(clock) != 3:
        return 0
    hours, minutes, seconds = (_number(part) for part in clock)
    since_midnight_s = hours * 3600 + minutes * 60 + seconds
    return (
        day_ns + round(since_midnight_s * 1000) * 1_000_000
        if 0 <= since_midnight_s <= 86_401
        else 0
    )


def _zoned_clock_ns(main: _Tags, detail: _Tags) -> int:
    offset = _text(
        detail.get(ExifTags.Base.OffsetTimeOriginal) or detail.get(ExifTags.Base.OffsetTime)
    )
    zone = re.fullmatch(r"([+-])(\d\d):?(\d\d)", offset.replace("Z", "+00:00"))
    clock_ns = _camera_clock_ns(main, detail)
    if not clock_ns or zone is None:
        return 0
    minutes_east = (int(zone[2]) * 60 + int(zone[3])) * (-1 if zone[1] == "-" else 1)
    return clock_ns - minutes_east * 60 * 1_000_000_000


def _place(gps: _Tags, properties: Mapping[str, str]) -> tuple[dict[str, float], PlaceDoubt | None]:
    """Latitude and longitude of EXIF and XMP held against each other, and what was in doubt.

    EXIF goes first. A sign that its references N, S, E, W do not give is XMP's, and so is one that XMP has otherwise:
    it stands within the number. A fix that the receiver calls void counts as none.
    """
    xmp = _on_earth(*photo_xmp.place_columns(properties).values())
    size = [
        _size_deg(gps.get(tag)) for tag in (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLongitude)
    ]
    signs = [
        -1 if is_negative else letters.get(_text(gps.get(tag))[:1].upper(), 0)
        for letters, tag, (_, is_negative) in zip(
            _SIGN_OF_LETTER, (ExifTags.GPS.GPSLatitudeRef, ExifTags.GPS.GPSLongitudeRef), size
        )
    ]
    exif = _on_earth(*(angle * (sign or 1) for (angle, _), sign in zip(size, signs)))
    if exif and _text(gps.get(ExifTags.GPS.GPSStatus))[:1].upper() == "V":
        return xmp, PlaceDoubt.VOID_BY_XMP if xmp else PlaceDoubt.VOID
    if not exif or not any(exif.values()):
        return xmp or exif, None
    if not any(xmp.values()):  # 0/0 is what drones write before their first fix
        return exif, None if all(signs) else PlaceDoubt.SIGN_ASSUMED
    by_xmp = {name: copysign(angle, xmp[name]) for name, angle in exif.items()}
    if apart_m(by_xmp, xmp) > APART_M:
        return exif, PlaceDoubt.CONTRADICTED
    return by_xmp, PlaceDoubt.SIGN_BY_XMP if apart_m(exif, by_xmp) > APART_M else None


def _on_earth(latitude_deg: float, longitude_deg: float) -> dict[str, float]:
    """The two as telemetry columns; none where they are no place."""
    if not (abs(latitude_deg) <= 90 and abs(longitude_deg) <= 180):
        return {}
    return {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}


def apart_m(one: Mapping[str, float], other: Mapping[str, float]) -> float:
    """How far two places, telemetry columns, are apart."""
    north_deg, east_deg = (one[name] - other[name] for name in ("latitude_deg", "longitude_deg"))
    east_deg = (east_deg + 180) % 360 - 180
    return M_PER_DEG_LATITUDE * hypot(north_deg, east_deg * cos(radians(one["latitude_deg"])))


def _finite(columns: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in columns.items() if isfinite(value)}


def _size_deg(parts: Any) -> tuple[float, bool]:
    """Degrees without sign of degrees, minutes, seconds, NaN if any part is missing; whether any part is negative."""
    numbers = (
        [_number(part) for part in parts] if isinstance(parts, (tuple, list)) else [_number(parts)]
    )
    # 75 minutes, and 41.89 degrees with 53 minutes beside them, are no place that anyone meant
    doubled = any(number % 1 and after for number, after in pairwise(numbers))
    if not 1 <= len(numbers) <= 3 or doubled or any(abs(each) > 60 for each in numbers[1:]):
        return nan, False
    angle_deg = sum(abs(number) / 60**power for power, number in enumerate(numbers))
    return angle_deg, any(number < 0 for number in numbers)


def _altitude(gps: _Tags) -> tuple[float, bool]:
    """EXIF's altitude, and whether its reference is the ellipsoid.

    References: 0 above, 1 below the sea; 2 above, 3 below the ellipsoid (EXIF 3.0).
    """
    altitude_m = _number(gps.get(ExifTags.GPS.GPSAltitude))
    reference = gps.get(ExifTags.GPS.GPSAltitudeRef, 0)
    if isinstance(reference, (bytes, str)):
        reference = reference[0] if reference else 0
        reference = ord(reference) if isinstance(reference, str) else reference
    code = int(_number(reference)) if isfinite(_number(reference)) else 0
    code = code - ord("0") if code >= ord("0") else code
    return -abs(altitude_m) if code in (1, 3) else altitude_m, code in (2, 3)
