"""Uploads by tus: resumed, limited, looked into apart; what is cut off, of a wrong kind or a bomb is refused."""

import asyncio
import base64
import io
import os
import shutil
import sys
import threading
import time
import zipfile
from collections.abc import AsyncIterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image
from starlette.testclient import TestClient

from sorvolo.station import check_upload, uploads
from sorvolo.station.app import station_app
from sorvolo.station.check_upload import UploadRefusal, look
from sorvolo.station.problems import Problem
from sorvolo.station.runs import Run
from sorvolo.station.settings import StationLimits, StationSettings
from sorvolo.station.uploads import Child

HEADERS = {"Tus-Resumable": "1.0.0"}
GIGA = 10**9


def begin(client: TestClient, name: str, length: int) -> Any:
    """The answer to a creation."""
    text = "filename " + base64.b64encode(name.encode()).decode()
    return client.post(
        "/api/uploads", headers={**HEADERS, "Upload-Length": str(length), "Upload-Metadata": text}
    )


def send(client: TestClient, address: str, offset: int, data: bytes) -> Any:
    """The answer to a PATCH."""
    return client.patch(
        address,
        content=data,
        headers={
            **HEADERS,
            "Upload-Offset": str(offset),
            "Content-Type": "application/offset+octet-stream",
        },
    )


def checked(client: TestClient, address: str) -> dict[str, Any]:
    """An upload once it was looked into."""
    for _ in range(600):
        state = client.get(address).json()
        if state["state"] not in ("receiving", "checking"):
            return state
        time.sleep(0.05)
    raise AssertionError(state)


