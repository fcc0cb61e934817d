"""Which method makes the best map, and at what cost: planar, thesis and OpenCV's Stitcher on the same frames.

python benchmarks/mosaic_methods.py 101 102 103 [--repeats 3] [--preset survey] [--length 60]

For each seed a flight is simulated as photos, so that every method is given the very same frames. Each run
has a process of its own, whose processor time and peak memory are measured. The table shows medians over runs
and, after +-, half the range; everything is written to results/mosaic_methods.json.
"""

import argparse
import json
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from child import peak_mb, run_child
from provenance import commit, machine, seeds_or_drawn
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.lab.evaluation.map_quality import corner_errors
from sorvolo.lab.evaluation.mosaic import evaluate_mosaic
from sorvolo.lab.simulation.presets import preset
from sorvolo.lab.simulation.site import simulate_site
from sorvolo.lab.thesis.mapping import ThesisMapping
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights

METHODS = ("planar", "thesis", "opencv-scans")
COLUMNS = {
    "shape_m": "shape rms m",
    "absolute_m": "absolute rms m",
    "floor_m": "floor m",
    "over_floor": "absolute over floor",
    "deviation": "deviation",
    "placed": "placed",
    "frames": "of",
    "cpu_ms_per_frame": "CPU ms/frame",
    "front_end_ms_per_frame": "registration ms/frame",
    "wall_s": "wall s",
    "peak_mb": "peak MB",
}
RESULTS = Path(__file__).parent / "results" / "mosaic_methods.json"


def main() -> None:
    """Run the benchmark, or one method in the child process."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument(
        "seeds", type=int, nargs="*", help="else new ones, drawn from the commit's hash"
    )
    parser.add_argument("--count", type=int, default=3, help="how many seeds to draw")
    parser.add_argument("--preset", default="survey")
    parser.add_argument("--length", type=float, help="length of a strip, m, for a shorter flight")
    parser.add_argument("--repeats", type=int, default=1, help="runs of each method on each flight")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--limit", type=float, default=1800.0, help="longest time of a run, s")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument(
        "--run", nargs=3, metavar=("METHOD", "SIMULATION", "SITE"), help=argparse.SUPPRESS
    )
    options = parser.parse_args()
    if options.run:
        run_method(options.run[0], Path(options.run[1]), Path(options.run[2]))
        return
    options.seeds = seeds_or_drawn("mosaic_methods", options.seeds, options.count)
    runs = []
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as folder:
            simulation = Path(folder) / "simulation"
            simulate(simulation, options.preset, seed, options.length)
            for repeat in range(options.repeats):
                for method in options.methods:
                    site = Path(folder) / f"{method}-{repeat}"
                    print(f"seed {seed}, run {repeat + 1}: {method}", file=sys.stderr, flush=True)
                    measured = run_apart(method, simulation, site, options.limit)
                    measured |= accuracy(method, simulation, site)
                    runs.append({"seed": seed, "method": method, **measured})
    summary = summarise(runs, options.methods)
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text(
        json.dumps(
            {
                "benchmark": "mosaic_methods",
                "preset": options.preset,
                "length_m": options.length,
                "seeds": options.seeds,
                "repeats": options.repeats,
                "machine": machine(),
                "commit": commit(),
                "summary": summary,
                "runs": runs,
            },
            indent=1,
        )
        + "\n"
    )
    show(summary)
    for run in runs:
        if "failure" in run:
            print(f"{run['method']}, seed {run['seed']}: {run['failure']}")


def simulate(folder: Path, name: str, seed: int, length_m: float | None) -> None:
    """One flight of a preset, as photos."""
    settings = preset(name)
    path = settings.path if length_m is None else replace(settings.path, length_m=length_m)
    output = replace(settings.output, photos=True)
    settings = replace(settings, seed=seed, path=path, flights=1, output=output)
    for _ in simulate_site(folder, settings):
        pass


def photos_of(simulation: Path) -> Path:
    """The folder of the simulated flight's photos."""
    return next(simulation.glob("*/photos"))


def run_apart(method: str, simulation: Path, site: Path, limit_s: float) -> dict[str, float | str]:
    """Run one method in a process of its own; what it cost, or how it failed."""
    return run_child(__file__, ["--run", method, str(simulation), str(site)], limit_s)


def run_method(method: str, simulation: Path, site: Path) -> None:
    """In the child: map, then print the cost as JSON."""
    photos = photos_of(simulation)
    before, started = resource.getrusage(resource.RUSAGE_SELF), time.monotonic()
    if method == "opencv-scans":
        stitch_with_opencv(photos, site)
    else:
        settings = MapSettings(ThesisMapping() if method == "thesis" else None, model="none")
        for _ in map_flights([photos], site, settings, camera=simulation / "camera.xml"):
            pass
    after = resource.getrusage(resource.RUSAGE_SELF)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    frames = len(list(photos.iterdir()))
    print(
        json.dumps(
            {
                "cpu_ms_per_frame": 1000 * cpu_s / frames,
                "wall_s": time.monotonic() - started,
                "peak_mb": peak_mb(),
                "frames": frames,
            }
        )
    )


