"""A flight found on the map as one, where single photos show too little of it."""

from typing import cast

import numpy as np
import pytest

from sorvolo.change.flight_on_map import FlightOnMap, PhotoFeatures
from sorvolo.change.map_search import MapSearch
from sorvolo.geometry.arrays import Floats, Matrix3, PointsM
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography, fit_similarity, site_from_image_homography
from sorvolo.geometry.pose import Pose
from sorvolo.survey.mosaic import Features

CAMERA = Camera.from_angle_of_view(400, 300, 60)
DOWN = np.diag([1.0, -1, -1])
POSES = {
    number: Pose(DOWN, np.array([30.0 * column, 25.0 * row, 60.0]))
    for number, (column, row) in enumerate(np.ndindex(5, 3))
}
MOVED = np.array([[1.018, 0.006, 3.1], [-0.006, 1.018, -2.4], [0, 0, 1]])  # map_from_flight


class Map:
    """Stands in for `MapSearch`: points all over the ground, each with a look of its own."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.ground_m = rng.uniform(-60, 200, (15_000, 2))
        self.looks = looks(rng, len(self.ground_m))

    def map_features(self, camera: Camera, pose: Pose, margin: float) -> tuple[Matrix3, Features]:
        """The points in a view, `margin` of its size around it included."""
        site_from_image = site_from_image_homography(camera, pose)
        return site_from_image, self.seen(site_from_image, camera, margin)

    def seen(self, site_from_image: Matrix3, camera: Camera, margin: float = 0.0) -> Features:
        image_px = apply_homography(np.linalg.inv(site_from_image), self.ground_m)
        size = np.array([camera.width_px, camera.height_px])
        kept = ((image_px > -margin * size) & (image_px < (1 + margin) * size)).all(axis=1)
        return Features("learned", image_px[kept], self.looks[kept])


def looks(rng: np.random.Generator, count: int) -> Floats:
    """(N, 12) descriptors: short, so that chance makes some alike."""
    drawn = rng.normal(size=(count, 12)).astype(np.float32)
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def photos_of(
    ground: Map, rng: np.random.Generator, *, unchanged: float
) -> dict[int, PhotoFeatures]:
    """Photos of ground of which that share is as it was, taken where `MOVED` has their poses."""
    stays = rng.random(len(ground.looks)) < unchanged
    later = Map.__new__(Map)
    later.ground_m, later.looks = (
        ground.ground_m,
        np.where(stays[:, None], ground.looks, looks(rng, len(stays))),
    )
    return {
        index: PhotoFeatures(
            CAMERA, later.seen(MOVED @ site_from_image_homography(CAMERA, pose), CAMERA)
        )
        for index, pose in POSES.items()
    }


@pytest.mark.parametrize("unchanged", [0.9, 0.1])
def test_what_each_photo_shows_too_weakly_adds_up(unchanged: float) -> None:
    rng = np.random.default_rng(8)
    ground = Map(rng)
    fit = FlightOnMap(cast(MapSearch, ground)).find(
        photos_of(ground, rng, unchanged=unchanged), POSES
    )
    assert fit is not None and fit.ratio > 10 and fit.residual_m < 0.3
    corners_m: PointsM = np.array([[-20.0, -15], [140, -15], [140, 65], [-20, 65]])
    assert (
        np.abs(
            apply_homography(fit.map_from_flight, corners_m) - apply_homography(MOVED, corners_m)
        ).max()
        < 0.15
    )
    assert np.allclose(
        fit.map_from_flight,
        fit_similarity(apply_homography(fit.map_from_flight, corners_m), corners_m),
    )


def test_one_photo_of_changed_ground_is_not_enough() -> None:
    rng = np.random.default_rng(9)
    ground = Map(rng)
    photos = photos_of(ground, rng, unchanged=0.1)
    assert FlightOnMap(cast(MapSearch, ground)).find({4: photos[4]}, POSES) is None
    assert FlightOnMap(cast(MapSearch, ground)).find(photos, POSES) is not None


@pytest.mark.parametrize("seed", range(4))
def test_other_ground_is_found_nowhere(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ground = Map(rng)
    assert (
        FlightOnMap(cast(MapSearch, ground)).find(photos_of(ground, rng, unchanged=0.0), POSES)
        is None
    )


def test_without_photos_or_beside_the_map_nothing_is_found() -> None:
    class Nowhere:
        def map_features(self, *_: object) -> None:
            return None

    rng = np.random.default_rng(1)
    photos = photos_of(Map(rng), rng, unchanged=0.9)
    assert FlightOnMap(cast(MapSearch, Nowhere())).find(photos, POSES) is None
    assert FlightOnMap(cast(MapSearch, Nowhere())).find({}, {}) is None
