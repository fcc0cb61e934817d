"""How long a streamed frame takes to the map, to its boxes and to the browsers, and what many viewers cost.

python benchmarks/station.py [--size 1920x1080] [--fps 30] [--seconds 60] [--viewers 20] [--only map] [--flight FOLDER]

A simulated flight is streamed in real time over loopback to a station in a process of its own, three times: with a map
mission, with a watch, and with a map mission and many viewers. Times run from the moment at which the client takes a
picture (the camera's own delay is not in it) to

- the tile at the frame's centre, fetched and whole, from the first announced map that has the frame in it;
- the frame's boxes, all of them and those of each class (cars may be known before people), and how the picture moved to
  it, received beside the video;
- the picture itself, received by a viewer.

Then the flight is sent ten times (--soak), as fast as the link takes it: the station's memory and open files after
each. 180 times the 40 s of --seconds 40 are two hours.

The flight is encoded as drones send video: no picture waits for a later one, and a key frame comes every second. (The
simulator's own video has pictures that do: up to a tenth of a second passes until such a one can be decoded.)

A browser's decoding and drawing is not in them. The load of the machine is written beside the figures.
"""

import argparse
import asyncio
import json
import math
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import av
import numpy as np
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from provenance import commit, machine
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)
from sorvolo.station.client import StreamClient, StreamSettings, stream_url
from sorvolo.station.footage import open_footage
from sorvolo.station.messages import Kind, sample_from_json
from sorvolo.station.spool import Spool
from sorvolo.survey.objects import CLASSES

RESULTS = Path(__file__).parent / "results" / "station.json"
_ZOOM = 21
_STREAM = "scout"
_CATCH_UP_S = 10.0  # after its first result, for what the drone sent before


@dataclass
class Seen:
    """What one streamed flight showed: when each picture was taken, by its time, and what came of it when."""

    taken_s: dict[int, float] = field(default_factory=dict)
    zero_ns: int = 0  # UTC of the flight's zero
    pictures: list[tuple[float, float]] = field(default_factory=list)  # taken, delay
    boxes: list[tuple[float, float]] = field(default_factory=list)
    of_class: dict[str, list[tuple[float, float]]] = field(
        default_factory=lambda: {each: [] for each in CLASSES}
    )
    early: dict[int, list[str]] = field(
        default_factory=dict
    )  # classes of a picture that came first
    motion: list[tuple[float, float]] = field(default_factory=list)
    map: list[tuple[float, float]] = field(default_factory=list)
    tiles_s: list[float] = field(default_factory=list)
    announced: dict[str, float] = field(
        default_factory=dict
    )  # when each revision of the map was heard of


class TimedSpool(Spool):
    """A spool that notes when each picture was taken."""

    def __init__(self, folder: Path, seen: Seen) -> None:
        super().__init__(folder, 2_000_000_000)
        self._seen = seen

    def append(self, kind: Kind, pts_us: int, payload: bytes, **more: Any) -> None:
        """See `Spool`."""
        if kind is Kind.VIDEO:
            self._seen.taken_s[pts_us] = time.time()
        elif not self._seen.zero_ns:
            self._seen.zero_ns = sample_from_json(payload).time_ns - 1000 * pts_us
        super().append(kind, pts_us, payload, **more)


