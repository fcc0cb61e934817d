"""The regions that the head learns from: drawn from what is proposed, and what it loses on them; for every schedule."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.lab.training.losses import Answer, Match, match_boxes, region_loss, sample
from sorvolo.lab.training.proposals import Proposed, propose


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
