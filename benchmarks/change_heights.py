"""Does `compare` gain by heights? Simulated streets with houses, flown again across the first strips and higher.

python benchmarks/change_heights.py [--seeds 301]

Three strips of photos over houses and trees, mapped, its heights made; a second flight at 90 degrees to the first and
1.2 times as high, with things that came, left and moved. Compared twice: without the heights, and with earlier pictures
rendered over them. Events as benchmarks/change_events.py counts them. Written to results/change_heights.json.
"""

import argparse
import json
import shutil
import tempfile
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

from heights import _SURVEY
from provenance import commit, machine, note_scoring, seeds_or_drawn
from sorvolo.lab.evaluation.changes import as_json, evaluate_changes
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.settings import LaterSettings, RevisitSettings
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.heights.run import HeightSettings, make_heights
from sorvolo.missions.map.flights import map_flights

RESULTS = Path(__file__).parent / "results" / "change_heights.json"


def main() -> None:
    """Measure and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds", type=int, nargs="*", default=[], help="without: one that nobody has scored"
    )
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    seeds = seeds_or_drawn("change_heights", options.seeds, 1)
    result: dict[str, Any] = {
        "benchmark": "change_heights",
        "machine": machine(),
        "commit": commit(),
        "seeds": seeds,
    }
    if not options.seeds:
        result |= note_scoring(f"change_heights, seeds {seeds}")
    result["runs"] = {str(seed): measured(seed) for seed in seeds}
    options.output.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result["runs"], indent=1))


def measured(seed: int) -> dict[str, Any]:
    """One site: events without and with heights."""
    later = LaterSettings(revisit=RevisitSettings(height_factor=1.2, heading_change_deg=90.0))
    settings = replace(
        _SURVEY,
        seed=seed,
        flights=2,
        later=later,
        scene=replace(_SURVEY.scene, people=3, cars=3, small_objects=4),
        output=replace(_SURVEY.output, truth_step=3),
    )
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        made, base = folder / "made", folder / "base"
        for _ in simulate_site(made, settings):
            pass
        camera = made / "camera.xml"
        list(
            map_flights(
                [made / "flight1" / "photos"], base, MapSettings(model="none"), camera=camera
            )
        )
        found = {}
        for name in ("without", "with"):
            if name == "with":
                list(make_heights(base, HeightSettings(has_orthophoto=False)))
            site = folder / name
            shutil.copytree(base, site)
            started = time.process_time()
            deque(
                compare_flights(
                    [made / "flight2" / "photos"],
                    site,
                    CompareSettings(model="none"),
                    camera=camera,
                ),
                1,
            )
            (each,) = evaluate_changes(site, made)
            plain = as_json([each])[0]
            found[name] = {
                "events": plain["events"],
                "pixels": plain["pixels"],
                "cpu_s": round(time.process_time() - started, 1),
            }
        return found


if __name__ == "__main__":
    main()
