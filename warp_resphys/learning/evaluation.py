"""Roll-outs of a simulator, a simulator with a learned force,
or a network alone, over observed motions.
"""

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import chain, islice
from typing import Any, Final

import numpy as np
import torch

from ..core.dynamics.simulator import Simulator
from ..core.stepping.rollout import states
from ..core.stepping.state import State
from ..data.markers import NoPoints
from ..data.trials import GIVEN, STATIC, Trials
from ..io.arrays import BoolArray, FloatArray
from ..io.errors import ConvergenceError, InputError, checks_types, listed
from ..io.parts import Arrays, Parts, Report, TrialPart, cut
from .metrics import marker_errors, summarise
from .observed_motions import Identified, ObservedMotions
from .replay import Replay
from .residuals.correction import (
    CorrectedSimulator,
    Learned,
    LearnedPredictor,
    Predictor,
    force_frames,
)
from .start import Start

HELD_OUT: Final = "left-out training"
_FOLDS: Final = 3  # of the training trials, where validation trials do not suffice
POSE_STEPS: Final = (
    200  # after which the roll-out of a network without simulator is taken to be at rest
)


@checks_types
def evaluate(
    simulator: Simulator,
    motions: ObservedMotions,
    force: Learned | Predictor | None = None,
    *,
    names: Sequence[str] | None = None,
    parameters: Identified | Mapping[str, float] | None = None,
    sensor: str | None = None,
    parts: Parts | None = None,
) -> FloatArray:
    """Rolls a simulator out from the start of observed motions and measures its error.

    Args:
        simulator: to evaluate.
        motions: observed states or markers.
        force: learned force from `fit_force`, or a function of the state and the number of the step
            that returns forces (B, N, 3) [N] for trials that begin alike; None for the simulator
            alone.
        names: of the R trials; all by default.
        parameters: values in place of the simulator's, such as `Identification.parameters`.
        sensor: name of the force sensor whose error is returned; None for that of the points.
        parts: workers and files of the work; this process and its memory if None.

    Returns:
        (T, R) mean distance of the observed points in the unit of the observation, such as m, or
        error of a force (`ForceSensor.distances`) [N]; NaN where nothing was seen or parameters
        were estimated (`Identified.first_frames`), infinite after a simulation diverged.

    Raises:
        InputError: an input that the body does not take.
        ConvergenceError: no initial equilibrium.
    """
    trials, parts = motions.trials, parts or Parts("evaluate")
    names = trials.chosen(names)
    if sensor is not None and sensor not in motions.sensors:
        raise InputError(
            f"there is no force sensor {sensor!r}: there are "
            f"{listed([*motions.sensors]) or 'none'}."
        )
    if sensor is None and isinstance(motions.observe, NoPoints):
        raise InputError(
            f"forces alone are observed: name one of the sensors, {listed([*motions.sensors])}."
        )
    cut_up = rollout_parts(simulator, motions, names, force, parameters, parts.batch)
    parts.run(cut_up)
    order = [*chain.from_iterable(part.names for part in cut_up)]
    rows = trials.rows(names)
    used = torch.from_numpy(used_frames(trials, names, Identified.of(parameters).first_frames))
    array = "observed" if sensor is None else "loads"
    made = parts.joined(cut_up, array, trials.observed.shape[1])[
        [order.index(name) for name in names]
    ]
    if sensor is not None:
        shown, read = (
            torch.from_numpy(x)
            for x in (made[:, :, [*trials.loads].index(sensor)], trials.loads[sensor][rows])
        )
        away = motions.sensors[sensor].distances(shown, read, torch.from_numpy(trials.times[rows]))
        return np.asarray(torch.where(used, torch.nan, away).T.numpy())
    shown, observed = simulator.tensor(made), simulator.tensor(trials.observed[rows])
    away = (
        motions.observe.residual(shown.nan_to_num(math.inf), observed)
        .norm(dim=-1)
        .nan_to_num(math.inf)
    )
    seen = torch.isfinite(observed).all(-1) & ~used[..., None].to(away.device)
    return np.asarray(torch.where(seen, away, torch.nan).nanmean(2).T.cpu().numpy())


