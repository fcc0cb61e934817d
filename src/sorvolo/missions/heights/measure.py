"""`sorvolo measure`: volumes, profiles and contours of flights that have heights."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sorvolo.capture.areas import read_area
from sorvolo.errors import InputError, NoHeightsError, SettingsError
from sorvolo.geometry.coordinates import lonlat_from_text
from sorvolo.heights.field import HeightField, along, standing
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.volumes import Tie, Volume, above_rim, between, contours, tie
from sorvolo.missions.heights.run import height_grid, newest_flight, run_of
from sorvolo.paths import AnyPath
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.exports.places import longitude_latitude
from sorvolo.store.exports.plain import feature, feature_collection, geojson_bytes
from sorvolo.store.rasters.height_model import PointCloud, read_height_cog
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import VersionEntry
from sorvolo.store.site.files import DamagedError, HeightFile
from sorvolo.survey.flight import Notice, Site

_MOST_BYTES = 16_000_000  # of heights.json, which has kilobytes; by choice


@dataclass(frozen=True, eq=False)
class MeasuredVolume:
    """A volume, between which flights, and how they were tied; one flight alone is measured from the area's rim."""

    flight: str
    earlier: str
    volume: Volume
    tied: Tie | None


@dataclass(frozen=True)
class ProfilePoint:
    """A point of a profile: its way along the line, its place, surface and bare ground, m, NaN in holes."""

    way_m: float
    longitude_deg: float
    latitude_deg: float
    surface_m: float
    sigma_m: float
    ground_m: float


def measure_volume(
    site: AnyPath,
    area: AnyPath,
    *,
    flight: str = "",
    since: str = "",
) -> MeasuredVolume:
    """What was dug and heaped in an area from the flight `since` to `flight`; without `since`, above the area's rim.

    Raises InputError for flights without heights, or without ground in common.
    """
    wanted = read_area(area)
    with Archive.open(site, write=False) as archive:
        later_id = flight or newest_flight(archive)
        later = read_field(archive, later_id, HeightFile.SURFACE)
        polygons = wanted.polygons_m(archive.site().frame)
        if not since:
            return MeasuredVolume(later_id, "", above_rim(later, polygons), None)
        if since == later_id:
            raise SettingsError(
                f"--since {since} is the flight that is measured; name an earlier one"
            )
        earlier = read_field(archive, since, HeightFile.SURFACE)
        tied = tie(earlier, later, ~earlier.inside(polygons))
        return MeasuredVolume(later_id, since, between(earlier, later, polygons, tied), tied)


def measure_profile(
    site: AnyPath, places: Sequence[str], *, flight: str = "", step_m: float = 0.0
) -> list[ProfilePoint]:
    """Heights along a line through places ("latitude,longitude"), every `step_m` (0: every cell)."""
    if len(places) < 2:
        raise SettingsError(
            f"a profile needs at least two places, got {len(places)}: --at LAT,LON --at LAT,LON"
        )
    with Archive.open(site, write=False) as archive:
        flight_id = flight or newest_flight(archive)
        surface, ground = (
            read_field(archive, flight_id, name) for name in (HeightFile.SURFACE, HeightFile.GROUND)
        )
        described = archive.site()
        corners = described.frame.ground_from_lonlat([lonlat_from_text(each) for each in places])
        points, ways = along(corners, step_m or surface.lattice.cell_m)
        heights, sigmas = surface.at(points)
        bare, _ = ground.at(points)
        longitudes, latitudes = longitude_latitude(points, described)
        rows = zip(ways, longitudes, latitudes, heights, sigmas, bare)
        return [ProfilePoint(*(float(each) for each in row)) for row in rows]


