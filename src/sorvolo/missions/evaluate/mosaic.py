"""Measure a site's map: against the truth of a simulation, its own frames, another map, or known camera
places.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Anything, Floats, ImageGray, ImageRGBA, Mask, PointsPx
from sorvolo.geometry.geodesy import Projection
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.missions.evaluate.frame_rows import (
    FrameRow,
    frame_row,
    map_frames,
    read_features,
    refuse_simulation,
    site_points,
    truth_file,
)
from sorvolo.mosaic.canvas_frame import CanvasFrame, coverage, warp
from sorvolo.mosaic.quality import (
    DEVIATION_BINS,
    CornerErrors,
    Deviation,
    Shift,
    Spread,
    corner_errors,
    correlation,
    deviation,
    position_errors,
    residual_shift,
    spread_of,
)
from sorvolo.store.rasters.geotiff import Raster, read_raster
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import Status

_DEVIATION_FRAMES = 120
_REFERENCE_PX = 2048
_FARTHEST_M = 10_000.0
_POSITION_COLUMNS = ("frame", "longitude_deg", "latitude_deg")
_POSITIONS_NEED = "needed are the columns frame,longitude_deg,latitude_deg[,height_m][,flight]"


@dataclass(frozen=True)
class FlightTally:
    """How the selected frames of one flight ended; `unmatched` are those that the truth does not know."""

    flight: str
    selected: int
    vision: int
    gps_only: int
    rejected: int
    unmatched: int = 0


@dataclass(frozen=True)
class TruthErrors:
    """A flight's errors against truth ("all" for all together): frames placed by vision, and by GPS alone."""

    flight: str
    corners: CornerErrors
    gps_only: Spread
    cameras: Spread


@dataclass(frozen=True, eq=False)
class DeviationSummary:
    """The thesis's deviation over frames: mean, median and worst share, and the mean histogram."""

    mean: float
    median: float
    worst: float
    histogram: Floats
    frames: int


@dataclass(frozen=True)
class ReferenceMatch:
    """Likeness with another map: eq. 4.1, at `m_per_px`, over `area_m2`; how far this map lies from it."""

    correlation: float
    correlation_after_shift: float
    shift: Shift
    shift_east_m: float
    shift_north_m: float
    m_per_px: float
    area_m2: float


@dataclass(frozen=True)
class PositionErrors:
    """Camera positions against a table: as they lie, and after the best similarity."""

    absolute: Spread
    shape: Spread
    missing: int


@dataclass(frozen=True, eq=False)
class MosaicEvaluation:
    """Everything that was measured of a site's map; empty or None where nothing was given to measure
    against.
    """

    site: str
    m_per_px: float
    flights: tuple[FlightTally, ...]
    truth: tuple[TruthErrors, ...]
    deviation: DeviationSummary
    reference: ReferenceMatch | None
    positions: PositionErrors | None


def evaluate_mosaic(
    site: Path, *, truth: Path | None = None, reference: Path | None = None, positions: Path | None = None
) -> MosaicEvaluation:
    """Measure the map in a site folder; the deviation from its own frames always, the rest where given.

    `truth` is a simulation's folder or the truth folder in it, `reference` a GeoTIFF of the same ground,
    `positions` a CSV of camera places: frame,longitude_deg,latitude_deg[,height_m][,flight]. Raises
    InputError for files that cannot be read or belong to another place, StoreError for a folder that is no
    site.
    """
    refuse_simulation(site)
    with Archive.open(site, write=False) as archive:
        described = archive.site()
        flights = map_frames(site, described)
        if (truth or reference or positions) and described.is_local:
            raise InputError(
                f"{site}: a map without geo-reference cannot be compared with truth, maps or positions"
            )
        tallies = _tally(flights)
        errors: tuple[TruthErrors, ...] = ()
        if truth:
            tallies, errors = _against_truth(flights, truth_file(truth), described)
        return MosaicEvaluation(
            described.name, described.m_per_px, tallies, errors,
            _deviation(archive),
            _against_reference(archive.mosaic_path, reference) if reference else None,
            _against_positions(flights, positions, described) if positions else None,
        )


