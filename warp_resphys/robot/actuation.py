"""Inputs of a robot by name: checked values, and their effects on its simulator,
its network and later steps.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import ArrayLike

from ..core.dynamics.frames import base_movement
from ..core.dynamics.simulator import Simulator
from ..core.energies.base import Energy
from ..core.energies.contact.contact_points import MOTION
from ..core.energies.materials import MASS_DAMPING
from ..core.stepping.inputs import Inputs
from ..core.stepping.quantity import Quantity
from ..core.stepping.rotations import rotations
from ..core.stepping.state import ROBOT, State
from ..data.base_motion import LARGEST_STEP
from ..data.driving import time_since_change
from ..data.input_network import InputNetwork
from ..data.input_response import InputResponse, response_of, with_means
from ..data.trials import PAYLOAD, payload_inputs
from ..io.arrays import FloatArray
from ..io.errors import InputError, listed
from ..learning.parameters import MASS_FACTOR, command_of
from ..learning.residuals.correction import LearnedPredictor
from .description import Description

BASE: Final = "base"
FORCE: Final = "external_force"
_POSE: Final = ("x", "y", "z", "turn_x", "turn_y", "turn_z")
_UNLIMITED: Final = Quantity("", "")
Given = ArrayLike | torch.Tensor | Mapping[str, float]


@dataclass(frozen=True)
class RobotInput:
    """An input of a robot.

    Attributes:
        name: keyword of the input in `Robot.step`.
        unit: of its values.
        parts: names of its C values, such as the chambers.
        low: (C,) least values in the experiment's trials; None if the trials lack the input.
        high: (C,) greatest values in the experiment's trials.
        quantity: with the range that a simulation accepts.
    """

    name: str
    unit: str
    parts: tuple[str, ...]
    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None
    quantity: Quantity = _UNLIMITED

    @property
    def is_driven(self) -> bool:
        """Whether it is the command of an actuator."""
        return self.is_taken and self.quantity not in MOTION

    @property
    def is_taken(self) -> bool:
        """Whether an energy of the body takes it: the command of an actuator,
        or the motion of an obstacle.
        """
        return self.quantity not in (_UNLIMITED, PAYLOAD)


def inputs_of(simulator: Simulator, description: Description) -> dict[str, RobotInput]:
    """Returns the inputs of a robot by name, except the external force."""
    inputs = {}
    for energy in [energy for energy in simulator.body.energies if isinstance(energy, Energy)]:
        for quantity in energy.inputs:
            low, high = description.seen.get(quantity.name, (None, None))
            inputs[quantity.name] = RobotInput(
                quantity.name, quantity.unit, energy.names, low, high, quantity
            )
    if description.payload_at is not None:
        inputs[PAYLOAD.name] = RobotInput(
            PAYLOAD.name, PAYLOAD.unit, ("payload",), quantity=PAYLOAD
        )
    if len(simulator.fixed):
        inputs[BASE] = RobotInput(BASE, "m, rad", _POSE)
    return inputs


class InputReader:
    """Converts values of a robot's inputs to tensors, and checks them.

    Args:
        inputs: by name.
        simulator: whose device and type the tensors get.
    """

    def __init__(self, inputs: Mapping[str, RobotInput], simulator: Simulator) -> None:
        self._inputs, self._simulator = inputs, simulator

    def read(self, name: str, value: Given, batch: int) -> torch.Tensor:
        """Returns the values (B, C) of an input during a step, or (B, N, 3) of the external force.

        Raises:
            InputError: an unknown input or part, values of another shape, or out of range.
        """
        if name == FORCE:
            return self.field(value, FORCE).expand(batch, -1, -1)
        if name not in self._inputs:
            raise InputError(
                f"there is no input {name!r}: the robot has {listed([*self._inputs, FORCE])}."
            )
        declared = self._inputs[name]
        parts = declared.parts
        if isinstance(value, Mapping):
            unknown = [part for part in value if part not in parts]
            if unknown:
                raise InputError(f"{name} has no part {unknown[0]!r}: it has {listed(parts)}.")
            value = [float(value.get(part, 0.0)) for part in parts]
        values = self._tensor(value, name)
        values = (
            values[..., None]
            if len(parts) == 1 and (values.ndim == 0 or values.shape[-1] != 1)
            else values
        )
        values = values[None] if values.ndim == 1 else values
        if values.ndim != 2 or values.shape[1] != len(parts) or len(values) not in (1, batch):
            raise InputError(
                f"{name} has shape {tuple(values.shape)}: give ({len(parts)},) values in "
                f"{declared.unit}, one for each of {listed(parts)}, or ({batch}, {len(parts)}) "
                f"for the {batch} environments."
            )
        if math.isfinite(declared.quantity.lower) or math.isfinite(declared.quantity.upper):
            declared.quantity.check(values)
        if not bool(torch.isfinite(values).all()):
            raise InputError(f"{name} has values that are not finite: check how they are computed.")
        return values.expand(batch, -1)

    def is_series(self, name: str, value: Given) -> bool:
        """Whether the input has a value for each step."""
        if isinstance(value, Mapping):
            return False
        return self._tensor(value, name).ndim >= (3 if name == FORCE else 2)

    def series(self, name: str, value: Given, batch: int) -> torch.Tensor:
        """Returns the values (1, B, C) of a constant input or (T, B, C) of a series.

        Raises the errors of `read`.
        """
        if isinstance(value, Mapping) or not self.is_series(name, value):
            return self.read(name, value, batch)[None]
        return torch.stack([self.read(name, now, batch) for now in self._tensor(value, name)])

    def by_step(
        self, inputs: Mapping[str, Given], steps: int | None, batch: int
    ) -> list[dict[str, torch.Tensor]]:
        """Returns the values of constant inputs and series in every step.

        The last ones of a shorter series stay.

        Args:
            inputs: by name.
            steps: number of steps T; the length of the longest series if omitted.
            batch: B.

        Raises:
            InputError: as `read`, or no number of steps.
        """
        series = {name: self.series(name, value, batch) for name, value in inputs.items()}
        lengths = [
            len(series[name]) for name, value in inputs.items() if self.is_series(name, value)
        ]
        if steps is None and not lengths:
            raise InputError(
                "the number of steps is unknown: give `steps`, "
                "or an input with a value for each step."
            )
        count = max(lengths, default=0) if steps is None else steps
        return [
            {name: value[min(k, len(value) - 1)] for name, value in series.items()}
            for k in range(count)
        ]

    def field(self, values: Any, name: str) -> torch.Tensor:
        """Returns vectors of the vertices (B, N, 3), given as (N, 3) or (B, N, 3).

        Raises:
            InputError: another shape.
        """
        field = self._tensor(values, name)
        field = field[None] if field.ndim == 2 else field
        wanted = (self._simulator.body.n_vertices, 3)
        if field.ndim != 3 or tuple(field.shape[1:]) != wanted:
            raise InputError(
                f"{name} has shape {tuple(field.shape)}: give {wanted}, "
                "or one such array an environment."
            )
        return field

    def _tensor(self, value: Any, name: str) -> torch.Tensor:
        try:
            return self._simulator.tensor(value)
        except InputError:
            raise InputError(
                f"{name} is {value!r}: give numbers, or an array or a tensor of numbers."
            ) from None


@dataclass(frozen=True)
class Acting:
    """Inputs that act during a step of B environments."""

    inputs: Inputs  # of the simulator
    conditions: torch.Tensor | None  # (B, A) what the network takes beside the state, if any
    # memory variables of the robot's actuators and base after the step (`State.memory_of`), such as
    # ``pressure.queue`` (B, K, C), see `InputResponse`, and ``base`` (B, 2, 6) [m, rad]
    memory: dict[str, torch.Tensor]
    # (3, B, 6) displacement of the base from one step ago until after the step; None if it never
    # moved
    base: torch.Tensor | None

    def remembered(self, state: State, predictor: LearnedPredictor | None, after: State) -> State:
        """Returns the robot's state after a step, from the one before it and the body after it."""
        memory = {**self.memory, "lost": after.lost, "left": state.left}
        if predictor is not None and predictor.left_at is not None:
            memory["left"] = state.left | (predictor.left_at >= 0)
        return after.with_memory(memory)


