"""A video file as a flight: its frames upright in RGB, timed by the stream's PTS, with damage counted."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, cast

import av
import numpy as np

from sorvolo.capture.containers import ends_early, top_boxes
from sorvolo.capture.decoding import is_heif
from sorvolo.capture.picture_sizes import is_same_shape, other_size
from sorvolo.capture.telemetry.cleaning import notice
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.survey.flight import CameraModel, Frame, LostFrame, Notice, Telemetry

PIXEL_LIMIT = 64_000_000
"""A video of larger frames is refused before it is decoded."""

VIDEO_SUFFIXES = frozenset({
    ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".ts", ".mts", ".m2ts", ".mpg", ".mpeg", ".avi", ".wmv", ".flv",
    ".3gp", ".h264", ".264", ".h265", ".265", ".hevc", ".lrv", ".insv", ".ogv",
})
"""How videos in a folder are recognised; a file given by name may have any name."""

_SECOND_NS = 1_000_000_000
_FALLBACK_RATE_HZ = 25.0
_GAP_S = 2.0
_CLOCK_RETURNS_WITHIN = 25  # frames after a backward step in which the old clock may come back
_DEMUX_RETRIES = 20


@dataclass(frozen=True)
class VideoInfo:
    """A video's properties by its header and first frame. Sizes are those of the frames as delivered, upright.

    `turn` is (transpose, flip left-right, flip up-down), applied in that order to decoded frames;
    `pixel_aspect` the width of a pixel over its height, as delivered; `frame_count` and `duration_s` are
    estimates, 0 where nothing is known; `is_cut`: the file ends before its header's own length.
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


class VideoSource:
    """A video's frames; fulfils `capture.source.Source`."""

    kind = "video"
    ground_elevation_m = float("nan")

    def __init__(
        self, name: str, fingerprint: str, info: VideoInfo, camera: CameraModel, telemetry: Telemetry,
        notices: Sequence[Notice] = (),
    ) -> None:
        self.name, self.fingerprint, self.info = name, fingerprint, info
        self.camera, self.telemetry = camera, telemetry
        self.inputs: tuple[str, ...] = (info.path.name,)
        self.frame_count, self.frame_rate_hz = info.frame_count, info.frame_rate_hz
        self.start_ns, self.start_origin = info.start_ns, info.start_origin
        self._notices = tuple(notices)
        self._found: tuple[Notice, ...] = tuple(_cut_notice(info.is_cut))

    def notices(self) -> tuple[Notice, ...]:
        """What was found so far; complete when `frames` is exhausted."""
        return (*self._notices, *self._found)

    def frames(self, wanted: Callable[[int, int], bool]) -> Iterator[Frame | LostFrame]:
        """Decode the whole video; convert and yield the frames for which `wanted(index, time_ns)` is true.

        A frame's time is `start_ns` plus its PTS since the first; where a PTS is missing or runs backward,
        the usual step is taken instead and counted. Damaged packets are counted and decoding goes on.
        """
        clock = _Clock(self.info.frame_rate_hz)
        damage = _Damage()
        sizes = _Sizes()
        last_ns = 0
        for index, decoded in enumerate(_decoded_frames(self.info.path, damage)):
            last_ns = clock.time_ns(decoded)
            self._found = self._damage_notices(self.info.is_cut, damage, sizes, clock)
            time_ns = self.start_ns + last_ns
            if not wanted(index, time_ns):
                continue
            own_px, flight_px = _upright_size_px(decoded, self.info.turn), (self.info.width_px, self.info.height_px)
            if not is_same_shape(own_px, flight_px):
                sizes.lost += 1
                yield LostFrame(index, str(index), time_ns, other_size(own_px, flight_px))
                continue
            try:
                image = self._image(decoded)
            except (av.FFmpegError, ValueError, MemoryError) as error:
                damage.unconverted += 1
                yield LostFrame(index, str(index), time_ns, f"corrupt: {error}")
                continue
            sizes.fitted += own_px != flight_px
            yield Frame(index, str(index), time_ns, image)
        missing_s = self.info.duration_s - last_ns / _SECOND_NS
        is_cut = self.info.is_cut or missing_s > max(1.0, 0.05 * self.info.duration_s)
        self._found = self._damage_notices(is_cut, damage, sizes, clock)

    def _damage_notices(self, is_cut: bool, damage: "_Damage", sizes: "_Sizes", clock: "_Clock") -> tuple[Notice, ...]:
        cut = _cut_notice(is_cut or damage.stopped)
        return (*cut, *damage.notices(), *sizes.notices(), *clock.notices())

    def _image(self, decoded: av.VideoFrame) -> ImageRGB:
        """The frame upright, at the first one's size."""
        width_px, height_px = self.info.width_px, self.info.height_px
        if self.info.turn[0]:
            width_px, height_px = height_px, width_px
        return upright(
            np.asarray(decoded.to_ndarray(format="rgb24", width=width_px, height=height_px), np.uint8), self.info.turn
        )

    def glimpses(self, count: int) -> list[Frame]:
        """A few frames spread over the video, found by seeking: quick, but their times are rough."""
        found: list[Frame] = []
        with _opened(self.info.path) as container:
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
                    continue  # a glimpse at a damaged place is of no use; `frames` counts the damage
                time_s = max(0.0, decoded.time - first_s) if decoded.time is not None else 0.0
                index = round(time_s * self.info.frame_rate_hz)
                found.append(Frame(index, str(index), self.start_ns + round(time_s * _SECOND_NS), image))
        return found


