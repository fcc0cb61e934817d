"""Which changes does `compare` find on simulated second flights, how late, how far off, how many false, at what cost?

python benchmarks/change_events.py [SEED...] [--presets compare compare-photos] [--methods thesis robust]
python benchmarks/change_events.py --speed        (a 1080p video at 30 frames a second instead)

For each seed and preset two flights are simulated, the first is mapped, the second compared by each method on a copy
of that map, each run in a process of its own whose processor time and peak memory are measured. Without seeds, new ones
are drawn from the commit's hash, never the same twice (provenance.py); 301 and 302 were scored about twenty times and
serve development now. Figures are pooled over seeds; the range over seeds is beside them.
Beside other work (load_1_min) frames_per_s, by the clock, means little; cpu_ms_per_frame is processor time.
Everything is written to results/change_events.json (--speed: change_speed_video.json).
"""

import argparse
import json
import os
import resource
import shutil
import sys
import tempfile
import time
from collections import deque
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from statistics import median

from rich.console import Console
from rich.table import Table

from child import peak_mb, run_child
from provenance import commit, machine, note_scoring, seeds_or_drawn
from sorvolo.lab.evaluation.changes import as_json, evaluate_changes
from sorvolo.lab.simulation.presets import preset
from sorvolo.lab.simulation.settings import ImagingSettings
from sorvolo.lab.simulation.site import simulate_site
from sorvolo.lab.thesis.changes import ThesisComparison
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights

_PAIRS = {"thesis": ThesisComparison(), "robust": None}
METHODS = tuple(_PAIRS)
PRESETS = ("compare", "compare-urban", "compare-dirt", "compare-photos", "compare-none")
RESULTS = Path(__file__).parent / "results"
LEAST_PX = 50
"""Of a frame's mask: a sliver of an object at the picture's rim makes no frame changed."""

_KINDS = ("appeared", "disappeared", "replaced", "moving")


