"""Tiles of a site for web maps: any version of its map, the growing one, and the floor below crowns at any height."""

import hashlib
import json
import os
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import cv2
import numpy as np
from fastapi import APIRouter, Request, Response
from numpy.typing import NDArray
from PIL import Image
from rasterio import DatasetReader
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.windows import Window

from sorvolo.canopy.integral import against_surroundings, averaged, levelled, seeing
from sorvolo.errors import SorvoloError
from sorvolo.geometry.arrays import Floats, Floats32, ImageRGBA, Numbers, shrunk
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import Grid, SiteGrid, TileIndex
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.views import View
from sorvolo.missions.heights.run import FlightPictures, flight_views, solved_before
from sorvolo.paths import Json
from sorvolo.station.problems import Problem
from sorvolo.station.security import FOR_VIEWERS, address
from sorvolo.station.sites import SiteShelf, bounds_lonlat
from sorvolo.store.images import BytesCache
from sorvolo.store.rasters.geotiff import crs_of_epsg, open_raster, quiet_gdal
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import UNDER_TREES
from sorvolo.store.site.tiles import TileView

_MOST_LEVELS = 24  # halvings; a map of a million tiles a side needs 20


class TilePyramid:
    """The tiles of one state of a map at halved resolutions. Level 0 is the map's own.

    Pictures are known by the hashes of what they are made of: where the map did not change, one made for an earlier
    state is used again from `cache`. `coarse`, where given, may have tiles of levels above 0 without reading what they
    are made of.
    """

    def __init__(
        self,
        tiles: TileView,
        tile_px: int,
        cache: BytesCache[str, ImageRGBA],
        coarse: Callable[[int, TileIndex], ImageRGBA | None] | None = None,
    ) -> None:
        self._tiles, self._cache, self._coarse, self.tile_px = tiles, cache, coarse, tile_px

    @cached_property
    def revision(self) -> str:
        """What names this state of the map: the same tiles, the same revision."""
        lines = sorted(
            f"{column},{row},{sha256}" for (column, row), sha256 in self._tiles.hashes.items()
        )
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:12]

    @cached_property
    def keys(self) -> list[Mapping[TileIndex, str]]:
        """For each level the tiles there are, and what names the content of each.

        The levels go on where one tile is left: a web tile of a whole country over a map of one tile would else be
        gathered at the map's own resolution, in gigabytes.
        """
        levels: list[Mapping[TileIndex, str]] = [dict(self._tiles.hashes)]
        while levels[-1] and len(levels) < _MOST_LEVELS:
            parts: dict[TileIndex, list[str]] = {}
            for (column, row), key in sorted(levels[-1].items()):
                parts.setdefault((column // 2, row // 2), []).append(f"{column % 2}{row % 2}{key}")
            levels.append(
                {
                    index: hashlib.sha256("".join(each).encode()).hexdigest()
                    for index, each in parts.items()
                }
            )
        return levels

    @cached_property
    def corner_tiles(self) -> list[TileIndex]:
        """The corners of the box around all tiles of level 0; none without tiles."""
        if not self._tiles.hashes:
            return []
        columns, rows = zip(*self._tiles.hashes)
        return [(min(columns), min(rows)), (max(columns), max(rows))]

    def changed_since(self, before: "TilePyramid") -> list[TileIndex]:
        """The tiles that are others than in an earlier state, those that are gone included."""
        now, then = self._tiles.hashes, before._tiles.hashes
        return [index for index in now.keys() | then.keys() if now.get(index) != then.get(index)]

    def picture(self, level: int, index: TileIndex) -> ImageRGBA | None:
        """A tile, (tile_px, tile_px, 4), not to be written to; None where there is none.

        Raises StoreError where the version was dropped or is damaged.
        """
        key = self.keys[level].get(index)
        if key is None:
            return None
        if level == 0:
            return self._tiles[index]  # kept by the site's own cache
        return self._cache.get(key, lambda: self._halved(level, index))

    def pieces(self, level: int) -> tuple[int, Mapping[TileIndex, str]]:
        """How large the pieces of a level are that `piece` gives, px, and what names each.

        Above level 0 a piece is a quarter of a tile: what one tile of the level below becomes. Where a map grows under
        a view, only the tiles under that view have to be read.
        """
        return (
            (self.tile_px, self.keys[0])
            if level == 0
            else (self.tile_px // 2, self.keys[level - 1])
        )

    def piece(self, level: int, index: TileIndex) -> ImageRGBA | None:
        """A piece of a level; None where there is none. Raises as `picture` does."""
        if level == 0:
            return self.picture(0, index)
        if self._coarse is None:
            return self._half_of(level - 1, index)
        whole, half = self.picture(level, (index[0] // 2, index[1] // 2)), self.tile_px // 2
        if whole is None:
            return None
        left, top = half * (index[0] % 2), half * (index[1] % 2)
        return whole[top : top + half, left : left + half]

    def _half_of(self, level: int, index: TileIndex) -> ImageRGBA | None:
        """A tile made smaller, (tile_px / 2, tile_px / 2, 4); None where there is none."""
        key = self.keys[level].get(index)
        if key is None:
            return None

        def made() -> ImageRGBA:
            part = self.picture(level, index)
            assert part is not None  # its key is there
            return halved(part)

        return self._cache.get(f"half {key}", made)

    def _halved(self, level: int, index: TileIndex) -> ImageRGBA:
        given = None if self._coarse is None else self._coarse(level, index)
        if given is not None:
            return given
        half = self.tile_px // 2
        result = np.zeros((self.tile_px, self.tile_px, 4), np.uint8)
        for right in (0, 1):
            for down in (0, 1):
                part = self._half_of(level - 1, (2 * index[0] + right, 2 * index[1] + down))
                if part is not None:
                    result[down * half : (down + 1) * half, right * half : (right + 1) * half] = (
                        part
                    )
        result.setflags(write=False)
        return result


def halved(rgba: ImageRGBA) -> ImageRGBA:
    """A picture of even sides at half its size, not to be written to.

    Colours are averaged by their alpha, so that the map's edges do not darken. That takes time and is only needed where
    the alphas of four pixels differ.
    """
    small = np.asarray(
        cv2.resize(rgba, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8
    )
    fours = [rgba[down::2, right::2] for down in (0, 1) for right in (0, 1)]
    alphas = [each[..., 3] for each in fours]
    lowest, highest = np.minimum.reduce(alphas), np.maximum.reduce(alphas)
    at = np.nonzero(lowest != highest)
    if len(at[0]):
        mixed = np.stack([each[at] for each in fours]).astype(np.float32)
        share = mixed[..., 3:]
        # one alpha at least is above 0
        colours = (mixed[..., :3] * share).sum(axis=0) / share.sum(axis=0)
        small[at] = np.round(np.column_stack([colours, share.mean(axis=0)])).astype(np.uint8)
    small.setflags(write=False)
    return small


TILE_PX = 256  # a side, as web maps have it
# a tile of 150 km: a map is less than a pixel there, and the site's plane is no plane
_SHALLOWEST_ZOOM = 8
_DEEPEST_ZOOM = 26  # 2 mm a pixel at the equator: finer than any map
_LATTICE = 17  # places a side that are projected exactly; between them it is linear to a hundredth of a pixel
_PICTURES_BYTES, _ANSWERS_BYTES = 192_000_000, 64_000_000
_LIVE = re.compile(r"live(-[0-9a-f]{1,64})?")
_QUALITY = 88  # of WebP, 0 to 100; by choice
_QUICK_METHOD = 1  # of 0 to 6: 7 % more bytes than the usual 4 in 40 % of its time


@dataclass(frozen=True)
class TileAnswer:
    """An encoded tile, b"" where the map has nothing; `is_final`: what its address names never changes."""

    data: bytes
    is_final: bool


class WebTiles:
    """The web tiles of all sites. Threads may share it; what was made last is kept within bounds of memory."""

    def __init__(self, shelf: SiteShelf) -> None:
        self._shelf = shelf
        self._pictures = BytesCache[str, ImageRGBA](_PICTURES_BYTES, lambda each: int(each.nbytes))
        self._answers = BytesCache[tuple[str, ...], bytes](
            _ANSWERS_BYTES, lambda each: len(each) + 100
        )
        self._states: dict[tuple[str, str], tuple[object, TilePyramid]] = {}
        self._lock = threading.Lock()

    def live(self, site_id: str) -> TilePyramid:
        """The map as it is now: the growing one as of its last flush, else the newest version. Raises as `open`."""
        archive = self._shelf.open(site_id)
        return self._state(site_id, "live", archive, archive.change_mark())

    def tile(
        self, site_id: str, version: str, z: int, x: int, y: int, ending: str = ".webp"
    ) -> TileAnswer:
        """An XYZ tile of a version: its number, `live-REVISION` or `live`. Raises Problem (404), StoreError."""
        if not (0 <= z <= _DEEPEST_ZOOM and 0 <= x < 2**z and 0 <= y < 2**z):
            raise Problem(
                404,
                f"no tile {z}/{x}/{y}: zooms go to {_DEEPEST_ZOOM}, columns and rows to 2^zoom - 1",
            )
        archive = self._shelf.open(site_id)
        if not archive.has_site:
            return TileAnswer(b"", False)
        if _LIVE.fullmatch(version):
            state = self.live(site_id)
            is_final = version == f"live-{state.revision}"
        elif version.isdecimal() and len(version) < 10:
            number = int(version)
            if number not in {each.id for each in archive.versions()}:
                raise Problem(
                    404,
                    f"the map has no version {number}; /api/sites/{site_id} lists those there are",
                )
            state, is_final = self._state(site_id, str(number), archive, archive), True
        else:
            raise Problem(404, f"no version {version[:40]!r}: a number or live-REVISION was needed")
        key = (site_id, state.revision, str(z), str(x), str(y), ending)
        grid = archive.site_grid()
        return TileAnswer(
            self._answers.get(key, lambda: render(state, grid, z, x, y, ending)), is_final
        )

    def _state(self, site_id: str, name: str, archive: Archive, mark: object) -> TilePyramid:
        with self._lock:
            known = self._states.get((site_id, name))
            if known is not None and known[0] == mark:
                return known[1]
        tiles = archive.live_tiles() if name == "live" else archive.tiles(int(name))
        grid = archive.site_grid().grid
        made = TilePyramid(tiles, grid.tile_px, self._pictures)
        path = archive.mosaic_path
        # whether a state, a version's number or `live`, is the one that the map's GeoTIFF
        # shows
        newest = max((each.id for each in archive.versions()), default=0)
        shown = newest if name == "live" and not archive.is_growing else name
        if (str(shown) == str(newest) and newest == archive.exported_version) and archive.is_sound(
            path.name
        ):
            made = TilePyramid(tiles, grid.tile_px, self._pictures, MapOverview(path, grid).tile)
        with self._lock:
            if len(self._states) > 200:
                self._states.clear()
            self._states[site_id, name] = (mark, made)
        return made


def render(
    state: TilePyramid, site_grid: SiteGrid, z: int, x: int, y: int, ending: str = ".webp"
) -> bytes:
    """An encoded tile of 256 x 256 pixels; b"" where the map has nothing there."""
    if z < _SHALLOWEST_ZOOM or not _meets_map(state, site_grid, z, x, y):
        return b""
    # (17, 17, 2) grid pixels of places spread over a tile, its outer edges included
    steps = np.linspace(0.0, 1.0, _LATTICE)
    lonlat = _lonlat(z, *np.meshgrid(x + steps, y + steps))
    wanted_px = site_grid.grid_from_site(site_grid.frame.ground_from_lonlat(lonlat)).reshape(
        _LATTICE, _LATTICE, 2
    )
    step_px = np.hypot(*(wanted_px[-1, -1] - wanted_px[0, 0])) / (TILE_PX * np.sqrt(2))
    level = int(np.clip(np.floor(np.log2(max(step_px, 1e-9)) + 0.25), 0, len(state.keys) - 1))
    level_px = (wanted_px + 0.5) / 2**level - 0.5
    source, corner_px = _gathered(state, level, level_px)
    if source is None:
        return b""
    picture = _resampled(source, _pixels_from_lattice((level_px - corner_px).astype(np.float32)))
    return encoded(picture, ending) if picture[..., 3].any() else b""


def encoded(rgba: ImageRGBA, ending: str) -> bytes:
    """A picture as .webp or .png bytes."""
    # by Pillow: OpenCV's has no choice of the method, and takes 2.5 times as long
    if ending == ".webp":
        kept = BytesIO()
        Image.fromarray(rgba).save(kept, "WEBP", quality=_QUALITY, method=_QUICK_METHOD)
        return kept.getvalue()
    done, data = cv2.imencode(
        ending, cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_PNG_COMPRESSION, 3]
    )
    assert done  # uint8 RGBA can always be encoded
    return data.tobytes()


def _pixels_from_lattice(places: Floats32) -> Floats32:
    """(256, 256, 2) places of pixel centres from those of a lattice whose outer points lie on the tile's edges."""
    at = (np.arange(TILE_PX) + 0.5) / TILE_PX * (_LATTICE - 1)
    low = np.minimum(at.astype(int), _LATTICE - 2)
    share = (at - low)[:, None].astype(np.float32)
    rows = places[low] * (1 - share[:, None]) + places[low + 1] * share[:, None]
    return rows[:, low] * (1 - share) + rows[:, low + 1] * share


def _lonlat(z: int, across: Numbers, down: Numbers) -> Floats:
    """(N, 2) longitudes and latitudes, degrees, of places counted in tiles of a zoom from the world's north-west."""
    latitude = np.degrees(np.arctan(np.sinh(np.pi * (1 - 2 * down / 2**z))))
    return np.column_stack([(across / 2**z * 360.0 - 180.0).ravel(), latitude.ravel()])


def _meets_map(state: TilePyramid, site_grid: SiteGrid, z: int, x: int, y: int) -> bool:
    """Whether a tile's ground meets the map's: far around the Earth the site's plane would show it again."""
    bounds = bounds_lonlat(state.corner_tiles, site_grid)
    if bounds is None:
        return False
    (west, south), (east, north) = _lonlat(z, np.array([x, x + 1]), np.array([y + 1, y]))
    return bool(
        bounds[0] <= east and bounds[2] >= west and bounds[1] <= north and bounds[3] >= south
    )


def _gathered(state: TilePyramid, level: int, places_px: Floats) -> tuple[ImageRGBA | None, Floats]:
    """The part of a level under these places in one picture, and where its first pixel lies; None without any."""
    size, there = state.pieces(level)
    flat = places_px.reshape(-1, 2)
    low, high = (
        np.floor(each).astype(int) for each in (flat.min(axis=0) - 1, flat.max(axis=0) + 3)
    )
    first, last = low // size, (high - 1) // size
    width, height = high - low
    picture = np.zeros((height, width, 4), np.uint8)
    is_empty = True
    for column in range(first[0], last[0] + 1):
        for row in range(first[1], last[1] + 1):
            part = state.piece(level, (column, row)) if (column, row) in there else None
            if part is None:
                continue
            is_empty = False
            x0, y0 = column * size - low[0], row * size - low[1]
            left, top = max(x0, 0), max(y0, 0)
            right, bottom = min(x0 + size, width), min(y0 + size, height)
            picture[top:bottom, left:right] = part[top - y0 : bottom - y0, left - x0 : right - x0]
    return (None if is_empty else picture), low.astype(np.float64)


def _resampled(source: ImageRGBA, places_px: Floats32) -> ImageRGBA:
    """A picture's pixels at places, (256, 256, 2), linear between them; transparent ones lend no colour."""
    across, down = (np.ascontiguousarray(places_px[..., axis]) for axis in (0, 1))
    if source[..., 3].min() == 255:
        return cv2.remap(
            source, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        ).astype(np.uint8)
    share = source[..., 3:].astype(np.float32) / 255
    weighted = np.dstack([source[..., :3] * share, share])
    mixed = cv2.remap(weighted, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    colours = mixed[..., :3] / np.maximum(mixed[..., 3:], 1e-3)
    return np.clip(np.round(np.dstack([colours, 255 * mixed[..., 3]])), 0, 255).astype(np.uint8)


_FLOOR_ZOOM = 17  # and deeper: the ground of a tile is small enough to be level
_FLOOR_REACH_M = (-15.0, 30.0)  # of heights about the floor's: below it, and up to crowns
_FLOOR_VIEWS = 64  # of a tile at most: what one costs is bound
_FLOOR_PX = 640  # the longest side of their pictures
_FLOOR_BYTES = 96 << 20
_LEAST_SHOWN = 8  # views of a pixel
_AROUND_M = 2.0  # of a tile, that its edges are held against, too


class FloorTiles:
    """The pictures of a flight laid on a height below its crowns, put together while somebody looks.

    One tile is made at a time. What was made last is kept within bounds of memory.
    """

    def __init__(self, shelf: SiteShelf) -> None:
        self._shelf, self._lock = shelf, threading.Lock()
        self._kept = BytesCache[tuple[str, ...], Any](_FLOOR_BYTES, lambda each: int(each.nbytes))
        self._views: tuple[tuple[str, ...], Sequence[View], FlightPictures] | None = None

    def about(self, site_id: str) -> Json | None:
        """The newest flight that was looked at below its crowns, its run, its floor's height and the heights there are,
        site metres up; None without one."""
        archive = self._shelf.open(site_id)
        for flight in reversed(archive.complete_flights):
            try:
                text = (archive.flight_folder(flight.id) / UNDER_TREES).read_text()
                found = json.loads(text)
                floor_m, (dark, bright) = (
                    round(float(found["floor_m"])),
                    map(float, found["levels"]),
                )
                low_m, high_m = (floor_m + each for each in _FLOOR_REACH_M)
                return {
                    "flight": flight.id,
                    "run": hashlib.sha256(text.encode()).hexdigest()[:12],
                    "floor_m": floor_m,
                    "low_m": low_m,
                    "high_m": high_m,
                    "levels": [dark, bright],
                }
            except (OSError, ValueError, KeyError, TypeError):  # none, or damaged
                continue
        return None

    def tile(self, site_id: str, run: str, up_m: float, z: int, x: int, y: int) -> bytes:
        """An XYZ tile as WebP, b"" where too few pictures show it. Raises Problem (404), StoreError."""
        about = self.about(site_id)
        if about is None or run != about["run"]:
            raise Problem(404, "nobody looked below the crowns of this site, or did so again since")
        if not (about["low_m"] <= up_m <= about["high_m"] and _FLOOR_ZOOM <= z <= _DEEPEST_ZOOM):
            raise Problem(
                404,
                f"no such height or zoom: heights from {about['low_m']} to {about['high_m']} m, zooms from {_FLOOR_ZOOM}",
            )
        with self._lock:
            return self._tile(site_id, about, up_m, z, x, y)

    def _tile(self, site_id: str, about: Json, up_m: float, z: int, x: int, y: int) -> bytes:
        archive = self._shelf.open(site_id)
        lonlat = _lonlat(z, np.array([x, x + 1, x]), np.array([y, y, y + 1]))
        first, right, below = archive.site_grid().frame.ground_from_lonlat(lonlat)
        across, down = (right - first) / TILE_PX, (below - first) / TILE_PX
        middle = first + (across + down) / 2
        affine = np.vstack([np.column_stack([across, down, middle]), [0.0, 0.0, 1.0]])
        cell_m = float(np.linalg.norm(across))
        margin = int(np.ceil(_AROUND_M / cell_m))
        end = TILE_PX + margin
        lattice = Lattice(affine, TILE_PX, TILE_PX, cell_m).window(-margin, -margin, end, end)
        views, pictures = self._opened(archive, site_id, about)
        numbers = seeing(views, lattice, up_m)
        numbers = numbers[:: -(-len(numbers) // _FLOOR_VIEWS) or 1]
        if not numbers:
            return b""

        def picture(k: int) -> Floats32:
            key, size = (site_id, about["run"], str(numbers[k])), views[numbers[k]].camera
            small = self._kept.get(key, partial(_levels, pictures, numbers[k], size))
            return small.astype(np.float32)

        chosen = [views[each] for each in numbers]
        mean, _ = averaged(chosen, picture, lattice, float(up_m), _LEAST_SHOWN)
        contrast = against_surroundings(mean, cell_m)[margin:-margin, margin:-margin, 0]
        dark, bright = about["levels"]
        shown = np.isfinite(contrast)
        grey = np.nan_to_num((contrast - dark) / max(bright - dark, 1e-6)) * 255
        rgba = np.clip(np.dstack([grey, grey, grey, 255 * shown]), 0, 255).astype(np.uint8)
        return encoded(rgba, ".webp") if shown.any() else b""

    def _opened(
        self, archive: Archive, site_id: str, about: Json
    ) -> tuple[Sequence[View], FlightPictures]:
        """The views of a look, their pixels those of pictures of `_FLOOR_PX`, and what loads these."""
        key = (site_id, about["run"])
        if self._views is None or self._views[0] != key:
            keyframes = [
                each for each in archive.sound_keyframes(about["flight"]) if each.site_from_camera
            ]
            mapped = flight_views(archive, about["flight"], keyframes)
            solved = solved_before(archive, keyframes, mapped, UNDER_TREES)
            if solved is None:
                raise Problem(
                    404, f"flight {about['flight']} was mapped again; look through its trees again"
                )
            by_name = {each.name: each for each in keyframes}
            keyframes = [by_name[view.name] for view in solved.views]
            first = solved.views[0].camera
            share = min(1.0, _FLOOR_PX / max(first.width_px, first.height_px))
            views = [each.smaller(share) for each in solved.views]
            self._views = key, views, FlightPictures(archive, keyframes, solved.radial)
        return self._views[1:]


def _levels(pictures: FlightPictures, number: int, camera: Camera) -> NDArray[np.int16]:
    """(H, W) a picture in gray without its usual level, of a camera's size."""
    size = camera.width_px, camera.height_px
    gray = shrunk(pictures.gray(number), size)
    return levelled(np.asarray(gray, np.uint8)).astype(np.int16)


_DEEPEST = 9  # beyond it a tile is wider than the file's blocks are aligned


class MapOverview:
    """The GeoTIFF of one state of a map, as it lies on the disk now; once it was replaced it gives nothing any more."""

    def __init__(self, path: Path, grid: Grid) -> None:
        self._path, self._grid = path, grid
        self._mark = _mark(path)

    def tile(self, level: int, index: TileIndex) -> ImageRGBA | None:
        """A tile of a level, (tile_px, tile_px, 4); None where the file cannot give it."""
        if not 0 < level <= _DEEPEST or not self._grid.crs or self._mark is None:
            return None
        try:
            with quiet_gdal(), open_raster(self._path, "the map's GeoTIFF") as source:
                left, top = self._corner(source)
                if left is None or top is None or _mark(self._path) != self._mark:
                    return None
                if max(source.overviews(1), default=1) < 2 ** (level - 1):  # it would be read whole
                    return None
                return self._read(source, level, index, left, top)
        except (
            RasterioError,
            SorvoloError,
            OSError,
        ):
            # damaged or taken away: the tiles themselves have it all
            return None

    def _corner(self, source: DatasetReader) -> tuple[int | None, int | None]:
        """Grid pixel of the file's first pixel; None where the file lies on another grid."""
        transform, grid = source.transform, self._grid
        if (
            source.crs != crs_of_epsg(grid.crs)
            or abs(transform.a - grid.m_per_px) > 1e-6 * grid.m_per_px
        ):
            return None, None
        left = (transform.c - grid.origin_m[0]) / grid.m_per_px + 0.5
        top = (grid.origin_m[1] - transform.f) / grid.m_per_px + 0.5
        if max(abs(left - round(left)), abs(top - round(top))) > 0.01:
            return None, None
        return round(left), round(top)

    def _read(
        self, source: DatasetReader, level: int, index: TileIndex, left: int, top: int
    ) -> ImageRGBA:
        size = self._grid.tile_px
        side = size << level
        x0, y0 = index[0] * side, index[1] * side
        low_x, low_y = max(x0, left), max(y0, top)
        high_x, high_y = min(x0 + side, left + source.width), min(y0 + side, top + source.height)
        result = np.zeros((size, size, 4), np.uint8)
        width, height = (high_x - low_x) >> level, (high_y - low_y) >> level
        if width > 0 and height > 0:
            window = Window(low_x - left, low_y - top, high_x - low_x, high_y - low_y)
            how = {"window": window, "resampling": Resampling.average}
            colours = source.read((1, 2, 3), out_shape=(3, height, width), **how)
            alpha = source.dataset_mask(out_shape=(height, width), **how)
            column, row = (low_x - x0) >> level, (low_y - y0) >> level
            result[row : row + height, column : column + width] = np.dstack([*colours, alpha])
        result.setflags(write=False)
        return result


def _mark(path: Path) -> tuple[int, int] | None:
    """What is another once the file was replaced."""
    try:
        about = os.stat(path)
    except OSError:
        return None
    return about.st_ino, about.st_mtime_ns


# of zoom 0 at 0.28 mm a pixel: WMTS 1.0.0, annex E.4 (GoogleMapsCompatible)
_FIRST_SCALE = 559082264.0287178
_EDGE_M = 20037508.342789244  # half of the equator's length on the sphere of web maps (EPSG:3857)
_ZOOMS = range(8, 25)
_SET = "GoogleMapsCompatible"


class XmlResponse(Response):
    """An XML document."""

    media_type = "application/xml"


def wmts_routes(shelf: SiteShelf) -> APIRouter:
    """The capabilities of each site's tiles."""
    router = APIRouter(prefix="/api/sites/{site}", tags=["rasters"], dependencies=FOR_VIEWERS)

    @router.get("/WMTSCapabilities.xml", response_class=XmlResponse)
    def capabilities(request: Request, site: str) -> XmlResponse:
        """Layers of a WMTS: every version of the map, and the growing one (`live`)."""
        return XmlResponse(document(shelf.open(site), address(request, f"/api/sites/{site}")))

    return router


def document(archive: Archive, base: str) -> str:
    """The capabilities of a site whose address is `base`."""
    layers = []
    if archive.has_site:
        names = {
            str(
                each.id
            ): f"version {each.id}, {each.flown_utc or each.created_utc}, {each.flight_id}"
            for each in archive.versions()
        }
        bounds = bounds_lonlat(list(archive.live_tiles()), archive.site_grid())
        layers = [
            _layer(name, title, bounds, base)
            for name, title in {"live": "the newest map", **names}.items()
        ]
    name = archive.site().name if archive.has_site else archive.folder.name
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<Capabilities xmlns="http://www.opengis.net/wmts/1.0" xmlns:ows="http://www.opengis.net/ows/1.1" '
        'xmlns:xlink="http://www.w3.org/1999/xlink" version="1.0.0">\n'
        f"<ows:ServiceIdentification><ows:Title>{escape(name)}</ows:Title><ows:ServiceType>OGC WMTS</ows:ServiceType>"
        "<ows:ServiceTypeVersion>1.0.0</ows:ServiceTypeVersion></ows:ServiceIdentification>\n"
        f"<Contents>\n{''.join(layers)}{_matrix_set()}</Contents>\n"
        f"<ServiceMetadataURL xlink:href={quoteattr(base + '/WMTSCapabilities.xml')}/>\n</Capabilities>\n"
    )


def _layer(name: str, title: str, bounds: list[float] | None, base: str) -> str:
    corners = ""
    if bounds is not None:
        corners = (
            f"<ows:WGS84BoundingBox><ows:LowerCorner>{bounds[0]} {bounds[1]}</ows:LowerCorner>"
            f"<ows:UpperCorner>{bounds[2]} {bounds[3]}</ows:UpperCorner></ows:WGS84BoundingBox>"
        )
    template = f"{base}/tiles/{name}/{{TileMatrix}}/{{TileCol}}/{{TileRow}}.png"
    return (
        f"<Layer><ows:Title>{escape(title)}</ows:Title>{corners}<ows:Identifier>{name}</ows:Identifier>"
        '<Style isDefault="true"><ows:Identifier>default</ows:Identifier></Style><Format>image/png</Format>'
        f"<TileMatrixSetLink><TileMatrixSet>{_SET}</TileMatrixSet></TileMatrixSetLink>"
        f'<ResourceURL format="image/png" resourceType="tile" template={quoteattr(template)}/></Layer>\n'
    )


def _matrix_set() -> str:
    matrices = "".join(
        f"<TileMatrix><ows:Identifier>{zoom}</ows:Identifier><ScaleDenominator>{_FIRST_SCALE / 2**zoom!r}"
        f"</ScaleDenominator><TopLeftCorner>-{_EDGE_M!r} {_EDGE_M!r}</TopLeftCorner><TileWidth>{TILE_PX}</TileWidth>"
        f"<TileHeight>{TILE_PX}</TileHeight><MatrixWidth>{2**zoom}</MatrixWidth><MatrixHeight>{2**zoom}"
        "</MatrixHeight></TileMatrix>\n"
        for zoom in _ZOOMS
    )
    return (
        f"<TileMatrixSet><ows:Identifier>{_SET}</ows:Identifier>"
        "<ows:SupportedCRS>urn:ogc:def:crs:EPSG::3857</ows:SupportedCRS>"
        f"<WellKnownScaleSet>urn:ogc:def:wkss:OGC:1.0:{_SET}</WellKnownScaleSet>\n{matrices}</TileMatrixSet>\n"
    )
