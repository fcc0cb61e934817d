"""Frames laid over a map: from telemetry that errs, from the frames before, from nothing at all."""

from functools import cache

import cv2
import numpy as np
import pytest

from sorvolo.change.alignment import Aligned, Aligner, Caution, NotAligned, _nearer
from sorvolo.change.reference import ReferenceMap, level_for
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.homography import apply_homography, site_from_image_homography
from sorvolo.geometry.pose import Pose
from sorvolo.survey.flight import CameraPrior

M_PER_PX = 0.05
TILE_PX = 256
CAMERA = Camera.from_angle_of_view(640, 360, 62.0)
DOWN = np.diag([1.0, -1.0, -1.0])


@cache
def textured(side: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    total = np.zeros((side, side, 3), np.float32)
    for octave in (3, 9, 27, 81):
        small = rng.normal(0, 1, (side // octave + 2, side // octave + 2, 3)).astype(np.float32)
        total += cv2.resize(small, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.clip(120 + 20 * total, 0, 255).astype(np.uint8)


GROUND = textured(8 * TILE_PX, 5)  # 102 m square around the site's origin
SITE_GRID = SiteGrid.at(Geodetic(0.0, 0.0), M_PER_PX, "", TILE_PX)


@pytest.fixture(scope="module")
def tiles() -> dict:
    """The ground as a map; its north-east tile is a hole."""
    found = {}
    for row in range(8):
        for column in range(8):
            rgb = GROUND[
                row * TILE_PX : (row + 1) * TILE_PX, column * TILE_PX : (column + 1) * TILE_PX
            ]
            found[column - 4, row - 4] = np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])
    del found[3, -4]
    return found


@pytest.fixture(scope="module")
def reference(tiles) -> ReferenceMap:
    """The map, whose features are found once for all tests."""
    return ReferenceMap(tiles, SITE_GRID.grid)


def site_from_ground() -> np.ndarray:
    """GROUND's pixels to site metres."""
    grid_from_ground = np.array([[1.0, 0, -4 * TILE_PX], [0, 1, -4 * TILE_PX], [0, 0, 1]])
    return np.linalg.inv(SITE_GRID.grid_from_site_affine(np.zeros(2), 50.0)) @ grid_from_ground


def turned(yaw_deg: float, tilt_deg: float = 0.0) -> np.ndarray:
    a, b = np.radians([yaw_deg, tilt_deg])
    yaw = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    return yaw @ DOWN @ np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])


def photographed(pose: Pose, ground: np.ndarray = GROUND, gain: float = 1.0) -> np.ndarray:
    image_from_ground = np.linalg.inv(site_from_image_homography(CAMERA, pose)) @ site_from_ground()
    image = cv2.warpPerspective(
        ground,
        image_from_ground,
        (CAMERA.width_px, CAMERA.height_px),
        flags=cv2.INTER_AREA,
        borderMode=cv2.BORDER_REFLECT,
    )
    return np.clip(
        image * gain + np.random.default_rng(0).normal(0, 2, image.shape), 0, 255
    ).astype(np.uint8)


def prior_at(
    pose: Pose, off_m=(0.0, 0.0, 0.0), sigma_m: float = 2.0, attitude_deg: float = 1.0
) -> CameraPrior:
    return CameraPrior(
        pose.translation_m + np.array(off_m),
        np.full(3, sigma_m),
        pose.rotation,
        np.full(3, attitude_deg),
    )


def error_px(found: Aligned, pose: Pose) -> float:
    truth = site_from_image_homography(CAMERA, pose)
    corners = CAMERA.corners_px
    miss_m = apply_homography(found.site_from_image, corners) - apply_homography(truth, corners)
    return float(np.linalg.norm(miss_m, axis=1).max() / (pose.translation_m[2] / CAMERA.fx_px))


def aligner(reference) -> Aligner:
    return Aligner(reference, SITE_GRID)


@pytest.mark.parametrize("off_m", [(0, 0, 0), (6, -5, 2), (-9, 9, -3)])
@pytest.mark.parametrize("yaw_deg", [0, 90, 200])
def test_telemetry_may_be_metres_off(reference, off_m, yaw_deg):
    pose = Pose(turned(yaw_deg, 3.0), np.array([4.0, -7.0, 30.0]))
    found = aligner(reference).align(
        photographed(pose, gain=0.7), CAMERA, prior_at(pose, off_m, 4.0), 0
    )
    assert isinstance(found, Aligned)
    assert not found.followed
    assert error_px(found, pose) < 1.0
    assert np.linalg.norm(found.camera_m - pose.translation_m) < 0.3
    assert found.residual_px < 0.7


