"""Heights of mapped flights: cameras in 3D, a height model, the bare ground and a true orthophoto, as files."""

import json
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Floats, Floats32, ImageGray, ImageRGB, ImageRGBA, PointsM
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.geometry.pose import Pose
from sorvolo.heights.cameras import Cameras3D, Tracks, find_tracks, solve_tracks
from sorvolo.heights.figures import (
    camera_figures,
    camera_warnings,
    judged_by_points,
    relief_picture,
    surface_figures,
    surface_warnings,
)
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.orthophoto import paint_orthophoto
from sorvolo.heights.surface import Surface, sizes_m, sweep_surface
from sorvolo.heights.terrain import closed, terrain
from sorvolo.heights.views import View, fix_from_residual, ground_outlines_m, pixels_wide
from sorvolo.missions.flight.headline import contradicts_itself
from sorvolo.missions.flight.report import peak_memory_mb
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.mission import FlightOutcome, mission
from sorvolo.mosaic.exposure import corrected
from sorvolo.paths import AnyPath
from sorvolo.registration.features import gray_from_rgb
from sorvolo.registration.lens import Undistorter, at_size, refined_camera
from sorvolo.store.atomic import atomic_write_bytes, scratch_folder
from sorvolo.store.exports.plain import features_name, json_bytes
from sorvolo.store.freed_memory import give_back
from sorvolo.store.images import BytesCache, ImageCache, png_from_rgba
from sorvolo.store.rasters.geotiff import write_cog
from sorvolo.store.rasters.height_model import write_height_cog
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.store.site.catalogue_place import Catalogues
from sorvolo.store.site.files import HeightFile
from sorvolo.store.site.tiles import TileFolder
from sorvolo.survey.flight import Site

_MOST_BYTES = 256_000_000  # of frames.geojson; 10,000 frames have some ten; by choice
_AXES = ("east", "north", "up")
_ASIDE_M = 2.0  # about a place: one false match pulls less of the ground there down


def flight_views(
    archive: Archive, flight_id: str, keyframes: Sequence[StoredKeyframe]
) -> list[View]:
    """The views of a flight. Raises InputError for one without cameras in space, or without metres."""
    if not keyframes:
        known = ", ".join(each.id for each in archive.flights()) or "none"
        raise InputError(
            f"{archive.folder} has no cameras in space of a flight {flight_id!r} (its flights: {known}); "
            "give a flight mapped with --method planar"
        )
    if archive.site().is_local:
        raise InputError(
            f"{archive.folder} has no GPS and so no metres; map a flight with GPS positions into a new site"
        )
    residuals = _residuals_m(archive, flight_id)
    return [
        View(
            each.name,
            each.camera,
            each.site_from_camera,
            fix_from_residual(each.site_from_camera, residuals.get(each.name, (None, None, None))),
        )
        for each in keyframes
        if each.site_from_camera is not None
    ]


def run_of(keyframes: Sequence[StoredKeyframe]) -> str:
    """Which mapping run the keyframes are of: heights of another run do not fit the map any more."""
    return keyframes[0].image_path.rsplit("/", 2)[-2]


def _residuals_m(archive: Archive, flight_id: str) -> dict[str, tuple[float | None, ...]]:
    """Camera minus fix of each frame by name, None where there was no fix."""
    path = archive.flight_folder(flight_id) / features_name("frames", is_local=False)
    try:
        name = path.relative_to(archive.folder).as_posix()
        features = json.loads(archive.read_file(name, _MOST_BYTES))["features"]
        rows = [each["properties"] for each in features]
        return {
            str(row["frame"]): tuple(row[f"gps_residual_{axis}_m"] for axis in _AXES)
            for row in rows
        }
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is gone or damaged ({error!r}); map the flight again") from error


_LARGE_BYTES = 192 << 20  # of pictures as stored, for the orthophoto: five of 12 megapixels
_SMALL_BYTES = (
    128 << 20
)  # of gray ones, for the sweep: about a hundred of 4000 px at the usual cells


def lens_left_over(camera: Camera, radial: tuple[float, float]) -> Undistorter | None:
    """What takes the distortion that heights found out of a camera's stored pictures; None where they found none."""
    return Undistorter(refined_camera(camera, 1.0, *radial)) if any(radial) else None


