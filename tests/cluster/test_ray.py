"""A batch on a Ray cluster of which a machine dies, or its head: nothing lost, the maps of an undisturbed run."""

import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from batch_flights import another, content, descendants, written_sites

from ended_work import ended
from sorvolo.cli.main import main
from sorvolo.cluster import ray_cluster, streams
from sorvolo.cluster.batch import BatchSettings, run_batch
from sorvolo.cluster.cost import Cost
from sorvolo.cluster.orders import Ending, FlightWish, Mission, Order, Outcome, WatchWish
from sorvolo.cluster.ray_cluster import WAITS, demand_same, probe_of, why_not
from sorvolo.cluster.ray_executor import (
    RayExecutor,
    _demand_fit,
    _LiveTry,
    ray_executor,
)
from sorvolo.cluster.streams import run_streams, streams_of
from sorvolo.cluster.table import LOCK, State
from sorvolo.errors import InputError, SettingsError, StoreError
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'sorvolo[fleet]'")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head without cores and two machines of a core each, on this one; the last test kills the head."""
    from ray.cluster_utils import Cluster

    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_CLIENT_RECONNECT_GRACE_PERIOD", "5")  # seconds; 30 of its own
        patch.setenv(
            "RAY_AUTH_MODE", "disabled"
        )  # this cluster is seen by nobody else for a few seconds
        head = {"num_cpus": 0, "include_dashboard": False, "ray_client_server_port": port}
        made = Cluster(initialize_head=True, head_node_args=head)
        made.client_address = f"ray://127.0.0.1:{port}"
        patch.setenv("RAY_ADDRESS", made.address)
        for cards in (0, 1):  # Ray believes what it is given as graphics cards
            made.add_node(num_cpus=1, num_gpus=cards)
        yield made
        made.shutdown()


def _kill_a_machine_at_work(cluster: Any, root: Path) -> None:
    """Wait for a flight with a journal, hold its process, have its machine die, and let go of the process."""
    while True:
        time.sleep(0.02)
        for node in list(cluster.worker_nodes):
            for pid in descendants({node.all_processes["raylet"][0].process.pid}):
                if any(
                    list(site.glob("flights/*/run.journal")) for site in written_sites(pid, root)
                ):
                    os.kill(pid, signal.SIGSTOP)
                    cluster.remove_node(node, allow_graceful=False)
                    os.kill(pid, signal.SIGCONT)
                    return


def _hold_the_parent_of_a_mission(cluster: Any) -> list[int]:
    """Wait for a mission, and hold the process of Ray's that started it."""
    missions = _held_missions(cluster)
    held = [
        int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1]) for pid in missions
    ]
    for pid in held:
        os.kill(pid, signal.SIGSTOP)
    threading.Timer(150, _let_go, [held]).start()
    _let_go(missions)
    return held


