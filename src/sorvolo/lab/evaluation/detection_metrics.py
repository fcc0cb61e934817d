"""How good detections are: COCO's measures, the thesis's, recall by size, confusions; pure functions of boxes.

Matching and average precision are pycocotools' own (COCOeval: boxes best first, each takes the label of its class that
it overlaps most; IoU 0.50 to 0.95 in steps of 0.05) but for one number: up to 300 boxes a class and picture are looked
at where COCO stops at 100, because a beach from above holds more. What COCO does not measure follows from its matches
at IoU 0.5.
"""

import io
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from itertools import chain, pairwise

import numpy as np
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import BoxesPx, Floats, Mask, Rows
from sorvolo.geometry.arrays import Counts as CountTable
from sorvolo.geometry.box_overlap import iou_matrix
from sorvolo.geometry.summary import CalibrationBin, calibration_bins
from sorvolo.lab.evaluation.change_metrics import Counts
from sorvolo.paths import Json
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import Detections

IOUS: Floats = np.linspace(0.5, 0.95, 10)
"""The overlaps at which COCO counts a box as right."""

MOST_BOXES = 300
"""Of a class and picture, best first; more are not looked at."""

SIZES_PX = (0.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, np.inf)
"""Edges of the bins of an object's longer side in the picture, px."""

SIZES_M = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, np.inf)
"""Edges of the bins of an object's longer side on the ground, m."""

TENTHS = tuple(each / 10 for each in range(11))
"""Edges of the bins of a score."""


@dataclass(frozen=True, eq=False)
class ClassMatch:
    """One class's detections in a set of pictures, best first, against its labels.

    Of D detections: `scores` (D,), `pictures` (D,) the picture's index, `boxes_px` (D, 4), `right` and `ignored`
    (10, D) at each of IOUS, `found` (D,) the row of the label found at IoU 0.5, else -1. Of G labels: `true_pictures`
    (G,), `true_boxes_px` (G, 4), `true_scores` (G,) the score of what found it at IoU 0.5, NaN where nothing did.
    """

    label: str
    scores: Floats
    pictures: Rows
    boxes_px: BoxesPx
    right: Mask
    ignored: Mask
    found: Rows
    true_pictures: Rows
    true_boxes_px: BoxesPx
    true_scores: Floats


@dataclass(frozen=True)
class CocoNumbers:
    """COCO's averages over IoU and recall; NaN where there is no label. Areas: below 32^2, to 96^2, above, px."""

    ap: float
    ap50: float
    ap75: float
    ap_small: float
    ap_medium: float
    ap_large: float


@dataclass(frozen=True)
class Threshold:
    """Reporting a class from `score` on gives this precision, recall and F1 (IoU 0.5)."""

    score: float
    precision: float
    recall: float
    f1: float


@dataclass(frozen=True)
class SizeRow:
    """Labels whose longer side is `low` or more and below `high`: how many were reported, or had any candidate."""

    low: float
    high: float
    count: int
    reported: int
    candidates: int

    @property
    def recall(self) -> float:
        """The share that was reported; NaN of none."""
        return self.reported / self.count if self.count else float("nan")


@dataclass(frozen=True)
class Mistake:
    """One mistake: `kind` is "false alarm", "miss" or "confusion"; boxes as (left, top, right, bottom), px.

    `overlap` is the best IoU of a false alarm with any label: 0.1 to 0.5 is a box badly placed rather than an
    invention.
    """

    kind: str
    picture: int
    box_px: tuple[float, ...]
    label: str
    score: float
    true_label: str = ""
    overlap: float = 0.0


def judged_classes(labelled: LabelledSet, classes: Sequence[str]) -> tuple[str, ...]:
    """The detector's classes that the set labels, in the detector's order; the others are neither right nor wrong.

    Raises InputError when there is none.
    """
    judged = tuple(
        name for name in classes if name in labelled.classes and name not in labelled.unlabelled
    )
    if not judged:
        raise InputError(
            f"{labelled.name}: labels {', '.join(labelled.classes) or 'nothing'}"
            + (
                f" (not labelled: {', '.join(sorted(labelled.unlabelled))})"
                if labelled.unlabelled
                else ""
            )
            + f", but the model finds {', '.join(classes)}; map the set's names to the model's with --classes"
        )
    return judged


