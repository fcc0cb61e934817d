"""The figures of a search: several flights together, coverage, sweep width, and probability of success.

Source of the terms: Koopman, Search and Screening (1946); the National Search and Rescue Manual's POS = POA x POD.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask
from sorvolo.search.recall import Chances


@dataclass(frozen=True)
class SearchFigures:
    """Of one class over the wanted ground. Chances count unseen ground as 0.

    `pod` with its interval is the chance that one who lay anywhere in the area was found, by all flights together.
    `swept_m2` is the ground times its chance, summed over the flights: effort adds up, even over the same ground.
    `coverage` is that over the area, so it may exceed 1. `sweep_width_m` is all ground that the flights saw, within the
    area or not, times its chance, over the path of all flights; NaN without a path, or where no cell was seen.
    `random_pod` is what Koopman's formula of random search, 1 - exp(-coverage), makes of it.
    """

    area_m2: float
    seen_m2: float
    pod: float
    pod_low: float
    pod_high: float
    swept_m2: float
    sweep_width_m: float
    coverage: float
    random_pod: float


@dataclass(frozen=True)
class Segment:
    """A piece of the area with the probability that the missing is in it: POA, POD and POS = POA x POD.

    `left` is the probability that the missing is in it and was not found.
    """

    name: str
    poa: float
    pod: float
    pos: float
    left: float
    area_m2: float
    seen_m2: float


def together(flights: Sequence[Chances]) -> Chances:
    """One or more flights over the same cells: 1 - prod(1 - p), the flights taken as independent looks.

    What no flight saw stays NaN. The bounds are those of all flights being as bad, or as good, as they may be.
    """
    seen = np.any([np.isfinite(each.mean) for each in flights], axis=0)
    mean, low, high = (
        np.where(
            seen,
            1 - np.prod([1 - np.nan_to_num(getattr(each, name)) for each in flights], axis=0),
            np.nan,
        )
        for name in ("mean", "low", "high")
    )
    return Chances(mean, low, high)


def figures(
    flights: Sequence[Chances], wanted: Mask, cell_m: float, path_m: float
) -> SearchFigures:
    """The figures of the wanted cells, (N,), of one or more flights; `path_m` is how far their cameras flew in all."""
    cell_m2 = cell_m**2
    inside = np.asarray(wanted, bool)
    area_m2 = float(inside.sum()) * cell_m2
    total = together(flights)
    mean, low, high = (np.nan_to_num(each[inside]) for each in (total.mean, total.low, total.high))
    swept_m2 = sum(float(np.nansum(each.mean[inside])) for each in flights) * cell_m2
    anywhere_m2 = sum(float(np.nansum(each.mean)) for each in flights) * cell_m2
    is_seen = any(np.isfinite(each.mean).any() for each in flights)
    width_m = anywhere_m2 / path_m if path_m > 0 and is_seen else float("nan")
    coverage = swept_m2 / area_m2 if area_m2 else 0.0
    pod, pod_low, pod_high = (
        float(each.mean()) if len(each) else 0.0 for each in (mean, low, high)
    )
    return SearchFigures(
        area_m2,
        float(np.isfinite(total.mean[inside]).sum()) * cell_m2,
        pod,
        pod_low,
        pod_high,
        swept_m2,
        width_m,
        coverage,
        float(1 - np.exp(-coverage)),
    )


def segment(
    name: str, poa: float, chances: Chances, inside: Mask, cell_m: float, area_m2: float
) -> Segment:
    """A segment's figures. `inside` (N,) are its cells; ground of it beyond all cells, of `area_m2`, was not seen."""
    sum_of_chances = float(np.nansum(chances.mean[inside])) * cell_m**2
    pod = min(1.0, sum_of_chances / area_m2) if area_m2 else 0.0
    seen_m2 = float(np.isfinite(chances.mean[inside]).sum()) * cell_m**2
    return Segment(name, poa, pod, poa * pod, poa * (1 - pod), area_m2, min(seen_m2, area_m2))


def path_length_m(places_m: Sequence[Floats]) -> float:
    """The length over ground of a way over places, (2,) or (3,) each, in order."""
    return (
        float(np.hypot(*np.diff(np.array(places_m)[:, :2], axis=0).T).sum())
        if len(places_m) > 1
        else 0.0
    )
