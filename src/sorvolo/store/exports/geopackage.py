"""Layers of features as a GeoPackage (OGC 12-128r19), one SQLite file that QGIS and others open; a project for QGIS."""

import json
import re
import sqlite3
import struct
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

import shapely
from rasterio import DatasetReader
from shapely.geometry import shape
from shapely.geometry.base import BaseGeometry

from sorvolo.store.atomic import atomic_path
from sorvolo.store.pages.words import xml_of

Feature = Mapping[str, Any]

_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,9})?(Z|[+-]\d\d:\d\d)")
_LENGTH = re.compile("_(m2?|px|deg)$")  # names of numbers, also where none is known
_APPLICATION = 0x47504B47  # "GPKG"
_VERSION = 10300  # GeoPackage 1.3.0, as its requirement 2 writes it
_WGS84, _NOWHERE = 4326, 0  # by EPSG; degrees of no known datum
_NOW = "strftime('%Y-%m-%dT%H:%M:%S.000Z', 'now')"
_WGS84_WKT = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]]'
)
_STYLES_TABLE = """
CREATE TABLE layer_styles (id INTEGER PRIMARY KEY AUTOINCREMENT, f_table_catalog TEXT(256), f_table_schema TEXT(256),
  f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT, styleSLD TEXT,
  useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30), update_time DATETIME)
"""
_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL, min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
  srs_id INTEGER REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL PRIMARY KEY REFERENCES gpkg_contents(table_name),
  column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL,
  m TINYINT NOT NULL);
"""


def write_geopackage(
    path: Path,
    layers: Mapping[str, Sequence[Feature]],
    styles: Mapping[str, str] = MappingProxyType({}),
    *,
    is_local: bool = False,
) -> None:
    """Write a layer for each name that has features; GeoJSON features in WGS84; `is_local`: in degrees that are nowhere on Earth.

    `styles` are QML documents by layer, which QGIS takes as the layers' own. Raises StoreError on a full disk.
    """
    with (
        atomic_path(path) as temporary,
        closing(sqlite3.connect(temporary, isolation_level=None)) as file,
    ):
        file.execute(f"PRAGMA application_id = {_APPLICATION}")
        file.execute(f"PRAGMA user_version = {_VERSION}")
        file.executescript(_TABLES)
        file.execute("BEGIN")
        file.executemany(
            "INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, '')",
            [
                ("Undefined cartesian", -1, "NONE", -1, "undefined"),
                ("Undefined geographic", _NOWHERE, "NONE", _NOWHERE, "undefined"),
                ("WGS 84", _WGS84, "EPSG", _WGS84, _WGS84_WKT),
            ],
        )
        for name, features in layers.items():
            if features:
                _write_layer(file, name, features, _NOWHERE if is_local else _WGS84)
        _write_styles(file, {name: qml for name, qml in styles.items() if layers.get(name)})
        file.execute("COMMIT")


def _write_layer(
    file: sqlite3.Connection, name: str, features: Sequence[Feature], srs_id: int
) -> None:
    shapes = _alike([shapely.force_2d(shape(each["geometry"])) for each in features])
    kind = (
        shapes[0].geom_type.upper() if len({each.geom_type for each in shapes}) == 1 else "GEOMETRY"
    )
    columns = _columns(features)
    declared = "".join(f", {_quoted(column)} {sql}" for column, sql in columns.items())
    file.execute(
        f"CREATE TABLE {_quoted(name)} (fid INTEGER PRIMARY KEY AUTOINCREMENT, geom {kind}{declared})"
    )
    marks = ", ".join("?" * (len(columns) + 1))
    names = ", ".join(["geom", *(_quoted(each) for each in columns)])
    file.executemany(
        f"INSERT INTO {_quoted(name)} ({names}) VALUES ({marks})",
        [
            (
                # magic, version, flags (little-endian, no envelope), srs_id, ISO WKB
                struct.pack("<2sBBi", b"GP", 0, 1, srs_id)
                + bytes(shapely.to_wkb(geometry, byte_order=1, flavor="iso")),
                *(_plain(each["properties"].get(name), sql) for name, sql in columns.items()),
            )
            for geometry, each in zip(shapes, features, strict=True)
        ],
    )
    bounds = shapely.total_bounds(shapes)
    file.execute(
        f"INSERT INTO gpkg_contents VALUES (?, 'features', ?, '', {_NOW}, ?, ?, ?, ?, ?)",
        (name, name, *(float(each) for each in bounds), srs_id),
    )
    file.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)", (name, kind, srs_id)
    )


def _write_styles(file: sqlite3.Connection, styles: Mapping[str, str]) -> None:
    """The table in which QGIS keeps styles; registered, so that programs do not take it for a damaged layer."""
    if not styles:
        return
    file.execute(_STYLES_TABLE)
    file.executemany(
        f"INSERT INTO layer_styles VALUES (NULL, '', '', ?, 'geom', 'sorvolo', ?, '', 1, 'Sorvolo', '', NULL, {_NOW})",
        styles.items(),
    )
    file.execute(
        "INSERT INTO gpkg_contents VALUES ('layer_styles', 'attributes', 'layer_styles', '', "
        f"{_NOW}, NULL, NULL, NULL, NULL, 0)"
    )


def _alike(shapes: Sequence[BaseGeometry]) -> list[BaseGeometry]:
    """Polygons beside multipolygons become multipolygons: a layer of one kind opens in every program."""
    if {each.geom_type for each in shapes} == {"Polygon", "MultiPolygon"}:
        return [
            shapely.MultiPolygon([each]) if each.geom_type == "Polygon" else each for each in shapes
        ]
    return list(shapes)


def _columns(features: Sequence[Feature]) -> dict[str, str]:
    """The columns of all features' properties with their SQL types; names that differ in case alone are one to SQL."""
    found: dict[str, set[str]] = {}
    spelled: dict[str, str] = {}
    for each in features:
        for name, value in each["properties"].items():
            if name.lower() not in ("fid", "geom"):
                kinds = found.setdefault(spelled.setdefault(name.lower(), name), set())
                if value is not None:
                    kinds.add(_sql_type(value))
    mixed = {
        name: "REAL"
        if kinds == {"INTEGER", "REAL"} or (not kinds and _LENGTH.search(name))
        else "TEXT"
        for name, kinds in found.items()
    }
    return mixed | {
        name: kind for name, kinds in found.items() if len(kinds) == 1 for kind in kinds
    }