def write_contours(site: AnyPath, path: AnyPath, interval_m: float, *, flight: str = "") -> int:
    """Write contour lines of the bare ground as GeoJSON; return how many lines there are."""
    if not 0.01 <= interval_m <= 1000:
        raise SettingsError(f"--interval {interval_m}: give metres, 0.01 to 1000")
    with Archive.open(site, write=False) as archive:
        flight_id = flight or newest_flight(archive)
        field = read_field(archive, flight_id, HeightFile.GROUND)
        described = archive.site()
        features = [_line(line, level, described) for level, line in contours(field, interval_m)]
        atomic_write_bytes(
            Path(path), geojson_bytes(feature_collection("contours", features, is_local=False))
        )
        return len(features)


def coloured_heights(archive: Archive, version: VersionEntry) -> Iterator[PointCloud]:
    """The surface of a version's flight, part by part, each cell in the colour that the version has there.

    Raises NoHeightsError without heights of the version's own mapping run.
    """
    flight_id = version.flight_id
    surface, ground = (
        read_field(archive, flight_id, name) for name in (HeightFile.SURFACE, HeightFile.GROUND)
    )
    if run_of(archive.keyframes(flight_id)) != str(version.run_id):
        raise NoHeightsError(
            f"version {version.id} is of an earlier map of flight {flight_id}, and its heights of the newest one: "
            "choose a later version (sorvolo history lists them)"
        )
    lattice, colours = surface.lattice, archive.tiles(version.id)
    grid, cells = archive.site_grid().grid, height_grid(archive.site(), lattice.cell_m).grid
    stands, _ = standing(surface, ground)
    for x0, y0, x1, y1 in lattice.windows(1024):  # bounds the memory
        rows, columns = np.nonzero(np.isfinite(surface.up_m[y0:y1, x0:x1]))
        at = rows + y0, columns + x0
        places_m = cells.projected_from_grid(np.column_stack(at[::-1]) + lattice.first)
        pixels = np.rint(grid.grid_from_projected(places_m)).astype(int)
        tiles, which = np.unique(pixels // grid.tile_px, axis=0, return_inverse=True)
        rgb = np.zeros((len(pixels), 3), np.uint8)
        for number, (column, row) in enumerate(tiles.tolist()):
            if (column, row) in colours:
                x, y = (pixels[which == number] % grid.tile_px).T
                rgb[which == number] = colours[column, row][y, x, :3]
        places_m = np.column_stack([places_m, surface.up_m[at]])
        yield PointCloud(places_m, surface.sigma_m[at], rgb, stands[at] == 0)


def read_field(archive: Archive, flight_id: str, file: HeightFile) -> HeightField:
    """A height model of a flight. Raises NoHeightsError if there is none of its present map."""
    report = _report(archive, flight_id)
    keyframes = archive.keyframes(flight_id)
    if not keyframes or report.get("run") != run_of(keyframes):
        raise NoHeightsError(
            f"the heights of flight {flight_id} are of an earlier map of it; make them again: "
            f"sorvolo heights {archive.folder} --flight {flight_id}"
        )
    return _read(archive, flight_id, file, float(report["cell_m"]))


def _read(archive: Archive, flight_id: str, file: HeightFile, cell_m: float) -> HeightField:
    if not archive.is_sound(f"flights/{flight_id}/{file}"):
        raise NoHeightsError(
            f"{file} of flight {flight_id} is damaged; make the heights again: "
            f"sorvolo heights {archive.folder} --flight {flight_id}"
        )
    site_grid = height_grid(archive.site(), cell_m)
    read = read_height_cog(archive.height_path(flight_id, file), site_grid.grid)
    rows, columns = read.bands[0].shape
    return HeightField(
        Lattice.at(site_grid, read.first, columns, rows), read.bands[0], read.bands[-1]
    )


def radial_of(archive: Archive, flight_id: str) -> tuple[float, float]:
    """The distortion left in a flight's pictures that its heights found, as `refined_camera` takes it."""
    cameras = _report(archive, flight_id).get("cameras", {})
    radial, fifth = cameras.get("radial", (0.0, 0.0))
    return float(radial), float(fifth)


def own_surface(archive: Archive, flight_id: str) -> HeightField | None:
    """The surface that a flight has from whichever map was made of it; None without any that can be read.

    A comparison replaces the map of its flight and leaves the heights: they no longer fit the site to a centimetre,
    and are to be tied to other heights before they are used.
    """
    report = _read_report(archive, flight_id)
    if report is None:
        return None
    try:
        return _read(archive, flight_id, HeightFile.SURFACE, float(report["cell_m"]))
    except InputError:
        return None


def own_heights_stamp(archive: Archive, flight_id: str) -> int | None:
    """When the heights that `own_surface` reads were written (ns); None without any."""
    if _read_report(archive, flight_id) is None:
        return None
    return archive.height_path(flight_id, HeightFile.REPORT).stat().st_mtime_ns


def flight_with_heights(archive: Archive, but: str) -> str | None:
    """The newest flight of `flights_with_heights`."""
    return next(flights_with_heights(archive, but), None)


def flights_with_heights(archive: Archive, but: str) -> Iterator[str]:
    """The flights, the newest first, `but` one, that have heights of their present map, and a report of them that can be
    read."""
    newest_first = dict.fromkeys(each.flight_id for each in reversed(archive.versions()))
    for flight_id in newest_first:
        keyframes, known = archive.keyframes(flight_id), _read_report(archive, flight_id)
        is_present = known is not None and keyframes and known["run"] == run_of(keyframes)
        if flight_id != but and is_present:
            yield flight_id


def without_heights(archive: Archive, but: str) -> tuple[Notice, ...]:
    """The notice of heights of flights, `but` one, that are there and cannot be used."""
    damaged = [
        each.id
        for each in archive.flights()
        if each.id != but
        and archive.height_path(each.id, HeightFile.REPORT).exists()
        and _read_report(archive, each.id) is None
    ]
    if not damaged:
        return ()
    text = (
        f"the heights of {', '.join(damaged)} are damaged and were left out; make them again: sorvolo heights "
        f"{archive.folder} --flight {damaged[0]}"
    )
    return (Notice("damaged heights", len(damaged), text),)


def heights_stamps(archive: Archive, but: str) -> dict[str, int]:
    """When the heights of each flight of `flights_with_heights` were written (ns)."""
    return {
        each: archive.height_path(each, HeightFile.REPORT).stat().st_mtime_ns
        for each in flights_with_heights(archive, but)
    }


def _report(archive: Archive, flight_id: str) -> Mapping[str, Any]:
    """What a flight's heights.json states. Raises NoHeightsError if there is none, or it is damaged."""
    report = _read_report(archive, flight_id)
    if report is None:
        is_there = archive.height_path(flight_id, HeightFile.REPORT).exists()
        found = (
            "has a damaged heights.json; make its heights again"
            if is_there
            else "has no heights; make them"
        )
        raise NoHeightsError(
            f"flight {flight_id} of {archive.folder} {found}: sorvolo heights {archive.folder} --flight {flight_id}"
        )
    return report


def _read_report(archive: Archive, flight_id: str) -> Mapping[str, Any] | None:
    try:
        report = json.loads(
            archive.read_file(f"flights/{flight_id}/{HeightFile.REPORT}", _MOST_BYTES)
        )
        known = {**report, "cell_m": float(report["cell_m"])}
        known["run"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError, DamagedError):
        return None
    files = (f"flights/{flight_id}/{file}" for file in (HeightFile.SURFACE, HeightFile.GROUND))
    is_usable = 0 < known["cell_m"] < math.inf and all(map(archive.is_sound, files))
    return known if is_usable else None


def _line(line: Any, level_m: float, site: Site) -> dict[str, Any]:
    longitudes, latitudes = longitude_latitude(line, site)
    places = [[round(float(x), 8), round(float(y), 8)] for x, y in zip(longitudes, latitudes)]
    return feature({"type": "LineString", "coordinates": places}, {"height_m": round(level_m, 3)})