@pytest.mark.long
@pytest.mark.parametrize("is_live", [False, True])
def test_a_worker_of_rays_that_hangs_is_killed_and_its_flight_goes_on(
    cluster: Any, flown: Path, tmp_path: Path, is_live: bool
) -> None:
    another(flown, tmp_path / "in" / "one")
    holder, found = ThreadPoolExecutor(1).submit(_hold_the_parent_of_a_mission, cluster), []
    wish = FlightWish(camera=str(flown / "camera.xml"), model="none", give_up_s=2.0)
    if is_live:
        running: Any = run_streams(
            streams_of([f"north=follow:{tmp_path / 'in' / 'one'}"]),
            tmp_path / "maps",
            BatchSettings(wish),
            lambda table: ray_executor("ray", 1, 8.0, table.root),
            threading.Event(),
        )
    else:
        running = run_batch(
            [tmp_path / "in"],
            tmp_path / "maps",
            BatchSettings(wish),
            lambda table: ray_executor("ray", 1, 8.0, table.root),
        )
    for update in running:
        if update.row is not None:
            found.append((update.row.state, update.row.words))
    assert (State.WAITING, "Ray's worker hung for 8 s and was killed") in found
    assert found[-1][0] is State.DONE
    for pid in holder.result():
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@pytest.mark.long
@pytest.mark.parametrize(
    "look_s", [pytest.param(0.05, id="asked often"), pytest.param(300.0, id="asked at its end")]
)
def test_a_stream_is_watched_by_an_actor_which_reports_what_it_finds(
    cluster: Any, flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, look_s: float
) -> None:
    monkeypatch.setattr(streams, "_LOOK_S", look_s)
    another(flown, tmp_path / "in" / "one")
    wish = FlightWish(Mission.WATCH, camera=str(flown / "camera.xml"), give_up_s=2.0)
    running = run_streams(
        streams_of([f"north=follow:{tmp_path / 'in' / 'one'}"]),
        tmp_path / "out",
        BatchSettings(wish),
        lambda table: ray_executor("ray", 1, 60.0, table.root),
        threading.Event(),
    )
    updates = list(running)
    assert {each.found.partition(" at ")[0] for each in updates if each.found} == {
        "car 2",
        "person 1",
    }
    last = updates[-1].row
    assert last is not None and (last.state, last.tries, last.words) == (
        State.DONE,
        1,
        "1 car, 1 person found in 4 frames",
    )
    assert (tmp_path / "out" / "north-watch" / "one" / "report.html").is_file()


class _SlowActor:
    """Found three things; what it is asked arrives late."""

    def __init__(self) -> None:
        self._tried, self.found_after, self.asked = _LiveTry(), self, 0
        self._tried._found += ["car 1", "person 2", "object 3"]

    def remote(self, taken: int) -> list[str]:
        """The answer, which `_SlowRay` hands on later."""
        self.asked += 1
        return self._tried.found_after(taken)


class _SlowRay:
    """Ray, with answers that are there when they were waited for three times."""

    exceptions = ray.exceptions

    def __init__(self) -> None:
        self._waits = 0

    def wait(
        self, tasks: list[list[str]], timeout: float
    ) -> tuple[list[list[str]], list[list[str]]]:
        """Nothing, nothing, all."""
        self._waits += 1
        return ([], tasks) if self._waits % 3 else (tasks, [])

    def get(self, task: list[str]) -> list[str]:
        """The answer."""
        return task


def test_what_a_watch_found_is_not_lost_when_its_answers_are_late(tmp_path: Path) -> None:
    executor, actor, key = (
        RayExecutor("ray://127.0.0.1:1", None, 9.0, tmp_path),
        _SlowActor(),
        ("watch", "north"),
    )
    executor._ray, executor._actors[key], executor._taken[key] = _SlowRay(), actor, 0
    assert [executor._taken_found() for _ in range(6)] == [
        [],
        [],
        [(key, "car 1"), (key, "person 2"), (key, "object 3")],
        [],
        [],
        [],
    ]
    assert actor.asked == 2


class _FailedRay:
    """Ray, whose task ended with an exception on its machine, as a machine with other code of Sorvolo's has it."""

    exceptions = ray.exceptions

    def get(self, task: Exception) -> None:
        """What Ray raises of it: no traceback is lost, and the first line has only the task's name."""
        failed = ray.exceptions.RayTaskError(
            "sorvolo one", "Traceback: ...", task, pid=7, ip="10.0.0.2"
        )
        raise failed.as_instanceof_cause()


def test_a_task_that_cannot_be_run_is_a_crash_with_its_cause(tmp_path: Path) -> None:
    executor = RayExecutor("ray://127.0.0.1:1", None, 9.0, tmp_path)
    executor._ray = _FailedRay()
    ending, _ = executor._ending(TypeError("Order() takes 3 arguments\nand more"))
    assert ending == Ending(
        Outcome.CRASHED, "its task could not be run (TypeError: Order() takes 3 arguments)"
    )
    with pytest.raises(
        InputError, match="install the same one"
    ) as caught:  # what all flights would meet
        executor._ending(InputError("the machine far has Sorvolo 0; install the same one"))
    assert type(caught.value) is InputError


