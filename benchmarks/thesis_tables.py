"""The thesis's Tables 4.1 and 4.3 to 4.5, and its times (4.2.2), on simulated videos of its three environments.

python benchmarks/thesis_tables.py [SEED...] [--length 24] [--output FILE]

The videos of the thesis are not public. Each seed simulates one video of an urban, a dirt and a countryside preset of
the UMCD dataset, cut to `--length` metres, and the same path flown again with objects that came. Table 4.1: minutes in
which each method maps the first video. Tables 4.3 and 4.4: frames of the second video with or without a change, by the
masks of `sorvolo compare --masks`; a frame is positive where any pixel is. Table 4.5: the same by pixel. Section 4.2.2:
seconds for one comparison of two pictures, with one thread and with all. Without seeds, one is drawn from the commit's
hash. Everything is written to results/thesis_tables.json. The numbers are not comparable with the thesis's: other
ground, other changes, and another computer.
"""

import argparse
import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from provenance import commit, machine, note_scoring, seeds_or_drawn
from sorvolo.change.metrics import Counts
from sorvolo.change.pair.thesis import compare_thesis
from sorvolo.change.pair.thesis_options import thesis_options
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.evaluate.changes import evaluate_changes
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.simulate.site import simulate_site
from sorvolo.simulation.presets import preset

RESULTS = Path(__file__).parent / "results" / "thesis_tables.json"
PRESETS = ("umcd-telemetry-urban-path1", "umcd-telemetry-dirt-path1", "umcd-telemetry-countryside-path1")
MAP_METHODS = ("thesis", "planar")
COMPARISONS = {
    "thesis": ("thesis", []),
    "thesis, eq. 3.21 as printed": ("thesis", ["eq3.21=printed"]),
    "thesis, thresholds from the light": ("thesis", ["T_gray=light", "T_H=light"]),
    "robust": ("robust", []),
}
REPEATS = 5
RATES = ("precision", "recall", "accuracy", "f1")


