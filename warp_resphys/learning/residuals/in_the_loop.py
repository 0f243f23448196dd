"""Training of a residual force through the simulator: the loss is the error of the corrected simulator over motions.

Its gradient goes back through the implicit adjoint of every step (Um et al. 2020, "Solver-in-the-Loop").

An epoch is one iteration of L-BFGS with its line search. Adam's first steps move every weight by the learning rate,
however small the gradient, which spoils a network that is nearly right; and where the loss comes from the simulator, a
line search costs less than tuning a schedule of rates. The variables are the weights, or for an actuator C^T w with
the Cholesky factor C of an approximate Hessian of the loss.

Few recordings determine only part of a residual force. So the force starts from zero, which is the uncorrected
simulator, and a penalty on the weights keeps it there as far as the motions allow. An `Actuator` is trained in the same
way, from weights that are given.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch.nn.utils import parameters_to_vector
from typing_extensions import override

from ...data.input_network import Actuator
from ...dynamics.frames import BaseFrame, VertexFrames
from ...io.arrays import FloatArray
from ...io.errors import ConvergenceError
from ...settings.learning import LoopSettings
from ..replay import Replay, Start
from .correction import LearnedPredictor
from .networks import OwnNetwork, ResidualForce
from .training import EpochTrainer

_EVALUATIONS = 12  # of the loss, at most, in one epoch
_FAILURE = 1e4  # loss of a failed simulation, from which the line search steps back
Corrects = ResidualForce | Actuator
Corrected = TypeVar("Corrected", bound=Corrects)
_LEAST = 1e-30  # of the loss of the first weights, by which others are divided


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

    Attributes:
        weights: (R,) of the squared errors of each group's trials.
        judged: for each call of `error_mm`, the mean distances (T,) by frame of each trial [mm], NaN where it diverged.
    """

    def __init__(self, groups: Sequence[TrialGroup], parameters: Mapping[str, torch.Tensor]) -> None:
        self._groups, self._parameters, self.judged = groups, parameters, list[list[FloatArray]]()
        counts = [len(group.replay.trials.names) for group in groups]
        shares = [count / sum(counts) for count in counts]
        self.weights = [g.replay.trials.loss_weight * share for g, share in zip(groups, shares, strict=True)]

    def _errors(self, model: Corrects | None) -> list[torch.Tensor]:
        """(R, T, M, 3) simulated less observed markers of each group [m], of the simulator if the model is None.

        Raises:
            ConvergenceError: the simulation fails.
        """
        errors = []
        for group in self._groups:
            force: Any = None
            replay = group.replay.changed(actuator=model.inputs) if isinstance(model, Actuator) else group.replay
            if isinstance(model, ResidualForce):
                force = LearnedPredictor(model, group.context, None, group.frames, group.base)
            simulated = replay(group.start, self._parameters or None, force=force)
            errors.append(replay.errors(simulated)[0])
        return errors

    def __call__(self, model: Corrects | None) -> torch.Tensor:
        """Returns the loss, differentiable in the model's weights."""
        pairs = zip(self._errors(model), self.weights, strict=True)
        return torch.stack([(errors.square().sum((1, 2, 3)) * weight).sum() for errors, weight in pairs]).sum()

    def error_mm(self, model: Corrects | None) -> float:
        """Mean distance of the seen markers, all trials with equal weight [mm]; infinite where a trial diverged.

        The distances by frame are kept in `judged`.
        """
        seen = [group.replay.trials.seen for group in self._groups]
        try:
            with torch.no_grad():
                distances = [errors.norm(dim=-1) for errors in self._errors(model)]
        except ConvergenceError:
            self.judged.append([np.full(1, np.nan) for one in seen for _ in one])
            return float("inf")
        pairs = [*zip(distances, seen, strict=True)]
        frames = [(row.sum(1) / s.sum(1))[s.any(1)] for d, shown in pairs for row, s in zip(d, shown, strict=True)]
        self.judged.append([1e3 * row.double().cpu().numpy() for row in frames])
        return 1e3 * float(torch.cat([d.sum((1, 2)) / s.sum((1, 2)) for d, s in pairs]).mean())

    def amplitudes_mm(self) -> list[float]:
        """Amplitudes of the trials [mm]."""
        return [1e3 * size for group in self._groups for size in group.replay.trials.amplitude.tolist()]


