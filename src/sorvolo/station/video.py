"""A drone's pictures for browsers: copied as they came, never decoded, each viewer at its own pace."""

import asyncio
import json
import logging
import struct
from collections import deque
from collections.abc import Mapping
from fractions import Fraction
from io import BytesIO
from typing import Any, Literal

import av

from sorvolo.station.messages import Hello, Message, codec_string, is_delimiter, nal_units

_LOG = logging.getLogger("sorvolo.station.video")

Mode = Literal["annexb", "fmp4"]

_MOST_WAITING = 90  # pictures, three seconds
_MOST_WAITING_BYTES = 8_000_000  # three seconds at 20 Mbit/s
# pictures since a key frame that are kept for new viewers
_MOST_GROUP = 900
_MOST_GROUP_BYTES = 64_000_000
_STAMP_BYTES = 8  # of a picture's time before its data, us
_CLOCK_HZ = 1_000_000  # us, as WebCodecs counts
_STEP_US = 33_333  # how long a picture is shown where nobody states the rate


class VideoHub:
    """One stream's pictures, given to any number of viewers. `begin`, `show` and `note` change it, in one event loop.

    A picture is packed once for all viewers of a mode. Whoever joins begins at the last key frame.
    """

    def __init__(self) -> None:
        self._hello: Hello | None = None
        self._group: list[Message] = []  # since the last key frame; none where they became too many
        self._group_bytes = 0
        self._codec = ""
        self.epoch_us: int | None = None  # UTC of the flight's zero, where the drone flies now
        self._viewers: set[Viewer] = set()
        self._fragments: Fragments | None = None

    @property
    def viewers(self) -> int:
        """How many watch."""
        return len(self._viewers)

    def begin(self, hello: Hello) -> None:
        """A drone came, or came back."""
        if self._hello is None or (self._hello.flight, self._hello.codec) != (
            hello.flight,
            hello.codec,
        ):
            self._group, self._codec, self._fragments, self.epoch_us = [], "", None, None
        self._hello = hello

    def show(self, message: Message) -> None:
        """Give a picture to all viewers."""
        if self._hello is None:
            return
        if message.is_key:
            assert self._hello is not None
            codec = codec_string(self._hello.codec, message.payload)
            if codec is not None and codec != self._codec:
                self._codec, self._group = codec, []
                self._fragments = _fragments_of(self._hello, message.payload)
                for viewer in self._viewers:
                    self._start(viewer)
            self._group = [message]
            self._group_bytes = len(message.payload)
        elif self._codec and self._group:
            # keep a picture for new viewers; where there are too many, new viewers wait for
            # the next key frame
            self._group_bytes += len(message.payload)
            if len(self._group) >= _MOST_GROUP or self._group_bytes > _MOST_GROUP_BYTES:
                self._group = []
            else:
                self._group.append(message)
        if not self._codec:
            return  # no key frame yet: nobody could show it
        packed: dict[Mode, bytes] = {}
        for viewer in self._viewers:
            if viewer.mode not in packed:
                packed[viewer.mode] = self._packed(viewer.mode, message)
            viewer.put(packed[viewer.mode], message.is_key)

    def note(self, words: Mapping[str, Any]) -> None:
        """Send all viewers a JSON message, such as the boxes of a picture."""
        text = json.dumps(words, separators=(",", ":"))
        for viewer in self._viewers:
            viewer.put_text(text)

    def join(self, mode: Mode) -> "Viewer":
        """A new viewer, who first gets what the stream is, then everything from the last key frame on."""
        viewer = Viewer(mode)
        self._viewers.add(viewer)
        if self._codec:
            self._start(viewer)
        return viewer

    def leave(self, viewer: "Viewer") -> None:
        """A viewer is gone."""
        self._viewers.discard(viewer)

    def _start(self, viewer: "Viewer") -> None:
        hello = self._hello
        assert hello is not None
        words: dict[str, Any] = {
            "type": "format",
            "codec": self._codec,
            "width": hello.width,
            "height": hello.height,
            "fps": hello.fps,
            "mode": viewer.mode,
        }
        viewer.put_text(
            json.dumps(words if self.epoch_us is None else words | {"epoch_us": self.epoch_us})
        )
        if viewer.mode == "fmp4" and self._fragments is not None:
            viewer.put(self._fragments.header, is_key=True, is_limited=False)
        for message in self._group:
            viewer.put(self._packed(viewer.mode, message), message.is_key, is_limited=False)
        if not self._group:
            viewer.wait_for_key()

    def _packed(self, mode: Mode, message: Message) -> bytes:
        if mode == "annexb":
            return annexb_bytes(message)
        return b"" if self._fragments is None else self._fragments.fragment(message)


