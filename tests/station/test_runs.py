"""Missions of the station: in processes of their own, found again, stopped, refused; a crash touches nothing else."""

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from small_flights import simulate_into, small_flight
from sorvolo.errors import StoreError
from sorvolo.missions.worker import Journal, Order, run_watch, work
from sorvolo.station import runs as runs_module
from sorvolo.station.app import station_app
from sorvolo.station.orders import InputWish, RunOrder, RunWish
from sorvolo.station.runs import Run, Runs
from sorvolo.station.settings import StationLimits, StationSettings
from sorvolo.station.state import utc_now
from waiting import wait_for

FLIGHT = small_flight(5, length_m=12, fps=4, cars=1)
HOST = "http://127.0.0.1:8750"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of one short strip with telemetry beside it."""
    return simulate_into(tmp_path_factory.mktemp("flown") / "flight", FLIGHT)


@pytest.fixture
def open_station(flown: Path, tmp_path: Path) -> Iterator[Callable[[], TestClient]]:
    """Opens a station over a folder with the flight, as often as it is asked."""
    root = tmp_path / "root"
    shutil.copytree(flown, root / "flown")
    opened: list[TestClient] = []

    def open_it() -> TestClient:
        client = TestClient(station_app(StationSettings(root, free_floor_gb=0.0)), base_url=HOST)
        opened.append(client)
        return client.__enter__()

    yield open_it
    for each in opened:
        each.__exit__(None, None, None)


def wish(
    client: TestClient, mission: str = "map", site: str = "new", **options: Any
) -> dict[str, Any]:
    """A mission on the flight."""
    inputs = {
        each["name"].rpartition("/")[2]: each["id"] for each in client.get("/api/inputs").json()
    }
    video = next(identity for name, identity in inputs.items() if name.endswith(".mp4"))
    return {
        "mission": mission,
        "site": site,
        "input": {"input": video},
        "options": {"camera_file": {"input": inputs["camera.xml"]}, "model": "none", **options},
    }


def ended(client: TestClient, run: str, within_s: float = 120.0) -> dict[str, Any]:
    """A run once it runs no more."""
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        state = client.get(f"/api/runs/{run}").json()
        if state["state"] != "running":
            return state
        time.sleep(0.05)
    raise AssertionError(f"still running: {state}")


def all_events(client: TestClient) -> list[dict[str, Any]]:
    """Every event there ever was."""
    log = client.app.state.station.events  # type: ignore[attr-defined]
    found: list[dict[str, Any]] = []
    while batch := log.after(found[-1]["seq"] if found else 0):
        found += batch
    return found


def look_at_place(client: TestClient, longitude: float, latitude: float) -> None:
    """The memory of a place leads to pictures of it, and into the video."""
    rows = client.get("/api/sites/new/place", params={"lon": longitude, "lat": latitude}).json()
    assert rows == sorted(rows, key=lambda each: each["time"]) and rows
    assert all(each["flight"] == "flight1" and 0 <= each["video_s"] < 10 for each in rows)
    assert client.get(rows[0]["crop_url"]).content[:2] == b"\xff\xd8"
    of_video = rows[0]["crop_url"].replace("/frame/", "/video/")
    assert client.get(of_video).content[:2] == b"\xff\xd8"
    part = client.get(rows[0]["video_url"], headers={"range": "bytes=4-7"})
    assert part.status_code == 206 and part.content == b"ftyp"


def test_a_mission_outlives_its_server_and_nothing_is_lost_or_doubled(
    open_station: Callable[[], TestClient], tmp_path: Path
) -> None:
    """Started by one server, finished under the next: the map is there, every journal line is one event."""
    first = open_station()
    started = first.post("/api/runs", json=wish(first))
    assert started.status_code == 201, started.text
    run = started.json()
    assert run["state"] == "running" and "pid" not in run
    second_mission = first.post("/api/runs", json=wish(first, "map"))
    assert second_mission.status_code == 409 and second_mission.json()["run"] == run["id"]
    first.__exit__(None, None, None)
    client = open_station()
    assert client.get(f"/api/runs/{run['id']}").json()["id"] == run["id"]
    done = ended(client, run["id"])
    assert done["state"] == "finished" and done["exit_code"] == 0 and "matched" in done["headline"]
    site = client.get("/api/sites/new").json()
    assert site["versions"][0]["n"] == 1 and site["flights"][0]["matched"] > 2
    events = all_events(client)
    assert [each["seq"] for each in events] == list(range(1, len(events) + 1))
    journal = (
        (tmp_path / "root/station/runs" / run["id"] / "journal.jsonl").read_text().splitlines()
    )
    types = [each["type"] for each in events if each["run"] == run["id"]]
    assert types == ["run.started", *(json.loads(each)["type"] for each in journal)]
    placed = [each["data"] for each in events if each["type"] == "frame.placed"]
    assert len(placed) == site["flights"][0]["frames"]
    west, south, east, north = site["bounds_wgs84"]
    for each in placed:
        assert west < each["position"][0] < east and south < each["position"][1] < north
        assert 15 < each["height_m"] < 25 and len(each["footprint"]) == 5
    look_at_place(client, *site["center_wgs84"])
    until = time.monotonic() + 30
    while not any(  # the newest one is announced, whichever that is by now
        each["type"] == "map.tiles"
        and each["data"]["revision"] == client.get("/api/sites/new").json()["live_revision"]
        for each in all_events(client)
    ):
        assert time.monotonic() < until
        time.sleep(0.05)


def test_a_killed_mission_is_named_and_the_next_one_may_start(
    open_station: Callable[[], TestClient],
) -> None:
    """By a signal from outside, as the system does when memory is short; stopped by a person; both at the beginning."""
    client = open_station()
    run = client.post("/api/runs", json=wish(client)).json()
    os.kill(client.app.state.station.runs.get(run["id"]).pid, signal.SIGKILL)  # type: ignore[attr-defined]
    done = ended(client, run["id"])
    assert done["state"] == "failed" and "signal 9" in done["error"]
    run = client.post("/api/runs", json=wish(client)).json()
    assert client.post(f"/api/runs/{run['id']}/stop").status_code == 200
    assert ended(client, run["id"])["state"] == "stopped"
    assert client.post(f"/api/runs/{run['id']}/stop").status_code == 409
    assert client.get("/api/sites").json() == []
    assert [each["state"] for each in client.get("/api/runs").json()] == ["stopped", "failed"]


def test_a_mission_that_cannot_do_its_work_names_the_reason(
    open_station: Callable[[], TestClient],
) -> None:
    """The same words as on the command line."""
    client = open_station()
    order = wish(client)
    inputs = {
        each["name"].rpartition("/")[2]: each["id"] for each in client.get("/api/inputs").json()
    }
    order["input"] = {"input": inputs["camera.xml"]}
    done = ended(client, client.post("/api/runs", json=order).json()["id"])
    assert done["state"] == "failed" and done["exit_code"] == 1 and "camera.xml" in done["error"]


def test_a_station_over_a_relative_folder_flies_what_lies_there(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `sorvolo serve maps` has it: missions run in folders of their own."""
    shutil.copytree(flown, tmp_path / "maps" / "flown")
    monkeypatch.chdir(tmp_path)
    with TestClient(
        station_app(StationSettings(Path("maps"), free_floor_gb=0.0)), base_url=HOST
    ) as client:
        done = ended(client, client.post("/api/runs", json=wish(client)).json()["id"])
    assert (done["state"], done["error"]) == ("finished", None)


