"""Missions on a camera's address: one process opens it, once; the page has its video and boxes, one flight is kept."""

import asyncio
import json
import os
import shutil
import signal
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError

import pytest
from browsers import Served
from live_sender import free_port, sending, udp_url
from rtsp_server import RtspServer
from websockets.asyncio.client import connect

from sorvolo.station.settings import StationSettings
from waiting import wait_for

SECRET = "s3cr3t-of-ada"
HALF_US = 25_000  # of the time between two pictures
LOOPBACK = ("127.0.0.0/8",)


@pytest.fixture
def camera() -> Iterator[RtspServer]:
    server = RtspServer()
    server.start()
    yield server
    server.close()


def watched(station: Served, url: str, **options: Any) -> str:
    """A watch of an address that has begun; its run."""
    options = {"frames_per_second": 2} | options
    wish = {"mission": "watch", "site": "new", "input": {"stream_url": url}, "options": options}
    return str(station.ask("/api/runs", "POST", wish)["id"])


def state(station: Served, run: str) -> dict[str, Any]:
    return dict(station.ask(f"/api/runs/{run}"))


def is_seen(station: Served, run: str, frames: int = 1) -> bool:
    """Whether the mission has looked at so many frames; no mission may have ended."""
    found = state(station, run)
    assert found["state"] == "running", found
    return ((found["progress"] or {}).get("searched") or 0) >= frames


def refused(station: Served, path: str) -> int:
    """With which status the station does not delete something; 0 where it does."""
    try:
        station.send(path, "DELETE")
    except HTTPError as error:
        return error.code
    return 0


def ended(station: Served, run: str) -> dict[str, Any]:
    wait_for(lambda: state(station, run)["state"] != "running", 60)
    return state(station, run)