def video(path: Path, frames: int = 6, **options: str) -> bytes:
    """A small video."""
    with av.open(str(path), "w", format="mp4", options=options) as file:
        stream = file.add_stream("mpeg4", rate=5)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number in range(frames):
            picture = np.full((48, 64, 3), 30 * number, np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        file.mux(stream.encode())
    return path.read_bytes()


def photo(width: int = 40, kind: str = "JPEG") -> bytes:
    """A small picture."""
    data = io.BytesIO()
    Image.new("RGB", (width, 30), (9, 90, 9)).save(data, kind)
    return data.getvalue()


def packed(path: Path, files: dict[str, bytes], **info: Any) -> Path:
    """A zip file."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = info.get("mode", 0o100644) << 16
            archive.writestr(entry, data)
    return path


def test_a_flight_comes_in_pieces_and_is_ready(client: TestClient, tmp_path: Path) -> None:
    """Cut in the middle, asked after, continued where it ended; then looked into by a process of its own."""
    data = video(tmp_path / "v.mp4")
    address = begin(client, "C:\\fake\\DJI_0001.MP4", len(data)).headers["location"]
    assert send(client, address, 0, data[:1000]).headers["upload-offset"] == "1000"
    assert send(client, address, 500, data[500:]).status_code == 409
    where = client.head(address)
    assert where.headers["upload-offset"] == "1000" and where.headers["upload-length"] == str(
        len(data)
    )
    assert where.headers["cache-control"] == "no-store"
    assert send(client, address, 1000, data[1000:]).status_code == 204
    done = checked(client, address)
    assert (
        done["state"] == "ready"
        and done["name"] == "DJI_0001.MP4"
        and done["facts"]["width_px"] == 64
    )
    here = client.app.state.station.uploads  # type: ignore[attr-defined]
    assert here.finished_path(done["id"]).read_bytes() == data
    assert client.delete(address).status_code == 204 and client.get(address).status_code == 404
    assert not list(here._folder.glob("*"))


def test_an_upload_that_a_mission_reads_is_not_deleted(client: TestClient) -> None:
    """As its flight, its telemetry or its camera; once the mission is over it may go."""
    runs = client.app.state.station.runs  # type: ignore[attr-defined]
    runs.close()
    addresses = [
        begin(client, f"{name}.srt", 5).headers["location"] for name in ("flight", "log", "other")
    ]
    flight, log, _ = (each.rpartition("/")[2] for each in addresses)
    run = Run(
        "1" * 16,
        "map",
        "new",
        "running",
        "Ada",
        "2026-01-01T00:00:00Z",
        input={"upload": flight},
        options={"telemetry": {"upload": log}},
    )
    runs._begin(run)
    assert [client.delete(each).status_code for each in addresses] == [423, 423, 204]
    assert "Ada" in client.delete(addresses[0]).json()["detail"]
    runs._keep(replace(run, state="finished"), [])
    assert [client.delete(each).status_code for each in addresses[:2]] == [204, 204]


def test_a_cut_off_video_is_refused_and_cannot_be_flown(client: TestClient, tmp_path: Path) -> None:
    """Its announced length was wrong: nothing in it can be decoded."""
    data = video(tmp_path / "v.mp4")[:700]
    address = begin(client, "cut.mp4", len(data)).headers["location"]
    send(client, address, 0, data)
    done = checked(client, address)
    assert done["state"] == "refused" and "cut off" in done["why"]
    answer = client.post(
        "/api/runs", json={"mission": "map", "site": "x", "input": {"upload": done["id"]}}
    )
    assert answer.status_code == 409 and "cut off" in answer.json()["detail"]


def test_of_a_video_that_was_cut_it_is_stated_how_much_is_missing(
    client: TestClient, tmp_path: Path
) -> None:
    """Its head comes first, so what is there can be used: of a drone that was lost there is no more."""
    data = video(tmp_path / "v.mp4", movflags="faststart")
    for cut in (0, 100):
        address = begin(client, "cut.mp4", len(data) - cut).headers["location"]
        send(client, address, 0, data[: len(data) - cut])
        done = checked(client, address)
        assert done["state"] == "ready" and done["facts"]["missing_bytes"] == cut


def test_what_tus_can_do_and_what_is_not_taken(client: TestClient) -> None:
    """Size, kind, names, more bytes than announced."""
    about = client.options("/api/uploads").headers
    assert about["tus-version"] == "1.0.0" and "creation" in about["tus-extension"]
    assert begin(client, "flight.exe", 10).status_code == 415
    assert begin(client, "map.vrt", 10).status_code == 415
    assert begin(client, "..", 10).status_code == 400
    assert begin(client, "a.mp4", 10**14).status_code == 413
    assert begin(client, "a.srt", GIGA).status_code == 413
    assert begin(client, "a.mp4", 0).status_code == 422
    broken = {"Upload-Length": "5", "Upload-Metadata": "filename %%%"}
    assert client.post("/api/uploads", headers=broken).status_code == 400
    address = begin(client, "a.srt", 5).headers["location"]
    assert send(client, address, 0, b"123456").status_code == 413
    assert (
        client.patch(
            address, content=b"x", headers={"Upload-Offset": "0", "Content-Type": "text/plain"}
        ).status_code
        == 415
    )
    assert client.head("/api/uploads/../../x").status_code in (404, 405)
    assert client.get("/api/uploads/" + "0" * 24).status_code == 404


def test_so_many_uploads_are_kept_and_no_more(root: Path) -> None:
    """As many as the station's limits state; deleting one makes room."""
    settings = StationSettings(root, limits=StationLimits(most_uploads=1))
    with TestClient(station_app(settings), base_url="http://127.0.0.1:8750") as client:
        address = begin(client, "a.srt", 5).headers["location"]
        answer = begin(client, "b.srt", 5)
        assert answer.status_code == 409 and "1 uploads" in answer.json()["detail"]
        client.delete(address)
        assert begin(client, "b.srt", 5).status_code == 201


def test_the_floor_of_free_space_holds(root: Path) -> None:
    """Nothing is taken in below it."""
    with TestClient(
        station_app(StationSettings(root, free_floor_gb=1e6)), base_url="http://127.0.0.1:8750"
    ) as client:
        answer = begin(client, "a.mp4", 10)
        assert answer.status_code == 507 and "free" in answer.json()["detail"]


def test_what_is_announced_needs_its_room_too(client: TestClient, monkeypatch: Any) -> None:
    usage = shutil.disk_usage("/")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=20 * GIGA))
    answers = [begin(client, f"{each}.mp4", 8 * GIGA) for each in "abc"]
    assert [each.status_code for each in answers] == [201, 201, 507]
    assert f"{24 * GIGA / 1e9:.1f} GB of uploads are to come" in answers[2].text
    folder = client.app.state.station.settings.state_folder
    for part in folder.rglob("*"):  # nothing came since yesterday: they were given up
        os.utime(part, (time.time() - 86_400,) * 2)
    assert begin(client, "d.mp4", 8 * GIGA).status_code == 201


