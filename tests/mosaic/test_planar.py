"""The planar method on small rendered flights: everything placed, and the reason of what cannot be placed."""

import cv2
import numpy as np
import pytest

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import apply_homography, fit_similarity, site_from_image_homography
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.mosaic.graph_settings import PoseGraphSettings
from sorvolo.mosaic.planar import KnownKeyframe, PlanarMapper
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.mosaic import Status

CAMERA = Camera.from_angle_of_view(400, 300, 62)
M_PER_PX = 20 / CAMERA.fx_px
SCENE_M_PER_PX = 0.05
SCENE_CORNER_M = np.array([-20.0, 50.0])  # west, north: the middle of the scene's first pixel


def ground(seed: int) -> np.ndarray:
    """(1600, 2000, 3) 100 m by 80 m of ground with detail from 0.15 m to 4 m."""
    rng = np.random.default_rng(seed)
    total = np.zeros((1600, 2000, 3), np.float32)
    for octave in (3, 9, 27, 81):
        small = rng.normal(0, 1, (1600 // octave + 2, 2000 // octave + 2, 3)).astype(np.float32)
        total += cv2.resize(small, (2000, 1600), interpolation=cv2.INTER_CUBIC)
    return np.clip(120 + 18 * total, 0, 255).astype(np.uint8)


SCENE, ELSEWHERE = ground(1), ground(2)


def seen(pose: Pose, scene: np.ndarray = SCENE, seed: int = 0) -> np.ndarray:
    scene_from_site = np.array(
        [
            [1 / SCENE_M_PER_PX, 0, -SCENE_CORNER_M[0] / SCENE_M_PER_PX],
            [0, -1 / SCENE_M_PER_PX, SCENE_CORNER_M[1] / SCENE_M_PER_PX],
            [0, 0, 1],
        ]
    )
    image = cv2.warpPerspective(
        scene,
        scene_from_site @ site_from_image_homography(CAMERA, pose),
        (400, 300),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT,
    )
    noise = np.random.default_rng(seed).normal(0, 1.5, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def flown(seed: int, per_strip: int = 6) -> list[Pose]:
    """Two strips 10 m apart there and back, a picture each 5 m, 20 m up, 1.5 deg of tilt."""
    rng = np.random.default_rng(seed)
    poses = []
    for strip in range(2):
        for step in range(per_strip):
            along = step if strip == 0 else per_strip - 1 - step
            place = np.array([5.0 * along, 10.0 * strip, 20.0]) + rng.normal(0, 0.3, 3)
            tilt, roll, yaw = rng.normal(0, 1.5, 3)
            poses.append(
                Pose(site_from_gimbal_rotation(yaw + (90, 270)[strip], -90 + tilt, roll), place)
            )
    return poses


def measured(
    pose: Pose, rng: np.random.Generator, shift_m: tuple[float, float, float] = (0, 0, 0)
) -> CameraPrior:
    """GPS of 1 m, a compass of 2 deg, no tilt."""
    forward = pose.rotation @ np.array([0.0, -1.0, 0.0])
    yaw = np.degrees(np.arctan2(forward[0], forward[1])) + rng.normal(0, 2)
    place = pose.translation_m + rng.normal(0, 1, 3) + shift_m
    return CameraPrior(
        place, np.ones(3), site_from_gimbal_rotation(yaw, -90, 0), np.array([3.0, 3.0, 4.0])
    )


def unmeasured(first: Pose | None = None) -> CameraPrior:
    """Without telemetry: the first frame defines the frame."""
    if first is not None:
        return CameraPrior(
            first.translation_m, np.full(3, 0.02), first.rotation, np.array([4.0, 4.0, 0.1])
        )
    unknown = np.full(3, np.inf)
    return CameraPrior(
        np.array([0, 0, 20.0]), unknown, np.diag([1.0, -1, -1]), np.array([12.0, 12.0, np.inf])
    )


def shape_rms_px(mapper: PlanarMapper, poses: dict[int, Pose]) -> float:
    true = np.concatenate([footprint(CAMERA, pose) for pose in poses.values()])
    found = np.concatenate([footprint(CAMERA, mapper.pose(each)) for each in poses])
    miss = apply_homography(fit_similarity(true, found), found) - true
    return float(np.sqrt((miss**2).sum(1).mean()) / M_PER_PX)


@pytest.mark.parametrize("has_gps", [True, False])
def test_a_flight_is_placed_by_vision(has_gps):
    poses, rng = flown(1), np.random.default_rng(1)
    mapper = PlanarMapper(PoseGraphSettings(altitude_offset_sigma_m=1.0 if has_gps else 0.0))
    for k, pose in enumerate(poses):
        prior = measured(pose, rng) if has_gps else unmeasured(pose if k == 0 else None)
        outcome = mapper.add(k, CAMERA, seen(pose, seed=k), prior)
        assert (outcome.status, outcome.reason) == (Status.VISION, "")
        assert k in outcome.moved
    mapper.settle()
    assert mapper.placed() == list(range(12))
    assert all(mapper.ending(k) == (Status.VISION, "") for k in range(12))
    # without fixes two strips alone hold the map flat only so well
    assert shape_rms_px(mapper, dict(enumerate(poses))) < (1.0 if has_gps else 3.0)
    assert max(mapper.residuals_px(CAMERA).values()) < 0.5
    assert np.isfinite(mapper.path_m()).all()
    assert len(mapper.exposure().gains) == 12
    assert mapper.recent_exposure().gains.keys() == mapper.exposure().gains.keys()


def test_while_a_flight_goes_on_gains_come_from_its_newest_links(monkeypatch):
    monkeypatch.setattr("sorvolo.mosaic.planar._RECENT_LINKS", 2)
    rng, poses = np.random.default_rng(2), flown(2)[:6]
    mapper = PlanarMapper(PoseGraphSettings())
    for k, pose in enumerate(poses):
        mapper.add(k, CAMERA, seen(pose, seed=k), measured(pose, rng))
    recent = mapper.recent_exposure()
    assert 5 in recent.gains
    assert 0 not in recent.gains
    assert len(mapper.exposure().updated(recent).gains) == 6
    assert (mapper.exposure().updated(recent).gains_of(5) == recent.gains_of(5)).all()


def test_a_flight_with_next_to_no_memory_is_placed_as_with_plenty():
    """Every keyframe comes from the shelf: the same places, gains and residuals to the last bit."""

    class Shelf(dict):
        def put(self, key, data):
            self[key] = data

        def get(self, key):
            return self[key]

    poses, shelf = flown(1, per_strip=4), Shelf()
    plenty, little = (
        PlanarMapper(PoseGraphSettings()),
        PlanarMapper(PoseGraphSettings(), shelf=shelf, keyframe_bytes=1),
    )
    for mapper in (plenty, little):
        rng = np.random.default_rng(1)
        for k, pose in enumerate(poses):
            mapper.add(k, CAMERA, seen(pose, seed=k), measured(pose, rng))
        mapper.settle()
    assert len(shelf) >= len(poses) - 1
    for k in range(len(poses)):
        assert (plenty.pose(k).translation_m == little.pose(k).translation_m).all()
        assert (plenty.exposure().gains_of(k) == little.exposure().gains_of(k)).all()
    assert plenty.residuals_px(CAMERA) == little.residuals_px(CAMERA)


def test_a_featureless_frame_stands_by_its_gps_and_the_next_ones_are_found_again():
    poses, rng = flown(2, per_strip=4), np.random.default_rng(2)
    mapper = PlanarMapper(PoseGraphSettings())
    for k, pose in enumerate(poses):
        image = seen(pose, seed=k)
        if k == 3:
            image = np.clip(
                90 + np.random.default_rng(9).normal(0, 1.5, image.shape), 0, 255
            ).astype(np.uint8)
        mapper.add(k, CAMERA, image, measured(pose, rng))
    mapper.settle()
    status, reason = mapper.ending(3)
    assert status is Status.GPS_ONLY
    assert reason.startswith("no other picture fits it: ") and len(reason.split()) > 7
    assert all(mapper.ending(k)[0] is Status.VISION for k in range(8) if k != 3)
    assert shape_rms_px(mapper, {k: pose for k, pose in enumerate(poses) if k != 3}) < 1.0
    assert np.linalg.norm(mapper.pose(3).translation_m - poses[3].translation_m) < 5.0
    assert np.isnan(mapper.path_m()[3]).all() and np.isfinite(mapper.path_m()[4]).all()
    assert mapper.sigmas_m()[3] > 1.5 * mapper.sigmas_m()[4]


def test_without_gps_a_frame_of_another_place_is_rejected_and_the_flight_goes_on():
    poses = flown(3)[:6]
    mapper = PlanarMapper(PoseGraphSettings(altitude_offset_sigma_m=0.0))
    outcomes = []
    for k, pose in enumerate(poses):
        image = seen(pose, ELSEWHERE if k == 3 else SCENE, seed=k)
        outcomes.append(mapper.add(k, CAMERA, image, unmeasured(poses[0] if k == 0 else None)))
    assert [each.status for each in outcomes] == [
        Status.VISION,
        Status.VISION,
        Status.VISION,
        Status.REJECTED,
        Status.VISION,
        Status.VISION,
    ]
    assert "no picture of the map fits it" in outcomes[3].reason
    assert outcomes[3].moved == frozenset()
    assert mapper.ending(3)[0] is Status.REJECTED and mapper.placed() == [0, 1, 2, 4, 5]
    assert mapper.ending(99) == (Status.REJECTED, "never placed")


def test_keyframes_of_a_known_map_tie_the_next_flight():
    first, second = flown(4), flown(5)
    known = [
        KnownKeyframe(k, CAMERA, pose, 0.05, lambda k=k, pose=pose: seen(pose, seed=k))
        for k, pose in enumerate(first)
    ]
    rng = np.random.default_rng(5)
    mapper = PlanarMapper(PoseGraphSettings(gps_offset_sigma_m=5.0), known=known)
    for k, pose in enumerate(second[:6]):
        # this day's GPS is two metres off the first one's
        outcome = mapper.add(
            100 + k, CAMERA, seen(pose, seed=50 + k), measured(pose, rng, (2.0, -1.5, 0.0))
        )
        assert outcome.status is Status.VISION
        assert all(each >= 100 for each in outcome.moved)
    mapper.settle()
    for k, pose in enumerate(second[:6]):
        miss = footprint(CAMERA, mapper.pose(100 + k)) - footprint(CAMERA, pose)
        assert np.abs(miss).max() < 2 * M_PER_PX
    assert set(mapper.residuals_px(CAMERA)) >= set(range(100, 106))
    assert set(mapper.gps_residuals_m()) == set(range(100, 106))


def test_a_flight_that_starts_with_water_is_placed():
    poses, rng = flown(6)[:5], np.random.default_rng(6)
    mapper = PlanarMapper(PoseGraphSettings())
    for k, pose in enumerate(poses):
        image = np.full((300, 400, 3), 90, np.uint8) if k == 0 else seen(pose, seed=k)
        mapper.add(k, CAMERA, image, measured(pose, rng))
    mapper.settle()
    assert [mapper.ending(k)[0] for k in range(5)] == [Status.GPS_ONLY] + 4 * [Status.VISION]


def test_a_camera_turned_in_its_mount_does_no_harm():
    poses, rng = flown(7, per_strip=3), np.random.default_rng(7)
    mapper = PlanarMapper(PoseGraphSettings())
    for k, pose in enumerate(poses):
        prior = measured(pose, rng)
        half_turn = CameraPrior(
            prior.position_m,
            prior.position_sigma_m,
            prior.rotation @ np.diag([-1.0, -1.0, 1.0]),
            prior.attitude_sigma_deg,
        )
        assert mapper.add(k, CAMERA, seen(pose, seed=k), half_turn).status is Status.VISION
    mapper.settle()
    assert shape_rms_px(mapper, dict(enumerate(poses))) < 1.5


def test_large_pictures_are_registered_small_and_residuals_are_of_the_full_size():
    camera = Camera.from_angle_of_view(1600, 1200, 62)
    poses, rng = flown(8)[:3], np.random.default_rng(8)
    mapper = PlanarMapper(PoseGraphSettings())
    for k, pose in enumerate(poses):
        image = cv2.resize(seen(pose, seed=k), (1600, 1200), interpolation=cv2.INTER_CUBIC)
        assert mapper.add(k, camera, image, measured(pose, rng)).status is Status.VISION
    small = mapper.residuals_px(camera.resized(400, 300))
    assert all(
        value == pytest.approx(4 * small[k]) for k, value in mapper.residuals_px(camera).items()
    )


def test_pictures_that_fit_nothing_cost_no_more_and_no_more():
    """Eleven pictures of other things each: after the first ones hardly any is asked the dear way."""
    rng = np.random.default_rng(3)
    mapper, dear = PlanarMapper(PoseGraphSettings()), []
    for k, pose in enumerate(flown(3)[:11]):
        noise = cv2.GaussianBlur(rng.integers(0, 255, (120, 160, 3), np.uint8), (0, 0), 2.0)
        found = mapper.register(k, CAMERA.resized(160, 120), noise, measured(pose, rng))
        mapper.place(found)
        dear.append(found.dear[0])
    assert found.dear[1] == 0 and max(dear) > 4, dear
    assert dear[-1] <= 2, dear
