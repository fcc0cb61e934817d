"""The offsets that all frames of a flight share: how far each is free, and which of them a flight shows to be real."""

import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats
from sorvolo.mosaic.bundle import SHARED
from sorvolo.mosaic.graph_settings import OffsetSettings, PoseGraphSettings
from sorvolo.mosaic.normal_equations import Factors

_GROUPS = ((2,), (5, 6), (7,))  # of SHARED: altitude's zero, tilt, heading; judged together


def shared_sigma(settings: PoseGraphSettings, as_reported: NDArray[np.bool_]) -> Floats:
    """(8,) prior sigma of each shared unknown; those taken as reported, (8,) bool, are held close to zero."""
    tilt, heading = np.radians([settings.tilt_offset_sigma_deg, settings.heading_offset_sigma_deg])
    sigma = np.array(
        [
            settings.focal_sigma,
            settings.radial_sigma,
            settings.altitude_offset_sigma_m,
            settings.gps_offset_sigma_m,
            settings.gps_offset_sigma_m,
            tilt,
            tilt,
            heading,
        ]
    )
    return np.where(as_reported, np.minimum(sigma, _held_sigma(settings.offsets)), sigma)


def unconfirmed(
    shared: Floats, sigma: Floats, factors: Factors, settings: OffsetSettings
) -> list[int]:
    """The offsets, as indices of SHARED, that a flight does not show: telemetry is taken as it reports them.

    An offset that all frames share (altitude's zero, gimbal, compass) and that the rest of the flight sees at less than
    two of its own sigmas is noise: left free, it would only turn, tilt or scale the whole map. `shared` (8,) are the
    offsets found with the priors `sigma` (8,), `factors` the normal equations, whose last unknowns they are.
    """
    variances = shared_variances(factors)
    silent = set()
    for k in (k for group in _GROUPS for k in group):
        if not 0 < sigma[k] < settings.widest_sigma:
            continue
        variance = max(float(variances[k]), 1e-30)
        information = 1 / variance - 1 / sigma[k] ** 2  # of the flight alone, without the prior
        estimate = shared[k] / variance / information if information > 0 else 0.0
        if estimate**2 * max(information, 0.0) <= settings.least_sigmas**2:
            silent.add(k)
    return [k for group in _GROUPS if silent.issuperset(group) for k in group]


def shared_variances(factors: Factors) -> Floats:
    """(8,) of the shared unknowns, the last of the normal equations."""
    units = np.zeros((factors.size, len(SHARED)))
    units[-len(SHARED) :] = np.eye(len(SHARED))
    return np.diag(factors.solve(units)[-len(SHARED) :])


def _held_sigma(settings: OffsetSettings) -> Floats:
    """(8,) prior sigma of an offset that is taken as telemetry reports it."""
    tilt_rad = settings.tilt_rad
    return np.array(
        [
            np.inf,
            np.inf,
            settings.altitude_m,
            np.inf,
            np.inf,
            tilt_rad,
            tilt_rad,
            settings.heading_rad,
        ]
    )
