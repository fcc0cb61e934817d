"""Objects on disk: the files of a flight and of the site, what a later flight replaces, catalogues of older formats."""

import json
import math
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_flights import SITE, frame, image

from sorvolo.errors import StoreError
from sorvolo.findings.register import SearchedDate
from sorvolo.store.images import image_from_jpeg, jpeg_from_image
from sorvolo.store.pages.flight import objects_section
from sorvolo.store.site import schema
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.register import sighting_of
from sorvolo.survey.map_objects import MapObject, ObjectSearch, SearchedFrames

CROP = jpeg_from_image(image(3))


def thing(
    object_id: str, east_m: float, north_m: float, label: str = "car", **others: object
) -> MapObject:
    """A car, seen four times."""
    plain = MapObject(
        object_id,
        label,
        0.8,
        np.array([east_m, north_m]),
        0.2,
        4.4,
        1.8,
        4,
        5,
        1_700_000_000 * 10**9,
        1_700_000_009 * 10**9,
        class_scores={label: 1.0},
        best_frame="3",
        crop_jpeg=CROP,
    )
    return replace(plain, **others)


def search(
    objects: tuple[MapObject, ...],
    west_m: float = -50.0,
    east_m: float = 50.0,
    frames: int = 3,
    classes: tuple[str, ...] = ("person", "car"),
) -> ObjectSearch:
    """A search of some frames over one rectangle of ground."""
    outline = [[west_m, 50.0], [east_m, 50.0], [east_m, -50.0], [west_m, -50.0]]
    searched_for = {name: np.ones(frames, bool) for name in classes}
    searched = SearchedFrames(np.array([outline] * frames), searched_for)
    return ObjectSearch("fast", classes, objects, searched, frames, 9, 1)


def commit(folder: Path, flight: str, found: ObjectSearch | None) -> None:
    """Make a flight with one frame part of the site."""
    with Archive.open(folder, write=True) as archive:
        if not archive.has_site:
            archive.create_site(SITE)
        with archive.begin_flight(flight, flight, {}) as writer:
            paths = {0: writer.save_image(0, image(0))}
            writer.commit([frame(0)], paths, {}, "<p>report", search=found)


def features(path: Path) -> dict[str, dict[str, object]]:
    """The properties by the object's own id; a site's list names its findings."""
    return {
        each["properties"]["object"]: each["properties"]
        for each in json.loads(path.read_text())["features"]
    }


@pytest.mark.usefixtures("kind")
def test_files_of_a_flight_and_of_the_site(tmp_path: Path) -> None:
    """Both agree; the crops lie where they state."""
    commit(
        tmp_path,
        "a",
        search(
            (thing("a-o1", 3.0, 4.0), thing("a-o2", 9.0, -2.0, "person", length_m=float("nan")))
        ),
    )
    own, whole = (
        features(tmp_path / "flights/a/objects.geojson"),
        features(tmp_path / "objects.geojson"),
    )
    assert list(own) == list(whole) == ["a-o1", "a-o2"]
    assert own["a-o1"]["class"] == "car"
    assert own["a-o2"]["length_m"] is None
    assert own["a-o1"]["best_frame"] == 3  # as frames.geojson numbers a video's
    assert whole["a-o1"]["east_m"] == 3.0
    assert own["a-o1"]["first_seen"] == "2023-11-14T22:13:20.000000Z"
    north = json.loads((tmp_path / "objects.geojson").read_text())["features"][0]["geometry"][
        "coordinates"
    ][1]
    assert north == pytest.approx(46.5 + 4.0 / 111_170, abs=2e-6)
    for crop in (
        tmp_path / str(whole["a-o1"]["crop"]),
        tmp_path / "flights/a" / str(own["a-o1"]["crop"]),
    ):
        assert image_from_jpeg(crop.read_bytes(), "crop").shape == (54, 96, 3)


