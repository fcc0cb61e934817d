"""Section 4.3: the schedule: proposals and classifier learn in turn, in four steps, until they share layers.

1. the proposal network with layers of its own, from ImageNet; 2. the classifier with layers of its own, from ImageNet
again, on the regions that step 1 proposes; 3. the proposal network's own layers on the classifier's shared ones, which
stay as they are; 4. the classifier's own layers on the same (Ren et al. 2015, 3.2).
"""

import time
from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from sorvolo.lab.thesis.faster_rcnn import FasterRCNN, Proposed, offsets_from_boxes, propose
from sorvolo.lab.training.boxes import area, iou_matrix, shared_area
from sorvolo.lab.training.learning import Answer, collate
from sorvolo.lab.training.progress import Progress
from sorvolo.lab.training.samples import TrainingSample

STEP_NAMES = ("1/4 proposals", "2/4 classifier", "3/4 proposals refined", "4/4 classifier refined")
LOSS_NAMES = ("proposals: score", "proposals: box", "classifier: score", "classifier: box")

_RATE, _MOMENTUM = 1e-4, 0.9  # of stochastic gradient descent, the thesis's
# per picture for the proposals, half of them positives at most (Ren et al. 2015, 3.1.3)
_ANCHORS = 256
# per picture for the classifier, and the share of positives at most
_REGIONS = 128
_POSITIVE = 0.25
_PROPOSED = 300  # regions per picture out of which those are drawn
# an anchor or region that is by this much in an ignored region teaches nothing
_IGNORED_SHARE = 0.5