def test_each_fit_foretells_the_next_although_fixes_jump(reference):
    along = aligner(reference)
    rng = np.random.default_rng(1)
    followed = []
    for k in range(8):
        pose = Pose(
            turned(80.0 + 0.3 * k, rng.normal(0, 0.3)), np.array([-15.0 + 1.5 * k, 2.0, 30.0])
        )
        found = along.align(
            photographed(pose), CAMERA, prior_at(pose, rng.normal(0, 3, 3), 3.0), k * 200_000_000
        )
        assert isinstance(found, Aligned)
        assert error_px(found, pose) < 1.0
        followed.append(found.followed)
    assert sum(followed) >= 6


def test_another_height_and_flight_direction_fit(reference):
    pose = Pose(turned(300.0), np.array([0.0, 0.0, 55.0]))
    found = aligner(reference).align(photographed(pose), CAMERA, prior_at(pose, (2, 1, 0)), 0)
    assert isinstance(found, Aligned)
    assert error_px(found, pose) < 1.0


def test_a_frame_without_telemetry_is_found_in_the_whole_map(reference):
    pose = Pose(turned(25.0), np.array([12.0, 9.0, 30.0]))
    unknown = CameraPrior(np.zeros(3), np.full(3, np.inf), DOWN, np.full(3, np.inf))
    found = aligner(reference).align(photographed(pose), CAMERA, unknown, 0)
    assert isinstance(found, Aligned)
    assert error_px(found, pose) < 1.0


def test_other_ground_does_not_fit_and_reports_it(reference):
    pose = Pose(turned(0.0), np.array([0.0, 0.0, 30.0]))
    found = aligner(reference).align(
        photographed(pose, textured(8 * TILE_PX, 77)), CAMERA, prior_at(pose), 0
    )
    assert isinstance(found, NotAligned)
    assert not found.is_outside
    assert found.reason


def test_a_frame_that_fits_nowhere_keeps_the_residual_of_the_best_try():
    unlike = NotAligned("no plane fits", np.nan)
    bad, worse = NotAligned("bad", 3.0), NotAligned("worse", 5.0)
    assert _nearer(_nearer(_nearer(unlike, worse), bad), unlike) is bad


@cache
def rebuilt(share: float) -> np.ndarray:
    """The ground with so much of it replaced, in blocks, in other light; the rest has moved by some 0.2 m."""
    rng = np.random.default_rng(8)
    side = GROUND.shape[0]
    blocks = (rng.random((20, 20)) < share).astype(np.uint8)
    new = cv2.resize(blocks, (side, side), interpolation=cv2.INTER_NEAREST)[..., None] > 0
    waves = [
        cv2.resize(rng.normal(0, 3.0, (12, 12)).astype(np.float32), (side, side)) for _ in range(2)
    ]
    x, y = np.meshgrid(np.arange(side, dtype=np.float32), np.arange(side, dtype=np.float32))
    moved = cv2.remap(GROUND, x + waves[0], y + waves[1], cv2.INTER_LINEAR)
    other = textured(side, 77)
    fine = other - cv2.GaussianBlur(other, (0, 0), 5).astype(np.float32)
    worn = np.clip(
        cv2.GaussianBlur(moved, (0, 0), 2.5) + fine, 0, 255
    )  # what is small has changed everywhere
    later = np.where(new, other, worn)
    return (255 * (later / 255.0) ** 1.5).astype(np.uint8)


@pytest.mark.parametrize(
    "yaw_off_deg,height_factor",
    [
        (0.0, 1.0),
        pytest.param(90.0, 1.0, marks=pytest.mark.long),
        pytest.param(0.0, 1.18, marks=pytest.mark.long),
    ],
)
def test_ground_that_is_mostly_rebuilt_is_found_by_learned_features(
    reference, yaw_off_deg, height_factor
):
    pose = Pose(turned(10.0, 1.0), np.array([3.0, -2.0, 30.0]))
    image = photographed(pose, rebuilt(0.6))
    prior = prior_at(
        Pose(turned(10.0 + yaw_off_deg), pose.translation_m * [1, 1, height_factor]),
        (1.0, -0.5, 0.0),
    )
    if height_factor > 1:
        prior = CameraPrior(
            prior.position_m, np.array([2.0, 2.0, 6.0]), prior.rotation, prior.attitude_sigma_deg
        )
    without = Aligner(reference, SITE_GRID).align(image, CAMERA, prior, 0, caution=Caution.ALWAYS)
    assert isinstance(without, NotAligned)
    found = Aligner(reference, SITE_GRID).align(image, CAMERA, prior, 0)
    assert isinstance(found, Aligned)
    assert error_px(found, pose) * 30 / CAMERA.fx_px < 0.6  # m


