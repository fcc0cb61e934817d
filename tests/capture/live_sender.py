"""What sends live streams in tests: simulated drones that speak MPEG-TS, KLV and NMEA over the loopback."""

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from fractions import Fraction
from random import SystemRandom
from typing import Any

import av
import numpy as np

from sorvolo.capture.live.klv import encode

RATE = 20
EPOCH_NS = 1_760_000_000 * 10**9
"""The drone's clock at its first frame: not this computer's."""


_PORTS = range(10_000, 15_999)
"""Below those that systems give to sockets that ask for any, so that none of them takes a port while it is free."""


def free_port(kind: int = socket.SOCK_DGRAM, count: int = 1) -> int:
    """The first of `count` neighbouring ports of this computer that nobody uses."""
    drawn = SystemRandom()  # what a test seeds would be drawn alike by two processes
    while True:
        first = drawn.choice(_PORTS[: len(_PORTS) - count])
        with suppress(OSError), ExitStack() as probes:
            for port in range(first, first + count):
                probes.enter_context(socket.socket(socket.AF_INET, kind)).bind(("127.0.0.1", port))
            return first


def picture(index: int, size: tuple[int, int] = (160, 96)) -> Any:
    """A frame whose number can be read from it: a bright column moves right, four pixels a frame."""
    image = np.full((size[1], size[0], 3), 40, np.uint8)
    start = 4 * index % (size[0] - 8)
    image[:, start : start + 8] = 220
    return image


def number_of(image: Any) -> int:
    """The frame's number, modulo 38, from a picture of 160 px."""
    return round((float(np.argmax(image[48, :, 0].astype(float) > 128))) / 4)


def packet_of(index: int, north_m: float | None = None) -> bytes:
    """The metadata of frame `index`: flying north at 60 m above ground at 100 m, or `north_m` from the start."""
    north_m = 5.0 * index / RATE if north_m is None else north_m
    return encode(
        EPOCH_NS + index * 10**9 // RATE,
        {
            "platform_heading_deg": 0.0,
            "platform_pitch_deg": 0.0,
            "platform_roll_deg": 0.0,
            "sensor_relative_azimuth_deg": 0.0,
            "sensor_relative_elevation_deg": -90.0,
            "sensor_relative_roll_deg": 0.0,
            "sensor_latitude_deg": 46.5 + north_m / 111_320,
            "sensor_longitude_deg": 11.3,
            "sensor_true_altitude_m": 160.0,
            "frame_center_elevation_m": 100.0,
            "sensor_horizontal_fov_deg": 62.0,
            "sensor_vertical_fov_deg": 39.6,
        },
    )


class Sender(threading.Thread):
    """Sends frames in real time until asked to stop or `count` are sent; `open_url` may wait for a listener."""

    def __init__(
        self,
        url: str,
        *,
        count: int = 10_000,
        size: tuple[int, int] = (160, 96),
        klv: bool = False,
        first: int = 0,
        container: str = "mpegts",
        options: Mapping[str, str] | None = None,
        speed: float = 1.0,
        image: Callable[[int], Any] | None = None,
        klv_of: Callable[[int], bytes] = packet_of,
        rate: int = RATE,
        codec: str = "libx264",
    ) -> None:
        super().__init__(daemon=True)
        self._url, self._count, self._size, self._klv, self._first = url, count, size, klv, first
        self._container, self._options, self._speed = container, dict(options or {}), speed
        self._image = image or (lambda index: picture(index, size))
        self._klv_of, self._rate, self._codec = klv_of, rate, codec
        self._stopped = threading.Event()
        self.sent_s: dict[int, float] = {}
        self.error: Exception | None = None

    def run(self) -> None:
        try:
            self._send()
        except (av.FFmpegError, OSError) as error:
            self.error = error

    def _send(self) -> None:
        with av.open(self._url, "w", format=self._container, options=self._options) as output:
            stream = output.add_stream(self._codec, rate=self._rate)
            stream.width, stream.height, stream.pix_fmt = *self._size, "yuv420p"
            if self._codec == "libx264":
                stream.options = {
                    "preset": "ultrafast",
                    "tune": "zerolatency",
                    "g": "10",
                    "crf": "12",
                }
            data = output.add_data_stream("klv") if self._klv else None
            began_s = time.monotonic()
            for step in range(self._count):
                index = self._first + step
                if self._stopped.wait(
                    max(0.0, began_s + step / self._rate / self._speed - time.monotonic())
                ):
                    break
                if data is not None:
                    packet = av.Packet(self._klv_of(index))
                    packet.stream, packet.time_base, packet.pts, packet.dts = (
                        data,
                        Fraction(1, self._rate),
                        step,
                        step,
                    )
                    output.mux(packet)
                frame = av.VideoFrame.from_ndarray(self._image(index), format="rgb24")
                frame.pts, frame.time_base = step, Fraction(1, self._rate)
                output.mux(stream.encode(frame))
                self.sent_s[index] = time.monotonic()
            output.mux(stream.encode(None))

    def stop(self) -> None:
        self._stopped.set()
        self.join(5)


@contextmanager
def sending(url: str, **kwargs: Any) -> Iterator[Sender]:
    sender = Sender(url, **kwargs)
    sender.start()
    try:
        yield sender
    finally:
        sender.stop()


def udp_url(port: int) -> str:
    return f"udp://127.0.0.1:{port}?pkt_size=1316"


@contextmanager
def sending_apart(url: str, **kwargs: Any) -> Iterator["subprocess.Popen[bytes]"]:
    """The same in a process of its own: PyAV's writers hold Python's lock while they wait for the other side."""
    process = subprocess.Popen([sys.executable, __file__, url, json.dumps(kwargs)])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextmanager
def dialling(port: int, at_s: float) -> Iterator[tuple[threading.Event, int]]:
    """A port that a sender may dial at once; what it sends goes on to `port`, dialled once, `at_s` after the event."""
    listens = threading.Event()
    with ExitStack() as stack:
        door = stack.enter_context(socket.create_server(("127.0.0.1", 0)))

        def pass_on() -> None:
            with suppress(OSError):
                sender = stack.enter_context(door.accept()[0])
                listens.wait()
                time.sleep(at_s)
                receiver = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
                threading.Thread(target=copy, args=(receiver, sender), daemon=True).start()
                copy(sender, receiver)

        threading.Thread(target=pass_on, daemon=True).start()
        yield listens, door.getsockname()[1]


def copy(source: socket.socket, target: socket.socket) -> None:
    """Pass on bytes until either side hangs up, which the other one is then made to notice."""
    with suppress(OSError):
        while data := source.recv(65_536):
            target.sendall(data)
    for each in (source, target):
        with suppress(OSError):
            each.shutdown(socket.SHUT_RDWR)


if __name__ == "__main__":
    Sender(sys.argv[1], **json.loads(sys.argv[2])).run()