def test_the_register_that_is_kept_is_what_all_flights_state_at_once(tmp_path: Path) -> None:
    """Flights beside and over each other; one mapped again, which changes what came after it."""
    places_m = np.random.default_rng(2).uniform(-200, 200, (60, 2))
    shown = []
    for number, name in enumerate("abcdebf"):
        west_m = 90.0 * (number % 3) - 180
        near = np.flatnonzero(np.abs(places_m[:, 0] - west_m - 60) < 60)
        own = [
            thing(f"{name}-o{k}", *(places_m[k] + 0.1 * number), first_seen_ns=number + 1)
            for k in near
            if (k + number) % 4
        ]
        found = search(tuple(own), west_m, west_m + 120)
        registers = []
        if name in "bcde":  # as it will be with this flight
            new = (
                [sighting_of(each, name, math.inf) for each in own],
                [SearchedDate(name, math.inf, found.frames)],
            )
            with Archive.open(tmp_path, write=False) as archive:
                registers = [archive.register(*new), archive.register(*new, set("abcdef"))]
        for register in registers:
            shown.append([(each.id, each.gone, len(each.sightings)) for each in register.findings])
        assert not registers or shown[-1] == shown[-2]
        commit(tmp_path, name, found)
        with Archive.open(tmp_path, write=False) as archive:
            kept, whole = archive.register(), archive.register(flights=set("abcdef"))
        for register in (kept, whole):
            shown.append(
                [
                    [each.id, each.gone, each.class_sums, *each.position_m, *each.known_m]
                    + [(one.id, one.date, one.origin) for one in each.sightings]
                    for each in register.findings
                ]
            )
        assert shown[-1] == shown[-2]
    assert {each[1] for each in shown[-1]} > {"", "f"}


def test_a_person_is_new_to_the_first_flight_alone(tmp_path: Path) -> None:
    """Who stands there still is no news; who came, or has another place, is."""
    here, there = thing("a-o1", 3.0, 4.0, "person"), thing("a-o2", 9.0, -2.0, "person")
    commit(tmp_path, "a", search((here, there)))
    stays = replace(here, id="b-o1", position_m=np.array([3.1, 4.2]))
    came = replace(here, id="b-o2", position_m=np.array([-20.0, 4.0]))
    commit(tmp_path, "b", search((stays, came)))
    with Archive.open(tmp_path, write=False) as archive:
        people = {name: archive.new_people(name) for name in "ab"}
        known = {
            seen.id: each.id for each in archive.register().findings for seen in each.sightings
        }
    assert [len(each) for each in people.values()] == [2, 1]
    assert people["b"][0]["id"] == known["b-o2"] != known["b-o1"] == known["a-o1"]


@pytest.mark.usefixtures("kind")
def test_a_later_flight_replaces_what_it_looked_at(tmp_path: Path) -> None:
    """Gone where two of its frames looked and found nothing, kept where none looked, older where it still stands."""
    commit(
        tmp_path,
        "a",
        search((thing("a-o1", 3.0, 4.0), thing("a-o2", 9.0, -2.0), thing("a-o3", -30.0, 0.0))),
    )
    first_id = features(tmp_path / "objects.geojson")["a-o1"]["id"]
    later = thing(
        "b-o1", 3.3, 4.1, first_seen_ns=1_700_090_000 * 10**9, last_seen_ns=1_700_090_009 * 10**9
    )
    commit(tmp_path, "b", search((later,), west_m=-10.0))
    site = features(tmp_path / "objects.geojson")
    assert list(site) == ["a-o3", "b-o1"]
    assert site["b-o1"]["flights"] == ["a", "b"]
    assert site["b-o1"]["first_seen"] == "2023-11-14T22:13:20.000000Z"
    assert features(tmp_path / "flights/b/objects.geojson")["b-o1"]["flights"] == ["b"]
    assert site["b-o1"]["id"] == first_id, "a later flight leaves a finding's id as it is"
    with Archive.open(tmp_path, write=False) as archive:
        assert [each.thing.id for each in archive.newest_objects({"a"})] == ["a-o1", "a-o2", "a-o3"]
        assert [each.date for each in archive.searches()] == ["a", "b"]


