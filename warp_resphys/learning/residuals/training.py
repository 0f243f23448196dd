"""Supervised training of a model, with weights selected by roll-out error or,
as published, by validation loss.
"""

import copy
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from typing_extensions import override

from ...data.input_network import Actuator
from ...io.errors import InputError
from ...io.progress import Progress
from ...settings.learning import EpochSettings, TrainerSettings
from .networks import Model, StateMap

_SAVE_SECONDS = 10.0

Trained = TypeVar("Trained", bound=StateMap | Actuator)
Snapshot = tuple[dict[str, torch.Tensor], dict[str, Any]]


@dataclass(frozen=True)
class Samples:
    """States and the fields to predict from them."""

    q: torch.Tensor  # (S, N, 3) positions [m]
    v: torch.Tensor  # (S, N, 3) velocities [m/s]
    outputs: tuple[torch.Tensor, ...]  # fields to predict, (S, N, 3) each
    actuation: torch.Tensor | None = None  # (S, A) further inputs of the network; None without any

    @classmethod
    def joined(cls, parts: "Sequence[Samples]") -> "Samples":
        """Returns the samples of all parts, one after the other."""
        actuation = [part.actuation for part in parts if part.actuation is not None]
        return cls(
            q=torch.cat([part.q for part in parts]),
            v=torch.cat([part.v for part in parts]),
            outputs=tuple(map(torch.cat, zip(*(part.outputs for part in parts), strict=True))),
            actuation=torch.cat(actuation) if actuation else None,
        )


