"""Control point files in OpenDroneMap's form (gcp_list.txt): a CRS, then `x y z px py image [label]` a line."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path

from pyproj import CRS

from sorvolo.capture.photo_xmp import finite
from sorvolo.capture.photos import PhotoSource
from sorvolo.capture.small_files import read_small_file, text_of
from sorvolo.capture.source import Source
from sorvolo.capture.telemetry.cleaning import notice
from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.crs import crs_from_words, transformer
from sorvolo.geometry.units import FOOT_M
from sorvolo.survey.control import ControlMark, ControlPoint, GroundControl
from sorvolo.survey.flight import Notice

LEAST_POINTS = 3
"""Fewer cannot show that one of them is wrong."""

_KIND, _NEEDED = "control point file", "a CRS in the first line, then x y z px py image a line"


@dataclass(frozen=True)
class _Line:
    number: int
    x: float
    y: float
    z: float
    x_px: float
    y_px: float
    image: str
    label: str


@dataclass(frozen=True)
class _Reading:
    """A way to read the file: its CRS, which columns are exchanged, and the CRS's units in one of x and y."""

    crs_words: str
    swaps_xy: bool = False
    swaps_px: bool = False
    units: float = 1.0


@dataclass(frozen=True)
class ControlFile:
    """A control point file as it was read; `control` takes it at its word."""

    path: Path
    crs_words: str
    lines: tuple[_Line, ...]

    @property
    def control(self) -> GroundControl:
        """Points and marks. Raises InputError for places that the CRS does not have."""
        return self._control(_Reading(self.crs_words))

    def other_readings(self) -> Iterator[tuple[str, GroundControl]]:
        """Other ways to read the file, each with the mistake it stands for: to name that where the file is wrong."""
        for words, reading in self._mistakes():
            try:
                yield words, self._control(reading)
            except InputError:
                continue

    def _mistakes(self) -> Iterator[tuple[str, _Reading]]:
        own = _Reading(self.crs_words)
        yield (
            "x and y are exchanged (easting or longitude comes first)",
            replace(own, swaps_xy=True),
        )
        yield (
            "px and py are exchanged (the column comes before the row)",
            replace(own, swaps_px=True),
        )
        yield (
            "x and y are exchanged, and px and py as well",
            replace(own, swaps_xy=True, swaps_px=True),
        )
        crs = _parsed_crs(self.crs_words, self.path)
        if not crs.is_projected:
            return
        degrees = _Reading("WGS84")
        yield "x and y are degrees (longitude, latitude): the CRS is WGS84", degrees
        yield (
            "x and y are degrees, latitude before longitude: the CRS is WGS84",
            replace(degrees, swaps_xy=True),
        )
        unit_m = _height_unit_m(crs)
        if unit_m == 1.0:
            yield "x, y and z are in feet: give them in metres", replace(own, units=FOOT_M)
        else:
            yield "x, y and z are in metres: the CRS counts in feet", replace(own, units=1 / unit_m)
        yield "the CRS is that of web maps (EPSG:3857)", _Reading("EPSG:3857")
        own_zone = re.fullmatch(r"\d+[NS]", crs.utm_zone or "")
        for zone in (f"{k}{side}" for k in range(1, 61) for side in "NS") if own_zone else ():
            if zone != crs.utm_zone:
                yield f"the CRS is UTM zone {zone}", _Reading(f"WGS84 UTM {zone}")

    def _control(self, reading: _Reading) -> GroundControl:
        crs_words = reading.crs_words
        crs = _parsed_crs(crs_words, self.path)
        to_m = _height_unit_m(crs)
        wgs84_from_crs = transformer(crs.to_wkt())
        points: dict[str, ControlPoint] = {}
        marks = []
        for line in self.lines:
            x, y = (line.y, line.x) if reading.swaps_xy else (line.x, line.y)
            if line.label not in points:
                longitude_deg, latitude_deg = wgs84_from_crs.transform(
                    x * reading.units, y * reading.units
                )
                if not (abs(latitude_deg) <= 90 and abs(longitude_deg) <= 360):
                    raise InputError(
                        f"{self.path}, line {line.number}: {line.x:g} {line.y:g} is no place in {crs_words} "
                        f"({crs.name}); {_no_place(crs)}"
                    )
                height_m = line.z * reading.units * to_m
                points[line.label] = ControlPoint(line.label, latitude_deg, longitude_deg, height_m)
            x_px, y_px = (line.y_px, line.x_px) if reading.swaps_px else (line.x_px, line.y_px)
            marks.append(ControlMark(line.label, line.image, x_px, y_px))
        return GroundControl(
            self.path.name, f"{crs_words} ({crs.name})", tuple(points.values()), tuple(marks)
        )


def read_control_points(path: Path) -> ControlFile:
    """Read a gcp_list.txt: the first line a CRS (see `crs_from_words`), the others are `x y z px py image [label]`; further columns, blank lines and those that begin with # are left out.

    Lines without a label belong together where their coordinates are the same. Raises InputError for what cannot be
    read, naming the line.
    """
    text = text_of(path, read_small_file(path, _KIND), _KIND, _NEEDED)
    numbered = [
        (number, line.strip())
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.strip().startswith("#")
    ]
    if not numbered:
        raise InputError(f"{path}: nothing but comments; {_NEEDED} is needed")
    crs_words = numbered[0][1]
    _parsed_crs(crs_words, path)
    lines = [_line(path, number, line) for number, line in numbered[1:]]
    names: dict[tuple[float, float], str] = {}  # of points without a label, by their coordinates
    for k, each in enumerate(lines):
        if not each.label:
            label = names.setdefault((each.x, each.y), f"point {len(names) + 1}")
            lines[k] = replace(each, label=label)
    if not lines:
        raise InputError(f"{path}: no control point after its first line; {_NEEDED} is needed")
    first: dict[str, _Line] = {}
    marked: set[tuple[str, str]] = set()
    for line in lines:
        known = first.setdefault(line.label, line)
        if (known.x, known.y) != (line.x, line.y):
            raise InputError(
                f"{path}: {line.label} has other coordinates in line {line.number} than in line {known.number}; give "
                "each point one place"
            )
        if (line.label, line.image) in marked:
            raise InputError(
                f"{path}, line {line.number}: {line.label} is marked twice in {line.image}; keep one mark"
            )
        marked.add((line.label, line.image))
    return ControlFile(path, crs_words, tuple(lines))


