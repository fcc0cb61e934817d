"""Frames of a stitched mosaic as a map has them."""

import numpy as np
import pytest

from sorvolo.capture.flight_telemetry import local_prior
from sorvolo.geometry.camera import Camera
from sorvolo.lab.thesis.mapping import MIRROR_Y, StitchedPlaces
from sorvolo.lab.thesis.stitching import Stitched
from sorvolo.survey.flight import Frame, PosedFrame
from sorvolo.survey.mosaic import Status


@pytest.mark.parametrize("has_fixes", [True, False])
def test_a_frame_departs_from_fixes_only_where_there_are_some(has_fixes: bool) -> None:
    camera = Camera.from_angle_of_view(640, 480, 60)
    places = StitchedPlaces(camera, camera, MIRROR_Y, has_fixes=has_fixes)
    posed = PosedFrame(
        Frame(0, "0", 0, np.zeros((480, 640, 3), np.uint8)), local_prior(camera, first=True)
    )
    stitched = Stitched(0, np.eye(3), np.array([319.5, 239.5]), 0, 0, float("nan"))
    placed = places.place(posed, stitched, 0, Status.VISION, "")
    assert placed.outline_m.mean(axis=0) == pytest.approx([319.5, -239.5])
    assert bool(np.isfinite(placed.gps_residual_m[:2]).all()) == has_fixes
