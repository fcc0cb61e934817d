"""What a map is made of: features, keyframes, links between them, placed frames and tiles."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import (
    Descriptors,
    Floats,
    ImageGray,
    Matrix3,
    PointsM,
    PointsPx,
    frozen,
)
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.ground import is_on_ground
from sorvolo.geometry.pose import Pose
from sorvolo.survey.flight import CameraPrior


@dataclass(frozen=True, eq=False)
class Features:
    """Salient points of one undistorted image: `points_px` (N, 2), `descriptors` (N, D), `kind` "orb", "sift"..."""

    kind: str
    points_px: PointsPx
    descriptors: Descriptors

    def __post_init__(self) -> None:
        if len(self.points_px) != len(self.descriptors):
            raise GeometryError(
                f"{len(self.points_px)} points but {len(self.descriptors)} descriptors"
            )

    def __len__(self) -> int:
        return len(self.points_px)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame that was chosen for the map, ready to be linked.

    `gray` is undistorted, contrast-normalised and at registration size, which may be smaller than the frame;
    `camera` is the distortion-free camera of that gray image. `id` counts up within a site's mapping run.
    """

    id: int
    camera: Camera
    gray: ImageGray
    features: Features
    prior: CameraPrior


@dataclass(frozen=True, eq=False)
class Link:
    """Two keyframes see the same ground: paired undistorted points, (N, 2) each, and the map between them.

    `new_from_old` is the homography that takes the old keyframe's pixels to the new one's; `sigma_px` is the
    robust spread of the pairs about it.
    """

    new_id: int
    old_id: int
    new_px: PointsPx
    old_px: PointsPx
    new_from_old: Matrix3
    sigma_px: float

    def __post_init__(self) -> None:
        for name in ("new_px", "old_px", "new_from_old"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        if self.new_px.shape != self.old_px.shape:
            raise GeometryError("a link needs as many points on both sides")


@dataclass(frozen=True)
class NoLink:
    """Two keyframes that do not fit, and why, in words."""

    new_id: int
    old_id: int
    reason: str


class Status(StrEnum):
    """How a selected frame ended."""

    VISION = "vision"
    GPS_ONLY = "gps-only"
    REJECTED = "rejected"


@dataclass(frozen=True, eq=False)
class PlacedFrame:
    """A selected frame as it ended: one feature of frames.geojson.

    `outline_m` (4, 2) is the image's corners on the ground (top-left, top-right, bottom-right, bottom-left), NaN
    when rejected. `site_from_image` (3, 3) takes the pixels of the undistorted image, as large as `camera` however
    small it is stored, to site metres on the ground; NaN when rejected.
    """

    name: str
    index: int
    time_ns: int
    status: Status
    reason: str
    camera: Camera
    site_from_camera: Pose | None  # None: a rejected frame, or a method without 6-DoF poses
    site_from_image: Matrix3
    outline_m: PointsM
    residual_px: float
    sigma_m: float
    gains: Floats = field(default_factory=lambda: np.ones(3))
    gps_residual_m: Floats = field(default_factory=lambda: np.full(3, np.nan))
    vignette: Floats = field(default_factory=lambda: np.zeros(2))

    @classmethod
    def rejected(
        cls,
        index: int,
        name: str,
        time_ns: int,
        reason: str,
        camera: Camera,
        residual_px: float = float("nan"),
    ) -> "PlacedFrame":
        """The record of a frame that has no place."""
        nowhere = np.full((3, 3), np.nan)
        return cls(
            name,
            index,
            time_ns,
            Status.REJECTED,
            reason,
            camera,
            None,
            nowhere,
            np.full((4, 2), np.nan),
            residual_px,
            float("nan"),
        )


@dataclass(frozen=True, eq=False)
class FrameView:
    """Where a frame was taken and what ground it shows, as far as that is known while its flight goes on.

    Metres are those of the site around `frame`; `outline_m` (4, 2) is as in PlacedFrame. `time_ns` is UTC where a clock
    has it.
    """

    time_ns: int
    frame: LocalFrame
    site_from_camera: Pose
    outline_m: PointsM


@dataclass(frozen=True)
class MosaicUpdate:
    """What one step of a mapping mission did: the flight and its frame, how it ended for now, the running counts.

    `view` is None for a frame that has no place yet.
    """

    flight: str
    frame_name: str
    status: Status
    reason: str
    frames_read: int
    frames_expected: int
    keyframes: int
    by_vision: int
    tiles_touched: int
    seconds: float
    view: FrameView | None = None
    is_resumed: bool = False
    """Whether the frame was taken over from a run of the same command that was killed."""


@dataclass(frozen=True, eq=False)
class FrameRow:
    """One frame of a frames.geojson, map or truth, in site metres; NaN where the file has nothing."""

    name: str
    status: str
    outline_m: Floats  # (4, 2)
    camera_m: Floats  # (2,)
    camera_height_m: float
    fix_m: Floats  # (2,)
    time_ns: int  # UTC; 0 where the file has none

    @property
    def has_outline(self) -> bool:
        """Whether the outline is known."""
        return is_on_ground(self.outline_m)

    @property
    def has_camera(self) -> bool:
        """Whether the camera's place is known."""
        return is_on_ground(self.camera_m)

    @property
    def has_fix(self) -> bool:
        """Whether the fix is known."""
        return is_on_ground(self.fix_m)
