"""Several people judge: every verdict is kept with who and when, and nobody overwrites what they did not see."""

import shutil
import threading
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from fake_flights import SITE, map_flight
from starlette.testclient import TestClient
from watch_runs import PICTURE, watch_run

from sorvolo.missions.site.review import list_changes, review_changes
from sorvolo.station.app import station_app
from sorvolo.station.settings import StationSettings
from sorvolo.station.state import StationState, utc_now
from sorvolo.station.tokens import make_token
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import Verdict
from waiting import wait_for

REVIEWS = "/api/sites/field/reviews"


def verdict(client: TestClient, change: str, word: str, revision: int, **more: Any) -> Any:
    """What a POST gives back."""
    return client.post(
        REVIEWS,
        json={
            "kind": "change",
            "id": change,
            "verdict": word,
            "revision": revision,
            **more,
        },
    )


def properties(client: TestClient, change: str) -> dict[str, Any]:
    """A change as the page gets it."""
    return client.get(f"/api/sites/field/collections/changes/items/{change}").json()["properties"]


def test_a_verdict_reaches_the_site_and_a_stale_one_is_refused(
    client: TestClient, root: Path
) -> None:
    """409 carries the current verdict, so that a person can look at it."""
    made = verdict(client, "b-1", "confirmed", 0, note="a shed")
    assert made.status_code == 201 and made.json()["revision"] == 1
    assert [
        (each.verdict, each.note) for each in list_changes(root / "field") if each.id == "b-1"
    ] == [(Verdict.CONFIRMED, "a shed")]
    late = verdict(client, "b-1", "rejected", 0)
    assert late.status_code == 409 and late.json()["current"]["verdict"] == "confirmed"
    assert properties(client, "b-1")["review"] == "confirmed"
    assert verdict(client, "b-1", "none", 1).status_code == 201
    assert next(each for each in list_changes(root / "field") if each.id == "b-1").verdict is None
    assert properties(client, "b-1")["revision"] == 2
    history = client.get(REVIEWS, params={"id": "b-1"}).json()
    assert [(each["verdict"], each["revision"]) for each in history] == [
        ("none", 2),
        ("confirmed", 1),
    ]


def test_verdicts_of_the_command_line_are_seen_and_counted(client: TestClient, root: Path) -> None:
    """`sorvolo review` beside the page: its verdict is the newest then."""
    verdict(client, "b-0", "confirmed", 0)
    review_changes(root / "field", ["b-0"], Verdict.REJECTED, "a shadow")
    assert {**properties(client, "b-0"), "reviewed_at": 0}.items() >= {
        "review": "rejected",
        "note": "a shadow",
        "revision": 2,
        "reviewer": "sorvolo review",
    }.items()
    assert verdict(client, "b-0", "confirmed", 1).status_code == 409
    assert verdict(client, "b-0", "confirmed", 2).json()["revision"] == 3
    assert len(client.get(REVIEWS, params={"id": "b-0"}).json()) == 3


def test_a_new_site_has_no_verdicts_of_a_deleted_one_of_its_name(
    client: TestClient, root: Path, made_site: Path
) -> None:
    """Its changes have the same ids."""
    assert verdict(client, "b-1", "rejected", 0, note="a shadow").status_code == 201
    shutil.rmtree(root / "field")
    time.sleep(0.01)  # a site's time of creation has milliseconds
    with Archive.open(root / "field", write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "a", 40)
        map_flight(archive, "b", 90, compared=True)
    wait_for(
        lambda: client.get("/api/sites/field").status_code == 200
    )  # it may have been looked for while it was gone
    assert properties(client, "b-1")["review"] is None and client.get(REVIEWS).json() == []
    assert all(each.verdict is None for each in list_changes(root / "field"))
    assert verdict(client, "b-1", "confirmed", 0).status_code == 201
    shutil.rmtree(root / "field")
    shutil.copytree(made_site, root / "field")  # the first one is back, such as from a backup
    wait_for(
        lambda: client.get("/api/sites/field/collections/changes/items/b-1").status_code == 200
    )
    assert properties(client, "b-1")["note"] == "a shadow"


def test_verdicts_of_a_station_of_format_1_are_kept(root: Path) -> None:
    """They are of the site that was there when they were given."""
    with closing(StationState.open(root / "station")) as state, state.changing() as connection:
        connection.execute("DROP TABLE reviews")
        connection.execute(
            "CREATE TABLE reviews (number INTEGER PRIMARY KEY AUTOINCREMENT, site TEXT NOT NULL, kind TEXT NOT NULL, "
            "id TEXT NOT NULL, revision INTEGER NOT NULL, verdict TEXT NOT NULL, note TEXT NOT NULL, "
            "who TEXT NOT NULL, at TEXT NOT NULL, UNIQUE (site, kind, id, revision))"
        )
        for change, at in (("b-0", "2001-01-01T00:00:00.000Z"), ("b-1", utc_now())):
            connection.execute(
                "INSERT INTO reviews (site, kind, id, revision, verdict, note, who, at) "
                "VALUES ('field', 'change', ?, 1, 'confirmed', '', 'Ada', ?)",
                (change, at),
            )
        connection.execute("PRAGMA user_version = 1")
    with TestClient(station_app(StationSettings(root)), base_url="http://127.0.0.1:8750") as client:
        assert (
            properties(client, "b-1")["review"] == "confirmed"
            and properties(client, "b-0")["review"] is None
        )
        assert [each["id"] for each in client.get(REVIEWS).json()] == ["b-1"]


