"""Files of a site for other programs: what missions wrote, a GeoPackage of what the map shows, height profiles."""

import math
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

import attr
import rasterio
from fastapi import APIRouter, Depends, FastAPI, Query, Request, Response
from fastapi.responses import FileResponse, JSONResponse
from morecantile import tms as all_tile_matrix_sets
from morecantile.defaults import TileMatrixSets
from rasterio.errors import RasterioError
from rio_tiler.errors import RioTilerError, TileOutsideBounds
from rio_tiler.io import Reader
from rio_tiler.models import ImageData
from titiler.core.algorithm import Algorithms
from titiler.core.algorithm.dem import HillShade, Slope
from titiler.core.dependencies import BidxParams
from titiler.core.factory import TilerFactory
from titiler.core.utils import render_image

from sorvolo.missions.heights.measure import measure_profile
from sorvolo.paths import Json
from sorvolo.station.collections import SEARCH_FOLDER, TITLES, SiteCollections
from sorvolo.station.problems import Problem, problem_answer
from sorvolo.station.reviews import Reviews
from sorvolo.station.security import FOR_VIEWERS, address, needs
from sorvolo.station.sites import SiteShelf
from sorvolo.station.tokens import Role
from sorvolo.store.exports.geopackage import LAYER_STYLES, qgs_of, qml_of, write_geopackage
from sorvolo.store.exports.places import kml_bytes
from sorvolo.store.exports.plain import rounded
from sorvolo.store.nofollow import open_below
from sorvolo.store.site.archive import Archive

_OF_FLIGHT_cogs = {
    "orthophoto": "True orthophoto",
    "heights": "Surface heights, m",
    "terrain": "Bare ground, m",
}
_MATRIX_SETS = TileMatrixSets(
    {name: all_tile_matrix_sets.get(name) for name in ("WebMercatorQuad", "WGS1984Quad")}
)
_PREFIX = "/api/sites/{site}/cogs/{cog}"
_GDAL = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_CACHEMAX": 64,
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "none",
}


@dataclass(frozen=True)
class Cog:
    """A raster of a site: its id, its file below the site's folder, what it shows."""

    id: str
    file: str
    title: str


@attr.s
class TiffReader(Reader):
    """rio-tiler's reader that takes GeoTIFFs alone: a VRT in disguise would make GDAL open what it names."""

    def __attrs_post_init__(self) -> None:
        """Open the file."""
        self.dataset = self._ctx_stack.enter_context(rasterio.open(self.input, driver="GTiff"))
        super().__attrs_post_init__()  # type: ignore[no-untyped-call]

    def tile(self, *args: Any, **kwargs: Any) -> ImageData:
        """A tile. Raises RioTilerError for bands and values that the raster has not."""
        with _named():
            return super().tile(*args, **kwargs)


class TileFactory(TilerFactory):
    """titiler's routes of tiles and of what describes them; those that read a whole raster at once are left out."""

    def register_routes(self) -> None:
        """Information, tile sets, tiles, TileJSON."""
        for register in (self.info, self.tilesets, self.tile, self.tilejson):
            register()  # type: ignore[no-untyped-call]


@contextmanager
def _named() -> Iterator[None]:
    """Turn what titiler's libraries raise for impossible parameters into one kind of error."""
    try:
        yield
    except (IndexError, ValueError, TypeError, ArithmeticError) as error:
        raise RioTilerError(str(error)) from error


def _rendered(*args: Any, **kwargs: Any) -> tuple[bytes, str]:
    with _named():
        return render_image(*args, **kwargs)


def cogs_of(archive: Archive) -> dict[str, Cog]:
    """The rasters that are there, by id."""
    found = [Cog("mosaic", archive.mosaic_path.name, "The map")]
    for flight in archive.flights():
        found += [
            Cog(f"{name}:{flight.id}", f"flights/{flight.id}/{name}.tif", f"{title}, {flight.id}")
            for name, title in _OF_FLIGHT_cogs.items()
        ]
    found.append(Cog("pod", f"{SEARCH_FOLDER}/pod.tif", "Probability of detection"))
    return {each.id: each for each in found if (archive.folder / each.file).is_file()}


def tilejson_address(site: str, cog: Cog) -> str:
    """Where a raster's TileJSON is found."""
    return f"/api/sites/{site}/cogs/{cog.id}/WebMercatorQuad/tilejson.json"


def cog_routes(shelf: SiteShelf) -> list[APIRouter]:
    """The list of a site's rasters, and titiler's routes below each."""
    listing = APIRouter(prefix="/api/sites/{site}/cogs", tags=["rasters"], dependencies=FOR_VIEWERS)

    @listing.get("")
    def rasters(site: str) -> list[dict[str, str]]:
        """The rasters of a site, with the address of each one's TileJSON."""
        return [
            {"id": each.id, "title": each.title, "tilejson": tilejson_address(site, each)}
            for each in cogs_of(shelf.open(site)).values()
        ]

    factory = TileFactory(
        reader=TiffReader,
        path_dependency=_path_of(shelf),
        router_prefix=_PREFIX,
        layer_dependency=BidxParams,
        process_dependency=Algorithms({"hillshade": HillShade, "slope": Slope}).dependency,
        supported_tms=_MATRIX_SETS,
        render_func=_rendered,
        environment_dependency=lambda: dict(_GDAL),
        router=APIRouter(
            tags=["rasters"], dependencies=[needs(Role.VIEW), Depends(_within_bounds)]
        ),
    )
    below = APIRouter()
    below.include_router(factory.router, prefix=_PREFIX)
    return [listing, below]


