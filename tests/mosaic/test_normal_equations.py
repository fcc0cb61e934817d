"""Normal equations gathered block by block solve what the whole matrix solves."""

import numpy as np
import pytest

from sorvolo.mosaic.normal_equations import NormalEquations


def strips(across: int, along: int) -> tuple[np.ndarray, np.ndarray]:
    """The ties of a survey: each camera to the next of its strip, and to its neighbours of the next strip."""
    number = np.arange(across * along).reshape(across, along)
    pairs = [
        (number[:, :-1], number[:, 1:]),
        (number[:-1], number[1:]),
        (number[:-1, :-1], number[1:, 1:]),
    ]
    one, other = (np.concatenate([each[k].ravel() for each in pairs]) for k in (0, 1))
    return one, other


def gathered(
    count: int, one: np.ndarray, other: np.ndarray, seed: int = 1
) -> tuple[NormalEquations, np.ndarray]:
    """Equations with these ties and two shared unknowns, in two batches, and their matrix."""
    rng = np.random.default_rng(seed)
    equations = NormalEquations(count, 2)
    rows = [np.sqrt(0.1) * np.eye(6 * count + 2)]
    equations.add_cameras(
        np.tile(0.1 * np.eye(6), (count, 1, 1)), np.zeros((count, 6, 2)), np.zeros((count, 6))
    )
    equations.add_shared(0.1 * np.eye(2), np.zeros(2))
    for some in np.array_split(np.arange(len(one)), 2):
        jacobian = rng.normal(size=(len(some), 6, 14))
        equations.add(jacobian, np.ones((len(some), 6)), (one[some], other[some]))
        for tie, block in zip(some, jacobian, strict=True):
            row = np.zeros((6, 6 * count + 2))
            row[:, 6 * one[tie] : 6 * one[tie] + 6] = block[:, :6]
            row[:, 6 * other[tie] : 6 * other[tie] + 6] = block[:, 6:12]
            row[:, -2:] = block[:, 12:]
            rows.append(row)
    whole = np.concatenate(rows)
    return equations, whole.T @ whole


@pytest.mark.parametrize("across, along", [(1, 1), (1, 7), (4, 5), (6, 20)])
def test_a_survey_is_solved_as_by_the_whole_matrix(across: int, along: int) -> None:
    equations, matrix = gathered(across * along, *strips(across, along))
    factors = equations.factorised()
    right = np.random.default_rng(2).normal(size=(len(matrix), 3))
    expected = np.linalg.solve(matrix, right)
    assert np.allclose(factors.solve(right), expected, rtol=1e-6, atol=1e-6)
    assert np.allclose(factors.solve(right[:, 0]), expected[:, 0], rtol=1e-6, atol=1e-6)
    assert np.allclose(equations.matrix() @ right, matrix @ right, rtol=1e-9, atol=1e-9)


def test_ties_in_any_order_some_twice_and_flights_apart() -> None:
    rng = np.random.default_rng(3)
    one, other = strips(5, 9)
    one, other = (
        np.concatenate([one, one[:9] + 45, one[:4]]),
        np.concatenate([other, other[:9] + 45, other[:4]]),
    )
    order = rng.permutation(len(one))
    swapped = rng.random(len(one)) < 0.5
    one, other = np.where(swapped, other, one)[order], np.where(swapped, one, other)[order]
    equations, matrix = gathered(90, one, other)
    right = rng.normal(size=len(matrix))
    found = equations.factorised().solve(right)
    assert np.allclose(found, np.linalg.solve(matrix, right), rtol=1e-6, atol=1e-6)


def test_a_camera_that_nothing_holds_moves_no_other() -> None:
    one, other = strips(3, 10)
    alone = (one != 12) & (other != 12)
    equations, matrix = gathered(30, one[alone], other[alone])
    nothing = np.zeros((30, 6, 6))
    nothing[12] = -0.1 * np.eye(6)
    equations.add_cameras(nothing, np.zeros((30, 6, 2)), np.zeros((30, 6)))
    right = np.random.default_rng(5).normal(size=182)
    held = np.delete(np.arange(182), 72 + np.arange(6))
    right[72:78] = 0.0
    found = equations.factorised().solve(right)
    expected = np.linalg.solve(matrix[np.ix_(held, held)], right[held])
    assert np.allclose(found[held], expected, rtol=1e-6, atol=1e-6)
    assert np.array_equal(found[72:78], np.zeros(6))


def test_a_long_flight_takes_a_fraction_of_the_whole_matrix() -> None:
    one, other = strips(40, 50)
    equations = NormalEquations(2000, 8)
    jacobian = np.random.default_rng(4).normal(size=(len(one), 6, 20))
    equations.add(jacobian, np.ones((len(one), 6)), (one, other))
    factors = equations.factorised(damping=1e-3)
    assert factors.nnz < 0.05 * (2000 * 6) ** 2
