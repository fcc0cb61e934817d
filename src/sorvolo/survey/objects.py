"""People, cars and small objects: seen in a picture, placed on the ground, and followed over time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import BoxesPx, Floats, Labels, Mask, Rows, TimesNs, frozen

CLASSES = ("person", "car", "small object")
"""The classes of Sorvolo's own models, in the order of their labels; other models bring their own names."""

PERSON = CLASSES[0]
"""The class whose finding every mission reports at once."""

TYPICAL_SIZE_M = {
    "person": (0.6, 0.5, 1.7),
    "car": (4.4, 1.8, 1.5),
    "small object": (0.6, 0.45, 0.35),
    "truck": (8.0, 2.5, 3.2),
    "bus": (12.0, 2.55, 3.2),
}
"""Length, width and height of a class's usual member; how high the middle of a box lies above the ground. Trucks and
buses are classes of models that were trained on them."""


@dataclass(frozen=True, eq=False)
class Detections:
    """What a detector saw in one picture, best first: columns of equal length, one row an object.

    `boxes_px` (N, 4) as BoxesPx, within the picture; `scores` (N,) 0 to 1; `labels` (N,) index `classes`.
    """

    boxes_px: BoxesPx
    scores: Floats
    labels: Labels
    classes: tuple[str, ...]

    def __post_init__(self) -> None:
        boxes = frozen(np.reshape(self.boxes_px, (-1, 4)), np.float32)
        object.__setattr__(self, "boxes_px", boxes)
        object.__setattr__(self, "scores", frozen(self.scores))
        object.__setattr__(self, "labels", frozen(self.labels, np.int64))
        object.__setattr__(self, "classes", tuple(self.classes))
        if not len(boxes) == len(self.scores) == len(self.labels):
            raise GeometryError(
                f"{len(boxes)} boxes, {len(self.scores)} scores, {len(self.labels)} labels"
            )
        if len(self.labels) and not 0 <= self.labels.min() <= self.labels.max() < len(self.classes):
            raise GeometryError(f"labels must index the {len(self.classes)} classes")

    def __len__(self) -> int:
        return len(self.scores)

    @property
    def names(self) -> list[str]:
        """Each row's class by name."""
        return [self.classes[label] for label in self.labels]

    def only(self, keep: Mask | Rows | Sequence[int]) -> "Detections":
        """The rows that a mask or indices keep."""
        index = np.asarray(keep) if len(keep) else np.zeros(0, int)  # [] would be floats
        return Detections(
            self.boxes_px[index], self.scores[index], self.labels[index], self.classes
        )

    def to_supervision(self) -> Any:
        """The same as `supervision.Detections` (pip install supervision)."""
        import supervision

        return supervision.Detections(
            xyxy=np.array(self.boxes_px),
            confidence=np.array(self.scores, np.float32),
            class_id=np.array(self.labels),
            data={"class_name": np.array(self.names, str)},
        )

    @classmethod
    def from_supervision(cls, found: Any, classes: Sequence[str] | None = None) -> "Detections":
        """Of `supervision.Detections`, best first. Its own class names are used where `classes` gives none.

        Raises GeometryError where neither names the classes.
        """
        named = found.data.get("class_name")
        if classes is None and named is None and len(found):
            raise GeometryError(
                "these detections name no classes: give `classes`, in the order of their ids"
            )
        scores = np.ones(len(found)) if found.confidence is None else np.asarray(found.confidence)
        order = np.argsort(-scores, kind="stable")
        if classes is None:
            names = [str(name) for name in (() if named is None else named)]
            classes = tuple(dict.fromkeys(names))
            labels = np.array([classes.index(name) for name in names], np.int64)
        else:
            labels = np.asarray(found.class_id, np.int64)
        return cls(found.xyxy[order], scores[order], labels[order], tuple(classes))

    def surest(self, most: int) -> "Detections":
        """At most this many rows, those of the highest scores first."""
        return self.only(np.argsort(-self.scores, kind="stable")[:most])


Early: TypeAlias = Callable[[tuple[str, ...], Detections], None]
"""Is given some of the classes that are searched for, and what was found of them: all that will be."""


def no_detections(classes: Sequence[str]) -> Detections:
    """An empty picture's."""
    return Detections(
        np.zeros((0, 4), np.float32), np.zeros(0), np.zeros(0, np.int64), tuple(classes)
    )


@dataclass(frozen=True, eq=False)
class Sighting:
    """One detection laid on the ground: where one object was when one frame was taken.

    `position_m` (2,) east, north in the site frame with `covariance_m2` (2, 2). Of a flight that nothing places, one
    unit is a pixel of its segment's first frame, with the camera's motion taken out (as a local Site). `shared_sigma_m`
    is the part of the error that all sightings of a frame, and of its neighbours in time, have in common (GPS,
    heading), within `covariance_m2`. `size_m` (2,) is the longer and the shorter side of the box on the ground.
    `box_px` (4,) as BoxesPx.
    """

    frame_index: int
    frame_name: str
    time_ns: int
    label: str
    score: float
    box_px: BoxesPx
    position_m: Floats
    covariance_m2: Floats
    size_m: Floats
    shared_sigma_m: float = 0.0

    def __post_init__(self) -> None:
        for name, shape in (("position_m", (2,)), ("covariance_m2", (2, 2)), ("size_m", (2,))):
            array = frozen(getattr(self, name))
            object.__setattr__(self, name, array)
            if array.shape != shape or not np.isfinite(array).all():
                raise GeometryError(
                    f"a sighting's {name} must be {shape} finite numbers, got {array}"
                )
        object.__setattr__(self, "box_px", frozen(self.box_px, np.float32))

    @property
    def sigma_m(self) -> float:
        """One sigma per axis, the mean of both."""
        return float(np.sqrt(np.trace(self.covariance_m2) / 2))


@dataclass(frozen=True, eq=False)
class Track:
    """One object, counted once, however many frames, passes and returns saw it; as it is known now.

    `id` counts from 1 within a flight. `label` is the class with the most of the summed scores, `score` its mean score
    where it was seen, `class_scores` the share of each class. `position_m` (2,) with `covariance_m2` (2, 2) is where
    it was when last seen (all its views together where it stands still), `velocity_m_s` (2,) east, north, zero where
    it stands. `views` counts frames, `passes` the times that it came into view. `best` is its clearest sighting.
    `path_m` (M, 2) and `path_ns` (M,) are its smoothed places, thinned. `confirmed` once enough views agree; only
    confirmed tracks count.
    """

    id: int
    label: str
    score: float
    confirmed: bool
    moving: bool
    first_seen_ns: int
    last_seen_ns: int
    views: int
    passes: int
    position_m: Floats
    covariance_m2: Floats
    velocity_m_s: Floats
    size_m: Floats
    best: Sighting
    path_m: Floats
    path_ns: TimesNs
    class_scores: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("position_m", "covariance_m2", "velocity_m_s", "size_m", "path_m"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        object.__setattr__(self, "path_ns", frozen(self.path_ns, np.int64))

    @property
    def sigma_m(self) -> float:
        """One sigma of the place per axis, the mean of both."""
        return float(np.sqrt(np.trace(self.covariance_m2) / 2))

    @property
    def apart_sigma_m(self) -> float:
        """The same beside the flight's other tracks, without what may move all of them, as a clock that is off."""
        return min(self.sigma_m, self.best.sigma_m)
