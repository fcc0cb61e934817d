"""What a run puts aside is there again, and leaves nothing behind."""

from pathlib import Path

import pytest

from sorvolo.errors import StoreError
from sorvolo.store.site.spill import SpillFile


def test_bytes_come_back_in_any_order_and_no_file_stays(tmp_path: Path) -> None:
    spill = SpillFile(tmp_path)
    for key in range(20):
        spill.put(key, bytes([key]) * (key * 1000))
    assert all(spill.get(key) == bytes([key]) * (key * 1000) for key in (19, 0, 7, 7))
    spill.put(20, b"last")
    assert spill.get(20) == b"last"
    with pytest.raises(KeyError):
        spill.get(21)
    assert list(tmp_path.iterdir()) == []  # a kill leaves nothing either
    spill.close()


def test_a_folder_that_cannot_be_written_is_one_clear_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(**_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sorvolo.store.site.spill.tempfile.TemporaryFile", full)
    with pytest.raises(StoreError, match="disk full"):
        SpillFile(tmp_path).put(0, b"x")
