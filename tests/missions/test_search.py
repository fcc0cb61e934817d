"""Searches through whole missions: a small flight mapped, things planted into its frames, what a map would report."""

import json
import re
from dataclasses import asdict, replace
from pathlib import Path
from shutil import copy, copytree
from typing import Any

import numpy as np
import pytest
import rasterio
from comparing_detector import Comparing
from PIL import Image

from sorvolo.capture.areas import read_segments
from sorvolo.cli.main import main
from sorvolo.errors import InputError, SettingsError
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.search.earlier import Basis, read_plants
from sorvolo.missions.search.flights import search_site
from sorvolo.missions.search.settings import SearchOutputs, SearchSettings
from sorvolo.store.exports.plain import plain_json
from sorvolo.store.site.archive import Archive

_CARS = SearchSettings(plants=20, classes=("car",), sun_deg=(215, 48))


@pytest.fixture
def site(photo_map: Path) -> Path:
    """The photos mapped after their flight."""
    return photo_map


def _report(
    site: Path, folder: Path, detector: Any, settings: SearchSettings, **outputs: Any
) -> dict[str, Any]:
    outcome = search_site(site, settings, SearchOutputs(folder, **outputs), detector).result()
    assert outcome.folder == folder and outcome.report["warnings"] == list(outcome.warnings)
    assert outcome.headline == outcome.report["headline"]["text"]
    assert outcome.trusted is outcome.report["headline"]["complete"]
    for label, row in outcome.report["classes"].items():
        stated = {**asdict(outcome.figures[label]), "holes_m2": outcome.holes_m2[label]}
        assert plain_json(stated) == row
    return dict(outcome.report)


@pytest.fixture(scope="module")
def searched(
    photo_map: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any]]:
    """The files and the report of a search for cars by a detector that sees all."""
    out = tmp_path_factory.mktemp("searched") / "out"
    return out, _report(photo_map, out, Comparing(photo_map), _CARS)


def test_a_detector_that_sees_all_gives_high_chances_and_the_files_agree(
    searched: tuple[Path, dict[str, Any]],
) -> None:
    out, report = searched
    row = report["classes"]["car"]
    planted = report["flights"][0]["classes"]["car"]
    assert planted["planted"] >= 8 and planted["found"] >= 0.75 * planted["planted"]
    with rasterio.open(out / "pod.tif") as file:
        assert file.descriptions == ("car: pod", "car: low", "car: high")
        pod, low, high = file.read()
        seen = np.isfinite(pod)
        assert (low[seen] <= pod[seen] + 1e-6).all() and (pod[seen] <= high[seen] + 1e-6).all()
        assert file.crs is not None and np.isnan(file.nodata)
        assert seen.sum() * file.res[0] ** 2 >= row["seen_m2"] - 1
    features = json.loads((out / "pod.geojson").read_text())["features"]
    area_m2 = sum(
        each["properties"]["area_m2"] for each in features if each["properties"]["kind"] == "pod"
    )
    assert area_m2 == pytest.approx(row["seen_m2"], rel=0.02)
    assert "probability of detection" in (out / "search.html").read_text()
    headline = report["headline"]
    assert headline["text"].startswith("probability of detection of a car")
    assert not headline["complete"]  # its map was made without a model
    assert "; nobody has looked for a car in photos: " in headline["text"]


def test_a_blind_detector_finds_nothing_and_the_headline_reports_it(
    site: Path, tmp_path: Path
) -> None:
    settings = SearchSettings(plants=12, classes=("car",), sun_deg=(215, 48))
    report = _report(site, tmp_path / "out", Comparing(site, sees=False), settings)
    assert report["flights"][0]["classes"]["car"]["found"] == 0
    assert report["classes"]["car"]["pod"] < 0.25 and not report["headline"]["complete"]
    assert sum(report["classes"]["car"]["holes_m2"].values()) == pytest.approx(
        report["classes"]["car"]["area_m2"]
    )


