"""The joint schedule: proposal network and head learn together, end to end."""

import math
import time
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from sorvolo.lab.training.faster_rcnn import FasterRCNN, Proposed, propose
from sorvolo.lab.training.regions import (
    boxes_from_offsets,
    cover_matrix,
    giou_loss,
    iou_matrix,
    offsets_from_boxes,
)
from sorvolo.lab.training.samples import TrainingSample

_DECAY = 0.02  # of AdamW's weights
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


@dataclass(frozen=True)
class DrawnRegions:
    """Regions (R, 4) px of each picture of a batch, and which true box each stands for."""

    regions: tuple[Tensor, ...]
    matches: tuple[Match, ...]

    @property
    def count(self) -> int:
        """All of them."""
        return sum(len(each) for each in self.regions)

    @property
    def positives(self) -> int:
        """Those that stand for a true box."""
        return sum(int(each.positive.sum()) for each in self.matches)

    def losses(
        self, model: FasterRCNN, levels: list[Tensor], answers: Sequence[Answer], *, overlap: bool
    ) -> tuple[Tensor, Tensor]:
        """The head's loss of the classes and of the boxes, each summed over all regions (`losses.region_loss`)."""
        counts = [len(each) for each in self.regions]
        batch = torch.repeat_interleave(torch.tensor(counts)).to(levels[0].device)
        scores, offsets = model.classify(levels, torch.cat(self.regions), batch)
        score_sum, box_sum = scores.new_zeros(()), scores.new_zeros(())
        parts = zip(
            torch.split(scores, counts),
            torch.split(offsets, counts),
            self.regions,
            self.matches,
            answers,
        )
        for each in parts:
            score, box = region_loss(*each, overlap=overlap)
            score_sum, box_sum = score_sum + score, box_sum + box
        return score_sum, box_sum


@torch.no_grad()
def draw_regions(
    model: FasterRCNN,
    levels: Sequence[Tensor],
    proposed: Proposed,
    answers: Sequence[Answer],
    generator: torch.Generator,
    *,
    before: int,
    after: int,
    count: int,
    most_positive: float,
) -> DrawnRegions:
    """Of each picture `count` regions, positives among them up to their share; the true boxes may be drawn, too.

    `before` and `after` as `proposals.propose` has them. Positives overlap a true box by half (Ren et al. 2015).
    """
    height, width = (levels[0].shape[axis] * model.proposals.strides[0] for axis in (2, 3))
    regions, matches = [], []
    for index, answer in enumerate(answers):
        found, _ = propose(proposed, index, (height, width), before=before, after=after)
        found = torch.cat([found, answer.boxes])
        match = match_boxes(found, answer, over=0.5, under=0.5, best_too=False)
        chosen = sample(match, count, most_positive, generator)
        regions.append(found[chosen])
        matches.append(Match(match.target[chosen]))
    return DrawnRegions(tuple(regions), tuple(matches))


@dataclass(frozen=True)
class JointSettings:
    """How long and how fast it learns."""

    steps: int = 8000
    batch: int = 4
    rate: float = 1e-3  # of AdamW for the new parts, at its height
    backbone_rate: float = 2e-4  # a fifth for what is trained already
    warm_steps: int = 200  # over which the rate rises
    regions: int = 96  # per picture for the head, a third of them positives at most
    averaging: float = 0.998  # of the weights that are kept in the end (an exponential mean)
    mixed_precision: bool = True  # bfloat16 in the convolutions


@dataclass(frozen=True)
class Progress(LossRow):
    """Where training stands after a step of `steps`; the losses are this step's, the seconds this run's."""

    steps: int


