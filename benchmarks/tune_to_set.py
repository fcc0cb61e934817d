"""The packaged model's weights tuned to one set's own training videos, measured on its held-out ones.

python benchmarks/tune_to_set.py cats WEIGHTS DATA [--steps 800] writes results/tuned_cats.json, and the tuned weights
beside WEIGHTS. The model is not shipped (cats is for research only).
"""

import argparse
import json
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch

import detection_data
from mosaic_methods import commit, machine
from sorvolo.detection.scores import score_set
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import CLASSES, Detections
from sorvolo.training.drawing import batches_from
from sorvolo.training.faster_rcnn import FasterRCNN
from sorvolo.training.joint import JointSettings, JointTraining
from sorvolo.training.presets import fast
from sorvolo.training.samples import Augmentation, Share
from sorvolo.training.seeing import see
from train_default_model import reader


def main() -> None:
    """Tune, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", help="of the set: cats, aerial_cars, tinyperson, hituav")
    parser.add_argument("weights", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--side", type=int, default=384)
    parser.add_argument("--scale", type=float, nargs=2, default=(0.6, 1.5))
    parser.add_argument("--look", type=float, default=1.0, help="the measured pictures are shown so many times larger")
    parser.add_argument("--seed", type=int, default=1)
    wishes = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    parts = getattr(detection_data, wishes.name)(wishes.data)
    labels = {each.labels[k] for each in parts["train"].pictures for k in range(len(each.labels))}
    unlabelled = frozenset(name for index, name in enumerate(CLASSES) if index not in labels)
    learnt = LabelledSet(wishes.name, CLASSES, parts["train"].pictures, unlabelled)
    held_out = LabelledSet(wishes.name, CLASSES, parts["test"].pictures, unlabelled)
    model = fast(CLASSES)
    model.load_state_dict(torch.load(wishes.weights, weights_only=True))
    settings = JointSettings(steps=wishes.steps, rate=5e-4, backbone_rate=1e-4, averaging=0.99, warm_steps=50)
    training = JointTraining(model.to(memory_format=torch.channels_last), settings, wishes.seed)
    aslant = wishes.name in ("hituav", "tinyperson")
    share = Share(learnt, 1.0, tuple(wishes.scale), thermal=wishes.name == "hituav", aslant=aslant)
    crops = Augmentation(side_px=wishes.side)
    drawn = batches_from([share], CLASSES, reader(), crops, seed=wishes.seed, batch=settings.batch)
    for done in (training.learn(each) for each in islice(drawn, wishes.steps)):
        if done.step % 50 == 0:
            print(done.step, round(done.loss, 3), flush=True)
    torch.save(training.average.state_dict(), wishes.weights.with_name(f"tuned_{wishes.name}.pt"))
    read = reader()
    found = [looked(training.average, read(each.path), wishes.look) for each in held_out.pictures]
    scores = score_set(held_out, found, CLASSES, dict.fromkeys(CLASSES, 0.5))
    document = {
        "benchmark": "tune_to_set", "set": wishes.name, "machine": machine(), "commit": commit(), "seed": wishes.seed,
        "steps": wishes.steps, "scale": wishes.scale, "look": wishes.look,
        "pictures": len(held_out), "learnt_from": len(learnt),
        "intervals": {name: asdict(each) for name, each in scores.intervals.items()},
    }
    out = Path(__file__).parent / "results" / f"tuned_{wishes.name}.json"
    out.write_text(json.dumps(document, indent=1) + "\n")
    print(document["intervals"], flush=True)


def looked(model: FasterRCNN, picture: ImageRGB, look: float) -> Detections:
    """What the network finds in a picture (H, W, 3) shown `look` times larger; boxes in the picture's pixels."""
    shown = np.asarray(cv2.resize(picture, None, fx=look, fy=look, interpolation=cv2.INTER_CUBIC), np.uint8)
    found = see(model, CLASSES, picture if look == 1 else shown)
    return replace(found, boxes_px=found.boxes_px / np.float32(look))


if __name__ == "__main__":
    main()
