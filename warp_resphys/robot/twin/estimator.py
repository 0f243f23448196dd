r"""The state of a robot's full simulator, estimated from its markers.

The simulator itself, with its learned force, carries the mean. The error of the mean is

    q - q^ = Phi z + S theta~,   v - v^ = Phi w + S' theta~,

with the r slowest vibrations Phi about the first state, and the derivatives S and S' of the motion by the refined
parameters theta. For each parameter a robot with another value runs beside, so that S follows by differences (a filter
with separate bias: Friedland, IEEE Trans. Autom. Control 14 (1969) 359). A force on the body, which fades, shifts its
equilibrium by b; and the markers sit o away from where they are bound. The covariance is that of (z, w, b, theta, o):
an extended Kalman filter of reduced rank (Pham, Verron and Roubaud, J. Mar. Syst. 16 (1998) 323).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
import torch.nn.functional as F

from ...energies.strings import PAYLOAD
from ...io.errors import ConvergenceError, InputError, listed
from ...learning.parameters import check_names, identifiable_parameters
from ...stepping.quantity import Quantity
from ...stepping.state import State
from ..inputs import Given
from ..state import RobotState
from .kalman import Correction, FloatArray, Gate, conditioned, distances
from .robots import Steppable
from .tangent import StepTangent, pulled_by, shifted

_DIFFERENCE: Final = 0.05  # of the robots that run beside, in deviations of their parameter
_OPEN: Final = 1e-3  # least distance of a parameter from a bound that it must not reach, over its first value
_UNKNOWN: Final = 0.1  # deviation of the first shape, and of that after a jump, over the size of the body
_SIMULATOR: Final = 0.02  # of a simulator whose errors are not known, over the size of the body
_WANDER: Final = 1.0  # time after which the force on the body is another [s]
_CHANGED: Final = 0.05  # change of a column of the transition after which the next step renews one, too
_LONGEST_PAUSE: Final = 8  # steps
_TRIED: Final = 0.2  # time over which errors are compared with those of the simulator without markers [s]
_WORSE: Final = 1.5  # errors over those of the simulator without markers, above which this takes over
_SEEN_STEP: Final = 1e-4  # of differences of markers, over the size of the body
_MEDIAN: Final = 2.366  # of the squared distance of a marker, chi-squared with three degrees of freedom
_ADAPTED: Final = 0.2  # share of a frame in the variance of steps, as a power
_FURTHER: Final = (0.1, 100.0)  # range of a frame's squared distance
_SHAKEN: Final = (0.03, 1000.0)  # range of the factor
_EXPLAINED: Final = 0.3  # of the distance of markers that jumped, what a motion of the body may leave
_LARGEST: Final = 0.1  # correction of a vertex in one frame, over the size of the body
_DOUBLINGS: Final = 40  # of the noise of a frame, after which it is left out
_JUMP: Final = 0.02  # least distance of a marker that counts as a jump, over the size of the body


@dataclass(frozen=True)
class TwinNoise:
    """Standard deviations from which a twin starts.

    Attributes:
        markers: of a coordinate of a marker [m].
        simulator: of simulated markers from real ones [m]; None for the mean error in the run's test trials.
        placement: of the markers on the body, from where they are bound [m].
        forget: time after which a refined parameter may be another [s].

    Raises:
        InputError: one that is not positive.
    """

    markers: float = 2e-4
    simulator: float | None = None
    placement: float = 1e-3
    forget: float = 10.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not value > 0.0:
                raise InputError(f"noise.{name} is {value:g}: it must be positive.")


@dataclass(frozen=True)
class Belief:
    """Estimate of a robot's state after a step, with its covariance.

    Attributes:
        state: of 2 + P environments: the estimate, the P with another parameter, and the one without markers.
        parameters: (P,) refined values.
        bias: (r,) shift of the equilibrium.
        places: (M, 3) markers from where they are bound [m].
        covariance: (n, n) of the errors of z, w, b, parameters and places.
        transition: (2 r, 3 r) of the errors (z, w) by (z, w, b) in a step.
        turn: number of the column of it that is renewed next.
        pause: steps between two renewals: few while they change the transition.
        wait: steps until the next one.
        since: (M,) for how long markers have been left out [s].
        squares: (2,) mean squared distances of markers from where they were expected, and from the simulator without
            markers, over the last frames [m^2].
        shaken: factor of the variance that a step adds, by which past frames would have been as far off as expected.
        left: (M, 3) what was left of the distance of markers when they were last believed [m]; NaN for never.
    """

    state: RobotState
    parameters: FloatArray
    bias: FloatArray
    places: FloatArray
    covariance: FloatArray
    transition: FloatArray
    turn: int
    pause: int
    wait: int
    since: FloatArray
    left: FloatArray
    squares: FloatArray
    shaken: float = 1.0


class FullEstimator:
    """Estimates the state of a robot with its own simulator.

    Args:
        robot: with a simulator.
        inputs: constant commands under which it rests at first.
        refine: standard deviations of the parameters to refine, by name, in their units; ``payload`` is one of them
            where the robot has one, and then starts from the first command and ignores later ones.
        modes: number r of vibrations.
        noise: of markers and simulator.
        gate: for markers that jump.
        start: of the robot, one environment; its equilibrium under the inputs if omitted.

    Raises:
        InputError: an unknown parameter or input; a network in place of the simulator.
        ConvergenceError: there is no equilibrium.
    """

    def __init__(
        self,
        robot: Steppable,
        inputs: Mapping[str, Given],
        refine: Mapping[str, float] | None = None,
        modes: int = 8,
        noise: TwinNoise | None = None,
        gate: Gate | None = None,
        start: RobotState | None = None,
    ) -> None:
        if robot.is_data_driven:
            raise InputError("a network in the simulator's place cannot be corrected by a force: load another model.")
        self.robot, self.labels, self.time_step, self.inputs = robot, robot.labels, robot.time_step, dict(inputs)
        self.noise, self._refined = noise or TwinNoise(), dict(refine or {})
        self._check()
        self._first = self._values(inputs)
        self._prior = np.array([*self._refined.values()], dtype=np.float64)
        self._apart = _DIFFERENCE * self._prior
        rest = robot.simulator.rest_positions
        self.size = float((rest.amax(0) - rest.amin(0)).max())
        self._gate = gate or Gate(least=_JUMP * self.size)
        resting = _at_rest(robot, 1, inputs)
        self.tangent = StepTangent.of(robot, resting, inputs, modes)
        self.count = robot.observe(resting).shape[1]
        self._set_noise()
        self._start = start

    def _check(self) -> None:
        named = [name for name in self._refined if name != PAYLOAD.name or name not in self.robot.inputs]
        check_names(named, identifiable_parameters(self.robot.simulator))
        for name, deviation in self._refined.items():
            if not deviation > 0.0:
                raise InputError(f"refine.{name} is {deviation:g}: give its standard deviation, which is positive.")

    def _values(self, inputs: Mapping[str, Given]) -> FloatArray:
        """First values (P,) of the refined parameters."""
        simulator, values = self.robot.simulator, []
        for name in self._refined:
            if name == PAYLOAD.name:
                values.append(float(torch.as_tensor(inputs.get(name, 0.0)).sum()))
                continue
            known = torch.as_tensor(self.robot.parameters.get(name, simulator.constants.get(name, ())))
            if known.numel() != 1:
                raise InputError(
                    f"refine names {name!r}, which has no single value in this robot: refine one that it has "
                    f"identified, {listed([*self.robot.parameters])}, or the payload."
                )
            values.append(float(known))
        return np.array(values, dtype=np.float64)

    def _set_noise(self) -> None:
        """Covariance at the start, and what a step adds to it.

        A unit of a coordinate moves the body by `StepTangent.size` in the root mean square. A force that is as large in
        all modes bends the body less in the faster ones, by the square of their frequency.
        """
        tangent, noise, h = self.tangent, self.noise, self.time_step
        known = self.robot.description.errors_mm.get("mean")
        error = noise.simulator or (_SIMULATOR * self.size if known is None else 1e-3 * float(known))
        less = (tangent.frequencies[0] / tangent.frequencies) ** 2
        shape, force = _UNKNOWN * self.size / tangent.size * less, error / tangent.size * less
        shaken = force * tangent.frequencies * np.sqrt(tangent.frequencies[0] * h / (2.0 * np.pi))
        places = np.full(3 * len(self.labels), noise.placement)
        self._unknown = np.concatenate([shape, shape * tangent.frequencies, force]) ** 2
        self._simulated = np.concatenate([force, force * tangent.frequencies, force]) ** 2
        self._placed = places**2
        self._initial = np.concatenate([self._unknown, self._prior**2, self._placed])
        self._added = np.concatenate(
            [
                np.zeros(len(shape)),
                shaken**2,
                force**2 * -np.expm1(-2.0 * h / _WANDER),
                self._prior**2 * h / noise.forget,
                np.zeros(len(places)),
            ]
        )

    # Steps

    def begin(self, inputs: Mapping[str, Given], refined: FloatArray | None = None) -> Belief:
        """Returns the first belief: a robot at rest under constant commands, with large deviations.

        Args:
            inputs: commands by name.
            refined: (P,) values of the refined parameters; those of the robot if omitted.

        Raises:
            InputError: an invalid command.
            ConvergenceError: there is no equilibrium.
        """
        self._first = self._values(inputs)
        values = self._first if refined is None else refined
        robot, given = self._at(values, inputs)
        state = _at_rest(robot, self._count, given) if self._start is None else self._start.repeat(self._count)
        self._start = None
        r, markers = len(self.tangent.frequencies), self.count
        return Belief(
            state.detach(),
            values,
            np.zeros(r),
            np.zeros((len(self.labels), 3)),
            np.diag(self._initial),
            self.tangent.transition,
            0,
            1,
            0,
            np.zeros(markers),
            np.full((markers, 3), np.nan),
            np.zeros(2),
        )

    @property
    def _count(self) -> int:
        return 2 + len(self._refined)

    def _at(self, values: FloatArray, inputs: Mapping[str, Given], more: int = 0) -> tuple[Steppable, dict[str, Given]]:
        """The robot with the parameters of all environments, and some more like the first, and its commands."""
        table = np.tile(values, (self._count + more, 1))
        table[1 : self._count - 1] += np.diag(self._apart)
        table[self._count - 1] = self._first
        columns = dict(zip(self._refined, table.T, strict=True))
        given = dict(inputs)
        if PAYLOAD.name in columns:
            given[PAYLOAD.name] = columns.pop(PAYLOAD.name)[:, None]
        changed = {name: self.robot.simulator.tensor(column) for name, column in columns.items()}
        return self.robot.with_parameters(**changed) if changed else self.robot, given

    def advance(self, belief: Belief, inputs: Mapping[str, Given], renew: bool = True) -> Belief:
        """Simulates a step under commands.

        Args:
            belief: before it.
            inputs: commands by name.
            renew: whether a column of the transition may be renewed, by two environments beside.

        Raises:
            InputError: an invalid command.
            ConvergenceError: the step failed.
        """
        tangent, r, renew = self.tangent, len(belief.bias), renew and not belief.wait
        more = 2 if renew else 0
        robot, given = self._at(belief.parameters, inputs, more)
        state = belief.state
        pull = torch.einsum("r,rni->ni", self.robot.simulator.tensor(belief.bias), tangent.pull)
        forces = pull.repeat(self._count + more, 1, 1)
        forces[self._count - 1] = 0.0
        if renew:
            changes = tangent.changes([belief.turn])
            moved, faster, pulled = (F.pad(change, (0, 0, 0, 0, self._count, 0)) for change in changes)
            state = shifted(robot, state.select([*range(self._count), 0, 0]), moved, faster)
            forces += pulled
        state = robot.step(state, **pulled_by(robot, given, forces)).detach()
        belief = replace(belief, wait=max(belief.wait - 1, 0))
        if renew:
            belief = self._renewed(belief, state)
            state = state.select(range(self._count))
        step = np.eye(len(belief.covariance))
        step[: 2 * r, : 3 * r] = belief.transition
        fades = float(np.exp(-self.time_step / _WANDER))
        step[2 * r : 3 * r] *= fades
        added = self._added * np.where(np.arange(len(step)) < 3 * r, belief.shaken, 1.0)
        covariance = step @ belief.covariance @ step.T + np.diag(added)
        known = slice(3 * r, 3 * r + len(self._prior))
        much = np.sqrt(np.maximum(np.diag(covariance)[known] / self._prior**2, 1.0))
        covariance[known] /= much[:, None]
        covariance[:, known] /= much
        return replace(belief, state=state, bias=fades * belief.bias, covariance=covariance)

    def _renewed(self, belief: Belief, after: RobotState) -> Belief:
        """Renews a column of the transition from a step of which the last two environments began with its changes."""
        column = self.tangent.slopes(after.select([self._count, self._count + 1]), [belief.turn])[:, 0]
        before, transition, r = belief.transition[:, belief.turn], belief.transition.copy(), len(belief.bias)
        transition[:, belief.turn] = column
        changed = np.abs(column - before)[:r].max() > _CHANGED * np.abs(before)[:r].max()
        pause = 1 if changed else min(2 * belief.pause, _LONGEST_PAUSE)
        turn = (belief.turn + 1) % (3 * r)
        return replace(belief, transition=transition, turn=turn, pause=pause, wait=pause - 1)

    # Markers

    def _seen(self, belief: Belief, ago: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Markers (M, 3) some time ago [m], their derivatives (M, 3, n), and those (M, 3) without a twin."""
        state, tangent = belief.state, self.tangent
        q = state.q - ago * state.v
        amount = _SEEN_STEP * self.size / tangent.shapes.norm(dim=2).amax(1)
        both = torch.cat([q, q[:1] + amount[:, None, None] * tangent.shapes])
        seen = self.robot.observe(RobotState(State(both, torch.zeros_like(both)))).cpu().double().numpy()
        now, beside, free, moved = seen[0], seen[1 : self._count - 1], seen[self._count - 1], seen[self._count :]
        by_z = np.moveaxis((moved - now) / amount.cpu().double().numpy()[:, None, None], 0, 2)
        by_values = np.moveaxis((beside - now) / self._apart[:, None, None], 0, 2)
        parts = [by_z, -ago * by_z, np.zeros_like(by_z), by_values]
        if self.labels:
            parts.append(np.eye(belief.places.size).reshape(-1, 3, belief.places.size))
            now = now + belief.places
        return now, np.concatenate(parts, axis=2), free

    def markers(self, belief: Belief, ago: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Returns markers (M, 3) some time ago, and the standard deviations of their coordinates [m]."""
        now, slopes, _ = self._seen(belief, ago)
        spread = np.einsum("min,nk,mik->mi", slopes, belief.covariance, slopes, optimize=True)
        return now, np.sqrt(np.maximum(spread, 0.0))

    def correct(self, belief: Belief, markers: FloatArray, ago: float, passed: float) -> tuple[Belief, Correction]:
        """Conditions a belief on a frame.

        Args:
            belief: after the step in which the frame was taken.
            markers: (M, 3) observed [m]; NaN where one is not seen.
            ago: time from the frame to the end of the step [s].
            passed: time since the last frame [s].
        """
        now, slopes, free = self._seen(belief, ago)
        seen, residual = np.asarray(np.isfinite(markers).all(axis=1)), markers - now
        jump = np.linalg.norm(residual - belief.left, axis=1)  # NaN for markers that were never believed: these are.
        away = np.full(len(seen), np.nan)
        away[seen] = distances(belief.covariance, slopes[seen], residual[seen], self.noise.markers)
        refused, stays, since = self._gate.judged(away, jump, belief.since, passed)
        off, apart = (np.linalg.norm(markers - points, axis=1) for points in (now, free))
        moved, restarted = np.zeros_like(refused), bool(seen.sum() > 1 and refused.sum() > 0.5 * seen.sum())
        if restarted or stays.any():
            lost = self._lost(belief)
            change, _ = self._conditioned(lost, slopes[seen], residual[seen])
            explained = np.linalg.norm(residual - slopes @ change, axis=1) < _EXPLAINED * off
            restarted = restarted or bool(explained[refused].mean() > 0.5)
            if restarted:
                belief, refused, since = lost, moved, np.zeros_like(since)
            elif self.labels:
                moved, refused = stays, refused & ~stays
                more = np.zeros(len(belief.covariance))
                more[-belief.places.size :] = np.repeat(np.where(moved, off, 0.0) ** 2, 3)
                belief = replace(belief, covariance=belief.covariance + np.diag(more))
                since = np.where(moved, 0.0, since)
        squares, worse = self._compared(belief.squares, off, apart, passed)
        correction = Correction(seen, refused, moved, restarted, off, apart, worse)
        belief = replace(belief, since=since, squares=squares, shaken=_shaken(belief.shaken, away))
        if worse:
            return self.without_markers(belief), correction
        use = seen & ~refused
        if not use.any():
            return belief, correction
        change, covariance = self._conditioned(belief, slopes[use], residual[use])
        left = np.where(use[:, None], residual - slopes @ change, belief.left)
        return self._changed(replace(belief, covariance=covariance, left=left), change), correction

    def _compared(
        self, squares: FloatArray, off: FloatArray, apart: FloatArray, passed: float
    ) -> tuple[FloatArray, bool]:
        """Returns `Belief.squares` after a frame, and whether the simulator without markers is much better."""
        seen = np.isfinite(off)
        if not seen.any():
            return squares, False
        now = np.array([np.mean(x[seen] ** 2) for x in (off, apart)])
        squares = now + np.exp(-passed / _TRIED) * (squares - now)
        own, other = squares
        return squares, bool(own > _WORSE**2 * (other + 3.0 * self.noise.markers**2))

    def _conditioned(self, belief: Belief, slopes: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """`kalman.conditioned` for markers, with more noise where the shape would change by too much at once."""
        deviation, rows = self.noise.markers, slopes.reshape(-1, slopes.shape[2])
        for _ in range(_DOUBLINGS):
            change, covariance = conditioned(belief.covariance, rows, residual.ravel(), deviation)
            if self._furthest(belief, change) <= _LARGEST * self.size:  # The vibrations hold for small motions.
                return change, covariance
            deviation *= 2.0
        return np.zeros(len(belief.covariance)), belief.covariance

    def without_markers(self, belief: Belief) -> Belief:
        """Returns a belief in the state of the simulator that sees no markers, with its errors, and without a force."""
        state = belief.state.select([self._count - 1] * self._count)
        covariance = self._with_block(belief.covariance, slice(3 * len(belief.bias)), self._simulated)
        markers = slice(len(covariance) - belief.places.size, None)
        return replace(
            belief,
            state=state,
            bias=np.zeros_like(belief.bias),
            places=np.zeros_like(belief.places),
            covariance=self._with_block(covariance, markers, self._placed),
            since=np.zeros_like(belief.since),
            left=np.full_like(belief.left, np.nan),
            squares=np.zeros(2),
        )

    def _lost(self, belief: Belief) -> Belief:
        """A belief with a state that may be far off."""
        covariance = self._with_block(belief.covariance, slice(3 * len(belief.bias)), self._unknown)
        return replace(belief, covariance=covariance)

    @staticmethod
    def _with_block(covariance: FloatArray, rows: slice, variances: FloatArray) -> FloatArray:
        """A covariance with independent errors of some variances in some rows."""
        covariance = covariance.copy()
        covariance[rows] = covariance[:, rows] = 0.0
        covariance[rows, rows] = np.diag(variances)
        return covariance

    def _changed(self, belief: Belief, change: FloatArray) -> Belief:
        """Adds a change (n,) of the errors to a belief."""
        r, count, tangent = len(belief.bias), len(self._refined), self.tangent
        z, w, b, values, places = np.split(change, np.cumsum([r, r, r, count]))
        after = np.clip(belief.parameters + values, *self._range())
        values = after - belief.parameters
        state = belief.state
        if count:
            share = state.q.new_tensor(values / self._apart)
            state = state.map(lambda value, axis: _along(value, axis, share))
        own = state.q.new_ones(self._count, 1, 1)
        own[-1] = 0.0
        shapes = (torch.einsum("r,rni->ni", state.q.new_tensor(x), tangent.shapes) for x in (z, w))
        moved, faster = (own * field for field in shapes)
        return replace(
            belief,
            state=shifted(self._at(after, {})[0], state, moved, faster),
            parameters=after,
            bias=belief.bias + b,
            places=belief.places + places.reshape(-1, 3),
        )

    def _furthest(self, belief: Belief, change: FloatArray) -> float:
        """Largest displacement of a vertex by a change (n,) of the errors [m]."""
        r, count, q = len(belief.bias), len(self._refined), belief.state.q
        moved = torch.einsum("r,rni->ni", q.new_tensor(change[:r]), self.tangent.shapes)
        share = q.new_tensor(change[3 * r : 3 * r + count] / self._apart)
        moved = moved + torch.einsum("p,pni->ni", share, q[1:-1] - q[:1])
        return float(moved.norm(dim=1).max())

    def _range(self) -> tuple[FloatArray, FloatArray]:
        """Least and greatest values (P,) of the refined parameters."""
        known = {**self.robot.simulator.parameters, PAYLOAD.name: PAYLOAD}
        quantities = [known.get(name, Quantity(name, "")) for name in self._refined]
        far = _OPEN * np.maximum(np.abs(self._first), self._prior)
        low, high = (np.array([getattr(one, end) for one in quantities]) for end in ("lower", "upper"))
        return low + far, high - far - self._apart

    def refined(self, belief: Belief) -> dict[str, tuple[float, float]]:
        """Refined values and their standard deviations, by name."""
        first = 3 * len(belief.bias)
        spread = np.sqrt(np.diag(belief.covariance)[first : first + len(self._refined)])
        return {
            name: (float(value), float(deviation))
            for name, value, deviation in zip(self._refined, belief.parameters, spread, strict=True)
        }


def _at_rest(robot: Steppable, batch: int, inputs: Mapping[str, Given]) -> RobotState:
    """The equilibrium under constant commands, without the learned force where there is none with it."""
    try:
        return robot.settle(batch, **inputs)
    except ConvergenceError:
        return robot.begin(batch, **inputs)


def _shaken(before: float, away: FloatArray) -> float:
    """Adapts `Belief.shaken` to a frame with markers (M,) at some distances from where they were expected, or NaN."""
    if np.isnan(away).all():
        return before
    far = float(np.nanmedian(away)) ** 2 / _MEDIAN
    return float(np.clip(before * np.clip(far, *_FURTHER) ** _ADAPTED, *_SHAKEN))


def _along(value: torch.Tensor, axis: int, share: torch.Tensor) -> torch.Tensor:
    """Moves a tensor of the state along those that run beside, by shares (P,) of the differences; the last stays."""
    if not value.is_floating_point():
        return value
    rows = value.movedim(axis, 0)
    step = torch.tensordot(share.to(value), rows[1 : 1 + len(share)] - rows[:1], dims=1)
    return torch.cat([rows[:-1] + step, rows[-1:]]).movedim(0, axis)
