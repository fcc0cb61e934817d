"""What a batch is made of: flights found, sites chosen, the table, costs, bad input."""

import json
import os
import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from sorvolo.cli.main import main
from sorvolo.cluster.batch import TABLE, BatchRow, BatchTable
from sorvolo.cluster.executors import LocalExecutor, TryEnding, run_order
from sorvolo.cluster.flights import Scouted, find_flights, sites_of
from sorvolo.errors import InputError, StoreError
from sorvolo.missions.worker import Order
from sorvolo.store.exports.detection_files import claimed_folder


def _touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(path.name.encode())


def test_flights_are_videos_and_folders_of_photos_however_deep(tmp_path: Path) -> None:
    _touch(
        tmp_path / "a" / "DJI_1.MP4",
        tmp_path / "a" / "DJI_1.SRT",
        tmp_path / "b" / "deep" / "1.JPG",
        tmp_path / "b" / "deep" / "2.jpg",
        tmp_path / "c" / "alone.jpg",
        tmp_path / "d" / "1.png",
        tmp_path / "d" / "2.png",
        tmp_path / ".hidden" / "x.mp4",
        tmp_path / "site" / "site.db",
        tmp_path / "site" / "flights" / "k" / "v.mp4",
        tmp_path / "maps" / "x" / "y.mp4",
        tmp_path / "a" / "DJI_1.LRV",
    )
    (tmp_path / "e").symlink_to(tmp_path / "a")
    found = find_flights([tmp_path, tmp_path / "b"], tmp_path / "maps")
    flights = [each.path.relative_to(tmp_path).as_posix() for each in found if not each.why_not]
    assert flights == ["a/DJI_1.MP4", "b/deep"]
    assert [each.path.name for each in found if each.why_not] == ["c"]


def test_a_flights_stamp_changes_with_its_files_and_its_telemetry(tmp_path: Path) -> None:
    _touch(tmp_path / "in" / "1.mp4")
    (before,) = find_flights([tmp_path / "in"], tmp_path / "maps")
    _touch(tmp_path / "in" / "1.srt")
    (after,) = find_flights([tmp_path / "in"], tmp_path / "maps")
    assert before.stamp != after.stamp


def test_folders_without_flights_are_an_error(tmp_path: Path) -> None:
    _touch(tmp_path / "in" / "notes.txt", tmp_path / "one" / "alone.jpg")
    with pytest.raises(
        InputError,
        match=r"no flights among 1 file in .*: videos, or folders with two or more photos",
    ):
        find_flights([tmp_path / "one"], tmp_path / "maps")
    with pytest.raises(
        InputError,
        match=r"no flights among 1 file in .*: videos, or folders with two or more photos",
    ):
        find_flights([tmp_path / "in"], tmp_path / "maps")
    with pytest.raises(InputError, match=r"no such folder: .*gone"):
        find_flights([tmp_path / "gone"], tmp_path / "maps")


def test_crops_of_a_watch_are_no_flight(tmp_path: Path) -> None:
    with claimed_folder(tmp_path / "one-watch", "one", "abc"):
        pass
    _touch(*(tmp_path / name / f"{n}.jpg" for name in ("in", "one-watch/objects") for n in (1, 2)))
    found = find_flights([tmp_path], tmp_path / "maps")
    assert [each.path.name for each in found] == ["in"]


def _placed(name: str, hour: int, south: float, west: float) -> tuple[Path, Scouted]:
    box = (south, west, south + 0.001, west + 0.001)
    return Path(f"/flights/{name}.mp4"), Scouted(name, 10, hour * 3_600_000_000_000, box)


def test_by_flight_each_has_a_site_of_its_own_name() -> None:
    one = (Path("/monday/DJI_1.mp4"), Scouted("a", 10, 1, None))
    other = (Path("/tuesday/DJI_1.mp4"), Scouted("b", 10, 2, None))
    third = (Path("/tuesday/DJI_2.mp4"), Scouted("c", 10, 3, None))
    assert sites_of([other, one, third], {}, {}, ["DJI_2"], by_place=False) == {
        "a": "DJI_1",
        "b": "tuesday_DJI_1",
        "c": "tuesday_DJI_2",
    }


def test_by_place_flights_near_each_other_share_the_site_of_the_first() -> None:
    later, first, far = (
        _placed("later", 9, 45.0005, 9.0),
        _placed("first", 8, 45.0, 9.0),
        _placed("far", 7, 45.0, 9.01),
    )
    beside = _placed("beside", 10, 45.0018, 9.0)  # 33 m north of what `later` covers
    nowhere = (Path("/flights/nowhere.mp4"), Scouted("nowhere", 10, 0, None))
    assert sites_of([later, first, far, beside, nowhere], {}, {}, by_place=True) == {
        "nowhere": "nowhere",
        "far": "far",
        "first": "first",
        "later": "first",
        "beside": "first",
    }


def test_by_place_flights_join_sites_that_exist_and_stay_where_they_are() -> None:
    first, later = _placed("first", 8, 45.0, 9.0), _placed("later", 9, 45.0, 9.0)
    assert sites_of([later], {}, {"field": (45.0, 9.0, 45.01, 9.01)}, by_place=True) == {
        "later": "field"
    }
    found = sites_of([first, later], {"first": "its-own"}, {}, by_place=True)
    assert found == {"first": "its-own", "later": "its-own"}


