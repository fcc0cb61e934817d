"""STAC items as one GeoParquet file (stac-geoparquet 1.1, GeoParquet 1.1), for searches without a server."""

import importlib.util
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from sorvolo.errors import SettingsError
from sorvolo.store.atomic import atomic_path
from sorvolo.store.exports.plain import utc_text

if TYPE_CHECKING:
    import pyarrow

STAC_VERSION = "1.1.0"
ASSETS = ("map", "preview", "report", "frames", "heights", "orthophoto", "before", "after", "crop")
_VERSION = "1.1.0"  # of stac-geoparquet and of GeoParquet
_ROWS = 20_000  # in a row group: a reader skips those whose boxes lie elsewhere


@dataclass(frozen=True, eq=False)
class StacItem:
    """One item: `place` in degrees of WGS84, moments in ns since 1970, `properties` by column, `assets` by name.

    `first_ns` and `last_ns` are None for what happened at one moment.
    """

    id: str
    collection: str
    title: str
    place: BaseGeometry
    moment_ns: int
    first_ns: int | None = None
    last_ns: int | None = None
    created_utc: str = ""
    gsd_m: float | None = None
    properties: Mapping[str, Any] = field(default_factory=dict)
    assets: Mapping[str, "StacAsset"] = field(default_factory=dict)


@dataclass(frozen=True)
class StacAsset:
    """A file that belongs to an item."""

    href: str
    type: str
    title: str
    role: str


@dataclass
class _Extent:
    """The ground and the kinds of geometries of what was written."""

    bounds: tuple[float, float, float, float] = (np.inf, np.inf, -np.inf, -np.inf)
    types: set[str] = field(default_factory=set)
    rows: int = 0

    def add(self, place: BaseGeometry) -> None:
        west, south, east, north = place.bounds
        known = self.bounds
        self.bounds = (
            min(known[0], west),
            min(known[1], south),
            max(known[2], east),
            max(known[3], north),
        )
        self.types.add(place.geom_type)
        self.rows += 1


class ItemTable:
    """A file of items while it grows, made by `item_table`; only `add` changes it."""

    def __init__(self, file: Any, schema: "pyarrow.Schema", own: Mapping[str, str]) -> None:
        self._file, self._schema, self._own = file, schema, own
        self._waiting: list[StacItem] = []
        self._collections: dict[str, Any] = {}
        self._extent = _Extent()

    @property
    def rows(self) -> int:
        """How many items it has."""
        return self._extent.rows

    def add(self, items: Sequence[StacItem], title: str) -> None:
        """Add all items of one collection, which has this title."""
        if not items:
            return
        self._collections[items[0].collection] = _collection(items, title)
        for each in items:
            self._extent.add(each.place)
        self._waiting += items
        if len(self._waiting) >= _ROWS:
            self._write()

    def finish(self) -> None:
        """Write what waits, and what the whole file holds."""
        self._write()
        self._file.add_key_value_metadata(
            {
                "geo": json.dumps(_geo(self._extent)),
                "stac-geoparquet": json.dumps(
                    {"version": _VERSION, "collections": self._collections}
                ),
            }
        )

    def _write(self) -> None:
        import pyarrow

        rows, self._waiting = [_row(each, self._own) for each in self._waiting], []
        if rows:
            self._file.write_table(pyarrow.Table.from_pylist(rows, self._schema))


@contextmanager
def item_table(path: Path, own: Mapping[str, str]) -> Iterator[ItemTable]:
    """A file of items to be filled; it appears whole or not at all.

    `own` are the items' own properties with their types ("string", "int32", "double"). Raises SettingsError where
    pyarrow is missing, StoreError on a full disk.
    """
    demand_pyarrow()
    import pyarrow.parquet

    schema = _schema(own)
    with (
        atomic_path(path) as temporary,
        # with Arrow's own schema in the file, readers would look for the metadata there, which is written first
        pyarrow.parquet.ParquetWriter(
            temporary, schema, compression="zstd", store_schema=False
        ) as file,
    ):
        table = ItemTable(file, schema, own)
        yield table
        table.finish()