class FlightPictures:
    """Loads and corrects pictures, and keeps those last asked for by `colour`; numbers count the keyframes given."""

    def __init__(
        self,
        archive: Archive,
        keyframes: Sequence[StoredKeyframe],
        radial: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self._archive, self._keyframes = archive, keyframes
        self._lens = lens_left_over(keyframes[0].camera, radial)
        self._large = ImageCache(self.load, _LARGE_BYTES)

    def colour(self, number: int) -> ImageRGB:
        """What `load` gives, kept."""
        return self._large.get(number)

    def release(self) -> None:
        """Drop the pictures that are kept."""
        self._large.clear()
        give_back()

    def gray(self, number: int) -> ImageGray:
        """A picture in gray, as it is stored; it is not kept."""
        return gray_from_rgb(self.load(number))

    def grays(self, number: int, widths: Sequence[int]) -> dict[int, ImageGray]:
        """A picture in gray, so many pixels wide each; decoded once, and not kept."""
        image, camera = self.load(number), self._keyframes[number].camera
        return {
            width: gray_from_rgb(
                at_size(image, width, round(width * camera.height_px / camera.width_px))
            )
            for width in widths
        }

    def load(self, number: int) -> ImageRGB:
        """A picture as it is stored, corrected; it is not kept."""
        keyframe = self._keyframes[number]
        image = corrected(self._archive.image(keyframe), keyframe.gains, keyframe.vignette)
        return image if self._lens is None else self._lens.undistort(image)


class SmallPictures:
    """The pictures of a flight in gray, their pixels covering about each of `sizes_m` of ground; those used last stay.

    A picture that is coarser than a size comes as it is. All its sizes are made when it is decoded, for a sweep needs
    one after the other.
    """

    def __init__(
        self,
        pictures: FlightPictures,
        views: Sequence[View],
        sizes_m: Sequence[float],
    ) -> None:
        self._pictures, self._views, self._sizes_m = pictures, views, sizes_m
        self._kept = BytesCache[int, dict[int, ImageGray]](
            _SMALL_BYTES, lambda sizes: sum(each.nbytes for each in sizes.values())
        )

    def gray(self, number: int, size_m: float) -> ImageGray:
        """View `number`'s picture, its pixels covering `size_m`, one of the sizes."""
        widths = {pixels_wide(self._views[number], each) for each in self._sizes_m}
        sizes = self._kept.get(number, lambda: self._pictures.grays(number, sorted(widths)))
        return sizes[pixels_wide(self._views[number], size_m)]


@dataclass(frozen=True)
class HeightsUpdate:
    """How far the heights of a flight are: the stage, and the share of it that is done."""

    flight_id: str
    stage: str
    share: float


@dataclass(frozen=True, eq=False)
class GroundModel:
    """A flight's ground in space: its cameras, the surface that they see, the bare ground below it, and the pictures
    of the cameras that points in space hold. `bare_m` (H, W) counts as the surface does; `seconds` is what it took."""

    solved: Cameras3D
    surface: Surface
    bare_m: Floats32
    pictures: FlightPictures
    figures: Mapping[str, Any]
    seconds: Mapping[str, float]

    def bare_at(self, places_m: PointsM) -> tuple[Floats, Floats]:
        """Return the bare ground's height about places (N, 2), (N,), and its spread there: how well it is known."""
        lattice, aside_m = self.surface.lattice, np.linspace(-_ASIDE_M, _ASIDE_M, 5)
        around_m = np.stack(np.meshgrid(aside_m, aside_m), axis=-1).reshape(-1, 1, 2)
        cells = np.round(lattice.cells_from_site((places_m + around_m).reshape(-1, 2)))
        column, row = cells.clip(0, [lattice.width - 1, lattice.height - 1]).astype(int).T
        up_m = self.bare_m[row, column].reshape(-1, len(places_m)).astype(np.float64)
        return np.median(up_m, axis=0), up_m.std(axis=0)


Tied = Callable[[Cameras3D], Cameras3D]
"""What brings cameras in space, and their points, to ground that is known."""


@mission
def make_heights(
    site: AnyPath,
    cell_m: float | None = None,
    *,
    flight: str | None = None,
    catalogues: Catalogues | None = None,
) -> Generator[HeightsUpdate, None, FlightOutcome]:
    """Make the heights of one mapped flight (None: the newest) as files in its folder, yielding progress.

    `cell_m` is the side of the height model's cells (None: by the photos' pixels), `catalogues` has the site's (None:
    that of the environment). Raises InputError for a flight that has no heights to give (no GPS, too few photos that
    overlap), StoreError for a folder that is no site, SettingsError for impossible cells.
    """
    if cell_m is not None and not 0.001 <= cell_m <= 100:
        raise SettingsError(f"--cell {cell_m}: give metres, 0.001 to 100")
    site = Path(site)
    Archive.open(
        site, write=False, catalogues=catalogues
    ).close()  # to write would make a folder that is not there
    with Archive.open(site, write=True, catalogues=catalogues) as archive:
        flight_id = flight or newest_flight(archive)
        keyframes = [
            each for each in archive.sound_keyframes(flight_id) if each.site_from_camera is not None
        ]
        started_s = time.monotonic()
        views = flight_views(archive, flight_id, keyframes)
        model = yield from model_ground(archive, views, keyframes, cell_m)
        folder = archive.flight_folder(flight_id)
        with archive.replacing(*(f"flights/{flight_id}/{file}" for file in HeightFile)):
            with scratch_folder(folder) as scratch:
                tiles = TileFolder(scratch)
                for index, rgba, share in ground_tiles(model, archive.site_grid()):
                    tiles.save(index, rgba)
                    yield HeightsUpdate(flight_id, "orthophoto", share)
                write_cog(tiles, archive.site_grid(), folder / HeightFile.ORTHOPHOTO)
            report = write_heights(
                archive,
                model,
                folder,
                flight_id=flight_id,
                run=run_of(keyframes),
                mapped=archive.report(flight_id),
                seconds=time.monotonic() - started_s,
            )
        yield HeightsUpdate(flight_id, "done", 1.0)
        cameras = report["cameras"]
        return FlightOutcome(
            flight_id,
            folder,
            "",
            not report["contradicts_itself"],
            {"views": cameras["views"]},
            cameras["residual_rms_px"],
            tuple(report["warnings"]),
            {file.value: folder / file for file in HeightFile},
        )


def model_ground(
    archive: Archive,
    views: Sequence[View],
    keyframes: Sequence[StoredKeyframe],
    cell_m: float | None = None,
    memo: ResultCache | None = None,
    tied: Tied = lambda solved: solved,
    beside: Sequence[tuple[View, FlightPictures]] = (),
) -> Generator[HeightsUpdate, None, GroundModel]:
    """The ground that views, each of one keyframe, see in space, yielding progress; `tied` moves their cameras first,
    which are solved with those of the map `beside` them.

    What a killed run found out is taken from its `memo`. Raises InputError where views share too little for it.
    """
    memo, last = memo or ResultCache(), keyframes[-1]
    flight_id, site = keyframes[0].flight_id, archive.site()
    started_s = time.monotonic()
    _lattice(site, views, cell_m)  # too many cells end here, before minutes of work
    yield HeightsUpdate(flight_id, "cameras", 0.0)
    own = FlightPictures(archive, keyframes)
    seen = [*views, *(each for each, _ in beside)]

    def gray(number: int) -> ImageGray:
        return own.gray(number) if number < len(views) else beside[number - len(views)][1].gray(0)

    tracks = memo.of(last, "tracks", Tracks, lambda: find_tracks(seen, gray))
    solved = tied(solve_tracks(seen, tracks)).of({each.name for each in views})
    kept = [each for each in keyframes if each.name not in set(solved.lost)]
    pictures = FlightPictures(archive, kept, solved.radial)
    cameras_s = time.monotonic() - started_s
    give_back()
    swept = memo.known(last.index, "surface", Surface)
    if swept is None:
        swept = yield from _sweep(site, solved, pictures, cell_m, flight_id)
        memo.keep(last, "surface", swept, compresses=True)
    surface, judgement = judged_by_points(swept, solved)
    yield HeightsUpdate(flight_id, "ground", 0.0)
    bare_m, shows_ground = terrain(surface.lattice, surface.up_m)
    give_back()
    return GroundModel(
        solved,
        surface,
        bare_m,
        pictures,
        surface_figures(surface, shows_ground, judgement),
        {"cameras": cameras_s, "heights": time.monotonic() - started_s},
    )


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
    complete = archive.versions()
    if not complete:
        raise InputError(
            f"{archive.folder} has no flight yet; map one: sorvolo map INPUT --site {archive.folder}"
        )
    return complete[-1].flight_id


def height_grid(site: Site, cell_m: float) -> SiteGrid:
    """The grid whose cells a height model of the site has."""
    return SiteGrid.at(site.origin, cell_m, site.crs)


def _sweep(
    site: Site,
    solved: Cameras3D,
    pictures: FlightPictures,
    cell_m: float | None,
    flight_id: str,
) -> Generator[HeightsUpdate, None, Surface]:
    low_m = min(0.0, float(np.percentile(solved.points_m[:, 2], 0.5)))  # low ground is seen farther
    lattice = _lattice(site, solved.views, cell_m, low_m)

    small = SmallPictures(pictures, solved.views, sizes_m(lattice.cell_m))
    for each in sweep_surface(
        lattice, solved.views, small.gray, solved.points_m, solved.height_sigma
    ):
        if isinstance(each, Surface):
            return each
        yield HeightsUpdate(flight_id, "heights", each)
    raise AssertionError("a sweep ends with a surface")


def _lattice(
    site: Site, views: Sequence[View], cell_m: float | None, low_m: float = 0.0
) -> Lattice:
    """The cells over the ground, `low_m` at its lowest, that the views show.

    Raises GeometryError for more of them than can be handled.
    """
    outlines_m = ground_outlines_m(views)
    cell_m = cell_m or Lattice.cell_for(outlines_m, site.m_per_px)
    outlines_m = np.concatenate([outlines_m, ground_outlines_m(views, low_m)])
    return Lattice.over(outlines_m, height_grid(site, cell_m))


def write_heights(
    archive: Archive,
    model: GroundModel,
    folder: Path,
    *,
    flight_id: str,
    run: str,
    mapped: Mapping[str, Any],
    seconds: float,
) -> dict[str, Any]:
    """Write heights.tif, terrain.tif, heights.png and heights.json, which is returned, of a ground into a folder.

    `run` is the mapping run that it is of, `mapped` that one's report.json, `seconds` what all of it took.
    """
    surface, site = model.surface, archive.site()
    grid = height_grid(site, surface.lattice.cell_m).grid
    zero_m = site.origin.height_m
    write_height_cog(
        surface.above(zero_m),
        (f"height, {site.height_reference}", "one sigma"),
        surface.lattice.first,
        grid,
        folder / HeightFile.SURFACE,
    )
    write_height_cog(
        [model.bare_m + zero_m],
        (f"bare ground, {site.height_reference}",),
        surface.lattice.first,
        grid,
        folder / HeightFile.GROUND,
    )
    atomic_write_bytes(folder / HeightFile.PICTURE, png_from_rgba(relief_picture(surface)))
    report = {
        "flight": flight_id,
        "run": run,
        "cell_m": surface.lattice.cell_m,
        "height_reference": site.height_reference,
        "cameras": camera_figures(model.solved),
        "surface": model.figures,
        "warnings": [
            *_map_warnings(mapped),
            *camera_warnings(model.solved),
            *surface_warnings(surface),
            *(each.text for each in archive.notices),
        ],
        "contradicts_itself": contradicts_itself(mapped),
        "seconds": {**model.seconds, "total": seconds},
        "peak_memory_mb": peak_memory_mb(),
    }
    atomic_write_bytes(folder / HeightFile.REPORT, json_bytes(report))
    return report


def solved_before(
    archive: Archive,
    keyframes: Sequence[StoredKeyframe],
    views: Sequence[View],
    file: str = HeightFile.REPORT,
) -> Cameras3D | None:
    """The cameras in space that this mapping run's heights, or another `file`, were made with; None without them."""
    path = archive.flight_folder(keyframes[0].flight_id) / file
    by_name = {view.name: view for view in views}
    try:
        report = json.loads(path.read_text())
        if report["run"] != run_of(keyframes):
            return None
        cameras = report["cameras"]
        x_px, y_px = cameras["optical_centre_px"]
        stand = [
            replace(
                view,
                camera=replace(
                    view.camera.with_focal_px(cameras["focal_px"]), cx_px=x_px, cy_px=y_px
                ),
                site_from_camera=Pose(
                    np.reshape(row["rotation"], (3, 3)),
                    np.array([row[f"{axis}_m"] for axis in ("east", "north", "up")]),
                ),
            )
            for row in cameras["places"]
            for view in (by_name[row["frame"]],)
        ]
        return Cameras3D(
            tuple(stand),
            tuple(cameras["lost"]),
            np.zeros((0, 3)),
            cameras["residual_rms_px"],
            cameras["focal_scale"],
            tuple(cameras["radial"]),
            np.full(3, np.nan),
            cameras["observations"],
        )
    except (OSError, ValueError, KeyError, TypeError):  # no heights, or damaged ones
        return None


def ground_tiles(
    model: GroundModel, site_grid: SiteGrid
) -> Iterator[tuple[TileIndex, ImageRGBA, float]]:
    """The tiles of a ground's true orthophoto; see `paint_orthophoto`."""
    lattice = model.surface.lattice
    up_m = closed(lattice, model.surface.up_m, model.bare_m)
    return paint_orthophoto(lattice, up_m, site_grid, model.solved.views, model.pictures.colour)