def _sql_type(value: object) -> str:
    if isinstance(value, bool):
        return "BOOLEAN"
    if isinstance(value, str):
        return "TEXT" if _moment(value) is None else "DATETIME"
    return "INTEGER" if isinstance(value, int) else "REAL" if isinstance(value, float) else "TEXT"


def _moment(text: str) -> str | None:
    """A time of RFC 3339 as GeoPackages write one, in UTC to the millisecond; None for other text."""
    if not _TIME.fullmatch(text):
        return None
    try:
        moment = datetime.fromisoformat(text).astimezone(UTC)
    except (ValueError, OverflowError):  # digits of no day or hour, as names may have them
        return None
    return moment.strftime("%Y-%m-%dT%H:%M:%S.") + f"{moment.microsecond // 1000:03d}Z"


def _plain(value: object, sql: str) -> object:
    if sql == "DATETIME" and isinstance(value, str):
        return _moment(value)
    return json.dumps(value) if isinstance(value, list | dict | tuple) else value


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


LAYER_STYLES: Mapping[str, Mapping[str, Any]] = tomllib.loads(
    files("sorvolo.store.exports").joinpath("layer_styles.toml").read_text(encoding="utf-8")
)
"""The style of each layer, by its name."""


def qml_of(style: Mapping[str, Any]) -> str:
    """A layer's style as a QML document (QGIS 3)."""
    return _for_qgis("layer_style", **style)


def qgs_of(name: str, layers: Iterable[str], map_: DatasetReader) -> str:
    """A project of QGIS 3: layers of `name`.gpkg in their styles over the map `name`-mosaic.tif, both beside it.

    Layers without a style are switched off.
    """
    return _for_qgis(
        "project",
        name=name,
        layers={layer: LAYER_STYLES.get(layer) for layer in layers},
        crs=map_.crs,
        wkt=map_.crs.to_wkt(),
        wgs84_wkt=_WGS84_WKT,
        bounds=map_.bounds,
        alpha_band=4 if map_.count == 4 else -1,
    )


def _for_qgis(template: str, **values: Any) -> str:
    head = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
    return head + xml_of(template, package="sorvolo.store.exports", **values).decode()
