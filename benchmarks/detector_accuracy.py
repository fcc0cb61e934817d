"""How well a model finds people, cars and small objects in pictures that it was not trained on, set by set.

python benchmarks/detector_accuracy.py MODEL [--data FOLDER] [--sets hituav cats ...] [--out FOLDER]

FOLDER holds the data sets; their held-out parts are those of detection_data.py (whole flights, videos, or blocks of
neighbouring frames). "simulated" are frames of simulated flights and "pictures" single simulated pictures, both of
seeds from 301 on, which no training uses; "pictures_thermal" their thermal kind. Intervals of 95 % by drawing whole
videos or flights. Written to results/detector_accuracy.json, with a page for each set in the folder of --out.
"""

import argparse
import json
import tempfile
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

import detection_data
from provenance import commit, machine, note_scoring
from sorvolo.lab.datasets import read_dataset
from sorvolo.lab.evaluation.detection_scores import score_set
from sorvolo.lab.evaluation.detector import (
    EvaluationSettings,
    FoundSet,
    evaluate_detector,
    write_evaluation,
)
from sorvolo.lab.simulation.flight import simulate_flight
from sorvolo.lab.simulation.pictures import (
    LEAST_VISIBLE,
    SMALLEST_PX,
    PictureSettings,
    simulate_pictures,
)
from sorvolo.lab.simulation.presets import preset
from sorvolo.lab.simulation.truth import coco_boxes
from sorvolo.store.exports.plain import plain_json
from sorvolo.store.images import jpeg_from_image
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES

RESULTS = Path(__file__).parent / "results" / "detector_accuracy.json"
REAL = ("hituav", "tinyperson", "aerial_cars", "cats", "sdd", "semantic_drone")
FIRST_SEED = 301
FLIGHTS, FRAMES_OF_ONE, PICTURES = (
    ("compare", "compare-urban", "compare-dirt", "survey", "survey-urban"),
    8,
    120,
)
TARGETS = {"people": 16, "cars": 8, "small_objects": 16}


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", help="a model's name or file")
    parser.add_argument("--data", type=Path, help="folder of the data sets")
    parser.add_argument(
        "--sets", nargs="+", default=[*REAL, "simulated", "pictures", "pictures_thermal"]
    )
    parser.add_argument(
        "--seeds", type=int, default=4, help="so many simulated flights of each preset"
    )
    parser.add_argument("--tiles", default="auto", help="auto, none, or pixels a side")
    parser.add_argument("--from-above", action="store_true", help="the pictures look straight down")
    parser.add_argument("--out", type=Path, help="folder for the pages")
    parser.add_argument("--results", type=Path, default=RESULTS, help="the file that is written")
    options = parser.parse_args()
    tiles = (
        int(options.tiles)
        if options.tiles.isdecimal()
        else options.tiles
        if options.tiles != "none"
        else None
    )
    settings = EvaluationSettings(tiles, from_above=options.from_above)
    scoring = note_scoring(
        f"detector_accuracy, {' '.join(options.sets)}{' from above' * options.from_above}"
    )
    runs = {}
    for name in options.sets:
        with tempfile.TemporaryDirectory() as folder:
            labelled = held_out(name, options.data, Path(folder), options.seeds)
            if labelled is None:
                print(f"{name}: no such data, left out", flush=True)
                continue
            measured = evaluate_detector([[options.model]], [labelled], settings)
        runs[name] = figures(measured.sets[0]) | {
            "seconds_per_picture": measured.found.seconds_per_picture,
            "people_by_centre": people_by_centre(
                labelled, measured.found.sets[labelled.name], measured.found.classes
            ),
            "people_from_8_px": people_from(
                8.0, labelled, measured.found.sets[labelled.name], measured.found.classes
            ),
        }
        print(name, json.dumps(plain_json(runs[name]["classes"])), flush=True)
        if options.out is not None:
            write_evaluation(
                measured, options.out / name, {"benchmark": "detector_accuracy", "set": name}
            )
    options.results.write_text(
        json.dumps(
            plain_json(
                {
                    "benchmark": "detector_accuracy",
                    "machine": machine(),
                    "commit": commit(),
                    "model": Path(options.model).name,
                    "tiles": options.tiles,
                    "from_above": options.from_above,
                    **scoring,
                    "draws": settings.draws,
                    "seed": settings.seed,
                    "first_simulated_seed": FIRST_SEED,
                    "sets": runs,
                }
            ),
            indent=1,
        )
        + "\n"
    )


def held_out(name: str, data: Path | None, folder: Path, seeds: int) -> LabelledSet | None:
    """The pictures to be measured on; None where the data is not there. Classes without any label are not judged."""
    makers: dict[str, Callable[[], LabelledSet]] = {
        "simulated": lambda: simulated_flights(folder, seeds),
        "pictures": lambda: simulated_pictures(folder / "pictures", 0.0),
        "pictures_thermal": lambda: simulated_pictures(folder / "pictures_thermal", 1.0),
    }
    if name in makers:
        labelled = makers[name]()
    elif data is not None and (data / name).is_dir():
        labelled = getattr(detection_data, name)(data)["test"]
    else:
        return None
    labels = {
        labelled.classes[label]
        for picture in labelled.pictures
        for label in picture.labels.tolist()
    }
    unlabelled = labelled.unlabelled | (set(labelled.classes) - labels)
    return LabelledSet(name, labelled.classes, labelled.pictures, frozenset(unlabelled))


def simulated_pictures(folder: Path, thermal_share: float) -> LabelledSet:
    """Single pictures, each of a site of its own."""
    for _ in simulate_pictures(
        folder, PictureSettings(PICTURES, FIRST_SEED, thermal_share=thermal_share)
    ):
        pass
    return read_dataset(folder)


