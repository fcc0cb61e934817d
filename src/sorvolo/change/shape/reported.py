"""Changes as they are reported: around the things alone, as uncertain as the map, without what a person rejected."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from sorvolo.change.shape.outlines import KnownPlace, is_known, measures
from sorvolo.change.shape.place_sigma import area_sigma_m, thing_sigma_m
from sorvolo.change.shape.shadows import without_shadow
from sorvolo.survey.findings import Change, ChangeKind


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
