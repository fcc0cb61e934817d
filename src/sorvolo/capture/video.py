"""A video file as a flight: its frames upright in RGB, timed by the stream's PTS, with damage counted."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, cast

import av
import numpy as np

from sorvolo.capture.decoding import is_heif, is_same_shape, other_size
from sorvolo.capture.telemetry.cleaning import notice
from sorvolo.capture.video_spans import SparseReading, SparseVideo, UnevenStreamError
from sorvolo.capture.video_stream import (
    PIXEL_LIMIT,
    DecodingDamage,
    VideoClock,
    decoded_frames,
    ends_early,
    opened_video,
    stamp_of,
    video_stream,
)
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.units import SECOND_NS
from sorvolo.survey.flight import CameraModel, Frame, LostFrame, Notice, Telemetry

VIDEO_SUFFIXES = frozenset(
    {
        ".mp4",
        ".m4v",
        ".mov",
        ".mkv",
        ".webm",
        ".ts",
        ".mts",
        ".m2ts",
        ".mpg",
        ".mpeg",
        ".avi",
        ".wmv",
        ".flv",
        ".3gp",
        ".h264",
        ".264",
        ".h265",
        ".265",
        ".hevc",
        ".lrv",
        ".lrf",
        ".insv",
        ".ogv",
    }
)
"""How videos in a folder are recognised; a file given by name may have any name."""

_DJI_TRACK = "DJI meta"  # the handler of the track djmd
_FALLBACK_RATE_HZ = 25.0  # of a video that states none: PAL's


@dataclass(frozen=True)
class VideoInfo:
    """A video's properties by its header and first frame. Sizes are those of the frames as delivered, upright.

    `turn` is (transpose, flip left-right, flip up-down), applied in that order to decoded frames;
    `pixel_aspect` the width of a pixel over its height, as delivered; `frame_count` and `duration_s` are
    estimates, 0 where nothing is known; `is_cut`: the file ends before its header's own length; `has_dji_track`: it has DJI's
    telemetry track (djmd), which is not read.
    """

    path: Path
    container: str
    codec: str
    width_px: int
    height_px: int
    turn: tuple[bool, bool, bool]
    pixel_aspect: float
    frame_rate_hz: float
    frame_count: int
    duration_s: float
    start_ns: int
    start_origin: str
    make: str
    model: str
    is_cut: bool
    has_dji_track: bool = False


@dataclass(frozen=True)
class Reading:
    """How a video was read: why all of it was decoded (empty: it was not), how many pictures were, and how many not."""

    whole_because: str = ""
    decoded: int = 0
    skipped: int = 0


class VideoSource:
    """A video's frames; fulfils `capture.source.Source`."""

    kind = "video"
    ground_elevation_m = float("nan")
    start_doubt = ""
    """Why `start_ns` is not when the first frame was taken; "" where nothing speaks against it."""

    def __init__(
        self,
        name: str,
        fingerprint: str,
        info: VideoInfo,
        camera: CameraModel,
        telemetry: Telemetry,
        notices: Sequence[Notice] = (),
    ) -> None:
        self.name, self.fingerprint, self.info = name, fingerprint, info
        self.camera, self.telemetry = camera, telemetry
        self.inputs: tuple[str, ...] = (info.path.name,)
        self.files: tuple[Path, ...] = (info.path,)
        self.frame_count, self.frame_rate_hz = info.frame_count, info.frame_rate_hz
        self.start_ns, self.start_origin = info.start_ns, info.start_origin
        self._notices = tuple(notices)
        self._found: tuple[Notice, ...] = tuple(_cut_notice(info.is_cut))
        self.reading = Reading()
        """How the frames were read; complete when `frames` is exhausted."""

    def note(self, *notices: Notice) -> None:
        """Add what was found before the video was opened."""
        self._notices = (*notices, *self._notices)

    def notices(self) -> tuple[Notice, ...]:
        """What was found so far; complete when `frames` is exhausted."""
        return (*self._notices, *self._found)

    def frames(
        self, wanted: Callable[[int, int], bool], sparse: SparseReading | None = None
    ) -> Iterator[Frame | LostFrame]:
        """Decode the video; convert and yield the frames for which `wanted(index, time_ns)` is true.

        A frame's time is `start_ns` plus its PTS since the first; where a PTS is missing or runs backward,
        the usual step is taken instead and counted. Damaged packets are counted and decoding goes on. With `sparse`
        only what that needs is decoded, and `wanted` goes for the rest of a stream that cannot be read so.
        """
        if sparse is None:
            self.reading = Reading("all frames were asked for")
            yield from self._all_frames(wanted)
            return
        clock, sizes, damage = VideoClock(self.info.frame_rate_hz), _Sizes(), DecodingDamage()
        timed = replace(
            sparse, wanted=lambda index, time_ns: sparse.wanted(index, self.start_ns + time_ns)
        )

        def deliver(decoded: av.VideoFrame, index: int, time_ns: int) -> Frame | LostFrame:
            return self._delivered(decoded, index, self.start_ns + time_ns, sizes, damage)

        video = SparseVideo(self.info.path, clock, timed, deliver)
        try:
            for each in video.frames():
                self.reading = Reading("", video.decoded, max(0, video.pictures - video.decoded))
                yield each
            self.reading = Reading("", video.decoded, max(0, video.pictures - video.decoded))
            self._found = self._damage_notices(
                self._ends_before(video.last_ns), damage, sizes, clock
            )
        except UnevenStreamError as reason:
            self.reading = Reading(str(reason), video.decoded)
            yield from self._all_frames(wanted, *video.passed)

    def _all_frames(
        self, wanted: Callable[[int, int], bool], passed: int = -1, passed_ns: int = -1
    ) -> Iterator[Frame | LostFrame]:
        """The wanted frames after one of this number and time since the first, every frame being decoded."""
        clock, damage, sizes = VideoClock(self.info.frame_rate_hz), DecodingDamage(), _Sizes()
        last_ns, before = 0, self.reading
        for index, decoded in enumerate(decoded_frames(self.info.path, damage)):
            last_ns = clock.time_ns(stamp_of(decoded))
            self.reading = replace(before, decoded=before.decoded + index + 1)
            self._found = self._damage_notices(self.info.is_cut, damage, sizes, clock)
            time_ns = self.start_ns + last_ns
            if wanted(index, time_ns) and index > passed and last_ns > passed_ns:
                yield self._delivered(decoded, index, time_ns, sizes, damage)
        self._found = self._damage_notices(self._ends_before(last_ns), damage, sizes, clock)

    def _ends_before(self, last_ns: int) -> bool:
        """Whether the video is shorter than its header states."""
        missing_s = self.info.duration_s - last_ns / SECOND_NS
        return self.info.is_cut or missing_s > max(1.0, 0.05 * self.info.duration_s)

    def _delivered(
        self,
        decoded: av.VideoFrame,
        index: int,
        time_ns: int,
        sizes: "_Sizes",
        damage: DecodingDamage,
    ) -> Frame | LostFrame:
        """A decoded picture as a frame; what is odd of it is counted."""
        own_px = _upright_size_px(decoded, self.info.turn)
        flight_px = (self.info.width_px, self.info.height_px)
        if not is_same_shape(own_px, flight_px):
            sizes.lost += 1
            return LostFrame(index, str(index), time_ns, other_size(own_px, flight_px))
        try:
            image = self._image(decoded)
        except (av.FFmpegError, ValueError, MemoryError) as error:
            damage.unconverted += 1
            return LostFrame(index, str(index), time_ns, f"corrupt: {error}")
        sizes.fitted += own_px != flight_px
        return Frame(index, str(index), time_ns, image)

    def _damage_notices(
        self, is_cut: bool, damage: DecodingDamage, sizes: "_Sizes", clock: VideoClock
    ) -> tuple[Notice, ...]:
        cut = _cut_notice(is_cut or damage.stopped)
        return (*cut, *damage.notices(), *sizes.notices(), *clock.notices())

    def _image(self, decoded: av.VideoFrame) -> ImageRGB:
        """The frame upright, at the first one's size."""
        width_px, height_px = self.info.width_px, self.info.height_px
        if self.info.turn[0]:
            width_px, height_px = height_px, width_px
        return upright(
            np.asarray(
                decoded.to_ndarray(format="rgb24", width=width_px, height=height_px), np.uint8
            ),
            self.info.turn,
        )

    def sample_frames(self, count: int) -> list[Frame]:
        """A few frames spread over the video, found by seeking: quick, but their times are rough."""
        found: list[Frame] = []
        with opened_video(self.info.path) as container:
            stream = container.streams.video[0]
            first_s = (stream.start_time or 0) * float(stream.time_base or 0)
            for part in range(count):
                target_s = first_s + (part + 0.5) / count * self.info.duration_s
                try:
                    if part or self.info.duration_s:
                        container.seek(int(target_s / float(stream.time_base or 1)), stream=stream)
                    decoded = next(container.decode(stream))
                    flight_px = self.info.width_px, self.info.height_px
                    if not is_same_shape(_upright_size_px(decoded, self.info.turn), flight_px):
                        continue
                    image = self._image(decoded)
                except (av.FFmpegError, StopIteration, ValueError, OverflowError, MemoryError):
                    continue  # a sample at a damaged place is of no use; `frames` counts the damage
                time_s = max(0.0, decoded.time - first_s) if decoded.time is not None else 0.0
                index = round(time_s * self.info.frame_rate_hz)
                found.append(
                    Frame(index, str(index), self.start_ns + round(time_s * SECOND_NS), image)
                )
        return found


