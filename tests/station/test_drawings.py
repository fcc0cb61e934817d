"""Drawings that all pages of a site share: kept, numbered, never overwritten unseen."""

import re
import shutil
import time
from datetime import datetime
from pathlib import Path

from fake_flights import SITE
from starlette.testclient import TestClient

from sorvolo.station.state import utc_after
from sorvolo.store.site.archive import Archive
from waiting import wait_for

URL = "/api/sites/field/drawings"


def zone(name: str, **more: object) -> dict:
    ring = [[12.0, 41.0], [12.001, 41.0], [12.001, 41.001], [12.0, 41.0]]
    properties = {"purpose": "alert", "name": name, **more}
    geometry = {"type": "Polygon", "coordinates": [ring]}
    return {"type": "Feature", "id": name, "geometry": geometry, "properties": properties}


def test_drawings_are_kept_with_a_revision_and_announced(client: TestClient) -> None:
    events = client.app.state.station.events
    before = events.last
    assert client.get(URL).json() == {"type": "FeatureCollection", "revision": 0, "features": []}
    answer = client.put(URL, json={"revision": 0, "features": [zone("a")]})
    assert (answer.status_code, answer.json()["revision"]) == (200, 1)
    assert client.get(URL).json()["features"][0]["geometry"]["coordinates"][0][1] == [12.001, 41.0]
    types = [
        each["type"] for each in events.after(before)
    ]  # among others', such as of a site seen for the first time
    assert types.count("drawings.changed") == 1


def test_what_a_person_marks_as_found_is_a_finding(client: TestClient) -> None:
    """Of the newest flight before it, named by who saw it; a detector's silence does not end it."""
    items = "/api/sites/field/collections/objects/items"
    mark = zone("seen", purpose="found")
    mark["geometry"] = {"type": "Point", "coordinates": [13.2501, 46.5001]}
    dog = {**mark, "id": "dog", "properties": {**mark["properties"], "label": "dog"}}
    dog["geometry"] = {"type": "Point", "coordinates": [13.2502, 46.5001]}
    assert client.put(URL, json={"revision": 0, "features": [mark, dog]}).status_code == 200
    person, other = client.get(items).json()["features"]
    assert (person["properties"]["class"], other["properties"]["class"]) == ("person", "dog")
    assert person["properties"]["origins"] == ["marked"]
    assert person["properties"]["flights"] == ["b"] and person["properties"]["crops"] == []
    assert person["geometry"]["coordinates"] == [13.2501, 46.5001]
    vote = {"kind": "object", "id": "seen", "verdict": "confirmed"}
    reviews = "/api/sites/field/reviews"
    assert client.post(reviews, json=vote).json()["id"] == person["id"]
    assert client.put(URL, json={"revision": 1, "features": []}).status_code == 200
    assert client.get(items).json()["features"] == []


def test_a_drawing_that_waited_has_the_time_when_it_was_drawn(client: TestClient) -> None:
    """As its page states it, once; not where that is no moment, lies ahead, or is of a wrong clock."""
    hour_ago = utc_after(-3600)
    times = [hour_ago, "", "when?", utc_after(3600), "2001-01-01T00:00:00Z", "0001-01-01"]
    zones = [zone(str(number), at=each) for number, each in enumerate(times)]
    answer = client.put(URL, json={"revision": 0, "features": zones}).json()
    drawn = [each["properties"]["at"] for each in answer["features"]]
    assert abs(when(drawn[0]) - when(hour_ago)) < 0.1
    assert all(-60 < when(each) - time.time() <= 0 for each in drawn[1:])
    again = [zone("0", at=utc_after(-9))]
    answer = client.put(URL, json={"revision": 1, "features": again}).json()
    assert answer["features"][0]["properties"]["at"] == drawn[0]


def when(moment: str) -> float:
    return datetime.fromisoformat(moment).timestamp()


def test_what_an_earlier_station_drew_can_be_kept_on(client: TestClient, root: Path) -> None:
    """It knew no time of drawing."""
    client.put(URL, json={"revision": 0, "features": [zone("a")]})
    (kept,) = (path for path in root.rglob("*.json") if '"purpose"' in path.read_text())
    kept.write_text(re.sub(r',"at":"[^"]*"', "", kept.read_text()))
    assert client.put(URL, json={"revision": 1, "features": [zone("a")]}).status_code == 200


def test_what_somebody_drew_meanwhile_is_not_overwritten(client: TestClient) -> None:
    client.put(URL, json={"revision": 0, "features": [zone("a")]})
    answer = client.put(URL, json={"revision": 0, "features": [zone("b")]})
    assert (answer.status_code, answer.json()["revision"]) == (409, 1)
    assert [each["id"] for each in client.get(URL).json()["features"]] == ["a"]


def test_what_is_no_drawing_is_refused(client: TestClient) -> None:
    far = zone("far")
    far["geometry"]["coordinates"][0][0] = [999, 0]
    for wrong in (far, zone("x", purpose="bomb"), zone("y", more="z"), zone("n" * 81)):
        assert client.put(URL, json={"revision": 0, "features": [wrong]}).status_code == 422
    assert client.get("/api/sites/nowhere/drawings").status_code == 404


def test_a_new_site_has_none_of_a_deleted_one_of_its_name(
    client: TestClient, root: Path, made_site: Path
) -> None:
    client.put(URL, json={"revision": 0, "features": [zone("old")]})
    shutil.rmtree(root / "field")
    time.sleep(0.01)
    with Archive.open(root / "field", write=True) as archive:
        archive.create_site(SITE)
    wait_for(
        lambda: client.get(URL).status_code == 200
    )  # it may have been looked for while it was gone
    assert client.get(URL).json() == {"type": "FeatureCollection", "revision": 0, "features": []}
    assert client.put(URL, json={"revision": 0, "features": [zone("new")]}).json()["revision"] == 1
    shutil.rmtree(root / "field")
    shutil.copytree(
        made_site, root / "field"
    )  # the first site is back, and what was drawn since is not of it
    wait_for(lambda: client.get(URL).status_code == 200)
    assert client.get(URL).json()["features"] == []
