"""Where whole flights find their place on a map (decision 0087), and whether ground that is not theirs is refused.

python benchmarks/flight_on_map.py DATA --keep FOLDER [--pairs 2023-10-14/2024-02-24 ...] [--seed 2] [--aside 4]

DATA holds building_site/, caliterra/ and brighton_beach/. Three kinds of ground:

- **dates**: pairs of dates of one building site, photos without attitude, GPS good to 1 m; flights, maps and what is
  right are those of real_dates.py, which describes them.
- **own**: photos of a real flight over the map that was made of them, at most 60.
- **simulated**: a simulated flight over the map of another one, from 20 and from 60 m up: nothing is there to be found.

Each flight is looked for in its place (but for the simulated ones) and `--aside` times moved by 25 to 80 m to where
other ground of the same site lies, in directions drawn from the commit. A flight counts as found where
`FlightOnMapSettings` accept it; what they go by is written of every try, refused ones as well: `votes` times the mean
place's, pairs that `agree`, and on how many times as many squares as chance leaves (`spread`). Written to
results/flight_on_map.json.
"""

import argparse
import json
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import real_dates
from provenance import commit, drawn_seeds, machine, note_scoring
from sorvolo.capture.source import opened_sources
from sorvolo.change.flight_on_map import FlightOnMap, FlightOnMapSettings, PhotoFeatures
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography, site_from_image_homography
from sorvolo.geometry.pose import Pose
from sorvolo.lab.evaluation.frame_rows import map_frames
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SensorSettings,
    SimulationSettings,
)
from sorvolo.missions.compare.run import view_maker
from sorvolo.missions.compare.whole_flight import WholeFlight
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.flight.setup import known_flights, known_ground_m, prepare
from sorvolo.missions.map.flights import map_flights
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Frame, PosedFrame

RESULTS = Path(__file__).parent / "results" / "flight_on_map.json"
APART = (  # four months and more
    "2023-10-14/2024-02-24",
    "2023-10-14/2024-03-01",
    "2023-10-14/2024-03-12",
    "2023-09-26/2024-02-24",
    "2023-09-26/2024-03-01",
    "2023-09-26/2024-03-12",
)
OWN = ("caliterra", "brighton_beach")
HEIGHTS_M = (20.0, 60.0)
MOST_PHOTOS = 60  # of a real flight
ASIDE_M = (25.0, 80.0)


@dataclass(frozen=True, eq=False)
class Laid:
    """A flight whose photos are laid on each other and wait to be looked for: their features, their cameras' places by
    index, their names, their camera without distortion, and where that has the corners of pictures as taken (4, 2)."""

    on_map: FlightOnMap
    photos: Mapping[int, PhotoFeatures]
    poses: Mapping[int, Pose]
    names: Mapping[int, str]
    camera: Camera
    corners_px: np.ndarray


def main() -> None:
    """Look for every flight in its place and aside of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument(
        "--keep",
        type=Path,
        required=True,
        help="folder for photos and maps, used again when run again",
    )
    parser.add_argument("--pairs", nargs="*", choices=real_dates.PAIRS, default=APART)
    parser.add_argument("--seed", type=int, default=2, help="of the two flights of a pair")
    parser.add_argument(
        "--own", nargs="*", choices=OWN, default=OWN, help="real flights over their own maps"
    )
    parser.add_argument("--simulated", type=int, default=3, help="simulated flights at each height")
    parser.add_argument(
        "--aside", type=int, default=4, help="other ground that each flight is looked for on"
    )
    parser.add_argument("--note", default="", help="kept with the run")
    options = parser.parse_args()
    options.keep.mkdir(parents=True, exist_ok=True)
    rows = []
    for row in all_rows(options):
        rows.append(row)
        print(json.dumps(row), flush=True)
    run = {
        "commit": commit(),
        "machine": machine(),
        "seed": options.seed,
        "settings": vars(FlightOnMapSettings()),
        "scored": note_scoring(f"flight_on_map, dates by seed {options.seed}"),
        "summary": summary(rows),
        "rows": rows,
    } | ({"note": options.note} if options.note else {})
    RESULTS.write_text(json.dumps({"benchmark": "flight_on_map"} | run, indent=1) + "\n")
    print(json.dumps(run["summary"], indent=1))


def all_rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Every try of every flight."""
    seeds = iter(drawn_seeds("flight_on_map", 100))
    for pair in options.pairs:
        yield from over_dates(pair, options, next(seeds))
    for name in options.own:
        yield from over_own(name, options, next(seeds))
    for height_m in HEIGHTS_M:
        yield from over_simulated(
            height_m, [next(seeds) for _ in range(options.simulated + 1)], options.keep
        )


