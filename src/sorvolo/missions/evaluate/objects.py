"""Measure what `sorvolo map` and `compare` say stands on the ground against a simulation's truth."""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Floats, Matrix3
from sorvolo.geometry.homography import apply_homography
from sorvolo.missions.evaluate.frame_rows import (
    PairedFlights,
    read_features,
    refuse_simulation,
    site_points,
    time_ns_of,
    truth_file,
)
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Site
from sorvolo.survey.objects import CLASSES

_REACH_M = 2.0  # a found object may lie so far from the true one, the map's own shift taken out
_OTHER_CLASS_M = 1.0  # so much farther a true object of another class seems
_LEAST_FRAMES = 2  # frames that were searched must show a true object before it has to be found
_VISIBLE = 0.5  # share of an object that nothing hides


@dataclass(frozen=True, eq=False)
class ObjectCounts:
    """Of one class or of all: true objects that had to be found, those found, those found under the right class.

    `twice` are reported objects beside one that is found already, `false` those where nothing is. What needed not be
    found (hardly seen, or hidden) is no error either way.
    """

    must_find: int
    found: int
    named_right: int
    twice: int
    false: int


@dataclass(frozen=True, eq=False)
class FlightObjects:
    """One flight's objects against the truth.

    `rms_m` and `p95_m` are distances of the places as they lie, `own_rms_m` without the map's own shift, which is
    `map_shift_m`. `within_two_sigma` is the share of single-axis errors under twice the stated sigma (0.954 if that is
    honest and errors are normal). `count_error` is reported less true, as a share of the true ones. `moving_right`
    counts the found ones of which it is told rightly whether they move. `length_error_m` is the median error of the
    longer side. NaN: nothing to measure.
    """

    flight: str
    by_class: Mapping[str, ObjectCounts]
    all: ObjectCounts
    count_error: float
    rms_m: float
    p95_m: float
    own_rms_m: float
    map_shift_m: float
    within_two_sigma: float
    sigma_median_m: float
    length_error_m: float
    moving: int
    moving_right: int
    missed: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Object:
    """A true or a found object; of a true one `place_m` is where it was in the middle of the flight."""

    name: str
    label: str
    place_m: Floats
    velocity_m_s: Floats
    length_m: float
    sigma_m: float = math.nan
    last_seen_ns: int = 0
    must_find: bool = True

    @property
    def moves(self) -> bool:
        return bool(np.any(self.velocity_m_s))


def evaluate_objects(site: Path, truth: Path, *, flight: str | None = None) -> tuple[FlightObjects, ...]:
    """Measure the objects of the site's flights against the folder that `sorvolo simulate` made.

    `flight` is one of the site's flights; None: all that were searched and that the truth knows. Raises InputError for
    folders that do not hold what is needed, SettingsError for a flight that was not searched.
    """
    refuse_simulation(site)
    frames_file = truth_file(truth)
    folder = frames_file.parent
    with Archive.open(site, write=False) as archive:
        described = archive.site()
        outlines_m = {each.flight_id: each.outlines_m for each in archive.searches()}
    searched = sorted(path.parent.name for path in (site / "flights").glob("*/objects.geojson"))
    if not searched:
        raise InputError(f"{site}: no flight of it was searched for objects; run `sorvolo map` with --model")
    unknown = [name for name in searched if name not in outlines_m]
    if unknown:
        raise InputError(
            f"{site}: flights/{unknown[0]}/objects.geojson is there, but the site's catalogue knows of no search of "
            "this flight; map it again with --model, or remove the file"
        )
    if flight is not None and flight not in searched:
        raise SettingsError(f"--flight {flight}: the flights of {site} that were searched are {', '.join(searched)}")
    if described.is_local:
        raise InputError(f"{site}: a map without geo-reference cannot be compared with a simulation's truth")
    flights = PairedFlights.read(site, frames_file, described)
    known = [name for name in searched if flights.true_name(name) and flight in (None, name)]
    if not known:
        raise InputError(f"{truth}: no frame of {', '.join(searched)} is in it; give the truth of these flights")
    return tuple(_evaluate(site, folder, described, flights, name, outlines_m[name]) for name in known)


def _evaluate(
    site: Path, folder: Path, described: Site, flights: PairedFlights, flight: str, outlines_m: Floats
) -> FlightObjects:
    true_name = flights.true_name(flight)
    map_from_truth, shift_m = flights.map_from_truth([flight])
    times_ns = [row.time_ns for row in flights.true[true_name].values()]
    middle_ns = (min(times_ns) + max(times_ns)) // 2
    found = _read_found(site / "flights" / flight / "objects.geojson", flights.clock(flight)[1])
    true = _read_true(folder, described, true_name, outlines_m, map_from_truth)
    pairs, twice, false = _matched(found, true, middle_ns, map_from_truth)
    offsets_m = _offsets_m(pairs, middle_ns, np.eye(3))
    distances_m = np.hypot(*offsets_m.T)
    stated = [(offset_m, one.sigma_m) for offset_m, (one, _) in zip(offsets_m, pairs) if math.isfinite(one.sigma_m)]
    within = [abs(error_m) <= 2 * sigma_m for offset_m, sigma_m in stated for error_m in offset_m]
    counted = [each for each in true if each.must_find]
    hit = {id(other) for _, other in pairs}
    optional = sum(not other.must_find for _, other in pairs)
    missed = [each for each in counted if id(each) not in hit]
    return FlightObjects(
        flight, {name: _counts(name, found, counted, pairs, twice, false) for name in CLASSES},
        _counts(None, found, counted, pairs, twice, false),
        (len(found) - optional - len(counted)) / len(counted) if counted else math.nan,
        _rms(distances_m), float(np.percentile(distances_m, 95)) if len(pairs) else math.nan,
        _rms(np.hypot(*_offsets_m(pairs, middle_ns, map_from_truth).T)), shift_m,
        float(np.mean(within)) if within else math.nan,
        float(np.median([sigma_m for _, sigma_m in stated])) if stated else math.nan,
        _median([abs(one.length_m - other.length_m) for one, other in pairs if not math.isnan(one.length_m)]),
        sum(other.moves for _, other in pairs), sum(one.moves == other.moves for one, other in pairs),
        tuple(f"{each.label} {each.name}" for each in missed),
    )