def read_video_info(path: Path) -> VideoInfo:
    """Read a video's header and decode its first frame.

    Raises InputError when the file is missing, empty, no video, cut so that nothing can be read, or its
    frames are larger than PIXEL_LIMIT.
    """
    _check_file(path)
    with _opened(path) as container:
        stream = _video_stream(container, path)
        size_px = stream.codec_context.width, stream.codec_context.height
        if size_px[0] * size_px[1] > PIXEL_LIMIT:
            raise InputError(
                f"{path.name}: frames of {size_px[0]}x{size_px[1]} px; at most "
                f"{PIXEL_LIMIT // 1_000_000} megapixels are read; convert the video to a smaller size"
            )
        metadata = {key.lower(): text for key, text in {**stream.metadata, **container.metadata}.items()}
        rate_hz = float(stream.average_rate or stream.guessed_rate or _FALLBACK_RATE_HZ)
        if stream.duration and stream.time_base:
            duration_s = float(stream.duration * stream.time_base)
        else:
            duration_s = (container.duration or 0) / av.time_base
        codec, count, aspect = stream.codec_context.name, stream.frames, stream.sample_aspect_ratio
        container_name = container.format.name.split(",")[0]
    first = next(_decoded_frames(path, _Damage()), None)
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
        path, container_name, codec, width_px, height_px, turn, 1 / pixel_aspect if turn[0] else pixel_aspect,
        rate_hz, count or round(duration_s * rate_hz), max(0.0, duration_s), start_ns, start_origin,
        _first_of(metadata, "com.apple.quicktime.make", "make", "com.android.manufacturer"),
        _first_of(metadata, "com.apple.quicktime.model", "model", "com.android.model"),
        ends_early(path, container_name),
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


class _Clock:
    """Frames' times since the first one, strictly increasing whatever the PTS do. `time_ns` changes it."""

    def __init__(self, frame_rate_hz: float) -> None:
        self._step_ns = max(1, round(_SECOND_NS / frame_rate_hz))
        self._last_ns = -1
        self._origin_ns = self._former_origin_ns = 0
        self._since_backward = _CLOCK_RETURNS_WITHIN
        self._missing = self._backward = self._gaps = 0
        self._longest_gap_ns = 0

    def time_ns(self, decoded: av.VideoFrame) -> int:
        """The frame's time in ns since the first frame."""
        stamp_ns = None
        if decoded.pts is not None and decoded.time_base:
            stamp_ns = round(decoded.pts * decoded.time_base * _SECOND_NS)
        if self._last_ns < 0:
            self._missing += stamp_ns is None
            self._origin_ns = self._former_origin_ns = stamp_ns or 0
            self._last_ns = 0
            return 0
        expected_ns = self._last_ns + self._step_ns
        self._since_backward += 1
        if stamp_ns is None:
            self._missing += 1
            time_ns = expected_ns
        elif stamp_ns - self._origin_ns <= self._last_ns:
            # the clock was set back: go on from here, but remember the old one, should this be a single slip
            self._backward += 1
            time_ns = expected_ns
            self._former_origin_ns, self._origin_ns = self._origin_ns, stamp_ns - time_ns
            self._since_backward = 0
        else:
            time_ns = stamp_ns - self._origin_ns
            former_ns = stamp_ns - self._former_origin_ns
            returned = abs(former_ns - expected_ns) < abs(time_ns - expected_ns)
            if self._since_backward <= _CLOCK_RETURNS_WITHIN and former_ns > self._last_ns and returned:
                time_ns, self._origin_ns = former_ns, self._former_origin_ns
        if (gap_ns := time_ns - self._last_ns) > max(_GAP_S * _SECOND_NS, 5 * self._step_ns):
            self._gaps += 1
            self._longest_gap_ns = max(self._longest_gap_ns, gap_ns)
        self._last_ns = time_ns
        return time_ns

    def notices(self) -> list[Notice]:
        longest_s = self._longest_gap_ns / _SECOND_NS
        return [
            *notice("missing_pts", self._missing, "frames without a time stamp, set by the usual step: {}"),
            *notice("backward_pts", self._backward, "times that the video's clock runs backward: {}"),
            *notice("video_gap", self._gaps, f"gaps in the video: {{}}, the longest {longest_s:.1f} s"),
        ]


