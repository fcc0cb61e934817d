"""What missions ask of a detector, and how a stranger's own becomes one: by a single method, `detect`."""

from collections.abc import Mapping, Sequence
from typing import Literal, Protocol, cast
from uuid import uuid4

import numpy as np

from sorvolo.build import added
from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.detector import Detector
from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.survey.flight import Notice
from sorvolo.survey.objects import Detections, Early

_BEST_PX = (8.0, 1e4)  # longer sides that a stranger's detector may find: nothing is known of it


class FindsObjects(Protocol):
    """The least that a mission needs of a detector; `as_detector` makes an `ObjectDetector` of it."""

    def detect(self, image: ImageRGB, /) -> Detections:
        """The objects in one picture, uint8 RGB (H, W, 3)."""


class ObjectDetector(Protocol):
    """Something that finds objects in pictures; `detection.detector.Detector` is one."""

    @property
    def classes(self) -> tuple[str, ...]:
        """The names of the classes that it detects, in the order of its labels."""

    @property
    def info(self) -> ModelInfo:
        """The model's own description."""

    @property
    def others(self) -> tuple[tuple[ModelInfo, int], ...]:
        """The models that looked at pictures in its place, or a second time, and how often each has."""

    @property
    def provider(self) -> str:
        """Where it runs, in words."""

    @property
    def notices(self) -> tuple[Notice, ...]:
        """What a user should know of the pictures seen so far."""

    def thresholds_for(
        self,
        picture: ImageRGB,
        *,
        from_above: bool = False,
        m_per_px: float | None = None,
    ) -> Mapping[str, float]:
        """From which score on each class is reported that is looked for in a picture (H, W, 3) like this."""

    def rest(self) -> None:
        """Give back memory that is kept for the next picture; it may be asked for more pictures later."""

    def detect(
        self,
        image: ImageRGB,
        *,
        tiles: Literal["auto"] | int | None = None,
        m_per_px: float | None = None,
        least_score: float | None = None,
        classes: Sequence[str] | None = None,
        from_above: bool = False,
        overlapping: bool = False,
        early: Early | None = None,
        is_part: bool = False,
    ) -> Detections:
        """The objects in one picture, (H, W, 3), best first.

        `tiles` cuts a large picture: "auto" by `m_per_px` (the ground's sampling distance), a number of pixels a side,
        or None for the picture as a whole. None for `least_score` means each class's own; for `classes`, all.
        `from_above`: the camera looked about straight down. `overlapping`: others show the same, so that none is worth
        much time. `early` may be given classes, and all that is found of them, while the picture is still searched for
        others. `is_part`: it is part of a frame, or made from frames, and counts as none in the notices.
        """


class PlainDetector:
    """A detector of which only `detect(image)` is known: uint8 RGB (H, W, 3) in, `Detections` out.

    `classes` and `version` are read from it where it has them. Without `classes` it is asked once, with a grey picture.
    Without `version` every run with it counts as a new one: nobody can know whether it is still the same.
    """

    def __init__(self, given: FindsObjects) -> None:
        self._given = given
        self.classes: tuple[str, ...] = tuple(
            getattr(given, "classes", None)
            or self._found(np.full((64, 64, 3), 114, np.uint8)).classes
        )
        self.info = ModelInfo(
            getattr(given, "name", type(given).__name__),
            self.classes,
            dict.fromkeys(self.classes, 0.0),
            dict.fromkeys(self.classes, _BEST_PX),
            version=str(getattr(given, "version", uuid4().hex)),
        )
        self.others: tuple[tuple[ModelInfo, int], ...] = ()
        self.notices: tuple[Notice, ...] = ()
        self.provider = f"{type(given).__module__}.{type(given).__qualname__}"

    def thresholds_for(self, picture: ImageRGB, **_: object) -> Mapping[str, float]:
        """From which score on each class is reported: all of its reports are."""
        return self.info.thresholds

    def rest(self) -> None:
        """Nothing is kept between pictures."""

    def detect(
        self,
        image: ImageRGB,
        *,
        least_score: float | None = None,
        classes: Sequence[str] | None = None,
        **_: object,
    ) -> Detections:
        """The objects in one picture, (H, W, 3). Raises SettingsError for a class that it did not name before."""
        found = self._found(image)
        names = found.names
        if unknown := set(names) - set(self.classes):
            raise SettingsError(
                f"{self.provider} found {min(unknown)!r}, but names {', '.join(self.classes)}: give it the attribute "
                "`classes`"
            )
        wanted = self.classes if classes is None else classes
        keep = [
            row
            for row, name in enumerate(names)
            if name in wanted and found.scores[row] >= (least_score or 0.0)
        ]
        keep.sort(key=lambda row: -found.scores[row])
        labels = np.array([self.classes.index(names[row]) for row in keep], np.int64)
        return Detections(found.boxes_px[keep], found.scores[keep], labels, self.classes)

    def _found(self, image: ImageRGB) -> Detections:
        found = self._given.detect(image)
        if not isinstance(found, Detections):
            raise SettingsError(
                f"`detect` of {type(self._given).__qualname__} gave {type(found).__name__}; needed is sorvolo.Detections"
            )
        return found


def as_detector(given: FindsObjects) -> ObjectDetector:
    """A detector as missions use it; of what has `detect` alone, a `PlainDetector`. Raises SettingsError for others."""
    if not hasattr(given, "detect"):
        raise SettingsError(
            f"{given!r} is no detector: it has no `detect`; give for instance sorvolo.Detector.load()"
        )
    if hasattr(given, "info"):
        return cast(ObjectDetector, given)
    return PlainDetector(given)


def load_detector(name: str) -> ObjectDetector:
    """An installed model, a model file, or a detector that another package adds to `sorvolo.detectors`.

    Raises InputError for what is not there or cannot be used.
    """
    load = added("detectors").get(name)
    return as_detector(load()()) if load else Detector.load(name)