def test_a_flight_without_a_place_is_left_out_and_named(
    site: Path, photographed: Path, tmp_path: Path
) -> None:
    """Its key frames are gone: the other flight is measured all the same."""
    both, photos = tmp_path / "site", tmp_path / "later"
    copytree(site, both)
    photos.mkdir()
    for each in sorted((photographed / "flight1" / "photos").glob("*.jpg"))[:7]:
        copy(each, photos)
    settings = MapSettings(model="none")
    map_flights([photos], both, settings, camera=photographed / "camera.xml").result()
    for each in both.rglob("flights/later/**/*.*p*g"):
        each.unlink()
    with pytest.warns(match="gone"):
        report = _report(both, tmp_path / "out", Comparing(site), replace(_CARS, plants=10))
    assert [each["name"] for each in report["flights"]] == ["photos"]
    assert "; no frame of later has a place" in report["headline"]["text"]
    assert not report["headline"]["complete"]
    with pytest.raises(InputError, match="no mapped flight with a place"), pytest.warns():
        _report(both, tmp_path / "none", Comparing(site), _CARS, flights=("later",))


def _triangles(site: Path, path: Path, *away_deg: float, swapped: bool = False) -> Path:
    """An area of triangles of some 200 m, so far north of the site each; latitude comes first where `swapped`.

    The first of several is a square around the site.
    """
    with Archive.open(site, write=False) as archive:
        origin = archive.site().origin
    west, south = origin.longitude_deg - 1e-3, origin.latitude_deg - 1e-3
    around = [
        [west, south],
        [west + 2e-3, south],
        [west + 2e-3, south + 2e-3],
        [west, south + 2e-3],
        [west, south],
    ]
    polygons = [] if len(away_deg) < 2 else [[around]]
    for each in away_deg[len(polygons) :]:
        south, west = origin.latitude_deg + each, origin.longitude_deg
        ring = [[west, south], [west + 0.002, south], [west + 0.002, south + 0.002], [west, south]]
        polygons.append([[place[::-1] if swapped else place for place in ring]])
    path.write_text(json.dumps({"type": "MultiPolygon", "coordinates": polygons}))
    return path


def test_an_area_that_no_drone_reaches_is_refused(site: Path, tmp_path: Path) -> None:
    """Of another search, with a stray polygon, or with latitude before longitude: never an area without holes."""
    settings = SearchSettings(plants=10, classes=("car",), sun_deg=(215, 48))
    for far, words in (
        ((0.27,), "the area begins 30 km"),
        ((0.0, 3.0), "polygon 2 of the area begins 33. km"),
    ):
        area = _triangles(site, tmp_path / "area.geojson", *far)
        with pytest.raises(InputError, match=words):
            _report(site, tmp_path / "out", Comparing(site), settings, area=area)
    area = _triangles(site, tmp_path / "area.geojson", 0.0, swapped=True)
    with pytest.raises(InputError, match="longitude before latitude"):
        _report(site, tmp_path / "out", Comparing(site), settings, area=area)
    assert not (tmp_path / "out").exists()


def test_an_area_elsewhere_is_asked_about(site: Path, tmp_path: Path) -> None:
    area = _triangles(site, tmp_path / "area.geojson", 0.09)
    settings = SearchSettings(plants=10, classes=("car",), sun_deg=(215, 48))
    report = _report(site, tmp_path / "out", Comparing(site), settings, area=area)
    assert any(
        "begins 10.0 km" in each and "is it the right --area" in each for each in report["warnings"]
    )
    assert not any("plants" in each for each in report["warnings"])
    assert (
        report["headline"]["hole_share"] == pytest.approx(1)
        and report["classes"]["car"]["pod"] == 0
    )


def test_ground_beyond_the_flight_is_a_hole_not_seen_and_is_flown_again(
    site: Path, tmp_path: Path
) -> None:
    with Archive.open(site, write=False) as archive:
        origin = archive.site().origin
    d_lat, d_lon = 25 / 111_000, 60 / 111_000 / np.cos(np.radians(origin.latitude_deg))
    west, east = origin.longitude_deg - 0.4 * d_lon, origin.longitude_deg + 2 * d_lon
    south, north = origin.latitude_deg - d_lat, origin.latitude_deg + d_lat
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    segments = tmp_path / "segments.geojson"
    segments.write_text(
        json.dumps(
            {
                "type": "FeatureCollection",
                "features": [
                    {
                        "type": "Feature",
                        "properties": {"name": "all", "poa": 0.9},
                        "geometry": {"type": "Polygon", "coordinates": [ring]},
                    }
                ],
            }
        )
    )
    report = _report(
        site,
        tmp_path / "out",
        Comparing(site),
        SearchSettings(plants=20, classes=("car",), sun_deg=(215, 48)),
        area=segments,
        poa=segments,
        refly=(tmp_path / "holes.kml", tmp_path / "holes.plan"),
    )
    row = report["classes"]["car"]
    assert row["area_m2"] == pytest.approx(2.4 * 60 * 50, rel=0.05)
    assert row["holes_m2"]["not seen"] > 0.4 * row["area_m2"] and not report["headline"]["complete"]
    assert "not seen" in report["headline"]["text"]
    (whole,) = report["segments"]
    assert whole["pod"] == pytest.approx(row["pod"], abs=0.03) and whole["pos"] == pytest.approx(
        0.9 * whole["pod"]
    )
    assert report["refly"]["area_m2"] > 0.4 * row["area_m2"]
    assert (tmp_path / "holes.kml").stat().st_size > 300 and (tmp_path / "holes.plan").is_file()


