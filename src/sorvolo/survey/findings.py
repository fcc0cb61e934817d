"""What a later flight finds: views laid over the known map, and the changes of the ground that they show."""

from dataclasses import dataclass, field
from enum import IntFlag, StrEnum
from functools import cached_property

import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import (
    Boxes,
    Floats,
    ImageGray,
    ImageRGB,
    ImageRGBA,
    Mask,
    Matrix3,
    PointsM,
    Vector3,
    frozen,
)
from sorvolo.geometry.homography import apply_homography
from sorvolo.survey.mosaic import FrameView


class ViewStatus(StrEnum):
    """How one frame's comparison with the map ended."""

    COMPARED = "compared"
    NOT_ALIGNED = "not-aligned"
    OUTSIDE = "outside"  # of the known map: the frame extends it
    ALL_CHANGED = "all-changed"  # snow, a flood, another place: no list of changes could be trusted
    LOST = "lost"  # the frame itself cannot be used


class ChangeKind(StrEnum):
    """What happened to a piece of ground between the map and the flight."""

    APPEARED = "appeared"
    DISAPPEARED = "disappeared"
    REPLACED = "replaced"
    AREA = "area"  # ground whose surface changed: paved, ploughed, heaped, flooded, built over
    MOVING = "moving"  # someone or something that moves while it is seen: no change of the ground


class Shade(IntFlag):
    """Bits of a shade mask: where one date shows the ground no brighter than the other, all colours alike.

    So does a shadow that came (on the later date) or left (on the earlier one), and unchanged ground on both.
    """

    LATER = 1
    LATER_DARK = 2  # clearly darker
    EARLIER = 4
    EARLIER_DARK = 8


class Verdict(StrEnum):
    """A person's verdict on a change."""

    CONFIRMED = "confirmed"
    REJECTED = "rejected"


@dataclass(frozen=True, eq=False)
class ComparedView:
    """One frame laid over the map and compared with it; all its pictures have the same pixels.

    `image` is the undistorted frame, perhaps made smaller; `reference` the map resampled to the same pixels;
    `valid` where both are known (elsewhere the answer is *unknown*); `changed` 0 or 255, 0 where not valid.
    `boxes` (N, 4) are x, y, width, height of the connected changes and `scores` (N,) how sure each is, 0 to 1.
    `site_from_image` (3, 3) takes pixels to the ground; `camera_m` (3,) is where the camera was, up being its height
    above the ground. `residual_px` is what is left between the image and the map after alignment. `shade` holds bits
    of `Shade`, the reference being the earlier date.
    """

    index: int
    name: str
    time_ns: int
    site_from_image: Matrix3
    camera_m: Vector3
    image: ImageRGB
    reference: ImageRGB
    valid: Mask
    changed: ImageGray
    boxes: Boxes
    scores: Floats
    residual_px: float
    shade: ImageGray

    def __post_init__(self) -> None:
        size = self.image.shape[:2]
        if (
            not size
            == self.reference.shape[:2]
            == self.valid.shape
            == self.changed.shape
            == self.shade.shape
        ):
            raise GeometryError(
                f"view {self.name}: image, reference, valid, changed and shade differ in size"
            )
        if len(self.boxes) != len(self.scores):
            raise GeometryError(
                f"view {self.name}: {len(self.boxes)} boxes but {len(self.scores)} scores"
            )

    @cached_property
    def changed_share(self) -> float:
        """Of the ground that was compared, the share that differs."""
        return float(np.count_nonzero(self.changed)) / max(1, int(np.count_nonzero(self.valid)))

    @cached_property
    def m_per_px(self) -> float:
        """Ground metres of a pixel in the middle of the view's picture."""
        height, width = self.changed.shape
        middle = np.array(
            [[width / 2, height / 2], [width / 2 + 1, height / 2], [width / 2, height / 2 + 1]]
        )
        a, b, c = apply_homography(self.site_from_image, middle)
        across = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        return float(np.sqrt(abs(across))) or 1.0

    @property
    def outline_m(self) -> PointsM:
        """(4, 2) the view's corners on the ground, site metres."""
        height, width = self.changed.shape
        corners_px = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
        return apply_homography(self.site_from_image, corners_px)


