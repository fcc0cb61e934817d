"""Tracks held against the truth: counted once, twice, missed or false (`benchmarks/watch_counts_detector.py`)."""

import importlib
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def test_tracks_are_of_the_object_that_most_of_their_boxes_lie_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    benchmark = importlib.import_module("watch_counts_detector")
    box, aside = np.array([0.0, 0.0, 10.0, 20.0]), np.array([500.0, 500.0, 540.0, 560.0])
    places = {1: box, 2: box + 100, 3: box + 200, 4: box + 300}
    frames = range(12)
    truth = benchmark.Truth(
        {1: "person", 2: "person", 3: "car", 4: "car"},
        {1: False, 2: False, 3: True, 4: False},
        {frame: places for frame in frames},
        {1: [0, 1, 2, 30, 31], 2: frames, 3: frames, 4: [0, 1]},
        {frame: aside[None] for frame in frames},
        least=5,
    )
    # of each track its class and where its boxes lie: the first person twice, a driving car, one of another class
    # than the object's, one that is mostly beside everything, and one in a region that is not judged
    tracks = {
        1: ("person", [places[1]] * 4),
        2: ("person", [places[1]] * 3),
        3: ("car", [places[3] + 1] * 5),
        4: ("car", [places[2]] * 3),
        5: ("person", [places[2], box + 400, box + 400]),
        6: ("person", [aside + 2] * 3),
    }
    rows = [
        {"track": each, "frame": str(frame), "box_px": list(place)}
        for each, (_, seen) in tracks.items()
        for frame, place in enumerate(seen)
    ]
    rows.append({"track": None, "frame": "0", "box_px": list(places[2])})
    found = benchmark.compared(
        [{"id": each, "class": label} for each, (label, _) in tracks.items()], rows, truth
    )
    assert found["person"] == {
        "true": 2,
        "found": 1,
        "missed": 1,
        "twice": 1,
        "appearances": 3,
        "false": 1,
        "counted": 3,
    }
    assert found["car"] == {
        "true": 1,
        "found": 1,
        "missed": 0,
        "twice": 0,
        "appearances": 1,
        "false": 1,
        "counted": 2,
    }
    # two who cross, and their tracks change: the count is right
    rows = [
        {
            "track": 1 + number,
            "frame": str(frame),
            "box_px": list(places[1 + (number + (frame > 8)) % 2]),
        }
        for number in range(2)
        for frame in frames
    ]
    crossed = benchmark.compared(
        [{"id": 1, "class": "person"}, {"id": 2, "class": "person"}], rows, truth
    )
    assert [crossed["person"][key] for key in ("true", "found", "twice", "false")] == [2, 2, 0, 0]
    assert found["moving car"] == {"true": 1, "found": 1, "missed": 0, "twice": 0, "appearances": 1}
