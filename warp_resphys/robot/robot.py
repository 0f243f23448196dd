"""A robot: its identified simulator and its learned force, stepped by the names of its inputs."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csc_array

from ..data.input_response import InputResponse, response_of, told_of
from ..dynamics.frames import BaseFrame, VertexFrames, base_movement, rotations
from ..energies.strings import PAYLOAD, Strings
from ..experiment.experiment import COROTATED
from ..experiment.files import payload_inputs
from ..experiment.models import POSE_STEPS
from ..io.errors import ConvergenceError, InputError
from ..learning.networks import NextState
from ..learning.parameters import MASS_FACTOR, check_known, constants_of, known_parameters
from ..learning.predictors import LearnedPredictor
from ..learning.replay import settled
from ..learning.rollout import FURTHEST, Rollout
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .description import Description
from .inputs import BASE, FORCE, Given, InputReader, inputs_of
from .motion import Motion
from .state import RobotState

SUFFIX: Final = ".safetensors"


class Robot:
    """An experiment's simulator with what was identified and learned; `loading.load` makes one.

    It is constant; states go in and come out. Whatever requires a gradient (states, inputs, parameters) gets one.

    Args:
        description: of what it is.
        device: of the simulation.
        on_failure: ``raise``, or ``count``: environments that diverge stand at rest and are ``lost``.
        parameters: (1,) or (B,) values in place of the identified ones.
        folder: of its run, with the trials; None for one from a file.

    Attributes:
        simulator: of its body.
        inputs: what acts on it, by name.
        time_step: of a step [s].
        labels: of its markers; none where every vertex is observed.
        frames: with which its learned force turns; None if it does not.
        parameters: identified values, by name.
        constants: what these come to.
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
        check_known(parameters, known_parameters(self.simulator))
        given = {**self.description.parameters, **parameters}
        values = {name: self.simulator.tensor(value).reshape(-1) for name, value in given.items()}
        count = max((len(value) for value in values.values()), default=1)
        odd = [name for name, value in values.items() if len(value) not in (1, count)]
        if odd:
            raise InputError(f"{odd[0]} has {len(values[odd[0]])} values, others {count}: give one, or one each.")
        self.parameters = values
        spread = {name: value.expand(count) for name, value in values.items()}
        self.constants = self.simulator.prepare(constants_of(self.simulator, spread))
        filters = self.description.filters if self._learned is not None else ()
        self._responses = {
            name: InputResponse(self.time_step, *response_of(name, values), filters) for name in self.driven
        }

    def with_parameters(self, **parameters: torch.Tensor | float) -> "Robot":
        """The same robot with other values of what was, or could have been, identified; on the same memory.

        Args:
            parameters: numbers, or (B,) tensors with one for each environment; differentiable.

        Raises:
            InputError: an unknown name, or a value out of range.
        """
        other = object.__new__(Robot)
        other.__dict__.update({name: value for name, value in self.__dict__.items() if name != "_payload_share"})
        other._set_parameters({**self.parameters, **parameters})
        return other

    @property
    def driven(self) -> tuple[str, ...]:
        """The inputs of its actuators, by name."""
        return tuple(name for name, each in self.inputs.items() if each.is_driven)

    @property
    def is_data_driven(self) -> bool:
        """Whether a network takes the simulator's place."""
        return self._learned is not None and isinstance(self._learned.network, NextState)

    def __repr__(self) -> str:
        """What it is, in some lines."""
        body, known = self.simulator.body, self.description
        lines = [
            f"Robot {known.name}, {known.model}: {body.n_vertices} vertices, "
            f"{len(self.labels) or 'no'} markers, steps of {1e3 * self.time_step:g} ms"
        ]
        for each in self.inputs.values():
            lines.append(f"  input {each.name} [{each.unit}]: {', '.join(each.parts)}")
        lines += [f"  identified {name}: {value:.6g}" for name, value in known.parameters.items()]
        if known.errors_mm.get("mean") is not None:
            lines.append(f"  mean error in the trials that tested it: {known.errors_mm['mean']:.3g} mm")
        return "\n".join(lines)

    def save(self, path: str | Path) -> Path:
        """Writes it, as it was described, into one safe file (safetensors and JSON) that `loading.load` opens anywhere.

        Raises:
            InputError: the name has another extension.
            DataFileError: it cannot be written.
        """
        place = Path(path).expanduser()
        if place.suffix != SUFFIX:
            raise InputError(f"{place} does not end in {SUFFIX}: give such a name.")
        self.description.write(place)
        return place

    # What it shows

    def observe(self, state: RobotState) -> torch.Tensor:
        """(B, M, 3) its markers, as recordings show them, or (B, N, 3) all vertices where these are observed [m]."""
        return state.q if self._observe is None else self._observe(state.q)

    def half_widths(self, markers: torch.Tensor) -> NDArray[np.float64] | None:
        """(..., M) half-widths of the prediction intervals of the coordinates of (..., M, 3) markers [m].

        They are those of the experiment's report (`learning.intervals`); None where it has none.
        """
        known = self.description
        if known.intervals is None or known.bound is None:
            return None
        return known.intervals.half_widths(markers.detach().cpu().numpy(), known.bound.numpy())

    # Where it begins

    def state(self, q: ArrayLike | torch.Tensor, v: ArrayLike | torch.Tensor | None = None) -> RobotState:
        """A state of given positions, before which no input has come.

        Args:
            q: (N, 3) or (B, N, 3) [m].
            v: the same [m/s]; at rest, if left out.
        """
        at = self._reader.field(q, "q")
        return self._new(State(at, torch.zeros_like(at) if v is None else self._reader.field(v, "v")))

    def begin(self, batch: int = 1, **inputs: Given) -> RobotState:
        """The simulator at rest under its weight and constant inputs, as trials begin; without the learned force.

        Args:
            batch: B.
            inputs: see `step`.

        Raises:
            InputError: see `step`.
            ConvergenceError: there is no equilibrium.
        """
        given = self._read(inputs, batch)
        if not len(self.simulator.fixed):
            return self._new(self.simulator.rest_state(batch), given)
        state = self._new(self.simulator.rest_state(batch), given)
        acting, _, _, _ = self._acting(state, given)
        return replace(state, body=self.simulator.static_equilibrium(acting, self.constants, batch=batch))

    def settle(self, batch: int = 1, **inputs: Given) -> RobotState:
        """Where the robot comes to rest under constant inputs, with its learned force.

        Args:
            batch: B.
            inputs: see `step`.

        Raises:
            InputError: see `step`.
            ConvergenceError: it does not come to rest.
        """
        start = self.begin(batch, **inputs)
        if self._learned is None:
            return start
        if self.is_data_driven:
            for _ in range(POSE_STEPS):
                start = self.step(start, **inputs)
            return start
        acting, told, memory, base = self._acting(start, self._read(inputs, batch))
        predictor = self._predictor(told, self._frame(base))

        def force(state: State) -> torch.Tensor:
            found = predictor(state, 0)
            assert isinstance(found, torch.Tensor)
            return found

        body = settled(self.simulator, acting, self.constants, start.body, force)
        left = start.left if predictor.left_at is None else predictor.left_at >= 0
        return replace(start, body=body, memory={**start.memory, **memory}, left=left)

    def settle_some(self, batch: int = 1, **inputs: Given) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, N, 3) where `settle` comes to rest [m], and (B,) bool, which of them do; elsewhere it is no equilibrium.

        Raises:
            InputError: see `step`.
            ConvergenceError: the simulator itself has no equilibrium.
        """
        try:
            found = self.settle(batch, **inputs).q
        except ConvergenceError as error:
            if not isinstance(error.report, torch.Tensor):
                raise
            return error.positions.detach(), error.report
        return found, torch.ones(batch, dtype=torch.bool, device=found.device)

    # How it moves

    def step(self, state: RobotState, **inputs: Given) -> RobotState:
        """The state one time step on; differentiable.

        Args:
            state: where it is.
            inputs: by name, what is commanded during the step: (C,) or (B, C) values, a number where there is one part,
                or numbers by the names of parts, the others zero. Those that are left out are zero, and the base stays.
                ``payload`` is a mass in kg, ``base`` the pose at the end of the step (x, y, z in m, rotation vector in
                rad), ``external_force`` (N, 3) or (B, N, 3) in N.

        Raises:
            InputError: an unknown input, a part that there is not, or values of another shape or out of range.
            ConvergenceError: the step failed; unless failures are counted.
        """
        acting, told, memory, base = self._acting(state, self._read(inputs, state.batch))
        predictor = None
        if self._learned is not None:
            predictor = self._predictor(told, self._frame(base))
            predictor.hidden = state.hidden
        rollout = Rollout(self.simulator, predictor, acting, self.constants)
        rollout.resume(state.lost, 0)
        body = rollout.differentiable_step(state.body)
        now = rollout.lost(body)
        if self.simulator.settings.on_failure == "raise" and bool((now & ~state.lost).any()):
            raise ConvergenceError(
                f"the robot has diverged: a vertex went further than {FURTHEST:g} of its lengths; take shorter steps, "
                "lower inputs, or a force that was trained longer.",
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
        """Steps many times.

        Args:
            state: the start.
            steps: T; as many as the longest input has, if left out.
            on_step: called with the number of steps that are done.
            inputs: as `step` takes them, (C,) throughout, or (T, C) or (T, B, C) during each step; past the end of a
                series, its last.

        Raises:
            InputError: see `step`; or no number of steps.
            ConvergenceError: see `step`.
        """
        series = {name: self._reader.series(name, value, state.batch) for name, value in inputs.items()}
        lengths = [len(value) for name, value in series.items() if self._reader.is_series(name, inputs[name])]
        if steps is None and not lengths:
            raise InputError("no number of steps: give `steps`, or an input with a value for each step.")
        count = max(lengths, default=0) if steps is None else steps
        states, acting = [state], list[dict[str, torch.Tensor]]()
        for number in range(count):
            now = {name: value[min(number, len(value) - 1)] for name, value in series.items()}
            state = self.step(state, **now)
            states.append(state)
            acting.append(now)
            on_step(number + 1)
        markers = torch.stack([self.observe(each) for each in states])
        return Motion(
            robot=self.description,
            times=self.time_step * np.arange(count + 1, dtype=np.float64),
            q=torch.stack([each.q for each in states]),
            v=torch.stack([each.v for each in states]),
            markers=markers,
            half_widths=self.half_widths(markers),
            left=torch.stack([each.left for each in states]),
            lost=torch.stack([each.lost for each in states]),
            inputs={name: torch.stack([each[name] for each in acting]) for name in series if acting},
            known_inputs=self.inputs,
            final=state,
        )

    # What it consists of, at a state

    def begin_memory(self, inputs: Mapping[str, Given], batch: int = 1) -> dict[str, torch.Tensor]:
        """What is remembered where constant inputs have lasted; see `RobotState.memory`."""
        return dict(self._new(self.simulator.rest_state(batch), self._read(inputs, batch)).memory)

    def told(self, state: RobotState, **inputs: Given) -> torch.Tensor | None:
        """(B, A) what the network is told beside the state during a step; see `program.told_names`."""
        return self._acting(state, self._read(inputs, state.batch))[1]

    def linearised(
        self, state: RobotState, **inputs: Given
    ) -> tuple[csc_array, NDArray[np.float64], NDArray[np.int64]]:
        """The simulator's Hessian of a step from a state, at that state, without the learned force.

        Returns:
            The (3 F, 3 F) Hessian and the (3 F,) inertia in it [N/m], and the numbers of the F free vertices.
        """
        acting = self._acting(state, self._read(inputs, state.batch))[0]
        found = self.simulator.linearise(state.body, acting, self.constants)
        hessian, inertia = found.matrix(state.q)
        return hessian, inertia, found.free.cpu().numpy()

    # Inputs

    def _read(self, inputs: Mapping[str, Given], batch: int) -> dict[str, torch.Tensor]:
        return {name: self._reader.read(name, value, batch) for name, value in inputs.items()}

    def _new(self, body: State, given: Mapping[str, torch.Tensor] | None = None) -> RobotState:
        """A state before which constant inputs (B, C) have acted for long; none, if left out."""
        memory: dict[str, torch.Tensor] = {}
        for name, response in self._responses.items():
            value = (given or {}).get(name)
            nothing = body.q.new_zeros(body.batch, len(self.inputs[name].parts))
            still = response.still(nothing if value is None else value)
            memory |= {f"{name}.{key}": each for key, each in still.items()}
        base = (given or {}).get(BASE)
        moved = self.description.told_of_base is not None or base is not None
        at = body.q.new_zeros(body.batch, len(self.inputs[BASE].parts)) if base is None else base
        return RobotState(body, memory, base=torch.stack([at, at]) if moved else None)

    @cached_property
    def _payload_share(self) -> torch.Tensor:
        """(1, N) the share of a payload that hangs on each vertex."""
        share = payload_inputs(self.simulator.body, self.description.payload_at, np.ones(1))["attached_mass"]
        return self.simulator.tensor(share)

    def _acting(
        self, state: RobotState, given: Mapping[str, torch.Tensor]
    ) -> tuple[Inputs, torch.Tensor | None, dict[str, torch.Tensor], torch.Tensor | None]:
        """What acts during a step, what a network is told, the next memory, and (3, B, 6) the base from a step ago."""
        fields: dict[str, torch.Tensor | None] = {FORCE: given.get(FORCE)}
        told, memory = list[torch.Tensor](), dict[str, torch.Tensor]()
        payload = given.get(PAYLOAD.name)
        if self.description.payload_at is not None and self.description.sees_payload:
            told.append(state.q.new_zeros(state.batch, 1) if payload is None else payload)
        for name, response in self._responses.items():
            value, own = given.get(name), f"{name}."
            nothing = state.q.new_zeros(state.batch, len(self.inputs[name].parts))
            remembered = {key.removeprefix(own): each for key, each in state.memory.items() if key.startswith(own)}
            acting, means, later = response(remembered, (nothing if value is None else value)[None])
            fields[name] = acting[0]
            told += [told_of(acting[0], means[:, 0])] if name in self.description.seen else []
            memory |= {f"{own}{key}": each for key, each in later.items()}
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
                told.append(moved[:, torch.tensor(self.description.told_of_base, device=moved.device)])
        return Inputs(**fields), torch.cat(told, -1) if told else None, memory, base

    def _hung(self, payload: torch.Tensor) -> dict[str, torch.Tensor]:
        """What a payload (B, 1) [kg] is for the simulator."""
        factor = self.parameters.get(MASS_FACTOR)
        mass = payload if factor is None else payload * factor[:, None]
        if any(isinstance(energy, Strings) for energy in self.simulator.body.energies):
            return {PAYLOAD.name: mass}
        return {"attached_mass": mass * self._payload_share}

    def _fixed(self, pose: torch.Tensor) -> torch.Tensor:
        """(B, D, 3) where poses (B, 6) of the base have the fixed vertices [m]."""
        rest = self.simulator.rest_positions[self.simulator.fixed]
        return rest @ rotations(pose[:, 3:]).mT + pose[:, None, :3]

    def _frame(self, base: torch.Tensor | None) -> BaseFrame | None:
        return None if base is None else BaseFrame(base, self.time_step, first=1)

    def _predictor(self, told: torch.Tensor | None, base: BaseFrame | None) -> LearnedPredictor:
        learned = self._learned
        assert learned is not None
        given = None if learned.network.actuation is None else told
        return LearnedPredictor(learned.network, given, learned.range_, self.frames, base)
