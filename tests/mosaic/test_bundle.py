"""The pose graph's mathematics: its derivatives are those of its residuals, and its solve finds the truth."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sorvolo.geometry.pose import NADIR_CAMERA_NORTH_UP, rotation_from_vector
from sorvolo.mosaic.bundle import (
    NO_GROUND,
    SHARED,
    Ground,
    Nodes,
    Pairs,
    _normal_equations,
    _Problem,
    linearise,
    solve,
    whiten,
)

FOCAL_PX = 600.0
HELD = np.zeros(len(SHARED))


def staged(
    seed: int = 0, count: int = 6, pairs_per_link: int = 25, own: list[int] | None = None
) -> tuple[Nodes, Pairs]:
    """Cameras on a winding path 20 m up and exact pairs between each and the two before it."""
    rng = np.random.default_rng(seed)
    along = np.arange(count)
    centres = np.column_stack([4.0 * along, 2.0 * np.sin(along), 20 + rng.normal(0, 0.5, count)])
    turn = np.column_stack([rng.normal(0, 0.04, (count, 2)), rng.uniform(-0.3, 0.3, count)])
    rotations = rotation_from_vector(turn) @ NADIR_CAMERA_NORTH_UP
    links = [(old, new) for new in range(count) for old in (new - 1, new - 2) if old >= 0]
    old, new = np.array(links).T
    middle = (centres[old, :2] + centres[new, :2]) / 2
    ground = np.concatenate(
        [
            middle[:, None] + rng.uniform(-4, 4, (len(links), pairs_per_link, 2)),
            np.zeros((len(links), pairs_per_link, 1)),
        ],
        axis=-1,
    )

    def ideal(at: np.ndarray) -> np.ndarray:
        local = (ground - centres[at][:, None]) @ rotations[at]
        return local[..., :2] / local[..., 2:]

    infinite = np.full((count, 3), 1e6)
    is_own = np.ones(count, bool) if own is None else np.isin(along, own)
    nodes = Nodes(
        rotations, centres, centres.copy(), np.ones((count, 3)), rotations.copy(), infinite, is_own
    )
    weight = np.ones((len(links), pairs_per_link))
    pairs = Pairs(
        old,
        new,
        ideal(old),
        ideal(new),
        weight,
        np.full(len(links), FOCAL_PX),
        np.full(len(links), 0.3),
        np.zeros(len(links)),
    )
    return nodes, pairs


def moved(nodes: Nodes, at: int, six: np.ndarray) -> Nodes:
    rotations, centres = nodes.rotations.copy(), nodes.centres_m.copy()
    rotations[at] = rotation_from_vector(six[:3]) @ rotations[at]
    centres[at] += six[3:]
    return replace(nodes, rotations=rotations, centres_m=centres)


def disturbed(nodes: Nodes, seed: int, metres: float = 0.3, radians: float = 0.02) -> Nodes:
    rng = np.random.default_rng(seed)
    for at in range(len(nodes.centres_m)):
        nodes = moved(
            nodes, at, np.concatenate([rng.normal(0, radians, 3), rng.normal(0, metres, 3)])
        )
    return nodes


def differs_by(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.abs(found - expected).max() / np.abs(expected).max())


@pytest.mark.parametrize("own", [None, [2, 3, 4, 5]])
def test_derivatives_by_cameras_are_those_of_the_residuals(own):
    nodes, pairs = staged(1, own=own)
    nodes = disturbed(nodes, 2)
    shared = np.array([0.03, 0.02, 0, 0, 0, 0, 0, 0.0])
    line = linearise(nodes, pairs, shared)
    assert line.seen.all()
    step = 1e-5
    for at in range(len(nodes.centres_m)):
        for axis in range(6):
            six = np.zeros(6)
            six[axis] = step
            ahead = linearise(moved(nodes, at, six), pairs, shared).residual_px
            back = linearise(moved(nodes, at, -six), pairs, shared).residual_px
            expected = (ahead - back) / (2 * step)
            analytic = (pairs.old == at)[:, None, None] * line.by_old[..., axis]
            analytic = analytic + (pairs.new == at)[:, None, None] * line.by_new[..., axis]
            assert differs_by(analytic, expected) < 1e-6


@pytest.mark.parametrize("own", [None, [2, 3, 4, 5]])
@pytest.mark.parametrize("which", [0, 1])
def test_derivatives_by_focal_length_and_radial_distortion(own, which):
    nodes, pairs = staged(3, own=own)
    nodes = disturbed(nodes, 4)
    shared = np.array([-0.02, 0.03, 0, 0, 0, 0, 0, 0.0])
    analytic = linearise(nodes, pairs, shared).by_shared[..., which]
    step = np.zeros(8)
    step[which] = 1e-5
    ahead = linearise(nodes, pairs, shared + step).residual_px
    back = linearise(nodes, pairs, shared - step).residual_px
    assert differs_by(analytic, (ahead - back) / 2e-5) < 1e-6


def test_parallax_is_what_a_metre_of_height_moves():
    nodes, pairs = staged(5)
    line = linearise(nodes, pairs, HELD)
    centre_old, centre_new = (
        nodes.centres_m[pairs.old][:, None],
        nodes.centres_m[pairs.new][:, None],
    )
    ray = np.concatenate([pairs.old_ideal, np.ones((*pairs.old_ideal.shape[:2], 1))], axis=-1)
    ray = ray @ nodes.rotations[pairs.old].transpose(0, 2, 1)
    point = centre_old + ray * ((1e-4 - centre_old[..., 2:]) / ray[..., 2:])
    local = (point - centre_new) @ nodes.rotations[pairs.new]
    shift = FOCAL_PX * (local[..., :2] / local[..., 2:] - pairs.new_ideal) / 1e-4
    assert np.abs(np.abs(shift) - np.abs(line.parallax)).max() < 1e-3 * np.abs(line.parallax).max()


def test_whitening_is_loose_along_the_parallax_and_tight_across_it():
    nodes, pairs = staged(6)
    pairs = replace(pairs, sigma_relief_m=np.full(len(pairs.old), 0.5))
    line = linearise(nodes, pairs, HELD)
    white = whiten(line, pairs)
    along = line.parallax / np.linalg.norm(line.parallax, axis=-1, keepdims=True)
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    tight = np.linalg.norm(np.einsum("lkij,lkj->lki", white, across), axis=-1)
    loose = np.linalg.norm(np.einsum("lkij,lkj->lki", white, along), axis=-1)
    assert np.allclose(tight, 1 / 0.3)
    assert np.allclose(loose, 1 / np.hypot(0.3, 0.5 * np.linalg.norm(line.parallax, axis=-1)))


def known_ground(nodes: Nodes, sigma_m: float = 0.05) -> Ground:
    """Two points below each camera, some metres high, as it really sees them."""
    rng = np.random.default_rng(30)
    node = np.repeat(np.arange(len(nodes.centres_m)), 2)
    below_m = nodes.centres_m[node, :2] + rng.uniform(-4, 4, (len(node), 2))
    place_m = np.column_stack([below_m, rng.uniform(-2, 2, len(node))])
    local = np.einsum("mji,mj->mi", nodes.rotations[node], place_m - nodes.centres_m[node])
    focal_px, sigma_px = np.full(len(node), FOCAL_PX), np.full(len(node), 0.5)
    return Ground(
        node, local[:, :2] / local[:, 2:], place_m, focal_px, sigma_px, np.full(len(node), sigma_m)
    )


@pytest.mark.parametrize("has_ground", [False, True], ids=["links", "known ground"])
@pytest.mark.parametrize("attitude_sigma_rad", [1e6, 0.05])
def test_the_gradient_is_that_of_the_cost(attitude_sigma_rad, has_ground):
    nodes, pairs = staged(7, count=4, pairs_per_link=8)
    ground = (
        known_ground(nodes, sigma_m=0.0) if has_ground else NO_GROUND
    )  # px of a place's sigma hang on the camera
    turned = rotation_from_vector(np.random.default_rng(8).normal(0, 2e-3, (4, 3)))
    nodes = replace(
        disturbed(nodes, 9, metres=0.02, radians=1e-3),
        prior_rotations=turned @ nodes.rotations,
        prior_sigma_rad=np.full((4, 3), attitude_sigma_rad),
    )
    shared = np.array([0.004, 0.005, 0.1, -0.2, 0.15, 2e-3, -1e-3, 2e-3])
    sigma = np.array([0.05, 0.03, 1.0, 2.0, 2.0, 0.02, 0.02, 0.02])

    def cost(at: int, step: np.ndarray) -> float:
        changed = moved(nodes, at, step[:6]) if at < 4 else nodes
        return _normal_equations(problem, changed, shared + (step if at == 4 else 0.0)).cost

    problem = _Problem(pairs, ground, sigma, np.array([-1, 0, 1, 2]))
    equations = _normal_equations(problem, nodes, shared)
    gradient = equations.gradient()
    expected = []
    for at, length in ((1, 6), (2, 6), (3, 6), (4, 8)):
        for axis in range(length):
            step = np.zeros(length)
            step[axis] = 1e-6
            # the step solves normal * step = gradient for a cost of squares: the gradient is minus half its slope
            expected.append(-(cost(at, step) - cost(at, -step)) / 2e-6 / 2)
    assert len(gradient) == 26
    # each kind of unknown against its own size: cameras, lens, offsets, boresight
    for kind in (slice(0, 18), slice(18, 20), slice(20, 23), slice(23, 26)):
        assert np.abs(gradient[kind] - expected[kind]).max() < 5e-3 * np.abs(expected[kind]).max()


def test_a_held_unknown_stays_where_it_is():
    nodes, pairs = staged(10)
    shared = np.array([0.01, 0, 0, 0, 0, 0, 0, 0.0])
    solution = solve(disturbed(nodes, 11), pairs, shared, HELD, np.ones(6, bool), 10)
    assert np.abs(solution.shared - shared).max() < 1e-6


def test_a_node_that_is_not_free_never_moves():
    nodes, pairs = staged(12)
    start = disturbed(nodes, 13)
    free = np.array([False, True, True, True, True, False])
    solution = solve(start, pairs, HELD, HELD, free, 10)
    assert (solution.nodes.centres_m[~free] == start.centres_m[~free]).all()
    assert (solution.nodes.rotations[~free] == start.rotations[~free]).all()
    assert np.abs(solution.nodes.centres_m[free] - start.centres_m[free]).max() > 0.01


@pytest.mark.parametrize("seed", range(4))
def test_a_perfect_problem_is_solved_exactly(seed):
    nodes, pairs = staged(seed)
    solution = solve(disturbed(nodes, seed + 20), pairs, HELD, HELD, np.ones(6, bool), 40)
    assert np.abs(solution.nodes.centres_m - nodes.centres_m).max() < 1e-6
    assert solution.equations.cost < 1e-8
    assert np.allclose(
        solution.nodes.rotations @ solution.nodes.rotations.transpose(0, 2, 1),
        np.eye(3),
        atol=1e-12,
    )


def test_known_ground_brings_a_map_without_fixes_to_its_place():
    nodes, pairs = staged(21, count=6)
    free = replace(nodes, prior_sigma_m=np.full((6, 3), 1e6))
    away = replace(
        disturbed(free, 22, 0.1, 0.005), centres_m=nodes.centres_m + np.array([3.0, -2.0, 1.0])
    )
    solution = solve(away, pairs, HELD, HELD, np.ones(6, bool), 40, ground=known_ground(nodes))
    assert np.abs(solution.nodes.centres_m - nodes.centres_m).max() < 1e-4


def test_the_focal_length_is_found_where_heights_are_known():
    nodes, pairs = staged(14, count=8)
    wrong = replace(pairs, old_ideal=pairs.old_ideal * 1.04, new_ideal=pairs.new_ideal * 1.04)
    sure = replace(nodes, prior_sigma_m=np.full((8, 3), 0.02))
    sigma = HELD.copy()
    sigma[0] = 0.1
    solution = solve(disturbed(sure, 15), wrong, HELD, sigma, np.ones(8, bool), 40)
    assert abs(np.exp(solution.shared[0]) - 1.04) < 2e-3
    assert np.abs(solution.nodes.centres_m - nodes.centres_m).max() < 0.02


def test_a_fifth_of_wild_pairs_does_no_harm():
    nodes, pairs = staged(16, count=8)
    rng = np.random.default_rng(17)
    wild = rng.random(pairs.weight.shape) < 0.2
    new_ideal = (
        pairs.new_ideal + wild[..., None] * rng.uniform(-60, 60, pairs.new_ideal.shape) / FOCAL_PX
    )
    new_ideal += rng.normal(0, 0.2 / FOCAL_PX, new_ideal.shape)
    solution = solve(
        disturbed(nodes, 18, 0.1, 0.005),
        replace(pairs, new_ideal=new_ideal),
        HELD,
        HELD,
        np.ones(8, bool),
        30,
    )
    assert np.abs(solution.nodes.centres_m - nodes.centres_m).max() < 0.15
    assert np.abs(solution.nodes.centres_m[:, :2] - nodes.centres_m[:, :2]).max() < 0.1


def test_one_wild_fix_does_no_harm(monkeypatch):
    nodes, pairs = staged(19, count=10)
    prior = nodes.prior_centres_m.copy()
    prior[4, :2] += [80.0, -50.0]
    solution = solve(
        disturbed(replace(nodes, prior_centres_m=prior), 20),
        pairs,
        HELD,
        HELD,
        np.ones(10, bool),
        40,
    )
    assert np.abs(solution.nodes.centres_m - nodes.centres_m).max() < 0.25
    # the same fix believed in squares would pull the whole flight along
    monkeypatch.setattr("sorvolo.mosaic.bundle.ROBUST_SIGMAS", 1e6)
    squares = solve(
        replace(nodes, prior_centres_m=prior),
        pairs,
        HELD,
        HELD,
        np.ones(10, bool),
        40,
    )
    assert np.abs(squares.nodes.centres_m - nodes.centres_m).max() > 3.0


@given(st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3))
def test_rotation_vectors_go_there_and_back(vector):
    there = rotation_from_vector(np.array([vector]))
    assert np.allclose(Rotation.from_matrix(there).as_rotvec()[0], vector, atol=1e-7)
