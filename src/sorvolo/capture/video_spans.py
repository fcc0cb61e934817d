"""A video read by the key frames of its stream; what lies between two of them is decoded where it is needed."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import av

from sorvolo.capture.video_stream import VideoClock, opened_video, stamp_of, video_stream
from sorvolo.survey.flight import Frame, LostFrame

if TYPE_CHECKING:
    _Packet = av.Packet[Any]


@dataclass(frozen=True)
class SparseReading:
    """Which frames to read of a video whose key frames mostly suffice.

    `wanted(index, time_ns)` is asked before a frame is decoded, always with the same answer. `is_enough(before,
    after)`: whether nothing between two key frames is needed; else a frame each `step_s` is read there. Key frames
    nearer to each other than `step_s` are passed over; a video whose key frames lie more than `longest_s` apart is read
    in full.
    """

    step_s: float
    wanted: Callable[[int, int], bool]
    is_enough: Callable[[Frame, Frame], bool]
    longest_s: float = 2.5


@dataclass(frozen=True)
class Stamp:
    """A picture of the stream before it is decoded: its number, its time in ns since the first one, its PTS."""

    index: int
    time_ns: int
    pts: int


@dataclass(frozen=True, eq=False)
class Span:
    """The pictures from a key frame to the next one that is looked at (None: to the end), and what decodes them."""

    first: Stamp
    between: Sequence[Stamp]
    next: Stamp | None
    packets: "Sequence[_Packet]"


class UnevenStreamError(Exception):
    """The stream cannot be read by its key frames; the text gives the reason in words, for a report."""


class SparseVideo:
    """One reading of a video by its key frames.

    `deliver` makes a frame of a decoded picture. While `frames` goes on, `decoded` counts the pictures that were
    decoded, `pictures` those that were passed; `passed` is the number and the time (ns) of the last one that was
    considered, or -1.
    """

    def __init__(
        self,
        path: Path,
        clock: VideoClock,
        sparse: SparseReading,
        deliver: Callable[[av.VideoFrame, int, int], Frame | LostFrame],
    ) -> None:
        self._path, self._clock, self._sparse, self._deliver = path, clock, sparse, deliver
        self.decoded = self.pictures = self.last_ns = 0
        self.passed = -1, -1
        # the key frame that was decoded last, by its number
        self._key: tuple[int, Frame | LostFrame] | None = None

    def frames(self) -> Iterator[Frame | LostFrame]:
        """The wanted frames, in order. Raises UnevenStreamError where only a full reading gives them."""
        with opened_video(self._path) as container:
            stream = video_stream(container, self._path)
            stream.thread_type = "AUTO"
            for span in self._spans(container, stream):
                if self._is_wanted(span.first):
                    frame = self._key_frame(span, span.first, stream)
                    self._pass(span.first)
                    yield frame
                self._pass(span.first)
                yield from self._frames_between(span, stream)
                self._pass(*span.between[-1:])

    # ---- inside -----------------------------------------------------------------------------------------------

    def _pass(self, *stamps: Stamp) -> None:
        for each in stamps:
            self.passed = each.index, each.time_ns

    def _is_wanted(self, stamp: Stamp) -> bool:
        return self._sparse.wanted(stamp.index, stamp.time_ns)

    def _key_frame(self, span: Span, stamp: Stamp, stream: av.VideoStream) -> Frame | LostFrame:
        """A key frame of the span, decoded alone."""
        if self._key is None or self._key[0] != stamp.index:
            packet = next(each for each in span.packets if each.pts == stamp.pts)
            shown = [each for each in _decoded(stream, [packet]) if each.pts == stamp.pts]
            if not shown:
                raise UnevenStreamError("a key frame of the stream cannot be decoded alone")
            self.decoded += 1
            self._key = stamp.index, self._deliver(shown[0], stamp.index, stamp.time_ns)
        return self._key[1]

    def _frames_between(self, span: Span, stream: av.VideoStream) -> Iterator[Frame | LostFrame]:
        """A frame each step between the span's key frames, where they are not enough."""
        step_ns = round(self._sparse.step_s * 1e9)
        due_ns, until_ns = span.first.time_ns + step_ns, self._until_ns(span, step_ns)
        if (
            due_ns >= until_ns
            or not any(map(self._is_wanted, span.between))
            or self._is_enough(span, stream)
        ):
            return
        for stamp, decoded in self._decoded_between(span, stream):
            if not due_ns <= stamp.time_ns < until_ns:
                continue
            due_ns += step_ns * (1 + (stamp.time_ns - due_ns) // step_ns)
            if self._is_wanted(stamp):
                self._pass(stamp)
                yield self._deliver(decoded, stamp.index, stamp.time_ns)

    def _until_ns(self, span: Span, step_ns: int) -> int:
        """What comes later between the key frames shows the same as the second one."""
        if span.next is not None:
            return span.next.time_ns - step_ns // 2
        return span.between[-1].time_ns + 1 if span.between else 0

    def _decoded_between(
        self, span: Span, stream: av.VideoStream
    ) -> Iterator[tuple[Stamp, av.VideoFrame]]:
        """The pictures between the key frames, but for those that no other refers to."""
        stamps = {each.pts: each for each in span.between}
        for decoded in _decoded(stream, span.packets, skip="NONREF"):
            if decoded.pts is not None and decoded.pts in stamps:
                self.decoded += 1
                yield stamps[decoded.pts], decoded

    def _is_enough(self, span: Span, stream: av.VideoStream) -> bool:
        if span.next is None:
            return False
        before = self._key_frame(span, span.first, stream)
        after = self._key_frame(span, span.next, stream)
        return (
            isinstance(before, Frame)
            and isinstance(after, Frame)
            and self._sparse.is_enough(before, after)
        )

    def _spans(
        self, container: av.container.InputContainer, stream: av.VideoStream
    ) -> Iterator[Span]:
        """From one key frame to the next that is a step later, or more."""
        first: Stamp | None = None
        between: list[Stamp] = []
        packets: list[_Packet] = []
        for group, ahead in _groups(container, stream, self._sparse.longest_s):
            first = self._stamp(group[0]) if first is None else first
            between += [self._stamp(each) for each in _in_order(group, ahead)]
            packets += [*(group[1:] if packets else group), *ahead]
            following = self._stamp(ahead[0]) if ahead else None
            if (
                following is not None
                and following.time_ns - first.time_ns < self._sparse.step_s * 1e9
            ):
                between.append(following)
                continue
            yield Span(first, between, following, packets)
            first, between, packets = following, [], []
        if packets and first is not None:  # the last key frames lay nearer than a step
            yield Span(first, between, None, packets)

    def _stamp(self, packet: "_Packet") -> Stamp:
        assert packet.pts is not None
        self.last_ns = self._clock.time_ns(stamp_of(packet))
        self.pictures += 1
        return Stamp(self.pictures - 1, self.last_ns, packet.pts)


def _groups(
    container: av.container.InputContainer, stream: av.VideoStream, longest_s: float
) -> "Iterator[tuple[list[_Packet], list[_Packet]]]":
    """The packets from each key frame to before the next; that next one, and those that follow it but are shown before.

    In decoding order; the last group has none ahead.
    """
    group: list[_Packet] = []
    ahead: list[_Packet] = []
    for packet in _packets(container, stream, longest_s):
        if ahead and (packet.is_keyframe or _pts(packet) > _pts(ahead[0])):
            yield group, ahead
            group, ahead = ahead[:1], []
        (ahead if group and (ahead or packet.is_keyframe) else group).append(packet)
    if group:
        yield group, ahead
    if ahead:
        yield ahead[:1], []


def _packets(
    container: av.container.InputContainer, stream: av.VideoStream, longest_s: float
) -> "Iterator[_Packet]":
    """All packets of an even stream, the first being a key frame's. Raises UnevenStreamError for any other."""
    key_pts: int | None = None
    unit_s = float(stream.time_base or 1)
    try:
        for packet in container.demux(stream):
            if packet.size == 0:
                continue  # PyAV's sign of the end
            if packet.pts is None:
                raise UnevenStreamError("pictures of the stream have no time stamps")
            if packet.is_corrupt or packet.is_discard:
                raise UnevenStreamError("the stream is damaged, or edited")
            key_pts = packet.pts if packet.is_keyframe else key_pts
            if key_pts is None:
                raise UnevenStreamError("the video does not begin with a key frame")
            if (_pts(packet) - key_pts) * unit_s > longest_s:
                raise UnevenStreamError(
                    f"key frames of the stream lie more than {longest_s:g} s apart"
                )
            yield packet
    except (av.FFmpegError, IndexError) as error:
        raise UnevenStreamError("the stream is damaged") from error


def _pts(packet: "_Packet") -> int:
    assert packet.pts is not None
    return packet.pts


def _in_order(group: "Sequence[_Packet]", ahead: "Sequence[_Packet]") -> "list[_Packet]":
    """The pictures between two key frames in the order in which they are shown."""
    shown = sorted([*group[1:], *ahead[1:]], key=_pts)
    bounds = [_pts(group[0]), *map(_pts, shown), *map(_pts, ahead[:1])]
    if any(later <= earlier for earlier, later in pairwise(bounds)):
        raise UnevenStreamError("time stamps of the stream run backward")
    return shown


def _decoded(
    stream: av.VideoStream, packets: "Sequence[_Packet]", skip: str = "DEFAULT"
) -> Iterator[av.VideoFrame]:
    """The pictures of these packets, the first of which is a key frame's; `skip` as FFmpeg names what is left out."""
    context = stream.codec_context
    context.flush_buffers()
    context.skip_frame = skip  # type: ignore[assignment]
    try:
        for packet in (*packets, None):
            for decoded in context.decode(packet):
                if decoded.is_corrupt:
                    raise UnevenStreamError("the stream is damaged")
                yield decoded
    except (av.FFmpegError, ValueError, MemoryError) as error:
        raise UnevenStreamError("the stream is damaged") from error
    finally:
        context.skip_frame = "DEFAULT"
        context.flush_buffers()
