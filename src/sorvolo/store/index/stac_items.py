"""A site as STAC items: the site itself, its flights, the versions of its map, changes and objects."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from sorvolo.geometry.units import DAY_NS
from sorvolo.store.exports.change_files import crop_names
from sorvolo.store.exports.object_files import crop_name
from sorvolo.store.exports.places import longitude_latitude
from sorvolo.store.exports.stac_geoparquet import StacAsset, StacItem
from sorvolo.store.index.site_rows import FlightRows, flight_rows
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import VersionEntry
from sorvolo.store.site.files import HeightFile
from sorvolo.survey.flight import Site

PROPERTIES = {
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
"""The items' own properties (docs/archive-search.md) and their types."""

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


def site_items(archive: Archive, name: str, address_of: Callable[[str], str]) -> Iterator[StacItem]:
    """The items of a site with a place on Earth; none of one without a map.

    `name` is the site's path in the archive, `address_of` gives a file's address by its path in the site folder, "" for
    one that is not there. Raises StoreError for a damaged catalogue.
    """
    if not archive.has_site or archive.site().is_local:
        return
    versions = [each for each in archive.versions() if each.complete]
    yield from _map_items(archive, name, versions, address_of)
    made = {each.flight_id: each for each in versions}
    for rows in flight_rows(archive, set(made)):
        yield from _flight_items(name, rows, made[rows.flight], address_of)


def _map_items(
    archive: Archive, name: str, versions: list[VersionEntry], address_of: Callable[[str], str]
) -> Iterator[StacItem]:
    """The site and the versions of its map that have tiles."""
    site = archive.site()
    places = {
        each.id: place for each in versions if (place := _ground(archive, each.id)) is not None
    }
    shown = [each for each in versions if each.id in places]
    if shown:
        yield _site_item(name, site, shown, places, address_of)
    for version in shown:
        yield _version_item(
            name, site, version, places[version.id], address_of, is_newest=version is shown[-1]
        )


def _site_item(
    name: str,
    site: Site,
    versions: list[VersionEntry],
    places: Mapping[int, BaseGeometry],
    address_of: Callable[[str], str],
) -> StacItem:
    moments = [_moment_ns(each) for each in versions]
    return StacItem(
        name,
        name,
        site.name,
        shapely.union_all([places[each.id] for each in versions]),
        max(moments),
        min(moments),
        max(moments),
        versions[0].created_utc,
        site.m_per_px,
        {"sorvolo:kind": "site", "sorvolo:site": name, "sorvolo:version": versions[-1].id},
        _assets(_MAP_FILES, "", address_of),
    )


def _version_item(
    name: str,
    site: Site,
    version: VersionEntry,
    place: BaseGeometry,
    address_of: Callable[[str], str],
    *,
    is_newest: bool,
) -> StacItem:
    return StacItem(
        f"{name}/version-{version.id}",
        name,
        f"{site.name}, version {version.id}",
        place,
        _moment_ns(version),
        created_utc=version.created_utc,
        gsd_m=site.m_per_px,
        properties={
            "sorvolo:kind": "version",
            "sorvolo:site": name,
            "sorvolo:flight": version.flight_id,
            "sorvolo:version": version.id,
        },
        assets=_assets(_MAP_FILES, "", address_of) if is_newest else {},
    )


def _flight_items(
    name: str, rows: FlightRows, version: VersionEntry, address_of: Callable[[str], str]
) -> Iterator[StacItem]:
    """A flight, its changes and its objects; what has no place on the ground is left out."""
    common = {"sorvolo:site": name, "sorvolo:flight": rows.flight, "sorvolo:version": version.id}
    folder = f"flights/{rows.flight}/"
    is_dated = rows.first_ns >= DAY_NS
    place = rows.frames.place
    if place is not None:
        yield StacItem(
            f"{name}/{rows.flight}",
            name,
            rows.flight,
            place,
            rows.first_ns if is_dated else _moment_ns(version),
            rows.first_ns if is_dated else None,
            rows.last_ns if is_dated else None,
            version.created_utc,
            None,
            {
                **common,
                "sorvolo:kind": "flight",
                "sorvolo:mission": rows.kind,
                "sorvolo:frames": len(rows.frames.names),
            },
            _assets(_FLIGHT_FILES, folder, address_of),
        )
    for place, row in zip(rows.changes.places, rows.changes.columns, strict=True):
        before, after = crop_names(row["change_id"])
        yield _thing(
            name,
            row["change_id"],
            place,
            row,
            version,
            {
                **common,
                "sorvolo:kind": "change",
                "sorvolo:change": row["kind"],
                "sorvolo:review": row["verdict"] or None,
            },
            _assets(
                (
                    ("before", f"changes/{before}", "Before", "visual"),
                    ("after", f"changes/{after}", "After", "visual"),
                ),
                folder,
                address_of,
            ),
        )
    for place, row in zip(rows.objects.places, rows.objects.columns, strict=True):
        yield _thing(
            name,
            row["object_id"],
            place,
            row,
            version,
            {
                **common,
                "sorvolo:kind": "object",
                "sorvolo:sigma_m": row["sigma_m"],
            },
            _assets(
                (("crop", f"objects/{crop_name(row['object_id'])}", "Best view", "visual"),),
                folder,
                address_of,
            ),
        )


def _thing(
    name: str,
    id: str,
    place: BaseGeometry,
    row: Mapping[str, Any],
    version: VersionEntry,
    properties: Mapping[str, Any],
    assets: Mapping[str, StacAsset],
) -> StacItem:
    """A change or an object, with when it was seen."""
    is_dated = row["first_ns"] >= DAY_NS
    return StacItem(
        f"{name}/{id}",
        name,
        f"{row['label']} ({id})",
        place,
        row["first_ns"] if is_dated else _moment_ns(version),
        row["first_ns"] if is_dated else None,
        row["last_ns"] if is_dated else None,
        version.created_utc,
        None,
        {**properties, "sorvolo:class": row["label"], "sorvolo:score": row["score"]},
        assets,
    )


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


def _assets(
    files: tuple[tuple[str, str, str, str], ...], folder: str, address_of: Callable[[str], str]
) -> dict[str, StacAsset]:
    """The files that are there, by the asset's name."""
    found = {
        name: (address_of(folder + file), file, title, role) for name, file, title, role in files
    }
    return {
        name: StacAsset(address, _TYPES[Path(file).suffix], title, role)
        for name, (address, file, title, role) in found.items()
        if address
    }
