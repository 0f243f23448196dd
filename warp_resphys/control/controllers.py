"""Controllers: receding horizon (a new plan at every step), and Jacobian feedback."""

from collections.abc import Callable

import numpy as np

from ..io.arrays import FloatArray
from ..settings.control import LimitsOfInputs
from .baselines import DELAYS, LinearModel
from .estimate import Estimator
from .plan import Planner
from .reduced import ReducedModel

_SETTLES = 0.1  # gain per step of the disturbance observer of the linear model
_AVERAGED = 0.25  # window of the means of points and inputs, which averages vibrations out [s]
_LEARNING = 0.05  # share of Broyden's correction taken per step
_LITTLE = 1e-3  # regularises Broyden's correction: squared change of the inputs, as shares of their ranges
_DAMPING = 0.05  # of the inverse of the Jacobian, relative to its largest singular value


Controller = Callable[[int, FloatArray], FloatArray]  # inputs (n,) of a step, from markers (M, 3) before it [m]


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
        self._estimator = Estimator(model, np.zeros(model.parts), np.where(np.isfinite(offset), offset, 0.0))
        self._offset = planner.tracked @ self._estimator.offset

    def __call__(self, number: int, markers: FloatArray) -> FloatArray:
        """Returns the inputs (n,) of a step, from markers (M, 3) before it [m], NaN where one is not seen."""
        estimate = self._estimator
        if number:
            estimate.correct(markers)
        command: FloatArray = self._planner.plan(number, estimate.state, estimate.bias, self._offset)[0]
        estimate.predict(command)
        return command


class LinearRecedingHorizon:
    """Plans with a linear model, from the last markers; a disturbance observer removes its constant error.

    Args:
        planner: along the path, on the model.
        model: fitted to the recordings.
        rest: as for `RecedingHorizon`.
    """

    def __init__(self, planner: Planner, model: LinearModel, rest: FloatArray) -> None:
        self._planner, self._model = planner, model
        self.seen = np.tile(np.where(np.isfinite(rest), rest, model.rest.reshape(-1, 3)).ravel(), (DELAYS, 1))
        self.expected = self.seen[0]
        self.missed = np.zeros_like(self.expected)

    def __call__(self, number: int, markers: FloatArray) -> FloatArray:
        """Returns the inputs (n,) of a step, from markers (M, 3) before it [m], NaN where one is not seen."""
        if number:
            now = np.where(np.isfinite(markers.ravel()), markers.ravel(), self.expected)
            self.missed = self.missed + _SETTLES * (now - self.expected - self.missed)
            self.seen = np.concatenate([now[None], self.seen[:-1]])
        state = self._model.state(list(self.seen))
        command: FloatArray = self._planner.plan(number, state, offset=self._planner.tracked @ self.missed)[0]
        self.expected = self._model.respond(state, command[None, None])[0, 0]
        return command


class JacobianFeedback:
    """Feeds the error back through a measured Jacobian, which Broyden's rule updates while the robot moves.

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
        self.jacobian, self._limits, self._gain, self._step = jacobian * limits.range, limits, gain, time_step
        self._tracked, self._path, self.last_seen = tracked, path, rest.ravel()
        self.shares = np.zeros(jacobian.shape[1])
        self._damping = _DAMPING * float(np.linalg.norm(self.jacobian, 2))
        self._window = max(round(_AVERAGED / time_step), 1)
        self.past = np.zeros((0, sum(jacobian.shape)))  # points and inputs as shares, latest last

    def __call__(self, number: int, markers: FloatArray) -> FloatArray:
        """Returns the inputs (n,) of a step, from markers (M, 3) before it [m], NaN where one is not seen."""
        self.last_seen = np.where(np.isfinite(markers.ravel()), markers.ravel(), self.last_seen)
        point, goal, next_goal = self._tracked @ self.last_seen, self._path[max(number - 1, 0)], self._path[number]
        u, h, d = self.shares, self._step, len(point)
        self.past = np.concatenate([self.past, [np.concatenate([point, u])]])[-2 * self._window :]
        if len(self.past) == 2 * self._window:
            before, now = (window.mean(0) for window in np.split(self.past, 2))
            moved, changed = (now - before)[:d], (now - before)[d:]
            missed = moved - self.jacobian @ changed
            self.jacobian = self.jacobian + _LEARNING / (changed @ changed + _LITTLE) * np.outer(missed, changed)
        wanted = next_goal - goal + self._gain * h * (goal - point)
        j = self.jacobian
        inverse = j.T @ np.linalg.inv(j @ j.T + self._damping**2 * np.eye(d))
        change = inverse @ wanted
        # In the null space of the Jacobian, the inputs move towards their mean, away from their bounds.
        change = change - 0.5 * h * (np.eye(len(u)) - inverse @ j) @ (u - u.mean())
        most = self._limits.rate * h / self._limits.range
        self.shares = np.clip(u + np.clip(change, -most, most), 0.0, 1.0)
        return np.asarray(self._limits.low + self._limits.range * self.shares)
