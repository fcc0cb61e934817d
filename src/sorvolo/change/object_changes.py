"""People, cars and things that a detector found on one date alone (0086)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.survey.findings import ChangeKind
from sorvolo.survey.map_objects import MapObject, SearchedFrames, looked_at


@dataclass(frozen=True, eq=False)
class SearchedGround:
    """What a detector found on one date, and the frames of its searches."""

    objects: Sequence[MapObject] = ()
    searches: Sequence[SearchedFrames] = ()


def on_one_date(
    before: SearchedGround, after: SearchedGround
) -> Iterator[tuple[ChangeKind, MapObject]]:
    """The objects that stood on one date and not on the other, where that was searched for their class as well:
    appeared or disappeared. What moves, or has no known size, is left out."""
    for kind, own, other in (
        (ChangeKind.APPEARED, after, before),
        (ChangeKind.DISAPPEARED, before, after),
    ):
        standing = [each for each in own.objects if not each.moving and np.isfinite(each.length_m)]
        places_m = np.array([each.position_m for each in standing]).reshape(-1, 2)
        was_searched = looked_at(places_m, [each.label for each in standing], other.searches)
        for each, is_searched in zip(standing, was_searched):
            if is_searched and not any(each.stands_where(old) for old in other.objects):
                yield kind, each