def main() -> None:
    """Simulate, map, compare, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", type=int, nargs="*", help="else one drawn from the commit's hash")
    parser.add_argument("--length", type=float, default=24.0, help="of the path, m")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    seeds = seeds_or_drawn("thesis_tables", options.seeds, 1)
    scoring = note_scoring(f"thesis_tables, seeds {' '.join(map(str, seeds))}")
    mapped, compared = [], []
    for seed in seeds:
        for name in PRESETS:
            with tempfile.TemporaryDirectory() as scratch:
                simulation = simulate(Path(scratch) / "simulation", name, seed, options.length)
                mapped += table_4_1(simulation, Path(scratch), name, seed)
                compared += comparisons(simulation, Path(scratch), name, seed)
    result = {
        "benchmark": "thesis_tables", "machine": machine(), "load_1_min": os.getloadavg()[0], "commit": commit(),
        **scoring, "presets": list(PRESETS), "length_m": options.length, "seeds": seeds,
        "table_4_1": mapped, "tables_4_3_and_4_4": pooled(compared, "frames"), "table_4_5": pooled(compared, "pixels"),
        "section_4_2_2": seconds_of_a_comparison(), "runs": compared,
    }
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text(json.dumps(result, indent=1) + "\n")
    show(result)


def simulate(folder: Path, name: str, seed: int, length_m: float) -> Path:
    """Two flights of a preset, cut short, with the truth of each frame that is compared."""
    settings = replace(preset(name), seed=seed)
    step = round(settings.imaging.fps / CompareSettings().views_per_second)
    settings = replace(
        settings, path=replace(settings.path, length_m=length_m), output=replace(settings.output, truth_step=step)
    )
    for _ in simulate_site(folder, settings):
        pass
    return folder


def table_4_1(simulation: Path, scratch: Path, name: str, seed: int) -> list[dict[str, Any]]:
    """How long each method maps the first video; the maps stay in `scratch`, by method."""
    rows = []
    for method in MAP_METHODS:
        started, started_cpu = time.monotonic(), time.process_time()
        settings = MapSettings(method=method, model="none")
        updates = list(map_flights(
            [video(simulation, 1)], scratch / method, settings, camera=simulation / "camera.xml"
        ))
        rows.append({
            "sequence": name, "seed": seed, "method": method, "frames": updates[-1].frames_read,
            "keyframes": len(updates), "minutes": round((time.monotonic() - started) / 60, 3),
            "cpu_minutes": round((time.process_time() - started_cpu) / 60, 3),
        })
    return rows


def comparisons(simulation: Path, scratch: Path, name: str, seed: int) -> list[dict[str, Any]]:
    """Counts by frame and by pixel of each way to compare the second video with the planar map of the first."""
    rows = []
    for title, (method, written) in COMPARISONS.items():
        site = scratch / "compared"
        shutil.rmtree(site, ignore_errors=True)
        shutil.copytree(scratch / "planar", site)
        settings = CompareSettings(
            method=method, model="none", writes_masks=True, updates_map=False, thesis=thesis_options(written)
        )
        for _ in compare_flights([video(simulation, 2)], site, settings, camera=simulation / "camera.xml"):
            pass
        (measured,) = evaluate_changes(site, simulation)
        assert measured.masks is not None
        rows.append({
            "sequence": name, "seed": seed, "method": title,
            **{kind: counts(getattr(measured.masks, kind)) for kind in ("frames", "pixels")},
        })
    return rows


def video(simulation: Path, number: int) -> Path:
    """The video of a simulated flight."""
    return simulation / f"flight{number}" / f"flight{number}.mp4"


def counts(of: Counts) -> dict[str, int]:
    """True and false positives and negatives."""
    return {"tp": of.tp, "fp": of.fp, "fn": of.fn, "tn": of.tn}


def pooled(rows: Sequence[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    """Counts of all videos together and the rates of section 4.2.1, by method; None where nothing was to divide by."""
    result = []
    for title in COMPARISONS:
        parts = [row[kind] for row in rows if row["method"] == title]
        whole = Counts(**{name: sum(part[name] for part in parts) for name in ("tp", "fp", "fn", "tn")})
        rates = {name: getattr(whole, name) for name in RATES}
        result.append({
            "method": title, **counts(whole),
            **{name: None if math.isnan(rate) else round(rate, 4) for name, rate in rates.items()},
        })
    return result


def seconds_of_a_comparison() -> dict[str, float | int]:
    """Medians of one comparison of two pictures of 1280 x 720 px, with one thread and with one for each core."""
    rng = np.random.default_rng(0)
    before = np.repeat(np.repeat(rng.integers(40, 200, (90, 160, 3)), 8, axis=0), 8, axis=1).astype(np.uint8)
    after = before.copy()
    after[200:280, 300:420] = 230
    cores = os.cpu_count() or 1
    seconds = {}
    for threads in (1, cores):
        times = []
        for _ in range(REPEATS):
            started = time.perf_counter()
            compare_thesis(before, after, threads=threads)
            times.append(time.perf_counter() - started)
        seconds[threads] = round(median(times), 4)
    return {"single_thread_s": seconds[1], "multithread_s": seconds[cores], "threads": cores, "repeats": REPEATS}


def show(result: dict[str, Any]) -> None:
    """The tables as the thesis prints them."""
    console = Console()
    table = Table("sequence", "method", "frames", "KFs", "minutes", title="Table 4.1")
    for row in result["table_4_1"]:
        table.add_row(row["sequence"], row["method"], *(str(row[key]) for key in ("frames", "keyframes", "minutes")))
    console.print(table)
    for key, title in (("tables_4_3_and_4_4", "Tables 4.3 and 4.4: frames"), ("table_4_5", "Table 4.5: pixels")):
        table = Table("method", "TP", "FP", "FN", "TN", "precision", "recall", "accuracy", "F1", title=title)
        for row in result[key]:
            rates = ["-" if row[name] is None else f"{row[name]:.2%}" for name in RATES]
            table.add_row(row["method"], *(str(row[name]) for name in ("tp", "fp", "fn", "tn")), *rates)
        console.print(table)
    console.print(result["section_4_2_2"])


if __name__ == "__main__":
    main()