def read_video_info(path: Path) -> VideoInfo:
    """Read a video's header and decode its first frame.

    Raises InputError when the file is missing, empty, no video, cut so that nothing can be read, or its
    frames are larger than PIXEL_LIMIT.
    """
    if not path.is_file():
        raise InputError(f"no such file: {path}; give a video, or a folder of photos")
    if path.stat().st_size == 0:
        raise InputError(f"{path.name} is empty (0 bytes); copy it again from the drone")
    with path.open("rb") as file:
        if is_heif(file.read(12)):
            raise InputError(
                f"{path.name} is a HEIC picture, not a video; rename it to {path.stem}.heic"
            )
    with opened_video(path) as container:
        stream = video_stream(container, path)
        size_px = stream.codec_context.width, stream.codec_context.height
        if size_px[0] * size_px[1] > PIXEL_LIMIT:
            raise InputError(
                f"{path.name}: frames of {size_px[0]}x{size_px[1]} px; at most "
                f"{PIXEL_LIMIT // 1_000_000} megapixels are read; convert the video to a smaller size"
            )
        metadata = {
            key.lower(): text for key, text in {**stream.metadata, **container.metadata}.items()
        }
        rate_hz = float(stream.average_rate or stream.guessed_rate or _FALLBACK_RATE_HZ)
        if stream.duration and stream.time_base:
            duration_s = float(stream.duration * stream.time_base)
        else:
            duration_s = (container.duration or 0) / av.time_base
        codec, count, aspect = stream.codec_context.name, stream.frames, stream.sample_aspect_ratio
        container_name = container.format.name.split(",")[0]
        handlers = {each.metadata.get("handler_name", "") for each in container.streams.data}
    first = next(decoded_frames(path, DecodingDamage()), None)
    if first is None:
        raise InputError(
            f"{path.name}: a {codec} video without a single readable frame; it was cut or never finished: "
            "copy it again from the drone, and record as MKV or TS, which survive a cut"
        )
    turn = _turn_of(first)
    width_px, height_px = _upright_size_px(first, turn)
    pixel_aspect = float(aspect) if aspect else 1.0
    start_ns, start_origin = _start_of(metadata)
    return VideoInfo(
        path,
        container_name,
        codec,
        width_px,
        height_px,
        turn,
        1 / pixel_aspect if turn[0] else pixel_aspect,
        rate_hz,
        count or round(duration_s * rate_hz),
        max(0.0, duration_s),
        start_ns,
        start_origin,
        _first_of(metadata, "com.apple.quicktime.make", "make", "com.android.manufacturer"),
        _first_of(metadata, "com.apple.quicktime.model", "model", "com.android.model"),
        ends_early(path, container_name),
        _DJI_TRACK in handlers,
    )


