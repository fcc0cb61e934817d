"""One object while it is followed: what was seen of it so far, and the track that it makes."""

from dataclasses import dataclass, field

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.survey.objects import Sighting, Track
from sorvolo.tracking.motion import MOVES, Motions

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
        clearness = _clearness(sighting)
        if clearness > self._clearest:
            self.best, self._clearest = sighting, clearness
        self.last_ns = sighting.time_ns
        self._extend_path(sighting.time_ns)

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
        self._join_counts(other)
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

    def _join_counts(self, other: "Followed") -> None:
        for counts, others in ((self.together, other.together), (self.apart, other.apart)):
            for neighbour, count in others.items():
                counts[neighbour] = counts.get(neighbour, 0) + count
            for own in (self.id, other.id):
                counts.pop(own, None)

    def _extend_path(self, time_ns: int) -> None:
        self.path_m.append(self.place_m)
        self.path_ns.append(time_ns)
        if len(self.path_m) > _MOST_PATH:
            self.path_m, self.path_ns = self.path_m[::2], self.path_ns[::2]


def _clearness(sighting: Sighting) -> float:
    """How well a sighting shows its object: sure, and large in the picture."""
    left, top, right, bottom = sighting.box_px.tolist()
    return float(sighting.score * max((right - left) * (bottom - top), 1.0) ** 0.25)


def _is_near(reported_m: PointsM, place_m: PointsM, shared_m2: float) -> bool:
    """Whether a place has moved by too little to be reported anew."""
    east, north = reported_m[0] - place_m[0], reported_m[1] - place_m[1]
    return bool(east * east + north * north < 0.01 * shared_m2 + 1e-4)
