"""Which method distinguishes changes from disturbances: robust, thesis, plain difference and SSIM on the same pairs.

python benchmarks/change_methods.py [--seeds 1 2 3] --split test
  [--count 30] [--suites hard none] [--data ../shared/data]

Each suite of change_suites.py isolates one nuisance; half of its pairs have no change. Counts are over all pixels and
all frames of a suite (thesis, Tables 4.3-4.5); a frame is positive where it has any change, and taken for positive
where its mask is not empty. Ranges are over seeds. Times are processor time of one thread at 1280x720, medians.
Everything is written to results/change_methods.json.
"""

import argparse
import json
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from statistics import median

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from change_suites import SUITES, Ground, Pair, grounds, pairs, views
from provenance import commit, machine, note_scoring, seeds_or_drawn
from sorvolo.change.pair.thesis import ThesisSettings, compare_thesis
from sorvolo.change.robust import compare_robust

RESULTS = Path(__file__).parent / "results" / "change_methods.json"
VIEWS, NEEDED = 5, 3
Images = tuple[np.ndarray, np.ndarray, np.ndarray]


def main() -> None:
    """Run the suites, print a table, write the numbers."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[], help="else two drawn from the commit's hash"
    )
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--count", type=int, default=30, help="pairs of each suite and seed")
    parser.add_argument("--suites", nargs="+", choices=list(SUITES), default=list(SUITES))
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    options.seeds = seeds_or_drawn("change_methods", options.seeds, 2)
    scoring = note_scoring(f"change_methods, {options.split} grounds")
    note_scoring(f"change_methods, seeds {' '.join(map(str, options.seeds))}")
    places = grounds(options.data, options.split)
    sources = sorted({each.source for each in places})
    if sources == ["procedural"]:
        print(f"no photos in the data folder: procedural grounds instead ({len(places)})")
    suites = [each for each in options.suites if each != "real" or sources != ["procedural"]]
    tasks = [
        (name, seed, options.count, places, options.split, tuple(options.methods))
        for name in suites
        for seed in options.seeds
    ]
    with ProcessPoolExecutor(options.jobs) as pool:
        runs = [run for part in pool.map(measure, *zip(*tasks)) for run in part]
    summary = [
        summarise(runs, suite, method)
        for suite in dict.fromkeys(run["suite"] for run in runs)
        for method in options.methods
    ]
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text(
        json.dumps(
            {
                "benchmark": "change_methods",
                "split": options.split,
                "seeds": options.seeds,
                "pairs": options.count,
                **scoring,
                "sources": sources,
                "machine": machine(),
                "commit": commit(),
                "summary": summary,
                "runs": runs,
            },
            indent=1,
        )
        + "\n"
    )
    show(summary, options.methods)


def measure(
    suite: str, seed: int, count: int, places: list[Ground], split: str, methods: tuple[str, ...]
) -> list[dict[str, object]]:
    """Counts of each method on one suite and seed; `hard` also where three of five views of a ground agree."""
    cv2.setNumThreads(1)
    runs = {name: empty_run(suite, seed, name) for name in methods}
    for pair in pairs(suite, seed, count, places, split):
        for name, run in runs.items():
            start = time.process_time()
            mask = METHODS[name]((pair.reference, pair.query, pair.valid)) > 0
            spent_ms = (time.process_time() - start) * 1e3
            if pair.query.shape[0] == 720:
                run["times_ms"].append(round(spent_ms, 2))
            add(run, pair, mask)
    found = list(runs.values())
    if suite == "hard":
        voted = {name: empty_run("hard, 3 of 5", seed, name) for name in methods}
        for number in range(count):
            seen = views(suite, seed, number, places, split, VIEWS)
            for name, run in voted.items():
                masks = [
                    METHODS[name]((each.reference, each.query, each.valid)) > 0 for each in seen
                ]
                add(run, seen[0], vote(masks))
        found += list(voted.values())
    return found


def vote(masks: list[np.ndarray]) -> np.ndarray:
    """Where enough views agree; a change may lie a few pixels elsewhere in each."""
    window = np.ones((5, 5), np.uint8)
    agree = sum(cv2.dilate(mask.astype(np.uint8), window) for mask in masks) >= NEEDED
    return np.asarray(cv2.erode(agree.astype(np.uint8), window) > 0)


def empty_run(suite: str, seed: int, method: str) -> dict[str, object]:
    """Nothing counted yet: [true positives, false positives, false negatives, true negatives]."""
    return {
        "suite": suite,
        "seed": seed,
        "method": method,
        "pixels": [0] * 4,
        "frames": [0] * 4,
        "things": [0] * 3,
        "times_ms": [],
        "by_source": {},
    }


def add(run: dict[str, object], pair: Pair, mask: np.ndarray) -> None:
    """Count one pair; `things` are changes found, false regions, changes missed."""
    counted = ~pair.ignored
    truth, found = pair.truth[counted], mask[counted]
    pixels = [int((truth & found).sum()), int((~truth & found).sum()), int((truth & ~found).sum())]
    run["pixels"] = [a + b for a, b in zip(run["pixels"], [*pixels, int(truth.size) - sum(pixels)])]
    is_changed, is_found = bool(truth.any()), bool(found.any())
    outcome = [
        is_changed and is_found,
        not is_changed and is_found,
        is_changed and not is_found,
        not is_changed and not is_found,
    ]
    run["frames"] = [a + int(b) for a, b in zip(run["frames"], outcome)]
    frames = run["by_source"].setdefault(pair.source, [0] * 4)
    run["by_source"][pair.source] = [a + int(b) for a, b in zip(frames, outcome)]
    things, labels = cv2.connectedComponents(pair.truth.astype(np.uint8))
    hit = int((np.bincount(labels[mask], minlength=things)[1:] > 0).sum())
    regions, marks = cv2.connectedComponents(mask.astype(np.uint8))
    false = int((np.bincount(marks[pair.truth | pair.ignored], minlength=regions)[1:] == 0).sum())
    run["things"] = [a + b for a, b in zip(run["things"], (hit, false, things - 1 - hit))]


def summarise(runs: list[dict[str, object]], suite: str, method: str) -> dict[str, object]:
    """F1 over all seeds together, its range over seeds, false alarms, and time."""
    own = [run for run in runs if run["suite"] == suite and run["method"] == method]
    result: dict[str, object] = {"suite": suite, "method": method}
    for field in ("pixels", "frames"):
        total = np.sum([run[field] for run in own], axis=0).tolist()
        each = [f1(run[field]) for run in own]
        result[field] = total
        result[f"{field}_f1"] = round(f1(total), 4)
        result[f"{field}_f1_seeds"] = [round(min(each), 4), round(max(each), 4)]
    frames = result["frames"]
    result["alarms_without_change"] = f"{frames[1]} of {frames[1] + frames[3]}"
    result["things"] = np.sum([run["things"] for run in own], axis=0).tolist()
    times = [value for run in own for value in run["times_ms"]]
    result["cpu_ms_1280x720"] = round(median(times), 2) if times else None
    return result


def f1(counts: list[int]) -> float:
    """The harmonic mean of precision and recall; 1 where there was nothing to find and nothing was found."""
    positives = 2 * counts[0] + counts[1] + counts[2]
    return 2 * counts[0] / positives if positives else 1.0


def show(summary: list[dict[str, object]], methods: list[str]) -> None:
    """Pixel / frame F1 in percent, a row for each suite; last the false alarms of the robust method."""
    heads = [f"{name} px / frame F1" for name in methods]
    table = Table("suite", *heads, "alarms without change", "found / false / missed")
    for suite in dict.fromkeys(each["suite"] for each in summary):
        rows = {each["method"]: each for each in summary if each["suite"] == suite}
        cells = [
            f"{100 * rows[name]['pixels_f1']:.1f} / {100 * rows[name]['frames_f1']:.1f}"
            for name in methods
        ]
        last = rows.get("robust", rows[methods[-1]])
        table.add_row(
            suite,
            *cells,
            last["alarms_without_change"],
            " / ".join(str(each) for each in last["things"]),
        )
    times = {
        name: [
            each["cpu_ms_1280x720"]
            for each in summary
            if each["method"] == name and each["cpu_ms_1280x720"]
        ]
        for name in methods
    }
    cells = [f"{median(times[name]):.1f}" if times[name] else "-" for name in methods]
    table.add_row("CPU ms at 1280x720", *cells, "", "")
    Console(width=150).print(table)


def by_thesis(images: Images) -> np.ndarray:
    """The thesis's method with its parameters."""
    reference, query, valid = images
    return np.asarray(compare_thesis(reference, query, valid, ThesisSettings()).mask)