def _fragments_of(hello: Hello, key_frame: bytes) -> "Fragments | None":
    """Fragments that begin with a key frame; None where FFmpeg makes no header of its parameter sets."""
    try:
        return Fragments(hello, key_frame)
    except (av.FFmpegError, ValueError, IndexError) as error:
        _LOG.warning("no fragmented MP4 of this stream: %s", error)
        return None


class Viewer:
    """One browser. `put` never waits: pictures that the browser has no time for are dropped to the next key frame."""

    def __init__(self, mode: Mode) -> None:
        self.mode = mode
        self.dropped = 0
        self._waiting: deque[bytes | str] = deque()
        self._bytes = self._pictures = 0
        self._needs_key = False
        self._arrived = asyncio.Event()

    def put(self, data: bytes, is_key: bool, *, is_limited: bool = True) -> None:
        """One more picture."""
        if not data:
            return
        if self._needs_key and not is_key:
            self.dropped += 1
            return
        if is_limited and (self._pictures >= _MOST_WAITING or self._bytes >= _MOST_WAITING_BYTES):
            self.dropped += self._pictures
            self._waiting = deque(each for each in self._waiting if isinstance(each, str))
            self._bytes = self._pictures = 0
            if not is_key:
                self._needs_key = True
                self.dropped += 1
                return
        self._needs_key = False
        self._waiting.append(data)
        self._bytes += len(data)
        self._pictures += 1
        self._arrived.set()

    def wait_for_key(self) -> None:
        """Drop pictures until one comes that needs no other."""
        self._needs_key = True

    def put_text(self, text: str) -> None:
        """One more message; left out where too many wait already."""
        if len(self._waiting) < 4 * _MOST_WAITING:
            self._waiting.append(text)
            self._arrived.set()

    async def next(self) -> bytes | str:
        """What to send now, once there is any."""
        while (item := self.take()) is None:
            self._arrived.clear()
            await self._arrived.wait()
        return item

    def take(self) -> bytes | str | None:
        """What to send now; None while there is nothing."""
        item = self._waiting.popleft() if self._waiting else None
        if isinstance(item, bytes):
            self._bytes -= len(item)
            self._pictures -= 1
        return item


class Fragments:
    """Pictures as fragmented MP4, one fragment each, for a browser's MediaSource; their times are the flight's own.

    The header is FFmpeg's, made from a key frame; the fragments (ISO 14496-12, 8.8) hold one picture each and depend on
    nothing before them, so that one packing serves all viewers, wherever they begin.
    """

    def __init__(self, hello: Hello, key_frame: bytes) -> None:
        self._codec = hello.codec
        self._number = 0
        self._step_us = round(_CLOCK_HZ / hello.fps) if hello.fps > 0 else _STEP_US
        sink = BytesIO()
        options = {"movflags": "empty_moov+default_base_moof+frag_custom"}
        with (
            av.open(BytesIO(key_frame), format=hello.codec) as looked_at,
            av.open(sink, "w", format="mp4", options=options) as output,
        ):
            stream = output.add_stream_from_template(looked_at.streams.video[0])
            stream.time_base = Fraction(1, _CLOCK_HZ)
            output.start_encoding()
            self.header = sink.getvalue()

    def fragment(self, message: Message) -> bytes:
        """One picture."""
        self._number += 1
        dts_us = max(0, message.pts_us if message.dts_us is None else message.dts_us)
        units = [each for each in nal_units(message.payload) if not is_delimiter(self._codec, each)]
        data = b"".join(len(each).to_bytes(4, "big") + each for each in units)
        # needs no other; needs one, is no place to begin
        flags = 0x0200_0000 if message.is_key else 0x0101_0000
        tfhd = _box(b"tfhd", struct.pack(">II", 0x02_0000, 1))  # offsets count from the fragment
        tfdt = _box(b"tfdt", struct.pack(">IQ", 0x0100_0000, dts_us))
        run = (0x0100_0F01, 1, 0, self._step_us, len(data), flags, message.pts_us - dts_us)
        moof = b""
        for _ in range(2):  # the data's offset is known once the length is
            trun = _box(b"trun", struct.pack(">IIiIIIi", *run[:2], len(moof) + 8, *run[3:]))
            mfhd = _box(b"mfhd", struct.pack(">II", 0, self._number))
            moof = _box(b"moof", mfhd + _box(b"traf", tfhd + tfdt + trun))
        return moof + _box(b"mdat", data)


def _box(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(body), name) + body


def annexb_bytes(message: Message) -> bytes:
    """A picture for WebCodecs: 8 bytes of time (us), then the access unit with start codes."""
    return message.pts_us.to_bytes(_STAMP_BYTES, "big", signed=True) + message.payload
