"""OGC API Features over a site's collections: landing page, conformance, collections, items by place, time and more."""

from collections.abc import Sequence
from datetime import UTC, datetime, time
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request
from fastapi.responses import JSONResponse
from shapely.geometry import box, mapping

from sorvolo.errors import SettingsError
from sorvolo.paths import Json, JsonView
from sorvolo.station.collections import TITLES, Collection, SiteCollections
from sorvolo.station.exports import cogs_of, tilejson_address
from sorvolo.station.found import Feature
from sorvolo.station.problems import Problem
from sorvolo.station.reviews import Reviews
from sorvolo.station.security import FOR_VIEWERS, address
from sorvolo.station.sites import SiteShelf, bounds_lonlat
from sorvolo.store.exports.plain import moment_of
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import VersionEntry

_CONFORMS = [
    f"http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/{name}"
    for name in ("core", "oas30", "geojson")
]
_GEOJSON = "application/geo+json"
_MOST = 10_000  # features in one answer; by choice
Limit = Query(1000, ge=1, le=_MOST, description="Features at most.")
Offset = Query(0, ge=0, le=10**9)


class GeoJsonResponse(JSONResponse):
    """A feature, or a page of them."""

    media_type = _GEOJSON


def landing_links(request: Request, site: str) -> list[dict[str, str]]:
    """The links of a site's landing page; whole addresses, as in all answers here: QGIS reads no others."""
    base, api = _base(request, site), address(request, "/openapi.json")
    return [
        _link(base, "self", "application/json", "This site"),
        _link(api, "service-desc", "application/vnd.oai.openapi+json;version=3.0", "The API"),
        _link(f"{base}/conformance", "conformance", "application/json", "What it conforms to"),
        _link(f"{base}/collections", "data", "application/json", "Collections of features"),
    ]


def feature_routes(collections: SiteCollections, reviews: Reviews) -> APIRouter:
    """Conformance, collections and items of each site."""
    router = APIRouter(prefix="/api/sites/{site}", tags=["features"], dependencies=FOR_VIEWERS)

    @router.get("/conformance")
    def conformance(site: str) -> Json:
        """Which classes of OGC API Features are fulfilled."""
        collections.get(site, "frames")
        return {"conformsTo": _CONFORMS}

    @router.get("/collections")
    def list_collections(request: Request, site: str) -> Json:
        """The collections of a site."""
        base = _base(request, site)
        return {
            "links": [_link(f"{base}/collections", "self", "application/json", "Collections")],
            "collections": [_about(name, collections.get(site, name), base) for name in TITLES],
        }

    @router.get("/collections/{name}")
    def one_collection(request: Request, site: str, name: str) -> Json:
        """One collection: its extent and links."""
        return _about(name, collections.get(site, name), _base(request, site))

    @router.get("/collections/{name}/items", response_class=GeoJsonResponse)
    def items(
        request: Request,
        site: str,
        name: str,
        bbox: str = Query("", max_length=200),
        datetime: str = Query("", max_length=100),
        limit: int = Limit,
        offset: int = Offset,
        labels: str = Query("", alias="class", max_length=400),
        min_score: float | None = Query(None, ge=0, le=1),
        flight: str = Query("", max_length=400),
        review: str = Query("", max_length=40),
        from_version: int | None = Query(None, ge=0, le=2**62),
        to_version: int | None = Query(None, ge=0, le=2**62),
    ) -> JSONResponse:
        """Features: within a box, at a time, of classes, with a score at least, of flights, by verdict; in pages."""
        collection = collections.get(site, name)
        wanted = _places(collection, bbox)
        features = reviews.shown(site, name, [collection.features[each] for each in wanted])
        kept = _filtered(
            features, _interval(datetime), _words(labels), min_score, _words(flight), _words(review)
        )
        if name == "changes":
            kept = [each for each in kept if _between(each["properties"], from_version, to_version)]
        return GeoJsonResponse(_page(request, kept, limit, offset))

    @router.get("/collections/{name}/items/{feature_id}", response_class=GeoJsonResponse)
    def one_item(site: str, name: str, feature_id: str) -> JSONResponse:
        """One feature."""
        found = [
            each for each in collections.get(site, name).features if str(each["id"]) == feature_id
        ]
        if not found:
            raise Problem(404, f"{name} has no feature {feature_id[:80]!r}")
        return GeoJsonResponse(reviews.shown(site, name, found)[0])

    return router


def _base(request: Request, site: str) -> str:
    """The whole address of a site, under the name and scheme by which the client asked."""
    return address(request, f"/api/sites/{site}")


