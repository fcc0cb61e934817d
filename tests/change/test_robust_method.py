"""The robust method: what it finds, what it leaves alone, and its kernels against their NumPy twins."""

import json
from importlib.resources import files

import cv2
import numpy as np
import numpy_robust
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sensor_noise import camera

from sorvolo import kernels
from sorvolo.change.measures import FlightMeasures, PairMeasures
from sorvolo.change.regions import FEATURES
from sorvolo.change.robust import Trees, compare_robust, examine, how_sure
from sorvolo.change.settling import settle


def with_box(image: np.ndarray, colour: tuple[int, int, int] = (190, 60, 40)) -> np.ndarray:
    """A 44 x 28 px box at (200, 150)."""
    return cv2.rectangle(image.copy(), (200, 150), (243, 177), colour, -1)


def overlap(mask: np.ndarray) -> float:
    truth = np.zeros(mask.shape, bool)
    truth[150:178, 200:244] = True
    return float((truth & (mask > 0)).sum() / (truth | (mask > 0)).sum())


def test_a_box_that_came_is_found_where_it_is(ground: np.ndarray) -> None:
    result = compare_robust(camera(ground, 1), camera(with_box(ground), 2))
    assert overlap(result.mask) > 0.85
    assert result.boxes.shape == (1, 4) and np.abs(result.boxes[0] - [200, 150, 44, 28]).max() <= 4
    assert result.scores[0] > 0.8
    assert set(np.unique(result.mask)) == {0, 255}


def test_no_result_is_written_over_by_the_next_pair(ground: np.ndarray) -> None:
    first, second = (
        (camera(ground, 1), camera(with_box(ground), 2)),
        (camera(with_box(ground), 3), camera(ground, 4)),
    )
    examined, compared = examine(*first, None), compare_robust(*first)
    arrays = [
        examined.views.after,
        examined.views.lit,
        examined.regions.strength,
        examined.regions.weak,
        examined.regions.labels,
        examined.light.gains,
        compared.mask,
        compared.light.gains,
    ]
    kept = [each.copy() for each in arrays]
    examine(*second, None)
    compare_robust(*second)
    assert all(np.array_equal(a, b) for a, b in zip(arrays, kept, strict=True))


def test_a_box_that_went_is_found_where_it_was(ground: np.ndarray) -> None:
    moved = cv2.warpAffine(
        ground,
        np.float64([[1, 0, 3.0], [0, 1, -2.0]]),
        ground.shape[1::-1],
        borderMode=cv2.BORDER_REFLECT,
    )
    result = compare_robust(camera(with_box(ground), 1), camera(moved, 2))
    assert overlap(result.mask) > 0.75


def test_other_light_and_misalignment_are_no_change(ground: np.ndarray) -> None:
    relit = np.clip(255 * (ground / 255.0) ** 0.8 * [0.8, 0.9, 1.0], 0, 255)
    moved = cv2.warpAffine(
        relit,
        np.float64([[1, 0.004, 2.5], [-0.004, 1, 3.0]]),
        ground.shape[1::-1],
        borderMode=cv2.BORDER_REFLECT,
    )
    result = compare_robust(camera(ground, 1), camera(moved, 2))
    assert not result.mask.any() and len(result.boxes) == len(result.scores) == 0


def test_a_cloud_is_no_change_and_hides_none(ground: np.ndarray) -> None:
    shade = np.zeros(ground.shape[:2], np.float32)
    cv2.circle(shade, (380, 80), 120, 1.0, -1)
    shade = 1 - 0.45 * cv2.GaussianBlur(shade, (0, 0), 20)[..., None]
    assert not compare_robust(camera(ground, 1), camera(ground * shade, 2)).mask.any()
    assert (
        overlap(compare_robust(camera(ground, 1), camera(with_box(ground) * shade, 2)).mask) > 0.8
    )


def test_unknown_is_never_changed_nor_is_its_rim(ground: np.ndarray) -> None:
    valid = np.ones(ground.shape[:2], bool)
    valid[:, 220:] = False
    hole = ground.copy()
    hole[~valid] = 0
    mask = compare_robust(camera(hole, 1), camera(with_box(ground), 2), valid).mask
    assert not mask[:, 214:].any()
    nothing = compare_robust(ground, with_box(ground), np.zeros_like(valid))
    assert not nothing.mask.any() and nothing.known == 0


@pytest.mark.parametrize("size", [(32, 32), (33, 47), (90, 61)])
def test_small_and_odd_sizes_work(ground: np.ndarray, size: tuple[int, int]) -> None:
    piece = np.ascontiguousarray(ground[: size[0], : size[1]])
    result = compare_robust(piece, camera(piece, 4))
    assert result.mask.shape == size and not result.mask.any()


@pytest.mark.parametrize("value", [0, 128, 255])
def test_flat_pictures_are_equal(value: int) -> None:
    flat = np.full((64, 80, 3), value, np.uint8)
    assert not compare_robust(flat, flat).mask.any()


def test_settling_finds_a_shift_whatever_the_light(ground: np.ndarray) -> None:
    gray = cv2.cvtColor(ground, cv2.COLOR_BGR2GRAY)
    moved = cv2.warpAffine(
        gray,
        np.float64([[1, 0, 2.0], [0, 1, -1.5]]),
        gray.shape[::-1],
        borderMode=cv2.BORDER_REFLECT,
    )
    settling = settle(gray, np.clip(moved * 0.7 + 5, 0, 255).astype(np.uint8))
    middle = settling.reference_from_query @ [240.0, 180.0, 1.0]
    np.testing.assert_allclose(middle[:2] / middle[2], [238.0, 181.5], atol=0.25)