@pytest.mark.long
def test_neighbours_hold_a_frame_of_ground_that_hardly_stayed(reference):
    aligner, alone_px, beside_px = Aligner(reference, SITE_GRID), [], []
    ground = np.concatenate([rebuilt(0.3)[:, :1000], textured(8 * TILE_PX, 31)[:, 1000:]], axis=1)
    for number, east_m in enumerate((-12.0, -6.0, 0.0, 6.0)):
        pose = Pose(turned(0.0), np.array([east_m, 0.0, 30.0]))
        image, prior = photographed(pose, ground), prior_at(pose, (1.0, 1.0, 0.0))
        beside = aligner.align(image, CAMERA, prior, number * 3 * 10**9)
        alone = Aligner(reference, SITE_GRID).align(image, CAMERA, prior, 0)
        assert isinstance(beside, Aligned) and isinstance(alone, Aligned)
        alone_px.append(error_px(alone, pose))
        beside_px.append(error_px(beside, pose))
    assert max(beside_px) * 30 / CAMERA.fx_px < 0.6  # m
    assert max(beside_px[2:]) < 0.6 * max(alone_px[2:])


def test_beyond_the_map_is_outside(reference):
    pose = Pose(turned(0.0), np.array([200.0, 0.0, 30.0]))
    found = aligner(reference).align(photographed(pose), CAMERA, prior_at(pose), 0)
    assert isinstance(found, NotAligned)
    assert found.is_outside
    assert found.reason == "less than 10% of it lies on the map"


def test_the_map_is_seen_as_the_camera_saw_it_and_holes_are_unknown(reference):
    pose = Pose(turned(10.0), np.array([38.0, 38.0, 30.0]))
    grid_from_image = SITE_GRID.grid_from_site_affine(
        np.zeros(2), 50.0
    ) @ site_from_image_homography(CAMERA, pose)
    seen, known = reference.seen_from(grid_from_image, CAMERA.width_px, CAMERA.height_px)
    corner = apply_homography(grid_from_image, np.array([[0.0, 0.0], [320.0, 180.0]]))
    assert 0.05 < known.mean() < 0.95
    assert not seen[~known].any() or (seen[~known] <= 255).all()
    inside = (corner[1] >= -4 * TILE_PX).all()
    assert inside
    image = photographed(pose)
    difference = np.abs(seen.astype(int) - image)[
        cv2.erode(known.view(np.uint8), np.ones((5, 5))) > 0
    ]
    assert difference.mean() < 6


@pytest.mark.parametrize(("scale", "level"), [(0.6, 0), (1.0, 0), (2.0, 1), (3.9, 2)])
def test_a_coarse_view_reads_a_coarse_level(scale, level):
    assert level_for(np.diag([scale, scale, 1.0]), 640, 360) == level


def test_levels_lie_over_each_other(reference):
    fine = np.array([[1.0, 0, -200], [0, 1, -152], [0, 0, 1]])
    coarse = np.array([[4.0, 0, -200 + 1.5], [0, 4, -152 + 1.5], [0, 0, 1]])
    large, _ = reference.seen_from(fine, 400, 320)
    small, known = reference.seen_from(coarse, 100, 80)
    assert known.all()
    expected = cv2.resize(large, (100, 80), interpolation=cv2.INTER_AREA).astype(int)
    assert np.abs(small.astype(int) - expected).mean() < 1.5


class _Counted(dict):
    """Tiles that count how often they are read."""

    reads = 0

    def get(self, *about):
        self.reads += 1
        return super().get(*about)


def test_a_small_view_beside_a_large_one_shows_the_same_and_reads_no_tile(tiles):
    counted = _Counted(tiles)
    reference = ReferenceMap(counted, SITE_GRID.grid)
    pose = Pose(turned(10.0, 4.0), np.array([38.0, 38.0, 30.0]))
    grid_from_image = SITE_GRID.grid_from_site_affine(
        np.zeros(2), 50.0
    ) @ site_from_image_homography(CAMERA, pose)
    large, large_known = reference.seen_from(grid_from_image, CAMERA.width_px, CAMERA.height_px)
    reads = counted.reads
    small, known = reference.seen_from(grid_from_image, CAMERA.width_px, CAMERA.height_px, shrink=4)
    assert counted.reads == reads
    assert small.shape == (90, 160, 3)
    whole = (
        cv2.resize(large_known.view(np.uint8) * 255, (160, 90), interpolation=cv2.INTER_AREA) == 255
    )
    assert not known[~cv2.dilate(whole.view(np.uint8), np.ones((3, 3))).astype(bool)].any()
    assert known.sum() > 0.95 * whole.sum()
    expected = cv2.resize(large, (160, 90), interpolation=cv2.INTER_AREA).astype(int)
    apart = [
        np.abs(small.astype(int) - np.roll(expected, shift, (0, 1)))[known & whole].mean()
        for shift in ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0))
    ]
    assert apart[0] < 0.5 * min(apart[1:])


