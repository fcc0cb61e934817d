"""What is each rule of comparing one pair of pictures worth? Every rule switched off alone, on pairs with an answer.

python benchmarks/pair_ablation.py [--count 12] [--sites 4] [--data ../shared/data] [--rules NAME ...]
  [--seeds-from HASH]

The cheap half of change_ablation.py: pairs of change_suites.py (development grounds) and of simulated_pairs.py instead
of flights. Each pair is made once and compared with all rules and without each of them, so that differences are between
the same pictures. A row is the mean F1 over the suites, of pixels and of frames, the things found, false and missed,
and the change of both F1 against all rules, with the 95 % range of a bootstrap over pairs. Seeds come from a commit's
hash, so that nobody chose them. Everything is written to results/pair_ablation.json.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from change_ablation import seed_of
from change_rules import PAIR_RULES, Rule, switched_off
from change_suites import SUITES, Ground, Pair, grounds, pairs
from provenance import commit, machine
from simulated_pairs import GROUNDS, simulated_pairs
from sorvolo.change.robust import compare_robust

RESULTS = Path(__file__).parent / "results" / "pair_ablation.json"
SEEDS_FROM = "d8c29816f3da932cc58e275308de55135fb002af"
PAIRS_A_SITE = 6


def main() -> None:
    """Compare every pair with all rules and without each; print and write the table."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("--count", type=int, default=12, help="pairs of each suite")
    parser.add_argument(
        "--sites", type=int, default=4, help=f"simulated sites, {PAIRS_A_SITE} pairs each"
    )
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    parser.add_argument(
        "--rules", nargs="*", help="names of rules; all without it, none with nothing after it"
    )
    parser.add_argument(
        "--seeds-from", default=SEEDS_FROM, help="hash of a commit that seeds are drawn from"
    )
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    rules = [each for each in PAIR_RULES if options.rules is None or each.name in options.rules]
    outcomes: dict[str, dict[str, list[list[int]]]] = {}
    places = grounds(options.data, "dev")
    for suite, pair in all_pairs(places, options.count, options.sites, options.seeds_from):
        for name, counts in outcomes_of(pair, rules).items():
            outcomes.setdefault(name, {}).setdefault(suite, []).append(counts)
    rows = [row(name, outcomes, rules) for name in outcomes]
    for each in rows:
        print(
            f"{each['rule']:38} px {each['pixels_f1']:6.2f} {each['pixels_change']:+6.2f} {each['pixels_range']!s:16}"
            f" frames {each['frames_f1']:6.2f} {each['frames_change']:+6.2f} {each['frames_range']!s:16}"
            f" things {each['things']} alarms {each['alarms']}"
        )
    sources = sorted({each.source for each in places})
    options.output.write_text(
        json.dumps(
            {
                "benchmark": "pair_ablation",
                "pairs": options.count,
                "sites": options.sites,
                "seeds_from": options.seeds_from,
                "sources": sources,
                "machine": machine(),
                "commit": commit(),
                "rows": rows,
            },
            indent=1,
        )
        + "\n"
    )


def all_pairs(
    places: list[Ground], count: int, sites: int, seeds_from: str
) -> Iterator[tuple[str, Pair]]:
    """The pairs of all suites, with the suite's name; simulated ones last."""
    has_photos = {each.source for each in places} != {"procedural"}
    for suite in SUITES:
        if suite != "real" or has_photos:
            for pair in pairs(suite, seed_of(suite, 0, seeds_from), count, places, "dev"):
                yield suite, pair
    for site in range(sites):
        seed = seed_of("simulated", site, seeds_from)
        for pair in simulated_pairs(seed, PAIRS_A_SITE, GROUNDS[site % len(GROUNDS)]):
            yield "simulated", pair


def outcomes_of(pair: Pair, rules: list[Rule]) -> dict[str, list[int]]:
    """By rule: true, false, missed pixels; the frame's own; things found, false, missed."""
    found = {}
    for rule in (None, *rules):
        with switched_off(rule):
            mask = compare_robust(pair.reference, pair.query, pair.valid).mask > 0
        found["all rules" if rule is None else rule.name] = counts_of(pair, mask)
    return found


def counts_of(pair: Pair, mask: np.ndarray) -> list[int]:
    """True, false and missed pixels, true, false and missed frame (0 or 1), things found, false and missed."""
    counted = ~pair.ignored
    truth, shown = pair.truth[counted], mask[counted]
    pixels = [int((truth & shown).sum()), int((~truth & shown).sum()), int((truth & ~shown).sum())]
    is_changed, is_shown = bool(truth.any()), bool(shown.any())
    frame = [
        int(is_changed and is_shown),
        int(not is_changed and is_shown),
        int(is_changed and not is_shown),
    ]
    things, labels = cv2.connectedComponents(pair.truth.astype(np.uint8))
    hit = int((np.bincount(labels[mask], minlength=things)[1:] > 0).sum())
    regions, marks = cv2.connectedComponents(mask.astype(np.uint8))
    false = int((np.bincount(marks[pair.truth | pair.ignored], minlength=regions)[1:] == 0).sum())
    return [*pixels, *frame, hit, false, things - 1 - hit]


def row(
    name: str, outcomes: dict[str, dict[str, list[list[int]]]], rules: list[Rule]
) -> dict[str, object]:
    """One rule's figures, and how they differ from those with all rules."""
    own = {suite: np.array(counts) for suite, counts in outcomes[name].items()}
    base = {suite: np.array(counts) for suite, counts in outcomes["all rules"].items()}
    total = np.sum([each.sum(axis=0) for each in own.values()], axis=0).tolist()
    result: dict[str, object] = {
        "rule": name,
        "decision": next((each.decision for each in rules if each.name == name), ""),
        "things": total[6:],
        "alarms": total[4],
    }
    rng = np.random.default_rng(0)
    drawn = [
        {suite: rng.integers(len(each), size=len(each)) for suite, each in own.items()}
        for _ in range(400)
    ]
    for field, first in (("pixels", 0), ("frames", 3)):
        mean = mean_f1(own, first)
        changes = [
            mean_f1({suite: own[suite][rows] for suite, rows in each.items()}, first)
            - mean_f1({suite: base[suite][rows] for suite, rows in each.items()}, first)
            for each in drawn
        ]
        result[f"{field}_f1"] = round(mean, 2)
        result[f"{field}_change"] = round(mean - mean_f1(base, first), 2)
        result[f"{field}_range"] = [
            round(float(each), 2) for each in np.percentile(changes, (2.5, 97.5))
        ]
    result["suites"] = {
        suite: [round(f1(each.sum(axis=0)[first : first + 3]), 1) for first in (0, 3)]
        for suite, each in own.items()
    }
    return result


def mean_f1(counts: dict[str, np.ndarray], first: int) -> float:
    """The mean over suites of the F1, per cent, of three columns from `first` on."""
    return float(np.mean([f1(each.sum(axis=0)[first : first + 3]) for each in counts.values()]))


def f1(counts: np.ndarray) -> float:
    """Per cent; 100 where there was nothing to find and nothing was found."""
    true, false, missed = (int(each) for each in counts)
    return 200 * true / (2 * true + false + missed) if true + false + missed else 100.0


if __name__ == "__main__":
    main()
