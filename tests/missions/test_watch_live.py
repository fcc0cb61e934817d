"""A watch of a flight that is going on: a real stream over the loopback, faster than the detector."""

import json
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from live_sender import RATE, free_port, sending, udp_url

from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.detection.contract import ModelInfo
from sorvolo.errors import StoreError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.run import EarlyFound, WatchUpdate
from sorvolo.missions.watch.settings import WatchOutputs
from sorvolo.survey.objects import Detections
from sorvolo.tracking.image_motion import PictureStep

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
        _, _, stats, _ = cv2.connectedComponentsWithStats((image[..., 0] > 150).astype(np.uint8))
        boxes = [[x, y, x + w, y + h] for x, y, w, h, area in stats[1:] if area > 20]
        return Detections(
            np.array(boxes, np.float32),
            np.full(len(boxes), 0.9),
            np.zeros(len(boxes), np.int64),
            self.classes,
        )


def test_the_newest_frames_are_searched_and_the_rest_is_counted(tmp_path: Path) -> None:
    port, folder = free_port(), tmp_path / "watch"
    detector = _SlowDetector()
    address, outputs = f"udp://127.0.0.1:{port}", WatchOutputs(folder=folder)
    with sending(udp_url(port), klv=True, image=_scene, count=4 * RATE) as sender:
        updates = list(watch(address, outputs=outputs, detector=detector, live=_LIVE))
    assert sender.error is None
    report = json.loads((folder / "report.json").read_text())
    frames = report["frames"]
    assert len(updates) == frames["detected"] >= 3
    assert frames["skipped"] > frames["detected"]
    assert frames["detected"] + frames["skipped"] + frames["lost"] <= frames["read"] + 1
    assert report["latency_s"]["median"] < 2.0  # not the seconds by which the detector is too slow
    assert report["georeferenced"] and report["ended"] == "the source ended"

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


def _textured(index: int) -> Any:
    """Ground that moves two pixels down with every frame."""
    noise = np.random.default_rng(5).integers(0, 130, (100, 40), np.uint8)
    return np.dstack([np.roll(cv2.resize(noise, (160, 400)), 2 * index, axis=0)[:96]] * 3)


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
