"""Area files: GeoJSON, KML, KMZ and QGroundControl polygons, and the thesis's list of coordinates (eq. 3.1).

A list that closes into a polygon (its last point repeats the first, or three or more points whose outline
does not cross itself) is that polygon. Any other list, and a line in GeoJSON or KML, is a path that was or
will be flown: its area is everything within `CORRIDOR_M` of it.
"""

import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias
from xml.etree.ElementTree import Element

import numpy as np
from defusedxml import ElementTree
from defusedxml.common import DefusedXmlException
from pyproj import Proj

from sorvolo.capture.small_files import MOST_BYTES, as_number, read_small_file, text_of
from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.crs import crs_from_words, transformer
from sorvolo.geometry.polygons import widened_line
from sorvolo.paths import AnyPath
from sorvolo.survey.area import Area

CORRIDOR_M = 30.0
"""How far to either side of a path its area reaches: about half a frame's width from 50 m, so that frames
taken along the path are kept although GPS is off by some metres."""

_MOST_POLYGONS = 10_000  # in one file; a field has a few; by choice
# zipfile trusts the offsets in a file: a negative one is a ValueError, one beyond 63 bits an OverflowError
_BROKEN_ZIP = (
    zipfile.BadZipFile,
    NotImplementedError,
    RuntimeError,
    EOFError,
    OSError,
    ValueError,
    OverflowError,
    zlib.error,
    struct.error,
)
_SEPARATOR = re.compile(r"[,;\s]+")
_LONGITUDE_FIRST = "GeoJSON and KML put longitude first"
_LATITUDE_NAMES = ("latitude", "lat", "latitude_deg")
_LONGITUDE_NAMES = ("longitude", "lon", "lng", "long", "longitude_deg")

Rings: TypeAlias = tuple[Floats, ...]


def read_area(path: AnyPath) -> Area:
    """The area of interest in a file, recognised by its content.

    Raises InputError for a file that is missing, empty, of another kind, without polygon or path, or whose
    coordinates are off the Earth, cross themselves or are not WGS84 longitude and latitude (GeoJSON may name another
    CRS, in its member `crs`).
    """
    path = Path(path)
    raw = read_small_file(path, "area file")
    if raw[:2] == b"PK":
        raw = _kml_in_kmz(path, raw)
    try:
        if _is_xml_of_another_encoding(raw):
            return Area(tuple(_from_kml(path, raw.strip())), path.stem)
        text = text_of(path, raw, "area file", "GeoJSON, KML, KMZ, .plan or a list of coordinates")
        if text.startswith("{"):
            polygons = _from_geojson(path, text)
        elif text.startswith("<"):
            polygons = _from_kml(path, text)
        else:
            polygons = _from_text(path, text)
        if len(polygons) > _MOST_POLYGONS:
            raise InputError(
                f"{path}: {len(polygons)} polygons; an area has at most {_MOST_POLYGONS}; join them"
            )
        return Area(tuple(polygons), path.stem)
    except GeometryError as error:
        raise InputError(f"{path}: {error}") from error


def _is_xml_of_another_encoding(raw: bytes) -> bool:
    """Whether the bytes are XML that only an XML parser can decode, by the encoding that it states."""
    try:
        raw.decode()
    except UnicodeDecodeError:
        return raw.lstrip()[:5] == b"<?xml"
    return False


