"""What training minimises: the multi-task loss of the thesis (eq. 4.2) and the joint schedule's of ours."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from sorvolo.lab.training.boxes import (
    boxes_from_offsets,
    cover_matrix,
    giou_loss,
    iou_matrix,
    offsets_from_boxes,
)
from sorvolo.lab.training.proposals import Proposed

_IGNORED_SHARE = (
    0.5  # an anchor or region that lies by this much in an ignored region teaches nothing
)
_FOCAL_ALPHA, _FOCAL_GAMMA = 0.25, 2.0


@dataclass(frozen=True)
class Answer:
    """The truth of one picture, in its pixels: `boxes` (N, 4), `labels` (N,), `ignored` regions (M, 4), and which of
    the C classes the picture has labels for, `known` (C,) bool: of the others nothing is learnt there."""

    boxes: Tensor
    labels: Tensor
    ignored: Tensor
    known: Tensor


@dataclass(frozen=True)
class LossRow:
    """The losses of `step`, or their means over the steps since the row before; the seconds of learning until then."""

    step: int
    proposal_score: float
    proposal_box: float
    region_score: float
    region_box: float
    seconds: float

    @property
    def loss(self) -> float:
        """Their sum, which is minimised."""
        return self.proposal_score + self.proposal_box + self.region_score + self.region_box


@dataclass(frozen=True)
class Match:
    """What boxes stand for, (K,): `target` the row of the answer, -1 background, -2 neither."""

    target: Tensor

    @property
    def positive(self) -> Tensor:
        """(K,) bool."""
        return self.target >= 0


def match_boxes(
    boxes: Tensor, answer: Answer, *, over: float, under: float, best_too: bool
) -> Match:
    """Boxes (K, 4) that overlap a true one by more than `over` are positives, by less than `under` background.

    `best_too`: every true box has at least its best-overlapping ones (Ren et al. 2015, 3.1.2).
    """
    target = torch.full((len(boxes),), -1, dtype=torch.int64, device=boxes.device)
    if len(answer.boxes):
        overlap = iou_matrix(boxes, answer.boxes)
        best, row = overlap.max(1)
        target[best >= under] = -2
        target = torch.where(best >= over, row, target)
        if best_too:
            most = overlap.max(0).values.clamp(min=0.05)
            again = (overlap >= 0.98 * most[None]) & (overlap > 0.05)
            chosen, which = (overlap * again).max(1)
            target = torch.where((chosen > 0) & (target < 0), which, target)
    if len(answer.ignored):
        inside = cover_matrix(boxes, answer.ignored).max(1).values > _IGNORED_SHARE
        target = torch.where(inside & (target == -1), -2, target)
    return Match(target)


def joint_proposal_loss(proposed: Proposed, answers: Sequence[Answer]) -> tuple[Tensor, Tensor]:
    """Focal loss of the scores and overlap loss of the boxes, each a mean over the positives of the batch.

    Where a class goes unlabelled, background teaches nothing: what is there may be of that class.
    """
    matches = [
        match_boxes(proposed.anchors, each, over=0.5, under=0.4, best_too=True) for each in answers
    ]
    target = torch.stack([each.target for each in matches])
    wanted = (target >= 0).to(proposed.scores.dtype)
    trust = torch.tensor(
        [1.0 if bool(each.known.all()) else 0.1 for each in answers], device=target.device
    )
    weight = torch.where(target >= 0, _FOCAL_ALPHA, (1 - _FOCAL_ALPHA) * trust[:, None]) * (
        target != -2
    )
    wrong = torch.sigmoid(proposed.scores.detach()).sub_(wanted).abs_()
    each = functional.binary_cross_entropy_with_logits(proposed.scores, wanted, reduction="none")
    score_loss = (weight * wrong**_FOCAL_GAMMA * each).sum()
    picture, anchor = (target >= 0).nonzero(as_tuple=True)
    if not len(picture):
        return score_loss, proposed.offsets.sum() * 0
    goals = torch.cat(
        [own.boxes[match.target[match.positive]] for own, match in zip(answers, matches)]
    )
    offsets = proposed.offsets.flatten(0, 1).index_select(0, picture * target.shape[1] + anchor)
    box_loss = giou_loss(boxes_from_offsets(offsets, proposed.anchors[anchor]), goals).sum()
    return score_loss / len(picture), box_loss / len(picture)


def region_loss(
    scores: Tensor, offsets: Tensor, regions: Tensor, match: Match, answer: Answer, *, overlap: bool
) -> tuple[Tensor, Tensor]:
    """Log loss over classes and background of one picture's regions, and of the positives' boxes: by overlap, or
    smooth L1 (eq. 4.2). Scores (R, C + 1), offsets (R, 4), regions (R, 4); `match` is of these very regions.

    A class without labels in this picture is left out of its softmax.
    """
    background = scores.shape[1] - 1
    wanted = torch.where(match.positive, 0, background)
    if len(answer.boxes):
        wanted = torch.where(match.positive, answer.labels[match.target.clamp(min=0)], background)
    allowed = torch.cat([answer.known, answer.known.new_ones(1)])
    masked = scores.masked_fill(~allowed[None], -1e4)
    score_loss = functional.cross_entropy(masked, wanted, reduction="sum")
    positive = match.positive
    if not bool(positive.any()):
        return score_loss, offsets.sum() * 0
    if overlap:
        shifted = boxes_from_offsets(offsets[positive], regions[positive])
        return score_loss, giou_loss(shifted, answer.boxes[match.target[positive]]).sum()
    goal = offsets_from_boxes(answer.boxes[match.target[positive]], regions[positive])
    return score_loss, functional.smooth_l1_loss(offsets[positive], goal, reduction="sum", beta=1.0)


def sample(match: Match, count: int, most_positive: float, generator: torch.Generator) -> Tensor:
    """(S,) indices of at most `count` boxes, positives among them up to their share, the rest background."""
    positive = match.positive.nonzero()[:, 0]
    negative = (match.target == -1).nonzero()[:, 0]
    positive = positive[
        torch.randperm(len(positive), generator=generator)[: int(count * most_positive)]
    ]
    negative = negative[torch.randperm(len(negative), generator=generator)[: count - len(positive)]]
    return torch.cat([positive, negative])