def answer_raster_errors(app: FastAPI) -> None:
    """Let what titiler raises be answered by a problem document."""

    @app.exception_handler(TileOutsideBounds)
    async def _outside(_: Request, __: TileOutsideBounds) -> JSONResponse:
        words = "this tile shows nothing of the raster; its TileJSON states its bounds"
        return problem_answer(Problem(404, words))

    async def _unreadable(_: Request, error: Exception) -> JSONResponse:
        words = f"this cannot be drawn ({str(error)[:200]}); /openapi.json describes what can"
        return problem_answer(Problem(400, words))

    app.add_exception_handler(RioTilerError, _unreadable)
    app.add_exception_handler(RasterioError, _unreadable)


def _within_bounds(
    tilesize: Annotated[int | None, Query(gt=0, le=1024)] = None,
    buffer: Annotated[float | None, Query(gt=0, le=64)] = None,
    padding: Annotated[int | None, Query(gt=0, le=64)] = None,
) -> None:
    """What titiler leaves open: how large a tile may be asked for."""


def _path_of(shelf: SiteShelf) -> Callable[[str, str], str]:
    def path_of(site: str, cog: str) -> str:
        """The file of a raster by its id. Raises Problem (404), StoreError for a link or damage."""
        archive = shelf.open(site)
        found = cogs_of(archive).get(cog)
        if found is None:
            raise Problem(
                404,
                f"the site has no raster {cog[:80]!r}; /api/sites/{site}/cogs lists those there are",
            )
        archive.require_sound(found.file)
        with open_below(archive.folder, found.file):  # refuses links on the way
            return str(archive.folder / found.file)

    return path_of


_OF_SITE: Mapping[str, str] = {
    "mosaic.tif": "Map, Cloud Optimized GeoTIFF",
    "mosaic.kmz": "Map for Google Earth",
    "preview.png": "Map, small picture",
    "objects.geojson": "Objects, GeoJSON",
    "objects.kml": "Objects, KML",
    "objects.gpx": "Objects, GPX",
    "search/search.html": "Search: probability of detection, one file",
    "search/pod.tif": "Probability of detection, GeoTIFF",
    "search/pod.geojson": "Probability of detection, GeoJSON",
    "search/plants.geojson": "Search: what was planted and what of it found, GeoJSON",
}
_OF_FLIGHT: Mapping[str, str] = {
    "report.html": "report, one file",
    "report.json": "report, JSON",
    "changes.html": "changes, one file",
    "changes.geojson": "changes, GeoJSON",
    "changes.kml": "changes, KML",
    "changes.gpx": "changes, GPX",
    "coverage.geojson": "ground compared, GeoJSON",
    "frames.geojson": "frames, GeoJSON",
    "orthophoto.tif": "true orthophoto, GeoTIFF",
    "heights.tif": "surface heights, GeoTIFF",
    "terrain.tif": "bare ground, GeoTIFF",
}
_GEOPACKAGE, _PROJECT, _LINK = "site.gpkg", "site.qgs", "site.kml"
_KML = "application/vnd.google-earth.kml+xml"  # Google Earth takes a link's answer as no other
_MADE = {
    _GEOPACKAGE: "Objects, changes, frames and coverage, GeoPackage",
    _PROJECT: "Project for QGIS: GeoPackage and map, to be saved beside it",
    _LINK: "Objects, loaded again every 30 s, KML network link",
}
_MOST_PROFILE_PLACES, _MOST_PROFILE_POINTS = 50, 2000


@dataclass(frozen=True)
class ExportFile:
    """A file that a browser may have; `id` names it, `path` lies below the site."""

    id: str
    path: str
    title: str


