"""A flight streamed to a station whose missions read it while it grows, though the station is restarted meanwhile."""

import asyncio
import json
import re
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
import uvicorn
from browsers import Watched, chromium, context_of
from PIL import Image
from stream_flights import HeldFootage
from test_runs import FLIGHT
from websockets.asyncio.client import connect

from small_flights import simulate_into, small_flight
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.station.app import station_app
from sorvolo.station.client import StreamClient, StreamSettings, stream_url
from sorvolo.station.footage import Footage, open_footage
from sorvolo.station.settings import StationSettings
from sorvolo.station.spool import Spool
from waiting import wait_for

IS_AWAY = re.compile(
    r"ERR_CONNECTION_REFUSED|ERR_CONNECTION_RESET|WebSocket connection to .* failed|Failed to fetch"
)
"""What a browser's console states while its station is gone."""


class Station:
    """A station at a port of its own, which may be ended and started again."""

    def __init__(self, root: Path) -> None:
        self._root, self._port = root, 0
        self.start()

    def start(self) -> None:
        app = station_app(StationSettings(self._root, free_floor_gb=0.0))
        self._lock = app.state.station.lock
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                "127.0.0.1",
                self._port,
                log_level="critical",
                ws="websockets-sansio",
                timeout_graceful_shutdown=0,
            )
        )
        self._thread = threading.Thread(target=self._server.run, daemon=True)
        self._thread.start()
        while not self._server.started:
            assert self._thread.is_alive()
            time.sleep(0.02)
        self._port = self._server.servers[0].sockets[0].getsockname()[1]

    def stop(self) -> None:
        self._server.should_exit = self._server.force_exit = True
        self._thread.join(10)
        self._lock.close()  # as the end of its process does: what the server closes at its end is left out

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._port}"

    def ask(self, path: str, body: Any = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(
            f"{self.url}{path}", data, {"Content-Type": "application/json"}
        )
        with urllib.request.urlopen(request, timeout=10) as answer:
            return json.loads(answer.read())

    def ended(self, run: str) -> dict[str, Any]:
        until_s = time.monotonic() + 60
        while (state := self.ask(f"/api/runs/{run}"))["state"] == "running":
            assert time.monotonic() < until_s, state
            time.sleep(0.1)
        return dict(state)


class StationProcess(Station):
    """The same in a process of its own, which `stop` kills."""

    def start(self) -> None:
        if not self._port:
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                self._port = free.getsockname()[1]
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "sorvolo",
                "serve",
                str(self._root),
                "--port",
                str(self._port),
            ]
        )
        wait_for(self._answers)

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()

    def _answers(self) -> bool:
        assert self._process.poll() is None
        try:
            return bool(self.ask("/api/status"))
        except OSError:
            return False


AnyStation = TypeVar("AnyStation", bound=Station)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown")
    simulate_into(folder, FLIGHT)
    return folder / "flight1" / "flight1.mp4"


def running(kind: type[AnyStation], folder: Path) -> Iterator[AnyStation]:
    (folder / "root").mkdir()
    made = kind(folder / "root")
    yield made
    made.stop()


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    yield from running(Station, tmp_path)


def sending(footage: Footage, station: Station, spool: Path, speed: float = 1.0) -> StreamClient:
    settings = StreamSettings(speed=speed)
    url = stream_url(station.url, "scout")
    return StreamClient(footage, Spool(spool, 50_000_000), url, "", settings, threading.Event())


def footage_of(flown: Path) -> Footage:
    camera = str(flown.parent.parent / "camera.xml")
    return open_footage(str(flown), None, camera, LiveSettings(), threading.Event())


