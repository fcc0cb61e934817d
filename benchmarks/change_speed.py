"""How long comparing two aligned pictures takes: the thesis's method and the robust one, by size and kind of pair.

python benchmarks/change_speed.py [--seed 11] [--pairs 4] [--repeats 9] [--data ../shared/data]

Pairs come from change_suites (development photos, or procedural ground without them), made larger or smaller to each
size; `inverted` is the worst case, a query with all values turned round, so that nearly every pixel is compared in its
patterns; it is left out for the robust method. Processor time is that of one thread, OpenCV's own threads off. For two
threads the time on the clock is given for a frame, with two frames at once and with each frame split in two; and half
the processor time of two frames at once, which is what the clock would show if both cores were free.
Each number is the median over repeats of a pair, then the median, lowest and highest over pairs; everything is written
to results/change_speed.json.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from change_suites import grounds, pairs
from provenance import commit, machine
from sorvolo.change.pair.compare import compare_images
from sorvolo.change.pair.thesis import prepare_reference

SIZES = ((960, 540), (1280, 720), (1920, 1080))
SUITES = ("plain", "illumination", "cloud", "hard")
RESULTS = Path(__file__).parent / "results" / "change_speed.json"


def main() -> None:
    """Measure, write the record, show the table."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--pairs", type=int, default=4, help="pairs of each suite")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    places = grounds(options.data, "dev")
    runs = []
    for suite in SUITES:
        for number, pair in enumerate(pairs(suite, options.seed, options.pairs, places, "dev")):
            for size in SIZES:
                reference, query = (cv2.resize(each, size) for each in (pair.reference, pair.query))
                about = {
                    "suite": suite,
                    "pair": number,
                    "source": pair.source,
                    "size": f"{size[0]}x{size[1]}",
                }
                runs.append(
                    about
                    | thesis_times(reference, query, options.repeats)
                    | {
                        "robust_cpu_ms": cpu_ms(
                            lambda: compare_images(reference, query, method="robust"),
                            options.repeats,
                        ),
                    }
                )
                if suite == "plain":
                    times = thesis_times(reference, 255 - reference, options.repeats)
                    runs.append(about | {"suite": "inverted"} | times)
    summary = summarise(runs)
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text(
        json.dumps(
            {
                "benchmark": "change_speed",
                "seed": options.seed,
                "pairs": options.pairs,
                "repeats": options.repeats,
                "ground": "procedural" if places[0].source == "procedural" else "photos",
                "machine": machine(),
                "load_1_min": os.getloadavg()[0],
                "commit": commit(),
                "summary": summary,
                "runs": runs,
            },
            indent=1,
        )
        + "\n"
    )
    show(summary)


def thesis_times(reference: np.ndarray, query: np.ndarray, repeats: int) -> dict[str, float]:
    """The thesis's method on one pair, reference prepared or not, on one thread and on two."""
    prepared = prepare_reference(reference)
    frames = 8

    def two_at_once() -> None:
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(lambda _: compare_images(prepared, query), range(frames)))

    return {
        "thesis_cpu_ms": cpu_ms(lambda: compare_images(prepared, query), repeats),
        "thesis_unprepared_cpu_ms": cpu_ms(lambda: compare_images(reference, query), repeats),
        "thesis_two_at_once_wall_ms": wall_ms(two_at_once, repeats) / frames,
        "thesis_two_at_once_half_cpu_ms": _median_ms(two_at_once, repeats, time.process_time)
        / frames
        / 2,
        "thesis_split_wall_ms": wall_ms(
            lambda: compare_images(prepared, query, threads=2), repeats
        ),
    }


def cpu_ms(work: Callable[[], object], repeats: int) -> float:
    """Median processor time of the calling thread."""
    return _median_ms(work, repeats, time.thread_time)


def wall_ms(work: Callable[[], object], repeats: int) -> float:
    """Median time on the clock."""
    return _median_ms(work, repeats, time.perf_counter)


def _median_ms(work: Callable[[], object], repeats: int, clock: Callable[[], float]) -> float:
    work()
    taken = []
    for _ in range(repeats):
        start = clock()
        work()
        taken.append(clock() - start)
    return 1000 * median(taken)


def summarise(runs: list[dict]) -> list[dict]:
    """Median, lowest and highest over pairs of each time, by suite and size."""
    rows = []
    for suite, size in dict.fromkeys((run["suite"], run["size"]) for run in runs):
        mine = [run for run in runs if (run["suite"], run["size"]) == (suite, size)]
        row: dict = {"suite": suite, "size": size, "pairs": len(mine)}
        for name in mine[0]:
            if name.endswith("_ms"):
                values = [run[name] for run in mine]
                row[name] = {
                    "median": median(values),
                    "lowest": min(values),
                    "highest": max(values),
                }
        rows.append(row)
    return rows


def show(summary: list[dict]) -> None:
    """One table: a line a suite and size, median and highest of each time in ms."""
    names = [name for name in summary[0] if name.endswith("_ms")]
    table = Table("suite", "size", *(name.removesuffix("_ms").replace("_", " ") for name in names))
    for row in summary:
        cells = [
            f"{row[name]['median']:.1f} ({row[name]['highest']:.1f})" if name in row else ""
            for name in names
        ]
        table.add_row(row["suite"], row["size"], *cells)
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
