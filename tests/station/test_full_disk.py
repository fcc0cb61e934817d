"""A disk that fills during a flight, on a real small file system: stated in words, waited for, ended as what it is."""

import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from browsers import Served
from rtsp_server import RtspServer
from stream_flights import HeldFootage
from test_camera_missions import LOOPBACK, ended, is_seen, state, watched

from small_flights import simulate_into, small_flight
from sorvolo.capture.live.growing import ENDED_SUFFIX
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.station.client import StreamClient, StreamSettings, stream_url
from sorvolo.station.footage import open_footage
from sorvolo.station.orders import RunOrder
from sorvolo.station.run_process import cut_off
from sorvolo.station.settings import StationLimits
from sorvolo.station.spool import Spool
from waiting import wait_for

DISK_BYTES, FLOOR_GB = 150_000_000, 0.03


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 150 MB."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = (
        shutil.which("mount")
        and not subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(place)],
            capture_output=True,
        ).returncode
    )
    if not mounted:
        pytest.skip("this user may not mount a small file system")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def fill(disk: Path, left_bytes: int) -> Path:
    """Leave so little of a disk, or less where others write meanwhile; what fills it."""
    path = disk / "filler"
    with path.open("wb", buffering=0) as file, suppress(OSError):
        file.write(bytes(max(0, shutil.disk_usage(disk).free - left_bytes)))
    return path


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown")
    simulate_into(folder, small_flight(5, length_m=60, fps=4, cars=1))
    return folder


class Drone:
    """A drone that sends a flight, and stands still before its 32nd picture."""

    def __init__(self, flown: Path, station: Served, spool: Path) -> None:
        footage = open_footage(
            str(flown / "flight1" / "flight1.mp4"),
            None,
            str(flown / "camera.xml"),
            LiveSettings(),
            threading.Event(),
        )
        self._held, self.stop = HeldFootage(footage, before=32), threading.Event()
        url = stream_url(station.url, "scout")
        settings = StreamSettings(speed=2.0, flush_s=0.5)
        self.client = StreamClient(
            self._held, Spool(spool, 50_000_000), url, "", settings, self.stop
        )
        self.thread = threading.Thread(target=self.client.run, daemon=True)
        self.thread.start()
        wait_for(lambda: self.client.report.frames >= 24)

    def goes_on(self) -> None:
        self._held.goes_on.set()


def mapped(station: Served, source: dict[str, str], **options: Any) -> str:
    wish = {
        "mission": "map",
        "site": "new",
        "input": source,
        "options": {"model": "none", **options},
    }
    return str(station.ask("/api/runs", "POST", wish)["id"])


def has_frames(station: Served, run: str) -> bool:
    found = state(station, run)
    assert found["state"] == "running", found
    return bool(found["progress"])


def test_a_flight_waits_for_a_full_disk_and_goes_on(
    flown: Path, disk: Path, tmp_path: Path
) -> None:
    """The run states why nothing moves, the drone keeps its pictures; with room again nothing is missing."""
    with Served(disk, free_floor_gb=FLOOR_GB) as station:
        drone = Drone(flown, station, tmp_path / "spool")
        run = mapped(station, {"stream": "scout"})
        wait_for(lambda: has_frames(station, run))
        filler = fill(disk, 20_000_000)
        wait_for(lambda: state(station, run)["notice"])
        assert (
            "disk is full (0.02 GB are free, and 0.03 GB must stay so)"
            in state(station, run)["notice"]
        )
        drone.goes_on()
        wait_for(lambda: "disk is full" in drone.client.report.words)
        filler.unlink()
        wait_for(lambda: state(station, run)["notice"] is None)
        drone.thread.join(60)
        assert (
            drone.client.is_complete
            and drone.client.report.late == drone.client.report.overflowed == 0
        )
        done = ended(station, run)
        assert (done["state"], done["exit_code"], done["notice"]) == ("finished", 0, None)


