"""Measure a site's map: against the truth of a simulation, its own frames, another map, or known camera places."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from rasterio.enums import Resampling
from rasterio.transform import Affine
from rasterio.warp import reproject

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, ImageGray, Mask
from sorvolo.geometry.homography import shifted
from sorvolo.lab.evaluation.frame_rows import (
    map_frames,
    refuse_simulation,
    true_frames,
    truth_file,
)
from sorvolo.lab.evaluation.map_quality import (
    CornerErrors,
    DeviationSummary,
    MapDeviation,
    Shift,
    Spread,
    corner_errors,
    correlation,
    frames_to_compare,
    position_errors,
    residual_shift,
    spread_of,
    summed_up,
)
from sorvolo.paths import AnyPath, as_path
from sorvolo.registration.features import gray_from_rgb
from sorvolo.store.rasters.geotiff import Raster, read_raster
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import FrameRow, Status


@dataclass(frozen=True)
class TruthErrors:
    """A flight's errors against truth ("all" for all together): frames placed by vision, and by GPS alone."""

    flight: str
    corners: CornerErrors
    gps_only: Spread
    cameras: Spread


@dataclass(frozen=True)
class PositionErrors:
    """Camera positions against a table: as they lie, and after the best similarity; `missing` of its frames have none."""

    absolute: Spread
    shape: Spread
    missing: int


def truth_errors(
    name: str, pairs: Sequence[tuple[FrameRow, FrameRow]], m_per_px: float
) -> TruthErrors:
    """The errors of a flight's frames, each given beside the true one."""
    # (N, 2) the true camera positions and the GPS fixes of the frames that have both
    fixed = [true for _, true in pairs if true.has_fix and true.has_camera]
    true_cameras_m = np.array([true.camera_m for true in fixed]).reshape(-1, 2)
    fixes_m = np.array([true.fix_m for true in fixed]).reshape(-1, 2)
    outlines_m = _outlines_m(pairs, Status.VISION)
    corners = corner_errors(*outlines_m, m_per_px, true_cameras_m, fixes_m)
    by_gps_m = [
        np.linalg.norm(mine - true, axis=1)
        for mine, true in zip(*_outlines_m(pairs, Status.GPS_ONLY))
    ]
    cameras_m = [
        float(np.linalg.norm(mine.camera_m - true.camera_m))
        for mine, true in pairs
        if mine.has_camera and true.has_camera
    ]
    return TruthErrors(
        name,
        corners,
        spread_of(np.array(by_gps_m), m_per_px),
        spread_of(np.array(cameras_m), m_per_px),
    )


def _outlines_m(
    pairs: Sequence[tuple[FrameRow, FrameRow]], status: Status
) -> tuple[Floats, Floats]:
    """(N, 4, 2) the estimated and the true outlines of the frames with this status that have both."""
    both = [
        pair
        for pair in pairs
        if pair[0].status == status and pair[0].has_outline and pair[1].has_outline
    ]
    mine = np.array([each.outline_m for each, _ in both]).reshape(-1, 4, 2)
    return mine, np.array([each.outline_m for _, each in both]).reshape(-1, 4, 2)


_LEAST_PX = 1000  # of common ground


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


def _resampled(raster: Raster, onto: Raster) -> tuple[ImageGray, Mask]:
    """A raster's gray in the pixels of another, and where it knows them."""
    moved = np.zeros((4, *onto.rgba.shape[:2]), np.uint8)
    reproject(
        np.moveaxis(raster.rgba, 2, 0),
        moved,
        src_transform=_transform(raster),
        src_crs=raster.crs,
        dst_transform=_transform(onto),
        dst_crs=onto.crs,
        resampling=Resampling.bilinear,
        tolerance=0.0,
    )
    return gray_from_rgb(np.ascontiguousarray(np.moveaxis(moved[:3], 0, 2))), moved[3] > 254


def _transform(raster: Raster) -> Affine:
    """Of GDAL, from the outer corner of the first pixel, whose centre is at the raster's origin."""
    west_m, north_m = raster.origin_m + raster.m_per_px * np.array([-0.5, 0.5])
    return Affine(raster.m_per_px, 0, west_m, 0, -raster.m_per_px, north_m)


_DEVIATION_FRAMES = 120  # at most, spread over the flight: it bounds the time
_REFERENCE_PX = 2048  # longer side at which maps are compared
_FARTHEST_M = 10_000.0  # from the map: a truth so far away is another flight's
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


@dataclass(frozen=True, eq=False)
class MosaicEvaluation:
    """Everything that was measured of a site's map; empty or None where nothing was given to measure against."""

    site: str
    m_per_px: float
    flights: tuple[FlightTally, ...]
    truth: tuple[TruthErrors, ...]
    deviation: DeviationSummary
    reference: ReferenceMatch | None
    positions: PositionErrors | None


def evaluate_mosaic(
    site: AnyPath,
    *,
    truth: AnyPath | None = None,
    reference: AnyPath | None = None,
    positions: AnyPath | None = None,
) -> MosaicEvaluation:
    """Measure the map in a site folder; the deviation from its own frames always, the rest where given.

    `truth` is a simulation's folder or the truth folder in it, `reference` a GeoTIFF of the same ground,
    `positions` a CSV of camera places: frame, longitude_deg, latitude_deg, and maybe height_m and flight. Raises
    InputError for files that cannot be read or belong to another place, StoreError for a folder that is no
    site.
    """
    site = Path(site)
    truth = as_path(truth)
    reference = as_path(reference)
    positions = as_path(positions)
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
        # The thesis's 4.1.1 over up to 120 keyframes, evenly chosen.
        keyframes = archive.keyframes()
        keyframes = [keyframes[i] for i in frames_to_compare(len(keyframes), _DEVIATION_FRAMES)]
        deviation = MapDeviation(archive.tiles(), archive.site_grid())
        return MosaicEvaluation(
            described.name,
            described.m_per_px,
            tallies,
            errors,
            summed_up(
                [deviation.of(archive.image(each), each.site_from_image) for each in keyframes]
            ),
            _against_reference(archive.mosaic_path, reference) if reference else None,
            _against_positions(flights, positions, described) if positions else None,
        )


