"""The map made small: a picture of it, previews, and a KMZ for Google Earth."""

import zipfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageRGBA, PointsPx
from sorvolo.geometry.geodesy import Projection
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.store.atomic import atomic_path, atomic_write_bytes
from sorvolo.store.exports.places import kml_bytes, near_longitudes, wrapped_deg
from sorvolo.store.exports.plain import name_safe
from sorvolo.store.images import png_from_rgba, shrink, unweighted, weighted

PREVIEW_PX = 2048  # longer side: a screen's width
LIVE_PREVIEW_PX = 1024  # longer side; written again and again while a flight goes on, so small
_KMZ_PX = 4096  # longer side; a map to a few pieces of what phones take
_KMZ_PIECE_PX = 1024  # viewers on phones refuse textures much larger


@dataclass(frozen=True, eq=False)
class Picture:
    """The map made small: `rgba` (H, W, 4), each pixel `step_px` grid pixels wide.

    The outer corner of its pixel (0, 0) is at `corner_px` on the grid; `shown_px` grid pixels show ground.
    """

    rgba: ImageRGBA
    corner_px: tuple[float, float]
    step_px: int
    shown_px: int = 0

    def shown_m2(self, m_per_px: float) -> float:
        """The ground that the map shows, its pixels being so wide."""
        return float(self.shown_px * m_per_px**2)


class SmallMap:
    """A map made small while its tiles pass by, in any order; only those methods change it whose name begins with take.

    The tiles are `tile_px` wide and lie at `indexes`. The map is halved until no side exceeds `max_px`, and memory
    depends on that alone.
    """

    def __init__(self, indexes: Collection[TileIndex], tile_px: int, max_px: int) -> None:
        columns, rows = np.array(sorted(indexes)).T
        self._left, self._top = int(columns.min()), int(rows.min())
        width, height = int(columns.max()) - self._left + 1, int(rows.max()) - self._top + 1
        # By how much tiles are made smaller, a power of two that divides a tile, so that `tiles`
        # in a row fit `max_px`.
        tiles = max(width, height)
        step = 1
        while tile_px % (2 * step) == 0 and tiles * tile_px > step * max_px:
            step *= 2
        self._tile_px, self._step = tile_px, step
        self._side = tile_px // self._step
        self._canvas: ImageRGBA = np.zeros((height * self._side, width * self._side, 4), np.uint8)
        self._shown_px: dict[TileIndex, int] = {}

    @property
    def side_px(self) -> int:
        """How wide a tile is drawn."""
        return self._side

    @property
    def taken(self) -> int:
        """How many tiles have passed by."""
        return len(self._shown_px)

    def take(self, index: TileIndex, tile: ImageRGBA) -> None:
        """Draw a tile, (tile_px, tile_px, 4)."""
        self._part(index)[:] = shrink(tile, self._side, self._side)
        self._shown_px[index] = int(np.count_nonzero(tile[..., 3]))

    def take_shrunk(self, index: TileIndex, small: ImageRGBA) -> None:
        """Draw what `shrink` made of a tile, (side_px, side_px, 4); each of its pixels counts as shown whole."""
        self._part(index)[:] = small
        self._shown_px[index] = int(np.count_nonzero(small[..., 3])) * self._step**2

    def take_from(self, other: "SmallMap", index: TileIndex) -> None:
        """Draw a tile that another map of the same tiles shows alike."""
        self._part(index)[:] = other._part(index)
        self._shown_px[index] = other._shown_px[index]

    def picture(self, *beside: "SmallMap") -> Picture:
        """What was drawn, cropped to what is seen in it or in any of the maps `beside` it, of the same tiles."""
        seen = np.any([each._canvas[..., 3] > 0 for each in (self, *beside)], axis=0)
        (y0, y1), (x0, x1) = (
            np.flatnonzero(seen.any(axis=axis))[[0, -1]] + [0, 1] for axis in (1, 0)
        )
        corner_px = tuple(
            float(tile * self._tile_px + int(first) * self._step - 0.5)
            for tile, first in ((self._left, x0), (self._top, y0))
        )
        rgba = np.ascontiguousarray(self._canvas[y0:y1, x0:x1])
        return Picture(rgba, (corner_px[0], corner_px[1]), self._step, sum(self._shown_px.values()))

    def _part(self, index: TileIndex) -> ImageRGBA:
        x, y = (index[0] - self._left) * self._side, (index[1] - self._top) * self._side
        return self._canvas[y : y + self._side, x : x + self._side]


