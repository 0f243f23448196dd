"""Misfits of parameters that are searched in ranges, with normal priors: a sum of squares and its linearisation.

Parameters are fractions of their ranges, "units" from 0 to 1. Prior knowledge (`parameters.Prior`, and whatever a
subclass fits for each set of parameters) adds its squares, weighted as much as one independent residual of the data: by
their mean square, times the number of residuals that are correlated. That weight is computed at the start of a search
and again at the minimum.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .parameters import Bounds
from .uncertainty import LinearMisfit, Uncertainty, redundancy, uncertainty_of

FloatArray = NDArray[np.float64]

_LEAST_WEIGHT = 1e-18  # of the priors, where the residuals are rounding


class BoundedMisfit(ABC):
    """A misfit as a function of parameters with bounds and priors.

    Args:
        bounds: range of each of the P parameters.

    Attributes:
        bounds: see above.
        prior_weight: mean square of one independent residual, which weights the priors; 0 before it is computed.
        failure: message of the last simulation that failed.
    """

    failure = ""

    def __init__(self, bounds: Mapping[str, Bounds]) -> None:
        self.bounds, self.prior_weight = dict(bounds), 0.0
        priors = [range_.unit_prior() for range_ in self.bounds.values()]
        self._priors = [(index, *prior) for index, prior in enumerate(priors) if prior is not None]

    @abstractmethod
    def linearise(self, unit: FloatArray, derivatives: bool = True) -> LinearMisfit | None:
        """Linearises the residuals at (P,) parameters; None where the simulation fails.

        Args:
            unit: the parameters, as fractions of their ranges.
            derivatives: whether to compute derivatives; they are zero otherwise.
        """

    def objective(self, unit: FloatArray, derivatives: bool) -> tuple[float, FloatArray, FloatArray]:
        """Returns the loss, its gradient (P,) and Gauss-Newton matrix (P, P), for `linalg.least_squares.UnitBox`."""
        count = len(unit)
        linear, slopes = self.linearise(unit, derivatives), (np.zeros(count), np.zeros((count, count)))
        if linear is None or not math.isfinite(linear.loss):
            return math.inf, *slopes
        slopes = (linear.gradient, linear.gauss_newton) if derivatives else slopes
        return linear.loss if np.isfinite(slopes[1]).all() else math.inf, *slopes

    @abstractmethod
    def forget(self) -> None:
        """Forgets the results of earlier parameters, from which the next are predicted."""

    def placement(self, unit: FloatArray) -> dict[str, Any] | None:
        """Returns the best placement of markers with (P,) parameters, as JSON data; None without uncertain places."""
        return None

    @property
    def has_priors(self) -> bool:
        """Whether something is held by prior knowledge."""
        return bool(self._priors)

    def to_unit(self, values: Mapping[str, float]) -> FloatArray:
        """(P,) values as fractions of their ranges, clipped to the bounds."""
        clipped = ((b, min(max(values[name], b.lower), b.upper)) for name, b in self.bounds.items())
        return np.array([b.to_unit(value) for b, value in clipped])

    def from_unit(self, unit: Sequence[float] | FloatArray) -> dict[str, float]:
        """Values of the parameters at (P,) fractions of their ranges."""
        return {
            name: float(range_.from_unit(torch.tensor(float(u), dtype=torch.float64)))
            for (name, range_), u in zip(self.bounds.items(), unit, strict=True)
        }

    def losses_or_infinite(self, points: FloatArray) -> FloatArray:
        """(E,) losses of (E, P) parameters, each as if it were the first; infinite where the simulation fails."""
        losses = np.full(len(points), np.inf)
        for number, point in enumerate(points):
            self.forget()
            linear = self.linearise(point, derivatives=False)
            losses[number] = np.inf if linear is None else linear.loss
        return losses

    def prior_rows(self, unit: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(K,) weighted residuals of the priors of parameters, and their derivatives (K, P)."""
        rows, slopes = np.zeros(len(self._priors)), np.zeros((len(self._priors), len(unit)))
        weight = math.sqrt(self.prior_weight)
        for row, (i, mean, deviation) in enumerate(self._priors):
            rows[row], slopes[row, i] = weight * (unit[i] - mean) / deviation, weight / deviation
        return rows, slopes

    def update_prior_weight(self, unit: FloatArray) -> float:
        """Sets the weight of the priors from the residuals at (P,) parameters; returns its ratio to the old weight."""
        before = self.prior_weight
        linearised = self.linearise(unit, derivatives=False) if self.has_priors else None
        if linearised is None:
            return 1.0
        trials = linearised.trials
        seen = sum(count for *_, count in trials)
        squares = [np.square(rows).sum() * redundancy(rows) for rows, _, _ in trials]
        self.prior_weight = max(float(sum(squares)) / max(seen, 1), _LEAST_WEIGHT)
        return self.prior_weight / before if before else math.inf

    def uncertainty(self, unit: FloatArray) -> Uncertainty | None:
        """Uncertainty of (P,) parameters; None if a simulation close by fails."""
        found = self.linearise(unit)
        if found is None:
            return None
        return uncertainty_of(found.trials, found.prior_slopes, self.prior_weight, self.bounds, unit)
