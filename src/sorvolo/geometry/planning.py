"""How high, how fast and along which strips to fly: Johnson's criteria, overlap, the lawnmower over an area.

Everything is computed from the focal length in pixels, f / k in the thesis's letters: eqs 3.7-3.9 hold the
sensor's size and its pixel's only in that ratio. `docs/errata.md` lists where the thesis's numbers differ.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain

import numpy as np

from sorvolo.errors import GeometryError, SettingsError
from sorvolo.geometry.arrays import Floats, PointsM, frozen
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.polygons import band_spans, join_spans, narrowest_extent

FRONT_CRITICAL_M = 0.75
"""Critical dimension of a person whom the camera faces (section 3.1.1)."""

BOTTOM_CRITICAL_M = float(np.hypot(0.25, 0.551))
"""Critical dimension of a person seen from above: the diagonal of bust depth and forearm-forearm breadth."""

LEGAL_CEILING_M = 120.0
"""Above ground, without a permit: the EU's open category (2019/947); the USA's Part 107 allows 400 ft (122 m)."""

TURN_S = 4.0
"""Time a multicopter loses by braking, turning and speeding up again at one waypoint."""

_MOST_STRIPS = 5000  # over an area: beyond any flight, and bounds the time for a wrong area


class Task(StrEnum):
    """What must be made out of an object (Johnson 1958)."""

    DETECTION = "detection"
    RECOGNITION = "recognition"
    IDENTIFICATION = "identification"

    @property
    def pixels(self) -> float:
        """The pixels that the object's critical dimension must fill."""
        return {Task.DETECTION: 1.5, Task.RECOGNITION: 6.0, Task.IDENTIFICATION: 12.0}[self]


def required_px_per_m(task: Task, critical_m: float) -> float:
    """The ground resolution that a task needs, SRJ in eq. 3.9 (Table 3.1)."""
    if not (np.isfinite(critical_m) and critical_m > 0):
        raise SettingsError(f"the critical dimension must be positive, got {critical_m} m")
    return task.pixels / critical_m


def px_per_m(height_m: float, focal_px: float) -> float:
    """Ground resolution straight below (eq. 3.8); its inverse is the ground sampling distance."""
    if not (np.isfinite(height_m) and height_m > 0):
        raise SettingsError(f"the height above ground must be positive, got {height_m} m")
    return focal_px / height_m


def maximum_height_m(focal_px: float, srj_px_per_m: float) -> float:
    """The greatest height that still gives this ground resolution (eq. 3.9)."""
    return focal_px / srj_px_per_m


def footprint_size_m(camera: Camera, height_m: float) -> tuple[float, float]:
    """Width and length of the ground that a level camera sees (eq. 3.7), without distortion."""
    return (
        camera.width_px / px_per_m(height_m, camera.fx_px),
        camera.height_px / px_per_m(height_m, camera.fy_px),
    )


def scene_length_m(height_m: float, angle_of_view_deg: float) -> float:
    """Length of the seen ground from its angle of view: eq. 3.16 with the tangent for its printed `tanh`."""
    if not 0 < angle_of_view_deg < 180:
        raise SettingsError(f"the angle of view must lie in (0, 180) deg, got {angle_of_view_deg}")
    return float(2 * height_m * np.tan(np.radians(angle_of_view_deg) / 2))


def minimum_frame_rate(speed_m_s: float, scene_m: float, overlap: float) -> float:
    """Frames a second that keep this overlap, in [0, 1), when a frame sees `scene_m` of track (eq. 3.17)."""
    if not 0 <= overlap < 1:
        raise SettingsError(
            f"overlap must lie in [0, 1), got {overlap}; 1 would need endlessly many frames"
        )
    if not (np.isfinite(speed_m_s) and speed_m_s > 0):
        raise SettingsError(f"the speed must be positive, got {speed_m_s} m/s")
    return speed_m_s / (scene_m * (1 - overlap))


@dataclass(frozen=True)
class StripSettings:
    """How an area is flown; the camera looks straight down with the image's top towards the flight direction.

    `strip_bearing_deg` is clockwise from north; None: along the area's longest extent.
    """

    height_m: float
    speed_m_s: float = 5.0
    forward_overlap: float = 0.75
    side_overlap: float = 0.65
    strip_bearing_deg: float | None = None

    def __post_init__(self) -> None:
        for name, overlap in (("forward", self.forward_overlap), ("side", self.side_overlap)):
            if not 0 <= overlap <= 0.95:
                raise SettingsError(f"{name} overlap must lie in [0, 0.95], got {overlap}")
        if not (np.isfinite(self.height_m) and self.height_m > 0):
            raise SettingsError(f"the flight height must be positive, got {self.height_m} m")
        if not (np.isfinite(self.speed_m_s) and self.speed_m_s > 0):
            raise SettingsError(f"the speed must be positive, got {self.speed_m_s} m/s")
        if not np.isfinite(self.strip_bearing_deg or 0):
            raise SettingsError(f"--bearing {self.strip_bearing_deg}: give degrees from north")