def test_a_map_of_a_stream_outlives_a_restarted_station(
    station: Station, flown: Path, tmp_path: Path
) -> None:
    held = HeldFootage(footage_of(flown), before=6)
    drone = sending(held, station, tmp_path / "spool")
    flying = threading.Thread(target=drone.run, daemon=True)
    flying.start()
    wait_for(lambda: any(each["flights"] for each in station.ask("/api/streams")))
    run = station.ask(
        "/api/runs",
        {
            "mission": "map",
            "site": "new",
            "input": {"stream": "scout"},
            "options": {"model": "none"},
        },
    )
    station.stop()
    wait_for(lambda: not drone.report.is_linked)
    station.start()
    held.goes_on.set()
    flying.join(60)
    assert (
        drone.is_complete
        and drone.report.outages == 1
        and drone.report.late == drone.report.overflowed == 0
    )
    done = station.ended(run["id"])
    assert done["state"] == "finished", done
    (flight,) = station.ask("/api/sites/new")["flights"]
    assert flight["matched"] == flight["frames"] >= 3 and flight["rejected"] == 0


def test_a_recorded_stream_is_searched_whole(station: Station, flown: Path, tmp_path: Path) -> None:
    """A watch that is started after the flight's end leaves out no frame for newer ones: none come."""
    drone = sending(footage_of(flown), station, tmp_path / "spool", speed=0)
    drone.run()
    assert drone.is_complete
    run = station.ask(
        "/api/runs",
        {"mission": "watch", "site": "new", "input": {"stream": "scout"}, "options": {}},
    )
    done = station.ended(run["id"])
    assert done["state"] == "finished", done
    assert done["progress"]["searched"] == done["progress"]["frames"] == drone.report.frames


@pytest.fixture
def killable(tmp_path: Path) -> Iterator[StationProcess]:
    yield from running(StationProcess, tmp_path)


@pytest.mark.long
def test_a_page_sees_a_flight_grow_though_its_station_is_killed(
    killable: StationProcess, tmp_path: Path
) -> None:
    """A first flight over new ground: its map, the station gone and back, the rest of the map, the end; in Chromium."""
    station = killable
    simulate_into(tmp_path / "flight", small_flight(5, length_m=60, fps=4, cars=1))
    held = HeldFootage(footage_of(tmp_path / "flight" / "flight1" / "flight1.mp4"), before=32)
    drone = sending(held, station, tmp_path / "spool", speed=4.0)
    flying = threading.Thread(target=drone.run, daemon=True)
    with chromium() as browser:
        context = context_of(
            browser, viewport={"width": 900, "height": 600}, reduced_motion="reduce"
        )
        watched = Watched(context, station.url)
        page = watched.page
        page.goto(f"{station.url}/#/site/new/live")
        page.get_by_text("Start a mission").wait_for()
        flying.start()
        wait_for(lambda: any(each["flights"] for each in station.ask("/api/streams")))
        wish = {
            "mission": "map",
            "site": "new",
            "input": {"stream": "scout"},
            "options": {"model": "none"},
        }
        run = station.ask("/api/runs", wish)
        page.get_by_role("button", name="Close the video").click()  # which lies over the map
        wait_for(lambda: length_of_ground(page) > 1)
        first_length = length_of_ground(page)
        assert watched.faults == []
        station.stop()
        page.locator("#link-state:not(.live)").wait_for()
        station.start()
        page.locator("#link-state.live").wait_for()
        held.goes_on.set()
        flying.join(60)
        done = station.ended(run["id"])
        assert done["state"] == "finished", done
        page.locator(".run.finished", has_text=done["headline"]).wait_for()
        wait_for(lambda: length_of_ground(page) > 1.1 * first_length)
        assert [each for each in watched.faults if not IS_AWAY.search(each)] == []
        context.close()


def length_of_ground(page: Any) -> float:
    """How much wider the ground on the map is than high, at whatever zoom; 0 where there is none on the gray yet."""
    page.evaluate("document.getElementById('messages').replaceChildren()")  # they lie over the map
    shot = np.asarray(
        Image.open(BytesIO(page.locator(".map-canvas").screenshot())).convert("RGB")
    ).astype(int)
    rows, columns = np.nonzero(np.ptp(shot, axis=2) > 25)
    return float(np.ptp(columns) / max(1, np.ptp(rows))) if len(rows) > 1000 else 0.0


