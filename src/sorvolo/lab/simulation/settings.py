"""What a simulation can be asked for: one small record per part, each checked at birth."""

from dataclasses import dataclass, field, replace

import numpy as np

from sorvolo.errors import SettingsError
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.lab.simulation.ground import GroundKind

TELEMETRY_FORMATS = ("csv", "srt", "nmea", "gpx")
"""The telemetry formats that can be written, in the order in which they are the primary one."""

GEOID_HEIGHT_M = 48.3
"""Height of the geoid above the ellipsoid at the default site; one constant, as a receiver's own table gives it."""

DEFAULT_ORIGIN = Geodetic(41.8923127, 12.6035418, 83.3)
"""A field east of Rome; the height is the ground's, above the ellipsoid."""


_RANGES: dict[str, tuple[float, float]] = {
    "people": (0, 10000),
    "cars": (0, 10000),
    "small_objects": (0, 10000),
    "removed": (0, 10000),
    "moved": (0, 10000),
    "moving_share": (0, 1),
    "relief_m": (0, 200),
    "height_m": (2, 500),
    "speed_m_s": (0.1, 40),
    "length_m": (1, 20000),
    "strips": (1, 200),
    "strip_spacing_m": (0.5, 500),
    "tilt_rms_deg": (0, 15),
    "roll_rms_deg": (0, 15),
    "height_rms_m": (0, 50),
    "drift_rms_m": (0, 50),
    "camera_pitch_deg": (-90, -45),
    "wind_m_s": (0, 20),
    "width_px": (64, 8192),
    "height_px": (64, 8192),
    "angle_of_view_deg": (10, 120),
    "fps": (0.2, 120),
    "exposure_s": (0, 0.1),
    "noise": (0, 60),
    "noise_m": (0, 1000),
    "clock_offset_s": (-3, 3),
    "gaps": (0, 100000),
    "jumps": (0, 100000),
    "zero_fixes": (0, 100000),
    "bad_checksums": (0, 100000),
    "wind_m": (0, 2),
    "brightness": (0, 3),
    "snow": (0, 1),
    "height_factor": (0.3, 3),
    "heading_change_deg": (-360, 360),
    "photo_overlap": (0, 0.98),
    "truth_step": (1, 1000000),
    "seed": (0, 2**63),
    "flights": (1, 20),
}
"""The least and the greatest value of each setting."""


class _Checked:
    """Checks its settings at birth. Raises SettingsError for one out of its range."""

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name, None)
            if value is not None and not low <= np.min(value) <= np.max(value) <= high:
                raise SettingsError(f"{name} must lie in [{low}, {high}], got {value}")


@dataclass(frozen=True)
class SceneSettings(_Checked):
    """The site: its ground and what stands on it during the first flight.

    `ground` is a GroundKind's name, or "orthophoto" for a given picture. Counts are objects inside the
    flown area.
    """

    ground: str = "countryside"
    people: int = 3
    cars: int = 2
    small_objects: int = 4
    moving_share: float = 0.5  # of people and cars, in later flights
    has_scenery: bool = True  # trees, bushes, houses
    relief_m: float = 0.0  # of smooth hills, from the lowest to the highest ground
    origin: Geodetic = DEFAULT_ORIGIN

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ground not in (*GroundKind, "orthophoto"):
            raise SettingsError(
                f"unknown ground {self.ground!r}; choose {', '.join(GroundKind)}, or an orthophoto's file"
            )


@dataclass(frozen=True)
class PathSettings(_Checked):
    """The planned path: parallel strips through the site's origin; one strip is a straight line."""

    height_m: float = 20.0  # above the ground, of the camera
    speed_m_s: float = 4.0
    length_m: float = 60.0  # of a strip
    strips: int = 2
    strip_spacing_m: float = 10.0
    heading_deg: float = 90.0  # of the first strip, clockwise from north


@dataclass(frozen=True)
class MotionSettings(_Checked):
    """How far the flight departs from its plan; root mean squares of smooth random series."""

    tilt_rms_deg: float = 1.5  # roll and pitch each, over about a second
    yaw_rms_deg: float = 1.5
    height_rms_m: float = 0.4
    drift_rms_m: float = 0.4  # east and north each, wind over ten seconds
    camera_pitch_deg: float = -90.0  # -90 looks straight down
    roll_rms_deg: float | None = None  # of roll alone; None: as tilt_rms_deg
    # banks into turns, and keeps its speed through the air instead of over the ground
    is_fixed_wing: bool = False
    wind_m_s: float = 0.0  # of a fixed wing: it is carried along and turns its nose into the wind
    wind_from_deg: float = 0.0  # clockwise from north

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.wind_m_s and not self.is_fixed_wing:
            raise SettingsError(
                "wind_m_s carries fixed wings only; a rotor drone's drift is drift_rms_m"
            )


