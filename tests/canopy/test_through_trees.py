"""`sorvolo search --through-trees` from the map of a flight to files, finds of the site and its exit code."""

import json
from contextlib import redirect_stdout
from io import BytesIO, StringIO
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
import rasterio
from forest_site import forest_site
from PIL import Image
from thermal_forest import fly, make_forest, photograph

from sorvolo.cli.main import main
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid
from sorvolo.missions.search.measure import MeasuredClass, MeasuredFlight, SearchedPlants
from sorvolo.missions.search.through_trees import seen_floor
from sorvolo.missions.worker import PERSON_FOUND, Journal, _add_people
from sorvolo.search.cells import Cells
from sorvolo.search.conditions import Conditions
from sorvolo.search.outcomes import Outcomes
from sorvolo.search.recall import Chances
from sorvolo.station.problems import Problem
from sorvolo.station.sites import SiteShelf
from sorvolo.station.tiles import FloorTiles
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
def searched(site: Path) -> tuple[Path, int, str]:
    words = ["search", str(site), "--through-trees", "--plants", "10"]
    out = site.parent / "out"
    with redirect_stdout(StringIO()) as printed:
        code = main([*words, "--out", str(out)])
    return out, code, printed.getvalue()


def test_the_people_are_named_with_the_chance_that_one_is_found(
    searched: tuple[Path, int, str], site: Path
) -> None:
    out, code, printed = searched
    assert printed.count("PERSON FOUND") == len(_PEOPLE_M)
    report = json.loads((out / "under_trees.json").read_text())
    places_m = np.array([each["place_m"][:2] for each in report["people"]])
    away_m = np.linalg.norm(places_m[:, None] - _PEOPLE_M, axis=2)
    assert len(places_m) == len(_PEOPLE_M) and away_m.min(axis=0).max() < 0.6
    assert report["headline"]["text"].startswith("2 possible people under trees on ")
    assert 0.5 < report["detection"]["pod"] <= 1 and 0.3 < report["detection"]["free_share"] < 1
    assert code == (0 if report["headline"]["complete"] else 3)
    page = (out / "under_trees.html").read_text()
    assert (
        page.count("<img") == 1 + len(_PEOPLE_M)
        and f"{report['people'][0]['latitude_deg']:.6f}" in page
    )
    with rasterio.open(out / "under_trees.tif") as opened:
        assert opened.descriptions[:3] == ("mean", "anomaly, sigmas", "views")
        assert opened.read(3).max() > 24


def test_a_station_shows_the_floor_at_each_height(
    searched: tuple[Path, int, str], site: Path
) -> None:
    """A person is a brighter spot at the floor's height than far above it."""
    tiles = FloorTiles(SiteShelf(site.parent))
    about = tiles.about("site")
    assert about is not None and abs(about["floor_m"] + 18) < 2
    first, *_ = json.loads((searched[0] / "under_trees.json").read_text())["people"]
    longitude, latitude = first["longitude_deg"], np.radians(first["latitude_deg"])
    column = (longitude / 360 + 0.5) * 2**20
    row = (0.5 - np.arcsinh(np.tan(latitude)) / (2 * np.pi)) * 2**20
    x, y = int(column), int(row)
    at = round((column - x) * 256), round((row - y) * 256)

    def contrast(up_m: float) -> float:
        data = tiles.tile("site", about["run"], up_m, 20, x, y)
        shown = np.asarray(Image.open(BytesIO(data)).convert("RGBA"))
        grey = shown[..., 0].astype(float)
        near = grey[max(at[1] - 1, 0) : at[1] + 2, max(at[0] - 1, 0) : at[0] + 2]
        return float(near.mean() - np.median(grey[shown[..., 3] > 0]))

    assert contrast(-18.0) > 2 * contrast(-6.0) > 0, (contrast(-18.0), contrast(-6.0))
    with pytest.raises(Problem):
        tiles.tile("site", about["run"], 99.0, 20, x, y)
    with pytest.raises(Problem):
        tiles.tile("site", "an earlier look's", -18.0, 20, x, y)