def test_trees_know_their_features() -> None:
    asked, thresholds, leaves = (
        np.array([[0, 1]], np.int32),
        np.array([[1.0, 5.0]]),
        np.array([[-3.0, -1.0, 1.0, 3.0]]),
    )
    trees = Trees(0.0, asked, thresholds, leaves)
    sure = how_sure(np.array([[0.0, 0.0], [0.0, 6.0], [2.0, 0.0], [2.0, 6.0]]), trees)
    np.testing.assert_allclose(sure, 1 / (1 + np.exp([3.0, 1.0, -1.0, -3.0])))
    assert how_sure(np.zeros((0, 2)), trees).shape == (0,)
    stored = json.loads(files("sorvolo.change").joinpath("region_score.json").read_text())
    assert tuple(stored["names"]) == FEATURES


def test_a_flight_shows_how_noisy_it_is(ground: np.ndarray) -> None:
    loud, quiet = FlightMeasures(), FlightMeasures()
    assert loud.summary() == {"frames": 0} and np.isnan(loud.brightness)
    noise = np.random.default_rng(5).normal(0, 14, ground.shape)
    for seed in range(3):
        query = np.clip(camera(ground, seed) + noise, 0, 255).astype(np.uint8)
        loud.observe(PairMeasures.of(compare_robust(ground, query)))
    quiet.observe(PairMeasures.of(compare_robust(ground, camera(ground, 1))))
    assert loud.summary()["frames"] == 3
    assert float(loud.summary()["noise_levels"]) > float(quiet.summary()["noise_levels"])
    assert 0.9 < quiet.brightness < 1.1


pictures = st.integers(0, 2**31).map(np.random.default_rng)


@settings(max_examples=25, deadline=None)
@given(
    pictures,
    st.integers(1, 40),
    st.integers(1, 40),
    st.floats(1.0, 2.0),
    st.floats(0.2, 1.0),
    st.integers(1, 8),
)
def test_core_regions_agree(
    rng: np.random.Generator, height: int, width: int, strong: float, core: float, least: int
) -> None:
    values = rng.integers(0, 90, (height, width), dtype=np.uint8)
    thresholds = rng.integers(20, 100, (height, width), dtype=np.uint8)
    ours = kernels.core_regions(values, thresholds, strong, core, least, 6)
    plain = numpy_robust.core_regions(values, thresholds, strong, core, least, 6)
    for one, other in zip(ours, plain):
        np.testing.assert_array_equal(one, other)


@settings(max_examples=15, deadline=None)
@given(pictures, st.integers(3, 80), st.integers(3, 80), st.integers(0, 3))
def test_matches_agree(rng: np.random.Generator, height: int, width: int, reach: int) -> None:
    query = rng.integers(0, 256, (height, width), dtype=np.uint8)
    searched = rng.integers(
        0, rng.integers(1, 257), (height + 2 * reach, width + 2 * reach)
    ).astype(np.uint8)
    corner = rng.integers(0, [width, height], (5, 2))
    boxes = np.hstack([corner, rng.integers(1, np.array([width, height]) - corner + 1)]).astype(
        np.int32
    )
    np.testing.assert_array_equal(
        kernels.match_regions(query, searched, boxes, reach),
        numpy_robust.match_regions(query, searched, boxes, reach),
    )


@settings(max_examples=15, deadline=None)
@given(pictures, st.integers(1, 50), st.integers(1, 50), st.integers(1, 12), st.integers(0, 5))
def test_measures_agree(
    rng: np.random.Generator, height: int, width: int, channels: int, margin: int
) -> None:
    labels = rng.integers(0, 4, (height, width), dtype=np.uint8)
    stack = list(rng.integers(0, 256, (channels, height, width), dtype=np.uint8))
    corner = rng.integers(0, [width, height], (3, 2))
    boxes = np.hstack([corner, rng.integers(1, np.array([width, height]) - corner + 1)]).astype(
        np.int32
    )
    np.testing.assert_array_equal(
        kernels.measure_regions(labels, boxes, stack, margin),
        numpy_robust.measure_regions(labels, boxes, stack, margin),
    )


@given(
    st.integers(0, 9).map(np.random.default_rng),
    st.integers(0, 30),
    st.integers(1, 40),
    st.integers(1, 6),
    st.integers(1, 9),
)
@settings(max_examples=40)
def test_trees_agree(
    rng: np.random.Generator, rows: int, trees: int, depth: int, width: int
) -> None:
    features = rng.integers(0, 5, (rows, width)).astype(float)
    asked = rng.integers(0, width, (trees, depth)).astype(np.int32)
    thresholds, leaves = (
        rng.integers(0, 5, (trees, depth)).astype(float),
        rng.normal(size=(trees, 2**depth)),
    )
    expected = numpy_robust.tree_margins(features, asked, thresholds, leaves)
    assert np.array_equal(kernels.tree_margins(features, asked, thresholds, leaves), expected)


def test_trees_that_do_not_fit_are_refused() -> None:
    asked, thresholds, leaves = np.zeros((2, 1), np.int32), np.zeros((2, 1)), np.zeros((2, 2))
    for wrong in (
        (np.zeros((1, 0)), asked),
        (np.zeros((1, 3)), asked + 3),
        (np.zeros((1, 3)), asked - 1),
    ):
        with pytest.raises(ValueError, match="tree_margins"):
            kernels.tree_margins(*wrong, thresholds, leaves)
    with pytest.raises(ValueError, match="tree_margins"):
        kernels.tree_margins(np.zeros((1, 3)), asked, thresholds, np.zeros((2, 3)))


def test_boxes_outside_are_refused() -> None:
    picture = np.zeros((10, 10), np.uint8)
    with pytest.raises(ValueError, match="outside"):
        kernels.match_regions(picture, np.zeros((14, 14), np.uint8), np.int32([[5, 5, 6, 2]]), 2)
