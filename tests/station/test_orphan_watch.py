"""Processes of missions of which nobody knows any more end by themselves; others go on."""

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from sorvolo.missions.worker import Done
from sorvolo.station import run_process
from sorvolo.station.orders import MissionOptions, RunOrder
from sorvolo.station.run_process import ended_when_orphaned, why_orphaned
from sorvolo.station.state import StationState
from waiting import wait_for

RUN = "ab12"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a run that the station knows."""
    found = tmp_path / "station" / "runs" / RUN
    found.mkdir(parents=True)
    options = MissionOptions(model="none").model_dump(mode="json")
    RunOrder(
        run=RUN,
        mission="map",
        site=str(tmp_path / "new"),
        source=f"follow:{tmp_path}",
        folder=str(found),
        options=options,
    ).write(found)
    with closing(StationState.open(tmp_path / "station")) as state, state.changing() as connection:
        connection.execute(
            "INSERT INTO runs (id, made_at, site, mission, state, record) VALUES (?, '', 'new', 'map', 'running', ?)",
            (RUN, "{}"),
        )
    return found


def forget(folder: Path) -> None:
    """Drop the station's record of the run."""
    with closing(StationState.open(folder.parent.parent)) as state, state.changing() as connection:
        connection.execute("DELETE FROM runs")


def test_a_run_that_is_known_is_no_orphan(folder: Path) -> None:
    """Nor is one whose station cannot be asked."""
    assert why_orphaned(folder, RUN) == ""
    assert "no record" in why_orphaned(folder, "other")
    for name in ("station.db-wal", "station.db-shm"):
        (folder.parent.parent / name).unlink(missing_ok=True)
    (folder.parent.parent / "station.db").write_bytes(b"no database")
    assert why_orphaned(folder, RUN) == ""
    (folder.parent.parent / "station.db").unlink()
    assert why_orphaned(folder, RUN) == ""


def test_several_looks_must_agree_and_a_mission_that_ended_is_left_alone(folder: Path) -> None:
    reasons: list[str] = []
    order = folder / "order.json"
    with ended_when_orphaned(folder, RUN, reasons.append, every_s=0.1):
        for _ in range(3):  # away for a moment each time
            order.rename(folder / "away")
            time.sleep(0.12)
            (folder / "away").rename(order)
            time.sleep(0.25)
        assert reasons == []
    forget(folder)
    time.sleep(0.6)
    assert reasons == []


OFTEN = """
import sys
from pathlib import Path
from sorvolo.station import run_process
run_process.ended_when_orphaned.__wrapped__.__kwdefaults__["every_s"] = 0.2  # else five seconds
sys.exit(run_process.main(Path(sys.argv[1])))
"""


def test_a_process_without_a_record_states_why_it_ended(folder: Path) -> None:
    """Its station was killed before it had noted the run: no next one would find it."""
    forget(folder)
    with (folder / "log.txt").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-c", OFTEN, str(folder)],
            stderr=log,
            start_new_session=True,
        )
    try:
        wait_for(lambda: process.poll() is not None, 40)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 1
    assert "no record of this run" in (folder / "log.txt").read_text()
    assert "no record of this run" in (folder / "journal.jsonl").read_text()


def test_a_mission_that_fails_because_its_folder_is_gone_states_that(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its own writing may fail before the missing folder is noticed: a traceback would hide the reason."""
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # those of the tests stay

    def writing(*_: object) -> Done:
        shutil.rmtree(folder)
        (folder / "detections.jsonl").write_text("{}")
        return Done("")

    monkeypatch.setattr(run_process, "fly", writing)
    assert run_process.main(folder) == 1
    assert capsys.readouterr().err == "the folder of this run was taken away; stopped\n"
