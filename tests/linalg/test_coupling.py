"""Solutions with dense couplings between a few unknowns, beside those of the whole matrix."""

import numpy as np
import pytest
import torch

from warp_resphys.linalg.coupling import Coupling, CouplingSolver
from warp_resphys.linalg.linear_solver import Factor


class DenseFactor(Factor):
    """Factor of given matrices, which counts its right-hand sides."""

    def __init__(self, matrices):
        self.failed, self.matrices, self.count = np.zeros(len(matrices), dtype=bool), matrices, 0

    def solve(self, rhs):
        self.count += rhs.shape[2]
        return torch.linalg.solve(self.matrices, rhs)


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
