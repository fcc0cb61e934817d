"""A search measured while the flight goes on: frame by frame, in a thread beside the map, into the same files."""

import json
import shutil
import threading
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from comparing_detector import Comparing

from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.errors import SettingsError, StoreError
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.search import while_flying
from sorvolo.missions.search.earlier import EarlierFlights
from sorvolo.missions.search.flights import search_site
from sorvolo.missions.search.measure import GrowingMeasure, MeasuredFlight, measure_flight
from sorvolo.missions.search.prepare import flights_to_search, prepare_search, search_frames
from sorvolo.missions.search.settings import SearchOutputs, SearchSettings
from sorvolo.missions.search.while_flying import MeasurePace, SearchWhileFlying
from sorvolo.search.cells import cells_of
from sorvolo.search.plant_places import PlantField
from sorvolo.store.site.archive import Archive

_SETTINGS = SearchSettings(plants=30, classes=("car", "person"), sun_deg=(215, 48))
_AT_ONCE = 14  # photos: from 12 on a flight has its height above the ground, and its map begins
_LIVE = LiveSettings(keeps_all=True, give_up_s=60.0, first_s=20.0)


@pytest.fixture
def site(photo_map: Path) -> Path:
    """The photos mapped after their flight."""
    return photo_map


def _chance(flight: MeasuredFlight, label: str) -> float:
    """Its mean over the ground that was seen."""
    (own,) = (each for each in flight.classes if each.label == label)
    return float(np.nanmean(own.chances.mean))


def _returned(work: Generator[object, None, MeasuredFlight]) -> MeasuredFlight:
    while True:
        try:
            next(work)
        except StopIteration as end:
            return end.value


def test_frame_by_frame_comes_to_what_the_whole_flight_comes_to(site: Path) -> None:
    with Archive.open(site, write=False) as archive:
        (name,) = flights_to_search(archive, ())
        frames, place = search_frames(archive, name)[::2], archive.site()
        growing = GrowingMeasure(
            name, place, Comparing(site), _SETTINGS, area_m=None, keep_off_m=[], above=None
        )
        planted = []
        for number, frame in enumerate(frames):
            growing.add(frame)
            if number % 5 == 0 or frame is frames[-1]:
                cells, flight = growing.measured()
                planted.append([len(each.outcomes) for each in flight.classes])
                assert len(flight.classes[0].chances.mean) == len(cells)
        whole = cells_of([each.placed.outline_m for each in frames], place, None)
        measuring = measure_flight(name, frames, whole, place, Comparing(site), _SETTINGS, [])
        at_once = _returned(measuring)
    assert (np.diff(planted, axis=0) >= 0).all()
    assert planted[-1][0] >= 4 and planted[-1][1] >= 2 * planted[0][1] > 8
    for measured in flight.classes:  # of a few plants one more that is found moves the chance
        near = max(0.15, 1.5 / len(measured.outcomes))
        assert _chance(flight, measured.label) == pytest.approx(
            _chance(at_once, measured.label), abs=near
        )


def test_a_blind_detector_is_known_as_such_while_it_flies(site: Path) -> None:
    with Archive.open(site, write=False) as archive:
        (name,) = flights_to_search(archive, ())
        growing = GrowingMeasure(
            name,
            archive.site(),
            Comparing(site, sees=False),
            _SETTINGS,
            area_m=None,
            keep_off_m=[],
            above=None,
        )
        for frame in search_frames(archive, name)[:4]:
            growing.add(frame)
        _, flight = growing.measured()
    assert (
        all(not each.outcomes.found.any() for each in flight.classes)
        and _chance(flight, "person") < 0.25
    )