@dataclass(frozen=True, eq=False)
class Patch:
    """A piece of ground on both dates, north up: pixel (column, row) is centred at east = `west_m` +
    (column + 1/2) `m_per_px`, north = `north_m` - (row + 1/2) `m_per_px`, in the site frame.

    `before` comes from the map, `after` from the flight's best view; alpha 0 where nothing is known. `changed` marks
    the change itself; the patch shows some of its surroundings, too. `shade` holds bits of `Shade`, as the views had
    them, 0 where nothing is known.
    """

    west_m: float
    north_m: float
    m_per_px: float
    before: ImageRGBA
    after: ImageRGBA
    changed: Mask
    shade: ImageGray

    def __post_init__(self) -> None:
        if (
            not self.before.shape[:2]
            == self.after.shape[:2]
            == self.changed.shape
            == self.shade.shape
        ):
            raise GeometryError("a patch's pictures differ in size")

    @property
    def site_from_patch(self) -> Matrix3:
        """(3, 3) affine map from the patch's pixels to site metres."""
        s = self.m_per_px
        return np.array(
            [[s, 0.0, self.west_m + s / 2], [0.0, -s, self.north_m - s / 2], [0.0, 0.0, 1.0]]
        )


@dataclass(frozen=True)
class HeightChange:
    """How much higher the ground of a change lies than before, its mean, and the one-sigma error of that."""

    rise_m: float
    sigma_m: float


@dataclass(frozen=True, eq=False)
class ChangeFacts:
    """What is known of a change, whether it was just found or is read from a site.

    `id` is the flight's name and a number, the same whenever the flight is compared again. `outline_m` (N, 2), N >= 3,
    is its outline on the ground in site metres, not closed. `length_m` is the longer side of the smallest rectangle
    around it. `sigma_m` is the one-sigma error of its place in the world, per axis, the map's own included. `views`
    counts the frames that showed it. Classes are "" where nobody looked.
    """

    id: str
    kind: ChangeKind
    score: float
    outline_m: PointsM
    first_seen_ns: int
    last_seen_ns: int
    views: int
    area_m2: float
    length_m: float
    sigma_m: float
    class_before: str = field(default="", kw_only=True)
    class_after: str = field(default="", kw_only=True)

    @property
    def centre_m(self) -> Floats:
        """(2,) the middle of the outline's box, site metres."""
        return (self.outline_m.min(axis=0) + self.outline_m.max(axis=0)) / 2

    @property
    def is_single_view(self) -> bool:
        """Whether one view alone shows it: no other confirmed it."""
        return self.views == 1


@dataclass(frozen=True, eq=False)
class Change(ChangeFacts):
    """One thing that happened to the ground, however many frames saw it, with its pictures.

    `velocity_m_s` (2,) east, north: zero unless it moves. `sigma_in_map_m` is the one-sigma error of its place on the
    map, per axis: NaN until the change is reported, for then `sigma_m` has nothing of the map's in it. `height_change` is None where it was not measured.
    """

    patch: Patch
    velocity_m_s: Floats = field(default_factory=lambda: np.zeros(2))
    announced_ns: int = -1  # when it was announced; -1: only after the last frame
    sigma_in_map_m: float = float("nan")
    height_change: HeightChange | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "outline_m", frozen(self.outline_m))
        object.__setattr__(self, "velocity_m_s", frozen(self.velocity_m_s))
        if self.outline_m.ndim != 2 or self.outline_m.shape[1] != 2 or len(self.outline_m) < 3:
            raise GeometryError(
                f"change {self.id}: an outline needs (N, 2) points, N >= 3, got {self.outline_m.shape}"
            )
        if not 0 <= self.score <= 1:
            raise GeometryError(f"change {self.id}: a score lies in 0 to 1, got {self.score}")


@dataclass(frozen=True)
class CompareUpdate:
    """What one step of a comparison did: the flight and its frame, how it ended, the changes announced just now,
    running counts."""

    flight: str
    frame_name: str
    time_ns: int
    status: ViewStatus
    reason: str
    residual_px: float  # NaN unless compared or not aligned
    announced: tuple[Change, ...]
    frames_read: int
    frames_expected: int
    views: int
    compared: int
    seconds: float
    view: FrameView | None = None  # None: not laid on the map
    is_resumed: bool = False  # compared by a run that was killed
    comes_again: bool = False  # it is looked for again, with all of its flight, if that needs it