def test_boxes_reach_a_viewer_with_the_time_of_their_picture(
    station: Station, flown: Path, tmp_path: Path
) -> None:
    async def watch() -> tuple[list[int], list[dict[str, Any]], list[dict[str, Any]]]:
        pictures, boxes, motion = [], [], []
        async with connect(
            f"{station.url.replace('http', 'ws')}/api/streams/scout/video"
        ) as socket:
            flying.start()
            while not (boxes and motion):
                item = await asyncio.wait_for(socket.recv(), 60)
                if isinstance(item, str):
                    words = json.loads(item)
                    boxes += [words] * (words["type"] == "boxes")
                    motion += [words] * (words["type"] == "motion")
                    continue
                pictures.append(int.from_bytes(item[:8], "big"))
                if len(pictures) == 2:
                    await asyncio.to_thread(
                        station.ask,
                        "/api/runs",
                        {
                            "mission": "watch",
                            "site": "new",
                            "input": {"stream": "scout"},
                            "options": {},
                        },
                    )
        return pictures, boxes, motion

    drone = sending(footage_of(flown), station, tmp_path / "spool", speed=0.3)
    flying = threading.Thread(target=drone.run, daemon=True)
    pictures, boxes, motion = asyncio.run(watch())
    flying.join(60)
    assert boxes and min(abs(boxes[0]["pts_us"] - each) for each in pictures) < 1000
    for each in ("from_us", "pts_us"):  # how the picture moved, so that the boxes can follow it
        assert min(abs(motion[0][each] - picture) for picture in pictures) < 1000
    assert motion[0]["from_us"] < motion[0]["pts_us"] and len(motion[0]["to_from"]) == 9
    assert boxes[0]["frame_size_px"] == [320, 180]


@pytest.mark.long
def test_a_stranger_sends_a_person_s_place_in_three_taps(station: Station, tmp_path: Path) -> None:
    """On a phone, with the missions as they are: a drone begins to send, and the detector finds somebody."""
    flight = small_flight(
        3, length_m=60, height_m=15, people=8, cars=2, size_px=(640, 360), spacing_m=9
    )
    simulate_into(tmp_path / "flight", flight)
    drone = sending(
        footage_of(tmp_path / "flight" / "flight1" / "flight1.mp4"), station, tmp_path / "spool"
    )
    flying = threading.Thread(target=drone.run, daemon=True)
    with chromium() as browser:
        context = context_of(browser, viewport={"width": 390, "height": 844}, has_touch=True)
        context.grant_permissions(["clipboard-read", "clipboard-write", "geolocation"])
        watched = Watched(context, station.url)
        page = watched.page
        page.set_default_timeout(120_000)
        page.goto(station.url)
        at_s = [time.monotonic()]
        flying.start()
        for place, name in (
            (".drone", "Map and find people"),
            (".message.person", "Show"),
            (".card-over", "Send place"),
        ):
            page.locator(place).get_by_role("button", name=name).tap()
            at_s.append(time.monotonic())
        page.get_by_text("Place copied").wait_for()
        sent = page.evaluate("navigator.clipboard.readText()")
        # 60 s where nothing else runs; a busy machine's missions alone may take longer
        assert len(at_s) == 4 and at_s[3] - at_s[2] < 20 and at_s[3] - at_s[0] < 180
        assert sent.startswith("person\n") and "(1 sigma)" in sent
        sentence = page.locator("#sentence").inner_text()
        assert sentence.count("Flying") + sentence.count("Landed") <= 1
        flying.join(60)
        for run in station.ask("/api/runs"):
            assert station.ended(run["id"])["state"] == "finished"
        assert watched.faults == []
        context.close()