@pytest.mark.parametrize(
    ("name", "state"), [("x.csv", "refused"), ("x.json.zip", "ready"), ("x.mp4.zip", "ready")]
)
def test_a_name_decides_what_an_upload_is(
    client: TestClient, tmp_path: Path, name: str, state: str
) -> None:
    data = packed(tmp_path / "part", {"a.jpg": photo()}).read_bytes()
    address = begin(client, name, len(data)).headers["location"]
    assert send(client, address, 0, data).status_code == 204
    done = checked(client, address)
    assert done["state"] == state
    if state == "ready":
        assert done["facts"]["photos"] == 1


def test_the_floor_holds_for_every_piece_and_for_what_is_unpacked(
    client: TestClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk may fill between two pieces of a few megabytes, which alone are never looked at."""
    address = begin(client, "a.srt", 5).headers["location"]
    part = packed(tmp_path / "part", {"a.jpg": photo()})
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=GIGA))
    assert send(client, address, 0, b"1").status_code == 507
    with pytest.raises(UploadRefusal, match="are there; delete"):
        look(part, tmp_path / "photos", GIGA, 2 * GIGA)
    assert not (tmp_path / "photos").exists()


def test_a_link_that_fell_silent_holds_up_nobody(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A radio link ends without a word: the next request goes on where the first one was left."""
    monkeypatch.setattr(uploads, "_SILENT_S", 0.05)
    address = begin(client, "a.srt", 5).headers["location"]
    here = client.app.state.station.uploads  # type: ignore[attr-defined]

    async def chunks() -> AsyncIterator[bytes]:
        yield b"12"
        await asyncio.sleep(60)

    with pytest.raises(Problem, match="nothing came"):
        asyncio.run(here.take(here.get(address.rpartition("/")[2]), 0, chunks()))
    assert send(client, address, 2, b"345").status_code == 204


def test_a_station_that_ends_while_it_looks_into_an_upload_looks_again(root: Path) -> None:
    """Ctrl-C reaches the whole terminal: the upload was refused, and its bytes were gone."""
    with TestClient(station_app(StationSettings(root)), base_url="http://127.0.0.1:8750") as client:
        client.app.state.station.uploads._child.end()  # type: ignore[attr-defined]
        address = begin(client, "a.srt", 5).headers["location"]
        assert send(client, address, 0, b"12345").status_code == 204
    with TestClient(station_app(StationSettings(root)), base_url="http://127.0.0.1:8750") as client:
        assert checked(client, address)["state"] == "ready"


def test_the_process_that_looks_is_out_of_the_terminals_reach_and_ends_with_the_station() -> None:
    """In a session of its own; killed at the end, so that the station need not wait for it."""
    child = Child()
    assert (
        child.run([sys.executable, "-c", "import os; print(os.getsid(0) == os.getpid())"], 30)
        == b"True\n"
    )
    threading.Timer(0.2, child.end).start()
    began_s = time.monotonic()
    assert child.run([sys.executable, "-c", "import time; time.sleep(60)"], 60) == b""
    assert time.monotonic() - began_s < 20 and child.run(["true"], 1) == b""


def test_photos_are_unpacked_into_one_folder(tmp_path: Path) -> None:
    """Files of the same name in two folders stay two; what is no photo is left out."""
    part = packed(
        tmp_path / "p",
        {
            "one/DJI_1.JPG": photo(),
            "two/DJI_1.JPG": photo(50),
            "two/DJI_2.tif": photo(kind="TIFF"),
            "run.sh": b"rm",
            "__MACOSX/._DJI_1.JPG": b"x",
            "one/log.csv": b"a,b",
        },
    )
    facts = look(part, tmp_path / "photos", GIGA)
    assert facts == {"kind": "photos", "photos": 3}
    assert sorted(each.name for each in (tmp_path / "photos").iterdir()) == [
        "DJI_1.JPG",
        "DJI_2.tif",
        "log.csv",
        "two_DJI_1.JPG",
    ]


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"../../evil.jpg": photo()}, "outside"),
        ({"/etc/evil.jpg": photo()}, "outside"),
        ({"C:\\evil.jpg": photo()}, "outside"),
        ({"..\\evil.jpg": photo()}, "outside"),
        (
            {"map.tif": b"<VRTDataset><SourceFilename>/etc/passwd</SourceFilename></VRTDataset>"},
            "no picture",
        ),
        ({"a.jpg": b"\0" * 20_000_000}, "no photo does"),
        ({"readme.txt": b"x"}, "no photo in it"),
        ({"a.heic": b"nothing of the kind"}, "no HEIC"),
        ({"a.jpg": photo()[:40]}, "no picture"),
    ],
)
def test_zip_files_made_to_do_harm(tmp_path: Path, files: dict[str, bytes], words: str) -> None:
    """Zip slip, disguises, bombs: refused, and nothing is written outside."""
    target = tmp_path / "deep" / "photos"
    target.parent.mkdir()
    with pytest.raises(UploadRefusal, match=words):
        look(packed(tmp_path / "part", files), target, GIGA)
    outside = [
        each for each in tmp_path.rglob("*") if each.is_file() and target not in each.parents
    ]
    assert [each.name for each in outside] == ["part"]