def main() -> None:
    """Stream the flight three times and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--viewers", type=int, default=20)
    parser.add_argument("--model", default="default")
    parser.add_argument("--only", choices=("", "map", "watch", "viewers", "soak"), default="")
    parser.add_argument(
        "--soak", type=int, default=10, help="how many times the flight is sent in the end"
    )
    parser.add_argument("--flight", type=Path, help="simulated before, or where to keep it")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        flight = simulated(options.flight or Path(scratch) / "flight", options)
        load = os.getloadavg()[0]
        plan = {"map": ("map", 1), "watch": ("watch", 1), "viewers": ("map", options.viewers)}
        runs = {
            name: streamed(flight, Path(scratch) / name, mission, viewers, options)
            for name, (mission, viewers) in plan.items()
            if options.only in ("", name)
        }
        if options.only in ("", "soak"):
            runs["soak"] = repeated(flight, Path(scratch) / "soak", options.soak)
    result = {
        "benchmark": "station",
        "machine": machine(),
        "commit": commit(),
        "size": options.size,
        "fps": options.fps,
        "seconds": options.seconds,
        "model": options.model,
        "load_before": round(load, 2),
        "load_after": round(os.getloadavg()[0], 2),
        **runs,
    }
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


def simulated(folder: Path, options: Any) -> Path:
    """The flight's folder, made unless it is there: one strip at 8 m/s, 40 m up, with things to find."""
    sent = folder / "flight1" / "sent.mp4"
    if not (folder / "flight1" / "flight1.mp4").is_file():
        width, height = map(int, options.size.split("x"))
        settings = SimulationSettings(
            seed=7,
            flights=1,
            scene=SceneSettings(people=8, cars=8, small_objects=4),
            path=PathSettings(height_m=40, speed_m_s=8, length_m=8 * options.seconds, strips=1),
            imaging=ImagingSettings(width_px=width, height_px=height, fps=options.fps),
            output=OutputSettings(truth_step=1_000_000),
        )
        for _ in simulate_site(folder, settings):
            pass
    if not sent.is_file():
        as_sent(folder / "flight1" / "flight1.mp4", sent)
    return folder


def as_sent(video: Path, target: Path) -> None:
    """The video as a drone's encoder sends it, with the same telemetry beside it."""
    with av.open(str(video)) as source, av.open(str(target), "w") as output:
        given = source.streams.video[0]
        stream = output.add_stream("libx264", rate=given.average_rate)
        stream.width, stream.height, stream.pix_fmt = given.width, given.height, "yuv420p"
        stream.options = {
            "crf": "18",
            "preset": "veryfast",
            "bf": "0",
            "g": str(round(given.average_rate)),
        }
        for frame in source.decode(given):
            frame.pict_type = av.video.frame.PictureType.NONE
            output.mux(stream.encode(frame))
        output.mux(stream.encode())
    shutil.copy(video.with_suffix(".csv"), target.with_suffix(".csv"))


def streamed(
    flight: Path, scratch: Path, mission: str, viewers: int, options: Any
) -> dict[str, Any]:
    """One flight with a mission and viewers; delays, s, and what it cost."""
    root = scratch / "root"
    root.mkdir(parents=True)
    seen = Seen()
    with station(root) as (url, pid):
        stop = threading.Event()
        footage = open_footage(
            str(flight / "flight1" / "sent.mp4"),
            None,
            str(flight / "camera.xml"),
            LiveSettings(),
            stop,
        )
        client = StreamClient(
            footage,
            TimedSpool(scratch / "spool", seen),
            stream_url(url, _STREAM),
            "",
            StreamSettings(),
            stop,
        )
        flying = threading.Thread(target=client.run)
        before_s = cpu_s(pid)
        run = asyncio.run(followed(url, seen, flying, mission, viewers, options))
        flying.join()
        report = client.report
        station_s = cpu_s(pid) - before_s
    return {
        "mission": mission,
        "viewers": viewers,
        "frames": report.frames,
        "dropped": report.late + report.overflowed,
        "station_cpu_s": round(station_s, 2),
        "mission_progress": run.get("progress"),
        "mission_state": run["state"],
        "frame_to_disk": figures(list(report.delays_s)),
        "frame_to_viewer": delays(seen.pictures),
        "frame_to_map_tile": delays(seen.map),
        "frame_to_map_tile_running": delays(running(seen.map)),
        "tile_fetch": figures(seen.tiles_s),
        "frame_to_boxes": delays(seen.boxes),
        "frame_to_boxes_running": delays(running(seen.boxes)),
        "frame_to_boxes_of_running": {
            name: delays(running(each)) for name, each in seen.of_class.items()
        },
        "frame_to_motion": delays(seen.motion),
        "frame_to_motion_running": delays(running(seen.motion)),
    }


