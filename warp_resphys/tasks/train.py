"""Stage: the network that predicts the residual force."""

import logging
import time
from pathlib import Path
from typing import Any

import torch

from ..configured import build_simulator, choose_device
from ..files import read_checkpoint, write_checkpoint, write_json
from ..integrator import State
from ..metrics import summarise, trajectory_errors
from ..progress import Progress
from ..residual.networks import ResidualForce, build_model, restore
from ..residual.rollout import Predictor, closed_loop
from ..residual.training import Samples, Trainer
from ..resumable import resume_checkpoint
from ..stages import StageContext
from .trajectories import (
    MODEL,
    RECONSTRUCTION,
    TRAINING,
    TRAJECTORIES,
    Split,
    read_fields,
    weight_split,
)

log = logging.getLogger(__name__)
_CHECKPOINT_SECONDS = 10.0


def train(context: StageContext) -> None:
    """Writes model.safetensors, the weights with the smallest validation roll-out error, and training.json."""
    settings = context.settings
    split, _ = weight_split(settings["data"])
    device = choose_device(settings["device"])
    torch.manual_seed(settings["seed"])
    samples = _samples(context.run_dir, split, device)
    rest = samples["train"].q.new_tensor(build_simulator(settings).body.mesh.vertices)
    pick = samples["train"]
    model = build_model(settings["network"], rest, pick.q, pick.v, pick.force)
    error = ValidationError(context, split)
    trainer = Trainer(model, pick, samples["validation"], error, settings["trainer"], settings["seed"])
    checkpoint = context.run_dir / "training.safetensors"
    found = resume_checkpoint(checkpoint, "training", context.fingerprint)
    if found is not None:
        trainer.resume(*found)
    _run_epochs(trainer, checkpoint, context.fingerprint)
    best = trainer.use_best()
    error_mm = trainer.state.best_error
    write_json(context.run_dir / TRAINING, trainer.state.history)
    write_checkpoint(
        context.run_dir / MODEL,
        "residual force",
        best.state_dict(),
        {**best.description(), "validation_rollout_error_mm": error_mm, "fingerprint": context.fingerprint},
    )
    checkpoint.unlink(missing_ok=True)


def _run_epochs(trainer: Trainer, checkpoint: Path, fingerprint: str) -> None:
    """Trains to the end; on the way, and however it ends, keeps the last whole epoch."""
    epochs = trainer.config["epochs"]
    saved = time.monotonic()
    kept = _copy(trainer.snapshot())
    with Progress("train", epochs, "epochs", trainer.state.epoch) as progress:
        try:
            while not trainer.finished:
                record = trainer.run_epoch()
                kept = _copy(trainer.snapshot())
                if time.monotonic() - saved > _CHECKPOINT_SECONDS:
                    _save(checkpoint, kept, fingerprint)
                    saved = time.monotonic()
                shown: dict[str, object] = {"loss": f"{record['train_loss']:.2e}"}
                if trainer.state.best:
                    shown["rollout"] = f"{trainer.state.best_error:.2g} mm"
                progress.advance(1, **shown)
        finally:
            _save(checkpoint, kept, fingerprint)


def _copy(
    snapshot: tuple[dict[str, torch.Tensor], dict[str, Any]],
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """The next epoch changes the tensors in place."""
    tensors, metadata = snapshot
    return {k: t.detach().clone() for k, t in tensors.items()}, {
        **metadata,
        "history": list(metadata["history"]),
    }


def _save(checkpoint: Path, kept: tuple[dict[str, torch.Tensor], dict[str, Any]], fingerprint: str) -> None:
    write_checkpoint(checkpoint, "training", kept[0], {**kept[1], "fingerprint": fingerprint})


def _samples(run_dir: Path, split: Split, device: torch.device) -> dict[str, Samples]:
    """States and the forces that lead on from them, by split."""
    arrays = read_fields(run_dir / RECONSTRUCTION, "reconstruction", "q", "v", "force")
    q, v, force = (torch.as_tensor(a, device=device) for a in arrays)
    samples = {}
    for name in ("train", "validation"):
        part = split.indices(name)
        samples[name] = Samples(q[part, :-1].flatten(0, 1), v[part, :-1].flatten(0, 1), force[part, 1:].flatten(0, 1))
    return samples


class ValidationError:
    """Mean roll-out error on the validation split [mm], infinite where a roll-out diverged."""

    def __init__(self, context: StageContext, split: Split) -> None:
        self.simulator = build_simulator(context.settings, on_failure="count")
        q, v = read_fields(context.run_dir / TRAJECTORIES, "trajectories", "q", "v")
        part = split.indices("validation")
        self._target = q[part]
        self._start = State(self.simulator.tensor(q[part, 0]), self.simulator.tensor(v[part, 0]))

    def __call__(self, model: ResidualForce) -> float:
        """Rolls the model out."""
        steps = self._target.shape[1] - 1
        positions = closed_loop(self.simulator, predictor(model), self._start, steps).cpu().numpy()
        pairs = zip(positions, self._target, strict=True)
        mean = summarise([trajectory_errors(q, target) for q, target in pairs])["mean"]
        return float("inf") if mean is None else mean


def predictor(model: ResidualForce) -> Predictor:
    """The model as a function on the simulator's device, wherever its weights are."""
    device = model.rest.device

    def predict(q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        dtype = model.rest.dtype
        return model(q.to(device, dtype), v.to(device, dtype)).to(q.device, q.dtype)

    return predict


def load_model(path: Path) -> ResidualForce:
    """A model that `train` wrote."""
    tensors, metadata = read_checkpoint(path, "residual force")
    return restore(tensors, metadata)
