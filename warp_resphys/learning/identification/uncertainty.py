"""Uncertainty of identified parameters, from the residuals
and their derivatives at the minimum (Gauss-Newton).

The covariance is (J^T J)^-1 (sum_r S_r) (J^T J)^-1, with S_r the covariance of a trial's gradient
J_r^T e. Its errors e are as large as its residuals and as correlated in time, up to the first zero
of their autocorrelation (Newey and West 1987, with one autocorrelation for all coordinates). The
priors count as one more trial, with independent errors.

Residuals of trials from which parameters were identified are smaller than errors of predictions. To
first order, they are identified without one of the trials, too. Without trial r, the parameters
minimise

    sum_{s != r} |e_s + J_s d + C_s p|^2 + priors

in their change d and that p of places and delays, with the residuals e, J and C their derivatives
(Cook and Weisberg, Residuals and Influence in Regression, 1982). So a trial that determines a
parameter alone has its error with the parameter's prior.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ...io.arrays import Brief, FloatArray
from ...settings.learning import Bounds
from ..metrics import autocorrelation
from .nuisances import Nuisances

_UNIFORM = 12.0  # reciprocal variance of a parameter in its range, as a fraction of it


class LinearTrial(NamedTuple):
    """Weighted residuals of a trial at P parameters, and their derivatives."""

    rows: FloatArray  # (T, C) residuals
    slopes: FloatArray  # (T C, P) by the parameters
    seen: float  # number of the independent coordinates that were seen
    name: str = ""
    session: str = ""
    columns: FloatArray = np.zeros((1, 0))  # (T C, K) by marker places and delays


@dataclass(frozen=True)
class LinearMisfit:
    """Weighted residuals at P parameters and their derivatives, whose squares sum to the loss.

    Attributes:
        trials: their residuals.
        prior: (K,) weighted residuals of the priors.
        prior_slopes: (K, P) by the parameters.
        prior_weight: of these squares, and of those of the priors of marker places and delays.
        nuisances: marker places and delays that are not eliminated yet.
    """

    trials: Sequence[LinearTrial]
    prior: FloatArray
    prior_slopes: FloatArray
    prior_weight: float
    nuisances: Nuisances = field(default_factory=Nuisances)

    @property
    def loss(self) -> float:
        """Sum of the squares."""
        return float(
            sum(np.square(trial.rows).sum() for trial in self.trials) + np.square(self.prior).sum()
        )

    @property
    def gradient(self) -> FloatArray:
        """(P,) gradient of the loss."""
        parts = [trial.slopes.T @ trial.rows.ravel() for trial in self.trials]
        return np.asarray(2.0 * (np.sum(parts, axis=0) + self.prior_slopes.T @ self.prior))

    @property
    def gauss_newton(self) -> FloatArray:
        """(P, P) Gauss-Newton matrix of the loss."""
        parts = [trial.slopes.T @ trial.slopes for trial in self.trials]
        return np.asarray(2.0 * (np.sum(parts, axis=0) + self.prior_slopes.T @ self.prior_slopes))

    def _follow(self, values: Sequence[FloatArray], prior: FloatArray | float = 0.0) -> FloatArray:
        """Returns the change (K, ...) of places and delays
        with the least squares of values, priors included.

        Args:
            values: (T C, ...) by trial.
            prior: (K, ...) weighted residuals of the priors of places and delays.
        """
        normal = np.sum([trial.columns.T @ trial.columns for trial in self.trials], axis=0)
        right = np.sum(
            [trial.columns.T @ of for trial, of in zip(self.trials, values, strict=True)], axis=0
        )
        right = right + math.sqrt(self.prior_weight) * prior
        return np.asarray(-np.linalg.solve(normal + self.prior_weight * np.eye(len(normal)), right))

    def eliminated(self) -> "LinearMisfit":
        """Returns the misfit in which places and delays follow the parameters (Kaufman, BIT 15
        (1975) 49).
        """
        follow = self._follow([trial.slopes for trial in self.trials])
        further = math.sqrt(self.prior_weight) * follow
        return LinearMisfit(
            [trial._replace(slopes=trial.slopes + trial.columns @ follow) for trial in self.trials],
            np.concatenate([self.prior, self.nuisances.rows]),
            np.concatenate([self.prior_slopes, further]),
            self.prior_weight,
        )

    def places(self, step: FloatArray, session: str) -> list[float] | None:
        """(3 M + 6,) change of a session's placement with a step (P,) of the parameters.

        None if places are exact.
        """
        if self.nuisances.common is None:
            return None
        moved = self._follow(
            [trial.rows.ravel() + trial.slopes @ step for trial in self.trials], self.nuisances.rows
        )
        moves = self.nuisances.moves[session]
        return [float(value) for value in moves @ moved[: moves.shape[1]]]


@dataclass(frozen=True)
class LeftOut:
    """Identification without one of its trials, to first order."""

    change: dict[str, float]  # of the parameters, in their units
    placement: list[float] | None  # (3 M + 6,) of the trial's marker offsets, shift [m], turn [rad]
    deviation: dict[str, float]  # see `Uncertainty`
    correlation: list[list[float]]


@dataclass(frozen=True)
class Uncertainty(Brief):
    """Uncertainty of the parameters near the minimum (Gauss-Newton approximation)."""

    deviation: dict[str, float]  # standard deviation of each parameter, in its unit
    correlation: list[list[float]]  # (P, P) of the parameters, in their order
    # the least certain direction: weights of the parameters, in fractions of their ranges
    poorest: dict[str, float]
    poorest_deviation: float  # standard deviation along it, as a fraction of the ranges
    ranges: dict[str, float]  # derivative by the fraction of each range, in the value's unit
    left_out: dict[str, LeftOut] = field(default_factory=dict)  # by trial; empty with less than two


def uncertainty_of(
    linear: LinearMisfit, bounds: Mapping[str, Bounds], unit: FloatArray
) -> Uncertainty:
    """Returns the uncertainty of P parameters at the minimum.

    Args:
        linear: misfit at the minimum.
        bounds: range of each parameter.
        unit: (P,) the minimum, in fractions of the ranges.
    """
    trials, prior = linear.trials, linear.prior_slopes
    free = 1.0 - min(len(unit) / sum(trial.seen for trial in trials), 0.5)
    scatter = [
        np.square(trial.rows).sum() / (trial.seen * free) * _scatter(trial.rows, trial.slopes)
        for trial in trials
    ]
    scatter.append(linear.prior_weight * prior.T @ prior)
    curvature = (
        np.sum([trial.slopes.T @ trial.slopes for trial in trials], axis=0) + prior.T @ prior
    )
    values, vectors = np.linalg.eigh(curvature)
    # The data say nothing about the other directions.
    known = values > 1e-12 * max(values[-1], 1e-300)
    inverse = vectors[:, known] / values[known] @ vectors[:, known].T
    covariance = (
        inverse @ np.sum(scatter, axis=0) @ inverse
        + vectors[:, ~known] / _UNIFORM @ vectors[:, ~known].T
    )
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


def _scatter(rows: FloatArray, jacobian: FloatArray) -> FloatArray:
    """(P, P) covariance of J^T e, for errors e of unit variance
    that are as correlated in time as the residuals.

    Args:
        rows: (T, C) the residuals.
        jacobian: (T C, P) J.
    """
    slopes = jacobian.reshape(*rows.shape, -1)
    covariance = np.einsum("tcp,tcq->pq", slopes, slopes)
    for lag, correlation in enumerate(autocorrelation(rows), 1):
        lagged = correlation * np.einsum("tcp,tcq->pq", slopes[lag:], slopes[:-lag])
        covariance += lagged + lagged.T
    # A truncated autocorrelation may leave negative eigenvalues.
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def left_out(
    system: LinearMisfit, bounds: Mapping[str, Bounds], unit: FloatArray
) -> dict[str, LeftOut]:
    """Returns the identification without each of the trials; empty with less than two.

    Ranges count as normal distributions of the same variance, as what no other trial determines
    could be anything.

    Args:
        system: misfit at the minimum, of which places and delays are not eliminated.
        bounds: range of each of the P parameters.
        unit: (P,) the minimum, in fractions of the ranges.
    """
    slopes = np.array([range_.slope(u) for range_, u in zip(bounds.values(), unit, strict=True)])
    result: dict[str, LeftOut] = {}
    for number, out in enumerate(system.trials if len(system.trials) > 1 else ()):
        others = replace(system, trials=[*system.trials[:number], *system.trials[number + 1 :]])
        linear, seen = others.eliminated(), sum(trial.seen for trial in others.trials)
        variance = sum(float(np.square(trial.rows).sum()) for trial in others.trials) / seen
        curvature = 0.5 * linear.gauss_newton + _UNIFORM * variance * np.eye(len(unit))
        step = np.asarray(-0.5 * np.linalg.lstsq(curvature, linear.gradient)[0], dtype=np.float64)
        uncertainty = uncertainty_of(linear, bounds, unit)
        result[out.name] = LeftOut(
            change=dict(zip(bounds, (slopes * step).tolist(), strict=True)),
            placement=others.places(step, out.session),
            deviation=uncertainty.deviation,
            correlation=uncertainty.correlation,
        )
    return result