class FourStepTraining:
    """A model on its way through the four steps. Only `learn` changes it; `average` is the model itself."""

    def __init__(self, model: FasterRCNN, steps: int, seed: int, device: str = "cpu") -> None:
        self.model = model.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.steps, self.device = steps, device
        self.step = 0
        self.generator = torch.Generator().manual_seed(seed)
        self._imagenet: dict[str, Any] | None = deepcopy(model.backbone.state_dict())
        self._proposer: nn.ModuleList | None = None
        self._enter(0)
        self._started_s = time.monotonic()

    @property
    def average(self) -> FasterRCNN:
        """The model that is kept in the end: the thesis takes no mean of weights."""
        return self.model

    @property
    def phase(self) -> str:
        """What it learns now, in words."""
        return STEP_NAMES[self._stage]

    @property
    def is_whole(self) -> bool:
        """Whether the parts fit together: in the last step alone."""
        return self._stage == 3

    def learn(self, batch: Sequence[TrainingSample]) -> Progress:
        """One batch of samples of one size; a loss that its step does not minimise is zero."""
        stage = min(3, self.step * 4 // self.steps)
        if stage != self._stage:
            self._enter(stage)
        self._prepare()
        images, answers = collate(batch, self.device)
        with torch.set_grad_enabled(stage < 2):
            features = self.model.backbone(images)
        if stage in (0, 2):
            parts = proposal_loss(self.model.proposals(features), answers, self.generator)
        else:
            parts = self._region_losses(images, features, answers)
        self.optimiser.zero_grad(set_to_none=True)
        (parts[0] + parts[1]).backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        self.step += 1
        losses = dict.fromkeys(LOSS_NAMES, 0.0)
        for name, part in zip(LOSS_NAMES[stage % 2 * 2 :], parts):
            losses[name] = float(part.detach())
        return Progress(self.step, losses, time.monotonic() - self._started_s, self.steps)

    def state(self) -> dict[str, object]:
        """All that is needed to go on: tensors, numbers and text only."""
        return {
            "model": self.model.state_dict(),
            "step": self.step,
            "stage": self._stage,
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "imagenet": self._imagenet,
            "proposer": None if self._proposer is None else self._proposer.state_dict(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave."""
        self._imagenet = state["imagenet"]
        self._proposer = None
        if state["proposer"] is not None:
            self._proposer = _proposer_of(self.model)
            self._proposer.load_state_dict(state["proposer"])
        self._stage = int(state["stage"])
        self._new_optimiser()
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
        self.step = int(state["step"])

    def _enter(self, stage: int) -> None:
        if stage == 1:
            self._proposer = _proposer_of(self.model)
            assert self._imagenet is not None
            self.model.backbone.load_state_dict(self._imagenet)
        self._imagenet = self._imagenet if stage == 0 else None
        self._proposer = self._proposer if stage == 1 else None
        self._stage = stage
        self._new_optimiser()

    def _new_optimiser(self) -> None:
        weights = [
            each for part in self._learning() for each in part.parameters() if each.requires_grad
        ]
        self.optimiser = torch.optim.SGD(weights, lr=_RATE, momentum=_MOMENTUM)

    def _learning(self) -> tuple[nn.Module, ...]:
        model = self.model
        own = model.proposals if self._stage in (0, 2) else model.head
        return (model.backbone, own) if self._stage < 2 else (own,)

    def _prepare(self) -> None:
        """Batch norms of what is fixed keep their statistics."""
        self.model.eval()
        for part in self._learning():
            part.train()

    def _region_losses(
        self, images: Tensor, features: Tensor, answers: Sequence[Answer]
    ) -> tuple[Tensor, Tensor]:
        """Eq. 4.2 for the classifier: both sums over the number of regions drawn."""
        # some of the proposed regions and the true boxes, of which positives overlap a true one by half
        regions, matches = [], []
        with torch.no_grad():
            if self._proposer is None:
                proposed = self.model.proposals(features)
            else:
                backbone, proposals = self._proposer
                proposed = proposals(backbone(images))
            for index, answer in enumerate(answers):
                found = propose(proposed, index, (images.shape[2], images.shape[3]), _PROPOSED)
                found = torch.cat([found, answer.boxes])
                target = match_boxes(found, answer, over=0.5, under=0.5)
                chosen = sample(target, _REGIONS, _POSITIVE, self.generator)
                regions.append(found[chosen])
                matches.append(target[chosen])
        counts = [len(each) for each in regions]
        batch = torch.repeat_interleave(torch.tensor(counts)).to(features.device)
        scores, offsets = self.model.classify(features, torch.cat(regions), batch)
        parts = zip(scores.split(counts), offsets.split(counts), regions, matches, answers)
        losses = [region_loss(*each) for each in parts]
        score, box = (torch.stack(each).sum() for each in zip(*losses))
        return score / max(1, sum(counts)), box / max(1, sum(counts))


def _proposer_of(model: FasterRCNN) -> nn.ModuleList:
    parts = nn.ModuleList([model.backbone, model.proposals])
    return deepcopy(parts).eval().requires_grad_(False)


def match_boxes(boxes: Tensor, answer: Answer, *, over: float, under: float) -> Tensor:
    """(K,) what boxes (K, 4) stand for: the row of the answer's boxes, -1 background, -2 neither.

    Boxes that overlap a true one by `over` are positives, by less than `under` background.
    """
    target = torch.full((len(boxes),), -1, dtype=torch.int64, device=boxes.device)
    if len(answer.boxes):
        best, row = iou_matrix(boxes, answer.boxes).max(1)
        target[best >= under] = -2
        target = torch.where(best >= over, row, target)
    if len(answer.ignored):
        inside = shared_area(boxes, answer.ignored).amax(1) > _IGNORED_SHARE * area(boxes)
        target = torch.where(inside & (target == -1), -2, target)
    return target


def sample(target: Tensor, count: int, most_positive: float, generator: torch.Generator) -> Tensor:
    """(S,) indices of at most `count` boxes, positives among them up to their share, the rest background."""
    positive = (target >= 0).nonzero()[:, 0]
    negative = (target == -1).nonzero()[:, 0]
    positive = positive[
        torch.randperm(len(positive), generator=generator)[: int(count * most_positive)]
    ]
    negative = negative[torch.randperm(len(negative), generator=generator)[: count - len(positive)]]
    return torch.cat([positive, negative])


def region_loss(
    scores: Tensor, offsets: Tensor, regions: Tensor, target: Tensor, answer: Answer
) -> tuple[Tensor, Tensor]:
    """Eq. 4.2 summed over one picture's regions: log loss over classes and background, smooth L1 of the positives' boxes.

    Scores (R, C + 1), offsets (R, 4), regions (R, 4), `target` (R,) of these very regions. A class without labels in
    this picture is left out of its softmax.
    """
    positive = target >= 0
    wanted = torch.full_like(target, scores.shape[1] - 1)
    wanted[positive] = answer.labels[target[positive]]
    allowed = torch.cat([answer.known, answer.known.new_ones(1)])
    masked = scores.masked_fill(~allowed[None], -1e4)
    goal = offsets_from_boxes(answer.boxes[target[positive]], regions[positive])
    return (
        functional.cross_entropy(masked, wanted, reduction="sum"),
        functional.smooth_l1_loss(offsets[positive], goal, reduction="sum", beta=1.0),
    )


def proposal_loss(
    proposed: Proposed, answers: Sequence[Answer], generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Eq. 4.2 for the proposals: log loss over sampled anchors and smooth L1 over the positives among them.

    Positives overlap a true box by more than 0.7, background by less than 0.3; half of a sample at most is positive. Of
    the two ways that the thesis's 4.3 names it chooses this: a box that no anchor overlaps so far has no positive.
    """
    score_losses, box_losses = [], []
    for index, answer in enumerate(answers):
        target = match_boxes(proposed.anchors, answer, over=0.7, under=0.3)
        chosen = sample(target, _ANCHORS, 0.5, generator)
        wanted = (target[chosen] >= 0).to(proposed.scores.dtype)
        score_losses.append(
            functional.binary_cross_entropy_with_logits(proposed.scores[index][chosen], wanted)
        )
        rows = chosen[target[chosen] >= 0]
        goal = offsets_from_boxes(answer.boxes[target[rows]], proposed.anchors[rows])
        missed = functional.smooth_l1_loss(
            proposed.offsets[index][rows], goal, reduction="sum", beta=1 / 9
        )
        box_losses.append(missed / _ANCHORS)
    return torch.stack(score_losses).mean(), torch.stack(box_losses).mean()
