"""A watch of a flight that is going on: a real stream over the loopback, faster than the detector."""

import json
import re
import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from live_sender import RATE, Sender, free_port, packet_of, sending, udp_url

from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.detection.contract import ModelInfo
from sorvolo.errors import StoreError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.run import EarlyFound, WatchUpdate
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.survey.objects import Detections
from sorvolo.tracking.image_motion import PictureStep
from waiting import wait_for

_LIVE = LiveSettings(silent_s=1.0, give_up_s=1.5, first_s=15.0)
_M_PER_PX = 2 * 60.0 * np.tan(np.radians(31.0)) / 160  # of the drone that live_sender flies
_STEP_PX = 5.0 / RATE / _M_PER_PX
_FIRST_TOP_PX = 8.0


def _scene(index: int) -> Any:
    """A car to the right of the way, which comes nearer from the front."""
    image = np.full((96, 160, 3), 40, np.uint8)
    top = round(_FIRST_TOP_PX + _STEP_PX * index)
    image[top : top + 8, 110:116] = 230
    return image


class _SlowDetector:
    """Bright rectangles are cars; it takes its time."""

    classes = ("car",)
    provider, notices, others = "here", (), ()
    info = ModelInfo("slow", ("car",), {"car": 0.5}, {"car": (4.0, 60.0)}, licence="CC0-1.0")

    def detect(self, image: ImageRGB, **_: object) -> Detections:
        time.sleep(0.12)
        return _bright(image, self.classes)


def _bright(image: ImageRGB, classes: tuple[str, ...]) -> Detections:
    """Bright rectangles, as the first of these classes."""
    _, _, stats, _ = cv2.connectedComponentsWithStats((image[..., 0] > 150).astype(np.uint8))
    boxes = [[x, y, x + w, y + h] for x, y, w, h, area in stats[1:] if area > 20]
    return Detections(
        np.array(boxes, np.float32).reshape(-1, 4),
        np.full(len(boxes), 0.9),
        np.zeros(len(boxes), np.int64),
        classes,
    )


def test_what_was_left_while_live_is_searched_after_landing(tmp_path: Path) -> None:
    port, folder = free_port(), tmp_path / "watch"
    detector = _SlowDetector()
    address, outputs = f"udp://127.0.0.1:{port}", WatchOutputs(folder=folder)
    asked = WatchSettings(through_trees=True)
    with sending(udp_url(port), klv=True, image=_scene, count=4 * RATE) as sender:
        updates = list(watch(address, asked, outputs, detector=detector, live=_LIVE))
    assert sender.error is None
    report = json.loads((folder / "report.json").read_text())
    frames = report["frames"]
    # a picture a step is kept for the look through trees, far fewer than came
    kept = re.search(r"has (\d+) pictures with a place; to look", report["headline"]["text"])
    assert kept is not None and 5 < int(kept[1]) < len(updates) / 2
    assert len(updates) >= frames["detected"] > 3 and frames["skipped"] == 0
    assert report["latency_s"]["median"] < 2.0  # of what was searched live
    assert report["georeferenced"] and report["ended"] == "the source ended"
    # half a metre a pixel is too coarse for a car, and the headline does not claim that there is no other
    assert "too coarse for car" in report["headline"]["text"]
    assert not report["headline"]["complete"]

    (track,) = json.loads((folder / "tracks.geojson").read_text())["features"]
    longitude, latitude = track["geometry"]["coordinates"]
    start = LocalFrame(Geodetic(46.5, 11.3, 0.0))
    east_m, north_m, _ = start.site_from_wgs84(
        np.array([latitude]), np.array([longitude]), np.zeros(1)
    )[0]
    # the first picture's middle lies under the drone's first place
    assert east_m == pytest.approx((113 - 80) * _M_PER_PX, abs=2.0)
    assert north_m == pytest.approx((48 - (_FIRST_TOP_PX + 4)) * _M_PER_PX, abs=2.0)
    assert track["properties"]["first_seen"].startswith("2025-10-09T08:53")  # the drone's own clock

    with (
        sending(udp_url(port), image=_scene, count=RATE),
        pytest.raises(StoreError, match="which stays"),
    ):
        list(watch(address, outputs=outputs, detector=detector, live=_LIVE))


_FLOWN_M, _REACH_M = (
    100.0,
    48 * _M_PER_PX,
)  # flown north, then hovered; what a frame shows along the way
_BOATS = ((0.0, 110), (60.0, 40))  # north, m, and column


