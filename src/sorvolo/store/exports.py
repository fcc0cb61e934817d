"""What other programs open: frames as GeoJSON, the map as a picture and as KMZ, reports as plain JSON."""

import json
import math
import zipfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import simplekml

from sorvolo.geometry.arrays import Floats, ImageRGBA
from sorvolo.geometry.geodesy import Projection
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.geometry.pose import gimbal_angles_from_rotation
from sorvolo.store.atomic import atomic_path, atomic_write_bytes
from sorvolo.store.images import png_from_rgba, shrink, unweighted, weighted
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame

PREVIEW_PX = 2048
_DAY_NS = 86_400_000_000_000
LIVE_PREVIEW_PX = 1024
_KMZ_PX = 4096
_KMZ_PIECE_PX = 1024  # viewers on phones refuse textures much larger


def frames_geojson(placed: Sequence[PlacedFrame], site: Site) -> dict[str, Any]:
    """The frames of a flight as a GeoJSON FeatureCollection, one feature each (docs/formats.md).

    Longitudes run on beyond 180 degrees where a flight crosses the antimeridian. For a local site the
    coordinates are the site's own units and "crs" is null.
    """
    collection: dict[str, Any] = {"type": "FeatureCollection", "name": "frames"}
    if site.is_local:
        collection["crs"] = None
    collection["features"] = [_feature(frame, site) for frame in placed]
    return collection


def plain_json(value: Any) -> Any:
    """The value as JSON can say it: records as objects, arrays as lists, NaN and infinities as null.

    Raises TypeError for what has no such form.
    """
    if value is None or isinstance(value, bool | str):
        return value.value if isinstance(value, Enum) else value
    if isinstance(value, np.generic | np.ndarray):
        return plain_json(value.tolist())
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain_json(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return plain_json(asdict(value))
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"a {type(value).__name__} cannot be written as JSON")


def json_bytes(value: Any) -> bytes:
    """The value as UTF-8 JSON text, laid out for people."""
    text = json.dumps(plain_json(value), indent=1, ensure_ascii=False, allow_nan=False)
    return text.encode() + b"\n"


def geojson_bytes(collection: Mapping[str, Any]) -> bytes:
    """A FeatureCollection as UTF-8 JSON text, one feature a line."""
    head = {key: value for key, value in collection.items() if key != "features"}
    opening = json.dumps(plain_json(head), ensure_ascii=False, allow_nan=False)[:-1]
    features = [
        json.dumps(plain_json(feature), ensure_ascii=False, allow_nan=False)
        for feature in collection["features"]
    ]
    return (opening + ', "features": [\n' + ",\n".join(features) + "\n]}\n").encode()


def utc_text(time_ns: int) -> str:
    """ISO 8601 UTC of nanoseconds since 1970, to the microsecond, or to the nanosecond where it matters."""
    seconds, rest_ns = divmod(time_ns, 1_000_000_000)
    day = datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return f"{day}.{rest_ns // 1000:06d}Z" if rest_ns % 1000 == 0 else f"{day}.{rest_ns:09d}Z"


def time_words(time_ns: int) -> str:
    """UTC to the second for people; the time into the flight where no clock told the date."""
    if 0 <= time_ns < _DAY_NS:
        return f"{time_ns // 60_000_000_000}:{time_ns // 1_000_000_000 % 60:02d} into the flight"
    return utc_text(time_ns)[:19].replace("T", " ")


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
    step = 1
    while tile_px % (2 * step) == 0 and max(width, height) * tile_px > step * max_px:
        step *= 2
    small_px = tile_px // step
    canvases = [np.zeros((height * small_px, width * small_px, 4), np.uint8) for _ in maps]
    seen = np.zeros((height * small_px, width * small_px), bool)
    for canvas, tiles in zip(canvases, maps):
        for column, row in sorted(tiles):
            y, x = (row - top) * small_px, (column - left) * small_px
            part = np.s_[y:y + small_px, x:x + small_px]
            if canvas is not canvases[0] and (column, row) in alike:
                canvas[part] = canvases[0][part]
            else:
                canvas[part] = shrink(tiles[column, row], small_px, small_px)
        seen |= canvas[..., 3] > 0
    (y0, y1), (x0, x1) = (np.flatnonzero(seen.any(axis=axis))[[0, -1]] + [0, 1] for axis in (1, 0))
    corner_px = (left * tile_px + int(x0) * step - 0.5, top * tile_px + int(y0) * step - 0.5)
    return [Picture(np.ascontiguousarray(canvas[y0:y1, x0:x1]), corner_px, step) for canvas in canvases]


def write_preview(tiles: Mapping[TileIndex, ImageRGBA], path: Path, max_px: int = PREVIEW_PX) -> None:
    """Write the map as one PNG with a transparent background."""
    atomic_write_bytes(path, png_from_rgba(picture(tiles, max_px).rgba))


def write_live_preview(tiles: Mapping[TileIndex, ImageRGBA], path: Path) -> None:
    """Write a small PNG of the map while it grows; nothing when there are no tiles yet."""
    if tiles:
        data = png_from_rgba(picture(tiles, LIVE_PREVIEW_PX).rgba)
        atomic_write_bytes(path, data, durable=False)


