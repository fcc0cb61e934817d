"""Heights of mapped flights: cameras in 3D, a height model, the bare ground and a true orthophoto, as files."""

import resource
import time
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.grid import SiteGrid
from sorvolo.heights.cameras import Cameras3D, CameraSettings, solve_cameras
from sorvolo.heights.figures import (
    OwnPointSettings,
    camera_figures,
    camera_warnings,
    judged_by_points,
    relief_picture,
    surface_figures,
    surface_warnings,
)
from sorvolo.heights.lattice import CellSettings, Lattice
from sorvolo.heights.orthophoto import OrthophotoSettings, paint_orthophoto
from sorvolo.heights.surface import Surface, SurfaceSettings, sweep_surface
from sorvolo.heights.terrain import TerrainSettings, terrain
from sorvolo.heights.views import View, ground_outlines_m
from sorvolo.missions.flight.headline import contradicts_itself
from sorvolo.missions.heights.flight_views import flight_views, run_of
from sorvolo.missions.heights.pictures import FlightPictures, SmallPictures
from sorvolo.store.atomic import atomic_write_bytes, scratch_folder
from sorvolo.store.exports.plain import json_bytes
from sorvolo.store.freed_memory import give_back
from sorvolo.store.images import png_from_rgba
from sorvolo.store.rasters.geotiff import write_cog
from sorvolo.store.rasters.heights import write_height_cog
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import Catalogues
from sorvolo.store.site.files import HeightFile
from sorvolo.store.site.tiles import TileFolder
from sorvolo.survey.flight import Site


@dataclass(frozen=True)
class HeightSettings:
    """What a person may choose, and the settings of the stages."""

    cell_m: float | None = None  # of the height model; None: by `cells`
    cells: CellSettings = field(default_factory=CellSettings)
    has_orthophoto: bool = True
    cameras: CameraSettings = field(default_factory=CameraSettings)
    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    own_points: OwnPointSettings = field(default_factory=OwnPointSettings)
    terrain: TerrainSettings = field(default_factory=TerrainSettings)
    orthophoto: OrthophotoSettings = field(default_factory=OrthophotoSettings)

    def __post_init__(self) -> None:
        if self.cell_m is not None and not 0.001 <= self.cell_m <= 100:
            raise SettingsError(f"--cell {self.cell_m}: give metres, 0.001 to 100")


@dataclass(frozen=True)
class HeightsUpdate:
    """How far the heights of a flight are: the stage, and the share of it that is done."""

    flight_id: str
    stage: str
    share: float


