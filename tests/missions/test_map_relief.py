"""`sorvolo map` over hills is a map over heights, and a flat one is reported as one to check; accuracy holds."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from small_flights import simulate_into, small_flight
from sorvolo.cli.main import main
from sorvolo.errors import DiskFullError
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.lab.simulation.settings import LaterSettings, OutputSettings
from sorvolo.missions.heights import run as heights_run
from sorvolo.missions.heights.measure import read_field
from sorvolo.missions.map import planar_run
from sorvolo.missions.map.ground import flights_over_heights, map_surface
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import HeightFile

_LEVEL = small_flight(
    6,
    length_m=20,
    spacing_m=8,
    noise_m=0.3,
    size_px=(400, 300),
    output=OutputSettings(photos=True, photo_overlap=0.7),
)

_SAME = LaterSettings(people=0, cars=0, small_objects=0, removed=0, moved=0)


def _mapped(folder: Path, site: str, *asked: str) -> int:
    """Map what was simulated into `made` of a folder, into a site beside it; the exit code."""
    made = folder / "made"
    command = ["map", str(made / "flight1" / "photos"), "--site", str(folder / site)]
    return main([*command, "--model", "none", "--camera", str(made / "camera.xml"), *asked])


@pytest.mark.parametrize("relief_m, asked", [(0.0, []), (12.0, ["--flat"]), (12.0, [])])
def test_the_report_names_ground_that_is_not_level(
    relief_m: float, asked: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stands = relief_m > 0 and not asked
    hills = replace(_LEVEL, scene=replace(_LEVEL.scene, relief_m=relief_m))
    simulate_into(tmp_path / "made", replace(hills, flights=1 + stands, later=_SAME))
    exit_code = _mapped(tmp_path, "site", *asked)
    report = json.loads(next((tmp_path / "site").glob("flights/*/report.json")).read_text())
    is_doubted = bool(asked)
    assert any("the ground is not level" in each for each in report["warnings"]) == is_doubted
    assert exit_code == (3 if is_doubted else 0)
    assert ("the ground is not level" in report["headline"]["text"]) == is_doubted
    assert report.get("shape", {}).get("is_flat", True) != stands
    assert any((tmp_path / "site").glob("flights/*/heights.tif")) == stands
    off_m = _off_m(tmp_path)
    assert (off_m < 2 * report["sigma_m"] * np.sqrt(2)).mean() > 0.9, (off_m, report["sigma_m"])
    if stands:
        _compares_over_heights(tmp_path)
        _extends_over_heights(tmp_path)
        _goes_on_after_a_full_disk(tmp_path, monkeypatch)


def _compares_over_heights(folder: Path) -> None:
    """Nothing changed, and each later camera is placed in space: over a level plane hills would move in its picture."""
    shutil.copytree(folder / "site", folder / "compared")
    made = folder / "made" / "flight2"
    command = ["compare", str(made / "photos"), "--site", str(folder / "compared")]
    assert main([*command, "--model", "none", "--camera", str(folder / "made" / "camera.xml")]) == 0
    later = folder / "compared" / "flights" / "photos-2"
    assert json.loads((later / "changes.geojson").read_text())["features"] == []
    off_m = _cameras_off_m(folder, later, "flight2")
    off_m -= np.median(_cameras_off_m(folder, later.parent / "photos", "flight1"), axis=0)
    assert len(off_m) >= 6 and np.median(np.linalg.norm(off_m, axis=1)) < 0.3


def _extends_over_heights(folder: Path) -> None:
    """What a map over heights gains by a later flight is no level plane: its cameras stand in space on that map."""
    made = folder / "made"
    for name in _names(made / "flight1" / "photos")[:6]:
        (folder / "half").mkdir(exist_ok=True)
        shutil.copy(made / "flight1" / "photos" / name, folder / "half")
    with_camera = ["--model", "none", "--camera", str(made / "camera.xml")]
    site = ["--site", str(folder / "extended"), *with_camera]
    assert main(["map", str(folder / "half"), "--heights", *site]) == 0
    _goes_on_with_another_battery(folder)
    main(["compare", str(made / "flight2" / "photos"), *site])
    later = folder / "extended" / "flights" / "photos"
    report = json.loads((later / "report.json").read_text())
    assert report["comparison"]["extension"]["area_m2"] > 50
    assert not any("fit each other badly" in each for each in report["warnings"])
    off_m = _cameras_off_m(folder, later, "flight2")
    off_m -= np.median(_cameras_off_m(folder, later.parent / "half", "flight1"), axis=0)
    assert len(off_m) >= 6 and np.linalg.norm(off_m, axis=1).max() < 1


def _goes_on_with_another_battery(folder: Path) -> None:
    """A second flight is held on the heights of the first, and a comparison is laid over those of both."""
    made, site = folder / "made", folder / "batteries"
    shutil.copytree(folder / "extended", site)
    for name in _names(made / "flight1" / "photos")[4:]:
        (folder / "rest").mkdir(exist_ok=True)
        shutil.copy(made / "flight1" / "photos" / name, folder / "rest")
    with_camera = ["--camera", str(made / "camera.xml"), "--model", "none", "--heights"]
    shutil.copytree(site, folder / "damaged")
    (folder / "damaged" / "flights" / "half" / "heights.json").write_text('{"cell_m": 1e999}')
    for each, is_held in ((folder / "damaged", False), (site, True)):
        assert main(["map", str(folder / "rest"), "--site", str(each), *with_camera]) == 0
        report = json.loads((each / "flights" / "rest" / "report.json").read_text())
        assert ("the heights of half are damaged" in report["shape"]["why"]) is not is_held
    with Archive.open(site, write=False) as archive:
        flights = flights_over_heights(archive, but="")
        assert flights == ["half", "rest"]
        surface = map_surface(archive, flights)
        first, second = (read_field(archive, each, HeightFile.SURFACE) for each in flights)
        zero_m = archive.site().origin.height_m
    assert surface is not None
    columns, rows = np.meshgrid(*[np.arange(-30, 30, 0.5)] * 2)
    places_m = np.column_stack([columns.ravel(), rows.ravel()])
    earlier_m, later_m = first.at(places_m)[0], second.at(places_m)[0]
    apart_m = np.abs(later_m - earlier_m)
    assert np.isfinite(apart_m).sum() > 500 and np.nanmedian(apart_m) < 0.15
    site_from_raster = np.array([[0.5, 0, -30], [0, 0.5, -30], [0, 0, 1]])
    merged_m = surface.under(site_from_raster, columns.shape).ravel() + zero_m
    alone = np.isnan(earlier_m) & np.isfinite(later_m)
    assert alone.sum() > 100 and np.median(np.abs(merged_m - later_m)[alone]) < 0.05
    assert np.nanmedian(np.abs(merged_m - earlier_m)) < 0.05


def _names(folder: Path) -> list[str]:
    return sorted(each.name for each in folder.iterdir())


def _cameras_off_m(folder: Path, mapped: Path, flight: str) -> np.ndarray:
    """(N, 3) how far a flight's cameras that were placed stand from where they were, m; heights by another zero."""
    truth = json.loads((folder / "made" / "truth" / "frames.geojson").read_text())
    true = {
        each["properties"]["frame"]: _camera_m(each["properties"])
        for each in truth["features"]
        if each["properties"]["flight"] == flight
    }
    found = [
        each["properties"]
        for each in json.loads((mapped / "frames.geojson").read_text())["features"]
        if each["properties"]["status"] == "vision"
    ]
    return np.array([_camera_m(each) - true[each["frame"]] for each in found])


