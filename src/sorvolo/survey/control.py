"""Ground control: surveyed points, the pixels that show them, and how well a map agrees with them."""

from dataclasses import dataclass, field
from enum import StrEnum
from statistics import median

from sorvolo.errors import InputError
from sorvolo.geometry.geodesy import Geodetic


@dataclass(frozen=True)
class ControlPoint:
    """A surveyed point. `height_m` counts from what its file's heights count from, NaN where it states none."""

    label: str
    latitude_deg: float
    longitude_deg: float
    height_m: float


@dataclass(frozen=True)
class ControlMark:
    """A pixel of a frame (centre of the top-left one is 0, 0) that shows a control point."""

    label: str
    frame: str
    x_px: float
    y_px: float


@dataclass(frozen=True)
class GroundControl:
    """The control points of a file, each label once, and their marks; `crs` is the file's, in words."""

    name: str
    crs: str
    points: tuple[ControlPoint, ...]
    marks: tuple[ControlMark, ...]

    def __post_init__(self) -> None:
        labels = {each.label for each in self.points}
        if len(labels) < len(self.points):
            raise InputError(f"{self.name}: two control points have the same label")
        if unknown := {each.label for each in self.marks} - labels:
            raise InputError(
                f"{self.name}: marks of points that it does not list: {', '.join(sorted(unknown))}"
            )

    @property
    def middle(self) -> Geodetic:
        """A place amid the points, by medians, on the ellipsoid."""
        return Geodetic(
            round(median(each.latitude_deg for each in self.points), 7),
            round(median(each.longitude_deg for each in self.points), 7),
        )


class ControlRole(StrEnum):
    """What a control point was for the map."""

    CONTROL = "control"  # tied the map
    CHECK = "check"  # held back: measures the map
    EXCLUDED = "excluded"  # contradicts the other points
    UNSEEN = "unseen"  # marked in no frame that has a place


@dataclass(frozen=True)
class ControlResidual:
    """Where the map has a control point less where it was surveyed, m; NaN where no placed frame shows it.

    `sigma_m` is how far its marks scatter on the map; `marks` counts those in placed frames.
    """

    point: ControlPoint
    role: ControlRole
    marks: int
    east_m: float
    north_m: float
    sigma_m: float


@dataclass(frozen=True)
class ControlReport:
    """How a map agrees with its control points."""

    name: str
    crs: str
    sigma_m: float  # stated for the points
    residuals: tuple[ControlResidual, ...] = field(default=())
    remarks: tuple[str, ...] = ()  # in words: how the points that tie the map lie badly for it

    def of(self, role: ControlRole) -> list[ControlResidual]:
        """The points that had this role."""
        return [each for each in self.residuals if each.role is role]

    def rms_m(self, role: ControlRole) -> float | None:
        """Rms distance of these points from where they were surveyed; None without any."""
        found = self.of(role)
        if not found:
            return None
        return (sum(each.east_m**2 + each.north_m**2 for each in found) / len(found)) ** 0.5