@pytest.mark.long
def test_a_stream_whose_actor_dies_goes_on_in_the_same_folder(
    cluster: Any, flown: Path, tmp_path: Path
) -> None:
    """The first alert kills the process of Ray's that holds the actor, the parent of the watch."""
    another(flown, tmp_path / "in" / "one")
    script = (
        'if mkdir "$0"; then kill -9 $(cut -d " " -f 4 /proc/$PPID/stat); else echo $2 >> "$1"; fi'
    )
    alert = f"sh -c {shlex.quote(script)} {tmp_path / 'killed'} {tmp_path / 'alerts'} {{class}}"
    wish = FlightWish(
        Mission.WATCH,
        camera=str(flown / "camera.xml"),
        give_up_s=2.0,
        watch=WatchWish(alert_command=alert),
    )
    report = ended(
        run_streams(
            streams_of([f"north=follow:{tmp_path / 'in' / 'one'}"]),
            tmp_path / "out",
            BatchSettings(wish),
            lambda table: ray_executor("ray", 1, 60.0, table.root),
            threading.Event(),
        )
    )
    (row,) = report.rows
    assert (row.state, row.tries, report.crashes) == (State.DONE, 2, 1)
    assert row.words == "1 car, 1 person found in 4 frames"
    assert [path.name for path in (tmp_path / "out" / "north-watch").iterdir()] == ["one"]


def _hold_a_machine_at_work(cluster: Any, root: Path) -> tuple[Any, list[int]]:
    """Wait for a flight with a journal, and hold all of its machine: no connection breaks, and nothing answers."""
    while True:
        time.sleep(0.02)
        for node in list(cluster.worker_nodes):
            raylet = node.all_processes["raylet"][0].process.pid
            below = descendants({raylet})
            if any(
                list(site.glob("flights/*/run.journal"))
                for pid in below
                for site in written_sites(pid, root)
            ):
                for pid in (held := [raylet, *below]):
                    os.kill(pid, signal.SIGSTOP)
                threading.Timer(
                    200, _let_go, [held]
                ).start()  # a batch that waits for it is to end, too
                return node, held


def _let_go(held: list[int]) -> None:
    for pid in held:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


@pytest.mark.long  # it waits for Ray to count a machine as dead, which takes a minute
def test_a_machine_that_is_cut_off_does_not_hold_up_the_batch(
    cluster: Any, flown: Path, tmp_path: Path
) -> None:
    """As behind a cut cable. What it may still write keeps the flight's next try waiting, until it is gone."""
    for name in ("one", "two", "three"):
        another(flown, tmp_path / "in" / name)
    root, found = tmp_path / "maps", []
    settings = BatchSettings(FlightWish(camera=str(flown / "camera.xml"), model="none"))
    holder = ThreadPoolExecutor(1).submit(_hold_a_machine_at_work, cluster, root)
    for update in run_batch(
        [tmp_path / "in"], root, settings, lambda table: ray_executor("ray", None, 60.0, table.root)
    ):
        if update.row is not None:
            found.append((update.row.state, update.row.words))
        if update.row is not None and "does not answer" in update.row.words:
            _let_go(holder.result()[1])  # it is reached again, and Ray ends it
    assert (State.WAITING, "its machine does not answer any more") in found
    assert sum(state is State.DONE for state, _ in found) == 3
    cluster.remove_node(holder.result()[0], allow_graceful=False)
    cluster.add_node(num_cpus=1)
    assert not list(root.glob(".tmp-*"))