def _camera_m(properties: dict[str, Any]) -> np.ndarray:
    """(3,) a camera's place, east, north and up, m, from a point nearby."""
    names = ("camera_longitude_deg", "camera_latitude_deg", "camera_height_m")
    place = np.array([properties[each] for each in names])
    return (place - [12.6, 41.89, 0]) * [111_320 * np.cos(np.radians(41.89)), 111_200, 1]


def _goes_on_after_a_full_disk(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Heights of a large flight are minutes of work: what a run that was stopped found out is not sought again."""

    def full(*_: object) -> None:
        raise DiskFullError("disk full")

    for modules, exit_code in (
        ({planar_run: ["ground_tiles"]}, 1),
        ({heights_run: ["find_tracks", "sweep_surface"]}, 0),
    ):
        with monkeypatch.context() as patch:
            for module, names in modules.items():
                for name in names:
                    patch.setattr(module, name, full)
            assert _mapped(folder, "stopped") == exit_code
    for name in ("mosaic.tif", "flights/photos/heights.tif", "flights/photos/terrain.tif"):
        assert (folder / "stopped" / name).read_bytes() == (folder / "site" / name).read_bytes()


@pytest.mark.parametrize(
    "seed", [pytest.param(6, id="a house"), pytest.param(8, id="trees", marks=pytest.mark.long)]
)
def test_what_stands_on_level_ground_makes_no_hill_of_it(seed: int, tmp_path: Path) -> None:
    scene = replace(_LEVEL.scene, ground="urban", has_scenery=True)
    simulate_into(tmp_path / "made", replace(_LEVEL, seed=seed, scene=scene))
    camera = str(tmp_path / "made" / "camera.xml")
    main(
        [
            "map",
            str(tmp_path / "made" / "flight1" / "photos"),
            "--site",
            str(tmp_path / "site"),
            "--model",
            "none",
            "--camera",
            camera,
        ]
    )
    report = json.loads(next((tmp_path / "site").glob("flights/*/report.json")).read_text())
    assert not any("the ground is not level" in each for each in report["warnings"]), report[
        "warnings"
    ]
    off_m = _off_m(tmp_path)
    assert (off_m < 2 * report["sigma_m"] * np.sqrt(2)).mean() > 0.9, (off_m, report["sigma_m"])


def _off_m(folder: Path) -> np.ndarray:
    """(N,) how far each picture's corners lie from where they are, m, the mean."""
    truth = json.loads((folder / "made" / "truth" / "frames.geojson").read_text())
    frame = LocalFrame(Geodetic(**truth["site"]))
    found = json.loads(next((folder / "site").glob("flights/*/frames.geojson")).read_text())
    true = {each["properties"]["frame"]: _corners_m(each, frame) for each in truth["features"]}
    return np.array(
        [
            np.linalg.norm(
                (_corners_m(each, frame) - true[each["properties"]["frame"]]).mean(axis=0)
            )
            for each in found["features"]
        ]
    )


def _corners_m(feature: dict[str, Any], frame: LocalFrame) -> np.ndarray:
    return frame.ground_from_lonlat(np.array(feature["geometry"]["coordinates"][0])[:4])