def _tally(
    flights: Mapping[str, Sequence[FrameRow]], known: Mapping[str, Mapping[str, FrameRow]] | None = None
) -> tuple[FlightTally, ...]:
    tallies = []
    for name, rows in flights.items():
        ended = [row.status for row in rows]
        unmatched = 0 if known is None else sum(row.name not in known.get(name, {}) for row in rows)
        tallies.append(FlightTally(
            name, len(rows), ended.count(Status.VISION), ended.count(Status.GPS_ONLY),
            ended.count(Status.REJECTED), unmatched,
        ))
    return tuple(tallies)


def _against_truth(
    flights: Mapping[str, Sequence[FrameRow]], path: Path, described: Site
) -> tuple[tuple[FlightTally, ...], tuple[TruthErrors, ...]]:
    true: dict[str, dict[str, FrameRow]] = {}
    for feature in read_features(path):
        row = frame_row(feature, described.frame, path)
        true.setdefault(str(feature["properties"].get("flight", "")), {})[row.name] = row
    if len(true) == len(flights) == 1:
        # one flight on both sides: photos of a simulated flight may be mapped under their folder's name
        true = {next(iter(flights)): next(iter(true.values()))}
    pairs = {
        name: [(row, true[name][row.name]) for row in rows if row.name in true.get(name, {})]
        for name, rows in flights.items()
    }
    pairs = {name: found for name, found in pairs.items() if found}
    if not pairs:
        raise InputError(
            f"{path}: knows the flights {', '.join(sorted(true)) or 'none'}, the map has "
            f"{', '.join(sorted(flights))}, and no frame is in both; give the truth of this very flight"
        )
    errors = [_errors(name, found, described.m_per_px) for name, found in pairs.items()]
    if len(pairs) > 1:
        together = [pair for found in pairs.values() for pair in found]
        errors.append(_errors("all", together, described.m_per_px))
    far_m = min((each.corners.absolute.rms_m for each in errors if each.corners.absolute.count), default=0.0)
    if far_m > _FARTHEST_M:
        raise InputError(f"{path}: lies {far_m / 1000:.0f} km from the map; give the truth of its own flight")
    return _tally(flights, true), tuple(errors)


def _errors(name: str, pairs: Sequence[tuple[FrameRow, FrameRow]], m_per_px: float) -> TruthErrors:
    placed = [(mine, true) for mine, true in pairs if np.isfinite([mine.outline_m, true.outline_m]).all()]
    seen = [pair for pair in placed if pair[0].status == Status.VISION]
    by_gps = [pair for pair in placed if pair[0].status == Status.GPS_ONLY]
    fixed = [true for _, true in pairs if np.isfinite([true.fix_m, true.camera_m]).all()]
    corners = corner_errors(
        np.array([mine.outline_m for mine, _ in seen]).reshape(-1, 4, 2),
        np.array([true.outline_m for _, true in seen]).reshape(-1, 4, 2),
        m_per_px,
        np.array([true.camera_m for true in fixed]).reshape(-1, 2),
        np.array([true.fix_m for true in fixed]).reshape(-1, 2),
    )
    off_m = [np.linalg.norm(mine.outline_m - true.outline_m, axis=1) for mine, true in by_gps]
    cameras_m = [
        float(np.linalg.norm(mine.camera_m - true.camera_m)) for mine, true in pairs
        if np.isfinite([mine.camera_m, true.camera_m]).all()
    ]
    return TruthErrors(
        name, corners, spread_of(np.array(off_m), m_per_px), spread_of(np.array(cameras_m), m_per_px)
    )


def _deviation(archive: Archive) -> DeviationSummary:
    """The thesis's 4.1.1 over up to 120 keyframes, evenly chosen."""
    keyframes = archive.keyframes()
    if len(keyframes) > _DEVIATION_FRAMES:
        keyframes = [keyframes[i] for i in np.linspace(0, len(keyframes) - 1, _DEVIATION_FRAMES).astype(int)]
    tiles, grid = _RecentTiles(archive.tiles()), archive.site_grid()
    found = [_deviation_of(archive, keyframe, grid, tiles) for keyframe in keyframes]
    found = [each for each in found if each.count]
    if not found:
        nan = float("nan")
        return DeviationSummary(nan, nan, nan, np.zeros(DEVIATION_BINS), 0)
    shares = np.array([each.share for each in found])
    return DeviationSummary(
        float(shares.mean()), float(np.median(shares)), float(shares.max()),
        np.mean([each.histogram for each in found], axis=0), len(found),
    )