@dataclass
class _Damage:
    """What was damaged while decoding; filled by `_decoded_frames`."""

    packets: int = 0
    corrupt_frames: int = 0
    unconverted: int = 0
    stopped: bool = False

    def notices(self) -> list[Notice]:
        return [
            *notice("decode_error", self.packets, "damaged places in the video, skipped: {}"),
            *notice("damaged_frame", self.corrupt_frames + self.unconverted, "frames damaged in part: {}"),
        ]


@dataclass
class _Sizes:
    """Frames of another size than the first one's: those that were brought to it, and those of another shape."""

    fitted: int = 0
    lost: int = 0

    def notices(self) -> list[Notice]:
        return [
            *notice("size_changed", self.fitted, "frames of another size, brought to the first one's: {}"),
            *notice("other_shape", self.lost, "frames of another shape, not used: {}"),
        ]


def _decoded_frames(path: Path, damage: _Damage) -> Iterator[av.VideoFrame]:
    """Every frame that FFmpeg can decode, in order; what it cannot is counted in `damage`."""
    with _opened(path) as container:
        stream = _video_stream(container, path)
        stream.thread_type = "AUTO"
        for _ in range(_DEMUX_RETRIES):
            try:
                for packet in container.demux(stream):
                    yield from _frames_of(packet, damage)
                return
            except (av.FFmpegError, IndexError):
                # PyAV's IndexError: damage made a stream appear that was not there at the start
                damage.packets += 1
        damage.stopped = True


def _frames_of(packet: "av.Packet[Any]", damage: _Damage) -> Iterator[av.VideoFrame]:
    damage.packets += packet.is_corrupt
    try:
        decoded = packet.decode()
    except (av.FFmpegError, ValueError, MemoryError):
        damage.packets += 1
        return
    for frame in decoded:
        if isinstance(frame, av.VideoFrame) and frame.width * frame.height <= PIXEL_LIMIT:
            damage.corrupt_frames += frame.is_corrupt
            yield frame


def _check_file(path: Path) -> None:
    if not path.exists():
        raise InputError(f"no such file: {path}")
    if not path.is_file():
        raise InputError(f"{path} is not a file; give a video file or a folder of photos")
    if path.stat().st_size == 0:
        raise InputError(f"{path.name} is empty (0 bytes); copy it again from the drone")
    with path.open("rb") as file:
        if is_heif(file.read(12)):
            raise InputError(f"{path.name} is a HEIC picture, not a video; rename it to {path.stem}.heic")


def _opened(path: Path) -> av.container.InputContainer:
    """Open for reading; nothing but this one file is read, whatever a playlist in it may name."""
    try:
        return av.open(f"file:{path}", options={"protocol_whitelist": "file"})
    except av.FFmpegError as error:
        raise InputError(f"{path.name} cannot be read as a video: {_why_unreadable(path, error)}") from error
    except (ValueError, MemoryError) as error:
        raise InputError(f"{path.name} cannot be read as a video: {error}") from error


def _why_unreadable(path: Path, error: Exception) -> str:
    try:
        boxes = top_boxes(path)
    except OSError as reason:
        return f"{reason}; check its permissions"
    if "ftyp" in boxes and "moov" not in boxes:
        return (
            "moov atom not found: the file was cut before its index, which an MP4 has at its end; "
            "copy it again from the drone, or repair it there; record as MKV or TS, which survive a cut"
        )
    words = getattr(error, "strerror", None) or str(error)
    return f"{words}; give a video that FFmpeg reads, or a folder of photos"


def _video_stream(container: av.container.InputContainer, path: Path) -> av.VideoStream:
    # cover art in a music file counts as a video stream
    cover = av.stream.Disposition.attached_pic
    streams = [stream for stream in container.streams.video if not stream.disposition & cover]
    if not streams:
        kinds = ", ".join(sorted({stream.type for stream in container.streams})) or "nothing"
        raise InputError(f"{path.name} has no video in it, only {kinds}; give the drone's video file")
    # PyAV's type does not state that an unknown codec leaves no context
    if cast(object, streams[0].codec_context) is None:
        raise InputError(f"{path.name}: the video's codec is unknown to FFmpeg, or its header is damaged")
    return streams[0]


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
    return notice("truncated", int(is_cut), "the video is cut: it is shorter than its header states")
