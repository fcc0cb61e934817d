"""Factors in pieces solve what the whole matrix solves."""

import numpy as np
import pytest

from sorvolo.mosaic.normal_equations import SIDE, Elimination


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


def staged(count: int, one: np.ndarray, other: np.ndarray, seed: int = 1):
    """Blocks of a positive definite matrix with these ties, and the matrix itself."""
    rng = np.random.default_rng(seed)
    matrix, between = np.zeros((count, SIDE, count, SIDE)), np.zeros((len(one), SIDE, SIDE))
    diagonal = np.tile(0.1 * np.eye(SIDE), (count, 1, 1))
    for tie, (a, b) in enumerate(zip(one, other, strict=True)):
        rows = rng.normal(size=(SIDE, 2 * SIDE))
        information = rows.T @ rows
        diagonal[a] += information[:SIDE, :SIDE]
        diagonal[b] += information[SIDE:, SIDE:]
        between[tie] = information[:SIDE, SIDE:]
        matrix[a, :, b] += between[tie]
        matrix[b, :, a] += between[tie].T
    for camera in range(count):
        matrix[camera, :, camera] = diagonal[camera]
    return diagonal, between, matrix.reshape(SIDE * count, SIDE * count)


@pytest.mark.parametrize("across, along", [(1, 1), (1, 7), (4, 5), (6, 20)])
def test_a_survey_is_solved_as_by_the_whole_matrix(across: int, along: int) -> None:
    one, other = strips(across, along)
    diagonal, between, matrix = staged(across * along, one, other)
    factors = Elimination(across * along, one, other).factorised(diagonal, between)
    right = np.random.default_rng(2).normal(size=(len(matrix), 3))
    expected = np.linalg.solve(matrix, right)
    assert np.allclose(factors.solve(right), expected, rtol=1e-9, atol=1e-9)
    assert np.allclose(factors.solve(right[:, 0]), expected[:, 0], rtol=1e-9, atol=1e-9)


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
    diagonal, between, matrix = staged(90, one, other)
    right = rng.normal(size=len(matrix))
    found = Elimination(90, one, other).factorised(diagonal, between).solve(right)
    assert np.allclose(found, np.linalg.solve(matrix, right), rtol=1e-8, atol=1e-8)


def test_a_camera_that_nothing_holds_moves_no_other() -> None:
    one, other = strips(3, 10)
    alone = np.flatnonzero((one != 12) & (other != 12))
    one, other = one[alone], other[alone]
    diagonal, between, matrix = staged(30, one, other)
    diagonal[12] = 0.0
    right = np.random.default_rng(5).normal(size=180)
    held = np.delete(np.arange(180), SIDE * 12 + np.arange(SIDE))
    right[SIDE * 12 : SIDE * 13] = 0.0
    found = Elimination(30, one, other).factorised(diagonal, between).solve(right)
    assert np.allclose(
        found[held], np.linalg.solve(matrix[np.ix_(held, held)], right[held]), rtol=1e-8, atol=1e-8
    )
    assert np.array_equal(found[SIDE * 12 : SIDE * 13], np.zeros(SIDE))


def test_a_long_flight_takes_a_fraction_of_the_whole_matrix() -> None:
    one, other = strips(40, 50)
    diagonal = np.tile(9.0 * np.eye(SIDE), (2000, 1, 1))
    between = np.random.default_rng(4).normal(size=(len(one), SIDE, SIDE)) * 0.1
    factors = Elimination(2000, one, other).factorised(diagonal, between)
    held = sum(corner.size + below.size for corner, below in factors._pieces)
    assert held < 0.05 * (2000 * SIDE) ** 2
