"""System identification: the physical parameters with which a simulator comes closest to observed motions.

The loss is the mean square distance of simulated and observed markers, each motion in units of its own amplitude, over
all motions at once. L-BFGS-B (Byrd, Lu, Nocedal, Zhu, SIAM J. Sci. Comput. 16, 1995) minimises it within bounds, from
the best of a coarse set of starts, with gradients through the simulator.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
import scipy.optimize
import scipy.stats
import torch
from numpy.typing import NDArray

from .errors import ConvergenceError, InputError
from .replay import PARAMETERS, Release, Replay

Report = Callable[[int, float, Mapping[str, float]], None]


@dataclass(frozen=True)
class Bounds:
    """The range of a parameter.

    Attributes:
        lower: in the parameter's unit.
        upper: the same.
        logarithmic: whether it is searched on a logarithmic scale.
    """

    lower: float
    upper: float
    logarithmic: bool = False

    def __post_init__(self) -> None:
        """Checks the range.

        Raises:
            InputError: an empty or infinite range, or a logarithmic one that is not positive.
        """
        if not (math.isfinite(self.lower) and math.isfinite(self.upper) and self.lower < self.upper):
            raise InputError(f"the bounds {self.lower:g} and {self.upper:g} leave no range: the first must be smaller.")
        if self.logarithmic and not self.lower > 0.0:
            raise InputError(f"a logarithmic range from {self.lower:g}: its lower bound must be positive.")

    def to_unit(self, value: float) -> float:
        """A value as a fraction of the range, 0 to 1."""
        low, high, x = (math.log(v) if self.logarithmic else v for v in (self.lower, self.upper, value))
        return (x - low) / (high - low)

    def from_unit(self, unit: torch.Tensor) -> torch.Tensor:
        """Values of fractions, differentiable."""
        if self.logarithmic:
            return self.lower * torch.exp(unit * math.log(self.upper / self.lower))
        return self.lower + unit * (self.upper - self.lower)


@dataclass(frozen=True)
class Uncertainty:
    """What the data say about the parameters near the minimum (Gauss-Newton approximation).

    Attributes:
        deviation: standard deviation of each parameter, in its unit.
        correlation: (P, P) of the parameters, in their order.
        poorest: the direction that the data tell least about: weights of the parameters, in fractions of their ranges.
        poorest_deviation: standard deviation along it, as a fraction of the ranges.
    """

    deviation: dict[str, float]
    correlation: list[list[float]]
    poorest: dict[str, float]
    poorest_deviation: float


@dataclass
class Identification:
    """Result of an identification.

    Attributes:
        parameters: the values of the smallest loss.
        loss: that loss, relative to the motions' amplitudes.
        history: for every start the records ``loss`` and the parameters, one an evaluation.
        at_bounds: parameters that ended on a bound.
        uncertainty: see the class.
    """

    parameters: dict[str, float]
    loss: float
    history: list[list[dict[str, float]]] = field(default_factory=list)
    at_bounds: tuple[str, ...] = ()
    uncertainty: Uncertainty | None = None


class Identifier:
    """Searches parameters.

    Args:
        replay: of the motions to fit.
        release: how they begin.
        bounds: range of each parameter to identify.
        seconds: how much of each motion counts; all of it if None.

    Raises:
        InputError: an unknown parameter, or none.
    """

    def __init__(
        self, replay: Replay, release: Release, bounds: Mapping[str, Bounds], seconds: float | None = None
    ) -> None:
        if not bounds:
            raise InputError("there is nothing to identify: name a parameter under identify.parameters.")
        for name in bounds:
            if name not in PARAMETERS:
                raise InputError(f"there is no parameter {name!r} to identify: choose from {', '.join(PARAMETERS)}.")
        self.replay, self.release, self.bounds, self.seconds = replay, release, dict(bounds), seconds
        seen = replay.motions.seen.sum((1, 2))
        # (R,) so that the sum of squares is the mean over motions of each one's mean square over its amplitude.
        self._weight = 1.0 / (seen * replay.motions.amplitude**2 * len(seen))

    def losses(self, unit: torch.Tensor) -> torch.Tensor:
        """(E,) losses of (E, P) parameters, each a fraction of its range."""
        return (self._residuals(unit).square().sum((2, 3, 4)) * self._weight).sum(1)

    def _residuals(self, unit: torch.Tensor) -> torch.Tensor:
        values = {name: b.from_unit(unit[:, i]) for i, (name, b) in enumerate(self.bounds.items())}
        return self.replay.errors(self.replay(self.release, values, self.seconds))

    def grid(self, axes: Mapping[str, int], others: Mapping[str, float], chunk: int = 12) -> NDArray[np.float64]:
        """Losses on a grid over some of the parameters, the others held.

        Args:
            axes: number of points of each parameter of the grid, over its whole range.
            others: values of the remaining parameters.
            chunk: sets of parameters that are simulated at once.

        Returns:
            Losses in the shape of the grid; infinite where a simulation failed.
        """
        ticks = [
            np.linspace(0.0, 1.0, axes[name]) if name in axes else [self._unit(name, others)] for name in self.bounds
        ]
        points = np.array(list(product(*ticks)))
        losses = np.concatenate([self._losses_safe(points[i : i + chunk]) for i in range(0, len(points), chunk)])
        return losses.reshape([axes[name] for name in self.bounds if name in axes])

    def ticks(self, name: str, count: int) -> NDArray[np.float64]:
        """The values of a parameter on `grid`."""
        return self.bounds[name].from_unit(torch.linspace(0.0, 1.0, count, dtype=torch.float64)).numpy()

    def _unit(self, name: str, values: Mapping[str, float]) -> float:
        bounds = self.bounds[name]
        return bounds.to_unit(min(max(values[name], bounds.lower), bounds.upper))

    def _losses_safe(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Losses without gradients; one point at a time where a simulation of several fails."""
        try:
            with torch.no_grad():
                return self.losses(self.replay.simulator.tensor(points)).cpu().numpy()
        except ConvergenceError:
            if len(points) == 1:
                return np.array([np.inf])
            return np.concatenate([self._losses_safe(p[None]) for p in points])

    def starts(self, first: Mapping[str, float], count: int, candidates: int, seed: int) -> list[dict[str, float]]:
        """The first guess, and the best of random candidates around the ranges.

        Args:
            first: a value of each parameter.
            count: starts, the first guess included.
            candidates: how many random sets are tried.
            seed: of the sets (Latin hypercube).
        """
        units = [np.array([self._unit(name, first) for name in self.bounds])]
        if count > 1:
            sampler = scipy.stats.qmc.LatinHypercube(len(self.bounds), rng=np.random.default_rng(seed))
            points = sampler.random(max(candidates, count - 1))
            losses = np.concatenate([self._losses_safe(points[i : i + 8]) for i in range(0, len(points), 8)])
            units += [points[i] for i in np.argsort(losses)[: count - 1] if np.isfinite(losses[i])]
        return [self._values(u) for u in units]

    def _values(self, unit: Sequence[float] | NDArray[np.float64]) -> dict[str, float]:
        return {
            n: float(b.from_unit(torch.tensor(float(u)))) for (n, b), u in zip(self.bounds.items(), unit, strict=True)
        }

    def run(
        self, starts: Sequence[Mapping[str, float]], max_iterations: int, report: Report | None = None
    ) -> Identification:
        """Minimises the loss from every start and keeps the best.

        Args:
            starts: a value of each parameter, for each start.
            max_iterations: of L-BFGS-B, a start.
            report: called with the start's number, the loss and the parameters after every evaluation.

        Raises:
            ConvergenceError: the simulation fails at every start.
        """
        best: tuple[float, NDArray[np.float64]] | None = None
        histories = []
        for number, start in enumerate(starts):
            history: list[dict[str, float]] = []

            def objective(
                unit: NDArray[np.float64], history: list[dict[str, float]] = history, number: int = number
            ) -> tuple[float, NDArray[np.float64]]:
                loss, gradient = self._loss_and_gradient(unit)
                values = self._values(unit)
                history.append({"loss": loss, **values})
                if report is not None:
                    report(number, loss, values)
                return loss, gradient

            x0 = np.array([self._unit(name, start) for name in self.bounds])
            result = scipy.optimize.minimize(
                objective,
                x0,
                jac=True,
                method="L-BFGS-B",
                bounds=[(0.0, 1.0)] * len(x0),
                options={"maxiter": max_iterations, "ftol": 1e-7, "gtol": 1e-7},
            )
            histories.append(history)
            if np.isfinite(result.fun) and (best is None or result.fun < best[0]):
                best = (float(result.fun), result.x)
        if best is None:
            raise ConvergenceError("the simulation failed at every start of the identification.", None, None)
        at_bounds = tuple(n for n, u in zip(self.bounds, best[1], strict=True) if min(u, 1.0 - u) < 1e-4)
        return Identification(self._values(best[1]), best[0], histories, at_bounds, self.uncertainty(best[1]))

    def _loss_and_gradient(self, unit: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        x = self.replay.simulator.tensor(unit)[None].requires_grad_()
        try:
            loss = self.losses(x)[0]
        except ConvergenceError:
            return 1e3, np.zeros_like(unit)  # L-BFGS-B's line search comes back from there
        (gradient,) = torch.autograd.grad(loss, x)
        return float(loss.detach()), gradient[0].cpu().numpy()

    def uncertainty(self, unit: NDArray[np.float64], step: float = 1e-3) -> Uncertainty:
        """Covariance s^2 (J^T J)^-1 with J from central differences, for residuals that are correlated in time.

        s^2 is the mean square residual times the number of frames that tell nothing new: the sum of the residuals'
        autocorrelation up to its first zero.
        """
        count = len(unit)
        inside = np.clip(unit, step, 1.0 - step)
        points = np.concatenate([inside[None], inside + step * np.eye(count), inside - step * np.eye(count)])
        with torch.no_grad():
            residuals = self._residuals(self.replay.simulator.tensor(points)) * self._weight.sqrt()[:, None, None, None]
        flat = residuals.flatten(1).cpu().numpy()
        jacobian = (flat[1 : count + 1] - flat[count + 1 :]).T / (2.0 * step)
        seen = int(self.replay.motions.seen.sum()) * 3
        variance = float(flat[0] @ flat[0]) / max(seen - count, 1) * _redundancy(residuals[0].cpu().numpy())
        information = jacobian.T @ jacobian
        values, vectors = np.linalg.eigh(information)
        covariance = (vectors / np.maximum(values, 1e-12 * values[-1])) @ vectors.T * variance
        deviation = np.sqrt(np.diag(covariance))
        slopes = [self._slope(name, u) for name, u in zip(self.bounds, inside, strict=True)]
        poorest = vectors[:, 0] * np.sign(vectors[np.abs(vectors[:, 0]).argmax(), 0])
        return Uncertainty(
            deviation={n: float(d * s) for n, d, s in zip(self.bounds, deviation, slopes, strict=True)},
            correlation=(covariance / np.outer(deviation, deviation)).tolist(),
            poorest=dict(zip(self.bounds, poorest.tolist(), strict=True)),
            poorest_deviation=float(np.sqrt(variance / max(values[0], 1e-12 * values[-1]))),
        )

    def _slope(self, name: str, unit: float) -> float:
        """Derivative of a parameter with respect to its fraction."""
        x = torch.tensor(float(unit), dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(self.bounds[name].from_unit(x), x)
        return float(slope)


def _redundancy(residuals: NDArray[np.float64]) -> float:
    """How many frames (R, T, M, 3) weigh as much as one: 1 + 2 sum of the autocorrelation up to its first zero."""
    series = residuals.transpose(1, 0, 2, 3).reshape(residuals.shape[1], -1)
    products = [float((series[lag:] * series[: len(series) - lag]).sum()) for lag in range(len(series) // 2)]
    if products[0] <= 0.0:
        return 1.0
    total = 1.0
    for value in products[1:]:
        if value <= 0.0:
            break
        total += 2.0 * value / products[0]
    return total