def test_of_many_at_once_one_wins(client: TestClient) -> None:
    """The others get a conflict, so nothing is lost."""
    codes: list[int] = []
    threads = [
        threading.Thread(
            target=lambda: codes.append(verdict(client, "b-2", "confirmed", 0).status_code)
        )
        for _ in range(6)
    ]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert sorted(codes) == [201, 409, 409, 409, 409, 409]


def test_while_a_mission_writes_verdicts_wait_for_its_end(client: TestClient, root: Path) -> None:
    """They are kept and shown at once, and reach the site afterwards."""
    with Archive.open(root / "field", write=True) as archive:
        with archive.begin_flight("c", "c", {}):
            assert verdict(client, "b-3", "rejected", 0).status_code == 201
            assert properties(client, "b-3")["review"] == "rejected"
        map_flight(archive, "d", 20, count=1)
    assert client.app.state.station.reviews.settle("field")  # type: ignore[attr-defined]
    assert (
        next(each for each in list_changes(root / "field") if each.id == "b-3").verdict
        is Verdict.REJECTED
    )


def test_a_verdict_waits_for_a_mission_that_fails_and_for_a_station_that_ends(root: Path) -> None:
    """No new version of the map comes then, which used to be what settled it."""

    def is_settled(change_id: str) -> bool:
        until_s = time.monotonic() + 10
        while time.monotonic() < until_s:
            if (
                next(each for each in list_changes(root / "field") if each.id == change_id).verdict
                is Verdict.REJECTED
            ):
                return True
            time.sleep(0.1)
        return False

    def opened() -> TestClient:
        return TestClient(station_app(StationSettings(root)), base_url="http://127.0.0.1:8750")

    with opened() as client:
        with Archive.open(root / "field", write=True):
            assert verdict(client, "b-3", "rejected", 0).status_code == 201
        assert is_settled("b-3")
    with Archive.open(root / "field", write=True), opened() as client:
        assert verdict(client, "b-2", "rejected", 0).status_code == 201
    with opened():
        assert is_settled("b-2")


def test_who_judged_is_the_name_of_the_token(root: Path) -> None:
    """Two people, two names; who may only look cannot judge."""
    state = StationState.open(root / "station")
    tokens = {
        name: make_token(state, name, role) for name, role in (("Ada", "review"), ("Ben", "view"))
    }
    state.close()
    with TestClient(station_app(StationSettings(root)), base_url="http://127.0.0.1:8750") as client:
        client.headers["authorization"] = f"Bearer {tokens['Ben']}"
        refused = verdict(client, "b-1", "confirmed", 0)
        assert refused.status_code == 403 and "review" in refused.json()["detail"]
        client.headers["authorization"] = f"Bearer {tokens['Ada']}"
        assert verdict(client, "b-1", "confirmed", 0).json()["who"] == "Ada"


def test_unknown_things_and_impossible_verdicts(client: TestClient) -> None:
    """404 and 422."""
    assert verdict(client, "b-99", "confirmed", 0).status_code == 404
    assert verdict(client, "b-1", "perhaps", 0).status_code == 422
    assert verdict(client, "b-1", "confirmed", -1).status_code == 422
    assert (
        client.post(
            "/api/sites/nowhere/reviews",
            json={"kind": "object", "id": "x", "verdict": "confirmed", "revision": 0},
        ).status_code
        == 404
    )


def test_what_a_watch_found_is_reviewed_as_changes_are(client: TestClient) -> None:
    watch_run(client.app.state.station, "run-1")
    items = "/api/sites/field/collections/findings/items"
    person, car = client.get(items).json()["features"]
    assert (person["id"], person["properties"]["class"], "path" in person["properties"]) == (
        "run-1:1",
        "person",
        False,
    )
    assert client.get(person["properties"]["crops"][0]).content == PICTURE
    assert car["properties"]["crops"] == []
    wish = {
        "kind": "finding",
        "id": "run-1:1",
        "verdict": "confirmed",
        "note": "a hiker",
        "revision": 0,
    }
    assert client.post(REVIEWS, json=wish).json()["revision"] == 1
    assert client.post(REVIEWS, json={**wish, "verdict": "rejected"}).status_code == 409
    assert client.post(REVIEWS, json={**wish, "id": "run-1:9"}).status_code == 404
    assert [each["id"] for each in client.get(f"{items}?review=confirmed").json()["features"]] == [
        "run-1:1"
    ]
    given = client.get(f"{REVIEWS}?kind=finding").json()
    assert [(each["id"], each["verdict"], each["note"]) for each in given] == [
        ("run-1:1", "confirmed", "a hiker")
    ]
    assert [each["id"] for each in client.get(REVIEWS).json()] == ["run-1:1"]


def test_a_watch_needs_no_site_and_others_see_nothing_of_it(client: TestClient) -> None:
    results = watch_run(client.app.state.station, "run-2", site="nowhere-yet")
    items = "/api/sites/nowhere-yet/collections/findings/items"
    assert len(client.get(items).json()["features"]) == 2
    wish = {"kind": "finding", "id": "run-2:2", "verdict": "rejected", "revision": 0}
    assert client.post("/api/sites/nowhere-yet/reviews", json=wish).status_code == 201
    assert client.get(items).json()["features"][1]["properties"]["review"] == "rejected"
    assert client.get("/api/sites/field/collections/findings/items").json()["features"] == []
    assert client.get("/api/sites/field/crops/finding/run-2:1/0.jpg").status_code == 404
    assert client.get("/api/sites/nothing/collections/findings/items").status_code == 404
    (results / "tracks.geojson").write_text("broken")
    assert client.get("/api/sites/field/collections/findings/items").json()["features"] == []
