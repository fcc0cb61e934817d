"""Frames of a stitched mosaic as a map has them, and the map as the frames were."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from real_data import real_data
from sorvolo.capture.flight_telemetry import local_prior
from sorvolo.geometry.camera import Camera
from sorvolo.lab.evaluation.map_quality import MapDeviation
from sorvolo.lab.thesis.mapping import StitchedFlight, ThesisMapping
from sorvolo.lab.thesis.stitching import RoiStitcher, Stitched
from sorvolo.missions.flight.log import Ending
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.store.site.archive import Archive
from sorvolo.survey.mosaic import Status

CAMERA = Camera.from_angle_of_view(640, 480, 60)


def stitched(frame_id: int, x_px: float) -> Stitched:
    move = np.array([[1.0, 0, x_px], [0, 1, 0], [0, 0, 1]])
    return Stitched(frame_id, move, np.array([319.5 + x_px, 239.5]), 0, float("nan"))


@pytest.mark.parametrize("has_fixes", [True, False])
def test_a_frame_departs_from_fixes_only_where_there_are_some(has_fixes: bool) -> None:
    flight = StitchedFlight(RoiStitcher(), CAMERA, CAMERA)
    flight.add(stitched(0, 0), None, None)
    placed = flight.place(
        Ending(0, "0", 0, Status.VISION, ""),
        0,
        local_prior(CAMERA, first=True),
        np.ones(3),
        has_fixes=has_fixes,
    )
    assert placed.outline_m.mean(axis=0) == pytest.approx([319.5, -239.5])
    assert bool(np.isfinite(placed.gps_residual_m[:2]).all()) == has_fixes


def test_a_flight_that_the_map_shows_is_tied_to_it_and_not_to_its_own_gps() -> None:
    """GPS is 3 m off; two of four frames are found on the map. The others follow with the same offset."""
    flight = StitchedFlight(RoiStitcher(), CAMERA, CAMERA)
    for number in range(4):
        true_m = np.array([100.0 + 10 * number, 50.0])
        on_map = np.array([[0.1, 0, true_m[0] - 31.95], [0, -0.1, true_m[1] + 23.95], [0, 0, 1]])
        flight.add(
            stitched(number, 100.0 * number),
            true_m + np.array([3.0, 0]),
            on_map if number < 2 else None,
        )
    flight.anchor()
    assert flight.m_per_px == pytest.approx(0.1)
    corner = flight.site_from_image(3, CAMERA) @ [319.5, 239.5, 1]
    assert corner[:2] == pytest.approx([130.0, 50.0], abs=1e-6)


@pytest.mark.long
def test_the_map_keeps_the_detail_of_real_photos_and_burns_none_of_it(tmp_path: Path) -> None:
    photos = sorted(real_data("flights/brighton_beach").glob("*.JPG"))[-4:]
    (tmp_path / "photos").mkdir()
    for photo in photos:
        shutil.copy(photo, tmp_path / "photos")
    settings = MapSettings(ThesisMapping(), model="none")
    list(map_flights([tmp_path / "photos"], tmp_path / "site", settings))
    kept, white_map, white_frames, shares = [], 0, 0, []
    with Archive.open(tmp_path / "site", write=False) as archive:
        compared = MapDeviation(archive.tiles(), archive.site_grid())
        for keyframe in archive.keyframes():
            image = archive.image(keyframe)
            shares.append(compared.of(image, keyframe.site_from_image).share)
            shown = compared.shown(image, keyframe.site_from_image)
            seen = (
                cv2.erode((shown["difference"][..., 0] != 236).astype(np.uint8), np.ones((9, 9)))
                > 0
            )
            detail = [
                cv2.Laplacian(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY), cv2.CV_32F)[seen].std()
                for each in (shown["mosaic"], shown["frame"])
            ]
            kept.append(detail[0] / detail[1])
            white_map += int((shown["mosaic"][seen] == 255).any(axis=1).sum())
            white_frames += int((shown["frame"][seen] == 255).any(axis=1).sum())
    assert np.mean(kept) > 0.95
    assert white_map <= white_frames
    assert np.mean(shares) < 0.14
