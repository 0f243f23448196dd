"""Observed motions of a body: how they begin, and what a simulator
and a network need to replay them.

`identification`, `reconstruction`, `training` and `evaluation` learn from them and test on them.
"""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self, SupportsFloat

import numpy as np
import torch
from numpy.typing import NDArray

from ..core.dynamics.frames import BaseFrame, base_movement
from ..core.dynamics.simulator import Simulator
from ..core.mesh.place import Place
from ..core.stepping.inputs import Inputs
from ..core.stepping.state import State
from ..data.force_sensors import ForceSensor
from ..data.input_network import InputNetwork
from ..data.input_response import InputResponse, with_means
from ..data.markers import WHOLE_STATE, Markers, NoPoints, Observation, WholeState
from ..data.trials import GIVEN, RELEASED, RESTING, STATIC, UNDER_INPUTS, Trials
from ..io.arrays import Brief
from ..io.errors import ConvergenceError, InputError, checks_types, in_short, listed
from ..settings.learning import ActuationSettings, ReleaseSettings
from .parameters import split_name
from .placement import PlacedMarkers, PlainPlacements, placement_of
from .release import begin_inputs, estimate_release
from .replay import Replay
from .scores import HeldOutTest
from .sensing import at_steps, later
from .start import Start
from .trial_batch import TrialBatch

_STANDS_STILL = 1e-9  # m/s, rad/s


@dataclass(frozen=True)
class Identified(Brief):
    """Identified parameters of a simulator, and marker places.

    Attributes:
        parameters: values that all trials share, by name.
        of_trials: values of single trials and sessions, by `parameters.value_name`.
        placement: of the markers, see `placement.placement_of`; None if it is exact.
        first_frames: first seconds of the trials from which values of a trial or session were
            estimated that nothing else was identified from, by its name and that of the trial [s];
            these frames count in no test error.
        actuator: learned changes of the inputs, by input; from `fit_actuator`.
        test: of the actuator on held-out trials; None: it was not tested.
    """

    parameters: Mapping[str, float] = field(default_factory=dict)
    of_trials: Mapping[str, float] = field(default_factory=dict)
    placement: PlainPlacements | None = None
    first_frames: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    actuator: Mapping[str, InputNetwork] = field(default_factory=dict)
    test: HeldOutTest | None = None

    @classmethod
    def of(cls, parameters: "Identified | Mapping[str, float] | None") -> "Identified":
        """Returns parameters given as a mapping, or none.

        Raises InputError for a value that is no number.
        """
        if isinstance(parameters, Identified):
            return parameters
        for name, value in (parameters or {}).items():
            if not isinstance(value, SupportsFloat) or getattr(value, "shape", ()) != ():
                raise InputError(f"the parameter {name} is {in_short(value)}: it must be a number.")
        return cls(parameters or {})

    def values(self, simulator: Simulator) -> dict[str, torch.Tensor]:
        """Returns (1,) values of all parameters, on the device of a simulator."""
        return {
            name: simulator.tensor([value])
            for name, value in {**self.parameters, **self.of_trials}.items()
        }