def over_dates(pair_name: str, options: argparse.Namespace, drawn: int) -> Iterator[dict[str, Any]]:
    """The later date's flight on the map of the earlier."""
    earlier, later = pair_name.split("/")
    first, size_px = real_dates.fly(options.data, earlier, 2 * options.seed)
    second, _ = real_dates.fly(options.data, later, 2 * options.seed + 1)
    mapped = options.keep / f"photos_{earlier}_{2 * options.seed}_known"
    flown = options.keep / f"photos_{later}_{2 * options.seed + 1}_none"
    shown = real_dates.write_photos(first, mapped, size_px, "known", real_dates.begins_ns(earlier))
    seen = real_dates.write_photos(second, flown, size_px, "none", real_dates.begins_ns(later))
    site = options.keep / f"map_{earlier}_{2 * options.seed}_none"
    given = options.keep / "camera.xml"
    make_map(site, mapped, given)
    truth = json.loads((real_dates.HERE / "real_dates.json").read_text())["pairs"]
    pair = real_dates.Pair.of(pair_name, truth)
    with laid_on_itself(site, flown, len(seen), given) as (laid, archive):
        frame = archive.site().frame
        off = real_dates.map_error(
            first, shown, map_frames(site, archive.site())[mapped.name], frame
        )
        expected_m = {}
        for index in laid.photos:
            outline_m = real_dates.footprint(
                second.camera, second.true_poses[seen[laid.names[index]]]
            )
            on_earlier_px = pair.a_from_b(real_dates.pixels(outline_m, size_px), size_px)
            there_m = real_dates.moved_frame(
                real_dates.metres(on_earlier_px, size_px), second.site, frame
            )
            expected_m[index] = apply_homography(off, there_m)
        yield from tries(
            {"ground": "dates", "flight": pair_name}, laid, drawn, options.aside, expected_m
        )


def over_own(name: str, options: argparse.Namespace, drawn: int) -> Iterator[dict[str, Any]]:
    """A real flight on its own map."""
    photos, site = options.data / name, options.keep / f"map_{name}"
    make_map(site, photos, None)
    with laid_on_itself(site, photos, MOST_PHOTOS, None) as (laid, archive):
        rows = {row.name: row for row in map_frames(site, archive.site())[photos.name]}
        yield from tries(
            {"ground": "own", "flight": name},
            laid,
            drawn,
            options.aside,
            {index: rows[laid.names[index]].outline_m for index in laid.photos},
        )


def over_simulated(height_m: float, seeds: Iterable[int], keep: Path) -> Iterator[dict[str, Any]]:
    """Simulated flights on the map of the first of them, which shows other ground."""
    folders = [simulated(height_m, seed, keep) for seed in seeds]
    site = folders[0] / "site"
    make_map(site, folders[0] / "flight1" / "photos", None)
    for folder in folders[1:]:
        with laid_on_itself(site, folder / "flight1" / "photos", MOST_PHOTOS, None) as (laid, _):
            row = {"ground": "simulated", "flight": f"{height_m:.0f} m, {folder.name}"}
            yield row | tried(laid, np.zeros(2), {}) | {"is_own": False}


def simulated(height_m: float, seed: int, keep: Path) -> Path:
    """Photos of two strips, in a folder."""
    folder = keep / f"simulated_{height_m:.0f}_{seed}"
    settings = SimulationSettings(
        seed=seed,
        flights=1,
        scene=SceneSettings(people=0, cars=6, small_objects=0, has_scenery=False),
        path=PathSettings(
            height_m=height_m,
            speed_m_s=0.2 * height_m,
            length_m=110,
            strips=2,
            strip_spacing_m=0.5 * height_m,
        ),
        imaging=ImagingSettings(width_px=480, height_px=360, fps=1),
        sensor=SensorSettings(noise_m=(1.0, 1.0, 1.0)),
        output=OutputSettings(photos=True),
    )
    if not folder.is_dir():
        deque(simulate_site(folder, settings), 0)
    return folder


def make_map(site: Path, photos: Path, camera: Path | None) -> None:
    """Map the photos, if that was not done before."""
    if not (site / "mosaic.tif").is_file():
        deque(map_flights([photos], site, MapSettings(model="none"), camera=camera), 0)


