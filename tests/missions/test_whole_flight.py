"""Photos that are not found on the map by themselves, placed with all others of their flight."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from small_flights import simulate_into, small_flight
from sorvolo.change.alignment import Aligner, NotAligned
from sorvolo.change.flight_on_map import FlightOnMap
from sorvolo.change.map_search import MapSearch
from sorvolo.errors import InputError
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.evaluate.frame_rows import map_frames
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.simulation.settings import OutputSettings
from sorvolo.store.site.archive import Archive

PLAIN = CompareSettings(model="none")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two flights of photos over the same ground, and the map of the first."""
    settings = small_flight(
        21, speed_m_s=8, length_m=90, height_m=60, size_px=(640, 480), fps=1, cars=4,
        output=OutputSettings(photos=True),
    )
    folder = simulate_into(tmp_path_factory.mktemp("flown"), replace(settings, flights=2))
    for _ in map_flights([folder / "flight1/photos"], folder / "site", MapSettings(model="none")):
        pass
    return folder


def compared(flown: Path, site: Path) -> dict[str, Any]:
    """The report of the second flight, compared in a copy of the site."""
    shutil.copytree(flown / "site", site)
    for _ in compare_flights([flown / "flight2/photos"], site, PLAIN):
        pass
    return dict(json.loads((site / "flights/photos-2/report.json").read_text()))


def outlines_m(site: Path) -> dict[str, np.ndarray]:
    """(4, 2) of each photo of the second flight."""
    with Archive.open(site, write=False) as archive:
        return {each.name: each.outline_m for each in map_frames(site, archive.site())["photos-2"]}


def nowhere(*_: object, **__: object) -> NotAligned:
    return NotAligned("its features are found nowhere in the map where it could be", np.nan)


def test_what_no_photo_shows_by_itself_is_placed_with_its_flight(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = compared(flown, tmp_path / "alone")
    assert alone["comparison"]["with_flight"]["views"] == 0
    monkeypatch.setattr(Aligner, "_by_homographies", nowhere)
    monkeypatch.setattr(MapSearch, "find", lambda *_: None)
    together = compared(flown, tmp_path / "together")
    views = alone["comparison"]["views"]["compared"]
    assert together["comparison"]["views"]["compared"] == together["comparison"]["with_flight"]["views"] == views >= 6
    assert [each["code"] for each in together["notices"]].count("placed_with_flight") == 1
    ours, theirs = outlines_m(tmp_path / "together"), outlines_m(tmp_path / "alone")
    apart_m = [np.linalg.norm(ours[name] - theirs[name], axis=1).max() for name in theirs]
    assert len(apart_m) == views and max(apart_m) < 0.4


def test_where_the_flight_is_not_found_either_nothing_is_compared(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Aligner, "_by_homographies", nowhere)
    monkeypatch.setattr(MapSearch, "find", lambda *_: None)
    monkeypatch.setattr(FlightOnMap, "find", lambda *_: None)
    shutil.copytree(flown / "site", tmp_path / "site")
    with pytest.raises(InputError, match="no frame of photos-2 could be compared: its features are found nowhere"):
        for _ in compare_flights([flown / "flight2/photos"], tmp_path / "site", PLAIN):
            pass
