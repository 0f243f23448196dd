"""A residual force trained on what markers saw: the loss is what the corrected simulator gets wrong over whole motions.

Few recordings leave most of a residual force open. The force starts from zero, which is the simulator as it is, and
every weight is paid for, so that it departs from there only as far as the motions ask for.
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
from .networks import ResidualForce
from .predictors import LearnedPredictor
from .replay import Replay, Start

_FAILURE = 1e4  # loss of a simulation that fails: the line search comes back from there


@dataclass(frozen=True)
class Watched:
    """Trials that begin alike, as a loss sees them.

    Attributes:
        replay: of the trials.
        start: how they begin.
        told: what a model is told of the inputs (`LearnedPredictor`); None for nothing.
        frames: with which forces turn; None if they do not.
        base: in whose frame the model predicts; None where that stands still.
    """

    replay: Replay
    start: Start
    told: torch.Tensor | None = None
    frames: VertexFrames | None = None
    base: BaseFrame | None = None


class MotionLoss:
    """Mean over trials of the mean squared distance of markers, in units of each trial's amplitude.

    Args:
        watched: the trials, in groups that begin alike.
        parameters: (1,) physical parameters that were identified.
    """

    def __init__(self, watched: Sequence[Watched], parameters: Mapping[str, torch.Tensor]) -> None:
        self._watched, self._parameters = watched, parameters
        counts = [len(each.replay.trials.names) for each in watched]
        shares = [count / sum(counts) for count in counts]
        self._weights = [w.replay.trials.loss_weight * share for w, share in zip(watched, shares, strict=True)]

    def markers(self, model: ResidualForce | None) -> list[torch.Tensor]:
        """(R, T, M, 3) at the frames of each group [m], with the force of the model or without any.

        Raises:
            ConvergenceError: the simulation fails.
        """
        found = []
        for each in self._watched:
            force: Any = None if model is None else LearnedPredictor(model, each.told, None, each.frames, each.base)
            found.append(each.replay(each.start, self._parameters or None, force=force)[0])
        return found

    def _errors(self, model: ResidualForce | None) -> list[torch.Tensor]:
        """(R, T, M, 3) simulated less observed markers of each group [m]."""
        pairs = zip(self._watched, self.markers(model), strict=True)
        return [each.replay.errors(markers[None])[0] for each, markers in pairs]

    def __call__(self, model: ResidualForce | None) -> torch.Tensor:
        """The loss, differentiable in the model's weights."""
        pairs = zip(self._errors(model), self._weights, strict=True)
        return torch.stack([(errors.square().sum((1, 2, 3)) * weight).sum() for errors, weight in pairs]).sum()

    def error_mm(self, model: ResidualForce | None) -> float:
        """Mean distance of the markers that were seen, trials weighing the same [mm]; infinite where one diverged."""
        try:
            with torch.no_grad():
                errors = [each.norm(dim=-1).sum((1, 2)) for each in self._errors(model)]
        except ConvergenceError:
            return float("inf")
        seen = [each.replay.trials.seen.sum((1, 2)) for each in self._watched]
        return 1e3 * float(torch.cat([e / s for e, s in zip(errors, seen, strict=True)]).mean())


class MarkersInTheLoop(FullBatchTrainer):
    """Minimises a `MotionLoss` and a penalty on the squares of the weights, by L-BFGS from no force at all.

    The last layers have no bias: a constant force would make up for how a trial was held, which the next one does not
    share.

    Args:
        model: whose network's weights are trained; those of its last layers are set to zero, as is the mean force.
        train: loss on the training motions.
        validation: loss on the validation motions, by which the weights are chosen; None: the training motions are.
        settings: epochs, and the penalty on the weights.
        epochs: in place of the configured ones; 0 keeps the simulator as it is.
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
        """Keeps the simulator as it is, without a force, as the first candidate; a trainer that has begun stays."""
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
            self._optimiser.zero_grad()
            return _FAILURE
        return float(loss.detach())


def cross_validated_epochs(
    make_model: Callable[[], ResidualForce],
    parts: Sequence[tuple[MotionLoss, MotionLoss]],
    settings: InTheLoopSettings,
    advance: Callable[[], None],
) -> int:
    """How many epochs serve motions that training did not see: those with the smallest mean error over the parts.

    Args:
        make_model: an untrained model, the same every time.
        parts: losses of the motions to train on, and of those that are held out.
        settings: of every search; its epochs are the most that are tried, and its patience is after how many
            without any gain the search ends.
        advance: called after every epoch of every part.

    Returns:
        0 where no training is better than the simulator as it is.
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
    """Makes the force vanish, and leaves the first layers as they are, so that gradients reach the last ones."""
    for coder in model.coders:
        coder.mean.zero_()
    for block in model.network.blocks:
        last = block[-1]  # type: ignore[index]
        last.weight.zero_()
        last.bias.zero_()
        last.bias.requires_grad_(False)