def test_a_station_is_told_of_each_person(searched: tuple[Path, int, str], site: Path) -> None:
    lines = BytesIO()
    _add_people(Journal(lines), site, ["flown"])
    assert not lines.getvalue()  # its map found none: whom it found was told then
    _add_people(Journal(lines), site, ["flown"], below_crowns=True)
    told = [json.loads(each) for each in lines.getvalue().splitlines()]
    assert [each["type"] for each in told] == [PERSON_FOUND] * len(_PEOPLE_M)
    assert {each["data"]["feature"]["properties"]["class"] for each in told} == {"person"}


def test_the_finds_are_findings_of_the_site(searched: tuple[Path, int, str], site: Path) -> None:
    with Archive.open(site, write=True) as archive:
        kept = archive.objects()
        findings = archive.register().findings
        archive.keep_under_trees("flown", [each.thing for each in kept])  # looked again: not twice
        assert len(archive.objects()) == len(kept) == len(_PEOPLE_M)
    assert [each.newest.mission for each in findings] == ["flown under trees"] * 2
    assert all((site / "flights/flown/objects" / f"{each.thing.id}.jpg").is_file() for each in kept)
    listed = json.loads((site / "objects.geojson").read_text())["features"]
    assert len(listed) == len(_PEOPLE_M)


def test_a_search_counts_the_floor_that_was_seen_below_what_hides_it(
    searched: tuple[Path, int], site: Path
) -> None:
    out = Path(copytree(searched[0], site.parent / "again"))
    written = out / "under_trees.json"
    report = json.loads(written.read_text())
    places_m = np.array([report["people"][0]["place_m"][:2], [40.0, 0.0]])
    with Archive.open(site, write=False) as archive:
        whole = archive.site()
        written.write_text(json.dumps(report | {"headline": {"complete": False}}))
        assert seen_floor(out, archive, "flown") is None  # its cameras may be off
        written.write_text(json.dumps(report | {"headline": {"complete": True}}))
        floor = seen_floor(out, archive, "flown")
        assert seen_floor(out, archive, "another") is None
    grid = SiteGrid.at(whole.origin, 1.0, whole.crs)
    cells = Cells(grid, -45, -5, 90, 10, np.ones(900, bool))
    rows = cells.rows_at(places_m)
    crowns, roofs = np.zeros(900), np.zeros(900, bool)
    crowns[rows], roofs[rows] = 1.0, True
    seen = Conditions(np.full(900, 9), np.zeros((900, 8)), crowns, roofs)
    chances = Chances(*[np.where(crowns, 0.0, 0.8)] * 3)
    none = Outcomes(np.zeros((0, 2)), np.zeros((0, 8)), np.zeros(0, bool), np.zeros(0))
    classes = [MeasuredClass(label, seen, none, None, chances) for label in ("person", "car")]
    flight = MeasuredFlight(
        "flown", 36, SearchedPlants(0, 0, 0.0, ()), False, True, True, 0.0, tuple(classes)
    )
    assert floor is not None
    measured = flight.with_floor(floor, cells)
    assert measured.floor is not None and measured.floor["area_m2"] == 1.0
    person, car = (each.chances for each in measured.classes)
    assert person.mean[rows].tolist() == [report["detection"]["pod"], 0.0]
    assert person.low[rows[0]] == report["detection"]["pod_low"]
    assert (np.delete(person.mean, rows) == 0.8).all() and not car.mean[rows].any()


def test_a_flight_with_too_few_pictures_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    forest = make_forest(5, 44, 0.0, _PEOPLE_M, -18.0)
    views = fly(forest, np.zeros(1), np.arange(0, 9.0))
    site = forest_site(tmp_path / "site", views, [photograph(forest, each) for each in views])
    assert main(["search", str(site), "--through-trees"]) == 1
    assert "has 9 pictures with a place" in capsys.readouterr().err
