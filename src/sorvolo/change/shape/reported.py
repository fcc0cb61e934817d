"""Changes as they are reported: around the things alone, as uncertain as the map, without what a person rejected."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from sorvolo.change.shape.outlines import KnownPlace, is_known
from sorvolo.change.shape.shadows import without_shadow
from sorvolo.survey.findings import Change, ChangeKind


def reported(changes: Iterable[Change], map_sigma_m: float, rejected: Sequence[KnownPlace]) -> list[Change]:
    """The changes without their shadows, with their sigmas in the map, and in the world, the map's own joined; m per
    axis.

    Those at places in `rejected` are left out: a person rejected them on an earlier flight.
    """
    finished = [each if each.kind is ChangeKind.AREA else without_shadow(each) for each in changes]
    return [
        replace(each, sigma_in_map_m=each.sigma_m, sigma_m=float(np.hypot(each.sigma_m, map_sigma_m)))
        for each in finished
        if not is_known(each.outline_m, each.kind, rejected)
    ]
