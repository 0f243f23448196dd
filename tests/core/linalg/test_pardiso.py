"""Pardiso's factors: precision, matrices without one, and the room that they share."""

import gc

import numpy as np
import pytest
import scipy.sparse
import torch

from warp_resphys.core.linalg.linear_solver import Factor
from warp_resphys.core.linalg.pardiso import PardisoSolver, has_pardiso

pytestmark = pytest.mark.skipif(
    not has_pardiso(), reason="needs the package mkl, which x86 processors alone have"
)

NODES = 40
ROWS, COLS = np.tril_indices(NODES)
RIGHT = torch.as_tensor(np.random.default_rng(3).normal(size=(1, NODES, 2)))


def stored(dense):
    """The upper triangle in rows, as the solver stores it."""
    return torch.as_tensor(dense[np.triu_indices(NODES)])[None]


def matrix(seed):
    """A dense symmetric matrix, and as the solver stores it."""
    dense = np.random.default_rng(seed).normal(size=(NODES, NODES))
    dense = dense + dense.T + 20.0 * np.eye(NODES)
    return dense, stored(dense)


@pytest.fixture
def solver():
    solver = PardisoSolver(ROWS, COLS, NODES, 1, torch.device("cpu"), torch.float64)
    dense, values = matrix(0)
    assert (values[0, solver.address[:, 0]].numpy() == dense[ROWS, COLS]).all()
    return solver


def solutions(factor: Factor):
    return factor.solve(RIGHT)[0].numpy()


def test_a_direction_is_accurate_to_single_precision_and_solutions_and_low_rank_terms_to_double(
    solver,
):
    dense, values = matrix(0)
    exact = np.linalg.solve(dense, RIGHT[0].numpy())
    np.testing.assert_allclose(solutions(solver.factor(values)), exact, rtol=1e-9, atol=1e-12)
    for kind in (torch.float64, torch.float32):
        direction = RIGHT[:, :, 0].to(kind, copy=True)
        solver.direction_factor(values).solve_in_place(direction)
        assert (
            1e-10
            < np.abs(direction[0].double().numpy() - exact[:, 0]).max()
            < 1e-5 * np.abs(exact).max()
        )
    dense, values = matrix(0)
    columns = 1e3 * torch.as_tensor(np.random.default_rng(6).normal(size=(1, NODES, 2)))
    whole = dense + (columns @ columns.mT)[0].numpy()
    direction = RIGHT[:, :, 0].clone()
    solver.direction_factor(values, columns).solve_in_place(direction)
    exact = np.linalg.solve(whole, RIGHT[0, :, 0].numpy())
    np.testing.assert_allclose(direction[0].numpy(), exact, atol=1e-7 * np.abs(exact).max())


def test_a_matrix_that_is_indefinite_in_single_precision_has_a_direction_and_a_singular_one_none(
    solver,
):
    turn = np.linalg.qr(matrix(2)[0])[0]
    dense = turn @ np.diag(np.logspace(-10, 0, NODES)) @ turn.T
    values = stored(dense)
    assert solver.factor(values.float().double()).failed.all()
    factor = solver.direction_factor(values)
    assert not factor.failed.any()
    right = np.random.default_rng(4).normal(size=(1, NODES)) @ dense
    direction = torch.as_tensor(right.copy())
    factor.solve_in_place(direction)
    np.testing.assert_allclose(direction.numpy() @ dense, right, atol=1e-9)
    singular = np.linalg.qr(matrix(4)[0])[0][:, :5]
    for broken in (singular @ singular.T, np.full((NODES, NODES), np.nan)):
        values = stored(broken)
        for factor in (solver.factor(values), solver.direction_factor(values)):
            assert factor.failed.all()
            assert np.isnan(solutions(factor)).all()


def test_memory_is_given_back_with_the_solver(monkeypatch):
    gc.collect()
    solver = PardisoSolver(ROWS, COLS, NODES, 1, torch.device("cpu"), torch.float32)
    factor = solver.factor(matrix(0)[1].float())
    phases, room = [], type(next(iter(solver._rooms.values())))
    call = room.call
    monkeypatch.setattr(
        room, "call", lambda self, phase, *rest: phases.append(phase) or call(self, phase, *rest)
    )
    del factor, solver
    gc.collect()
    assert phases == [-1]


@pytest.mark.slow
def test_torch_may_change_its_number_of_threads():
    n, width = 1200, 400
    rows, cols = (index[np.subtract(*np.tril_indices(n)) <= width] for index in np.tril_indices(n))
    solver = PardisoSolver(rows, cols, n, 1, torch.device("cpu"), torch.float64)
    random = np.random.default_rng(5)
    right = torch.ones(1, n, 1, dtype=torch.float64)
    before = torch.get_num_threads()
    try:
        for threads in (2, *[1] * 8):
            torch.set_num_threads(threads)
            entries = np.where(rows == cols, 4.0 * width, random.normal(size=len(rows)))
            values = torch.zeros(1, solver.n_values, dtype=torch.float64)
            values[0, solver.address[:, 0]] = torch.as_tensor(entries)
            x = solver.factor(values).solve(right)[0, :, 0].numpy()
            lower = scipy.sparse.csr_array((entries, (rows, cols)), shape=(n, n))
            product = lower @ x + lower.T @ x - 4.0 * width * x
            np.testing.assert_allclose(product, 1.0, atol=1e-12)
    finally:
        torch.set_num_threads(before)
