"""When two tracks, or two boxes of one frame, are one object."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import BoxesPx, Floats, PointsM
from sorvolo.geometry.box_overlap import iou_matrix, nesting_matrix
from sorvolo.survey.objects import Detections
from sorvolo.tracking.followed import Followed
from sorvolo.tracking.motion import MOVES, log_density, predicted

WITHIN = 0.9
"""Share of the smaller of two boxes of a class that lies in the other from which on they show one object: of 174 such
pairs in validation pictures 4 were two."""


@dataclass(frozen=True)
class JoiningSettings:
    """When two boxes of a frame, or two tracks, are one object."""

    same_box: float = (
        0.6  # overlap of two boxes from which they show one object, whatever their classes
    )
    least_nested: float = 0.5  # overlap of boxes of two classes, one within the other, from which they show one object
    within: float = WITHIN
    frames_apart: int = 5  # of two neighbours of which each frame sees one
    overlap: float = (
        0.5  # nearer than this share of their longer sides two bodies have no room: ...
    )
    frames_overlapping: int = 2  # ... fewer frames do
    together_share: float = (
        0.15  # of frames with one of them: what is seen together more often is two objects
    )
    least_class_fit: float = 0.1  # 0 to 1, how alike the classes of two tracks are
    least_views: int = 4  # of a mover whose velocity is to be trusted


def frame_doubles(
    boxes_px: BoxesPx | Floats,
    labels: Sequence[str],
    scores: Floats,
    settings: JoiningSettings = JoiningSettings(),
) -> dict[int, int]:
    """Rows whose box shows what a stronger row shows: weaker row to stronger row; (N, 4), N and N of one frame.

    It overlaps that box, or lies within it or around it: of the same class always, of another one if it is not much
    smaller, for a bag beside a person or a person in a car is a thing of its own.
    """
    if len(labels) < 2:
        return {}
    boxes, names = np.asarray(boxes_px, np.float64), np.array(labels)
    overlap = iou_matrix(boxes, boxes)
    is_nested = nesting_matrix(boxes, boxes) > settings.within
    is_alike = (names[:, None] == names[None]) | (overlap > settings.least_nested)
    same = (overlap > settings.same_box) | (is_nested & is_alike)
    doubles: dict[int, int] = {}
    order = np.argsort(-np.asarray(scores, np.float64), kind="stable")
    for place, row in enumerate(order):
        for stronger in order[:place]:
            if same[row, stronger] and int(stronger) not in doubles:
                doubles[int(row)] = int(stronger)
                break
    return doubles


def without_doubles(found: Detections) -> tuple[Detections, list[int]]:
    """A frame's detections, each object's surest one only, and their rows in `found`."""
    doubles = frame_doubles(found.boxes_px, found.names, found.scores)
    rows = [row for row in range(len(found)) if row not in doubles]
    return found.only(np.array(rows, int)), rows


def inward_m(outline_m: PointsM, points_m: PointsM) -> Floats:
    """(N,) how deep points lie within a convex outline (4, 2), corners in either turn; below 0 outside."""
    edges = np.roll(outline_m, -1, axis=0) - outline_m
    lengths = np.maximum(np.linalg.norm(edges, axis=1), 1e-9)
    away = points_m[:, None] - outline_m[None]
    side = (edges[None, :, 0] * away[..., 1] - edges[None, :, 1] * away[..., 0]) / lengths
    middle = outline_m.mean(axis=0) - outline_m
    turn = np.sign(np.sum(edges[:, 0] * middle[:, 1] - edges[:, 1] * middle[:, 0]))
    return np.asarray((side * turn).min(axis=1))


def neighbours(
    first: Sequence[Followed], second: Sequence[Followed], reach_m: float
) -> Iterator[tuple[Followed, Followed]]:
    """Pairs of different tracks that lie within `reach_m` of each other."""
    if not first or not second:
        return
    a = np.array([each.place_m for each in first])
    b = np.array([each.place_m for each in second])
    for row, column in np.argwhere(np.linalg.norm(a[:, None] - b[None], axis=2) < reach_m):
        if first[row] is not second[column]:
            yield first[row], second[column]


def double_of(
    followed: Followed,
    by_id: Mapping[int, Followed],
    reach_m: float,
    settings: JoiningSettings = JoiningSettings(),
) -> Followed | None:
    """The track of the same object that ran beside this one: frames see one of both, never both.

    Of another class it must lie where there is no room for two: the detector takes it now for this, now for that.
    """
    for neighbour, frames in followed.apart.items():
        other = by_id.get(neighbour)
        if other is None or followed.together.get(neighbour, 0) > settings.together_share * frames:
            continue
        apart_m = float(np.linalg.norm(other.place_m - followed.place_m))
        overlaps = apart_m < settings.overlap * min(followed.sides_m[0], other.sides_m[0])
        if frames < (settings.frames_overlapping if overlaps else settings.frames_apart):
            continue
        is_alike = _class_fit(followed, other) > settings.least_class_fit
        if apart_m < reach_m and (is_alike or (overlaps and frames >= settings.frames_apart)):
            return other
    return None


def earlier_mover(
    followed: Followed,
    others: Sequence[Followed],
    new_per_m2: float,
    settings: JoiningSettings = JoiningSettings(),
) -> Followed | None:
    """The moving track, out of sight since before this one began, whose prediction this one continues best.

    None where it is more likely something new: by the density of places and velocities of unseen movers.
    """
    if followed.views < settings.least_views:
        return None
    best, most = None, 0.0
    state, spread = followed.motion.means[0, MOVES], followed.motion.covariances[0, MOVES]
    speed, moving_share = followed.motion.habits[0, 0], followed.motion.habits[0, 2]
    new = np.log(new_per_m2 * moving_share) + log_density(state[2:], speed**2 * np.eye(2))
    for other in others:
        if other is followed or not other.confirmed or other.last_ns >= followed.first_ns:
            continue
        if other.id in followed.together:
            continue
        ahead = predicted(other.motion, np.array([(followed.motion_ns - other.motion_ns) / 1e9]))
        gap = state - ahead.means[0, MOVES]
        fit = log_density(gap, spread + ahead.covariances[0, MOVES]) + np.log(
            max(_class_fit(followed, other), 1e-3)
        )
        gain = float(fit + np.log(ahead.weights[0, MOVES]) - new)
        if gain > most:
            best, most = other, gain
    return best


def _class_fit(first: Followed, second: Followed) -> float:
    """How alike the classes of two tracks are, 0 to 1."""
    totals = sum(first.scores.values()) * sum(second.scores.values())
    common = sum(score * second.scores.get(label, 0.0) for label, score in first.scores.items())
    return common / max(totals, 1e-12)
