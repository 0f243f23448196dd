"""Controllers: receding horizon (a new plan at every step),
with the state from markers, and Jacobian feedback.

The state is estimated by an extended Kalman filter on a reduced model. It is (z, z', b):
coordinates, their rates, and the offset b of the real robot's equilibria from the model's, a random
walk. Estimating b removes the steady-state error of a receding horizon, whatever constant error the
model has (offset-free control: Pannocchia and Rawlings, AIChE J. 49 (2003) 426).
"""

from collections.abc import Callable

import numpy as np
import scipy.linalg

from ..io.arrays import FloatArray
from ..settings.control import LimitsOfInputs
from .linear_model import DELAYS, LinearModel
from .plan import Planner
from .polynomials import Monomials
from .reduced_model import ReducedModel

_SETTLES = 0.1  # gain per step of the disturbance observer of the linear model
_AVERAGED = 0.25  # window of the means of points and inputs, which averages vibrations out [s]
_LEARNING = 0.05  # share of Broyden's correction taken per step
# Regularises Broyden's correction: squared change of the inputs, as shares of their ranges.
_LITTLE = 1e-3
_DAMPING = 0.05  # of the inverse of the Jacobian, relative to its largest singular value

# Inputs (n,) of a step, from markers (M, 3) before it [m].
Controller = Callable[[int, FloatArray], FloatArray]
# Unmodelled change of the rates in a step, relative to their spread in a swing of one millimetre.
_RATE = 0.3
_BIAS = 5e-3  # drift of the bias in a second, as a displacement of the markers [m]
_JITTER = 1e-12  # of a correlation matrix, which is singular where a quantity is known exactly


class Estimator:
    """Estimates the state of a robot from its markers.

    Args:
        model: of the robot.
        inputs: (n,) under which the robot rests at first.
        offset: (3 M,) of its markers from those of the model, at rest [m]; zero if omitted.
        noise: standard deviation of a coordinate of a marker [m].
    """

    def __init__(
        self,
        model: ReducedModel,
        inputs: FloatArray,
        offset: FloatArray | None = None,
        noise: float = 1e-4,
    ) -> None:
        self.model, self._noise = model, noise
        self.state = model.rest(inputs)
        r = model.modes
        self.bias = np.zeros(r)
        self.offset = np.zeros(model.curved.shape[2]) if offset is None else offset
        u = Monomials(self.state.acting)
        seen = model.point_slopes(self.state.z, u)[0]
        # Mean displacement of the markers per unit of each coordinate [m].
        size = np.linalg.norm(seen, axis=0) / np.sqrt(len(self.offset) / 3.0)
        one = 1e-3 / size
        stiffness = np.abs(np.diag(model.stiffness(u)[0]))
        self._wander = np.concatenate(
            [
                np.zeros(r),
                (_RATE * one * np.sqrt(stiffness)) ** 2,
                (_BIAS / size) ** 2 * model.time_step,
            ]
        )
        self._covariance = np.diag(
            np.concatenate([one**2, (one * np.sqrt(stiffness)) ** 2, (2.0 * one) ** 2])
        )

    def predict(self, inputs: FloatArray) -> None:
        """Advances the estimate by one step under inputs (n,)."""
        transition = np.eye(3 * self.model.modes)
        self.state, transition[: 2 * self.model.modes] = self.model.transition(
            self.state, inputs, self.bias[None]
        )
        self._covariance = transition @ self._covariance @ transition.T + np.diag(self._wander)

    def correct(self, markers: FloatArray) -> None:
        """Updates the estimate with markers (M, 3) observed after the step [m].

        NaN where one is not seen.
        """
        model, r = self.model, self.model.modes
        seen = np.isfinite(markers).ravel()
        if not seen.any():
            return
        slopes = np.zeros((int(seen.sum()), 3 * r))
        slopes[:, :r] = model.point_slopes(self.state.z, Monomials(self.state.acting))[0, seen]
        expected = (model.observe(self.state)[0] + self.offset)[seen]
        residual = markers.ravel()[seen] - expected
        change, self._covariance = conditioned(self._covariance, slopes, residual, self._noise)
        self.state = self.state.moved(change[None, :r], change[None, r : 2 * r], model.time_step)
        self.bias = self.bias + change[2 * r :]


def conditioned(
    covariance: FloatArray, slopes: FloatArray, residual: FloatArray, deviation: float
) -> tuple[FloatArray, FloatArray]:
    """Conditions n jointly normal errors on m observations with independent noise.

    In the square-root form of Bierman (1977), which stays positive definite, and costs n^3 however
    many observations.

    Args:
        covariance: (n, n).
        slopes: (m, n) of the observations.
        residual: (m,) observed minus expected.
        deviation: standard deviation of the noise.

    Returns:
        The change of the mean (n,), and the covariance (n, n) after it.
    """
    size = np.sqrt(np.diag(covariance))
    size = np.where(size > 0.0, size, 1.0)
    scaled = covariance / size / size[:, None]
    root = size[:, None] * np.linalg.cholesky(scaled + _JITTER * np.eye(len(size)))
    seen = (slopes @ root).T / deviation
    gained = scipy.linalg.solve(np.eye(len(size)) + seen @ seen.T, root.T, assume_a="pos").T
    after = gained @ root.T
    return gained @ (seen @ residual) / deviation, 0.5 * (after + after.T)


