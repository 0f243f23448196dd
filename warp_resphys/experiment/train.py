"""Stages: the network that predicts the residual force, and the data-driven baseline."""

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

import torch

from ..dynamics.integrator import State
from ..io.files import read_checkpoint, write_checkpoint, write_json
from ..io.progress import Progress
from ..io.resumable import forget_checkpoint, keep_checkpoint, resume_checkpoint
from ..io.stages import StageContext
from ..learning.metrics import summarise, trajectory_errors
from ..learning.networks import Model, NextState, ResidualForce, build_model, build_next_state, restore
from ..learning.predictors import LearnedPredictor
from ..learning.rollout import Rollout, closed_loop
from ..learning.training import EpochTrainer, Samples, Trainer
from .build import build_simulator, choose_device
from .trajectories import (
    MODEL,
    RECONSTRUCTION,
    SIMFREE,
    SIMFREE_TRAINING,
    TRAINING,
    TRAJECTORIES,
    Split,
    read_fields,
    split_of,
)

log = logging.getLogger(__name__)
_CHECKPOINT_SECONDS = 10.0


Snapshot = tuple[dict[str, torch.Tensor], dict[str, Any]]


@dataclass(frozen=True)
class Learning(Generic[Model]):
    """What is learned, from what, and how it is judged; the network and the way of training are open.

    Attributes:
        samples: of the splits ``train`` and ``validation``.
        build: a model from the group ``network``.
        rollout_error: mean roll-out error on the validation split [mm]; infinite where a roll-out diverged.
    """

    samples: Mapping[str, Samples]
    build: Callable[[Mapping[str, Any]], Model]
    rollout_error: Callable[[Model], float]

    def trainer(self, network: Mapping[str, Any], trainer: Mapping[str, Any], seed: int) -> Trainer[Model]:
        """A trainer of a new model; the same settings and seed give the same model.

        Args:
            network: the group of that name.
            trainer: the group of that name.
            seed: of the weights, the batches and the noise.

        Raises:
            InputError: a setting out of range, or an empty split.
        """
        torch.manual_seed(seed)
        train, validation = (self.samples[name] for name in ("train", "validation"))
        return Trainer(self.build(network), train, validation, self.rollout_error, trainer, seed)


def residual_force_learning(context: StageContext) -> Learning[ResidualForce]:
    """The residual force, from the reconstruction in the run folder."""
    split, _ = split_of(context.settings["data"])
    device = choose_device(context.settings["device"])
    q, v, force = _read(context.run_dir / RECONSTRUCTION, "reconstruction", device, "q", "v", "force")
    samples = {name: _samples(q, v, (force,), split.indices(name)) for name in ("train", "validation")}
    validation = Validation(context, split, "simulation")
    rest = q.new_tensor(validation.simulator.body.mesh.vertices)
    pick = samples["train"]

    def error(candidate: ResidualForce) -> float:
        return validation.error_mm(Rollout(validation.simulator, LearnedPredictor(candidate)))

    return Learning(samples, lambda network: build_model(network, rest, pick.q, pick.v, pick.outputs[0]), error)


def next_state_learning(context: StageContext) -> Learning[NextState]:
    """The data-driven baseline, from the trajectories in the run folder."""
    split, _ = split_of(context.settings["data"])
    device = choose_device(context.settings["device"])
    q, v = _read(context.run_dir / TRAJECTORIES, "trajectories", device, "q", "v")
    validation = Validation(context, split, "reality")
    rest = q.new_tensor(validation.simulator.body.mesh.vertices)
    samples = {name: _samples(q, v, (q - rest, v), split.indices(name)) for name in ("train", "validation")}
    pick = samples["train"]

    def error(candidate: NextState) -> float:
        return validation.error_mm(Rollout(validation.simulator, LearnedPredictor(candidate)))

    return Learning(samples, lambda network: build_next_state(network, rest, pick.q, pick.v), error)


def train(context: StageContext) -> None:
    """Trains the residual force: model.safetensors, with the weights that are selected, and training.json."""
    fit(context, _configured(context, residual_force_learning(context)), MODEL, TRAINING, "residual force")


def train_simfree(context: StageContext) -> None:
    """Trains the data-driven baseline on the same trajectories: simfree.safetensors and simfree_training.json."""
    fit(context, _configured(context, next_state_learning(context)), SIMFREE, SIMFREE_TRAINING, "next state")


def _configured(context: StageContext, learning: Learning[Model]) -> Trainer[Model]:
    return learning.trainer(*(context.settings[key] for key in ("network", "trainer", "seed")))


