"""Links: right to a fraction of a pixel where two views share ground, a reason in words where they do not."""

from dataclasses import replace

import numpy as np
import pytest
from pictured import HEIGHT, WIDTH, ground, keyframe, photographed, placed

from sorvolo.geometry.homography import apply_homography, site_from_image_homography
from sorvolo.lab.simulation.flight import simulate_flight
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)
from sorvolo.registration.link import Effort, LinkCache, LinkPrediction, LinkSettings, link, refine
from sorvolo.survey.mosaic import Link, NoLink

SCENE = ground(1)
OLD = placed(500, 420)
NEW = placed(590, 450, turn_deg=6, scale=1.04, lean=4e-5)
NEW_FROM_OLD = np.linalg.inv(NEW) @ OLD


def linked(new_image, old_image, prediction=None):
    settings = LinkSettings()
    return link(
        keyframe(7, new_image),
        keyframe(3, old_image),
        prediction,
        settings,
        LinkCache(settings.features),
    )


def median_miss_px(found: Link, new_from_old: np.ndarray) -> float:
    return float(
        np.median(
            np.linalg.norm(apply_homography(new_from_old, found.old_px) - found.new_px, axis=1)
        )
    )


def corner_miss_px(found: Link, new_from_old: np.ndarray) -> float:
    inside = np.array(
        [[150, 80], [WIDTH - 20, 80], [WIDTH - 20, HEIGHT - 40], [150, HEIGHT - 40]], float
    )
    return float(
        np.abs(
            apply_homography(found.new_from_old, inside) - apply_homography(new_from_old, inside)
        ).max()
    )


@pytest.mark.parametrize("gain", [1.0, 1.3, 0.7])
def test_pairs_are_right_whatever_the_exposure(gain):
    found = linked(photographed(SCENE, NEW, gain=gain, seed=1), photographed(SCENE, OLD, seed=2))
    assert isinstance(found, Link)
    assert (found.new_id, found.old_id) == (7, 3)
    assert median_miss_px(found, NEW_FROM_OLD) < 0.15
    assert corner_miss_px(found, NEW_FROM_OLD) < 0.5
    assert 18 <= len(found.new_px) <= LinkSettings().max_pairs
    assert 0.05 <= found.sigma_px < 0.5


