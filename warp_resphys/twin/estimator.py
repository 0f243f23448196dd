r"""The state of a robot, estimated from its markers:
what the estimators of the full and the reduced simulator share.

The simulator carries the mean. The error of the mean is

    q - q^ = Phi z + S theta~,   v - v^ = Phi w + S' theta~,

with r shapes Phi, and the derivatives S and S' of the motion by the refined parameters theta. A
force on the body, which fades, shifts its equilibrium by b; and the markers sit o away from where
they are bound. The covariance is that of (z, w, b, theta, o): an extended Kalman filter of reduced
rank (Pham, Verron and Roubaud, J. Mar. Syst. 16 (1998) 323).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Final, Generic, TypeVar

import numpy as np
import scipy.special

from ..control.controllers import conditioned
from ..core.stepping.state import State
from ..io.arrays import BoolArray, FloatArray
from ..io.errors import InputError
from ..robot.actuation import Given
from ..robot.robot import Robot
from .belief import Belief, Correction

# Errors over the size of the body: of a first shape, which may be anything, and so the most that
# one frame corrects; and of a simulator whose errors are not known, so that a marker further off
# has jumped or the body is elsewhere.
_UNKNOWN, _SIMULATOR = 0.1, 0.02
_WANDER = 1.0  # after which the force on the body, such as a touch, is another [s]
# Over which it is judged whether markers stay away or the simulator without markers is better,
# which is longer than a period of most soft bodies [s].
_JUDGED = 0.2
# After which a refined parameter, such as a stiffness that depends on the temperature, is another
# [s].
_FORGET = 10.0
_WORSE: Final = (
    1.5  # errors over those of the simulator without markers, above which this takes over
)
# Distance of a marker that has jumped, in deviations; fewer would refuse true errors of the model.
_GATE: Final = 6.0
_EXPLAINED: Final = (
    0.3  # of the distance of markers that jumped, what a motion of the whole body may leave
)
_PLACED: Final = (
    1e-3  # deviation of markers on the body from where they are bound, as measured with a ruler [m]
)
# Of chi-squared with three degrees of freedom.
_MEDIAN: Final = 2.0 * scipy.special.gammaincinv(1.5, 0.5)
_ADAPTED: Final = (
    0.2  # power of a frame's share in the variance of steps, so that about five frames count
)
# Range of the factor of that variance: never zero, as no simulator is exact.
_SHAKEN: Final = (0.03, 1000.0)
_DOUBLINGS: Final = 40  # of the noise of a frame, after which a correction is nothing


B = TypeVar("B", bound=Belief)


class TwinEstimator(ABC, Generic[B]):
    """Estimates the state of a robot from its markers.

    Args:
        robot: with a simulator.
        inputs: constant commands under which it rests at first.
        prior: standard deviations of the refined parameters, by name.
        frequencies: (r,) of the shapes [rad/s].
        reach: root mean square displacement of the body per unit of a coordinate [m].
        noise: standard deviation of a coordinate of a marker [m].

    Raises:
        InputError: a noise that is not positive.

    Attributes:
        count: number M of markers.
        size: of the body [m].
        engine: name of its kind of simulator.
    """

    engine: ClassVar[str] = "simulator"

    def __init__(
        self,
        robot: Robot,
        inputs: Mapping[str, Given],
        prior: Mapping[str, float],
        frequencies: FloatArray,
        reach: float,
        noise: float,
    ) -> None:
        if not noise > 0.0:
            raise InputError(
                f"noise is {noise:g}: give the deviation "
                "of a marker's coordinate in m, more than zero."
            )
        self.robot, self.inputs = robot, dict(inputs)
        self.labels, self.time_step = robot.labels, robot.time_step
        self.noise, self._names = noise, tuple(prior)
        self._prior = np.array([*prior.values()], dtype=np.float64)
        rest = robot.simulator.rest_positions
        self.size = float((rest.amax(0) - rest.amin(0)).max())
        self.count = len(robot.labels) or len(rest)
        self._set_noise(frequencies, reach)

    def _set_noise(self, frequencies: FloatArray, reach: float) -> None:
        """Covariance at the start, and what a step adds to it.

        A force that is as large in all modes bends the body less in the faster ones, by the square
        of their frequency.
        """
        h, known = self.time_step, self.robot.description.errors_mm
        error = (
            _SIMULATOR * self.size
            if known is None or known["mean"] is None
            else 1e-3 * known["mean"]
        )
        less = (frequencies.min() / frequencies) ** 2
        shape, force = _UNKNOWN * self.size / reach * less, error / reach * less
        shaken = force * frequencies * np.sqrt(frequencies.min() * h / (2.0 * np.pi))
        self._modes, places = len(frequencies), np.full(3 * len(self.labels), _PLACED)
        self._unknown = np.concatenate([shape, shape * frequencies, force]) ** 2
        self._simulated = np.concatenate([force, force * frequencies, force]) ** 2
        self._placed = places**2
        self._initial = np.concatenate([self._unknown, self._prior**2, self._placed])
        self._added = np.concatenate(
            [
                np.zeros(len(shape)),
                shaken**2,
                force**2 * -np.expm1(-2.0 * h / _WANDER),
                self._prior**2 * h / _FORGET,
                np.zeros(len(places)),
            ]
        )

    @abstractmethod
    def begin(self, inputs: Mapping[str, Given], refined: FloatArray | None = None) -> B:
        """Returns the first belief: a robot at rest under constant commands, with large deviations.

        Args:
            inputs: commands by name.
            refined: (P,) values of the refined parameters; those of the robot if omitted.

        Raises:
            InputError: an invalid command.
            ConvergenceError: there is no equilibrium.
        """

    @abstractmethod
    def advance(self, belief: B, inputs: Mapping[str, Given], renew: bool = True) -> B:
        """Simulates a step under commands.

        Args:
            belief: before it.
            inputs: commands by name.
            renew: whether derivatives that are not exact may be computed again in this step.

        Raises:
            InputError: an invalid command.
            ConvergenceError: the step failed.
        """

    def faults(self, inputs: Mapping[str, Given]) -> list[str]:
        """Returns what is wrong with commands by name that are simulated all the same.

        Raises:
            InputError: commands that cannot be simulated.
        """
        return []

    @abstractmethod
    def robot_state(self, belief: B) -> State:
        """Returns the estimated state of the robot, one environment."""

    @abstractmethod
    def _seen(self, belief: B, ago: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Markers (M, 3) some time ago [m], their derivatives (M, 3, n),
        and those (M, 3) without a twin.
        """

    @abstractmethod
    def _moved(self, belief: B, z: FloatArray, w: FloatArray, parameters: FloatArray) -> B:
        """A belief with changes (r,) of coordinates and rates,
        and parameters (P,), in its state.
        """

    @abstractmethod
    def _furthest(self, belief: B, z: FloatArray, parameters: FloatArray) -> float:
        """Largest displacement of a vertex by changes (r,) of the coordinates
        and (P,) of the parameters [m].
        """

    @abstractmethod
    def _free(self, belief: B) -> B:
        """A belief in the state of the simulator without markers."""

    def _within(self, parameters: FloatArray) -> FloatArray:
        """Parameters (P,) within their ranges."""
        return parameters

    def _first(self, parameters: FloatArray) -> Belief:
        """The first belief, without a state."""
        return Belief(
            parameters=parameters,
            bias=np.zeros(self._modes),
            places=np.zeros((len(self.labels), 3)),
            covariance=np.diag(self._initial),
            since=np.zeros(self.count),
            left=np.full((self.count, 3), np.nan),
            squares=np.zeros(2),
        )

    def _propagated(self, belief: B, transition: FloatArray) -> B:
        """Bias and covariance after a step with a transition (2 r, 3 r)
        of the errors (z, w) by (z, w, b).
        """
        r = self._modes
        step = np.eye(len(belief.covariance))
        step[: 2 * r, : 3 * r] = transition
        fades = float(np.exp(-self.time_step / _WANDER))
        step[2 * r : 3 * r] *= fades
        added = self._added * np.where(np.arange(len(step)) < 3 * r, belief.shaken, 1.0)
        covariance = step @ belief.covariance @ step.T + np.diag(added)
        known = slice(3 * r, 3 * r + len(self._prior))
        much = np.sqrt(np.maximum(np.diag(covariance)[known] / self._prior**2, 1.0))
        covariance[known] /= much[:, None]
        covariance[:, known] /= much
        return replace(belief, bias=fades * belief.bias, covariance=covariance)

    def markers(self, belief: B) -> tuple[FloatArray, FloatArray]:
        """Returns markers (M, 3), and the standard deviations of their coordinates [m]."""
        now, slopes = self._seen(belief, 0.0)[:2]
        spread = np.einsum("min,nk,mik->mi", slopes, belief.covariance, slopes, optimize=True)
        return now, np.sqrt(np.maximum(spread, 0.0))

    def correct(
        self, belief: B, markers: FloatArray, ago: float, passed: float
    ) -> tuple[B, Correction]:
        """Conditions a belief on a frame.

        Args:
            belief: after the step in which the frame was taken.
            markers: (M, 3) observed [m]; NaN where one is not seen.
            ago: time from the frame to the end of the step [s].
            passed: time since the last frame [s].
        """
        now, slopes, free = self._seen(belief, ago)
        seen, residual = np.asarray(np.isfinite(markers).all(axis=1)), markers - now
        # NaN for markers that were never believed: these are.
        jump = np.linalg.norm(residual - belief.left, axis=1)
        away = np.full(len(seen), np.nan)
        away[seen] = distances(belief.covariance, slopes[seen], residual[seen], self.noise)
        refused, stays, since = self._judged(away, jump, belief.since, passed)
        off, apart = (np.linalg.norm(markers - points, axis=1) for points in (now, free))
        moved = np.zeros_like(refused)
        restarted = bool(seen.sum() > 1 and refused.sum() > 0.5 * seen.sum())
        if restarted or stays.any():
            lost = self._lost(belief)
            change, _ = self._conditioned(lost, slopes[seen], residual[seen])
            explained = np.linalg.norm(residual - slopes @ change, axis=1) < _EXPLAINED * off
            restarted = restarted or bool(explained[refused].mean() > 0.5)
            if restarted:
                belief, refused = lost, moved
                since = np.zeros_like(since)
            elif self.labels:
                moved, refused = stays, refused & ~stays
                more = np.zeros(len(belief.covariance))
                more[-belief.places.size :] = np.repeat(np.where(moved, off, 0.0) ** 2, 3)
                belief = replace(belief, covariance=belief.covariance + np.diag(more))
                since = np.where(moved, 0.0, since)
        squares, worse = self._compared(belief.squares, off, apart, passed)
        correction = Correction(seen, refused, moved, restarted, off, markers - free, worse)
        belief = replace(belief, since=since, squares=squares, shaken=adapted(belief.shaken, away))
        if worse:
            return self.without_markers(belief), correction
        use = seen & ~refused
        if not use.any():
            return belief, correction
        change, covariance = self._conditioned(belief, slopes[use], residual[use])
        left = np.where(use[:, None], residual - slopes @ change, belief.left)
        return self._changed(replace(belief, covariance=covariance, left=left), change), correction

    def _judged(
        self, away: FloatArray, jump: FloatArray, since: FloatArray, passed: float
    ) -> tuple[BoolArray, BoolArray, FloatArray]:
        """Returns which markers (M,) are left out, which of these have stayed away,
        and the new `Belief.since`.

        Args:
            away: (M,) `distances`, NaN where a marker is not seen.
            jump: (M,) how far it has jumped beside what was expected, since it was last believed
                [m].
            since: (M,) how long each has been left out [s].
            passed: time since the last frame [s].
        """
        out = (away > _GATE) & (jump > _SIMULATOR * self.size)
        later = np.where(out, since + passed, np.where(np.isnan(away), since, 0.0))
        return out, out & (since > 0.0) & (later >= _JUDGED), later

    def _compared(
        self, squares: FloatArray, off: FloatArray, apart: FloatArray, passed: float
    ) -> tuple[FloatArray, bool]:
        """Returns `Belief.squares` after a frame, and whether the simulator
        without markers is much better.
        """
        seen = np.isfinite(off)
        if not seen.any():
            return squares, False
        now = np.array([np.mean(x[seen] ** 2) for x in (off, apart)])
        squares = now + np.exp(-passed / _JUDGED) * (squares - now)
        twin, simulator = squares
        return squares, bool(twin > _WORSE**2 * (simulator + 3.0 * self.noise**2))

    def _conditioned(
        self, belief: B, slopes: FloatArray, residual: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """`conditioned` for markers, with more noise
        where the shape would change by too much at once.
        """
        deviation, rows = self.noise, slopes.reshape(-1, slopes.shape[2])
        for _ in range(_DOUBLINGS):
            change, covariance = conditioned(belief.covariance, rows, residual.ravel(), deviation)
            if self._furthest(belief, *self._parts(change)[::3]) <= _UNKNOWN * self.size:
                # Vibrations are small.
                return change, covariance
            deviation *= 2.0
        return np.zeros(len(belief.covariance)), belief.covariance

    def without_markers(self, belief: B) -> B:
        """Returns a belief in the state of the simulator that sees no markers,
        with its errors, and without a force.
        """
        covariance = self._with_block(belief.covariance, slice(3 * self._modes), self._simulated)
        markers = slice(len(covariance) - belief.places.size, None)
        return replace(
            self._free(belief),
            bias=np.zeros_like(belief.bias),
            places=np.zeros_like(belief.places),
            covariance=self._with_block(covariance, markers, self._placed),
            since=np.zeros_like(belief.since),
            left=np.full_like(belief.left, np.nan),
            squares=np.zeros(2),
        )

    def _lost(self, belief: B) -> B:
        """A belief with a state that may be far off."""
        covariance = self._with_block(belief.covariance, slice(3 * self._modes), self._unknown)
        return replace(belief, covariance=covariance)

    @staticmethod
    def _with_block(covariance: FloatArray, rows: slice, variances: FloatArray) -> FloatArray:
        """A covariance with independent errors of some variances in some rows."""
        covariance = covariance.copy()
        covariance[rows] = covariance[:, rows] = 0.0
        covariance[rows, rows] = np.diag(variances)
        return covariance

    def _changed(self, belief: B, change: FloatArray) -> B:
        """Adds a change (n,) of the errors to a belief."""
        z, w, b, values, places = self._parts(change)
        after = self._within(belief.parameters + values)
        return replace(
            self._moved(belief, z, w, after),
            parameters=after,
            bias=belief.bias + b,
            places=belief.places + places.reshape(-1, 3),
        )

    def _parts(self, change: FloatArray) -> list[FloatArray]:
        """Parts z, w, b, parameters and places of a change (n,) of the errors."""
        r = self._modes
        return np.split(change, np.cumsum([r, r, r, len(self._prior)]))

    def refined(self, belief: B) -> dict[str, tuple[float, float]]:
        """Refined values and their standard deviations, by name."""
        first = 3 * self._modes
        spread = np.sqrt(np.diag(belief.covariance)[first : first + len(self._prior)])
        return {
            name: (float(value), float(deviation))
            for name, value, deviation in zip(self._names, belief.parameters, spread, strict=True)
        }


def adapted(before: float, away: FloatArray) -> float:
    """Adapts `Belief.shaken` to a frame with markers (M,) at some distances
    from where they were expected, or NaN.
    """
    if np.isnan(away).all():
        return before
    far = float(np.nanmedian(away)) ** 2 / _MEDIAN
    return float(np.clip(before * far**_ADAPTED, *_SHAKEN))


def distances(
    covariance: FloatArray, slopes: FloatArray, residual: FloatArray, deviation: float
) -> FloatArray:
    """Distances (M,) of markers from where they are expected, in standard deviations (Mahalanobis).

    Args:
        covariance: (n, n) of the errors.
        slopes: (M, 3, n) of the markers.
        residual: (M, 3) observed minus expected [m].
        deviation: of a coordinate [m].
    """
    spread = slopes @ covariance @ slopes.mT + deviation**2 * np.eye(3)
    return np.sqrt(
        np.einsum("mi,mi->m", residual, np.linalg.solve(spread, residual[..., None])[..., 0])
    )