def repeated(flight: Path, scratch: Path, flights: int) -> dict[str, Any]:
    """The flight sent so many times, one after another; memory, MB, and open files of the station after each."""
    (scratch / "root").mkdir(parents=True)
    memory_mb, files, frames = [], [], 0
    began_s = time.monotonic()
    with station(scratch / "root") as (url, pid):
        for number in range(flights):
            stop = threading.Event()
            footage = open_footage(
                str(flight / "flight1" / "sent.mp4"), None, None, LiveSettings(), stop
            )
            spool = Spool(scratch / f"spool{number}", 2_000_000_000)
            settings = StreamSettings(speed=0, latency_s=math.inf)
            frames += (
                StreamClient(footage, spool, stream_url(url, _STREAM), "", settings, stop)
                .run()
                .frames
            )
            shutil.rmtree(scratch / f"spool{number}")
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            memory_mb.append(round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1))
            files.append(len(os.listdir(f"/proc/{pid}/fd")))
    return {
        "flights": flights,
        "frames": frames,
        "seconds": round(time.monotonic() - began_s, 1),
        "memory_mb": memory_mb,
        "open_files": files,
    }


async def followed(
    url: str, seen: Seen, flying: threading.Thread, mission: str, viewers: int, options: Any
) -> dict[str, Any]:
    """Start the flight and the mission, listen until both are over; the mission's last state."""
    listening = [asyncio.create_task(viewed(url, seen)) for _ in range(viewers)]
    listening.append(asyncio.create_task(heard(url, seen)))
    flying.start()
    while not any(each["flights"] for each in await ask(url, "/api/streams")):
        await asyncio.sleep(0.1)
    wish = {
        "mission": mission,
        "site": "field",
        "input": {"stream": _STREAM},
        "options": {"model": options.model},
    }
    run = await ask(url, "/api/runs", wish)
    while (run := await ask(url, f"/api/runs/{run['id']}"))["state"] == "running":
        await asyncio.sleep(0.5)
    await asyncio.sleep(0.5)
    for each in listening:
        each.cancel()
    await asyncio.gather(*listening, return_exceptions=True)
    return dict(run)


async def viewed(url: str, seen: Seen) -> None:
    """A viewer: when each picture, each frame's boxes and its motion came."""
    with suppress(ConnectionClosed):
        async with connect(
            f"ws{url[4:]}/api/streams/{_STREAM}/video", max_size=20_000_000, compression=None
        ) as link:
            async for item in link:
                if isinstance(item, bytes):
                    note(
                        seen.pictures,
                        seen.taken_s.get(int.from_bytes(item[:8], "big", signed=True)),
                    )
                elif (words := json.loads(item))["type"] == "motion":
                    note(seen.motion, taken_s_of(seen, words["pts_us"]))
                elif words["type"] == "boxes":
                    note_boxes(seen, words["pts_us"], words.get("classes"))


async def heard(url: str, seen: Seen) -> None:
    """Live events: frames that are placed, tiles that change."""
    fetching: set[asyncio.Task[None]] = set()
    with suppress(ConnectionClosed):
        async with connect(f"ws{url[4:]}/api/events?after=0", max_size=20_000_000) as link:
            async for text in link:
                event = json.loads(text)
                if event["type"] == "frame.placed" and event["data"]["status"] == "vision":
                    task = asyncio.create_task(shown(url, seen, event))
                    fetching.add(task)
                    task.add_done_callback(fetching.discard)
                elif event["type"] == "map.tiles":
                    seen.announced[event["data"]["revision"]] = time.time()


async def shown(url: str, seen: Seen, event: dict[str, Any]) -> None:
    """Fetch the tile at a placed frame's centre from the first announced map that has the frame in it.

    A frame is reported as placed once its tiles are stored, so the site's revision of that moment, or any announced
    later, has it. A page fetches when it hears of the revision, be that before or after it hears of the frame.
    """
    asked_s, placed = time.time(), event["data"]
    moment_us = (
        round(datetime.fromisoformat(placed["time"]).timestamp() * 1e9) - seen.zero_ns
    ) // 1000
    nearest = min(seen.taken_s, key=lambda each: abs(each - moment_us))
    revision = (await ask(url, f"/api/sites/{event['site']}"))["live_revision"]
    while revision not in seen.announced:
        await asyncio.sleep(0.01)
        later = [name for name, at_s in seen.announced.items() if at_s > asked_s]
        revision = later[0] if later else revision
    corners = np.array(placed["footprint"][:4])
    x, y = tile_of(float(corners[:, 0].mean()), float(corners[:, 1].mean()))
    began_s = time.time()
    path = f"/api/sites/{event['site']}/tiles/live-{revision}/{_ZOOM}/{x}/{y}.webp"
    status, _ = await asyncio.to_thread(get, url, path)
    if status == 200:
        fetch_s = time.time() - began_s
        seen.tiles_s.append(fetch_s)
        seen.map.append(
            (seen.taken_s[nearest], seen.announced[revision] + fetch_s - seen.taken_s[nearest])
        )