def _deviation_of(
    archive: Archive, keyframe: StoredKeyframe, site_grid: SiteGrid, tiles: "_RecentTiles"
) -> Deviation:
    image = archive.image(keyframe)
    height, width = image.shape[:2]
    x, y, z = keyframe.site_from_image @ np.array([width / 2, height / 2, 1.0])
    grid_from_site = site_grid.grid_from_site_affine(np.array([x / z, y / z]), 100.0)
    frame = CanvasFrame(0, 0, width, height, grid_from_site @ keyframe.site_from_image)
    low, high = np.floor(frame.outline_px.min(axis=0)), np.ceil(frame.outline_px.max(axis=0)) + 1
    window = int(low[0]), int(low[1]), int(high[0]), int(high[1])
    mosaic = tiles.crop(window, site_grid.grid.tile_px)
    mask = (coverage(frame, window) > 0) & (mosaic[..., 3] > 0)
    return deviation(np.ascontiguousarray(mosaic[..., :3]), warp(image, frame, window), mask)


class _RecentTiles:
    """Crops of a map's tiles; remembers the last 64, for neighbouring frames share most."""

    def __init__(self, tiles: Mapping[TileIndex, ImageRGBA]) -> None:
        self._tiles = tiles
        self._recent: dict[TileIndex, ImageRGBA] = {}

    def crop(self, window: tuple[int, int, int, int], side: int) -> ImageRGBA:
        """(height, width, 4) the map in a window of grid pixels (x0, y0, x1, y1, ends exclusive)."""
        x0, y0, x1, y1 = window
        result = np.zeros((y1 - y0, x1 - x0, 4), np.uint8)
        for row in range(y0 // side, (y1 - 1) // side + 1):
            for column in range(x0 // side, (x1 - 1) // side + 1):
                if (column, row) not in self._tiles:
                    continue
                left, top = max(x0, column * side), max(y0, row * side)
                right, bottom = min(x1, (column + 1) * side), min(y1, (row + 1) * side)
                tile = self._tile((column, row))
                result[top - y0:bottom - y0, left - x0:right - x0] = tile[
                    top - row * side:bottom - row * side, left - column * side:right - column * side
                ]
        return result

    def _tile(self, index: TileIndex) -> ImageRGBA:
        tile = self._recent.pop(index, None)
        if tile is None:
            tile = self._tiles[index]
            if len(self._recent) >= 64:
                del self._recent[next(iter(self._recent))]
        self._recent[index] = tile
        return tile


def _against_reference(mosaic_path: Path, reference: Path) -> ReferenceMatch:
    mine, other = read_raster(mosaic_path, _REFERENCE_PX), read_raster(reference, 2 * _REFERENCE_PX)
    if not other.crs:
        raise InputError(f"{reference}: has no coordinate system; a reference map needs one (a GeoTIFF)")
    gray, known = _resampled(other, mine)
    mask = known & (mine.rgba[..., 3] > 0)
    if mask.sum() < 1000:
        raise InputError(f"{reference}: shows hardly any ground of this map; give a map of the same place")
    own: Anything = cv2.cvtColor(np.ascontiguousarray(mine.rgba[..., :3]), cv2.COLOR_RGB2GRAY)
    shift = residual_shift(gray, own, mask)
    moved = np.array([[1, 0, -shift.x_px], [0, 1, -shift.y_px]])
    size = own.shape[1], own.shape[0]
    back: Anything = cv2.warpAffine(own, moved, size, borderMode=cv2.BORDER_REPLICATE)
    still = mask & (cv2.warpAffine(mask.astype(np.uint8), moved, size, flags=cv2.INTER_NEAREST) > 0)
    return ReferenceMatch(
        correlation(gray, own, mask), correlation(gray, back, still), shift,
        shift.x_px * mine.m_per_px, -shift.y_px * mine.m_per_px, mine.m_per_px,
        float(mask.sum()) * mine.m_per_px**2,
    )


def _resampled(raster: Raster, onto: Raster) -> tuple[ImageGray, Mask]:
    """A raster's gray in the pixels of another, and where it knows them; CRS to CRS by a lattice of
    points.
    """
    height, width = onto.rgba.shape[:2]
    step = 64
    columns, rows = np.arange(0, width + step, step), np.arange(0, height + step, step)
    x, y = (each.ravel().astype(np.float64) for each in np.meshgrid(columns, rows))
    points_m = np.column_stack([x, -y]) * onto.m_per_px + onto.origin_m
    if raster.crs != onto.crs:
        latitude_deg, longitude_deg = Projection(onto.crs).wgs84_from_projected(points_m)
        points_m = Projection(raster.crs).projected_from_wgs84(latitude_deg, longitude_deg)
    lattice: PointsPx = (points_m - raster.origin_m) / raster.m_per_px * [1.0, -1.0]
    # OpenCV's own enlargements round places to 1/32 of the lattice's step, which is pixels here
    down = np.maximum(0.0, 1 - abs(np.arange(height)[:, None] - rows) / step)
    across = np.maximum(0.0, 1 - abs(np.arange(width)[:, None] - columns) / step)
    places = np.einsum("hr,rcd->hcd", down, lattice.reshape(len(rows), len(columns), 2))
    places = np.einsum("wc,hcd->hwd", across, places, optimize=True).astype(np.float32)
    source = raster.rgba
    while onto.m_per_px > 2 * raster.m_per_px and min(source.shape[:2]) > 32:
        source = cv2.pyrDown(source)  # type: ignore[assignment]
        places = places / 2
        raster = Raster(source, raster.origin_m, 2 * raster.m_per_px, raster.crs)
    moved: Anything = cv2.remap(  # type: ignore[call-overload]
        source, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    gray: Anything = cv2.cvtColor(np.ascontiguousarray(moved[..., :3]), cv2.COLOR_RGB2GRAY)
    return gray, moved[..., 3] > 254


def _against_positions(
    flights: Mapping[str, Sequence[FrameRow]], path: Path, described: Site
) -> PositionErrors:
    known = _positions(path)
    mine, reference, missing = [], [], 0
    cameras = {(flight, row.name): row for flight, rows in flights.items() for row in rows}
    for (flight, name), (longitude_deg, latitude_deg, height_m) in known.items():
        found = [row for (of, each), row in cameras.items() if each == name and flight in ("", of)]
        if len(found) > 1:
            raise InputError(f"{path}: frame {name} is in several flights; add a column flight")
        if not found or not np.isfinite(found[0].camera_m).all():
            missing += 1
            continue
        place = site_points(described.frame, np.array([[longitude_deg, latitude_deg]]))[0]
        mine.append([*found[0].camera_m, found[0].camera_height_m])
        reference.append([*place, height_m])
    if not mine:
        raise InputError(f"{path}: none of its {len(known)} frames has a camera in this map; check the names")
    a, b = np.array(mine), np.array(reference)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        a, b = a[:, :2], b[:, :2]
    return PositionErrors(*position_errors(a, b, described.m_per_px), missing)


def _positions(path: Path) -> dict[tuple[str, str], tuple[float, float, float]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            table = csv.DictReader(file)
            rows = list(table)
        missing = [name for name in _POSITION_COLUMNS if name not in (table.fieldnames or ())]
        if missing:
            columns = ", ".join(table.fieldnames or ()) or "none at all"
            raise InputError(f"{path}: no column {', '.join(missing)}, but {columns}; {_POSITIONS_NEED}")
        return {
            ((row.get("flight") or "").strip(), row["frame"].strip()): (
                float(row["longitude_deg"]), float(row["latitude_deg"]), float(row.get("height_m") or "nan"),
            )
            for row in rows
        }
    except (OSError, UnicodeDecodeError, ValueError, AttributeError, TypeError, csv.Error) as error:
        raise InputError(
            f"{path}: cannot be read as camera positions ({error}); {_POSITIONS_NEED}"
        ) from error