def match_pictures(
    labelled: LabelledSet, found: Sequence[Detections], judged: Sequence[str]
) -> tuple[tuple[ClassMatch, ...], CocoNumbers, dict[str, CocoNumbers]]:
    """Match one Detections a picture with the set's labels: each judged class, COCO's numbers of all and of each.

    A detection within an ignored region (COCO's crowd) is neither right nor wrong. Raises InputError when the numbers
    of pictures differ.
    """
    if len(found) != len(labelled):
        raise InputError(
            f"{labelled.name}: {len(labelled)} pictures, but detections in {len(found)}"
        )
    # COCO's records of the labels, and of each label that counts its picture and box by id
    annotations: list[Json] = []
    rows: dict[int, tuple[int, BoxesPx]] = {}
    category = {labelled.classes.index(name): k for k, name in enumerate(judged)}
    for index, picture in enumerate(labelled.pictures):
        for box, label in zip(picture.boxes_px, picture.labels.tolist()):
            if label in category:
                rows[len(annotations) + 1] = index, box
                annotations.append(_annotation(len(annotations) + 1, index, category[label], box))
        for region in picture.ignored_px:
            annotations += [
                _annotation(len(annotations) + 1 + k, index, k, region) | {"iscrowd": 1}
                for k in range(len(judged))
            ]
    truth = {
        "info": {},
        "images": [
            {
                "id": index,
                "width": picture.width_px,
                "height": picture.height_px,
                "file_name": picture.path,
            }
            for index, picture in enumerate(labelled.pictures)
        ],
        "categories": [{"id": k, "name": name} for k, name in enumerate(judged)],
        "annotations": annotations,
    }
    with redirect_stdout(io.StringIO()):  # pycocotools prints as it goes
        judge = COCOeval(
            _indexed(truth), _indexed(truth | {"annotations": _candidates(found, judged)}), "bbox"
        )
        judge.params.maxDets = [1, 10, MOST_BOXES]
        judge.evaluate()
        judge.accumulate()
    precision = np.asarray(judge.eval["precision"])[..., -1]  # IoU, recall, class, area
    # of each class the pictures, all areas first
    by_class = np.reshape(judge.evalImgs, (len(judged), -1, len(labelled)))[:, 0]
    matches = tuple(
        _class_match(name, own, judge, rows) for name, own in zip(judged, by_class.tolist())
    )
    each = {name: _numbers(precision[:, :, k : k + 1]) for k, name in enumerate(judged)}
    return matches, _numbers(precision), each


def counts_at(match: ClassMatch, score: float) -> Counts:
    """True positives, false positives and misses of what scores at least this, at IoU 0.5."""
    reported = match.scores >= score
    right = int((reported & match.right[0]).sum())
    wrong = int((reported & ~match.right[0] & ~match.ignored[0]).sum())
    return Counts(right, wrong, len(match.true_scores) - right)


def right_by_score(match: ClassMatch) -> list[CalibrationBin]:
    """Which share of the reports of each tenth of the score is right, at IoU 0.5: where 0.5 means half, half of them.

    Reports within ignored regions do not count; tenths without any are left out.
    """
    counted = ~match.ignored[0]
    return calibration_bins(match.scores[counted].astype(float), match.right[0][counted], TENTHS)


def precision_recall(match: ClassMatch) -> tuple[Floats, Floats, Floats]:
    """Score, precision and recall (N,) after each detection that counts, best first, at IoU 0.5."""
    counted = ~match.ignored[0]
    right = np.cumsum(match.right[0][counted])
    total = np.arange(1, len(right) + 1)
    return match.scores[counted], right / total, right / max(len(match.true_scores), 1)


def _every_threshold(match: ClassMatch) -> Floats:
    """(N, 4) the fields of `Threshold` at each detection that counts; F1 is 0 where equal scores would be parted."""
    scores, precision, recall = precision_recall(match)
    f1 = 2 * precision * recall / np.maximum(precision + recall, 1e-12)
    f1[:-1][scores[:-1] == scores[1:]] = 0.0
    return np.column_stack([scores, precision, recall, f1])


def best_threshold(match: ClassMatch) -> Threshold:
    """The score from which on F1 is highest; NaN where nothing is right.

    It is optimistic: the threshold is chosen on the pictures it is measured on.
    """
    if not match.right[0].any():
        return Threshold(*[float("nan")] * 4)
    rows = _every_threshold(match)
    return Threshold(*rows[np.argmax(rows[:, 3])].tolist())


