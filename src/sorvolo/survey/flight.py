"""A flight's data: telemetry, frames, and each frame's camera as telemetry has it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.arrays import Floats, ImageRGB, Matrix3, TimesNs, Vector3, frozen
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame

TELEMETRY_COLUMNS = (
    "latitude_deg",
    "longitude_deg",
    "ellipsoidal_height_m",
    "orthometric_height_m",
    "height_above_takeoff_m",
    "horizontal_sigma_m",
    "vertical_sigma_m",
    "camera_yaw_deg",
    "camera_pitch_deg",
    "camera_roll_deg",
    "body_yaw_deg",
    "body_pitch_deg",
    "body_roll_deg",
    "tilt_sigma_deg",
    "heading_sigma_deg",
    "course_deg",
    "speed_m_s",
)
"""Every number a telemetry sample can carry. NaN means that the source does not state it.

The three heights are different things and are never converted silently: above the WGS84 ellipsoid, above mean sea
level (a geoid), above the take-off point. Camera angles are a gimbal's, against north and the horizon (pitch -90 looks
straight down); body angles are the aircraft's (yaw clockwise from north, pitch nose up, roll right side down).
The attitude's sigmas are those that the source states, of the angles that it gives.
"""


@dataclass(frozen=True)
class Notice:
    """Something that was found, counted and survived; `code` is stable, `text` is for people."""

    code: str
    count: int
    text: str


@dataclass(frozen=True, eq=False)
class Telemetry:
    """Samples of one flight in order of time, as columns of equal length; NaN where the source states nothing.

    `time_ns` is UTC and strictly increasing. `video_time_ns`, where the source is tied to a video (subtitles), is
    the sample's time since the video's first frame; -1 where unknown. `format` is the reader's name. `is_per_photo`:
    each sample is of one photo and at exactly its time, so that no clock ties the two.
    """

    format: str
    time_ns: TimesNs
    columns: Mapping[str, Floats]
    video_time_ns: TimesNs = None  # type: ignore[assignment]  # becomes all -1
    notices: tuple[Notice, ...] = ()
    is_per_photo: bool = False

    def __post_init__(self) -> None:
        time_ns = frozen(self.time_ns, np.int64)
        if unknown := set(self.columns) - set(TELEMETRY_COLUMNS):
            known = ", ".join(TELEMETRY_COLUMNS)
            raise GeometryError(f"unknown telemetry columns: {sorted(unknown)}; there are {known}")
        if len(time_ns) > 1 and not (np.diff(time_ns) > 0).all():
            raise GeometryError("telemetry times must increase strictly")
        columns = {
            name: frozen(self.columns.get(name, np.full(len(time_ns), np.nan)))
            for name in TELEMETRY_COLUMNS
        }
        video = frozen(
            np.full(len(time_ns), -1) if self.video_time_ns is None else self.video_time_ns,
            np.int64,
        )
        if any(len(column) != len(time_ns) for column in [*columns.values(), video]):
            raise GeometryError("telemetry columns differ in length")
        object.__setattr__(self, "time_ns", time_ns)
        object.__setattr__(self, "columns", columns)
        object.__setattr__(self, "video_time_ns", video)

    def __len__(self) -> int:
        return len(self.time_ns)

    def __getitem__(self, name: str) -> Floats:
        return self.columns[name]

    @property
    def has_fixes(self) -> bool:
        """Whether any sample knows where it is."""
        return bool(np.isfinite(self["latitude_deg"]).any())


def no_telemetry() -> Telemetry:
    """The telemetry of a flight without any."""
    return Telemetry("none", np.zeros(0, np.int64), {})


@dataclass(frozen=True)
class CameraModel:
    """A camera with where it comes from, in words, and how well its focal length is known.

    `focal_sigma` is relative (0.01 = 1 %): below about 0.003 for a calibration of this very camera.
    """

    camera: Camera
    origin: str
    focal_sigma: float

    def __post_init__(self) -> None:
        if not 0 < self.focal_sigma <= 1:
            raise GeometryError(f"focal_sigma must lie in (0, 1], got {self.focal_sigma}")


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture of a flight. `name` is the photo's file name, or the frame's index in the video as text."""

    index: int
    name: str
    time_ns: int
    image: ImageRGB

    @classmethod
    def unseen(cls, index: int, name: str, time_ns: int, size_px: tuple[int, int]) -> "Frame":
        """One of this height and width whose picture is not there any more: its image has no channel, (H, W, 0)."""
        return cls(index, name, time_ns, np.zeros((*size_px, 0), np.uint8))


@dataclass(frozen=True)
class LostFrame:
    """A picture that could not be used at all (corrupt, a duplicate, of another size), and why, in words."""

    index: int
    name: str
    time_ns: int
    reason: str


@dataclass(frozen=True, eq=False)
class CameraPrior:
    """One frame's camera by telemetry, in the site frame; what telemetry does not state has an infinite sigma.

    `position_m` (east, north, up above the site's ground plane); `rotation` is site_from_camera;
    `attitude_sigma_deg` is about the camera's own x, y (tilt) and z (heading) axes.
    `velocity_m_s` is the aircraft's over ground, zero where unknown; `source` names what was used.
    """

    position_m: Vector3
    position_sigma_m: Vector3
    rotation: Matrix3
    attitude_sigma_deg: Vector3
    velocity_m_s: Vector3 = field(default_factory=lambda: np.zeros(3))
    source: str = ""

    def __post_init__(self) -> None:
        for name in (
            "position_m",
            "position_sigma_m",
            "rotation",
            "attitude_sigma_deg",
            "velocity_m_s",
        ):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        if not np.isfinite(self.position_m).all() or not np.isfinite(self.rotation).all():
            raise GeometryError(
                "a prior's numbers are finite; what is unknown has an infinite sigma"
            )

    @property
    def knows_place(self) -> bool:
        """Whether east and north are known at all."""
        return bool(np.isfinite(self.position_sigma_m[:2]).all())


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """A frame with its camera by telemetry."""

    frame: Frame
    prior: CameraPrior


@dataclass(frozen=True)
class Site:
    """One place that is watched; its origin is fixed for ever.

    The site's up = 0 is its ground; `origin.height_m` is the ellipsoidal height of that ground where it is known,
    else 0 (`docs/frames.md`). `is_local` marks a site without geo-reference, in a frame without metres.
    `height_reference` names what `origin.height_m` is counted from: "ellipsoidal", "orthometric" (mean sea level),
    "above take-off" or "above ground".
    """

    name: str
    origin: Geodetic
    crs: str
    m_per_px: float
    is_local: bool = False
    height_reference: str = "above ground"

    def __post_init__(self) -> None:
        if not self.name:
            raise InputError("a site needs a name")

    @property
    def frame(self) -> LocalFrame:
        """WGS84 to the site's metres and back."""
        return LocalFrame(self.origin)