def test_a_sweep_width_is_the_flights_and_not_the_areas(
    site: Path, searched: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    """Over a corner of what was flown it is as wide as over all; and nothing to fly is stated, old waypoints go."""
    (out, whole), old = searched, tmp_path / "old.kml"
    with Archive.open(site, write=False) as archive:
        origin = archive.site().origin
    west, south = origin.longitude_deg, origin.latitude_deg
    ring = [[west, south], [west + 5e-5, south], [west + 5e-5, south + 5e-5], [west, south]]
    area = tmp_path / "area.geojson"
    area.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    old.write_text("of an earlier search")
    part = _report(site, tmp_path / "part", Comparing(site), _CARS, area=area, refly=(old,))
    one, other = whole["classes"]["car"], part["classes"]["car"]
    assert other["area_m2"] < 0.05 * one["area_m2"]
    assert other["sweep_width_m"] == pytest.approx(one["sweep_width_m"], rel=0.3)
    assert not old.exists() and "no waypoints were written" in part["warnings"][0]
    assert (
        str(old) in part["warnings"][0] and "Found over stated" in (out / "search.html").read_text()
    )


@pytest.mark.parametrize("name", ["area.geojson", "out/pod.geojson", "out/plants.geojson"])
def test_waypoints_never_take_the_place_of_an_input_or_a_result(
    site: Path, tmp_path: Path, name: str
) -> None:
    area = _triangles(site, tmp_path / "area.geojson", 0.0)
    (tmp_path / "out").mkdir()
    outputs = SearchOutputs(tmp_path / "out", area=area, refly=(tmp_path / name,))
    with pytest.raises(SettingsError, match="another name"):
        next(search_site(site, SearchSettings(), outputs, Comparing(site)))
    assert area.stat().st_size > 100


class Counting(Comparing):
    """Counts the pictures that it is shown."""

    shown = 0

    def detect(self, *args: Any, **wishes: Any) -> Any:
        self.shown += 1
        return super().detect(*args, **wishes)


def test_a_flight_is_searched_once(site: Path, tmp_path: Path) -> None:
    """A later search takes what was planted from the first's file, if that can be read."""
    settings = SearchSettings(plants=12, classes=("car", "person"), sun_deg=(215, 48))
    detector, out = Counting(site), tmp_path / "out"
    first = _report(site, out, detector, settings)
    plants = json.loads((out / "plants.geojson").read_text())
    shown = detector.shown
    again = _report(site, out, detector, settings)
    assert detector.shown == shown > 0
    (one,), (other,) = first["flights"], again["flights"]
    assert not one["measured_before"] and other["measured_before"]
    assert {**one, "measured_before": True} == other and first["classes"] == again["classes"]
    counts = {label: (row["planted"], row["found"]) for label, row in one["classes"].items()}
    for label, (planted, found) in counts.items():
        own = [each for each in plants["features"] if each["properties"]["class"] == label]
        assert len(own) >= planted > 0 and sum(each["properties"]["found"] for each in own) >= found
    with Archive.open(site, write=False) as archive:
        origin = archive.site().origin
    for each in plants["features"]:
        east, north = each["geometry"]["coordinates"]
        assert abs(east - origin.longitude_deg) < 0.005 and abs(north - origin.latitude_deg) < 0.005
    ((basis, searched),) = read_plants(out).values()
    assert (
        basis.seed == 1
        and len(searched.plants) == len(plants["features"])
        and searched.looked == shown
    )
    (out / "plants.geojson").write_text(json.dumps(plants)[:-400])
    assert not read_plants(out) and not read_plants(tmp_path)
    (tmp_path / "plants.geojson").write_text('{"format": 1, "flights": [], "features": []}')
    assert not read_plants(tmp_path)
    next(
        search_site(site, settings, SearchOutputs(out), detector)
    )  # what cannot be read is measured anew
    assert detector.shown == shown + 1


def test_plants_serve_another_search_of_the_same_frames_alone() -> None:
    basis = Basis("1", "model", "frames", "", None, ("person", "car"), 80, 1, "", "")
    assert basis.serves(replace(basis, plants=20, seed=4, area="field"))
    assert basis.serves(replace(basis, classes=("car",)))
    for other in (
        {"model": "x"},
        {"frames": "x"},
        {"program": "2"},
        {"heights": "x"},
        {"sun_deg": (1.0, 2.0)},
        {"classes": ("small object",)},
    ):
        assert not basis.serves(replace(basis, **other))
    assert Basis.from_json(
        json.loads(json.dumps(asdict(replace(basis, sun_deg=(1.0, 2.0)))))
    ).sun_deg == (1.0, 2.0)


def test_a_map_without_metres_is_refused(tmp_path: Path, filmed: Path) -> None:
    lonely = tmp_path / "video.mp4"
    lonely.write_bytes((filmed / "flight1" / "flight1.mp4").read_bytes())
    for _ in map_flights(
        [lonely], tmp_path / "site", MapSettings(model="none"), camera=filmed / "camera.xml"
    ):
        pass
    with pytest.raises(InputError, match="without GPS"):
        list(search_site(tmp_path / "site", SearchSettings(), SearchOutputs(tmp_path / "out")))


def test_the_command_refuses_what_it_cannot_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["search", str(tmp_path / "nothing")]) == 1
    assert "there is no" in (words := capsys.readouterr().err) and "--site" in words
    for option in ("--camera", "--telemetry"):
        assert main(["search", str(tmp_path), option, "missing.csv"]) == 1
        assert f"{option} is for flights that are mapped now" in capsys.readouterr().err
    assert main(["search", str(tmp_path), "--plants", "2"]) == 1
    assert "--plants" in capsys.readouterr().err


