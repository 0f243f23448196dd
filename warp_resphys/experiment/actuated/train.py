"""Stages: the residual force and the data-driven baseline, from the reconstructed training trials."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from ...dynamics.frames import VertexFrames
from ...dynamics.modes import RestStiffness
from ...io.files import read_array, read_hdf5
from ...io.stages import StageContext
from ...learning.driven_rollout import DrivenDataRollout, DrivenHybridRollout, Range, WatchedModel
from ...learning.metrics import summarise
from ...learning.networks import NextState, StateMap, build_model, build_next_state
from ...learning.rollout import Rollout
from ...learning.training import Samples, Trainer
from ..build import choose_device
from ..measured.evaluate import marker_errors
from ..measured.files import training_file, weights_file
from ..train import fit
from .files import RECONSTRUCTED, WORLD
from .scene import DrivenScene


@dataclass(frozen=True)
class Reconstructed:
    """The states and forces of some trials that networks learn from, in single precision, as they are kept.

    Attributes:
        q: (R, K + 1, N, 3) positions [m].
        v: (R, K + 1, N, 3) velocities [m/s].
        force: (R, K + 1, N, 3) that leads to each state [N].
        inputs: (R, K, A) what the networks are told of the pressures.
        seen: (R, K) whether a marker saw where a step ends: what none saw has no force to learn.
    """

    q: torch.Tensor
    v: torch.Tensor
    force: torch.Tensor
    inputs: torch.Tensor
    seen: torch.Tensor

    def starts(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Positions, velocities (S, N, 3) and what is told of the pressures (S, A) where steps begin."""
        return self._of(self.q[:, :-1]), self._of(self.v[:, :-1]), self._of(self.inputs)

    def ends(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions and velocities (S, N, 3) where they end."""
        return self._of(self.q[:, 1:]), self._of(self.v[:, 1:])

    def forces(self) -> torch.Tensor:
        """(S, N, 3) that lead there."""
        return self._of(self.force[:, 1:])

    def _of(self, field: torch.Tensor) -> torch.Tensor:
        return field.flatten(0, 1) if bool(self.seen.all()) else field[self.seen]


def read_reconstructed(context: StageContext, scene: DrivenScene, device: torch.device) -> dict[str, Reconstructed]:
    """What the stage ``reconstruct`` left of each split."""
    with read_hdf5(context.run_dir / RECONSTRUCTED, "reconstruction") as file:
        found = {name: torch.as_tensor(read_array(file, name)) for name in ("q", "v", "force")}
    split, first, parts = context.settings["split"], 0, {}
    for name in ("train", "validation"):
        rows = slice(first, first + len(split[name]))
        first = rows.stop
        q, v, force = (found[key][rows].to(device) for key in ("q", "v", "force"))
        steps = q.shape[1] - 1
        inputs = scene.drive("resphys", tuple(split[name])).inputs[:, :steps].to(device)
        seen = torch.isfinite(scene.smoothed(tuple(split[name]))[:, 1 : steps + 1]).all(-1).any(-1).to(device)
        parts[name] = Reconstructed(q, v, force, inputs, seen)
    return parts


def train_driven(context: StageContext) -> None:
    """Trains the residual force: resphys.safetensors and training_resphys.json."""
    scene = DrivenScene(context.settings, context.run_dir, "count")
    device = choose_device(context.settings["device"])
    found = read_reconstructed(context, scene, device)
    frames, samples = scene.frames(context.settings["force_frame"]), {}
    for name, each in found.items():
        q, v, inputs = each.starts()
        force = each.forces() if frames is None else frames.to_rest(q, v, each.forces())
        samples[name] = Samples(q, v, (force,), inputs)
    train = samples["train"]
    rest = scene.simulator.rest_positions.to(train.q.device)
    torch.manual_seed(context.settings["seed"])
    stiffness = RestStiffness(scene.simulator)
    fields = train.q, train.v, train.outputs[0]
    model = build_model(context.settings["network"], rest, *fields, train.actuation, stiffness)
    _fit(context, scene, model, samples, "resphys", "residual force", context.settings["force_frame"])


def train_simfree_driven(context: StageContext) -> None:
    """Trains the data-driven baseline on the same states: simfree.safetensors and training_simfree.json."""
    scene = DrivenScene(context.settings, context.run_dir, "count")
    found = read_reconstructed(context, scene, choose_device(context.settings["device"]))
    rest = scene.simulator.rest_positions.to(found["train"].q.device)
    samples = {}
    for name, each in found.items():
        q, v, inputs = each.starts()
        following, speed = each.ends()
        samples[name] = Samples(q, v, (following - rest.to(following), speed), inputs)
    train = samples["train"]
    torch.manual_seed(context.settings["seed"])
    model = build_next_state(context.settings["network"], rest, train.q, train.v, train.actuation)
    _fit(context, scene, model, samples, "simfree", "next state")


def _fit(
    context: StageContext,
    scene: DrivenScene,
    model: Any,
    samples: Mapping[str, Samples],
    name: str,
    kind: str,
    frame: str = WORLD,
) -> None:
    """Trains, chooses by roll-outs of the validation trials, and keeps the range of the training beside the weights."""
    settings, train = context.settings, samples["train"]
    with torch.no_grad():
        range_ = Range.of(model.encode(train.q, train.v, train.actuation))
    error = validation_error(scene, name, tuple(settings["split"]["validation"]), range_, scene.frames(frame))
    trainer: Trainer[Any] = Trainer(model, train, samples["validation"], error, settings["trainer"], settings["seed"])
    fit(
        context,
        trainer,
        weights_file(name),
        training_file(name),
        kind,
        {"range": range_.description(), "force_frame": frame},
    )


def rollout_of(scene: DrivenScene, name: str, predict: WatchedModel | None, trials: tuple[str, ...]) -> Rollout:
    """A roll-out of a model of that name, over some trials.

    Args:
        scene: of the experiment.
        name: one of `files.MODELS`.
        predict: what it has learned; None for a simulator alone.
        trials: their names.
    """
    drive = scene.drive(name, trials)
    if predict is not None and isinstance(predict.model, NextState):
        return DrivenDataRollout(scene.simulator, predict, drive)
    return DrivenHybridRollout(scene.simulator, predict, drive, scene.tensors(name, trials))


def validation_error(
    scene: DrivenScene, name: str, trials: tuple[str, ...], range_: Range, frames: VertexFrames | None = None
) -> Callable[[StateMap], float]:
    """The mean error of a model's markers over what is learned from [mm]; infinite where a roll-out diverged.

    Args:
        scene: of the experiment.
        name: one of `files.MODELS`, that learns.
        trials: their names.
        range_: of the model's inputs in training.
        frames: with which what it predicts turns; None if it does not.
    """
    motions = scene.pick(trials)
    observed = motions.markers[:, : scene.learned_steps + 1].cpu().numpy()
    start = scene.simulator.static_equilibrium(material=scene.tensors(name, trials), batch=len(trials))

    def error(model: StateMap) -> float:
        rollout, state = rollout_of(scene, name, WatchedModel(model, range_, frames), trials), start
        series = [scene.markers(state.q)]
        for _ in range(observed.shape[1] - 1):
            state = rollout.step(state)
            lost = rollout.lost(state)[:, None, None]
            if bool(lost.all()):
                return float("inf")
            series.append(torch.where(lost, torch.nan, scene.markers(state.q)))
        found = torch.stack(series, 1).cpu().numpy()
        mean = summarise([marker_errors(x, y) for x, y in zip(found, observed, strict=True)])["mean"]
        return float("inf") if mean is None else mean

    return error
