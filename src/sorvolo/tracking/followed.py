"""One object while it is followed: what was seen of it, the track it makes, and when two are one."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sorvolo.geometry.arrays import BoxesPx, Floats, PointsM
from sorvolo.geometry.box_overlap import iou_matrix, nesting_matrix
from sorvolo.survey.objects import Detections, Sighting, Track
from sorvolo.tracking.motion import MOVES, Motions, log_density, predicted

_MOST_PATH = 400  # places of a track, which bounds its memory


@dataclass(eq=False)
class Followed:
    """A track while it grows; only the tracker changes it. `motion` is one row at `motion_ns`, in the tracker's map.

    Of it come `moves`, whether it does more likely than not, `place_m` (2,), and `rough`: east, north, their speeds
    (zero unless it moves) and the time in ns, for a first look at who is near.

    `evidence` is a log odds for its being there: sightings add to it, frames that show its place without it take away.
    """

    id: int
    motion: Motions
    motion_ns: int
    evidence: float
    first_ns: int
    last_ns: int
    best: Sighting
    confirmed: bool = False
    ended: bool = False
    was_missed: bool = False  # by a frame that shows its place whole
    views: int = 0
    passes: int = 1
    is_out: bool = False  # of the frames' view since it was last seen
    score_sum: float = 0.0
    scores: dict[str, float] = field(default_factory=dict)
    log_sides: Floats = field(default_factory=lambda: np.zeros(2))
    looks: Floats | None = None
    path_m: list[PointsM] = field(default_factory=list)
    path_ns: list[int] = field(default_factory=list)
    together: dict[int, int] = field(default_factory=dict)  # neighbours by id: frames that saw both
    apart: dict[int, int] = field(
        default_factory=dict
    )  # neighbours by id: frames that could see both and saw one
    moves: bool = field(init=False)
    place_m: PointsM = field(init=False)
    rough: tuple[float, ...] = field(init=False)
    _clearest: float = 0.0
    _reported: Track | None = None

    def __post_init__(self) -> None:
        self.go_on(self.motion, self.motion_ns)

    def go_on(self, motion: Motions, time_ns: int) -> None:
        """Take its motion at a time over."""
        self.motion, self.motion_ns = motion, time_ns
        self.moves = bool(motion.weights[0, MOVES] > 0.5)
        self.place_m = motion.places_m[0]
        velocity = motion.means[0, MOVES, 2:].tolist() if self.moves else (0.0, 0.0)
        self.rough = (*self.place_m.tolist(), *velocity, float(time_ns))

    @property
    def label(self) -> str:
        """The class with the most of the summed scores."""
        return max(self.scores, key=lambda name: (self.scores[name], name))

    @property
    def sides_m(self) -> Floats:
        """(2,) longer and shorter side."""
        return np.exp(self.log_sides)

    def vote(self, label: str, score: float) -> None:
        """A box for its class."""
        self.scores[label] = self.scores.get(label, 0.0) + score

    def record(self, sighting: Sighting, looks: Floats | None) -> None:
        """Remember a sighting; its motion has been corrected with it."""
        self._reported = None
        self.views += 1
        self.score_sum += sighting.score
        self.vote(sighting.label, sighting.score)
        sides = np.log(np.maximum(sighting.size_m, 1e-3))
        self.log_sides = self.log_sides + (sides - self.log_sides) / self.views
        if looks is not None:
            self.looks = (
                looks if self.looks is None else self.looks + (looks - self.looks) / self.views
            )
        # How well a sighting shows its object: sure, and large in the picture.
        left, top, right, bottom = sighting.box_px.tolist()
        clearness = float(sighting.score * max((right - left) * (bottom - top), 1.0) ** 0.25)
        if clearness > self._clearest:
            self.best, self._clearest = sighting, clearness
        self.last_ns = sighting.time_ns
        self.path_m.append(self.place_m)
        self.path_ns.append(sighting.time_ns)
        if len(self.path_m) > _MOST_PATH:
            self.path_m, self.path_ns = self.path_m[::2], self.path_ns[::2]

    def join(self, other: "Followed") -> None:
        """Take in another track of the same object; the one seen last gives its place."""
        if other.motion_ns >= self.motion_ns and other.last_ns >= self.last_ns:
            self.go_on(other.motion, other.motion_ns)
        later = other.first_ns > self.last_ns
        self.passes += other.passes if later else 0
        self.evidence = max(self.evidence, other.evidence)
        self.score_sum += other.score_sum
        for label, score in other.scores.items():
            self.vote(label, score)
        total = self.views + other.views
        self.log_sides = (self.log_sides * self.views + other.log_sides * other.views) / total
        self.views = total
        self.confirmed |= other.confirmed
        self.ended &= other.ended
        self.was_missed |= other.was_missed
        self.is_out &= other.is_out
        for counts, others in ((self.together, other.together), (self.apart, other.apart)):
            for neighbour, count in others.items():
                counts[neighbour] = counts.get(neighbour, 0) + count
            for own in (self.id, other.id):
                counts.pop(own, None)
        self._reported = None
        if other._clearest > self._clearest:
            self.best, self._clearest = other.best, other._clearest
        self.first_ns, self.last_ns = (
            min(self.first_ns, other.first_ns),
            max(self.last_ns, other.last_ns),
        )
        order = np.argsort([*self.path_ns, *other.path_ns], kind="stable")
        places = [*self.path_m, *other.path_m]
        times = [*self.path_ns, *other.path_ns]
        self.path_m, self.path_ns = [places[row] for row in order], [times[row] for row in order]

    def shift(self, step_m: Floats) -> None:
        """Move it in the map, (2,)."""
        motion = self.motion
        means = motion.means.copy()
        means[:, :, :2] += step_m
        self.go_on(
            Motions(means, motion.covariances, motion.weights, motion.habits), self.motion_ns
        )
        self.path_m = [place + step_m for place in self.path_m] if self.moves else self.path_m

    def track(self, shared_m2: float) -> Track:
        """As it is known now; its place in the map has an error of `shared_m2` per axis beside its own."""
        place_m = self.place_m
        reported = self._reported
        if (
            reported is not None
            and reported.confirmed == self.confirmed
            and _is_near(reported.position_m, place_m, shared_m2)
        ):
            return reported
        total = sum(self.scores.values())
        path_m, path_ns = (
            (np.array(self.path_m), self.path_ns) if self.moves else (place_m[None], [self.last_ns])
        )
        self._reported = Track(
            self.id,
            self.label,
            self.score_sum / self.views,
            self.confirmed,
            self.moves,
            self.first_ns,
            self.last_ns,
            self.views,
            self.passes,
            place_m,
            self.motion.place_covariances_m2[0] + shared_m2 * np.eye(2),
            self.motion.means[0, MOVES, 2:] if self.moves else np.zeros(2),
            self.sides_m,
            self.best,
            path_m.reshape(-1, 2),
            np.array(path_ns),
            {label: score / total for label, score in sorted(self.scores.items())},
        )
        return self._reported


def _is_near(reported_m: PointsM, place_m: PointsM, shared_m2: float) -> bool:
    """Whether a place has moved by too little to be reported anew."""
    east, north = reported_m[0] - place_m[0], reported_m[1] - place_m[1]
    return bool(east * east + north * north < 0.01 * shared_m2 + 1e-4)


WITHIN = 0.9
"""Share of the smaller of two boxes of a class that lies in the other from which on they show one object: of 174 such
pairs in validation pictures 4 were two."""


_SAME_BOX = 0.6  # overlap of two boxes from which they show one object, whatever their classes
# overlap of boxes of two classes, one within the other, from which they show one object
_LEAST_NESTED = 0.5
_WITHIN = WITHIN
_FRAMES_APART = 5  # of two neighbours of which each frame sees one
_OVERLAP = 0.5  # nearer than this share of their longer sides two bodies have no room: ...
_FRAMES_OVERLAPPING = 2  # ... fewer frames do
# of frames with one of them: what is seen together more often is two objects
_TOGETHER_SHARE = 0.15
_LEAST_CLASS_FIT = 0.1  # 0 to 1, how alike the classes of two tracks are
_LEAST_VIEWS = 4  # of a mover whose velocity is to be trusted


def frame_doubles(
    boxes_px: BoxesPx | Floats,
    labels: Sequence[str],
    scores: Floats,
) -> dict[int, int]:
    """Rows whose box shows what a stronger row shows: weaker row to stronger row; (N, 4), N and N of one frame.

    It overlaps that box, or lies within it or around it: of the same class always, of another one if it is not much
    smaller, for a bag beside a person or a person in a car is a thing of its own.
    """
    if len(labels) < 2:
        return {}
    boxes, names = np.asarray(boxes_px, np.float64), np.array(labels)
    overlap = iou_matrix(boxes, boxes)
    is_nested = nesting_matrix(boxes, boxes) > _WITHIN
    is_alike = (names[:, None] == names[None]) | (overlap > _LEAST_NESTED)
    same = (overlap > _SAME_BOX) | (is_nested & is_alike)
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
    return (side * turn).min(axis=1)


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
) -> Followed | None:
    """The track of the same object that ran beside this one: frames see one of both, never both.

    Of another class it must lie where there is no room for two: the detector takes it now for this, now for that.
    """
    for neighbour, frames in followed.apart.items():
        other = by_id.get(neighbour)
        if other is None or followed.together.get(neighbour, 0) > _TOGETHER_SHARE * frames:
            continue
        apart_m = float(np.linalg.norm(other.place_m - followed.place_m))
        overlaps = apart_m < _OVERLAP * min(followed.sides_m[0], other.sides_m[0])
        if frames < (_FRAMES_OVERLAPPING if overlaps else _FRAMES_APART):
            continue
        is_alike = _class_fit(followed, other) > _LEAST_CLASS_FIT
        if apart_m < reach_m and (is_alike or (overlaps and frames >= _FRAMES_APART)):
            return other
    return None


def earlier_mover(
    followed: Followed,
    others: Sequence[Followed],
    new_per_m2: float,
) -> Followed | None:
    """The moving track, out of sight since before this one began, whose prediction this one continues best.

    None where it is more likely something new: by the density of places and velocities of unseen movers.
    """
    if followed.views < _LEAST_VIEWS:
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