def test_classes_that_cannot_be_measured_are_refused(site: Path, tmp_path: Path) -> None:
    """An unknown class, a known one of which nothing can be drawn, and a model that knows nothing that can."""
    detector, outputs = Comparing(site), SearchOutputs(tmp_path / "out")
    with pytest.raises(SettingsError, match="'giraffe'; it knows person, car, small object"):
        next(search_site(site, SearchSettings(classes=("giraffe",)), outputs, detector))
    detector.classes = ("truck", "bus")
    detector.info = replace(
        detector.info,
        classes=("truck", "bus"),
        thresholds={"truck": 0.3, "bus": 0.3},
        best_px={"truck": (4.0, 400.0), "bus": (4.0, 400.0)},
    )
    with pytest.raises(SettingsError, match="no 'truck' can be drawn"):
        next(search_site(site, SearchSettings(classes=("truck",)), outputs, detector))
    with pytest.raises(SettingsError, match="reports truck, bus"):
        next(search_site(site, SearchSettings(), outputs, detector))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"refly": "holes.txt"}, "not as '.txt'"),
        ({"refly": "nowhere/holes.kml"}, "there is no folder"),
        ({"refly": "holes.kmz", "dji-drone": "paper"}, "--dji-drone paper"),
        ({"area": "missing.geojson"}, "missing"),
        ({"poa": "missing.geojson"}, "missing"),
        ({"classes": "giraffe"}, "giraffe"),
        ({"model": "none"}, "nothing"),
        ({"out": "camera.xml"}, "is a file"),
    ],
)
def test_what_cannot_be_used_is_refused_before_a_flight_is_mapped(
    photographed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: dict[str, str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "camera.xml").write_bytes((photographed / "camera.xml").read_bytes())
    wishes = [part for name, value in options.items() for part in (f"--{name}", value)]
    photos = str(photographed / "flight1" / "photos")
    assert main(["search", photos, "--site", "site", "--camera", "camera.xml", *wishes]) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "site" / "site.db").exists()


