"""Measure the objects that `sorvolo map` and `compare` report against a simulation's truth."""

import json
import math
from collections import Counter
from collections.abc import Container
from pathlib import Path
from typing import Any

from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Floats, Matrix3, floats
from sorvolo.lab.evaluation.frame_rows import (
    paired_flights,
    read_features,
    refuse_simulation,
    time_ns_of,
    truth_file,
)
from sorvolo.lab.evaluation.track_metrics import (
    FlightObjects,
    JudgedObject,
    frames_over,
    middle_of,
    score_objects,
)
from sorvolo.mosaic.paired_flights import PairedFlights
from sorvolo.paths import AnyPath
from sorvolo.store.exports.plain import features_path
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Site
from sorvolo.survey.objects import CLASSES

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
