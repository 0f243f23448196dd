"""The simulation of observed trials.

A replay simulates every trial from its own start, under its own inputs, for one or several sets of
physical parameters at once, and interpolates the observation at the times of the frames. All of it
is differentiable.
"""

import itertools
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch

from ..core.dynamics.linearisation import Linearisation, first_order
from ..core.dynamics.simulator import Constants, Simulator
from ..core.stepping.inputs import Inputs
from ..core.stepping.rollout import on_steps, rollout, sample, states
from ..core.stepping.state import State
from ..data.input_network import InputNetwork
from ..data.input_response import InputResponse, response_of
from ..data.markers import Observation
from ..io.errors import ConvergenceError, InputError
from .parameters import (
    HUNG,
    MASS_FACTOR,
    check_names,
    constants_of,
    identifiable_parameters,
    split_name,
)
from .residuals.correction import acts_of
from .residuals.feedback import equilibrium_under_feedback
from .sensing import readings
from .start import Start
from .trial_batch import TrialBatch

log = logging.getLogger(__name__)

StepForce = Callable[[State, int], torch.Tensor]
Parameters = Mapping[str, torch.Tensor]
Near = Callable[[int], torch.Tensor | None]
Prepared = tuple[Constants, Inputs, Inputs]
Record = Callable[[torch.Tensor, torch.Tensor], None]
Sensed = tuple[torch.Tensor, torch.Tensor]  # points and readings of force sensors

_FIRST, _OTHERS = slice(0, 1), slice(1, None)  # sets of parameters
_AT_ONCE = 16  # positions that are observed together


