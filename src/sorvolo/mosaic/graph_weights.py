"""How far links and telemetry are believed, learnt from how they depart from the map that they make together."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask, Rows
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.mosaic.bundle import Linked, Nodes, Pairs, linearise, rotation_vector
from sorvolo.mosaic.graph_rows import NodeRows

_ENOUGH = 8  # frames from which telemetry's own errors are learnt


@dataclass(frozen=True, eq=False)
class Trust:
    """Factors on telemetry's stated sigmas, (3,) each, and the nodes whose angles are plainly wrong."""

    place: Floats = field(default_factory=lambda: np.ones(3))
    attitude: Floats = field(default_factory=lambda: np.ones(3))
    contradicted: Rows = field(default_factory=lambda: np.zeros(0, int))


@dataclass(frozen=True, eq=False)
class LinkNoise:
    """What each of L links shows: its noise across the parallax, px, and the relief along it, m; (L,) each."""

    across_px: Floats
    relief_m: Floats

    def is_false(self, typical_px: float) -> Mask:
        """(L,) where a link cannot be true, if most links' noise is `typical_px`."""
        return self.across_px > max(6.0, 8 * typical_px)


def link_noise(nodes: Nodes, pairs: Linked, shared: Floats) -> LinkNoise:
    """The noise of at least one link, by the cameras as they stand."""
    found = [_noise(nodes, some, shared) for some in pairs.batches()]
    return LinkNoise(
        np.concatenate([each.across_px for each in found]),
        np.concatenate([e.relief_m for e in found]),
    )


def miss_px(nodes: Nodes, pairs: Linked, shared: Floats) -> Iterator[tuple[Rows, Rows, Floats]]:
    """Of some links after the others their old and new nodes, (l,) each, and how far each pair is transferred amiss,
    (l, K); NaN where there is none."""
    for some in pairs.batches():
        miss = np.linalg.norm(linearise(nodes, some, shared).residual_px, axis=-1)
        miss[some.weight <= 0] = np.nan
        yield some.old, some.new, miss


def telemetry_trust(rows: NodeRows, tied: Mask, miss_m: Floats) -> Trust:
    """How good telemetry really is, from how it departs from the pictures, once there are enough of them.

    Fixes and angles scatter more or less than they claim, and both are scaled to what they show. Angles that are
    plainly wrong are left out one by one. `tied` (N,): the flight's keyframes that have links; `miss_m` (N, 3): their
    cameras' distance from telemetry's places.
    """
    stated_m, stated_rad = rows.stated_sigma_m, rows.stated_sigma_rad
    error_rad = rotation_vector(rows.prior_rotations.transpose(0, 2, 1) @ rows.rotations)
    size = np.linalg.norm(error_rad, axis=1)
    angled = np.isfinite(stated_rad[:, 2])
    contradicted = np.flatnonzero(
        tied & angled & (size > np.maximum(5 * stated_rad.max(axis=1), np.radians(15)))
    )
    used = tied & angled
    used[contradicted] = False
    return Trust(
        _place_factors(stated_m, tied, miss_m),
        _attitude_factors(stated_rad, used, error_rad),
        contradicted,
    )


def _place_factors(stated_m: Floats, tied: Mask, miss_m: Floats) -> Floats:
    place = np.ones(3)
    fixed = tied & np.isfinite(stated_m[:, 0])
    if fixed.sum() >= _ENOUGH:
        ratio = np.linalg.norm(miss_m[fixed, :2], axis=1) / stated_m[fixed, 0] / 1.1774
        place[:2] = np.clip(np.median(ratio), 0.5, 20.0)
    high = tied & np.isfinite(stated_m[:, 2])
    if high.sum() >= _ENOUGH:
        times = SIGMA_PER_MEDIAN_DEVIATION * np.median(np.abs(miss_m[high, 2]) / stated_m[high, 2])
        place[2] = np.clip(times, 0.5, 20.0)
    return place


def _attitude_factors(stated_rad: Floats, used: Mask, error_rad: Floats) -> Floats:
    if used.sum() < _ENOUGH:
        return np.ones(3)
    scatter = error_rad[used] - np.median(error_rad[used], axis=0)
    spread = SIGMA_PER_MEDIAN_DEVIATION * np.median(np.abs(scatter), axis=0)
    # pictures see heading well, tilt hardly: a small scatter of tilt only shows that it was believed
    return np.asarray(np.clip(spread / np.median(stated_rad[used], axis=0), [1.0, 1.0, 0.25], 5.0))


def _noise(nodes: Nodes, pairs: Pairs, shared: Floats) -> LinkNoise:
    line = linearise(nodes, pairs, shared)
    length = np.linalg.norm(line.parallax, axis=-1)
    along = line.parallax / np.maximum(length, 1e-9)[..., None]
    miss_along = np.abs((line.residual_px * along).sum(-1))
    miss_across = np.abs(
        line.residual_px[..., 0] * along[..., 1] - line.residual_px[..., 1] * along[..., 0]
    )
    unused = pairs.weight <= 0
    with np.errstate(all="ignore"):
        across = SIGMA_PER_MEDIAN_DEVIATION * np.nanmedian(
            np.where(unused, np.nan, miss_across), axis=1
        )
        sigma_along = SIGMA_PER_MEDIAN_DEVIATION * np.nanmedian(
            np.where(unused, np.nan, miss_along), axis=1
        )
        reach = np.nanmedian(np.where(unused, np.nan, length), axis=1)
    return LinkNoise(
        across, np.sqrt(np.maximum(sigma_along**2 - across**2, 0)) / np.maximum(reach, 1e-6)
    )
