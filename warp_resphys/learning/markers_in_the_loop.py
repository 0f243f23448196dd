"""A residual force trained on marker motions: the loss is the error of the corrected simulator over whole motions.

Few recordings determine only part of a residual force. So the force starts from zero, which is the uncorrected
simulator, and a penalty on the weights keeps it there as far as the motions allow.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from typing_extensions import override

from ..dynamics.frames import BaseFrame, VertexFrames
from ..io.errors import ConvergenceError
from ..settings.learning import InTheLoopSettings
from .full_batch import FullBatchTrainer
from .networks import OwnNetwork, ResidualForce
from .predictors import LearnedPredictor
from .replay import Replay, Start

_FAILURE = 1e4  # loss of a failed simulation, from which the line search steps back


@dataclass(frozen=True)
class TrialGroup:
    """Trials that begin alike, with the arguments of `LearnedPredictor` for them."""

    replay: Replay
    start: Start
    context: torch.Tensor | None = None
    frames: VertexFrames | None = None
    base: BaseFrame | None = None


class MotionLoss:
    """Mean over trials of the mean squared distance of markers, in units of each trial's amplitude.

    Args:
        groups: of trials.
        parameters: (1,) identified physical parameters.
    """

    def __init__(self, groups: Sequence[TrialGroup], parameters: Mapping[str, torch.Tensor]) -> None:
        self._groups, self._parameters = groups, parameters
        counts = [len(group.replay.trials.names) for group in groups]
        shares = [count / sum(counts) for count in counts]
        self._weights = [g.replay.trials.loss_weight * share for g, share in zip(groups, shares, strict=True)]

    def markers(self, model: ResidualForce | None) -> list[torch.Tensor]:
        """Simulated markers (R, T, M, 3) of each group [m], with the force of the model; without a force if None.

        Raises:
            ConvergenceError: the simulation fails.
        """
        markers = []
        for group in self._groups:
            force: Any = None
            if model is not None:
                force = LearnedPredictor(model, group.context, None, group.frames, group.base)
            markers.append(group.replay(group.start, self._parameters or None, force=force)[0])
        return markers

    def _errors(self, model: ResidualForce | None) -> list[torch.Tensor]:
        """(R, T, M, 3) simulated less observed markers of each group [m]."""
        pairs = zip(self._groups, self.markers(model), strict=True)
        return [group.replay.errors(markers[None])[0] for group, markers in pairs]

    def __call__(self, model: ResidualForce | None) -> torch.Tensor:
        """Returns the loss, differentiable in the model's weights."""
        pairs = zip(self._errors(model), self._weights, strict=True)
        return torch.stack([(errors.square().sum((1, 2, 3)) * weight).sum() for errors, weight in pairs]).sum()

    def error_mm(self, model: ResidualForce | None) -> float:
        """Mean distance of the seen markers, all trials with equal weight [mm]; infinite where a trial diverged."""
        try:
            with torch.no_grad():
                distances = [errors.norm(dim=-1).sum((1, 2)) for errors in self._errors(model)]
        except ConvergenceError:
            return float("inf")
        seen = [group.replay.trials.seen.sum((1, 2)) for group in self._groups]
        return 1e3 * float(torch.cat([d / s for d, s in zip(distances, seen, strict=True)]).mean())


class MarkersInTheLoop(FullBatchTrainer):
    """Minimises a `MotionLoss` and a penalty on the squares of the weights, by L-BFGS from zero force.

    The last layers have no bias: a constant force would compensate how one trial was held, which does not generalise.

    Args:
        model: to train; its last layers and the mean force are set to zero.
        train: loss on the training motions.
        validation: loss on the validation motions, which selects the weights; the training loss does if None.
        settings: epochs, and the penalty on the weights.
        epochs: in place of the configured number; 0 keeps the force at zero.
    """

    settings: InTheLoopSettings

    def __init__(
        self,
        model: ResidualForce,
        train: MotionLoss,
        validation: MotionLoss | None,
        settings: InTheLoopSettings,
        epochs: int | None = None,
    ) -> None:
        judge = train if validation is None else validation
        with torch.no_grad():
            _remove_force(model)
        super().__init__(
            model, judge.error_mm, settings if epochs is None else settings.model_copy(update={"epochs": epochs})
        )
        self._train = train

    def begin(self) -> None:
        """Records zero force as the first candidate, unless training has begun."""
        if not self.state.history:
            error = self.rollout_error(self.model)
            self._keep({"epoch": 0.0, "train_loss": self._loss_without_gradient(), "rollout_error_mm": error})

    @override
    def _run_epoch(self) -> dict[str, float]:
        self.begin()
        return {"train_loss": self._iterate()}

    def _loss_without_gradient(self) -> float:
        with torch.no_grad():
            return float(self._train(self.model) + self._penalty())

    def _penalty(self) -> torch.Tensor:
        squares = [w.square().sum() for w in self.model.network.parameters()]
        return self.settings.penalty * torch.stack(squares).sum()

    @override
    def _backward(self) -> float:
        try:
            loss = self._train(self.model) + self._penalty()
            loss.backward()
        except ConvergenceError:
            self._lbfgs.zero_grad()
            return _FAILURE
        return float(loss.detach())


def cross_validated_epochs(
    make_model: Callable[[], ResidualForce],
    parts: Sequence[tuple[MotionLoss, MotionLoss]],
    settings: InTheLoopSettings,
    advance: Callable[[], None],
) -> int:
    """Returns the number of epochs with the smallest mean error on held-out motions, by cross-validation.

    Args:
        make_model: returns an untrained model, with the same weights every time.
        parts: losses on the motions to train on and on the held-out ones, for each fold.
        settings: of every training; epochs is the largest number tried, and patience the number of epochs without an
            improvement after which the search ends.
        advance: called after every epoch of every fold.

    Returns:
        The number of epochs; 0 where training never improves on zero force.
    """
    settings = settings.changed(rollout_every=1)
    trainers = [MarkersInTheLoop(make_model(), train, held_out, settings) for train, held_out in parts]
    for trainer in trainers:
        trainer.begin()
    while True:
        means = np.mean([[record["rollout_error_mm"] for record in t.state.history] for t in trainers], axis=0)
        best = int(np.argmin(means))
        if trainers[0].finished or len(means) - 1 - best >= settings.patience:
            return best
        for trainer in trainers:
            trainer.run_epoch()
            advance()


def _remove_force(model: ResidualForce) -> None:
    """Makes the force zero through the last layers alone, so that their gradients stay non-zero."""
    for coder in model.coders:
        coder.mean.zero_()
    if isinstance(model.network, OwnNetwork):
        model.network.gain.zero_()
        return
    for block in model.network.blocks:
        last = block[-1]  # type: ignore[index]
        last.weight.zero_()
        last.bias.zero_()
        last.bias.requires_grad_(False)
