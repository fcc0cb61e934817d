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

from sorvolo.lab.training.drawn_regions import draw_regions
from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.lab.training.losses import Answer, LossRow, joint_proposal_loss
from sorvolo.lab.training.proposals import Proposed
from sorvolo.lab.training.samples import Sample


@dataclass(frozen=True)
class JointSettings:
    """How long and how fast it learns."""

    steps: int = 8000
    batch: int = 4
    rate: float = 1e-3  # of AdamW for the new parts, at its height
    backbone_rate: float = 2e-4  # a fifth for what is trained already
    decay: float = 0.02  # of AdamW's weights
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
            weight_decay=settings.decay,
            fused=True,
        )
        self._started_s = time.monotonic()

    phase, is_whole = "learning", True

    def learn(self, batch: Sequence[Sample]) -> Progress:
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
        values = [float(part.detach()) for part in parts]
        return Progress(
            self.step,
            values[0],
            values[1],
            values[2],
            values[3],
            time.monotonic() - self._started_s,
            self.settings.steps,
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


def collate(batch: Sequence[Sample], device: str) -> tuple[Tensor, list[Answer]]:
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
