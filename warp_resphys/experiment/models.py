"""The models of an experiment, rolled out: a simulator, with a learned force, or a network in its place."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch

from ..dynamics.frames import VertexFrames
from ..dynamics.integrator import State
from ..dynamics.simulator import Simulator
from ..io.errors import ConvergenceError
from ..io.files import read_checkpoint
from ..learning.metrics import marker_errors, summarise
from ..learning.networks import NextState, ResidualForce, StateMap, restore
from ..learning.predictors import LearnedPredictor, Range
from ..learning.replay import Replay, Start
from ..learning.rollout import Rollout
from .files import GIVEN, weights_file
from .scene import LEARNED, Scene

SIMFREE: Final = "simfree"
_KINDS: Final[Mapping[bool, tuple[type[StateMap], str]]] = {
    True: (NextState, "next state"),
    False: (ResidualForce, "residual force"),
}
_POSE_STEPS = 200  # in which a network in place of a simulator is taken to come to rest


def kind_of(model: str) -> tuple[type[StateMap], str]:
    """The class of a learned model, and what its checkpoints hold."""
    return _KINDS[model == SIMFREE]


@dataclass(frozen=True)
class Learned:
    """What a model has learned.

    Attributes:
        network: that predicts a force, or the next state.
        range_: of its inputs in training, in which roll-outs hold it; None for no guard.
        force_frame: whether its forces turn with the body, see `Scene.frames`.
    """

    network: StateMap
    range_: Range | None = None
    force_frame: str = "world"

    def description(self) -> dict[str, Any]:
        """What `load` needs beside the network's own."""
        return {
            "range": None if self.range_ is None else self.range_.description(),
            "force_frame": self.force_frame,
        }


def load(folder: Path, model: str, refined: bool = False, like: torch.Tensor | None = None) -> Learned:
    """What a model has learned, from its checkpoint.

    Args:
        folder: of the split.
        model: one of `LEARNED`.
        refined: whether through the simulator, too.
        like: a tensor on the device; that of the checkpoint if left out.

    Raises:
        DataFileError: the file is missing or damaged.
    """
    network_type, kind = kind_of(model)
    tensors, description = read_checkpoint(folder / weights_file(model, refined), kind)
    network = restore(network_type, tensors, description)
    network = network if like is None else network.to(like.device)
    known = description["range"]
    return Learned(
        network, None if known is None else Range.restore(known, network.linear), str(description["force_frame"])
    )


