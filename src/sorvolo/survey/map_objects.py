"""What stands on a map: each object once, however many frames of a flight saw it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, Mask, PointsM, frozen
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
            raise GeometryError(f"object {self.id}: a place is two finite numbers, got {self.position_m}")
        if not 0 <= self.score <= 1:
            raise GeometryError(f"object {self.id}: a score lies in 0 to 1, got {self.score}")
        if not 1 <= self.views <= self.possible_views:
            raise GeometryError(f"object {self.id}: seen {self.views} times of {self.possible_views}")


@dataclass(frozen=True, eq=False)
class ObjectSearch:
    """What one flight was searched for, with which model, and all that was found.

    `outlines_m` (N, 4, 2) are the outlines on the ground of the frames that were looked at, site metres. `looked`
    counts the frames, `sightings` the detections in them, `dropped` those of them that belong to no object.
    """

    model: str
    classes: tuple[str, ...]
    objects: tuple[MapObject, ...]
    outlines_m: Floats
    looked: int
    sightings: int
    dropped: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "outlines_m", frozen(np.reshape(self.outlines_m, (-1, 4, 2))))

    @classmethod
    def over(
        cls, frames: Sequence[PlacedFrame], model: str, classes: tuple[str, ...], objects: tuple[MapObject, ...],
        looked: int, sightings: int, dropped: int,
    ) -> "ObjectSearch":
        """The search of these placed frames."""
        outlines_m = np.array([each.outline_m for each in frames])
        return cls(model, classes, objects, outlines_m, looked, sightings, dropped)


def looked_at(places_m: PointsM, outlines_m: Floats) -> Mask:
    """Which places, (N, 2), lie in enough of the outlines, (M, 4, 2), of a search's frames for what it did not find
    there not to be there."""
    needed = min(_LOOKS, len(outlines_m))
    counts = np.zeros(len(places_m), int)
    for outline_m in outlines_m:
        low_m, high_m = outline_m.min(axis=0), outline_m.max(axis=0)
        ring = np.ascontiguousarray(outline_m - low_m, np.float32)
        for k in np.flatnonzero(((places_m >= low_m) & (places_m <= high_m)).all(axis=1)):
            east, north = places_m[k] - low_m
            counts[k] += cv2.pointPolygonTest(ring, (float(east), float(north)), False) >= 0
    return np.asarray((counts >= needed) & (needed > 0), bool)
