"""One object while it is followed: what was seen of it so far, and the track that it makes."""

from dataclasses import dataclass, field

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.survey.objects import Sighting, Track
from sorvolo.tracking.common_shift import FORGETS_S
from sorvolo.tracking.motion import MOVES, Motions

_MOST_PATH = 400


@dataclass(eq=False)
class AveragePlace:
    """The mean of an object's places as they were seen, and how well it is known.

    What each sighting errs alone shrinks with their number; what they share only as fast as it forgets itself.
    """

    trust: Floats = field(default_factory=lambda: np.zeros((2, 2)))
    trusted_m: Floats = field(default_factory=lambda: np.zeros(2))
    own_trust: Floats = field(default_factory=lambda: np.zeros((2, 2)))
    shared_m2: float = 0.0
    count: int = 0
    last_ns: int = 0
    alike: float = 0.0  # sum over earlier sightings of how far they err as the last one
    alike_all: float = 0.0  # the same over all pairs

    def add(self, sighting: Sighting, own_m2: Floats) -> None:
        """One more sighting with its own covariance (2, 2)."""
        trust = np.linalg.inv(sighting.covariance_m2 + 1e-9 * np.eye(2))
        self.trust = self.trust + trust
        self.trusted_m = self.trusted_m + trust @ sighting.position_m
        self.own_trust = self.own_trust + np.linalg.inv(own_m2)
        self.shared_m2 += (sighting.shared_sigma_m**2 - self.shared_m2) / (self.count + 1)
        elapsed_s = (sighting.time_ns - self.last_ns) / 1e9
        self.alike = (self.alike + 1) * float(np.exp(-abs(elapsed_s) / FORGETS_S)) if self.count else 0.0
        self.alike_all += 1 + 2 * self.alike
        self.count, self.last_ns = self.count + 1, sighting.time_ns

    def join(self, other: "AveragePlace") -> None:
        """Take in another one of the same object, seen at other times."""
        gap_s = abs(other.last_ns - self.last_ns) / 1e9
        between = 2 * self.count * other.count * float(np.exp(-gap_s / FORGETS_S))
        self.trust, self.trusted_m = self.trust + other.trust, self.trusted_m + other.trusted_m
        self.own_trust = self.own_trust + other.own_trust
        total = self.count + other.count
        self.shared_m2 = (self.shared_m2 * self.count + other.shared_m2 * other.count) / total
        self.alike_all += other.alike_all + between
        self.count, self.last_ns = total, max(self.last_ns, other.last_ns)

    @property
    def place_m(self) -> PointsM:
        """(2,)."""
        return np.linalg.solve(self.trust, self.trusted_m)

    @property
    def covariance_m2(self) -> Floats:
        """(2, 2)."""
        shared = self.shared_m2 * self.alike_all / self.count**2
        return np.asarray(np.linalg.inv(self.own_trust) + shared * np.eye(2))


