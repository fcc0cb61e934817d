"""A watch's folder: who may write into it, what its files hold, that lines outlive a kill, and the annotated video."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from sorvolo.errors import StoreError, UnavailableError
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.store.exports.annotated import AnnotatedVideo, annotated, write_annotated
from sorvolo.store.exports.detection_files import (
    DetectionLines,
    claimed_folder,
    crop_around,
    detection_row,
    track_placemarks,
    tracks_collection,
    write_crop,
    write_detections,
)
from sorvolo.survey.flight import Frame, Site
from sorvolo.survey.objects import Sighting, Track

_NOW_NS = 1_780_000_000_000_000_000
_SITE = Site("field", Geodetic(41.9, 12.6, 0.0), "EPSG:32633", 0.02)
_LOCAL = Site("clip", Geodetic(0.0, 0.0), "", 1.0, is_local=True)
_FRAME = Frame(3, "3", _NOW_NS, np.zeros((100, 200, 3), np.uint8))


def _sighting() -> Sighting:
    return Sighting(
        3,
        "3",
        _NOW_NS,
        "person",
        0.8,
        np.array([10, 20, 30, 60], np.float32),
        np.array([100.0, 200.0]),
        np.diag([4.0, 1.0]),
        np.array([1.0, 0.5]),
    )


def _track(**changes: Any) -> Track:
    track = Track(
        7,
        "person",
        0.82,
        True,
        False,
        _NOW_NS,
        _NOW_NS + 10**9,
        5,
        2,
        np.array([100.0, 200.0]),
        np.diag([4.0, 1.0]),
        np.zeros(2),
        np.array([1.0, 0.5]),
        _sighting(),
        np.array([[100.0, 199.0], [100.0, 200.0]]),
        np.array([_NOW_NS, _NOW_NS + 10**9]),
        {"person": 0.9, "car": 0.1},
    )
    return replace(track, **changes)


def claimed(folder: Path, source: str, fingerprint: str, *, replaces: bool = True) -> None:
    with claimed_folder(folder, source, fingerprint, replaces=replaces):
        pass


def test_a_folder_has_one_writer(tmp_path: Path) -> None:
    folder = tmp_path / "watch"
    with claimed_folder(folder, "DJI_1", "abc"):
        (folder / "detections.jsonl").write_text("{}\n")
        with pytest.raises(UnavailableError, match="another process writes its watch into"):
            claimed(folder, "DJI_1", "abc")
        assert (folder / "detections.jsonl").exists()
    (folder / "watch.json").unlink()
    (folder / "detections.jsonl").unlink()
    (folder / "watch.lock").touch()  # of one that was killed
    claimed(folder, "DJI_2", "abd")
    assert [path.name for path in folder.iterdir()] == ["watch.json"]


def test_a_folder_belongs_to_one_source(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "watch"
    claimed(folder, "DJI_1", "abc")
    (folder / "detections.jsonl").write_text("{}\n")
    (folder / "objects").mkdir()
    (folder / "objects" / "1.jpg").write_bytes(b"x")
    (folder / "my notes.txt").write_text("keep")
    claimed(folder, "DJI_1", "abc")
    assert sorted(path.name for path in folder.iterdir()) == ["my notes.txt", "watch.json"]
    for source, fingerprint, replaces in (
        ("DJI_2", "abc", True),
        ("DJI_1", "abd", True),
        ("DJI_1", "abc", False),
    ):
        with pytest.raises(StoreError, match="holds a watch of DJI_1"):
            claimed(folder, source, fingerprint, replaces=replaces)


def test_other_peoples_folders_and_files_stay(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(StoreError, match="no earlier watch"):
        claimed(tmp_path, "DJI_1", "abc")
    with pytest.raises(StoreError, match="is a file"):
        claimed(tmp_path / "thesis.txt", "DJI_1", "abc")
    (tmp_path / "watch.json").write_text('["not ours"]')
    with pytest.raises(StoreError, match="no earlier watch"):
        claimed(tmp_path, "DJI_1", "abc")
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


def test_lines_become_points(tmp_path: Path) -> None:
    placed = detection_row(
        _FRAME, _NOW_NS, "person", 0.81234, [10, 20, 30, 60], _sighting(), 7, _SITE
    )
    unplaced = detection_row(_FRAME, _NOW_NS, "car", 0.3, [1, 2, 3, 4], None, None, _SITE)
    with DetectionLines(tmp_path) as lines:
        lines.append([placed, unplaced])
        lines.append([])
    rows = [json.loads(line) for line in (tmp_path / "detections.jsonl").read_text().splitlines()]
    assert rows[0] == {
        "frame": 3,
        "time": "2026-05-28T20:26:40.000000Z",
        "class": "person",
        "score": 0.8123,
        "box_px": [10.0, 20.0, 30.0, 60.0],
        "track": 7,
        "latitude": rows[0]["latitude"],
        "longitude": rows[0]["longitude"],
        "east_m": 100.0,
        "north_m": 200.0,
        "sigma_m": 1.581,
        "size_m": [1.0, 0.5],
    }
    assert "latitude" not in rows[1] and rows[1]["track"] is None
    assert write_detections(tmp_path, _SITE) == 2
    collection = json.loads((tmp_path / "detections.geojson").read_text())
    assert "crs" not in collection
    first, second = collection["features"]
    assert first["geometry"] == {
        "type": "Point",
        "coordinates": [rows[0]["longitude"], rows[0]["latitude"]],
    }
    assert second["geometry"] is None and second["properties"]["class"] == "car"
    where = _SITE.frame.site_from_wgs84(
        np.array([rows[0]["latitude"]]), np.array([rows[0]["longitude"]]), np.zeros(1)
    )[0]
    assert where[:2] == pytest.approx((100.0, 200.0), abs=0.01)


def test_nothing_found_is_an_empty_collection(tmp_path: Path) -> None:
    with DetectionLines(tmp_path):
        pass
    assert write_detections(tmp_path, _LOCAL) == 0
    collection = json.loads((tmp_path / "detections.json").read_text())
    assert collection["features"] == [] and collection["crs"] is None
    assert not (tmp_path / "detections.geojson").exists()


def test_tracks_carry_path_and_crop(tmp_path: Path) -> None:
    moving = _track(id=8, moving=True, velocity_m_s=np.array([0.0, 1.4]))
    collection = tracks_collection([_track(), moving], _SITE, {7: "objects/7.jpg"})
    first, second = collection["features"]
    reported = first["properties"]
    assert (
        reported["id"],
        reported["class"],
        reported["views"],
        reported["passes"],
        reported["crop"],
    ) == (
        7,
        "person",
        5,
        2,
        "objects/7.jpg",
    )
    assert reported["velocity_m_s"] is None and second["properties"]["velocity_m_s"] == [0.0, 1.4]
    assert second["properties"]["crop"] is None
    assert reported["first_seen"] == "2026-05-28T20:26:40.000000Z"
    assert len(reported["path"]["coordinates"]) == len(reported["path"]["times"]) == 2
    assert reported["path"]["coordinates"][1] == first["geometry"]["coordinates"]
    local = tracks_collection([_track()], _LOCAL, {})
    assert local["crs"] is None and local["features"][0]["geometry"]["coordinates"] == [
        100.0,
        200.0,
    ]
    assert (
        "type" not in local and "pixels of the first picture" in local["note"]
    )  # no map shows it by mistake


def test_tracks_are_placemarks_where_they_were_last() -> None:
    track = _track()
    (mark,) = track_placemarks([track], _SITE)
    (feature,) = tracks_collection([track], _SITE, {})["features"]
    assert (mark.longitude_deg, mark.latitude_deg) == pytest.approx(
        feature["geometry"]["coordinates"], abs=1e-8
    )
    assert mark.name == f"{track.label} {track.id}" and "position accuracy" in mark.description


def test_a_kill_leaves_every_line_written(tmp_path: Path) -> None:
    script = (
        "import sys, time; from pathlib import Path\n"
        "from sorvolo.store.exports.detection_files import DetectionLines\n"
        "with DetectionLines(Path(sys.argv[1])) as lines:\n"
        "    lines.append([{'frame': '1'}, {'frame': '2'}]); print('written', flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE
    ) as running:
        assert running.stdout is not None and running.stdout.readline() == b"written\n"
        os.kill(running.pid, signal.SIGKILL)
    rows = [json.loads(line) for line in (tmp_path / "detections.jsonl").read_text().splitlines()]
    assert rows == [{"frame": "1"}, {"frame": "2"}]


def test_crops_stay_inside_the_picture(tmp_path: Path) -> None:
    image = np.zeros((100, 200, 3), np.uint8)
    image[90:, 190:] = 255
    crop = crop_around(image, [190.0, 90.0, 200.0, 100.0])
    assert crop.shape == (17, 17, 3) and crop[-1, -1].tolist() == [255, 255, 255]
    assert crop_around(image, [50, 50, 52, 51]).shape == (25, 24, 3)
    name = write_crop(tmp_path, 7, crop)
    assert name == "objects/7.jpg" and (tmp_path / name).stat().st_size > 100


def test_annotated_pictures_show_the_box_only(tmp_path: Path) -> None:
    image = np.full((120, 160, 3), 90, np.uint8)
    drawn = annotated(
        image,
        np.array([[40, 60, 80, 100]], np.float32),
        [0],
        ["person 1 \u00e9"],
        [True],
        headline="",
    )
    assert (image == 90).all()
    changed = np.argwhere((drawn != 90).any(axis=2))
    assert (drawn[80, 60] == 90).all() and (drawn[60, 60] != 90).any()
    assert changed[:, 0].max() <= 103 and changed[:, 1].min() >= 36
    write_annotated(tmp_path / "annotated", "7", drawn)
    assert cv2.imread(str(tmp_path / "annotated" / "7.jpg")).shape == (120, 160, 3)


def test_words_of_neighbouring_boxes_do_not_hide_each_other() -> None:
    image, boxes = (
        np.full((300, 400, 3), 90, np.uint8),
        np.array([[100, 100, 140, 140]] * 2, np.float32),
    )
    once = annotated(image, boxes[:1], [0], ["person 1 0.90"], [True])
    twice = annotated(image, boxes, [0, 0], ["person 1 0.90", "person 2 0.80"], [True, True])
    above, below = slice(70, 98), slice(144, 175)
    assert (once[above] == twice[above]).all() and (once[below] == 90).all()
    assert (twice[below] != 90).any()


def test_the_video_keeps_the_frames_times(tmp_path: Path) -> None:
    path = tmp_path / "annotated.mp4"
    with AnnotatedVideo(path) as video:
        for number, time_s in enumerate(
            (0.0, 0.1, 0.5, 0.5)
        ):  # two frames of one time: a clock that stood still
            picture = np.full((91, 121, 3), 40 * number, np.uint8)
            video.add(picture, _NOW_NS + round(time_s * 1e9))
        assert not path.exists()
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
    assert [round(float(frame.time or 0), 3) for frame in frames] == [0.0, 0.1, 0.5, 0.5]
    assert (frames[0].width, frames[0].height) == (120, 90)
    levels = [frame.to_ndarray(format="rgb24").mean() for frame in frames]
    assert levels == pytest.approx([0, 40, 80, 120], abs=4)


def test_no_frame_no_video(tmp_path: Path) -> None:
    with AnnotatedVideo(tmp_path / "annotated.mp4"):
        pass
    assert list(tmp_path.iterdir()) == []
