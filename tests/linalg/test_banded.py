"""LAPACK's banded routines, as they are called here."""

import numpy as np
import pytest
import scipy.linalg
import torch

from warp_resphys.linalg.banded import BandedCholesky, general_band

SIZE, WIDTH = 11, 3


def banded(shift):
    """A symmetric matrix (n, n), and its lower band (n, w + 1)."""
    random = np.random.default_rng(0).normal(size=(SIZE, SIZE))
    distance = np.abs(np.subtract.outer(np.arange(SIZE), np.arange(SIZE)))
    matrix = np.where(distance <= WIDTH, random + random.T, 0.0) + shift * np.eye(SIZE)
    band = np.zeros((SIZE, WIDTH + 1))
    for below in range(WIDTH + 1):
        band[: SIZE - below, below] = np.diagonal(matrix, -below)
    return matrix, band


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
def test_a_factor_solves_one_and_several_right_hand_sides_in_place(dtype, tolerance):
    matrix, band = banded(20.0)
    solver, factor = BandedCholesky(SIZE, WIDTH, dtype), torch.as_tensor(band).to(dtype)
    assert solver.factor(factor)
    for shape in ((SIZE,), (2, SIZE)):
        right = np.random.default_rng(1).normal(size=shape)
        columns = torch.tensor(right, dtype=dtype)
        solver.solve(factor, columns)
        np.testing.assert_allclose(columns.numpy(), np.linalg.solve(matrix, right.T).T, rtol=0.0, atol=tolerance)


def test_a_matrix_that_is_not_positive_definite_has_no_factor():
    _, band = banded(0.0)
    assert not BandedCholesky(SIZE, WIDTH, torch.float64).factor(torch.as_tensor(band))


def test_general_storage_solves_an_indefinite_matrix():
    matrix, band = banded(0.0)
    right = np.arange(SIZE, dtype=float)
    solution = scipy.linalg.solve_banded((WIDTH, WIDTH), general_band(band)[WIDTH:], right)
    np.testing.assert_allclose(solution, np.linalg.solve(matrix, right), rtol=1e-9)
