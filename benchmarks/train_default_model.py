"""Train the default model: python benchmarks/train_default_model.py DATA OUT --weights LITE0 (`make model`).

With --start MODEL instead of --weights it learns on from an exported model, such as the packaged one. With --thermal
it learns thermal frames alone, all layers of it: the packaged model `thermal`, which starts from `default`.

DATA is a folder with the labelled sets that detection_data.py names and two flights of photos as ground for composed
small objects; simulated pictures are made first. Held-out parts are never read here. A run that was stopped goes on
from its last checkpoint.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from functools import lru_cache
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch

from detection_data import SMALL, aerial_cars, hituav, in_order, mannequin, tinyperson
from sorvolo.detection.models import find_model
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.missions.simulate.pictures import simulate_pictures
from sorvolo.simulation.pictures import PictureSettings
from sorvolo.store.datasets import read_dataset
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES
from sorvolo.training.drawing import batches_from
from sorvolo.training.exported import load_exported
from sorvolo.training.joint import JointSettings, JointTraining, collate
from sorvolo.training.presets import fast
from sorvolo.training.samples import Augmentation, Sample, Share
from sorvolo.training.weights import read_weights

SIMULATED_SEED, SIMULATED_PICTURES = 1, 1800
SIMULATED = "boxes.json"
STEEP_DEG = 75.0  # from so many degrees below the horizon a picture has no up and down
SETTLING = 12  # batches by which the norms of a started model are settled


def main() -> None:
    """Train and leave weights and the log in OUT."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    start = parser.add_mutually_exclusive_group(required=True)
    start.add_argument("--weights", type=Path, help="EfficientNet-Lite0's published weights")
    start.add_argument("--start", help="an installed model's name or a model file to learn on from")
    parser.add_argument("--thermal", action="store_true", help="the thermal model: learns thermal frames alone")
    parser.add_argument("--simulated", type=Path, help="folder of simulated pictures, made once; else OUT/simulated")
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--side", type=int, default=384)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    wishes = parser.parse_args()
    torch.set_num_threads(wishes.threads)
    torch.set_flush_denormal(True)
    torch.manual_seed(wishes.seed)
    wishes.out.mkdir(parents=True, exist_ok=True)

    simulated = wishes.simulated or wishes.out / "simulated"
    shares = (thermal_shares if wishes.thermal else training_shares)(wishes.data, simulated)
    for share in shares:
        boxes = sum(len(each.labels) for each in share.labelled.pictures)
        name, pictures = share.labelled.name, len(share.labelled)
        print(f"{name}: {pictures} pictures, {boxes} boxes, weight {share.weight}", flush=True)
    def stream(start: int, seed: int) -> Iterator[list[Sample]]:
        crops = Augmentation(side_px=wishes.side, blur=0.12, tone=0.5 if wishes.thermal else 0.0)
        return batches_from(shares, CLASSES, reader(), crops, seed=seed, batch=wishes.batch, start=start)

    model = fast(CLASSES, thaw_all=wishes.thermal)
    rate = JointSettings.rate
    if wishes.weights is not None:
        model.backbone.load_imagenet(read_weights(wishes.weights).layers)
    else:
        first = [each for batch in islice(stream(0, wishes.seed + 1), SETTLING) for each in batch]
        load_exported(model, find_model(wishes.start).read_bytes(), collate(first, "cpu")[0])
        rate *= 0.5 if wishes.thermal else 0.7
    model = model.to(memory_format=torch.channels_last)
    settings = JointSettings(
        steps=wishes.steps, batch=wishes.batch, rate=rate, backbone_rate=0.3 * rate,
        regions=192 if wishes.thermal else JointSettings.regions,
    )
    training = JointTraining(model, settings, wishes.seed, wishes.device)
    checkpoint = wishes.out / "checkpoint.pt"
    if checkpoint.is_file():
        training.load_state(torch.load(checkpoint, weights_only=True))
        print(f"going on from step {training.step}", flush=True)
    drawn = stream(training.step, wishes.seed)
    recent: list[list[float]] = []
    started_s = time.monotonic()
    with (wishes.out / "log.jsonl").open("a") as log:
        while training.step < wishes.steps:
            done = training.learn(next(drawn))
            recent.append([done.proposal_score, done.proposal_box, done.region_score, done.region_box])
            if done.step % 50 == 0:
                means = [round(float(each), 4) for each in np.mean(recent, axis=0)]
                recent = []
                row = {"step": done.step, "losses": means, "seconds": round(time.monotonic() - started_s, 1)}
                log.write(json.dumps(row) + "\n")
                log.flush()
                print(row, flush=True)
            if done.step % 250 == 0 or done.step == wishes.steps:
                partial = checkpoint.with_suffix(".partial")
                torch.save(training.state(), partial)
                partial.replace(checkpoint)
                torch.save(training.average.state_dict(), wishes.out / "weights.pt")