@contextmanager
def laid_on_itself(
    site: Path, photos: Path, most: int, camera: Path | None
) -> Iterator[tuple[Laid, Archive]]:
    """The first photos of a flight laid on each other, to be looked for on the map of a site."""
    settings = CompareSettings(model="none")
    opened = opened_sources([photos], None, camera, known_flights(site))
    with Archive.open(site, write=False) as archive, opened as (source,):
        setup = prepare(
            source,
            settings.mapping,
            archive.site(),
            telemetry_named=False,
            finds_itself=True,
            ground_m=known_ground_m(archive),
        )
        newest = [each for each in archive.versions() if each.complete][-1].id
        views = view_maker(setup, archive, settings, newest)
        accepts_all = FlightOnMapSettings(least_ratio=0.0, least_agree=0, least_spread=0.0)
        on_map = FlightOnMap(views.search, accepts_all)
        names = {}
        with WholeFlight(
            setup, archive, views, on_map, min(most, source.frame_count or most)
        ) as whole:
            for frame in source.frames(lambda index, _: index < most):
                if isinstance(frame, Frame):
                    whole.add(PosedFrame(frame, setup.prior(frame, first=False)))
                    names[frame.index] = frame.name
            found, poses = whole.sought()
        camera = views.undistorted_camera
        as_taken = source.camera.camera.resized(camera.width_px, camera.height_px)
        corners_px = as_taken.undistort_points(as_taken.corners_px)
        yield Laid(on_map, found, poses, names, camera, corners_px), archive


def tries(
    row: dict[str, Any], laid: Laid, drawn: int, aside: int, expected_m: Mapping[int, np.ndarray]
) -> Iterator[dict[str, Any]]:
    """A flight looked for in its own place and on other ground."""
    yield row | tried(laid, np.zeros(2), expected_m) | {"is_own": True}
    rng = np.random.default_rng(drawn)
    for _ in range(aside):
        far_m, turn = rng.uniform(*ASIDE_M), rng.uniform(0, 2 * np.pi)
        yield (
            row
            | tried(laid, far_m * np.array([np.cos(turn), np.sin(turn)]), {})
            | {"is_own": False}
        )


def tried(laid: Laid, aside_m: np.ndarray, expected_m: Mapping[int, np.ndarray]) -> dict[str, Any]:
    """How the flight fits the map, taken for so far aside (2,); how far off its photos' corners then are, medians."""
    began, settings = time.process_time(), FlightOnMapSettings()
    moved = {
        index: replace(pose, translation_m=pose.translation_m + np.array([*aside_m, 0.0]))
        for index, pose in laid.poses.items()
    }
    fit = laid.on_map.find(laid.photos, moved)
    row: dict[str, Any] = {
        "aside_m": [round(float(each), 1) for each in aside_m],
        "photos": len(laid.photos),
        "cpu_s": round(time.process_time() - began, 1),
    }
    if fit is None:
        return row | {"votes": None, "is_found": False}
    is_found = (
        fit.ratio >= settings.least_ratio
        and fit.agree >= settings.least_agree
        and fit.spread >= settings.least_spread
    )
    row |= {
        "votes": round(fit.ratio, 1),
        "agree": fit.agree,
        "spread": round(fit.spread, 2),
        "residual_m": round(fit.residual_m, 3),
        "left_to_search": len(fit.elsewhere),
        "is_found": is_found,
    }
    errors_m = []
    for index, corners_m in expected_m.items():
        on_map = fit.map_from_flight @ site_from_image_homography(laid.camera, moved[index])
        errors_m.append(
            float(
                np.median(
                    np.linalg.norm(apply_homography(on_map, laid.corners_px) - corners_m, axis=1)
                )
            )
        )
    if errors_m and is_found:
        row |= {
            "right": sum(each < real_dates.RIGHT_M for each in errors_m),
            "error_median_m": round(float(np.median(errors_m)), 2),
            "error_most_m": round(max(errors_m), 2),
        }
    return row


def summary(rows: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """By kind of ground: own places found, photos right in them, other places taken for own, and the votes."""
    result: dict[str, Any] = {}
    for ground in ("dates", "own", "simulated"):
        of = [row for row in rows if row["ground"] == ground]
        own, other = [row for row in of if row["is_own"]], [row for row in of if not row["is_own"]]
        if of:
            result[ground] = {
                "own_found": f"{sum(row['is_found'] for row in own)} of {len(own)}",
                "photos_right": f"{sum(row.get('right', 0) for row in own)} of {sum(row['photos'] for row in own)}",
                "least_votes_own": min((row["votes"] or 0.0 for row in own), default=None),
                "other_found": f"{sum(row['is_found'] for row in other)} of {len(other)}",
                "most_votes_other": max((row["votes"] or 0.0 for row in other), default=None),
            }
    return result


if __name__ == "__main__":
    main()