def simulated_flights(folder: Path, seeds: int) -> LabelledSet:
    """A few frames of flights of several presets; what hardly shows is ignored, as in single pictures."""
    pictures = []
    for name in FLIGHTS:
        for seed in range(FIRST_SEED, FIRST_SEED + seeds):
            settings = replace(preset(name), seed=seed)
            flight = simulate_flight(replace(settings, scene=replace(settings.scene, **TARGETS)))
            chosen = np.unique(np.linspace(0, len(flight) - 1, FRAMES_OF_ONE).astype(int)).tolist()
            truth = coco_boxes(flight, chosen)
            for index in chosen:
                path = folder / f"{name}-{seed}-{index:06d}.jpg"
                path.write_bytes(jpeg_from_image(flight.frame(index).image))
                boxes, labels, ignored = [], [], []
                for row in truth["annotations"]:
                    if row["image_id"] != index:
                        continue
                    x, y, width, height = row["bbox"]
                    box = [x, y, x + width, y + height]
                    if row["visibility"] < LEAST_VISIBLE or max(width, height) < SMALLEST_PX:
                        ignored.append(box)
                    else:
                        boxes.append(box)
                        labels.append(row["category_id"] - 1)
                pictures.append(
                    LabelledPicture(
                        str(path),
                        flight.camera.width_px,
                        flight.camera.height_px,
                        f"{name}-{seed}",
                        np.array(boxes, np.float32),
                        np.array(labels, np.int64),
                        np.array(ignored, np.float32),
                        flight.path.height_m / flight.camera.fx_px,
                    )
                )
    return LabelledSet("simulated", CLASSES, tuple(pictures))


def figures(scores) -> dict[str, object]:
    """What the result file keeps of one set."""
    return {
        "pictures": scores.pictures,
        "groups": scores.groups,
        "ignored_regions": scores.ignored_regions,
        "AP": asdict(scores.intervals["AP"]),
        "AP50": asdict(scores.intervals["AP50"]),
        "thesis_map": asdict(scores.intervals["thesis_map"]),
        "classes": {
            row.label: {
                "labels": row.labels,
                "AP50": asdict(scores.intervals[f"AP50 {row.label}"]),
                "AP": asdict(scores.intervals[f"AP {row.label}"]),
                "reported": asdict(row.reported),
                "best_f1": asdict(row.best),
                "by_size_px": [
                    {**asdict(each), "recall": each.recall} for each in scores.by_size_px[row.label]
                ],
                "by_size_m": [
                    {**asdict(each), "recall": each.recall} for each in scores.by_size_m[row.label]
                ],
            }
            for row in scores.classes
        },
        "remarks": list(scores.remarks),
    }


def people_by_centre(
    labelled: LabelledSet, found: FoundSet, classes: tuple[str, ...]
) -> dict[str, float | int] | None:
    """How many people are found if a reported box's centre within the label is enough, for sets with loose boxes.

    At the model's own threshold; None where no person is labelled. `found` and `right` are shares of the labels and of
    the reported boxes; boxes whose centre lies in a region to ignore are left out.
    """
    own, person = labelled.classes.index("person"), classes.index("person")
    labels = hits = boxes = right = 0
    for picture, seen in zip(labelled.pictures, found.detections):
        people = picture.boxes_px[picture.labels == own]
        is_reported = (seen.labels == person) & (seen.scores >= found.thresholds["person"])
        centres = (seen.boxes_px[is_reported][:, :2] + seen.boxes_px[is_reported][:, 2:]) / 2
        inside, ignored = _holds(people, centres), _holds(picture.ignored_px, centres)
        labels, hits = labels + len(people), hits + int(inside.any(axis=1).sum())
        counts = inside.any(axis=0) | ~ignored.any(axis=0)
        boxes, right = boxes + int(counts.sum()), right + int(inside.any(axis=0).sum())
    if not labels:
        return None
    return {
        "labels": labels,
        "reported": boxes,
        "found": hits / labels,
        "right": right / max(boxes, 1),
    }


def people_from(
    least_px: float, labelled: LabelledSet, found: FoundSet, classes: tuple[str, ...]
) -> dict[str, object] | None:
    """AP50 and what is reported of people whose longer side has `least_px` or more, smaller ones being ignored.

    None where no person is that large.
    """
    own = labelled.classes.index("person")
    pictures = []
    for each in labelled.pictures:
        sides = np.max(each.boxes_px[:, 2:] - each.boxes_px[:, :2], axis=1, initial=0)
        small = (each.labels == own) & (sides < least_px)
        pictures.append(
            replace(
                each,
                boxes_px=each.boxes_px[~small],
                labels=each.labels[~small],
                ignored_px=np.vstack([each.ignored_px, each.boxes_px[small]]),
            )
        )
    scores = score_set(labelled.only(pictures), found.detections, classes, found.thresholds)
    rows = [row for row in scores.classes if row.label == "person" and row.labels]
    return (
        {
            "labels": rows[0].labels,
            "AP50": asdict(scores.intervals["AP50 person"]),
            "reported": asdict(rows[0].reported),
        }
        if rows
        else None
    )


def _holds(boxes_px: np.ndarray, points_px: np.ndarray) -> np.ndarray:
    """(boxes, points) whether each box, left, top, right, bottom, holds each point."""
    low, high = boxes_px[:, None, :2], boxes_px[:, None, 2:]
    return ((points_px >= low) & (points_px <= high)).all(axis=2)


if __name__ == "__main__":
    main()