def _tally(
    flights: Mapping[str, Sequence[FrameRow]],
    known: Mapping[str, Mapping[str, FrameRow]] | None = None,
) -> tuple[FlightTally, ...]:
    tallies = []
    for name, rows in flights.items():
        ended = [row.status for row in rows]
        unmatched = 0 if known is None else sum(row.name not in known.get(name, {}) for row in rows)
        tallies.append(
            FlightTally(
                name,
                len(rows),
                ended.count(Status.VISION),
                ended.count(Status.GPS_ONLY),
                ended.count(Status.REJECTED),
                unmatched,
            )
        )
    return tuple(tallies)


def _against_truth(
    flights: Mapping[str, Sequence[FrameRow]], path: Path, described: Site
) -> tuple[tuple[FlightTally, ...], tuple[TruthErrors, ...]]:
    true = true_frames(path, described.frame)
    if len(true) == len(flights) == 1:
        # one flight on both sides: photos of a simulated flight may be mapped under their folder's name
        true = {next(iter(flights)): next(iter(true.values()))}
    # the frames of each flight beside the true ones; flights that share none are left out
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
    errors = [truth_errors(name, found, described.m_per_px) for name, found in pairs.items()]
    if len(pairs) > 1:
        together = [pair for found in pairs.values() for pair in found]
        errors.append(truth_errors("all", together, described.m_per_px))
    far_m = min(
        (each.corners.absolute.rms_m for each in errors if each.corners.absolute.count), default=0.0
    )
    if far_m > _FARTHEST_M:
        raise InputError(
            f"{path}: lies {far_m / 1000:.0f} km from the map; give the truth of its own flight"
        )
    return _tally(flights, true), tuple(errors)


def _against_reference(mosaic_path: Path, reference: Path) -> ReferenceMatch:
    mine, other = read_raster(mosaic_path, _REFERENCE_PX), read_raster(reference, 2 * _REFERENCE_PX)
    if not other.crs:
        raise InputError(
            f"{reference}: has no coordinate system; a reference map needs one (a GeoTIFF)"
        )
    gray, known = _resampled(other, mine)
    mask = known & (mine.rgba[..., 3] > 0)
    if mask.sum() < _LEAST_PX:
        raise InputError(
            f"{reference}: shows hardly any ground of this map; give a map of the same place"
        )
    own = gray_from_rgb(np.ascontiguousarray(mine.rgba[..., :3]))
    shift = residual_shift(gray, own, mask)
    moved = shifted(-shift.x_px, -shift.y_px)[:2]
    size = own.shape[1], own.shape[0]
    back = np.asarray(cv2.warpAffine(own, moved, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)
    still = mask & (cv2.warpAffine(mask.astype(np.uint8), moved, size, flags=cv2.INTER_NEAREST) > 0)
    return ReferenceMatch(
        correlation(gray, own, mask),
        correlation(gray, back, still),
        shift,
        shift.x_px * mine.m_per_px,
        -shift.y_px * mine.m_per_px,
        mine.m_per_px,
        float(mask.sum()) * mine.m_per_px**2,
    )


def _against_positions(
    flights: Mapping[str, Sequence[FrameRow]], path: Path, described: Site
) -> PositionErrors:
    known = _positions(path)
    cameras_m: list[list[float]] = []
    places_m: list[list[float]] = []
    for (flight, name), (longitude_deg, latitude_deg, height_m) in known.items():
        found = [
            row
            for of, rows in flights.items()
            for row in rows
            if row.name == name and flight in ("", of)
        ]
        if len(found) > 1:
            raise InputError(f"{path}: frame {name} is in several flights; add a column flight")
        if found and found[0].has_camera:
            cameras_m.append([*found[0].camera_m, found[0].camera_height_m])
            place_m = described.frame.ground_from_lonlat([[longitude_deg, latitude_deg]])[0]
            places_m.append([*place_m, height_m])
    if not places_m:
        raise InputError(
            f"{path}: none of its {len(known)} frames has a camera in this map; check the names"
        )
    # heights count where all are known
    axes = 3 if np.isfinite(cameras_m).all() and np.isfinite(places_m).all() else 2
    errors = position_errors(
        np.array(cameras_m)[:, :axes], np.array(places_m)[:, :axes], described.m_per_px
    )
    return PositionErrors(*errors, len(known) - len(places_m))


def _positions(path: Path) -> dict[tuple[str, str], tuple[float, float, float]]:
    """Longitude and latitude, deg, and height, m, of a table by flight ("": any) and frame; raises InputError where it cannot be read."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            table = csv.DictReader(file)
            rows = list(table)
        columns = table.fieldnames or ()
        missing = [name for name in _POSITION_COLUMNS if name not in columns]
        if missing:
            there = ", ".join(columns) or "none at all"
            raise InputError(
                f"{path}: no column {', '.join(missing)}, but {there}; {_POSITIONS_NEED}"
            )
        return {
            ((row.get("flight") or "").strip(), row["frame"].strip()): (
                float(row["longitude_deg"]),
                float(row["latitude_deg"]),
                float(row.get("height_m") or "nan"),
            )
            for row in rows
        }
    except (OSError, UnicodeDecodeError, ValueError, AttributeError, TypeError, csv.Error) as error:
        raise InputError(
            f"{path}: cannot be read as camera positions ({error}); {_POSITIONS_NEED}"
        ) from error