@dataclass(frozen=True)
class ImagingSettings(_Checked):
    """The camera and what it does to the picture."""

    width_px: int = 960
    height_px: int = 540
    angle_of_view_deg: float = 62.0  # horizontal, of the lens without its distortion
    # k1 k2 p1 p2 k3
    distortion: tuple[float, float, float, float, float] = (
        -0.08,
        0.02,
        0.0004,
        -0.0003,
        0.0,
    )
    fps: float = 25.0
    exposure_s: float = 1 / 1000
    exposure_drift: float = 0.06  # rms, relative
    white_balance_drift: float = 0.02  # rms, relative
    noise: float = 2.0  # rms, grey levels

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width_px % 2 or self.height_px % 2:
            raise SettingsError(
                f"H.264 needs an even picture size, got {self.width_px}x{self.height_px}"
            )

    @property
    def camera(self) -> Camera:
        """The true camera, its optical centre a little off the middle as real ones are."""
        ideal = Camera.from_angle_of_view(self.width_px, self.height_px, self.angle_of_view_deg)
        shift = self.width_px / 960
        return Camera(
            self.width_px,
            self.height_px,
            ideal.fx_px,
            ideal.fy_px,
            ideal.cx_px + 3.0 * shift,
            ideal.cy_px - 2.0 * shift,
            np.array(self.distortion),
        )


@dataclass(frozen=True)
class SensorSettings(_Checked):
    """The telemetry and its faults. Errors are in site axes."""

    noise_m: tuple[float, float, float] = (1.0, 1.0, 1.0)  # white, rms: east, north, up
    wander_m: float = 0.0  # rms of an error that forgets itself over a minute, each axis
    bias_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    clock_offset_s: float = 0.0  # telemetry's clock minus the video's
    attitude_noise_deg: float = 0.3
    gaps: int = 0  # three seconds without samples
    jumps: int = 0  # fixes some hundred metres off
    zero_fixes: int = 0  # fixes at latitude 0, longitude 0
    bad_checksums: int = 0  # NMEA only


@dataclass(frozen=True)
class WeatherSettings(_Checked):
    """The day of a later flight: its light and what the weather did to the ground."""

    has_other_light: bool = True  # another sun, another colour and strength of the light
    has_clouds: bool = True
    wind_m: float = 0.03  # how far crowns and grass have moved
    brightness: float = 1.0  # of all light; a night under street lamps has about 0.06
    snow: float = 0.0  # share of the ground that lies under snow


@dataclass(frozen=True)
class RevisitSettings(_Checked):
    """How a later flight is flown other than the first: higher, in another direction, by another camera."""

    height_factor: float = 1.0
    heading_change_deg: float = 0.0
    imaging: ImagingSettings | None = None  # None: the first flight's own camera


@dataclass(frozen=True)
class LaterSettings(_Checked):
    """How a later flight differs from the first: what came, how many of the first flight's targets left or moved."""

    people: int = 1
    cars: int = 1
    small_objects: int = 2
    removed: int = 2
    moved: int = 2
    weather: WeatherSettings = field(default_factory=WeatherSettings)
    revisit: RevisitSettings = field(default_factory=RevisitSettings)


@dataclass(frozen=True)
class OutputSettings(_Checked):
    """What is written to the folder; `truth_step` samples the truth."""

    telemetry: str = "csv"  # a format, "all" or "none"
    photos: bool = False  # JPEG photos instead of a video
    photo_overlap: float = 0.7
    truth_step: int = 25  # boxes and change masks at every so many frames

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.telemetry not in (*TELEMETRY_FORMATS, "all", "none"):
            raise SettingsError(
                f"unknown telemetry {self.telemetry!r}; choose {', '.join(TELEMETRY_FORMATS)}, all or none"
            )

    @property
    def formats(self) -> tuple[str, ...]:
        """The telemetry formats to write, the primary one first."""
        if self.telemetry == "all":
            return TELEMETRY_FORMATS
        return () if self.telemetry == "none" else (self.telemetry,)


@dataclass(frozen=True)
class SimulationSettings(_Checked):
    """A whole simulation; the same settings and seed give the same pictures, numbers and files."""

    preset: str = "custom"
    seed: int = 1
    flights: int = 2
    scene: SceneSettings = field(default_factory=SceneSettings)
    path: PathSettings = field(default_factory=PathSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)
    imaging: ImagingSettings = field(default_factory=ImagingSettings)
    sensor: SensorSettings = field(default_factory=SensorSettings)
    later: LaterSettings = field(default_factory=LaterSettings)
    output: OutputSettings = field(default_factory=OutputSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scene.relief_m > 0.8 * self.path.height_m:
            raise SettingsError(
                f"hills of {self.scene.relief_m:g} m are too high for a flight at {self.path.height_m:g} m; "
                "at most 0.8 of it"
            )

    @property
    def m_per_px(self) -> float:
        """Ground sampling distance of the planned first flight."""
        return self.path.height_m / self.imaging.camera.fx_px

    def of_flight(self, flight: int) -> "SimulationSettings":
        """These settings with the camera of one flight, counted from 1."""
        other = self.later.revisit.imaging
        return self if flight == 1 or other is None else replace(self, imaging=other)
