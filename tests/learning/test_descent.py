"""Descents with few derivatives, on functions whose minima are known."""

import numpy as np
import torch

from warp_resphys.learning.bounded_misfit import LinearMisfit
from warp_resphys.learning.descent import Descent
from warp_resphys.linalg.least_squares import UnitBox, minimise


class Function:
    """Residuals of two unknowns as a misfit, with a record of what was evaluated."""

    def __init__(self, residuals, slopes):
        self.residuals, self.slopes = residuals, slopes
        self.evaluated, self.differentiated = [], []

    def __call__(self, x, derivatives):
        self.evaluated += [] if derivatives else [x.tolist()]
        self.differentiated += [x.tolist()] if derivatives else []
        slopes = self.slopes(x) if derivatives else np.zeros((len(self.residuals(x)), len(x)))
        return None if slopes is None else LinearMisfit([(self.residuals(x)[:, None], slopes, 1.0)], *_no_prior())

    def search(self, start, tolerance=1e-6, most=40):
        descent = Descent(self, tolerance, lambda x, value: None)
        return descent, minimise(descent, descent.evaluate(torch.tensor([start]).double()), tolerance, most).point


def _no_prior():
    return np.zeros(0), np.zeros((0, 2))


LINEAR = np.array([[1.0, 0.5], [0.2, 2.0], [1.0, 1.0]])
TARGET = np.array([0.45, 0.52])


def linear(x):
    return LINEAR @ (x - TARGET) + np.array([0.1, 0.1, -0.12])


def rosenbrock(x):
    return np.array([10.0 * (x[1] - x[0] ** 2), 0.7 - x[0]])


def rosenbrock_slopes(x):
    return np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])


def test_a_linear_function_needs_two_evaluations():
    function = Function(linear, lambda x: LINEAR)
    _, point = function.search([0.5, 0.5])
    best = np.linalg.lstsq(LINEAR, -linear(np.zeros(2)), rcond=None)[0]
    np.testing.assert_allclose(point.x[0], best, atol=1e-6)
    assert len(function.evaluated) == 2
    assert len(function.differentiated) == 2
    np.testing.assert_allclose(float(point.value), np.square(linear(best)).sum(), rtol=1e-6)


def test_a_curved_valley_ends_at_the_same_minimum_with_derivatives_at_fewer_points():
    function, all_of_them = Function(rosenbrock, rosenbrock_slopes), []

    def objective(x):
        all_of_them.append(x)
        residuals, slopes = rosenbrock(x), rosenbrock_slopes(x)
        return residuals @ residuals, 2.0 * slopes.T @ residuals, 2.0 * slopes.T @ slopes

    _, point = function.search([0.1, 0.9], 1e-9)
    whole = UnitBox(objective)
    wanted = minimise(whole, whole.evaluate(torch.tensor([[0.1, 0.9]]).double()), 1e-9, 40).point
    np.testing.assert_allclose(point.x, [[0.7, 0.49]], atol=1e-4)
    np.testing.assert_allclose(point.x, wanted.x, atol=1e-4)
    assert len(function.evaluated) <= len(all_of_them)
    assert all(x in function.evaluated for x in function.differentiated)


def test_a_search_ends_where_there_are_no_derivatives():
    function = Function(rosenbrock, lambda x: None if x[0] > 0.5 else rosenbrock_slopes(x))
    descent, point = function.search([0.1, 0.9])
    assert descent.stuck_at is not None
    assert torch.equal(descent.stuck_at, point.x)
    assert float(point.x[0, 0]) > 0.5
    assert np.isfinite(float(point.value))
    descent, _ = Function(rosenbrock, rosenbrock_slopes).search([0.1, 0.9])
    assert descent.stuck_at is None
