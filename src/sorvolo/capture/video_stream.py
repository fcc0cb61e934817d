"""A video's stream: opened, decoded picture by picture, timed by its PTS, with damage counted."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, cast

import av

from sorvolo.capture.telemetry.cleaning import notice
from sorvolo.errors import InputError
from sorvolo.geometry.units import SECOND_NS
from sorvolo.survey.flight import Notice

_TS_PACKET_BYTES = 188  # ISO/IEC 13818-1
_MOST_BOXES = 100_000  # at the top of an MP4; a fragmented one has two a fragment; by choice
_EBML_UNKNOWN_SIZES = frozenset((1 << 7 * length) - 1 for length in range(1, 9))


def ends_early(path: Path, container: str) -> bool:
    """Whether the file's own structure reaches beyond its end; False for containers without such a structure.

    `container` is FFmpeg's name: mpegts, mov (also MP4) or matroska (also WebM).
    """
    size = path.stat().st_size
    if container == "mpegts":
        with path.open("rb") as file:
            return file.read(1) == b"\x47" and size % _TS_PACKET_BYTES != 0
    if container == "mov":
        return any(end > size for end in top_boxes(path).values())
    if container == "matroska":
        return _matroska_end(path) > size
    return False


def top_boxes(path: Path) -> dict[str, int]:
    """The boxes at the top of an MP4 or MOV file by name, each with the offset where its last one ends."""
    boxes: dict[str, int] = {}
    size, start = path.stat().st_size, 0
    with path.open("rb") as file:
        for _ in range(_MOST_BOXES):
            if start + 8 > size:
                break
            file.seek(start)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            if length == 1:
                length = int.from_bytes(head[8:16], "big")
            elif length == 0:  # to the end of the file
                length = size - start
            if length < 8:
                break
            start += length
            boxes[head[4:8].decode("latin-1")] = start
    return boxes


def _matroska_end(path: Path) -> int:
    """Where the first Matroska segment ends by its own header, bytes; 0 if unknown."""
    with path.open("rb") as file:
        for _ in range(2):  # the EBML header, then the segment
            identity = file.read(4)
            length = _ebml_length(file)
            if identity == b"\x18\x53\x80\x67":
                return 0 if length in _EBML_UNKNOWN_SIZES else file.tell() + length
            file.seek(length, 1)
    return 0


def _ebml_length(file: BinaryIO) -> int:
    first = file.read(1)
    if not first or not first[0]:
        return 0
    extra = 8 - first[0].bit_length()
    return int.from_bytes(bytes([first[0] & ((1 << (7 - extra)) - 1)]) + file.read(extra), "big")


PIXEL_LIMIT = 64_000_000
"""A video of larger frames is refused before it is decoded."""

_GAP_S = 2.0  # between two frames, or five usual steps: longer, pictures are missing; by choice
_CLOCK_RETURNS_WITHIN = 25  # frames after a backward step in which the old clock may come back
_DEMUX_RETRIES = 20  # damaged places after which reading goes on; then the file has ended


class VideoClock:
    """Frames' times since the first one, strictly increasing whatever the PTS do. `time_ns` changes it."""

    def __init__(self, frame_rate_hz: float) -> None:
        self._step_ns = max(1, round(SECOND_NS / frame_rate_hz))
        self._last_ns = -1
        self._origin_ns = self._former_origin_ns = 0
        self._since_backward = _CLOCK_RETURNS_WITHIN
        self._missing = self._backward = self._gaps = 0
        self._longest_gap_ns = 0

    def time_ns(self, stamp_ns: int | None) -> int:
        """The next frame's time in ns since the first frame, by its PTS in ns; None where it has none."""
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
            if (
                self._since_backward <= _CLOCK_RETURNS_WITHIN
                and former_ns > self._last_ns
                and returned
            ):
                time_ns, self._origin_ns = former_ns, self._former_origin_ns
        if (gap_ns := time_ns - self._last_ns) > max(_GAP_S * SECOND_NS, 5 * self._step_ns):
            self._gaps += 1
            self._longest_gap_ns = max(self._longest_gap_ns, gap_ns)
        self._last_ns = time_ns
        return time_ns

    def notices(self) -> list[Notice]:
        """What was wrong with the time stamps so far."""
        longest_s = self._longest_gap_ns / SECOND_NS
        return [
            *notice(
                "missing_pts",
                self._missing,
                "frames without a time stamp, set by the usual step: {}",
            ),
            *notice(
                "backward_pts", self._backward, "times that the video's clock runs backward: {}"
            ),
            *notice(
                "video_gap", self._gaps, f"gaps in the video: {{}}, the longest {longest_s:.1f} s"
            ),
        ]