def test_a_field_is_the_same_from_wherever_it_is_come_to() -> None:
    ground = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 40.0], [0.0, 40.0]])

    def sown(*corners_m: tuple[float, float]) -> dict[tuple[float, float], str]:
        field = PlantField(
            ("person", "car"), ground, keep_off_m=[np.array([30.0, 20.0])], free_m=4.0, seed=5
        )
        for corner_m in corners_m:
            field.near(ground + corner_m, 5.0)
        return {tuple(each.place_m): each.label for each in field.places}  # type: ignore[misc]

    one, other = sown((0, 0), (-50, 30)), sown((-50, 30), (0, 0))
    assert one == other and {*one.values()} == {"person", "car"}
    places_m = np.array([*one])
    apart_m = np.linalg.norm(places_m[:, None] - places_m, axis=2) + 1e9 * np.eye(len(places_m))
    assert apart_m.min() >= 4.0 and np.linalg.norm(places_m - (30, 20), axis=1).min() >= 3.0
    cars_m = places_m[[label == "car" for label in one.values()]]
    assert len(cars_m) > 5
    assert (
        np.linalg.norm(cars_m[:, None] - cars_m, axis=2) + 1e9 * np.eye(len(cars_m))
    ).min() >= 10.0


def test_a_flight_that_climbs_is_sown_anew(site: Path) -> None:
    """What was measured from below would crowd the pictures from above."""
    with Archive.open(site, write=False) as archive:
        (name,) = flights_to_search(archive, ())
        frames, place = search_frames(archive, name)[:3], archive.site()
    growing = GrowingMeasure(
        name, place, Comparing(site), _SETTINGS, area_m=None, keep_off_m=[], above=None
    )
    field = PlantField(
        ("person", "car"), frames[0].placed.outline_m / 10, keep_off_m=[], free_m=4.0, seed=1
    )
    small = PlantField(
        ("person", "car"),
        frames[0].placed.outline_m / 10,
        keep_off_m=[],
        free_m=4.0,
        seed=1,
        square_m=0.5,
    )
    assert field.fits(frames[0].placed.outline_m) and not small.fits(frames[0].placed.outline_m)
    growing.add(frames[0])
    growing._field = small
    growing.add(frames[1])
    growing.add(frames[2])
    _, flight = growing.measured()
    assert flight.frames == 2 and growing.frames == frames[1:]


class Arriving:
    """Photos that come into a folder: as many at once as a map needs to begin, the next as soon as the search has
    written something, or after `most_s`."""

    def __init__(self, photos: Path, folder: Path, most_s: float) -> None:
        self._photos, self._folder, self._most_s = sorted(photos.iterdir())[:20], folder, most_s
        folder.mkdir()
        for each in self._photos[:_AT_ONCE]:
            self._bring(each)
        self.landed = threading.Event()
        self.reports: list[Mapping[str, Any]] = []

    def fly(
        self, flying: SearchWhileFlying, report: Path, over: threading.Event
    ) -> threading.Thread:
        """Bring the others in a thread, and keep each report that the search writes meanwhile; land when it is
        `over`."""

        def bring() -> None:
            for each in [*self._photos[_AT_ONCE:], None]:
                _wait(lambda: flying.written > len(self.reports), self._most_s)
                if flying.written > len(self.reports):
                    self.reports.append(json.loads(report.read_bytes()))
                if each is not None:
                    self._bring(each)
            over.wait(60.0)
            self.landed.set()

        thread = threading.Thread(target=bring)
        thread.start()
        return thread

    def _bring(self, photo: Path) -> None:
        part = self._folder / f".{photo.name}"
        shutil.copy(photo, part)
        part.rename(self._folder / photo.name)


def _wait(holds: Any, most_s: float) -> None:
    pause = threading.Event()
    for _ in range(int(most_s / 0.05)):
        if holds():
            return
        pause.wait(0.05)


def _flown(
    photos: Path,
    camera: Path,
    folder: Path,
    flying: SearchWhileFlying,
    most_s: float = 60.0,
    over: threading.Event | None = None,
) -> Sequence[Mapping[str, Any]]:
    arriving = Arriving(photos, folder / "in", most_s)
    if over is None:
        over = threading.Event()
        over.set()
    thread = arriving.fly(flying, folder / "out" / "search.json", over)
    for _ in map_flights(
        [f"follow:{folder / 'in'}"],
        folder / "site",
        MapSettings(model="none", live_s=0.2),
        camera=camera,
        live=_LIVE,
        until=arriving.landed,
        search=flying,
    ):
        pass
    thread.join()
    return arriving.reports


