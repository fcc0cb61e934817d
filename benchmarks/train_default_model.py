"""Train an aerial network: benchmarks/train_default_model.py DATA OUT --weights LITE0 (`make model`).

DATA is a folder with the labelled sets that detection_data.py names and two flights of photos as ground for composed
small objects; simulated pictures are made first. Held-out parts are never read here. Or it is the one file that
pack_training_data.py made of all that (`make training-data`): no other file and no network is needed then, not even
for the weights to start from (`make long-training PRESET=accurate`).

With --start MODEL instead of --weights it learns on from an exported model, such as the packaged one. With --thermal
it learns thermal frames alone, all layers of it: the packaged model `thermal`, which starts from `default`.

OUT gets checkpoint.pt, from which the same command goes on after a stop or a kill, weights.pt, run.json, which states
what they are of, and log.jsonl. pack_default_model.py makes a model file of them.
"""

import argparse
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch

from sorvolo.errors import InputError, SorvoloError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.training.checkpoint import checkpoint_bytes, read_checkpoint, restore
from sorvolo.lab.training.drawing import batches_from
from sorvolo.lab.training.exported import load_exported
from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.lab.training.joint import JointSettings, JointTraining, Progress, collate
from sorvolo.lab.training.losses import LossRow
from sorvolo.lab.training.presets import NETS, accurate, build, fast
from sorvolo.lab.training.progress import History
from sorvolo.lab.training.samples import Augmentation, Sample, Share
from sorvolo.lab.training.starting import device_of
from sorvolo.lab.training.weights import ImageNetWeights, read_weights
from sorvolo.store.atomic import atomic_write_bytes, remove_leftovers
from sorvolo.survey.objects import CLASSES
from training_archive import TrainingArchive, fingerprint

SETTLING = 12  # batches by which the norms of a started model are settled
CHECKPOINT, WEIGHTS, RUN, LOG = "checkpoint.pt", "weights.pt", "run.json", "log.jsonl"
LOGGED_STEPS = 50
MOST_READERS = 8  # threads that cut samples


@dataclass(frozen=True)
class Pace:
    """How long and how fast a preset learns by default."""

    steps: int
    batch: int  # crops a step
    side_px: int  # of the square crops
    rate: float  # of AdamW at its height
    backbone_share: float  # of that rate, for what ImageNet taught


PACES: dict[Literal["fast", "accurate"], Pace] = {
    "fast": Pace(6000, 4, 384, 1e-3, 0.3),
    "accurate": Pace(
        20_000, 16, 416, 2e-4, 0.2
    ),  # rates of `sorvolo train`; steps and batch by choice, not yet run
}


def main() -> None:
    """Train as the command line asks; what cannot be used ends it with one line."""
    try:
        train(arguments())
    except SorvoloError as error:
        raise SystemExit(f"error: {error}") from None


def train(wishes: argparse.Namespace) -> None:
    """Train and leave checkpoint, weights and the log in OUT. Raises InputError and SettingsError as its parts do."""
    torch.set_num_threads(wishes.threads)
    torch.set_flush_denormal(True)
    torch.manual_seed(wishes.seed)
    wishes.out.mkdir(parents=True, exist_ok=True)
    archive = TrainingArchive(wishes.data) if wishes.data.is_file() else None
    shares = shares_in(wishes) if archive is None else archive.shares
    for line in described(shares):
        print(line, flush=True)
    read = reader() if archive is None else reader(archive.content)
    crops = Augmentation(side_px=wishes.side, blur=0.12, tone=0.5 if wishes.thermal else 0.0)
    threads = max(1, min(MOST_READERS, (os.cpu_count() or 1) - 1))

    def stream(start: int, seed: int = wishes.seed) -> Iterator[list[Sample]]:
        return batches_from(
            shares,
            CLASSES,
            read,
            crops,
            seed=seed,
            batch=wishes.batch,
            start=start,
            threads=threads,
        )

    weights = imagenet_weights(wishes, archive)
    pace, rate = PACES[wishes.preset], PACES[wishes.preset].rate
    if wishes.start is None:
        model, begun = (
            started(wishes.preset, weights, thermal=wishes.thermal),
            weights.origin if weights else "nothing",
        )
    else:
        model, begun = (
            learnt_on(wishes.start, stream(0, wishes.seed + 1), thermal=wishes.thermal),
            wishes.start,
        )
        rate *= 0.5 if wishes.thermal else 0.7
    settings = JointSettings(
        steps=wishes.steps,
        batch=wishes.batch,
        rate=rate,
        backbone_rate=pace.backbone_share * rate,
        regions=192 if wishes.thermal else JointSettings.regions,
    )
    model = model.to(memory_format=torch.channels_last)
    training = JointTraining(model, settings, wishes.seed, device_of(wishes.device))
    run = {
        "preset": wishes.preset,
        "begun": begun,
        "original": weights is not None and weights.original,
        "frozen": weights is not None,
        "thermal": wishes.thermal,
        "steps": wishes.steps,
        "batch": wishes.batch,
        "side_px": wishes.side,
        "seed": wishes.seed,
        "data": fingerprint(shares),
    }
    print(f"{wishes.preset} from {begun}, on {training.device}", flush=True)
    for _ in learn(training, stream, wishes.out, run, save_s=wishes.save_s):
        pass
    print(f"{wishes.out / WEIGHTS} is ready, step {training.step} of {wishes.steps}", flush=True)


