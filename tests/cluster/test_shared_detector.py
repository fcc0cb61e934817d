"""Flights that share one detector: the maps of flights with their own, also when its process dies."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from batch_flights import another, content

from ended_work import ended
from sorvolo.cli.main import main
from sorvolo.cluster.batch import BatchSettings, run_batch
from sorvolo.cluster.cost import Cost, CostSettings
from sorvolo.cluster.local_executor import LocalExecutor
from sorvolo.cluster.orders import FlightWish, Order, Part, PartKind
from sorvolo.cluster.shared_detector import SharedDetector, SharingSettings, searches
from sorvolo.cluster.table import BatchTable, State
from sorvolo.detection.models import find_model
from sorvolo.detection.sharing import SharedDetectorGone, shared_engine
from sorvolo.errors import SettingsError, StoreError
from sorvolo.missions.flight.memory import available_bytes
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from waiting import wait_for


class Disturbed(LocalExecutor):
    """A local executor that kills or holds the shared detector as the first try begins."""

    how = signal.SIGKILL
    pids: tuple[int, ...] = ()
    memory_mb = 0.0

    def start(self, key: tuple[str, str], order: Order, cost: Cost) -> None:
        super().start(key, order, cost)
        assert self._detector is not None
        self.pids = (*self.pids, self._detector.pid)
        self.memory_mb = max(self.memory_mb, self._detector.memory_mb)
        if len(self.pids) == 1:
            os.kill(self._detector.pid, self.how)


@pytest.mark.long
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_shared_detector_that_dies_or_hangs_is_started_again_and_finds_the_same(
    flown: Path, tmp_path: Path, how: signal.Signals
) -> None:
    flight = another(flown, tmp_path / "in" / "one")
    made: list[Disturbed] = []

    @contextmanager
    def executor(table: BatchTable) -> Iterator[LocalExecutor]:
        with Disturbed(2, 60.0, table.lock, shares_detector=True) as one:
            one.how = how
            made.append(one)
            yield one

    settings = BatchSettings(FlightWish(camera=str(flown / "camera.xml")))
    report = ended(run_batch([tmp_path / "in"], tmp_path / "maps", settings, executor))
    (row,) = report.rows
    assert row.state is State.DONE and (row.tries, report.crashes) == (2, 1)
    assert len(set(made[0].pids)) == 2
    assert 30 < made[0].memory_mb < 5_000
    for pid in made[0].pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    own = tmp_path / "own" / "one"
    for _ in map_flights([flight], own, MapSettings(), camera=flown / "camera.xml"):
        pass
    assert content(tmp_path / "maps" / "one") == content(own)


def test_a_shared_detector_that_hangs_is_ended_and_who_waits_for_it_learns_that() -> None:
    with SharedDetector(silent_s=12.0) as shared:
        address = shared.address
        engine = shared_engine(address, find_model("thermal"))
        planes = np.zeros((1, 3, 64, 64), np.uint8)
        assert len(engine.run(planes)) == 3
        held = shared.pid
        os.kill(held, signal.SIGSTOP)
        os.waitid(os.P_PID, held, os.WSTOPPED)  # it may answer once more before it stands still
        with pytest.raises(SharedDetectorGone):
            engine.run(planes)
        wait_for(
            lambda: shared.address != address
        )  # who waits may learn it before the system has buried it
        assert len(shared_engine(shared.address, find_model("thermal")).run(planes)) == 3
        assert shared.pid != held


@pytest.mark.parametrize(("shares", "fits"), [(False, True), (True, False)])
def test_the_shared_detector_counts_in_the_memory(shares: bool, fits: bool) -> None:
    costs = CostSettings(detector_mb=1000.0, machine_share=1500e6 / available_bytes())
    with LocalExecutor(2, 60.0, 0, costs, shares_detector=shares) as executor:
        assert executor.has_room(Cost(1.0, 9000.0))  # nothing else runs
        executor._running["map", "a"] = None, Cost(1.0, 500.0)  # type: ignore[assignment]
        assert executor.has_room(Cost(1.0, 500.0)) is fits
        executor._running.clear()


def test_a_stream_is_budgeted_what_it_takes_once_that_is_known() -> None:
    costs = CostSettings(machine_share=20_000e6 / available_bytes())
    with LocalExecutor(9, 60.0, 0, costs) as executor:
        for seconds, is_live, fits in (
            (90.0, True, True),
            (30.0, True, False),
            (90.0, False, False),
        ):
            running = SimpleNamespace(pid=os.getpid(), seconds=seconds)
            executor._running["map", "a"] = running, Cost(1.0, 15_000.0)  # type: ignore[assignment]
            executor._live = {("map", "a")} if is_live else set()
            assert executor.has_room(Cost(1.0, 10_000.0)) is fits
        executor._running.clear()


def test_what_shows_nothing_to_a_detector_shares_none() -> None:
    order = Order("in", "site", FlightWish())
    assert searches(order)
    assert not searches(Order("in", "site", FlightWish(model="none")))
    assert not searches(
        Order("in", "site", FlightWish(), part=Part(PartKind.BLOCK, 0, 2, "blocks"))
    )


def test_a_socket_that_cannot_be_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deep = tmp_path / ("x" * 100)  # longer than a socket's path may be
    deep.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(deep))
    with (
        SharedDetector() as shared,
        pytest.raises(StoreError, match="set TMPDIR to a folder of this machine"),
    ):
        _ = shared.address


def test_shares_that_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SettingsError, match="a share of one graphics card, 0 to 1"):
        SharingSettings(True, 1.5)
    (tmp_path / "1.mp4").write_text("no video")
    common = ["batch", str(tmp_path / "1.mp4"), "--root", str(tmp_path / "maps"), "--gpus", "0.5"]
    assert main(common) == 1
    assert "give --share-detector as well" in capsys.readouterr().err
    assert main([*common, "--share-detector"]) == 1
    assert "give --executor ray as well" in capsys.readouterr().err