@pytest.mark.parametrize(
    ("inputs", "wishes", "words"),
    [
        (["photos"], ["--flight", "flight1"], "flights that the map has"),
        (["photos"], ["--plants", "2"], "--plants"),
        (["follow:a", "follow:b"], [], "one live flight"),
    ],
)
def test_what_makes_no_sense_of_a_flight_to_map_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    inputs: list[str],
    wishes: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["search", *inputs, "--site", "site", *wishes]) == 1
    assert words in capsys.readouterr().err


def test_waypoints_of_an_unknown_format_are_refused_before_the_search(
    site: Path, tmp_path: Path
) -> None:
    outputs = SearchOutputs(tmp_path / "out", refly=(tmp_path / "holes.txt",))
    with pytest.raises(SettingsError, match="flight plans are written as"):
        next(search_site(site, SearchSettings(), outputs, Comparing(site)))
    assert not (tmp_path / "out").exists()


def test_segments_need_probabilities_that_add_up(tmp_path: Path) -> None:
    ring = [[12.6, 41.8], [12.61, 41.8], [12.61, 41.81], [12.6, 41.81], [12.6, 41.8]]
    path = tmp_path / "segments.geojson"

    def write(*properties: dict[str, Any]) -> None:
        path.write_text(
            json.dumps(
                {
                    "type": "FeatureCollection",
                    "features": [
                        {
                            "type": "Feature",
                            "properties": each,
                            "geometry": {"type": "Polygon", "coordinates": [ring]},
                        }
                        for each in properties
                    ],
                }
            )
        )

    write({"poa_percent": 40}, {"name": "b", "POA": 0.5})
    assert [(name, poa) for name, _, poa in read_segments(path)] == [("segment 1", 0.4), ("b", 0.5)]
    for wrong in (
        [{"name": "x"}],
        [{"poa": 0.7}, {"poa": 0.7}],
        [{"poa": 3}],
        [{"poa": True}],
        [{"poa": 10**400}],
        [],
    ):
        write(*wrong)
        with pytest.raises(InputError, match=r"poa|too large"):
            read_segments(path)


def test_a_look_through_trees_ignores_no_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["search", str(tmp_path), "--through-trees", "--area", "area.kml", "--refly", "a.kml"]
    assert main(words) == 1
    assert capsys.readouterr().err.startswith("error: --area, --refly: --through-trees looks")


def _cut_out(path: Path, length_px: int = 90) -> Path:
    """A person in red, 30 px wide, on a ground that was made transparent."""
    rgba = np.zeros((60, length_px + 30, 4), np.uint8)
    rgba[15:45, 15:-15] = (200, 30, 30, 255)
    Image.fromarray(rgba).save(path)
    return path


def test_a_crew_plants_people_of_its_own(site: Path, tmp_path: Path) -> None:
    settings = SearchSettings(plants=12, classes=("person",), sun_deg=(215, 48))
    outputs = {"plant": _cut_out(tmp_path / "ours.png"), "plant_cm": 2.0}
    report = _report(site, tmp_path / "out", Comparing(site), settings, **outputs)
    planted = report["flights"][0]["classes"]["person"]
    assert report["cut_outs"] == ["ours.png"] and planted["found"] >= 0.6 * planted["planted"] > 0
    assert any("plants are 1 picture of your own people" in each for each in report["warnings"])
    sheet = np.asarray(Image.open(tmp_path / "out" / "cut-outs.png"))
    assert (sheet[..., 3] > 127).sum() == pytest.approx(1.8 * 0.6 * 1e4, rel=0.05)
    again = _report(site, tmp_path / "out", Comparing(site), settings, **outputs)
    assert again["flights"][0]["measured_before"]
    drawn = _report(site, tmp_path / "out", Comparing(site), settings)
    assert not drawn["flights"][0]["measured_before"] and drawn["cut_outs"] == []


@pytest.mark.parametrize(
    ("length_px", "cm", "words"),
    [
        (90, None, "a picture with transparency states no scale; give plant_cm"),
        (400, 2.0, "what there is is 8.0 m long"),
    ],
)
def test_a_cut_out_that_cannot_be_planted(
    site: Path, tmp_path: Path, length_px: int, cm: float | None, words: str
) -> None:
    picture = _cut_out(tmp_path / "ours.png", length_px)
    outputs = SearchOutputs(tmp_path / "out", plant=picture, plant_cm=cm)
    with pytest.raises(InputError, match=re.escape(words)):
        search_site(site, SearchSettings(), outputs, Comparing(site)).result()
    assert not (tmp_path / "out").exists()
