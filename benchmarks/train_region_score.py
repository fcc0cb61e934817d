"""Train the region score: python benchmarks/train_region_score.py [--data ../shared/data] [--count 120]

Answers are exact: the suites of change_suites.py over the photos of caliterra (CC0), grounds painted over them
(painted_grounds.py) and procedural ones, and simulated flights (simulated_pairs.py), with random numbers that no score
uses. Boosted oblivious trees, written to src/sorvolo/change/region_score.json.

Not reproducible: the packaged trees come from many rounds on older states of the code, each trained `--onto` the trees
before (the file's `trained` and `onto` list their commands). One run makes a score of the same kind, not the same one.
"""

import argparse
import json
import shlex
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from change_suites import SUITES, Ground, grounds, pairs, picture
from painted_grounds import painted_ground
from simulated_pairs import simulated_pairs
from sorvolo.change.regions import FEATURES, Regions, RegionSettings
from sorvolo.change.robust import RobustSettings, examine
from sorvolo.lab.simulation.ground import GroundKind

TARGET = Path(__file__).parents[1] / "src" / "sorvolo" / "change" / "region_score.json"
SPLIT, SEED, EACH = "train", 9000, 10
CROWDING = 3
EAGER = RegionSettings(reach_px=1, least_difference=6.0, activity_factor=1.0, strong_factor=1.25)
SITE_SEED, PAIRS_OF_A_SITE = 1000, 14
TREES, DEPTH, RATE, BINS = 300, 4, 0.1, 48


def main() -> None:
    """Collect regions with their answers, train, write the numbers."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    parser.add_argument("--count", type=int, default=120, help="pairs of each suite")
    parser.add_argument(
        "--sites", type=int, default=40, help="simulated sites, each of another seed"
    )
    parser.add_argument("--painted", type=int, default=40, help="painted grounds")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--suites", nargs="+", choices=list(SUITES), default=list(SUITES))
    parser.add_argument("--seed", type=int, default=SEED, help="the first of them")
    parser.add_argument("--collect", type=Path, help="only collect regions, into this .npz")
    parser.add_argument(
        "--rows", type=Path, nargs="+", help="train on regions collected before, joined"
    )
    parser.add_argument(
        "--onto", type=Path, help="trees to go on from; their features may be fewer"
    )
    parser.add_argument("--output", type=Path, default=TARGET)
    options = parser.parse_args()
    cv2.setNumThreads(1)  # a process forked from one with OpenCV's threads hangs in them
    if options.rows:
        kept = [dict(np.load(path)) for path in options.rows]
        names = "rows", "answers", "suites"
        rows, answers, suites = (np.concatenate([each[name] for each in kept]) for name in names)
        command_line = [str(each["command_line"]) for each in kept]
    else:
        rows, answers, suites, sources = collect_all(options)
        command = f"--count {options.count} --sites {options.sites} --painted {options.painted} --seed {options.seed}"
        if options.suites != list(SUITES):
            command += " --suites " + shlex.join(options.suites)
        command_line = [f"{command}: {len(rows)} regions of {', '.join(sources)}"]
        if options.collect:
            np.savez_compressed(
                options.collect,
                rows=rows,
                answers=answers,
                suites=suites,
                command_line=command_line[0],
            )
            return
    before = json.loads(options.onto.read_text()) if options.onto else None
    trees = train(rows, answers, suites == "simulated", before)
    print(f"{len(rows)} regions, {int(answers.sum())} of them changes")
    trees["trained"] = {
        "regions": len(rows),
        "changes": int(answers.sum()),
        "collected": command_line,
    }
    if before:
        trees["trained"]["onto"] = before["trained"]
    options.output.write_text(json.dumps(trees) + "\n")


def collect_all(
    options: argparse.Namespace,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    """Features (N, F), answers (N,) and suites (N,) of all regions, and the grounds' sources."""
    with tempfile.TemporaryDirectory() as folder:
        return _collected(options, Path(folder))