@pytest.mark.long
def test_a_machine_that_dies_loses_nothing(cluster: Any, flown: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        another(flown, tmp_path / "in" / name)
    root = tmp_path / "maps"

    killer = threading.Thread(target=_kill_a_machine_at_work, args=(cluster, root), daemon=True)
    killer.start()
    settings = BatchSettings(FlightWish(camera=str(flown / "camera.xml"), model="none"))
    report = ended(
        run_batch(
            [tmp_path / "in"],
            root,
            settings,
            lambda table: ray_executor("ray", None, 60.0, table.root),
        )
    )
    assert [row.state for row in report.rows] == [State.DONE, State.DONE]
    assert (report.tries, report.crashes) == (3, 1)
    for name in ("one", "two"):
        wanted = tmp_path / "undisturbed" / name
        for _ in map_flights(
            [tmp_path / "in" / name], wanted, MapSettings(model="none"), camera=flown / "camera.xml"
        ):
            pass
        assert content(root / name) == content(wanted)
    # what a machine lacks is no crash of a flight: it would end every one
    order = Order(str(tmp_path / "elsewhere"), str(root / "x"), settings.wish)
    with ray_executor("ray", None, 60.0, root) as executor:
        executor.start(("map", "x"), order, Cost(1.0, 100.0))
        with pytest.raises(StoreError, match=r"^the machine \S+ does not have .*elsewhere"):
            executor.next_ended()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("ray://127.0.0.1", "give ray://HOST:PORT"),
        ("ray://:10001", "give ray://HOST:PORT"),
        ("ray://127.0.0.1:{port}", "no Ray cluster answers at 127.0.0.1:"),
        ("ray", "`ray stop` forgets one that is gone"),
    ],
)
def test_a_cluster_that_is_not_there_is_an_error_within_seconds(
    name: str,
    words: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with socket.socket() as silent:  # its port is taken, and nobody answers
        silent.bind(("127.0.0.1", 0))
        (tmp_path / "in").mkdir()
        (tmp_path / "in" / "1.mp4").write_text("no video")
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{silent.getsockname()[1]}")
        address, started_s = name.format(port=silent.getsockname()[1]), time.monotonic()
        assert (
            main(
                [
                    "batch",
                    str(tmp_path / "in"),
                    "--root",
                    str(tmp_path / "maps"),
                    "--executor",
                    address,
                ]
            )
            == 1
        )
    output = capsys.readouterr().err
    assert f"error: --executor {address}: " in output and words in output
    assert time.monotonic() - started_s < 30


@pytest.mark.long  # it waits for Ray to give up
def test_what_listens_but_is_no_cluster_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        (tmp_path / "1.mp4").write_text("no video")
        address = f"ray://127.0.0.1:{other.getsockname()[1]}"
        assert (
            main(
                [
                    "batch",
                    str(tmp_path / "1.mp4"),
                    "--root",
                    str(tmp_path / "maps"),
                    "--executor",
                    address,
                ]
            )
            == 1
        )
    assert f"{address[6:]} is not a Ray cluster" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            RuntimeError(
                "Version mismatch: The cluster was started with:\n    Ray: 2.59.0\n    Python: 3.11.7"
            ),
            "another version of Ray or Python than this machine; install the same ones on all machines (here Ray 2.60",
        ),
        (
            ConnectionError("ray client connection timeout"),
            "a cluster with a token (set RAY_AUTH_MODE=token",
        ),
        (
            ConnectionError("Initialization failure from server:\nTraceback"),
            "started nothing to serve this batch",
        ),
        (RuntimeError("Invalid authentication token"), "the cluster needs another token"),
    ],
)
def test_what_ray_reports_of_a_cluster_that_takes_no_batch_is_put_in_words(
    error: Exception, words: str
) -> None:
    assert words in why_not("ray://10.0.0.1:10001", error)


