"""Two hours of streaming: the station's memory and open files each minute, and whether an event is lost or doubled.

python benchmarks/station_hours.py [--minutes 120] [--speed 1]

A simulated flight of a minute, there and back again (640x360, 10 frames a second, 0.5 m/s), is streamed over and over
as one flight, with a watch and a map mission on it. Events are heard by a page, by one that comes and goes each minute
and asks on from its last, and by a program (Server-Sent Events); a viewer takes the video. In the end all are compared
with the station's own list of events, and the viewer's pictures with those that were sent. The missions' memory is
noted beside the station's: a map's grows with its ground. `--speed 1.6` sends 1.6 s of flight each second.

The figures go into results/station.json, as `hours`.
"""

import argparse
import asyncio
import csv
import json
import os
import tempfile
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from http.client import HTTPException
from pathlib import Path
from typing import Any

import av
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
from sorvolo.station.footage import Footage, Piece, open_footage
from sorvolo.station.messages import Kind, sample_from_json
from sorvolo.station.spool import Spool
from station import RESULTS, ask, cpu_s, station

_STREAM = "scout"
_STAY_S, _AWAY_S = 60.0, 5.0  # of the page that comes and goes
_MODEL, _LOOKS_PER_S = "default-int8", 0.5
_SIDE_S, _FPS = 60.0, 10


class Again:
    """A recording sent over and over as one flight."""

    is_live = False

    def __init__(self, once: Footage, times: int, length_us: int) -> None:
        self._once, self._times, self._length_us = once, times, length_us
        self.name, self.format = once.name, once.format

    def pieces(self, begin_us: int, stop: threading.Event) -> Iterator[Piece]:
        """See `Footage`."""
        for number in range(self._times):
            for piece in self._once.pieces(begin_us, stop):
                if piece.pts_us >= self._length_us:  # telemetry goes on for longer than the video
                    continue
                later = piece.shifted(number * self._length_us)
                if piece.kind is Kind.TELEMETRY:
                    sample = sample_from_json(piece.payload)
                    moved = replace(
                        sample, time_ns=sample.time_ns + 1000 * number * self._length_us
                    )
                    later = replace(later, payload=moved.to_json().encode())
                yield later

    def notices(self) -> Sequence[str]:
        """See `Footage`."""
        return self._once.notices()


def main() -> None:
    """Stream, listen, compare, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=120.0, help="of flight")
    parser.add_argument(
        "--speed", type=float, default=1.0, help="seconds of flight that are sent each second"
    )
    parser.add_argument("--flight", type=Path, help="simulated before, or where to keep it")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        flight = there_and_back(options.flight or Path(scratch) / "flight")
        hours = asyncio.run(flown(flight, Path(scratch), options))
    hours = {
        "machine": machine(),
        "commit": commit(),
        **hours,
        "load_after": round(os.getloadavg()[0], 2),
    }
    result = (
        json.loads(options.output.read_text())
        if options.output.is_file()
        else {"benchmark": "station"}
    )
    options.output.write_text(json.dumps({**result, "hours": hours}, indent=1) + "\n")
    print(json.dumps(hours))


def there_and_back(folder: Path) -> Path:
    """The folder of a flight that ends where it begins, made unless it is there."""
    once, both = folder / "flight1" / "flight1.mp4", folder / "both" / "both.mp4"
    if not once.is_file():
        settings = SimulationSettings(
            seed=7,
            flights=1,
            scene=SceneSettings(people=4, cars=4, small_objects=4),
            path=PathSettings(height_m=30, speed_m_s=0.5, length_m=0.5 * _SIDE_S, strips=1),
            imaging=ImagingSettings(width_px=640, height_px=360, fps=_FPS),
            output=OutputSettings(truth_step=1_000_000),
        )
        for _ in simulate_site(folder, settings):
            pass
    if not both.is_file():
        both.parent.mkdir()
        mirrored(once, both)
    return folder


def mirrored(video: Path, target: Path) -> None:
    """A flight followed by itself backwards, with its telemetry, as a drone's encoder sends it."""
    with av.open(str(video)) as source:
        pictures = [
            frame.to_ndarray(format="yuv420p") for frame in source.decode(source.streams.video[0])
        ]
        size = source.streams.video[0].width, source.streams.video[0].height
    with av.open(str(target), "w") as output:
        stream = output.add_stream("libx264", rate=_FPS)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.options = {"crf": "26", "preset": "veryfast", "bf": "0", "g": str(_FPS)}
        for picture in [*pictures[:-1], *pictures[:0:-1]]:
            output.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="yuv420p")))
        output.mux(stream.encode())
    with open(video.with_suffix(".csv"), newline="") as given:
        rows = list(csv.DictReader(given))
    length_s = (len(pictures) - 1) / _FPS
    there = [row for row in rows if float(row["offsetTime"]) < length_s]
    back = []
    for row in reversed(rows):
        at_s = 2 * length_s - float(row["offsetTime"])
        speeds = {name: str(-float(row[name])) for name in ("velN(M/S)", "velE(M/S)")}
        if length_s <= at_s < 2 * length_s:
            row |= {
                "offsetTime": f"{at_s:.3f}",
                "flightTime(msec)": f"{1000 * at_s:.0f}",
                "Tick#": f"{600 * at_s:.0f}",
            }
            back.append({**row, **speeds})
    with open(target.with_suffix(".csv"), "w", newline="") as wanted:
        writer = csv.DictWriter(wanted, rows[0])
        writer.writeheader()
        writer.writerows([*there, *back])