def read_segments(path: Path) -> list[tuple[str, Area, float]]:
    """The segments of a search in a GeoJSON file: name, area, and the probability that the missing is in it (POA).

    Each feature is a polygon with the property `poa` or `POA`, a probability from 0 to 1, or `poa_percent`; `name` is
    its name. Raises InputError for anything else, and for probabilities that add up to more than 1.
    """
    text = text_of(
        path,
        read_small_file(path, "file of segments"),
        "file of segments",
        "GeoJSON polygons",
    )
    try:
        tree = json.loads(text)
        to_wgs84 = _wgs84_from_stated(path, tree)
        segments = [
            _segment(path, number, each, to_wgs84)
            for number, each in enumerate(tree["features"], start=1)
        ]
    except (ValueError, RecursionError, OverflowError) as error:
        raise InputError(f"{path}: broken GeoJSON: {error}") from error
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: no FeatureCollection of polygons with the property poa: {error}"
        ) from error
    except GeometryError as error:
        raise InputError(f"{path}: {error}") from error
    if not segments or sum(poa for _, _, poa in segments) > 1.0 + 1e-6:
        raise InputError(
            f"{path}: the probabilities (poa) of at least one segment must add up to 1 at most"
        )
    return segments


def _segment(
    path: Path, number: int, feature: Any, to_wgs84: Callable[[Floats], Floats]
) -> tuple[str, Area, float]:
    properties = feature["properties"] or {}
    name = str(properties.get("name") or f"segment {number}")
    shares = {"poa": 1.0, "POA": 1.0, "poa_percent": 0.01}
    stated = [
        as_number(properties[key]) * share
        for key, share in shares.items()
        if properties.get(key) is not None
    ]
    if not stated or not 0 <= stated[0] <= 1:
        raise InputError(
            f"{path}: {name} needs the property poa, the probability (0 to 1) that the missing is there"
        )
    polygons, _ = _geojson_shapes(path, feature, to_wgs84)
    return name, Area(tuple(polygons), name), stated[0]


def _geojson_shapes(
    path: Path, tree: Any, to_wgs84: Callable[[Floats], Floats]
) -> tuple[list[Rings], list[Floats]]:
    """The polygons and the lines of a GeoJSON object."""
    polygons: list[Rings] = []
    lines: list[Floats] = []
    for geometry in _geometries(tree):
        kind, coordinates = geometry["type"], geometry["coordinates"]
        if kind in ("Polygon", "LineString"):
            coordinates = [coordinates]
        if kind in ("Polygon", "MultiPolygon"):
            polygons += [
                tuple(to_wgs84(_positions(path, ring)) for ring in rings) for rings in coordinates
            ]
        elif kind in ("LineString", "MultiLineString"):
            lines += [to_wgs84(_positions(path, line)) for line in coordinates]
    return polygons, lines


def _kml_in_kmz(path: Path, raw: bytes) -> bytes:
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            names = [name for name in archive.namelist() if name.lower().endswith(".kml")]
            if not names:
                raise InputError(f"{path}: the KMZ holds no .kml file")
            # programs take doc.kml, else the first at the archive's root; what is in folders is linked from there
            main = min(names, key=lambda name: (name.lower() != "doc.kml", name.count("/") > 0))
            with archive.open(main) as file:
                kml = file.read(MOST_BYTES + 1)
    except _BROKEN_ZIP as error:
        raise InputError(f"{path}: broken KMZ: {error}; export it again") from error
    if len(kml) > MOST_BYTES:
        raise InputError(f"{path}: its KML is larger than {MOST_BYTES // 1_000_000} MB")
    return kml


def _from_geojson(path: Path, text: str) -> list[Rings]:
    try:
        tree = json.loads(text)
        if tree.get("fileType") == "Plan":
            # the surveys' polygons of a QGroundControl plan; their corners are latitude
            # first
            items = tree["mission"]["items"]
            corners = [
                each["polygon"]
                for each in items
                if each.get("type") == "ComplexItem" and "polygon" in each
            ]
            if not corners:
                raise InputError(
                    f"{path}: a QGroundControl plan without a survey's polygon; draw the area as a survey in it, or give it as "
                    "GeoJSON or KML"
                )
            order = "a plan puts latitude first"
            return [(_checked(path, _positions(path, each)[:, ::-1], order),) for each in corners]
        polygons, lines = _geojson_shapes(path, tree, _wgs84_from_stated(path, tree))
    except (
        ValueError,
        RecursionError,
    ) as error:
        # a whole number of thousands of digits is a plain ValueError
        raise InputError(f"{path}: broken GeoJSON: {error}") from error
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: GeoJSON without the expected member: {error}") from error
    return _polygons_or_corridors(path, polygons, lines)