def test_one_frame_does_not_take_away(tmp_path: Path) -> None:
    """One of a later flight's frames may have missed it; a flight of one frame counts as it is."""
    commit(tmp_path, "a", search((thing("a-o1", 3.0, 4.0),)))
    mixed = search((), west_m=100.0, east_m=200.0, frames=2)
    outlines_m = np.concatenate([mixed.frames.outlines_m, search(()).frames.outlines_m[:1]])
    commit(tmp_path, "b", replace(mixed, frames=SearchedFrames(outlines_m)))
    assert list(features(tmp_path / "objects.geojson")) == ["a-o1"]
    commit(tmp_path, "c", search((), frames=1))
    assert list(features(tmp_path / "objects.geojson")) == []


@pytest.mark.usefixtures("kind")
def test_a_flight_replaces_only_the_classes_that_it_looked_for(tmp_path: Path) -> None:
    """A person found from low above stays where a later flight was too high for people, and asked for cars alone."""
    commit(tmp_path, "a", search((thing("a-o1", 3.0, 4.0), thing("a-o2", 9.0, -2.0, "person"))))
    commit(tmp_path, "b", search((), classes=("car",)))
    assert list(features(tmp_path / "objects.geojson")) == ["a-o2"]
    both = {"car": np.array([True, True, True]), "person": np.array([False, True, False])}
    once = search(())
    commit(
        tmp_path,
        "c",
        replace(
            once,
            frames=SearchedFrames(
                once.frames.outlines_m[:2], {name: rows[:2] for name, rows in both.items()}
            ),
        ),
    )
    assert list(features(tmp_path / "objects.geojson")) == [], (
        "one frame looked for people, and it was the only one"
    )
    with Archive.open(tmp_path, write=False) as archive:
        stored = archive.searches()
    assert [len(each.frames.for_class("person")) for each in stored] == [3, 0, 1]
    assert [len(each.frames.for_class("car")) for each in stored] == [3, 3, 2]


@pytest.mark.usefixtures("kind")
def test_mapped_again_without_a_model(tmp_path: Path) -> None:
    """The former run's files go with it, crops and all."""
    commit(tmp_path, "a", search((thing("a-o1", 3.0, 4.0),)))
    commit(tmp_path, "a", None)
    assert not (tmp_path / "objects.geojson").exists()
    assert not (tmp_path / "flights/a/objects.geojson").exists()
    assert not (tmp_path / "flights/a/objects").exists()


@pytest.mark.usefixtures("kind")
def test_what_was_deleted_is_made_again(tmp_path: Path) -> None:
    """The catalogue is the truth."""
    commit(tmp_path, "a", search((thing("a-o1", 3.0, 4.0),)))
    (tmp_path / "objects.geojson").unlink()
    with Archive.open(tmp_path, write=True):
        pass
    assert list(features(tmp_path / "objects.geojson")) == ["a-o1"]


def test_a_site_of_a_later_format_is_refused(tmp_path: Path) -> None:
    """Its files stay as they are."""
    commit(tmp_path, "a", None)
    connection = sqlite3.connect(tmp_path / "site.db")
    connection.execute(f"PRAGMA user_version = {schema.FORMAT + 1}")
    connection.close()
    with pytest.raises(StoreError, match="format version"):
        Archive.open(tmp_path, write=True)


def test_section_of_the_report() -> None:
    """Text is escaped; without a model it states why nothing was looked for; old reports have no section."""
    row = {
        "id": "a-o1",
        "class": "<i>",
        "score": 0.8,
        "east_m": 1.0,
        "north_m": 2.0,
        "sigma_m": None,
        "views": 3,
    }
    placed = {**row, "id": "a-o2", "sigma_m": 0.534}
    headline = {"text": "1 <i>; 3 of 3 pictures looked at"}
    reported = {"model": "fast", "headline": headline, "list": [row, placed]}
    page = objects_section({"objects": reported}, {"a-o1": CROP})
    assert "<i>" not in page
    assert "1 &lt;i&gt;" in page
    assert page.count(">+1.0, +2.0<") == 2 and ">0.5 m<" in page
    placed_page = objects_section({"objects": reported}, {}, SITE)
    assert (
        ">46.500018, 13.250013<" in placed_page
        and ">33T UM" in placed_page
        and ">UTM<" in placed_page
    )
    assert "data:image/jpeg;base64," in page
    assert "no model was wanted" in objects_section(
        {"objects": {"model": None, "why_not": "no model was wanted"}}, {}
    )
    assert objects_section({}, {}) == ""