def _row(fingerprint: str, **values: object) -> BatchRow:
    scouted = Scouted(fingerprint, 9, 1, (1.0, 2.0, 3.0, 4.0))
    row = BatchRow(f"/flights/{fingerprint}.mp4", "map", "stamp", "request", scouted)
    return replace(row, **values)  # type: ignore[arg-type]


def test_a_table_holds_the_newest_row_of_each_flight_whatever_was_torn(tmp_path: Path) -> None:
    with BatchTable.open(tmp_path) as table:
        table.put(_row("a"))
        done = table.put(_row("a", state="done", words="8 of 8 frames matched", cpu_s=2.5))
        table.put(_row("b", state="running"))
    with (tmp_path / TABLE).open("ab") as file:
        file.write(b'{"source": "/flights/c.mp4", "mis')
    with BatchTable.open(tmp_path) as table:
        assert table.get(("map", "a")) == done
        assert [row.state for row in table] == ["done", "running"]
    assert len((tmp_path / TABLE).read_bytes().splitlines()) == 3


def test_a_flight_that_can_be_read_now_has_one_row(tmp_path: Path) -> None:
    with BatchTable.open(tmp_path) as table:
        table.put(replace(_row("a"), scouted=None, state="failed"))
        table.put(_row("a"))
    with BatchTable.open(tmp_path) as table:
        assert [row.state for row in table] == ["waiting"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"notes\n", "line 1 is no row of a batch"),
        (b'{"a": 1}\n', "is not a table of sorvolo batch"),
        (b'{"made_by": "sorvolo batch", "format": 2}\n', "has format 2, this version reads 1"),
        (
            b'{"made_by": "sorvolo batch", "format": 1}\n{"source": 1}\n{}\n',
            "line 2 is no row of a batch",
        ),
    ],
)
def test_a_table_of_something_else_is_an_error_and_stays(
    tmp_path: Path, content: bytes, words: str
) -> None:
    (tmp_path / TABLE).write_bytes(content)
    with pytest.raises(StoreError, match=words):
        BatchTable.open(tmp_path)
    assert (tmp_path / TABLE).read_bytes() == content


def test_roots_that_cannot_be_used(tmp_path: Path) -> None:
    _touch(tmp_path / "site" / "site.db", tmp_path / "file")
    with pytest.raises(StoreError, match="is a site itself"):
        BatchTable.open(tmp_path / "site")
    with pytest.raises(StoreError, match="is a file, a folder was needed"):
        BatchTable.open(tmp_path / "file")
    with (
        BatchTable.open(tmp_path / "maps"),
        pytest.raises(StoreError, match=r"another batch is running .*: process"),
    ):
        BatchTable.open(tmp_path / "maps")


def test_the_tries_of_a_flight_add_up() -> None:
    crashed = TryEnding("crashed", "killed", "", 3.0, 2.0, 900.0, "one")
    row = _row("a", tries=1).after(crashed)
    assert (row.state, row.crashes) == ("waiting", 1)
    assert row.after(crashed).state == "set aside"
    row = row.after(TryEnding("done", "fine", "a", 4.0, 3.0, 400.0, "two"))
    assert (row.seconds, row.cpu_s, row.peak_memory_mb, row.host, row.flight) == (
        7.0,
        5.0,
        900.0,
        "two",
        "a",
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--executor", "slurm"], "--executor slurm: give local, ray, or ray://HOST:PORT"),
        (["--workers", "0"], "--workers 0: at least 1 is needed"),
        (["--gsd", "-1"], "--gsd"),
        (["--model", "nosuch"], "nosuch"),
        (["--mission", "watch", "--site-by", "place"], "--mission watch makes no sites"),
        (["--mission", "watch", "--model", "none"], "--mission watch needs a detector"),
        (["--mission", "watch", "--gsd", "0.1"], "--gsd is for maps"),
    ],
)
def test_options_out_of_range(
    tmp_path: Path, options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    _touch(tmp_path / "in" / "1.mp4")
    assert main(["batch", str(tmp_path / "in"), "--root", str(tmp_path / "maps"), *options]) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "maps").exists()


def test_a_batch_of_broken_flights_ends_with_code_1_and_names_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _touch(tmp_path / "in" / "1.mp4")
    assert main(["batch", str(tmp_path / "in"), "--root", str(tmp_path / "maps"), "--json"]) == 1
    output = json.loads(capsys.readouterr().out)
    assert output["counts"] == {"failed": 1}
    assert output["flights"][0]["words"].startswith("1.mp4 cannot be read as a video")


def test_a_process_that_died_before_it_read_its_order_is_a_crash() -> None:
    def strike(process: "subprocess.Popen[bytes]") -> None:
        os.kill(process.pid, signal.SIGSEGV)
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)

    ending = run_order(Order("inspect", "", "nowhere"), started=strike)
    assert (ending.outcome, ending.words) == ("crashed", "its process ended by signal 11")


def test_a_batch_does_not_wait_for_a_process_that_could_not_be_started(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_process(*_: object, **__: object) -> None:
        raise OSError("no process can be started")

    monkeypatch.setattr(subprocess, "Popen", no_process)
    with LocalExecutor(1, 0) as executor:
        executor.start("a", Order("inspect", "", "nowhere"))
        key, ending = executor.next_ended()
    assert (key, ending.outcome) == ("a", "crashed")
    assert "no process can be started" in ending.words
