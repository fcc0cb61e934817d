"""Sites deleted by the API: what would be lost is stated first, nobody else's work goes, nothing outside is touched."""

import fcntl
import os
import shutil
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import pytest
from fake_flights import SITE, map_flight
from starlette.testclient import TestClient
from watch_runs import watch_run

from sorvolo.station.app import station_app
from sorvolo.station.orders import LOCK_FILE
from sorvolo.station.runs import Run
from sorvolo.station.settings import StationSettings
from sorvolo.station.state import StationState, compact_json, utc_now
from sorvolo.station.tokens import make_token
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import POINTER
from sorvolo.store.site.files import COPYING, ORIGIN
from waiting import wait_for

HOST = "http://127.0.0.1:8750"
FIELD = "/api/sites/field"


def mark_of(client: TestClient, path: str = FIELD) -> dict[str, str]:
    """The header with which a site as it is now can be deleted."""
    return {"if-match": client.get(f"{path}/deletion").headers["etag"]}


def keep_run(client: TestClient, run: str, state: str) -> IO[str]:
    """A watch of the site `field` in some state, as the station keeps it; its lock: held, as by the run's process."""
    station = client.app.state.station  # type: ignore[attr-defined]
    lock = (watch_run(station, run).parent / LOCK_FILE).open("w")
    fcntl.flock(lock, fcntl.LOCK_EX)
    record = asdict(Run(run, "watch", "field", state, "ada", utc_now()))
    with station.state.changing() as connection:
        connection.execute(
            "UPDATE runs SET state = ?, record = ? WHERE id = ?", (state, compact_json(record), run)
        )
    return lock


def events(client: TestClient) -> list[tuple[str, str | None]]:
    """The types of all events, with their sites."""
    return [(each["type"], each["site"]) for each in client.app.state.station.events.after(0)]  # type: ignore[attr-defined]


def test_a_site_goes_with_all_that_the_station_keeps_of_it(
    client: TestClient, root: Path, made_site: Path
) -> None:
    """Its size is stated before; every page hears of it; a new site of its name knows nothing of it."""
    shutil.copytree(made_site, root / "other")
    keep_run(client, "feed", "finished")
    body = {"kind": "change", "id": "b-1", "verdict": "confirmed"}
    assert client.post(f"{FIELD}/reviews", json=body).status_code == 201
    assert client.put(f"{FIELD}/drawings", json={"revision": 0, "features": []}).status_code == 200
    wait_for(lambda: len(client.get("/api/sites").json()) == 2)
    answer = client.get(f"{FIELD}/deletion")
    loss = answer.json()
    on_disk = [each.stat().st_size for each in (root / "field").rglob("*") if each.is_file()]
    assert (loss["flights"], loss["versions"], loss["missions"]) == (2, 2, 1)
    assert loss["files"] == len(on_disk) and loss["bytes"] == sum(on_disk)
    assert client.delete(FIELD, headers={"if-match": answer.headers["etag"]}).status_code == 204
    assert not (root / "field").exists() and not list((root / "station" / "deleted").iterdir())
    assert client.get(FIELD).status_code == 404 and client.get("/api/runs").json() == []
    assert not (root / "station" / "runs" / "feed").exists() and not list(
        (root / "station" / "drawings").iterdir()
    )
    assert client.app.state.station.state.rows("SELECT * FROM reviews") == []  # type: ignore[attr-defined]
    wait_for(lambda: ("site.gone", "field") in events(client))
    assert [each["id"] for each in client.get("/api/sites").json()] == ["other"]
    with Archive.open(root / "field", write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "b", 90, compared=True)
    wait_for(lambda: client.get(FIELD).status_code == 200)
    assert client.get(f"{FIELD}/reviews").json() == []


def test_what_was_not_looked_at_is_not_deleted(client: TestClient, root: Path) -> None:
    """428 without its mark, 412 where a flight came since."""
    assert client.delete(FIELD).status_code == 428
    assert client.delete(FIELD, headers={"if-match": "*"}).status_code == 412
    before = mark_of(client)
    with Archive.open(root / "field", write=True) as archive:
        map_flight(archive, "c", 60)
    assert client.delete(FIELD, headers=before).status_code == 412
    assert (root / "field" / "site.db").is_file()
    assert client.delete(FIELD, headers=mark_of(client)).status_code == 204


def test_a_site_that_is_used_stays(client: TestClient, root: Path) -> None:
    """By a mission of the station, or by another program that writes it."""
    mark = mark_of(client)
    keep_run(client, "feed", "finished")
    lock = os.open(root / "station" / "runs" / "feed" / "running.lock", os.O_RDWR | os.O_CREAT)
    fcntl.flock(lock, fcntl.LOCK_EX)  # it has stated its end, and its process is still there
    for answer in (client.get(f"{FIELD}/deletion"), client.delete(FIELD, headers=mark)):
        assert answer.status_code == 409 and "a watch that ada started" in answer.json()["detail"]
    os.close(lock)
    with Archive.open(root / "field", write=True):
        for answer in (client.get(f"{FIELD}/deletion"), client.delete(FIELD, headers=mark)):
            assert answer.status_code == 409 and "another program writes" in answer.json()["detail"]
    assert (root / "field" / "site.db").is_file()
    assert client.delete(FIELD, headers=mark).status_code == 204