class EpochTrainer(ABC, Generic[Trained]):
    """Trains epoch by epoch, and keeps the weights with the smallest roll-out error.

    Args:
        model: to train.
        optimiser: of the network's weights; None: the training needs no memory of earlier epochs.
        rollout_error: mean roll-out error on the validation split [mm]; infinite where a roll-out
            diverged.
        settings: number of epochs, and how often the roll-out error is measured.

    Attributes:
        epoch: epochs done.
        history: a record for each epoch: ``epoch``, ``train_loss``, ``validation_loss``,
            ``learning_rate``, and where measured ``rollout_error_mm``, infinite where a roll-out
            diverged.
        best_score: smallest value so far of the selection criterion, a roll-out error [mm] or a
            validation loss.
        best_epoch: its epoch.
        best: its weights.
    """

    selection: str = "rollout"

    def __init__(
        self,
        model: Trained,
        optimiser: torch.optim.Optimizer | None,
        rollout_error: Callable[[Trained], float],
        settings: EpochSettings,
    ) -> None:
        self.model = model
        self.settings = settings
        self.rollout_error = rollout_error
        self._optimiser = optimiser
        self.epoch = 0
        self.history = list[dict[str, float]]()
        self.best_score = math.inf
        self.best_epoch = 0
        self.best = dict[str, torch.Tensor]()

    @abstractmethod
    def _run_epoch(self) -> dict[str, float]:
        """Trains for one epoch; returns the losses for its record."""

    @property
    def finished(self) -> bool:
        """Whether all epochs are done."""
        return self.epoch >= self.settings.epochs

    def run_epoch(self) -> dict[str, float]:
        """Trains for one epoch and returns its record."""
        losses = self._run_epoch()
        self.epoch += 1
        record = {"epoch": float(self.epoch), **losses}
        if self.epoch % self.settings.rollout_every == 0 or self.finished:
            record["rollout_error_mm"] = self.rollout_error(self.model)
        self._keep(record)
        return record

    def _keep(self, record: dict[str, float]) -> None:
        """Adds a record to the history, and keeps the weights
        if their score is the first or the best so far.
        """
        self.history.append(record)
        score = record.get("rollout_error_mm" if self.selection == "rollout" else self.selection)
        if score is not None and (score < self.best_score or not self.best):
            self.best_score, self.best_epoch = score, self.epoch
            self.best = {k: t.detach().clone() for k, t in self.model.network.state_dict().items()}

    def _kept_record(self) -> dict[str, float]:
        """Record of the epoch whose weights are kept."""
        return next(record for record in self.history if record["epoch"] == self.best_epoch)

    @property
    def best_error(self) -> float:
        """Roll-out error of the kept weights [mm].

        Infinite if one diverged, NaN before the first measurement.
        """
        return self._kept_record().get("rollout_error_mm", math.nan) if self.best else math.nan

    def use_best(self) -> Trained:
        """Returns the model with the kept weights.

        Adds their roll-out error to the history if missing.
        """
        self.model.network.load_state_dict(self.best)
        self.model.eval()
        record = self._kept_record()
        if "rollout_error_mm" not in record:
            record["rollout_error_mm"] = self.rollout_error(self.model)
        return self.model

    def snapshot(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Returns tensors and metadata for `resume`."""
        tensors = {f"model.{k}": t for k, t in self.model.state_dict().items()}
        tensors |= {f"best.{k}": t for k, t in self.best.items()}
        numbers: dict[str, Any] = {}
        slots = {} if self._optimiser is None else self._optimiser.state_dict()["state"]
        for i, slot in slots.items():
            for key, value in slot.items():
                name = f"{i}.{key}"
                if isinstance(value, torch.Tensor):
                    tensors[f"optimiser.{name}"] = value
                elif not isinstance(value, list):
                    numbers[name] = value
                elif key != "al":  # Scratch memory of L-BFGS.
                    numbers[name] = []
                    tensors |= {f"optimiser.{name}.{k:04d}": t for k, t in enumerate(value)}
        return tensors, {
            "epoch": self.epoch,
            "best_score": self.best_score,
            "best_epoch": self.best_epoch,
            "history": self.history,
            "optimiser": numbers,
        }

    def resume(self, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
        """Continues exactly from a `snapshot`."""
        self.model.load_state_dict(with_prefix(tensors, "model."))
        self.epoch, self.history = metadata["epoch"], copy.deepcopy(metadata["history"])
        self.best_score, self.best_epoch = metadata["best_score"], metadata["best_epoch"]
        self.best = with_prefix(tensors, "best.")
        slots: dict[int, dict[str, Any]] = {}
        for name, value in metadata["optimiser"].items():
            index, key = name.split(".")
            slots.setdefault(int(index), {})[key] = (
                list(value) if isinstance(value, list) else value
            )
        for name, tensor in sorted(with_prefix(tensors, "optimiser.").items()):
            index, key, *position = name.split(".")
            slot = slots.setdefault(int(index), {})
            slot[key] = [*slot[key], tensor] if position else tensor
        if self._optimiser is not None:
            self._optimiser.load_state_dict({**self._optimiser.state_dict(), "state": slots})


class Trainer(EpochTrainer[Model]):
    """Minimises the mean squared error of the standardised outputs by Adam.

    The kept weights have the smallest roll-out error on the validation split, measured every few
    epochs, or the smallest validation loss. In both cases `use_best` records their roll-out error
    in the history.

    Args:
        model: to train; on the device of the samples.
        train: training samples.
        validation: held-out samples.
        rollout_error: see `EpochTrainer`.
        settings: rates, batches, noise and epochs.
        seed: of the batches and the noise.

    Raises:
        InputError: an empty split.
    """

    settings: TrainerSettings

    def __init__(
        self,
        model: Model,
        train: Samples,
        validation: Samples,
        rollout_error: Callable[[Model], float],
        settings: TrainerSettings,
        seed: int,
    ) -> None:
        for name, samples in (("training", train), ("validation", validation)):
            if not len(samples.q):
                raise InputError(f"the {name} split is empty: give it at least one trajectory.")
        weights = [w for w in model.network.parameters() if w.requires_grad]
        self._adam = torch.optim.Adam(weights, weight_decay=settings.weight_decay, fused=True)
        super().__init__(model, self._adam, rollout_error, settings)
        self.selection = settings.selection
        self._random = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            self._train = (
                model.encode(train.q, train.v, train.actuation),
                model.encode_outputs(*train.outputs),
            )
            self._validation = (
                model.encode(validation.q, validation.v, validation.actuation),
                model.encode_outputs(*validation.outputs),
            )
            if settings.linear_noise is not None:
                model.fit_linear(*self._train, settings.linear_noise)
            self._weights = scale_weights(model, settings.scale_weight)

    def learning_rate(self, epoch: int) -> float:
        """Learning rate of an epoch: cosine schedule, or steps by a factor gamma."""
        first, last = self.settings.learning_rate, self.settings.final_learning_rate
        if self.settings.schedule == "step":
            return float(first * self.settings.gamma ** (epoch // self.settings.step_epochs))
        phase = epoch / max(self.settings.epochs - 1, 1)
        return float(last + 0.5 * (first - last) * (1.0 + math.cos(math.pi * phase)))

    @override
    def _run_epoch(self) -> dict[str, float]:
        rate = self.learning_rate(self.epoch)
        self._adam.param_groups[0]["lr"] = rate
        self.model.train()
        inputs, outputs = self._train
        total = torch.zeros((), device=inputs.device)
        order = torch.randperm(len(inputs), generator=self._random).to(inputs.device)
        for batch in order.split(self.settings.batch_size):
            loss = self._loss(self._noisy(inputs[batch]), outputs[batch])
            self._adam.zero_grad()
            loss.backward()
            self._adam.step()
            total += loss.detach() * len(batch)
        self.model.eval()
        unit = float(self.model.remainder) ** 2
        with torch.no_grad():
            validation = float(self._loss(*self._validation)) * unit
        return {
            "train_loss": float(total) / len(inputs) * unit,
            "validation_loss": validation,
            "learning_rate": rate,
        }

    def _noisy(self, inputs: torch.Tensor) -> torch.Tensor:
        if not self.settings.noise > 0.0:
            return inputs
        return inputs + self.settings.noise * torch.randn(inputs.shape, generator=self._random).to(
            inputs.device
        )

    def _loss(self, inputs: torch.Tensor, outputs: torch.Tensor) -> torch.Tensor:
        """Mean weighted squared error of the standardised outputs,
        relative to the remainder of the linear part.
        """
        error = self.model.standardised(inputs) - outputs
        return (self._weights * error / self.model.remainder).square().mean()

    @override
    def snapshot(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        tensors, metadata = super().snapshot()
        return {**tensors, "random": self._random.get_state()}, metadata

    @override
    def resume(self, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
        super().resume(tensors, metadata)
        self._random.set_state(tensors["random"])


def scale_weights(model: StateMap, exponent: float) -> torch.Tensor:
    """Weights (n_out,) of the standardised outputs in the loss:
    powers of their deviations, mean square one in a field.

    With exponent zero, all modes have equal weight. With exponent one, the loss is the squared
    error of the fields themselves, which a few modes dominate; with a half, small modes are learned
    too.
    """
    weights = []
    for coder in model.coders:
        powers = coder.scale**exponent
        weights.append(powers / powers.square().mean().sqrt())
    return torch.cat(weights).to(model.linear.dtype)


def with_prefix(tensors: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """Returns the tensors whose names start with a prefix, without the prefix."""
    return {
        key.removeprefix(prefix): tensor
        for key, tensor in tensors.items()
        if key.startswith(prefix)
    }


def run_epochs(
    name: str,
    trainer: EpochTrainer[Any],
    save: Callable[[Snapshot], None] = lambda kept: None,
    watch: Callable[[Mapping[str, float]], None] | None = None,
) -> None:
    """Trains to the end.

    Saves the last complete epoch regularly, and whenever training ends or is interrupted.

    Args:
        name: description of the progress bar.
        trainer: trainer, possibly resumed.
        save: saves a snapshot.
        watch: is called with the record of every epoch; an exception raised by it ends the
            training.
    """
    saved = time.monotonic()
    kept = _copy(trainer.snapshot())
    with Progress(name, trainer.settings.epochs, "epochs", trainer.epoch) as progress:
        try:
            while not trainer.finished:
                record = trainer.run_epoch()
                kept = _copy(trainer.snapshot())
                if time.monotonic() - saved > _SAVE_SECONDS:
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
    """Copies a snapshot, whose tensors the next epoch changes in place."""
    tensors, metadata = snapshot
    copies = {name: tensor.detach().clone() for name, tensor in tensors.items()}
    return copies, {**metadata, "history": list(metadata["history"])}