def test_links_in_zip_files_and_sizes_that_lie(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A link could lead anywhere; what an archive announces is not trusted."""
    with pytest.raises(UploadRefusal, match="link"):
        look(
            packed(tmp_path / "part", {"a.jpg": b"/etc/passwd"}, mode=0o120777),
            tmp_path / "photos",
            GIGA,
        )
    with pytest.raises(UploadRefusal, match="taken"):
        look(packed(tmp_path / "large", {"a.jpg": photo(900)}), tmp_path / "photos", 100)
    monkeypatch.setattr(check_upload, "_MOST_PIXELS", 100)
    with pytest.raises(UploadRefusal, match="pixels"):
        look(packed(tmp_path / "wide", {"a.jpg": photo()}), tmp_path / "wide-photos", GIGA)


@pytest.mark.parametrize(
    "data",
    [
        b"#EXTM3U\nfile:///etc/passwd\n",
        b"ffconcat version 1.0\nfile /etc/passwd",
        b"",
        bytes(range(130, 194)),
    ],
)
def test_playlists_named_as_videos(tmp_path: Path, data: bytes) -> None:
    """FFmpeg would open what they name."""
    (tmp_path / "part").write_bytes(data)
    with pytest.raises(UploadRefusal):
        look(tmp_path / "part", tmp_path / "flight.mp4", GIGA)


LIMITED = """
import sys
from sorvolo.station import check_upload
def look(part, *_):
    {work}
check_upload.look = look
check_upload._MEMORY_BYTES, check_upload._CPU_S = 1 << 30, 1
check_upload.main(*sys.argv[1:5])
"""


@pytest.mark.parametrize(
    ("work", "within_s", "words"),
    [
        ("bytearray(2 << 30)", 60.0, "more memory than a flight needs"),
        ("while True: pass", 60.0, "more memory or time than a flight needs"),
        ("import time; time.sleep(60)", 1.0, "took too long"),
    ],
)
def test_the_process_that_looks_has_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, work: str, within_s: float, words: str
) -> None:
    """Of memory, of processor time and of time: whatever a decoder does with an upload, it is refused in words."""
    monkeypatch.setattr(uploads, "_CHECK_WITHIN_S", within_s)
    child = Child()

    def run(command: Sequence[str], timeout_s: float) -> bytes:
        return child.run([command[0], "-c", LIMITED.format(work=work), *command[4:]], timeout_s)

    error, facts = uploads.checked_apart(tmp_path / "part", tmp_path / "a.mp4", GIGA, 0, run)
    assert error is not None and words in error and facts is None