def make_heights(
    site: Path,
    settings: HeightSettings = HeightSettings(),
    *,
    flight: str | None = None,
    catalogues: Catalogues | None = None,
) -> Generator[HeightsUpdate]:
    """Make the heights of one mapped flight (None: the newest) as files in its folder, yielding progress.

    `catalogues` has the site's; None: that of the environment. Raises InputError for a flight that has no heights to
    give (no GPS, too few photos that overlap), StoreError for a folder that is no site.
    """
    Archive.open(
        site, write=False, catalogues=catalogues
    ).close()  # to write would make a folder that is not there
    with Archive.open(site, write=True, catalogues=catalogues) as archive:
        flight_id = flight or newest_flight(archive)
        keyframes = [
            each for each in archive.keyframes(flight_id) if each.site_from_camera is not None
        ]
        started_s = time.monotonic()
        views = flight_views(archive, flight_id, keyframes)
        _lattice(archive.site(), views, settings)  # too many cells end here, before minutes of work
        yield HeightsUpdate(flight_id, "cameras", 0.0)
        solved = solve_cameras(views, FlightPictures(archive, keyframes).gray, settings.cameras)
        kept = [each for each in keyframes if each.name not in set(solved.lost)]
        pictures = FlightPictures(archive, kept, solved.radial)
        cameras_s = time.monotonic() - started_s
        give_back()
        swept = yield from _sweep(archive, solved, pictures, settings, flight_id)
        surface, judgement = judged_by_points(swept, solved, settings.own_points)
        mapped = archive.report(flight_id)
        yield HeightsUpdate(flight_id, "ground", 0.0)
        ground, shows_ground = terrain(surface.lattice, surface.up_m, settings.terrain)
        _write_models(archive, flight_id, surface, ground)
        heights_s = time.monotonic() - started_s
        give_back()
        if settings.has_orthophoto:
            yield from _paint(archive, surface, solved, pictures, settings, flight_id)
        report = {
            "flight": flight_id,
            "run": run_of(keyframes),
            "cell_m": surface.lattice.cell_m,
            "height_reference": archive.site().height_reference,
            "cameras": camera_figures(solved),
            "surface": surface_figures(surface, shows_ground, judgement),
            "warnings": [
                *_map_warnings(mapped),
                *camera_warnings(solved),
                *surface_warnings(surface),
            ],
            "contradicts_itself": contradicts_itself(mapped),
            "seconds": {
                "cameras": cameras_s,
                "heights": heights_s,
                "total": time.monotonic() - started_s,
            },
            "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }
        atomic_write_bytes(archive.height_path(flight_id, HeightFile.REPORT), json_bytes(report))
        yield HeightsUpdate(flight_id, "done", 1.0)


def _map_warnings(mapped: Mapping[str, Any]) -> list[str]:
    """What of a flight's report, of its map, spoils its heights too."""
    warnings = []
    if contradicts_itself(mapped):
        warnings.append(
            f"the flight has {mapped['headline'].get('text')}; do not build on its heights"
        )
    if any(each.get("code") == "zoom" for each in mapped.get("notices", ())):
        warnings.append(
            "the photos have different focal lengths and were taken as of one lens: heights are wrong by more than "
            "their stated error; map the photos of each focal length as a flight of their own"
        )
    return warnings


def newest_flight(archive: Archive) -> str:
    """The flight that made the newest map. Raises InputError while there is none."""
    complete = [each for each in archive.versions() if each.complete]
    if not complete:
        raise InputError(
            f"{archive.folder} has no flight yet; map one: sorvolo map INPUT --site {archive.folder}"
        )
    return complete[-1].flight_id


def height_grid(site: Site, cell_m: float) -> SiteGrid:
    """The grid whose cells a height model of the site has."""
    return SiteGrid.at(site.origin, cell_m, site.crs)


def _sweep(
    archive: Archive,
    solved: Cameras3D,
    pictures: FlightPictures,
    settings: HeightSettings,
    flight_id: str,
) -> Generator[HeightsUpdate, None, Surface]:
    lattice = _lattice(archive.site(), solved.views, settings)

    small = SmallPictures(pictures, solved.views, settings.surface.sizes_m(lattice.cell_m))
    for each in sweep_surface(
        lattice, solved.views, small.gray, solved.points_m, solved.height_sigma, settings.surface
    ):
        if isinstance(each, Surface):
            return each
        yield HeightsUpdate(flight_id, "heights", each)
    raise AssertionError("a sweep ends with a surface")


def _lattice(site: Site, views: Sequence[View], settings: HeightSettings) -> Lattice:
    """The cells over the ground that the views show. Raises GeometryError for more of them than can be handled."""
    outlines_m = ground_outlines_m(views)
    cell_m = settings.cell_m or Lattice.cell_for(outlines_m, site.m_per_px, settings.cells)
    return Lattice.over(outlines_m, height_grid(site, cell_m))


def _write_models(archive: Archive, flight_id: str, surface: Surface, ground: Any) -> None:
    site = archive.site()
    grid = height_grid(site, surface.lattice.cell_m).grid
    zero_m = site.origin.height_m
    write_height_cog(
        surface.above(zero_m),
        (f"height, {site.height_reference}", "one sigma"),
        surface.lattice.first,
        grid,
        archive.height_path(flight_id, HeightFile.SURFACE),
    )
    write_height_cog(
        [ground + zero_m],
        (f"bare ground, {site.height_reference}",),
        surface.lattice.first,
        grid,
        archive.height_path(flight_id, HeightFile.GROUND),
    )
    atomic_write_bytes(
        archive.height_path(flight_id, HeightFile.PICTURE), png_from_rgba(relief_picture(surface))
    )


def _paint(
    archive: Archive,
    surface: Surface,
    solved: Cameras3D,
    pictures: FlightPictures,
    settings: HeightSettings,
    flight_id: str,
) -> Generator[HeightsUpdate]:
    folder, site_grid = archive.flight_folder(flight_id), archive.site_grid()
    with scratch_folder(folder) as scratch:
        tiles = TileFolder(scratch)
        painting = paint_orthophoto(
            surface, site_grid, solved.views, pictures.colour, settings.orthophoto
        )
        for index, rgba, share in painting:
            tiles.save(index, rgba)
            yield HeightsUpdate(flight_id, "orthophoto", share)
        write_cog(tiles, site_grid, archive.height_path(flight_id, HeightFile.ORTHOPHOTO))