def _wgs84_from_stated(path: Path, tree: Any) -> Callable[[Floats], Floats]:
    """From the positions, (N, 2), of a GeoJSON file to WGS84, by its member `crs`, which files before 2016 have."""
    stated = tree.get("crs")
    name = "CRS84" if stated is None else str(stated["properties"]["name"])
    if re.search(r"CRS84h?$", name):
        return lambda lonlat: _checked(path, lonlat, _LONGITUDE_FIRST)
    code = re.fullmatch(r"(?:urn:ogc:def:crs:)?EPSG:(?:[\d.]*:)?(\d+)", name)
    try:
        to_wgs84 = transformer(crs_from_words(f"EPSG:{code[1]}" if code else name).to_wkt())
    except GeometryError as error:
        raise InputError(f"{path}: its crs: {error}") from error
    return lambda places: _checked(
        path, np.column_stack(to_wgs84.transform(places[:, 0], places[:, 1])), f"its crs is {name}"
    )


def _geometries(tree: Any) -> Iterator[Any]:
    kind = tree["type"]
    if kind == "FeatureCollection":
        for feature in tree["features"]:
            yield from _geometries(feature)
    elif kind == "Feature":
        if tree["geometry"] is not None:
            yield from _geometries(tree["geometry"])
    elif kind == "GeometryCollection":
        for geometry in tree["geometries"]:
            yield from _geometries(geometry)
    else:
        yield tree


def _positions(path: Path, positions: Sequence[Any]) -> Floats:
    """Positions with or without a height as (N, 2)."""
    try:
        pairs = np.array([[as_number(position[k]) for k in (0, 1)] for position in positions])
    except (TypeError, ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{path}: a position is not a pair of numbers: {error}") from error
    return pairs.reshape(-1, 2)


def _checked(path: Path, lonlat: Floats, order: str) -> Floats:
    """The points if they lie on the Earth; else an InputError with the likely cause."""
    bad = ~(
        np.isfinite(lonlat).all(axis=1)
        & (np.abs(lonlat[:, 0]) <= 360)
        & (np.abs(lonlat[:, 1]) <= 90)
    )
    if not bad.any():
        return lonlat
    longitude, latitude = lonlat[np.argmax(bad)]
    if abs(longitude) > 360 or not np.isfinite([longitude, latitude]).all():
        why = "are these metres of a projected system? WGS84 degrees are needed"
    else:
        why = f"are the two swapped? {order}"
    raise InputError(
        f"{path}: latitude {latitude:g}, longitude {longitude:g} is no place on Earth; {why}"
    )


def _from_kml(path: Path, text: str | bytes) -> list[Rings]:
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, DefusedXmlException, ValueError, LookupError) as error:
        raise InputError(f"{path}: broken KML: {error}") from error
    polygons, lines = [], []
    for element in root.iter():
        if _tag(element) == "Polygon":
            rings: dict[str, list[Floats]] = {"outerBoundaryIs": [], "innerBoundaryIs": []}
            for each in element.iter():
                if _tag(each) in rings:
                    rings[_tag(each)].append(_kml_coordinates(path, each))
            if not rings["outerBoundaryIs"]:
                raise InputError(f"{path}: a KML Polygon has no outerBoundaryIs")
            polygons.append((rings["outerBoundaryIs"][0], *rings["innerBoundaryIs"]))
        elif _tag(element) == "LineString":
            lines.append(_kml_coordinates(path, element))
    return _polygons_or_corridors(path, polygons, lines)


