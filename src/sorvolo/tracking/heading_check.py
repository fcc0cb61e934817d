"""Headings by telemetry that cannot be, by what pictures show, and how they are set right."""

from dataclasses import dataclass, replace

import numpy as np

from sorvolo.geometry.pose import rotation_from_vector
from sorvolo.survey.flight import CameraPrior

_LEAST_DOWN = 0.96  # of the optical axis: 16 degrees off straight down or less; the heading of others is not checked
_WRONG_DEG = 30.0  # less is within what tilts, winds and small compasses do; by choice
_WRONG_SIGMAS = 4.0  # and it must be beyond what both sides may err by; by choice


@dataclass(frozen=True)
class HeadingTurn:
    """By how much a heading has to turn clockwise, from -180 to 180 degrees, and how well that is known."""

    turn_deg: float
    sigma_deg: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "turn_deg", (self.turn_deg + 180) % 360 - 180)


def is_checked(prior: CameraPrior) -> bool:
    """Whether a camera's place and heading are known at all, and it looks about straight down."""
    is_known = (
        prior.knows_place
        and bool(np.isfinite(prior.attitude_sigma_deg[2]))
        and prior.position_m[2] > 0
    )
    return is_known and -float(prior.rotation[2, 2]) >= _LEAST_DOWN


def is_wrong(shown: HeadingTurn, prior: CameraPrior) -> bool:
    """Whether a heading by telemetry is one that cannot be, where pictures show this turn."""
    both_deg = float(np.hypot(shown.sigma_deg, prior.attitude_sigma_deg[2]))
    return abs(shown.turn_deg) > max(_WRONG_DEG, _WRONG_SIGMAS * both_deg)


def heading_deg(prior: CameraPrior) -> float:
    """Where the picture's top points, clockwise from north."""
    return float(np.degrees(np.arctan2(-prior.rotation[0, 1], -prior.rotation[1, 1])))


def turned(prior: CameraPrior, turn: HeadingTurn) -> CameraPrior:
    """The prior turned about the vertical, its heading as well known as the turn."""
    rotation = (
        rotation_from_vector(np.array([0.0, 0.0, -np.radians(turn.turn_deg)])) @ prior.rotation
    )
    sigma_deg = np.array([*prior.attitude_sigma_deg[:2], turn.sigma_deg])
    return replace(prior, rotation=rotation, attitude_sigma_deg=sigma_deg)
