"""Two stations on one root: the second is refused; one that was killed is in nobody's way."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sorvolo.errors import StoreError
from sorvolo.station.app import Station
from sorvolo.station.settings import StationSettings
from sorvolo.station.state import RootLock

HOLDS = (
    "import sys, time; from pathlib import Path; from sorvolo.station.state import RootLock; "
    "lock = RootLock(Path(sys.argv[1])); print('held', flush=True); time.sleep(60)"
)


def test_a_second_station_is_refused_and_the_next_one_is_not(tmp_path: Path) -> None:
    """In this process and from the command line; the first one goes on."""
    first = Station.open(StationSettings(tmp_path))
    with pytest.raises(StoreError, match="another station serves this folder"):
        Station.open(StationSettings(tmp_path))
    command = [sys.executable, "-m", "sorvolo", "serve", str(tmp_path), "--port", "8999"]
    second = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert second.returncode and "another station serves" in " ".join(
        (second.stderr + second.stdout).split()
    )
    assert first.events.last == 0 and first.shelf.folders() == {}
    first.close()
    Station.open(StationSettings(tmp_path)).close()


def test_a_killed_station_blocks_nobody(tmp_path: Path) -> None:
    """Its file stays, with the number of its process, which nobody holds any more."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(tmp_path / "station")], stdout=subprocess.PIPE
    )
    assert process.stdout is not None and process.stdout.readline() == b"held\n"
    with pytest.raises(StoreError, match=f"process {process.pid}"):
        RootLock(tmp_path / "station")
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (tmp_path / "station" / "station.lock").exists()
    RootLock(tmp_path / "station").close()
