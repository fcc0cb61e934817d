"""Calibration against pictures drawn, ray by ray, with a known camera."""

import cv2
import numpy as np
import pytest

from sorvolo.capture.calibration import read_camera
from sorvolo.capture.checkerboard import Board, BoardView, NoBoard, _rounded_down, find_board
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose, rotation_from_vector
from sorvolo.missions.calibrate_camera import (
    calibrate_camera,
    find_views,
    parse_board,
    write_calibration,
)

BOARD = Board(8, 5, 20.0)
TRUTH = Camera(560, 420, 500.0, 502.0, 284.0, 206.0, np.array([-0.12, 0.05, 0.001, -0.0015, 0.0]))
CORNERS_PX = np.stack(np.meshgrid(np.arange(560.0), np.arange(420.0)), axis=-1).reshape(-1, 2)


@pytest.fixture(scope="module")
def rays():
    return TRUTH.rays_from_pixels(CORNERS_PX)


def camera_from_board(tilt_x_deg, tilt_y_deg, turn_deg, centre_px, distance_mm):
    """The board's pose when its middle is seen at `centre_px`."""
    rotation = rotation_from_vector(
        np.radians([tilt_x_deg, tilt_y_deg, 0.0])
    ) @ rotation_from_vector(np.radians([0.0, 0.0, turn_deg]))
    towards = np.array([(centre_px[0] - 284) / 500, (centre_px[1] - 206) / 502, 1.0]) * distance_mm
    middle_mm = np.array([(BOARD.columns - 1) / 2, (BOARD.rows - 1) / 2, 0.0]) * BOARD.square_mm
    return Pose(rotation, towards - rotation @ middle_mm)


