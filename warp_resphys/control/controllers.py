"""Controllers: they play a plan, plan anew at every step, or feed back the error by a Jacobian.

A controller has a memory of arrays, from which a run that was interrupted goes on.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from .baselines import DELAYS, LinearModel
from .estimate import Estimator, Noise
from .plan import Limits, Planner, PredictionModel, Weights
from .reduced import ReducedModel

FloatArray = NDArray[np.float64]
Memory = dict[str, FloatArray]

_SETTLES = 0.1  # share by which a linear model's constant error is corrected in a step
_AVERAGED = 0.25  # s, over which the means of points and inputs are compared, without what vibrates
_LEARNING = 0.05  # share of Broyden's correction that is taken in a step
_LITTLE = 1e-3  # of the squared changes of the inputs, as shares of their ranges, that tell little
_DAMPING = 0.05  # of the largest singular value


class Controller(ABC):
    """Commands inputs (n,) at each step, from what cameras saw after the last one.

    Attributes:
        memory_keys: attributes that the next step depends on; None is not kept.
    """

    memory_keys: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def command(self, number: int, markers: FloatArray) -> FloatArray:
        """(n,) inputs for a step, from markers (M, 3) before it [m], NaN where one is not seen."""

    def remembered(self) -> Memory:
        """The arrays that the next step depends on."""
        return {key: value for key in self.memory_keys if (value := getattr(self, key)) is not None}

    def recall(self, memory: Mapping[str, FloatArray]) -> None:
        """Continues from what another controller of the same settings `remembered`."""
        for key in self.memory_keys:
            setattr(self, key, memory.get(key))


class OpenLoop(Controller):
    """Plays a plan (T, n)."""

    def __init__(self, inputs: FloatArray) -> None:
        self._inputs = inputs

    @override
    def command(self, number: int, markers: FloatArray) -> FloatArray:
        return np.asarray(self._inputs[number])


@dataclass(frozen=True)
class Horizon:
    """How far receding plans look.

    Attributes:
        steps: T.
        pieces: of the broken line of the inputs.
        weights: see `plan.Weights`.
        iterations: of Gauss-Newton, at each step.
    """

    steps: int
    pieces: int
    weights: Weights
    iterations: int = 1


class _Receding(Controller):
    """Plans anew at every step, from where the last plan would go on."""

    memory_keys: ClassVar[tuple[str, ...]] = ("last_command", "knots")

    def __init__(
        self, model: PredictionModel, tracked: FloatArray, limits: Limits, horizon: Horizon, path: FloatArray
    ) -> None:
        self._planner = Planner(
            model, tracked, limits, horizon.steps, horizon.pieces, horizon.weights, horizon.iterations
        )
        self._path, self.last_command = path, np.array(limits.low)
        self.knots: FloatArray | None = None

    def _ahead(self, number: int) -> FloatArray:
        """(H, d) of the path from a step on; at its end it stays."""
        return np.asarray(self._path[np.minimum(np.arange(number, number + self._planner.steps), len(self._path) - 1)])

    def _keep(self, inputs: FloatArray, knots: FloatArray) -> FloatArray:
        """Takes the first of the inputs, and moves the knots on by a step."""
        planner = self._planner
        steps, pieces = planner.steps, planner.knots - 1
        line = np.concatenate([knots[:1], inputs])
        at = np.minimum(np.arange(pieces + 1) * steps / pieces + 1.0, steps)
        self.knots = np.stack([np.interp(at, np.arange(steps + 1), column) for column in line.T], axis=1)
        self.last_command = inputs[0]
        return self.last_command


class RecedingHorizon(_Receding):
    """Plans with a reduced model, from an estimate of its state.

    Args:
        model: of the robot.
        tracked: see `Planner`.
        limits: of the inputs.
        horizon: of the plans.
        noise: see `Estimator`.
        path: (T, d) where the points are to be after each step [m].
        rest: (M, 3) markers of the robot as it hangs without inputs [m].
    """

    def __init__(
        self,
        model: ReducedModel,
        tracked: FloatArray,
        limits: Limits,
        horizon: Horizon,
        noise: Noise,
        path: FloatArray,
        rest: FloatArray,
    ) -> None:
        super().__init__(model, tracked, limits, horizon, path)
        offset = rest.ravel() - model.observe(model.rest())[0]
        self._estimator = Estimator(model, noise, np.zeros(model.parts), np.where(np.isfinite(offset), offset, 0.0))
        self._offset = tracked @ self._estimator.offset

    @override
    def command(self, number: int, markers: FloatArray) -> FloatArray:
        known = self._estimator
        if number:
            known.correct(markers)
        plan = self._planner.plan(
            known.state, self.last_command, self._ahead(number), self.knots, known.bias, self._offset
        )
        found = self._keep(plan.inputs, plan.knots)
        known.predict(found)
        return found

    @override
    def remembered(self) -> Memory:
        return super().remembered() | self._estimator.memory

    @override
    def recall(self, memory: Mapping[str, FloatArray]) -> None:
        super().recall(memory)
        self._estimator.memory = memory


class LinearRecedingHorizon(_Receding):
    """Plans with a linear model, from the last markers; what it misses at rest is observed and taken away.

    Args:
        model: of the same recordings as the simulator.
        tracked, limits, horizon, path, rest: see `RecedingHorizon`.
    """

    memory_keys: ClassVar[tuple[str, ...]] = (*_Receding.memory_keys, "seen", "expected", "missed")

    def __init__(
        self,
        model: LinearModel,
        tracked: FloatArray,
        limits: Limits,
        horizon: Horizon,
        path: FloatArray,
        rest: FloatArray,
    ) -> None:
        super().__init__(model, tracked, limits, horizon, path)
        self._model, self._tracked = model, tracked
        self.seen = np.tile(np.where(np.isfinite(rest), rest, model.rest.reshape(-1, 3)).ravel(), (DELAYS, 1))
        self.expected = self.seen[0]
        self.missed = np.zeros_like(self.expected)

    @override
    def command(self, number: int, markers: FloatArray) -> FloatArray:
        if number:
            now = np.where(np.isfinite(markers.ravel()), markers.ravel(), self.expected)
            self.missed = self.missed + _SETTLES * (now - self.expected - self.missed)
            self.seen = np.concatenate([now[None], self.seen[:-1]])
        state = self._model.state(list(self.seen))
        plan = self._planner.plan(
            state, self.last_command, self._ahead(number), self.knots, offset=self._tracked @ self.missed
        )
        found = self._keep(plan.inputs, plan.knots)
        self.expected = self._model.respond(state, found[None]).y[0]
        return found


class JacobianFeedback(Controller):
    """Follows a path by how the points moved when the inputs were pressed, corrected on the way by Broyden's rule.

    The rule is applied to means over a while, as the body vibrates.

    Args:
        jacobian: (d, n) of the points by the inputs, measured [m per unit].
        limits: of the inputs.
        gain: of the error [1/s].
        time_step: h [s].
        tracked: see `Planner`.
        path: (T, d) where the points are to be after each step [m].
        rest: (M, 3) markers at the beginning [m].
    """

    memory_keys: ClassVar[tuple[str, ...]] = ("jacobian", "shares", "past", "last_seen")

    def __init__(
        self,
        jacobian: FloatArray,
        limits: Limits,
        gain: float,
        time_step: float,
        tracked: FloatArray,
        path: FloatArray,
        rest: FloatArray,
    ) -> None:
        self.jacobian, self._limits, self._gain, self._step = jacobian * limits.range, limits, gain, time_step
        self._tracked, self._path, self.last_seen = tracked, path, rest.ravel()
        self.shares = np.zeros(len(limits.range))
        self._damping = _DAMPING * float(np.linalg.norm(self.jacobian, 2))
        self._window = max(round(_AVERAGED / time_step), 1)
        self.past = np.zeros((0, len(jacobian) + len(limits.range)))  # points and shares of the inputs, the last last

    @override
    def command(self, number: int, markers: FloatArray) -> FloatArray:
        self.last_seen = np.where(np.isfinite(markers.ravel()), markers.ravel(), self.last_seen)
        point, goal, next_goal = self._tracked @ self.last_seen, self._path[max(number - 1, 0)], self._path[number]
        u, h, d = self.shares, self._step, len(point)
        self.past = np.concatenate([self.past, [np.concatenate([point, u])]])[-2 * self._window :]
        if len(self.past) == 2 * self._window:
            before, now = (each.mean(0) for each in np.split(self.past, 2))
            moved, changed = (now - before)[:d], (now - before)[d:]
            missed = moved - self.jacobian @ changed
            self.jacobian = self.jacobian + _LEARNING / (changed @ changed + _LITTLE) * np.outer(missed, changed)
        wanted = next_goal - goal + self._gain * h * (goal - point)
        j = self.jacobian
        inverse = j.T @ np.linalg.inv(j @ j.T + self._damping**2 * np.eye(d))
        change = inverse @ wanted
        # What moves no point brings the inputs together, away from their bounds.
        change = change - 0.5 * h * (np.eye(len(u)) - inverse @ j) @ (u - u.mean())
        most = self._limits.rate * h / self._limits.range
        self.shares = np.clip(u + np.clip(change, -most, most), 0.0, 1.0)
        return np.asarray(self._limits.low + self._limits.range * self.shares)


def timed_command(controller: Controller, number: int, markers: FloatArray) -> tuple[FloatArray, float]:
    """A command, and the seconds that it took."""
    begun = time.perf_counter()
    found = controller.command(number, markers)
    return found, time.perf_counter() - begun
