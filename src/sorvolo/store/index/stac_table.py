"""Sites as STAC items in one GeoParquet file (stac-geoparquet 1.1, GeoParquet 1.1), for searches without a server."""

import importlib.util
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from sorvolo.errors import SettingsError
from sorvolo.geometry.units import DAY_NS
from sorvolo.store.atomic import atomic_path
from sorvolo.store.exports.change_files import crop_name, crop_names
from sorvolo.store.exports.places import longitude_latitude
from sorvolo.store.exports.plain import utc_text
from sorvolo.store.index.archive_index import FlightRows, flight_rows
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import VersionEntry
from sorvolo.store.site.files import HeightFile

if TYPE_CHECKING:
    import pyarrow

_STAC_VERSION = "1.1.0"
_VERSION = "1.1.0"  # of stac-geoparquet and of GeoParquet
_ROWS = 20_000  # in a row group: a reader skips those whose boxes lie elsewhere
_BOX = ("xmin", "ymin", "xmax", "ymax")
_ASSETS = ("map", "preview", "report", "frames", "heights", "orthophoto", "before", "after", "crop")
_PROPERTIES = {  # the items' own, with their types (docs/archives.md)
    "sorvolo:kind": "string",
    "sorvolo:site": "string",
    "sorvolo:flight": "string",
    "sorvolo:version": "int32",
    "sorvolo:mission": "string",
    "sorvolo:frames": "int32",
    "sorvolo:class": "string",
    "sorvolo:change": "string",
    "sorvolo:score": "double",
    "sorvolo:sigma_m": "double",
    "sorvolo:review": "string",
}
_TYPES = {
    ".tif": "image/tiff; application=geotiff; profile=cloud-optimized",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".html": "text/html",
    ".geojson": "application/geo+json",
}
_MAP_FILES = (
    ("map", "mosaic.tif", "The newest map", "data"),
    ("preview", "preview.png", "Preview", "thumbnail"),
)
_FLIGHT_FILES = (
    ("report", "report.html", "Report", "metadata"),
    ("frames", "frames.geojson", "What each frame shows", "metadata"),
    ("heights", HeightFile.SURFACE, "Height model", "data"),
    ("orthophoto", HeightFile.ORTHOPHOTO, "True orthophoto", "data"),
)
_Span = tuple[int, int | None, int | None]  # a moment, and first and last of a span, ns since 1970


class StacTable:
    """A file of items while it grows, made by `stac_table`; only `add` changes it."""

    def __init__(self, file: Any, schema: "pyarrow.Schema") -> None:
        self._file, self._schema = file, schema
        self._waiting: list[dict[str, Any]] = []
        self._collections: dict[str, Any] = {}
        self._boxes: list[Any] = []  # of each site
        self._kinds: set[str] = set()  # of geometries
        self.rows = 0

    def add(self, items: Sequence[dict[str, Any]]) -> None:
        """Add all items of one site."""
        if not items:
            return
        places = shapely.from_wkb([item["geometry"] for item in items])
        box = shapely.total_bounds(places).tolist()
        spans = [item["span_ns"] for item in items]
        first = min(moment if first is None else first for moment, first, _ in spans)
        last = max(moment if last is None else last for moment, _, last in spans)
        self._collections[items[0]["collection"]] = {
            "type": "Collection",
            "stac_version": _STAC_VERSION,
            "id": items[0]["collection"],
            "title": items[0]["title"],
            "license": "other",
            "description": "A map made of drone flights: its versions, flights, changes and objects.",
            "extent": {
                "spatial": {"bbox": [box]},
                "temporal": {"interval": [[utc_text(first), utc_text(last)]]},
            },
            "links": [],
        }
        self._boxes.append(box)
        self._kinds |= {place.geom_type for place in places}
        self.rows += len(items)
        self._waiting += items
        if len(self._waiting) >= _ROWS:
            self.write()

    def write(self) -> None:
        """Write what waits."""
        import pyarrow

        rows, self._waiting = self._waiting, []
        if rows:
            self._file.write_table(pyarrow.Table.from_pylist(rows, self._schema))

    def finish(self) -> None:
        """Write what waits, and what the whole file holds: longitude and latitude in WGS84, GeoParquet's default."""
        self.write()
        column: dict[str, Any] = {
            "encoding": "WKB",
            "geometry_types": sorted(self._kinds),
            "covering": {"bbox": {edge: ["bbox", edge] for edge in _BOX}},
        }
        if self._boxes:
            low, high = np.min(self._boxes, axis=0), np.max(self._boxes, axis=0)
            column["bbox"] = [*low[:2].tolist(), *high[2:].tolist()]
        geo = {"version": _VERSION, "primary_column": "geometry", "columns": {"geometry": column}}
        stac = {"version": _VERSION, "collections": self._collections}
        self._file.add_key_value_metadata(
            {"geo": json.dumps(geo), "stac-geoparquet": json.dumps(stac)}
        )