def export_routes(shelf: SiteShelf, collections: SiteCollections, reviews: Reviews) -> APIRouter:
    """What can be taken away, each by its id; a profile of heights."""
    router = APIRouter(prefix="/api/sites/{site}", tags=["exports"], dependencies=FOR_VIEWERS)

    @router.get("/exports")
    def listed(site: str) -> list[Json]:
        """The files of a site that are there."""
        archive = shelf.open(site)
        rows = [
            _row(site, each, size)
            for each in export_files(archive)
            if (size := _size(archive, each)) is not None
        ]
        if archive.has_site:
            rows[2:2] = [
                _row(site, ExportFile(name, "", title), None)
                for name, title in _MADE.items()
                if name == _GEOPACKAGE or not archive.site().is_local
            ]
        return rows

    @router.get("/exports/{export_id}", response_class=FileResponse)
    def one(request: Request, site: str, export_id: str) -> Response:
        """One of them, to be kept; ranges are answered, so that GDAL reads of a GeoTIFF what it needs."""
        archive = shelf.open(site)
        if export_id == _GEOPACKAGE:
            if not archive.has_site:
                raise Problem(404, "this site has no map yet, so nothing for a GeoPackage")
            layers = {
                name: reviews.shown(site, name, collections.get(site, name).features)
                for name in TITLES
            }
            styles = {name: qml_of(style) for name, style in LAYER_STYLES.items()}
            with tempfile.TemporaryDirectory(prefix="sorvolo-") as folder:
                path = Path(folder) / _GEOPACKAGE
                write_geopackage(path, layers, styles, is_local=archive.site().is_local)
                made = path.read_bytes()  # another time other bytes: whole, no ranges
            headers = _as_file(f"{_plain_name(site)}.gpkg")
            return Response(made, media_type="application/octet-stream", headers=headers)
        if export_id == _PROJECT:
            return _project(site, archive, collections)
        if export_id == _LINK:
            objects = address(request, f"/api/sites/{site}/exports/objects.kml")
            link, named = kml_bytes(site, link=objects), _as_file(f"{_plain_name(site)}.kml")
            return Response(link, media_type=_KML, headers=named)
        found = next((each for each in export_files(archive) if each.id == export_id), None)
        if found is None or _size(archive, found) is None:
            raise Problem(
                404,
                f"no file {export_id[:80]!r} of this site; its list of exports names those there are",
            )
        archive.require_sound(found.path)
        return FileResponse(
            archive.folder / found.path,
            media_type=_KML if found.id.endswith(".kml") else "application/octet-stream",
            headers=_as_file(f"{_plain_name(site)}-{found.id}"),
        )

    @router.get("/profile")
    def profile(
        site: str,
        line: str = Query(max_length=4000),
        step_m: float = Query(0, ge=0, le=1000),
    ) -> Json:
        """Heights along a line, `LON,LAT;LON,LAT;...`; 404 where the site has no heights."""
        folder = shelf.open(site).folder
        points = measure_profile(folder, _places(line), step_m=step_m)
        points = points[:: max(1, math.ceil(len(points) / _MOST_PROFILE_POINTS))]
        known = [each.sigma_m for each in points if math.isfinite(each.sigma_m)]
        return {
            "distance_m": [each.way_m for each in points],
            "height_m": [rounded(each.surface_m, 3) for each in points],
            "ground_m": [rounded(each.ground_m, 3) for each in points],
            "sigma_m": sum(known) / len(known) if known else None,
        }

    return router


def export_files(archive: Archive) -> list[ExportFile]:
    """Everything that could be there, the site's own files first, then those of each flight, the newest first."""
    files = [ExportFile(path.rpartition("/")[2], path, title) for path, title in _OF_SITE.items()]
    for flight in reversed(archive.flights()) if archive.has_site else ():
        files += [
            ExportFile(
                f"{flight.id}-{name}", f"flights/{flight.id}/{name}", f"{flight.id}: {title}"
            )
            for name, title in _OF_FLIGHT.items()
        ]
    return files


def _size(archive: Archive, file: ExportFile) -> int | None:
    try:
        with open_below(archive.folder, file.path) as opened:
            return os.fstat(opened.fileno()).st_size
    except FileNotFoundError:
        return None


def _row(site: str, file: ExportFile, size: int | None) -> Json:
    url = f"/api/sites/{quote(site, safe='')}/exports/{quote(file.id, safe='')}"
    return {
        "id": file.id,
        "title": file.title,
        "bytes": size,
        "url": url,
        "name": f"{_plain_name(site)}-{file.id}",
    }


def _plain_name(site: str) -> str:
    return "".join(each if each.isalnum() or each in "-_." else "-" for each in site)


def _as_file(name: str) -> dict[str, str]:
    return {
        "content-disposition": f"attachment; filename*=UTF-8''{quote(name)}",
        "cache-control": "no-cache",
    }


def _project(site: str, archive: Archive, collections: SiteCollections) -> Response:
    if not archive.has_site or archive.site().is_local or not archive.mosaic_path.is_file():
        raise Problem(
            404, "a project for QGIS needs a map with a place on Earth; map a flight first"
        )
    archive.require_sound(archive.mosaic_path.name)
    name = _plain_name(site)
    layers = (each for each in TITLES if collections.get(site, each).features)
    with (
        open_below(archive.folder, archive.mosaic_path.name),  # refuses a link
        rasterio.open(archive.mosaic_path, driver="GTiff") as map_,
    ):
        made = qgs_of(name, layers, map_)  # the other exports' names begin with it
    return Response(made, media_type="application/x-qgis", headers=_as_file(f"{name}.qgs"))


def _places(line: str) -> list[str]:
    """The places of `LON,LAT;LON,LAT;...` as `LAT,LON` each. Raises Problem (400)."""
    places = [each.split(",") for each in line.split(";") if each]
    if not 2 <= len(places) <= _MOST_PROFILE_PLACES or any(len(each) != 2 for each in places):
        raise Problem(
            400,
            f"line={line[:80]}: 2 to {_MOST_PROFILE_PLACES} places LON,LAT;LON,LAT;... were needed",
        )
    return [f"{lat},{lon}" for lon, lat in places]