def main() -> None:
    """Run the benchmark, or one comparison in the child process."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument(
        "seeds", type=int, nargs="*", help="else new ones, drawn from the commit's hash"
    )
    parser.add_argument("--count", type=int, default=2, help="how many seeds to draw")
    parser.add_argument("--presets", nargs="+", default=PRESETS)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--no-masks", action="store_true", help="leave frames and pixels out")
    parser.add_argument(
        "--speed", action="store_true", help="time 1080p video at 30 frames a second, without masks"
    )
    parser.add_argument("--length", type=float, help="length of a strip, m, for a shorter flight")
    parser.add_argument(
        "--fps",
        type=float,
        help="frames a second of the simulated videos; five of them are compared",
    )
    parser.add_argument("--limit", type=float, default=1800.0, help="longest time of a run, s")
    parser.add_argument(
        "--keep", type=Path, help="folder for simulations and sites, used again when run again"
    )
    parser.add_argument("--output", type=Path)
    parser.add_argument(
        "--run", nargs=4, metavar=("METHOD", "MASKS", "SIMULATION", "SITE"), help=argparse.SUPPRESS
    )
    options = parser.parse_args()
    if options.run:
        run_method(
            options.run[0], options.run[1] == "masks", Path(options.run[2]), Path(options.run[3])
        )
        return
    options.seeds = seeds_or_drawn("change_events", options.seeds, options.count)
    presets = ["compare"] if options.speed else options.presets
    masks = not (options.no_masks or options.speed)
    options.scoring = note_scoring(f"change_events, seeds {' '.join(map(str, options.seeds))}")
    runs = []
    for name in presets:
        for seed in options.seeds:
            with tempfile.TemporaryDirectory() as scratch:
                folder = (
                    options.keep or Path(scratch)
                ) / f"{name}-{seed}{'-1080p' if options.speed else ''}"
                simulation, base = simulate(folder, name, seed, options)
                for method in options.methods:
                    print(f"{name}, seed {seed}: {method}", file=sys.stderr, flush=True)
                    site = folder / method
                    shutil.rmtree(site, ignore_errors=True)
                    shutil.copytree(base, site)
                    measured = run_apart(method, simulation, site, options.limit, masks=masks)
                    if "failure" not in measured:
                        measured |= accuracy(site, simulation)
                    runs.append({"preset": name, "seed": seed, "method": method, **measured})
                    save(runs, presets, options)
    summary = summarised(runs, presets, options.methods)
    show(summary)
    for run in runs:
        if "failure" in run:
            print(f"{run['preset']}, seed {run['seed']}, {run['method']}: {run['failure']}")


def save(runs: list[dict], presets: list[str], options: argparse.Namespace) -> None:
    """Write what is known so far: a long benchmark that is stopped leaves its figures."""
    output = options.output or RESULTS / (
        "change_speed_video.json" if options.speed else "change_events.json"
    )
    output.parent.mkdir(exist_ok=True)
    output.write_text(
        json.dumps(
            {
                "benchmark": "change_events",
                "presets": list(presets),
                "length_m": options.length,
                "fps": options.fps,
                "seeds": options.seeds,
                **options.scoring,
                "least_px": LEAST_PX,
                "machine": machine(),
                "commit": commit(),
                "date": f"{datetime.now(UTC):%Y-%m-%d}",
                "summary": summarised(runs, presets, options.methods),
                "runs": runs,
            },
            indent=1,
        )
        + "\n"
    )


def summarised(
    runs: list[dict], presets: list[str], methods: list[str]
) -> dict[str, dict[str, dict]]:
    """The figures by preset and method, and of all presets together."""
    return {
        name: {
            method: summarise(
                [run for run in runs if run["method"] == method and name in (run["preset"], "all")]
            )
            for method in methods
        }
        for name in [*presets, "all"]
    }


def simulate(folder: Path, name: str, seed: int, options: argparse.Namespace) -> tuple[Path, Path]:
    """The two flights of a preset, and the map of the first; what is there already is kept."""
    simulation, base = folder / "simulation", folder / "base"
    settings = replace(preset(name), seed=seed)
    if options.length is not None:
        settings = replace(settings, path=replace(settings.path, length_m=options.length))
    if options.fps is not None:  # the truth's steps as far apart in time as before
        step = max(1, round(settings.output.truth_step * options.fps / settings.imaging.fps))
        settings = replace(
            settings,
            imaging=replace(settings.imaging, fps=options.fps),
            output=replace(settings.output, truth_step=step),
        )
    if options.speed:
        imaging = ImagingSettings(1920, 1080, fps=30)
        settings = replace(
            settings, imaging=imaging, output=replace(settings.output, truth_step=1_000_000)
        )
    if not simulation.is_dir():
        print(f"{name}, seed {seed}: simulating", file=sys.stderr, flush=True)
        for _ in simulate_site(simulation, settings):
            pass
    if not (base / "mosaic.tif").is_file():
        shutil.rmtree(base, ignore_errors=True)
        inputs, camera = [flight(simulation, 1)], simulation / "camera.xml"
        deque(map_flights(inputs, base, MapSettings(model="none"), camera=camera), 0)
    return simulation, base


def flight(simulation: Path, number: int) -> Path:
    """The video, or the folder of photos, of a simulated flight."""
    video = simulation / f"flight{number}" / f"flight{number}.mp4"
    return video if video.is_file() else simulation / f"flight{number}" / "photos"


def run_apart(method: str, simulation: Path, site: Path, limit_s: float, *, masks: bool) -> dict:
    """Run one comparison in a process of its own; what it cost, or how it failed."""
    arguments = ["--run", method, "masks" if masks else "no", str(simulation), str(site)]
    return run_child(__file__, arguments, limit_s)


def run_method(method: str, masks: bool, simulation: Path, site: Path) -> None:
    """In the child: compare, then print the cost as JSON."""
    settings = CompareSettings(_PAIRS[method], model="none", writes_masks=masks)
    before, started = resource.getrusage(resource.RUSAGE_SELF), time.monotonic()
    (last,) = deque(
        compare_flights([flight(simulation, 2)], site, settings, camera=simulation / "camera.xml"),
        1,
    )
    after = resource.getrusage(resource.RUSAGE_SELF)
    wall_s = time.monotonic() - started
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(
        json.dumps(
            {
                "frames": last.frames_expected,
                "views": last.views,
                "compared": last.compared,
                "wall_s": round(wall_s, 2),
                "cpu_s": round(cpu_s, 2),
                "frames_per_s": round(last.frames_expected / wall_s, 2),
                "cpu_ms_per_view": round(1000 * cpu_s / max(last.views, 1), 1),
                "cpu_ms_per_frame": round(1000 * cpu_s / max(last.frames_expected, 1), 1),
                "load_1_min": round(os.getloadavg()[0], 1),
                "peak_mb": peak_mb(),
            }
        )
    )


def accuracy(site: Path, simulation: Path) -> dict:
    """What a comparison's events and masks are worth."""
    (measured,) = evaluate_changes(site, simulation, least_px=LEAST_PX)
    plain = as_json([measured])[0]
    return {
        name: plain[name]
        for name in ("events", "pixels", "frames", "lists", "map_shift_m", "remarks")
    }