def marks_in_frames(
    control: GroundControl, source: Source
) -> tuple[GroundControl, tuple[Notice, ...]]:
    """The control with its marks in the pixels of the flight's frames, those of other pictures left out and counted.

    Names match without regard to case and ending. Raises InputError where a mark lies beside its picture, and where
    fewer than three points are marked in pictures of this flight.
    """
    sizes = _original_sizes(source)
    kept, elsewhere = [], set()
    for mark in control.marks:
        frame = _matching(mark.frame, sizes)
        if frame is None:
            elsewhere.add(mark.frame)
            continue
        kept.append(
            _scaled(control, replace(mark, frame=frame), sizes[frame], source.camera.camera)
        )
    if not kept:
        raise InputError(
            f"{control.name}: none of its pictures ({', '.join(sorted(elsewhere)[:3])} ...) is one of this flight's "
            f"({', '.join(source.inputs[:3])} ...); give the marks of these photos"
        )
    marked = {each.label for each in kept}
    if len(marked) < LEAST_POINTS:
        raise InputError(
            f"{control.name}: {len(marked)} control points are marked in pictures of {source.name}, at least "
            f"{LEAST_POINTS} are needed, well apart; mark more of them"
        )
    words = "pictures of the control point file that are not this flight's: {}"
    notices = notice("control_elsewhere", len(elsewhere), words)
    points = tuple(each for each in control.points if each.label in marked)
    return replace(control, points=points, marks=tuple(kept)), tuple(notices)


def _original_sizes(source: Source) -> dict[str, tuple[int, int]]:
    """Each frame's name with the size, width and height, in whose pixels a person marks it."""
    if isinstance(source, PhotoSource):
        return {
            photo.path.name: photo.metadata.shown_size_px
            for photo in source.album.photos
            if photo.metadata.width_px
        }
    camera = source.camera.camera
    return {
        str(number): (camera.width_px, camera.height_px) for number in range(source.frame_count)
    }


def _matching(name: str, sizes: Mapping[str, tuple[int, int]]) -> str | None:
    if name in sizes:
        return name
    stem = Path(name).stem.casefold()
    return next((each for each in sizes if Path(each).stem.casefold() == stem), None)


def _scaled(
    control: GroundControl, mark: ControlMark, size_px: tuple[int, int], camera: Camera
) -> ControlMark:
    """A mark of a picture of this size in the frames' pixels; raises InputError for one beside the picture."""
    width_px, height_px = size_px
    if not (-1 <= mark.x_px <= width_px and -1 <= mark.y_px <= height_px):
        swapped = mark.x_px <= height_px and mark.y_px <= width_px
        hint = "are px and py exchanged?" if swapped else "give pixels of the photo as it was taken"
        raise InputError(
            f"{control.name}: {mark.label} is marked at {mark.x_px:g}, {mark.y_px:g} in {mark.frame}, which has "
            f"{width_px} x {height_px} pixels; {hint}"
        )
    across, down = camera.width_px / width_px, camera.height_px / height_px
    return replace(mark, x_px=(mark.x_px + 0.5) * across - 0.5, y_px=(mark.y_px + 0.5) * down - 0.5)


def _line(path: Path, number: int, text: str) -> _Line:
    fields = text.split()
    if len(fields) < 6:
        raise InputError(
            f"{path}, line {number}: {len(fields)} columns, {text[:60]!r}; x y z px py image was needed"
        )
    numbers = [finite(each) for each in fields[:5]]
    wrong = [
        fields[at] for at in (0, 1, 3, 4) if not isfinite(numbers[at])
    ]  # a height may be missing: NaN
    if wrong:
        raise InputError(
            f"{path}, line {number}: {wrong[0]!r} is no number; x y z px py image was needed"
        )
    x, y, z, x_px, y_px = numbers
    image = fields[5].replace("\\", "/").rpartition("/")[2]
    return _Line(number, x, y, z, x_px, y_px, image, fields[6] if len(fields) > 6 else "")


def _parsed_crs(words: str, path: Path) -> CRS:
    """The CRS of the first line; raises InputError."""
    try:
        return crs_from_words(words)
    except GeometryError as error:
        raise InputError(f"{path}: its first line: {error}") from error


def _height_unit_m(crs: CRS) -> float:
    """Metres in a unit of the points' heights: their own, else that of their other coordinates, where lengths."""
    if crs.is_compound or crs.is_projected:
        return float(crs.axis_info[-1].unit_conversion_factor)
    return 1.0


def _no_place(crs: CRS) -> str:
    """What to do about coordinates that a CRS does not have."""
    if crs.is_geographic:
        return "it is in degrees, longitude before latitude: for metres name their CRS, as WGS84 UTM 32N"
    return "give x (easting, longitude) before y, in the CRS of the first line"
