"""Measure a site's map: against the truth of a simulation, its own frames, another map, or known camera places."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sorvolo.errors import InputError
from sorvolo.lab.evaluation.frame_rows import (
    map_frames,
    refuse_simulation,
    true_frames,
    truth_file,
)
from sorvolo.mosaic.frame_deviation import (
    DeviationSummary,
    MapDeviation,
    frames_to_compare,
    summed_up,
)
from sorvolo.mosaic.reference_match import MapPicture, ReferenceMatch, match_reference
from sorvolo.mosaic.truth_errors import PositionErrors, TruthErrors, table_errors, truth_errors
from sorvolo.store.rasters.geotiff import Raster, read_raster
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Site
from sorvolo.survey.frame_rows import FrameRow
from sorvolo.survey.mosaic import Status

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


@dataclass(frozen=True)
class _TablePlace:
    """A row of a table of camera places: degrees, metres, NaN for a height that it has not."""

    longitude_deg: float
    latitude_deg: float
    height_m: float


def evaluate_mosaic(
    site: Path,
    *,
    truth: Path | None = None,
    reference: Path | None = None,
    positions: Path | None = None,
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
            described.name,
            described.m_per_px,
            tallies,
            errors,
            _deviation(archive),
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
    pairs = _paired(flights, true)
    if not pairs:
        raise InputError(
            f"{path}: knows the flights {', '.join(sorted(true)) or 'none'}, the map has "
            f"{', '.join(sorted(flights))}, and no frame is in both; give the truth of this very flight"
        )
    errors = [truth_errors(name, found, described.m_per_px) for name, found in pairs.items()]
    if len(pairs) > 1:
        together = [pair for found in pairs.values() for pair in found]
        errors.append(truth_errors("all", together, described.m_per_px))
    _refuse_far(errors, path)
    return _tally(flights, true), tuple(errors)


def _refuse_far(errors: Sequence[TruthErrors], path: Path) -> None:
    far_m = min(
        (each.corners.absolute.rms_m for each in errors if each.corners.absolute.count), default=0.0
    )
    if far_m > _FARTHEST_M:
        raise InputError(
            f"{path}: lies {far_m / 1000:.0f} km from the map; give the truth of its own flight"
        )


def _paired(
    flights: Mapping[str, Sequence[FrameRow]], true: Mapping[str, Mapping[str, FrameRow]]
) -> dict[str, list[tuple[FrameRow, FrameRow]]]:
    """The frames of each flight beside the true ones; flights that share none are left out."""
    pairs = {
        name: [(row, true[name][row.name]) for row in rows if row.name in true.get(name, {})]
        for name, rows in flights.items()
    }
    return {name: found for name, found in pairs.items() if found}


def _deviation(archive: Archive) -> DeviationSummary:
    """The thesis's 4.1.1 over up to 120 keyframes, evenly chosen."""
    keyframes = archive.keyframes()
    keyframes = [keyframes[i] for i in frames_to_compare(len(keyframes), _DEVIATION_FRAMES)]
    deviation = MapDeviation(archive.tiles(), archive.site_grid())
    return summed_up(
        [deviation.of(archive.image(each), each.site_from_image) for each in keyframes]
    )


def _against_reference(mosaic_path: Path, reference: Path) -> ReferenceMatch:
    mine, other = read_raster(mosaic_path, _REFERENCE_PX), read_raster(reference, 2 * _REFERENCE_PX)
    if not other.crs:
        raise InputError(
            f"{reference}: has no coordinate system; a reference map needs one (a GeoTIFF)"
        )
    found = match_reference(_map_picture(mine), _map_picture(other))
    if found is None:
        raise InputError(
            f"{reference}: shows hardly any ground of this map; give a map of the same place"
        )
    return found


def _map_picture(raster: Raster) -> MapPicture:
    return MapPicture(raster.rgba, raster.origin_m, raster.m_per_px, raster.crs)


def _against_positions(
    flights: Mapping[str, Sequence[FrameRow]], path: Path, described: Site
) -> PositionErrors:
    known = _positions(path)
    mine: list[FrameRow] = []
    places_m: list[tuple[float, float, float]] = []
    cameras = {(flight, row.name): row for flight, rows in flights.items() for row in rows}
    for (flight, name), place in known.items():
        found = _rows_of(cameras, flight, name, path)
        if found and found[0].has_camera:
            east_m, north_m = described.frame.ground_from_lonlat(
                [[place.longitude_deg, place.latitude_deg]]
            )[0]
            mine.append(found[0])
            places_m.append((float(east_m), float(north_m), place.height_m))
    if not mine:
        raise InputError(
            f"{path}: none of its {len(known)} frames has a camera in this map; check the names"
        )
    return table_errors(mine, places_m, len(known) - len(mine), described.m_per_px)


def _rows_of(
    cameras: Mapping[tuple[str, str], FrameRow], flight: str, name: str, path: Path
) -> list[FrameRow]:
    """The frame of this name, of this flight or ("") of any; raises InputError where several flights have one."""
    found = [row for (of, each), row in cameras.items() if each == name and flight in ("", of)]
    if len(found) > 1:
        raise InputError(f"{path}: frame {name} is in several flights; add a column flight")
    return found


def _positions(path: Path) -> dict[tuple[str, str], _TablePlace]:
    """The places of a table by flight ("": any) and frame; raises InputError where it cannot be read."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            table = csv.DictReader(file)
            rows = list(table)
        _demand_columns(path, table.fieldnames or ())
        return {
            ((row.get("flight") or "").strip(), row["frame"].strip()): _TablePlace(
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


def _demand_columns(path: Path, columns: Sequence[str]) -> None:
    missing = [name for name in _POSITION_COLUMNS if name not in columns]
    if missing:
        there = ", ".join(columns) or "none at all"
        raise InputError(f"{path}: no column {', '.join(missing)}, but {there}; {_POSITIONS_NEED}")