def test_pairs_are_spread_over_the_overlap():
    found = linked(photographed(SCENE, NEW, seed=1), photographed(SCENE, OLD, seed=2))
    cells = {(int(x // 120), int(y // 120)) for x, y in found.new_px}
    assert len(cells) >= 8


def test_a_faint_ghost_in_other_ground_is_no_link():
    """Dirt on the lens or the drone's own legs stand still in every picture: what is followed must also look alike."""
    picture = photographed(SCENE, OLD, seed=1)
    ghost = picture * 0.15 + photographed(ground(12), OLD, seed=4) * 0.85
    new, old = keyframe(7, picture), keyframe(3, np.clip(ghost, 0, 255).astype(np.uint8))
    careless = LinkSettings(min_correlation=-1.0)
    assert isinstance(refine(new, old, np.eye(3), careless, LinkCache(careless.features)), Link)
    assert isinstance(
        refine(new, old, np.eye(3), LinkSettings(), LinkCache(careless.features)), str
    )


def test_asked_cheaply_nobody_pays_for_sift():
    settings, old = LinkSettings(), keyframe(3, photographed(SCENE, OLD, seed=2))
    cache = LinkCache(settings.features)
    other = keyframe(8, photographed(ground(20), NEW))
    assert isinstance(link(other, old, None, settings, cache, Effort.CHEAP), NoLink)
    assert not cache._sift
    found = link(
        keyframe(7, photographed(SCENE, NEW, seed=1)), old, None, settings, cache, Effort.DEAR
    )
    assert isinstance(found, Link) and cache._sift


@pytest.mark.parametrize("turn_deg", [90, 180, -90])
def test_turned_pictures_link(turn_deg):
    turned = placed(520, 430, turn_deg=turn_deg)
    found = linked(photographed(SCENE, turned, seed=3), photographed(SCENE, OLD, seed=4))
    assert isinstance(found, Link)
    assert median_miss_px(found, np.linalg.inv(turned) @ OLD) < 0.15


def test_bare_sand_links():
    sand = ground(2, spread=2.0)
    new = placed(560, 440, turn_deg=3)
    truth = np.linalg.inv(new) @ OLD
    for prediction in (None, LinkPrediction(placed_off(truth, 12), 40.0)):
        found = linked(
            photographed(sand, new, noise=0.7, seed=5),
            photographed(sand, OLD, noise=0.7, seed=6),
            prediction,
        )
        assert isinstance(found, Link)
        assert median_miss_px(found, truth) < 0.3


def placed_off(new_from_old: np.ndarray, off_px: float) -> np.ndarray:
    return np.array([[1, 0, off_px], [0, 1, -off_px / 2], [0, 0, 1.0]]) @ new_from_old


def test_faint_sand_under_noise_links_by_learned_features():
    """Half of each picture is shared, three gray levels of texture under nine of noise: all else fails."""
    flight = simulate_flight(
        SimulationSettings(
            seed=7104,
            flights=1,
            scene=SceneSettings("sand", 0, 0, 0, has_scenery=False),
            path=PathSettings(height_m=25, length_m=22, strips=1),
            imaging=ImagingSettings(width_px=640, height_px=480, distortion=(0.0,) * 5, noise=9.0),
            output=OutputSettings(photos=True, photo_overlap=0.5),
        )
    )
    site_from = [site_from_image_homography(flight.camera, pose) for pose in flight.true_poses[:2]]
    truth = np.linalg.inv(site_from[1]) @ site_from[0]
    old, new = (
        replace(keyframe(number, flight.frame(number).image), camera=flight.camera)
        for number in (0, 1)
    )
    turned = (
        truth @ np.linalg.inv(placed(240, 180)) @ placed(245, 170, turn_deg=3, scale=1.04)
    )  # as a compass errs
    prediction, settings = LinkPrediction(turned, 60.0), LinkSettings()
    found = link(new, old, prediction, settings, LinkCache(settings.features))
    assert isinstance(found, Link)
    assert median_miss_px(found, truth) < 2.0 and found.sigma_px > 0.3
    elsewhere = LinkPrediction(placed_off(truth, 200), 40.0)
    assert isinstance(link(new, old, elsewhere, settings, LinkCache(settings.features)), NoLink)


@pytest.mark.parametrize("off_px", [0.0, 2.0, 4.0])
def test_a_tight_prediction_is_refined_at_once(off_px):
    prediction = LinkPrediction(placed_off(NEW_FROM_OLD, off_px), 24.0, is_tight=True)
    found = linked(photographed(SCENE, NEW, seed=7), photographed(SCENE, OLD, seed=8), prediction)
    assert isinstance(found, Link)
    assert median_miss_px(found, NEW_FROM_OLD) < 0.15


def test_a_tight_prediction_that_is_wrong_is_found_out():
    prediction = LinkPrediction(placed_off(NEW_FROM_OLD, 30), 60.0, is_tight=True)
    found = linked(photographed(SCENE, NEW, seed=7), photographed(SCENE, OLD, seed=8), prediction)
    assert isinstance(found, Link)
    assert median_miss_px(found, NEW_FROM_OLD) < 0.15


def test_a_prediction_of_another_place_gives_no_false_link():
    prediction = LinkPrediction(placed_off(NEW_FROM_OLD, 150), 20.0)
    found = linked(photographed(SCENE, NEW, seed=7), photographed(SCENE, OLD, seed=8), prediction)
    assert isinstance(found, NoLink)


@pytest.mark.parametrize(
    "prediction",
    [None, LinkPrediction(NEW_FROM_OLD, 40.0), LinkPrediction(NEW_FROM_OLD, 9, True)],
    ids=["none", "loose", "tight"],
)
def test_unrelated_pictures_do_not_link(prediction):
    for seed in range(2):
        found = linked(
            photographed(ground(10 + seed), NEW, seed=9),
            photographed(ground(20 + seed), OLD, seed=10),
            prediction,
        )
        assert isinstance(found, NoLink)
        assert (found.new_id, found.old_id) == (7, 3)
        assert len(found.reason.split()) >= 3


@pytest.mark.parametrize(
    "prediction",
    [None, LinkPrediction(NEW_FROM_OLD, 40.0), LinkPrediction(NEW_FROM_OLD, 9, True)],
    ids=["none", "loose", "tight"],
)
def test_water_does_not_link(prediction):
    flat = np.full((900, 1200), 90.0, np.float32)
    found = linked(
        photographed(flat, NEW, noise=1.5, seed=11),
        photographed(flat, OLD, noise=1.5, seed=12),
        prediction,
    )
    assert isinstance(found, NoLink)
    assert found.reason


def test_a_black_picture_does_not_link():
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    assert isinstance(linked(black, black), NoLink)
    assert isinstance(
        linked(black, photographed(SCENE, OLD), LinkPrediction(NEW_FROM_OLD, 9, True)), NoLink
    )


def test_what_is_known_to_share_little_links_by_sift():
    far = placed(500 + 0.8 * WIDTH, 420, turn_deg=3)
    truth = np.linalg.inv(far) @ OLD
    new, old = (
        keyframe(7, photographed(SCENE, far, seed=13)),
        keyframe(3, photographed(SCENE, OLD, seed=14)),
    )
    prediction, settings = LinkPrediction(placed_off(truth, 4), 24.0, is_tight=True), LinkSettings()
    found = link(new, old, prediction, settings, LinkCache(settings.features), Effort.DEAR)
    assert isinstance(found, Link)
    assert median_miss_px(found, truth) < 0.3


def test_pictures_that_share_a_sliver_do_not_link():
    far = placed(500 + 0.97 * WIDTH, 420)
    found = linked(photographed(SCENE, far, seed=13), photographed(SCENE, OLD, seed=14))
    assert isinstance(found, NoLink)


def test_linking_repeats_itself():
    images = photographed(SCENE, NEW, seed=1), photographed(SCENE, OLD, seed=2)
    first, second = linked(*images), linked(*images)
    assert (first.new_px == second.new_px).all() and (
        first.new_from_old == second.new_from_old
    ).all()


def test_the_cache_forgets_the_oldest():
    settings = LinkSettings()
    cache = LinkCache(settings.features, capacity=2)
    frames = [keyframe(k, photographed(SCENE, placed(450 + 40 * k, 420))) for k in range(3)]
    first = cache.corners(frames[0])
    assert cache.corners(frames[0]) is first
    for each in frames[1:]:
        cache.corners(each)
    again = cache.corners(frames[0])
    assert again is not first and (again == first).all()
