"""How well a detector does on pictures that were held out while it learnt: per class, over several sets."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import cv2
import numpy as np
import torch

from sorvolo.detection.contract import ScoreCalibration
from sorvolo.detection.fusing import platt_fit
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import BoxesPx, Floats, ImageRGB
from sorvolo.lab.evaluation.detection_metrics import (
    ClassMatch,
    CocoNumbers,
    Threshold,
    at_score,
    judged_classes,
    match_pictures,
    reporting_threshold,
)
from sorvolo.lab.training.boxes import Finder
from sorvolo.lab.training.progress import Check
from sorvolo.mosaic.selection import evenly
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import Detections

_FALLBACK_THRESHOLD = 0.5  # where nothing was held out to choose one
_FEW_LABELS = 50  # held-out labels of a class: with fewer, the best score on them may lie anywhere
_NONE = Threshold(*[float("nan")] * 4)
_FEW = 10  # objects found, from which on the range of their sizes means something; right and wrong reports likewise


@dataclass(frozen=True, eq=False)
class Checked:
    """One look at the held-out sets: of each class the matches in each set that labels it, and COCO's numbers there."""

    matches: Mapping[str, tuple[ClassMatch, ...]]
    numbers: Mapping[str, tuple[CocoNumbers, ...]]

    @property
    def ap50(self) -> dict[str, float]:
        """AP50 of each class: the mean over its sets, weighted by labels; NaN without any."""
        return {name: self._mean(name, "ap50") for name in self.matches}

    @property
    def ap(self) -> dict[str, float]:
        """AP of each class, as `ap50`."""
        return {name: self._mean(name, "ap") for name in self.matches}

    def thresholds(
        self, classes: Sequence[str], before: Mapping[str, float] = MappingProxyType({})
    ) -> dict[str, Threshold]:
        """The score from which each class is reported: `metrics.reporting_threshold` over all sets together.

        `before` are the thresholds of the model that was learnt on from: kept for `too_few` classes.
        """
        unknown = replace(_NONE, score=_FALLBACK_THRESHOLD)
        chosen = {
            name: _chosen(_pooled(self.matches[name])) for name in classes if name in self.matches
        }
        for name in set(self.too_few(classes)) & set(before):
            matches = self.matches.get(name, ())
            chosen[name] = (
                at_score(_pooled(matches), before[name])
                if matches
                else replace(unknown, score=before[name])
            )
        return {
            name: chosen[name] if np.isfinite(chosen.get(name, _NONE).score) else unknown
            for name in classes
        }

    def calibration(
        self, classes: Sequence[str], before: Mapping[str, ScoreCalibration] = MappingProxyType({})
    ) -> dict[str, ScoreCalibration]:
        """The scale by which scores of each class become the share that is right among the held-out pictures' reports.

        `before` is that of the model that was learnt on from: kept for `too_few` classes. Nothing of a class of which
        too few reports are right, or wrong, to know.
        """
        found = {}
        for name in set(classes) - set(self.too_few(classes)):
            match = _pooled(self.matches[name])
            counted = ~match.ignored[0]
            right = match.right[0][counted]
            if min(np.count_nonzero(right), np.count_nonzero(~right)) < _FEW:
                continue
            if (fit := platt_fit(match.scores[counted].astype(float), right)) is not None:
                found[name] = fit
        return {name: before[name] for name in self.too_few(classes) if name in before} | found

    def too_few(self, classes: Sequence[str]) -> tuple[str, ...]:
        """The classes with so few held-out labels that a threshold chosen by them is chance."""
        counts = {
            name: sum(len(each.true_scores) for each in self.matches.get(name, ()))
            for name in classes
        }
        return tuple(name for name in classes if counts[name] < _FEW_LABELS)

    def found_sides_px(self, name: str, score: float) -> Floats:
        """(N,) longer sides of the labels of a class that were found at this score."""
        sides = [np.zeros(0)]
        for match in self.matches.get(name, ()):
            sides.append(_longer_px(match.true_boxes_px[match.true_scores >= score]))
        return np.concatenate(sides)

    def _mean(self, name: str, field: str) -> float:
        labels = [len(match.true_scores) for match in self.matches[name]]
        values = [getattr(numbers, field) for numbers in self.numbers[name]]
        if not any(labels):
            return float("nan")
        known = np.flatnonzero(labels)
        return float(np.average(np.take(values, known), weights=np.take(labels, known)))