def reporting_threshold(match: ClassMatch) -> Threshold:
    """The lowest score at which F1 is not worse than the highest by more than chance explains; NaN as there.

    Of few labels the highest F1 may lie anywhere on a flat curve, at 0.99 even, where little is found in other
    pictures. F1 of G labels is known to about half of one over the root of G; at most a tenth is given away.
    """
    best = best_threshold(match)
    if not np.isfinite(best.score):
        return best
    rows = _every_threshold(match)
    margin = min(0.1, 0.5 / np.sqrt(len(match.true_pictures)))
    return Threshold(*rows[rows[:, 3] >= best.f1 - margin][-1].tolist())


def at_score(match: ClassMatch, score: float) -> Threshold:
    """What reporting from a given score on gives, at IoU 0.5; rates as those of `Counts`."""
    counts = counts_at(match, score)
    return Threshold(score, counts.precision, counts.recall, counts.f1)


def recall_by_size(
    matches: Sequence[ClassMatch],
    thresholds: Mapping[str, float],
    scale: Floats,
    edges: Sequence[float],
) -> dict[str, tuple[SizeRow, ...]]:
    """Each class's recall by the longer side of its labels, in units of `scale` (P,) per pixel of each picture.

    Labels in pictures whose scale is NaN are left out; bins without labels as well.
    """
    table: dict[str, tuple[SizeRow, ...]] = {}
    for match in matches:
        sides = (match.true_boxes_px[:, 2:] - match.true_boxes_px[:, :2]).max(axis=1) * scale[
            match.true_pictures
        ]
        reported = match.true_scores >= thresholds[match.label]
        rows = []
        for low, high in pairwise(edges):
            inside = (sides >= low) & (sides < high)
            if inside.any():
                counts = (inside, inside & reported, inside & np.isfinite(match.true_scores))
                rows.append(SizeRow(float(low), float(high), *(int(each.sum()) for each in counts)))
        table[match.label] = tuple(rows)
    return table


def confusion(
    matches: Sequence[ClassMatch], thresholds: Mapping[str, float]
) -> tuple[CountTable, tuple[Mistake, ...]]:
    """(C + 1, C + 1) true class by reported class, the last row and column being background; and every mistake.

    First each class's own matches at IoU 0.5; then what is left, best first, takes what is left of other classes at IoU
    0.5 or more. The rest of the reported are false alarms (last row), the rest of the labels are missed (last column).
    """
    size = len(matches)
    table: CountTable = np.zeros((size + 1, size + 1), np.int64)
    wrong: list[tuple[float, int, int]] = []  # score, class, detection
    missed: dict[int, list[tuple[int, int]]] = {}  # picture -> class, label
    for k, match in enumerate(matches):
        reported = match.scores >= thresholds[match.label]
        table[k, k] = int((reported & match.right[0]).sum())
        wrong += [
            (float(match.scores[d]), k, d)
            for d in np.flatnonzero(reported & ~match.right[0] & ~match.ignored[0]).tolist()
        ]
        for g in np.flatnonzero(~(match.true_scores >= thresholds[match.label])).tolist():
            missed.setdefault(int(match.true_pictures[g]), []).append((k, g))
    mistakes = []
    for _, k, d in sorted(wrong, key=lambda row: (-row[0], row[1], row[2])):
        mistake, taken = _wrong_detection(
            matches, k, d, missed.get(int(matches[k].pictures[d]), [])
        )
        if taken is not None:
            missed[mistake.picture].remove(taken)
        table[size if taken is None else taken[0], k] += 1
        mistakes.append(mistake)
    for picture, rows in missed.items():
        for c, g in rows:
            table[c, size] += 1
            box = matches[c].true_boxes_px[g]
            score = float(np.nan_to_num(matches[c].true_scores[g]))
            place = tuple(box.tolist())
            mistakes.append(Mistake("miss", picture, place, "", score, matches[c].label))
    return table, tuple(mistakes)


