"""Section 4.3: the schedule: proposals and classifier learn in turn, in four steps, until they share layers.

1. the proposal network with layers of its own, from ImageNet; 2. the classifier with layers of its own, from ImageNet
again, on the regions that step 1 proposes; 3. the proposal network's own layers on the classifier's shared ones, which
stay as they are; 4. the classifier's own layers on the same (Ren et al. 2015, 3.2).
"""

import time
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from sorvolo.lab.training.faster_rcnn import FasterRCNN, Proposed
from sorvolo.lab.training.joint import (
    Answer,
    Progress,
    collate,
    draw_regions,
    match_boxes,
    sample,
)
from sorvolo.lab.training.regions import offsets_from_boxes
from sorvolo.lab.training.samples import TrainingSample

STEP_NAMES = ("1/4 proposals", "2/4 classifier", "3/4 proposals refined", "4/4 classifier refined")


@dataclass(frozen=True)
class FourStepSettings:
    """How long and how fast it learns; rate and momentum are the thesis's."""

    steps: int = 8000  # batches of all four steps together, a quarter each
    rate: float = 1e-4  # of stochastic gradient descent
    momentum: float = 0.9
    anchors: int = 256  # per picture for the proposals, half of them positives at most (Ren et al. 2015, 3.1.3)
    regions: int = 128  # per picture for the classifier, a quarter of them positives at most
    proposed: int = 300  # regions per picture out of which those are drawn


class FourStepTraining:
    """A model on its way through the four steps. Only `learn` changes it; `average` is the model itself."""

    def __init__(
        self, model: FasterRCNN, settings: FourStepSettings, seed: int, device: str = "cpu"
    ) -> None:
        self.model, self.settings, self.device = model.to(device), settings, device
        self.step = 0
        self.generator = torch.Generator().manual_seed(seed)
        self._imagenet: dict[str, Any] | None = deepcopy(_shared(model).state_dict())
        self._proposer: nn.ModuleList | None = None
        self._enter(0)
        self._started_s = time.monotonic()

    @property
    def average(self) -> FasterRCNN:
        """The model that is kept in the end: the thesis takes no mean of weights."""
        return self.model

    @property
    def stage(self) -> int:
        """Which of the four steps the last batch belonged to, 0 to 3."""
        return self._stage

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
        stage = min(3, self.step * 4 // self.settings.steps)
        if stage != self._stage:
            self._enter(stage)
        self._prepare()
        images, answers = collate(batch, self.device)
        with torch.set_grad_enabled(stage < 2):
            levels = self.model.features(images)
        zero = torch.zeros((), device=self.device)
        parts = [zero, zero, zero, zero]
        if stage in (0, 2):
            parts[:2] = proposal_loss(
                self.model.proposals(levels), answers, self.generator, sampled=self.settings.anchors
            )
        else:
            parts[2:] = self._region_losses(levels, self._proposed(images, levels), answers)
        self.optimiser.zero_grad(set_to_none=True)
        sum(parts, zero).backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        self.step += 1
        first, second, third, fourth = (float(part.detach()) for part in parts)
        seconds = time.monotonic() - self._started_s
        return Progress(self.step, first, second, third, fourth, seconds, self.settings.steps)

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
            _shared(self.model).load_state_dict(self._imagenet)
        self._imagenet = self._imagenet if stage == 0 else None
        self._proposer = self._proposer if stage == 1 else None
        self._stage = stage
        self._new_optimiser()

    def _new_optimiser(self) -> None:
        weights = [
            each for part in self._learning() for each in part.parameters() if each.requires_grad
        ]
        self.optimiser = torch.optim.SGD(
            weights, lr=self.settings.rate, momentum=self.settings.momentum
        )

    def _learning(self) -> tuple[nn.Module, ...]:
        model = self.model
        own = model.proposals if self._stage in (0, 2) else model.head
        return (model.backbone, model.neck, own) if self._stage < 2 else (own,)

    def _prepare(self) -> None:
        """Batch norms of what is fixed keep their statistics."""
        self.model.eval()
        for part in self._learning():
            part.train()

    @torch.no_grad()
    def _proposed(self, images: Tensor, levels: list[Tensor]) -> Proposed:
        if self._proposer is None:
            return self.model.proposals(levels)
        backbone, neck, proposals = self._proposer
        return proposals(neck(backbone(images.float())))

    def _region_losses(
        self, levels: list[Tensor], proposed: Proposed, answers: Sequence[Answer]
    ) -> tuple[Tensor, Tensor]:
        """Eq. 4.2 for the classifier: both sums over the number of regions drawn."""
        drawn = draw_regions(
            self.model,
            levels,
            proposed,
            answers,
            self.generator,
            before=2000,
            after=self.settings.proposed,
            count=self.settings.regions,
            most_positive=0.25,
        )
        score, box = drawn.losses(self.model, levels, answers, overlap=False)
        return score / max(1, drawn.count), box / max(1, drawn.count)


def _shared(model: FasterRCNN) -> nn.ModuleList:
    return nn.ModuleList([model.backbone, model.neck])


def _proposer_of(model: FasterRCNN) -> nn.ModuleList:
    parts = nn.ModuleList([model.backbone, model.neck, model.proposals])
    return deepcopy(parts).eval().requires_grad_(False)


def proposal_loss(
    proposed: Proposed, answers: Sequence[Answer], generator: torch.Generator, *, sampled: int = 256
) -> tuple[Tensor, Tensor]:
    """Eq. 4.2 for the proposals: log loss over sampled anchors and smooth L1 over the positives among them.

    Positives overlap a true box by more than 0.7, background by less than 0.3; half of a sample at most is positive. Of
    the two ways that the thesis's 4.3 names it chooses this: a box that no anchor overlaps so far has no positive.
    """
    score_losses, box_losses = [], []
    for index, answer in enumerate(answers):
        match = match_boxes(proposed.anchors, answer, over=0.7, under=0.3, best_too=False)
        chosen = sample(match, sampled, 0.5, generator)
        wanted = match.positive[chosen].to(proposed.scores.dtype)
        score_losses.append(
            functional.binary_cross_entropy_with_logits(proposed.scores[index][chosen], wanted)
        )
        rows = chosen[match.positive[chosen]]
        offsets = proposed.offsets[index][rows]
        if len(rows):
            goal = offsets_from_boxes(answer.boxes[match.target[rows]], proposed.anchors[rows])
            missed = functional.smooth_l1_loss(offsets, goal, reduction="sum", beta=1 / 9)
        else:
            missed = offsets.sum() * 0
        box_losses.append(missed / sampled)
    return torch.stack(score_losses).mean(), torch.stack(box_losses).mean()
