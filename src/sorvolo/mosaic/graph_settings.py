"""What the pose graph may move, when it solves, and how well a flight's own figures are known beforehand."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class FlightPriors:
    """What is believed of every flight's calibration and telemetry before its pictures are looked at, one sigma."""

    calibrated: float = 0.005  # relative: a focal length known so well is held
    radial: float = 0.03  # of a lens that nobody calibrated
    free_m: float = 1e4  # a zero of heights that nothing is known of
    gps_offset_m: float = 5.0  # of a receiver, the same all flight
    tilt_offset_deg: float = 2.0  # a gimbal's zero, or a camera's mount
    heading_offset_deg: float = 5.0  # a drone's compass beside its motors


@dataclass(frozen=True)
class SharedOffsetSettings:
    """When an offset that all frames share is real, and how close to zero one is held that is not."""

    altitude_m: float = 0.1
    tilt_rad: float = 0.002
    heading_rad: float = 0.003
    least_sigmas: float = 2.0  # of its own, without the prior: less is noise
    widest_sigma: float = (
        100.0  # of the prior, m or rad: a wider one is no belief that a flight could confirm
    )


PAIRS_PER_LINK = 40  # matches that stand for a link, spread over it
INDEPENDENT_PAIRS = 20.0  # matches of one link share lens and relief errors: they count as so many
WINDOW = 6  # recent keyframes freed by each local solve
UNEVEN = (
    0.002  # relief left between linked pictures over the height: level ground 0.0003, hills 0.004
)
STRAINED = (
    3.0  # times a link's believed noise: the ground around it cannot be laid without bending more
)


@dataclass(frozen=True)
class PoseGraphSettings:
    """What the graph may move and when it solves."""

    sigma_px: float = (
        0.3  # floor of a match's noise; calibration and rolling shutter never are better
    )
    region: int = 120  # keyframes; a larger flight is solved around its newest ones only, until it ends or is strained
    focal_sigma: float = 0.0  # relative; 0 holds the focal length
    radial_sigma: float = 0.0  # prior of the left-over radial distortion; 0 holds it
    altitude_offset_sigma_m: float = 1.0  # how well the altitude's zero is known to be the ground
    gps_offset_sigma_m: float = (
        0.0  # > 0 when a known map fixes the datum instead of this flight's GPS
    )
    tilt_offset_sigma_deg: float = (
        0.0  # of gimbal or mount against the vertical, the same all flight
    )
    heading_offset_sigma_deg: float = 0.0  # of the compass, the same all flight
    offsets: SharedOffsetSettings = SharedOffsetSettings()

    @classmethod
    def of_flight(
        cls,
        focal_sigma: float,
        altitude_offset_sigma_m: float | None,
        *,
        joins_map: bool,
        priors: FlightPriors = FlightPriors(),
    ) -> "PoseGraphSettings":
        """Choose free parameters from the uncertainty of focal length, `focal_sigma` (relative), and of the zero of
        heights, `altitude_offset_sigma_m` (infinite: unknown; None: no telemetry). `joins_map`: a known map fixes
        where the flight lies.
        """
        calibrated = focal_sigma <= priors.calibrated
        has_telemetry = altitude_offset_sigma_m is not None
        height_known = altitude_offset_sigma_m is not None and bool(
            np.isfinite(altitude_offset_sigma_m)
        )
        return cls(
            focal_sigma=0.0 if calibrated or not height_known else focal_sigma,
            radial_sigma=0.0 if calibrated else priors.radial,
            altitude_offset_sigma_m=_altitude_prior_m(altitude_offset_sigma_m, priors.free_m),
            gps_offset_sigma_m=priors.gps_offset_m if joins_map else 0.0,
            tilt_offset_sigma_deg=priors.tilt_offset_deg if has_telemetry else 0.0,
            heading_offset_sigma_deg=priors.heading_offset_deg if has_telemetry else 0.0,
        )


def _altitude_prior_m(sigma_m: float | None, free_m: float) -> float:
    """The prior sigma of the altitude's zero: 0 holds it (no telemetry), a wide one where `sigma_m` is infinite."""
    if sigma_m is None:
        return 0.0
    return sigma_m if np.isfinite(sigma_m) else free_m