def _wrong_detection(
    matches: Sequence[ClassMatch], k: int, d: int, missed: Sequence[tuple[int, int]]
) -> tuple[Mistake, tuple[int, int] | None]:
    """What detection d of class k is: a confusion with one of its picture's missed (class, label), which is named, or
    a false alarm."""
    match, picture = matches[k], int(matches[k].pictures[d])
    box, score = match.boxes_px[d], float(match.scores[d])
    place = tuple(box.tolist())
    left = [row for row in missed if row[0] != k]
    overlaps = iou_matrix(
        box[None], np.reshape([matches[c].true_boxes_px[g] for c, g in left], (-1, 4))
    )[0]
    if len(left) and overlaps.max() >= IOUS[0]:
        c, g = left[int(np.argmax(overlaps))]
        return Mistake("confusion", picture, place, match.label, score, matches[c].label), (c, g)
    near = [
        iou_matrix(box[None], each.true_boxes_px[each.true_pictures == picture]).max(initial=0.0)
        for each in matches
    ]
    return Mistake(
        "false alarm", picture, place, match.label, score, overlap=float(max(near))
    ), None


def _candidates(found: Sequence[Detections], judged: Sequence[str]) -> list[Json]:
    rows: list[Json] = []
    for index, detections in enumerate(found):
        for box, score, name in zip(
            detections.boxes_px, detections.scores.tolist(), detections.names
        ):
            if name in judged:
                rows.append(
                    _annotation(len(rows) + 1, index, judged.index(name), box) | {"score": score}
                )
    return rows


def _annotation(row_id: int, picture: int, category: int, box: BoxesPx) -> Json:
    left, top, right, bottom = (float(edge) for edge in box)
    return {
        "id": row_id,
        "image_id": picture,
        "category_id": category,
        "iscrowd": 0,
        "bbox": [left, top, right - left, bottom - top],
        "area": (right - left) * (bottom - top),
    }


def _indexed(dataset: Json) -> COCO:
    records = COCO()
    records.dataset = dataset
    records.createIndex()
    return records


def _numbers(precision: Floats) -> CocoNumbers:
    """COCO's averages of (IoU, recall, class, area); -1 stands where there is no label."""

    def mean(part: Floats) -> float:
        known = part[part > -1]
        return float(known.mean()) if known.size else float("nan")

    every = precision[..., 0]
    sizes = (mean(precision[..., area]) for area in (1, 2, 3))
    return CocoNumbers(mean(every), mean(every[0]), mean(every[5]), *sizes)


def _class_match(
    name: str,
    rows: Sequence[Json | None],
    judge: COCOeval,
    truth_rows: Mapping[int, tuple[int, BoxesPx]],
) -> ClassMatch:
    """The class's pictures of COCO's evaluation (all areas) as columns."""
    seen = [row for row in rows if row is not None]
    # COCO's ids of the labels that are not to be ignored, one picture after another
    true_ids = [
        gt
        for row in seen
        for gt, ignored in zip(row["gtIds"], np.asarray(row["gtIgnore"]))
        if not ignored
    ]
    scores = np.array(list(chain.from_iterable(row["dtScores"] for row in seen)), np.float64)
    ids = chain.from_iterable(row["dtIds"] for row in seen)
    boxes = np.array([judge.cocoDt.anns[dt]["bbox"] for dt in ids], np.float64).reshape(-1, 4)
    boxes[:, 2:] += boxes[:, :2]
    pictures = np.array([row["image_id"] for row in seen for _ in row["dtIds"]], np.int64)
    matched, ignored = _by_iou(seen, "dtMatches"), _by_iou(seen, "dtIgnore") > 0
    right = (matched > 0) & ~ignored
    # (N,) where each of `ids` (N,) stands among the wanted; -1 for what does not
    ids = matched[0]
    row_of = {each: row for row, each in enumerate(true_ids)}
    found = np.array([row_of.get(int(each), -1) for each in ids], np.int64)
    true_scores = np.full(len(true_ids), np.nan)
    true_scores[found[found >= 0]] = scores[found >= 0]
    order = np.argsort(-scores, kind="mergesort")
    return ClassMatch(
        name,
        scores[order],
        pictures[order],
        boxes[order].astype(np.float32),
        right[:, order],
        ignored[:, order],
        found[order],
        np.array([truth_rows[gt][0] for gt in true_ids], np.int64),
        np.array([truth_rows[gt][1] for gt in true_ids], np.float32).reshape(-1, 4),
        true_scores,
    )


def _by_iou(rows: Sequence[Json], key: str) -> Floats:
    """(10, D) one of COCO's results for the detections of all pictures, at each of IOUS."""
    return np.concatenate(
        [np.zeros((len(IOUS), 0)), *(np.reshape(row[key], (len(IOUS), -1)) for row in rows)], axis=1
    )
