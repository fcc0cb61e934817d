"""Small flights for the tests of streaming: a few seconds of moving pictures with telemetry beside them."""

import threading
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from sorvolo.station.footage import Footage, FootagePiece, Format
from sorvolo.station.messages import Kind

RATE = 10


class HeldFootage:
    """A recording that stops before one of its pictures until it is let go on: a drone that is certainly in the air."""

    is_live = False

    def __init__(self, footage: Footage, before: int) -> None:
        self._footage, self._before = footage, before
        self.goes_on = threading.Event()

    @property
    def name(self) -> str:
        """See `Footage`."""
        return self._footage.name

    @property
    def format(self) -> Format:
        """See `Footage`."""
        return self._footage.format

    def pieces(self, begin_us: int, stop: threading.Event) -> Iterator[FootagePiece]:
        """See `Footage`."""
        pictures = 0
        for each in self._footage.pieces(begin_us, stop):
            pictures += each.kind is Kind.VIDEO
            while pictures > self._before and not (self.goes_on.wait(0.02) or stop.is_set()):
                pass
            yield each

    def notices(self) -> Sequence[str]:
        """See `Footage`."""
        return self._footage.notices()


def write_video(
    path: Path, *, seconds: float = 3.0, codec: str = "libx264", keyint: int = 10, bframes: int = 0
) -> Path:
    """A moving pattern, 160 x 120 px, 10 pictures a second; the n-th picture's mean grey grows with n."""
    with av.open(str(path), "w") as output:
        options = {"g": str(keyint), "bf": str(bframes), "preset": "ultrafast"}
        if codec == "libx265":
            options = {
                "x265-params": f"keyint={keyint}:bframes={bframes}:log-level=none",
                "preset": "ultrafast",
            }
        stream = output.add_stream(
            codec, rate=RATE, options=options if codec.startswith("libx") else {}
        )
        stream.width, stream.height, stream.pix_fmt = (
            160,
            120,
            "yuvj420p" if codec == "mjpeg" else "yuv420p",
        )
        stream.time_base = Fraction(1, RATE)
        for number in range(round(seconds * RATE)):
            picture = np.full((120, 160, 3), min(250, 40 + 4 * number), np.uint8)
            picture[40:80, (5 * number) % 120 : (5 * number) % 120 + 30] = 255
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")):
                output.mux(packet)
        for packet in stream.encode(None):
            output.mux(packet)
    return path


def write_track(path: Path, *, seconds: float = 3.0) -> Path:
    """Telemetry twice a second beside a video: a flight north at 5 m/s, 40 m above take-off."""
    rows = [
        "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(meters),compass_heading(degrees)"
    ]
    for step in range(round(2 * seconds) + 1):
        second = step / 2
        rows.append(
            f"{500 * step},2024-05-01 10:00:{int(second):02d},{45 + second * 4.5e-5:.7f},9.0,40.0,0.0"
        )
    path.write_text("\n".join(rows) + "\n")
    return path