def training_shares(data: Path, simulated: Path) -> list[Share]:
    """What is learnt from, and how often each."""
    made = _made(simulated)
    return [
        *frames_of_heat(data),
        Share(tinyperson(data)["train"], 1.8, (1.0, 2.8), pastes=SMALL, aslant=True),
        Share(mannequin(data)["train"], 0.2, (0.3, 1.2), pastes=SMALL),
        Share(aerial_cars(data)["train"], 1.4, (0.25, 1.2), pastes=SMALL),
        Share(made, 3.0, (0.6, 1.6)),
        Share(_ground(data), 0.4, (0.12, 0.5), pastes=SMALL),
    ]


def thermal_shares(data: Path, simulated: Path) -> list[Share]:
    """What the thermal model learns from; simulated frames show what HIT-UAV does not: other poses, small things."""
    made = _made(simulated)
    is_thermal = {row["file_name"]: row["thermal"] for row in json.loads((simulated / SIMULATED).read_text())["images"]}
    heat = made.only([each for each in made.pictures if is_thermal[f"images/{Path(each.path).name}"]])
    return [*frames_of_heat(data), Share(heat, 0.6, (0.8, 1.8))]


def frames_of_heat(data: Path) -> list[Share]:
    """HIT-UAV's frames: those from aslant have an up and a down."""
    thermal = hituav(data)["train"]
    return [
        Share(_from(thermal, lambda angle_deg: angle_deg < STEEP_DEG), 3.2, (1.0, 2.3), thermal=True, aslant=True),
        Share(_from(thermal, lambda angle_deg: angle_deg >= STEEP_DEG), 1.4, (1.0, 2.3), thermal=True),
    ]


def _made(simulated: Path) -> LabelledSet:
    """The simulated pictures, made at the first time."""
    if not (simulated / SIMULATED).is_file():
        settings = PictureSettings(pictures=SIMULATED_PICTURES, seed=SIMULATED_SEED, thermal_share=0.2)
        for _ in simulate_pictures(simulated, settings):
            pass
    return in_order(read_dataset(simulated))


def _from(labelled: LabelledSet, fits: Callable[[float], bool]) -> LabelledSet:
    """HIT-UAV's frames taken at angles below the horizon that `fits`; their names give them, night_height_angle_."""
    return labelled.only([each for each in labelled.pictures if fits(float(Path(each.path).stem.split("_")[2]))])


def _ground(data: Path) -> LabelledSet:
    """Photos without labels as ground for small objects: whether people or cars are in them is not known."""
    pictures = []
    folder = data.parent / "flights"
    paths = sorted([*folder.glob("brighton_beach/**/*.JPG"), *folder.glob("caliterra/**/*.[jJ][pP]*")])
    for path in paths:
        height, width = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_REDUCED_COLOR_8).shape[:2]
        none = np.zeros((0, 4), np.float32)
        pictures.append(LabelledPicture(str(path), width * 8, height * 8, path.parent.name, none, np.zeros(0), none))
    return LabelledSet("ground", CLASSES, tuple(pictures), frozenset(CLASSES[:2]))


def reader() -> Callable[[str], ImageRGB]:
    """Reads pictures, keeping their files' bytes."""
    @lru_cache(maxsize=4000)
    def content(path: str) -> bytes:
        return Path(path).read_bytes()

    def read(path: str) -> ImageRGB:
        picture = cv2.imdecode(np.frombuffer(content(path), np.uint8), cv2.IMREAD_COLOR)
        return np.asarray(picture[..., ::-1], np.uint8)

    return read


if __name__ == "__main__":
    main()