def upright(image: ImageRGB, turn: tuple[bool, bool, bool]) -> ImageRGB:
    """The picture, (height, width, channels), transposed and flipped by `VideoInfo.turn`."""
    transpose, left_right, up_down = turn
    if transpose:
        image = image.transpose(1, 0, 2)
    if left_right:
        image = image[:, ::-1]
    if up_down:
        image = image[::-1]
    return np.ascontiguousarray(image, dtype=np.uint8)


def _upright_size_px(decoded: av.VideoFrame, turn: tuple[bool, bool, bool]) -> tuple[int, int]:
    return (decoded.height, decoded.width) if turn[0] else (decoded.width, decoded.height)


@dataclass
class _Sizes:
    """Frames of another size than the first one's: those that were brought to it, and those of another shape."""

    fitted: int = 0
    lost: int = 0

    def notices(self) -> list[Notice]:
        return [
            *notice(
                "size_changed",
                self.fitted,
                "frames of another size, brought to the first one's: {}",
            ),
            *notice("other_shape", self.lost, "frames of another shape, not used: {}"),
        ]


def _turn_of(frame: av.VideoFrame) -> tuple[bool, bool, bool]:
    """The display matrix, (x, y) -> (ax + cy, bx + dy), as transpose, flip left-right, flip up-down."""
    side_data = cast(Mapping[str, Any], frame.side_data)  # its stub knows one key only
    if "DISPLAYMATRIX" not in side_data:
        return False, False, False
    matrix = np.frombuffer(bytes(side_data["DISPLAYMATRIX"]), np.int32)
    a, b, _, c, d = (int(value) for value in matrix[:5])
    if abs(b) + abs(c) > abs(a) + abs(d):
        return True, c < 0, b < 0
    return False, a < 0, d < 0


def _start_of(metadata: dict[str, str]) -> tuple[int, str]:
    for key in ("creation_time", "com.apple.quicktime.creationdate", "date"):
        try:
            moment = datetime.fromisoformat(metadata[key].replace("Z", "+00:00"))
        except (KeyError, ValueError):
            continue
        zoned = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
        if 1990 <= zoned.year <= 2200:  # cameras without a clock write 1904 or 1970
            since = zoned - datetime(1970, 1, 1, tzinfo=UTC)
            origin = f"{key} in the video (some cameras write local time there)"
            return since // timedelta(microseconds=1) * 1000, origin
    return 0, "unknown: the video does not state when it was recorded"


def _first_of(metadata: dict[str, str], *keys: str) -> str:
    return next((metadata[key].strip() for key in keys if metadata.get(key, "").strip()), "")


def _cut_notice(is_cut: bool) -> list[Notice]:
    return notice(
        "truncated", int(is_cut), "the video is cut: it is shorter than its header states"
    )