async def flown(flight: Path, scratch: Path, options: Any) -> dict[str, Any]:
    """The whole flight with missions and listeners, and what was noted of it."""
    (scratch / "root").mkdir()
    stop = threading.Event()
    once = open_footage(
        str(flight / "both" / "both.mp4"), None, str(flight / "camera.xml"), LiveSettings(), stop
    )
    length_us = frames_of(flight / "both" / "both.mp4") * 1_000_000 // _FPS
    footage = Again(once, round(options.minutes * 60e6 / length_us), length_us)
    heard: dict[str, list[int]] = {"page": [], "comes_and_goes": [], "program": []}
    pictures: list[int] = []
    samples: list[dict[str, Any]] = []
    with station(scratch / "root") as (url, pid):
        settings = StreamSettings(speed=options.speed)
        client = StreamClient(
            footage,
            Spool(scratch / "spool", 2_000_000_000),
            stream_url(url, _STREAM),
            "",
            settings,
            stop,
        )
        listening = [
            asyncio.create_task(page(url, heard["page"], float("inf"))),
            asyncio.create_task(page(url, heard["comes_and_goes"], _STAY_S)),
            asyncio.create_task(viewed(url, pictures)),
        ]
        threading.Thread(target=program, args=(url, heard["program"]), daemon=True).start()
        flying = threading.Thread(target=client.run)
        began_s, began_cpu_s = time.monotonic(), cpu_s(pid)
        flying.start()
        while not any(each["flights"] for each in await ask(url, "/api/streams")):
            await asyncio.sleep(0.1)
        runs = [
            await ask(url, "/api/runs", wish)
            for wish in (
                {
                    "mission": "watch",
                    "site": "watched",
                    "input": {"stream": _STREAM},
                    "options": {"model": _MODEL, "frames_per_second": _LOOKS_PER_S},
                },
                {
                    "mission": "map",
                    "site": "mapped",
                    "input": {"stream": _STREAM},
                    "options": {"model": "none"},
                },
            )
        ]
        while any(run["state"] == "running" for run in runs):
            runs = [await ask(url, f"/api/runs/{run['id']}") for run in runs]
            if time.monotonic() - began_s >= 60 * len(samples):
                samples.append(
                    {
                        "minute": len(samples),
                        "memory_mb": memory_mb(pid),
                        "open_files": len(os.listdir(f"/proc/{pid}/fd")),
                        "pictures": client.report.frames,
                        "events": len(heard["page"]),
                        "load": round(os.getloadavg()[0], 1),
                        "missions_mb": {run["mission"]: mission_mb(run["id"]) for run in runs},
                    }
                )
                print(json.dumps(samples[-1]), flush=True)
            await asyncio.sleep(1.0)
        flying.join()
        took_s = time.monotonic() - began_s
        station_s = cpu_s(pid) - began_cpu_s
        await asyncio.sleep(_AWAY_S + 10)  # the last events reach all
        for each in listening:
            each.cancel()
        await asyncio.gather(*listening, return_exceptions=True)
        kinds = await all_events(url)
    report = client.report
    return {
        "minutes_of_flight": options.minutes,
        "speed": options.speed,
        "seconds": round(took_s),
        "station_cpu_s": round(station_s, 1),
        "pictures": {
            "sent": report.frames,
            "dropped": report.late + report.overflowed,
            "at_viewer": len(pictures),
            "doubled": len(pictures) - len(set(pictures)),
            "in_order": pictures == sorted(pictures),
        },
        "missions": [
            {"mission": run["mission"], "state": run["state"], "progress": run["progress"]}
            for run in runs
        ],
        "events": {
            "count": len(kinds),
            "without_gap": sorted(kinds) == list(range(1, len(kinds) + 1)),
            "by_type": dict(Counter(kinds.values())),
        },
        "heard": {
            name: {
                "count": len(seqs),
                "lost": len(set(kinds) - set(seqs)),
                "doubled": len(seqs) - len(set(seqs)),
                "in_order": seqs == sorted(seqs),
            }
            for name, seqs in heard.items()
        },
        "each_minute": samples,
    }


