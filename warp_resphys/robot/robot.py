"""A robot: an identified simulator with a learned force, stepped with its inputs by name."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csc_array

from ..data.input_response import InputResponse, response_of, with_means
from ..dynamics.frames import BaseFrame, VertexFrames, base_movement, rotations
from ..energies.strings import PAYLOAD, Strings
from ..experiment.experiment import COROTATED
from ..experiment.files import payload_inputs
from ..experiment.models import POSE_STEPS
from ..io.errors import ConvergenceError, InputError
from ..learning.feedback_equilibrium import equilibrium_under_feedback
from ..learning.networks import NextState
from ..learning.parameters import MASS_FACTOR, check_names, constants_of, identifiable_parameters
from ..learning.predictors import LearnedPredictor
from ..learning.rollout import DIVERGENCE_DISTANCE, Rollout
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .description import Description
from .inputs import BASE, FORCE, Given, InputReader, inputs_of
from .motion import Motion
from .state import RobotState

SUFFIX: Final = ".safetensors"


class Robot:
    """The simulator of an experiment with identified parameters and learned force; `loading.load` makes one.

    A robot is constant: `step` returns a new state. States, inputs and parameters are differentiable.

    Args:
        description: definition of the robot.
        device: of the simulation.
        on_failure: ``raise``, or ``count``: environments that diverge stand at rest and are ``lost``.
        parameters: (1,) or (B,) values that replace the identified ones.
        folder: of its run, with the trials; None for a robot from a file.

    Attributes:
        simulator: of its body.
        inputs: declarations of its inputs, by name.
        time_step: h [s].
        labels: of its markers; empty if every vertex is observed.
        frames: corotated frames of its learned force; None for a force in the world frame.
        parameters: identified values, by name.
        constants: of the simulator, computed from the parameters.
    """

    def __init__(
        self,
        description: Description,
        device: torch.device | str = "cpu",
        on_failure: str = "raise",
        parameters: Mapping[str, torch.Tensor | float] | None = None,
        folder: Path | None = None,
    ) -> None:
        self.description, self.folder = description, folder
        self.simulator = description.simulator(torch.device(device), on_failure)
        self.time_step, self.labels = self.simulator.time_step, description.labels
        observe = description.observe()
        self._observe = None if observe is None else observe.to(self.simulator.rest_positions)
        self._learned = description.learned
        self.frames: VertexFrames | None = None
        if self._learned is not None:
            self._learned.network.requires_grad_(False).to(self.simulator.device)
            if self._learned.force_frame == COROTATED and not self.is_data_driven:
                self.frames = VertexFrames(self.simulator.body, self.time_step, self.simulator.rest_positions)
        self.inputs = inputs_of(self.simulator, description)
        self._reader = InputReader(self.inputs, self.simulator)
        self._set_parameters(parameters or {})

    def _set_parameters(self, parameters: Mapping[str, torch.Tensor | float]) -> None:
        check_names(parameters, identifiable_parameters(self.simulator))
        given = {**self.description.parameters, **parameters}
        values = {name: self.simulator.tensor(value).reshape(-1) for name, value in given.items()}
        count = max((len(value) for value in values.values()), default=1)
        for name, value in values.items():
            if len(value) not in (1, count):
                raise InputError(f"{name} has {len(value)} values, others {count}: give 1 or {count}.")
        self.parameters = values
        spread = {name: value.expand(count) for name, value in values.items()}
        self.constants = self.simulator.prepare(constants_of(self.simulator, spread))
        filters = self.description.filters if self._learned is not None else ()
        self._responses = {
            name: InputResponse(self.time_step, *response_of(name, values), filters) for name in self.driven
        }

    def with_parameters(self, **parameters: torch.Tensor | float) -> "Robot":
        """Returns a robot with other parameters, which shares all other data with this one.

        Args:
            parameters: by name, numbers or (B,) tensors with a value for each environment; differentiable.

        Raises:
            InputError: an unknown name, or a value out of range.
        """
        other = object.__new__(Robot)
        other.__dict__.update({name: value for name, value in self.__dict__.items() if name != "_payload_share"})
        other._set_parameters({**self.parameters, **parameters})
        return other

    @property
    def driven(self) -> tuple[str, ...]:
        """Names of the inputs that command its actuators."""
        return tuple(name for name, declared in self.inputs.items() if declared.is_driven)

    @property
    def is_data_driven(self) -> bool:
        """Whether a network replaces the simulator."""
        return self._learned is not None and isinstance(self._learned.network, NextState)

    def __repr__(self) -> str:
        """Returns a short description: vertices, markers, time step, inputs, parameters, error."""
        body, description = self.simulator.body, self.description
        lines = [
            f"Robot {description.name}, {description.model}: {body.n_vertices} vertices, "
            f"{len(self.labels) or 'no'} markers, steps of {1e3 * self.time_step:g} ms"
        ]
        lines += [f"  input {name} [{given.unit}]: {', '.join(given.parts)}" for name, given in self.inputs.items()]
        lines += [f"  identified {name}: {value:.6g}" for name, value in description.parameters.items()]
        if description.errors_mm.get("mean") is not None:
            lines.append(f"  mean error in the test trials: {description.errors_mm['mean']:.3g} mm")
        return "\n".join(lines)

    def save(self, path: str | Path) -> Path:
        """Writes its description to one safe file (safetensors and JSON) that `loading.load` opens on any machine.

        Raises:
            InputError: the name has another extension.
            DataFileError: the file cannot be written.
        """
        place = Path(path).expanduser()
        if place.suffix != SUFFIX:
            raise InputError(f"{place} does not end in {SUFFIX}: give such a name.")
        self.description.write(place)
        return place

    # Observation

    def observe(self, state: RobotState) -> torch.Tensor:
        """Markers (B, M, 3) in a state, as recordings have them; vertices (B, N, 3) if these are observed [m]."""
        return state.q if self._observe is None else self._observe(state.q)

    def half_widths(self, markers: torch.Tensor) -> NDArray[np.float64] | None:
        """Half-widths (..., M) of the prediction intervals of markers' coordinates (..., M, 3) [m].

        They are those of the experiment's report (`learning.intervals`); None if it has none.
        """
        description = self.description
        if description.intervals is None or description.bound is None:
            return None
        return description.intervals.half_widths(markers.detach().cpu().numpy(), description.bound.numpy())

    # Initial states

    def state(self, q: ArrayLike | torch.Tensor, v: ArrayLike | torch.Tensor | None = None) -> RobotState:
        """Returns a state of given positions, with a history of zero inputs.

        Args:
            q: (N, 3) or (B, N, 3) [m].
            v: velocities of the same shape [m/s]; zero if omitted.
        """
        at = self._reader.field(q, "q")
        return self._new(State(at, torch.zeros_like(at) if v is None else self._reader.field(v, "v")))

    def begin(self, batch: int = 1, **inputs: Given) -> RobotState:
        """Returns the equilibrium of the simulator under its weight and constant inputs, without the learned force.

        Trials begin with it. A body without fixed vertices keeps its rest shape.

        Args:
            batch: B.
            inputs: by name, as for `step`.

        Raises:
            InputError: an invalid input, as for `step`.
            ConvergenceError: there is no equilibrium.
        """
        given = self._read(inputs, batch)
        state = self._new(self.simulator.rest_state(batch), given)
        if not len(self.simulator.fixed):
            return state
        acting = self._acting(state, given)[0]
        return replace(state, body=self.simulator.static_equilibrium(acting, self.constants, batch=batch))

    def settle(self, batch: int = 1, **inputs: Given) -> RobotState:
        """Returns the equilibrium of the robot under constant inputs, with its learned force.

        Args:
            batch: B.
            inputs: by name, as for `step`.

        Raises:
            InputError: an invalid input, as for `step`.
            ConvergenceError: there is no equilibrium.
        """
        start = self.begin(batch, **inputs)
        if self._learned is None:
            return start
        if self.is_data_driven:
            for _ in range(POSE_STEPS):
                start = self.step(start, **inputs)
            return start
        acting, conditions, memory, base = self._acting(start, self._read(inputs, batch))
        predictor = self._predictor(conditions, base)

        def force(state: State) -> torch.Tensor:
            predicted = predictor(state, 0)
            assert isinstance(predicted, torch.Tensor)
            return predicted

        body = equilibrium_under_feedback(self.simulator, acting, self.constants, start.body, force)
        left = start.left if predictor.left_at is None else predictor.left_at >= 0
        return replace(start, body=body, memory={**start.memory, **memory}, left=left)

    def settle_some(self, batch: int = 1, **inputs: Given) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns positions (B, N, 3) of `settle` [m], and (B,) bool, which environments are in equilibrium.

        Raises:
            InputError: an invalid input, as for `step`.
            ConvergenceError: the simulator has no equilibrium even without the learned force.
        """
        try:
            q = self.settle(batch, **inputs).q
        except ConvergenceError as error:
            if not isinstance(error.report, torch.Tensor):
                raise
            return error.positions.detach(), error.report
        return q, torch.ones(batch, dtype=torch.bool, device=q.device)

    # Motion

    def step(self, state: RobotState, **inputs: Given) -> RobotState:
        """Returns the state after one time step; differentiable.

        Args:
            state: before the step.
            inputs: commands during the step by name: (C,) or (B, C) values, a number for an input of one part, or a
                mapping from parts to numbers (other parts are zero). Omitted inputs are zero, an omitted base stays.
                ``payload`` is a mass in kg, ``base`` the pose at the end of the step (x, y, z in m, rotation vector in
                rad), ``external_force`` (N, 3) or (B, N, 3) in N.

        Raises:
            InputError: an unknown input or part, or values of another shape or out of range.
            ConvergenceError: the step failed, and ``on_failure`` is ``raise``.
        """
        acting, conditions, memory, base = self._acting(state, self._read(inputs, state.batch))
        predictor = None
        if self._learned is not None:
            predictor = self._predictor(conditions, base)
            predictor.hidden = state.hidden
        rollout = Rollout(self.simulator, predictor, acting, self.constants)
        rollout.resume(state.lost, 0)
        body = rollout.differentiable_step(state.body)
        now = rollout.lost(body)
        if self.simulator.settings.on_failure == "raise" and bool((now & ~state.lost).any()):
            raise ConvergenceError(
                f"the robot has diverged: a vertex moved further than {DIVERGENCE_DISTANCE:g} body lengths; "
                "use shorter steps, lower inputs, or a force that was trained longer.",
                state.q.detach(),
                None,
            )
        left = state.left
        if predictor is not None and predictor.left_at is not None:
            left = left | (predictor.left_at >= 0)
        hidden = None if predictor is None else predictor.hidden
        return RobotState(body, memory, hidden, None if base is None else base[1:], left, now)

    def rollout(
        self,
        state: RobotState,
        steps: int | None = None,
        on_step: Callable[[int], None] = lambda number: None,
        **inputs: Given,
    ) -> Motion:
        """Simulates many steps.

        Args:
            state: initial state.
            steps: T; the length of the longest input if omitted.
            on_step: called with the number of steps done.
            inputs: by name as for `step`, either constant (C,), or a series (T, C) or (T, B, C) with values for each
                step; the last value of a shorter series is held.

        Raises:
            InputError: an invalid input, as for `step`, or no number of steps.
            ConvergenceError: a step failed, and ``on_failure`` is ``raise``.
        """
        series = {name: self._reader.series(name, value, state.batch) for name, value in inputs.items()}
        lengths = [len(value) for name, value in series.items() if self._reader.is_series(name, inputs[name])]
        if steps is None and not lengths:
            raise InputError("the number of steps is unknown: give `steps`, or an input with a value for each step.")
        count = max(lengths, default=0) if steps is None else steps
        states, acting = [state], list[dict[str, torch.Tensor]]()
        for number in range(count):
            now = {name: value[min(number, len(value) - 1)] for name, value in series.items()}
            state = self.step(state, **now)
            states.append(state)
            acting.append(now)
            on_step(number + 1)
        markers = torch.stack([self.observe(state) for state in states])
        return Motion(
            robot=self.description,
            times=self.time_step * np.arange(count + 1, dtype=np.float64),
            q=torch.stack([state.q for state in states]),
            v=torch.stack([state.v for state in states]),
            markers=markers,
            half_widths=self.half_widths(markers),
            left=torch.stack([state.left for state in states]),
            lost=torch.stack([state.lost for state in states]),
            inputs={name: torch.stack([now[name] for now in acting]) for name in series if acting},
            known_inputs=self.inputs,
            final=state,
        )

    # Linearisation and the network's inputs in a state

    def begin_memory(self, inputs: Mapping[str, Given], batch: int = 1) -> dict[str, torch.Tensor]:
        """Returns `RobotState.memory` after constant inputs have acted for a long time."""
        return dict(self._new(self.simulator.rest_state(batch), self._read(inputs, batch)).memory)

    def conditions(self, state: RobotState, **inputs: Given) -> torch.Tensor | None:
        """Inputs (B, A) of the network beside the state in a step, as `program.condition_names` lists them."""
        return self._acting(state, self._read(inputs, state.batch))[1]

    def linearised(
        self, state: RobotState, **inputs: Given
    ) -> tuple[csc_array, NDArray[np.float64], NDArray[np.int64]]:
        """Linearises a step of the simulator about a state, without the learned force.

        Returns:
            The (3 F, 3 F) Hessian and its inertial part (3 F,) [N/m], and the numbers of the F free vertices.
        """
        acting = self._acting(state, self._read(inputs, state.batch))[0]
        linearised = self.simulator.linearise(state.body, acting, self.constants)
        hessian, inertia = linearised.matrix(state.q)
        return hessian, inertia, linearised.free.cpu().numpy()

    # Inputs

    def _read(self, inputs: Mapping[str, Given], batch: int) -> dict[str, torch.Tensor]:
        return {name: self._reader.read(name, value, batch) for name, value in inputs.items()}

    def _new(self, body: State, given: Mapping[str, torch.Tensor] | None = None) -> RobotState:
        """State after constant inputs (B, C), zero if omitted, have acted for a long time."""
        memory: dict[str, torch.Tensor] = {}
        for name, response in self._responses.items():
            value = (given or {}).get(name)
            zeros = body.q.new_zeros(body.batch, len(self.inputs[name].parts))
            still = response.steady(zeros if value is None else value)
            memory |= {f"{name}.{key}": values for key, values in still.items()}
        base = (given or {}).get(BASE)
        moved = self.description.told_of_base is not None or base is not None
        at = body.q.new_zeros(body.batch, len(self.inputs[BASE].parts)) if base is None else base
        return RobotState(body, memory, base=torch.stack([at, at]) if moved else None)

    @cached_property
    def _payload_share(self) -> torch.Tensor:
        """Share (1, N) of a payload that hangs on each vertex."""
        share = payload_inputs(self.simulator.body, self.description.payload_at, np.ones(1))["attached_mass"]
        return self.simulator.tensor(share)

    def _acting(
        self, state: RobotState, given: Mapping[str, torch.Tensor]
    ) -> tuple[Inputs, torch.Tensor | None, dict[str, torch.Tensor], torch.Tensor | None]:
        """Simulator inputs, conditions of the network, next memory, and the base (3, B, 6) from a step ago on."""
        fields: dict[str, torch.Tensor | None] = {FORCE: given.get(FORCE)}
        conditions, memory = list[torch.Tensor](), dict[str, torch.Tensor]()
        payload = given.get(PAYLOAD.name)
        if self.description.payload_at is not None and self.description.sees_payload:
            conditions.append(state.q.new_zeros(state.batch, 1) if payload is None else payload)
        for name, response in self._responses.items():
            value, own = given.get(name), f"{name}."
            zeros = state.q.new_zeros(state.batch, len(self.inputs[name].parts))
            remembered = {key.removeprefix(own): x for key, x in state.memory.items() if key.startswith(own)}
            acting, means, later = response(remembered, (zeros if value is None else value)[None])
            fields[name] = acting[0]
            conditions += [with_means(acting[0], means[:, 0])] if name in self.description.seen else []
            memory |= {f"{own}{key}": values for key, values in later.items()}
        if payload is not None:
            fields |= self._hung(payload)
        base = state.base
        if BASE in given or base is not None:
            before = given[BASE].new_zeros(2, *given[BASE].shape) if base is None else base
            base = torch.cat([before, given.get(BASE, before[1])[None]])
            fields["fixed_positions"] = self._fixed(base[2])
            if self.description.told_of_base is not None:
                gravity = self.simulator.tensor(self.simulator.gravity)
                moved = base_movement(base, self.time_step, gravity)[1]
                conditions.append(moved[:, torch.tensor(self.description.told_of_base, device=moved.device)])
        return Inputs(**fields), torch.cat(conditions, -1) if conditions else None, memory, base

    def _hung(self, payload: torch.Tensor) -> dict[str, torch.Tensor]:
        """Inputs of the simulator for a payload (B, 1) [kg]."""
        factor = self.parameters.get(MASS_FACTOR)
        mass = payload if factor is None else payload * factor[:, None]
        if any(isinstance(energy, Strings) for energy in self.simulator.body.energies):
            return {PAYLOAD.name: mass}
        return {"attached_mass": mass * self._payload_share}

    def _fixed(self, pose: torch.Tensor) -> torch.Tensor:
        """Positions (B, D, 3) of the fixed vertices for poses (B, 6) of the base [m]."""
        rest = self.simulator.rest_positions[self.simulator.fixed]
        return rest @ rotations(pose[:, 3:]).mT + pose[:, None, :3]

    def _predictor(self, conditions: torch.Tensor | None, base: torch.Tensor | None) -> LearnedPredictor:
        learned = self._learned
        assert learned is not None
        given = None if learned.network.actuation is None else conditions
        frame = None if base is None else BaseFrame(base, self.time_step, first=1)
        return LearnedPredictor(learned.network, given, learned.range_, self.frames, frame)