class LivePreview:
    """A small PNG of the map while it grows, for which only tiles that changed are read; only `write` changes it."""

    def __init__(self, tile_px: int) -> None:
        self._tile_px = tile_px
        self._shrunk: dict[TileIndex, ImageRGBA] = {}
        self._side = tile_px

    def write(
        self, tiles: Mapping[TileIndex, ImageRGBA], changed: Collection[TileIndex], path: Path
    ) -> None:
        """Write the map, of whose tiles `changed` are others than when it was written last; nothing without tiles."""
        if not tiles:
            return
        small = SmallMap(list(tiles), self._tile_px, LIVE_PREVIEW_PX)
        if small.side_px != self._side:
            kept = {} if small.side_px > self._side else self._shrunk
            self._side = small.side_px
            self._shrunk = {
                index: shrink(each, self._side, self._side) for index, each in kept.items()
            }
        for index in tiles:
            if index not in self._shrunk or index in changed:
                self._shrunk[index] = shrink(tiles[index], self._side, self._side)
            small.take_shrunk(index, self._shrunk[index])
        atomic_write_bytes(path, png_from_rgba(small.picture().rgba), durable=False)


def picture(tiles: Mapping[TileIndex, ImageRGBA], max_px: int) -> Picture:
    """The whole map, halved until no side exceeds `max_px`, cropped to what is seen; `tiles` is not empty.

    Reads one tile at a time, so that memory depends on `max_px` only.
    """
    return pictures([tiles], max_px)[0]


