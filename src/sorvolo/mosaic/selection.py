"""Which frames become keyframes: enough overlap by eq. 3.17, sharp enough, inside the area of interest."""

import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import ImageGray, ImageRGB, PointsM, shrunk
from sorvolo.geometry.camera import Camera
from sorvolo.registration.features import gray_from_rgb, normalise_contrast, sharpness
from sorvolo.survey.flight import Frame, LostFrame, PosedFrame

_SMALL_PX = 256  # longer side of the pictures by which overlap is judged
_COPIES_KEPT = 16  # more than wait between the decoder and the selection
_COARSE_PX = 64  # at which a sensor's noise averages out and ground still shows itself


_BLURRED = 0.6  # of the usual sharpness: wait for a better one
_USELESS = 0.35  # of the usual sharpness: reject
# of gray, spread at 64 px: one gray 0, with noise 0.5, the barest real field 2.2
_BARE_LEVELS = 0.6
_USUAL = 25  # frames that show how sharp the flight's usually are
_SPARSE_SHARE = 2 / 3  # of the way between keyframes that decoded frames may lie apart


@dataclass(frozen=True)
class SelectionSettings:
    """When a frame is worth a place in the map."""

    overlap: float = 0.7  # s of eq. 3.17: share of a frame that its successor shows again
    # a blurred frame is skipped only while its successors still overlap this much
    least_overlap: float = 0.5

    def __post_init__(self) -> None:
        if not 0 < self.least_overlap <= self.overlap < 1:
            raise SettingsError(
                f"overlap must lie between {self.least_overlap} and 1, got {self.overlap}"
            )


_STEP_S = 0.2  # five a second: the pictures decide
# at least, of a live flight that has just begun: a drone's usual speed over a survey
_LIVE_SPEED_M_S = 5.0


@dataclass(frozen=True)
class FramePlan:
    """How often a flight's frames are asked for, and how many keyframes to expect.

    `step_s` is between candidates (0: every frame); fixes within `smooth_s` to both sides of a frame are averaged.
    """

    step_s: float
    smooth_s: float
    expected: int


@dataclass(frozen=True, eq=False)
class Selected:
    """A selected frame; `reason` is empty, or why it cannot be used after all."""

    posed: PosedFrame
    reason: str


def interval_s(camera: Camera, height_m: float, speed_m_s: float, overlap: float) -> float:
    """Longest time between frames that keeps `overlap` along the shorter side: 1 / fr_min of eq. 3.17."""
    length_m = height_m * min(camera.width_px / camera.fx_px, camera.height_px / camera.fy_px)
    return float(np.clip(length_m * (1 - overlap) / max(speed_m_s, 0.1), 0.02, 10.0))


def untimed_plan(*, is_video: bool, expected: int) -> FramePlan:
    """The plan of a flight of unknown speed: a video's pictures are asked five times a second, photos are all taken."""
    step_s = _STEP_S if is_video else 0.0
    return FramePlan(step_s, 0.0, expected)


def live_plan(
    camera: Camera,
    height_m: float,
    speed_m_s: float,
    overlap: float,
    *,
    by_pictures: bool,
) -> FramePlan:
    """The plan of a video that has just begun and does not show yet how fast it will be."""
    keyframe_s = interval_s(camera, height_m, max(speed_m_s, _LIVE_SPEED_M_S), overlap)
    step_s = _STEP_S if by_pictures else min(keyframe_s, 2.0)
    return FramePlan(step_s, 0.5 * keyframe_s if by_pictures else 0.0, 2)


def video_plan(
    camera: Camera,
    height_m: float,
    speed_m_s: float,
    overlap: float,
    duration_s: float,
    frame_rate_hz: float,
    *,
    by_pictures: bool,
) -> FramePlan:
    """The plan of a recorded video. `by_pictures`: three times as many frames are asked as eq. 3.17 needs, and the
    pictures decide; else it alone does."""
    keyframe_s = interval_s(camera, height_m, speed_m_s, overlap)
    share = 3 if by_pictures else 1
    step_s = float(np.clip(keyframe_s / share, 1 / max(frame_rate_hz, 1.0), 2.0 / share))
    return FramePlan(
        step_s, 0.5 * keyframe_s if by_pictures else 0.0, max(2, round(duration_s / keyframe_s))
    )


def every(step_s: float) -> Callable[[int, int], bool]:
    """A `wanted(index, time_ns)` that takes the first frame and then one each `step_s`."""
    due_ns: list[int] = []

    def wanted(_index: int, time_ns: int) -> bool:
        if due_ns and time_ns < due_ns[0]:
            return False
        due_ns[:] = [max((due_ns[0] if due_ns else time_ns) + round(step_s * 1e9), time_ns + 1)]
        return True

    return wanted


def evenly(count: int, most: int) -> list[int]:
    """At most this many of the numbers from 0 to `count` - 1, evenly chosen, first and last among them."""
    return [int(each) for each in np.unique(np.rint(np.linspace(0, count - 1, min(most, count))))]