class ModelRollout:
    """A model over some trials that begin alike.

    Args:
        scene: of the experiment.
        model: its name.
        names: of the trials.
        learned: what it has learned; None for a simulator alone.
        start: how the trials begin, where that is known; estimated if left out.
        simulator: in place of the model's.
    """

    def __init__(
        self,
        scene: Scene,
        model: str,
        names: Sequence[str],
        learned: Learned | None = None,
        start: Start | None = None,
        simulator: Simulator | None = None,
    ) -> None:
        self.scene, self.model = scene, model
        self.simulator = scene.model_simulator(model) if simulator is None else simulator
        self.replay = Replay(self.simulator, scene.observe, scene.trials(names, self.simulator))
        self.start = scene.start(self.simulator, self.replay.trials) if start is None else start
        parameters = scene.parameters(model)
        self._constants, self._inputs, self._resting = self.replay.setting(parameters)
        self._told = None if learned is None else scene.conditions(self.replay, parameters, model == SIMFREE)
        self._first: State | None = None
        self.rollout, self.predictor = self._make(learned)

    def _make(self, learned: Learned | None) -> tuple[Rollout, LearnedPredictor | None]:
        predict = None
        if learned is not None:
            frames = self._frames(learned)
            base = self.scene.base(self.replay.trials.names, self.simulator)
            predict = LearnedPredictor(learned.network, self._told, learned.range_, frames, base)
        return Rollout(self.simulator, predict, self._inputs, self._constants), predict

    def _frames(self, learned: Learned) -> VertexFrames | None:
        return (
            None if isinstance(learned.network, NextState) else self.scene.frames(self.simulator, learned.force_frame)
        )

    def with_learned(self, learned: Learned) -> "ModelRollout":
        """The same trials from their beginning, with something else learned."""
        if not self.replay.is_static:
            self.begin()  # Once for all.
        other = object.__new__(ModelRollout)
        other.__dict__.update(self.__dict__)
        other.rollout, other.predictor = self._make(learned)
        return other

    @property
    def steps(self) -> int:
        """That reach past all frames; of whole time steps of the experiment."""
        if self.replay.is_static:
            return _POSE_STEPS if self.model == SIMFREE else 0
        substeps = round(self.scene.config["time_step"] / self.simulator.time_step)
        return -(-self.replay.steps(self.start) // substeps) * substeps

    @torch.no_grad()
    def begin(self) -> State:
        """The states that the trials begin with; poses end there too."""
        if self.replay.is_static and self.predictor is not None and self.model != SIMFREE:
            force: Any = self.predictor
            return self.replay.begin(self.start, self._constants, self._resting, force=force)
        if self._first is None:
            self._first = self.replay.begin(self.start, self._constants, self._resting)
        return self._first

    def points(self, state: State) -> torch.Tensor:
        """(R, M, 3) what is observed of a state [m]; NaN where the roll-out has diverged."""
        lost = self.rollout.lost(state)[:, None, None]
        return torch.where(lost, torch.nan, self.scene.observe(state.q))

    def at_frames(self, series: torch.Tensor) -> torch.Tensor:
        """(R, T, M, 3) at the frames [m], of (R, K + 1, M, 3) at the steps; see `Replay.at_frames`."""
        last = series[:, -1:] if self.replay.is_static else series
        return self.replay.at_frames(last, self.start)

    @torch.no_grad()
    def errors(self, learned_from: bool = False) -> list[Any]:
        """Mean distances [mm] of what is observed at the frames of each trial; NaN where the roll-out diverged.

        Args:
            learned_from: whether only the part of each trial that is learned from counts.
        """
        observed = self.replay.trials.observed
        if learned_from:
            observed = observed[:, : self.scene.learned_steps(observed.shape[1] - 1) + 1]
        steps = self.steps
        if learned_from and self.scene.config["data"].get("train_fraction", 1.0) < 1.0:
            steps = min(steps, self.scene.learned_steps(steps))
        try:
            state = self.begin()
        except ConvergenceError:
            return [torch.full((1,), torch.nan).numpy() for _ in observed]
        series = [self.points(state)]
        for _ in range(steps):
            state = self.rollout.step(state)
            if bool(self.rollout.lost(state).all()):
                return [torch.full((1,), torch.nan).numpy() for _ in observed]
            series.append(self.points(state))
        found = self.at_frames(torch.stack(series, 1))[:, : observed.shape[1]]
        first = first_frame(self.scene, self.replay.trials.names)
        pairs = zip(found[:, first:].cpu().numpy(), observed[:, first:].cpu().numpy(), strict=True)
        return [marker_errors(x, y) for x, y in pairs]


def first_frame(scene: Scene, names: Sequence[str]) -> int:
    """From which frame on errors count: the state that a roll-out is given is none of its making."""
    return int(scene.begins(names[0]) == GIVEN)


def rollout_error(scene: Scene, model: str, names: Sequence[str]) -> Callable[[Learned], float]:
    """What tells the mean error of a model over some trials [mm]; infinite where a roll-out diverged.

    Args:
        scene: whose simulators count failures.
        model: one that learns.
        names: of the trials.
    """
    runs: list[ModelRollout] = []

    def error(learned: Learned) -> float:
        if not runs:  # The beginnings of trials are estimated once, and only where someone asks.
            runs.extend(ModelRollout(scene, model, some, learned) for some in scene.alike(names))
        rows = [row for run in runs for row in run.with_learned(learned).errors(learned_from=True)]
        mean = summarise(rows)["mean"]
        return float("inf") if mean is None else mean

    return error


def learned_of(scene: Scene, model: str, like: torch.Tensor) -> Learned | None:
    """What a model has learned in this run; None for those that are simulators alone."""
    refined = model != SIMFREE and scene.config["refinement"] != "none"
    return load(scene.folder, model, refined, like) if model in LEARNED else None
