"""Pictures from straight above looked at several times, each time turned: what the looks agree on."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.detection.session import Seen
from sorvolo.geometry.arrays import BoxesPx, Floats, ImageRGB, Matrix3, Rows
from sorvolo.geometry.box_overlap import iou_matrix


@dataclass(frozen=True)
class LookSettings:
    """How pictures from above are looked at. The thresholds on models' cards (`turned`) hold for these values.

    From straight above nothing is upright, but networks that learnt from photos know people upright: a second look a
    quarter turned finds others, and few mistakes look alike in both.
    """

    quarters: tuple[int, ...] = (0, 1)  # quarter turns, one for each look
    # of the optical axis: 37 degrees off straight down or less is from above
    least_down: float = 0.8
    # boxes of one class that overlap more are one object, as COCO counts them
    same_iou: float = 0.5
    unseen: float = 0.02  # the score of what a look does not show: models report nothing below it


def is_from_above(site_from_camera: Matrix3, settings: LookSettings = LookSettings()) -> bool:
    """Whether a camera of this rotation (3, 3) looks about straight down."""
    return -float(site_from_camera[2, 2]) >= settings.least_down


def turned(picture: ImageRGB, quarters: int) -> ImageRGB:
    """A picture (H, W, 3) turned counter-clockwise by this many quarters."""
    return np.ascontiguousarray(np.rot90(picture, quarters))


def turned_back(boxes_px: BoxesPx, quarters: int, size_px: tuple[int, int]) -> BoxesPx:
    """Boxes (N, 4) of a turned picture in the picture as it was, (height, width) `size_px`."""
    height, width = size_px
    left, top, right, bottom = boxes_px.T
    columns = {
        0: (left, top, right, bottom),
        1: (width - bottom, left, width - top, right),
        2: (width - right, height - bottom, width - left, height - top),
        3: (top, height - right, bottom, height - left),
    }[quarters % 4]
    return np.column_stack(columns).astype(np.float32).reshape(-1, 4)


def agreed(looks: Sequence[Seen], settings: LookSettings = LookSettings()) -> Seen:
    """What several looks at one picture saw, each object once, best first.

    Boxes of a class that overlap are one object, at most one of each look. Its score is the mean over all looks, so
    that what only one of them shows counts less; its box the mean of the looks' boxes by their scores.
    """
    boxes = np.concatenate([each.boxes_px for each in looks]).astype(np.float64)
    scores = np.concatenate([each.scores for each in looks])
    labels = np.concatenate([each.labels for each in looks])
    of_look = np.repeat(np.arange(len(looks)), [len(each.scores) for each in looks])
    kept: list[tuple[Floats, float, int]] = []
    for label in np.unique(labels).tolist():
        rows = np.flatnonzero(labels == label)
        rows = rows[np.argsort(-scores[rows], kind="stable")]
        for group in alike(boxes[rows], settings.same_iou):
            members = rows[group]
            best = np.full(len(looks), settings.unseen)
            np.maximum.at(best, of_look[members], scores[members])
            kept.append(
                (
                    np.average(boxes[members], axis=0, weights=scores[members]),
                    float(best.mean()),
                    label,
                )
            )
    order = sorted(range(len(kept)), key=lambda k: -kept[k][1])
    return Seen(
        np.array([kept[k][0] for k in order], np.float32).reshape(-1, 4),
        np.array([kept[k][1] for k in order]),
        np.array([kept[k][2] for k in order], np.int64),
    )


def alike(boxes_px: Floats, same_iou: float) -> Iterator[Rows]:
    """Rows of boxes (N, 4) that are one object: of what is left the first, and all that overlap it more than so."""
    overlap = iou_matrix(boxes_px, boxes_px)
    is_free = np.ones(len(boxes_px), bool)
    for first in range(len(boxes_px)):
        if is_free[first]:
            others = np.flatnonzero(is_free & (overlap[first] > same_iou))
            group = np.concatenate([[first], others[others != first]])
            is_free[group] = False
            yield group