def note_boxes(seen: Seen, pts_us: int, classes: list[str] | None) -> None:
    """A picture's boxes: of some classes, or of all."""
    taken_s = taken_s_of(seen, pts_us)
    for name in CLASSES if classes is None else classes:
        if classes is not None or name not in seen.early.get(pts_us, ()):
            note(seen.of_class[name], taken_s)
    if classes is None:
        note(seen.boxes, taken_s)
    else:
        seen.early[pts_us] = classes


def taken_s_of(seen: Seen, pts_us: int) -> float | None:
    """When the picture of a message was taken, whose time went through UTC and telemetry's zero: to 2 ms."""
    nearest = min(seen.taken_s, key=lambda each: abs(each - pts_us), default=None)
    return None if nearest is None or abs(nearest - pts_us) > 2000 else seen.taken_s[nearest]


def note(found: list[tuple[float, float]], taken_s: float | None) -> None:
    """One more delay until now."""
    if taken_s is not None:
        found.append((taken_s, time.time() - taken_s))


def delays(found: list[tuple[float, float]]) -> dict[str, Any]:
    """The figures of all delays."""
    return figures([delay_s for _, delay_s in found])


def running(found: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Those of pictures taken once the mission ran and had time to catch up: it starts while the drone flies."""
    began_s = min((taken_s + delay_s for taken_s, delay_s in found), default=0.0) + _CATCH_UP_S
    return [each for each in found if each[0] > began_s]


def tile_of(longitude_deg: float, latitude_deg: float) -> tuple[int, int]:
    """The Web Mercator tile that shows a place (OpenStreetMap's formula)."""
    y = (1 - math.asinh(math.tan(math.radians(latitude_deg))) / math.pi) / 2
    return int((longitude_deg + 180) / 360 * 2**_ZOOM), int(y * 2**_ZOOM)


def figures(delays_s: list[float]) -> dict[str, Any]:
    """Median, 95th percentile and largest, s."""
    if not delays_s:
        return {"count": 0}
    values = np.array(delays_s)
    return {
        "count": len(values),
        "median_s": round(float(np.median(values)), 3),
        "p95_s": round(float(np.percentile(values, 95)), 3),
        "max_s": round(float(values.max()), 3),
    }


@contextmanager
def station(root: Path) -> Iterator[tuple[str, int]]:
    """A station in a process of its own: its address and process."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "sorvolo",
            "serve",
            str(root),
            "--port",
            str(port),
            "--free-floor",
            "0",
        ],
        stderr=subprocess.DEVNULL,
    )
    url = f"http://127.0.0.1:{port}"
    try:
        until_s = time.monotonic() + 60
        while True:
            with suppress(OSError):
                get(url, "/api/status")
                break
            if time.monotonic() > until_s or process.poll() is not None:
                raise RuntimeError("the station does not start")
            time.sleep(0.2)
        yield url, process.pid
    finally:
        process.terminate()
        process.wait(20)


async def ask(url: str, path: str, body: Any = None) -> Any:
    """A JSON answer."""
    _, data = await asyncio.to_thread(get, url, path, body)
    return json.loads(data)


def get(url: str, path: str, body: Any = None) -> tuple[int, bytes]:
    """The status and the body of an answer."""
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url + path, data, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=30) as answer:
        return answer.status, answer.read()


def cpu_s(pid: int) -> float:
    """The processor time that a process has used, without its children."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
