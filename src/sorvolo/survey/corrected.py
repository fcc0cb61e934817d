"""A flight's corrected telemetry: where the camera was by the pictures, and how wrong its own log was."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CorrectedFrame:
    """One frame's camera as its flight was solved.

    Degrees of WGS84; `height_m` in the site's height reference, `above_ground_m` over its ground. Yaw, pitch and roll
    are a gimbal's (-90 looks straight down). `sigma_m` is the position's, per axis; NaN where unknown.
    """

    name: str
    index: int
    time_ns: int
    video_s: float
    latitude_deg: float
    longitude_deg: float
    height_m: float
    above_ground_m: float
    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    sigma_m: float
    horizontal_fov_deg: float
    vertical_fov_deg: float
    status: str


@dataclass(frozen=True)
class Bias:
    """How far telemetry was off, telemetry less truth, the same all flight; one sigma of it, and its scatter (1 sigma)
    from frame to frame. NaN where telemetry states nothing that could be off."""

    value: float
    sigma: float
    scatter: float = float("nan")

    @property
    def is_significant(self) -> bool:
        """Whether it is more than its own uncertainty explains."""
        return abs(self.value) > 3 * self.sigma


@dataclass(frozen=True)
class TelemetryFaults:
    """What was wrong with a flight's telemetry. `clock_s` is telemetry's clock less the video's; `heading_deg` positive
    where the compass read too far clockwise; `tilt_deg` how far the camera looked from its stated direction, sideways
    and forward together; `height_m` positive where the log was too high above the ground. `outlying` are the rows of
    compared frames whose stated angles are far beside what those of the others are off, `outlying_deg` their median."""

    clock_s: Bias
    heading_deg: Bias
    tilt_deg: Bias
    height_m: Bias
    position_m: Bias
    outlying: tuple[int, ...] = ()
    outlying_deg: float = 0.0
