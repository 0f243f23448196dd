"""Pardiso's factors of one matrix as preconditioners of the next ones."""

import gc

import numpy as np
import pytest
import scipy.sparse
import torch

from warp_resphys.linalg.linear_solver import Factor
from warp_resphys.linalg.pardiso import PardisoSolver, has_pardiso

pytestmark = pytest.mark.skipif(not has_pardiso(), reason="needs the package mkl, which x86 processors alone have")

NODES = 40
ROWS, COLS = np.tril_indices(NODES)
RIGHT = torch.as_tensor(np.random.default_rng(3).normal(size=(1, NODES, 2)))


def matrix(seed, shift=20.0):
    """A dense symmetric matrix with its upper triangle in rows, as the solver stores it."""
    dense = np.random.default_rng(seed).normal(size=(NODES, NODES))
    dense = dense + dense.T + shift * np.eye(NODES)
    return dense, torch.as_tensor(dense[np.triu_indices(NODES)])[None]


@pytest.fixture
def solver():
    solver = PardisoSolver(ROWS, COLS, NODES, 1, torch.device("cpu"), torch.float64)
    _, values = matrix(0)
    assert (values[0, solver.address[:, 0]].numpy() == matrix(0)[0][ROWS, COLS]).all()
    return solver


def counted(solver, monkeypatch):
    """The phases that Pardiso runs from here on."""
    phases, memory = [], type(next(iter(next(iter(solver._rooms.values()))._memories.values())))
    call = memory.call
    monkeypatch.setattr(memory, "call", lambda self, phase, *rest: phases.append(phase) or call(self, phase, *rest))
    return phases


def solutions(factor: Factor):
    return factor.solve(RIGHT)[0].numpy()


def test_a_later_matrix_is_solved_exactly_without_a_factor(solver, monkeypatch):
    first, values = matrix(0)
    kept = solver.factor(values)
    np.testing.assert_allclose(solutions(kept), np.linalg.solve(first, RIGHT[0]), rtol=1e-9, atol=1e-12)
    phases = counted(solver, monkeypatch)
    later = first + 0.05 * matrix(1)[0]
    near = solver.near(torch.as_tensor(later[np.triu_indices(NODES)])[None])
    np.testing.assert_allclose(solutions(near), np.linalg.solve(later, RIGHT[0]), rtol=1e-9, atol=1e-11)
    assert 22 not in phases


@pytest.mark.parametrize("shift", [20.0, 0.0], ids=["definite", "indefinite"])
def test_a_matrix_far_from_the_last_one_gets_its_factor(solver, shift, monkeypatch):
    solver.factor(torch.as_tensor(np.diag(np.logspace(-6, 6, NODES))[np.triu_indices(NODES)])[None])
    phases = counted(solver, monkeypatch)
    dense, values = matrix(2, shift)
    np.testing.assert_allclose(solutions(solver.near(values)), np.linalg.solve(dense, RIGHT[0]), rtol=1e-8, atol=1e-10)
    assert 22 in phases


def test_a_first_matrix_needs_a_factor_and_a_singular_one_has_no_solution(solver):
    dense, values = matrix(4)
    np.testing.assert_allclose(solutions(solver.near(values)), np.linalg.solve(dense, RIGHT[0]), rtol=1e-9, atol=1e-12)
    singular = np.linalg.qr(dense)[0][:, :5]
    for broken in (singular @ singular.T, np.full_like(dense, np.nan)):
        values = torch.as_tensor(broken[np.triu_indices(NODES)])[None]
        assert solver.factor(values, definite=False).failed.all()
        assert np.isnan(solutions(solver.near(values))).all()


def test_memory_is_given_back_with_the_solver(monkeypatch):
    gc.collect()
    solver = PardisoSolver(ROWS, COLS, NODES, 1, torch.device("cpu"), torch.float32)
    factor = solver.factor(matrix(0)[1].float())
    phases = counted(solver, monkeypatch)
    del factor, solver
    gc.collect()
    assert phases == [-1]


def test_torch_may_change_its_number_of_threads():
    n, width = 1200, 400
    rows, cols = (index[np.subtract(*np.tril_indices(n)) <= width] for index in np.tril_indices(n))
    solver = PardisoSolver(rows, cols, n, 1, torch.device("cpu"), torch.float64)
    random, right, before = np.random.default_rng(5), torch.ones(1, n, 1, dtype=torch.float64), torch.get_num_threads()
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
