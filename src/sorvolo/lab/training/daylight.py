"""The daylight model: people as NanoDet learnt them on COCO, and aerial candidates scored again by its features."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from sorvolo.lab.training.boxes import at_most, suppress
from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.lab.training.heads import roi_means
from sorvolo.lab.training.nanodet import CocoDetector, NanoDetBackbone, NanoDetHead

_SUPPORT_CELLS = 3  # a side, over a candidate's box


class Softened(nn.Module):
    """A picture as soft as the video frames that the aerial network learnt cars from: photos are sharper (0086)."""

    def __init__(self, sigma_px: float) -> None:
        super().__init__()
        self.reach = math.ceil(2.5 * sigma_px)
        across = torch.arange(-self.reach, self.reach + 1, dtype=torch.float32)
        bell = torch.exp(-(across**2) / (2 * sigma_px**2))
        self.register_buffer(
            "bell", torch.outer(bell, bell).div(bell.sum() ** 2).expand(3, 1, -1, -1).contiguous()
        )

    def forward(self, images: Tensor) -> Tensor:
        """(N, 3, H, W) of the pictures (N, 3, H, W); beyond their edges they go on as at them."""
        padded = nn.functional.pad(images.float(), (self.reach,) * 4, mode="replicate")
        softened: Tensor = nn.functional.conv2d(padded, self.get_buffer("bell"), groups=3)
        return softened


@dataclass(frozen=True)
class JudgeSettings:
    """Which features of a candidate the judge reads: levels of NanoDet's backbone, around how much of the box."""

    levels: tuple[int, ...] = (1, 2)  # strides 8 and 16
    grown: tuple[float, ...] = (1.3, 2.0)  # the box and its surroundings, in sides of the box
    cells: tuple[int, ...] = (4, 3)  # pooled to this many cells a side
    width: int = 48  # channels of its layers; by choice


class Judge(nn.Module):
    """Scores a candidate again: from NanoDet's features in and around its box, its size, and the score that it had."""

    def __init__(self, classes: int, settings: JudgeSettings = JudgeSettings()) -> None:
        super().__init__()
        self.settings, self.classes = settings, classes
        channels = [NanoDetBackbone.channels[level] for level in settings.levels]
        inputs = sum(each * cells**2 for each, cells in zip(channels, settings.cells))
        self.look = nn.Linear(inputs, settings.width)
        self.decide = nn.Sequential(
            nn.Linear(settings.width + classes + 1, 32), nn.ReLU(), nn.Linear(32, classes)
        )

    def pooled(self, levels: Sequence[Tensor], boxes: Tensor) -> Tensor:
        """(R, inputs) one picture's features in and around boxes (R, 4) px."""
        middle, half = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]) / 2
        parts = []
        for level, grown, cells in zip(
            self.settings.levels, self.settings.grown, self.settings.cells
        ):
            around = torch.cat([middle - grown * half, middle + grown * half], 1)
            parts.append(
                roi_means(levels[level], around, NanoDetBackbone.strides[level], cells).flatten(1)
            )
        return torch.cat(parts, 1)

    def forward(self, pooled: Tensor, boxes: Tensor, scores: Tensor, labels: Tensor) -> Tensor:
        """(R, classes) before the sigmoid; the candidates came with `scores` (R,) for the classes `labels` (R,)."""
        known = odds_from_scores(scores).clamp(-6, 6)[:, None] * one_hot(labels, self.classes)
        size = torch.log((boxes[:, 2:] - boxes[:, :2]).amax(1, keepdim=True).clamp(min=1.0) / 32)
        answer: Tensor = self.decide(torch.cat([torch.relu(self.look(pooled)), known, size], 1))
        return answer


@dataclass(frozen=True)
class Calibration:
    """How an opinion in logits becomes a score: the sigmoid of `slope` times it, `support` times NanoDet's, `shift`."""

    slope: float = 1.0
    shift: float = 0.0
    support: float = 0.0


@dataclass(frozen=True)
class DaylightSettings:
    """The class that NanoDet finds too, and what is reported in the end."""

    person: int = 0
    most: int = 300  # detections of one picture
    suppress_iou: float = 0.5  # of two boxes of a class that overlap more, the better one stays
    least_score: float = 0.02  # thresholds are far above
    softened_px: float = 1.0  # 0086: sigma of a Gaussian; 0.9 to 1.6 find cars on sharp photos, more blurs small boxes


