"""Solutions with dense couplings between a few unknowns, beside those of the whole matrix."""

import numpy as np
import pytest
import scipy.sparse
import torch

from warp_resphys.linalg.choice import make_linear_solver
from warp_resphys.linalg.coupling import Coupling, CouplingSolver
from warp_resphys.linalg.linear_solver import Factor


class DenseFactor(Factor):
    """Factor of given matrices, which counts its right-hand sides."""

    def __init__(self, matrices):
        self.failed, self.matrices, self.count = np.zeros(len(matrices), dtype=bool), matrices, 0

    def solve(self, rhs):
        self.count += rhs.shape[2]
        return torch.linalg.solve(self.matrices, rhs)


@pytest.mark.parametrize("name", ["banded", "tiled", "dense", "sparse"])
def test_columns_of_inverses(name):
    """Of a matrix of two blocks that are not coupled, in two environments, beside those of the dense inverse."""
    random = np.random.default_rng(1)
    rows = np.concatenate([np.arange(5), np.arange(1, 3), np.array([4])])
    cols = np.concatenate([np.arange(5), np.arange(2), np.array([3])])
    solver = make_linear_solver(name, rows, cols, 5, 3, torch.device("cpu"), torch.float64)
    pattern = np.kron(scipy.sparse.coo_array((np.ones(len(rows)), (rows, cols))).toarray(), np.ones((3, 3)))
    pattern = (pattern + pattern.T) > 0
    matrices = np.stack([np.where(pattern, symmetric(random, 15, True), 0.0) + 30.0 * np.eye(15) for _ in range(2)])
    values = torch.zeros(2, solver.n_values, dtype=torch.float64)
    for e, (i, j) in enumerate(zip(rows, cols, strict=True)):
        block = matrices[:, 3 * i : 3 * i + 3, 3 * j : 3 * j + 3].reshape(2, 9)
        stored = solver.address[e] >= 0
        values[:, solver.address[e][stored]] = torch.tensor(block[:, stored])
    environments, unknowns = torch.tensor([0, 0, 1, 1, 1]), torch.tensor([2, 14, 0, 9, 13])
    actual = solver.factor(values).inverse_columns(environments, unknowns, values.new_zeros(2, 0, 15))
    expected = np.linalg.inv(matrices)[environments, unknowns]
    np.testing.assert_allclose(actual.numpy(), expected, rtol=0.0, atol=1e-12)


def symmetric(random, size, definite):
    half = random.normal(size=(size, size))
    return half @ half.T + size * np.eye(size) if definite else half + half.T


def test_solutions_are_those_of_the_whole_matrix_and_columns_are_kept():
    """Two environments with other unknowns, one of them with room for more, and an order of unknowns of its own."""
    random, n = np.random.default_rng(0), 12
    matrices = torch.tensor(np.stack([symmetric(random, n, True) for _ in range(3)]))
    factor, solver = DenseFactor(matrices), CouplingSolver(3, n, matrices)
    right, order = torch.tensor(random.normal(size=(3, n, 1))), torch.tensor(random.permutation(n))

    def corrected(couplings):
        x = torch.linalg.solve(matrices, right)[:, order]
        solver.correct(factor, couplings, x, order)
        return x

    for given in ({0: [1, 4, 7], 2: [0, 2]}, {0: [4, 1, 11], 2: [2, 5]}):
        unknowns, values = torch.full((2, 3), -1), torch.zeros(2, 3, 3, dtype=torch.float64)
        whole, environments = matrices.clone(), torch.tensor(list(given))
        for k, (b, numbers) in enumerate(given.items()):
            own, m = torch.tensor(numbers), len(numbers)
            unknowns[k, :m], values[k, :m, :m] = own, torch.tensor(symmetric(random, m, False))
            whole[b, own[:, None], own] += values[k, :m, :m]
        couplings = [Coupling(environments, unknowns, values)]
        expected = torch.linalg.solve(whole, right)[:, order]
        assert corrected(couplings).numpy() == pytest.approx(expected.numpy(), rel=1e-10, abs=1e-12)
    assert factor.count == 3 + 1  # 1, 4, 7 beside 0, 2; then 11 beside 5
    solver.forget(torch.tensor([True, False, False]))
    corrected([Coupling(torch.tensor([0]), torch.tensor([[4]]), torch.ones(1, 1, 1, dtype=torch.float64))])
    assert factor.count == 5
