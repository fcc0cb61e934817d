"""Rasters of a site (map, orthophotos, heights, probability of detection) as OGC tiles, by titiler; by ids only."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any

import attr
import rasterio
from fastapi import APIRouter, Depends, FastAPI, Query, Request
from fastapi.responses import JSONResponse
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

from sorvolo.station.collections import SEARCH_FOLDER
from sorvolo.station.problems import Problem, problem_answer
from sorvolo.station.security import needs
from sorvolo.station.sites import SiteShelf
from sorvolo.station.tokens import Role
from sorvolo.store.nofollow import open_below
from sorvolo.store.site.archive import Archive

_OF_FLIGHT = {
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
            for name, title in _OF_FLIGHT.items()
        ]
    found.append(Cog("pod", f"{SEARCH_FOLDER}/pod.tif", "Probability of detection"))
    return {each.id: each for each in found if (archive.folder / each.file).is_file()}


def tilejson_address(site: str, cog: Cog) -> str:
    """Where a raster's TileJSON is found."""
    return f"/api/sites/{site}/cogs/{cog.id}/WebMercatorQuad/tilejson.json"


def cog_routes(shelf: SiteShelf) -> list[APIRouter]:
    """The list of a site's rasters, and titiler's routes below each."""
    listing = APIRouter(
        prefix="/api/sites/{site}/cogs", tags=["rasters"], dependencies=[Depends(needs(Role.VIEW))]
    )

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
            tags=["rasters"], dependencies=[Depends(needs(Role.VIEW)), Depends(_within_bounds)]
        ),
    )
    below = APIRouter()
    below.include_router(factory.router, prefix=_PREFIX)
    return [listing, below]


def answer_raster_errors(app: FastAPI) -> None:
    """Let what titiler raises be answered by a problem document."""

    @app.exception_handler(TileOutsideBounds)
    async def _outside(_: Request, __: TileOutsideBounds) -> JSONResponse:
        return problem_answer(
            404, "this tile shows nothing of the raster; its TileJSON states its bounds"
        )

    async def _unreadable(_: Request, error: Exception) -> JSONResponse:
        return problem_answer(
            400, f"this cannot be drawn ({str(error)[:200]}); /openapi.json describes what can"
        )

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
