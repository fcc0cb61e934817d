"""Labelled pictures: their objects as people, or a simulation, mark them; training and evaluation read these."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import BoxesPx, Labels, frozen
from sorvolo.survey.flight import Notice


@dataclass(frozen=True, eq=False)
class LabelledPicture:
    """One picture's labels. `path` is the picture's file as text; `group` its video or flight: neighbours share it.

    `boxes_px` (N, 4) as BoxesPx, within the picture; `labels` (N,) index the set's classes. `ignored_px` (M, 4) are
    regions where nothing is to be learnt nor counted (crowds, other classes, "do not care"). `m_per_px` is the ground
    sampling distance, NaN where unknown.
    """

    path: str
    width_px: int
    height_px: int
    group: str
    boxes_px: BoxesPx
    labels: Labels
    ignored_px: BoxesPx
    m_per_px: float = float("nan")

    def __post_init__(self) -> None:
        object.__setattr__(self, "boxes_px", frozen(np.reshape(self.boxes_px, (-1, 4)), np.float32))
        object.__setattr__(
            self, "ignored_px", frozen(np.reshape(self.ignored_px, (-1, 4)), np.float32)
        )
        object.__setattr__(self, "labels", frozen(np.reshape(self.labels, -1), np.int64))
        if len(self.boxes_px) != len(self.labels):
            raise InputError(
                f"{self.path}: {len(self.boxes_px)} boxes but {len(self.labels)} labels"
            )


@dataclass(frozen=True, eq=False)
class LabelledSet:
    """Pictures with labels of the same classes. `unlabelled` names classes that may be in the pictures without a label:
    a detection of one is neither right nor wrong there, and no such picture is a negative for it.
    """

    name: str
    classes: tuple[str, ...]
    pictures: tuple[LabelledPicture, ...]
    unlabelled: frozenset[str] = frozenset()
    notices: tuple[Notice, ...] = ()

    def __len__(self) -> int:
        return len(self.pictures)

    def only(self, pictures: Sequence[LabelledPicture]) -> "LabelledSet":
        """The same set with fewer pictures."""
        return LabelledSet(self.name, self.classes, tuple(pictures), self.unlabelled)
