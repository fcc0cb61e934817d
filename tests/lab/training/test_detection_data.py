"""Which labelled pictures may be learnt from (`benchmarks/detection_data.py`)."""

import importlib
from pathlib import Path

import pytest
from square_pictures import labelled_squares

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"


def test_only_the_publishers_own_cars_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another's video is under another licence."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    place = labelled_squares(tmp_path / "aerial_cars", 1, 5)
    names = ("DJI_0005-0018", "harlem-0005", "DJI-007-01", "M", "DJI_0762-1")
    for number, name in enumerate(names):
        for part, end in (("images", ".png"), ("labels", ".txt")):
            (place / part / f"flight0_{number:04d}{end}").rename(place / part / f"{name}{end}")
    parts = importlib.import_module("detection_data").aerial_cars(tmp_path)
    read = {
        part: [Path(picture.path).stem for picture in labelled.pictures]
        for part, labelled in parts.items()
    }
    assert read == {"train": ["DJI-007-01", "DJI_0005-0018"], "val": [], "test": ["DJI_0762-1"]}
