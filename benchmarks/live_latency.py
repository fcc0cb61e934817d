"""From a key frame's arrival to its pixels in the map's tiles, at 1080p: the distribution, and the causes of its peaks.

    python benchmarks/live_latency.py VIDEO.mp4 [--seconds 60] [--rate 30] [--output results/live_latency.json]

The video's pictures are copied, as they are, into a transport stream that is written at `--rate` pictures a second, and
`sorvolo map follow:` reads it in this process. The delay ends when the tiles with the key frame's pixels are in the
site, where readers see them. Beside it: how long each part of the work took, also in the processor time of the thread
that maps, which other work on the machine hardly changes; the slowest frames; the pictures dropped; the load.
`benchmarks/long_video.py make` makes a video that fits.
"""

import argparse
import json
import os
import tempfile
import threading
import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2

from provenance import commit, machine
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.map.painting import FlightPainter
from sorvolo.mosaic.flight_figures import delay_figures
from sorvolo.mosaic.planar import PlanarMapper
from sorvolo.store.exports import map_pictures
from sorvolo.store.site.flight_writer import FlightWriter

PARTS = (
    (PlanarMapper, "register"),
    (PlanarMapper, "place"),
    (PlanarMapper, "recent_exposure"),
    (FlightPainter, "save"),
    (FlightPainter, "show"),
    (FlightWriter, "flush"),
    (map_pictures, "picture"),
)
SLOW_S = 1.0


def main() -> None:
    """Map the stream and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("video", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--output", type=Path, help="a JSON file for the figures")
    options = parser.parse_args()
    cv2.setNumThreads(2)
    found = {
        "benchmark": "live_latency",
        "commit": commit(),
        "machine": machine(),
        "rate_hz": options.rate,
        "load_before": os.getloadavg()[0],
        **measure(options.video, options.seconds, options.rate),
        "load_after": os.getloadavg()[0],
    }
    if options.output is not None:
        options.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(found, indent=1))


def measure(video: Path, seconds: float, rate_hz: float) -> dict[str, Any]:
    """The delays, and what the slowest frames were spent on."""
    spent: dict[str, float] = {}
    for owner, name in PARTS:
        setattr(owner, name, timed(getattr(owner, name), name, spent))
    rows: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        growing = Path(folder) / "live.ts"
        growing.touch()
        sender = threading.Thread(target=send, args=(video, growing, seconds, rate_hz), daemon=True)
        sender.start()
        while growing.stat().st_size < 400_000:
            time.sleep(0.05)
        site = Path(folder) / "site"
        started_s, cpu_s = time.monotonic(), time.process_time()
        for _ in map_flights(
            [f"follow:{growing}"], site, MapSettings(model="none"), camera="aov=62"
        ):
            rows.append({name: round(value, 3) for name, value in spent.items()})
            spent.clear()
        report = json.loads(
            next((site / "flights").glob("*/report.json")).read_text(encoding="utf-8")
        )
    flown_s = min(seconds, time.monotonic() - started_s)
    slow = sorted(rows, key=lambda row: -work_s(row))
    shown = [row for row in rows if "show" in row]
    return {
        "delay_s": report["delay_s"],
        "key_frames": len(rows),
        "flown_s": round(flown_s, 1),
        "cpu_s": round(time.process_time() - cpu_s, 1),
        "dropped": next(
            (each["count"] for each in report["notices"] if each["code"] == "skipped_frame"), 0
        ),
        "work_s": delay_figures([work_s(row) for row in shown]),
        "work_cpu_s": delay_figures([work_s(row, " cpu") for row in shown]),
        "parts": {
            key: delay_figures([row[key] for row in rows if key in row])
            for _, name in PARTS
            for key in (name, f"{name} cpu")
            if any(key in row for row in rows)
        },
        "slowest": slow[:8],
        "slower_than_a_second": sum(work_s(row) >= SLOW_S for row in rows),
    }


def work_s(row: dict[str, float], kind: str = "") -> float:
    """What a key frame took from its picture to its tiles; of the kind " cpu", in processor time."""
    return sum(row.get(name + kind, 0.0) for name in ("register", "place", "save", "_show_now"))


def timed(method: Callable[..., Any], name: str, spent: dict[str, float]) -> Callable[..., Any]:
    """The method, its seconds and its thread's processor time added to `spent`."""

    def measured(*arguments: Any, **named: Any) -> Any:
        started_s, cpu_s = time.monotonic(), time.thread_time()
        try:
            return method(*arguments, **named)
        finally:
            for key, value in (
                (name, time.monotonic() - started_s),
                (f"{name} cpu", time.thread_time() - cpu_s),
            ):
                spent[key] = spent.get(key, 0.0) + value

    return measured


def send(video: Path, path: Path, seconds: float, rate_hz: float) -> None:
    """Copy the video's pictures into a transport stream, so many a second, and state its end."""
    with (
        av.open(str(video)) as source,
        path.open("wb", buffering=0) as sink,
        av.open(sink, "w", format="mpegts", options={"flush_packets": "1"}) as target,
    ):
        taken = source.streams.video[0]
        stream = target.add_stream_from_template(taken)
        began_s, slower = time.monotonic(), float(taken.average_rate) / rate_hz
        for number, packet in enumerate(source.demux(taken)):
            if packet.dts is None or number / rate_hz > seconds:
                break
            packet.pts, packet.dts = round(packet.pts * slower), round(packet.dts * slower)
            packet.time_base, packet.stream = Fraction(packet.time_base), stream
            target.mux(packet)
            time.sleep(max(0.0, began_s + number / rate_hz - time.monotonic()))
    path.with_name(path.name + ".ended").touch()


if __name__ == "__main__":
    main()
