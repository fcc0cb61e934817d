"""How the single-stage network learns: which cells stand for a thing, what is minimised, and step after step."""

import math
import time
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.rnn import pad_sequence

from sorvolo.lab.training.boxes import area, common
from sorvolo.lab.training.progress import Progress
from sorvolo.lab.training.samples import TrainingSample
from sorvolo.lab.training.single_stage import (
    BINS,
    STRIDES,
    SingleStage,
    boxes_from_bins,
    cells,
)

_ANCHOR_STRIDES = 5.0  # side of the square by which a cell is compared with a thing (ATSS)
_BOX_WEIGHT, _EDGE_WEIGHT = 2.0, 0.25  # NanoDet's own

_TUNED_RATE, _FIRST_RATE = (
    6e-4,
    1e-3,
)  # of AdamW at its height: for a model that knows much, and from nothing
_BACKBONE_SHARE = 0.4  # of that rate, for a model that knows much
_WARM_STEPS = 150  # over which the rate rises, a tenth of all steps at most
_LEAST_RATE = 0.02  # share of the rate in the end
_DECAY, _MOST_GRADIENT = 0.02, 10.0
_AVERAGED = 0.999  # of the weights that are kept in the end (an exponential mean)


@dataclass(frozen=True)
class Answer:
    """The truth of one picture, in its pixels: `boxes` (N, 4), `labels` (N,), `ignored` regions (M, 4), and which of
    the C classes the picture has labels for, `known` (C,) bool: of the others nothing is learnt there."""

    boxes: Tensor
    labels: Tensor
    ignored: Tensor
    known: Tensor


def collate(batch: Sequence[TrainingSample], device: str) -> tuple[Tensor, list[Answer]]:
    """Samples as the picture tensor (N, 3, H, W) and their answers."""
    images = (
        torch.from_numpy(np.stack([each.image for each in batch])).permute(0, 3, 1, 2).to(device)
    )
    answers = [
        Answer(
            *(
                torch.from_numpy(values).to(device)
                for values in (
                    each.boxes.astype(np.float32),
                    each.labels,
                    each.ignored.astype(np.float32),
                    each.known,
                )
            )
        )
        for each in batch
    ]
    return images, answers


def dense_losses(outputs: Sequence[Tensor], answers: Sequence[Answer]) -> dict[str, Tensor]:
    """The losses of a batch by name: quality focal, generalised IoU, distribution focal (Li et al. 2020).

    `outputs` (N, classes + 44, H, W) of each stride. A class without labels in a picture teaches nothing there, nor
    does what is in an ignored region.
    """
    known = torch.stack([each.known for each in answers])
    # of each picture one row more that is no thing, so that there are rows in any batch
    boxes = pad_sequence(
        [functional.pad(each.boxes, (0, 0, 0, 1)) for each in answers], batch_first=True
    )
    labels = pad_sequence(
        [functional.pad(each.labels, (0, 1), value=-1) for each in answers], True, -1
    )
    ignored = pad_sequence([each.ignored for each in answers], batch_first=True)
    scores, bins, places = cells([each.float() for each in outputs], known.shape[1])
    sizes = [(each.shape[2], each.shape[3]) for each in outputs]
    owner = assigned(places, sizes, boxes, labels, ignored)

    row, cell = torch.nonzero(owner >= 0, as_tuple=True)
    goal, label = boxes[row, owner[row, cell]], labels[row, owner[row, cell]]
    own, place = bins[row, cell], places[cell]
    found = boxes_from_bins(own, place)
    overlap, outside = _overlaps(found, goal)

    # a cell's score aims at how well its box fits
    target = torch.zeros_like(scores)
    target[row, cell, label] = overlap.detach()
    chance = scores.detach().sigmoid()
    each_cell = functional.binary_cross_entropy_with_logits(scores, target, reduction="none")
    weight = (owner > -2).float()[..., None] * known[:, None]
    weight[row, cell, label] = 1.0
    focal = (weight * (target - chance) ** 2 * each_cell).sum() / max(len(row), 1)

    # a side between two bins is the mean of both
    share = chance[row, cell, label]
    reach = torch.cat([place[:, :2] - goal[:, :2], goal[:, 2:] - place[:, :2]], 1) / place[:, 2:]
    reach = reach.clamp(0, BINS - 1.01)
    below = reach.floor().long()
    odds = own.log_softmax(-1)
    lower, upper = (odds.gather(-1, each[..., None])[..., 0] for each in (below, below + 1))
    edges = -(lower * (1 - reach + below) + upper * (reach - below)).mean(1)
    total = share.sum().clamp(min=1e-3)
    return {
        "score": focal,
        "box": _BOX_WEIGHT * ((1 - overlap + outside) * share).sum() / total,
        "box edges": _EDGE_WEIGHT * (edges * share).sum() / total,
    }


def _overlaps(boxes: Tensor, goals: Tensor) -> tuple[Tensor, Tensor]:
    """(N,) intersection over union of pairs, and which share of their hull neither fills (Rezatofighi et al. 2019)."""
    low, high = torch.minimum(boxes, goals), torch.maximum(boxes, goals)
    inner, outer = common(boxes, goals), torch.cat([low[:, :2], high[:, 2:]], 1)
    union = (area(boxes) + area(goals) - area(inner)).clamp(min=1e-6)
    hull = area(outer).clamp(min=1e-6)
    return area(inner) / union, (hull - union) / hull