def demand_pyarrow() -> None:
    """Raises SettingsError where the library that writes Parquet is not installed."""
    if importlib.util.find_spec("pyarrow") is None:
        raise SettingsError(
            "Parquet needs one more package; install it: pip install 'sorvolo[archive]'"
        )


def _collection(items: Sequence[StacItem], title: str) -> dict[str, Any]:
    """STAC's record of a collection: its ground and its span of time."""
    extent = _Extent()
    for each in items:
        extent.add(each.place)
    first = min(each.moment_ns if each.first_ns is None else each.first_ns for each in items)
    last = max(each.moment_ns if each.last_ns is None else each.last_ns for each in items)
    return {
        "type": "Collection",
        "stac_version": STAC_VERSION,
        "id": items[0].collection,
        "title": title,
        "license": "other",
        "description": "A map made of drone flights: its versions, flights, changes and objects.",
        "extent": {
            "spatial": {"bbox": [list(extent.bounds)]},
            "temporal": {"interval": [[utc_text(first), utc_text(last)]]},
        },
        "links": [],
    }


def _row(item: StacItem, own: Mapping[str, str]) -> dict[str, Any]:
    west, south, east, north = item.place.bounds
    return {
        "type": "Feature",
        "stac_version": STAC_VERSION,
        "stac_extensions": [],
        "id": item.id,
        "collection": item.collection,
        "geometry": shapely.to_wkb(item.place),
        "bbox": {"xmin": west, "ymin": south, "xmax": east, "ymax": north},
        "links": [],
        "assets": {
            name: {"href": each.href, "type": each.type, "title": each.title, "roles": [each.role]}
            for name, each in item.assets.items()
        },
        "datetime": _time(item.moment_ns),
        "start_datetime": _time(item.first_ns),
        "end_datetime": _time(item.last_ns),
        "created": datetime.fromisoformat(item.created_utc) if item.created_utc else None,
        "title": item.title,
        "gsd": item.gsd_m,
        **{name: item.properties.get(name) for name in own},
    }


def _time(moment_ns: int | None) -> datetime | None:
    if moment_ns is None:
        return None
    seconds, rest_ns = divmod(moment_ns, 1_000_000_000)
    return datetime.fromtimestamp(seconds, UTC).replace(microsecond=rest_ns // 1000)


def _schema(own: Mapping[str, str]) -> "pyarrow.Schema":
    import pyarrow as pa

    text, moment = pa.string(), pa.timestamp("us", tz="UTC")
    asset = pa.struct([("href", text), ("type", text), ("title", text), ("roles", pa.list_(text))])
    link = pa.struct([("href", text), ("rel", text), ("type", text), ("title", text)])
    types = {"string": text, "int32": pa.int32(), "double": pa.float64()}
    return pa.schema(
        [
            ("type", text),
            ("stac_version", text),
            ("stac_extensions", pa.list_(text)),
            ("id", text),
            ("collection", text),
            pa.field("geometry", pa.binary(), nullable=False),
            pa.field(
                "bbox",
                pa.struct([(each, pa.float64()) for each in ("xmin", "ymin", "xmax", "ymax")]),
            ),
            ("links", pa.list_(link)),
            ("assets", pa.struct([(each, asset) for each in ASSETS])),
            ("datetime", moment),
            ("start_datetime", moment),
            ("end_datetime", moment),
            ("created", moment),
            ("title", text),
            ("gsd", pa.float64()),
            *((name, types[kind]) for name, kind in own.items()),
        ]
    )


def _geo(extent: _Extent) -> dict[str, Any]:
    """The metadata of GeoParquet: longitude and latitude in WGS84 (its default), with boxes for skipping."""
    column: dict[str, Any] = {
        "encoding": "WKB",
        "geometry_types": sorted(extent.types),
        "covering": {"bbox": {each: ["bbox", each] for each in ("xmin", "ymin", "xmax", "ymax")}},
    }
    if extent.rows:
        column["bbox"] = list(extent.bounds)
    return {"version": _VERSION, "primary_column": "geometry", "columns": {"geometry": column}}
