"""A residual force trained on what markers saw: the loss is what the corrected simulator gets wrong over whole motions.

Few recordings leave most of a residual force open. The force starts from zero, which is the simulator as it is, and
every weight is paid for, so that it departs from there only as far as the motions ask for.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from typing_extensions import override

from ..io.errors import ConvergenceError, InputError
from .full_batch import FullBatchTrainer
from .networks import ResidualForce
from .replay import Release, Replay

_FAILURE = 1e4  # loss of a simulation that fails: the line search comes back from there


class MotionLoss:
    """Mean over motions of the mean squared distance of markers, in units of each motion's amplitude.

    Args:
        replay: of the motions.
        release: how they begin.
        parameters: (1,) physical parameters that were identified.
        loads: (R, A) what acts on the body in each motion.
    """

    def __init__(
        self,
        replay: Replay,
        release: Release,
        parameters: Mapping[str, torch.Tensor],
        loads: torch.Tensor,
    ) -> None:
        self._replay, self._release, self._parameters, self._loads = replay, release, parameters, loads
        self._weight = replay.motions.loss_weight

    def markers(self, model: ResidualForce | None) -> torch.Tensor:
        """(R, T, M, 3) at the frames [m], with the force of the model or without any.

        Raises:
            ConvergenceError: the simulation fails.
        """
        force = None if model is None else (lambda q, v: model(q, v, self._loads).to(q.dtype))
        return self._replay(self._release, self._parameters or None, force=force)[0]

    def __call__(self, model: ResidualForce | None) -> torch.Tensor:
        """The loss, differentiable in the model's weights."""
        errors = self._replay.errors(self.markers(model)[None])[0]
        return (errors.square().sum((1, 2, 3)) * self._weight).sum()

    def error_mm(self, model: ResidualForce | None) -> float:
        """Mean distance of the markers that were seen, motions weighing the same [mm]; infinite where one diverged."""
        try:
            with torch.no_grad():
                errors = self._replay.errors(self.markers(model)[None])[0].norm(dim=-1)
        except ConvergenceError:
            return float("inf")
        return 1e3 * float((errors.sum((1, 2)) / self._replay.motions.seen.sum((1, 2))).mean())


class MarkersInTheLoop(FullBatchTrainer):
    """Minimises a `MotionLoss` and a penalty on the squares of the weights, by L-BFGS from no force at all.

    The last layers have no bias: a constant force would make up for how a trial was held, which the next one does not
    share.

    Args:
        model: whose network's weights are trained; those of its last layers are set to zero, as is the mean force.
        train: loss on the training motions.
        validation: loss on the validation motions, by which the weights are chosen; None: the training motions are.
        config: the group ``in_the_loop``.
        epochs: in place of the configured ones; 0 keeps the simulator as it is.

    Raises:
        InputError: a setting out of range.
    """

    def __init__(
        self,
        model: ResidualForce,
        train: MotionLoss,
        validation: MotionLoss | None,
        config: Mapping[str, Any],
        epochs: int | None = None,
    ) -> None:
        check_in_the_loop(config)
        judge = train if validation is None else validation
        with torch.no_grad():
            _remove_force(model)
        super().__init__(model, judge.error_mm, config if epochs is None else {**config, "epochs": epochs})
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
        return self.config["penalty"] * torch.stack(squares).sum()

    @override
    def _backward(self) -> float:
        try:
            loss = self._train(self.model) + self._penalty()
            loss.backward()
        except ConvergenceError:
            self._optimiser.zero_grad()
            return _FAILURE
        return float(loss.detach())


def epochs_that_hold_up(
    make_model: Callable[[], ResidualForce],
    parts: Sequence[tuple[MotionLoss, MotionLoss]],
    config: Mapping[str, Any],
    advance: Callable[[], None],
) -> int:
    """How many epochs serve motions that training did not see: those with the smallest mean error over the parts.

    Args:
        make_model: an untrained model, the same every time.
        parts: losses of the motions to train on, and of those that are held out.
        config: the group ``in_the_loop``; its epochs are the most that are tried, and its patience is after how many
            without any gain the search ends.
        advance: called after every epoch of every part.

    Returns:
        0 where no training is better than the simulator as it is.
    """
    config = {**config, "rollout_every": 1}
    trainers = [MarkersInTheLoop(make_model(), train, held_out, config) for train, held_out in parts]
    for trainer in trainers:
        trainer.begin()
    while True:
        means = np.mean([[record["rollout_error_mm"] for record in t.state.history] for t in trainers], axis=0)
        best = int(np.argmin(means))
        if trainers[0].finished or len(means) - 1 - best >= config["patience"]:
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


def check_in_the_loop(config: Mapping[str, Any]) -> None:
    """Checks the ranges of the group ``in_the_loop``.

    Raises:
        InputError: a setting out of range.
    """
    for key in ("epochs", "memory", "rollout_every", "patience"):
        if not config[key] > 0:
            raise InputError(f"in_the_loop.{key} is {config[key]}: it must be positive.")
    if not config["penalty"] >= 0.0:
        raise InputError(f"in_the_loop.penalty is {config['penalty']}: it must be zero or more.")