def arguments() -> argparse.Namespace:
    """What the command line asks for, what the preset leaves open filled in. Raises InputError without data."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "data", type=Path, help="the folder of labelled sets, or the file of pack_training_data.py"
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--preset", choices=PACES, default="fast")
    start = parser.add_mutually_exclusive_group()
    start.add_argument(
        "--weights", help="the backbone's ImageNet weights, or none; else those in the file DATA"
    )
    start.add_argument(
        "--start", help="an installed model's name or a model file to learn on from (fast alone)"
    )
    parser.add_argument(
        "--thermal", action="store_true", help="the thermal model: learns thermal frames alone"
    )
    parser.add_argument(
        "--simulated", type=Path, help="folder of simulated pictures, made once; else OUT/simulated"
    )
    parser.add_argument("--steps", type=int)
    parser.add_argument("--batch", type=int)
    parser.add_argument("--side", type=int, help="of the crops, px")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument(
        "--device", default="auto", help="auto (a GPU where torch sees one), cpu or cuda"
    )
    parser.add_argument(
        "--save-s", type=float, default=60.0, help="seconds between checkpoints: what a kill costs"
    )
    wishes = parser.parse_args()
    if not wishes.data.exists():
        raise InputError(
            f"there is no file {wishes.data}; make it by `make training-data DATA=FOLDER` and copy it here, or give "
            "the folder of the labelled sets"
        )
    if not wishes.data.is_file() and wishes.weights is None and wishes.start is None:
        parser.error("a folder has no weights to start from; give --weights or --start")
    if wishes.data.is_file() and wishes.thermal:
        parser.error("--thermal learns from a folder; the file is of the daylight recipe")
    if wishes.preset != "fast" and (wishes.thermal or wishes.start):
        parser.error(
            "--thermal and --start are of the preset fast: no model file of another can be learnt on from"
        )
    pace = PACES[wishes.preset]
    for name, usual in (("steps", pace.steps), ("batch", pace.batch), ("side", pace.side_px)):
        if getattr(wishes, name) is None:
            setattr(wishes, name, usual)
    return wishes


def shares_in(wishes: argparse.Namespace) -> list[Share]:
    """What is learnt from, out of the folder of labelled sets."""
    # imported only here: a machine that learns from an archive need not have what reads labels and draws pictures
    from training_shares import thermal_shares, training_shares

    simulated = wishes.simulated or wishes.out / "simulated"
    return (thermal_shares if wishes.thermal else training_shares)(wishes.data, simulated)


def imagenet_weights(
    wishes: argparse.Namespace, archive: TrainingArchive | None
) -> ImageNetWeights | None:
    """Those asked for, else the archive's; None where nothing or a model is where the training starts.

    Raises InputError for weights of another network than the preset's.
    """
    net = NETS[wishes.preset]
    if wishes.start is not None or wishes.weights == "none":
        return None
    if wishes.weights is None:
        assert archive is not None
        return archive.weights(net)
    weights = read_weights(Path(wishes.weights))
    if weights.net != net:
        raise InputError(
            f"{wishes.weights} holds weights of {weights.net}; preset {wishes.preset} starts from {net}"
        )
    return replace(weights, origin=f"ImageNet, {Path(wishes.weights).name}")


def started(
    preset: Literal["fast", "accurate"], weights: ImageNetWeights | None, *, thermal: bool = False
) -> FasterRCNN:
    """The preset's network before its first step."""
    if not (thermal and weights):
        return build(preset, CLASSES, "extended-residual", weights)
    model = fast(CLASSES, thaw_all=True)
    model.backbone.load_imagenet(weights.layers)
    return model


