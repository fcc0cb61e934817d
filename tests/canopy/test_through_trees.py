"""`sorvolo search --through-trees` from the map of a flight to files, finds of the site and its exit code."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from forest_site import forest_site

from sorvolo.cli.main import main
from sorvolo.geometry.camera import Camera
from sorvolo.lab.simulation.forest import fly, make_forest, photograph
from sorvolo.store.site.archive import Archive

_PEOPLE_M = np.array([[-4.0, -3.0], [4.0, 5.0]])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    forest = make_forest(5, 44, 1.5, _PEOPLE_M, -18.0)
    camera = Camera.from_angle_of_view(192, 192, 40)
    views = fly(forest, np.arange(-7.5, 8, 3.0), np.arange(-7.5, 8, 3.0), camera=camera)
    pictures = [photograph(forest, view) for view in views]
    return forest_site(tmp_path_factory.mktemp("forest") / "site", views, pictures)


@pytest.fixture(scope="module")
def searched(site: Path) -> tuple[Path, int]:
    words = ["search", str(site), "--through-trees", "--plants", "10"]
    out = site.parent / "out"
    return out, main([*words, "--out", str(out)])


def test_the_people_are_named_with_the_chance_that_one_is_found(
    searched: tuple[Path, int], site: Path
) -> None:
    out, code = searched
    report = json.loads((out / "under_trees.json").read_text())
    places_m = np.array([each["place_m"][:2] for each in report["people"]])
    away_m = np.linalg.norm(places_m[:, None] - _PEOPLE_M, axis=2)
    assert len(places_m) == len(_PEOPLE_M) and away_m.min(axis=0).max() < 0.6
    assert report["headline"]["text"].startswith("2 possible people under trees on ")
    assert 0.5 < report["detection"]["pod"] <= 1 and 0.3 < report["detection"]["free_share"] < 1
    assert code == (0 if report["headline"]["complete"] else 3)
    with rasterio.open(out / "under_trees.tif") as opened:
        assert opened.descriptions[:3] == ("mean", "anomaly, sigmas", "views")
        assert opened.read(3).max() > 24


def test_the_finds_are_findings_of_the_site(searched: tuple[Path, int], site: Path) -> None:
    with Archive.open(site, write=True) as archive:
        kept = archive.objects()
        findings = archive.register().findings
        archive.keep_under_trees("flown", [each.thing for each in kept])  # looked again: not twice
        assert len(archive.objects()) == len(kept) == len(_PEOPLE_M)
    assert [each.newest.mission for each in findings] == ["flown under trees"] * 2
    assert all((site / "flights/flown/objects" / f"{each.thing.id}.jpg").is_file() for each in kept)
    listed = json.loads((site / "objects.geojson").read_text())["features"]
    assert len(listed) == len(_PEOPLE_M)


def test_a_flight_with_too_few_pictures_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    forest = make_forest(5, 44, 0.0, _PEOPLE_M, -18.0)
    views = fly(forest, np.zeros(1), np.arange(0, 9.0))
    site = forest_site(tmp_path / "site", views, [photograph(forest, each) for each in views])
    assert main(["search", str(site), "--through-trees"]) == 1
    assert "has 9 pictures with a place" in capsys.readouterr().err
