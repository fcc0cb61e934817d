"""What a comparison could see: every cell of ground under its views has an answer, and sizes are those measured."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sorvolo.change.coverage import (
    GroundCoverage,
    coverage_summary,
)
from sorvolo.change.planting import (
    CONTRASTS,
    SIZES_PX,
    Planted,
    planted_in,
    recall_curve,
    sensitivities,
)
from sorvolo.change.robust import compare_robust
from sorvolo.survey.coverage import CoveredGround, Gap
from sorvolo.survey.findings import ComparedView

M_PER_PX = 0.05
SIZE = 640, 480  # 32 x 24 m


def view_of(
    ground: np.ndarray, index: int = 0, west_m: float = 0.0, north_m: float = 0.0
) -> ComparedView:
    """A view from straight above that shows the ground as the map has it; its top left corner is at a place."""
    picture = cv2.cvtColor(ground, cv2.COLOR_BGR2RGB)
    site_from_image = np.array([[M_PER_PX, 0, west_m], [0, -M_PER_PX, north_m], [0, 0, 1.0]])
    return ComparedView(
        index,
        f"{index}",
        index * 10**9,
        site_from_image,
        np.array([16.0 + west_m, -12.0 + north_m, 40.0]),
        picture,
        picture,
        np.ones(picture.shape[:2], bool),
        np.zeros(picture.shape[:2], np.uint8),
        np.zeros((0, 4), np.int64),
        np.zeros(0),
        0.3,
        np.zeros(picture.shape[:2], np.uint8),
    )


@pytest.fixture(scope="module")
def large_ground(ground: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(cv2.resize(ground, SIZE))


def areas(parts: list[CoveredGround]) -> dict[str, float]:
    found: dict[str, float] = {}
    for each in parts:
        name = "compared" if each.gap is None else each.gap.value
        found[name] = found.get(name, 0.0) + each.area_m2
    return found


def plain_things(count: int = 60) -> tuple[Planted, ...]:
    """Things of 10 px and more were found, smaller ones not."""
    return tuple(
        Planted(size, contrast, 0.1, size >= 10.0)
        for size in SIZES_PX
        for contrast in CONTRASTS
        for _ in range(count // 10)
    )


def test_two_views_compare_ground_and_one_does_not(large_ground):
    coverage = GroundCoverage()
    coverage.compare(view_of(large_ground), planted=plain_things())
    assert set(areas(coverage.parts())) == {"one-view"}
    coverage.compare(view_of(large_ground, 1, west_m=8.0))
    found = areas(coverage.parts())
    assert found["compared"] == pytest.approx(24 * 24, abs=40)
    assert found["one-view"] == pytest.approx(2 * 8 * 24, abs=40)


def test_each_gap_is_named_where_it_is(large_ground):
    coverage, dark = GroundCoverage(), large_ground.copy()
    dark[:, :160] = 3
    for index in range(3):
        view = view_of(dark, index)
        valid, doubted = view.valid.copy(), np.zeros(view.valid.shape, bool)
        valid[:, 480:], doubted[:240, 160:320] = False, True
        coverage.compare(replace(view, valid=valid), doubted=doubted, planted=plain_things())
    coverage.reject(
        np.array([[40.0, 0], [50, 0], [50, -10], [40, -10]]), Gap.REJECTED, "no single plane fits"
    )
    found = areas(coverage.parts())
    assert found["dark"] == pytest.approx(8 * 24, rel=0.1)
    assert found["leaning"] == pytest.approx(8 * 12, rel=0.1)
    assert found["no-map"] == pytest.approx(8 * 24, rel=0.1)
    assert found["view-rejected"] == pytest.approx(100, rel=0.25)
    assert found["compared"] == pytest.approx(8 * 24 + 8 * 12, rel=0.1)
    rejected = next(each for each in coverage.parts() if each.gap is Gap.REJECTED)
    assert rejected.why == "no single plane fits"
    outline = np.concatenate([rings[0] for rings in rejected.polygons])
    assert np.abs(outline.mean(axis=0) - [45, -5]).max() < 1.0
    summary = coverage_summary(coverage.parts(), 2)
    assert summary["not_compared_m2"] == pytest.approx(sum(found.values()) - found["compared"])
    assert summary["views_without_a_place"] == 2


def test_what_a_later_view_compares_is_no_longer_rejected(large_ground):
    coverage = GroundCoverage()
    outline = np.array([[2.0, -2], [20, -2], [20, -20], [2, -20]])
    coverage.reject(outline, Gap.REJECTED, "its features are found nowhere")
    for index in range(2):
        coverage.compare(view_of(large_ground, index), planted=plain_things())
    assert set(areas(coverage.parts())) == {"compared"}


def test_a_dark_flight_and_a_blurred_view_compare_nothing(large_ground):
    coverage = GroundCoverage()
    for index in range(3):
        coverage.compare(view_of(large_ground, index), is_dark=True)
    assert set(areas(coverage.parts())) == {"dark"}
    coverage = GroundCoverage()
    for index in range(4):
        coverage.compare(view_of(large_ground, index, west_m=100.0), planted=plain_things())
    blurred = cv2.GaussianBlur(large_ground, (0, 0), 4.0)
    for index in range(4, 6):
        coverage.compare(view_of(blurred, index), planted=plain_things())
    assert areas(coverage.parts())["blurred"] == pytest.approx(32 * 24, rel=0.1)


def test_most_of_the_ground_must_be_compared(large_ground):
    coverage = GroundCoverage()
    for index in range(2):
        coverage.compare(view_of(large_ground, index), planted=plain_things())
    assert coverage_summary(coverage.parts(), 0)["is_enough"]
    coverage.reject(
        np.array([[50.0, 0], [100, 0], [100, -30], [50, -30]]), Gap.NO_MAP, "beside the map"
    )
    assert coverage_summary(coverage.parts(), 0)["is_enough"]  # new ground extends the map
    coverage.reject(
        np.array([[50.0, 50], [100, 50], [100, 80], [50, 80]]),
        Gap.REJECTED,
        "its features are nowhere",
    )
    assert not coverage_summary(coverage.parts(), 0)["is_enough"]
    assert not coverage_summary(GroundCoverage().parts(), 3)["is_enough"]


def test_the_smallest_size_is_that_of_four_in_five_and_grows_with_roughness():
    rng = np.random.default_rng(5)
    planted = []
    for _ in range(4000):
        size = float(rng.choice(SIZES_PX))
        texture = float(rng.choice([0.05, 0.2]))
        chance = 1 / (1 + np.exp(-(4 * np.log(size / 10) - 2 * np.log(texture / 0.1))))
        planted.append(Planted(size, 1.0, texture, bool(rng.random() < chance)))
    plain, faint = sensitivities(planted)
    for texture in (0.05, 0.2):
        true = 10 * np.exp((np.log(4) + 2 * np.log(texture / 0.1)) / 4)
        assert plain.smallest_px(np.array([texture]))[0] == pytest.approx(true, rel=0.12)
    assert np.isnan(faint.smallest_px(np.array([0.1]))).all()  # nothing faint was planted


def test_ground_that_differs_and_that_no_change_explains_is_not_compared(large_ground):
    coverage = GroundCoverage()
    changed = np.zeros(SIZE[::-1], np.uint8)
    changed[100:300, 100:300] = 255  # 10 x 10 m
    changed[400, 500] = 255  # noise
    for index in range(3):
        flags = changed if index else np.zeros_like(changed)  # two of three views
        coverage.compare(replace(view_of(large_ground, index), changed=flags))
    assert areas(coverage.parts())["unexplained"] == pytest.approx(100, abs=21)
    square_m = np.array([[5.0, -5.0], [15, -5], [15, -15], [5, -15]])
    assert "unexplained" not in areas(coverage.parts([square_m]))
    assert areas(coverage.parts([square_m + np.array([40.0, 0.0])]))[
        "unexplained"
    ] == pytest.approx(100, abs=21)


def test_too_few_planted_things_prove_nothing(large_ground):
    coverage, few = (
        GroundCoverage(),
        [each for each in plain_things(60) if each.contrast == 1.0][:30],
    )
    lost_faint = [replace(few[0], contrast=0.35, found=False)]
    for index in range(2):
        coverage.compare(
            view_of(large_ground, index), planted=tuple([*few, *lost_faint]) if index else ()
        )
    summary = coverage_summary(coverage.parts(), 0, coverage.planted)
    assert summary["smallest_m"] is not None and summary["large_found"] is not None
    assert not summary["faint_known"] and summary["faint_m"] is None
    rare = GroundCoverage()
    for index in range(2):
        rare.compare(view_of(large_ground, index), planted=tuple(lost_faint))
    assert set(areas(rare.parts())) == {"compared"}  # one thing missed makes no ground blind
    assert coverage_summary(rare.parts(), 0, rare.planted)["large_found"] is None


def test_where_nothing_planted_is_found_nothing_is_compared(large_ground):
    coverage = GroundCoverage()
    for index in range(3):
        lost = tuple(replace(each, found=False) for each in plain_things())
        coverage.compare(view_of(large_ground, index), planted=lost)
    assert set(areas(coverage.parts())) == {"insensitive"}
    assert coverage_summary(coverage.parts(), 0)["smallest_m"] is None


def test_large_plain_things_are_found_on_real_ground_and_small_faint_ones_are_not(large_ground):
    view = view_of(large_ground)
    reference = cv2.cvtColor(view.reference, cv2.COLOR_RGB2BGR)

    def find(picture: np.ndarray) -> np.ndarray:
        query = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        return compare_robust(reference, query, view.valid, 0.5).mask > 0

    planted = [
        each for seed in range(3) for each in planted_in(view, find, np.random.default_rng(seed))
    ]
    curve = {(each["contrast"], each["size_px"]): each for each in recall_curve(planted)}
    assert sum(each["planted"] for each in curve.values()) == len(planted) >= 50
    plain = [curve[1.0, size] for size in SIZES_PX]
    assert sum(each["found"] for each in plain[-3:]) >= 0.8 * sum(
        each["planted"] for each in plain[-3:]
    )
    faint = [curve[0.35, size] for size in SIZES_PX]
    assert sum(each["found"] for each in faint[:2]) <= 0.5 * sum(
        each["planted"] for each in faint[:2]
    )
    smallest = [each.smallest_px(np.array([0.1]))[0] for each in sensitivities(planted)]
    assert smallest[0] < 28 and not smallest[1] < smallest[0]


def test_a_view_in_its_turn_is_planted(large_ground):
    from sorvolo.change.planting import Planting

    planting, taken = Planting(), []
    for index in range(60):
        taken.append(
            bool(
                planting.plant(
                    view_of(large_ground, index), lambda each: np.zeros(each.shape[:2], bool)
                )
            )
        )
    assert taken[0] and 8 <= sum(taken) <= 12
