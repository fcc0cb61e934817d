"""The map made small: a picture of it, previews, and a KMZ for Google Earth."""

import zipfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import simplekml

from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.geometry.geodesy import Projection
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.store.atomic import atomic_path, atomic_write_bytes
from sorvolo.store.exports.places import near_longitudes, wrapped_deg
from sorvolo.store.exports.plain import name_safe
from sorvolo.store.images import png_from_rgba, shrink, unweighted, weighted

PREVIEW_PX = 2048
LIVE_PREVIEW_PX = 1024
_KMZ_PX = 4096
_KMZ_PIECE_PX = 1024  # viewers on phones refuse textures much larger


@dataclass(frozen=True, eq=False)
class Picture:
    """The map made small: `rgba` (H, W, 4), each pixel `step_px` grid pixels wide.

    The outer corner of its pixel (0, 0) is at `corner_px` on the grid.
    """

    rgba: ImageRGBA
    corner_px: tuple[float, float]
    step_px: int


def picture(tiles: Mapping[TileIndex, ImageRGBA], max_px: int) -> Picture:
    """The whole map, halved until no side exceeds `max_px`, cropped to what is seen; `tiles` is not empty.

    Reads one tile at a time, so that memory depends on `max_px` only.
    """
    return pictures([tiles], max_px)[0]


def pictures(
    maps: Sequence[Mapping[TileIndex, ImageRGBA]], max_px: int, alike: Collection[TileIndex] = ()
) -> list[Picture]:
    """Several maps of one site as `picture` shows one, all of the same size and the same ground; one is not empty.

    Tiles at the places `alike` are the same in all maps and are read once.
    """
    indexes = sorted(set().union(*maps))
    tile_px = next(tiles[index].shape[0] for index in indexes[:1] for tiles in maps if index in tiles)
    columns, rows = np.array(indexes).T
    left, top = int(columns.min()), int(rows.min())
    width, height = int(columns.max()) - left + 1, int(rows.max()) - top + 1
    step = _thinning(max(width, height), tile_px, max_px)
    small_px = tile_px // step
    canvases = [np.zeros((height * small_px, width * small_px, 4), np.uint8) for _ in maps]
    seen = np.zeros((height * small_px, width * small_px), bool)
    for canvas, tiles in zip(canvases, maps):
        known = alike if canvas is not canvases[0] else ()
        for column, row in sorted(tiles):
            y, x = (row - top) * small_px, (column - left) * small_px
            part = np.s_[y:y + small_px, x:x + small_px]
            canvas[part] = (
                canvases[0][part] if (column, row) in known else shrink(tiles[column, row], small_px, small_px)
            )
        seen |= canvas[..., 3] > 0
    (y0, y1), (x0, x1) = (np.flatnonzero(seen.any(axis=axis))[[0, -1]] + [0, 1] for axis in (1, 0))
    corner_px = (left * tile_px + int(x0) * step - 0.5, top * tile_px + int(y0) * step - 0.5)
    return [Picture(np.ascontiguousarray(canvas[y0:y1, x0:x1]), corner_px, step) for canvas in canvases]


def _thinning(tiles: int, tile_px: int, max_px: int) -> int:
    """By how much tiles are made smaller, a power of two that divides a tile, so that `tiles` in a row fit `max_px`."""
    step = 1
    while tile_px % (2 * step) == 0 and tiles * tile_px > step * max_px:
        step *= 2
    return step


def write_preview(tiles: Mapping[TileIndex, ImageRGBA], path: Path, max_px: int = PREVIEW_PX) -> None:
    """Write the map as one PNG with a transparent background."""
    atomic_write_bytes(path, png_from_rgba(picture(tiles, max_px).rgba))


def write_small_maps(
    tiles: Mapping[TileIndex, ImageRGBA], site_grid: SiteGrid, name: str, preview: Path, kmz: Path
) -> None:
    """Write what `write_preview` and `write_kmz` do, the tiles being read once for both."""
    shown = picture(tiles, _KMZ_PX)
    small = shown.rgba
    while max(small.shape[:2]) > PREVIEW_PX:
        small = shrink(small, -(-small.shape[1] // 2), -(-small.shape[0] // 2))
    atomic_write_bytes(preview, png_from_rgba(small))
    _write_kmz(shown, site_grid, name, kmz)


def write_live_preview(tiles: Mapping[TileIndex, ImageRGBA], path: Path) -> None:
    """Write a small PNG of the map while it grows; nothing when there are no tiles yet."""
    if tiles:
        data = png_from_rgba(picture(tiles, LIVE_PREVIEW_PX).rgba)
        atomic_write_bytes(path, data, durable=False)


def write_kmz(tiles: Mapping[TileIndex, ImageRGBA], site_grid: SiteGrid, name: str, path: Path) -> None:
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
    simplekml.Kml.resetidcounter()
    kml = simplekml.Kml(name=name)
    images: dict[str, bytes] = {}
    for row in range(counts[1]):
        for column in range(counts[0]):
            box = (longitudes[column], latitudes[row + 1], longitudes[column + 1], latitudes[row])
            rgba = _north_up(small, site_grid, box, *(int(side) for side in -(-size // counts)))
            if not rgba[..., 3].any():
                continue
            overlay = kml.newgroundoverlay(name=f"{name} {row}-{column}")
            overlay.icon.href = f"files/{name_safe(name)}_{row}_{column}.png"
            overlay.latlonbox.west, overlay.latlonbox.south = wrapped_deg(box[0]), box[1]
            overlay.latlonbox.east, overlay.latlonbox.north = wrapped_deg(box[2]), box[3]
            images[overlay.icon.href] = png_from_rgba(rgba)
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        # without the time at which it was made: the same map gives the same bytes
        archive.writestr(zipfile.ZipInfo("doc.kml"), kml.kml(format=False), zipfile.ZIP_DEFLATED)
        for file, data in images.items():
            archive.writestr(zipfile.ZipInfo(file), data, zipfile.ZIP_STORED)


def _bounds_deg(small: Picture, site_grid: SiteGrid) -> tuple[float, float, float, float]:
    """West, south, east, north of the picture, from a net of points: meridians bend in a projection."""
    net = np.stack(np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)), axis=-1).reshape(-1, 2)
    pixels = net * small.rgba.shape[1::-1] * small.step_px + small.corner_px
    points_m = site_grid.grid.projected_from_grid(pixels)
    latitudes, longitudes = Projection(site_grid.grid.crs).wgs84_from_projected(points_m)
    longitudes = near_longitudes(longitudes, site_grid.frame.origin.longitude_deg)
    return (
        float(longitudes.min()), float(latitudes.min()), float(longitudes.max()), float(latitudes.max())
    )


def _north_up(
    small: Picture, site_grid: SiteGrid, box_deg: tuple[float, float, float, float], width: int, height: int
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
    matrix = cv2.getPerspectiveTransform((source - [x0, y0]).astype(np.float32), target.astype(np.float32))
    part = weighted(small.rgba[y0:y1, x0:x1])
    return unweighted(cv2.warpPerspective(part, matrix, (width, height), flags=cv2.INTER_LINEAR))
