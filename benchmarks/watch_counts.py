"""Simulated patrols with returns: is each object counted once, and how far off is its place?

python benchmarks/watch_counts.py [--seeds 304 305 306 307] [--height 60] [--output FILE]

Each patrol flies three strips that overlap by half, so that most objects come into view two or three times, some of
them walking or driving. The detector is fed with the truth: it misses 20 % of the objects in each frame, invents one
box in five frames, and its edges err by 5 %. GPS errs by 1.5 m (rms per axis), most of it slowly. An object counts as
seen when five frames showed it, be it a corner that the picture's edge cuts off, as long as no more than half of that
was hidden; whether one that fewer frames showed is counted is neither right nor wrong. A track is right when it lies
within 8 m of an object of its class; `inside_95` is the share of right tracks whose place errs by less than 2.45 of its
own sigma.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from provenance import commit, machine, note_scoring, seeds_or_drawn
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.lab.simulation.settings import (
    DEFAULT_ORIGIN,
    ImagingSettings,
    LaterSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SensorSettings,
    SimulationSettings,
)
from sorvolo.lab.simulation.site import simulate_site
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.settings import WatchOutputs

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "missions"))
from truth_detector import TruthDetector

RESULTS = Path(__file__).parent / "results" / "watch_counts.json"
_FLIGHT = "flight2"  # in which people walk and cars drive
_REACH_M = 8.0


def main() -> None:
    """Fly the patrols and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[], help="else 12 by the commit")
    parser.add_argument("--height", type=float, default=60.0)
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    options.seeds = seeds_or_drawn("watch_counts", options.seeds, 12)
    scoring = note_scoring(f"watch_counts, seeds {' '.join(map(str, options.seeds))}")
    patrols = [patrol(seed, options.height) for seed in options.seeds]
    seen, counted = (sum(each[key] for each in patrols) for key in ("seen", "counted"))
    errors_m = np.array([error for each in patrols for error in each["errors_m"]])
    standing_m = np.array([error for each in patrols for error in each["standing_errors_m"]])
    inside = [each for one in patrols for each in one["inside"]]
    result: dict[str, Any] = {
        "benchmark": "watch_counts",
        "machine": machine(),
        "commit": commit(),
        "height_m": options.height,
        **scoring,
        "seen": seen,
        "counted": counted,
        "count_error": abs(counted - seen) / seen,
        "mean_count_error_of_a_patrol": float(
            np.mean([abs(one["counted"] - one["seen"]) / one["seen"] for one in patrols])
        ),
        "missed": sum(each["missed"] for each in patrols),
        "extra": sum(each["extra"] for each in patrols),
        "rms_m": _rms(errors_m),
        "standing_rms_m": _rms(standing_m),
        "inside_95": float(np.mean(inside)),
        "patrols": [
            {key: value for key, value in each.items() if key in _OF_A_PATROL} for each in patrols
        ],
    }
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


_OF_A_PATROL = ("seed", "seen", "counted", "missed", "extra", "rms_m")


def fly(
    folder: Path,
    seed: int,
    path: PathSettings,
    later: LaterSettings = LaterSettings(removed=0, moved=0),
    flights: int = 2,
    **scene: Any,
) -> Path:
    """Simulate flights with GPS as drones have it over ten people and six cars; the folder."""
    settings = SimulationSettings(
        seed=seed,
        flights=flights,
        scene=SceneSettings(people=10, cars=6, **scene),
        path=replace(path, strips=3, strip_spacing_m=0.35 * path.height_m),
        imaging=ImagingSettings(width_px=960, height_px=540, fps=5),
        sensor=SensorSettings(noise_m=(0.5, 0.5, 0.5), wander_m=1.4),
        later=later,
        output=OutputSettings(truth_step=1),
    )
    for _ in simulate_site(folder / "simulated", settings):
        pass
    return folder / "simulated"


def patrol(seed: int, height_m: float) -> dict[str, Any]:
    """One simulated patrol: what was seen, what was counted, and how far off each right track lies."""
    path = PathSettings(height_m=height_m, speed_m_s=8, length_m=150)
    with tempfile.TemporaryDirectory() as scratch:
        simulated = fly(Path(scratch), seed, path, small_objects=4, has_scenery=False)
        detector = TruthDetector(simulated, _FLIGHT, misses=0.2, false_alarms=0.2, seed=seed)
        folder = Path(scratch) / "watch"
        for _ in watch(
            simulated / _FLIGHT / f"{_FLIGHT}.mp4",
            outputs=WatchOutputs(folder=folder),
            camera=simulated / "camera.xml",
            detector=detector,
        ):
            pass
        tracks = [
            each["properties"]
            for each in json.loads((folder / "tracks.geojson").read_text())["features"]
        ]
        return {"seed": seed, **_compared(tracks, simulated)}


def _compared(tracks: list[dict[str, Any]], simulated: Path) -> dict[str, Any]:
    boxes = json.loads((simulated / "truth" / _FLIGHT / "boxes.json").read_text())
    frames: dict[int, list[int]] = {}
    for each in boxes["annotations"]:
        if each["visibility"] > 0.5:
            frames.setdefault(each["object_id"], []).append(each["image_id"])
    fps, count = 5.0, len(boxes["images"])
    objects = [
        each["properties"]
        for each in json.loads((simulated / "truth" / "objects.geojson").read_text())["features"]
        if 2 in each["properties"]["flights"] and each["properties"]["id"] in frames
    ]
    often = [len(frames[each["id"]]) >= 5 for each in objects]
    site = LocalFrame(DEFAULT_ORIGIN)
    cost = np.full((len(tracks), len(objects)), 1e6)
    for row, track in enumerate(tracks):
        place = site.ground_from_lonlat([(track["longitude"], track["latitude"])])[0][:2]
        for column, thing in enumerate(objects):
            # a track's place is where the object was when it was last seen
            last_s = frames[thing["id"]][-1] / fps - (count - 1) / fps / 2
            there = np.array([thing["east_m"], thing["north_m"]]) + last_s * np.array(
                thing["velocity_m_s"]
            )
            if thing["class"] == track["class"]:
                cost[row, column] = np.linalg.norm(place - there)
    rows, columns = linear_sum_assignment(cost)
    right = [(row, column) for row, column in zip(rows, columns) if cost[row, column] < _REACH_M]
    errors = np.array([cost[pair] for pair in right])
    found, extra = sum(often[column] for _, column in right), len(tracks) - len(right)
    return {
        "seen": sum(often),
        "counted": found + extra,
        "missed": sum(often) - found,
        "extra": extra,
        "errors_m": errors.tolist(),
        "rms_m": _rms(errors),
        "standing_errors_m": [
            float(cost[pair]) for pair in right if not objects[pair[1]]["moving"]
        ],
        "inside": [
            bool(cost[row, column] < 2.45 * tracks[row]["sigma_m"]) for row, column in right
        ],
    }


def _rms(values: Any) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


if __name__ == "__main__":
    main()