@dataclass
class DecodingDamage:
    """What was damaged while decoding; filled by `decoded_frames`."""

    packets: int = 0
    corrupt_frames: int = 0
    unconverted: int = 0
    stopped: bool = False

    def notices(self) -> list[Notice]:
        """What was damaged so far."""
        return [
            *notice("decode_error", self.packets, "damaged places in the video, skipped: {}"),
            *notice(
                "damaged_frame",
                self.corrupt_frames + self.unconverted,
                "frames damaged in part: {}",
            ),
        ]


def decoded_frames(path: Path, damage: DecodingDamage) -> Iterator[av.VideoFrame]:
    """Every frame that FFmpeg can decode, in order; what it cannot is counted in `damage`."""
    with opened_video(path) as container:
        stream = video_stream(container, path)
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


def stamp_of(picture: "av.VideoFrame | av.Packet[Any]") -> int | None:
    """A picture's PTS in ns, decoded or not; None where it has none."""
    base = picture.time_base
    if picture.pts is None or not base:
        return None
    # as `round` of the fraction, which takes ten times as long, and there is one for each picture of a video
    whole, rest = divmod(picture.pts * base.numerator * SECOND_NS, base.denominator)
    return whole + (2 * rest + whole % 2 > base.denominator)


def _frames_of(packet: "av.Packet[Any]", damage: DecodingDamage) -> Iterator[av.VideoFrame]:
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


# FFmpeg's readers of one file each: none that opens what a file names (concat, hls, dash, sdp, numbered pictures)
ONE_FILE = {
    "protocol_whitelist": "file",
    "format_whitelist": "mov,mp4,matroska,webm,avi,mpegts,mpeg,flv,asf,mxf,ogg,nut,ivf,dv,gif,h264,hevc,m4v,"
    "mjpeg,mpegvideo,yuv4mpegpipe,wav,mp3",
}


def opened_video(path: Path) -> av.container.InputContainer:
    """Open for reading; nothing but this one file is read, whatever a playlist in it may name."""
    try:
        return av.open(f"file:{path}", options=ONE_FILE)
    except av.FFmpegError as error:
        raise InputError(
            f"{path.name} cannot be read as a video: {_why_unreadable(path, error)}"
        ) from error
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
    if isinstance(error, av.error.ArgumentError):
        return (
            "it is a list of other files, or of a kind that is not read; give a video, MP4 or MKV"
        )
    words = getattr(error, "strerror", None) or str(error)
    return f"{words}; give a video that FFmpeg reads, or a folder of photos"


def video_stream(container: av.container.InputContainer, path: Path) -> av.VideoStream:
    """The container's first video. Raises InputError where it has none, or of a codec that is not known."""
    # cover art in a music file counts as a video stream
    cover = av.stream.Disposition.attached_pic
    streams = [stream for stream in container.streams.video if not stream.disposition & cover]
    if not streams:
        kinds = ", ".join(sorted({stream.type for stream in container.streams})) or "nothing"
        raise InputError(
            f"{path.name} has no video in it, only {kinds}; give the drone's video file"
        )
    # PyAV's type does not state that an unknown codec leaves no context
    if cast(object, streams[0].codec_context) is None:
        raise InputError(
            f"{path.name}: the video's codec is unknown to FFmpeg, or its header is damaged"
        )
    return streams[0]