def rollout_parts(
    simulator: Simulator,
    motions: ObservedMotions,
    names: Sequence[str],
    force: Learned | Predictor | None = None,
    parameters: Identified | Mapping[str, float] | None = None,
    batch: int | None = None,
    filmed: str = "",
    label: str = "rollout",
) -> list[TrialPart]:
    """Returns the parts of roll-outs of any trials, see `roll_out`.

    Args:
        simulator: see `evaluate`.
        motions: see `evaluate`.
        names: of the trials.
        force: see `evaluate`.
        parameters: see `evaluate`.
        batch: most trials of a part; None for no limit.
        filmed: name of the trial whose vertices are kept.
        label: first part of the names of the files.
    """
    parts = list[TrialPart]()
    for number, whole in enumerate(motions.trials.batches(names)):
        steps = math.ceil(motions.trials.seconds(whole) / simulator.time_step)
        if (
            not motions.trials.moving(whole)
            and isinstance(force, Learned)
            and force.replaces_simulator
        ):
            steps = POSE_STEPS
        for first, some in cut(whole, batch):
            work = partial(
                roll_out, simulator, motions, some, force, Identified.of(parameters), filmed
            )
            parts.append(TrialPart(f"{label}{number}_{first:03d}", some, steps + 1, work))
    return parts


def roll_out(
    simulator: Simulator,
    motions: ObservedMotions,
    names: Sequence[str],
    force: Learned | Predictor | None,
    identified: Identified,
    filmed: str,
    report: Report,
) -> Arrays:
    """Rolls out trials that begin in the same way.

    Args:
        simulator: of which a copy is used, so that results do not depend on other parts, and its
            buffers are let go.
        motions: see `evaluate`.
        names: of the R trials.
        force: see `evaluate`.
        identified: parameters of the simulator.
        filmed: name of the trial whose vertices are kept.
        report: called after every step.

    Returns:
        ``observed`` (R, T, M, D) points at the frames, NaN where the roll-out diverged;
        ``sideways`` (R,) estimated displacement of bodies before their release [mm], NaN where it
        is not estimated; with force sensors, ``loads`` (R, T, S, 6) readings [N, N m], NaN where
        there is none of a model; with a network, ``left`` (R,) steps at which trials left the
        training range, -1 where they did not; ``film`` (K + 1, N, 3) vertices [m].
    """
    data_driven = isinstance(force, Learned) and force.replaces_simulator
    simulator = replace(simulator, solver=simulator.settings.changed(on_failure="count"))
    run = TrialRollout(simulator, motions, names, identified, data_driven)
    points = []
    bodies = list[torch.Tensor]()
    predictor = run.predictor(force) if isinstance(force, Learned) else force
    loads = list[torch.Tensor]()
    for state in run.roll(predictor):
        points.append(run.points(state))
        loads.append(run.loads(state, len(loads)))
        lost = state.lost
        bodies += [
            torch.where(lost[row], torch.nan, state.q[row]).float()
            for row, name in enumerate(names)
            if name == filmed
        ]
        report()
    shift = run.start.shift
    sideways = (
        torch.full((len(names),), torch.nan) if shift is None else 1e3 * shift.norm(dim=2).mean(1)
    )
    arrays: dict[str, Any] = {"observed": (run.at_frames(points), motions.observe.unit)}
    arrays["sideways"] = (sideways.cpu().numpy(), "mm")
    if motions.sensors:
        arrays["loads"] = (run.loads_at_frames(loads), "N, N m")
    if isinstance(predictor, LearnedPredictor):
        left = predictor.left_at
        arrays["left"] = (np.full(len(names), -1) if left is None else left.cpu().numpy(), "1")
    return arrays | ({"film": (torch.stack(bodies).cpu().numpy(), "m")} if bodies else {})