class Replay:
    """Simulates observed trials.

    Args:
        simulator: of the body; gives the constants that are not a parameter.
        observe: observation of the body, M points.
        trials: observed trials.
        actuator: learned changes of inputs, by input; None without any.

    Attributes:
        parameter_names: names of the accepted parameters: scalar constants of the simulator; those
            of each part of an energy, such as ``tendon_stiffness_left`` of a tendon ``left``; a
            factor on the weights that hang on the body; components of gravity's tilt; and for every
            input a factor on its commands, their delay [s], the rise time [s] of its response, its
            reciprocal slew rate, its dead band, its zero, its backlash and the slopes of its
            characteristic curve: ``pressure_factor``, ``pressure_delay``, ``pressure_rise``,
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
        self.simulator = simulator
        self.observe = observe
        self.trials = trials
        self.actuator = actuator or {}
        self.parameter_names = identifiable_parameters(simulator)
        self._shaped = tuple(
            name for name, q in simulator.parameters.items() if q.shape and name != "gravity"
        )

    def changed(self, **fields: Any) -> "Replay":
        """Returns a replay with other arguments."""
        kept = {
            name: getattr(self, name) for name in ("simulator", "observe", "trials", "actuator")
        }
        return Replay(**{**kept, **fields})

    def prepare(self, parameters: Parameters | None = None) -> Prepared:
        """Returns constants and inputs of E sets of parameters and R trials, as (E R) environments.

        Trials run fastest.

        Args:
            parameters: (E,) values, by any of `parameter_names`, or (E, W) of a constant with W
                values; values of single trials or sessions by `parameters.value_name`, beside the
                common value.

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
        return (
            sim.prepare(constants),
            inputs.replace(**acting, **hung),
            resting.replace(**before, **hung),
        )

    def _spread(self, parameters: Parameters, sets: int) -> dict[str, torch.Tensor]:
        """(E R,) values in all environments, from (E,) values.

        Those of trials and sessions replace the common ones.
        """
        count = len(self.trials.names)
        spread = {
            name: v.repeat_interleave(count, 0)
            for name, v in parameters.items()
            if not split_name(name)[1]
        }
        for name, value in parameters.items():
            parameter, owner = split_name(name)
            mine = [owner in (trial, self.trials.session) for trial in self.trials.names]
            if owner and parameter not in spread:
                raise InputError(
                    f"{name} is the value of one trial: give {parameter}, that of the others, too."
                )
            if owner and any(mine):
                rows = torch.tensor(mine, device=value.device).repeat(sets)
                spread[parameter] = torch.where(
                    rows, value.repeat_interleave(count, 0), spread[parameter]
                )
        return spread

    def _acting(
        self, inputs: Inputs, resting: Inputs, spread: Parameters
    ) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        """Inputs that act under the commanded ones,
        during and before the trials, with parameters (E R,).
        """
        acting, before = {}, {}
        for name, commands in inputs.actuation.items():
            if name in HUNG:
                continue
            parts = self.simulator.parts.get(name, ())
            arguments = response_of(self.simulator.inputs[name], spread, parts, self.actuator)
            response = InputResponse(self.simulator.time_step, **arguments)
            throughout = commands.ndim == 2
            first = resting.actuation.get(name, 0.0 * (commands if throughout else commands[0]))
            acting[name] = (
                response.still(commands)
                if throughout
                else response(response.steady(first), commands)[0]
            )
            if name in resting.actuation or arguments.get("zero") is not None:
                before[name] = response.still(first)
        return acting, before

    def initial_state(
        self,
        start: Start,
        constants: Constants,
        resting: Inputs,
        sets: int = 1,
        force: StepForce | None = None,
    ) -> State:
        """Initial states (E R) of the trials, with the constants and resting inputs of `prepare`.

        The state-dependent force acts on static poses only: they are in equilibrium with the force
        at that equilibrium.

        Args:
            start: of the R trials.
            constants: from `prepare`.
            resting: from `prepare`.
            sets: E, number of sets of parameters.
            force: (B, N, 3) added force [N] of the state and the number of the step.

        Raises:
            ConvergenceError: there is no equilibrium, or `equilibrium_under_feedback` does not
                converge.
        """
        batch = sets * len(self.trials.names)
        q, v = (t.repeat(batch // len(t), 1, 1) for t in (start.state.q, start.state.v))
        if not start.at_rest:
            return State(q, v)
        if force is None or not self.is_static:
            return self.simulator.static_equilibrium(resting, constants, start=q)
        return equilibrium_under_feedback(self.simulator, resting, constants, State(q, v), force)

    @property
    def is_static(self) -> bool:
        """Whether the trials are static poses."""
        return self.trials.observed.shape[1] == 1 and not bool(self.trials.times.any())

    def steps(self, start: Start) -> int:
        """Number of steps to the last frame.

        One more, for the slope there, where frames are between two steps.
        """
        times = (self.trials.times - start.delay[:, None]).clamp_min(0.0)
        last = float(times.max()) / self.simulator.time_step
        return (
            round(last)
            if on_steps(times, self.simulator.time_step)
            else max(math.ceil(last - 1e-6) + 1, 2)
        )

    def __call__(
        self, start: Start, parameters: Parameters | None = None, force: StepForce | None = None
    ) -> torch.Tensor:
        """(E, R, T, M, 3) simulated points at the times of the frames [m].

        Before its release a body stands still.

        Args:
            start: of the R trials.
            parameters: (E,) values, by any of `parameter_names`; E = 1 if left out.
            force: (B, N, 3) added force [N] of the state and the number of the step.

        Raises:
            ConvergenceError: see `Simulator.step`.
        """
        return self.sensed(start, parameters, force)[0]

    def sensed(
        self, start: Start, parameters: Parameters | None = None, force: StepForce | None = None
    ) -> Sensed:
        """Points as of a call, and the readings of the sensors (E, R, T, S, 6) [N, N m]."""
        return self._of_sets(self._series(start, parameters, force), start, _count(parameters))

    def series(
        self, start: Start, parameters: Parameters | None = None, force: StepForce | None = None
    ) -> torch.Tensor:
        """(E R, K + 1, M, 3) simulated points at the steps [m], from the release on.

        For the arguments, see a call.
        """
        return self._series(start, parameters, force)[0]

    def _series(
        self, start: Start, parameters: Parameters | None, force: StepForce | None
    ) -> Sensed:
        """Points as of `series`, and readings (E R, K + 1, S, 6) at the steps [N, N m]."""
        constants, inputs, resting = self.prepare(parameters)

        def step(last: tuple[State, torch.Tensor], k: int) -> tuple[State, torch.Tensor]:
            state = last[0]
            acting = inputs.at(k).plus(None if force is None else force(state, k), acts_of(force))
            new = self.simulator.step(state, acting, constants)
            return new, self.read(new, state, acting, constants)

        begun = self.initial_state(start, constants, resting, _count(parameters), force)
        first = begun, self._first_reading(start, begun, resting, constants)
        seen = rollout(
            step, first, range(self.steps(start)), lambda now: (self.observe(now[0].q), now[1])
        )
        points, loads = (torch.stack([*values], 1) for values in zip(*seen, strict=True))
        return points, loads

    def read(
        self, after: State, before: State | None, inputs: Inputs, constants: Constants
    ) -> torch.Tensor:
        """Returns `readings` of the sensors of the trials."""
        return readings(self.simulator, self.trials.sensors, after, before, inputs, constants)

    def _first_reading(
        self, start: Start, state: State, resting: Inputs, constants: Constants
    ) -> torch.Tensor:
        """Readings (B, S, 6) of the initial state, NaN where no equilibrium led there [N, N m]."""
        if start.at_rest:
            return self.read(state, None, resting, constants)
        return state.q.new_full((state.batch, len(self.trials.sensors), 6), torch.nan)

    @torch.no_grad()
    def states(self, start: Start, parameters: Parameters, near: Near | None = None) -> list[State]:
        """K + 1 states of R trials at the steps, from the release on, with one set of parameters.

        Args:
            start: of the R trials, or of these for several sets of parameters, of which the first
                are taken.
            parameters: (1,) values, by any of `parameter_names`.
            near: predicts the positions (R, N, 3) of a state by its number [m], see
                `Simulator.step`.

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

        return [
            *states(step, self.initial_state(first, constants, resting), range(self.steps(start)))
        ]

    def _observed(self, positions: Iterable[torch.Tensor]) -> torch.Tensor:
        """(B, K, M, 3) points at K positions (B, N, 3) [m],
        `_AT_ONCE` in a call, which is mostly overhead.
        """
        series, rest = list[torch.Tensor](), iter(positions)
        while some := list(itertools.islice(rest, _AT_ONCE)):
            series.append(
                self.observe(torch.cat(some)).unflatten(0, (len(some), -1)).transpose(0, 1)
            )
        return torch.cat(series, 1)

    @torch.no_grad()
    def observed(self, start: Start, states: Sequence[State], parameters: Parameters) -> Sensed:
        """Points (1, R, T, M, 3) [m] and readings (1, R, T, S, 6) [N, N m]
        at the frames, from `states`.
        """
        points = self._observed(state.q for state in states)
        if not self.trials.sensors:
            return self._of_sets((points, points.new_zeros(*points.shape[:2], 0, 6)), start, 1)
        constants, inputs, resting = self.prepare(parameters)
        pairs = enumerate(itertools.pairwise(states))
        loads = [self.read(after, before, inputs.at(k), constants) for k, (before, after) in pairs]
        loads.insert(0, self._first_reading(start, states[0], resting, constants))
        return self._of_sets((points, torch.stack(loads, 1)), start, 1)

    def varied(
        self,
        start: Start,
        parameters: Parameters,
        states: Sequence[State] | None = None,
        record: Record | None = None,
    ) -> Sensed:
        """Points and readings as of `sensed`, for sets of parameters
        that hardly differ from the first.
        """
        return self._of_sets(
            self._varied_series(start, parameters, states, record), start, _count(parameters)
        )

    def varied_series(self, start: Start, parameters: Parameters) -> torch.Tensor:
        """(E R, K + 1, M, 3) points as of `series`,
        for sets of parameters that hardly differ from the first.
        """
        return self._varied_series(start, parameters, None, None)[0]

    @torch.no_grad()
    def _varied_series(
        self,
        start: Start,
        parameters: Parameters,
        states: Sequence[State] | None,
        record: Record | None,
    ) -> Sensed:
        """Points (E R, K + 1, M, 3) and readings (E R, K + 1, S, 6) at the steps,
        for sets that hardly differ.

        The first set is simulated. In its equilibrium and each of its steps, with the solution x,
        the residual g(x) and its derivative H, the solutions of the others are
        x - H^-1 (g'(x) - g(x)), one step of Newton's method from there: differences to the first
        set are exact to first order, for one factor and one residual each.

        Args:
            start: of the R trials, or of these for each set of parameters.
            parameters: (E,) values, by any of `parameter_names`; E is two or more.
            states: `states` of the first set; simulated if omitted.
            record: called for each state with the positions (R, N, 3) of the first set and those of
                the others [m].

        Raises:
            ConvergenceError: see `Simulator.step`.
        """
        first, others = (
            {name: value[chosen] for name, value in parameters.items()}
            for chosen in (_FIRST, _OTHERS)
        )
        states = self.states(start, first) if states is None else states
        return self.varied_points(
            start, self.prepare(first), self.prepare(others), _count(others), states, record
        )

    def varied_points(
        self,
        start: Start,
        first: Prepared,
        others: Prepared,
        sets: int,
        states: Sequence[State],
        record: Record | None = None,
    ) -> Sensed:
        """Points and readings as of `_varied_series`,
        from constants and inputs of `prepare` of E - 1 sets.
        """
        loads = list[torch.Tensor]()

        def positions() -> Iterator[torch.Tensor]:
            for q, read in self._varied_positions(start, first, others, sets, states, record):
                loads.append(read)
                yield q

        points = self._observed(positions())
        return points, torch.stack(loads, 1)

    def _varied_positions(
        self,
        start: Start,
        first: Prepared,
        others: Prepared,
        sets: int,
        states: Sequence[State],
        record: Record | None,
    ) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Yields positions (E R, N, 3) of `varied_series` [m],
        and readings, from the release on.
        """
        constants, inputs, resting = first
        their, their_inputs, their_resting = others
        state = states[0]
        if not start.at_rest:
            whole = self.initial_state(start, constants, resting, 1 + sets)
            varied = whole.map(lambda t: t[state.batch :])
        elif self.simulator.energies.follow_pose:
            varied = self.initial_state(start.near(state.q), their, their_resting, sets)
        else:
            here = self._beside[0].linearise_equilibrium(resting, constants, state.batch)
            there = self._beside[1].linearise_equilibrium(their_resting, their, sets * state.batch)
            state, varied = self._varied(state, state.q, here, there)
        if record is not None:
            record(state.q, varied.q)
        begun = (state, resting, constants), (varied, their_resting, their)
        read = [self._first_reading(start, *now) for now in begun]
        yield torch.cat([state.q, varied.q]), torch.cat(read)
        for k, (state, solved) in enumerate(itertools.pairwise(states)):
            here = self._beside[0].linearise(state, inputs.at(k), constants)
            try:
                there = self._beside[1].linearise(varied, their_inputs.at(k), their)
            except InputError as error:
                message = (
                    "the motion depends so much on the parameters that it has no derivatives "
                    f"from step {k} on."
                )
                raise ConvergenceError(message, None, None) from error
            before, acting = varied, their_inputs.at(k)
            x = self.simulator.method.solution_for(state, solved.q)
            solved, varied = self._varied(solved, x, here, there)
            read = [
                self.read(solved, state, inputs.at(k), constants),
                self.read(varied, before, acting, their),
            ]
            yield torch.cat([solved.q, varied.q]), torch.cat(read)
            if record is not None:
                record(solved.q, varied.q)

    def _varied(
        self, solved: State, x: torch.Tensor, here: Linearisation, there: Linearisation
    ) -> tuple[State, State]:
        """Returns the state with the solution (R, N, 3) x [m], and those of the other sets.

        Reactions at rounded x.
        """
        near, sensed = first_order(x, here, there), bool(self.trials.sensors)
        found = there.reached(near) if sensed else there.finish(near)
        varied = (
            found
            if found.q.dtype == x.dtype
            else found.map(lambda t: t.to(x) if t.is_floating_point() else t)
        )
        reaction = here.reached(x).reaction if sensed else solved.reaction
        return replace(solved, reaction=reaction), replace(varied, reaction=found.reaction)

    @cached_property
    def _beside(self) -> tuple[Simulator, Simulator]:
        """Simulators whose buffers the steps of this one do not use."""
        return replace(self.simulator), replace(self.simulator)

    def _of_sets(self, series: Sensed, start: Start, sets: int) -> Sensed:
        """Points (E, R, T, M, 3) and readings (E, R, T, S, 6) at frames, from those at steps."""
        points, loads = self.at_frames(series[0], start), self.loads_at_frames(series[1], start)
        return points.unflatten(0, (sets, -1)), loads.unflatten(0, (sets, -1))

    def at_frames(self, series: torch.Tensor, start: Start) -> torch.Tensor:
        """(E R, T, M, 3) points at the frames [m], from points (E R, K + 1, M, 3) at the steps."""
        points, sets = self._at_times(series, start), len(series) // len(self.trials.names)
        return start.shifted(points.unflatten(0, (sets, -1))).flatten(0, 1)

    def loads_at_frames(self, series: torch.Tensor, start: Start) -> torch.Tensor:
        """Readings (E R, T, S, 6) at the frames, from those of the steps.

        The midpoint rule has them in its middle.
        """
        halves = self.simulator.integrator == "midpoint" and series.shape[1] > 2
        return self._at_times(series, start, 0.5 * self.simulator.time_step * halves)

    def _at_times(self, series: torch.Tensor, start: Start, ahead: float = 0.0) -> torch.Tensor:
        """Values (E R, T, ...) at the frames, from those at the steps,
        which belong to a time before the end [s].
        """
        times = (self.trials.times - start.delay[:, None]).clamp_min(0.0) + ahead
        return sample(series, times.repeat(len(series) // len(times), 1), self.simulator.time_step)

    def errors(self, simulated: torch.Tensor) -> torch.Tensor:
        """(E, R, T, M, 3) simulated less observed points [m], zero where a point was not seen."""
        return self.observe.residual(simulated, self.trials.observed)


def _count(parameters: Parameters | None) -> int:
    """Number of sets of parameters."""
    return len(next(iter(parameters.values()))) if parameters else 1
