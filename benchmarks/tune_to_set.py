"""The packaged model's weights tuned to one set's own training videos, measured on its held-out ones.

python benchmarks/tune_to_set.py cats WEIGHTS DATA [--steps 800] writes results/tuned_cats.json, and the tuned weights
beside WEIGHTS. With --on val it measures the validation part, by which settings are chosen, and writes nothing. A set
without a training part (sdd) is learnt scene by scene: each scene is measured by a model that saw the others alone. The
models are not shipped (cats and sdd are for research only).
"""

import argparse
import json
from collections.abc import Mapping
from dataclasses import asdict
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch

import detection_data
from detector_accuracy import people_by_centre
from mosaic_methods import commit, machine
from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.session import Seen
from sorvolo.detection.suppression import SeenTile, merge_tiles
from sorvolo.detection.tiling import plan_tiles
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.evaluation.detection_scores import score_set
from sorvolo.lab.training.drawing import batches_from
from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.lab.training.joint import JointSettings, JointTraining
from sorvolo.lab.training.presets import fast
from sorvolo.lab.training.samples import Augmentation, Share
from sorvolo.lab.training.seeing import see
from sorvolo.store.exports.detector_files import FoundSet
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES, Detections
from train_default_model import reader


def main() -> None:
    """Tune, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", help="of the set: cats, aerial_cars, tinyperson, hituav, sdd")
    parser.add_argument("weights", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--side", type=int, default=384)
    parser.add_argument("--scale", type=float, nargs=2, default=(0.6, 1.5))
    parser.add_argument(
        "--look",
        type=float,
        default=1.0,
        help="the measured pictures are shown so many times larger",
    )
    parser.add_argument(
        "--tiles", type=int, help="cut into tiles of so many of the picture's pixels; else whole"
    )
    parser.add_argument(
        "--on", choices=("val", "test"), default="test", help="which part is measured"
    )
    parser.add_argument(
        "--tuned", type=Path, help="weights that an earlier run tuned: only measure"
    )
    parser.add_argument(
        "--results", type=Path, help="the file that is written; else results/tuned_NAME.json"
    )
    parser.add_argument("--seed", type=int, default=1)
    wishes = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    parts = getattr(detection_data, wishes.name)(wishes.data)
    whole = parts.get("train", parts["test"])
    labels = {each.labels[k] for each in whole.pictures for k in range(len(each.labels))}
    unlabelled = frozenset(name for index, name in enumerate(CLASSES) if index not in labels)
    pictures: list[LabelledPicture] = []
    found: list[Detections] = []
    learnt_from = 0
    for learnt, measured in folds(parts, wishes.on):
        model = tuned(LabelledSet(wishes.name, CLASSES, learnt, unlabelled), wishes)
        pictures += measured
        found += [
            looked(model, reader()(each.path), wishes.look, wishes.tiles) for each in measured
        ]
        learnt_from += len(learnt)
    held_out = LabelledSet(wishes.name, CLASSES, tuple(pictures), unlabelled)
    thresholds = dict.fromkeys(CLASSES, 0.5)
    scores = score_set(held_out, found, CLASSES, thresholds)
    centres = people_by_centre(held_out, FoundSet((), tuple(found), thresholds), CLASSES)
    document = {
        "benchmark": "tune_to_set",
        "set": wishes.name,
        "machine": machine(),
        "commit": commit(),
        "seed": wishes.seed,
        "steps": wishes.steps,
        "scale": wishes.scale,
        "look": wishes.look,
        "tiles": wishes.tiles,
        "pictures": len(held_out),
        "learnt_from": learnt_from,
        "labels": {each.label: each.labels for each in scores.classes},
        "intervals": {name: asdict(each) for name, each in scores.intervals.items()},
        "people_by_centre": centres,
    }
    if wishes.on == "test":
        out = wishes.results or Path(__file__).parent / "results" / f"tuned_{wishes.name}.json"
        out.write_text(json.dumps(document, indent=1) + "\n")
    print(
        json.dumps({name: document[name] for name in ("look", "labels", "people_by_centre")}),
        flush=True,
    )
    print(
        json.dumps(
            {name: each for name, each in document["intervals"].items() if name.startswith("AP")}
        ),
        flush=True,
    )


def folds(
    parts: Mapping[str, LabelledSet], on: str
) -> list[tuple[tuple[LabelledPicture, ...], tuple[LabelledPicture, ...]]]:
    """What is learnt from and what is measured: the set's own parts, or each scene against all others."""
    if "train" in parts:
        return [(parts["train"].pictures, parts[on].pictures)]
    every = parts["test"].pictures
    return [
        (
            tuple(each for each in every if each.group != scene),
            tuple(each for each in every if each.group == scene),
        )
        for scene in sorted({each.group for each in every})
    ]


def tuned(learnt: LabelledSet, wishes: argparse.Namespace) -> FasterRCNN:
    """The model after learning on."""
    model = fast(CLASSES)
    if wishes.tuned is not None:
        model.load_state_dict(torch.load(wishes.tuned, weights_only=True))
        return model
    model.load_state_dict(torch.load(wishes.weights, weights_only=True))
    settings = JointSettings(
        steps=wishes.steps, rate=5e-4, backbone_rate=1e-4, averaging=0.99, warm_steps=50
    )
    training = JointTraining(model.to(memory_format=torch.channels_last), settings, wishes.seed)
    aslant = wishes.name in ("hituav", "tinyperson", "sdd")
    share = Share(learnt, 1.0, tuple(wishes.scale), thermal=wishes.name == "hituav", aslant=aslant)
    crops = Augmentation(side_px=wishes.side)
    drawn = batches_from([share], CLASSES, reader(), crops, seed=wishes.seed, batch=settings.batch)
    for done in (training.learn(each) for each in islice(drawn, wishes.steps)):
        if done.step % 50 == 0:
            print(done.step, round(done.loss, 3), flush=True)
    torch.save(training.average.state_dict(), wishes.weights.with_name(f"tuned_{wishes.name}.pt"))
    return training.average


def looked(model: FasterRCNN, picture: ImageRGB, look: float, tiles: int | None) -> Detections:
    """What the network finds in a picture (H, W, 3) shown `look` times larger; boxes in the picture's pixels."""
    info = ModelInfo(
        "tuned", CLASSES, dict.fromkeys(CLASSES, 0.5), {name: (10.0, 40.0) for name in CLASSES}
    )
    plan = plan_tiles(picture.shape[:2], info, CLASSES, tiles=tiles)
    seen = []
    for place in plan.places_px:
        left, top, right, bottom = place
        part = picture[top:bottom, left:right]
        shown = np.asarray(
            cv2.resize(part, None, fx=look, fy=look, interpolation=cv2.INTER_CUBIC), np.uint8
        )
        found = see(model, CLASSES, part if look == 1 else shown)
        boxes = found.boxes_px / np.float32(look) + np.array([left, top, left, top], np.float32)
        seen.append(SeenTile(place, Seen(boxes, found.scores, found.labels)))
    merged = seen[0].seen if len(seen) == 1 else merge_tiles(seen, picture.shape[:2])
    return Detections(merged.boxes_px, merged.scores, merged.labels, CLASSES)


if __name__ == "__main__":
    main()
