"""Changes enter the site with their flight, appear as files, are replaced whole, and keep their verdicts."""

import json
import sqlite3
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from io import BytesIO, StringIO
from pathlib import Path
from xml.etree import ElementTree

import cv2
import gpxpy
import numpy as np
import pytest
from fake_changes import SEEN_NS, fake_change, fake_comparison
from fake_flights import LOCAL_SITE, SITE, frame, map_flight, tile
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from sealing import seal_again
from sorvolo.cli.printing import announce_people
from sorvolo.errors import InputError, SettingsError, StoreError
from sorvolo.findings.importance import between, in_short
from sorvolo.geometry.polygons import signed_area
from sorvolo.missions.site.history import came_and_left
from sorvolo.missions.worker import PERSON_FOUND, Journal, _add_people
from sorvolo.station.found import found_features
from sorvolo.store.exports.change_files import changes_geojson, mask_name, write_view_masks
from sorvolo.store.exports.places import Placemark, gpx_bytes, kml_bytes, longitude_latitude
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.change_records import StoredChange, stored_changes
from sorvolo.survey.findings import Change, ChangeKind, HeightChange, Verdict
from sorvolo.survey.map_objects import MapObject, ObjectSearch, SearchedFrames


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A site with the flight "a" mapped."""
    with Archive.open(tmp_path / "site", write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "a", 20)
    return tmp_path / "site"


def compare(
    archive: Archive,
    flight_id: str,
    changes: list[Change] | None,
    colour: int = 0,
    report_html: str = "<html></html>",
) -> int:
    """Compare a fake flight; it paints one tile unless `colour` is 0."""
    with archive.begin_flight(flight_id, "print", {"method": "compare-robust"}) as writer:
        if colour:
            writer.tiles[0, 0] = tile(colour)
        report = {"flight": flight_id, "site": "field", "comparison": fake_comparison()}
        return writer.commit([frame(0)], {}, report, report_html, changes=changes)


def properties(folder: Path, flight_id: str = "b") -> list[dict]:
    collection = json.loads((folder / "flights" / flight_id / "changes.geojson").read_text())
    return [feature["properties"] for feature in collection["features"]]


def same(one: StoredChange, other: Change) -> bool:
    return (
        (
            one.id,
            one.kind,
            one.score,
            one.views,
            one.first_seen_ns,
            one.last_seen_ns,
            one.class_after,
        )
        == (
            other.id,
            other.kind,
            other.score,
            other.views,
            other.first_seen_ns,
            other.last_seen_ns,
            other.class_after,
        )
        and np.array_equal(one.outline_m, other.outline_m)
        and np.allclose(
            [one.area_m2, one.length_m, one.sigma_m], [other.area_m2, other.length_m, other.sigma_m]
        )
    )


@pytest.mark.usefixtures("kind")
def test_changes_come_back_as_they_were_found(folder: Path) -> None:
    made = [
        fake_change(2, kind=ChangeKind.MOVING, velocity_m_s=(1.0, -0.5)),
        replace(
            fake_change(1, kind=ChangeKind.DISAPPEARED),
            sigma_in_map_m=0.03,
            height_change=HeightChange(-0.4, 0.1),
        ),
    ]
    with Archive.open(folder, write=True) as archive:
        compare(archive, "b", made, colour=90)
    with Archive.open(folder, write=False) as archive:
        first, second = archive.changes()
        assert same(first, made[1]) and same(second, made[0])
        assert (first.number, second.number, first.flight_id, first.verdict) == (1, 2, "b", None)
        assert list(second.velocity_m_s) == [1.0, -0.5]
        assert (first.sigma_in_map_m, first.height_change) == (0.03, HeightChange(-0.4, 0.1))
        assert np.isnan(second.sigma_in_map_m) and second.height_change is None
        assert first.crop.width_px == 64 and first.crop.m_per_px == made[1].patch.m_per_px
        assert archive.changes("a") == []
        assert archive.comparisons() == {
            2: {"appeared": 0, "disappeared": 1, "replaced": 0, "moving": 1, "area": 0}
        }
    written = cv2.imread(str(folder / "flights/b/changes/b-1-before.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(cv2.cvtColor(written, cv2.COLOR_BGRA2RGBA), made[1].patch.before)
    page = (folder / "flights/b/changes.html").read_text()
    assert "-0.40 m (accuracy 0.10 m, 1 sigma)" in page and "position on this map (1 sigma)" in page
    reported, other = properties(folder)
    names = "sigma_in_map_m", "height_change_m", "height_change_sigma_m"
    assert [reported[name] for name in names] == [0.03, -0.4, 0.1] and not any(
        other[name] for name in names
    )
    assert "2 changes" not in page and "1 change " in page and "1 moving object" in page
    assert (
        "version 1: flight a, <time>flown 2023-11-14</time>" in page
        and "version 2: flight b" in page
    )
    assert ".dates time{white-space:nowrap}" in page  # on a telephone, too, no line breaks a date


def test_the_geojson_states_what_is_promised_in_wgs84(folder: Path) -> None:
    with Archive.open(folder, write=True) as archive:
        compare(archive, "b", [fake_change(3, score=0.875)])
        site = archive.site()
    text = (folder / "flights/b/changes.geojson").read_text()
    (feature,) = json.loads(text)["features"]
    assert set(feature["properties"]) >= {
        "id",
        "kind",
        "score",
        "first_seen",
        "last_seen",
        "views",
        "area_m2",
        "length_m",
        "sigma_m",
        "class_before",
        "class_after",
        "number",
        "east_m",
        "north_m",
        "velocity_m_s",
        "review",
    }
    reported = feature["properties"]
    assert (reported["id"], reported["kind"], reported["score"], reported["number"]) == (
        "b-3",
        "appeared",
        0.875,
        3,
    )
    assert reported["review"] is reported["class_after"] is reported["velocity_m_s"] is None
    seen = datetime.fromisoformat(reported["first_seen"])
    assert abs(seen.timestamp() - SEEN_NS / 1e9) < 1e-6 and reported["first_seen"].endswith("Z")
    ring = np.array(feature["geometry"]["coordinates"][0])
    assert np.array_equal(ring[0], ring[-1]) and signed_area(ring[:-1]) > 0
    # every corner lies where the outline does, to a tenth of a millimetre
    back_m = site.frame.site_from_wgs84(
        ring[:-1, 1], ring[:-1, 0], np.full(5, site.origin.height_m)
    )[:, :2]
    gaps_m = np.linalg.norm(back_m[:, None] - fake_change(3).outline_m[None], axis=-1).min(axis=1)
    assert gaps_m.max() < 1e-4
    assert np.allclose(feature["outline_m"], fake_change(3).outline_m, atol=1e-4)


def test_a_local_site_writes_no_places_on_earth_and_names_the_reason(tmp_path: Path) -> None:
    with Archive.open(tmp_path / "site", write=True) as archive:
        archive.create_site(LOCAL_SITE)
        map_flight(archive, "a", 20, count=1)
        compare(archive, "b", [fake_change(1)])
    for kind in ("geojson", "kml", "gpx", "kmz"):
        assert not list((tmp_path / "site").rglob(f"*.{kind}"))
    frames = json.loads((tmp_path / "site/flights/b/frames.json").read_text())
    collection = json.loads((tmp_path / "site/flights/b/changes.json").read_text())
    assert "no GPS" in collection["note"] and "no GPS" in frames["note"]
    assert (
        collection["crs"] is None
        and "type" not in collection
        and "type" not in collection["features"][0]
    )
    ring = np.array(collection["features"][0]["geometry"]["coordinates"][0])
    assert np.allclose(ring.max(axis=0), fake_change(1).outline_m.max(axis=0))
    page = (tmp_path / "site/flights/b/changes.html").read_text().split("All changes")[1]
    assert (
        " m²" not in page
        and "unit" not in page
        and "MGRS" not in page
        and "changes.geojson" not in page
    )


def test_changes_are_places_for_google_earth_and_receivers(folder: Path) -> None:
    with Archive.open(folder, write=True) as archive:
        compare(
            archive, "b", [fake_change(1, east_m=30.0), fake_change(2, kind=ChangeKind.DISAPPEARED)]
        )
        archive.review("b-2", Verdict.REJECTED)
    flight = folder / "flights" / "b"
    (waypoint,) = gpxpy.parse((flight / "changes.gpx").read_text()).waypoints
    longitudes, latitudes = longitude_latitude(np.array([[30.0, -4.0]]), SITE)
    assert waypoint.name == "b-1 appeared" and "score 0.80" in waypoint.description
    assert (waypoint.longitude, waypoint.latitude) == pytest.approx(
        (longitudes[0], latitudes[0]), abs=1e-7
    )
    assert waypoint.time is not None and waypoint.time.isoformat() == "2023-11-14T22:13:20+00:00"
    document = ElementTree.fromstring((flight / "changes.kml").read_bytes())
    kml = "{http://www.opengis.net/kml/2.2}"
    (mark,) = document.iter(f"{kml}Placemark")
    assert [name.text for name in mark.iter(f"{kml}name")] == ["b-1 appeared"]
    assert len(list(mark.iter(f"{kml}Point"))) == len(list(mark.iter(f"{kml}Polygon"))) == 1
    point = next(mark.iter(f"{kml}Point"))
    assert str(point.findtext(f"{kml}coordinates")).startswith(f"{longitudes[0]:.6f}"[:8])


def test_names_from_elsewhere_stay_xml() -> None:
    odd = Placemark('<&\x00\x1b>"', "]]> & <b>", 13.0, 46.0, 0)
    for data in (kml_bytes(odd.name, [odd]), gpx_bytes(odd.name, [odd])):
        texts = [
            each.text
            for each in ElementTree.fromstring(data).iter()
            if each.text and each.text.strip()
        ]
        assert '<&>"' in texts and "]]> & <b>" in texts


@given(
    st.lists(st.tuples(st.floats(-5e3, 5e3), st.floats(-5e3, 5e3), st.floats(0.05, 50)), max_size=4)
)
def test_any_change_makes_plain_json(places: list[tuple[float, float, float]]) -> None:
    changes = [
        fake_change(k, east_m=east, north_m=north, size_m=size)
        for k, (east, north, size) in enumerate(places)
    ]
    collection = changes_geojson(stored_changes("b", changes), SITE)
    assert json.loads(json.dumps(collection, allow_nan=False)) == collection


def test_a_comparison_without_changes_reports_that_and_a_mapping_nothing(folder: Path) -> None:
    with Archive.open(folder, write=True) as archive:
        compare(archive, "b", [])
        assert list(archive.comparisons()) == [2]
    assert properties(folder) == []
    assert "No change was found" in (folder / "flights/b/changes.html").read_text()
    assert not (folder / "flights/b/changes").exists()
    assert not (folder / "flights/a/changes.geojson").exists()


def test_changes_enter_the_register_by_the_order_of_flights(folder: Path) -> None:
    """However late one is compared again, and of a flight without times; what moves is of its own date alone."""
    changes = [
        fake_change(1, kind=ChangeKind.DISAPPEARED),
        fake_change(2, kind=ChangeKind.MOVING, east_m=30.0, velocity_m_s=(1.0, 0.0)),
    ]
    with Archive.open(folder, write=True) as archive:
        compare(archive, "b", changes)
        with archive.begin_flight("c", "", {}) as writer:
            made = [fake_change(1, "c", east_m=60.0)]
            writer.commit([], {}, {"flight": "c"}, "<html></html>", changes=made)
        compare(archive, "b", changes)
        found = archive.register().findings
        assert {(*each.dates, each.gone, each.newest.moving) for each in found} == {
            ("a", "b", False),
            ("b", "", True),
            ("c", "", False),
        }
        assert between(archive.register(), "a", "b").endswith("1 thing left")


def test_history_states_what_the_comparison_states(folder: Path) -> None:
    """In its own sentence, less what a person rejected; and by both searches where a flight was mapped."""
    changes = [fake_change(1), replace(fake_change(2, east_m=30.0), class_after="person")]
    with Archive.open(folder, write=True) as archive:
        compare(archive, "b", changes)
    assert came_and_left(folder) == f"from a to b: {in_short(changes)}"
    with Archive.open(folder, write=True) as archive:
        archive.review(changes[1].id, Verdict.REJECTED)
    assert came_and_left(folder) == f"from a to b: {in_short(changes[:1])}"
    # whom the search of one date found, and that of the other did not
    outlines_m = np.array([[[-99, 99], [99, 99], [99, -99], [-99, -99]]] * 2, float)
    person = MapObject("a-o1", "person", 0.9, np.zeros(2), 0.3, 0.6, 0.4, 2, 2, SEEN_NS, SEEN_NS)
    search = ObjectSearch("default", ("person",), (), SearchedFrames(outlines_m), 2, 0, 0)
    with Archive.open(folder, write=True) as archive:
        for flight, objects, found in (("a", (person,), None), ("b", (), changes)):
            searched = replace(search, objects=objects)
            with archive.begin_flight(flight, "", {}) as writer:
                report = {"flight": flight, "comparison": found and fake_comparison()}
                writer.commit([frame(0)], {}, report, "", changes=found, search=searched)
        archive.review(changes[1].id, Verdict.REJECTED)
        (left,) = (each for each in found_features(archive, [], []) if each["properties"]["untold"])
    assert left["properties"]["untold"] == {"b": "disappeared"}
    assert (
        came_and_left(folder)
        == f"from a to b: {in_short(changes[:1])}; by the search alone: 1 person left"
    )
    with Archive.open(folder, write=True) as archive, archive.begin_flight("c", "", {}) as writer:
        writer.commit([frame(0)], {}, {"flight": "c"}, "<html></html>")
    assert "no objects were searched for on c" in came_and_left(folder)


def test_a_person_whom_a_comparison_alone_found_is_announced(folder: Path) -> None:
    """Who walks, and is found in no frame by itself: with the bell, in a line with the place, and to a station."""
    walks = fake_change(1, kind=ChangeKind.MOVING, velocity_m_s=(1.0, 0.0))
    with Archive.open(folder, write=True) as archive:
        compare(archive, "b", [replace(walks, class_after="person"), fake_change(2)])
    console = Console(force_terminal=True, highlight=False, file=(out := StringIO()))
    announce_people({"flight": "b", "objects": {"model": "default"}}, folder, console)
    assert out.getvalue().count("\a") == out.getvalue().count("PERSON FOUND") == 1
    assert " at 46.4999" in out.getvalue()
    lines = BytesIO()
    _add_people(Journal(lines), folder, ["a", "b"])
    (told,) = (json.loads(each) for each in lines.getvalue().splitlines())
    assert told["type"] == PERSON_FOUND and told["data"]["feature"]["properties"]["score"] == 0.8


@pytest.mark.usefixtures("kind")
def test_comparing_again_replaces_everything(folder: Path) -> None:
    with Archive.open(folder, write=True) as archive:
        for number in (1, 2):  # the second time other changes, without masks
            with archive.begin_flight("b", "", {}) as writer:
                if number == 1:
                    writer.save_masks(
                        "7",
                        np.zeros((4, 4), np.uint8),
                        np.ones((4, 4), bool),
                        np.zeros((0, 4), int),
                    )
                changes = [fake_change(number), fake_change(3, east_m=number)]
                more = {f"notes-{number}.txt": b"x"}
                writer.commit(
                    [], {}, {"flight": "b"}, "<html></html>", changes=changes, documents=more
                )
        assert [each.id for each in archive.changes()] == ["b-2", "b-3"]
        assert archive.changes()[1].centre_m[0] == pytest.approx(2)
    flight = folder / "flights" / "b"
    assert {path.name for path in flight.iterdir()} == {
        "frames.geojson",
        "report.json",
        "report.html",
        "changes.geojson",
        "changes.kml",
        "changes.gpx",
        "changes.html",
        "changes",
        "notes-2.txt",
    }
    assert {path.name for path in (flight / "changes").iterdir()} == {
        "b-2-before.png",
        "b-2-after.png",
        "b-3-before.png",
        "b-3-after.png",
    }
    assert [each["id"] for each in properties(folder)] == ["b-2", "b-3"]
    with Archive.open(folder, write=True) as archive:
        compare(archive, "b", None)
    assert {path.name for path in flight.iterdir()} == {
        "frames.geojson",
        "report.json",
        "report.html",
    }


@pytest.mark.usefixtures("kind")
def test_leaving_a_comparison_without_commit_changes_nothing(folder: Path) -> None:
    with Archive.open(folder, write=True) as archive:
        compare(archive, "b", [fake_change(1)])
        before = {path: path.read_bytes() for path in folder.glob("flights/**/*") if path.is_file()}
        with pytest.raises(ZeroDivisionError), archive.begin_flight("b", "", {}) as writer:
            writer.save_masks(
                "1", np.zeros((4, 4), np.uint8), np.ones((4, 4), bool), np.zeros((0, 4), int)
            )
            raise ZeroDivisionError
    assert {
        path: path.read_bytes() for path in folder.glob("flights/**/*") if path.is_file()
    } == before
    assert not (folder / "flights/b/staged").exists()


@pytest.mark.usefixtures("kind")
def test_files_that_a_commit_still_owed_are_written_by_the_next_opening(folder: Path) -> None:
    (folder / "flights/b/changes.geojson/in the way").mkdir(
        parents=True
    )  # as good as a kill: the commit stops here
    with Archive.open(folder, write=True) as archive:
        with pytest.raises(StoreError, match=r"changes\.geojson"):
            compare(archive, "b", [fake_change(1)])
        assert [each.id for each in archive.changes()] == ["b-1"]
    (folder / "flights/b/changes.geojson/in the way").rmdir()
    (folder / "flights/b/changes.geojson").rmdir()
    with Archive.open(folder, write=True):
        pass
    assert [each["id"] for each in properties(folder)] == ["b-1"]
    assert len(list((folder / "flights/b/changes").iterdir())) == 2
    assert (folder / "flights/b/changes.html").is_file()
    assert not (folder / "flights/b/staged").exists()


@pytest.mark.parametrize("bad", ["a/b", "", ".hidden"])
def test_an_id_must_name_a_file_once(folder: Path, bad: str) -> None:
    change = fake_change(1)
    object.__setattr__(change, "id", bad)
    with Archive.open(folder, write=True) as archive:
        with pytest.raises(StoreError, match="cannot name"):
            compare(archive, "b", [change])
        with pytest.raises(StoreError, match="two changes"):
            compare(archive, "b", [fake_change(1), fake_change(1)])
        compare(archive, "b", [fake_change(1)])
        with pytest.raises(StoreError, match="another flight"):
            compare(archive, "c", [fake_change(1, flight_id="b")])
        assert [each.flight_id for each in archive.changes()] == ["b"]
        assert [flight.id for flight in archive.flights()] == ["a", "b"]


@pytest.mark.usefixtures("kind")
def test_a_verdict_reaches_the_files_and_outlives_the_run(folder: Path) -> None:
    with Archive.open(folder, write=True) as archive:
        compare(archive, "b", [fake_change(1), fake_change(2, east_m=-8)], colour=90)
        archive.review("b-2", Verdict.CONFIRMED)
        archive.review(["b-1", "b-2"], Verdict.REJECTED, "Schatten <&>")
        archive.review("b-1", Verdict.CONFIRMED)
    assert [each["review"] for each in properties(folder)] == ["confirmed", "rejected"]
    page = (folder / "flights/b/changes.html").read_text()
    assert "1 confirmed and 1 rejected" in page and "Schatten &lt;&amp;&gt;" in page
    with Archive.open(folder, write=True) as archive:
        reported = {review.change_id: review for review in archive.reviews()}
        assert {each: reported[each].verdict.value for each in reported} == {
            "b-1": "confirmed",
            "b-2": "rejected",
        }
        assert (
            reported["b-2"].note == "Schatten <&>" and reported["b-2"].kind is ChangeKind.APPEARED
        )
        assert np.array_equal(reported["b-2"].outline_m, fake_change(2, east_m=-8).outline_m)
        # the same number on other ground was not reviewed; the same ground was
        compare(archive, "b", [fake_change(1, east_m=60), fake_change(2, east_m=-8.2)])
        assert [each.verdict for each in archive.changes()] == [None, Verdict.REJECTED]
        assert len(archive.reviews()) == 2
        compare(archive, "b", [])
        assert len(archive.reviews()) == 2


@pytest.mark.usefixtures("kind")
def test_an_unknown_id_is_named_and_nothing_is_changed(folder: Path) -> None:
    with Archive.open(folder, write=True) as archive:
        compare(archive, "b", [fake_change(1)])
        with pytest.raises(InputError, match="b-9"):
            archive.review(["b-1", "b-9"], Verdict.REJECTED)
        assert archive.reviews() == []
    with (
        Archive.open(folder, write=False) as archive,
        pytest.raises(StoreError, match="write=True"),
    ):
        archive.review("b-1", Verdict.REJECTED)


def test_masks_state_changed_unchanged_and_unknown(folder: Path) -> None:
    changed = np.zeros((6, 8), np.uint8)
    changed[2:4, 3:6] = 255
    valid = np.ones((6, 8), bool)
    valid[:, :2] = False
    with Archive.open(folder, write=True) as archive, archive.begin_flight("b", "", {}) as writer:
        writer.save_masks("12", changed, valid, np.array([[3, 2, 3, 2]]))
        writer.save_masks(
            "IMG_01.JPG", np.zeros((6, 8), np.uint8), valid, np.zeros((0, 4), np.int64)
        )
        assert not (folder / "flights/b/masks").exists()
        writer.commit([], {}, {}, "", changes=())
    masks = folder / "flights/b/masks"
    assert {path.name for path in masks.iterdir()} == {"12.png", "IMG_01.png", "boxes.json"}
    assert json.loads((masks / "boxes.json").read_text()) == {"12": [[3, 2, 3, 2]], "IMG_01": []}
    mask = cv2.imread(str(masks / "12.png"), cv2.IMREAD_UNCHANGED)
    assert mask.shape == (6, 8)
    assert np.array_equal(mask, np.where(valid, changed, 128))
    assert (
        write_view_masks(masks, "x", changed, valid).read_bytes() == (masks / "12.png").read_bytes()
    )


def test_frames_of_one_name_keep_a_mask_each() -> None:
    assert (
        mask_name("a.jpg") == "a"
        and mask_name("a.dng", {"a"}) == "a.dng"
        and mask_name("1.5") == "1.5"
    )
    assert "/" not in mask_name("../up.jpg")


def test_a_month_without_change_costs_no_tiles_and_little_else(folder: Path) -> None:
    blobs = set(folder.glob("tiles/*/*"))
    with Archive.open(folder, write=True) as archive:
        compare(archive, "day-0", [])
    before = (folder / "site.db").stat().st_size
    report = "<html>" + "x" * 1_000_000 + "</html>"  # it holds a picture
    for day in range(1, 11):
        with Archive.open(folder, write=True) as archive:
            compare(archive, f"day-{day}", [], report_html=report)
    assert set(folder.glob("tiles/*/*")) == blobs
    assert not list(folder.glob("flights/day-*/keyframes/*"))
    # the first report takes a place in the file that the others use again
    assert (folder / "site.db").stat().st_size - before - len(report) < 10 * 100_000
    assert (folder / "flights/day-7/report.html").read_text() == report
    with Archive.open(folder, write=False) as archive:
        newest = archive.versions()[-1]
        assert newest.tiles == 4 and archive.tile_difference(newest).changed == 0


def test_a_version_is_found_by_its_time_and_differs_by_its_tiles(folder: Path) -> None:
    with Archive.open(folder, write=True) as archive:
        compare(archive, "b", [fake_change(1)], colour=90)
        first, second = archive.versions()
        difference = archive.tile_difference(second)
        blob = max(folder.glob("tiles/*/*"), key=lambda path: path.stat().st_mtime_ns)
        assert (difference.changed, difference.removed, difference.changed_bytes) == (
            1,
            0,
            blob.stat().st_size,
        )
        assert archive.tile_difference(first).changed == 4
        # both were flown in 2023, whenever they were mapped
        assert [version.flown_utc[:10] for version in (first, second)] == ["2023-11-14"] * 2
        flown = datetime(2023, 11, 14, 22, 13, 21, tzinfo=UTC)
        assert (
            archive.version_at(flown).id == archive.version_at(flown.replace(tzinfo=None)).id == 2
        )
        with pytest.raises(InputError, match=r"had no map.*2023-11-14T22:13:20"):
            archive.version_at(flown - timedelta(seconds=2))
        for day in (flown.date(), str(flown.date()), f"{flown:%Y-%m-%dT%H:%M:%S}"):
            assert archive.version_at(day).id == 2
        with pytest.raises(SettingsError, match="'May' is not a date"):
            archive.version_at("May")
    page = (folder / "flights/b/changes.html").read_text()
    assert all(f"flight {each}, <time>flown 2023-11-14</time>" in page for each in "ab")
    with sqlite3.connect(folder / "site.db") as connection:  # flights whose clocks have no date
        connection.execute("UPDATE flown SET first_ns = 7, last_ns = 8")
    connection.close()
    seal_again(folder / "site.db")
    with Archive.open(folder, write=False) as archive:
        made = [datetime.fromisoformat(version.created_utc) for version in archive.versions()]
        assert (
            archive.version_at(made[0]).id
            == archive.version_at(made[1] - timedelta(milliseconds=1)).id
            == 1
        )
        assert archive.version_at(made[1]).id == archive.version_at(datetime.now(UTC)).id == 2
        assert {version.flown_utc for version in archive.versions()} == {""}
        with pytest.raises(InputError, match="had no map"):
            archive.version_at(made[0] - timedelta(seconds=1))