class Daylight(nn.Module):
    """Two networks in one graph: NanoDet finds people, Faster R-CNN all classes, and its scores count NanoDet's.

    A candidate of the aerial network for a person is supported by NanoDet's own score for people there; one of a
    judged class is scored again by the judge, and the mean of both opinions counts.
    """

    stride = 32

    def __init__(
        self,
        aerial: FasterRCNN,
        coco: CocoDetector,
        judge: Judge,
        judged: Mapping[int, Calibration],
        person: Calibration,
        aerial_person: Calibration = Calibration(),
        settings: DaylightSettings = DaylightSettings(),
        people: NanoDetHead | None = None,
    ) -> None:
        """`coco` finds people alone. `judged`: classes whose aerial candidates the judge scores again.

        `people`, a head of one class on NanoDet's features, finds people instead, supported by NanoDet's own scores.
        """
        super().__init__()
        self.aerial, self.coco, self.judge, self.settings = aerial, coco, judge, settings
        self.people, self.softened = people, Softened(settings.softened_px)
        self.judged, self.person, self.aerial_person = dict(judged), person, aerial_person

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One picture (1, 3, H, W), RGB 0 to 255: boxes (K, 4) px, scores (K,), labels (K,), best first."""
        levels = self.coco.backbone(images)
        outputs = self.coco.head(levels)
        people, opinions, supporting = self.people_of(
            levels, outputs, (images.shape[2], images.shape[3])
        )
        people_scores = _calibrated(opinions, self.person, supporting)
        boxes, scores, labels = self.aerial(self.softened(images))
        scores = self._scored(levels, outputs, boxes, scores, labels)
        boxes, scores = torch.cat([people, boxes]), torch.cat([people_scores, scores])
        labels = torch.cat(
            [torch.full_like(people_scores, self.settings.person).to(labels.dtype), labels]
        )
        by_class = (scores[:, None] * one_hot(labels, self.judge.classes)).T
        reach = self.settings
        kept = suppress(
            boxes, by_class.contiguous(), reach.most, reach.suppress_iou, reach.least_score
        )
        rows = kept[:, 1]
        best, order = torch.topk(scores[rows], at_most(reach.most, scores[rows]))
        return boxes[rows][order], best, kept[:, 0][order]

    def people_of(
        self, levels: Sequence[Tensor], outputs: Sequence[Tensor], size_px: tuple[int, int]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """People (K, 4) px in a picture of this (height, width), the opinions of them and NanoDet's support (K,)."""
        if self.people is None:
            boxes, scores, _ = self.coco.found(outputs, size_px)
            return boxes, odds_from_scores(scores), torch.zeros_like(scores)
        finder = CocoDetector(self.coco.backbone, self.people, ((0,),))
        boxes, scores, _ = finder.found(self.people(levels), size_px)
        row = self.coco.coco_of_class[0][0]
        return boxes, odds_from_scores(scores), support(outputs, self.coco.head.strides, boxes, row)

    def _scored(
        self,
        levels: Sequence[Tensor],
        outputs: Sequence[Tensor],
        boxes: Tensor,
        scores: Tensor,
        labels: Tensor,
    ) -> Tensor:
        """(R,) the aerial candidates' scores, those of people and of judged classes with NanoDet's share."""
        own = odds_from_scores(scores)
        answers = self.judge(self.judge.pooled(levels, boxes), boxes, scores, labels)
        supporting = support(outputs, self.coco.head.strides, boxes, self.coco.coco_of_class[0][0])
        person = _calibrated(own, self.aerial_person, supporting)
        out = torch.where(labels == self.settings.person, person, scores)
        for label, calibration in self.judged.items():
            out = torch.where(
                labels == label, _calibrated((own + answers[:, label]) / 2, calibration), out
            )
        return out


def support(outputs: Sequence[Tensor], strides: Sequence[int], boxes: Tensor, row: int) -> Tensor:
    """(R,) NanoDet's highest score for the COCO class `row` in each box (R, 4) px, before the sigmoid."""
    best = [
        roi_means(output[:, row : row + 1], boxes, stride, _SUPPORT_CELLS).flatten(1).amax(1)
        for output, stride in zip(outputs, strides)
    ]
    return torch.stack(best).amax(0)


def _calibrated(opinion: Tensor, how: Calibration, supporting: Tensor | None = None) -> Tensor:
    logits = how.slope * opinion + how.shift
    return torch.sigmoid(logits if supporting is None else logits + how.support * supporting)


def odds_from_scores(scores: Tensor) -> Tensor:
    """The logarithm of the odds of scores 0 to 1, within -9 and 9."""
    inside = scores.clamp(1e-4, 1 - 1e-4)
    return torch.log(inside / (1 - inside))


def one_hot(labels: Tensor, classes: int) -> Tensor:
    """(N, classes) float: one at each row's label."""
    numbers = torch.tensor(list(range(classes)), device=labels.device)
    return (labels[:, None] == numbers).to(torch.float32)
