"""The archive index finds what a look through every site would find, and reads only what changed."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from fake_changes import fake_change
from fake_flights import LOCAL_SITE, SITE, frame, image, map_flight, tile
from test_objects_store import search, thing

from ended_work import ended
from postgres_server import PostgresServer
from sorvolo.cli.main import main
from sorvolo.errors import SettingsError, StoreError
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.missions.archive import index as indexing
from sorvolo.missions.archive.index import IndexOutcome, find_place, index_archive
from sorvolo.store.index import tables
from sorvolo.store.index.archive_index import INDEX, POINTER, ArchiveIndex
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import Verdict

DAY_NS = 86_400 * 10**9
SECOND = replace(SITE, name="second", origin=Geodetic(46.50003, 13.25003, 300.0))


def fly(folder: Path, site, flight: str, day: int, **found: object) -> None:
    """A flight of three frames on a day, ten metres apart, with objects or changes."""
    with Archive.open(folder, write=True) as archive:
        if not archive.has_site:
            archive.create_site(site)
        with archive.begin_flight(flight, flight, {}) as writer:
            placed = [replace(frame(k), time_ns=frame(k).time_ns + day * DAY_NS) for k in range(3)]
            writer.tiles[0, 0] = tile(day)
            writer.commit(placed, {0: writer.save_image(0, image(0))}, {}, "", **found)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sites beside each other, a third without a place on Earth, and files of no site."""
    root = tmp_path_factory.mktemp("archive") / "root"
    fly(
        root / "north" / "field",
        SITE,
        "a",
        0,
        search=search((thing("a-o1", 3.0, 4.0), thing("a-o2", 25.0, 4.0))),
    )
    fly(root / "north" / "field", SITE, "b", 1, changes=[fake_change(1)])
    fly(root / "second", SECOND, "c", 2)
    with Archive.open(root / "pond", write=True) as archive:
        archive.create_site(LOCAL_SITE)
        map_flight(archive, "d", 5, count=1)
    (root / "notes").mkdir()
    return root


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "root"))


