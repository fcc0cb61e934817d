"""What people lose where a picture is searched in bands rather than at once, and when the first band is known.

python benchmarks/picture_bands.py DATA [--model default-int8] [--seed 3]

For live video, whose newest ground could be searched first (decision 0064). Pictures are those of look_scales.py: the
middles of the photos of brighton_beach (1.7 cm a pixel), here 1920x1080, with people and cars planted, and bare. Bands
overlap by a person's length. Found: a box that overlaps a planted person by 0.4 or more, from the model's threshold on
(and from half of that on), after the second look. It compares ways with each other, and is no accuracy. Processor time
of the people's look, one thread. Written to results/picture_bands.json.
"""

import argparse
import json
import time
from collections import Counter
from itertools import islice, pairwise
from pathlib import Path

import numpy as np

from look_scales import CUTOUTS, FOUND_IOU, M_PER_PX, middle, planted
from photo_cutouts import cutouts
from provenance import commit, machine
from sorvolo.detection.calibration import in_own_scale
from sorvolo.detection.detector import Detector, _look
from sorvolo.detection.models import find_model
from sorvolo.detection.session import Seen
from sorvolo.detection.suppression import SeenTile, merge_tiles
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.box_overlap import iou_matrix

RESULTS = Path(__file__).parent / "results" / "picture_bands.json"
WIDTH_PX, HEIGHT_PX = 1920, 1080
OVERLAP_PX = 118  # a person's length and 15 %, as tiles overlap
WAYS = {
    "at once": (),
    "310 rows of new ground, the rest": (310,),
    "halves": (540,),
    "thirds": (360, 720),
}
"""Where each way cuts, px. At 8 m/s, 1.7 cm a pixel and a look every 0.66 s, 310 rows are new."""

Place = tuple[int, int, int, int]


def main() -> None:
    """Plant, search in each way, write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--model", default="default-int8")
    parser.add_argument("--seed", type=int, default=3)
    wishes = parser.parse_args()
    rng = np.random.default_rng(wishes.seed)
    things = {
        name: list(islice(cutouts(wishes.data, name, rng), count))
        for name, count in CUTOUTS.items()
    }
    detector = Detector.load(find_model(wishes.model), provider="cpu", threads=1)
    counts = {name: Counter[str]() for name in WAYS}
    for path in sorted((wishes.data / "flights" / "brighton_beach").glob("*.JPG")):
        bare = middle(path)
        full, truth = planted(bare, things, rng)
        whole = [
            box
            for name, box in truth
            if name == "person" and box[2] <= WIDTH_PX and box[3] <= HEIGHT_PX
        ]
        for name, cuts in WAYS.items():
            for picture, boxes in ((full, whole), (bare, None)):
                shown = np.clip(picture[:HEIGHT_PX, :WIDTH_PX], 0, 255).astype(np.uint8)
                count(counts[name], searched(detector, shown, cuts, counts[name]), boxes, detector)
    rows = {name: row_of(each) for name, each in counts.items()}
    document = {
        "benchmark": "picture_bands",
        "machine": machine(),
        "commit": commit(),
        "model": wishes.model,
        "seed": wishes.seed,
        "m_per_px": M_PER_PX,
        "ways": rows,
    }
    RESULTS.write_text(json.dumps(document, indent=1) + "\n")
    print(json.dumps(rows, indent=1))


def bands(cuts: tuple[int, ...]) -> list[Place]:
    """The places of bands that overlap."""
    edges = [0, *cuts, HEIGHT_PX]
    half = OVERLAP_PX // 2
    return [
        (0, max(0, top - half), WIDTH_PX, min(HEIGHT_PX, low + half))
        if cuts
        else (0, top, WIDTH_PX, low)
        for top, low in pairwise(edges)
    ]


def searched(
    detector: Detector, shown: ImageRGB, cuts: tuple[int, ...], spent: Counter[str]
) -> Seen:
    """What is seen in a picture; `spent` takes the processor time, ms."""
    session = detector._session  # a look that the detector does not offer
    began_s, tiles = time.process_time(), []
    for place in bands(cuts):
        tiles.append(SeenTile(place, _look(session, shown, place, 1.0)))
        if len(tiles) == 1:
            spent["first_ms"] += round(1000 * (time.process_time() - began_s))
    seen = tiles[0].seen if len(tiles) == 1 else merge_tiles(tiles, (HEIGHT_PX, WIDTH_PX))
    seen = detector._seen_again(session, shown, seen, ["person"])
    spent["ms"] += round(1000 * (time.process_time() - began_s))
    spent["pictures"] += 1
    return seen


def count(
    counts: Counter[str], seen: Seen, truth: list[np.ndarray] | None, detector: Detector
) -> None:
    """Count the people found, or reported on bare ground."""
    least = in_own_scale(detector.info)["person"]
    people = seen.labels == detector.classes.index("person")
    scores, boxes = seen.scores[people], seen.boxes_px[people]
    if truth is None:
        counts["on_bare_ground"] += int((scores >= least).sum())
        return
    for box in truth:
        best = (
            scores[iou_matrix(boxes, box[None])[:, 0] >= FOUND_IOU].max(initial=0.0)
            if len(boxes)
            else 0.0
        )
        counts["planted"] += 1
        counts["found"] += bool(best >= least)
        counts["found_at_half_the_threshold"] += bool(best >= least / 2)


def row_of(counts: Counter[str]) -> dict[str, float]:
    """One way's line of the table."""
    names = ("planted", "found", "found_at_half_the_threshold", "on_bare_ground")
    return {name: counts[name] for name in names} | {
        f"{name}_cpu_s": round(counts[key] / 1000 / counts["pictures"], 3)
        for name, key in (("whole", "ms"), ("first_band", "first_ms"))
    }


if __name__ == "__main__":
    main()