@dataclass(frozen=True, eq=False)
class FlightPlan:
    """A lawnmower over an area, in the site frame.

    `passes_m`, (P, 2, 2), holds the start and end (east, north) of every straight pass in flying order. The
    camera works on passes; between two of them the aircraft moves on. Photos are taken at both ends of a pass
    and every `photo_spacing_m` between.
    """

    passes_m: Floats
    height_m: float
    speed_m_s: float
    photo_spacing_m: float
    strip_spacing_m: float
    strip_bearing_deg: float

    def __post_init__(self) -> None:
        passes_m = frozen(self.passes_m)
        if passes_m.ndim != 3 or passes_m.shape[1:] != (2, 2) or len(passes_m) == 0:
            raise GeometryError(
                f"a plan needs (P, 2, 2) passes, at least one, got {passes_m.shape}"
            )
        object.__setattr__(self, "passes_m", passes_m)

    @property
    def waypoints_m(self) -> PointsM:
        """(2 P, 2) east, north: start and end of every pass."""
        return self.passes_m.reshape(-1, 2)

    @property
    def photo_count(self) -> int:
        """How many photos the plan takes: evenly along each pass, one at either end."""
        lengths_m = np.linalg.norm(self.passes_m[:, 1] - self.passes_m[:, 0], axis=1)
        return int((np.rint(lengths_m / self.photo_spacing_m) + 1).sum())

    @property
    def distance_m(self) -> float:
        """Length of the path from the first waypoint to the last."""
        return float(np.linalg.norm(np.diff(self.waypoints_m, axis=0), axis=1).sum())

    @property
    def duration_s(self) -> float:
        """Time from the first waypoint to the last, `TURN_S` a turn; without take-off, climb and return."""
        return self.distance_m / self.speed_m_s + TURN_S * (len(self.waypoints_m) - 2)

    @property
    def photo_interval_s(self) -> float:
        """Time between photos on a pass, the inverse of eq. 3.17."""
        return self.photo_spacing_m / self.speed_m_s


def plan_strips(
    polygons_m: Sequence[Sequence[PointsM]], camera: Camera, settings: StripSettings
) -> FlightPlan:
    """Parallel strips over the union of polygons, so that every point of it is seen in at least one photo.

    Each polygon is its outline and holes, (N, 2) east, north rings. A strip is split where it crosses no
    wanted ground for more than two image lengths. Raises SettingsError when thousands of strips are needed.
    """
    width_m, length_m = footprint_size_m(camera, settings.height_m)
    spacing_m, photo_m = (
        width_m * (1 - settings.side_overlap),
        length_m * (1 - settings.forward_overlap),
    )
    outlines_m = np.concatenate([rings[0] for rings in polygons_m])
    bearing_deg = settings.strip_bearing_deg
    if bearing_deg is None:
        bearing_deg = longest_bearing_deg(outlines_m)
    turn = np.radians(90 - bearing_deg)
    # strip axes: x along the strips, y across
    strip_from_site = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    turned = [[ring @ strip_from_site.T for ring in rings] for rings in polygons_m]
    across = outlines_m @ strip_from_site[1]
    levels = _strip_levels(float(across.min()), float(across.max()), width_m, spacing_m)
    bands = _strip_bands(levels, width_m, spacing_m)
    spans = zip(*(band_spans(rings, bands) for rings in turned))
    passes: list[Floats] = []
    for index, (level, parts) in enumerate(zip(levels, spans)):
        strip = _passes(
            level, list(chain.from_iterable(parts)), gap_m=2 * length_m, photo_m=photo_m
        )
        passes += strip if index % 2 == 0 else [each[::-1] for each in reversed(strip)]
    return FlightPlan(
        np.array(passes) @ strip_from_site,
        settings.height_m,
        settings.speed_m_s,
        photo_m,
        spacing_m,
        bearing_deg % 360,
    )


def _strip_bands(levels: Floats, width_m: float, spacing_m: float) -> list[tuple[float, float]]:
    """From where to where each strip, at its level across, covers the ground: the outermost ones to their edge."""
    reaches_m = np.full((len(levels), 2), 0.5 * spacing_m)
    reaches_m[0, 0] = reaches_m[-1, 1] = 0.5 * width_m
    return list(zip((levels - reaches_m[:, 0]).tolist(), (levels + reaches_m[:, 1]).tolist()))


def _passes(
    level: float, spans: Sequence[tuple[float, float]], *, gap_m: float, photo_m: float
) -> list[Floats]:
    """The passes, (2, 2) each, along y = `level` over spans of x, in strip axes."""
    ends = [_whole_steps(span, photo_m) for span in join_spans(spans, gap_m)]
    return [np.array([[x0, level], [x1, level]]) for x0, x1 in ends]


def longest_bearing_deg(points_m: PointsM) -> float:
    """The bearing, in [0, 180) deg, across which points, (N, 2), spread least: a rectangle's longer side.

    Strips that way are the fewest, and so are the turns.
    """
    _, along = narrowest_extent(points_m)
    return float(np.degrees(np.arctan2(along[0], along[1])) % 180)


def _strip_levels(low: float, high: float, width_m: float, spacing_m: float) -> Floats:
    """Where across the area the strips lie: as few as see all of it, centred."""
    count = 1 + max(0, int(np.ceil((high - low - width_m) / spacing_m - 1e-9)))
    if count > _MOST_STRIPS:
        raise SettingsError(
            f"the area needs {count} strips {spacing_m:.2f} m apart, more than {_MOST_STRIPS}: "
            "fly higher, ask for less side overlap, or cut the area into parts"
        )
    return np.asarray(0.5 * (low + high) + (np.arange(count) - 0.5 * (count - 1)) * spacing_m)


def _whole_steps(span: tuple[float, float], step_m: float) -> tuple[float, float]:
    """The span, widened evenly so that it holds a whole number of photo steps, at least one."""
    steps = max(1, int(np.ceil((span[1] - span[0]) / step_m - 1e-9)))
    middle = 0.5 * (span[0] + span[1])
    return middle - 0.5 * steps * step_m, middle + 0.5 * steps * step_m
