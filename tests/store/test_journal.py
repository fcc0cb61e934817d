"""A run's journal: what was appended comes back, whatever a kill, a power cut or a stranger did to the file."""

import json
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from sorvolo.store.site.journal import Entry, RunJournal, content_sha256, is_journal_after

_ENTRIES = [
    Entry(
        "a",
        {"x": float("inf"), "y": 1 / 3},
        {"m": np.arange(6.0).reshape(2, 3), "none": np.zeros((0, 2))},
    ),
    Entry("b", {}, {"gray": np.full((3, 4), 200, np.uint8), "ids": np.array([1, -2])}),
    Entry("c", {"words": "Ötztal"}, {"mask": np.arange(35).reshape(5, 7) > 9}, compresses=True),
]


def written(
    path: Path, entries: list[Entry] = _ENTRIES, key: str = "k", after: int = 3
) -> RunJournal:
    journal = RunJournal(path, key, after)
    for each in entries:
        journal.append(each)
    return journal


def kinds(path: Path, key: str = "k", after: int = 3) -> list[str]:
    return [each.kind for each in RunJournal(path, key, after).entries()]


def test_entries_come_back_bit_by_bit(tmp_path: Path) -> None:
    written(tmp_path / "flight" / "j").close()
    for found, wanted in zip(
        RunJournal(tmp_path / "flight" / "j", "k", 3).entries(), _ENTRIES, strict=True
    ):
        assert (found.kind, found.values) == (wanted.kind, wanted.values)
        assert list(found.arrays) == list(wanted.arrays)
        for name, array in wanted.arrays.items():
            assert found.arrays[name].dtype == array.dtype and np.array_equal(
                found.arrays[name], array
            )


def test_one_of_another_run_is_empty_and_written_over(tmp_path: Path) -> None:
    written(tmp_path / "j").close()
    assert kinds(tmp_path / "j", "other") == [] and kinds(tmp_path / "j", after=4) == []
    assert is_journal_after(tmp_path / "j", 3) and not is_journal_after(tmp_path / "j", 4)
    other = RunJournal(tmp_path / "j", "other", 3)
    assert list(other.entries()) == []
    other.append(_ENTRIES[2])
    other.close()
    assert kinds(tmp_path / "j", "other") == ["c"] and kinds(tmp_path / "j") == []


def test_the_disk_has_entries_after_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a power cut may take; to wait for the disk each time would hold up every frame."""
    now_s, synced = [100.0], []
    monkeypatch.setattr("sorvolo.store.site.journal.time.monotonic", lambda: now_s[0])
    monkeypatch.setattr(os, "fdatasync", lambda number: synced.append(os.fstat(number).st_size))
    journal = RunJournal(tmp_path / "run.journal", "a", 0)
    sizes = []
    for step_s in (0.0, 0.4, 0.4, 0.4, 5.0):
        now_s[0] += step_s
        journal.append(Entry("frame", {}))
        sizes.append((tmp_path / "run.journal").stat().st_size)
    assert synced == [sizes[0], sizes[3], sizes[4]]
    journal.remove()


def test_a_torn_entry_is_dropped_and_the_next_takes_its_place(tmp_path: Path) -> None:
    written(tmp_path / "j", _ENTRIES[:2]).close()
    two = (tmp_path / "j").stat().st_size
    written(tmp_path / "whole").close()
    whole = (tmp_path / "whole").read_bytes()
    for end in range(two, len(whole)):
        (tmp_path / "j").write_bytes(whole[:end])
        journal = RunJournal(tmp_path / "j", "k", 3)
        assert [each.kind for each in journal.entries()] == ["a", "b"]
    journal.append(_ENTRIES[0])
    journal.close()
    assert kinds(tmp_path / "j") == ["a", "b", "a"]


def test_an_entry_that_was_not_taken_is_written_over(tmp_path: Path) -> None:
    written(tmp_path / "j").close()
    journal = RunJournal(tmp_path / "j", "k", 3)
    for each in journal.entries():
        if each.kind == "b":
            break
    journal.append(_ENTRIES[2])
    journal.close()
    assert kinds(tmp_path / "j") == ["a", "c"]


def test_a_flipped_bit_ends_it(tmp_path: Path) -> None:
    written(tmp_path / "j").close()
    data = bytearray((tmp_path / "j").read_bytes())
    at = data.index(bytes(_ENTRIES[1].arrays["gray"].data))
    data[at] ^= 1
    (tmp_path / "j").write_bytes(data)
    assert kinds(tmp_path / "j") == ["a"]


def npy(header: str) -> bytes:
    """An array of NumPy's with this header and no content."""
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode()


@pytest.mark.parametrize(
    ("head", "array"),
    [
        (
            ["x", {}, ["m"]],
            npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776,)}"),
        ),
        (["x", {}, ["m"]], npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}")),
        (["x", {}, ["m"]], npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}")),
        (["x", {}, ["m"]], npy("{'descr': '<f8', 'fortran_order': False, 'shape': (2,)}")),
        (["x", {}, ["m"]], npy("{'shape': ((1\n")),
        (["x", {}, ["m"]], npy("__import__('os').abort()")),
        (["x", {}, ["m"]], b""),
        (["x", [], []], b""),
        ([7, {}, []], b""),
        ([], b""),
        ("[" * 100_000, b""),
        (7, b""),
    ],
)
def test_what_no_sorvolo_wrote_ends_it(tmp_path: Path, head: object, array: bytes) -> None:
    written(tmp_path / "j", _ENTRIES[:1]).close()
    text = head.encode() if isinstance(head, str) else json.dumps(head).encode()
    body = zlib.compress(struct.pack("<Q", len(text)) + text + array)
    with (tmp_path / "j").open("ab") as file:
        file.write(struct.pack("<Q", len(body)) + body)
    assert kinds(tmp_path / "j") == ["a"]
    (tmp_path / "j").write_bytes(b"sorvolo journal 2\n" + struct.pack("<Q", 1 << 60))
    assert kinds(tmp_path / "j") == []


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("precious")
    (tmp_path / "j").symlink_to(tmp_path / "victim")
    with pytest.raises(OSError, match="symbolic link"):
        written(tmp_path / "j")
    assert (tmp_path / "victim").read_text() == "precious"


def test_arrays_of_objects_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Object arrays"):
        written(tmp_path / "j", [Entry("a", {}, {"m": np.array([{}])})])


def test_content_is_one_number(tmp_path: Path) -> None:
    first = content_sha256({"b": 1, "a": np.arange(3)}, "x", None, tmp_path)
    assert first == content_sha256({"a": np.arange(3), "b": 1}, "x", None, tmp_path)
    for other in (
        {"a": np.arange(3), "b": 1.0},
        {"a": np.arange(3.0), "b": 1},
        {"a": np.arange(4), "b": 1},
    ):
        assert first != content_sha256(other, "x", None, tmp_path)
    assert content_sha256(["a", ["b"]]) != content_sha256([["a"], "b"])
    with pytest.raises(TypeError, match="content"):
        content_sha256(os)
