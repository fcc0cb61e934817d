"""Which ground `sorvolo search` holds for hidden by trees: python benchmarks/search_crowns.py [--flights 8]

Simulated flights over fresh ground with trees, bushes, houses and cars. Of some frames of each, the share of the pixels
in which crowns are found: of trees (a quarter of a metre within their outlines), of sunlit open ground, of shadows on
the ground, of houses and of cars; with the sun's direction, and without. Simulated crowns are as smooth as the grass
around, smoother than real ones: without the sun few of them can be found.

Writes results/search_crowns.json.
"""

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from provenance import commit, machine, seeds_or_drawn
from sorvolo.geometry.sun import direction_from_angles
from sorvolo.lab.simulation.flight import SimulatedFlight, simulate_flight
from sorvolo.lab.simulation.rendering import render, render_labels
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)
from sorvolo.lab.simulation.world import Day, build_day
from sorvolo.search.conditions import look_at
from sorvolo.search.drawing.objects import Label

RESULTS = Path(__file__).parent / "results" / "search_crowns.json"
SUN = direction_from_angles(215.0, 48.0)  # of every first day in the simulation
GROUNDS = ("countryside", "countryside", "urban", "dirt")
HEIGHTS_M = (25.0, 35.0, 45.0)
FRAMES = 3  # of a flight
SHADED = 0.8  # of the ground without things: darker, a shadow lies on it


def main() -> None:
    """Fly, look, count, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", type=int, default=8)
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    parser.add_argument("--results", type=Path, default=RESULTS)
    wishes = parser.parse_args()
    seeds = seeds_or_drawn("search_crowns", wishes.seeds, wishes.flights)
    counts: dict[str, dict[str, np.ndarray]] = {"with the sun": {}, "without the sun": {}}
    for seed in seeds:
        flight = flown(seed)
        bare = bare_day(flight)
        for index in np.linspace(0, len(flight) - 1, FRAMES).astype(int):
            for name, found in counts.items():
                sun = SUN if name == "with the sun" else None
                crowns = look_at(
                    flight.frame(index).image, flight.camera, flight.true_poses[index], 0.5, sun
                ).crowns
                for what, mask in truth(flight, bare, int(index), crowns.shape):
                    found[what] = found.get(what, 0) + np.array([(crowns & mask).sum(), mask.sum()])
        print(seed, shares(counts), flush=True)
    document = {
        "benchmark": "search_crowns",
        "machine": machine(),
        "commit": commit(),
        "date": time.strftime("%Y-%m-%d"),
        "seeds": seeds,
        "frames": FRAMES * len(seeds),
        "share_held_for_crowns": shares(counts),
    }
    wishes.results.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def flown(seed: int) -> SimulatedFlight:
    """A flight of photos by a clear day."""
    rng = np.random.default_rng([seed, 1])
    height_m = float(rng.choice(HEIGHTS_M) * rng.uniform(0.85, 1.15))
    return simulate_flight(
        SimulationSettings(
            seed=seed,
            flights=1,
            scene=SceneSettings(str(rng.choice(GROUNDS)), people=2, cars=4, small_objects=0),
            path=PathSettings(
                height_m=height_m,
                speed_m_s=8,
                length_m=2.2 * height_m,
                strips=2,
                strip_spacing_m=0.5 * height_m,
            ),
            imaging=ImagingSettings(960, 720, fps=6, distortion=(0.0,) * 5),
            output=OutputSettings(photos=True, photo_overlap=0.55),
        )
    )


def bare_day(flight: SimulatedFlight) -> Day:
    """The same ground with nothing on it."""
    return build_day(
        replace(flight.world, days=((),)), flight.settings, 1, flight.settings.m_per_px
    )


def truth(
    flight: SimulatedFlight, bare: Day, index: int, shape: tuple[int, ...]
) -> Iterator[tuple[str, np.ndarray]]:
    """What each pixel of a small picture of (H, W) shows."""
    view, pose, moment_s = (
        flight.view(index),
        flight.true_poses[index],
        float(flight.from_middle_s[index]),
    )
    labels, _ = render_labels(flight.day.things, flight.day.bodies, view, pose, moment_s)
    shown, without = (render(day, view, pose, moment_s).mean(axis=2) for day in (flight.day, bare))
    shaded = (shown < SHADED * without) & (labels == 0)
    masks = {"shadows": shaded, "open ground": (labels == 0) & ~shaded}
    for name, label in (("trees", Label.TREE), ("houses", Label.HOUSE), ("cars", Label.CAR)):
        masks[name] = np.isin(
            labels, [thing.id for thing in flight.day.things if thing.label is label]
        )
    for name, mask in masks.items():
        small = cv2.resize(mask.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
        yield (
            name,
            cv2.erode(small.astype(np.uint8), np.ones((3, 3))) > 0 if name == "trees" else small,
        )


def shares(counts: dict[str, dict[str, np.ndarray]]) -> dict[str, dict[str, float]]:
    """The shares of pixels that count as crowns."""
    return {
        name: {
            what: round(float(hits / max(total, 1)), 3)
            for what, (hits, total) in sorted(found.items())
        }
        for name, found in counts.items()
    }


if __name__ == "__main__":
    main()