@dataclass(frozen=True)
class ObservedMotions(Brief):
    """Trials of one body with an observation, as simulators replay them.

    Attributes:
        trials: of all names.
        observe: observation of the body, M points: markers, all vertices, or another sensor.
        release: how the start of a motion is estimated.
        payload_at: vertices that carry the payloads of the trials; None if there are none.
        actuation: inputs of networks beside the state.
        train_fraction: share of every trial, from its beginning, that is learned from.
        sensors: force sensors, by the name of their readings in the trials.

    Raises:
        InputError: readings without a sensor, or a sensor without readings.
    """

    trials: Trials
    observe: Observation = WHOLE_STATE
    release: ReleaseSettings = field(default_factory=ReleaseSettings)
    payload_at: Place | None = None
    actuation: ActuationSettings = field(default_factory=ActuationSettings)
    train_fraction: float = 1.0
    sensors: Mapping[str, ForceSensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Checks that sensors and readings belong together."""
        odd = {*self.sensors} ^ {*self.trials.loads}
        if odd:
            raise InputError(
                f"force sensors are {listed([*self.sensors]) or 'none'}, but the trials have "
                f"readings of {listed([*self.trials.loads]) or 'none'}: give "
                f"{listed(sorted(odd))} both, or none."
            )

    @classmethod
    @checks_types
    def of(
        cls,
        simulator: Simulator,
        observed: torch.Tensor | Sequence[Any] | NDArray[np.float64] | None,
        start: State | None = None,
        inputs: Inputs | None = None,
        resting: Inputs | None = None,
        observation: Observation = WHOLE_STATE,
        loads: Mapping[str, torch.Tensor | NDArray[np.float64]] | None = None,
        **more: Any,
    ) -> Self:
        """Returns motions of which every step of a simulator was observed.

        Args:
            simulator: of the same time step and body.
            observed: (T + 1, B, M, D) measured points [unit of `observation`], NaN where a point
                was not seen; by default positions of all vertices, as in `Motion.q`. (T + 1, M, D)
                is one motion; None: forces alone.
            start: initial positions and velocities; None: at rest in equilibrium under `resting`.
            inputs: during the motion, with or without a time axis.
            resting: inputs before the motion, where `start` is None.
            observation: the sensor, such as markers from `bind_markers`.
            loads: (T + 1, B, 6) readings of each of the `sensors` [N, N m], NaN where there is
                none; (T + 1, 6) of one motion.
            more: further attributes.

        Raises:
            InputError: observations of a wrong shape or number of points, a start or inputs for
                another number of motions or steps, or an input that the body does not take.
        """
        read = {name: _batched(readings, 3) for name, readings in (loads or {}).items()}
        if observed is None:
            shape = next((readings.shape[:2] for readings in read.values()), (0, 0))
            observed, observation = torch.zeros(*shape, 0, 3), NoPoints()
        observed = _batched(observed, 4)
        if observed.ndim != 4 or observed.shape[-1] != observation.dimension or len(observed) < 2:
            raise InputError(
                f"observed has shape {tuple(observed.shape)}: it must be (time, motion, point, "
                f"{observation.dimension}) in {observation.unit}, of two times or more."
            )
        for name, readings in read.items():
            if readings.shape != (wanted := (*observed.shape[:2], 6)):
                raise InputError(
                    f"readings of {name!r} have shape {tuple(readings.shape)}: it must be {wanted}."
                )
        count = observed.shape[1]
        frames = len(observed)
        like = simulator.rest_positions
        observation = observation.to(like)
        at_rest = observation(like.expand(count, -1, -1))
        if observed.shape[2] != (seen := at_rest.shape[1]):
            kind = (
                "vertices of the body"
                if isinstance(observation, WholeState)
                else "points of the observation"
            )
            raise InputError(
                f"{observed.shape[2]} points were observed, but there are {seen} {kind}."
            )
        points = _array(observed.transpose(0, 1))
        acting, before = (
            _fitted(simulator, fields or Inputs(), count) for fields in (inputs, resting)
        )
        acting.check_steps(frames - 1)
        if start is not None and len(start.q) != count:
            raise InputError(
                f"start has {len(start.q)} states, but {count} motions were observed: give as many."
            )
        trials = Trials(
            names=tuple(f"motion {number}" for number in range(count)),
            labels=observation.labels,
            begins=(UNDER_INPUTS if start is None else GIVEN,) * count,
            times=np.tile(simulator.time_step * np.arange(frames), (count, 1)),
            observed=points,
            held=points[:, 0],
            payload=np.zeros(count),
            gravity=np.asarray(simulator.gravity, dtype=np.float64),
            time_step=simulator.time_step,
            bound=_array(at_rest[0])
            if observation.labels and isinstance(observation, Markers)
            else None,
            initial=None if start is None else _array(torch.stack([start.q, start.v], 1)),
            inputs={
                name: _array(x if axis == 0 else x.transpose(0, 1))
                for name, (x, axis) in acting.axes().items()
            },
            resting={name: _array(x) for name, x in before.fields.items()},
            loads={name: _array(readings.transpose(0, 1)) for name, readings in read.items()},
        )
        return cls(trials, observation, **more)

    def need_points(self, what: str) -> None:
        """Raises InputError where forces alone are observed, by which something is not tested."""
        if isinstance(self.observe, NoPoints):
            raise InputError(
                f"{what} is tested on points, and forces alone are observed: "
                "observe markers as well."
            )

    @property
    def sees_states(self) -> bool:
        """Whether the positions of all vertices are observed."""
        return isinstance(self.observe, WholeState)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the observed points, which are numbers where they have none."""
        return self.trials.labels or tuple(map(str, range(self.trials.observed.shape[2])))

    def batch(self, names: Sequence[str], simulator: Simulator) -> TrialBatch:
        """Trials that begin in the same way, on the device of a simulator,
        with inputs at its steps.
        """
        arguments = (self.trials, names, simulator.body, self.payload_at, simulator.time_step)
        sensors = tuple(self.sensors[name] for name in self.trials.loads)
        batch = TrialBatch.of(*arguments, sensors=sensors, noise=self.release.noise)
        return batch.to(simulator.rest_positions)

    def replay(
        self, simulator: Simulator, names: Sequence[str], identified: Identified | None = None
    ) -> Replay:
        """Replay of trials of one batch, with the markers where they were identified."""
        identified = identified or Identified()
        observe, placement = self.observe, identified.placement
        if placement is not None:
            assert isinstance(observe, Markers)
            placed = placement_of(placement, self.labels, self.trials.session(names[0]))
            observe = PlacedMarkers.of(observe, placed).to(simulator.rest_positions)
        return Replay(simulator, observe, self.batch(names, simulator), identified.actuator)

    def start(self, replay: Replay, identified: Identified | None = None) -> Start:
        """Estimates how the trials of a replay begin.

        Args:
            replay: of trials that begin in the same way.
            identified: parameters of its simulator; the simulator's constants if None.

        Raises:
            ConvergenceError: a body cannot be held, or a step of the simulation fails.
        """
        simulator, trials = replay.simulator, replay.trials
        begins = self.trials.begin_of(trials.names[0])
        if begins == GIVEN:
            rows, initial = self.trials.rows(trials.names), self.trials.initial
            if initial is not None:
                q, v = (simulator.tensor(initial[rows, at]) for at in (0, 1))
            else:
                q, velocity = trials.observed[:, 0], self.trials.velocity
                v = torch.zeros_like(q) if velocity is None else q.new_tensor(velocity[rows, 0])
            return Start(State(q, v), q.new_zeros(len(q)))
        known = {} if identified is None else identified.values(simulator)
        values = {
            name: value
            for name, value in known.items()
            if split_name(name)[0] in replay.parameter_names
        } or None
        if begins == RELEASED:
            return estimate_release(replay, self.release, values)
        guess = simulator.rest_positions.expand(len(trials.names), -1, -1)
        if begins in (STATIC, UNDER_INPUTS):
            # Small changes of a parameter then start close to the solution.
            with contextlib.suppress(ConvergenceError), torch.no_grad():
                constants, _, resting = replay.prepare(values)
                guess = simulator.static_equilibrium(resting, constants).q.expand_as(guess)
        if begins == STATIC:
            return Start.resting(guess)
        return begin_inputs(replay, Start.resting(guess), self.release, values)

    def replays(
        self,
        simulator: Simulator,
        names: Sequence[str] | None = None,
        identified: Identified | None = None,
    ) -> list[tuple[Replay, Start]]:
        """Replays of any trials, one for each batch, each with its start."""
        batches = self.trials.batches(self.trials.names if names is None else names)
        replays = [self.replay(simulator, batch, identified) for batch in batches]
        return [(replay, self.start(replay, identified)) for replay in replays]

    def learned(self, replay: Replay) -> Replay:
        """Returns a replay of the frames that are learned from."""
        if self.train_fraction == 1.0 or replay.is_static:
            return replay
        seconds = self.train_fraction * float(replay.trials.times.max())
        return replay.changed(trials=replay.trials.first(seconds))

    def targets(self, replay: Replay, start: Start) -> torch.Tensor:
        """(R, K + 1, M, 3) target positions at a simulator's steps [m],
        NaN where a marker was not seen.

        Only the part of each trial that is used for training is returned.
        """
        simulator, trials = replay.simulator, replay.trials
        if self.trials.smoothed is not None and self.trials.begin_of(trials.names[0]) in RESTING:
            smoothed = simulator.tensor(self.trials.smoothed[self.trials.rows(trials.names)])
            targets = later(smoothed, start.delay, simulator.time_step)
        elif self.trials.begin_of(trials.names[0]) in (GIVEN, STATIC) or not self.trials.labels:
            targets, frame = trials.observed, float(trials.times[0, :2].sum())
            if frame and abs(frame - simulator.time_step) > 1e-6 * frame:
                raise InputError(
                    f"{trials.names[0]!r} was observed every {1e3 * frame:g} ms, but the step of "
                    f"the simulator is {1e3 * simulator.time_step:g} ms: reconstruct it with "
                    f"time_step={frame:g}."
                )
        else:
            targets = start.bound(
                simulator.tensor(at_steps(trials, simulator.time_step, start.delay))
            )
        return targets[:, : self.learned_steps(targets.shape[1] - 1) + 1]

    def learned_steps(self, steps: int) -> int:
        """Number of steps of a trial that are used for training."""
        return max(round(self.train_fraction * steps), 1)

    def base(self, names: Sequence[str], simulator: Simulator) -> BaseFrame | None:
        """Frame of the base to which the body is fixed in trials; None if the base stands still."""
        poses = self.trials.base_at(names, simulator.time_step)
        return (
            None
            if poses is None
            else BaseFrame(poses.to(simulator.rest_positions), simulator.time_step)
        )

    def _base_movement(self, names: Sequence[str], simulator: Simulator) -> torch.Tensor | None:
        """(K, R, A) motion of the base during each step as network inputs.

        None if the base stands still.
        """
        poses = self.trials.base_at(names, simulator.time_step)
        mask = self.base_movement_mask(simulator)
        if poses is None or mask is None:
            return None
        movement = base_movement(poses, simulator.time_step, torch.from_numpy(self.trials.gravity))
        return movement[..., mask].to(simulator.rest_positions)

    def base_movement_mask(self, simulator: Simulator) -> torch.Tensor | None:
        """(15,) bool, components of `base_movement` that vary and are network inputs.

        None if the base stands still.
        """
        poses = self.trials.base_at(self.trials.names, simulator.time_step)
        if poses is None:
            return None
        movement = base_movement(poses, simulator.time_step, torch.from_numpy(self.trials.gravity))
        return movement.flatten(0, 1).std(0) > _STANDS_STILL

    def conditions(
        self, replay: Replay, parameters: Mapping[str, torch.Tensor], payload: bool = False
    ) -> torch.Tensor | None:
        """Returns the network inputs of trials besides the state; None if there are none.

        Args:
            replay: replay of the trials.
            parameters: (1,) identified parameters.
            payload: whether to include the payload even if ``actuation.sees_payload`` is false.

        Returns:
            (R, 1) payloads [kg] if nothing else acts; otherwise (K, R, A) during each step:
            payloads, inputs (of actuators, and those that move obstacles) with their exponential
            means, and motion of the base (`base_movement`). (R, A) for static poses, under steady
            inputs.
        """
        _, inputs, resting = replay.prepare(parameters)
        constant = list[torch.Tensor]()
        if self.payload_at is not None and (payload or self.actuation.sees_payload):
            rows = self.trials.rows(replay.trials.names)
            constant.append(replay.trials.times.new_tensor(self.trials.payload[rows])[:, None])
        filters = self.actuation.filter_time_constants
        acting = resting if replay.is_static else inputs
        driven = acting.actuation
        moving = self._base_movement(replay.trials.names, replay.simulator)
        if replay.is_static:
            constant += [values.repeat(1, 1 + len(filters)) for values in driven.values()]
            constant += [] if moving is None else [moving[0]]
            return torch.cat(constant, -1) if constant else None
        response = InputResponse(replay.simulator.time_step, filters=filters)
        series = []
        for name, values in driven.items():
            values = values if values.ndim == 3 else values[None]
            first = resting.actuation.get(name)
            memory = response.steady(0.0 * values[0] if first is None else first)
            series.append(with_means(*response(memory, values)[:2]))
        series += [] if moving is None else [moving]
        if not series:
            return constant[0] if constant else None
        at = torch.arange(max(map(len, series)))
        series = [values[at.clamp_max(len(values) - 1).to(values.device)] for values in series]
        return torch.cat([*(values.expand(len(at), -1, -1) for values in constant), *series], -1)


def _batched(values: Any, ndim: int) -> torch.Tensor:
    """Returns values (T, B, ...), of (T, ...) for one motion."""
    values = torch.as_tensor(values)
    return values[:, None] if values.ndim == ndim - 1 else values


def _fitted(simulator: Simulator, inputs: Inputs, count: int) -> Inputs:
    """The inputs of some motions, or raises InputError for those that the body does not take."""
    fitted = inputs.fitted(simulator.counts, simulator.rest_positions, count).to(
        simulator.rest_positions
    )
    accepted = {
        name: (quantity, simulator.counts[name]) for name, quantity in simulator.inputs.items()
    }
    vertices, fixed = simulator.body.n_vertices, len(simulator.fixed)
    fitted.at(0).check(accepted, count, vertices, fixed, simulator.rest_positions)
    return fitted


def _array(values: torch.Tensor) -> NDArray[np.float64]:
    return values.detach().cpu().numpy().astype(np.float64)
