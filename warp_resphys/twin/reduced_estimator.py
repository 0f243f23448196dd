"""The state of a robot, estimated from its markers on its reduced model:
a few milliseconds a frame.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from typing_extensions import override

from ..control.polynomials import Monomials
from ..control.reduced_model import ReducedState
from ..control.reduction import reduced_of
from ..core.stepping.state import State
from ..io.arrays import FloatArray
from ..io.errors import ConvergenceError, InputError
from ..learning.residuals.correction import DIVERGENCE_DISTANCE
from ..robot.actuation import Given, InputReader
from ..robot.robot import Robot
from .belief import Belief
from .estimator import TwinEstimator

_SLOWEST = 1.0  # least frequency of a coordinate, for the scale of its errors [rad/s]


@dataclass(frozen=True, kw_only=True)
class ReducedBelief(Belief):
    """Estimate of the state of a reduced model."""

    state: ReducedState  # of two models: the estimate, and the one without markers


class ReducedEstimator(TwinEstimator[ReducedBelief]):
    """Estimates the state of a robot with its reduced model,
    in whose coordinates all derivatives are exact.

    Args:
        robot: whose trials are driven by one input.
        inputs: constant commands under which it rests at first.
        refine: none, as a reduced model has no parameters.
        noise: standard deviation of a coordinate of a marker [m].

    Raises:
        InputError: the robot cannot be reduced; a parameter to refine, or an input that the model
            does not have.
        ConvergenceError: there is no equilibrium.
    """

    engine = "reduced model"

    def __init__(
        self, robot: Robot, inputs: Mapping[str, Given], refine: Mapping[str, float], noise: float
    ) -> None:
        if refine:
            raise InputError(
                f"a reduced model has no {next(iter(refine))} to refine: set engine=full, in "
                "which a twin refines it."
            )
        self.model = model = reduced_of(robot)
        self._reader = InputReader(robot.inputs, robot.simulator)
        stiffness = model.stiffness(self._rest(inputs).acting)[0]
        frequencies = np.sqrt(np.abs(np.diag(stiffness))).clip(_SLOWEST)
        reach = float(np.sqrt((model.basis**2).sum() / (len(model.basis) / 3) / model.modes))
        super().__init__(robot, inputs, {}, frequencies, reach, noise)

    @override
    def faults(self, inputs: Mapping[str, Given]) -> list[str]:
        values = self._commands(inputs)
        beyond = (values < self.model.range[0]) | (values > self.model.range[1])
        return (
            [f"{self.model.name} beyond that of the trials, and held at their limit"]
            if beyond.any()
            else []
        )

    def _commands(self, inputs: Mapping[str, Given]) -> FloatArray:
        """Values (n,) of the model's input."""
        read = {name: self._reader.read(name, value, 1)[0] for name, value in inputs.items()}
        values = read.pop(self.model.name, torch.zeros(self.model.parts))
        for name, value in read.items():
            if bool((value != 0.0).any()):
                raise InputError(
                    f"the reduced model has no input but {self.model.name}, and {name} is given: "
                    "leave it out, or use the full simulator (engine=full)."
                )
        return np.asarray(values.double().cpu().numpy())

    def _held(self, inputs: Mapping[str, Given]) -> FloatArray:
        """Commands (n,) within those of the trials, as polynomials beyond them mean nothing."""
        return np.clip(self._commands(inputs), *self.model.range)

    def _rest(self, inputs: Mapping[str, Given]) -> ReducedState:
        """Two models at rest, as a full twin without the learned force
        where there is no equilibrium with it.
        """
        commands = self._held(inputs)
        try:
            return self.model.rest(commands, 2)
        except ConvergenceError:
            return replace(self.model, force=None).rest(commands, 2)

    @override
    def begin(
        self, inputs: Mapping[str, Given], refined: FloatArray | None = None
    ) -> ReducedBelief:
        return ReducedBelief(**vars(self._first(np.zeros(0))), state=self._rest(inputs))

    @override
    def advance(
        self, belief: ReducedBelief, inputs: Mapping[str, Given], renew: bool = True
    ) -> ReducedBelief:
        bias = np.stack([belief.bias, np.zeros_like(belief.bias)])
        end, transition = self.model.transition(belief.state, self._held(inputs), bias)
        off = end.z - self.model.static(end.acting)
        far = np.linalg.norm((off @ self.model.basis.T).reshape(2, -1, 3), axis=2).max()
        if not far < DIVERGENCE_DISTANCE * self.size:
            raise ConvergenceError("the reduced model has diverged.", end.z, None)
        return replace(self._propagated(belief, transition), state=end)

    @override
    def robot_state(self, belief: ReducedBelief) -> State:
        """Returns the estimated state of the robot, in which the material has relaxed."""
        simulator, (rate, *_) = self.robot.simulator, belief.state.v
        moved = self.model.positions(belief.state)[:1]
        faster = (self.model.basis @ rate).reshape(1, -1, 3)
        state = self.robot.state(
            simulator.rest_positions + simulator.tensor(moved), simulator.tensor(faster)
        )
        memory = {
            **state.memory_of(),
            "left": torch.full_like(state.left, bool(belief.state.left[0])),
        }
        for key, value in belief.state.memory.items():
            memory[f"{self.model.name}.{key}"] = simulator.tensor(
                np.moveaxis(value[..., :1, :], -2, 0).copy()
            )
        return state.with_memory(memory)

    @override
    def _seen(self, belief: ReducedBelief, ago: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        state, u = belief.state, Monomials(belief.state.acting)
        z = state.z - ago * state.v
        now, free = self.model.points(z, u).reshape(2, -1, 3)
        by_z = self.model.point_slopes(z, u)[0].reshape(self.count, 3, -1)
        by_place = np.eye(3 * self.count).reshape(self.count, 3, -1)
        slopes = np.concatenate([by_z, -ago * by_z, np.zeros_like(by_z), by_place], axis=2)
        return now + belief.places, slopes, free

    @override
    def _free(self, belief: ReducedBelief) -> ReducedBelief:
        return replace(belief, state=belief.state.select([1, 1]))

    @override
    def _moved(
        self, belief: ReducedBelief, z: FloatArray, w: FloatArray, parameters: FloatArray
    ) -> ReducedBelief:
        moved, faster = (np.stack([change, np.zeros_like(change)]) for change in (z, w))
        return replace(belief, state=belief.state.moved(moved, faster, self.time_step))

    @override
    def _furthest(self, belief: ReducedBelief, z: FloatArray, parameters: FloatArray) -> float:
        return float(np.linalg.norm((self.model.basis @ z).reshape(-1, 3), axis=1).max())
