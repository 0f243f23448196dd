"""System identification: the physical parameters with which a simulator comes closest to observed motions.

A misfit, such as `misfit.Misfit`, is minimised within bounds, from the best of a coarse set of starts
(`linalg.least_squares.UnitBox`), with derivatives along the motions (`Replay.varied`). It is a sum of squares, and its
parameters are fractions of their ranges, "units" from 0 to 1. Prior knowledge (`parameters.Prior`, and whatever a
misfit fits for each set of parameters) adds its squares, weighted as much as one independent residual of the data: by
their mean square, times the number of residuals that are correlated. That weight is computed at the start of a search
and again at the minimum.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from ..io.arrays import FloatArray
from ..io.errors import ConvergenceError
from ..linalg.least_squares import Point, UnitBox, minimise
from .parameters import Bounds
from .uncertainty import LinearMisfit, Uncertainty, redundancy, uncertainty_of

Report = Callable[[int, float, Mapping[str, float]], None]
Attempt = dict[str, Any]

_LEAST_WEIGHT = 1e-18  # of the priors, where the residuals are rounding
_SIMILAR = 0.7  # ratio of old and new weights of the priors above which a second descent is not worth its time


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


@dataclass
class Identification:
    """Result of an identification."""

    parameters: dict[str, float]  # the values of the smallest loss
    loss: float  # that loss, relative to the motions' amplitudes
    # for every start the records ``loss`` and the parameters, one a step that did not fail; the loss of the last step
    # may be that of the linearisation
    history: list[list[dict[str, float]]] = field(default_factory=list)
    at_bounds: tuple[str, ...] = ()  # parameters that ended on a bound
    placement: dict[str, Any] | None = None  # of the markers, as `nuisance.Nuisances.plain` has it
    uncertainty: Uncertainty | None = None  # None if the simulation fails beside the minimum


class ParameterSearch:
    """A search for the parameters with the smallest misfit.

    Args:
        misfit: of the parameters.
    """

    def __init__(self, misfit: BoundedMisfit) -> None:
        self._misfit = misfit

    @property
    def bounds(self) -> dict[str, Bounds]:
        """Range of each parameter."""
        return self._misfit.bounds

    def starts(self, first: Mapping[str, float], count: int, candidates: int, seed: int) -> list[dict[str, float]]:
        """The first guess, and the best of random candidates in the ranges.

        Args:
            first: a value of each parameter.
            count: number of starts, the first guess included.
            candidates: number of random sets of parameters (Latin hypercube).
            seed: of the random sets.
        """
        units = [self._misfit.to_unit(first)]
        if count > 1:
            from scipy.stats import qmc

            sampler = qmc.LatinHypercube(len(self.bounds), rng=np.random.default_rng(seed))
            points = sampler.random(max(candidates, count - 1))
            losses = self._misfit.losses_or_infinite(points)
            units += [points[i] for i in np.argsort(losses)[: count - 1] if np.isfinite(losses[i])]
        return [self._misfit.from_unit(unit) for unit in units]

    def run(
        self,
        starts: Sequence[Mapping[str, float]],
        max_evaluations: int,
        report: Report | None = None,
        tolerance: float = 1e-6,
        is_last: Callable[[float], bool] = lambda loss: True,
    ) -> Identification:
        """Minimises the loss from every start and keeps the best.

        Args:
            starts: a value of each parameter, for each start.
            max_evaluations: of the loss and its gradient, for each start.
            tolerance: relative decrease of the loss below which the search ends; a step from which the linearisation
                expects less is not evaluated.
            report: called after every evaluation with the start's number, the loss (infinite where the simulation
                failed) and the parameters.
            is_last: whether no other search follows one with a loss; if not, placement and uncertainty are left out.

        Raises:
            ConvergenceError: the simulation fails at every start.
        """
        attempts = [self._descend(k, start, max_evaluations, tolerance, report) for k, start in enumerate(starts)]
        good = [attempt for attempt in attempts if attempt["loss"] is not None]
        if not good:
            reason = self._misfit.failure or "motions that are not finite"
            raise ConvergenceError(f"the simulation failed at every start of the identification: {reason}", None, None)
        best, misfit = min(good, key=lambda attempt: attempt["loss"]), self._misfit
        unit, misfit.prior_weight = np.array(best["unit"]), best["prior_weight"]
        last = is_last(best["loss"])
        identified = Identification(
            parameters=best["parameters"],
            loss=best["loss"],
            history=[attempt["history"] for attempt in attempts],
            at_bounds=tuple(n for n, u in zip(self.bounds, unit, strict=True) if min(u, 1.0 - u) < 1e-4),
            placement=misfit.placement(unit) if last else None,
            uncertainty=misfit.uncertainty(unit) if last else None,
        )
        misfit.forget()
        return identified

    def _descend(
        self, number: int, start: Mapping[str, float], max_evaluations: int, tolerance: float, report: Report | None
    ) -> Attempt:
        """Result of one start: the parameters, their loss (None if the simulation fails there) and the history."""
        misfit, history = self._misfit, list[dict[str, float]]()

        def evaluated(unit: FloatArray, loss: float) -> None:
            values = misfit.from_unit(unit)
            if math.isfinite(loss):
                history.append({"loss": loss, **values})
            if report is not None:
                report(number, loss, values)

        first = misfit.to_unit(start)
        misfit.prior_weight = 0.0
        misfit.forget()
        misfit.update_prior_weight(first)
        point = self._minimum(torch.as_tensor(first)[None], max_evaluations, tolerance, evaluated)
        left = max_evaluations - len(history)
        refines = left > 1 and math.isfinite(float(point.value))
        if refines and not _SIMILAR < misfit.update_prior_weight(point.x[0].numpy()) < 1.0 / _SIMILAR:
            refined = self._minimum(point.x, left, tolerance, evaluated)
            point = refined if math.isfinite(float(refined.value)) else point
        return {
            "parameters": misfit.from_unit(point.x[0].tolist()),
            "loss": float(point.value) if math.isfinite(float(point.value)) else None,
            "unit": point.x[0].tolist(),
            "history": history,
            "prior_weight": misfit.prior_weight,
        }

    def _minimum(
        self, x: torch.Tensor, max_evaluations: int, tolerance: float, evaluated: Callable[[FloatArray, float], None]
    ) -> Point:
        """Returns the minimum reached from parameters (1, P); its loss is infinite if there are no derivatives."""
        problem = UnitBox(self._misfit.objective, tolerance, evaluated)
        start = problem.evaluate(x)
        if not math.isfinite(float(start.value)):
            return start
        end = minimise(problem, start, tolerance, max_evaluations - 1).point
        return replace(end, value=torch.full_like(end.value, torch.inf)) if problem.differentiates is False else end
