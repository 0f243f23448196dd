"""Roll-outs of the models of an experiment: a simulator, a simulator with a learned force, or a network alone."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from ..data.dataset import GIVEN
from ..dynamics.simulator import Simulator
from ..io.arrays import FloatArray
from ..io.errors import ConvergenceError
from ..io.files import read_checkpoint
from ..learning.correction import CorrectedSimulator, LearnedPredictor, Range, force_frames
from ..learning.metrics import marker_errors, summarise
from ..learning.networks import NextState, ResidualForce, StateMap, restore
from ..learning.replay import Start
from ..stepping.rollout import states
from ..stepping.state import State
from .experiment import LEARNED, Experiment
from .files import weights_file

SIMFREE: Final = "simfree"
POSE_STEPS = 200  # after which the roll-out of a network without simulator is taken to be at rest


def kind_of(model: str) -> tuple[type[StateMap], str]:
    """Class of a learned model, and the kind of its checkpoint files."""
    return (NextState, "next state") if model == SIMFREE else (ResidualForce, "residual force")


@dataclass(frozen=True)
class Learned:
    """A trained network with the settings of its roll-outs.

    Attributes:
        network: network that predicts a residual force or the next state.
        range_: training range to which roll-outs clamp its inputs; None for no clamping.
        force_frame: frame of the predicted forces, see `Experiment.frames`.
    """

    network: StateMap
    range_: Range | None = None
    force_frame: str = "world"

    def to(self, device: torch.device) -> "Learned":
        """Returns the model on a device; its network moves there."""
        range_ = None if self.range_ is None else self.range_.to(device)
        return Learned(self.network.to(device), range_, self.force_frame)

    def description(self) -> dict[str, Any]:
        """Metadata of a checkpoint that `load` needs besides the description of the network."""
        range_ = None if self.range_ is None else self.range_.description()
        return {"range": range_, "force_frame": self.force_frame}


def load(folder: Path, model: str, device: torch.device) -> Learned:
    """Loads a trained model of `LEARNED` from its checkpoint.

    Args:
        folder: folder of the split.
        model: name of the model.
        device: device of the network.

    Raises:
        DataFileError: the file is missing or damaged.
    """
    network_type, kind = kind_of(model)
    tensors, description = read_checkpoint(folder / weights_file(model), kind)
    network, limits = restore(network_type, tensors, description).to(device), description["range"]
    range_ = None if limits is None else Range.restore(limits, network.linear)
    return Learned(network, range_, str(description["force_frame"]))


class ModelRollout:
    """Trials that begin in the same way, rolled out by a model.

    Args:
        experiment: the experiment.
        model: name of the model.
        names: names of the trials.
        start: how the trials begin; estimated by default.
        simulator: simulator to use instead of the model's own.

    Attributes:
        replay: of the trials.
        start: how they begin.
        steps: number of steps that covers all frames, rounded up to whole time steps of the experiment.
    """

    def __init__(
        self,
        experiment: Experiment,
        model: str,
        names: Sequence[str],
        start: Start | None = None,
        simulator: Simulator | None = None,
    ) -> None:
        self._experiment, self._model = experiment, model
        self._simulator = experiment.model_simulator(model) if simulator is None else simulator
        self.replay = experiment.motions.replay(self._simulator, names, experiment.identified(model))
        self.start = experiment.motions.start(self.replay, experiment.identified(model)) if start is None else start
        parameters = experiment.parameters(model)
        self._constants, self._inputs, self._resting = self.replay.prepare(parameters)
        self._conditions = (
            experiment.motions.conditions(self.replay, parameters, model == SIMFREE) if model in LEARNED else None
        )
        self._first: State | None = None  # of motions, whatever the network
        substeps = round(experiment.settings.time_step / self._simulator.time_step)
        self.steps = -(-self.replay.steps(self.start) // substeps) * substeps
        if self.replay.is_static:
            self.steps = POSE_STEPS if model == SIMFREE else 0

    def predictor(self, learned: Learned | None) -> LearnedPredictor | None:
        """Returns the predictor of a network in these trials; None without a network."""
        if learned is None:
            return None
        replaces = isinstance(learned.network, NextState)
        frames = None if replaces else force_frames(self._simulator, learned.force_frame)
        base = self._experiment.motions.base(self.replay.trials.names, self._simulator)
        return LearnedPredictor(learned.network, self._conditions, learned.range_, frames, base)

    @torch.no_grad()
    def begin(self, predictor: LearnedPredictor | None) -> State:
        """Initial states of the trials; for static poses these are the final states, too.

        Raises:
            ConvergenceError: the equilibrium of an initial state was not found.
        """
        force: Any = predictor if self.replay.is_static and self._model != SIMFREE else None
        if force is not None:
            return self.replay.initial_state(self.start, self._constants, self._resting, force=force)
        if self._first is None:
            self._first = self.replay.initial_state(self.start, self._constants, self._resting)
        return self._first

    @torch.no_grad()
    def roll(self, predictor: LearnedPredictor | None) -> Iterator[State]:
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

    def points(self, state: State) -> torch.Tensor:
        """(R, M, 3) observed points of a state [m]; NaN where the roll-out has diverged."""
        return torch.where(state.lost[:, None, None], torch.nan, self.replay.observe(state.q))

    def at_frames(self, points: Sequence[torch.Tensor]) -> FloatArray:
        """(R, T, M, 3) observed points at the frames of the trials [m], from those of all steps (R, M, 3)."""
        series = torch.stack([*points[-1:]] if self.replay.is_static else [*points], 1)
        return np.asarray(self.replay.at_frames(series, self.start).cpu().numpy())

    def errors(self, learned: Learned) -> list[FloatArray]:
        """Mean marker distances [mm] of each trial at its training frames; NaN where the roll-out diverged."""
        observed, steps = self.replay.trials.observed, self.steps
        observed = observed[:, : self._experiment.motions.learned_steps(observed.shape[1] - 1) + 1]
        if self._experiment.settings.train_fraction < 1.0:
            steps = min(steps, self._experiment.motions.learned_steps(steps))
        series: list[torch.Tensor] = []
        with contextlib.suppress(ConvergenceError):
            for state in islice(self.roll(self.predictor(learned)), steps + 1):
                if series and bool(state.lost.all()):
                    series = []
                    break
                series.append(self.points(state))
        if not series:
            return [np.full(1, np.nan) for _ in observed]
        first = first_frame(self._experiment, self.replay.trials.names)
        pairs = zip(self.at_frames(series)[:, first:], observed[:, first:].cpu().numpy(), strict=True)
        return [marker_errors(x[: len(y)], y) for x, y in pairs]


def first_frame(experiment: Experiment, names: Sequence[str]) -> int:
    """First frame that counts in errors: 1 if the roll-out starts from the given state, else 0."""
    return int(experiment.dataset.begin_of(names[0]) == GIVEN)


def rollout_error(experiment: Experiment, model: str, names: Sequence[str]) -> Callable[[Learned], float]:
    """Returns a function that computes the mean error of a model over trials [mm]; infinite if a roll-out diverged.

    Args:
        experiment: an experiment with ``on_failure="count"``.
        model: name of a model with a network.
        names: names of the trials.
    """
    runs: list[ModelRollout] = []

    def error(learned: Learned) -> float:
        if not runs:  # The starts of the trials are estimated once, at the first call.
            runs.extend(ModelRollout(experiment, model, batch) for batch in experiment.dataset.batches(names))
        rows = [row for run in runs for row in run.errors(learned)]
        mean = summarise(rows)["mean"]
        return float("inf") if mean is None else mean

    return error


def learned_of(experiment: Experiment, model: str) -> Learned | None:
    """Trained network of a model in this run; None for models without a network."""
    return load(experiment.folder, model, experiment.like.device) if model in LEARNED else None
