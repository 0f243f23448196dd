"""The simulation of observed trials.

A replay simulates every trial from its own start, under its own inputs, for one or several sets of physical parameters
at once, and interpolates the observation at the times of the frames. All of it is differentiable.
"""

import itertools
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch

from ..data.input_network import InputNetwork
from ..data.input_response import InputResponse, response_of
from ..data.markers import Observation
from ..dynamics.linearisation import Linearisation
from ..dynamics.simulator import Constants, Simulator
from ..io.arrays import Brief
from ..io.errors import ConvergenceError, InputError
from ..stepping.inputs import Inputs
from ..stepping.rollout import on_steps, rollout, sample, states
from ..stepping.state import State
from .parameters import HUNG, MASS_FACTOR, check_names, constants_of, identifiable_parameters, split_name
from .residuals.correction import equilibrium_under_feedback
from .trial_batch import TrialBatch

log = logging.getLogger(__name__)

StepForce = Callable[[State, int], torch.Tensor]
Parameters = Mapping[str, torch.Tensor]
Near = Callable[[int], torch.Tensor | None]
Prepared = tuple[Constants, Inputs, Inputs]
Record = Callable[[torch.Tensor, torch.Tensor], None]

_FIRST, _OTHERS = slice(0, 1), slice(1, None)  # sets of parameters
_AT_ONCE = 16  # positions that are observed together
_EXACT = 1e-12  # relative tolerance of a solver, small enough for differences of solutions


@dataclass(frozen=True)
class Start(Brief):
    """Initial conditions of R trials."""

    state: State  # (R, N, 3) positions [m] and velocities [m/s]; a first guess where the trials begin at rest
    delay: torch.Tensor  # (R,) between time zero of the frames and the release of the body, or of its inputs [s]
    # (R, M, 3) true less bound marker places, where a body was held bent but registered as undeformed [m]; None for
    # no shift
    shift: torch.Tensor | None = None
    # whether the bodies begin in equilibrium, which is then solved again for every set of parameters
    at_rest: bool = False

    @classmethod
    def resting(cls, guess: torch.Tensor) -> "Start":
        """Starts in equilibrium, which is solved from a first guess (R, N, 3) [m]."""
        return cls(State(guess, torch.zeros_like(guess)), guess.new_zeros(len(guess)), at_rest=True)

    def near(self, q: torch.Tensor) -> "Start":
        """The start with another first guess of its equilibrium [m], (R or E R, N, 3) for E sets of parameters."""
        return replace(self, state=State(q, torch.zeros_like(q)))

    def select(self, indices: list[int]) -> "Start":
        """The start of the trials with these indices."""
        pick = torch.as_tensor(indices, device=self.delay.device)
        shift = None if self.shift is None else self.shift[pick]
        return replace(self, state=self.state.map(lambda t: t[pick]), delay=self.delay[pick], shift=shift)

    def shifted(self, markers: torch.Tensor) -> torch.Tensor:
        """(..., R, T, M, 3) true marker positions, from those of bound markers [m]."""
        return markers if self.shift is None else markers + self.shift[:, None]

    def bound(self, markers: torch.Tensor) -> torch.Tensor:
        """(R, T, M, 3) positions of bound markers, from true marker positions [m]."""
        return markers if self.shift is None else markers - self.shift[:, None]


def exact(simulator: Simulator) -> Simulator:
    """Returns a simulator whose solutions differ by their parameters alone, also where these hardly differ."""
    return replace(simulator, solver=simulator.settings.changed(relative_tolerance=_EXACT))