class RecedingHorizon:
    """Plans at every step with a reduced model, from an estimate of its state.

    Args:
        planner: along the path, on the model.
        model: of the robot.
        rest: (M, 3) markers of the robot at rest without inputs [m].
    """

    def __init__(self, planner: Planner, model: ReducedModel, rest: FloatArray) -> None:
        offset = rest.ravel() - model.observe(model.rest())[0]
        self._planner = planner
        self._estimator = Estimator(
            model, np.zeros(model.parts), np.where(np.isfinite(offset), offset, 0.0)
        )
        self._offset = planner.tracked @ self._estimator.offset

    def __call__(self, number: int, markers: FloatArray) -> FloatArray:
        """Returns the inputs (n,) of a step, from markers (M, 3) before it [m],
        NaN where one is not seen.
        """
        estimate = self._estimator
        if number:
            estimate.correct(markers)
        command: FloatArray = self._planner.plan(
            number, estimate.state, estimate.bias, self._offset
        )[0]
        estimate.predict(command)
        return command


class LinearRecedingHorizon:
    """Plans with a linear model, from the last markers.

    A disturbance observer removes its constant error.

    Args:
        planner: along the path, on the model.
        model: fitted to the recordings.
        rest: as for `RecedingHorizon`.
    """

    def __init__(self, planner: Planner, model: LinearModel, rest: FloatArray) -> None:
        self._planner, self._model = planner, model
        self.seen = np.tile(
            np.where(np.isfinite(rest), rest, model.rest.reshape(-1, 3)).ravel(), (DELAYS, 1)
        )
        self.expected = self.seen[0]
        self.missed = np.zeros_like(self.expected)

    def __call__(self, number: int, markers: FloatArray) -> FloatArray:
        """Returns the inputs (n,) of a step, from markers (M, 3) before it [m],
        NaN where one is not seen.
        """
        if number:
            now = np.where(np.isfinite(markers.ravel()), markers.ravel(), self.expected)
            self.missed = self.missed + _SETTLES * (now - self.expected - self.missed)
            self.seen = np.concatenate([now[None], self.seen[:-1]])
        state = self._model.state(list(self.seen))
        command: FloatArray = self._planner.plan(
            number, state, offset=self._planner.tracked @ self.missed
        )[0]
        self.expected = self._model.respond(state, command[None, None])[0, 0]
        return command


class JacobianFeedback:
    """Feeds the error back through a measured Jacobian,
    which Broyden's rule updates while the robot moves.

    The rule is applied to means over a time window, because the body vibrates.

    Args:
        jacobian: (d, n) of the points with respect to the inputs, measured [m per unit].
        limits: of each input.
        gain: of the error [1/s].
        time_step: h [s].
        tracked: (d, 3 M) from the markers to the coordinates that follow the path.
        path: (T, d) reference after each step [m].
        rest: (M, 3) markers at the beginning [m].
    """

    def __init__(
        self,
        jacobian: FloatArray,
        limits: LimitsOfInputs,
        gain: float,
        time_step: float,
        tracked: FloatArray,
        path: FloatArray,
        rest: FloatArray,
    ) -> None:
        self.jacobian = jacobian * limits.range
        self._limits = limits
        self._gain, self._step = gain, time_step
        self._tracked, self._path = tracked, path
        self.last_seen = rest.ravel()
        self.shares = np.zeros(jacobian.shape[1])
        self._damping = _DAMPING * float(np.linalg.norm(self.jacobian, 2))
        self._window = max(round(_AVERAGED / time_step), 1)
        self.past = np.zeros((0, sum(jacobian.shape)))  # points and inputs as shares, latest last

    def __call__(self, number: int, markers: FloatArray) -> FloatArray:
        """Returns the inputs (n,) of a step, from markers (M, 3) before it [m],
        NaN where one is not seen.
        """
        self.last_seen = np.where(np.isfinite(markers.ravel()), markers.ravel(), self.last_seen)
        point = self._tracked @ self.last_seen
        goal = self._path[max(number - 1, 0)]
        next_goal = self._path[number]
        u, h = self.shares, self._step
        d = len(point)
        self.past = np.concatenate([self.past, [np.concatenate([point, u])]])[-2 * self._window :]
        if len(self.past) == 2 * self._window:
            before, now = (window.mean(0) for window in np.split(self.past, 2))
            moved, changed = (now - before)[:d], (now - before)[d:]
            missed = moved - self.jacobian @ changed
            self.jacobian = self.jacobian + _LEARNING / (changed @ changed + _LITTLE) * np.outer(
                missed, changed
            )
        wanted = next_goal - goal + self._gain * h * (goal - point)
        j = self.jacobian
        inverse = j.T @ np.linalg.inv(j @ j.T + self._damping**2 * np.eye(d))
        change = inverse @ wanted
        # In the null space of the Jacobian, the inputs move towards their mean, away from their
        # bounds.
        change = change - 0.5 * h * (np.eye(len(u)) - inverse @ j) @ (u - u.mean())
        most = self._limits.rate * h / self._limits.range
        self.shares = np.clip(u + np.clip(change, -most, most), 0.0, 1.0)
        return np.asarray(self._limits.low + self._limits.range * self.shares)