def fit(
    context: StageContext,
    trainer: EpochTrainer[Model],
    model: str,
    history: str,
    kind: str,
    known: Mapping[str, Any] | None = None,
) -> None:
    """Trains, going on from an interrupted run, and writes the selected weights and the history.

    Args:
        context: of the stage.
        trainer: of the model.
        model: the file of the weights.
        history: the file of the epochs' records.
        kind: of the weights.
        known: what else is to be known of the model, beside its weights.
    """
    checkpoint = context.run_dir / f"{context.name}.safetensors"
    found = resume_checkpoint(checkpoint, "training", context.fingerprint)
    if found is not None:
        trainer.resume(*found)
    run_epochs(context.name, trainer, lambda kept: save_training(checkpoint, kept, context.fingerprint))
    best = trainer.use_best()
    kept = {
        "selection": trainer.selection,
        "epoch": trainer.state.best_epoch,
        "validation_rollout_error_mm": trainer.best_error if math.isfinite(trainer.best_error) else None,
    }
    if kept["validation_rollout_error_mm"] is None:
        log.warning("%s: the weights that are kept diverge on the validation split", context.name)
    write_json(context.run_dir / history, {"kept": kept, "epochs": trainer.state.history})
    write_checkpoint(
        context.run_dir / model,
        kind,
        best.state_dict(),
        {**best.description(), **(known or {}), **kept, "fingerprint": context.fingerprint},
    )
    forget_checkpoint(checkpoint)


def run_epochs(
    name: str,
    trainer: EpochTrainer[Model],
    save: Callable[[Snapshot], None],
    watch: Callable[[Mapping[str, float]], None] | None = None,
) -> None:
    """Trains to the end; on the way, and however it ends, keeps the last whole epoch.

    Args:
        name: what is shown beside the progress.
        trainer: goes on from where it stands.
        save: keeps a snapshot.
        watch: is told the record of every epoch; what it raises ends the training.
    """
    saved = time.monotonic()
    kept = _copy(trainer.snapshot())
    with Progress(name, trainer.config["epochs"], "epochs", trainer.state.epoch) as progress:
        try:
            while not trainer.finished:
                record = trainer.run_epoch()
                kept = _copy(trainer.snapshot())
                if time.monotonic() - saved > _CHECKPOINT_SECONDS:
                    save(kept)
                    saved = time.monotonic()
                shown: dict[str, object] = {"loss": f"{record['train_loss']:.2e}"}
                if not math.isnan(trainer.best_error):
                    shown["rollout"] = f"{trainer.best_error:.2g} mm"
                progress.advance(1, **shown)
                if watch is not None:
                    watch(record)
        finally:
            save(kept)


def _copy(snapshot: Snapshot) -> Snapshot:
    """The next epoch changes the tensors in place."""
    tensors, metadata = snapshot
    return {k: t.detach().clone() for k, t in tensors.items()}, {
        **metadata,
        "history": list(metadata["history"]),
    }


def save_training(checkpoint: Path, kept: Snapshot, fingerprint: str) -> None:
    """Writes a checkpoint that `resume_checkpoint` reads under the same fingerprint."""
    keep_checkpoint(checkpoint, "training", kept[0], {**kept[1], "fingerprint": fingerprint})


def _read(path: Path, kind: str, device: torch.device, *names: str) -> list[torch.Tensor]:
    return [torch.as_tensor(a, device=device) for a in read_fields(path, kind, *names)]


def _samples(q: torch.Tensor, v: torch.Tensor, outputs: tuple[torch.Tensor, ...], part: slice) -> Samples:
    """The states of a split, and the fields at the next frame of each."""
    now, following = (part, slice(None, -1)), (part, slice(1, None))
    return Samples(
        q[now].flatten(0, 1), v[now].flatten(0, 1), tuple(field[following].flatten(0, 1) for field in outputs)
    )


class Validation:
    """Roll-outs of the validation split.

    Args:
        context: of the stage.
        split: of the trajectories.
        material: the simulator's, ``simulation`` or ``reality``.
    """

    def __init__(self, context: StageContext, split: Split, material: str) -> None:
        self.simulator = build_simulator(context.settings, material, on_failure="count")
        q, v = read_fields(context.run_dir / TRAJECTORIES, "trajectories", "q", "v")
        part = split.indices("validation")
        self._target = q[part]
        self._start = State(self.simulator.tensor(q[part, 0]), self.simulator.tensor(v[part, 0]))

    def error_mm(self, rollout: Rollout) -> float:
        """Mean error [mm], infinite where a roll-out diverged."""
        positions = closed_loop(rollout, self._start, self._target.shape[1] - 1).cpu().numpy()
        pairs = zip(positions, self._target, strict=True)
        mean = summarise([trajectory_errors(q, target) for q, target in pairs])["mean"]
        return float("inf") if mean is None else mean


def load_model(path: Path) -> ResidualForce:
    """A residual force that `train` wrote."""
    return restore(ResidualForce, *read_checkpoint(path, "residual force"))


def load_simfree(path: Path) -> NextState:
    """A data-driven model that `train_simfree` wrote."""
    return restore(NextState, *read_checkpoint(path, "next state"))
