"""Uncertainty of a linear fit, against ordinary least squares and against the variance of correlated errors."""

import numpy as np
import pytest

from warp_resphys.learning.identification.uncertainty import LinearMisfit, LinearTrial, redundancy, uncertainty_of
from warp_resphys.settings.learning import Bounds

BOUNDS = {"stiffness": Bounds(lower=1.0, upper=3.0), "damping": Bounds(lower=0.1, upper=10.0, logarithmic=True)}
UNIT = np.array([0.5, 0.25])


def series(correlation, shape, seed=0):
    """Errors of unit variance, correlated along the first axis."""
    errors = np.random.default_rng(seed).normal(size=shape)
    for k in range(1, len(errors)):
        errors[k] = correlation * errors[k - 1] + np.sqrt(1.0 - correlation**2) * errors[k]
    return errors


def linear(rows, slopes):
    """One trial without priors."""
    return LinearMisfit([LinearTrial(rows, slopes, rows.size)], np.zeros(0), np.zeros((0, slopes.shape[1])), 1.0)


def test_independent_errors_have_the_covariance_of_least_squares():
    frames, coordinates = 400, 6
    rows = 0.1 * series(0.0, (frames, coordinates))
    jacobian = np.random.default_rng(1).normal(size=(frames * coordinates, 2)) @ [[1.0, 0.6], [0.0, 0.5]]
    result = uncertainty_of(linear(rows, jacobian), BOUNDS, UNIT)
    covariance = 0.1**2 * np.linalg.inv(jacobian.T @ jacobian)
    deviation = np.sqrt(np.diag(covariance))
    slopes = [2.0, 0.1 * 100**0.25 * np.log(100.0)]
    np.testing.assert_allclose(list(result.deviation.values()), deviation * slopes, rtol=0.1)
    assert result.correlation[0][1] == pytest.approx(covariance[0, 1] / deviation.prod(), abs=0.05)
    values, vectors = np.linalg.eigh(covariance)
    assert abs(np.dot(list(result.poorest.values()), vectors[:, 1])) == pytest.approx(1.0, abs=1e-6)
    assert result.poorest_deviation == pytest.approx(np.sqrt(values[1]), rel=0.1)


@pytest.mark.parametrize("correlation", [0.5, 0.8])
def test_correlated_frames_are_worth_fewer(correlation):
    """The mean of an autoregressive series varies (1 + r) / (1 - r) times as much as that of independent values."""
    rows = series(correlation, (4000, 5))
    expected = (1.0 + correlation) / (1.0 - correlation)
    assert redundancy(rows) == pytest.approx(expected, rel=0.15)
    same = linear(rows, np.ones((rows.size, 1)))
    deviation = uncertainty_of(same, {"a": BOUNDS["stiffness"]}, UNIT[:1]).deviation["a"]
    assert deviation == pytest.approx(2.0 * np.sqrt(expected / rows.size), rel=0.1)


def test_what_the_data_do_not_change_is_uncertain_by_its_range():
    """A uniform variable in [0, 1] has the standard deviation 1 / sqrt(12)."""
    rows = series(0.0, (100, 3))
    jacobian = np.stack([np.ones(rows.size), np.zeros(rows.size)], axis=1)
    result = uncertainty_of(linear(rows, jacobian), BOUNDS, UNIT)
    assert result.poorest == {"stiffness": 0.0, "damping": 1.0}
    assert result.poorest_deviation == pytest.approx(12.0**-0.5)
    assert result.deviation["damping"] == pytest.approx(12.0**-0.5 * 0.1 * 100**0.25 * np.log(100.0))
