"""What stands on a map: each object once, however many frames of a flight saw it."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, Mask, PointsM, Rows, frozen
from sorvolo.survey.mosaic import PlacedFrame

_LOOKS = 2  # frames that must show a place before what was not found there is not there


@dataclass(frozen=True, eq=False)
class MapObject:
    """One object on the map of one flight.

    `id` is the flight's name and a number, "flight1-o3". `label` is the class with the most of the summed scores,
    `score` that of its being there, by all frames that could show it (of what moves the mean where it was seen),
    `class_scores` the share of each class. `position_m` (2,) east,
    north in the site frame is the middle of its foot; of what moves, where it was last seen. `sigma_m` is the one-sigma
    error of the place per axis, what the whole flight errs in common included; NaN where unknown. `length_m` and
    `width_m` are its longer and shorter side seen from above, NaN on a site without metres. `views` frames saw it of
    `possible_views` that showed its place. `velocity_m_s` (2,) east, north, is zero unless it is `moving`.
    `crop_jpeg` is the picture around its best view, `best_frame` that frame's name.
    """

    id: str
    label: str
    score: float
    position_m: Floats
    sigma_m: float
    length_m: float
    width_m: float
    views: int
    possible_views: int
    first_seen_ns: int
    last_seen_ns: int
    moving: bool = False
    velocity_m_s: Floats = field(default_factory=lambda: np.zeros(2))
    class_scores: dict[str, float] = field(default_factory=dict)
    best_frame: str = ""
    crop_jpeg: bytes = b""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_m", frozen(self.position_m))
        object.__setattr__(self, "velocity_m_s", frozen(self.velocity_m_s))
        if self.position_m.shape != (2,) or not np.isfinite(self.position_m).all():
            raise GeometryError(
                f"object {self.id}: a place is two finite numbers, got {self.position_m}"
            )
        if not 0 <= self.score <= 1:
            raise GeometryError(f"object {self.id}: a score lies in 0 to 1, got {self.score}")
        if not 1 <= self.views <= self.possible_views:
            raise GeometryError(
                f"object {self.id}: seen {self.views} times of {self.possible_views}"
            )


@dataclass(frozen=True, eq=False)
class SearchedFrames:
    """The frames of one search by their outlines on the ground, (N, 4, 2) site metres, and by class which of them,
    (N,), were searched for it; a class that is not named in none. No `searched_for` at all: each for all classes."""

    outlines_m: Floats
    searched_for: Mapping[str, Mask] | None = None
    _trees: dict[str, shapely.STRtree] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "outlines_m", frozen(np.reshape(self.outlines_m, (-1, 4, 2))))

    @classmethod
    def of(
        cls,
        frames: Sequence[PlacedFrame],
        looked_for: Sequence[Collection[str]],
        classes: Sequence[str],
    ) -> "SearchedFrames":
        """These frames, of which each was searched for those of the classes that stand at its place in `looked_for`."""
        searched_for = {
            name: np.array([name in each for each in looked_for], bool) for name in classes
        }
        return cls(np.array([each.outline_m for each in frames]), searched_for)

    def for_class(self, label: str) -> Floats:
        """(M, 4, 2) the outlines of the frames that were searched for a class."""
        if self.searched_for is None:
            return self.outlines_m
        return self.outlines_m[self.searched_for.get(label, np.zeros(len(self.outlines_m), bool))]

    def shown(self, places_m: PointsM, label: str) -> Rows:
        """How many frames that were searched for a class show each of the places (N, 2)."""
        if label not in self._trees:
            self._trees[label] = shapely.STRtree(shapely.polygons(self.for_class(label)))
        places, _ = self._trees[label].query(shapely.points(places_m), predicate="intersects")
        return np.bincount(places, minlength=len(places_m))


@dataclass(frozen=True, eq=False)
class ObjectSearch:
    """What one flight was searched for, with which model, and all that was found.

    `looked` counts the frames, `sightings` the detections in them, `dropped` those of them that belong to no object.
    """

    model: str
    classes: tuple[str, ...]
    objects: tuple[MapObject, ...]
    frames: SearchedFrames
    looked: int
    sightings: int
    dropped: int


def looked_at(places_m: PointsM, labels: Sequence[str], searches: Sequence[SearchedFrames]) -> Mask:
    """Where, of places (N, 2), enough frames of these searches looked for that place's class for what they did not find
    not to be there."""
    result = np.zeros(len(places_m), bool)
    for label in set(labels):
        own = np.flatnonzero([each == label for each in labels])
        counts, frames = np.zeros(len(own), int), 0
        for search in searches:
            rare = np.flatnonzero(counts < _LOOKS)
            if not rare.size:
                break
            frames += len(search.for_class(label))
            counts[rare] += search.shown(places_m[own[rare]], label)
        result[own] = counts >= max(min(_LOOKS, frames), 1)
    return result