@pytest.fixture
def threads() -> Iterator[None]:
    """No thread of a search outlives its flight."""
    yield
    assert not [each for each in threading.enumerate() if each.name == "search"]


@pytest.mark.usefixtures("threads")
def test_files_and_waypoints_follow_the_flight(
    photographed: Path, site: Path, tmp_path: Path
) -> None:
    refly = tmp_path / "holes.kml"
    outputs = SearchOutputs(tmp_path / "out", area=_area(site, tmp_path), refly=(refly,))
    flying = SearchWhileFlying(
        _SETTINGS, outputs, Comparing(site), MeasurePace(again_s=0.0, rest=0.0, look_s=0.02)
    )
    reports = _flown(
        photographed / "flight1" / "photos", photographed / "camera.xml", tmp_path, flying
    )
    assert len(reports) >= 2
    for each in reports:
        assert 1 <= each["so_far"]["measured"] <= each["so_far"]["placed"]
        assert each["headline"]["text"].startswith(f"so far, by {each['so_far']['measured']} of ")
        assert (
            "of the flight in alone" in each["headline"]["text"]
            and each["so_far"]["state"] == "flying"
        )
        assert not each["headline"]["complete"] and "not seen" in each["headline"]["text"]
    seen_m2 = [each["classes"]["car"]["seen_m2"] for each in reports]
    assert seen_m2 == sorted(seen_m2) and seen_m2[-1] > seen_m2[0] > 0
    page = (tmp_path / "out" / "search.html").read_text()
    assert "The flight has landed" in page and 'http-equiv="refresh"' in page
    assert f"As of {reports[-1]['so_far']['as_of'][:10]}" in page
    assert refly.is_file() and (tmp_path / "out" / "pod.tif").is_file()


def test_a_flight_that_an_earlier_search_measured_counts_once_it_was_looked_at(
    site: Path, tmp_path: Path
) -> None:
    """What it states of its ground is what the search itself stated, over other cells too."""
    settings, outputs = replace(_SETTINGS, plants=10), SearchOutputs(tmp_path / "out")
    whole = search_site(site, settings, outputs, Comparing(site)).result().report
    prepared = prepare_search(settings, outputs, Comparing(site))
    with Archive.open(site, write=False) as archive:
        (name,) = flights_to_search(archive, ())
        earlier = EarlierFlights(
            archive, "other", prepared, replace(settings, plants=90, seed=7), outputs
        )
        for _ in search_frames(archive, name):
            assert not earlier.frames and earlier.uncounted_m and earlier.look()
        assert not earlier.look()
        frames_m = [each.placed.outline_m for each in earlier.frames[name]]
        (flight,) = earlier.on(cells_of(frames_m, archive.site(), None))
        (beside,) = earlier.on(
            cells_of([each + np.array([25.0, 0.0]) for each in frames_m], archive.site(), None)
        )
        blind = EarlierFlights(
            archive, "other", prepared, replace(settings, sun_deg=(200.0, 30.0)), outputs
        )
        assert (
            not blind.look() and len(blind.uncounted_m) == len(frames_m) and not earlier.uncounted_m
        )
    for own, other in zip(flight.classes, beside.classes, strict=True):
        row = whole["classes"][own.label]
        assert float(np.nansum(own.chances.mean)) == pytest.approx(row["swept_m2"], rel=0.02)
        assert 0.3 * row["swept_m2"] < float(np.nansum(other.chances.mean)) < 0.9 * row["swept_m2"]
        assert own.seen.seen.sum() > other.seen.seen.sum() > 0