async def page(url: str, seqs: list[int], stay_s: float) -> None:
    """Events by WebSocket from the first on; away for a few seconds after so long, then on from the last."""
    while True:
        with suppress(ConnectionClosed, TimeoutError):
            async with connect(
                f"ws{url[4:]}/api/events?after={seqs[-1] if seqs else 0}", max_size=20_000_000
            ) as link:
                async with asyncio.timeout(None if stay_s == float("inf") else stay_s):
                    async for text in link:
                        if (event := json.loads(text))["type"] != "alive":
                            seqs.append(event["seq"])
        await asyncio.sleep(_AWAY_S)


def program(url: str, seqs: list[int]) -> None:
    """Events as Server-Sent Events, on one connection, until the station ends."""
    with (
        suppress(OSError, HTTPException),
        urllib.request.urlopen(f"{url}/api/events?after=0") as answer,
    ):
        for line in answer:
            if line.startswith(b"id: "):
                seqs.append(int(line[4:]))


async def viewed(url: str, pictures: list[int]) -> None:
    """The time of each picture, us."""
    while True:
        with suppress(ConnectionClosed):
            address = f"ws{url[4:]}/api/streams/{_STREAM}/video"
            async with connect(address, max_size=20_000_000, compression=None) as link:
                async for item in link:
                    if isinstance(item, bytes):
                        pictures.append(int.from_bytes(item[:8], "big", signed=True))
        await asyncio.sleep(0.2)


async def all_events(url: str) -> dict[int, str]:
    """Each event's number and type, as the station kept them."""
    kinds: dict[int, str] = {}
    async with connect(f"ws{url[4:]}/api/events?after=0", max_size=20_000_000) as link:
        async for text in link:
            if (event := json.loads(text))["type"] == "alive":
                break
            kinds[event["seq"]] = event["type"]
    return kinds


def frames_of(video: Path) -> int:
    """How many pictures it has."""
    with av.open(str(video)) as source:
        return sum(packet.size > 0 for packet in source.demux(video=0))


def memory_mb(pid: int) -> float:
    """A process's resident memory."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1)


def mission_mb(run: str) -> float | None:
    """The memory of a mission's process; nothing once it is over."""
    for folder in Path("/proc").iterdir():
        with suppress(OSError, ValueError):
            if folder.name.isdigit() and run in (folder / "cmdline").read_text():
                return memory_mb(int(folder.name))
    return None


if __name__ == "__main__":
    main()
