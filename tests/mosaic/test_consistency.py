"""Maps that contradict themselves are named, those of poor GPS or uneven take-off places are not."""

from dataclasses import replace

import numpy as np
import pytest

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.geometry.pose import NADIR_CAMERA_NORTH_UP, Pose
from sorvolo.mosaic.consistency import Consistency, Stated, consistency
from sorvolo.mosaic.flight_figures import flight_figures
from sorvolo.survey.mosaic import PlacedFrame, Status

_CAMERA = Camera.from_angle_of_view(640, 480, 60)


def flown(
    count: int = 24,
    *,
    second_scale: float = 1.0,
    gps_rms_m: float = 1.0,
    uneven_m: float = 0.0,
    scale: float = 1.0,
    step_m: float = 20.0,
) -> list[PlacedFrame]:
    """Two strips 60 m up, the second one `second_scale` times as large as its fixes have it."""
    rng = np.random.default_rng(2)
    frames = []
    for k in range(count):
        second = k >= count // 2
        fix_m = np.array([step_m * (k % (count // 2)), 40.0 * second, 60.0])
        place_m = fix_m * [*[scale * (second_scale if second else 1.0)] * 2, 1.0]
        place_m += np.array([*rng.normal(0, gps_rms_m / np.sqrt(2), 2), uneven_m * (-1) ** k])
        pose = Pose(NADIR_CAMERA_NORTH_UP, place_m)
        frames.append(
            PlacedFrame(
                f"{k}.jpg",
                k,
                0,
                Status.VISION,
                "",
                _CAMERA,
                pose,
                site_from_image_homography(_CAMERA, pose),
                footprint(_CAMERA, pose),
                0.3,
                0.5,
                gps_residual_m=place_m - fix_m,
            )
        )
    return frames


def held(frames: list[PlacedFrame], stated_m: float = 60.0, sigma_m: float = 1.5) -> Consistency:
    pieces = [list(range(len(frames) // 2)), list(range(len(frames) // 2, len(frames)))]
    figures = flight_figures(frames, _CAMERA.fx_px)
    return consistency(frames, pieces, figures, Stated(sigma_m, stated_m, "the photos' heights"))


@pytest.mark.parametrize("gps_rms_m", [1.0, 5.0, 16.0])
def test_gps_that_errs_as_receivers_do_is_no_fault(gps_rms_m: float) -> None:
    found = held(flown(gps_rms_m=gps_rms_m))
    assert (
        not found.faults
        and not found.remarks
        and [each.frames for each in found.pieces] == [12, 12]
    )


@pytest.mark.parametrize(
    "frames, words",
    [
        (flown(second_scale=0.6), "differ in scale"),
        (flown(scale=1.4), "as large as its GPS track"),
        (flown(gps_rms_m=40.0, step_m=80.0), "more than a receiver errs"),
        (flown(uneven_m=30.0), "several scales"),
        (flown(count=8, gps_rms_m=60.0), "disagree by"),
    ],
)
def test_what_no_receiver_could_err_is_named(frames: list[PlacedFrame], words: str) -> None:
    assert any(words in each for each in held(frames).faults), held(frames)


def test_a_poor_receiver_that_follows_the_path_makes_a_map_to_check_and_another_path_none() -> None:
    poor = held(flown(gps_rms_m=16.0, step_m=8.0))
    assert not poor.faults and any("disagree by" in each for each in poor.steps)
    other = held(flown(gps_rms_m=40.0, step_m=4.0))
    assert any("disagree by" in each for each in other.faults)


def test_pieces_beside_each_other_are_steps_and_areas_far_apart_are_not() -> None:
    (step,) = held(flown()).steps
    assert "2 pieces" in step and "0.jpg to 11.jpg" in step
    frames = flown()
    far_m = np.array([0.0, 900.0])
    apart = [
        replace(each, outline_m=each.outline_m + far_m) if each.index >= 12 else each
        for each in frames
    ]
    assert not held(apart).steps


def test_heights_that_drift_in_telemetry_alone_are_no_fault_of_the_map() -> None:
    frames = [
        replace(each, gps_residual_m=each.gps_residual_m - np.array([0.0, 0.0, 4.0 * each.index]))
        for each in flown(step_m=40.0)
    ]
    assert not held(frames).faults


def test_heights_that_pictures_contradict_are_reported_with_both_numbers() -> None:
    (remark,) = held(flown(), stated_m=120.0).remarks
    assert "120 m" in remark and "60 m" in remark
    assert not held(flown(), stated_m=120.0).faults, "the ground may lie higher than the take-off"
    assert (
        not held(flown(), stated_m=64.0).remarks
        and not held(flown(), stated_m=float("nan")).remarks
    )