def _collected(
    options: argparse.Namespace, painted: Path
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    places = [each for each in grounds(options.data, "dev") if each.source == "caliterra"]
    photos = [each.path for each in places]
    names = [name for name in options.suites if places or name != "real"]
    places += [
        Ground("procedural", f"{kind.value} {500 + n}") for kind in GroundKind for n in range(3)
    ]
    places += [
        Ground("painted", str(_paint(photos, painted, number)))
        for number in range(options.painted if photos else 0)
    ]
    parts = range(-(-options.count // EACH))
    first = SITE_SEED + options.seed - SEED
    tasks = [("simulated", first + site, PAIRS_OF_A_SITE, []) for site in range(options.sites)]
    tasks += [(name, options.seed + part, EACH, places) for name in names for part in parts]
    with ProcessPoolExecutor(options.jobs) as pool:
        collected = list(pool.map(collect, *zip(*tasks)))
    rows = np.concatenate([rows for rows, _ in collected])
    answers = np.concatenate([answers for _, answers in collected])
    suites = np.concatenate([[task[0]] * len(part) for task, (_, part) in zip(tasks, collected)])
    sources = {each.source for each in places} | ({"simulation"} if options.sites else set())
    return rows, answers, suites, sorted(sources)


def _paint(photos: list[str], folder: Path, number: int) -> Path:
    rng = np.random.default_rng([SEED, number])
    path = folder / f"{number}.png"
    cv2.imwrite(str(path), painted_ground(picture(photos[int(rng.integers(len(photos)))]), rng))
    return path


def collect(
    suite: str, seed: int, count: int, places: list[Ground]
) -> tuple[np.ndarray, np.ndarray]:
    """Features (N, F) and answers (N,) of the regions found in a suite's pairs, each pair taken both ways round.

    Eager settings find more of what is no change, and the same things with other rims: the check sees more for as many
    pairs.
    """
    cv2.setNumThreads(1)
    rows, answers = [], []
    found = (
        simulated_pairs(seed, count)
        if suite == "simulated"
        else pairs(suite, seed, count, places, SPLIT, CROWDING)
    )
    for pair in found:
        for before, after in ((pair.reference, pair.query), (pair.query, pair.reference)):
            for settings in (RegionSettings(), EAGER):
                regions, *_ = examine(before, after, pair.valid, RobustSettings(regions=settings))
                changed, ignored = (_shares(regions, mask) for mask in (pair.truth, pair.ignored))
                is_change = (changed > 0.3) | ((changed > 0.1) & (_held(regions, pair.truth) > 0.5))
                clear = is_change | ((changed < 0.05) & (ignored < 0.2))
                rows.append(regions.features[clear])
                answers.append(is_change[clear])
    return np.concatenate(rows), np.concatenate(answers)


def _shares(regions: Regions, mask: np.ndarray) -> np.ndarray:
    """The share (N,) of each region's pixels that lie in a mask of the pictures' own size."""
    count = len(regions.boxes) + 1
    cover = cv2.resize(
        mask.astype(np.float32), regions.labels.shape[::-1], interpolation=cv2.INTER_AREA
    )
    total = np.bincount(regions.labels.ravel(), minlength=count)[1:]
    return np.bincount(regions.labels.ravel(), cover.ravel(), minlength=count)[1:] / np.maximum(
        total, 1
    )


def _held(regions: Regions, truth: np.ndarray) -> np.ndarray:
    """The largest share (N,) of any one true thing that each region holds: a person with a long shadow is one."""
    small = (
        cv2.resize(
            truth.astype(np.uint8) * 255, regions.labels.shape[::-1], interpolation=cv2.INTER_AREA
        )
        > 127
    )
    things, numbers = cv2.connectedComponents(small.view(np.uint8))
    count = len(regions.boxes) + 1
    both = regions.labels.astype(np.int64) * things + numbers
    pixels = np.bincount(both.ravel(), minlength=count * things).reshape(count, things)
    return (pixels / np.maximum(pixels.sum(axis=0), 1))[1:, 1:].max(axis=1, initial=0.0)


def train(
    rows: np.ndarray, answers: np.ndarray, simulated: np.ndarray, onto: dict | None = None
) -> dict[str, object]:
    """Boosted oblivious trees: each level of a tree asks one question of all; logistic loss.

    `simulated` (N,) marks regions of simulated flights; as a whole they weigh as much as all others. `onto` are trees
    whose answers the new ones correct.
    """
    rng = np.random.default_rng(5)
    cuts = [np.unique(np.quantile(column, np.linspace(0, 1, BINS + 1)[1:-1])) for column in rows.T]
    binned = np.column_stack(
        [np.searchsorted(cut, column, "left") for cut, column in zip(cuts, rows.T)]
    )
    count, width = binned.shape
    weights = (
        np.where(answers, 0.5 / max(answers.mean(), 1e-9), 0.5 / max(1 - answers.mean(), 1e-9))
        ** 0.5
    )
    if simulated.any() and not simulated.all():
        weights = weights * np.where(
            simulated, 0.5 * count / simulated.sum(), 0.5 * count / (~simulated).sum()
        )
    prior = float(np.log((weights @ answers) / (weights @ ~answers)))
    features, thresholds, leaves = [], [], []
    if onto:
        prior, thresholds, leaves = onto["prior"], list(onto["thresholds"]), list(onto["leaves"])
        features = [
            [FEATURES.index(onto["names"][one]) for one in tree] for tree in onto["features"]
        ]
    powers = 1 << np.arange(DEPTH)[::-1]
    margin = np.full(count, prior)
    for tree, cut, values in zip(features, thresholds, leaves):
        margin += np.array(values)[(rows[:, tree] > np.array(cut)) @ powers]
    for _ in range(TREES):
        chance = 1 / (1 + np.exp(-margin))
        sample = rng.uniform(size=count) < 0.7
        slope, bend = (
            (answers - chance) * weights * sample,
            chance * (1 - chance) * weights * sample,
        )
        asked = np.sort(rng.choice(width, size=max(1, int(width * 0.6)), replace=False))
        leaf = np.zeros(count, np.int64)
        tree_features, tree_thresholds = [], []
        for level in range(DEPTH):
            best = (-np.inf, 0, 0)
            for one in asked:
                shape = (2**level, BINS)
                at = leaf * BINS + binned[:, one]
                left_slope = (
                    np.bincount(at, slope, minlength=shape[0] * BINS).reshape(shape).cumsum(axis=1)
                )
                left_bend = (
                    np.bincount(at, bend, minlength=shape[0] * BINS).reshape(shape).cumsum(axis=1)
                )
                gain = left_slope**2 / (left_bend + 4)
                gain += (left_slope[:, -1:] - left_slope) ** 2 / (left_bend[:, -1:] - left_bend + 4)
                total = gain.sum(axis=0)[: len(cuts[one])]
                if len(total) and total.max() > best[0]:
                    best = (float(total.max()), int(one), int(total.argmax()))
            _, one, cut = best
            tree_features.append(one)
            tree_thresholds.append(float(np.float32(cuts[one][cut])))
            leaf = 2 * leaf + (rows[:, one] > np.float32(cuts[one][cut]))
        values = (
            RATE
            * np.bincount(leaf, slope, minlength=2**DEPTH)
            / (np.bincount(leaf, bend, minlength=2**DEPTH) + 4)
        )
        margin += values[leaf]
        features.append(tree_features)
        thresholds.append([float(f"{value:.6g}") for value in tree_thresholds])
        leaves.append([round(float(value), 4) for value in values])
    trees = {"features": features, "thresholds": thresholds, "leaves": leaves}
    return {"names": list(FEATURES), "prior": prior, **trees}


if __name__ == "__main__":
    main()
