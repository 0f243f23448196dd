"""Training of a residual force through the simulator:
the loss is the error of the corrected simulator over motions.

Its gradient goes back through the implicit adjoint of every step (Um et al. 2020,
"Solver-in-the-Loop").

An epoch is one iteration of L-BFGS with its line search. Adam's first steps move every weight by
the learning rate, however small the gradient, which spoils a network that is nearly right; and
where the loss comes from the simulator, a line search costs less than tuning a schedule of rates.

Few recordings determine only part of a residual force. So the force starts from zero, which is the
uncorrected simulator, and a penalty on the weights keeps it there as far as the motions allow.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, TypeVar

import numpy as np
import torch
from typing_extensions import override

from ...core.dynamics.frames import BaseFrame, VertexFrames
from ...data.input_network import Actuator
from ...io.arrays import FloatArray
from ...io.errors import ConvergenceError
from ...settings.learning import InTheLoopSettings, LoopSettings
from ..replay import Replay, Sensed
from ..start import Start
from .correction import LearnedPredictor
from .networks import OwnNetwork, ResidualForce
from .training import EpochTrainer

_EVALUATIONS = 12  # of the loss, at most, in one epoch
_FAILURE = 1e4  # loss of a failed simulation, from which the line search steps back
Corrects = ResidualForce | Actuator
Corrected = TypeVar("Corrected", bound=Corrects)


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

    Readings of force sensors count as `TrialBatch.load_errors`.

    Args:
        groups: of trials.
        parameters: (1,) identified physical parameters.

    Attributes:
        weights: (R,) of the squared errors of each group's trials.
        judged: for each call of `error_mm`, the mean distances (T,) by frame of each trial [mm],
            NaN where it diverged.
    """

    def __init__(
        self, groups: Sequence[TrialGroup], parameters: Mapping[str, torch.Tensor]
    ) -> None:
        self._groups = groups
        self._parameters = parameters
        self.judged = list[list[FloatArray]]()
        counts = [len(group.replay.trials.names) for group in groups]
        shares = [count / sum(counts) for count in counts]
        self.weights = [
            g.replay.trials.loss_weight * share for g, share in zip(groups, shares, strict=True)
        ]

    def _errors(self, model: Corrects | None) -> list[Sensed]:
        """Errors (R, T, M, 3) of markers and (R, T, S, 6) of readings of each group [m].

        None: those of the simulator.

        Raises:
            ConvergenceError: the simulation fails.
        """
        errors = []
        for group in self._groups:
            force: Any = None
            replay = (
                group.replay.changed(actuator=model.inputs)
                if isinstance(model, Actuator)
                else group.replay
            )
            if isinstance(model, ResidualForce):
                force = LearnedPredictor(model, group.context, None, group.frames, group.base)
            points, loads = replay.sensed(group.start, self._parameters or None, force=force)
            errors.append((replay.errors(points)[0], replay.trials.load_errors(loads)[0]))
        return errors

    def __call__(self, model: Corrects | None) -> torch.Tensor:
        """Returns the loss, differentiable in the model's weights."""
        pairs = zip(self._errors(model), self.weights, strict=True)
        squares = [
            ((of_points.square().sum((1, 2, 3)) + of_loads.square().sum((1, 2, 3))) * weight).sum()
            for (of_points, of_loads), weight in pairs
        ]
        return torch.stack(squares).sum()

    def error_mm(self, model: Corrects | None) -> float:
        """Mean distance of the seen markers, all trials with equal weight [mm].

        Infinite where a trial diverged.

        The distances by frame are kept in `judged`.
        """
        seen = [group.replay.trials.seen for group in self._groups]
        try:
            with torch.no_grad():
                distances = [errors.norm(dim=-1) for errors, _ in self._errors(model)]
        except ConvergenceError:
            self.judged.append([np.full(1, np.nan) for _ in range(sum(map(len, seen)))])
            return float("inf")
        pairs = [*zip(distances, seen, strict=True)]
        rows = zip(chain.from_iterable(distances), chain.from_iterable(seen), strict=True)
        frames = [(row.sum(1) / s.sum(1))[s.any(1)] for row, s in rows]
        self.judged.append([1e3 * row.double().cpu().numpy() for row in frames])
        return 1e3 * float(torch.cat([d.sum((1, 2)) / s.sum((1, 2)) for d, s in pairs]).mean())

    def amplitudes_mm(self) -> list[float]:
        """Amplitudes of the trials [mm]."""
        sizes = (group.replay.trials.amplitude.tolist() for group in self._groups)
        return [1e3 * size for size in chain.from_iterable(sizes)]