def test_a_mission_that_cannot_be_noted_does_not_run(
    open_station: Callable[[], TestClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full at this very moment: its process would write into the site, known to nobody."""
    runs = open_station().app.state.station.runs  # type: ignore[attr-defined]
    spawned: list[subprocess.Popen[bytes]] = []
    started = runs_module._spawned

    def spawn(folder: Path, order: RunOrder) -> "subprocess.Popen[bytes]":
        spawned.append(started(folder, order))
        return spawned[-1]

    def fail(_: object) -> None:
        raise StoreError("disk full")

    monkeypatch.setattr(runs_module, "_spawned", spawn)
    monkeypatch.setattr(runs, "_begin", fail)
    with pytest.raises(StoreError):
        runs.start(
            RunWish(mission="map", site="new", input=InputWish(input=runs._inputs.all()[0].id)),
            "Ada",
        )
    assert spawned[0].poll() == -signal.SIGKILL and runs.all() == []


@pytest.mark.long
def test_lines_that_cannot_be_read_are_passed_over(open_station: Callable[[], TestClient]) -> None:
    """A power cut tore one: what stands behind it counts."""
    client = open_station()
    runs = client.app.state.station.runs  # type: ignore[attr-defined]
    runs.close()
    run = Run("1" * 16, "map", "new", "running", "Ada", "2026-01-01T00:00:00Z")
    folder = runs._folder / run.id
    folder.mkdir(parents=True)
    (folder / "journal.jsonl").write_bytes(b"torn\n" * 1_000_000)
    runs._begin(run)
    assert runs.look() == 1 and runs.get(run.id).state == "running"
    line = {"type": "run.finished", "data": {"headline": "mapped", "exit_code": 0, "error": None}}
    with (folder / "journal.jsonl").open("ab") as journal:
        journal.write(json.dumps(line).encode() + b"\n")
    while runs.look():
        pass
    assert runs.get(run.id).headline == "mapped"


def waiting(runs: Runs, run: Run, program: str) -> Run:
    """A run whose process is a program that waits, with the run's lock; its folder and record are there."""
    folder = runs._folder / run.id
    folder.mkdir(parents=True)
    with (folder / "running.lock").open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        process = subprocess.Popen(
            [sys.executable, "-c", program],
            pass_fds=(lock.fileno(),),
            start_new_session=True,
            stdout=subprocess.PIPE,
        )
    assert process.stdout is not None and process.stdout.readline() == b"ready\n"
    runs._processes[run.id] = process
    run = replace(run, pid=process.pid)
    runs._begin(run)
    return run


def test_a_watch_that_is_stopped_keeps_what_it_found_and_states_that_it_was(tmp_path: Path) -> None:
    simulate_into(tmp_path / "flown", small_flight(5, length_m=60, fps=8))
    with TestClient(
        station_app(StationSettings(tmp_path, free_floor_gb=0.0)), base_url=HOST
    ) as client:
        run = client.post("/api/runs", json=wish(client, "watch", model="default")).json()
        path = f"/api/runs/{run['id']}"
        wait_for(lambda: client.get(path).json()["progress"])
        client.post(f"{path}/stop")
        done = ended(client, run["id"])
    assert done["state"] == "finished" and done["headline"].startswith(
        "stopped before the flight's end: "
    )
    assert done["progress"]["frames"] < done["progress"]["frames_expected"]


def test_a_stop_between_two_frames_keeps_what_a_watch_found(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal strikes anywhere, also while the journal is written: what the watch found is no less there."""
    struck: list[int] = []

    def strike(journal: Journal, data: dict[str, Any]) -> None:
        if not struck:
            struck.append(data["searched"])
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(Journal, "progress", strike)
    handlers = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    video, out = str(flown / "flight1" / "flight1.mp4"), tmp_path / "watch"
    order = Order("watch", "", video, folder=str(out), options={"model": "default"})
    try:
        with (tmp_path / "lines").open("wb") as file:
            journal = Journal(file)
            code = work(order, journal, lambda stop: run_watch(order, journal, stop.until))
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)
    last = json.loads((tmp_path / "lines").read_text().splitlines()[-1])
    assert (last["type"], code) == ("run.finished", 3), last
    assert last["data"]["headline"].startswith("stopped before the flight's end: ")
    assert struck == [1] and (out / "report.json").is_file()


DEAF = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready', flush=True); time.sleep(60)"


@pytest.mark.parametrize(("source", "stops"), [({"input": "1"}, 1), ({"stream": "scout"}, 2)])
def test_a_mission_that_hangs_is_killed_some_time_after_it_was_stopped(
    tmp_path: Path, source: dict[str, str], stops: int
) -> None:
    """A live flight has longer, to be finished, until it is stopped again. Looking at missions never waits for one."""
    limits = StationLimits(stop_within_s=1.0, finish_within_s=3600.0)
    with TestClient(station_app(StationSettings(tmp_path, limits=limits)), base_url=HOST) as client:
        runs: Runs = client.app.state.station.runs  # type: ignore[attr-defined]
        runs.close()
        run = waiting(
            runs, Run("2" * 16, "map", "new", "running", "Ada", utc_now(), input=source), DEAF
        )
        for _ in range(stops):
            assert runs.look() == 1
            runs.stop(run.id)
            assert (
                runs.look() == 1 and runs._processes[run.id].poll() is None
            )  # it did not wait for its end
        wait_for(lambda: not runs.look())
        done = runs.get(run.id)
        assert done.state == "stopped" and done.exit_code == -signal.SIGKILL


def test_a_process_that_states_its_end_and_does_not_come_to_it_holds_up_nobody(
    tmp_path: Path,
) -> None:
    """A thread that never ends; the mission is over, its process is killed after a while."""
    limits = StationLimits(stop_within_s=0.3)
    with TestClient(station_app(StationSettings(tmp_path, limits=limits)), base_url=HOST) as client:
        runs: Runs = client.app.state.station.runs  # type: ignore[attr-defined]
        runs.close()
        run = waiting(runs, Run("3" * 16, "map", "new", "running", "Ada", utc_now()), DEAF)
        line = {
            "type": "run.finished",
            "data": {"headline": "mapped", "exit_code": 0, "error": None},
        }
        (runs._folder / run.id / "journal.jsonl").write_text(json.dumps(line) + "\n")
        process = runs._processes[run.id]
        assert runs.look() == 0 and process.poll() is None  # it did not wait for its end
        assert runs.get(run.id).state == "finished"
        wait_for(lambda: runs.look() == 0 and not runs._processes)
        assert process.returncode == -signal.SIGKILL


def test_a_line_of_a_mission_is_taken_in_when_it_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not when the station next looks at all missions: boxes wait for it."""
    with TestClient(station_app(StationSettings(tmp_path)), base_url=HOST) as client:
        runs: Runs = client.app.state.station.runs  # type: ignore[attr-defined]
        run = waiting(runs, Run("4" * 16, "map", "new", "running", "Ada", utc_now()), DEAF)
        wait_for(lambda: run.id in runs._ends)
        monkeypatch.setattr(runs_module, "_LOOK_EVERY_S", 3600.0)
        time.sleep(0.3)  # the last wait of the usual length is over
        with (runs._folder / run.id / "journal.jsonl").open("a") as journal:
            journal.write(json.dumps({"type": "run.progress", "data": {"frames": 7}}) + "\n")
        wait_for(lambda: (runs.get(run.id).progress or {}).get("frames") == 7)
        runs._processes[run.id].kill()


def test_a_search_maps_the_flight_that_it_is_given_and_measures_it(
    open_station: Callable[[], TestClient], tmp_path: Path
) -> None:
    """It writes into its site as a map does; a search of the site's own flights does not."""
    client = open_station()
    run = client.post(
        "/api/runs", json=wish(client, "search", model="default", classes=["car"], plants=10)
    ).json()
    second = client.post("/api/runs", json=wish(client, "map"))
    assert second.status_code == 409 and "search" in second.json()["detail"]
    state = ended(client, run["id"])
    assert state["state"] == "finished", state
    assert state["headline"].startswith("probability of detection of a car")
    report = json.loads((tmp_path / "root" / "new" / "search" / "search.json").read_bytes())
    assert report["so_far"] is None and report["flights"][0]["name"] == "flight1"
    assert client.get("/api/sites/new").json()["versions"]


@pytest.mark.long
def test_a_demo_is_simulated_mapped_and_compared(open_station: Callable[[], TestClient]) -> None:
    """A minute and a half of processor time: one site with both flights, and what they found."""
    client = open_station()
    run = client.post("/api/runs", json={"mission": "demo", "site": "demo"}).json()
    busy = client.post("/api/runs", json={"mission": "demo", "site": "demo"})
    assert busy.status_code == 409
    done = ended(client, run["id"], 400)
    assert (done["state"], done["error"]) == ("finished", None)
    site = client.get("/api/sites/demo").json()
    assert [each["flight"] for each in site["versions"]] == ["flight1", "flight2"]
    found = client.get("/api/sites/demo/collections/objects/items").json()["features"]
    assert {"person", "car"} <= {each["properties"]["class"] for each in found}


def test_the_missions_of_a_site_are_not_cut_off_by_those_of_others(tmp_path: Path) -> None:
    """The limit counts what was asked for."""
    with TestClient(station_app(StationSettings(tmp_path)), base_url=HOST) as client:
        runs: Runs = client.app.state.station.runs  # type: ignore[attr-defined]
        runs.close()
        for number, site in enumerate(["mine", "theirs", "theirs"]):
            runs._begin(
                Run(str(number), "map", site, "failed", "Ada", f"2026-01-01T00:00:0{number}Z")
            )
        assert [each["id"] for each in client.get("/api/runs?site=mine&limit=2").json()] == ["0"]
        assert [each["id"] for each in client.get("/api/runs?limit=2").json()] == ["2", "1"]


WRONG: list[tuple[dict[str, Any], int]] = [
    ({"mission": "fly"}, 422),
    ({"site": ""}, 422),
    ({"site": "../out"}, 400),
    ({"site": "station"}, 400),
    ({"site": "streams"}, 400),
    ({"input": {"input": "0" * 16}}, 404),
    ({"input": {"upload": "../../etc/passwd"}}, 404),
    ({"input": None}, 422),
    ({"input": {"path": "/etc/passwd"}}, 422),
    ({"input": {"input": "a", "upload": "b"}}, 422),
    ({"options": {"camera": "/etc/passwd"}}, 422),
    ({"options": {"model": "../model"}}, 422),
    ({"options": {"alert_command": "rm"}}, 422),
    ({"options": {"overlap": 2}}, 422),
    ({"options": {"votes": True}}, 422),  # it would count as 1
    ({"options": {"through_trees": True}}, 422),
    ({"mission": "compare", "site": "nowhere"}, 404),
    ({"mission": "search", "site": "nowhere", "input": None}, 404),
    ({"input": {"stream_url": "rtsp://127.0.0.1/live"}}, 400),
    ({"input": {"stream": "../x"}}, 400),
    ({"input": {"stream": "nobody"}}, 404),
]


def test_what_cannot_be_started_is_refused(open_station: Callable[[], TestClient]) -> None:
    """In words, and no process is started."""
    client = open_station()
    for change, status in WRONG:
        answer = client.post("/api/runs", json={**wish(client), **change})
        assert answer.status_code == status, (change, answer.text)
        assert answer.json()["detail"]
    assert client.get("/api/runs").json() == []


def test_without_free_space_nothing_starts(flown: Path, tmp_path: Path) -> None:
    """507, and what to do."""
    shutil.copytree(flown, tmp_path / "root" / "flown")
    with TestClient(
        station_app(StationSettings(tmp_path / "root", free_floor_gb=1e6)), base_url=HOST
    ) as client:
        answer = client.post("/api/runs", json=wish(client))
        assert answer.status_code == 507 and "delete" in answer.json()["detail"]
        client.app.state.station.runs.look_at_disk()  # type: ignore[attr-defined]
        (low,) = [each for each in all_events(client) if each["type"] == "station.disk"]
        assert low["data"]["is_low"] and low["data"]["floor_gb"] == 1e6