class JointTraining:
    """A model on its way, with its optimiser and the mean of its weights. Only `learn` changes it."""

    def __init__(
        self, model: FasterRCNN, settings: JointSettings, seed: int, device: str = "cpu"
    ) -> None:
        self.model, self.settings, self.device = model.to(device), settings, device
        self.average = deepcopy(model).eval()
        self.step = 0
        self.generator = torch.Generator().manual_seed(seed)
        backbone = [each for each in model.backbone.parameters() if each.requires_grad]
        own = {id(each) for each in model.backbone.parameters()}
        others = [each for each in model.parameters() if id(each) not in own]
        self.optimiser = torch.optim.AdamW(
            [
                {"params": others, "rate": settings.rate},
                {"params": backbone, "rate": settings.backbone_rate},
            ],
            lr=settings.rate,
            weight_decay=_DECAY,
            fused=True,
        )
        self._started_s = time.monotonic()

    phase, is_whole = "learning", True

    def learn(self, batch: Sequence[TrainingSample]) -> Progress:
        """One step on a batch of samples of one size."""
        self.model.train()
        share = self._share_of_rate()
        for group in self.optimiser.param_groups:
            group["lr"] = group["rate"] * share
        images, answers = collate(batch, self.device)
        # half precision where it pays, in the convolutions; on CPUs without it torch is only slower
        with torch.autocast(self.device, torch.bfloat16, enabled=self.settings.mixed_precision):
            levels = self.model.features(images)
            proposed = self.model.proposals(levels)
        levels = [level.float() for level in levels]
        proposed = replace(
            proposed, scores=proposed.scores.float(), offsets=proposed.offsets.float()
        )
        parts = self._losses(levels, proposed, answers)
        self.optimiser.zero_grad(set_to_none=True)
        torch.stack(parts).sum().backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), 10.0)
        self.optimiser.step()
        self.step += 1
        self._average()
        proposal_score, proposal_box, score, box = (float(part.detach()) for part in parts)
        seconds = time.monotonic() - self._started_s
        return Progress(
            self.step, proposal_score, proposal_box, score, box, seconds, self.settings.steps
        )

    def state(self) -> dict[str, object]:
        """All that is needed to go on: tensors, numbers and text only."""
        return {
            "model": self.model.state_dict(),
            "average": self.average.state_dict(),
            "step": self.step,
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave."""
        self.model.load_state_dict(state["model"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
        self.step = int(state["step"])

    def _losses(
        self, levels: list[Tensor], proposed: Proposed, answers: Sequence[Answer]
    ) -> list[Tensor]:
        proposal_score, proposal_box = joint_proposal_loss(proposed, answers)
        drawn = draw_regions(
            self.model,
            levels,
            proposed,
            answers,
            self.generator,
            before=500,
            after=200,
            count=self.settings.regions,
            most_positive=1 / 3,
        )
        score, box = drawn.losses(self.model, levels, answers, overlap=True)
        return [
            proposal_score,
            proposal_box,
            score / max(1, drawn.count) * 2,
            box / max(1, drawn.positives),
        ]

    def _share_of_rate(self) -> float:
        """Up in a straight line, then down half a cosine."""
        s = self.settings
        if self.step < s.warm_steps:
            return (self.step + 1) / s.warm_steps
        done = min(1.0, (self.step - s.warm_steps) / max(1, s.steps - s.warm_steps))
        return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done))

    @torch.no_grad()
    def _average(self) -> None:
        keep = min(self.settings.averaging, (1 + self.step) / (10 + self.step))
        pairs = list(zip(self.average.state_dict().values(), self.model.state_dict().values()))
        means, values = zip(*(each for each in pairs if each[0].dtype.is_floating_point))
        torch._foreach_lerp_(means, values, 1 - keep)
        for mean, value in pairs:
            if not mean.dtype.is_floating_point:
                mean.copy_(value)


def collate(batch: Sequence[TrainingSample], device: str) -> tuple[Tensor, list[Answer]]:
    """Samples as the picture tensor (N, 3, H, W) and their answers."""
    images = (
        torch.from_numpy(np.stack([each.image for each in batch])).permute(0, 3, 1, 2).to(device)
    )
    answers = [
        Answer(
            torch.from_numpy(each.boxes.astype(np.float32)).to(device),
            torch.from_numpy(each.labels).to(device),
            torch.from_numpy(each.ignored.astype(np.float32)).to(device),
            torch.from_numpy(each.known).to(device),
        )
        for each in batch
    ]
    return images, answers