class JudgedTrainer(EpochTrainer[Corrected]):
    """Training whose start is the first candidate of the weights that are kept.

    Args:
        model: to train.
        optimiser: of the network's weights, if one is used.
        train: loss on the training motions.
        judge: loss whose error selects the weights.
        settings: epochs and patience.
        epochs: in place of the configured number; 0 keeps the start.

    Attributes:
        penalty: on the squared weights, which is added to the loss.
    """

    settings: LoopSettings
    penalty = 0.0

    def __init__(
        self,
        model: Corrected,
        optimiser: torch.optim.Optimizer | None,
        train: MotionLoss,
        judge: MotionLoss,
        settings: LoopSettings,
        epochs: int | None = None,
    ) -> None:
        last = settings.epochs if epochs is None else epochs
        super().__init__(
            model, optimiser, judge.error_mm, settings.model_copy(update={"epochs": last})
        )
        self.train, self.judge = train, judge

    def begin(self) -> None:
        """Records the start as the first candidate, unless training has begun."""
        if not self.history:
            error = self.rollout_error(self.model)
            with torch.no_grad():
                loss = float(self.loss())
            self._keep({"epoch": float(self.epoch), "train_loss": loss, "rollout_error_mm": error})

    def loss(self) -> torch.Tensor:
        """Loss of the training motions and penalty."""
        squares = [w.square().sum() for w in self.model.network.parameters()]
        return self.train(self.model) + self.penalty * torch.stack(squares).sum()


class InTheLoop(JudgedTrainer[ResidualForce]):
    """Minimises a `MotionLoss` of a force, and a penalty on the squares of its weights, by L-BFGS.

    The force begins at zero, and its last layers have no bias: a constant force would compensate
    how one trial was held, which does not generalise.

    Args:
        model: to train; its last layers and mean force are set to zero.
        train: loss on the training motions.
        judge: loss whose error selects the weights, those of the start among them.
        settings: epochs and the penalty on the weights.
        epochs: in place of the configured number; 0 keeps the start.
    """

    def __init__(
        self,
        model: ResidualForce,
        train: MotionLoss,
        judge: MotionLoss,
        settings: InTheLoopSettings,
        epochs: int | None = None,
    ) -> None:
        with torch.no_grad():
            _remove_force(model)
        self._weights = [w for w in model.network.parameters() if w.requires_grad]
        self._lbfgs = torch.optim.LBFGS(
            self._weights,
            max_iter=1,
            max_eval=_EVALUATIONS,
            history_size=settings.memory,
            line_search_fn="strong_wolfe",
            tolerance_grad=0.0,
            tolerance_change=0.0,
        )
        super().__init__(model, self._lbfgs, train, judge, settings, epochs)
        self.penalty = settings.penalty
        self._last: tuple[list[torch.Tensor], list[torch.Tensor], torch.Tensor] | None = None

    @override
    def _run_epoch(self) -> dict[str, float]:
        """Makes one iteration."""
        self.begin()
        self._lbfgs.step(self._evaluate)
        return {"train_loss": float(self._evaluate())}

    def _evaluate(self) -> torch.Tensor:
        """Returns the loss and sets its gradient.

        Cached, as L-BFGS evaluates the weights that it accepts twice.
        """
        if self._last is None or not all(map(torch.equal, self._weights, self._last[0])):
            self.model.zero_grad()
            try:
                loss = self.loss()
                loss.backward()
            except ConvergenceError:
                self.model.zero_grad()
                loss = torch.tensor(_FAILURE, dtype=torch.float64)
            gradients = [torch.zeros_like(w) if w.grad is None else w.grad for w in self._weights]
            self._last = (
                [w.detach().clone() for w in self._weights],
                [g.clone() for g in gradients],
                loss.detach(),
            )
        for weight, gradient in zip(self._weights, self._last[1], strict=True):
            weight.grad = gradient.clone()
        return self._last[2]

    @override
    def resume(self, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
        super().resume(tensors, metadata)
        self._last = None


def cross_validated_epochs(
    trainers: Sequence[JudgedTrainer[Any]], advance: Callable[[], None]
) -> tuple[int, tuple[list[FloatArray], list[FloatArray]]]:
    """Returns the number of epochs with the smallest mean error
    on held-out motions, by cross-validation.

    Args:
        trainers: one for each fold, whose `judge` is the loss on the held-out motions, with an
            error after each epoch. They end after `patience` epochs without an improvement,
            together.
        advance: called after every epoch of every fold.

    Returns:
        The number of epochs, 0 where training never improves on its start, and the mean distances
        (T,) by frame of all held-out motions [mm], at the start and after that number.
    """
    for trainer in trainers:
        trainer.begin()
    while True:
        means = np.mean(
            [[record["rollout_error_mm"] for record in t.history] for t in trainers], axis=0
        )
        best = int(np.argmin(means))
        if (
            all(trainer.finished for trainer in trainers)
            or len(means) - 1 - best >= trainers[0].settings.patience
        ):
            judged = [trainer.judge.judged[-len(means) :] for trainer in trainers]
            before = chain.from_iterable(of_part[0] for of_part in judged)
            after = chain.from_iterable(of_part[best] for of_part in judged)
            return best, ([*before], [*after])
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
