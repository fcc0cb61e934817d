"""Drawings that all pages of a site share: kept, numbered, never overwritten unseen."""

from starlette.testclient import TestClient

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
    types = [each["type"] for each in events.after(before)]  # among others', such as of a site seen for the first time
    assert types.count("drawings.changed") == 1


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
