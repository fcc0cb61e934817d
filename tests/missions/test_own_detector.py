"""A detector of a user's own, of one method: in Python, and by name from another package."""

from pathlib import Path

import numpy as np
import pytest

import sorvolo
from small_flights import simulate_into, small_flight
from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.missions.flight.detector_protocol import as_detector
from sorvolo.survey.objects import Detections


class Middle:
    """Finds a deer in the middle of each picture; the red of its first pixel is the score."""

    def detect(self, image: ImageRGB) -> Detections:
        height, width = image.shape[:2]
        box = [width / 2 - 8, height / 2 - 8, width / 2 + 8, height / 2 + 8]
        return Detections(
            np.array([box, box]), np.array([0.3, 0.9]), np.array([1, 0]), ("deer", "fox")
        )


def test_one_method_is_a_detector(tmp_path: Path) -> None:
    found = as_detector(Middle()).detect(np.zeros((90, 160, 3), np.uint8), classes=("deer",))
    assert found.names == ["deer"] and found.scores[0] == 0.9
    flight = simulate_into(tmp_path / "flown", small_flight(7, length_m=20)) / "flight1"
    settings = sorvolo.WatchSettings(classes=("deer",))
    outputs = sorvolo.WatchOutputs(folder=tmp_path / "seen")
    video = next(flight.glob("*.mp4"))
    (outcome,) = sorvolo.watch(video, settings, outputs, detector=Middle()).result()
    assert outcome.paths["tracks.geojson"].is_file() and outcome.frames["detected"] > 5
    report = (tmp_path / "seen" / "report.json").read_text()
    assert '"deer"' in report and "Middle" in report


def test_what_a_detector_must_give() -> None:
    class Wrong:
        def detect(self, image: ImageRGB) -> Detections:
            return [image.mean()]  # type: ignore[return-value]

    class Surprising:
        classes = ("deer",)

        def detect(self, image: ImageRGB) -> Detections:
            return Middle().detect(image)

    picture = np.zeros((90, 160, 3), np.uint8)
    with pytest.raises(SettingsError, match=r"gave list; needed is sorvolo\.Detections"):
        as_detector(Wrong())
    with pytest.raises(SettingsError, match="found 'fox', but names deer"):
        as_detector(Surprising()).detect(picture)


def test_supervision_gives_back_what_it_was_given() -> None:
    pytest.importorskip("supervision")
    found = Middle().detect(np.zeros((90, 160, 3), np.uint8))
    there = found.to_supervision()
    assert there.data["class_name"].tolist() == ["fox", "deer"]
    back = Detections.from_supervision(there)
    assert back.names == ["deer", "fox"] and back.scores == pytest.approx([0.9, 0.3])
    assert (back.boxes_px == found.boxes_px).all()
    assert Detections.from_supervision(there, ("deer", "fox")).names == ["deer", "fox"]
