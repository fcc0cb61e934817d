"""What missions ask of a detector, so that a test's own or a plug-in's can stand in for Sorvolo's."""

from collections.abc import Mapping, Sequence
from typing import Literal, Protocol

from sorvolo.detection.contract import ModelInfo
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.survey.flight import Notice
from sorvolo.survey.objects import Detections, Early


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