def _about(name: str, collection: Collection, base: str) -> Json:
    extent = {}
    if collection.shapes:
        edges = [each.bounds for each in collection.shapes]
        columns = list(zip(*edges))
        bbox = [min(columns[0]), min(columns[1]), max(columns[2]), max(columns[3])]
        extent = {
            "extent": {
                "spatial": {"bbox": [bbox], "crs": "http://www.opengis.net/def/crs/OGC/1.3/CRS84"}
            }
        }
    return {
        "id": name,
        "title": TITLES[name],
        "itemType": "feature",
        "count": len(collection.features),
        **extent,
        "crs": ["http://www.opengis.net/def/crs/OGC/1.3/CRS84"],
        "links": [
            _link(f"{base}/collections/{name}", "self", "application/json", TITLES[name]),
            _link(f"{base}/collections/{name}/items", "items", _GEOJSON, TITLES[name]),
        ],
    }


def _link(href: str, rel: str, kind: str, title: str) -> dict[str, str]:
    return {"href": href, "rel": rel, "type": kind, "title": title}


def _page(request: Request, features: Sequence[Feature], limit: int, offset: int) -> Json:
    shown = features[offset : offset + limit]
    path = address(request, request.url.path)
    links = [
        _link(
            f"{path}?{request.url.query}" if request.url.query else path,
            "self",
            _GEOJSON,
            "This page",
        )
    ]
    if offset + limit < len(features):
        query = urlencode({**dict(request.query_params), "limit": limit, "offset": offset + limit})
        links.append(_link(f"{path}?{query}", "next", _GEOJSON, "Next page"))
    return {
        "type": "FeatureCollection",
        "timeStamp": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "numberMatched": len(features),
        "numberReturned": len(shown),
        "links": links,
        "features": shown,
    }


def _places(collection: Collection, bbox: str) -> list[int]:
    """Which features to look at: all, or those that meet the box. Raises Problem (400) for what is no box."""
    if not bbox:
        return list(range(len(collection.features)))
    try:
        edges = [float(each) for each in bbox.split(",")]
    except ValueError:
        edges = []
    if len(edges) == 6:
        edges = [edges[0], edges[1], edges[3], edges[4]]
    if len(edges) != 4 or not all(-1e6 < each < 1e6 for each in edges) or edges[1] > edges[3]:
        raise Problem(400, f"bbox={bbox[:80]}: west,south,east,north in degrees was needed")
    if edges[0] > edges[2]:  # across the antimeridian
        west, south, east, north = edges
        found = {
            *collection.within([west, south, 180.0, north]),
            *collection.within([-180.0, south, east, north]),
        }
        return sorted(found)
    return collection.within(edges)


def _interval(text: str) -> tuple[datetime | None, datetime | None]:
    """Start and end of an RFC 3339 moment or interval, None: open. Raises Problem (400)."""
    if not text:
        return None, None
    parts = text.split("/")
    if len(parts) > 2:
        raise Problem(
            400, f"datetime={text[:80]}: a moment or START/END was needed, .. for an open end"
        )
    start, end = (
        None if each in ("", "..") else _moment(each, of_day)
        for each, of_day in ((parts[0], time.min), (parts[-1], time.max))
    )
    return start, end


def _moment(text: str, of_day: time = time.min) -> datetime:
    """A time; a date alone stands for this time of its day. Raises Problem (400)."""
    try:
        return moment_of(text, of_day)
    except SettingsError as error:
        raise Problem(
            400, f"datetime: {text[:60]!r} is no time such as 2026-05-31T12:00:00Z"
        ) from error


def _words(text: str) -> frozenset[str]:
    return frozenset(each.strip() for each in text.split(",") if each.strip())


def _filtered(
    features: Sequence[Feature],
    interval: tuple[datetime | None, datetime | None],
    labels: frozenset[str],
    min_score: float | None,
    flights: frozenset[str],
    verdicts: frozenset[str],
) -> list[Feature]:
    def is_wanted(values: JsonView) -> bool:
        return (
            (
                not labels
                or not labels.isdisjoint(
                    {values.get("class"), values.get("kind"), values.get("status")}
                )
            )
            and (min_score is None or (values.get("score") or 0.0) >= min_score)
            and (
                not flights
                or not flights.isdisjoint(values.get("flights") or [values.get("flight")])
            )
            and (not verdicts or (values.get("review") or "none") in verdicts)
            and _meets(values, interval)
        )

    return [each for each in features if is_wanted(each["properties"] or {})]


def _meets(values: JsonView, interval: tuple[datetime | None, datetime | None]) -> bool:
    start, end = interval
    if start is None and end is None:
        return True
    first = values.get("datetime")
    if not isinstance(first, str):
        return False
    last = values.get("end_datetime") or first
    return (start is None or _moment(str(last)) >= start) and (end is None or _moment(first) <= end)