@dataclass(eq=False)
class Followed:
    """A track while it grows; only the tracker changes it. `motion` is one row at `motion_ns`, in the tracker's map.

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
    views: int = 0
    passes: int = 1
    is_out: bool = False  # of the frames' view since it was last seen
    score_sum: float = 0.0
    scores: dict[str, float] = field(default_factory=dict)
    average: AveragePlace = field(default_factory=AveragePlace)
    log_sides: Floats = field(default_factory=lambda: np.zeros(2))
    looks: Floats | None = None
    path_m: list[PointsM] = field(default_factory=list)
    path_ns: list[int] = field(default_factory=list)
    together: dict[int, int] = field(default_factory=dict)  # neighbours by id: frames that saw both
    apart: dict[int, int] = field(default_factory=dict)  # neighbours by id: frames that could see both and saw one
    _told: Track | None = None

    @property
    def place_m(self) -> PointsM:
        """(2,) in the map, at `motion_ns`."""
        return self.motion.places_m[0]

    @property
    def rough(self) -> tuple[float, float, float, float, int]:
        """East, north and velocity, zero unless it moves, at a time in ns: for a first look at who is near."""
        east, north = self.place_m
        velocity = self.motion.means[0, MOVES, 2:] if self.moves else (0.0, 0.0)
        return float(east), float(north), float(velocity[0]), float(velocity[1]), self.motion_ns

    @property
    def moves(self) -> bool:
        """Whether it moves more likely than not."""
        return bool(self.motion.weights[0, MOVES] > 0.5)

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

    def record(self, sighting: Sighting, own_m2: Floats, looks: Floats | None) -> None:
        """Remember a sighting; its motion has been corrected with it."""
        self._told = None
        self.views += 1
        self.score_sum += sighting.score
        self.vote(sighting.label, sighting.score)
        self.average.add(sighting, own_m2)
        sides = np.log(np.maximum(sighting.size_m, 1e-3))
        self.log_sides = self.log_sides + (sides - self.log_sides) / self.views
        if looks is not None:
            self.looks = looks if self.looks is None else self.looks + (looks - self.looks) / self.views
        if _clearness(sighting) > _clearness(self.best):
            self.best = sighting
        self.last_ns = sighting.time_ns
        self._extend_path(sighting.time_ns)

    def join(self, other: "Followed") -> None:
        """Take in another track of the same object; the one seen last says where it is."""
        if other.motion_ns >= self.motion_ns and other.last_ns >= self.last_ns:
            self.motion, self.motion_ns = other.motion, other.motion_ns
        later = other.first_ns > self.last_ns
        self.passes += other.passes if later else 0
        self.evidence = max(self.evidence, other.evidence)
        self.score_sum += other.score_sum
        for label, score in other.scores.items():
            self.vote(label, score)
        self.average.join(other.average)
        total = self.views + other.views
        self.log_sides = (self.log_sides * self.views + other.log_sides * other.views) / total
        self.views = total
        self.confirmed |= other.confirmed
        self.ended &= other.ended
        self.is_out &= other.is_out
        for counts, others in ((self.together, other.together), (self.apart, other.apart)):
            for neighbour, count in others.items():
                counts[neighbour] = counts.get(neighbour, 0) + count
            for own in (self.id, other.id):
                counts.pop(own, None)
        self._told = None
        self.best = max(self.best, other.best, key=_clearness)
        self.first_ns, self.last_ns = min(self.first_ns, other.first_ns), max(self.last_ns, other.last_ns)
        order = np.argsort([*self.path_ns, *other.path_ns], kind="stable")
        places = [*self.path_m, *other.path_m]
        times = [*self.path_ns, *other.path_ns]
        self.path_m, self.path_ns = [places[row] for row in order], [times[row] for row in order]

    def track(self) -> Track:
        """As it is known now."""
        if self._told is None or self._told.confirmed != self.confirmed:
            self._told = self._tell()
        return self._told

    def _tell(self) -> Track:
        total = sum(self.scores.values())
        path_m, path_ns = np.array(self.path_m), self.path_ns
        if self.moves:
            shared_m2 = self.average.shared_m2 * np.eye(2)
            place_m, covariance = self.place_m, self.motion.place_covariances_m2[0] + shared_m2
            velocity = self.motion.means[0, MOVES, 2:]
        else:
            place_m, covariance, velocity = self.average.place_m, self.average.covariance_m2, np.zeros(2)
            path_m, path_ns = place_m[None], [self.last_ns]
        return Track(
            self.id, self.label, self.score_sum / self.views, self.confirmed, self.moves, self.first_ns, self.last_ns,
            self.views, self.passes, place_m, covariance, velocity, self.sides_m, self.best, path_m.reshape(-1, 2),
            np.array(path_ns), {label: score / total for label, score in sorted(self.scores.items())},
        )

    def _extend_path(self, time_ns: int) -> None:
        self.path_m.append(self.place_m)
        self.path_ns.append(time_ns)
        if len(self.path_m) > _MOST_PATH:
            self.path_m, self.path_ns = self.path_m[::2], self.path_ns[::2]


def _clearness(sighting: Sighting) -> float:
    """How well a sighting shows its object: sure, and large in the picture."""
    left, top, right, bottom = sighting.box_px
    return float(sighting.score * max((right - left) * (bottom - top), 1.0) ** 0.25)