@pytest.mark.usefixtures("threads")
@pytest.mark.long
def test_a_flight_that_is_stopped_leaves_no_waypoints(
    photographed: Path, site: Path, tmp_path: Path
) -> None:
    """And a page that states it, not one that is loaded anew for ever. A flight before it counts as well."""
    refly = tmp_path / "holes.kml"
    outputs = SearchOutputs(tmp_path / "out", area=_area(site, tmp_path), refly=(refly,))
    shutil.copytree(site, tmp_path / "site")
    settings, pace = (
        replace(_SETTINGS, plants=10),
        MeasurePace(again_s=0.0, rest=0.0, look_s=0.02, earlier=99),
    )
    whole = search_site(tmp_path / "site", settings, outputs, Comparing(site)).result().report
    flying = SearchWhileFlying(settings, outputs, Comparing(site), pace)
    photos = Arriving(photographed / "flight1" / "photos", tmp_path / "in", 0.0)
    over = threading.Event()
    thread = photos.fly(flying, tmp_path / "out" / "search.json", over)
    updates = map_flights(
        [f"follow:{tmp_path / 'in'}"],
        tmp_path / "site",
        MapSettings(model="none", live_s=0.2),
        camera=photographed / "camera.xml",
        live=_LIVE,
        until=photos.landed,
        search=flying,
    )
    refly.write_text("of an earlier search")
    next(updates)
    assert "Waiting for the first pictures" in (tmp_path / "out" / "search.html").read_text()
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"search.html", "plants.geojson"}
    assert not refly.exists()
    for _ in updates:
        _wait(lambda: flying.written > 0, 3.0 if flying.placed else 0.0)
        if flying.written:
            assert refly.is_file()
            break
    updates.cancel()
    over.set()
    thread.join()
    page = (tmp_path / "out" / "search.html").read_text()
    assert "when the flight was stopped" in page and "refresh" not in page and not refly.exists()
    assert (
        "of the flight in and 1 flight before it" in page
        and "no waypoints were written" not in page
    )
    assert "the flight was stopped, and its waypoints were taken away" in page
    report = json.loads((tmp_path / "out" / "search.json").read_bytes())
    assert report["so_far"]["earlier"] == ["photos"] and isinstance(whole, dict)
    assert [(each["name"], each["measured_before"]) for each in report["flights"]] == [
        ("photos", True),
        ("in", False),
    ]
    for label in ("car", "person"):
        before, now = whole["classes"][label], report["classes"][label]
        assert now["seen_m2"] >= 0.97 * before["seen_m2"] and now["pod"] > 0.97 * before["pod"]
        assert now["swept_m2"] > before["swept_m2"]


@pytest.mark.usefixtures("threads")
def test_a_fault_of_the_measure_does_not_end_the_map(
    photographed: Path, site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = threading.Event()

    def full(*_: Any, **__: Any) -> None:
        failed.set()
        raise StoreError("disk full")

    monkeypatch.setattr(while_flying, "write_search", full)
    outputs = SearchOutputs(tmp_path / "out")
    flying = SearchWhileFlying(
        _SETTINGS, outputs, Comparing(site), MeasurePace(again_s=0.0, rest=0.0, look_s=0.02)
    )
    with pytest.warns(match="not measured whole while the flight goes on: disk full"):
        _flown(
            photographed / "flight1" / "photos",
            photographed / "camera.xml",
            tmp_path,
            flying,
            0.0,
            failed,
        )
    assert flying.written == 0
    with Archive.open(tmp_path / "site", write=False) as archive:
        assert archive.keyframes()


def test_what_cannot_be_used_is_refused_before_the_flight(site: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="giraffe"):
        SearchWhileFlying(
            SearchSettings(classes=("giraffe",)), SearchOutputs(tmp_path / "out"), Comparing(site)
        )


def _area(site: Path, folder: Path) -> Path:
    """An area twice as long as what is flown."""
    with Archive.open(site, write=False) as archive:
        frame = archive.site().frame
        (name,) = flights_to_search(archive, ())
        outlines_m = np.concatenate(
            [each.placed.outline_m for each in search_frames(archive, name)]
        )
    (west, south), (east, north) = outlines_m.min(axis=0), outlines_m.max(axis=0)
    ring_m = [
        (west, south),
        (2 * east - west, south),
        (2 * east - west, north),
        (west, north),
        (west, south),
    ]
    latitudes_deg, longitudes_deg, _ = frame.wgs84_from_site(
        np.array([(x, y, 0.0) for x, y in ring_m])
    )
    ring = np.column_stack([longitudes_deg, latitudes_deg]).tolist()
    path = folder / "area.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    return path
