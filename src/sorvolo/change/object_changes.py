"""People, cars and things that a detector found on one date alone (0086)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats
from sorvolo.survey.findings import ChangeKind
from sorvolo.survey.map_objects import MapObject, looked_at


@dataclass(frozen=True)
class SameObjectSettings:
    """When the objects of two dates are one."""

    beside: float = 0.4  # of its own length, an object of the other date at most lies from it
    beside_m: float = 0.5  # and this much more: a person who turned


@dataclass(frozen=True, eq=False)
class SearchedGround:
    """What a detector found on one date, and the outlines on the ground of the frames that it searched, (N, 4, 2) for
    each of its searches."""

    objects: Sequence[MapObject] = ()
    searched_m: Sequence[Floats] = ()


def on_one_date(
    before: SearchedGround, after: SearchedGround, settings: SameObjectSettings = SameObjectSettings(),
) -> Iterator[tuple[ChangeKind, MapObject]]:
    """The objects that stood on one date and not on the other, where that was searched as well: appeared or
    disappeared. What moves, or has no known size, is left out."""
    for kind, own, other in (
        (ChangeKind.APPEARED, after, before), (ChangeKind.DISAPPEARED, before, after),
    ):
        standing = [each for each in own.objects if not each.moving and np.isfinite(each.length_m)]
        places_m = np.array([each.position_m for each in standing]).reshape(-1, 2)
        outlines_m = np.concatenate([np.zeros((0, 4, 2)), *other.searched_m])
        others_m = np.array([each.position_m for each in other.objects if not each.moving]).reshape(-1, 2)
        for each, is_searched in zip(standing, looked_at(places_m, outlines_m)):
            reach_m = settings.beside * each.length_m + settings.beside_m
            if is_searched and not (np.hypot(*(others_m - each.position_m).T) <= reach_m).any():
                yield kind, each