def with_room(shown: Picture, corners_px: PointsPx, max_px: int) -> Picture:
    """The map with empty room up to grid pixels (N, 2) beyond it, made smaller until no side exceeds `max_px`."""
    step, corner_px = shown.step_px, np.array(shown.corner_px)
    height, width = shown.rgba.shape[:2]
    low = np.minimum(corner_px, np.floor(corners_px.min(axis=0)))
    high = np.maximum(corner_px + step * np.array([width, height]), corners_px.max(axis=0))
    times = max(
        1, int(np.ceil((high - low).max() / (step * (max_px - 2))))
    )  # room at both ends is rounded up
    wider = step * times
    before = np.ceil((corner_px - low) / wider).astype(int)  # pixels of the wider picture
    own = -(-np.array([width, height]) // times)
    after = np.maximum(np.ceil((high - corner_px) / wider).astype(int) - own, 0)
    padded = np.pad(shown.rgba, [(0, own[1] * times - height), (0, own[0] * times - width), (0, 0)])
    rgba = np.pad(
        shrink(padded, own[0], own[1]), [(before[1], after[1]), (before[0], after[0]), (0, 0)]
    )
    corner = corner_px - before * wider
    return Picture(rgba, (float(corner[0]), float(corner[1])), wider, shown.shown_px)


def pictures(
    maps: Sequence[Mapping[TileIndex, ImageRGBA]], max_px: int, alike: Collection[TileIndex] = ()
) -> list[Picture]:
    """Several maps of one site as `picture` shows one, all of the same size and the same ground; one is not empty.

    Tiles at the places `alike` are the same in all maps and are read once.
    """
    indexes = sorted(set().union(*maps))
    tile_px = next(
        tiles[index].shape[0] for index in indexes[:1] for tiles in maps if index in tiles
    )
    small = [SmallMap(indexes, tile_px, max_px) for _ in maps]
    for each, tiles in zip(small, maps):
        known = alike if each is not small[0] else ()
        for index in sorted(tiles):
            if index in known:
                each.take_from(small[0], index)
            else:
                each.take(index, tiles[index])
    return [each.picture(*small) for each in small]


def write_preview(
    tiles: Mapping[TileIndex, ImageRGBA], path: Path, max_px: int = PREVIEW_PX
) -> None:
    """Write the map as one PNG with a transparent background."""
    atomic_write_bytes(path, png_from_rgba(picture(tiles, max_px).rgba))


def small_map_of(tiles: Collection[TileIndex], tile_px: int) -> SmallMap:
    """The map as large as `write_small_maps` wants it, to be drawn from these tiles."""
    return SmallMap(tiles, tile_px, _KMZ_PX)


def write_small_maps(
    small: SmallMap, site_grid: SiteGrid, name: str, preview: Path, kmz: Path | None
) -> None:
    """Write what `write_preview` and, unless that is None, `write_kmz` do, of a `small_map_of` all tiles."""
    shown = small.picture()
    rgba = shown.rgba
    while max(rgba.shape[:2]) > PREVIEW_PX:
        if rgba.shape[0] % 2 or rgba.shape[1] % 2:
            rgba = np.pad(rgba, [(0, rgba.shape[0] % 2), (0, rgba.shape[1] % 2), (0, 0)])
        rgba = shrink(rgba, rgba.shape[1] // 2, rgba.shape[0] // 2)
    atomic_write_bytes(preview, png_from_rgba(rgba))
    if kmz is not None:
        _write_kmz(shown, site_grid, name, kmz)


def write_kmz(
    tiles: Mapping[TileIndex, ImageRGBA], site_grid: SiteGrid, name: str, path: Path
) -> None:
    """Write the map as a KMZ of north-up ground overlays in WGS84, at most 4096 px a side.

    The site must have a CRS. Raises StoreError on a full disk.
    """
    _write_kmz(picture(tiles, _KMZ_PX), site_grid, name, path)


def _write_kmz(small: Picture, site_grid: SiteGrid, name: str, path: Path) -> None:
    west, south, east, north = _bounds_deg(small, site_grid)
    size = np.array(small.rgba.shape[1::-1])
    counts = -(-size // _KMZ_PIECE_PX)
    longitudes = np.linspace(west, east, counts[0] + 1)
    latitudes = np.linspace(north, south, counts[1] + 1)
    pieces: list[
        tuple[str, str, tuple[float, float, float, float], bytes]
    ] = []  # title, file, box, picture
    for row in range(counts[1]):
        for column in range(counts[0]):
            box = (longitudes[column], latitudes[row + 1], longitudes[column + 1], latitudes[row])
            rgba = _north_up(small, site_grid, box, *(int(side) for side in -(-size // counts)))
            if not rgba[..., 3].any():
                continue
            file = f"files/{name_safe(name)}_{row}_{column}.png"
            box = wrapped_deg(box[0]), box[1], wrapped_deg(box[2]), box[3]
            pieces.append((f"{name} {row}-{column}", file, box, png_from_rgba(rgba)))
    text = kml_bytes(name, overlays=pieces)
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        # without the time at which it was made: the same map gives the same bytes
        archive.writestr(zipfile.ZipInfo("doc.kml"), text, zipfile.ZIP_DEFLATED)
        for _, file, _, data in pieces:
            archive.writestr(zipfile.ZipInfo(file), data, zipfile.ZIP_STORED)


def _bounds_deg(small: Picture, site_grid: SiteGrid) -> tuple[float, float, float, float]:
    """West, south, east, north of the picture, from a net of points: meridians bend in a projection."""
    net = np.stack(np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)), axis=-1).reshape(-1, 2)
    pixels = net * small.rgba.shape[1::-1] * small.step_px + small.corner_px
    points_m = site_grid.grid.projected_from_grid(pixels)
    latitudes, longitudes = Projection(site_grid.grid.crs).wgs84_from_projected(points_m)
    longitudes = near_longitudes(longitudes, site_grid.frame.origin.longitude_deg)
    return (
        float(longitudes.min()),
        float(latitudes.min()),
        float(longitudes.max()),
        float(latitudes.max()),
    )


def _north_up(
    small: Picture,
    site_grid: SiteGrid,
    box_deg: tuple[float, float, float, float],
    width: int,
    height: int,
) -> ImageRGBA:
    """The part of the picture in the box (west, south, east, north), with pixels along meridian and parallel.

    A perspective map through the box's corners: over the few hundred metres of a piece, a meridian's bend is
    centimetres.
    """
    west, south, east, north = box_deg
    longitudes = np.array([west, east, east, west])
    latitudes = np.array([north, north, south, south])
    points_m = Projection(site_grid.grid.crs).projected_from_wgs84(latitudes, longitudes)
    corners_px = site_grid.grid.grid_from_projected(points_m)
    source = (corners_px - small.corner_px) / small.step_px - 0.5
    limit = small.rgba.shape[1::-1]
    x0, y0 = np.clip(np.floor(source.min(axis=0)).astype(int) - 1, 0, limit)
    x1, y1 = np.clip(np.ceil(source.max(axis=0)).astype(int) + 2, 0, limit)
    if x0 == x1 or y0 == y1:
        return np.zeros((height, width, 4), np.uint8)
    target = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    matrix = cv2.getPerspectiveTransform(
        (source - [x0, y0]).astype(np.float32), target.astype(np.float32)
    )
    part = weighted(small.rgba[y0:y1, x0:x1])
    return unweighted(cv2.warpPerspective(part, matrix, (width, height), flags=cv2.INTER_LINEAR))