@pytest.fixture(params=["sqlite", "postgis"])
def address(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Where the index lies."""
    if request.param == "sqlite":
        return ""
    url = request.getfixturevalue("postgis")
    monkeypatch.setenv("SORVOLO_CATALOGUE", f"sqlite {url}")
    return url


@pytest.fixture(scope="session")
def postgis(postgres: PostgresServer) -> str:
    if not postgres.sql("SELECT 1 FROM pg_available_extensions WHERE name = 'postgis'"):
        pytest.skip("PostGIS is not installed (Debian: apt-get install postgresql-postgis)")
    postgres.sql("CREATE DATABASE places")
    postgres.sql("CREATE EXTENSION IF NOT EXISTS postgis SCHEMA public", database="places")
    return postgres.url.replace("/postgres", "/places")


def indexed(root: Path, address: str = "") -> IndexOutcome:
    return ended(index_archive(root, address))


def at(east_m: float, north_m: float, site=SITE) -> str:
    latitudes, longitudes, _ = site.frame.wgs84_from_site(np.array([[east_m, north_m]]))
    return f"{latitudes[0]:.9f},{longitudes[0]:.9f}"


def brute_force(root: Path, place: str) -> dict[tuple[str, str], int]:
    """How many frames of each flight show a place, by its files."""
    latitude, longitude = map(float, place.split(","))
    found = {}
    for file in sorted(root.rglob("frames.geojson")):
        shapes = [
            shapely.geometry.shape(each["geometry"])
            for each in json.loads(file.read_text())["features"]
            if each["geometry"]
        ]
        count = sum(each.intersects(shapely.Point(longitude, latitude)) for each in shapes)
        if count:
            found[file.parents[2].relative_to(root).as_posix(), file.parent.name] = count
    return found


def test_it_finds_what_the_files_hold(root: Path, address: str) -> None:
    outcome = indexed(root, address)
    assert (outcome.sites, outcome.added, outcome.faults) == (3, 3, {})
    assert outcome.holds == {"sites": 3, "flights": 3, "frames": 9, "objects": 2, "changes": 1}
    chance = np.random.default_rng(4)
    seen = 0
    for _ in range(60):
        place = at(*chance.uniform(-20, 45, 2))
        found = find_place(root, place)
        assert {
            (each.site, each.flight): each.frames for each in found if each.frames
        } == brute_force(root, place)
        seen += bool(found)
    assert 10 < seen < 60
    first, second, third = find_place(root, at(12.0, 5.0))
    assert [each.flight for each in (first, second, third)] == ["a", "b", "c"]
    assert first.site == "north/field" and third.site_name == "second"
    assert (first.kind, second.kind) == ("map", "compare")
    assert first.best_frame == "0" and first.best_is_kept  # the only one whose picture was kept
    assert second.first_ns - first.first_ns == DAY_NS


def test_what_was_found_there(root: Path, address: str) -> None:
    indexed(root, address)
    (flight,) = find_place(root, at(3.0, 4.5), classes=("car",))
    (car,) = flight.things
    assert (car.type, car.id, car.label) == ("object", "a-o1", "car") and abs(
        car.distance_m - 0.5
    ) < 0.02
    assert not find_place(root, at(3.0, 7.0), classes=("car",))
    assert find_place(root, at(3.0, 7.0), classes=("car",), within_m=3.1)
    assert not find_place(root, at(3.0, 4.5), classes=("person",))
    with Archive.open(root / "north" / "field", write=True) as archive:
        (change,) = archive.changes()
        archive.review(change.id, Verdict.CONFIRMED)
    assert indexed(root).added == 0
    centre = change.outline_m.mean(axis=0)
    found = [
        each
        for flight in find_place(root, at(*centre))
        for each in flight.things
        if each.type == "change"
    ]
    assert [(each.id, each.verdict, each.distance_m) for each in found] == [
        (change.id, "confirmed", 0.0)
    ]


def test_by_time(root: Path, address: str) -> None:
    indexed(root, address)
    place = at(12.0, 5.0)
    assert [each.flight for each in find_place(root, place, first="2023-11-15")] == ["b", "c"]
    assert [each.flight for each in find_place(root, place, last="2023-11-15")] == ["a", "b"]
    between = find_place(root, place, first="2023-11-15T22:00", last="2023-11-15T23:59Z")
    assert [each.flight for each in between] == ["b"]
    assert not find_place(root, place, first="2023-11-15T22:14")[:-1]


def test_only_what_changed_is_read(
    root: Path, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    indexed(root, address)
    read: list[str] = []
    rows = indexing.flight_rows

    def counted(archive: Archive, wanted: set[str]):
        read.extend(sorted(wanted))
        return rows(archive, wanted)

    monkeypatch.setattr(indexing, "flight_rows", counted)
    assert indexed(root).added == 0 and not read
    fly(
        root / "north" / "field", SITE, "b", 5, search=search((thing("b-o1", 3.0, 4.0),))
    )  # again, another day
    shutil.rmtree(root / "second")
    outcome = indexed(root)
    assert read == ["b"] and outcome.gone == ["second"]
    assert outcome.holds == {"sites": 2, "flights": 2, "frames": 6, "objects": 3, "changes": 0}
    assert [each.flight for each in find_place(root, at(12.0, 5.0))] == ["a", "b"]
    if not address:  # no box is left of a row that is gone
        with ArchiveIndex.open(root, write=False) as index, index.reading() as connection:
            boxes = [
                connection.exec_driver_sql(f"SELECT count(*) FROM {each.name}_places").scalar_one()
                for each in tables.PLACED
            ]
            assert boxes == [2, 3, 0]


def test_a_site_that_cannot_be_read_is_named_and_what_is_known_of_it_stays(
    root: Path, capsys
) -> None:
    indexed(root)
    (root / "second" / "site.db").write_bytes(b"broken")
    assert main(["archive", "index", str(root)]) == 1
    assert "second: " in capsys.readouterr().err
    assert [each.flight for each in find_place(root, at(12.0, 5.0))] == ["a", "b", "c"]


def test_an_update_that_was_stopped_goes_on(root: Path, address: str) -> None:
    work = index_archive(root, address)
    next(work)
    work.close()
    assert indexed(root).holds["flights"] == 3
    assert len(find_place(root, at(12.0, 5.0))) == 3


def test_across_the_antimeridian(tmp_path: Path, address: str) -> None:
    site = replace(SITE, origin=Geodetic(-17.0, 179.99995, 10.0), crs="EPSG:32760")
    fly(tmp_path / "fiji", site, "a", 0)
    indexed(tmp_path, address)
    for longitude in (179.9999, -179.9999, 180.0, -180.0, 180.0001):
        assert [each.flight for each in find_place(tmp_path, f"-16.99996,{longitude}")] == ["a"], (
            longitude
        )
    assert not find_place(tmp_path, "-16.99996,0.0001")


@pytest.mark.parametrize(
    ("words", "match"),
    [
        ({"at": "north pole"}, "no place"),
        ({"at": "91,0"}, "off the Earth"),
        ({"at": "nan,0"}, "off the Earth"),
        ({"at": "1,2", "first": "soon"}, "is not a date"),
        ({"at": "1,2", "within_m": 0}, "more than 0"),
        ({"at": "1,2", "first": "2026-02-01", "last": "2026-01-01"}, "in order"),
    ],
)
def test_what_cannot_be_asked_is_named(tmp_path: Path, words: dict, match: str) -> None:
    with pytest.raises(SettingsError, match=match):
        find_place(tmp_path, **words)


def test_without_an_index_or_with_another_one(
    root: Path, postgis: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(StoreError, match="sorvolo archive index"):
        find_place(root, "46.5,13.25")
    indexed(root)
    with pytest.raises(SettingsError, match="lies in its folder already"):
        indexed(root, postgis)
    monkeypatch.setattr(tables, "FORMAT", 9)
    with pytest.raises(StoreError, match=r"format 1 of the index.*with 9"):
        find_place(root, "46.5,13.25")


def test_without_postgis(root: Path, postgres: PostgresServer, capsys) -> None:
    assert main(["archive", "index", str(root), "--catalogue", postgres.url]) == 1
    assert "has no PostGIS" in capsys.readouterr().err
    assert not (root / POINTER).exists() and not (root / INDEX).exists()


def test_the_command_lists_and_prints_json(root: Path, capsys) -> None:
    assert main(["archive", "index", str(root)]) == 0
    assert (
        "3 sites, 3 flights, 9 frames, 2 objects, 1 change; 3 flights new, 0 gone"
        in capsys.readouterr().out
    )
    assert (
        main(["archive", "find", str(root), "--at", at(3.0, 4.5), "--class", "car", "--json"]) == 0
    )
    (flight,) = json.loads(capsys.readouterr().out)["flights"]
    assert flight["flight"] == "a" and flight["things"][0]["id"] == "a-o1"
    assert main(["archive", "find", str(root), "--at", at(3.0, 4.5)]) == 0
    assert "car (a-o1" in capsys.readouterr().out.replace("\n", "")
    assert main(["archive", "find", str(root), "--at", "0,0"]) == 0
    assert "no flight saw this place at that time\n" in capsys.readouterr().out
    assert main(["archive", "find", str(root), "--at", at(3.0, 4.5), "--class", "auto"]) == 0
    assert "or none found auto there" in capsys.readouterr().out  # flights did see it