def write_kmz(tiles: Mapping[TileIndex, ImageRGBA], site_grid: SiteGrid, name: str, path: Path) -> None:
    """Write the map as a KMZ of north-up ground overlays in WGS84, at most 4096 px a side.

    The site must have a CRS. Raises StoreError on a full disk.
    """
    small = picture(tiles, _KMZ_PX)
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
            overlay.latlonbox.west, overlay.latlonbox.south = _wrapped_deg(box[0]), box[1]
            overlay.latlonbox.east, overlay.latlonbox.north = _wrapped_deg(box[2]), box[3]
            images[overlay.icon.href] = png_from_rgba(rgba)
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        # without the time at which it was made: the same map gives the same bytes
        archive.writestr(zipfile.ZipInfo("doc.kml"), kml.kml(format=False), zipfile.ZIP_DEFLATED)
        for file, data in images.items():
            archive.writestr(zipfile.ZipInfo(file), data, zipfile.ZIP_STORED)


def name_safe(name: str) -> str:
    """The name with everything but letters, digits, dash and underscore replaced by an underscore."""
    return "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in name)


def _feature(frame: PlacedFrame, site: Site) -> dict[str, Any]:
    # a video's frames are named by their index, photos by their file
    is_indexed = frame.name == str(frame.index)
    properties = {
        "frame": frame.index if is_indexed else frame.name,
        "time": utc_text(frame.time_ns),
        "status": frame.status.value,
        "reason": frame.reason,
        **_camera_place(frame, site),
        "residual_px": rounded(frame.residual_px, 4),
        "sigma_m": rounded(frame.sigma_m, 4),
        "gps_residual_east_m": rounded(frame.gps_residual_m[0], 4),
        "gps_residual_north_m": rounded(frame.gps_residual_m[1], 4),
        "gps_residual_up_m": rounded(frame.gps_residual_m[2], 4),
    }
    return {"type": "Feature", "geometry": _outline(frame, site), "properties": properties}


def _outline(frame: PlacedFrame, site: Site) -> dict[str, Any] | None:
    if not np.isfinite(frame.outline_m).all():
        return None
    corners = frame.outline_m
    if not site.is_local:
        corners = np.column_stack(longitude_latitude(frame.outline_m, site))
    ring = [[round(float(x), 10), round(float(y), 10)] for x, y in [*corners, corners[0]]]
    return {"type": "Polygon", "coordinates": [ring]}


def _camera_place(frame: PlacedFrame, site: Site) -> dict[str, Any]:
    longitude_deg = latitude_deg = height_m = up_m = yaw_deg = pitch_deg = roll_deg = np.nan
    local = {}
    if frame.site_from_camera is not None:
        east_m, north_m, up_m = frame.site_from_camera.translation_m
        height_m = site.origin.height_m + up_m
        yaw_deg, pitch_deg, roll_deg = gimbal_angles_from_rotation(frame.site_from_camera.rotation)
        if site.is_local:
            local = {"camera_east": rounded(east_m, 6), "camera_north": rounded(north_m, 6)}
        else:
            longitudes, latitudes = longitude_latitude(frame.site_from_camera.translation_m[None], site)
            longitude_deg, latitude_deg = longitudes[0], latitudes[0]
    return {
        "camera_longitude_deg": rounded(longitude_deg, 10),
        "camera_latitude_deg": rounded(latitude_deg, 10),
        **local,
        "camera_height_m": rounded(height_m, 4),
        "height_above_ground_m": rounded(up_m, 4),
        "height_reference": site.height_reference,
        "camera_yaw_deg": rounded(yaw_deg, 5),
        "camera_pitch_deg": rounded(pitch_deg, 5),
        "camera_roll_deg": rounded(roll_deg, 5),
    }


def longitude_latitude(points_m: Floats, site: Site) -> tuple[Floats, Floats]:
    """WGS84 degrees of site points, (N, 2) or (N, 3), (N,) each; longitudes run on where the site meets +-180."""
    latitudes, longitudes, _ = site.frame.wgs84_from_site(points_m)
    return _near(longitudes, site.origin.longitude_deg), latitudes


def _near(longitudes_deg: Floats, reference_deg: float) -> Floats:
    """The same longitudes within half a turn of the reference, so that none jumps at the antimeridian."""
    return np.asarray(longitudes_deg) + 360 * np.round((reference_deg - np.asarray(longitudes_deg)) / 360)


def _wrapped_deg(longitude_deg: float) -> float:
    return (longitude_deg + 180) % 360 - 180


def rounded(number: float, digits: int) -> float | None:
    """The number for JSON; None when it is not finite."""
    return round(float(number), digits) if np.isfinite(number) else None


def _bounds_deg(small: Picture, site_grid: SiteGrid) -> tuple[float, float, float, float]:
    """West, south, east, north of the picture, from a net of points: meridians bend in a projection."""
    net = np.stack(np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)), axis=-1).reshape(-1, 2)
    pixels = net * small.rgba.shape[1::-1] * small.step_px + small.corner_px
    points_m = site_grid.grid.projected_from_grid(pixels)
    latitudes, longitudes = Projection(site_grid.grid.crs).wgs84_from_projected(points_m)
    longitudes = _near(longitudes, site_grid.frame.origin.longitude_deg)
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
