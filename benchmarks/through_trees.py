"""How well `search --through-trees` sees: python benchmarks/through_trees.py [--forests 2] [--seeds ...]

Simulated thermal forests of two densities, people on their floors, views with known poses. Stated is the
probability of planted bodies (canopy.planting), found are the hidden people. Writes results/through_trees.json.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from provenance import commit, machine, seeds_or_drawn
from sorvolo.canopy.finds import look_under_trees
from sorvolo.canopy.integral import LEAST_VIEWS, levelled
from sorvolo.canopy.planting import plant_on_floor
from sorvolo.geometry.summary import wilson
from sorvolo.heights.lattice import Lattice

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "canopy"))
from thermal_forest import fly, hidden_share, make_forest, photograph

RESULTS = Path(__file__).parent / "results" / "through_trees.json"
LEAVES_PER_M2 = 3.0, 6.0  # hide about half and two thirds of the floor
SIDE_M, CELL_M, PEOPLE, REACH_M, PLANTS = 36.0, 0.1, 5, 1.0, 20


def look(seed: int, leaves_per_m2: float) -> dict[str, Any]:
    """One forest's figures."""
    draw = np.random.default_rng(seed)
    cells = np.stack(np.meshgrid([-10.0, 0.0, 10.0], [-10.0, 0.0, 10.0]), 2)
    people_m = draw.permutation(cells.reshape(-1, 2))[:PEOPLE] + draw.uniform(-2, 2, (PEOPLE, 2))
    floor_m = float(draw.uniform(-4, 0))
    forest = make_forest(seed, 72.0, leaves_per_m2, people_m, floor_m)
    views = fly(forest, np.arange(-14, 15, 4.0), np.arange(-14, 15, 2.0), seed=seed)
    pictures = [levelled(photograph(forest, view)) for view in views]
    count = round(SIDE_M / CELL_M)
    half_m = SIDE_M / 2
    lattice = Lattice(
        np.array([[CELL_M, 0, -half_m], [0, -CELL_M, half_m], [0, 0, 1]]), count, count, CELL_M
    )
    started_s = time.process_time()
    under, floor, finds = look_under_trees(views, pictures.__getitem__, lattice, -12.0, 12.0)
    looked_s = time.process_time() - started_s
    planted = plant_on_floor(under, views, pictures.__getitem__, finds.people, PLANTS, seed)
    found_m = np.array([each.place_m[:2] for each in finds.people]).reshape(-1, 2)
    away_m = np.linalg.norm(found_m[:, None] - people_m[None], axis=2)
    off_m = floor.up_m - floor_m
    return {
        "seed": seed,
        "hidden": hidden_share(forest, views[len(views) // 2]),
        "views": len(views),
        "people": PEOPLE,
        "found": int((away_m.min(axis=0, initial=np.inf) < REACH_M).sum()),
        "false": int((away_m.min(axis=1, initial=np.inf) >= REACH_M).sum()),
        "seen_ha": float((under.views >= LEAST_VIEWS).mean()) * SIDE_M**2 / 1e4,
        "floor_rms_m": float(np.sqrt(np.mean(off_m**2))),
        "planted": len(planted.found),
        "planted_found": int(planted.found.sum()),
        "free_share": float(planted.free_share.mean()),
        "look_cpu_s": looked_s,
        "plant_cpu_s": time.process_time() - started_s - looked_s,
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of forests that are equally dense, together."""
    total = {name: sum(row[name] for row in rows) for name in rows[0]}
    return {
        "hidden": total["hidden"] / len(rows),
        "found": total["found"] / total["people"],
        "found_interval": wilson(total["found"], total["people"]),
        "stated": total["planted_found"] / total["planted"],
        "false_per_ha": total["false"] / total["seen_ha"],
        "floor_rms_m": float(np.sqrt(np.mean([row["floor_rms_m"] ** 2 for row in rows]))),
        "forests": rows,
    }


def main() -> None:
    """Run all forests and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--forests", type=int, default=2)
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    arguments = parser.parse_args()
    seeds = seeds_or_drawn("through_trees", arguments.seeds, arguments.forests)
    results: dict[str, Any] = {"commit": commit(), "machine": machine(), "leaves_per_m2": {}}
    for leaves_per_m2 in LEAVES_PER_M2:
        rows = []
        for seed in seeds:
            rows.append(look(seed, leaves_per_m2))
            print(leaves_per_m2, rows[-1], flush=True)
        results["leaves_per_m2"][leaves_per_m2] = summary(rows)
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
