"""STAC 1.1 of a site: a collection, and an item for each version of its map."""

from collections.abc import Mapping, Sequence
from typing import Any

from fastapi import APIRouter, Depends
from fastapi.responses import JSONResponse

from sorvolo.station.cogs import cogs_of, tilejson_address
from sorvolo.station.ogc_features import GeoJsonResponse
from sorvolo.station.problems import Problem
from sorvolo.station.security import needs
from sorvolo.station.sites import SiteShelf, bounds_lonlat
from sorvolo.station.tokens import Role
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import VersionEntry

_VERSION = "1.1.0"


def stac_routes(shelf: SiteShelf) -> APIRouter:
    """The catalogue of all sites, the collection of each, the items of its versions."""
    router = APIRouter(prefix="/api/stac", tags=["STAC"], dependencies=[Depends(needs(Role.VIEW))])

    @router.get("")
    def catalogue() -> dict[str, Any]:
        """The sites of this station."""
        links = [_link("self", "/api/stac"), _link("root", "/api/stac")]
        return {
            "type": "Catalog",
            "stac_version": _VERSION,
            "id": "sorvolo",
            "title": "Sorvolo station",
            "description": "Maps from small drones, each site with the versions of its map.",
            "links": [
                *links,
                *(_link("child", f"/api/stac/{each}") for each in sorted(shelf.folders())),
            ],
        }

    @router.get("/{site}")
    def collection(site: str) -> dict[str, Any]:
        """A site with its extent in space and time, and a link to each version."""
        archive = shelf.open(site)
        versions = _complete(archive)
        return {
            "type": "Collection",
            "stac_version": _VERSION,
            "id": site,
            "license": "other",
            "title": archive.site().name if versions else site,
            "description": "A map made of drone flights; an item for each version of it.",
            "extent": {
                "spatial": {"bbox": [_bbox(archive, None) or [-180, -90, 180, 90]]},
                "temporal": {
                    "interval": [
                        [_time(versions[0]), _time(versions[-1])] if versions else [None, None]
                    ]
                },
            },
            "links": [
                _link("self", f"/api/stac/{site}"),
                _link("root", "/api/stac"),
                _link("parent", "/api/stac"),
                *(
                    _link("item", f"/api/stac/{site}/{each.id}", "application/geo+json")
                    for each in versions
                ),
            ],
        }

    @router.get("/{site}/{version}", response_class=GeoJsonResponse)
    def item(site: str, version: int) -> JSONResponse:
        """A version of the map: its ground, its time, its tiles, and the rasters of the newest one."""
        archive = shelf.open(site)
        versions = _complete(archive)
        found = next((each for each in versions if each.id == version), None)
        if found is None:
            raise Problem(
                404, f"the map has no version {version}; /api/stac/{site} links to those there are"
            )
        bbox = _bbox(archive, version)
        assets = _assets(site, archive, found, is_newest=found.id == versions[-1].id)
        return GeoJsonResponse(
            {
                "type": "Feature",
                "stac_version": _VERSION,
                "stac_extensions": [],
                "id": f"{site}-{version}",
                "collection": site,
                "geometry": _ring(bbox),
                "bbox": bbox,
                "properties": {
                    "datetime": _time(found),
                    "created": found.created_utc,
                    "title": f"{site}, version {version}",
                    "gsd": archive.site().m_per_px,
                    "sorvolo:flight": found.flight_id,
                    "sorvolo:parent": found.parent_id,
                },
                "assets": assets,
                "links": [
                    _link("self", f"/api/stac/{site}/{version}", "application/geo+json"),
                    _link("root", "/api/stac"),
                    _link("parent", f"/api/stac/{site}"),
                    _link("collection", f"/api/stac/{site}"),
                ],
            }
        )

    return router


def _assets(
    site: str, archive: Archive, version: VersionEntry, *, is_newest: bool
) -> dict[str, Any]:
    tiles = f"/api/sites/{site}/tiles/{version.id}/{{z}}/{{x}}/{{y}}.webp"
    assets: dict[str, Any] = {
        "tiles": {"href": tiles, "type": "image/webp", "title": "XYZ tiles", "roles": ["visual"]}
    }
    for cog in cogs_of(archive).values():
        belongs = is_newest if cog.id == "mosaic" else cog.id.partition(":")[2] == version.flight_id
        if belongs:
            href = tilejson_address(site, cog)
            assets[cog.id] = {
                "href": href,
                "type": "application/json",
                "title": cog.title,
                "roles": ["tiles"],
            }
    return assets


def _complete(archive: Archive) -> Sequence[VersionEntry]:
    return [each for each in archive.versions() if each.complete]


def _bbox(archive: Archive, version: int | None) -> list[float] | None:
    if not archive.has_site:
        return None
    return bounds_lonlat(list(archive.tiles(version)), archive.site_grid())


def _ring(bbox: Sequence[float] | None) -> Mapping[str, Any] | None:
    if bbox is None:
        return None
    west, south, east, north = bbox
    return {
        "type": "Polygon",
        "coordinates": [
            [
                [west, south],
                [east, south],
                [east, north],
                [west, north],
                [west, south],
            ]
        ],
    }


def _time(version: VersionEntry) -> str:
    return version.flown_utc or version.created_utc


def _link(rel: str, href: str, kind: str = "application/json") -> dict[str, str]:
    return {"rel": rel, "href": href, "type": kind}