def test_a_map_that_differs_locally_is_met_by_a_local_fit(reference):
    """Waves of 0.2 m over ground that changed: the camera's fit alone leaves them."""
    pose = Pose(turned(10.0, 1.0), np.array([3.0, -2.0, 30.0]))
    found = aligner(reference).align(
        photographed(pose, rebuilt(0.4)), CAMERA, prior_at(pose, (1.0, -0.5, 0.0)), 0
    )
    assert isinstance(found, Aligned) and found.local is not None
    assert found.local_m > 0.03
    places = found.local.places_px(CAMERA.width_px, CAMERA.height_px)
    seen = apply_homography(np.linalg.inv(site_from_ground()) @ found.site_from_image, places)
    rng = np.random.default_rng(8)
    rng.random((20, 20))
    waves = [
        cv2.resize(rng.normal(0, 3.0, (12, 12)).astype(np.float32), GROUND.shape[1::-1])
        for _ in range(2)
    ]
    shown = np.linalg.inv(site_from_ground()) @ site_from_image_homography(CAMERA, pose)

    def missed(by_px):
        at = apply_homography(shown, places + by_px).astype(np.float32)
        moved = [
            cv2.remap(each, at[:, None, 0], at[:, None, 1], cv2.INTER_LINEAR)[:, 0]
            for each in waves
        ]
        return float(np.median(np.linalg.norm(at + np.column_stack(moved) - seen, axis=1)))

    assert missed(found.local.moved_px.reshape(-1, 2)) < 0.85 * missed(0.0)


def test_a_frame_without_gps_is_placed_beside_one_that_was_on_rebuilt_ground(reference):
    along, ground = aligner(reference), rebuilt(0.6)
    placed = []
    for number, east_m in enumerate((0.0, 3.0, 6.0)):
        pose = Pose(turned(10.0, 1.0), np.array([east_m, -2.0, 30.0]))
        prior = prior_at(pose, (1.0, -0.5, 0.0))
        if number:
            prior = CameraPrior(np.zeros(3), np.full(3, np.inf), DOWN, np.full(3, np.inf))
        found = along.align(photographed(pose, ground), CAMERA, prior, number * 3 * 10**9)
        assert isinstance(found, Aligned)
        placed.append(error_px(found, pose) * 30 / CAMERA.fx_px)
    assert max(placed) < 0.7  # m
    alone = aligner(reference).align(photographed(pose, ground), CAMERA, prior, 0)
    assert isinstance(alone, NotAligned)


@pytest.mark.long
def test_one_strip_that_is_not_found_does_not_lose_the_flight(reference):
    """Photos of other ground between two strips: those before and after are placed as if it had not been."""
    along, ground = aligner(reference), rebuilt(0.3)
    other = textured(8 * TILE_PX, 31)
    for number in range(14):
        pose = Pose(turned(0.0), np.array([-6.0 + number, 0.0, 30.0]))
        lost = 2 <= number < 12
        found = along.align(
            photographed(pose, other if lost else ground),
            CAMERA,
            prior_at(pose, (1.0, 1.0, 0.0)),
            number * 3 * 10**9,
        )
        assert isinstance(found, NotAligned) == lost
        assert lost or error_px(found, pose) * 30 / CAMERA.fx_px < 0.6


@pytest.mark.long
def test_a_frame_tried_again_is_placed_beside_its_neighbours(reference):
    """Ground that stayed in its west third only: nothing there places the frame until those beside it have been."""
    along = aligner(reference)
    ground = np.concatenate([rebuilt(0.3)[:, :1000], textured(8 * TILE_PX, 31)[:, 1000:]], axis=1)
    poses = [
        Pose(turned(0.0), np.array([east_m, 0.0, 30.0])) for east_m in (10.0, -12.0, -6.0, 0.0, 5.0)
    ]

    def tried(number: int) -> Aligned | NotAligned:
        prior = prior_at(poses[number], (1.0, 1.0, 0.0))
        return along.align(photographed(poses[number], ground), CAMERA, prior, number * 3 * 10**9)

    assert isinstance(tried(0), NotAligned)
    assert all(isinstance(tried(number), Aligned) for number in (1, 2, 3, 4))
    again = tried(0)
    assert isinstance(again, Aligned)
    assert error_px(again, poses[0]) * 30 / CAMERA.fx_px < 2.0  # m, at the worst corner
