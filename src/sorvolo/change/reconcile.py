"""Changes of several sources made one list, each piece of ground reported once."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from sorvolo.change.gathered import GatheredThings
from sorvolo.change.outlines import (
    KnownPlace,
    area_sigma_m,
    dilated,
    is_known,
    mask_of,
    measures,
    thing_sigma_m,
)
from sorvolo.change.things import without_shadow
from sorvolo.geometry.arrays import PointsM
from sorvolo.survey.findings import Change, ChangeKind, Patch

# When a change is a part of an area, or an area only changes.
_INSIDE = 0.7  # share of a change within an area: it is a part of it ...
_STANDS_OUT = 1.5  # ... unless it differs by so many spreads of the ground around
_EXPLAINED = 0.5  # share of an area within things: it is nothing more than they


def reconcile(
    changes: Sequence[Change],
    areas: Sequence[Change],
    gathered: GatheredThings | None,
    id_prefix: str,
    numbers: Iterator[int],
) -> list[Change]:
    """Make one list of what all finders claim, each piece of ground reported once.

    `gathered` is what all views together show, None where that is not asked: it keeps things within areas, and goes on
    as the changes that it holds, under the next of `numbers` where it holds none.
    """
    if gathered is None:
        return with_areas(changes, areas)
    claims = with_areas(changes, areas, gathered.lies_apart)
    return gathered.conclude(id_prefix, numbers, claims)


def with_areas(
    changes: Sequence[Change],
    areas: Sequence[Change],
    lies_apart: Callable[[PointsM], bool] = lambda _: False,
) -> list[Change]:
    """Changes and areas, each piece of ground reported once.

    A change that is a part of an area is left out, unless it is a thing that stands out from the ground around it on
    either date, or whose outline, (N, 2), `lies_apart` by evidence of another kind. An area that things explain for the
    most part is left out itself.
    """
    parts = [
        each
        for each in changes
        if each.kind is not ChangeKind.MOVING
        and any(_inside(each, area.outline_m) > _INSIDE for area in areas)
        and not _is_thing(each.patch, _STANDS_OUT)
    ]
    things = [each for each in changes if each not in parts]
    still = [each for each in things if each.kind is not ChangeKind.MOVING]
    kept = [area for area in areas if _explained(area, still) < _EXPLAINED]
    return things + [each for each in parts if lies_apart(each.outline_m)] + kept


def _explained(area: Change, things: Sequence[Change]) -> float:
    """The share of an area that lies within things."""
    shape, site_from_patch = area.patch.changed.shape, area.patch.site_from_patch
    own, theirs = mask_of(area.outline_m, site_from_patch, shape), np.zeros(shape, bool)
    for each in things:
        theirs |= mask_of(each.outline_m, site_from_patch, shape)
    return float((own & theirs).sum() / max(1, own.sum()))


def _inside(change: Change, outline_m: PointsM) -> float:
    """The share of a change that lies within an outline, (N, 2)."""
    shape, site_from_patch = change.patch.changed.shape, change.patch.site_from_patch
    own, theirs = (mask_of(each, site_from_patch, shape) for each in (change.outline_m, outline_m))
    return float((own & theirs).sum() / max(1, own.sum()))


def _is_thing(patch: Patch, stands_out: float) -> bool:
    """Whether what changed differs from the ground around it by more than that ground varies, before or after."""
    reach = max(3, round(0.15 * max(patch.changed.shape)))
    near = dilated(patch.changed, 2 * reach + 1)
    for picture in (patch.before, patch.after):
        known = picture[..., 3] > 0
        ring, own = near & ~patch.changed & known, patch.changed & known
        if np.count_nonzero(ring) < 20 or not own.any():
            continue
        levels = np.log2(picture[..., :3].astype(np.float32) + 8.0)
        spread = levels[ring].std(axis=0) + 0.1
        contrast = np.median(levels[own], axis=0) - np.median(levels[ring], axis=0)
        if float(np.abs(contrast / spread).max()) > stands_out:
            return True
    return False


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