@contextmanager
def stac_table(path: Path) -> Iterator[StacTable]:
    """A file of items to be filled; it appears whole or not at all.

    Raises SettingsError where pyarrow is missing, StoreError on a full disk.
    """
    demand_pyarrow()
    import pyarrow as pa
    import pyarrow.parquet

    text, moment, number = pa.string(), pa.timestamp("us", tz="UTC"), pa.float64()
    asset = pa.struct([("href", text), ("type", text), ("title", text), ("roles", pa.list_(text))])
    link = pa.struct([("href", text), ("rel", text), ("type", text), ("title", text)])
    types = {"string": text, "int32": pa.int32(), "double": number}
    schema = pa.schema(
        [
            ("type", text),
            ("stac_version", text),
            ("stac_extensions", pa.list_(text)),
            ("id", text),
            ("collection", text),
            pa.field("geometry", pa.binary(), nullable=False),
            pa.field("bbox", pa.struct([(edge, number) for edge in _BOX])),
            ("links", pa.list_(link)),
            ("assets", pa.struct([(name, asset) for name in _ASSETS])),
            ("datetime", moment),
            ("start_datetime", moment),
            ("end_datetime", moment),
            ("created", moment),
            ("title", text),
            ("gsd", number),
            *((name, types[kind]) for name, kind in _PROPERTIES.items()),
        ]
    )
    with (
        atomic_path(path) as temporary,
        # with Arrow's own schema in the file, readers would look for the metadata there, which is written first
        pyarrow.parquet.ParquetWriter(
            temporary, schema, compression="zstd", store_schema=False
        ) as file,
    ):
        table = StacTable(file, schema)
        yield table
        table.finish()


def demand_pyarrow() -> None:
    """Raises SettingsError where the library that writes Parquet is not installed."""
    if importlib.util.find_spec("pyarrow") is None:
        raise SettingsError(
            "Parquet needs one more package; install it: pip install 'sorvolo[archive]'"
        )


def site_items(
    archive: Archive, name: str, address_of: Callable[[str], str]
) -> Iterator[dict[str, Any]]:
    """The items of a site with a place on Earth, the site itself first; none of one without a map.

    `name` is the site's path in the archive, `address_of` gives a file's address by its path in the site folder, "" for
    one that is not there. Raises StoreError for a damaged catalogue.
    """
    if not archive.has_site or archive.site().is_local:
        return
    site = archive.site()
    versions = archive.versions()
    grounds = {version.id: _ground(archive, version.id) for version in versions}
    shown = [(version, place) for version in versions if (place := grounds[version.id]) is not None]
    if shown:
        moments = [_moment_ns(version) for version, _ in shown]
        newest, _ = shown[-1]
        yield _item(
            name,
            "",
            site.name,
            shapely.union_all([place for _, place in shown]),
            (max(moments), min(moments), max(moments)),
            shown[0][0],
            {"sorvolo:kind": "site", "sorvolo:flight": None, "sorvolo:version": newest.id},
            _assets(_MAP_FILES, "", address_of),
            site.m_per_px,
        )
        for version, place in shown:
            yield _item(
                name,
                f"version-{version.id}",
                f"{site.name}, version {version.id}",
                place,
                (_moment_ns(version), None, None),
                version,
                {"sorvolo:kind": "version"},
                _assets(_MAP_FILES, "", address_of) if version is newest else {},
                site.m_per_px,
            )
    made = {version.flight_id: version for version in versions}
    for rows in flight_rows(archive, set(made)):
        yield from _flight_items(name, rows, made[rows.flight], address_of)


