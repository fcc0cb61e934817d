"""Several people judge: every verdict is kept with who and when, and nobody overwrites what they did not see."""

import shutil
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from fake_flights import SITE, map_flight
from starlette.testclient import TestClient
from watch_runs import PICTURE, watch_run

from sorvolo.missions.site.review import list_changes, review_changes
from sorvolo.station.app import station_app
from sorvolo.station.settings import StationSettings
from sorvolo.station.state import StationState
from sorvolo.station.tokens import make_token, revoke_token
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import Verdict
from waiting import wait_for

REVIEWS = "/api/sites/field/reviews"


def verdict(client: TestClient, change: str, word: str, **more: Any) -> Any:
    """What a POST gives back."""
    return client.post(
        REVIEWS,
        json={
            "kind": "change",
            "id": change,
            "verdict": word,
            **more,
        },
    )


def properties(client: TestClient, change: str) -> dict[str, Any]:
    """A change as the page gets it."""
    return client.get(f"/api/sites/field/collections/changes/items/{change}").json()["properties"]


def stored(root: Path, change: str) -> Verdict | None:
    """What missions are told of a change."""
    return next(each.verdict for each in list_changes(root / "field") if each.id == change)


def test_votes_reach_the_site_and_none_is_overwritten(client: TestClient, root: Path) -> None:
    """One person's last vote counts; all are kept."""
    made = verdict(client, "b-1", "confirmed", note="a shed", label="car")
    assert made.status_code == 201 and made.json()["revision"] == 1
    assert stored(root, "b-1") is Verdict.CONFIRMED
    assert verdict(client, "b-1", "unsure").json()["verdict"] == "unsure"
    assert stored(root, "b-1") is None
    assert verdict(client, "b-1", "rejected").json()["state"] == "single"
    assert stored(root, "b-1") is Verdict.REJECTED
    assert verdict(client, "b-1", "none").status_code == 201
    assert stored(root, "b-1") is None and properties(client, "b-1")["revision"] == 4
    history = client.get(REVIEWS, params={"id": "b-1"}).json()
    assert [(each["verdict"], each["label"]) for each in history] == [
        ("none", ""),
        ("rejected", ""),
        ("unsure", ""),
        ("confirmed", "car"),
    ]


def test_votes_of_two_people_agree_or_are_disputed(client: TestClient, root: Path) -> None:
    """`sorvolo review` beside the page is another person; missions are told nothing while they disagree."""
    verdict(client, "b-0", "confirmed")
    review_changes(root / "field", ["b-0"], Verdict.REJECTED, "a shadow")
    assert {**properties(client, "b-0"), "reviewed_at": 0}.items() >= {
        "review": "disputed",
        "review_state": "disputed",
        "note": "a shadow",
        "revision": 2,
        "reviewer": "sorvolo review",
    }.items()
    assert verdict(client, "b-0", "confirmed").json()["state"] == "disputed"
    assert stored(root, "b-0") is None
    agreed = verdict(client, "b-0", "rejected").json()
    assert (agreed["verdict"], agreed["state"]) == ("rejected", "agreed")
    assert stored(root, "b-0") is Verdict.REJECTED
    assert len(client.get(REVIEWS, params={"id": "b-0"}).json()) == 4


def test_a_new_site_has_no_verdicts_of_a_deleted_one_of_its_name(
    client: TestClient, root: Path, made_site: Path
) -> None:
    """Its changes have the same ids."""
    assert verdict(client, "b-1", "rejected", note="a shadow").status_code == 201
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
    assert verdict(client, "b-1", "confirmed").status_code == 201
    shutil.rmtree(root / "field")
    shutil.copytree(made_site, root / "field")  # the first one is back, such as from a backup
    wait_for(
        lambda: client.get("/api/sites/field/collections/changes/items/b-1").status_code == 200
    )
    assert properties(client, "b-1")["note"] == "a shadow"


