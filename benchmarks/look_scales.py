"""At which size does a model find people and cars from straight above? Real cut-outs planted into real photos.

python benchmarks/look_scales.py DATA [--model default-int8] [--scales 1.4 1 0.8 0.64 0.5 0.36 0.25] [--every 2]

From each photo of brighton_beach (1.7 cm a pixel) the middle, 2000 x 1125 px, is taken; people and cars, cut from the
pictures of semantic_drone (photo_cutouts.py; nothing learnt from them), are planted there at true size. Each picture,
with and without them, is shown to the model larger or smaller. A thing is found where a box of its class overlaps it
by 0.4 or more. Per class: the share found from the model's own threshold on, and what it reports there without
anything planted (some are real cars); and the share found from the score on that ten such reports reach. The planted
things lie flat and the photos are development data: the table compares scales with each other, and is no accuracy.
Written to results/look_scales.json.
"""

import argparse
import json
import time
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from photo_cutouts import Cutout, Planted, cutouts, in_light_of
from provenance import commit, machine
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.box_overlap import iou_matrix
from sorvolo.geometry.homography import apply_homography

RESULTS = Path(__file__).parent / "results" / "look_scales.json"
M_PER_PX, SIZE_PX = 0.017, (2000, 1125)
COUNTS = {"car": 4, "person": 10}  # in each picture
CUTOUTS = {"person": 60, "car": 12}
FOUND_IOU, LEAST_SCORE, FALSE = 0.4, 0.05, 10


@dataclass
class Scored:
    """What one scale gave: the best score on each planted thing, and those of all boxes on bare ground, by class."""

    found: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in COUNTS})
    bare: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in COUNTS})
    cpu_s: float = 0.0


def main() -> None:
    """Plant, look at each scale, write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--model", default="default-int8")
    parser.add_argument(
        "--scales", type=float, nargs="+", default=[1.4, 1.0, 0.8, 0.64, 0.5, 0.36, 0.25]
    )
    parser.add_argument("--every", type=int, default=2, help="only each so-manieth photo")
    parser.add_argument("--seed", type=int, default=1)
    wishes = parser.parse_args()
    rng = np.random.default_rng(wishes.seed)
    things = {
        name: list(islice(cutouts(wishes.data, name, rng), count))
        for name, count in CUTOUTS.items()
    }
    detector = Detector.load(find_model(wishes.model), provider="cpu", threads=1)
    scored = {scale: Scored() for scale in wishes.scales}
    for path in sorted((wishes.data / "flights" / "brighton_beach").glob("*.JPG"))[:: wishes.every]:
        bare = middle(path)
        full, truth = planted(bare, things, rng)
        for scale, row in scored.items():
            look(detector, full, bare, scale, truth, row)
    rows = [row_of(scale, row, detector) for scale, row in scored.items()]
    document = {
        "benchmark": "look_scales",
        "machine": machine(),
        "commit": commit(),
        "seed": wishes.seed,
        "model": wishes.model,
        "m_per_px": M_PER_PX,
        "rows": rows,
    }
    RESULTS.write_text(json.dumps(document, indent=1) + "\n")
    print(json.dumps(rows, indent=1))


def middle(path: Path) -> Floats:
    """The middle of a photo, float32 (1125, 2000, 3) RGB."""
    whole = cv2.imread(str(path), cv2.IMREAD_COLOR)
    top, left = (whole.shape[0] - SIZE_PX[1]) // 2, (whole.shape[1] - SIZE_PX[0]) // 2
    return whole[top : top + SIZE_PX[1], left : left + SIZE_PX[0], ::-1].astype(np.float32)


def planted(
    bare: Floats, things: dict[str, list[Cutout]], rng: np.random.Generator
) -> tuple[Floats, list[tuple[str, Floats]]]:
    """The picture with things on it, apart from each other, and each thing's class and box (4,) px."""
    picture, truth, taken = bare.copy(), [], []
    image_from_site = np.diag([1 / M_PER_PX, -1 / M_PER_PX, 1.0])
    for name, count in COUNTS.items():
        for _ in range(count):
            cutout = things[name][rng.integers(len(things[name]))]
            reach_px = cutout.length_m / M_PER_PX
            at_px = rng.uniform(reach_px, np.array(SIZE_PX) - reach_px)
            while any(
                np.linalg.norm(at_px - other) < 0.75 * (reach_px + far_px)
                for other, far_px in taken
            ):
                at_px = rng.uniform(reach_px, np.array(SIZE_PX) - reach_px)
            taken.append((at_px, reach_px))
            column, row = at_px.astype(int)
            ground = picture[row - 5 : row + 6, column - 5 : column + 6].mean(axis=(0, 1))
            thing = Planted(
                in_light_of(cutout, ground, False, rng),
                at_px * M_PER_PX * np.array([1, -1]),
                float(rng.uniform(0, 360)),
                40.0,
                0.6 * cutout.height_m,
                0.45,
                False,
            )
            thing.paint(picture, image_from_site)
            outline_px = apply_homography(image_from_site, thing.outline_m)
            truth.append((name, np.concatenate([outline_px.min(axis=0), outline_px.max(axis=0)])))
    return picture, truth


def look(
    detector: Detector,
    full: Floats,
    bare: Floats,
    scale: float,
    truth: list[tuple[str, Floats]],
    row: Scored,
) -> None:
    """Look at both pictures at one scale; `row` takes the scores."""
    for picture, is_full in ((full, True), (bare, False)):
        shown = cv2.resize(
            np.clip(picture, 0, 255).astype(np.uint8),
            None,
            fx=scale,
            fy=scale,
            interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC,
        )
        began_s = time.process_time()
        seen = detector.detect(
            shown, tiles="auto", classes=tuple(COUNTS), from_above=True, least_score=LEAST_SCORE
        )
        row.cpu_s += time.process_time() - began_s
        names = np.array(seen.names)
        if not is_full:
            for name in COUNTS:
                row.bare[name] += seen.scores[names == name].tolist()
            continue
        for name, box in truth:
            same = (iou_matrix(seen.boxes_px / scale, box[None])[:, 0] >= FOUND_IOU) & (
                names == name
            )
            row.found[name].append(float(seen.scores[same].max(initial=0.0)))


def row_of(scale: float, row: Scored, detector: Detector) -> dict[str, object]:
    """One scale's line of the table."""
    line: dict[str, object] = {
        "scale": scale,
        "px_per_m": round(scale / M_PER_PX, 1),
        "cpu_s_a_picture": round(
            row.cpu_s / 2 / max(1, len(row.found["person"]) / COUNTS["person"]), 2
        ),
    }
    for name in COUNTS:
        found, bare = np.array(row.found[name]), np.sort(row.bare[name])[::-1]
        least = detector.info.thresholds[name]
        tenth = float(bare[FALSE - 1]) if len(bare) >= FALSE else LEAST_SCORE
        line[name] = {
            "planted": len(found),
            "found": round(float((found >= least).mean()), 3),
            "on_bare_ground": int((bare >= least).sum()),
            "found_at_ten_on_bare_ground": round(float((found >= tenth).mean()), 3),
        }
    return line


if __name__ == "__main__":
    main()
