"""Measure the objects that `sorvolo map` and `compare` report against a simulation's truth."""

import json
import math
from collections import Counter
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Floats, Matrix3, floats, frozen
from sorvolo.geometry.homography import apply_homography
from sorvolo.lab.evaluation.change_metrics import percentile, sigma_median_m, within_two_sigma
from sorvolo.lab.evaluation.frame_rows import (
    paired_flights,
    read_features,
    refuse_simulation,
    time_ns_of,
    truth_file,
)
from sorvolo.mosaic.paired_flights import PairedFlights
from sorvolo.paths import AnyPath
from sorvolo.store.exports.plain import features_path
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Site
from sorvolo.survey.objects import CLASSES
from sorvolo.tracking.association import least_cost

_REACH_M = 2.0  # a found object may lie so far from the true one, the map's own shift taken out
_OTHER_CLASS_M = 1.0  # so much farther a true object of another class seems
_APART = 1e6  # the cost of a pair that cannot be


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
    counts the found ones that are rightly reported as moving or standing. `length_error_m` is the median error of the
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
class JudgedObject:
    """A true or a found object; of a true one `place_m` is where it was in the middle of the flight."""

    name: str
    label: str
    place_m: Floats
    velocity_m_s: Floats
    length_m: float
    sigma_m: float = math.nan
    last_seen_ns: int = 0
    must_find: bool = True

    def __post_init__(self) -> None:
        for name in ("place_m", "velocity_m_s"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @property
    def moves(self) -> bool:
        """Whether it moves."""
        return bool(np.any(self.velocity_m_s))


@dataclass(frozen=True, eq=False)
class ObjectMatch:
    """Found and true ones in pairs; found ones beside a true one that has its pair (`twice`), or beside nothing."""

    pairs: tuple[tuple[JudgedObject, JudgedObject], ...]
    twice: tuple[JudgedObject, ...]
    false: tuple[JudgedObject, ...]


def match_objects(
    found: Sequence[JudgedObject],
    true: Sequence[JudgedObject],
    middle_ns: int,
    map_from_truth: Matrix3,
) -> ObjectMatch:
    """Pair found and true ones by their distances without the map's own shift, `map_from_truth` (3, 3).

    `middle_ns` is the time at which true ones are at their `place_m`.
    """
    if not found or not true:
        return ObjectMatch((), (), tuple(found))
    every = [(one, other) for one in found for other in true]
    apart_m = np.hypot(*_offsets_m(every, middle_ns, map_from_truth).T).reshape(
        len(found), len(true)
    )
    differs = np.array([one.label != other.label for one, other in every]).reshape(apart_m.shape)
    cost = np.where(apart_m <= _REACH_M, apart_m + _OTHER_CLASS_M * differs, _APART)
    rows, columns = least_cost(cost)
    pairs = tuple(
        (found[row], true[column])
        for row, column in zip(rows, columns)
        if cost[row, column] < _APART
    )
    # Found ones without a pair: those beside a true one, by `is_near` (found,), and those beside nothing
    is_near = (apart_m <= _REACH_M).any(axis=1)
    taken = {id(one) for one, _ in pairs}
    left = [(each, near) for each, near in zip(found, is_near) if id(each) not in taken]
    unpaired = (
        tuple(each for each, near in left if near),
        tuple(each for each, near in left if not near),
    )
    return ObjectMatch(pairs, *unpaired)


def score_objects(
    flight: str,
    found: Sequence[JudgedObject],
    true: Sequence[JudgedObject],
    middle_ns: int,
    map_from_truth: Matrix3,
    map_shift_m: float,
) -> FlightObjects:
    """The numbers of one flight; `map_from_truth` takes true places to where the map shows them."""
    match = match_objects(found, true, middle_ns, map_from_truth)
    pairs = match.pairs
    offsets_m = _offsets_m(pairs, middle_ns, np.eye(3))
    distances_m = np.hypot(*offsets_m.T)
    counted = [each for each in true if each.must_find]
    stated = [(offset_m, one.sigma_m) for offset_m, (one, _) in zip(offsets_m, pairs)]
    return FlightObjects(
        flight,
        {name: _counts(name, counted, match) for name in CLASSES},
        _counts(None, counted, match),
        _count_error(found, counted, match),
        _rms(distances_m),
        percentile(distances_m.tolist(), 95),
        _rms(np.hypot(*_offsets_m(pairs, middle_ns, map_from_truth).T)),
        map_shift_m,
        within_two_sigma(stated),
        sigma_median_m(stated),
        percentile(
            [
                abs(one.length_m - other.length_m)
                for one, other in pairs
                if not math.isnan(one.length_m)
            ],
            50,
        ),
        sum(other.moves for _, other in pairs),
        sum(one.moves == other.moves for one, other in pairs),
        _missed(counted, match),
    )


def middle_of(outline_m: Floats) -> Floats:
    """(2,) the middle of the box around an outline, (N, 2)."""
    return np.asarray((outline_m.min(axis=0) + outline_m.max(axis=0)) / 2, np.float64)


def frames_over(outline_m: Floats, map_from_truth: Matrix3, outlines_m: Floats) -> int:
    """How many frames' outlines on the map, (N, 4, 2), hold the middle of a true outline."""
    place_m = apply_homography(map_from_truth, middle_of(outline_m)[None])[0]
    return sum(
        cv2.pointPolygonTest((each - place_m).astype(np.float32), (0.0, 0.0), False) > 0
        for each in outlines_m
    )


def _count_error(
    found: Sequence[JudgedObject], counted: Sequence[JudgedObject], match: ObjectMatch
) -> float:
    optional = sum(not other.must_find for _, other in match.pairs)
    return (len(found) - optional - len(counted)) / len(counted) if counted else math.nan


def _missed(counted: Sequence[JudgedObject], match: ObjectMatch) -> tuple[str, ...]:
    hit = {id(other) for _, other in match.pairs}
    return tuple(f"{each.label} {each.name}" for each in counted if id(each) not in hit)


def _offsets_m(
    pairs: Sequence[tuple[JudgedObject, JudgedObject]], middle_ns: int, map_from_truth: Matrix3
) -> Floats:
    """(N, 2) how far the found ones lie from the true ones, those moved as the map lies."""
    # (2,) where the true object was when the found one was last seen
    places_m = np.array(
        [
            other.place_m
            + other.velocity_m_s * ((one.last_seen_ns - middle_ns) / 1e9 if other.moves else 0.0)
            for one, other in pairs
        ]
    ).reshape(-1, 2)
    return np.array([one.place_m for one, _ in pairs]).reshape(-1, 2) - apply_homography(
        map_from_truth, places_m
    )


def _counts(name: str | None, counted: Sequence[JudgedObject], match: ObjectMatch) -> ObjectCounts:
    """Those of a class; None: of all."""

    def of(each: JudgedObject) -> bool:
        return name is None or each.label == name

    hits = [(one, other) for one, other in match.pairs if other.must_find and of(other)]
    return ObjectCounts(
        sum(map(of, counted)),
        len(hits),
        sum(one.label == other.label for one, other in hits),
        sum(map(of, match.twice)),
        sum(map(of, match.false)),
    )


def _rms(distances_m: Floats) -> float:
    return float(np.sqrt(np.mean(distances_m**2))) if len(distances_m) else math.nan


_LEAST_FRAMES = 2  # frames that were searched must show a true object before it has to be found
_VISIBLE = 0.5  # share of an object that nothing hides


def evaluate_objects(
    site: AnyPath, truth: AnyPath, *, flight: str | None = None
) -> tuple[FlightObjects, ...]:
    """Measure the objects of the site's flights against the folder that `sorvolo simulate` made.

    `flight` is one of the site's flights; None: all that were searched and that the truth knows. Raises InputError for
    folders that do not hold what is needed, SettingsError for a flight that was not searched.
    """
    site = Path(site)
    truth = Path(truth)
    refuse_simulation(site)
    frames_file = truth_file(truth)
    folder = frames_file.parent
    with Archive.open(site, write=False) as archive:
        described = archive.site()
        outlines_m = {each.flight_id: each.frames.outlines_m for each in archive.searches()}
    searched = _searched_flights(site, outlines_m)
    if flight is not None and flight not in searched:
        raise SettingsError(
            f"--flight {flight}: the flights of {site} that were searched are {', '.join(searched)}"
        )
    if described.is_local:
        raise InputError(
            f"{site}: a map without geo-reference cannot be compared with a simulation's truth"
        )
    flights = paired_flights(site, frames_file, described)
    known = [name for name in searched if flights.true_name(name) and flight in (None, name)]
    if not known:
        raise InputError(
            f"{truth}: no frame of {', '.join(searched)} is in it; give the truth of these flights"
        )
    return tuple(
        _evaluate(site, folder, described, flights, name, outlines_m[name]) for name in known
    )


def _searched_flights(site: Path, known: Container[str]) -> list[str]:
    """The flights that were searched for objects; raises InputError for none, and for one that is not in `known`."""
    searched = sorted(path.parent.name for path in (site / "flights").glob("*/objects.*json"))
    if not searched:
        raise InputError(
            f"{site}: no flight of it was searched for objects; run `sorvolo map` with --model"
        )
    unknown = [name for name in searched if name not in known]
    if unknown:
        raise InputError(
            f"{site}: flights/{unknown[0]}/objects.geojson is there, but the site's catalogue knows of no search of "
            "this flight; map it again with --model, or remove the file"
        )
    return searched


def _evaluate(
    site: Path,
    folder: Path,
    described: Site,
    flights: PairedFlights,
    flight: str,
    outlines_m: Floats,
) -> FlightObjects:
    true_name = flights.true_name(flight)
    map_from_truth, shift_m = flights.map_from_truth([flight])
    times_ns = [row.time_ns for row in flights.true[true_name].values()]
    middle_ns = (min(times_ns) + max(times_ns)) // 2
    found = _read_found(
        features_path(site / "flights" / flight, "objects"), flights.clock(flight)[1]
    )
    true = _read_true(folder, described, true_name, outlines_m, map_from_truth)
    return score_objects(flight, found, true, middle_ns, map_from_truth, shift_m)


def _read_found(path: Path, behind_ns: int) -> list[JudgedObject]:
    objects = []
    for feature in read_features(path):
        try:
            properties = feature["properties"]
            objects.append(
                JudgedObject(
                    str(properties["id"]),
                    str(properties["class"]),
                    floats([properties["east_m"], properties["north_m"]]),
                    floats(properties["velocity_m_s"] or (0.0, 0.0)),
                    _number(properties["length_m"]),
                    _number(properties["sigma_m"]),
                    time_ns_of(properties["last_seen"]) + behind_ns,
                )
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{path}: an object is not as docs/formats.md has it ({error!r})"
            ) from error
    return objects


def _read_true(
    folder: Path, described: Site, flight: str, outlines_m: Floats, map_from_truth: Matrix3
) -> list[JudgedObject]:
    """The people, cars and small objects of one flight, in the site's own metres."""
    path = folder / "objects.geojson"
    number, views = (
        int("".join(filter(str.isdigit, flight)) or 1),
        _clear_views(folder / flight / "boxes.json"),
    )
    objects = []
    for feature in read_features(path):
        try:
            properties = feature["properties"]
            if properties["class"] not in CLASSES or number not in properties["flights"]:
                continue
            outline_m = described.frame.ground_from_lonlat(
                feature["geometry"]["coordinates"][0][:-1]
            )
            seen = views[int(properties["id"])] > 0
            seen = seen and frames_over(outline_m, map_from_truth, outlines_m) >= _LEAST_FRAMES
            objects.append(
                JudgedObject(
                    str(properties["id"]),
                    str(properties["class"]),
                    middle_of(outline_m),
                    floats(properties["velocity_m_s"]),
                    float(properties["length_m"]),
                    must_find=seen,
                )
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(
                f"{path}: an object is not as docs/simulation.md has it ({error!r})"
            ) from error
    return objects


def _clear_views(path: Path) -> Counter[int]:
    """How many of the truth's sampled frames show each object clearly, by id."""
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["annotations"]
        return Counter(int(row["object_id"]) for row in rows if row["visibility"] > _VISIBLE)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} cannot be read ({error!r}); run `sorvolo simulate` again"
        ) from error


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)