def values_of_material(
    simulator: Simulator, parameters: Mapping[str, torch.Tensor]
) -> dict[str, float]:
    """Returns those of a robot's parameters that are its material's, without damping by mass."""
    materials = simulator.materials.items()
    material = {
        f"{region}_{name}" if region else name
        for region, used in materials
        for name in used.parameters
    }
    return {
        name: float(parameters[name][0]) for name in material & parameters.keys() - {MASS_DAMPING}
    }


def moved_actuators(
    description: Description,
    parameters: Mapping[str, torch.Tensor],
    here: Simulator,
    there: Simulator,
) -> tuple[dict[str, float], dict[str, InputNetwork]]:
    """Returns the parameters of inputs, and the networks that change them,
    for inputs whose parts two bodies share.

    Args:
        description: of the robot.
        parameters: its parameters.
        here: its simulator.
        there: that of the other body.
    """
    same = {name for name, parts in here.parts.items() if there.parts.get(name) == parts}
    response = {
        name: float(x[0]) for name, x in parameters.items() if command_of(here, name)[0] in same
    }
    return response, {
        name: network for name, network in description.actuator.items() if name in same
    }


class Commands:
    """Converts the inputs of a robot, through the delay and lag of its actuators.

    Args:
        simulator: of the robot.
        description: of the robot.
        inputs: declarations of its inputs, by name.
        parameters: its parameters, (1,) or (B,) by name.
    """

    def __init__(
        self,
        simulator: Simulator,
        description: Description,
        inputs: Mapping[str, RobotInput],
        parameters: Mapping[str, torch.Tensor],
    ) -> None:
        self._simulator, self._inputs = simulator, inputs
        self._description = description
        self._mass_factor = parameters.get(MASS_FACTOR)
        h = simulator.time_step
        filters = description.filters if description.learned is not None else ()
        taken = [name for name, declared in inputs.items() if declared.is_taken]
        parts, actuator = simulator.parts, description.actuator
        responses = {
            name: response_of(simulator.inputs[name], parameters, parts.get(name, ()), actuator)
            for name in taken
        }
        self._responses = {
            name: InputResponse(h, **values, filters=filters) for name, values in responses.items()
        }

    def begin(self, body: State, inputs: Mapping[str, torch.Tensor]) -> State:
        """Returns the state after constant inputs (B, C),
        zero if omitted, have acted for a long time.
        """
        memory = {"lost": body.lost, "left": body.left}
        for name, response in self._responses.items():
            still = response.steady(self._value(name, inputs, body))
            memory |= {f"{name}.{key}": values.movedim(-2, 0) for key, values in still.items()}
        if self._description.told_of_base is not None or BASE in inputs:
            memory[BASE] = torch.stack([self._value(BASE, inputs, body)] * 2, 1)
        return body.with_memory(memory)

    def act(self, state: State, inputs: Mapping[str, torch.Tensor]) -> Acting:
        """Returns what acts during a step with inputs (B, C) by name.

        Omitted ones are zero, an omitted base stays.
        """
        description = self._description
        fields: dict[str, torch.Tensor | None] = {FORCE: inputs.get(FORCE)}
        conditions = list[torch.Tensor]()
        memory = dict[str, torch.Tensor]()
        before = state.memory_of()
        payload = inputs.get(PAYLOAD.name)
        if description.payload_at is not None and description.sees_payload:
            conditions.append(self._value(PAYLOAD.name, inputs, state))
        for name, response in self._responses.items():
            remembered = {
                key: x.movedim(0, -2) for key, x in state.memory_of(f"{ROBOT}.{name}").items()
            }
            acting, means, later = response(remembered, self._value(name, inputs, state)[None])
            fields[name] = acting[0]
            conditions += [with_means(acting[0], means[:, 0])] if name in description.seen else []
            memory |= {f"{name}.{key}": values.movedim(-2, 0) for key, values in later.items()}
        if payload is not None:
            fields |= self._hung(payload)
        base = None
        if BASE in inputs or BASE in before:
            moved = (
                before[BASE].unbind(1) if BASE in before else [torch.zeros_like(inputs[BASE])] * 2
            )
            base = torch.stack([*moved, inputs.get(BASE, moved[1])])
            memory[BASE] = base[1:].movedim(1, 0)
            fields["fixed_positions"] = self._fixed(base[2])
            if BASE in inputs:
                self._check_base(base)
            if description.told_of_base is not None:
                gravity = self._simulator.tensor(self._simulator.gravity)
                movement = base_movement(base, self._simulator.time_step, gravity)[1]
                conditions.append(
                    movement[:, torch.tensor(description.told_of_base, device=movement.device)]
                )
        return Acting(
            Inputs(**fields), torch.cat(conditions, -1) if conditions else None, memory, base
        )

    def _value(self, name: str, inputs: Mapping[str, torch.Tensor], body: State) -> torch.Tensor:
        """Returns the values (B, C) of an input, zero if omitted."""
        value = inputs.get(name)
        return (
            body.q.new_zeros(body.batch, len(self._inputs[name].parts)) if value is None else value
        )

    @cached_property
    def _payload_share(self) -> torch.Tensor:
        """Share (1, N) of a payload that hangs on each vertex."""
        share = payload_inputs(self._simulator.body, self._description.payload_at, np.ones(1))[
            "attached_mass"
        ]
        return self._simulator.tensor(share)

    def _hung(self, payload: torch.Tensor) -> dict[str, torch.Tensor]:
        """Inputs of the simulator for a payload (B, 1) [kg]."""
        mass = payload if self._mass_factor is None else payload * self._mass_factor[:, None]
        return {"attached_mass": mass * self._payload_share}

    def _check_base(self, base: torch.Tensor) -> None:
        """Refuses poses (3, B, 6) of the base of which the last step moves fixed vertices too
        far.
        """
        moved = (self._fixed(base[2]) - self._fixed(base[1])).detach().norm(dim=2)
        rest = self._simulator.rest_positions
        furthest, size = float(moved.max()), float((rest.amax(0) - rest.amin(0)).max())
        milliseconds = 1e3 * self._simulator.time_step
        if furthest > LARGEST_STEP * size:
            raise InputError(
                f"base moves by {1e3 * furthest:.4g} mm in a step of {milliseconds:g} ms, and a "
                f"body of {1e3 * size:.4g} mm follows up to {1e3 * LARGEST_STEP * size:.4g} mm: "
                "give poses in m and rad, or move it in smaller steps."
            )

    def _fixed(self, pose: torch.Tensor) -> torch.Tensor:
        """Positions (B, D, 3) of the fixed vertices for poses (B, 6) of the base [m]."""
        rest = self._simulator.rest_positions[self._simulator.fixed]
        return rest @ rotations(pose[:, 3:]).mT + pose[:, None, :3]


def since_change(
    time_step: float, driven: Mapping[str, torch.Tensor], times: int, batch: int
) -> FloatArray:
    """Returns (T + 1, B) times since the last change of commands (T, B, ...) at T + 1 times [s]."""
    values = [commands.detach().cpu().double().numpy() for commands in driven.values()]
    acting = [np.concatenate([series, series[-1:]]).reshape(times, batch, -1) for series in values]
    at = time_step * np.arange(times, dtype=np.float64)
    return time_since_change(np.broadcast_to(at[:, None], (times, batch)), acting)