class Replay:
    """Simulates observed trials.

    Args:
        simulator: of the body; gives the constants that are not a parameter.
        observe: observation of the body, M points.
        trials: observed trials.
        actuator: learned changes of inputs, by input; None without any.

    Attributes:
        parameter_names: names of the accepted parameters: scalar constants of the simulator; those of each part of an
            energy, such as ``tendon_stiffness_left`` of a tendon ``left``; a factor on the weights that hang on the
            body; components of gravity's tilt; and for every input a factor on its commands, their delay [s], the rise
            time [s] of its response, its reciprocal slew rate, its dead band, its zero, its backlash and the
            slopes of its characteristic curve: ``pressure_factor``, ``pressure_delay``, ``pressure_rise``,
            ``pressure_slew``, ``pressure_dead_band``, ``pressure_zero``, ``pressure_backlash`` and
            ``pressure_slope_1``.
    """

    def __init__(
        self,
        simulator: Simulator,
        observe: Observation,
        trials: TrialBatch,
        actuator: Mapping[str, InputNetwork] | None = None,
    ) -> None:
        self.simulator, self.observe, self.trials, self.actuator = simulator, observe, trials, actuator or {}
        self.parameter_names = identifiable_parameters(simulator)
        self._shaped = tuple(name for name, q in simulator.parameters.items() if q.shape and name != "gravity")

    def changed(self, **fields: Any) -> "Replay":
        """Returns a replay with other arguments."""
        kept = {name: getattr(self, name) for name in ("simulator", "observe", "trials", "actuator")}
        return Replay(**{**kept, **fields})

    def prepare(self, parameters: Parameters | None = None) -> Prepared:
        """Returns constants and inputs of E sets of parameters and R trials, as (E R) environments; trials run fastest.

        Args:
            parameters: (E,) values, by any of `parameter_names`, or (E, W) of a constant with W values; values of
                single trials or sessions by `parameters.value_name`, beside the common value.

        Returns:
            The constants, the inputs of the trials, and those before time zero.

        Raises:
            InputError: an unknown parameter.
        """
        parameters = {} if parameters is None else parameters
        check_names([name for name in parameters if name not in self._shaped], self.parameter_names)
        sim = self.simulator
        sets = _count(parameters)
        spread = self._spread(parameters, sets)
        constants = constants_of(sim, spread)
        inputs, resting = self.trials.inputs.repeat(sets), self.trials.resting.repeat(sets)
        hung = {name: weight for name, weight in inputs.fields.items() if name in HUNG}
        if MASS_FACTOR in spread:
            hung = {name: weight * spread[MASS_FACTOR][:, None] for name, weight in hung.items()}
        acting, before = self._acting(inputs, resting, spread)
        return sim.prepare(constants), inputs.replace(**acting, **hung), resting.replace(**before, **hung)

    def _spread(self, parameters: Parameters, sets: int) -> dict[str, torch.Tensor]:
        """(E R,) values in all environments, from (E,) values; those of trials and sessions replace the common ones."""
        count = len(self.trials.names)
        spread = {name: v.repeat_interleave(count, 0) for name, v in parameters.items() if not split_name(name)[1]}
        for name, value in parameters.items():
            parameter, owner = split_name(name)
            mine = [owner in (trial, self.trials.session) for trial in self.trials.names]
            if owner and parameter not in spread:
                raise InputError(f"{name} is the value of one trial: give {parameter}, that of the others, too.")
            if owner and any(mine):
                rows = torch.tensor(mine, device=value.device).repeat(sets)
                spread[parameter] = torch.where(rows, value.repeat_interleave(count, 0), spread[parameter])
        return spread

    def _acting(
        self, inputs: Inputs, resting: Inputs, spread: Parameters
    ) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        """Inputs that act under the commanded ones, during and before the trials, with parameters (E R,)."""
        acting, before = {}, {}
        for name, commands in inputs.actuation.items():
            if name in HUNG:
                continue
            parts = self.simulator.parts.get(name, ())
            arguments = response_of(self.simulator.inputs[name], spread, parts, self.actuator)
            response = InputResponse(self.simulator.time_step, **arguments)
            throughout = commands.ndim == 2
            first = resting.actuation.get(name, 0.0 * (commands if throughout else commands[0]))
            acting[name] = response.still(commands) if throughout else response(response.steady(first), commands)[0]
            if name in resting.actuation or arguments.get("zero") is not None:
                before[name] = response.still(first)
        return acting, before

    def initial_state(
        self, start: Start, constants: Constants, resting: Inputs, sets: int = 1, force: StepForce | None = None
    ) -> State:
        """Initial states (E R) of the trials, with the constants and resting inputs of `prepare`.

        The state-dependent force acts on static poses only: they are in equilibrium with the force at that equilibrium.

        Args:
            start: of the R trials.
            constants: from `prepare`.
            resting: from `prepare`.
            sets: E, number of sets of parameters.
            force: (B, N, 3) added force [N] of the state and the number of the step.

        Raises:
            ConvergenceError: there is no equilibrium, or `equilibrium_under_feedback` does not converge.
        """
        batch = sets * len(self.trials.names)
        q, v = (t.repeat(batch // len(t), 1, 1) for t in (start.state.q, start.state.v))
        if not start.at_rest:
            return State(q, v)
        if force is None or not self.is_static:
            return self.simulator.static_equilibrium(resting, constants, start=q)
        return equilibrium_under_feedback(
            self.simulator, resting, constants, State(q, v), lambda state: force(state, 0)
        )

    @property
    def is_static(self) -> bool:
        """Whether the trials are static poses."""
        return self.trials.observed.shape[1] == 1 and not bool(self.trials.times.any())

    def steps(self, start: Start) -> int:
        """Number of steps to the last frame; one more, for the slope there, where frames are between two steps."""
        times = (self.trials.times - start.delay[:, None]).clamp_min(0.0)
        last = float(times.max()) / self.simulator.time_step
        return round(last) if on_steps(times, self.simulator.time_step) else max(math.ceil(last - 1e-6) + 1, 2)

    def __call__(
        self, start: Start, parameters: Parameters | None = None, force: StepForce | None = None
    ) -> torch.Tensor:
        """(E, R, T, M, 3) simulated points at the times of the frames [m]; before its release a body stands still.

        Args:
            start: of the R trials.
            parameters: (E,) values, by any of `parameter_names`; E = 1 if left out.
            force: (B, N, 3) added force [N] of the state and the number of the step.

        Raises:
            ConvergenceError: see `Simulator.step`.
        """
        series = self.series(start, parameters, force)
        return self.at_frames(series, start).unflatten(0, (_count(parameters), -1))

    def series(
        self, start: Start, parameters: Parameters | None = None, force: StepForce | None = None
    ) -> torch.Tensor:
        """(E R, K + 1, M, 3) simulated points at the steps [m], from the release on; for the arguments, see a call."""
        constants, inputs, resting = self.prepare(parameters)

        def step(state: State, k: int) -> State:
            added = None if force is None else force(state, k)
            return self.simulator.step(state, inputs.at(k).plus(added), constants)

        begun = self.initial_state(start, constants, resting, _count(parameters), force)
        return torch.stack(rollout(step, begun, range(self.steps(start)), lambda state: self.observe(state.q)), 1)

    @torch.no_grad()
    def states(self, start: Start, parameters: Parameters, near: Near | None = None) -> list[State]:
        """K + 1 states of R trials at the steps, from the release on, with one set of parameters.

        Args:
            start: of the R trials, or of these for several sets of parameters, of which the first are taken.
            parameters: (1,) values, by any of `parameter_names`.
            near: predicts the positions (R, N, 3) of a state by its number [m], see `Simulator.step`.

        Raises:
            ConvergenceError: see `Simulator.step`.
        """
        constants, inputs, resting = self.prepare(parameters)
        first = replace(start, state=start.state.map(lambda t: t[: len(self.trials.names)]))

        def step(state: State, k: int) -> State:
            predicted = None if near is None else near(k + 1)
            if predicted is not None:
                try:
                    return self.simulator.step(state, inputs.at(k), constants, predicted)
                except ConvergenceError as error:
                    log.debug("the step is solved again without a prediction: %s", error)
            return self.simulator.step(state, inputs.at(k), constants)

        return [*states(step, self.initial_state(first, constants, resting), range(self.steps(start)))]

    def _observed(self, positions: Iterable[torch.Tensor]) -> torch.Tensor:
        """(B, K, M, 3) points at K positions (B, N, 3) [m], `_AT_ONCE` in a call, which is mostly overhead."""
        series, rest = list[torch.Tensor](), iter(positions)
        while some := list(itertools.islice(rest, _AT_ONCE)):
            series.append(self.observe(torch.cat(some)).unflatten(0, (len(some), -1)).transpose(0, 1))
        return torch.cat(series, 1)

    def seen(self, start: Start, states: Sequence[State]) -> torch.Tensor:
        """(1, R, T, M, 3) points at the times of the frames [m], from `states`."""
        return self.at_frames(self._observed(state.q for state in states), start)[None]

    def varied(
        self, start: Start, parameters: Parameters, states: Sequence[State] | None = None, record: Record | None = None
    ) -> torch.Tensor:
        """(E, R, T, M, 3) simulated points as of a call, for sets of parameters that hardly differ from the first."""
        series = self.varied_series(start, parameters, states, record)
        return self.at_frames(series, start).unflatten(0, (_count(parameters), -1))

    @torch.no_grad()
    def varied_series(
        self, start: Start, parameters: Parameters, states: Sequence[State] | None = None, record: Record | None = None
    ) -> torch.Tensor:
        """(E R, K + 1, M, 3) points as of `series`, for sets of parameters that hardly differ from the first.

        The first set is simulated. In its equilibrium and each of its steps, with the solution x, the residual g(x) and
        its derivative H, the solutions of the others are x - H^-1 (g'(x) - g(x)), one step of Newton's method from
        there: differences to the first set are exact to first order, for one factor and one residual each.

        Args:
            start: of the R trials, or of these for each set of parameters.
            parameters: (E,) values, by any of `parameter_names`; E is two or more.
            states: `states` of the first set; simulated if omitted.
            record: called for each state with the positions (R, N, 3) of the first set and those of the others [m].

        Raises:
            ConvergenceError: see `Simulator.step`.
        """
        first, others = ({name: value[chosen] for name, value in parameters.items()} for chosen in (_FIRST, _OTHERS))
        states = self.states(start, first) if states is None else states
        return self.varied_points(start, self.prepare(first), self.prepare(others), _count(others), states, record)

    def varied_points(
        self,
        start: Start,
        first: Prepared,
        others: Prepared,
        sets: int,
        states: Sequence[State],
        record: Record | None = None,
    ) -> torch.Tensor:
        """(E R, K + 1, M, 3) points as of `varied_series`, from constants and inputs of `prepare` of E - 1 sets."""
        return self._observed(self._varied_positions(start, first, others, sets, states, record))

    def _varied_positions(
        self, start: Start, first: Prepared, others: Prepared, sets: int, states: Sequence[State], record: Record | None
    ) -> Iterator[torch.Tensor]:
        """Yields the positions (E R, N, 3) of `varied_series` [m], from the release on."""
        (constants, inputs, resting), (their, their_inputs, their_resting), state = first, others, states[0]
        if not start.at_rest:
            whole = self.initial_state(start, constants, resting, 1 + sets)
            varied = whole.map(lambda t: t[state.batch :])
        elif self.simulator.energies.follow_pose:
            varied = self.initial_state(start.near(state.q), their, their_resting, sets)
        else:
            here = self._beside[0].linearise_equilibrium(resting, constants, state.batch)
            there = self._beside[1].linearise_equilibrium(their_resting, their, sets * state.batch)
            varied = self._varied(state.q, here, there)
        if record is not None:
            record(state.q, varied.q)
        yield torch.cat([state.q, varied.q])
        for k, (state, solved) in enumerate(itertools.pairwise(states)):
            here = self._beside[0].linearise(state, inputs.at(k), constants)
            try:
                there = self._beside[1].linearise(varied, their_inputs.at(k), their)
            except InputError as error:
                message = f"the motion depends so much on the parameters that it has no derivatives from step {k} on."
                raise ConvergenceError(message, None, None) from error
            varied = self._varied(self.simulator.method.solution_for(state, solved.q), here, there)
            yield torch.cat([solved.q, varied.q])
            if record is not None:
                record(solved.q, varied.q)

    def _varied(self, x: torch.Tensor, here: Linearisation, there: Linearisation) -> State:
        """Returns the states of the other sets of parameters, from the solution (R, N, 3) x of the first [m]."""
        here.factorise(x)
        sets = len(there.start) // len(x)
        at = x.repeat(sets, 1, 1)
        forces = (there.residual(at) - here.residual(x).repeat(sets, 1, 1)).unflatten(0, (sets, -1))
        moved = here.solve(forces.permute(1, 2, 3, 0).flatten(1, 2)).unflatten(1, (-1, 3))
        return there.finish(at - moved.permute(3, 0, 1, 2).flatten(0, 1))

    @cached_property
    def _beside(self) -> tuple[Simulator, Simulator]:
        """Simulators whose buffers the steps of this one do not use."""
        return replace(self.simulator), replace(self.simulator)

    def at_frames(self, series: torch.Tensor, start: Start) -> torch.Tensor:
        """(E R, T, M, 3) points at the frames [m], from points (E R, K + 1, M, 3) at the steps."""
        sets = len(series) // len(self.trials.names)
        times = (self.trials.times - start.delay[:, None]).clamp_min(0.0).repeat(sets, 1)
        points = sample(series, times, self.simulator.time_step)
        return start.shifted(points.unflatten(0, (sets, -1))).flatten(0, 1)

    def errors(self, simulated: torch.Tensor) -> torch.Tensor:
        """(E, R, T, M, 3) simulated less observed points [m], zero where a point was not seen."""
        return self.observe.residual(simulated, self.trials.observed)


def _count(parameters: Parameters | None) -> int:
    """Number of sets of parameters."""
    return len(next(iter(parameters.values()))) if parameters else 1
