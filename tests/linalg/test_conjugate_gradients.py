"""Conjugate gradients of a batch, against dense solves."""

import numpy as np
import pytest
import torch

from warp_resphys.linalg.conjugate_gradients import conjugate_gradients


def problem(batch=3, n=7):
    random = np.random.default_rng(0)
    directions = np.linalg.qr(random.normal(size=(batch, 3 * n, 3 * n)))[0]
    eigenvalues = 10.0 ** random.uniform(-2, 3, size=(batch, 3 * n))
    matrices = np.einsum("bij,bj,bkj->bik", directions, eigenvalues, directions)
    right = random.normal(size=(batch, n, 3))
    right[1] = 0.0
    return torch.tensor(matrices), torch.tensor(right)


def product(matrices):
    return lambda d: (matrices @ d.flatten(1)[:, :, None]).view_as(d)


@pytest.mark.parametrize("preconditioned", [False, True])
def test_dense_solve(preconditioned):
    matrices, right = problem()
    diagonal = torch.diag_embed(matrices.diagonal(dim1=1, dim2=2)).inverse()
    preconditioner = product(diagonal) if preconditioned else torch.clone
    x = conjugate_gradients(product(matrices), preconditioner, right, tolerance=1e-12).x
    expected = torch.linalg.solve(matrices, right.flatten(1)).view_as(right)
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-9 * float(expected.abs().max()))
    assert not x[1].any()


def test_it_stops_at_the_tolerance():
    matrices, right = problem()
    calls = []

    def operator(d):
        calls.append(1)
        return product(matrices)(d)

    exact = product(torch.linalg.inv(matrices))
    conjugate_gradients(operator, exact, right, tolerance=1e-6)
    assert len(calls) == 1
    conjugate_gradients(operator, torch.clone, right, tolerance=0.0, max_iterations=4)
    assert len(calls) == 5
    largest = float(right.abs().max())
    assert conjugate_gradients(operator, torch.clone, right, tolerance=0.0, shortest=largest).converged.all()
    assert len(calls) == 5
    conjugate_gradients(operator, exact, right, tolerance=0.0, shortest=1e-6)
    assert len(calls) == 6


def test_a_system_with_an_indefinite_preconditioner_stops():
    matrices, right = problem()
    result = conjugate_gradients(product(matrices), torch.neg, right, tolerance=1e-6)
    assert result.iterations == 0
    assert result.converged.tolist() == [False, True, False]