def _north_m(index: int) -> float:
    return min(10.0 * index / RATE, _FLOWN_M)


def _lake(index: int) -> Any:
    """Two boats, the second one in the middle of the way."""
    image = np.full((96, 160, 3), 40, np.uint8)
    for north_m, column in _BOATS:
        top = round(48 + (_north_m(index) - north_m) / _M_PER_PX)
        image[max(0, top - 4) : max(0, top + 4), column : column + 6] = 230
    return image


class _StalledDetector(_SlowDetector):
    """Bright rectangles are boats; it is busy with its first picture until the drone hovers, and fast on the ground."""

    classes = ("boat",)
    info = ModelInfo("stalled", ("boat",), {"boat": 0.5}, {"boat": (4.0, 60.0)}, licence="CC0-1.0")
    sender: Sender

    def __init__(self) -> None:
        self.asked = 0

    def detect(self, image: ImageRGB, **_: object) -> Detections:
        self.asked += 1
        due = 240 + 20 * self.asked  # frames that are sent when it is done
        while self.sender.is_alive() and len(self.sender.sent_s) < due:
            time.sleep(0.005)
        return _bright(image, self.classes)

    def film(self, index: int) -> Any:
        """What the drone sends, which waits for no computer, but for this test's."""
        wait_for(lambda: self.asked >= (index - 240) // 20)
        return _lake(index)


def _note_end(sender: Sender, film: Path) -> None:
    sender.join()
    film.with_name(film.name + ".ended").touch()


def test_new_ground_comes_first_and_all_of_it_in_the_end(tmp_path: Path) -> None:
    """A slow computer in a bad moment: 4 % of the frames while live, of the ground four fifths, then all."""
    detector, film, folder = _StalledDetector(), tmp_path / "film.ts", tmp_path / "watch"
    live, after, looked_m = list[WatchUpdate](), list[WatchUpdate](), list[float]()
    with sending(
        str(film),
        klv=True,
        image=detector.film,
        klv_of=lambda k: packet_of(k, _north_m(k)),
        count=23 * RATE,
        speed=10.0,
        options={"flush_packets": "1"},
    ) as detector.sender:
        wait_for(lambda: film.exists() and film.stat().st_size > 0)
        threading.Thread(target=_note_end, args=(detector.sender, film)).start()
        # the file says when it ends: a computer that writes it late is no silence
        patient = replace(_LIVE, silent_s=10.0, give_up_s=20.0)
        for update in watch(
            f"follow:{film}", outputs=WatchOutputs(folder=folder), detector=detector, live=patient
        ):
            is_live = detector.sender.is_alive()
            (live if is_live else after).append(update)
            if is_live:
                looked_m.append(_north_m(round(update.clip_ns * RATE / 1e9)))
    report = json.loads((folder / "report.json").read_text())
    frames = report["frames"]
    assert 4 <= len(live) < 0.05 * frames["detected"]
    flown_m = np.arange(-_REACH_M, _FLOWN_M + _REACH_M, 0.5)
    near_m = np.abs(flown_m[:, None] - np.array(looked_m)).min(axis=1)
    assert (near_m <= _REACH_M).mean() >= 0.8
    # what was seen once is looked at again: both are announced while it flies
    assert len({track.id for update in live for track in update.new}) == 2

    assert frames["skipped"] == 0 and frames["detected"] == 230
    assert detector.asked == frames["detected"]  # nothing twice
    assert report["headline"] == {
        "text": "2 boats; 230 of 230 pictures, 100 % of the ground looked at",
        "complete": True,
    }
    (classes,) = report["looked_at"]["classes"].values()
    assert classes["skipped_m2"] == 0
    searched = json.loads((folder / "searched.geojson").read_text())["features"]
    assert {each["properties"]["state"] for each in searched} == {"looked at"}
    tracks = json.loads((folder / "tracks.geojson").read_text())["features"]
    announced = [track.id for update in (*live, *after) for track in update.new]
    assert sorted(announced) == sorted(each["id"] for each in tracks)  # each once, by one id


class _VerySlowDetector(_SlowDetector):
    """Takes three times as long as the frames that come."""

    def detect(self, image: ImageRGB, **_: object) -> Detections:
        time.sleep(0.2)
        return super().detect(image)


def test_what_is_left_when_it_is_stopped_is_counted(tmp_path: Path) -> None:
    port, folder = free_port(), tmp_path / "watch"
    detector, address = _VerySlowDetector(), f"udp://127.0.0.1:{port}"
    with sending(udp_url(port), klv=True, image=_scene, count=3 * RATE):
        watching = watch(
            address, outputs=WatchOutputs(folder=folder), detector=detector, live=_LIVE
        )
        for update in watching:
            if update.has_landed:
                watching.cancel()
    report = json.loads((folder / "report.json").read_text())
    assert report["frames"]["skipped"] > 0 and report["objects"]["total"] == 1
    assert not report["headline"]["complete"]


def _textured(index: int) -> Any:
    """Ground that moves two pixels down with every frame."""
    noise = np.random.default_rng(5).integers(0, 130, (100, 40), np.uint8)
    return np.dstack([np.roll(cv2.resize(noise, (160, 400)), 2 * index, axis=0)[:96]] * 3)


def _car_on_texture(index: int) -> Any:
    image = _textured(index)
    image[8 + 2 * index : 16 + 2 * index, 110:116] = 230
    return image


def test_without_places_pictures_count_and_objects_keep_their_ids(tmp_path: Path) -> None:
    port, folder = free_port(), tmp_path / "watch"
    detector, address = _VerySlowDetector(), f"udp://127.0.0.1:{port}"
    with sending(udp_url(port), image=_car_on_texture, count=2 * RATE):
        updates = list(
            watch(address, outputs=WatchOutputs(folder=folder), detector=detector, live=_LIVE)
        )
    report = json.loads((folder / "report.json").read_text())
    assert any(each.has_landed for each in updates) and report["frames"]["skipped"] == 0
    searched = report["frames"]["detected"]
    assert report["headline"]["text"] == f"1 car; {searched} of {searched} pictures looked at"
    assert report["headline"]["complete"] and not (folder / "searched.geojson").exists()
    (track,) = json.loads((folder / "tracks.json").read_text())["features"]
    assert [new.id for each in updates for new in each.new] == [track["id"]]


def test_how_the_picture_moves_is_known_between_the_frames_that_are_searched(
    tmp_path: Path,
) -> None:
    port = free_port()
    steps: list[PictureStep] = []
    address, outputs = f"udp://127.0.0.1:{port}", WatchOutputs(folder=tmp_path / "watch")
    with sending(udp_url(port), klv=True, image=_textured, count=3 * RATE):
        updates = list(
            watch(
                address, outputs=outputs, detector=_SlowDetector(), live=_LIVE, moved=steps.append
            )
        )
    assert len(steps) > 8
    for step in steps:
        frames = (step.to_ns - step.from_ns) * RATE / 1e9
        assert frames == pytest.approx(2, abs=0.1)  # a tenth of a second, of twenty frames
        assert step.to_from[:2, 2] == pytest.approx([0, 2 * frames], abs=0.6)
        assert step.to_from[:2, :2] == pytest.approx(np.eye(2), abs=0.02)
    assert all(later.from_ns == step.to_ns for step, later in pairwise(steps))
    # on the clock of the updates, so that boxes can follow
    assert steps[0].from_ns <= updates[-1].time_ns and updates[1].time_ns <= steps[-1].to_ns


class _EarlyDetector(_SlowDetector):
    """Cars are known before the picture is searched for people, of whom there are none."""

    classes = ("car", "person")

    def detect(self, image: ImageRGB, *, early: Any, **_: object) -> Detections:
        found = super().detect(image)
        if early is not None:  # not once it has landed
            early(("car",), found)
        time.sleep(0.1)
        return found


def test_what_is_known_of_a_frame_early_comes_before_the_rest_of_it(tmp_path: Path) -> None:
    port = free_port()
    came: list[EarlyFound | WatchUpdate] = []
    with sending(udp_url(port), klv=True, image=_scene, count=2 * RATE):
        address, outputs = f"udp://127.0.0.1:{port}", WatchOutputs(folder=tmp_path / "watch")
        for update in watch(
            address, outputs=outputs, detector=_EarlyDetector(), live=_LIVE, early=came.append
        ):
            if not update.has_landed:
                came.append(update)
    assert len(came) >= 4
    for early, whole in zip(came[::2], came[1::2], strict=True):
        assert isinstance(early, EarlyFound) and isinstance(whole, WatchUpdate)
        assert early.classes == ("car",) and early.latency_s < whole.latency_s - 0.09
        assert (early.time_ns, early.clip_ns, early.size_px) == (
            whole.time_ns,
            whole.clip_ns,
            whole.size_px,
        )
        assert np.array_equal(early.detections.boxes_px, whole.detections.boxes_px)
