"""System identification: the physical parameters with which a simulator comes closest to observed motions.

The loss is the mean square distance of simulated and observed markers, each motion in units of its own amplitude, over
all motions at once. `linalg.least_squares` minimises it within bounds, from the best of a coarse set of starts, with
gradients through the simulator.

What is known beforehand, normal distributions of parameters (`Prior`) and of where markers sit (`placement`), adds its
squares, weighed as much as one residual that tells something new: by the mean square residual of the data, times the
number of frames that tell the same. That number is found at the start and again at the minimum.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
import scipy.stats
import torch
from numpy.typing import NDArray

from ..data.markers import Markers
from ..data.trials import Trials
from ..io.errors import ConvergenceError, InputError
from ..linalg.least_squares import UnitBox, minimise
from .bounds import Bounds
from .placement import Accuracy, Placement, Stems, estimate
from .replay import Replay, Start
from .uncertainty import Linearised, Uncertainty, redundancy, uncertainty_of

Report = Callable[[int, float, Mapping[str, float]], None]
Attempt = dict[str, Any]

_MOST_ITERATIONS = 200  # of a solve; steps take a handful, and parameters that need more have failed
_DIFFERENCE = 1e-3  # of a range, for derivatives by differences
_LEAST_WEIGHT = 1e-18  # of the priors, where the residuals are rounding
_ALIKE = 0.7  # weights of the priors that differ by less are not worth another descent


@dataclass
class Identification:
    """Result of an identification."""

    parameters: dict[str, float]  # the values of the smallest loss
    loss: float  # that loss, relative to the motions' amplitudes
    # for every start the records ``loss`` and the parameters, one an evaluation that did not fail
    history: list[list[dict[str, float]]] = field(default_factory=list)
    at_bounds: tuple[str, ...] = ()  # parameters that ended on a bound
    placement: dict[str, Any] | None = None  # of the markers, as `Placement.plain` has it
    uncertainty: Uncertainty | None = None  # see the class; None if the simulation fails beside the minimum


class Identifier:
    """Searches parameters.

    Args:
        replays: of the trials to fit, each of trials that begin alike, such as motions and static poses, with how these
            begin; all by one simulator.
        bounds: range of each parameter to identify.
        seconds: how much of each motion counts; all of it if None.
        accuracy: to which it is known where markers sit and how the recordings lie; None: exactly.
        labels: of the markers, if that is given.
        centre: (3,) about which recordings may be turned [m].

    Raises:
        InputError: an unknown parameter, or none; or a motion in which nothing moves.
    """

    def __init__(
        self,
        replays: Sequence[tuple[Replay, Start]],
        bounds: Mapping[str, Bounds],
        seconds: float | None = None,
        accuracy: Accuracy | None = None,
        labels: Sequence[str] = (),
        centre: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        if not bounds:
            raise InputError("there is nothing to identify: name a parameter under identify.parameters.")
        first = replays[0][0]
        for name in bounds:
            if name not in first.known:
                raise InputError(f"there is no parameter {name!r} to identify: choose from {', '.join(first.known)}.")
        simulator, self.bounds = first.simulator, dict(bounds)
        most = min(simulator.settings.max_iterations, _MOST_ITERATIONS)
        settings = replace(simulator.settings, max_iterations=most, on_failure="raise")
        self.simulator = replace(simulator, solver=settings)
        self._replays: list[tuple[Replay, Start]] = []
        self._weights: list[torch.Tensor] = []
        self._accuracy, self._labels, self._centre = accuracy, tuple(labels), self.simulator.tensor(list(centre))
        # By replay, equilibria for the parameters that were tried last, near which the next ones are.
        self._near: list[_Equilibria | None] = []
        self._expected = [each.expected() for each in self.bounds.values()]
        self._prior_weight = 0.0
        count = sum(len(replay.trials.names) for replay, _ in replays)
        for replay, start in replays:
            trials = replay.trials if seconds is None else replay.trials.first(seconds)
            for name, moved in zip(trials.names, trials.amplitude.tolist(), strict=True):
                if not moved > 0.0:
                    raise InputError(f"the markers of the trial {name!r} stay where they were held: leave it out.")
            self._replays.append(self._watched(replay, start, trials))
            self._weights.append(trials.loss_weight * (len(trials.names) / count))

    def _watched(self, replay: Replay, start: Start, trials: Trials) -> tuple[Replay, Start]:
        """A replay that also tells how stems turn, where markers may sit elsewhere."""
        if self._accuracy is None:
            return Replay(self.simulator, replay.observe, trials), start
        if not isinstance(replay.observe, Markers):
            raise InputError("where the markers sit can be identified of markers alone: leave identify.placement out.")
        stems = Stems(replay.observe, trials.observed.shape[2])
        shift = None if start.shift is None else start.shift.repeat(1, stems.copies, 1)
        return Replay(self.simulator, stems, trials), replace(start, shift=shift)

    def losses(self, unit: torch.Tensor) -> torch.Tensor:
        """(E,) losses of (E, P) parameters, each a fraction of its range."""
        residuals, prior = self._residuals(unit)
        pairs = zip(residuals, self._weights, strict=True)
        data = torch.stack([(each.square().sum((2, 3, 4)) * weight).sum(1) for each, weight in pairs]).sum(0)
        return data + prior.square().sum(1)

    def _residuals(self, unit: torch.Tensor) -> tuple[list[torch.Tensor], torch.Tensor]:
        """(E, R, T, M, 3) simulated less observed points of each replay [m], and (E, K) what the priors add."""
        series = self._simulated(unit)
        weight = math.sqrt(self._prior_weight)
        known = [(i, *expected) for i, expected in enumerate(self._expected) if expected is not None]
        prior = [weight * (unit[:, i] - mean) / deviation for i, mean, deviation in known]
        rows = torch.stack(prior, 1) if prior else unit.new_zeros(len(unit), 0)
        if self._accuracy is None:
            return [r.errors(each) for (r, _), each in zip(self._replays, series, strict=True)], rows
        placed, inside = [], []
        for row in range(len(unit)):
            shown = [each[row] for each in series]
            if not self._prior_weight:  # Nothing is known yet of how much the data tell.
                placed.append([Stems.parts(each)[0] for each in shown])
                inside.append(unit.new_zeros(1))
                continue
            placement, deviations, points = self._place(shown)
            inside.append(weight * deviations)
            placed.append([placement.apply(at) for at in points])
        errors = [
            r.errors(torch.stack(each)) for (r, _), each in zip(self._replays, zip(*placed, strict=True), strict=True)
        ]
        return errors, torch.cat([rows, torch.stack(inside)], 1)

    def _simulated(self, unit: torch.Tensor) -> list[torch.Tensor]:
        """(E, R, T, M, 3) what each replay shows with (E, P) parameters [m]."""
        values = {name: b.from_unit(unit[:, i]) for i, (name, b) in enumerate(self.bounds.items())}
        near = self._near or [None] * len(self._replays)
        found = []
        for (replay, start), known in zip(self._replays, near, strict=True):
            found.append(replay(start if known is None else start.near(known.at(unit.detach())), values))
        return found

    def _settle(self, unit: torch.Tensor) -> None:
        """Finds the equilibria for (1, P) parameters alone, near which are those of others."""
        values = {name: b.from_unit(unit[:, i]) for i, (name, b) in enumerate(self.bounds.items())}
        for replay, start in self._replays:
            if start.at_rest:
                constants, _, resting = replay.setting(values)
                replay.begin(start, constants, resting)
        self._remember(unit)

    def _remember(self, unit: torch.Tensor) -> None:
        """Keeps the equilibria of the last simulation.

        Args:
            unit: (1, P) parameters, or (1 + P, P), in which each is changed once; what was simulated besides is left.
        """
        unit, near = unit.detach(), self._near or [None] * len(self._replays)
        self._near = []
        for (replay, start), known in zip(self._replays, near, strict=True):
            if not start.at_rest or replay.settled is None:
                self._near.append(None)
                continue
            first, *others = replay.settled.split(len(replay.trials.names))[: len(unit)]
            slopes = None if known is None else known.slopes
            if others:
                steps = (unit[1:] - unit[:1]).diagonal()
                slopes = (torch.stack(others) - first) / steps[:, None, None, None]
            self._near.append(_Equilibria(unit[0], first, slopes))

    def _place(self, series: Sequence[torch.Tensor]) -> tuple[Placement, torch.Tensor, list[torch.Tensor]]:
        """The best placement for what one set of parameters shows, it in standard deviations, and the moved markers."""
        assert self._accuracy is not None
        parts = [Stems.parts(each) for each in series]
        with torch.no_grad():  # Where it is the best, the loss does not change with it.
            errors = [r.errors(at[None])[0] for (r, _), (at, _) in zip(self._replays, parts, strict=True)]
            seen = [r.trials.seen for r, _ in self._replays]
            points, turns = [at for at, _ in parts], [turn for _, turn in parts]
            known = self._accuracy, self._centre, errors, seen
            found, inside = estimate(*known, points, turns, self._weights, self._prior_weight)
        moved = [at + (turn @ found.offsets[..., None])[..., 0] for at, turn in parts]
        return found, inside, moved

    def _weigh_priors(self, unit: NDArray[np.float64]) -> float:
        """Sets what a residual that tells something new weighs, from those at parameters; the ratio to before."""
        before = self._prior_weight
        if self._accuracy is None and not any(self._expected):
            return 1.0
        found = self._linearise(unit, derivatives=False)
        if found is None:
            return 1.0
        trials = found[0]
        seen = sum(count for *_, count in trials)
        squares = [np.square(rows).sum() * redundancy(rows) for rows, _, _ in trials]
        self._prior_weight = max(float(sum(squares)) / max(seen, 1), _LEAST_WEIGHT)
        return self._prior_weight / before if before else math.inf

    def placement(self, unit: NDArray[np.float64]) -> Placement | None:
        """Where the markers sit with parameters, each a fraction of its range; None where that is known."""
        if self._accuracy is None:
            return None
        with torch.no_grad():
            x = self.simulator.tensor(unit)[None]
            series = self._simulated(x)
            self._remember(x)
            return self._place([each[0] for each in series])[0]

    def grid(
        self,
        axes: Mapping[str, int],
        others: Mapping[str, float],
        chunk: int = 12,
        finished: Sequence[float] = (),
        report: Callable[[list[float]], None] | None = None,
    ) -> NDArray[np.float64]:
        """Losses on a grid over some of the parameters, the others held.

        Args:
            axes: number of points of each parameter of the grid, over its whole range.
            others: values of the remaining parameters; those of all of them tell how much the priors weigh.
            chunk: sets of parameters that are simulated at once.
            finished: what an interrupted call with the same arguments told last; those losses are not computed again.
            report: is told the losses so far, in the order of the grid's points, after every chunk.

        Returns:
            Losses with an axis for each of `axes`, in their order; infinite where a simulation failed.
        """
        if not self._prior_weight and others.keys() >= self.bounds.keys():
            self._weigh_priors(self._units(others))
        held = self._units({**others, **{name: self.bounds[name].lower for name in axes}})
        ticks = [
            np.linspace(0.0, 1.0, axes[name]) if name in axes else [unit]
            for name, unit in zip(self.bounds, held, strict=True)
        ]
        points = np.array(list(product(*ticks)))
        losses = list(finished)
        while len(losses) < len(points):
            losses += self._losses_safe(points[len(losses) : len(losses) + chunk]).tolist()
            if report is not None:
                report(losses)
        inside = [name for name in self.bounds if name in axes]
        return (
            np.array(losses).reshape([axes[name] for name in inside]).transpose([inside.index(name) for name in axes])
        )

    def ticks(self, name: str, count: int) -> NDArray[np.float64]:
        """The values of a parameter on `grid`."""
        return self.bounds[name].from_unit(torch.linspace(0.0, 1.0, count, dtype=torch.float64)).numpy()

    def _units(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """(P,) values as fractions of their ranges, those outside at the bound."""
        pairs = ((b, min(max(values[name], b.lower), b.upper)) for name, b in self.bounds.items())
        return np.array([b.to_unit(value) for b, value in pairs])

    def _losses_safe(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Losses without gradients; where some simulations fail, the others are done again without them."""
        losses, left = np.full(len(points), np.inf), np.arange(len(points))
        while len(left):
            try:
                with torch.no_grad():
                    losses[left] = self.losses(self.simulator.tensor(points[left])).cpu().numpy()
                break
            except ConvergenceError as error:
                left = left[error.report.converged.view(len(left), -1).all(1).cpu().numpy()]
        return losses

    def starts(self, first: Mapping[str, float], count: int, candidates: int, seed: int) -> list[dict[str, float]]:
        """The first guess, and the best of random candidates around the ranges.

        Args:
            first: a value of each parameter.
            count: starts, the first guess included.
            candidates: how many random sets are tried.
            seed: of the sets (Latin hypercube).
        """
        units = [self._units(first)]
        if count > 1:
            sampler = scipy.stats.qmc.LatinHypercube(len(self.bounds), rng=np.random.default_rng(seed))
            points = sampler.random(max(candidates, count - 1))
            losses = np.concatenate([self._losses_safe(points[i : i + 8]) for i in range(0, len(points), 8)])
            units += [points[i] for i in np.argsort(losses)[: count - 1] if np.isfinite(losses[i])]
        return [self._values(u) for u in units]

    def _values(self, unit: Sequence[float] | NDArray[np.float64]) -> dict[str, float]:
        return {
            n: float(b.from_unit(torch.tensor(float(u), dtype=torch.float64)))
            for (n, b), u in zip(self.bounds.items(), unit, strict=True)
        }

    def run(
        self,
        starts: Sequence[Mapping[str, float]],
        max_evaluations: int,
        report: Report | None = None,
        finished: Sequence[Attempt] = (),
        keep: Callable[[list[Attempt]], None] | None = None,
        tolerance: float = 1e-6,
    ) -> Identification:
        """Minimises the loss from every start and keeps the best.

        Args:
            starts: a value of each parameter, for each start.
            max_evaluations: of the loss and its gradient, a start.
            tolerance: relative decrease of the loss that is still worth a step.
            report: called after every evaluation with the start's number, the loss (infinite where the simulation
                failed) and the parameters.
            finished: what an interrupted run with the same starts gave to `keep`; those starts are not done again.
            keep: called after every start with the results of all so far, which can be written as JSON.

        Raises:
            ConvergenceError: the simulation fails at every start.
        """
        attempts = list(finished)
        for number in range(len(attempts), len(starts)):
            attempts.append(self._descend(number, starts[number], max_evaluations, tolerance, report))
            if keep is not None:
                keep(attempts)
        good = [attempt for attempt in attempts if attempt["loss"] is not None]
        if not good:
            raise ConvergenceError("the simulation failed at every start of the identification.", None, None)
        best = min(good, key=lambda attempt: attempt["loss"])
        unit = self._units(best["parameters"])
        self._prior_weight = best.get("prior_weight", 0.0)
        self._near = []  # As in a run that only reads what the starts led to.
        placement = self.placement(unit)
        at_bounds = tuple(n for n, u in zip(self.bounds, unit, strict=True) if min(u, 1.0 - u) < 1e-4)
        histories = [attempt["history"] for attempt in attempts]
        return Identification(
            best["parameters"],
            best["loss"],
            histories,
            at_bounds,
            None if placement is None else placement.plain(self._labels),
            self.uncertainty(unit),
        )

    def _descend(
        self, number: int, start: Mapping[str, float], max_evaluations: int, tolerance: float, report: Report | None
    ) -> Attempt:
        """What one start leads to: the parameters, their loss (None if the simulation fails there), the history."""
        history: list[dict[str, float]] = []

        def objective(unit: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
            loss, gradient = self._loss_and_gradient(unit)
            if np.isfinite(loss):
                history.append({"loss": loss, **self._values(unit)})
            if report is not None:
                report(number, loss, self._values(unit))
            return loss, gradient

        def matrix(unit: NDArray[np.float64]) -> NDArray[np.float64] | None:
            found = self._linearise(unit)
            if found is None:
                return None
            trials, prior = found
            return 2.0 * (np.stack([j.T @ j for _, j, _ in trials]).sum(0) + prior.T @ prior)

        first = self._units(start)
        self._prior_weight, self._near = 0.0, []
        self._weigh_priors(first)
        problem = UnitBox(objective, matrix)
        point = problem.evaluate(torch.as_tensor(first)[None])
        simulated = math.isfinite(float(point.value))
        if simulated:
            point = minimise(problem, point, tolerance, max_evaluations - 1).point
            left = max_evaluations - len(history)
            if left > 1 and not _ALIKE < self._weigh_priors(point.x[0].numpy()) < 1.0 / _ALIKE:
                point = minimise(problem, problem.evaluate(point.x), tolerance, left - 1).point
        loss = float(point.value) if simulated else None
        return {
            "parameters": self._values(point.x[0].tolist()),
            "loss": loss,
            "history": history,
            "prior_weight": self._prior_weight,
        }

    def _loss_and_gradient(self, unit: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Infinite, and zero, where the simulation fails."""
        x = self.simulator.tensor(unit)[None].requires_grad_()
        try:
            with torch.enable_grad():
                loss = self.losses(x)[0]
                (gradient,) = torch.autograd.grad(loss, x)
        except ConvergenceError:
            return np.inf, np.zeros_like(unit)
        self._remember(x)
        return float(loss.detach()), gradient[0].double().cpu().numpy()

    def _linearise(
        self, unit: NDArray[np.float64], central: bool = False, derivatives: bool = True
    ) -> tuple[list[Linearised], NDArray[np.float64]] | None:
        """Weighted residuals of every trial, their derivatives by the fractions from differences, and how many count.

        One-sided differences lead into the range; central ones are taken a step inside of it. None where a simulation
        fails.

        Returns:
            A trial each (T, 3 M), (3 T M, P) and the number of coordinates that were seen; and (K, P) the derivatives
            of what the priors add.
        """
        count, steps = len(unit), np.where(unit < 0.5, _DIFFERENCE, -_DIFFERENCE)
        if central:
            unit = np.clip(unit, _DIFFERENCE, 1.0 - _DIFFERENCE)
        sides = [unit[None], unit + np.diag(steps), unit - np.diag(steps)]
        wanted = sides[: 3 if central else 2] if derivatives else sides[:1]
        points = self.simulator.tensor(np.concatenate(wanted))
        try:
            with torch.no_grad():
                if derivatives and not self._near:
                    self._settle(points[:1])
                residuals, prior = self._residuals(points)
        except ConvergenceError:
            return None
        self._remember(points[: count + 1])

        def slopes(values: NDArray[np.float64]) -> NDArray[np.float64]:
            """(..., P) of values (E, ...) at the points."""
            if not derivatives:
                return np.zeros((*values.shape[1:], count))
            behind, width = (values[count + 1 :], 2.0 * steps) if central else (values[:1], steps)
            change = values[1 : count + 1] - behind
            return np.moveaxis(change / width.reshape(-1, *[1] * (change.ndim - 1)), 0, -1)

        found = []
        for (replay, _), each, weight in zip(self._replays, residuals, self._weights, strict=True):
            weighted = (each * weight.sqrt()[:, None, None, None]).double().cpu().numpy()  # (E, R, T, M, 3)
            jacobian = slopes(weighted.reshape(*weighted.shape[:2], -1))
            seen = 3 * replay.trials.seen.sum((1, 2)).cpu().numpy()
            rows = weighted[0].reshape(*weighted.shape[1:3], -1)
            found += list(zip(rows, jacobian, seen.tolist(), strict=True))
        return found, slopes(prior.double().cpu().numpy())

    def uncertainty(self, unit: NDArray[np.float64]) -> Uncertainty | None:
        """The uncertainty of parameters at fractions of their ranges; None if a simulation close by fails."""
        found = self._linearise(unit, central=True)
        return None if found is None else uncertainty_of(*found, self._prior_weight, self.bounds, unit)


@dataclass(frozen=True)
class _Equilibria:
    """Equilibria of trials, and how they change with the parameters."""

    unit: torch.Tensor  # (P,) the parameters, each a fraction of its range
    q: torch.Tensor  # (R, N, 3) [m]
    slopes: torch.Tensor | None  # (P, R, N, 3) by the parameters [m]; None where not known

    def at(self, unit: torch.Tensor) -> torch.Tensor:
        """(E R, N, 3) where they may be with (E, P) other parameters [m]."""
        away = unit - self.unit
        if self.slopes is None:
            return self.q.repeat(len(unit), 1, 1)
        return (self.q + torch.einsum("ep,prni->erni", away, self.slopes)).flatten(0, 1)