def learnt_on(start: str, batches: Iterator[list[Sample]], *, thermal: bool) -> FasterRCNN:
    """The network with an exported model's weights, its norms settled by the first batches."""
    from sorvolo.detection.models import find_model

    model = fast(CLASSES, thaw_all=thermal)
    first = [each for batch in islice(batches, SETTLING) for each in batch]
    load_exported(model, find_model(start).read_bytes(), collate(first, "cpu")[0])
    return model


def network_of(run: Mapping[str, Any]) -> FasterRCNN:
    """The network that WEIGHTS of a run are of, by its run.json, as chance has it."""
    if run["preset"] == "fast":
        return fast(CLASSES)
    return accurate(CLASSES, original=run["original"], frozen=run["frozen"])


def learn(
    training: JointTraining,
    stream: Callable[[int], Iterator[list[Sample]]],
    out: Path,
    run: Mapping[str, Any],
    *,
    save_s: float,
) -> Iterator[Progress]:
    """From OUT's checkpoint, or from the beginning, to the last step, with a checkpoint every `save_s` seconds.

    `stream` gives the batches from a step on. Raises SettingsError where the checkpoint is of another `run`, and
    RuntimeError where a loss is no number: the checkpoint is from before then.
    """
    remove_leftovers([out])
    history = History()
    if (out / CHECKPOINT).is_file():
        checkpoint = read_checkpoint((out / CHECKPOINT).read_bytes(), str(out / CHECKPOINT))
        restore(training, checkpoint, run)
        history = checkpoint.history
        print(f"going on from step {training.step}", flush=True)
    (out / LOG).write_text(
        "".join(logged(row) for row in history.rows)
    )  # rows that the kill undid are made again
    batches = stream(training.step)
    before_s, saved_s = history.seconds, time.monotonic()
    started_s = saved_s
    while training.step < training.settings.steps:
        done = training.learn(next(batches))
        if not math.isfinite(done.loss):
            raise RuntimeError(f"the loss of step {done.step} is no number")
        rows, now_s = len(history.rows), time.monotonic()
        history = history.after(done, before_s + now_s - started_s, every=LOGGED_STEPS)
        for row in history.rows[rows:]:
            print(logged(row), end="", flush=True)
            with (out / LOG).open("a") as log:
                log.write(logged(row))
        if now_s - saved_s >= save_s or done.step == done.steps:
            save(training, out, run, history)
            saved_s = time.monotonic()
        yield done


def save(training: JointTraining, out: Path, run: Mapping[str, Any], history: History) -> None:
    """Write checkpoint, the averaged weights (for any machine) and what they are of, each whole or not at all."""
    atomic_write_bytes(out / CHECKPOINT, checkpoint_bytes(training, run, history))
    weights = BytesIO()
    torch.save({name: each.cpu() for name, each in training.average.state_dict().items()}, weights)
    atomic_write_bytes(out / WEIGHTS, weights.getvalue())
    atomic_write_bytes(
        out / RUN, (json.dumps({**run, "step": training.step}, indent=1) + "\n").encode()
    )


def logged(row: LossRow) -> str:
    """A line of the log: the mean losses since the row before, the seconds of all runs so far."""
    losses = (row.proposal_score, row.proposal_box, row.region_score, row.region_box)
    plain = {
        "step": row.step,
        "losses": [round(each, 4) for each in losses],
        "seconds": round(row.seconds, 1),
    }
    return json.dumps(plain) + "\n"


def described(shares: Sequence[Share]) -> Iterator[str]:
    """A line for each: what it is, and how often it is drawn from."""
    for share in shares:
        boxes = sum(len(each.labels) for each in share.labelled.pictures)
        yield f"{share.labelled.name}: {len(share.labelled)} pictures, {boxes} boxes, weight {share.weight}"


def reader(
    content: Callable[[str], bytes] = lambda path: Path(path).read_bytes(),
) -> Callable[[str], ImageRGB]:
    """Reads pictures by their paths, keeping their files' bytes, which `content` gives."""
    kept = lru_cache(maxsize=4000)(content)

    def read(path: str) -> ImageRGB:
        picture = cv2.imdecode(np.frombuffer(kept(path), np.uint8), cv2.IMREAD_COLOR)
        return np.asarray(picture[..., ::-1], np.uint8)

    return read


if __name__ == "__main__":
    main()