def summarise(runs: list[dict]) -> dict:
    """The figures of several runs of one method: sums over runs, rates of the sums, and their range over runs."""
    good = [run for run in runs if "failure" not in run]
    if not good:
        return {"runs": len(runs), "failed": len(runs)}
    events = [run["events"] for run in good]
    totals = {
        name: sum(each[name] for each in events)
        for name in (
            "must_find",
            "found",
            "named_right",
            "judged_late",
            "late",
            "twice",
            "false",
            "optional",
        )
    }
    compared_m2 = sum(each["compared_m2"] for each in events)
    errors = [
        pair["error_m"]
        for run in good
        for pair in run["lists"]["found"]
        if pair["kind"] != "moving"
    ]
    within = [
        (each["within_two_sigma"], each["found"])
        for each in events
        if each["within_two_sigma"] is not None
    ]
    return {
        "runs": len(runs),
        "failed": len(runs) - len(good),
        **totals,
        "compared_m2": round(compared_m2),
        "found_share": ratio(totals["found"], totals["must_find"]),
        "found_share_range": spread([each["found_share"] for each in events]),
        "false_per_hectare": ratio(1e4 * totals["false"], compared_m2),
        "false_per_hectare_range": spread([each["false_per_hectare"] for each in events]),
        "named_right_share": ratio(totals["named_right"], totals["found"]),
        "error_median_m": median(errors) if errors else None,
        "sigma_median_m": middle([each["sigma_median_m"] for each in events]),
        "within_two_sigma": ratio(
            sum(share * count for share, count in within), sum(count for _, count in within)
        ),
        "world_sigma_median_m": middle([each["world_sigma_median_m"] for each in events]),
        "world_within_two_sigma": middle([each["world_within_two_sigma"] for each in events]),
        "pixel_f1": pooled_f1([run["pixels"] for run in good]),
        "frame_f1": pooled_f1([run["frames"] for run in good]),
        "frame_f1_range": spread([run["frames"]["f1"] for run in good if run["frames"]]),
        "by_kind": {
            kind: {
                name: sum(each["by_kind"][kind][name] for each in events)
                for name in ("must_find", "found", "named_right", "late", "twice", "false")
            }
            for kind in _KINDS
        },
        **{
            name: {"median": middle(values), "range": spread(values)}
            for name in (
                "frames_per_s",
                "cpu_ms_per_view",
                "cpu_ms_per_frame",
                "wall_s",
                "cpu_s",
                "load_1_min",
                "peak_mb",
            )
            for values in [[run[name] for run in good]]
        },
    }


def ratio(part: float, whole: float) -> float | None:
    """The share, None of nothing."""
    return part / whole if whole else None


def spread(values: list[float | None]) -> list[float]:
    """Lowest and highest."""
    known = [value for value in values if value is not None]
    return [min(known), max(known)] if known else []


def middle(values: list[float | None]) -> float | None:
    """The median of what is known."""
    known = [value for value in values if value is not None]
    return median(known) if known else None


def pooled_f1(counts: list[dict | None]) -> float | None:
    """F1 of all masks together."""
    tp, wrong = (
        sum(sum(each[name] for name in names) for each in counts if each)
        for names in (["tp"], ["fp", "fn"])
    )
    return ratio(2 * tp, 2 * tp + wrong)


def show(summary: dict) -> None:
    """One table, a row for each preset and method."""
    table = Table(
        "",
        "method",
        "found",
        "of",
        "share",
        "range",
        "named",
        "late",
        "twice",
        "false",
        "per ha",
        "error m",
        "in 2 sigma",
        "pixel F1",
        "frame F1",
        "frames/s",
        "CPU ms/view",
        "MB",
    )
    for name, methods in summary.items():
        for method, each in methods.items():
            if each["runs"] == each["failed"]:
                table.add_row(name, method, "failed")
                continue
            table.add_row(
                name,
                method,
                *(str(each[key]) for key in ("found", "must_find")),
                text(each["found_share"]),
                "-".join(text(value) for value in each["found_share_range"]),
                text(each["named_right_share"]),
                f"{each['late']}/{each['judged_late']}",
                str(each["twice"]),
                str(each["false"]),
                text(each["false_per_hectare"]),
                text(each["error_median_m"]),
                text(each["within_two_sigma"]),
                text(each["pixel_f1"]),
                text(each["frame_f1"]),
                *(
                    text(each[key]["median"])
                    for key in ("frames_per_s", "cpu_ms_per_view", "peak_mb")
                ),
            )
    Console(width=200).print(table)


def text(value: float | None) -> str:
    """Three digits."""
    return "-" if value is None else f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


if __name__ == "__main__":
    main()