def own_processes(station: Served, run: str) -> list[tuple[int, bytes]]:
    """The processes of a run, each with its command line."""
    leader = station.station.runs.get(run).pid
    found = []
    for each in Path("/proc").glob("[0-9]*"):
        try:
            if (
                os.getsid(int(each.name)) == leader
                and (each / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
            ):
                found.append((int(each.name), (each / "cmdline").read_bytes()))
        except OSError:
            continue
    return found


async def viewed(station: Served, stream: str) -> tuple[list[int], dict[str, Any]]:
    """The times of the pictures that a viewer gets until boxes of one of them have come, and those.

    Whoever joins gets the pictures since the last key frame. On a busy machine the first boxes may be of an older one,
    or come before their picture.
    """
    pictures: list[int] = []
    boxes: dict[str, Any] | None = None
    async with connect(f"{station.url.replace('http', 'ws')}/api/streams/{stream}/video") as socket:
        while boxes is None or pictures[-1] < boxes["pts_us"] - HALF_US:
            item = await asyncio.wait_for(socket.recv(), 60)
            if isinstance(item, bytes):
                pictures.append(int.from_bytes(item[:8], "big"))
                continue
            words = json.loads(item)
            if (
                boxes is None
                and words["type"] == "boxes"
                and pictures
                and words["pts_us"] > pictures[0] - HALF_US
            ):
                boxes = words
        return pictures, boxes


def test_a_camera_is_opened_once_and_seen_by_the_mission_and_by_browsers(
    camera: RtspServer, tmp_path: Path
) -> None:
    """Its password is in no file and no command line; a broken connection is one flight; a stop keeps it."""
    with Served(tmp_path, free_floor_gb=0.0, stream_ranges=LOOPBACK) as station:
        run = watched(station, camera.address.replace("//", f"//ada:{SECRET}@"))
        wait_for(lambda: is_seen(station, run), 60)
        (stream,) = station.ask("/api/streams")
        assert stream["stream"].startswith("rtsp-127.0.0.1-") and stream["is_connected"]
        played = camera.methods.count(
            "PLAY"
        )  # mostly once; a busy machine may need a second call to reach it
        pictures, boxes = asyncio.run(viewed(station, stream["stream"]))
        assert (
            min(abs(boxes["pts_us"] - each) for each in pictures) < HALF_US
        )  # nearer than the next
        assert camera.playing == 1 and camera.methods.count("PLAY") == played
        processes = own_processes(station, run)
        assert sum(b"sorvolo.station.camera" in line for _, line in processes) == 1
        assert not any(SECRET.encode() in line for _, line in processes)
        assert refused(station, f"/api/runs/{run}") == 409
        assert refused(station, f"/api/streams/{stream['stream']}") == 423  # the mission reads it
        camera.hang_up()
        wait_for(lambda: camera.methods.count("PLAY") > played, 30)
        before = station.ask(f"/api/streams/{stream['stream']}")["frames"]
        wait_for(lambda: station.ask(f"/api/streams/{stream['stream']}")["frames"] > before + 5, 30)
        assert station.ask(f"/api/runs/{run}/stop", "POST")["stop_asked"]
        done = ended(station, run)
        assert done["state"] == "finished" and done["input"]["stream_url"] == camera.address
        (kept,) = station.ask(f"/api/streams/{stream['stream']}")["flights"]
        assert kept["is_over"] and kept["bytes"] > 10_000
        wait_for(lambda: not own_processes(station, run), 20)
    written = [each for each in tmp_path.rglob("*") if each.is_file()]
    assert not [each for each in written if SECRET.encode() in each.read_bytes()]
    assert not list(tmp_path.rglob("spool"))
    with Served(tmp_path, free_floor_gb=0.0) as station:
        assert station.ask("/api/streams")[0]["bytes"] == kept["bytes"]
        assert refused(station, f"/api/streams/{stream['stream']}/flights/nothing") == 404
        assert refused(station, f"/api/runs/{run}") == 0
        assert station.ask("/api/streams") == station.ask("/api/runs") == []
    assert (
        not list((tmp_path / "streams").iterdir())
        and not (tmp_path / "station" / "runs" / run).exists()
    )


@pytest.mark.long
def test_a_camera_outlives_a_restarted_station(tmp_path: Path) -> None:
    """What comes meanwhile waits and is sent; the flight is one, of the mission that goes on."""
    port = free_port()
    settings = {"free_floor_gb": 0.0, "stream_ranges": LOOPBACK}
    with sending(udp_url(port), klv=True) as drone:
        with Served(tmp_path, **settings) as station:
            run = watched(station, f"udp://:{port}")
            wait_for(lambda: is_seen(station, run), 60)
        away_s = max(drone.sent_s.values())
        with Served(tmp_path, **settings) as station:
            before = (state(station, run)["progress"] or {})["searched"]
            wait_for(lambda: is_seen(station, run, before + 2), 60)
            # the mission may have searched what waited on the disk before the camera's reader is back
            wait_for(lambda: station.ask("/api/streams")[0]["is_connected"], 30)
            (stream,) = station.ask("/api/streams")
            assert stream["flight_count"] == 1
            assert max(drone.sent_s.values()) > away_s
            station.ask(f"/api/runs/{run}/stop", "POST")
            assert ended(station, run)["state"] == "finished"
            assert station.ask(f"/api/streams/{stream['stream']}")["flights"][0]["is_over"]


def test_a_killed_mission_takes_its_camera_with_it(camera: RtspServer, tmp_path: Path) -> None:
    """By the system, which kills the mission's process alone."""
    with Served(tmp_path, free_floor_gb=0.0, stream_ranges=LOOPBACK) as station:
        run = watched(station, camera.address)
        wait_for(lambda: is_seen(station, run), 60)
        os.kill(station.station.runs.get(run).pid or 0, signal.SIGKILL)
        assert ended(station, run)["state"] == "failed"
        wait_for(lambda: not own_processes(station, run), 20)
        (stream,) = station.ask("/api/streams")
        assert not stream["is_connected"] and stream["flights"][0]["is_over"]


@pytest.mark.long
def test_a_mission_whose_folder_is_taken_away_ends_with_its_camera(
    camera: RtspServer, tmp_path: Path
) -> None:
    """It wrote into nothing until the machine was switched off: no next station would have found it."""
    with Served(tmp_path, free_floor_gb=0.0, stream_ranges=LOOPBACK) as station:
        run = watched(station, camera.address)
        wait_for(lambda: is_seen(station, run), 60)
        folder = tmp_path / "station" / "runs" / run
        log = (folder / "log.txt").open("rb")  # as whoever looks for the reason still has it
        shutil.rmtree(folder)
        wait_for(lambda: not own_processes(station, run), 40)
        assert "its folder was taken away" in ended(station, run)["error"]
        assert b"the folder of this run was taken away" in log.read()
        log.close()


@pytest.mark.long
def test_a_killed_camera_ends_the_flight_and_what_came_is_kept(
    camera: RtspServer, tmp_path: Path
) -> None:
    with Served(tmp_path, free_floor_gb=0.0, stream_ranges=LOOPBACK) as station:
        run = watched(station, camera.address)
        wait_for(lambda: is_seen(station, run), 60)
        (reader,) = [
            pid for pid, line in own_processes(station, run) if b"sorvolo.station.camera" in line
        ]
        os.kill(reader, signal.SIGKILL)
        assert ended(station, run)["state"] == "finished"


def test_a_camera_that_refuses_the_password_fails_the_mission_in_words(tmp_path: Path) -> None:
    camera = RtspServer(password=True)
    camera.start()
    with Served(tmp_path, free_floor_gb=0.0, stream_ranges=LOOPBACK) as station:
        done = ended(station, watched(station, camera.address.replace("//", f"//ada:{SECRET}@")))
    camera.close()
    assert done["state"] == "failed" and "password" in done["error"] and SECRET not in done["error"]
    assert (
        camera.methods.count("DESCRIBE") <= 2
    )  # asked, and asked with the password: not again and again


def test_a_camera_that_redirects_fails_the_mission_in_words(
    camera: RtspServer, tmp_path: Path
) -> None:
    moved = f"RTSP/1.0 302 Found\r\nCSeq: {{cseq}}\r\nLocation: {camera.address}\r\n\r\n"
    public = RtspServer(says=moved)
    public.start()
    with Served(tmp_path, free_floor_gb=0.0, stream_ranges=LOOPBACK) as station:
        done = ended(station, watched(station, public.address))
    public.close()
    assert done["state"] == "failed" and f"redirects to {camera.address}" in done["error"]
    assert not camera.methods


@pytest.mark.long
def test_pictures_that_no_browser_plays_are_read_by_the_mission_itself(tmp_path: Path) -> None:
    """No video then, and no failure: the watch sees its frames."""
    port = free_port()
    with (
        sending(udp_url(port), codec="mpeg2video"),
        Served(tmp_path, free_floor_gb=0.0, stream_ranges=LOOPBACK) as station,
    ):
        run = watched(station, f"udp://:{port}")
        wait_for(lambda: is_seen(station, run, 2), 60)
        assert station.ask("/api/streams") == []
        assert len(own_processes(station, run)) == 1  # the camera's has ended
        station.ask(f"/api/runs/{run}/stop", "POST")
        assert ended(station, run)["state"] == "finished"


def test_the_door_is_for_the_stations_user_alone_and_may_lie_deep(tmp_path: Path) -> None:
    """Longer than a socket's address may be; one that a killed station left is replaced."""
    root = tmp_path / ("deep" * 30)
    door = StationSettings(root).camera_door
    door.parent.mkdir(parents=True)
    door.touch()
    with Served(root, free_floor_gb=0.0):
        assert door.is_socket() and stat.S_IMODE(door.parent.stat().st_mode) == 0o700
    assert not door.exists()
