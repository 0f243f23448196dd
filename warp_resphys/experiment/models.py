"""Roll-outs of the models of an experiment: a simulator, a simulator with a learned force, or a network alone."""

import contextlib
import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from ..dynamics.simulator import Simulator
from ..io.errors import ConvergenceError
from ..io.files import read_checkpoint
from ..learning.metrics import marker_errors, summarise
from ..learning.networks import NextState, ResidualForce, StateMap, restore
from ..learning.predictors import LearnedPredictor, Range
from ..learning.replay import Start
from ..learning.rollout import Rollout
from ..settings.stages import TestStage
from ..stepping.state import State
from .experiment import LEARNED, Experiment
from .files import GIVEN, weights_file
from .parts import PartRollout

FloatArray = NDArray[np.float64]

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


class ModelRollout(PartRollout):
    """Step-by-step roll-out of a model over trials that begin in the same way.

    Args:
        experiment: the experiment.
        model: name of the model.
        names: names of the trials.
        learned: trained network; None for a simulator alone.
        start: how the trials begin; estimated by default.
        simulator: simulator to use instead of the model's own.
        filmed: trial of which all vertex positions are saved, too.
    """

    def __init__(
        self,
        experiment: Experiment,
        model: str,
        names: Sequence[str],
        learned: Learned | None = None,
        start: Start | None = None,
        simulator: Simulator | None = None,
        filmed: str | None = None,
    ) -> None:
        self.experiment, self.model = experiment, model
        self.simulator = experiment.model_simulator(model) if simulator is None else simulator
        self.replay = experiment.replay(self.simulator, names, model)
        self.start = experiment.start(self.replay, model) if start is None else start
        parameters = experiment.parameters(model)
        self._constants, self._inputs, self._resting = self.replay.prepare(parameters)
        self._conditions = None if learned is None else experiment.conditions(self.replay, parameters, model == SIMFREE)
        self._first: State | None = None
        self._failed = False
        self._filmed = names.index(filmed) if filmed in names else None
        self.rollout, self.predictor = self._make(learned)
        self.frames, self.units = self._steps() + 1, {"points": "m", "left": "1", "film": "m"}

    def _make(self, learned: Learned | None) -> tuple[Rollout, LearnedPredictor | None]:
        predict = None
        if learned is not None:
            replaces = isinstance(learned.network, NextState)
            frames = None if replaces else self.experiment.frames(self.simulator, learned.force_frame)
            base = self.experiment.base(self.replay.trials.names, self.simulator)
            predict = LearnedPredictor(learned.network, self._conditions, learned.range_, frames, base)
        return Rollout(self.simulator, predict, self._inputs, self._constants), predict

    def with_learned(self, learned: Learned) -> "ModelRollout":
        """Returns a roll-out of the same trials from their beginning with another network."""
        if not self.replay.is_static:
            self.beginning()  # Computed once and shared by the copies.
        other = copy.copy(self)
        other.rollout, other.predictor = self._make(learned)
        return other

    def _steps(self) -> int:
        """Number of steps that covers all frames, rounded up to whole time steps of the experiment."""
        if self.replay.is_static:
            return POSE_STEPS if self.model == SIMFREE else 0
        substeps = round(self.experiment.settings.time_step / self.simulator.time_step)
        return -(-self.replay.steps(self.start) // substeps) * substeps

    @torch.no_grad()
    def beginning(self) -> State:
        """Initial states of the trials; for static poses these are the final states, too.

        Raises:
            ConvergenceError: the equilibrium of an initial state was not found.
        """
        if self.replay.is_static and self.predictor is not None and self.model != SIMFREE:
            force: Any = self.predictor
            return self.replay.initial_state(self.start, self._constants, self._resting, force=force)
        if self._first is None:
            self._first = self.replay.initial_state(self.start, self._constants, self._resting)
        return self._first

    @override
    def begin(self) -> State:
        """Returns the `beginning`; a static pose without equilibrium is marked as diverged."""
        try:
            return self.beginning()
        except ConvergenceError:
            if not self.replay.is_static:
                raise
            self._failed = True
            return self.simulator.rest_state(len(self.replay.trials.names))

    @override
    def step(self, number: int) -> State:
        return self.rollout.step(self.state)

    @property
    def _lost(self) -> torch.Tensor:
        return self.rollout.lost(self.state) | self._failed

    def points(self) -> torch.Tensor:
        """(R, M, 3) observed points of the last state [m]; NaN where the roll-out has diverged."""
        return torch.where(self._lost[:, None, None], torch.nan, self.replay.observe(self.state.q))

    @override
    def frame_arrays(self, number: int) -> dict[str, NDArray[Any]]:
        """Observed points, steps at which trials left the training range (-1 before that), and filmed vertices."""
        points = self.points()
        kept = {"points": points.cpu().numpy()}
        if self.predictor is not None:
            left = self.predictor.left_at
            kept["left"] = np.full(len(points), -1) if left is None else left.cpu().numpy()
        if self._filmed is not None:
            body = self.state.q[self._filmed, None].float().cpu().numpy()
            kept["film"] = np.full_like(body, np.nan) if self._lost[self._filmed] else body
        return kept

    @override
    def constants(self) -> dict[str, tuple[NDArray[Any], str]]:
        shift = torch.zeros_like(self.replay.trials.held) if self.start.shift is None else self.start.shift
        return {"delay": (self.start.delay.cpu().numpy(), "s"), "shift": (shift.cpu().numpy(), "m")}

    def errors(self) -> list[FloatArray]:
        """Mean marker distances [mm] of each trial at its training frames; NaN where the roll-out diverged."""
        observed, steps = self.replay.trials.observed, self.frames - 1
        observed = observed[:, : self.experiment.learned_steps(observed.shape[1] - 1) + 1]
        if self.experiment.settings.train_fraction < 1.0:
            steps = min(steps, self.experiment.learned_steps(steps))
        series: list[torch.Tensor] = []
        with contextlib.suppress(ConvergenceError):
            self.state = self.beginning()
            series.append(self.points())
        while series and len(series) <= steps:
            self.state = self.step(len(series))
            series = [] if bool(self._lost.all()) else [*series, self.points()]
        if not series:
            return [np.full(1, np.nan) for _ in observed]
        simulated = self.replay.at_frames(torch.stack(series[-1:] if self.replay.is_static else series, 1), self.start)
        first = first_frame(self.experiment, self.replay.trials.names)
        pairs = zip(simulated[:, first:].cpu().numpy(), observed[:, first:].cpu().numpy(), strict=True)
        return [marker_errors(x[: len(y)], y) for x, y in pairs]


def first_frame(experiment: Experiment, names: Sequence[str]) -> int:
    """First frame that counts in errors: 1 if the roll-out starts from the given state, else 0."""
    return int(experiment.begins(names[0]) == GIVEN)


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
            runs.extend(ModelRollout(experiment, model, batch, learned) for batch in experiment.batches(names))
        rows = [row for run in runs for row in run.with_learned(learned).errors()]
        mean = summarise(rows)["mean"]
        return float("inf") if mean is None else mean

    return error


def learned_of(experiment: Experiment, model: str) -> Learned | None:
    """Trained network of a model in this run; None for models without a network."""
    assert isinstance(experiment.settings, TestStage)
    return load(experiment.folder, model, experiment.like.device) if model in LEARNED else None
