"""Nonlinear least squares, whose problems do not see each other,
and conjugate gradients of a batch.
"""

import numpy as np
import pytest
import torch

from warp_resphys.core.linalg.conjugate_gradients import conjugate_gradients
from warp_resphys.core.linalg.least_squares import Point, Problem, UnitBox, damped, minimise, ridge


def squares(r, j):
    """|r|^2, its gradient and the second derivatives of Gauss and Newton."""
    return float(r @ r), 2.0 * j.T @ r, 2.0 * j.T @ j


class Valley:
    """|r|^2 with a bent narrow floor: r = (100 (y - x^2), x - 0.7), failing left of a wall."""

    def __init__(self, wall=-1.0):
        self.wall, self.calls, self.differentiated = wall, 0, 0

    def __call__(self, x, derivatives):
        self.calls += not derivatives
        self.differentiated += derivatives
        assert (x >= 0.0).all()
        assert (x <= 1.0).all()
        if x[0] < self.wall:
            return np.inf, np.zeros(2), np.zeros((2, 2))
        r = np.array([100.0 * (x[1] - x[0] ** 2), x[0] - 0.7])
        return squares(
            r,
            np.array([[-200.0 * x[0], 100.0], [1.0, 0.0]])
            if derivatives
            else np.full((2, 2), np.nan),
        )


def descend(valley, start, max_iterations):
    problem = UnitBox(valley)
    point = minimise(
        problem, problem.evaluate(torch.tensor([start], dtype=torch.float64)), 1e-6, max_iterations
    ).point
    return point.x[0].numpy(), float(point.value)


@pytest.mark.parametrize("start", [[0.05, 0.9], [0.95, 0.9]])
def test_the_descent_follows_a_bent_valley(start):
    """Without a second step after a rejected one, two of these are not there
    after a hundred evaluations.
    """
    valley = Valley()
    x, value = descend(valley, start, 50)
    np.testing.assert_allclose(x, [0.7, 0.49], atol=1e-6)
    assert value < 1e-10
    assert valley.differentiated <= valley.calls < 30


def test_the_descent_does_not_walk_to_and_fro_and_turns_back_from_failures():
    """Full steps go from one side of the minimum to the other and back,
    each as long as the trust box allows.
    """

    def objective(x, derivatives):
        t = 40.0 * (x[0] - 0.5)
        return squares(
            np.array([np.arctan(t), 0.3 * (x[1] - 0.4)]), np.diag([40.0 / (1.0 + t * t), 0.3])
        )

    x, _ = descend(objective, [0.38, 0.9], 30)
    np.testing.assert_allclose(x, [0.5, 0.4], atol=1e-5)
    x, _ = descend(Valley(wall=0.6), [0.99, 0.2], 50)
    np.testing.assert_allclose(x, [0.7, 0.49], atol=1e-5)
    assert descend(Valley(wall=0.6), [0.1, 0.1], 5)[1] == np.inf


def test_a_linear_function_needs_two_evaluations():
    matrix, evaluated = np.array([[1.0, 0.5], [0.2, 2.0], [1.0, 1.0]]), []

    def objective(x, derivatives):
        evaluated.append(derivatives)
        return squares(matrix @ (x - [0.45, 0.52]) + [0.1, 0.1, -0.12], matrix)

    steps = []
    problem = UnitBox(objective, 1e-6, lambda x, value: steps.append((x.tolist(), value)))
    point = minimise(problem, problem.evaluate(torch.tensor([[0.5, 0.5]]).double()), 1e-6, 40).point
    best = np.array([0.45, 0.52]) + np.linalg.lstsq(matrix, [-0.1, -0.1, 0.12], rcond=None)[0]
    np.testing.assert_allclose(point.x[0], best, atol=1e-6)
    # The step after the second derivatives is not evaluated.
    assert evaluated == [False, True, False, True]
    assert float(point.value) == pytest.approx(objective(best, False)[0], rel=1e-6)
    assert len(steps) == 3
    assert steps[-1] == (point.x[0].tolist(), float(point.value))


