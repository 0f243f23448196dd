"""Training on the full batch: an epoch is one iteration of L-BFGS with its line search.

Adam's first steps move every weight by the learning rate, however small the gradient, which spoils a network that is
nearly right. Where the loss comes from the simulator, a line search costs less than tuning a learning-rate schedule.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import torch
from typing_extensions import override

from ..settings.learning import FullBatchSettings
from .networks import ResidualForce
from .training import EpochTrainer

_EVALUATIONS = 12  # of the loss, at most, in one epoch


class FullBatchTrainer(EpochTrainer[ResidualForce]):
    """Minimises a loss over those weights of the network that require a gradient, by L-BFGS.

    `FullBatchSettings.memory` is the number of pairs that L-BFGS keeps.
    """

    settings: FullBatchSettings

    def __init__(
        self,
        model: ResidualForce,
        rollout_error: Callable[[ResidualForce], float],
        settings: FullBatchSettings,
    ) -> None:
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
        super().__init__(model, self._lbfgs, rollout_error, settings)
        self._last: tuple[list[torch.Tensor], list[torch.Tensor], torch.Tensor] | None = None

    @abstractmethod
    def _backward(self) -> float:
        """Returns the loss at the current weights and accumulates its gradient in them."""

    def _iterate(self) -> float:
        """Makes one iteration; returns the loss after it."""
        self._lbfgs.step(self._evaluate)
        return float(self._evaluate())

    def _evaluate(self) -> torch.Tensor:
        """Returns the loss and sets its gradient; cached, as L-BFGS evaluates the weights that it accepts twice."""
        if self._last is None or not all(map(torch.equal, self._weights, self._last[0])):
            self._lbfgs.zero_grad()
            loss = self._backward()
            gradients = [torch.zeros_like(w) if w.grad is None else w.grad for w in self._weights]
            self._last = (
                [w.detach().clone() for w in self._weights],
                gradients,
                torch.tensor(loss, dtype=torch.float64),
            )
        for weight, gradient in zip(self._weights, self._last[1], strict=True):
            weight.grad = gradient.clone()
        return self._last[2]

    @override
    def resume(self, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
        super().resume(tensors, metadata)
        self._last = None
