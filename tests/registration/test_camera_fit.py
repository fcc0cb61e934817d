"""A camera's pose from pairs that are mostly wrong, held by telemetry where they leave it open."""

import numpy as np

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography, site_from_image_homography
from sorvolo.geometry.pose import Pose, rotation_from_vector
from sorvolo.registration.camera_fit import PosePrior, fit_camera, similar

CAMERA = Camera.from_angle_of_view(640, 360, 62.0)
DOWN = np.diag([1.0, -1.0, -1.0])
TRUE = Pose(DOWN @ rotation_from_vector(np.radians([1.5, -1.0, 2.0])), np.array([4.0, -3.0, 100.0]))
SIGMA_RAD = np.radians([3.0, 3.0, 5.0])


def pairs(right: int, wrong: int, corner: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Image and ground points; the right ones lie in so much of the picture's width and height."""
    rng = np.random.default_rng(2)
    seen = rng.uniform(0, [640 * corner, 360 * corner], (right, 2))
    anywhere = rng.uniform(0, [640, 360], (wrong, 2))
    image = np.concatenate([seen, anywhere])
    ground = apply_homography(site_from_image_homography(CAMERA, TRUE), image)
    ground[right:] += rng.uniform(-4, 4, (wrong, 2))
    return image + rng.normal(0, 0.7, image.shape), ground


def prior(off_m: tuple[float, float, float]) -> PosePrior:
    return PosePrior(Pose(DOWN, TRUE.translation_m + off_m), np.array([1.5, 1.5, 1.5]), SIGMA_RAD)


def test_a_pose_is_found_among_four_wrong_pairs_for_each_right_one() -> None:
    image, ground = pairs(80, 320)
    fit = fit_camera(image, ground, CAMERA, prior((1.0, -1.0, 1.0)), start_px=40.0, band_px=4.0)
    assert fit is not None
    assert fit.agree[:80].mean() > 0.95 and fit.agree[80:].mean() < 0.15
    assert np.linalg.norm(fit.pose.translation_m - TRUE.translation_m) < 1.0
    assert fit.residual_px < 2.0


def test_telemetry_holds_what_a_corner_of_the_picture_leaves_open() -> None:
    image, ground = pairs(40, 60, corner=0.3)
    fit = fit_camera(image, ground, CAMERA, prior((0.5, 0.5, 0.5)), start_px=40.0, band_px=4.0)
    assert fit is not None
    corners = np.array([[0, 0], [639, 0], [639, 359], [0, 359.0]])
    true = apply_homography(site_from_image_homography(CAMERA, TRUE), corners)
    assert np.linalg.norm(apply_homography(fit.site_from_image, corners) - true, axis=1).max() < 2.5


def test_similarities_of_another_scale_are_refused() -> None:
    old = np.random.default_rng(3).uniform(0, 300, (40, 2))
    assert similar(2 * old + 5, old, 3.0, 1.35) is None
    found = similar(1.2 * old + 5, old, 3.0, 1.35)
    assert found is not None and found[1].all() and abs(found[0][0, 0] - 1.2) < 0.01