@pytest.mark.parametrize("way", ["stopped", pytest.param("given up", marks=pytest.mark.long)])
def test_a_flight_that_a_full_disk_cut_is_kept_and_called_incomplete(
    way: str, flown: Path, disk: Path, tmp_path: Path
) -> None:
    """By a person who stops it, or after the longest wait: what came is a map, and it is not reported as all."""
    limits = StationLimits(away_s=900.0 if way == "stopped" else 6.0)
    with Served(disk, free_floor_gb=FLOOR_GB, limits=limits) as station:
        drone = Drone(flown, station, tmp_path / "spool")
        run = mapped(station, {"stream": "scout"})
        wait_for(lambda: has_frames(station, run))
        (recording,) = (disk / "streams" / "scout").glob("*.ts")
        fill(disk, 20_000_000)
        drone.goes_on()
        wait_for(lambda: "disk is full" in drone.client.report.words)
        size = recording.stat().st_size
        wait_for(lambda: state(station, run)["notice"])
        if way == "stopped":
            station.ask(f"/api/runs/{run}/stop", "POST")
        done = ended(station, run)
        assert (done["state"], done["exit_code"], done["error"], done["notice"]) == (
            "incomplete",
            3,
            None,
            None,
        )
        assert done["headline"].startswith("incomplete: the station's disk is full (0.0")
        assert ("nothing came for 6 s" in done["headline"]) == (way == "given up")
        assert "matched" in done["headline"]
        (flight,) = station.ask("/api/sites/new")["flights"]
        assert flight["frames"] >= 2 and recording.stat().st_size == size
        drone.stop.set()
        drone.thread.join(30)
        assert drone.client.report.spooled > 0  # the others are still the drone's


@pytest.mark.long
def test_a_camera_whose_station_has_no_room_ends_incomplete(disk: Path) -> None:
    """The pictures that the station could not take are counted."""
    camera = RtspServer()
    camera.start()
    try:
        with Served(disk, free_floor_gb=FLOOR_GB, stream_ranges=LOOPBACK) as station:
            run = watched(station, camera.address)
            wait_for(lambda: is_seen(station, run), 60)
            fill(disk, 20_000_000)
            wait_for(lambda: state(station, run)["notice"])
            wait_for(lambda: not station.ask("/api/streams")[0]["is_connected"])
            station.ask(f"/api/runs/{run}/stop", "POST")
            done = ended(station, run)
            assert (done["state"], done["exit_code"]) == ("incomplete", 3)
            assert (
                "disk is full" in done["headline"]
                and "of the camera did not get to the station" in done["headline"]
            )
            text = station.read("/metrics")
            assert (
                'sorvolo_missions{state="incomplete"} 1.0' in text
                and "sorvolo_disk_floor_bytes 3e+07" in text
            )
    finally:
        camera.close()


@pytest.mark.long
def test_an_upload_s_mission_on_a_full_disk_fails_in_words(flown: Path, disk: Path) -> None:
    """It is warned of before; the site is as it was, and the station goes on."""
    shutil.copytree(flown, disk / "flown")
    with Served(disk, free_floor_gb=FLOOR_GB) as station:
        (video,) = [
            each["id"] for each in station.ask("/api/inputs") if each["name"].endswith(".mp4")
        ]
        first = mapped(station, {"input": video})
        assert ended(station, first)["state"] == "finished"
        before = station.ask("/api/sites/new")
        run = mapped(
            station, {"input": video}, overlap=0.97
        )  # needs more than the station holds back
        fill(disk, 0)
        done = ended(station, run)
        assert done["state"] == "failed" and done["exit_code"] == 1, done
        assert "disk" in done["error"] or "space" in done["error"], done
        after = station.ask("/api/sites/new")
        assert after["versions"] == before["versions"] and after["flights"] == before["flights"]
        wait_for(lambda: is_announced(station))


def is_announced(station: Served) -> bool:
    """Whether an event has stated that the disk is full."""
    rows = station.station.state.rows("SELECT data FROM events WHERE type = 'station.disk'")
    return any('"is_low":true' in row["data"] for row in rows)


def order_of(source: str, floor_gb: float) -> RunOrder:
    return RunOrder(
        run="1", mission="map", site="new", source=source, stream="scout", floor_gb=floor_gb
    )


def test_what_a_cut_flight_lacks(tmp_path: Path) -> None:
    """A flight whose end was stated lacks nothing, however full the disk; a stopped one with room neither."""
    path = tmp_path / "flight.ts"
    path.touch()
    assert cut_off(order_of(f"follow:{path}", 0.0), was_stopped=True) == ""
    assert "never stated" in cut_off(order_of(f"follow:{path}", 0.0), was_stopped=False)
    assert "disk is full" in cut_off(order_of(f"follow:{path}", 1e6), was_stopped=True)
    assert cut_off(order_of(str(path), 1e6), was_stopped=True) == ""
    path.with_name(path.name + ENDED_SUFFIX).touch()
    assert cut_off(order_of(f"follow:{path}", 1e6), was_stopped=False) == ""