def _flight_items(
    name: str, rows: FlightRows, version: VersionEntry, address_of: Callable[[str], str]
) -> Iterator[dict[str, Any]]:
    """A flight, its changes and its objects; what has no place on the ground is left out."""
    folder = f"flights/{rows.flight}/"

    def span(first_ns: int, last_ns: int) -> _Span:
        is_dated = first_ns >= DAY_NS
        return (first_ns, first_ns, last_ns) if is_dated else (_moment_ns(version), None, None)

    place = rows.frames.place
    if place is not None:
        properties = {
            "sorvolo:kind": "flight",
            "sorvolo:mission": rows.kind,
            "sorvolo:frames": len(rows.frames.names),
        }
        times = span(rows.first_ns, rows.last_ns)
        assets = _assets(_FLIGHT_FILES, folder, address_of)
        yield _item(name, rows.flight, rows.flight, place, times, version, properties, assets)
    for kind, found in (("change", rows.changes), ("object", rows.objects)):
        for place, row in zip(found.places, found.columns, strict=True):
            number = row[f"{kind}_id"]
            properties = {
                "sorvolo:kind": kind,
                "sorvolo:class": row["label"],
                "sorvolo:score": row["score"],
                "sorvolo:sigma_m": row.get("sigma_m"),
            }
            files = [("crop", f"objects/{crop_name(number)}", "Best view", "visual")]
            if kind == "change":
                properties |= {
                    "sorvolo:change": row["kind"],
                    "sorvolo:review": row["verdict"] or None,
                }
                names = zip(("before", "after"), crop_names(number))
                files = [
                    (when, f"changes/{file}", when.capitalize(), "visual") for when, file in names
                ]
            times = span(row["first_ns"], row["last_ns"])
            assets = _assets(files, folder, address_of)
            title = f"{row['label']} ({number})"
            yield _item(name, number, title, place, times, version, properties, assets)


def _item(
    name: str,
    own: str,
    title: str,
    place: BaseGeometry,
    span: _Span,
    version: VersionEntry,
    properties: Mapping[str, Any],
    assets: Mapping[str, Any],
    gsd_m: float | None = None,
) -> dict[str, Any]:
    """One row: `own` is its id within the site, `place` in degrees of WGS84."""
    moment, first, last = (None if time_ns is None else _time(time_ns) for time_ns in span)
    common = {
        "sorvolo:site": name,
        "sorvolo:flight": version.flight_id,
        "sorvolo:version": version.id,
    }
    return {
        "type": "Feature",
        "stac_version": _STAC_VERSION,
        "stac_extensions": [],
        "id": f"{name}/{own}" if own else name,
        "collection": name,
        "geometry": shapely.to_wkb(place),
        "bbox": dict(zip(_BOX, place.bounds)),
        "links": [],
        "assets": assets,
        "datetime": moment,
        "start_datetime": first,
        "end_datetime": last,
        "created": datetime.fromisoformat(version.created_utc) if version.created_utc else None,
        "title": title,
        "gsd": gsd_m,
        "span_ns": span,  # no column
        **dict.fromkeys(_PROPERTIES),
        **common,
        **properties,
    }


def _ground(archive: Archive, version: int) -> BaseGeometry | None:
    """The tiles of a version as one outline in degrees; None without tiles."""
    tiles, site = np.array(sorted(archive.tiles(version))).reshape(-1, 2), archive.site()
    if not len(tiles):
        return None
    grid = archive.site_grid()
    corners_px = tiles * grid.grid.tile_px - 0.5
    squares = shapely.box(*corners_px.T, *(corners_px + grid.grid.tile_px).T)
    site_from_grid = np.linalg.inv(grid.grid_from_site_affine(np.zeros(2), 50.0))

    def degrees(points_px: Any) -> Any:
        return np.column_stack(
            longitude_latitude(points_px @ site_from_grid[:2, :2].T + site_from_grid[:2, 2], site)
        )

    return shapely.transform(shapely.union_all(squares).simplify(0), degrees)


def _moment_ns(version: VersionEntry) -> int:
    return round(version.moment.timestamp()) * 1_000_000_000


def _time(moment_ns: int) -> datetime:
    seconds, rest_ns = divmod(moment_ns, 1_000_000_000)
    return datetime.fromtimestamp(seconds, UTC).replace(microsecond=rest_ns // 1000)


def _assets(
    files: Sequence[tuple[str, str, str, str]], folder: str, address_of: Callable[[str], str]
) -> dict[str, Any]:
    """The files that are there, by the asset's name."""
    return {
        name: {"href": address, "type": _TYPES[Path(file).suffix], "title": title, "roles": [role]}
        for name, file, title, role in files
        if (address := address_of(folder + file))
    }