@pytest.mark.parametrize(("limit", "differentiates"), [(0.5, True), (0.05, False)])
def test_a_search_ends_where_there_are_no_derivatives(limit, differentiates):
    valley = Valley()

    def objective(x, derivatives):
        return (
            (np.inf, np.zeros(2), np.zeros((2, 2)))
            if derivatives and x[0] > limit
            else valley(x, derivatives)
        )

    problem = UnitBox(objective)
    start = problem.evaluate(torch.tensor([[0.1, 0.9]]).double())
    assert problem.differentiates is None
    point = minimise(problem, start, 1e-6, 40).point
    assert problem.differentiates is differentiates
    assert np.isfinite(float(point.value))
    assert float(point.x[0, 0]) > limit
    assert torch.equal(point.x, start.x) is not differentiates


class Rosenbrock(Problem):
    """|r|^2 with r = (10 (y - x^2), 1 - x), failing left of a wall; unknowns (B, 2)."""

    def __init__(self, wall=-10.0):
        self.wall, self.evaluated = wall, []

    def evaluate(self, x):
        self.evaluated.append(x.clone())
        r = torch.stack([10.0 * (x[:, 1] - x[:, 0] ** 2), 1.0 - x[:, 0]], 1)
        return Point(x, torch.where(x[:, 0] < self.wall, torch.inf, r.square().sum(1)), (r,))

    def linearise(self, point):
        (x,), (r,) = (point.x,), point.kept
        zero = torch.zeros_like(x[:, 0])
        j = torch.stack(
            [torch.stack([-20.0 * x[:, 0], zero + 10.0], 1), torch.stack([zero - 1.0, zero], 1)], 1
        )
        gradient = (j.mT @ r[..., None])[..., 0]
        return lambda damping: x - torch.linalg.solve(damped(j.mT @ j, damping), gradient)

    def distance(self, old, new):
        return (new.x - old.x).abs().amax(1)


STARTS = torch.tensor([[-1.2, 1.0], [0.9, 0.8], [2.0, -3.0], [1.0, 1.0]], dtype=torch.float64)


@pytest.mark.parametrize("wall", [-10.0, -1.3])
def test_problems_of_a_batch_do_not_see_each_other(wall):
    problem = Rosenbrock(wall)
    together = minimise(problem, problem.evaluate(STARTS), 1e-10, 100)
    assert together.converged
    torch.testing.assert_close(together.point.x, torch.ones_like(STARTS), rtol=0.0, atol=1e-8)
    counts = []
    for start, x in zip(STARTS, together.point.x, strict=True):
        problem = Rosenbrock(wall)
        alone = minimise(problem, problem.evaluate(start[None]), 1e-10, 100)
        torch.testing.assert_close(alone.point.x[0], x, rtol=0.0, atol=1e-12)
        counts.append(alone.iterations)
        assert len(problem.evaluated) == alone.iterations + 1
    assert together.iterations == max(counts) < 60
    assert counts[3] == 1  # It is there already.


def test_a_start_that_fails_everywhere_stays():
    problem = Rosenbrock(wall=np.inf)
    solution = minimise(problem, problem.evaluate(STARTS), 1e-10, 5)
    assert not solution.converged
    assert torch.equal(solution.point.x, STARTS)


@pytest.mark.parametrize("shape", [(3, 7), (7, 3)])
def test_ridge(shape):
    random = np.random.default_rng(0)
    matrix, right = random.normal(size=shape), random.normal(size=shape[0])
    stacked = np.vstack([matrix, 0.3 * np.eye(shape[1])])
    expected = np.linalg.lstsq(stacked, np.concatenate([right, np.zeros(shape[1])]), rcond=None)[0]
    solution = ridge(torch.tensor(matrix)[None], torch.tensor(right)[None, :, None], 0.09)
    np.testing.assert_allclose(solution[0, :, 0], expected, rtol=1e-10)


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
    assert conjugate_gradients(
        operator, torch.clone, right, tolerance=0.0, shortest=largest
    ).converged.all()
    assert len(calls) == 5
    conjugate_gradients(operator, exact, right, tolerance=0.0, shortest=1e-6)
    assert len(calls) == 6


def test_a_system_with_an_indefinite_preconditioner_stops():
    matrices, right = problem()
    result = conjugate_gradients(product(matrices), torch.neg, right, tolerance=1e-6)
    assert result.iterations == 0
    assert result.converged.tolist() == [False, True, False]
