"""Pairs from simulated flights: a later flight's frame and one of the earlier flight laid over it, with the answer.

Unlike pasted composites they have what real flights have together: another sun with its shadows, leaning trees and
houses, the lens and the exposure of each frame, things of every size that came, went or move.
"""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from change_suites import Pair
from sorvolo.geometry.homography import apply_homography, site_from_image_homography
from sorvolo.lab.simulation.flight import SimulatedFlight, simulate_flights
from sorvolo.lab.simulation.presets import preset
from sorvolo.lab.simulation.truth import change_mask
from sorvolo.registration.lens import Undistorter

GROUNDS = ("countryside", "urban", "dirt", "sand")
HEIGHTS_M = (14.0, 20.0, 28.0, 40.0)


def simulated_pairs(seed: int, count: int, ground: str | None = None) -> Iterator[Pair]:
    """`count` pairs of one simulated site; ground, height, light and wind follow from the seed."""
    rng = np.random.default_rng([seed, 77])
    settings = preset("compare")
    height_m = float(rng.choice(HEIGHTS_M))
    later = replace(settings.later, people=6, cars=4, small_objects=8, removed=6, moved=5)
    settings = replace(
        settings,
        seed=seed,
        scene=replace(
            settings.scene,
            ground=ground or str(rng.choice(GROUNDS)),
            people=8,
            cars=6,
            small_objects=10,
            has_scenery=bool(rng.random() < 0.8),
        ),
        path=replace(
            settings.path,
            height_m=height_m,
            speed_m_s=height_m / 4,
            length_m=height_m * 2.2,
            strip_spacing_m=height_m * 0.5,
        ),
        imaging=replace(settings.imaging, fps=5.0),
        later=later,
    )
    first, second = list(simulate_flights(settings))[:2]
    for index in rng.choice(len(second), size=min(count, len(second)), replace=False):
        pair = _pair(first, second, int(index), rng)
        if pair is not None:
            yield pair


def _pair(
    first: SimulatedFlight, second: SimulatedFlight, index: int, rng: np.random.Generator
) -> Pair | None:
    camera = second.camera
    lens = Undistorter(camera)
    site_from_query = site_from_image_homography(lens.camera, second.true_poses[index])
    centre = apply_homography(site_from_query, np.array([[camera.cx_px, camera.cy_px]]))[0]
    places = np.array(
        [
            apply_homography(
                site_from_image_homography(first.camera.undistorted(), pose),
                np.array([[first.camera.cx_px, first.camera.cy_px]]),
            )[0]
            for pose in first.true_poses
        ]
    )
    footprint_m = second.true_poses[index].translation_m[2] * camera.height_px / camera.fx_px
    near = np.flatnonzero(np.linalg.norm(places - centre, axis=1) < 0.45 * footprint_m)
    if not len(near):
        return None
    chosen = int(rng.choice(near))
    query = lens.undistort(second.frame(index).image)
    earlier = Undistorter(first.camera).undistort(first.frame(chosen).image)
    query_from_earlier = np.linalg.inv(site_from_query) @ site_from_image_homography(
        first.camera.undistorted(), first.true_poses[chosen]
    )
    # what alignment leaves: up to a few pixels at the corners
    corners = camera.corners_px.astype(np.float32)
    off = corners + rng.normal(0, rng.uniform(0, 1.5), corners.shape).astype(np.float32)
    query_from_earlier = cv2.getPerspectiveTransform(corners, off) @ query_from_earlier
    size = camera.width_px, camera.height_px
    reference = cv2.warpPerspective(earlier, query_from_earlier, size, flags=cv2.INTER_LINEAR)
    white = np.full(earlier.shape[:2], 255, np.uint8)
    white[[0, -1]] = 0
    white[:, [0, -1]] = 0
    valid = cv2.warpPerspective(white, query_from_earlier, size) == 255
    valid &= cv2.erode(valid.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
    truth = lens.undistort(change_mask(second, index)) > 127
    query, reference = (_stored(each, rng) for each in (query, reference))
    # the pixels around a thing are half its own, and its shadow is part of what came
    around = cv2.dilate(truth.view(np.uint8), np.ones((13, 13), np.uint8)) > 0
    return Pair(
        "simulated",
        f"simulated {second.settings.seed}",
        reference[..., ::-1].copy(),
        query[..., ::-1].copy(),
        valid,
        truth & valid,
        (around & ~truth) | ~valid,
    )


def _stored(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """As a video or a JPEG keeps it."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(75, 96))])[1]
    return cv2.imdecode(data, cv2.IMREAD_COLOR)
