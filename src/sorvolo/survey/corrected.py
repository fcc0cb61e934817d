"""A flight's corrected telemetry: where the camera was by the pictures, and how wrong its own log was."""

from dataclasses import dataclass

_LEAST_SCALE = 0.01  # a change of scale that matters: 30 cm in 30 m of height
_LEAST_TURN_DEG = 0.5  # a turn that matters: 45 cm at 50 m from the path's middle


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
class PathFit:
    """The fixes' path held against the one that the pictures gave: how many times as large it is, and by how much it is
    turned, counter-clockwise as seen from above. NaN where there are too few fixes."""

    scale: Bias
    turn_deg: Bias

    @property
    def sure_scale(self) -> float:
        """The scale where it is surely another than the map's, else 1."""
        departure = abs(self.scale.value - 1)
        return self.scale.value if departure > max(3 * self.scale.sigma, _LEAST_SCALE) else 1.0

    @property
    def sure_turn_deg(self) -> float:
        """The turn where there surely is one, else 0."""
        return (
            self.turn_deg.value
            if abs(self.turn_deg.value) > max(3 * self.turn_deg.sigma, _LEAST_TURN_DEG)
            else 0.0
        )


AS_THE_MAP = PathFit(Bias(1.0, 0.0), Bias(0.0, 0.0))
"""Of a map whose scale and direction are known from the ground, better than from the flight's fixes."""


@dataclass(frozen=True)
class TelemetryFaults:
    """What was wrong with a flight's telemetry. `clock_s` is telemetry's clock less the video's; `heading_deg` positive
    where the compass read too far clockwise, its sigma infinite where it cannot be known; `tilt_deg` how far the camera
    looked from its stated direction, sideways and forward together; `height_m` positive where the log was too high
    above the ground, its sigma infinite where that cannot be known. `path` is the fixes' path held against the map.

    The rest are rows of compared frames: `outlying`, whose stated angles alone are far beside what those of the others
    are off, by `outlying_deg` in the median; `misplaced`, whose places and angles both are, so that the map is doubtful
    there; `apart`, whose places alone are, so that the map or the fix is wrong. `misplaced_m` and `apart_m` are how far
    each of these lies beside where the fixes usually put the camera: an error that all fixes share is taken off.
    """

    clock_s: Bias
    heading_deg: Bias
    tilt_deg: Bias
    height_m: Bias
    position_m: Bias
    path: PathFit
    outlying: tuple[int, ...] = ()
    outlying_deg: float = 0.0
    misplaced: tuple[int, ...] = ()
    misplaced_m: tuple[float, ...] = ()
    apart: tuple[int, ...] = ()
    apart_m: tuple[float, ...] = ()