def _matched(
    found: Sequence[_Object], true: Sequence[_Object], middle_ns: int, map_from_truth: Matrix3
) -> tuple[list[tuple[_Object, _Object]], list[_Object], list[_Object]]:
    """Found and true ones in pairs, by their distances without the map's own shift; found ones beside a true one that
    has its pair; found ones beside nothing."""
    if not found or not true:
        return [], [], list(found)
    every = [(one, other) for one in found for other in true]
    apart_m = np.hypot(*_offsets_m(every, middle_ns, map_from_truth).T).reshape(len(found), len(true))
    differs = np.array([[one.label != other.label for other in true] for one in found])
    cost = np.where(apart_m <= _REACH_M, apart_m + _OTHER_CLASS_M * differs, 1e6)
    rows, columns = linear_sum_assignment(cost)
    pairs = [(found[row], true[column]) for row, column in zip(rows, columns) if cost[row, column] < 1e6]
    taken = {id(one) for one, _ in pairs}
    near = {id(one) for one, others in zip(found, apart_m <= _REACH_M) if others.any()}
    left = [each for each in found if id(each) not in taken]
    return pairs, [each for each in left if id(each) in near], [each for each in left if id(each) not in near]


def _place_m(true: _Object, found: _Object, middle_ns: int) -> Floats:
    """(2,) where the true object was when the found one was last seen."""
    return true.place_m + true.velocity_m_s * ((found.last_seen_ns - middle_ns) / 1e9 if true.moves else 0.0)


def _offsets_m(
    pairs: Sequence[tuple[_Object, _Object]], middle_ns: int, map_from_truth: Matrix3
) -> Floats:
    """(N, 2) how far the found ones lie from the true ones, those moved as the map lies."""
    places_m = np.array([_place_m(other, one, middle_ns) for one, other in pairs]).reshape(-1, 2)
    return np.array([one.place_m for one, _ in pairs]).reshape(-1, 2) - apply_homography(map_from_truth, places_m)


def _counts(
    name: str | None, found: Sequence[_Object], counted: Sequence[_Object],
    pairs: Sequence[tuple[_Object, _Object]], twice: Sequence[_Object], false: Sequence[_Object],
) -> ObjectCounts:
    def of(each: _Object) -> bool:
        return name is None or each.label == name

    hits = [(one, other) for one, other in pairs if other.must_find and of(other)]
    return ObjectCounts(
        sum(map(of, counted)), len(hits), sum(one.label == other.label for one, other in hits),
        sum(map(of, twice)), sum(map(of, false)),
    )


def _read_found(path: Path, behind_ns: int) -> list[_Object]:
    objects = []
    for feature in read_features(path):
        try:
            said = feature["properties"]
            objects.append(_Object(
                str(said["id"]), str(said["class"]), np.array([said["east_m"], said["north_m"]], np.float64),
                np.array(said["velocity_m_s"] or (0.0, 0.0), np.float64), _number(said["length_m"]),
                _number(said["sigma_m"]), time_ns_of(said["last_seen"]) + behind_ns,
            ))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: an object is not as docs/formats.md says ({error!r})") from error
    return objects


def _read_true(
    folder: Path, described: Site, flight: str, outlines_m: Floats, map_from_truth: Matrix3
) -> list[_Object]:
    """The people, cars and small objects of one flight, in the site's own metres."""
    path = folder / "objects.geojson"
    number, views = int("".join(filter(str.isdigit, flight)) or 1), _clear_views(folder / flight / "boxes.json")
    objects = []
    for feature in read_features(path):
        try:
            said = feature["properties"]
            if said["class"] not in CLASSES or number not in said["flights"]:
                continue
            ring = np.array(feature["geometry"]["coordinates"][0][:-1], np.float64)[:, :2]
            outline_m = site_points(described.frame, ring)
            place_m = (outline_m.min(axis=0) + outline_m.max(axis=0)) / 2
            shown_m = apply_homography(map_from_truth, place_m[None])[0]
            seen = views[int(said["id"])] > 0 and _frames_over(shown_m, outlines_m) >= _LEAST_FRAMES
            objects.append(_Object(
                str(said["id"]), str(said["class"]), place_m, np.array(said["velocity_m_s"], np.float64),
                float(said["length_m"]), must_find=seen,
            ))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(f"{path}: an object is not as docs/simulation.md says ({error!r})") from error
    return objects


def _clear_views(path: Path) -> Counter[int]:
    """How many of the truth's sampled frames show each object clearly, by id."""
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["annotations"]
        return Counter(int(row["object_id"]) for row in rows if row["visibility"] > _VISIBLE)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} cannot be read ({error!r}); run `sorvolo simulate` again") from error


def _frames_over(place_m: Floats, outlines_m: Floats) -> int:
    """How many outlines (N, 4, 2) hold a place (2,)."""
    return sum(
        cv2.pointPolygonTest((outline_m - place_m).astype(np.float32), (0.0, 0.0), False) > 0
        for outline_m in outlines_m
    )


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _rms(distances_m: Floats) -> float:
    return float(np.sqrt(np.mean(distances_m**2))) if len(distances_m) else math.nan


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else math.nan
