"""OGC API Features: collections of a site, filtered and in pages; pictures of changes by their ids."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_flights import frame, image, tile
from starlette.testclient import TestClient

from sorvolo.station import crops
from sorvolo.station.reviews import crop_addresses
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import Verdict
from waiting import wait_for

ITEMS = "/api/sites/field/collections/{}/items"


def features(client: TestClient, name: str, **query: Any) -> list[dict[str, Any]]:
    """The features of a collection."""
    answer = client.get(ITEMS.format(name), params=query)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/geo+json"
    return answer.json()["features"]


def test_a_client_finds_its_way_from_the_landing_page(client: TestClient) -> None:
    """QGIS follows links: landing page, conformance, collections, items."""
    links = {each["rel"]: each["href"] for each in client.get("/api/sites/field").json()["links"]}
    assert all(
        each.startswith("http://127.0.0.1:8750/") for each in links.values()
    )  # QGIS 3.22 reads no relative ones
    assert client.get(links["service-desc"]).json()["openapi"]
    assert (
        "http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/core"
        in client.get(links["conformance"]).json()["conformsTo"]
    )
    found = client.get(links["data"]).json()["collections"]
    assert {each["id"]: each["count"] for each in found} == {
        "frames": 8,
        "objects": 0,
        "changes": 4,
        "findings": 4,
        "coverage": 0,
        "pod": 0,
        "track": 2,
    }
    west, south, east, north = found[0]["extent"]["spatial"]["bbox"][0]
    assert west < 13.25 < east and south < 46.5 < north
    items = next(each["href"] for each in found[0]["links"] if each["rel"] == "items")
    assert client.get(items).json()["numberMatched"] == 8
    assert all(
        each["href"].startswith(items) for each in client.get(f"{items}?limit=3").json()["links"]
    )
    assert client.get(items.replace("/items", "")).json()["id"] == "frames"


def test_a_map_that_grows_leaves_its_collections_as_they_are(
    client: TestClient, root: Path
) -> None:
    """Twice a second all of them were made anew; a flight that is complete, and a verdict, do change them."""
    kept = client.app.state.station.collections  # type: ignore[attr-defined]
    before = {name: kept.get("field", name) for name in ("frames", "changes")}
    with Archive.open(root / "field", write=True) as archive:
        with archive.begin_flight("c", "c", {}) as writer:
            for column in range(3):
                writer.tiles[column, 0] = tile(50 * column)
                writer.flush()
                assert all(kept.get("field", name) is made for name, made in before.items())
            writer.commit([frame(0)], {0: writer.save_image(0, image(0))}, {}, "")
        assert kept.get("field", "frames") is not before["frames"]
        assert kept.get("field", "changes") is not before["changes"]
        changes = kept.get("field", "changes")
        archive.review("b-1", Verdict.CONFIRMED)
    assert kept.get("field", "changes") is not changes


def test_pages_hold_every_feature_once(client: TestClient) -> None:
    """By the links to the next page."""
    address, seen = ITEMS.format("frames") + "?limit=3", []
    while address:
        page = client.get(address).json()
        assert page["numberReturned"] == len(page["features"]) <= 3
        seen += [each["id"] for each in page["features"]]
        address = next((each["href"] for each in page["links"] if each["rel"] == "next"), "")
    assert len(seen) == len(set(seen)) == 8


def test_filters(client: TestClient) -> None:
    """By box, time, class, score, flight, versions."""
    everything = features(client, "frames")
    corner = everything[0]["geometry"]["coordinates"][0][0]
    near = features(client, "frames", bbox=f"{corner[0]},{corner[1]},{corner[0]},{corner[1]}")
    assert 0 < len(near) < len(everything)
    assert features(client, "frames", bbox="0,0,1,1") == []
    assert (
        len(features(client, "frames", bbox="170,-80,169,80")) == 8
    )  # across the antimeridian, nearly all
    assert len(features(client, "frames", flight="a")) == 4
    assert len(features(client, "frames", datetime="2023-11-14T22:13:20Z/..")) == 8
    assert features(client, "frames", datetime="../2020-01-01T00:00:00Z") == []
    assert len(features(client, "changes", **{"class": "appeared"})) == 4
    assert features(client, "changes", **{"class": "car"}) == []
    assert features(client, "changes", min_score=0.9) == []
    assert len(features(client, "changes", from_version=1, to_version=2)) == 4
    assert features(client, "changes", from_version=2) == []
    one = features(client, "changes")[2]
    assert client.get(ITEMS.format("changes") + f"/{one['id']}").json()["id"] == one["id"]


@pytest.mark.parametrize(
    "query",
    [
        "bbox=1,2,3",
        "bbox=a,b,c,d",
        "bbox=1,9,2,3",
        "bbox=nan,0,1,1",
        "datetime=yesterday",
        "datetime=a/b/c",
        "limit=0",
        "limit=99999999",
        "offset=-1",
        "min_score=2",
        "from_version=-1",
    ],
)
def test_what_cannot_be_asked_is_refused_in_words(reader: TestClient, query: str) -> None:
    """400 or 422, never 500."""
    answer = reader.get(ITEMS.format("frames") + "?" + query)
    assert answer.status_code in (400, 422) and len(answer.json()["detail"]) > 20


def test_pictures_of_changes_and_of_places(client: TestClient) -> None:
    """Before and after; and cut from a key frame that shows the place."""
    change = features(client, "changes")[0]
    before, after = (client.get(each) for each in change["properties"]["crops"])
    assert before.headers["content-type"] == after.headers["content-type"] == "image/jpeg"
    assert before.content != after.content
    cut = client.get("/api/sites/field/crops/frame/a/1/5000/-4000.jpg")
    assert cut.status_code == 200 and cut.content[:2] == b"\xff\xd8"
    for missing in (
        "change/b-1/2.jpg",
        "change/nothing/0.jpg",
        "object/b-1/0.jpg",
        "frame/a/77/0/0.jpg",
        "frame/..%2f..%2fetc/0/0/0.jpg",
    ):
        assert client.get(f"/api/sites/field/crops/{missing}").status_code == 404, missing


def test_addresses_of_pictures_are_addresses() -> None:
    """Names of flights, and so of changes, may hold what ends a path."""
    address = crop_addresses("demo:site", "change", "flight #2-1")[1]
    assert address == "/api/sites/demo:site/crops/change/flight%20%232-1/1.jpg"


def test_pictures_that_are_cut_hold_up_nothing_else(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some browsers ask for strips of pictures: those that wait took all threads, and no tile was answered."""
    goes_on = threading.Event()

    def cut(*_: object) -> np.ndarray:
        goes_on.wait(120)
        return np.zeros((320, 320, 3), np.uint8)

    monkeypatch.setattr(crops, "cut", cut)
    with ThreadPoolExecutor(45) as browsers:
        asked = [
            browsers.submit(client.get, "/api/sites/field/crops/frame/a/1/5000/-4000.jpg")
            for _ in range(45)
        ]
        time.sleep(0.5)
        try:
            assert browsers_can_ask(client)
        finally:
            goes_on.set()
        assert {each.result().status_code for each in asked} == {200}


def browsers_can_ask(client: TestClient) -> bool:
    """Whether another request is answered while those wait."""
    answer: list[int] = []
    asking = threading.Thread(
        target=lambda: answer.append(client.get("/api/sites").status_code), daemon=True
    )
    asking.start()
    asking.join(30)
    return answer == [200]


def test_a_coverage_that_grows_is_announced(client: TestClient, root: Path) -> None:
    """So that a page shows the holes of the flight in the air without being asked."""
    station = client.app.state.station
    before = station.events.last

    def announced() -> list[str]:
        return [
            each["site"]
            for each in station.events.after(before)
            if each["type"] == "coverage.changed"
        ]

    for number, text in enumerate(['{"features": []}', '{"features": [] }'], start=1):
        (root / "field" / "live-coverage.geojson").write_text(text)
        wait_for(lambda number=number: len(announced()) >= number)
    assert announced() == ["field", "field"]
