"""What a map reports of people and cars, and what it makes up: python benchmarks/map_objects.py [--flights 18]

The simulated searches of `search_pod.py`, by day and thermal, searched as `sorvolo map` does it, frames on their true
places. What is reported is right where at least half of its sightings are of one hidden thing of its class; of things
that a frame shows, each is found or not.

Writes results/map_objects.json.
"""

import argparse
import json
import time
from collections import Counter
from pathlib import Path

import numpy as np

from provenance import commit, machine, seeds_or_drawn
from search_pod import CLASSES, flown, placed, seen_by_map
from sorvolo.detection.detector import Detector
from sorvolo.lab.simulation.flight import SimulatedFlight
from sorvolo.tracking.map_objects import shown_plant
from sorvolo.tracking.standing import fuse

RESULTS = Path(__file__).parent / "results" / "map_objects.json"


def main() -> None:
    """Fly, search, count, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", type=int, default=18)
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    parser.add_argument("--results", type=Path, default=RESULTS)
    wishes = parser.parse_args()
    detector = Detector.load("default", provider="cpu", threads=1)
    seeds = seeds_or_drawn("map_objects", wishes.seeds, wishes.flights)
    counts: Counter[str] = Counter()
    for number, seed in enumerate(seeds):
        flight, images = flown(seed, number)
        counts += counted(flight, images, detector, "thermal" if number % 3 == 2 else "by day")
        print(number, seed, dict(counts), flush=True)
    wishes.results.write_text(
        json.dumps(
            {
                "benchmark": "map_objects",
                "machine": machine(),
                "commit": commit(),
                "date": time.strftime("%Y-%m-%d"),
                "seeds": seeds,
                "model": detector.info.name,
                "counts": dict(sorted(counts.items())),
            },
            indent=1,
        )
        + "\n"
    )


def counted(
    flight: SimulatedFlight, images: list[np.ndarray], detector: Detector, light: str
) -> Counter[str]:
    """How many hidden things a frame shows, how many of them are reported, and how many reports are of none."""
    targets = [thing for thing in flight.day.things if thing.label.is_target]
    frames = [placed(flight, index) for index in range(len(images))]
    laid, boxes, least = seen_by_map(flight, frames, images, detector, targets)
    counts: Counter[str] = Counter()
    right: set[int] = set()
    for each in fuse(laid, frames, least).objects:
        row = shown_plant(each, laid, boxes)
        if row is not None and str(targets[row].label) == each.label:
            right.add(row)
        else:
            counts[f"{each.label} {light}: false"] += 1
    for row, thing in enumerate(targets):
        if str(thing.label) in CLASSES and any(
            np.isfinite(each[row]).all() for each in boxes.values()
        ):
            kind = "plain figure" if thing.kind == "person" else str(thing.label)
            counts[f"{kind} {light}: shown"] += 1
            counts[f"{kind} {light}: found"] += row in right
    return counts


if __name__ == "__main__":
    main()