def _between(values: JsonView, after: int | None, until: int | None) -> bool:
    """Whether a change came between two versions of the map: after the first, at the second or before it."""
    version = values.get("version") or 0
    low, high = min(after or 0, until or 2**62), max(after or 0, until or 2**62)
    return low < version <= high


_VERSION = "1.1.0"
_PROJECTION = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"


def stac_routes(shelf: SiteShelf) -> APIRouter:
    """The catalogue of all sites, the collection of each, the items of its versions."""
    router = APIRouter(prefix="/api/stac", tags=["STAC"], dependencies=FOR_VIEWERS)

    @router.get("")
    def catalogue(request: Request) -> Json:
        """The sites of this station."""
        links = [_link_stac(request, "self", "/api/stac"), _link_stac(request, "root", "/api/stac")]
        return {
            "type": "Catalog",
            "stac_version": _VERSION,
            "id": "sorvolo",
            "title": "Sorvolo station",
            "description": "Maps from small drones, each site with the versions of its map.",
            "links": [
                *links,
                *(
                    _link_stac(request, "child", f"/api/stac/{each}")
                    for each in sorted(shelf.folders())
                ),
            ],
        }

    @router.get("/{site}")
    def collection(request: Request, site: str) -> Json:
        """A site with its extent in space and time, and a link to each version."""
        archive = shelf.open(site)
        versions = archive.versions()
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
                _link_stac(request, "self", f"/api/stac/{site}"),
                _link_stac(request, "root", "/api/stac"),
                _link_stac(request, "parent", "/api/stac"),
                *(
                    _link_stac(
                        request, "item", f"/api/stac/{site}/{each.id}", "application/geo+json"
                    )
                    for each in versions
                ),
            ],
        }

    @router.get("/{site}/{version}", response_class=GeoJsonResponse)
    def item(request: Request, site: str, version: int) -> JSONResponse:
        """A version of the map: its ground, its time, its tiles, and the rasters of the newest one."""
        archive = shelf.open(site)
        versions = archive.versions()
        found = next((each for each in versions if each.id == version), None)
        if found is None:
            raise Problem(
                404, f"the map has no version {version}; /api/stac/{site} links to those there are"
            )
        bbox = _bbox(archive, version)
        assets = _assets(request, site, archive, found, is_newest=found.id == versions[-1].id)
        return GeoJsonResponse(
            {
                "type": "Feature",
                "stac_version": _VERSION,
                "stac_extensions": [_PROJECTION],
                "id": f"{site}-{version}",
                "collection": site,
                "geometry": bbox and mapping(box(*bbox)),
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
                    _link_stac(
                        request, "self", f"/api/stac/{site}/{version}", "application/geo+json"
                    ),
                    _link_stac(request, "root", "/api/stac"),
                    _link_stac(request, "parent", f"/api/stac/{site}"),
                    _link_stac(request, "collection", f"/api/stac/{site}"),
                ],
            }
        )

    return router


def _assets(
    request: Request, site: str, archive: Archive, version: VersionEntry, *, is_newest: bool
) -> Json:
    tiles = f"/api/sites/{site}/tiles/{version.id}/{{z}}/{{x}}/{{y}}.webp"
    assets: Json = {
        "tiles": {
            "href": address(request, tiles),
            "type": "image/webp",
            "title": "XYZ tiles",
            "roles": ["visual"],
        }
    }
    for cog in cogs_of(archive).values():
        belongs = is_newest if cog.id == "mosaic" else cog.id.partition(":")[2] == version.flight_id
        if belongs:
            assets[f"{cog.id}-tiles"] = {
                "href": address(request, tilejson_address(site, cog)),
                "type": "application/json",
                "title": f"{cog.title}, TileJSON",
                "roles": ["tiles"],
            }
            name = cog.file.rpartition("/")[2]
            file = name if cog.id == "mosaic" else f"{version.flight_id}-{name}"
            assets[cog.id] = {
                "href": address(request, f"/api/sites/{site}/exports/{file}"),
                "type": "image/tiff; application=geotiff; profile=cloud-optimized",
                "title": cog.title,
                "roles": ["data"],
                "proj:code": archive.site().crs,
            }
    return assets


def _bbox(archive: Archive, version: int | None) -> list[float] | None:
    if not archive.has_site:
        return None
    return bounds_lonlat(list(archive.tiles(version)), archive.site_grid())


def _time(version: VersionEntry) -> str:
    return version.flown_utc or version.created_utc


def _link_stac(
    request: Request, rel: str, href: str, kind: str = "application/json"
) -> dict[str, str]:
    return {"rel": rel, "href": address(request, href), "type": kind}
