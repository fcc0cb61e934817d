"""Photos that are not found on the map by themselves, placed with all others of their flight."""

import json
import shutil
from collections.abc import Sequence
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
from sorvolo.lab.evaluation.frame_rows import map_frames
from sorvolo.lab.simulation.settings import OutputSettings
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import CompareUpdate, ViewStatus
from sorvolo.survey.mosaic import FrameRow


class Flown:
    """Two flights over the same ground, the map of the first, and what the second is compared by."""

    def __init__(self, folder: Path, *, photos: bool) -> None:
        settings = small_flight(
            21,
            speed_m_s=8,
            length_m=64,
            height_m=60,
            size_px=(400, 300),
            fps=1 if photos else 3,
            cars=4,
            output=OutputSettings(photos=photos),
        )
        simulate_into(folder, replace(settings, flights=2))
        first, self._second = (
            folder / (f"flight{number}/photos" if photos else f"flight{number}/flight{number}.mp4")
            for number in (1, 2)
        )
        self._site = folder / "site"
        for _ in map_flights([first], self._site, MapSettings(model="none")):
            pass
        self.is_video = not photos

    def compare(self, site: Path) -> Sequence[CompareUpdate]:
        """Compare the second flight in a copy of the site."""
        shutil.copytree(self._site, site)
        return list(compare_flights([self._second], site, CompareSettings(model="none")))


@pytest.fixture(scope="module", params=["photos", pytest.param("video", marks=pytest.mark.long)])
def flown(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return Flown(tmp_path_factory.mktemp("flown"), photos=request.param == "photos")


def report_of(site: Path) -> dict[str, Any]:
    """That of the second flight."""
    (path,) = (site / "flights").glob("*2/report.json")
    return dict(json.loads(path.read_text()))


def frames_of(site: Path) -> dict[str, FrameRow]:
    """Those of the second flight that were placed, by name."""
    with Archive.open(site, write=False) as archive:
        flights = map_frames(site, archive.site())
    (rows,) = (rows for name, rows in flights.items() if name.endswith("2"))
    return {each.name: each for each in rows if each.status != "rejected"}


def nowhere(*_: object, **__: object) -> NotAligned:
    return NotAligned("its features are found nowhere in the map where it could be", np.nan)


def test_what_no_picture_shows_by_itself_is_placed_with_its_flight(
    flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(FlightOnMap, "find", lambda *_: None)
        flown.compare(tmp_path / "alone")
    monkeypatch.setattr(Aligner, "_by_homographies", nowhere)
    monkeypatch.setattr(MapSearch, "find", lambda *_: None)
    everything = flown.compare(tmp_path / "together")
    updates = [each for each in everything if not each.comes_again]
    together = report_of(tmp_path / "together")
    left_out = {each.frame_name for each in everything} - {each.frame_name for each in updates}
    assert len(left_out) == together["comparison"]["with_flight"]["left_out"]
    assert bool(left_out) == flown.is_video
    assert len({each.frame_name for each in updates}) == len(updates), "each frame ends once"
    views = together["comparison"]["views"]["compared"]
    assert (
        views
        == together["comparison"]["with_flight"]["views"]
        == sum(each.status is ViewStatus.COMPARED for each in updates)
    )
    assert [
        each["count"] for each in together["notices"] if each["code"] == "placed_with_flight"
    ] == [views]
    ours, theirs = frames_of(tmp_path / "together"), frames_of(tmp_path / "alone")
    apart_m = [
        np.linalg.norm(ours[name].outline_m - theirs[name].outline_m, axis=1).mean()
        for name in ours
    ]
    assert views == len(ours) >= 2 and max(apart_m) < 0.4, (
        "photos where the strip is bent are left to the search"
    )


def test_where_the_flight_is_not_found_either_nothing_is_compared(
    flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Aligner, "_by_homographies", nowhere)
    monkeypatch.setattr(MapSearch, "find", lambda *_: None)
    monkeypatch.setattr(FlightOnMap, "find", lambda *_: None)
    with pytest.raises(InputError, match="2 could be compared: its features are found nowhere"):
        flown.compare(tmp_path / "site")
