"""Who commands a robot at each step: a plan that is played, plans that begin anew at every step, or feedback.

Each has a memory of arrays, from which a run that was interrupted goes on.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from .baselines import DELAYS, JacobianFeedback, LinearModel
from .estimate import Estimator, Noise
from .plan import Foretelling, Limits, Planner, Weights
from .reduced import ReducedModel

FloatArray = NDArray[np.float64]
Memory = dict[str, FloatArray]

_SETTLES = 0.1  # share by which a linear model's constant error is corrected in a step


class Controller(ABC):
    """Commands inputs (n,) at each step, of what cameras saw after the last one."""

    @abstractmethod
    def command(self, number: int, markers: FloatArray) -> FloatArray:
        """(n,) for a step, of markers (M, 3) before it [m], NaN where one is not seen."""

    def remembered(self) -> Memory:
        """What the next step depends on."""
        return {}

    def recall(self, memory: Mapping[str, FloatArray]) -> None:
        """Goes back to what was `remembered`."""
        del memory


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

    def __init__(
        self, model: Foretelling, tracked: FloatArray, limits: Limits, horizon: Horizon, path: FloatArray
    ) -> None:
        self._planner = Planner(
            model, tracked, limits, horizon.steps, horizon.pieces, horizon.weights, horizon.iterations
        )
        self._path, self._command = path, np.array(limits.low)
        self._knots: FloatArray | None = None

    def _ahead(self, number: int) -> FloatArray:
        """(H, d) of the path from a step on; at its end it stays."""
        return np.asarray(self._path[np.minimum(np.arange(number, number + self._planner.steps), len(self._path) - 1)])

    def _keep(self, inputs: FloatArray, knots: FloatArray) -> FloatArray:
        """Takes the first of the inputs, and moves the knots on by a step."""
        planner = self._planner
        steps, pieces = planner.steps, planner.knots - 1
        line = np.concatenate([knots[:1], inputs])
        at = np.minimum(np.arange(pieces + 1) * steps / pieces + 1.0, steps)
        self._knots = np.stack([np.interp(at, np.arange(steps + 1), column) for column in line.T], axis=1)
        self._command = inputs[0]
        return self._command

    @override
    def remembered(self) -> Memory:
        kept = {"command": self._command}
        return kept if self._knots is None else {**kept, "knots": self._knots}

    @override
    def recall(self, memory: Mapping[str, FloatArray]) -> None:
        self._command, self._knots = memory["command"], memory.get("knots")


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
        nothing = np.zeros((1, model.parts))
        offset = rest.ravel() - model.observe(model.rest().z[None], nothing)[0]
        self._estimator = Estimator(model, noise, nothing[0], np.where(np.isfinite(offset), offset, 0.0))
        self._offset = tracked @ self._estimator.offset

    @override
    def command(self, number: int, markers: FloatArray) -> FloatArray:
        known = self._estimator
        if number:
            known.correct(markers)
        plan = self._planner.plan(
            known.state, self._command, self._ahead(number), self._knots, known.bias, self._offset
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
        self._seen = np.tile(np.where(np.isfinite(rest), rest, model.rest.reshape(-1, 3)).ravel(), (DELAYS, 1))
        self._expected = self._seen[0]
        self._missed = np.zeros_like(self._expected)

    @override
    def command(self, number: int, markers: FloatArray) -> FloatArray:
        if number:
            now = np.where(np.isfinite(markers.ravel()), markers.ravel(), self._expected)
            self._missed = self._missed + _SETTLES * (now - self._expected - self._missed)
            self._seen = np.concatenate([now[None], self._seen[:-1]])
        state = self._model.state(list(self._seen))
        plan = self._planner.plan(
            state, self._command, self._ahead(number), self._knots, offset=self._tracked @ self._missed
        )
        found = self._keep(plan.inputs, plan.knots)
        self._expected = self._model.respond(state, found[None]).y[0]
        return found

    @override
    def remembered(self) -> Memory:
        return super().remembered() | {"seen": self._seen, "expected": self._expected, "missed": self._missed}

    @override
    def recall(self, memory: Mapping[str, FloatArray]) -> None:
        super().recall(memory)
        self._seen, self._expected, self._missed = (memory[key] for key in ("seen", "expected", "missed"))


class Feedback(Controller):
    """Follows a path by a measured Jacobian.

    Args:
        feedback: how.
        tracked: see `Planner`.
        path: (T, d) where the points are to be after each step [m].
        rest: (M, 3) markers at the beginning [m].
    """

    def __init__(self, feedback: JacobianFeedback, tracked: FloatArray, path: FloatArray, rest: FloatArray) -> None:
        self._feedback, self._tracked, self._path = feedback, tracked, path
        self._last = rest.ravel()

    @override
    def command(self, number: int, markers: FloatArray) -> FloatArray:
        now = np.where(np.isfinite(markers.ravel()), markers.ravel(), self._last)
        self._last = now
        goal = self._path[max(number - 1, 0)]
        return self._feedback.command(self._tracked @ now, goal, self._path[number])

    @override
    def remembered(self) -> Memory:
        return {"last_seen": self._last, **self._feedback.memory}

    @override
    def recall(self, memory: Mapping[str, FloatArray]) -> None:
        self._last, self._feedback.memory = memory["last_seen"], memory


def timed_command(controller: Controller, number: int, markers: FloatArray) -> tuple[FloatArray, float]:
    """A command, and the seconds that it took."""
    begun = time.perf_counter()
    found = controller.command(number, markers)
    return found, time.perf_counter() - begun