def test_a_head_that_has_just_started_is_asked_again_for_a_while(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    failures = [ConnectionError("Initialization failure from server:\nTraceback")] * 2
    asked: list[int] = []

    def connect() -> None:
        asked.append(1)
        if len(asked) <= len(failures):
            raise failures[0]

    monkeypatch.setattr(ray_cluster, "WAITS", replace(WAITS, again_s=0.01))
    ray_cluster._connect_client(connect)
    assert len(asked) == 3
    monkeypatch.setattr(ray_cluster, "WAITS", replace(WAITS, start_s=-1.0))
    asked.clear()
    with pytest.raises(ConnectionError, match="Initialization failure"):
        ray_cluster._connect_client(connect)
    assert len(asked) == 1


def test_without_ray_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with (
        pytest.raises(SettingsError, match=r"pip install 'sorvolo\[fleet\]'"),
        ray_executor("ray", 1, 9.0, tmp_path),
    ):
        pass


def test_a_machine_that_does_not_share_the_disk_is_named(tmp_path: Path) -> None:
    probe = probe_of(str(tmp_path / "word"), "word of the batch")
    assert probe()[2] is False
    (tmp_path / "word").write_text("word of the batch")
    assert probe()[2] is True
    assert (tmp_path / f"word-{socket.gethostname()}").read_text() == "word of the batch"
    with pytest.raises(StoreError, match="does not see the files of this one"):
        _demand_fit(str(tmp_path), "0.1.0")
    (tmp_path / LOCK).touch()
    _demand_fit(str(tmp_path), "0.1.0")


def test_a_machine_with_another_sorvolo_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"the machine far has Sorvolo 0\.0\.9, this one"):
        demand_same("far", "0.0.9")
    with pytest.raises(SettingsError, match="the machine far has no Sorvolo, this one"):
        demand_same("far", "")
    with pytest.raises(
        InputError, match=rf"{os.uname().nodename} has Sorvolo .*, the batch 0\.0\.9"
    ):
        _demand_fit(str(tmp_path), "0.0.9")


def _started(executor: str, flown: Path, folder: Path) -> "subprocess.Popen[str]":
    """A batch of the flight in `folder`, whose first try has begun."""
    another(flown, folder / "in" / "one")
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "sorvolo",
            "batch",
            str(folder / "in"),
            "--root",
            str(folder / "maps"),
            "--camera",
            str(flown / "camera.xml"),
            "--model",
            "none",
            "--executor",
            executor,
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    table, end_s = folder / "maps" / "batch.jsonl", time.monotonic() + 90
    while not (table.exists() and '"running"' in table.read_text()):
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < end_s
        time.sleep(0.02)
    return process


def _held_missions(cluster: Any) -> list[int]:
    """Wait for the processes that do missions on the machines, and hold them."""
    end_s = time.monotonic() + 90
    while time.monotonic() < end_s:
        held = []
        for node in cluster.worker_nodes:
            for pid in descendants({node.all_processes["raylet"][0].process.pid}):
                with suppress(OSError):  # it has ended
                    if b"sorvolo.cluster.worker" in Path(f"/proc/{pid}/cmdline").read_bytes():
                        os.kill(pid, signal.SIGSTOP)
                        held.append(pid)
        if held:
            return held
        time.sleep(0.02)
    raise AssertionError("no mission runs")


@pytest.mark.long
def test_a_head_that_dies_ends_the_batch_and_the_same_command_goes_on(
    cluster: Any, flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # the one machine that is left has one core: the second flight waits for it while the first is held
    executors = {"outside": cluster.client_address, "inside": "ray"}
    batches = {"outside": _started(executors["outside"], flown, tmp_path / "outside")}
    held = _held_missions(cluster)
    batches["inside"] = _started(executors["inside"], flown, tmp_path / "inside")
    for processes in cluster.head_node.all_processes.values():
        for each in processes:
            each.process.kill()
    _let_go(held)
    for name, process in batches.items():
        _, printed = process.communicate(timeout=120)
        assert process.returncode == 1, printed
        (error,) = [line for line in printed.splitlines() if line.startswith("error: ")] or [
            printed
        ]
        assert error.startswith(f"error: --executor {executors[name]}: the cluster is gone ("), (
            printed
        )
        assert error.endswith("; when it is back, the same command goes on")
    # and with another executor as well
    places = [str(tmp_path / "outside" / "in"), "--root", str(tmp_path / "outside" / "maps")]
    assert main(["batch", *places, "--camera", str(flown / "camera.xml"), "--model", "none"]) == 0
    assert (tmp_path / "outside" / "maps" / "one" / "mosaic.tif").is_file()
    capsys.readouterr()