def test_of_many_at_once_all_are_kept(client: TestClient) -> None:
    """Each is the next revision; one that is sent again is one."""
    codes: list[int] = []
    threads = [
        threading.Thread(
            target=lambda note: codes.append(
                verdict(client, "b-2", "confirmed", note=note).status_code
            ),
            args=(str(number),),
        )
        for number in range(6)
    ]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert codes == [201] * 6
    given = client.get(REVIEWS, params={"id": "b-2"}).json()
    assert [each["revision"] for each in given] == [6, 5, 4, 3, 2, 1]
    again = verdict(client, "b-2", "confirmed", note=given[0]["note"]).json()
    assert again["revision"] == 6 and len(client.get(REVIEWS, params={"id": "b-2"}).json()) == 6


def test_while_a_mission_writes_verdicts_wait_for_its_end(client: TestClient, root: Path) -> None:
    """They are kept and shown at once, and reach the site afterwards."""
    with Archive.open(root / "field", write=True) as archive:
        with archive.begin_flight("c", "c", {}):
            assert verdict(client, "b-3", "rejected").status_code == 201
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
            assert verdict(client, "b-3", "rejected").status_code == 201
        assert is_settled("b-3")
    with Archive.open(root / "field", write=True), opened() as client:
        assert verdict(client, "b-2", "rejected").status_code == 201
    with opened():
        assert is_settled("b-2")


def test_who_judged_is_the_name_of_the_token(root: Path) -> None:
    """Two people, two names; who may only look cannot judge, nor may one whose token was revoked."""
    state = StationState.open(root / "station")
    tokens = {
        name: make_token(state, name, role) for name, role in (("Ada", "review"), ("Ben", "view"))
    }
    state.close()
    with TestClient(station_app(StationSettings(root)), base_url="http://127.0.0.1:8750") as client:
        client.headers["authorization"] = f"Bearer {tokens['Ben']}"
        refused = verdict(client, "b-1", "confirmed")
        assert refused.status_code == 403 and "review" in refused.json()["detail"]
        client.headers["authorization"] = f"Bearer {tokens['Ada']}"
        assert verdict(client, "b-1", "confirmed").json()["who"] == "Ada"
        revoke_token(client.app.state.station.state, "Ada")  # type: ignore[attr-defined]
        assert verdict(client, "b-1", "rejected").status_code == 401


def test_unknown_things_and_impossible_verdicts(client: TestClient) -> None:
    """404 and 422."""
    assert verdict(client, "b-99", "confirmed").status_code == 404
    assert verdict(client, "b-1", "perhaps").status_code == 422
    assert verdict(client, "b-1", "confirmed", label="x" * 101).status_code == 422
    assert (
        client.post(
            "/api/sites/nowhere/reviews",
            json={"kind": "object", "id": "x", "verdict": "confirmed"},
        ).status_code
        == 404
    )


def test_what_a_watch_found_is_reviewed_as_all_findings_are(client: TestClient) -> None:
    """One list; a vote on a sighting is one on its finding."""
    watch_run(client.app.state.station, "run-1")
    items = "/api/sites/field/collections/findings/items"
    person, car, *things = client.get(items).json()["features"]
    assert {each["properties"]["class"] for each in things} == {"thing"}  # of unnamed changes
    assert person["properties"]["class"] == "person" and "path" not in person["properties"]
    assert person["properties"]["sightings"] == ["run-1:1"]
    assert client.get(person["properties"]["crops"][0]).content == PICTURE
    assert car["properties"]["crops"] == []
    wish = {"kind": "object", "id": "run-1:1", "verdict": "confirmed", "note": "a hiker"}
    assert client.post(REVIEWS, json=wish).json()["id"] == person["id"]
    assert client.post(REVIEWS, json={**wish, "id": "run-1:9"}).status_code == 404
    for name in ("findings", "objects"):
        found = client.get(f"/api/sites/field/collections/{name}/items?review=confirmed").json()
        assert [each["id"] for each in found["features"]] == [person["id"]]
    given = client.get(f"{REVIEWS}?kind=object").json()
    assert [(each["id"], each["verdict"], each["note"]) for each in given] == [
        (person["id"], "confirmed", "a hiker")
    ]


