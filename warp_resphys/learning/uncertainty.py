"""Uncertainty of identified parameters, from the residuals and their derivatives at the minimum (Gauss-Newton).

The covariance is (J^T J)^-1 (sum_r S_r) (J^T J)^-1, with S_r the covariance of a trial's gradient J_r^T e. Its errors e
are as large as its residuals and as correlated in time, up to the first zero of their autocorrelation (Newey and West
1987, with one autocorrelation for all coordinates). The priors count as one more trial, with independent errors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

from .bounds import Bounds

FloatArray = NDArray[np.float64]

# Of a trial: weighted residuals (T, 3 M), their derivatives (3 T M, P), and the number of independent coordinates seen.
Linearised = tuple[FloatArray, FloatArray, float]


@dataclass(frozen=True)
class LeftOut:
    """Identification without one of its trials, to first order."""

    change: dict[str, float]  # of the parameters, in their units
    placement: list[float] | None  # (3 M + 6,) change of the trial's marker offsets [m], shift [m] and turn [rad]
    deviation: dict[str, float]  # see `Uncertainty`
    correlation: list[list[float]]


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of the parameters near the minimum (Gauss-Newton approximation)."""

    deviation: dict[str, float]  # standard deviation of each parameter, in its unit
    correlation: list[list[float]]  # (P, P) of the parameters, in their order
    # the least certain direction: weights of the parameters, in fractions of their ranges
    poorest: dict[str, float]
    poorest_deviation: float  # standard deviation along it, as a fraction of the ranges
    ranges: dict[str, float]  # derivative of each parameter by its fraction of its range, in its unit
    left_out: dict[str, LeftOut] = field(default_factory=dict)  # by trial; empty with less than two


def uncertainty_of(
    trials: Sequence[Linearised],
    prior: FloatArray,
    prior_weight: float,
    bounds: Mapping[str, Bounds],
    unit: FloatArray,
) -> Uncertainty:
    """Returns the uncertainty of P parameters at the minimum.

    Args:
        trials: linearised at the minimum.
        prior: (K, P) derivatives of the prior residuals.
        prior_weight: mean square of the prior residuals.
        bounds: range of each parameter.
        unit: (P,) the minimum, in fractions of the ranges.
    """
    free = 1.0 - min(len(unit) / sum(seen for _, _, seen in trials), 0.5)
    scatter = [np.square(rows).sum() / (seen * free) * _scatter(rows, jacobian) for rows, jacobian, seen in trials]
    scatter.append(prior_weight * prior.T @ prior)
    curvature = np.sum([jacobian.T @ jacobian for _, jacobian, _ in trials], axis=0) + prior.T @ prior
    values, vectors = np.linalg.eigh(curvature)
    inverse = (vectors / np.maximum(values, 1e-12 * max(values[-1], 1e-300))) @ vectors.T
    covariance = inverse @ np.sum(scatter, axis=0) @ inverse
    deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    slopes = [range_.slope(u) for range_, u in zip(bounds.values(), unit, strict=True)]
    poorest = vectors[:, 0] * np.sign(vectors[np.abs(vectors[:, 0]).argmax(), 0])
    return Uncertainty(
        deviation=dict(zip(bounds, (deviation * slopes).tolist(), strict=True)),
        correlation=(covariance / np.outer(deviation, deviation)).tolist(),
        poorest=dict(zip(bounds, poorest.tolist(), strict=True)),
        poorest_deviation=float(np.sqrt(max(vectors[:, 0] @ covariance @ vectors[:, 0], 0.0))),
        ranges=dict(zip(bounds, map(float, slopes), strict=True)),
    )


def _autocorrelation(series: FloatArray) -> list[float]:
    """Autocorrelation of (T, C) values at lags of 1, 2, ... frames, up to its first zero."""
    products = [float((series[lag:] * series[: len(series) - lag]).sum()) for lag in range(len(series) // 2)]
    if not products or products[0] <= 0.0:
        return []
    return [value / products[0] for value in takewhile(lambda value: value > 0.0, products[1:])]


def redundancy(series: FloatArray) -> float:
    """Number of correlated frames of a series (T, C) with as much information as one independent frame."""
    return 1.0 + 2.0 * sum(_autocorrelation(series))


def _scatter(rows: FloatArray, jacobian: FloatArray) -> FloatArray:
    """(P, P) covariance of J^T e, for errors e of unit variance that are as correlated in time as the residuals.

    Args:
        rows: (T, C) the residuals.
        jacobian: (T C, P) J.
    """
    slopes = jacobian.reshape(*rows.shape, -1)
    covariance = np.einsum("tcp,tcq->pq", slopes, slopes)
    for lag, correlation in enumerate(_autocorrelation(rows), 1):
        lagged = correlation * np.einsum("tcp,tcq->pq", slopes[lag:], slopes[:-lag])
        covariance += lagged + lagged.T
    values, vectors = np.linalg.eigh(covariance)  # A truncated autocorrelation may leave negative eigenvalues.
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