class InTheLoop(EpochTrainer[Corrected]):
    """Minimises a `MotionLoss` and a penalty on the squares of the weights, by L-BFGS.

    A force begins at zero, and its last layers have no bias: a constant force would compensate how one trial was held,
    which does not generalise. An actuator begins at its weights, and the loss is divided by its first value.

    Args:
        model: to train; last layers and mean force of a residual force are set to zero.
        train: loss on the training motions.
        judge: loss whose error selects the weights, those of the start among them.
        settings: epochs and the penalty on the weights.
        epochs: in place of the configured number; 0 keeps the start.
        factor: (P, P) lower Cholesky factor C of an approximate Hessian of the loss over its first value, by the P
            weights w: L-BFGS varies C^T w, in which that Hessian is the identity. It varies w itself if None.
    """

    settings: LoopSettings

    def __init__(
        self,
        model: Corrected,
        train: MotionLoss,
        judge: MotionLoss,
        settings: LoopSettings,
        epochs: int | None = None,
        factor: torch.Tensor | None = None,
    ) -> None:
        if isinstance(model, ResidualForce):
            with torch.no_grad():
                _remove_force(model)
        self._train = train
        self._weights = [w for w in model.network.parameters() if w.requires_grad]
        self._factor, weights = factor, parameters_to_vector(self._weights).detach()
        self._variables = weights.clone() if factor is None else factor.T @ weights
        self._lbfgs = torch.optim.LBFGS(
            [self._variables],
            max_iter=1,
            max_eval=_EVALUATIONS,
            history_size=settings.memory,
            line_search_fn="strong_wolfe",
            tolerance_grad=0.0,
            tolerance_change=0.0,
        )
        last = settings.epochs if epochs is None else epochs
        super().__init__(model, self._lbfgs, judge.error_mm, settings.model_copy(update={"epochs": last}))
        self._last: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None = None

    def begin(self) -> None:
        """Records the start as the first candidate, unless training has begun."""
        if not self.history:
            error = self.rollout_error(self.model)
            with torch.no_grad():
                loss = float(self._loss())
            self._keep({"epoch": float(self.epoch), "train_loss": loss, "rollout_error_mm": error})

    @override
    def _run_epoch(self) -> dict[str, float]:
        """Makes one iteration."""
        self.begin()
        (group,) = self._lbfgs.param_groups
        group["lr"] = 1.0
        if self._factor is not None and self.epoch == 0:
            self._evaluate()  # L-BFGS divides its first step by the sum of the slopes, which is undone here.
            assert self._last is not None
            group["lr"] = max(float(self._last[1].abs().sum()), 1.0)
        self._lbfgs.step(self._evaluate)
        return {"train_loss": float(self._evaluate()) * self._unit}

    @property
    def _unit(self) -> float:
        """Loss by which that of the optimiser is divided."""
        return max(self.history[0]["train_loss"], _LEAST) if isinstance(self.model, Actuator) else 1.0

    def _loss(self) -> torch.Tensor:
        squares = [w.square().sum() for w in self.model.network.parameters()]
        return self._train(self.model) + self.settings.penalty * torch.stack(squares).sum()

    def _evaluate(self) -> torch.Tensor:
        """Returns the loss and sets its gradient; cached, as L-BFGS evaluates the weights that it accepts twice."""
        if self._last is None or not torch.equal(self._variables, self._last[0]):
            values = self._solved(self._variables, transposed=True).split([w.numel() for w in self._weights])
            for weight, value in zip(self._weights, values, strict=True):
                weight.data.copy_(value.view_as(weight))
            self.model.zero_grad()
            try:
                loss = self._loss() / self._unit
                loss.backward()
            except ConvergenceError:
                self.model.zero_grad()
                loss = torch.tensor(_FAILURE, dtype=torch.float64)
            gradients = [torch.zeros_like(w) if w.grad is None else w.grad for w in self._weights]
            self._last = self._variables.clone(), self._solved(parameters_to_vector(gradients)), loss.detach()
        self._variables.grad = self._last[1].clone()
        return self._last[2]

    def _solved(self, vector: torch.Tensor, transposed: bool = False) -> torch.Tensor:
        """C^-1 x, or C^-T x, of a vector x (P,)."""
        if self._factor is None:
            return vector.clone()
        factor = self._factor.T if transposed else self._factor
        return torch.linalg.solve_triangular(factor, vector[:, None], upper=transposed)[:, 0]

    @override
    def snapshot(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        tensors, metadata = super().snapshot()
        if self._factor is None:
            return tensors, metadata
        return {**tensors, "factor": self._factor, "varied": self._variables.clone()}, metadata

    @override
    def resume(self, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
        super().resume(tensors, metadata)
        factor, self._last = tensors.get("factor"), None
        self._factor = None if factor is None else factor.to(self._variables)
        self._variables.copy_(parameters_to_vector(self._weights).detach() if factor is None else tensors["varied"])


def cross_validated_epochs(
    parts: Sequence[tuple[Corrected, MotionLoss, MotionLoss, torch.Tensor | None]],
    settings: LoopSettings,
    advance: Callable[[], None],
) -> tuple[int, tuple[list[FloatArray], list[FloatArray]]]:
    """Returns the number of epochs with the smallest mean error on held-out motions, by cross-validation.

    Args:
        parts: a model to train, the losses on the motions to train on and on the held-out ones, and the factor of
            `InTheLoop`, for each fold.
        settings: of every training; epochs is the largest number tried, and patience the number of epochs without an
            improvement after which the search ends.
        advance: called after every epoch of every fold.

    Returns:
        The number of epochs, 0 where training never improves on its start, and the mean distances (T,) by frame of all
        held-out motions [mm], at the start and after that number.
    """
    settings = settings.changed(rollout_every=1)
    trainers = [InTheLoop(model, train, held_out, settings, None, factor) for model, train, held_out, factor in parts]
    for trainer in trainers:
        trainer.begin()
    while True:
        means = np.mean([[record["rollout_error_mm"] for record in t.history] for t in trainers], axis=0)
        best = int(np.argmin(means))
        if trainers[0].finished or len(means) - 1 - best >= settings.patience:
            judged = [held_out.judged[-len(means) :] for _, _, held_out, _ in parts]
            before, after = ([row for of_part in judged for row in of_part[epoch]] for epoch in (0, best))
            return best, (before, after)
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