class TrialRollout:
    """Trials that begin in the same way, to be rolled out with any network.

    Args:
        simulator: its solver settings must count failures rather than raise them.
        motions: observed motions.
        names: names of the trials.
        identified: parameters of the simulator.
        data_driven: whether a network replaces the simulator.
        start: how the trials begin; estimated if None.

    Attributes:
        replay: of the trials.
        start: how they begin.
        steps: number of steps that covers all frames, rounded up to whole time steps of the inputs.
    """

    def __init__(
        self,
        simulator: Simulator,
        motions: ObservedMotions,
        names: Sequence[str],
        identified: Identified | None = None,
        data_driven: bool = False,
        start: Start | None = None,
    ) -> None:
        self._simulator = simulator
        self._motions = motions
        self._data_driven = data_driven
        self._values = {} if identified is None else identified.values(simulator)
        self.replay = motions.replay(simulator, names, identified)
        self.start = motions.start(self.replay, identified) if start is None else start
        self._constants, self._inputs, self._resting = self.replay.prepare(self._values)
        self._first: State | None = None  # of motions, whatever the network
        self._before: State | None = None  # of which readings were taken last
        substeps = round(motions.trials.time_step / simulator.time_step)
        self.steps = -(-self.replay.steps(self.start) // substeps) * substeps
        if self.replay.is_static:
            self.steps = POSE_STEPS if data_driven else 0

    def predictor(self, learned: Learned, replay: Replay | None = None) -> LearnedPredictor:
        """Returns the predictor of a network in these trials,
        or raises InputError for one of another body.

        Args:
            learned: the network.
            replay: of the trials under other inputs; None: `replay`.
        """
        given = len(learned.network.rest)
        wanted = len(self._simulator.rest_positions)
        if given != wanted:
            raise InputError(
                f"a force on {given} vertices was learned, "
                f"but the body has {wanted}: learn one for it."
            )
        frames = None if self._data_driven else force_frames(self._simulator, learned.force_frame)
        base = self._motions.base(self.replay.trials.names, self._simulator)
        conditions = self._motions.conditions(
            replay or self.replay, self._values, self._data_driven
        )
        return LearnedPredictor(learned.network, conditions, learned.range_, frames, base)

    @torch.no_grad()
    def begin(self, predictor: Predictor | None) -> State:
        """Initial states of the trials; for static poses these are the final states, too.

        Raises:
            ConvergenceError: the equilibrium of an initial state was not found.
        """
        force: Any = predictor if self.replay.is_static and not self._data_driven else None
        if force is not None:
            return self.replay.initial_state(
                self.start, self._constants, self._resting, force=force
            )
        if self._first is None:
            self._first = self.replay.initial_state(self.start, self._constants, self._resting)
        return self._first

    @torch.no_grad()
    def roll(self, predictor: Predictor | None) -> Iterator[State]:
        """Yields the state of each step; a pose without equilibrium is lost.

        Raises:
            ConvergenceError: the equilibrium from which a motion begins was not found.
        """
        try:
            state = self.begin(predictor)
        except ConvergenceError:
            if not self.replay.is_static:
                raise
            state = self._simulator.rest_state(len(self.replay.trials.names))
            state = state.with_memory({"lost": ~state.lost})
        step = CorrectedSimulator(self._simulator, predictor, self._inputs, self._constants).step
        yield from states(step, state, range(self.steps))

    @torch.no_grad()
    def loads(self, state: State, number: int) -> torch.Tensor:
        """(R, S, 6) readings in a state of `roll` by its number [N, N m].

        They are NaN in an initial state that no equilibrium led to, and infinite where the
        simulation has diverged.
        """
        before = self._before
        self._before = state
        sensors = len(self.replay.trials.sensors)
        resting = number == 0 and self.start.at_rest
        none = state.q.new_full((state.batch, sensors, 6), torch.nan)
        if self._data_driven or not sensors:
            return none
        if bool(state.lost.all()) or not (number or resting):
            return torch.where(state.lost[:, None, None], torch.inf, none)
        inputs = self._resting if resting else self._inputs.at(number - 1)
        read = self.replay.read(state, None if resting else before, inputs, self._constants)
        return torch.where(state.lost[:, None, None], torch.inf, read)

    def points(self, state: State) -> torch.Tensor:
        """(R, M, D) observed points of a state; NaN where the roll-out has diverged."""
        return torch.where(state.lost[:, None, None], torch.nan, self.replay.observe(state.q))

    def at_frames(self, points: Sequence[torch.Tensor]) -> FloatArray:
        """(R, T, M, D) observed points at frames of trials, from those of all steps (R, M, D)."""
        return np.asarray(self.replay.at_frames(self._stacked(points), self.start).cpu().numpy())

    def loads_at_frames(self, loads: Sequence[torch.Tensor]) -> FloatArray:
        """(R, T, S, 6) readings at frames of trials [N, N m], from those of all steps (R, S, 6)."""
        series = self._stacked(loads)
        # Of the steps around a frame.
        lost = self.replay.loads_at_frames(series.isinf().to(series), self.start) > 0.5
        read = self.replay.loads_at_frames(
            torch.where(series.isinf(), torch.nan, series), self.start
        )
        return np.asarray(torch.where(lost, torch.inf, read).cpu().numpy())

    def _stacked(self, steps: Sequence[torch.Tensor]) -> torch.Tensor:
        """Values of all steps, the last one alone of static poses."""
        return torch.stack([*steps[-1:]] if self.replay.is_static else [*steps], 1)

    def errors(self, learned: Learned | None) -> list[FloatArray]:
        """Mean marker distances [mm] of each trial at its training frames.

        NaN where the roll-out diverged.

        Args:
            learned: network; None for the simulator alone.
        """
        motions = self._motions
        observed = self.replay.trials.observed
        steps = self.steps
        observed = observed[:, : motions.learned_steps(observed.shape[1] - 1) + 1]
        if motions.train_fraction < 1.0:
            steps = min(steps, motions.learned_steps(steps))
        series: list[torch.Tensor] = []
        with contextlib.suppress(ConvergenceError):
            for state in islice(
                self.roll(None if learned is None else self.predictor(learned)), steps + 1
            ):
                if series and bool(state.lost.all()):
                    series = []
                    break
                series.append(self.points(state))
        if not series:
            return [np.full(1, np.nan) for _ in observed]
        first = first_frame(motions.trials, self.replay.trials.names)
        pairs = zip(
            self.at_frames(series)[:, first:], observed[:, first:].cpu().numpy(), strict=True
        )
        return [marker_errors(x[: len(y)], y) for x, y in pairs]


def first_frame(trials: Trials, names: Sequence[str]) -> int:
    """First frame that counts in errors: 1 if the roll-out starts from the given state, else 0."""
    return int(trials.begin_of(names[0]) == GIVEN)


def used_frames(
    trials: Trials, names: Sequence[str], first_frames: Mapping[str, Mapping[str, float]]
) -> BoolArray:
    """(R, T) whether values were estimated from a frame of some trials, see
    `Identified.first_frames`.
    """
    seconds = dict(chain.from_iterable(shown.items() for shown in first_frames.values()))
    last = np.array([seconds.get(name, -math.inf) for name in names])
    return np.asarray(trials.times[trials.rows(names)] <= last[:, None] + 1e-9)


def left_out_in_turn(
    trials: Trials, names: Sequence[str], validation: Sequence[str] = ()
) -> list[tuple[str, ...]]:
    """Divides the training trials that begin alike among the folds of a test
    where validation trials do not suffice.

    A single static pose does not, as its error has no spread.

    Args:
        trials: of all names.
        names: of the training trials.
        validation: names of the validation trials.

    Returns:
        Names that are left out of a fit together; nothing if the validation trials suffice, or if
        each training trial begins in its own way.
    """
    if len(validation) > 1 or any(trials.begin_of(name) != STATIC for name in validation):
        return []
    alike = [batch for batch in trials.batches(names) if len(batch) > 1]
    count = min(max(map(len, alike), default=0), _FOLDS)
    return [
        tuple(chain.from_iterable(batch[number::count] for batch in alike))
        for number in range(count)
    ]


class HeldOutRollouts:
    """Roll-outs of trials with any networks, whose starts are estimated once, at the first one.

    Args:
        simulator: its solver settings must count failures rather than raise them.
        motions: observed motions.
        names: names of the trials.
        identified: parameters of the simulator.
        data_driven: whether networks replace the simulator.
    """

    def __init__(
        self,
        simulator: Simulator,
        motions: ObservedMotions,
        names: Sequence[str],
        identified: Identified,
        data_driven: bool = False,
    ) -> None:
        self.batches = motions.trials.batches(names)
        self._of = partial(
            TrialRollout, simulator, motions, identified=identified, data_driven=data_driven
        )

    @cached_property
    def _runs(self) -> list[TrialRollout]:
        return [self._of(batch) for batch in self.batches]

    @property
    def names(self) -> list[str]:
        """Names of the trials, in the order of the errors."""
        return [*chain.from_iterable(self.batches)]

    def amplitudes_mm(self) -> list[float]:
        """Amplitudes of the trials [mm]."""
        sizes = (run.replay.trials.amplitude.tolist() for run in self._runs)
        return [1e3 * size for size in chain.from_iterable(sizes)]

    def errors(self, learned: Learned | None) -> list[FloatArray]:
        """Mean distances of the points of each trial by frame [mm], see `TrialRollout.errors`."""
        return [*chain.from_iterable(run.errors(learned) for run in self._runs)]

    def error_mm(self, learned: Learned) -> float:
        """Mean error of a network over the trials [mm]; infinite if a roll-out diverged."""
        mean = summarise(self.errors(learned))["mean"]
        return float("inf") if mean is None else mean
