"""A robot: an identified simulator with a learned force, stepped with its inputs by name."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ..core.dynamics.frames import BaseFrame, VertexFrames
from ..core.dynamics.simulator import Simulator
from ..core.dynamics.trajectory import Motion
from ..core.mesh.volume_mesh import Mesh
from ..core.stepping.adjoints import refuse_transforms
from ..core.stepping.inputs import Inputs
from ..core.stepping.rollout import rollout, states
from ..core.stepping.rotations import rotations
from ..core.stepping.state import State
from ..data.markers import Observation
from ..io.errors import ConvergenceError, InputError, checks_methods, checks_types
from ..learning.evaluation import POSE_STEPS
from ..learning.observed_motions import Identified
from ..learning.parameters import (
    TILTS,
    check_names,
    constants_of,
    identifiable_parameters,
    replaced,
)
from ..learning.residuals.correction import (
    DIVERGENCE_DISTANCE,
    CorrectedSimulator,
    LearnedPredictor,
    force_frames,
)
from ..learning.residuals.feedback import equilibrium_under_feedback
from ..learning.residuals.networks import NextState
from .actuation import (
    BASE,
    Acting,
    Commands,
    Given,
    InputReader,
    inputs_of,
    moved_actuators,
    since_change,
    values_of_material,
)
from .description import Description
from .of_simulator import description_of


@checks_methods("__init__", "rollout", "begin", "settle", "step", "observe", "save")
class Robot:
    """The simulator of an experiment with identified parameters and learned force.

    `loading.load` makes one.

    A robot is constant: `step` returns a new state. States, inputs and parameters are
    differentiable.

    Args:
        description: definition of the robot.
        device: of the simulation.
        on_failure: ``raise``, or ``count``: environments that diverge stand at rest and are
            ``lost``.
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
        self.simulator = description.simulator(torch.device(device), on_failure)
        description = description.to(torch.device(device))
        self.description, self.folder = description, folder
        self.time_step, self.labels = self.simulator.time_step, description.labels
        observe = description.observe()
        self._observe = None if observe is None else observe.to(self.simulator.rest_positions)
        self._learned = description.learned
        self.frames: VertexFrames | None = None
        if self._learned is not None:
            self._learned.network.requires_grad_(False)
            if not self.is_data_driven:
                self.frames = force_frames(self.simulator, self._learned.force_frame)
        self.inputs = inputs_of(self.simulator, description)
        self._reader = InputReader(self.inputs, self.simulator)
        self._set_parameters(parameters or {})

    @classmethod
    @checks_types
    def of(
        cls,
        simulator: Simulator,
        markers: Observation | Mapping[str, ArrayLike] | None = None,
        parameters: Identified | Mapping[str, float] | None = None,
        ranges: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
        name: str = "robot",
    ) -> "Robot":
        """Returns the robot of a simulator of Python,
        which can do what one of a run can, but has no trials.

        Args:
            simulator: of one body.
            markers: of `bind_markers`, or places (3,) on the body at rest by label [m]; None:
                vertices are observed.
            parameters: values in place of the simulator's, by name or from `identify`, with their
                uncertainty.
            ranges: least and greatest value by input, a number or one for each part; environments
                need them.
            name: in descriptions.

        Raises:
            InputError: no simulator of one body, or markers, parameters or ranges that do not fit
                it.
        """
        made = description_of(simulator, markers, parameters, ranges or {}, name)
        return cls(made, simulator.device, simulator.settings.on_failure)

    def _set_parameters(self, parameters: Mapping[str, torch.Tensor | float]) -> None:
        check_names(parameters, identifiable_parameters(self.simulator))
        known = replaced(self.simulator, self.description.parameters, parameters)
        values = {name: self.simulator.tensor(value).reshape(-1) for name, value in known.items()}
        count = max((len(value) for value in values.values()), default=1)
        for name, value in values.items():
            if len(value) not in (1, count):
                raise InputError(
                    f"{name} has {len(value)} values, others {count}: give 1 or {count}."
                )
        self.parameters = values
        spread = {name: value.expand(count) for name, value in values.items()}
        self.constants = self.simulator.prepare(constants_of(self.simulator, spread))
        self._commands = Commands(self.simulator, self.description, self.inputs, values)

    def with_parameters(self, **parameters: torch.Tensor | float) -> "Robot":
        """Returns a robot with other parameters, which shares all other data with this one.

        Args:
            parameters: by name, numbers or (B,) tensors with a value for each environment;
                differentiable.

        Raises:
            InputError: an unknown name, or a value out of range.
        """
        return self._changed(replaced(self.simulator, self.parameters, parameters))

    def integrated_by(self, integrator: str) -> "Robot":
        """Returns the robot, stepped by another time integrator."""
        simulator = replace(self.simulator, integrator=integrator)
        description = self.description.stepped_by(simulator)
        return self._changed(self.parameters, simulator=simulator, description=description)

    def in_gravity(self, gravity: ArrayLike) -> "Robot":
        """Returns the robot under another gravity (3,) in axes of the world [m/s^2],
        without an identified tilt.
        """
        known = {name: value for name, value in self.parameters.items() if name not in TILTS}
        simulator = replace(self.simulator, gravity=np.asarray(gravity).tolist())
        description = self.description.stepped_by(simulator, without=TILTS)
        return self._changed(known, simulator=simulator, description=description)

    def _changed(self, parameters: Mapping[str, torch.Tensor | float], **others: Any) -> "Robot":
        """Returns a robot with other parameters and attributes."""
        other = object.__new__(Robot)
        other.__dict__.update(self.__dict__ | others)
        other._set_parameters(parameters)
        return other

    def on(self, mesh: Mesh, **body: Any) -> "Robot":
        """Returns a robot with the material of this one on another body,
        without learned force and markers.

        A learned force belongs to its mesh; the material does not, nor do actuators whose parts
        have the same names in the new body: the response of their inputs goes there, too. Damping
        by mass stays behind, as it stands for what slows this robot down beside its material.
        Directions of fibres are in the axes of the new mesh.

        Args:
            mesh: rest shape.
            body: settings of the body that differ, by key of the configuration, such as
                ``fixed={"z": 0.0}`` or ``chambers=None``.

        Raises:
            InputError: an unknown setting, or one that does not fit the mesh, such as regions of
                the material that it lacks; or a robot whose network replaces the simulator.
            MeshError: the mesh cannot be simulated, or has no vertex where the body is fixed.
        """
        parameters = values_of_material(self.simulator, self.parameters)
        made = Robot(self.description.on(mesh, parameters, body), self.simulator.device)
        response, actuator = moved_actuators(
            self.description, self.parameters, self.simulator, made.simulator
        )
        description = replace(made.description, parameters=parameters | response, actuator=actuator)
        return Robot(description, self.simulator.device) if response or actuator else made

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
        inputs = [
            f"  input {name} [{one.unit}]: {', '.join(one.parts)}"
            for name, one in self.inputs.items()
        ]
        return self.description.summary(self.time_step, inputs)

    def save(self, path: str | Path) -> Path:
        """Writes its description to one safe file (safetensors and JSON)
        that `loading.load` opens on any machine.

        Raises:
            InputError: the name has another extension, something cannot be saved, or parameters
                differ by environment.
            DataFileError: the file cannot be written.
        """
        return self.description.with_values(self.parameters).write(Path(path).expanduser())

    # Observation

    def observe(self, state: State) -> torch.Tensor:
        """Markers (B, M, 3) in a state, as recordings have them.

        Vertices (B, N, 3) if these are observed [m].
        """
        return state.q if self._observe is None else self._observe(state.q)

    def half_widths(
        self, markers: torch.Tensor, since: ArrayLike | None = None
    ) -> NDArray[np.float64] | None:
        """Half-widths (..., M) of the prediction intervals of markers' coordinates.

        They are those of the experiment's report (`learning.intervals`); None if it has none.

        Args:
            markers: (..., M, 3) predicted [m].
            since: (...,) time since the last change of the inputs [s]; None for that at which
                intervals are widest.
        """
        return self.description.half_widths(markers.detach().cpu().numpy(), since)

    # Initial states

    def state(
        self,
        q: ArrayLike | torch.Tensor,
        v: ArrayLike | torch.Tensor | None = None,
        **inputs: Given,
    ) -> State:
        """Returns a state of given positions, in which constant inputs have acted for a long time.

        Args:
            q: (N, 3) or (B, N, 3) [m].
            v: velocities of the same shape [m/s]; zero if omitted.
            inputs: by name, as for `step`.
        """
        at = self._reader.field(q, "q")
        body = State(at, torch.zeros_like(at) if v is None else self._reader.field(v, "v"))
        return self._commands.begin(body, self._read(inputs, len(at)))

    def begin(self, batch: int = 1, **inputs: Given) -> State:
        """Returns the equilibrium of the simulator under its weight and constant inputs,
        without the learned force.

        Trials begin with it. A body that nothing holds (`Simulator.is_held`) keeps its rest shape.

        Args:
            batch: B.
            inputs: by name, as for `step`.

        Raises:
            InputError: an invalid input, as for `step`.
            ConvergenceError: there is no equilibrium.
        """
        values = self._read(inputs, batch)
        state = self._commands.begin(self.simulator.rest_state(batch), values)
        acting = self._commands.act(state, values).inputs
        if not self.simulator.is_held(state, acting, self.constants):
            return state
        base, start = values.get(BASE), None
        if base is not None:
            start = self.simulator.rest_positions @ rotations(base[:, 3:]).mT + base[:, None, :3]
        body = self.simulator.static_equilibrium(acting, self.constants, start, batch)
        return body.with_memory(state.memory_of())

    def settle(self, batch: int = 1, **inputs: Given) -> State:
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
            *_, settled = states(
                lambda state, _: self.step(state, **inputs), start, range(POSE_STEPS)
            )
            return settled
        acting, predictor = self._acting(start, inputs)
        assert predictor is not None
        body = equilibrium_under_feedback(
            self.simulator, acting.inputs, self.constants, start, predictor
        )
        left = start.left if predictor.left_at is None else predictor.left_at >= 0
        return body.with_memory({**start.memory_of(), **acting.memory, "left": left})

    # Motion

    def step(self, state: State, **inputs: Given) -> State:
        """Returns the state after one time step; differentiable.

        Args:
            state: before the step.
            inputs: commands during the step by name: (C,) or (B, C) values, a number for an input
                of one part, or a mapping from parts to numbers (other parts are zero). Omitted
                inputs are zero, an omitted base stays. ``payload`` is a mass in kg, ``base`` the
                pose at the end of the step (x, y, z in m, rotation vector in rad),
                ``external_force`` (N, 3) or (B, N, 3) in N.

        Raises:
            InputError: an unknown input or part, or values of another shape or out of range.
            ConvergenceError: the step failed, and ``on_failure`` is ``raise``.
        """
        acting, predictor = self._acting(state, inputs)
        after = CorrectedSimulator(self.simulator, predictor, acting.inputs, self.constants).step(
            state, 0
        )
        if self.simulator.settings.on_failure == "raise" and bool((after.lost & ~state.lost).any()):
            raise ConvergenceError(
                f"the robot has diverged: a vertex moved further than {DIVERGENCE_DISTANCE:g} "
                "body lengths from where its base holds it at rest; use shorter steps, lower "
                "inputs, or a force that was trained longer.",
                state.q.detach(),
                None,
            )
        return acting.remembered(state, predictor, after)

    def _acting(
        self, state: State, inputs: Mapping[str, Given]
    ) -> tuple[Acting, LearnedPredictor | None]:
        """Returns what acts in a step under commands, and the predictor of its learned force."""
        acting, learned = self.acting(state, **inputs), self._learned
        if learned is None:
            return acting, None
        conditions = None if learned.network.actuation is None else acting.conditions
        frame = None if acting.base is None else BaseFrame(acting.base, self.time_step, first=1)
        return acting, LearnedPredictor(
            learned.network, conditions, learned.range_, self.frames, frame
        )

    def drive(self, state: State, **inputs: Given) -> tuple[Inputs, Callable[[State], State]]:
        """Returns a step's inputs with the learned force,
        and a map from the body after it to the robot's state.

        For a simulator of several bodies (`robot_scene.RobotScene`).

        Args:
            state: before the step.
            inputs: by name, as for `step`.

        Raises:
            InputError: an invalid input, as for `step`.
        """
        acting, predictor = self._acting(state, inputs)
        total = acting.inputs
        if predictor is not None:
            force = predictor(state, 0)
            assert isinstance(force, torch.Tensor)
            total = total.plus(force, predictor.acts)
        return total, lambda body: acting.remembered(state, predictor, body)

    def rollout(
        self,
        state: State,
        steps: int | None = None,
        on_step: Callable[[int], None] = lambda number: None,
        **inputs: Given,
    ) -> Motion:
        """Simulates many steps.

        Args:
            state: initial state.
            steps: T; the length of the longest input if omitted.
            on_step: called with the number of steps done.
            inputs: by name as for `step`, either constant (C,), or a series (T, C) or (T, B, C)
                with values for each step; the last value of a shorter series is held.

        Raises:
            InputError: an invalid input, as for `step`, or no number of steps.
            ConvergenceError: a step failed, and ``on_failure`` is ``raise``.
        """
        acting = self._reader.by_step(inputs, steps, state.batch)

        def step(before: State, number: int) -> State:
            after = self.step(before, **acting[number])
            on_step(number + 1)
            return after

        motion = rollout(step, state, range(len(acting)), lambda reached: reached)
        markers = torch.stack([self.observe(reached) for reached in motion])
        driven = {name: torch.stack([now[name] for now in acting]) for name in inputs if acting}
        return Motion.of(
            motion,
            self.simulator.body,
            self.time_step,
            obstacles=self.simulator.energies.obstacles(motion, self.constants),
            name=f"{self.description.name}, {self.description.model}",
            markers=markers,
            labels=self.labels,
            half_widths=self.half_widths(
                markers, since_change(self.time_step, driven, *markers.shape[:2])
            ),
            left=torch.stack([reached.left for reached in motion]),
            lost=torch.stack([reached.lost for reached in motion]),
            inputs=driven,
            units={name: (self.inputs[name].unit, self.inputs[name].parts) for name in self.driven},
        )

    def acting(self, state: State, **inputs: Given) -> Acting:
        """Returns what acts during a step from a state, except the learned force."""
        return self._commands.act(state, self._read(inputs, state.batch))

    def _read(self, inputs: Mapping[str, Given], batch: int) -> dict[str, torch.Tensor]:
        refuse_transforms()
        return {name: self._reader.read(name, value, batch) for name, value in inputs.items()}