def best_sizes_px(
    checked: Checked,
    thresholds: Mapping[str, float],
    learnt: Sequence[LabelledSet],
    classes: Sequence[str],
    before: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> dict[str, tuple[float, float]]:
    """Of each class the longer sides between which nine of ten objects lie: of those found where enough were held out,
    else of those learnt from.

    `before` are the sizes of the model that was learnt on from: kept for `too_few` classes, as its thresholds are.
    """
    kept = {name: before[name] for name in checked.too_few(classes) if name in before}
    found = found_sizes_px(checked, thresholds, classes) | kept
    learnt_px = {
        name: np.concatenate([np.zeros(0), *(_sides_px(each, name) for each in learnt)])
        for name in classes
    }
    return {name: found.get(name) or _most_of(learnt_px[name]) for name in classes}


def found_sizes_px(
    checked: Checked, thresholds: Mapping[str, float], classes: Sequence[str]
) -> dict[str, tuple[float, float]]:
    """Of each class the longer sides between which nine of ten of the held-out objects that were found lie; nothing of
    a class of which too few were."""
    sides = {name: checked.found_sides_px(name, thresholds[name]) for name in classes}
    return {name: _most_of(each) for name, each in sides.items() if len(each) >= _FEW}


def _most_of(sides_px: Floats) -> tuple[float, float]:
    low, high = np.percentile(sides_px, [5, 95]) if len(sides_px) else (8.0, 256.0)
    low = max(1.0, round(float(low), 1))
    return low, max(low + 1, round(float(high), 1))


def _sides_px(labelled: LabelledSet, name: str) -> Floats:
    if name not in labelled.classes:
        return np.zeros(0)
    label = labelled.classes.index(name)
    sides = [_longer_px(each.boxes_px[each.labels == label]) for each in labelled.pictures]
    return np.concatenate([np.zeros(0), *sides])


def _longer_px(boxes: BoxesPx) -> Floats:
    return np.asarray((boxes[:, 2:] - boxes[:, :2]).max(1, initial=0), float)


def _chosen(match: ClassMatch) -> Threshold:
    found = reporting_threshold(match)
    return replace(found, score=round(found.score, 3)) if np.isfinite(found.score) else found


def _pooled(matches: Sequence[ClassMatch]) -> ClassMatch:
    """The matches of several sets as one, best first; which picture each is of is lost."""
    scores = np.concatenate([each.scores for each in matches])
    order = np.argsort(-scores, kind="stable")
    return replace(
        matches[0],
        scores=scores[order],
        right=np.concatenate([each.right for each in matches], 1)[:, order],
        ignored=np.concatenate([each.ignored for each in matches], 1)[:, order],
        true_scores=np.concatenate([each.true_scores for each in matches]),
    )


def mean_known(values: Iterable[float]) -> float:
    """The plain mean of those that are known; NaN where none is."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def check_of(checked: Checked, step: int) -> Check:
    """The figures of a check: AP50 and AP over all classes, the plain mean, and AP50 of each class."""
    return Check(
        step, mean_known(checked.ap50.values()), mean_known(checked.ap.values()), checked.ap50
    )


def check_model(
    model: Finder,
    classes: Sequence[str],
    held_out: Sequence[LabelledSet],
    read: Callable[[str], ImageRGB],
    *,
    device: str,
    most: int,
) -> Checked:
    """Run the network over at most `most` held-out pictures, spread evenly over each set; damaged ones are left out."""
    total = sum(len(each) for each in held_out)
    matches: dict[str, tuple[ClassMatch, ...]] = {}
    numbers: dict[str, tuple[CocoNumbers, ...]] = {}
    for whole in held_out:
        count = min(len(whole), max(1, round(most * len(whole) / total)))
        seen: list[LabelledPicture] = []
        found = []
        for picture in (whole.pictures[row] for row in evenly(len(whole), count)):
            try:
                image = read(picture.path)
            except InputError:
                continue
            seen.append(picture)
            found.append(see(model, classes, image, device))
        labelled = whole.only(seen)
        own, _, by_class = match_pictures(labelled, found, judged_classes(labelled, classes))
        for match in own:
            matches[match.label] = (*matches.get(match.label, ()), match)
            numbers[match.label] = (*numbers.get(match.label, ()), by_class[match.label])
    return Checked(matches, numbers)


_LONGEST_PX = 1280  # larger pictures are made smaller: they are looked at whole, without tiles
_FILL = 114  # grey, as around samples


@torch.no_grad()
def see(
    model: Finder, classes: Sequence[str], picture: ImageRGB, device: str = "cpu"
) -> Detections:
    """What the network finds in one picture (H, W, 3), padded to its stride; above 1280 px in a smaller copy."""
    model.eval()
    height, width = picture.shape[:2]
    scale = min(1.0, _LONGEST_PX / max(height, width))
    seen = picture
    if scale < 1:
        seen = np.asarray(
            cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
        )
    down, right = (-side % model.stride for side in seen.shape[:2])
    padded = np.pad(seen, ((0, down), (0, right), (0, 0)), constant_values=_FILL)
    planes = torch.from_numpy(np.ascontiguousarray(padded.transpose(2, 0, 1))[None]).to(device)
    boxes, scores, labels = (each.cpu().numpy() for each in model(planes))
    boxes = np.clip(boxes / scale, 0, [width, height, width, height])
    kept = (boxes[:, 2:] > boxes[:, :2]).all(1)
    return Detections(boxes[kept], scores[kept], labels[kept], tuple(classes))


def padded_to(picture: ImageRGB, side_px: int) -> ImageRGB:
    """The picture, padded with gray where a side is shorter than `side_px`."""
    down, right = (max(0, side_px - side) for side in picture.shape[:2])
    return np.pad(picture, ((0, down), (0, right), (0, 0)), constant_values=114)
