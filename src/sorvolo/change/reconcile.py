"""Changes of several sources made one list, each piece of ground reported once."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sorvolo.change.outlines import KnownPlace, area_sigma_m, is_known, measures, thing_sigma_m
from sorvolo.change.things import without_shadow
from sorvolo.survey.findings import Change, ChangeKind
from sorvolo.survey.map_objects import MapObject, SearchedFrames, looked_at


def reported(
    changes: Iterable[Change], map_sigma_m: float, rejected: Sequence[KnownPlace]
) -> list[Change]:
    """The changes without their shadows, with their sigmas in the map, and in the world, the map's own joined; m per
    axis.

    Those at places in `rejected` are left out: a person rejected them on an earlier flight.
    """
    finished = [each if each.kind is ChangeKind.AREA else without_shadow(each) for each in changes]
    return [
        _with_sigmas(each, map_sigma_m)
        for each in finished
        if not is_known(each.outline_m, each.kind, rejected)
    ]


def _with_sigmas(change: Change, map_sigma_m: float) -> Change:
    """The change with what its outline errs by joined: that which is reported, not the one with a shadow or of a whole
    that was parted."""
    size = measures(change.outline_m)
    outline_sigma_m = area_sigma_m(size) if change.kind is ChangeKind.AREA else thing_sigma_m(size)
    in_map_m = float(np.hypot(change.sigma_m, outline_sigma_m))
    return replace(change, sigma_in_map_m=in_map_m, sigma_m=float(np.hypot(in_map_m, map_sigma_m)))


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