def by_robust(images: Images) -> np.ndarray:
    """The robust method as it comes."""
    reference, query, valid = images
    return np.asarray(compare_robust(reference, query, valid).mask)


def by_difference(images: Images) -> np.ndarray:
    """Gray levels 40 or more apart; specks opened away."""
    reference, query, valid = images
    grays = [
        cv2.GaussianBlur(cv2.cvtColor(each, cv2.COLOR_BGR2GRAY), (5, 5), 0)
        for each in (reference, query)
    ]
    return _opened(np.asarray(cv2.absdiff(*grays)) >= 40, valid)


def by_ssim(images: Images) -> np.ndarray:
    """Structural similarity below 0.2 over windows of 11 px; specks opened away."""
    reference, query, valid = images
    a, b = (
        cv2.cvtColor(each, cv2.COLOR_BGR2GRAY).astype(np.float32) for each in (reference, query)
    )

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.GaussianBlur(values, (11, 11), 1.5))

    mean_a, mean_b = mean(a), mean(b)
    spread_a, spread_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    common = mean(a * b) - mean_a * mean_b
    first, second = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    above = (2 * mean_a * mean_b + first) * (2 * common + second)
    return _opened(
        above / ((mean_a**2 + mean_b**2 + first) * (spread_a + spread_b + second)) < 0.2, valid
    )


def _opened(changed: np.ndarray, valid: np.ndarray) -> np.ndarray:
    mask = (changed & (cv2.erode(valid.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0)).astype(
        np.uint8
    ) * 255
    return np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)))


METHODS: dict[str, Callable[[Images], np.ndarray]] = {
    "robust": by_robust,
    "thesis": by_thesis,
    "difference": by_difference,
    "ssim": by_ssim,
}

if __name__ == "__main__":
    main()
