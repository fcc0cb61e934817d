"""The memory of a place: who saw it, when, what was found there; pictures cut from key frames and from videos."""

import shutil
import time
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from fake_changes import fake_change
from fake_flights import frame, image
from starlette.testclient import TestClient

from sorvolo.station.cut_video import frame_of
from sorvolo.store.site.archive import Archive
from waiting import wait_for


def test_every_flight_that_saw_a_place_is_remembered_in_order(
    client: TestClient, root: Path
) -> None:
    """With the changes that were found there and the verdicts on them."""
    with (
        Archive.open(root / "field", write=True) as archive,
        archive.begin_flight("c", "c", {}) as writer,
    ):
        paths = {0: writer.save_image(0, image(0))}
        writer.commit(
            [frame(0)], paths, {}, "", changes=[fake_change(1, "c", east_m=0.0, north_m=5.0)]
        )
    change = client.get("/api/sites/field/collections/changes/items/c-1").json()
    longitude, latitude = np.mean(change["geometry"]["coordinates"][0][:-1], axis=0)
    client.post(
        "/api/sites/field/reviews",
        json={
            "kind": "change",
            "id": "c-1",
            "verdict": "confirmed",
            "note": "a shed",
        },
    )
    rows = client.get("/api/sites/field/place", params={"lon": longitude, "lat": latitude}).json()
    assert {each["flight"] for each in rows} == {"a", "b", "c"}
    assert [each["time"] for each in rows] == sorted(each["time"] for each in rows)
    for each in rows:
        assert ("c-1" in {one["id"] for one in each["changes"]}) == (each["flight"] == "c")
        assert [one["verdict"] for one in each["reviews"]] == (
            ["confirmed"] if each["flight"] == "c" else []
        )
        picture = client.get(each["crop_url"])
        assert picture.status_code == 200
        assert cv2.imdecode(np.frombuffer(picture.content, np.uint8), 1).shape == (320, 320, 3)
    few = client.get(
        "/api/sites/field/place", params={"lon": longitude, "lat": latitude, "most_per_flight": 1}
    ).json()
    assert len(few) == 3


@pytest.mark.parametrize("query", ["lon=0&lat=0", "lon=-170&lat=80"])
def test_nobody_saw_other_places(reader: TestClient, query: str) -> None:
    """An empty list."""
    assert reader.get(f"/api/sites/field/place?{query}").json() == []


@pytest.mark.parametrize("query", ["lon=0", "lat=91&lon=0", "lat=a&lon=0", "lat=nan&lon=0"])
def test_what_is_no_place(reader: TestClient, query: str) -> None:
    """422 in words."""
    assert reader.get(f"/api/sites/field/place?{query}").status_code == 422


def test_the_frame_of_a_number_is_that_frame(tmp_path: Path) -> None:
    """In the middle of a group of pictures, too."""
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w") as file:
        stream = file.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number in range(20):
            file.mux(
                stream.encode(
                    av.VideoFrame.from_ndarray(np.full((48, 64, 3), 12 * number, np.uint8))
                )
            )
        file.mux(stream.encode())
    for number in (0, 7, 13, 19):
        assert abs(float(frame_of(str(path), number).mean()) - 12 * number) < 4, number
    with pytest.raises(ValueError, match="no frame"):
        frame_of(str(path), 400)


def test_all_sites_are_asked_at_once(client: TestClient, root: Path, made_site: Path) -> None:
    """By an index that the station makes and keeps: a flight that came since is found, a site that went is not."""
    shutil.copytree(made_site, root / "more" / "field")
    wait_for(lambda: client.get("/api/sites/more:field").status_code == 200)
    place = {"lon": 0.0, "lat": 0.0}
    for each in client.get("/api/sites/field/collections/frames/items").json()["features"][:1]:
        place["lon"], place["lat"] = np.mean(each["geometry"]["coordinates"][0][:-1], axis=0)
    rows = client.get("/api/place", params=place).json()
    assert {(each["site"], each["flight"]) for each in rows} == {
        (site, flight) for site in ("field", "more:field") for flight in ("a", "b")
    }
    assert all(each["frames"] and each["best_frame"] for each in rows)
    with (
        Archive.open(root / "field", write=True) as archive,
        archive.begin_flight("c", "c", {}) as writer,
    ):
        writer.commit([frame(0)], {0: writer.save_image(0, image(0))}, {}, "")
    shutil.rmtree(root / "more" / "field")
    time.sleep(1.1)  # the station looks for sites once a second
    rows = client.get("/api/place", params=place).json()
    assert {(each["site"], each["flight"]) for each in rows} == {
        ("field", flight) for flight in "abc"
    }
    assert client.get("/api/place", params={"lon": 170, "lat": 80}).json() == []


def test_an_index_of_no_use_is_named_and_one_site_does_without(
    client: TestClient, root: Path
) -> None:
    frames = client.get("/api/sites/field/collections/frames/items").json()["features"]
    place = dict(
        zip(
            ("lon", "lat"),
            np.mean(frames[0]["geometry"]["coordinates"][0][:-1], axis=0),
            strict=True,
        )
    )
    with_index = client.get("/api/sites/field/place", params=place).json()
    (root / "archive-index.db").write_bytes(b"nothing of ours")
    answer = client.get("/api/place", params=place)
    assert answer.status_code == 503
    assert "archive-index.db" in answer.json()["title"] + answer.json()["detail"]
    assert client.get("/api/sites/field/place", params=place).json() == with_index != []