def stitch_with_opencv(photos: Path, site: Path) -> None:
    """Write picture and, for each image used, where it lies in it, to the folder `site`."""
    files = sorted(photos.iterdir())
    images = [cv2.imread(str(path)) for path in files]
    stitcher = cv2.Stitcher_create(cv2.Stitcher_SCANS)
    status, picture = stitcher.stitch(images)
    if status != cv2.Stitcher_OK:
        raise SystemExit(f"OpenCV's Stitcher ended with status {status}")
    site.mkdir()
    cv2.imwrite(str(site / "mosaic.png"), picture)
    scale = stitcher.workScale()
    at_scale = np.diag([scale, scale, 1.0])
    placed = {
        files[index].name: (
            picture_from_image(np.asarray(camera.R, dtype=np.float64)) @ at_scale
        ).tolist()
        for index, camera in zip(
            np.ravel(stitcher.component()).tolist(), stitcher.cameras(), strict=True
        )
    }
    (site / "placed.json").write_text(json.dumps(placed))


def picture_from_image(rotation: np.ndarray) -> np.ndarray:
    """SCANS keeps an image's map [A t] in its camera's rotation and draws its pixels p at A^T (p - t)."""
    result = np.eye(3)
    result[:2, :2] = rotation[:2, :2].T
    result[:2, 2] = -rotation[:2, :2].T @ rotation[:2, 2]
    return result


def accuracy(method: str, simulation: Path, site: Path) -> dict[str, float]:
    """What a run's map is worth; only `placed` = 0 when there is none."""
    if method == "opencv-scans":
        return (
            opencv_accuracy(simulation, site) if (site / "placed.json").is_file() else {"placed": 0}
        )
    if not (site / "mosaic.tif").is_file():
        return {"placed": 0}
    measured = evaluate_mosaic(site, truth=simulation)
    errors = measured.truth[-1].corners
    return {
        "shape_m": errors.shape.rms_m,
        "absolute_m": errors.absolute.rms_m,
        "floor_m": errors.floor.rms_m,
        "over_floor": errors.over_floor,
        "deviation": measured.deviation.mean,
        "placed": sum(each.vision for each in measured.flights),
        **front_end(site),
    }


def front_end(site: Path) -> dict[str, float]:
    """Processor time a keyframe of undistorting and registering (for the thesis blending, too), from the
    report.
    """
    report = json.loads(next(site.glob("flights/*/report.json")).read_text())
    return {"front_end_ms_per_frame": 1000 * report["registration_cpu_s_per_keyframe"]}


def opencv_accuracy(simulation: Path, site: Path) -> dict[str, float]:
    """The shape error of the images that the Stitcher used; it knows no place on Earth."""
    placed = json.loads((site / "placed.json").read_text())
    truth = json.loads((simulation / "truth" / "frames.geojson").read_text())
    origin = truth["site"]
    frame = LocalFrame(
        Geodetic(origin["latitude_deg"], origin["longitude_deg"], origin["height_m"])
    )
    first = cv2.imread(str(next(photos_of(simulation).iterdir())))
    height, width = first.shape[:2]
    corners = np.array(
        [[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]]
    )
    mine, true = [], []
    for feature in truth["features"]:
        matrix = placed.get(str(feature["properties"]["frame"]))
        if matrix is None:
            continue
        ring = np.array(feature["geometry"]["coordinates"][0][:4])
        true.append(
            frame.site_from_wgs84(ring[:, 1], ring[:, 0], np.full(4, origin["height_m"]))[:, :2]
        )
        mine.append(apply_homography(np.array(matrix), corners) * [1.0, -1.0])
    true_m, mine_px = np.array(true), np.array(mine)
    metres = float(
        np.sqrt(
            abs(
                np.linalg.det(fit_similarity(true_m.reshape(-1, 2), mine_px.reshape(-1, 2))[:2, :2])
            )
        )
    )
    return {
        "shape_m": corner_errors(mine_px * metres, true_m, metres).shape.rms_m,
        "placed": len(true),
    }


def summarise(runs: list[dict], methods: list[str]) -> dict[str, dict[str, dict[str, float]]]:
    """Median, lowest and highest of each number over a method's runs."""
    summary: dict[str, dict[str, dict[str, float]]] = {}
    for method in methods:
        mine = [run for run in runs if run["method"] == method]
        summary[method] = {}
        for name in COLUMNS:
            values = [run[name] for run in mine if name in run and np.isfinite(run[name])]
            if values:
                summary[method][name] = {
                    "median": median(values),
                    "lowest": min(values),
                    "highest": max(values),
                    "runs": len(values),
                }
    return summary


def show(summary: dict[str, dict[str, dict[str, float]]]) -> None:
    """One table, a column a method."""
    table = Table("", *summary)
    for name, title in COLUMNS.items():
        cells = []
        for measured in summary.values():
            value = measured.get(name)
            spread = 0.0 if value is None else (value["highest"] - value["lowest"]) / 2
            middle = "-" if value is None else f"{value['median']:.4g}"
            cells.append(f"{middle} +- {spread:.2g}" if spread else middle)
        table.add_row(title, *cells)
    Console().print(table)


if __name__ == "__main__":
    main()
