"""What a head of NanoDet minimises: quality focal loss, distribution focal loss, generalised IoU (Li et al. 2020)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from sorvolo.lab.training.boxes import giou_loss, iou_matrix
from sorvolo.lab.training.nanodet import BINS, boxes_from_bins, cells

_NEAREST = 9  # cells of a level that may stand for a thing (ATSS, Zhang et al. 2020)
_ANCHOR_STRIDES = 5.0  # side of a cell's anchor
_BOX_WEIGHT, _BIN_WEIGHT = 2.0, 0.25  # NanoDet's own


@dataclass(frozen=True, eq=False)
class Wanted:
    """One picture's things (N, 4) px and its regions to ignore (M, 4); `labels` (N,), None where there is one class;
    `known` (C,) the classes that are labelled in it, None for all."""

    boxes: Tensor
    ignored: Tensor
    labels: Tensor | None = None
    known: Tensor | None = None


def dense_loss(
    outputs: Sequence[Tensor], strides: Sequence[int], wanted: Sequence[Wanted], classes: int = 1
) -> Tensor:
    """The loss of a batch, by how many cells stand for things; outputs (N, classes + 44, H, W) of each stride."""
    scores, bins, places = cells(outputs, strides, classes)
    boxes = boxes_from_bins(bins, places)
    target, weight = torch.zeros_like(scores), torch.ones_like(scores)
    box_losses, bin_losses, shares = [], [], []
    for index, each in enumerate(wanted):
        row = assigned(places, each)
        chosen = torch.nonzero(row >= 0)[:, 0]
        weight[index] = (row > -2).to(weight.dtype)[:, None]
        if each.known is not None:
            weight[index] *= each.known.to(weight.dtype)
        if not len(chosen):
            continue
        goal = each.boxes[row[chosen]]
        label = torch.zeros_like(chosen) if each.labels is None else each.labels[row[chosen]]
        target[index, chosen, label] = _overlap(boxes[index, chosen].detach(), goal)
        share = scores[index, chosen, label].detach().sigmoid()
        box_losses.append(giou_loss(boxes[index, chosen], goal) * share)
        bin_losses.append(_bin_loss(bins[index, chosen], places[chosen], goal) * share)
        shares.append(share)
    each_cell = functional.binary_cross_entropy_with_logits(scores, target, reduction="none")
    focal = (weight * (target - scores.detach().sigmoid()).abs() ** 2 * each_cell).sum()
    count = max(sum(len(each) for each in shares), 1)
    if not shares:
        return focal
    total = torch.cat(shares).sum().clamp(min=1e-3)
    return (
        focal / count
        + (_BOX_WEIGHT * torch.cat(box_losses).sum() + _BIN_WEIGHT * torch.cat(bin_losses).sum())
        / total
    )


def assigned(places: Tensor, wanted: Wanted) -> Tensor:
    """(K,) which thing each cell stands for; -1 none, -2 it lies in a region to ignore (ATSS)."""
    row = torch.full((len(places),), -1, dtype=torch.int64)
    inside = _inside(places, wanted.ignored).any(1)
    row[inside] = -2
    if not len(wanted.boxes):
        return row
    half = _ANCHOR_STRIDES / 2 * places[:, 2:]
    anchors = torch.cat([places[:, :2] - half, places[:, :2] + half], 1)
    overlap = iou_matrix(anchors, wanted.boxes)
    middle = (wanted.boxes[:, :2] + wanted.boxes[:, 2:]) / 2
    away = (places[:, None, :2] - middle[None]).norm(dim=2)
    near = torch.zeros_like(overlap, dtype=torch.bool)
    for stride in places[:, 2].unique():
        own = torch.nonzero(places[:, 2] == stride)[:, 0]
        best = away[own].topk(min(_NEAREST, len(own)), 0, largest=False).indices
        near[own[best], torch.arange(len(middle))] = True
    some = torch.where(near, overlap, torch.nan)
    mean = some.nanmean(0)
    least = mean + ((some - mean) ** 2).nanmean(0).sqrt()
    fits = near & (overlap >= least) & _inside(places, wanted.boxes)
    closest = away.argmin(0)
    fits[closest, torch.arange(len(middle))] |= ~fits.any(0)
    best, which = torch.where(fits, overlap + 1e-6, 0.0).max(1)
    return torch.where(best > 0, which, row)


def _inside(places: Tensor, boxes: Tensor) -> Tensor:
    """(K, N) whether each cell's centre lies in each box."""
    low, high = places[:, None, :2] > boxes[None, :, :2], places[:, None, :2] < boxes[None, :, 2:]
    return (low & high).all(2)


def _overlap(a: Tensor, b: Tensor) -> Tensor:
    """(N,) intersection over union of pairs."""
    shared = (
        (torch.minimum(a[:, 2:], b[:, 2:]) - torch.maximum(a[:, :2], b[:, :2])).clamp(min=0).prod(1)
    )
    union = (a[:, 2:] - a[:, :2]).prod(1) + (b[:, 2:] - b[:, :2]).prod(1) - shared
    return shared / union.clamp(min=1e-6)


def _bin_loss(bins: Tensor, places: Tensor, goal: Tensor) -> Tensor:
    """(N,) how badly the bins (N, 4, 11) of the sides show where they are: between two bins, both count."""
    reach = torch.cat([places[:, :2] - goal[:, :2], goal[:, 2:] - places[:, :2]], 1) / places[:, 2:]
    reach = reach.clamp(0, BINS - 1 - 0.01)
    low = reach.long()
    share = reach - low
    logs = bins.log_softmax(-1)
    lower = logs.gather(-1, low[..., None])[..., 0]
    upper = logs.gather(-1, low[..., None] + 1)[..., 0]
    return -(lower * (1 - share) + upper * share).sum(-1)