def _kml_coordinates(path: Path, element: Element) -> Floats:
    """The (N, 2) points of the coordinates under an element: "lon,lat[,height]" separated by blanks."""
    texts = [each.text or "" for each in element.iter() if _tag(each) == "coordinates"]
    # blanks beside commas are not valid KML, but say the same where each position still ends in a blank
    joined = re.sub(r"\s*,\s*", ",", " ".join(texts))
    positions = [each.strip(",").split(",") for each in joined.split()]
    if wrong := next((each for each in positions if len(each) > 3), None):
        raise InputError(
            f"{path}: where a position of the KML ends is not clear in {','.join(wrong)[:60]!r}; blanks after commas are "
            "not valid KML: write longitude,latitude,height without blanks, and a blank between positions"
        )
    return _checked(path, _positions(path, positions), _LONGITUDE_FIRST)


def _tag(element: Element) -> str:
    """The element's name without its namespace, which differs between KML versions and programs."""
    return str(element.tag).rpartition("}")[2]


def _polygons_or_corridors(path: Path, polygons: list[Rings], lines: list[Floats]) -> list[Rings]:
    """Polygons where a file has any; a path beside them is a flight plan drawn into the same file."""
    polygons = polygons or [capsule for line in lines for capsule in _corridor(path, line)]
    if not polygons:
        raise InputError(f"{path}: neither a polygon nor a path in it; draw the area as a polygon")
    return polygons


def _from_text(path: Path, text: str) -> list[Rings]:
    """Lists of "latitude, longitude" lines, the thesis's order; a blank line starts another area.

    What follows a # is a comment. A first line with names (lat, latitude, lon, longitude ...) names the
    columns.
    """
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    columns = (0, 1)
    first = next((index for index, line in enumerate(lines) if line), 0)
    names = [name.strip('"').lower() for name in _SEPARATOR.split(lines[first])]
    if any(name in _LATITUDE_NAMES for name in names):
        latitude = [names.index(name) for name in _LATITUDE_NAMES if name in names]
        longitude = [names.index(name) for name in _LONGITUDE_NAMES if name in names]
        if not latitude or not longitude:
            raise InputError(
                f"{path}: the header {' '.join(names)[:60]!r} names no latitude and longitude"
            )
        columns = latitude[0], longitude[0]
        lines = lines[first + 1 :]
    lists: list[list[tuple[float, float]]] = [[]]
    for number, line in enumerate(lines, start=1):
        if not line:
            lists.append([])
            continue
        cells = _SEPARATOR.split(line)
        try:
            lists[-1].append((float(cells[columns[1]]), float(cells[columns[0]])))
        except (ValueError, IndexError) as error:
            raise InputError(
                f"{path}: line {number} is {line[:60]!r}; a latitude and a longitude in degrees are needed"
            ) from error
    polygons: list[Rings] = []
    for points in filter(None, lists):
        polygons += _area_of_list(
            path, _checked(path, np.array(points), "lists put latitude first")
        )
    if not polygons:
        raise InputError(f"{path}: no coordinates in it")
    return polygons


def _area_of_list(path: Path, lonlat: Floats) -> list[Rings]:
    try:
        Area(((lonlat,),))
    except GeometryError:
        if len(lonlat) > 2 and (lonlat[0] == lonlat[-1]).all():
            raise
        return _corridor(path, lonlat)
    return [(lonlat,)]


def _corridor(path: Path, lonlat: Floats) -> list[Rings]:
    """The polygons of everything within `CORRIDOR_M` of the path."""
    if len(lonlat) < 2:
        raise InputError(f"{path}: a single point; an area needs a path or an outline")
    middle = lonlat[len(lonlat) // 2]
    # distances from the path's middle are true, so a corridor of 500 km is 0.03 % too narrow at most
    plane = Proj(proj="aeqd", lon_0=middle[0], lat_0=middle[1], datum="WGS84")
    path_m = np.column_stack(plane(lonlat[:, 0], lonlat[:, 1]))
    return [
        tuple(np.column_stack(plane(ring[:, 0], ring[:, 1], inverse=True)) for ring in rings)
        for rings in widened_line(path_m, CORRIDOR_M)
    ]
