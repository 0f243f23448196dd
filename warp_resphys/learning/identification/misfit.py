"""The misfit of a simulator to observed motions, as a function
of the physical parameters to identify.

The loss is the mean square distance of simulated and observed markers, each motion in units of its
own amplitude, over all motions at once. Prior knowledge is that of the parameters
(`parameters.Prior`) and of marker places (`placement`). It adds its squares, weighted as much as
one independent residual of the data: by their mean square, times the number of residuals that are
correlated. That weight is computed at the start of a search and again where the loss hardly falls.

A parameter may have a value for each trial or session (`parameters.value_name`), held by its prior;
all others have the mean of the prior. A trial depends on its own value alone, so that one motion
gives the derivatives of all trials.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from itertools import chain, starmap

import numpy as np
import torch
from typing_extensions import override

from ...core.linalg.threads import in_threads, thread_count
from ...core.stepping.state import State
from ...io.arrays import FloatArray
from ...io.errors import ConvergenceError, InputError
from ...settings.learning import Bounds
from ..metrics import redundancy
from ..parameters import check_names, exact, split_name
from ..placement import Accuracy, DisplacedMarkers
from ..replay import Replay, Sensed
from ..start import Start
from ..trial_batch import TrialBatch
from .nuisances import NuisanceFit, Nuisances
from .uncertainty import LinearMisfit, LinearTrial, Uncertainty, left_out, uncertainty_of

_LEAST_WEIGHT = 1e-18  # of the priors, where the residuals are rounding
_MOST_ITERATIONS = (
    200  # of a solve; steps take a handful, and parameters that need more have failed
)
_DIFFERENCE = 1e-5  # of a parameter, for derivatives, as a fraction of its range
_MOST_BYTES = 2**30  # of the states, and of the derivatives, that are kept


class BoundedMisfit(ABC):
    """A misfit as a function of parameters with bounds and priors.

    Args:
        bounds: range of each of the P parameters.

    Attributes:
        bounds: see above.
        prior_weight: mean square of one independent residual, which weights the priors; 0 before it
            is computed.
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

    def objective(
        self, unit: FloatArray, derivatives: bool
    ) -> tuple[float, FloatArray, FloatArray]:
        """Returns the loss, its gradient (P,) and Gauss-Newton matrix (P, P), for
        `linalg.least_squares.UnitBox`.
        """
        count = len(unit)
        linear = self.linearise(unit, derivatives)
        slopes = (np.zeros(count), np.zeros((count, count)))
        if linear is None or not math.isfinite(linear.loss):
            return math.inf, *slopes
        slopes = (linear.gradient, linear.gauss_newton) if derivatives else slopes
        return linear.loss if np.isfinite(slopes[1]).all() else math.inf, *slopes

    @abstractmethod
    def forget(self) -> None:
        """Forgets the results of earlier parameters, from which the next are predicted."""

    def nuisances(self, unit: FloatArray) -> Nuisances:
        """Returns the best places of the markers and delays of the trials with (P,) parameters."""
        return Nuisances()

    @property
    def has_priors(self) -> bool:
        """Whether there is prior knowledge."""
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
        """(E,) losses of (E, P) parameters, each as if it were the first.

        Infinite where the simulation fails.
        """
        losses = np.full(len(points), np.inf)
        for number, point in enumerate(points):
            self.forget()
            linear = self.linearise(point, derivatives=False)
            losses[number] = np.inf if linear is None else linear.loss
        return losses

    def prior_rows(self, unit: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """(K,) weighted residuals of the priors of parameters,
        their derivatives (K, P), and their weight.
        """
        rows, slopes = np.zeros(len(self._priors)), np.zeros((len(self._priors), len(unit)))
        weight = math.sqrt(self.prior_weight)
        for row, (i, mean, deviation) in enumerate(self._priors):
            rows[row], slopes[row, i] = weight * (unit[i] - mean) / deviation, weight / deviation
        return rows, slopes, self.prior_weight

    def update_prior_weight(self, unit: FloatArray) -> None:
        """Sets the weight of the priors from the residuals at (P,) parameters."""
        linearised = self.linearise(unit, derivatives=False) if self.has_priors else None
        if linearised is None:
            return
        seen = sum(trial.seen for trial in linearised.trials)
        squares = [
            np.square(trial.rows).sum() * redundancy(trial.rows) for trial in linearised.trials
        ]
        self.prior_weight = max(float(sum(squares)) / max(seen, 1), _LEAST_WEIGHT)

    def uncertainty(self, unit: FloatArray) -> Uncertainty | None:
        """Uncertainty of (P,) parameters; None if a simulation close by fails."""
        found = self.linearise(unit)
        return None if found is None else uncertainty_of(found, self.bounds, unit)


class Misfit(BoundedMisfit):
    """Loss, residuals and their derivatives.

    Args:
        replays: groups of trials that begin alike, such as motions or static poses, with their
            starts; all with one simulator.
        bounds: range of each of the P parameters to identify.
        seconds: length of each motion that is compared [s]; the whole motion if None.
        accuracy: standard deviations of the marker places and of the recording's frame; None: both
            are exact.
        known: values of further parameters, which are not identified; residuals are lengths then,
            as amplitudes would be those of the whole motions.
        delay: standard deviation of the delay of motions that their inputs begin [s]; see
            `nuisances.NuisanceFit`.
        shares: (M,) of the coordinates of each observed point that are independent of the others;
            None: all.

    Attributes:
        simulator: of all replays; it raises where a solve fails.

    Raises:
        InputError: an unknown parameter, or none; or a motion in which nothing moves.
    """

    def __init__(
        self,
        replays: Sequence[tuple[Replay, Start]],
        bounds: Mapping[str, Bounds],
        seconds: float | None = None,
        accuracy: Accuracy | None = None,
        known: Mapping[str, float] | None = None,
        delay: float = 0.0,
        shares: Sequence[float] | None = None,
    ) -> None:
        if not bounds:
            raise InputError(
                "there is nothing to identify: name a parameter under identify.parameters."
            )
        first = replays[0][0]
        check_names(bounds, first.parameter_names)
        super().__init__(bounds)
        simulator = first.simulator
        most = min(simulator.settings.max_iterations, _MOST_ITERATIONS)
        settings = simulator.settings.changed(max_iterations=most, on_failure="raise")
        self.simulator = replace(simulator, solver=settings)
        self._known = {} if known is None else dict(known)
        self._shares = None if shares is None else np.array(shares)
        self._replays, self._weights = list[tuple[Replay, Start]](), list[torch.Tensor]()
        count = sum(len(replay.trials.names) for replay, _ in replays)
        for replay, start in chain.from_iterable(starmap(_parts, replays)):
            trials = replay.trials if seconds is None else replay.trials.first(seconds)
            amplitude = torch.ones_like(trials.size) if self._known else trials.size
            for name, moved in zip(trials.names, amplitude.tolist(), strict=True):
                if not moved > 0.0:
                    still = "markers" if trials.observed.shape[2] else "forces"
                    stay = "stay where they were held" if trials.observed.shape[2] else "are zero"
                    stay += (
                        ", and its forces are zero"
                        if trials.sensors and trials.observed.shape[2]
                        else ""
                    )
                    raise InputError(f"the {still} of the trial {name!r} {stay}: leave it out.")
            pair = replay.changed(simulator=self.simulator, trials=trials), start
            self._replays.append(pair if accuracy is None else DisplacedMarkers.replay(*pair))
            self._weights.append(1.0 / (trials.count * amplitude**2 * count))
        self._fit = NuisanceFit(self._replays, self._weights, accuracy, delay)
        self._moves = _moves_of(self.bounds)
        self.forget()

    @override
    def forget(self) -> None:
        """Forgets motions with earlier parameters, from which the next ones are predicted."""
        self._motions = [
            NearbyMotion(self.simulator.tensor(self._owners(r.trials))) for r, _ in self._replays
        ]
        self._last: tuple[torch.Tensor, list[Sensed]] | None = None  # of `_followed`

    @override
    def linearise(self, unit: FloatArray, derivatives: bool = True) -> LinearMisfit | None:
        """Linearises the residuals at (P,) parameters, which marker places and delays follow."""
        system = self._system(unit, derivatives)
        return None if system is None else system.eliminated()

    @override
    def uncertainty(self, unit: FloatArray) -> Uncertainty | None:
        """Uncertainty of (P,) parameters, see `left_out`; None if a simulation close by fails.

        Equilibria that are solved again with other parameters (`EnergySet.follow_pose`) are solved
        exactly if that converges.
        """
        system = None
        if self.simulator.energies.follow_pose:
            accurate = copy(self)
            accurate.simulator = exact(self.simulator)
            accurate._replays = [
                (r.changed(simulator=accurate.simulator), start) for r, start in self._replays
            ]
            accurate.forget()
            system = accurate._system(unit)
        system = system or self._system(unit)
        if system is None:
            return None
        whole = uncertainty_of(system.eliminated(), self.bounds, unit)
        return replace(whole, left_out=left_out(system, self.bounds, unit))

    def _system(self, unit: FloatArray, derivatives: bool = True) -> LinearMisfit | None:
        """Linearises the residuals at constant marker places and delays.

        Derivatives are differences of motions of nearly the same parameters (`Replay.varied`), into
        the range.
        """
        steps = _DIFFERENCE * np.where(unit < 0.5, 1.0, -1.0)
        moves = self._moves if derivatives else []
        moved = np.array(
            [np.isin(np.arange(len(unit)), columns) * steps for columns in moves]
        ).reshape(-1, len(unit))
        points = self.simulator.tensor(np.concatenate([unit[None], unit + moved]))
        try:
            with torch.no_grad():
                sensed = self._followed(points)
        except ConvergenceError as error:
            self.failure = str(error)
            return None
        fitted, nuisances = self._fit(sensed, self.prior_weight)
        trials = list[LinearTrial]()
        for number, (errors, weight) in enumerate(zip(fitted, self._weights, strict=True)):
            observed = self._replays[number][0].trials
            # (E, R, T, C)
            weighted = (errors * weight.sqrt()[:, None, None]).double().cpu().numpy()
            flat = weighted.reshape(*weighted.shape[:2], -1)
            slopes = np.zeros((*flat.shape[1:], len(unit)))  # (R, T C, P)
            for changed, columns, owners in zip(
                flat[1:], self._moves, self._owners(observed), strict=derivatives
            ):
                slopes[..., columns] = (changed - flat[0])[..., None] * (
                    owners[:, columns] / steps[columns]
                )[:, None]
            follow = (
                nuisances.columns[number] if nuisances.columns else np.zeros((*slopes.shape[:2], 0))
            )
            shown = observed.seen.sum(1).cpu().numpy()  # (R, M) frames
            shown = shown if self._shares is None else self._shares * shown
            seen = observed.observed.shape[-1] * shown.sum(1)
            seen = (seen + observed.readings.cpu().numpy()).tolist()
            of_trials = zip(weighted[0], slopes, seen, observed.names, follow, strict=True)
            trials += [
                LinearTrial(r, s, n, name, observed.session, c) for r, s, n, name, c in of_trials
            ]
        return LinearMisfit(trials, *self.prior_rows(unit), nuisances)

    def _owners(self, trials: TrialBatch) -> FloatArray:
        """(S, R, P) one where a motion of `_moves_of` changes a parameter of a trial, else zero."""
        owners = np.zeros((len(self._moves), len(trials.names), len(self.bounds)))
        names = [split_name(name)[1] for name in self.bounds]
        for number, moved in enumerate(self._moves):
            for column in moved:
                owner = names[column]
                owners[number, :, column] = [
                    not owner or owner in (t, trials.session) for t in trials.names
                ]
        return owners

    @property
    @override
    def has_priors(self) -> bool:
        return super().has_priors or not self._fit.is_empty

    @override
    def nuisances(self, unit: FloatArray) -> Nuisances:
        with torch.no_grad():
            return self._fit(self._followed(self.simulator.tensor(unit)[None]), self.prior_weight)[
                1
            ]

    def _values(self, unit: torch.Tensor) -> dict[str, torch.Tensor]:
        """(E,) values of each parameter.

        Where trials have their own, the common one is the mean of the prior.
        """
        values = {
            name: range_.from_unit(unit[:, i])
            for i, (name, range_) in enumerate(self.bounds.items())
        }
        common = {
            split_name(name)[0]: range_
            for name, range_ in self.bounds.items()
            if split_name(name)[1]
        }
        others = {
            name: range_.prior.mean for name, range_ in common.items() if range_.prior is not None
        } | self._known
        return {name: torch.full_like(unit[:, 0], value) for name, value in others.items()} | values

    def _followed(self, points: torch.Tensor) -> list[Sensed]:
        """Simulated points and readings of each replay (`Replay.sensed`),
        predicted from those with earlier parameters.

        The first motion is not simulated again where the last one had its parameters.

        Args:
            points: (1, P) parameters, or further rows that change them along each direction of the
                derivatives.
        """
        if self._last is not None and torch.equal(self._last[0], points):
            return self._last[1]
        unit, values = points[0], self._values(points)
        first = {name: value[:1] for name, value in values.items()}

        def follow(number: int) -> Sensed:
            (replay, start), motion = self._replays[number], self._motions[number]
            guess = motion.predict(unit, 0) if start.at_rest else None
            begin = start if guess is None else start.near(guess)
            states = motion.states(unit)
            if states is None:
                states = replay.states(begin, first, partial(motion.predict, unit))
                motion.keep(unit, states)
            if len(points) == 1:
                return replay.observed(begin, states, first)
            motion.differentiate(points)
            return replay.varied(begin, values, states, motion.record)

        numbers = range(len(self._replays))
        shares = self.simulator.rest_positions.device.type == "cpu"
        self._last = points, in_threads(follow, numbers) if shares else [*map(follow, numbers)]
        return self._last[1]


class NearbyMotion:
    """The last motion of R trials, and the last derivatives of its positions by P parameters.

    A search for parameters simulates nearly the same motion again and again. Its prediction to
    first order, q(p) = q(p0) + dq/dp (p - p0), is where the solver of an equilibrium or a step
    starts (`Simulator.step`): the error is of second order in the change of the parameters, and
    smooth in time, so that the solver extrapolates it from step to step. States are kept, so that
    derivatives can be computed after a simulation.

    Args:
        owners: (S, R, P) one where a direction of the derivatives changes a parameter of a trial,
            else zero.
    """

    def __init__(self, owners: torch.Tensor) -> None:
        self._owners = owners
        self._unit: torch.Tensor | None = None
        self._states: Sequence[State] = ()
        self._count = 0  # of the states, of which the first alone is kept where they are large
        self._slopes: list[torch.Tensor] = []  # (S, R, N, 3) in float32, of each state [m]
        self._steps = owners.new_zeros(())

    def keep(self, unit: torch.Tensor, states: Sequence[State]) -> None:
        """Keeps states of the motion with parameters (P,), as fractions of their ranges."""
        small = sum(state.q.nbytes + state.v.nbytes for state in states) <= _MOST_BYTES
        self._unit = unit
        self._states = states if small else states[:1]
        self._count = len(states)

    def states(self, unit: torch.Tensor) -> Sequence[State] | None:
        """Returns states with parameters (P,), if the last motion had these and they are kept."""
        whole = len(self._states) == self._count > 0
        return (
            self._states
            if whole and self._unit is not None and torch.equal(unit, self._unit)
            else None
        )

    def predict(self, unit: torch.Tensor, number: int) -> torch.Tensor | None:
        """Returns positions (R, N, 3) of a state with parameters (P,) [m].

        None where nothing predicts them.
        """
        if self._unit is None or number >= len(self._states):
            return None
        q = self._states[number].q
        if number >= len(self._slopes):
            return q if number == 0 else None
        change = (self._owners @ (unit - self._unit)).to(self._slopes[number])
        q = q + torch.einsum("sr,srni->rni", change, self._slopes[number])
        return q if bool(q.isfinite().all()) else None

    def differentiate(self, points: torch.Tensor) -> None:
        """Begins derivatives by parameters (1 + S, P): those of the motion,
        and those changed along each direction.
        """
        steps = torch.einsum("srp,sp->sr", self._owners, points[1:] - points[0])
        self._steps, self._slopes = torch.where(steps == 0.0, torch.inf, steps)[..., None, None], []

    def record(self, q: torch.Tensor, others: torch.Tensor) -> None:
        """Keeps the derivatives of the next state, unless a long motion
        of a large body needs too much memory.

        Args:
            q: (R, N, 3) positions [m].
            others: (S R, N, 3) those with the changed parameters [m].
        """
        slopes = ((others.unflatten(0, (-1, len(q))) - q) / self._steps).float()
        if (len(self._slopes) + 1) * slopes.nbytes <= _MOST_BYTES:
            self._slopes.append(slopes)


def _parts(replay: Replay, start: Start) -> list[tuple[Replay, Start]]:
    """A replay and its start, divided by trials into a part for each thread of a CPU."""
    trials, count = replay.trials, len(replay.trials.names)
    parts = min(thread_count(), count) if start.delay.device.type == "cpu" else 1
    chosen = [part.tolist() for part in np.array_split(np.arange(count), parts)]
    return [(replay.changed(trials=trials.select(part)), start.select(part)) for part in chosen]


def _moves_of(names: Iterable[str]) -> list[list[int]]:
    """Indices of the parameters that one motion gives the derivatives by:
    all values of trials of a parameter.
    """
    moves: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        parameter, owner = split_name(name)
        moves.setdefault(parameter if owner else name, []).append(number)
    return [*moves.values()]
