"""What the pose graph may move, when it solves, and how well a flight's own figures are known beforehand."""

from dataclasses import dataclass

import numpy as np

PRIOR_CALIBRATED = 0.005  # relative: a focal length known so well is held
PRIOR_RADIAL = 0.03  # of a lens that nobody calibrated
PRIOR_FREE_M = 1e4  # a zero of heights that nothing is known of
PRIOR_GPS_OFFSET_M = 5.0  # of a receiver, the same all flight
PRIOR_TILT_OFFSET_DEG = 2.0  # a gimbal's zero, or a camera's mount
PRIOR_HEADING_OFFSET_DEG = 5.0  # a drone's compass beside its motors


OFFSET_ALTITUDE_M = 0.1
OFFSET_TILT_RAD = 0.002
OFFSET_HEADING_RAD = 0.003
OFFSET_LEAST_SIGMAS = 2.0  # of its own, without the prior: less is noise
# of the prior, m or rad: a wider one is no belief that a flight could confirm
OFFSET_WIDEST_SIGMA = 100.0


PAIRS_PER_LINK = 40  # matches that stand for a link, spread over it
INDEPENDENT_PAIRS = 20.0  # matches of one link share lens and relief errors: they count as so many
WINDOW = 6  # recent keyframes freed by each local solve
# relief left between linked pictures over the height: level ground 0.0003, hills 0.004
UNEVEN = 0.002


@dataclass(frozen=True)
class PoseGraphSettings:
    """What the graph may move and when it solves."""

    # floor of a match's noise; calibration and rolling shutter never are better
    sigma_px: float = 0.3
    focal_sigma: float = 0.0  # relative; 0 holds the focal length
    radial_sigma: float = 0.0  # prior of the left-over radial distortion; 0 holds it
    altitude_offset_sigma_m: float = 1.0  # how well the altitude's zero is known to be the ground
    # > 0 when a known map fixes the datum instead of this flight's GPS
    gps_offset_sigma_m: float = 0.0
    # of gimbal or mount against the vertical, the same all flight
    tilt_offset_sigma_deg: float = 0.0
    heading_offset_sigma_deg: float = 0.0  # of the compass, the same all flight

    @classmethod
    def of_flight(
        cls,
        focal_sigma: float,
        altitude_offset_sigma_m: float | None,
        *,
        joins_map: bool,
    ) -> "PoseGraphSettings":
        """Choose free parameters from the uncertainty of focal length, `focal_sigma` (relative), and of the zero of
        heights, `altitude_offset_sigma_m` (infinite: unknown; None: no telemetry). `joins_map`: a known map fixes
        where the flight lies.
        """
        calibrated = focal_sigma <= PRIOR_CALIBRATED
        has_telemetry = altitude_offset_sigma_m is not None
        height_known = altitude_offset_sigma_m is not None and bool(
            np.isfinite(altitude_offset_sigma_m)
        )
        return cls(
            focal_sigma=0.0 if calibrated or not height_known else focal_sigma,
            radial_sigma=0.0 if calibrated else PRIOR_RADIAL,
            # 0 holds it
            altitude_offset_sigma_m=(
                0.0
                if altitude_offset_sigma_m is None
                else altitude_offset_sigma_m
                if np.isfinite(altitude_offset_sigma_m)
                else PRIOR_FREE_M
            ),
            gps_offset_sigma_m=PRIOR_GPS_OFFSET_M if joins_map else 0.0,
            tilt_offset_sigma_deg=PRIOR_TILT_OFFSET_DEG if has_telemetry else 0.0,
            heading_offset_sigma_deg=PRIOR_HEADING_OFFSET_DEG if has_telemetry else 0.0,
        )
