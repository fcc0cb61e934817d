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
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np

import detection_data
from provenance import commit, machine, note_scoring
from sorvolo.detection.detector import Detector
from sorvolo.geometry.box_overlap import iou_matrix
from sorvolo.lab.datasets import read_dataset
from sorvolo.lab.evaluation.detector import (
    EvaluationSettings,
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
from sorvolo.store.images import image_from_jpeg, jpeg_from_image
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES
from sorvolo.tracking.sizes import TOO_SHORT_CUT_PX, cut_edges, impossible_size

RESULTS = Path(__file__).parent / "results" / "detector_accuracy.json"
REAL = ("hituav", "tinyperson", "aerial_cars", "cats", "sdd", "semantic_drone")
FIRST_SEED = 301
FLIGHTS, FRAMES_OF_ONE, PICTURES = (
    ("compare", "compare-urban", "compare-dirt", "survey", "survey-urban"),
    8,
    120,
)
FLIGHTS_SEEN = {
    "brighton_beach": ("", 0.034),
    "caliterra": ("IMG_9400.jpg", 0.07),
}  # first photo, half size
SAME_IOU = 0.3
TARGETS = {"people": 16, "cars": 8, "small_objects": 16}


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", help="a model's name or file")
    parser.add_argument("--data", type=Path, help="folder of the data sets")
    parser.add_argument("--flights", type=Path, help="folder of the flights for false alarms")
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
        f"{' false alarms' * bool(options.flights)}"
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
                    "flights": flight_alarms(options.model, options.flights)
                    if options.flights
                    else None,
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


def flight_alarms(model: str, flights: Path) -> dict[str, object]:
    """What a model reports of photos of real flights that hardly show anyone, a photo, and how much of it is wrong.

    Photos are shown at half size and at the scale of their ground (FLIGHTS_SEEN, roughly known), as in a map, and boxes of
    a size on the ground that their class cannot have do not count. The truth is what a person drew on crops.
    """
    detector = Detector.load(model, provider="cpu", threads=1)
    here = Path(__file__).parent
    people, cars = (
        json.loads((here / name).read_text())
        for name in ("brighton_people.json", "flight_cars.json")
    )
    rows = {}
    for flight, (first, m_per_px) in FLIGHTS_SEEN.items():
        counts: Counter[str] = Counter()
        paths = [path for path in sorted((flights / flight).iterdir()) if path.name >= first]
        paths = [path for path in paths if path.suffix.lower() == ".jpg"]
        for path in paths:
            whole = image_from_jpeg(path.read_bytes(), path.name)
            size_px = whole.shape[1] // 2, whole.shape[0] // 2
            shown = np.asarray(cv2.resize(whole, size_px, interpolation=cv2.INTER_AREA), np.uint8)
            seen = detector.detect(
                shown, tiles="auto", m_per_px=m_per_px, classes=("person", "car"), from_above=True
            )
            sides_m = (seen.boxes_px[:, 2:] - seen.boxes_px[:, :2]).astype(float) * m_per_px
            cut = cut_edges(seen.boxes_px, *size_px, TOO_SHORT_CUT_PX)
            seen = seen.only(~impossible_size(seen.names, sides_m, cut))
            drawn = (
                people["people"].get(path.stem, []),
                cars["cars"].get(f"{flight}/{path.stem}", []),
            )
            true = dict(zip(("person", "car"), drawn))
            crowd = np.array(people["around"].get(path.stem, []), float).reshape(-1, 4)
            for name, box in zip(seen.names, 2.0 * seen.boxes_px):
                known = np.array(true[name], float).reshape(-1, 4)
                is_right = (iou_matrix(box[None], known) >= SAME_IOU).any()
                middle = np.tile((box[:2] + box[2:]) / 2, 2)
                inside = ((crowd - middle) * [1, 1, -1, -1] <= 0).all(axis=1).any()
                if is_right or name != "person" or not inside:
                    counts[f"{name} {'right' if is_right else 'false'}"] += 1
        rows[flight] = {"photos": len(paths)} | {
            name: {
                "right": counts[f"{name} right"],
                "false": counts[f"{name} false"],
                "false_a_photo": counts[f"{name} false"] / len(paths),
            }
            for name in ("person", "car")
        }
    return rows


if __name__ == "__main__":
    main()