@torch.no_grad()
def assigned(
    places: Tensor,
    sizes: Sequence[tuple[int, int]],
    boxes: Tensor,
    labels: Tensor,
    ignored: Tensor,
) -> Tensor:
    """(N, K) which thing each cell stands for; -1 none, -2 it is in a region to ignore.

    `places` (K, 3) and `sizes` (rows, columns) of each stride's cells, boxes (N, M, 4) px, labels (N, M), -1 for none,
    ignored regions (N, R, 4). ATSS (Zhang et al. 2020) among the nine cells of a stride around a thing's centre. A thing
    in which no such cell's centre is gets the nearest cell of the finest stride.
    """
    real = labels >= 0
    count, things = real.shape
    centre = (boxes[..., :2] + boxes[..., 2:]) / 2
    near: list[Tensor] = []
    first = 0
    around = torch.arange(-1, 2, device=boxes.device)
    for stride, (high, wide) in zip(STRIDES, sizes):
        middle = (centre / stride).floor().long()
        columns, rows = (
            (middle[..., axis, None].clamp(1, max(1, side - 2)) + around).clamp(max=side - 1)
            for axis, side in ((0, wide), (1, high))
        )
        near.append((first + rows[..., :, None] * wide + columns[..., None, :]).flatten(2))
        first += high * wide
    cell = torch.cat(near, 2)

    # cells whose square overlaps the thing more than most, and whose centre it covers
    place, box = places[cell], boxes[:, :, None]
    half = _ANCHOR_STRIDES / 2 * place[..., 2:]
    square = torch.cat([place[..., :2] - half, place[..., :2] + half], -1)
    shared = area(common(square, box))
    overlap = shared / (area(square) + area(box) - shared).clamp(min=1e-6)
    inside = ((place[..., :2] > box[..., :2]) & (place[..., :2] < box[..., 2:])).all(-1)
    enough = overlap >= overlap.mean(2, keepdim=True) + overlap.std(2, keepdim=True)
    fits = enough & inside & real[..., None]
    away = ((place[..., :2] - centre[:, :, None]) ** 2).sum(-1) + (place[..., 2] > STRIDES[0]) * 1e6
    fits |= (~fits.any(2) & real)[..., None] & (away == away.amin(2, keepdim=True))

    # of things that want the same cell, the one that overlaps its square the most
    cell, worth = cell.flatten(1), torch.where(fits, overlap + 1e-4, 0.0).flatten(1)
    best = torch.zeros(count, len(places), device=boxes.device)
    best.scatter_reduce_(1, cell, worth, "amax")
    wins = (worth > 0) & (worth >= best.gather(1, cell))
    owner = torch.full((count, len(places) + 1), -1, device=boxes.device)
    thing = torch.arange(things, device=boxes.device)[None, :, None].expand_as(fits).flatten(1)
    owner.scatter_(1, torch.where(wins, cell, len(places)), thing)
    owner = owner[:, :-1]
    for region in ignored.unbind(1):
        corner, far = region[:, None, :2], region[:, None, 2:]
        held = ((places[:, :2] > corner) & (places[:, :2] < far)).all(-1)
        owner[held & (owner < 0)] = -2
    return owner


class SingleStageTraining:
    """A network on its way, with its optimiser and the mean of its weights. Only `learn` changes it."""

    phase, is_whole = "learning", True

    def __init__(self, model: SingleStage, steps: int, device: str, *, is_tuned: bool) -> None:
        """`is_tuned`: the model knows much already, so it learns more slowly, its backbone most."""
        self.model = model.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = deepcopy(self.model).eval()
        self.steps, self.step, self.device = steps, 0, device
        rate = _TUNED_RATE if is_tuned else _FIRST_RATE
        slower = rate * _BACKBONE_SHARE if is_tuned else rate
        parts = (model.backbone, slower), (model.head, rate)
        self.optimiser = torch.optim.AdamW(
            [{"params": part.parameters(), "rate": own} for part, own in parts],
            rate,
            weight_decay=_DECAY,
            fused=True,
        )
        # half precision where it pays; on processors without it torch is only slower
        self._halves = device != "cpu" or bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
        self._started_s = time.monotonic()

    def learn(self, batch: Sequence[TrainingSample]) -> Progress:
        """One step on a batch of samples of one size."""
        self.model.train()
        # the rate rises in a straight line and falls by half a cosine
        falling = 0.5 + 0.5 * math.cos(math.pi * min(1.0, self.step / self.steps))
        rising = (self.step + 1) / min(_WARM_STEPS, max(1, self.steps // 10))
        for group in self.optimiser.param_groups:
            group["lr"] = group["rate"] * min(rising, _LEAST_RATE + (1 - _LEAST_RATE) * falling)
        images, answers = collate(batch, self.device)
        images = images.float().contiguous(memory_format=torch.channels_last)
        kind = torch.device(self.device).type
        with torch.autocast(kind, torch.bfloat16, enabled=self._halves):
            outputs = self.model.outputs(images)
        losses = dense_losses(outputs, answers)
        self.optimiser.zero_grad(set_to_none=True)
        torch.stack([*losses.values()]).sum().backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.model.parameters(), _MOST_GRADIENT)
        self.optimiser.step()
        self.step += 1
        keep = min(_AVERAGED, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            means, values = ([*each.parameters()] for each in (self.average, self.model))
            torch._foreach_lerp_(means, values, 1 - keep)
        return Progress(
            self.step,
            {name: float(each.detach()) for name, each in losses.items()},
            time.monotonic() - self._started_s,
            self.steps,
        )

    def state(self) -> dict[str, object]:
        """All that is needed to go on: tensors, numbers and text only."""
        return {
            "model": self.model.state_dict(),
            "average": self.average.state_dict(),
            "step": self.step,
            "optimiser": self.optimiser.state_dict(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave."""
        self.model.load_state_dict(state["model"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = int(state["step"])
