"""A batch on a Ray cluster of which a machine dies: nothing lost, the maps of an undisturbed run."""

import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from batch_flights import another, content

from ended_work import ended
from sorvolo.build import build
from sorvolo.cli.main import main
from sorvolo.cluster.batch import BatchSettings, run_batch
from sorvolo.cluster.executors import LOCK, _run_there, ray_executor
from sorvolo.errors import SettingsError, StoreError
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.worker import Order

pytest.importorskip("ray", reason="Ray is not installed: pip install 'sorvolo[fleet]'")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head without cores and two machines of a core each, on this one."""
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_AUTH_MODE", "disabled")  # nobody else sees this cluster
        head = {"num_cpus": 0, "include_dashboard": False}
        made = Cluster(initialize_head=True, head_node_args=head)
        patch.setenv("RAY_ADDRESS", made.address)
        for _ in range(2):
            made.add_node(num_cpus=1)
        yield made
        made.shutdown()


def _descendants(pid: int) -> set[int]:
    """The processes that this one started, and those that they started."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has ended
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
    found = {pid}
    while more := {child for child, parent in parents.items() if parent in found} - found:
        found |= more
    return found - {pid}


def _kill_a_machine_at_work(cluster: Any, root: Path) -> None:
    """Wait for a flight with a journal, hold its process, have its machine die, and let go of the process."""
    while not list(root.glob("*/flights/*/run.journal")):
        time.sleep(0.02)
    for node in list(cluster.worker_nodes):
        for pid in _descendants(node.all_processes["raylet"][0].process.pid):
            with suppress(OSError):
                if b"sorvolo.missions.worker" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    os.kill(pid, signal.SIGSTOP)
                    cluster.remove_node(node, allow_graceful=False)
                    os.kill(pid, signal.SIGCONT)
                    return


@pytest.mark.long
def test_a_machine_that_dies_loses_nothing(cluster: Any, flown: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        another(flown, tmp_path / "in" / name)
    root = tmp_path / "maps"
    settings = BatchSettings(camera=str(flown / "camera.xml"), model="none")
    threading.Thread(target=_kill_a_machine_at_work, args=(cluster, root), daemon=True).start()
    report = ended(
        run_batch(
            [tmp_path / "in"], root, settings, lambda table: ray_executor("ray", None, table.root)
        )
    )
    assert [row.state for row in report.rows] == ["done", "done"]
    assert (report.tries, report.crashes) == (3, 1)
    for name in ("one", "two"):
        wanted = tmp_path / "undisturbed" / name
        for _ in map_flights(
            [tmp_path / "in" / name], wanted, MapSettings(model="none"), camera=flown / "camera.xml"
        ):
            pass
        assert content(root / name) == content(wanted)
    # what a machine lacks is no crash of a flight: it would end every one
    with ray_executor("ray", None, root) as executor:
        executor.start("x", Order("map", str(root / "x"), str(tmp_path / "elsewhere")))
        with pytest.raises(StoreError, match=r"^the machine \S+ does not see .*elsewhere"):
            executor.next_ended()


@pytest.mark.parametrize("name", ["ray://127.0.0.1", "ray://:10001", "ray://127.0.0.1:{port}"])
def test_a_cluster_that_is_not_there_is_an_error_within_seconds(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as silent:  # its port is taken, and nobody answers
        silent.bind(("127.0.0.1", 0))
        (tmp_path / "1.mp4").write_text("no video")
        address, started_s = name.format(port=silent.getsockname()[1]), time.monotonic()
        options = ["--root", str(tmp_path / "maps"), "--executor", address]
        assert main(["batch", str(tmp_path / "1.mp4"), *options]) == 1
    assert f"--executor {address}: no Ray cluster answers at " in capsys.readouterr().err
    assert time.monotonic() - started_s < 30


def test_without_ray_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with (
        pytest.raises(SettingsError, match=r"pip install 'sorvolo\[fleet\]'"),
        ray_executor("ray", 1, tmp_path),
    ):
        pass


def test_a_machine_that_cannot_take_part_is_named(tmp_path: Path) -> None:
    order = Order("map", str(tmp_path), str(tmp_path))
    with pytest.raises(StoreError, match=r"has Sorvolo .*, the batch 0\.0\.9"):
        _run_there(order, str(tmp_path), "0.0.9")
    with pytest.raises(StoreError, match="does not see"):
        _run_there(order, str(tmp_path), build())
    assert not (tmp_path / LOCK).exists()