def select_keyframes(
    frames: Iterable[PosedFrame | LostFrame],
    settings: SelectionSettings,
    *,
    keep_all: bool,
    inside: Callable[[PosedFrame], bool],
    small: "SmallCopies | None" = None,
) -> Iterator[Selected | LostFrame]:
    """The frames that the map needs, in order; lost ones pass through.

    `inside` is True for frames in the area of interest (UAV_path, eq. 3.1); the others are dropped. `keep_all`: photos,
    each of which was meant. The shift since the last keyframe is measured in the pictures by phase correlation of
    small copies, so it needs no telemetry; where that fails (a turn, water) each candidate is taken. `small` has copies
    of the frames that were looked at before.
    """
    small = SmallCopies() if small is None else small
    last: ImageGray | None = None  # texture of the last frame selected
    latest: tuple[float, ...] = ()  # sharpness of the latest frames
    count = 0
    for posed in frames:
        if isinstance(posed, LostFrame):
            yield posed
            continue
        if not inside(posed):
            continue
        gray = small.of(posed.frame)
        clarity = sharpness(gray)
        typical = float(np.median(latest)) if latest else clarity
        texture = normalise_contrast(gray)
        overlap = 0.0 if last is None or keep_all else _overlap(last, texture)
        latest, count = (*latest, clarity)[-_USUAL:], count + 1
        reason = _reason_if_selected(overlap, clarity, typical, count, settings)
        if reason is None:
            continue
        if not reason:
            last = texture
        yield Selected(posed, reason)


def shows_all_between(old: ImageGray, new: ImageGray, settings: SelectionSettings) -> bool:
    """Whether no frame between these two, `small_gray`, is needed to keep the overlap: they lie near each other, and
    the later one is as sharp as the earlier.

    Keyframes chosen among frames so near overlap by `least_overlap` at least, with the usual settings.
    """
    if sharpness(new) < _BLURRED * sharpness(old):
        return False
    moved = 1 - _overlap(normalise_contrast(old), normalise_contrast(new))
    return moved <= _SPARSE_SHARE * (1 - settings.overlap)


class SmallCopies:
    """`small_gray` of a flight's frames, made once for the frames looked at last; only `of` changes it. Threads may
    share it."""

    def __init__(self) -> None:
        self._kept: dict[int, ImageGray] = {}
        self._keeping = threading.Lock()

    def of(self, frame: Frame) -> ImageGray:
        """The small copy of a frame."""
        with self._keeping:
            kept = self._kept.get(frame.index)
        if kept is not None:
            return kept
        made = small_gray(frame.image)
        with self._keeping:
            self._kept[frame.index] = made
            while len(self._kept) > _COPIES_KEPT:
                self._kept.pop(next(iter(self._kept)))
        return made


class StretchSelection:
    """Of frames whose places are known, those that show enough ground that the last one taken did not.

    `overlap` is the share of a frame that the last one taken may show as well; of photos each was meant, and all are
    taken. Only `take` changes it.
    """

    def __init__(self, overlap: float, *, keep_all: bool) -> None:
        self._overlap, self._keep_all = overlap, keep_all
        self._last_m: PointsM | None = None

    def take(self, outline_m: PointsM | None) -> bool:
        """Whether to take the frame of this outline, (4, 2) site metres; None where its place is not known."""
        last_m = None if self._keep_all else self._last_m
        if (
            outline_m is not None
            and last_m is not None
            and _covered(last_m, outline_m) > self._overlap
        ):
            return False
        self._last_m = outline_m
        return True


def small_gray(image: ImageRGB) -> ImageGray:
    """A gray copy whose longer side has 256 px."""
    scale = _SMALL_PX / max(image.shape[:2])
    size = (max(16, round(image.shape[1] * scale)), max(16, round(image.shape[0] * scale)))
    return gray_from_rgb(shrunk(image, size))


def has_texture(image: ImageRGB) -> bool:
    """Whether a picture shows anything but one gray, or noise alone, as a covered lens gives."""
    gray = small_gray(image)
    scale = _COARSE_PX / max(gray.shape)
    size = (max(4, round(gray.shape[1] * scale)), max(4, round(gray.shape[0] * scale)))
    coarse = shrunk(gray.astype(np.float32), size)
    return float((coarse - cv2.boxFilter(coarse, -1, (9, 9))).std()) >= _BARE_LEVELS


def _reason_if_selected(
    overlap: float, clarity: float, typical: float, count: int, settings: SelectionSettings
) -> str | None:
    """The `reason` of a selected frame; None for a frame to leave out. `count` frames gave the `typical` sharpness."""
    if overlap > settings.overlap:
        return None
    if clarity < _USELESS * typical and count > 3:
        return f"blurred: {clarity / typical:.0%} of the usual sharpness"
    if clarity < _BLURRED * typical and overlap > settings.least_overlap:
        return None
    return ""


def _overlap(last: ImageGray, new: ImageGray) -> float:
    """Share of the frame that both show; 0 where phase correlation finds no peak."""
    if last.shape != new.shape:
        return 0.0
    height, width = last.shape
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    (dx, dy), response = cv2.phaseCorrelate(last.astype(np.float32), new.astype(np.float32), window)
    if response < 0.04:
        return 0.0
    return max(0.0, 1 - abs(dx) / width) * max(0.0, 1 - abs(dy) / height)


def _covered(a_m: PointsM, b_m: PointsM) -> float:
    """The share of outline b, convex, that outline a covers."""
    centre = b_m.mean(axis=0)
    a, b = (a_m - centre).astype(np.float32), (b_m - centre).astype(np.float32)
    area, _ = cv2.intersectConvexConvex(a, b)
    return float(area / max(cv2.contourArea(b), 1e-6))