def drawn(rays, pose):
    """What the camera sees: squares with edges a pixel wide, a white rim, grey around."""
    normal, origin = pose.rotation[:, 2], pose.translation_m
    points = rays * (normal @ origin / (rays @ normal))[:, None]
    u, v = ((points - origin) @ pose.rotation[:, :2] / BOARD.square_mm).T
    softness = (
        0.3 * BOARD.square_mm * 500 / origin[2]
    )  # px a square, so that an edge is about a pixel wide
    edges = np.clip(np.sin(np.pi * u) * softness, -1, 1) * np.clip(
        np.sin(np.pi * v) * softness, -1, 1
    )
    value = np.where(edges > 0, 1, -1) * np.abs(edges) * 100 + 128
    squares = (u > -1) & (u < BOARD.columns) & (v > -1) & (v < BOARD.rows)
    rim = (u > -1.8) & (u < BOARD.columns + 0.8) & (v > -1.8) & (v < BOARD.rows + 0.8)
    gray = np.where(squares, value, np.where(rim, 228, 90)).reshape(420, 560)
    noise = np.random.default_rng(3).normal(0, 2, gray.shape)
    return np.repeat(np.clip(gray + noise, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


VARIED = [
    (25, 0, 5, (200, 150), 290),
    (-25, 5, 0, (350, 260), 300),
    (5, 28, -8, (180, 280), 310),
    (0, -28, 10, (380, 150), 300),
    (20, 20, 90, (280, 210), 330),
    (-20, -20, 20, (300, 200), 260),
    (30, -10, 0, (200, 290), 320),
    (-10, 30, 180, (390, 300), 330),
    (2, 3, 0, (280, 200), 240),
    (-30, 15, -15, (200, 130), 330),
    (15, -30, 3, (370, 270), 310),
]


def save(folder, rays, poses):
    for number, pose in enumerate(poses):
        cv2.imwrite(
            str(folder / f"view{number:02d}.png"), drawn(rays, camera_from_board(*pose))[..., ::-1]
        )


@pytest.fixture(scope="module")
def looked(tmp_path_factory, rays):
    """The pictures as files, searched once; the last one shows no board."""
    folder = tmp_path_factory.mktemp("board")
    save(folder, rays, VARIED)
    cv2.imwrite(str(folder / "view99.png"), np.full((420, 560, 3), 120, np.uint8))
    return tuple(find_views([folder], BOARD))


def test_corners_are_found_to_a_tenth_of_a_pixel(rays):
    pose = camera_from_board(*VARIED[0])
    view = find_board("one", drawn(rays, pose), BOARD)
    assert isinstance(view, BoardView)
    truth_px = TRUTH.pixels_from_points(pose.apply(BOARD.corners_mm))
    offsets_px = [
        np.linalg.norm(view.corners_px - order, axis=1) for order in (truth_px, truth_px[::-1])
    ]
    assert min(each.max() for each in offsets_px) < 0.15


def test_corners_of_a_large_picture_are_refined_at_full_size(rays):
    pose = camera_from_board(*VARIED[1])
    large = cv2.resize(drawn(rays, pose), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    view = find_board("large", large, BOARD)
    assert isinstance(view, BoardView)
    truth_px = (TRUTH.pixels_from_points(pose.apply(BOARD.corners_mm)) + 0.5) * 4 - 0.5
    offsets_px = [
        np.linalg.norm(view.corners_px - order, axis=1) for order in (truth_px, truth_px[::-1])
    ]
    assert min(np.sqrt(np.mean(each**2)) for each in offsets_px) < 0.4


def test_calibration_finds_the_camera_and_its_file_can_be_read(looked, tmp_path):
    assert sum(isinstance(each.view, NoBoard) for each in looked) == 1
    result = calibrate_camera(looked, BOARD)
    assert result.camera.fx_px == pytest.approx(TRUTH.fx_px, rel=0.004)
    assert result.camera.fy_px == pytest.approx(TRUTH.fy_px, rel=0.004)
    assert abs(result.camera.cx_px - TRUTH.cx_px) < 2
    assert abs(result.camera.cy_px - TRUTH.cy_px) < 2
    assert result.reprojection_error_px < 0.1
    assert result.tilt_spread_deg > 30
    # the whole lens, distortion too, in pixels at the picture's corners
    corners_px = result.camera.pixels_from_points(TRUTH.rays_from_pixels(TRUTH.corners_px))
    assert np.linalg.norm(corners_px - TRUTH.corners_px, axis=1).max() < 3
    path = tmp_path / "camera.xml"
    write_calibration(path, result)
    model = read_camera(path, 560, 420)
    np.testing.assert_allclose(model.camera.matrix, result.camera.matrix)
    np.testing.assert_allclose(model.camera.distortion, result.camera.distortion)
    assert model.focal_sigma == pytest.approx(result.focal_sigma, rel=1e-4)
    assert abs(model.camera.fx_px / TRUTH.fx_px - 1) < 3 * model.focal_sigma


def test_a_view_that_does_not_fit_is_left_out(looked):
    looked = list(looked)
    bent = looked[4].view
    wave_px = 4 * np.sin(np.arange(len(bent.corners_px)))[:, None]
    looked[4] = type(looked[4])(
        BoardView(bent.name, bent.corners_px + wave_px, bent.blur_px), 560, 420
    )
    result = calibrate_camera(looked, BOARD)
    assert result.dropped == (bent.name,)
    assert result.camera.fx_px == pytest.approx(TRUTH.fx_px, rel=0.005)


def test_too_few_views_are_refused(looked):
    with pytest.raises(InputError, match=r"6 different views.*8 are needed.*tilted"):
        calibrate_camera(looked[:6], BOARD)


def test_the_same_view_again_and_again_is_refused(looked):
    with pytest.raises(InputError, match="1 different views"):
        calibrate_camera(looked[:1] * 20, BOARD)


def test_views_without_tilt_are_refused(rays, tmp_path):
    flat = [
        (0, 0, 3 * n, (220 + 50 * (n % 4), 160 + 50 * (n // 4)), 210 + 10 * n) for n in range(12)
    ]
    save(tmp_path, rays, flat)
    with pytest.raises(InputError, match="tilted by no more than"):
        calibrate_camera(list(find_views([tmp_path], BOARD)), BOARD)


def test_views_in_one_corner_are_refused(looked):
    small = [
        type(each)(BoardView(each.view.name, each.view.corners_px, each.view.blur_px), 1400, 1050)
        for each in looked
        if isinstance(each.view, BoardView)
    ]
    with pytest.raises(InputError, match="of the picture"):
        calibrate_camera(small, BOARD)


def test_no_board_shows_how_to_count(looked):
    with pytest.raises(InputError, match="8x5 inner corners in any of 2 pictures; count"):
        calibrate_camera(looked[-1:] * 2, BOARD)


def test_a_board_of_another_size_is_not_taken_for_this_one(rays):
    assert isinstance(
        find_board("other", drawn(rays, camera_from_board(*VARIED[0])), Board(9, 7)), NoBoard
    )


@pytest.mark.parametrize("text", ["9", "x6", "9x", "9*6", "ninexsix", "1x1", "9x6x2", ""])
def test_a_board_that_is_none_is_refused(text):
    with pytest.raises(SettingsError):
        parse_board(text)


def test_too_little_never_reads_as_enough():
    assert _rounded_down(100 * 0.3999) == "39.9"
    assert _rounded_down(9.97) == "9.9"