def test_two_watches_of_one_flight_find_each_thing_once(client: TestClient) -> None:
    """Whatever its clock states."""
    for run, day in (("run-1", "2026-05-01"), ("run-2", "2026-05-01"), ("run-3", "2031-05-01")):
        watch_run(client.app.state.station, run, day=day)
    found = client.get("/api/sites/field/collections/objects/items").json()["features"]
    assert [each["properties"]["class"] for each in found] == ["person", "car"]
    assert [sorted(each["properties"]["missions"]) for each in found] == [
        ["run-1", "run-2", "run-3"]
    ] * 2


def test_a_watch_needs_no_site_and_others_see_nothing_of_it(client: TestClient) -> None:
    results = watch_run(client.app.state.station, "run-2", site="nowhere-yet")
    items = "/api/sites/nowhere-yet/collections/findings/items"
    assert len(client.get(items).json()["features"]) == 2
    wish = {"kind": "object", "id": "run-2:2", "verdict": "rejected"}
    assert client.post("/api/sites/nowhere-yet/reviews", json=wish).status_code == 201
    assert client.get(items).json()["features"][1]["properties"]["review"] == "rejected"
    assert client.get("/api/sites/field/collections/objects/items").json()["features"] == []
    assert client.get("/api/sites/field/crops/finding/run-2:1/0.jpg").status_code == 404
    assert client.get("/api/sites/nothing/collections/findings/items").status_code == 404
    (results / "tracks.geojson").write_text("broken")
    assert client.get("/api/sites/field/collections/objects/items").json()["features"] == []
    (results / "tracks.geojson").unlink()  # of a watch that found nothing yet
    assert client.get(items).json()["features"] == []


def test_a_vote_on_what_a_watch_found_stays_when_the_flight_is_mapped(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its finding has another id then; and another watch, listed first, moves nothing."""
    watch_run(client.app.state.station, "run-1", site="new")
    wish = {"kind": "object", "id": "run-1:1", "verdict": "confirmed"}
    assert client.post("/api/sites/new/reviews", json=wish).status_code == 201
    watch_run(client.app.state.station, "run-2", site="new", place=(11.01, 46.0))
    assert _confirmed(client, "new") == ["run-1:1"]
    watch_run(client.app.state.station, "run-3")
    before = client.post(REVIEWS, json={**wish, "id": "run-3:1"}).json()
    flown_ns = 1_777_629_600 * 10**9  # 2026-05-01T10:00
    flown = [("a", 0, flown_ns, flown_ns + 10**12)]
    monkeypatch.setattr(Archive, "flown", lambda _: flown)
    client.app.state.station.collections._kept.clear()
    assert _confirmed(client, "field") == ["run-3:1"]
    given = client.get(REVIEWS, params={"kind": "object", "id": "run-3:1"}).json()
    assert len(given) == 1 and given[0]["id"] != before["id"]


def _confirmed(client: TestClient, site: str) -> list[str]:
    items = f"/api/sites/{site}/collections/findings/items?review=confirmed"
    found = client.get(items).json()["features"]
    return [each for feature in found for each in feature["properties"]["sightings"]]


def test_a_note_is_no_vote(client: TestClient) -> None:
    """Neither on what another confirmed nor on what is disputed."""
    review_changes(client.app.state.station.settings.root / "field", ["b-1"], Verdict.CONFIRMED)
    noted = client.post(REVIEWS, json={"kind": "change", "id": "b-1", "note": "look again"}).json()
    assert (noted["verdict"], noted["state"]) == ("confirmed", "single")
    assert verdict(client, "b-1", "rejected").json()["state"] == "disputed"
    noted = client.post(REVIEWS, json={"kind": "change", "id": "b-1", "note": "a shed"}).json()
    assert (noted["verdict"], noted["note"]) == ("disputed", "a shed")