@pytest.mark.parametrize("name", [POINTER, ORIGIN, COPYING])
def test_a_folder_that_is_not_the_whole_of_a_site_stays(
    client: TestClient, root: Path, name: str
) -> None:
    """Its catalogue, or its truth, lies elsewhere; or it is still being copied."""
    mark = mark_of(client)
    (root / "field" / name).write_text("{}")
    if name == POINTER:
        (root / "field" / "site.db").unlink()
    assert client.delete(FIELD, headers=mark).status_code == 409
    assert (root / "field" / "mosaic.tif").is_file()


def test_the_served_folder_itself_stays(made_site: Path, tmp_path: Path) -> None:
    """It holds the station's own files, too."""
    shutil.copytree(made_site, tmp_path / "field")
    with TestClient(station_app(StationSettings(tmp_path / "field")), base_url=HOST) as client:
        assert client.get(f"{FIELD}/deletion").status_code == 409
        assert client.delete(FIELD, headers={"if-match": "x"}).status_code == 409
    assert (tmp_path / "field" / "site.db").is_file()


def test_a_damaged_site_can_be_deleted(client: TestClient, root: Path) -> None:
    """All the more."""
    client.app.state.station.shelf.forget("field")  # type: ignore[attr-defined]
    (root / "field" / "site.db").write_bytes(b"no database")
    found = client.get(f"{FIELD}/deletion").json()
    assert found["flights"] is None and found["versions"] is None and found["bytes"] > 0
    assert client.delete(FIELD, headers=mark_of(client)).status_code == 204
    assert not (root / "field").exists()


@pytest.mark.parametrize("role", ["view", "review"])
def test_who_may_not_start_missions_deletes_nothing(root: Path, role: str) -> None:
    with closing(StationState.open(root / "station")) as state:
        token = make_token(state, "Ada", role)
    with TestClient(station_app(StationSettings(root)), base_url=HOST) as client:
        client.headers["authorization"] = f"Bearer {token}"
        assert client.get(FIELD).status_code == 200
        assert client.get(f"{FIELD}/deletion").status_code == 403
        assert client.delete(FIELD, headers={"if-match": "x"}).status_code == 403


@pytest.mark.parametrize(
    "name",
    [
        "..",
        "%2e%2e",
        "..%2f..%2foutside",
        "%2e%2e:outside",
        "..:outside",
        "field%2f..%2f..%2foutside",
        "field%2f..",
        "station",
        "streams",
        ".",
        "%00",
        "field%00",
        "linked",
        "field%3alinked",
        "%2fetc",
    ],
)
def test_no_name_leads_outside(
    client: TestClient, root: Path, made_site: Path, tmp_path: Path, name: str
) -> None:
    """Not by a path, not by a link to a site that lies elsewhere."""
    shutil.copytree(made_site, tmp_path / "outside")
    (root / "linked").symlink_to(tmp_path / "outside")
    (root / "streams").mkdir()
    before = sorted(tmp_path.rglob("*"))
    for path in (f"/api/sites/{name}", f"/api/sites/{name}/"):
        answer = client.delete(path, headers={"if-match": "x"}, follow_redirects=False)
        assert answer.status_code in (400, 404, 405, 307), name
    assert client.get(f"/api/sites/{name}/deletion").status_code in (400, 404, 405)
    kept: list[Any] = [each for each in before if "station" not in each.parts]
    assert all(each.exists() for each in kept)


def test_links_in_a_site_go_and_what_they_lead_to_stays(
    client: TestClient, root: Path, tmp_path: Path
) -> None:
    mark = mark_of(client)
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "film.mp4").write_bytes(bytes(1000))
    (root / "field" / "flights" / "more").symlink_to(outside)
    (root / "field" / "film.mp4").symlink_to(outside / "film.mp4")
    assert client.delete(FIELD, headers=mark).status_code == 204
    assert not (root / "field").exists() and (outside / "film.mp4").stat().st_size == 1000


def test_a_folder_that_became_a_link_meanwhile_is_not_emptied(
    client: TestClient, root: Path, made_site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By somebody who may write below the root, between the last look and the deletion."""
    outside = tmp_path / "outside"
    shutil.copytree(made_site, outside)
    mark = mark_of(client)
    rename = Path.rename

    def swapped(self: Path, target: Path) -> Path:
        rename(self, tmp_path / "taken")
        self.symlink_to(outside)
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", swapped)
    client.delete(FIELD, headers=mark)
    assert (outside / "site.db").is_file() and (outside / "mosaic.tif").is_file()


def test_what_a_killed_station_had_begun_to_delete_goes_when_the_next_one_starts(
    root: Path,
) -> None:
    (root / "station" / "deleted").mkdir(parents=True)
    (root / "field").rename(root / "station" / "deleted" / "half")
    with TestClient(station_app(StationSettings(root)), base_url=HOST) as client:
        assert client.get("/api/sites").json() == []
    assert not (root / "station" / "deleted").exists()


def test_a_site_is_renamed_and_its_addresses_stay(client: TestClient, root: Path) -> None:
    """As everybody sees it, at once; its rows keep their seals; not while a mission runs."""
    assert client.put(f"{FIELD}/name", json={"name": "Pré fleuri"}).status_code == 204
    assert client.get(FIELD).json()["name"] == "Pré fleuri"
    assert [each["name"] for each in client.get("/api/sites").json()] == ["Pré fleuri"]
    with Archive.open(root / "field", write=False) as archive:
        assert archive.site().name == "Pré fleuri"
    for wrong in ("", " ", "n" * 81):
        assert client.put(f"{FIELD}/name", json={"name": wrong}).status_code == 422
    assert client.put("/api/sites/nowhere/name", json={"name": "x"}).status_code == 404
    with keep_run(client, "feed", "running"):
        assert client.put(f"{FIELD}/name", json={"name": "x"}).status_code == 409
