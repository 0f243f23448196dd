"""Adam with the fused step of torch, without the rest of `torch.optim`.

The classes of `torch.optim` import torch's compiler, which takes a second of every run. Both give the same weights
(tests/learning/test_adam.py), if every weight has a gradient.

    m <- b1 m + (1 - b1) g,   v <- b2 v + (1 - b2) g^2,   w <- w - lr (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

Kingma and Ba, Adam: a method for stochastic optimization, ICLR 2015, algorithm 1.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch

_BETAS, _EPSILON = (0.9, 0.999), 1e-8


class Adam:
    """Moves weights along their gradients.

    Args:
        weights: of one network, on one device; those that require no gradient stay as they are.
        weight_decay: factor of the weights that is added to their gradients.
    """

    def __init__(self, weights: Iterable[torch.Tensor], weight_decay: float) -> None:
        self.weights, self._decay = [weight for weight in weights if weight.requires_grad], weight_decay
        self._first, self._second = ([torch.zeros_like(weight) for weight in self.weights] for _ in range(2))
        self._step = torch.zeros((), device=self.weights[0].device)

    @torch.no_grad()
    def step(self, gradients: Sequence[torch.Tensor], learning_rate: float) -> None:
        """Makes a step, in place.

        Args:
            gradients: of the `weights`.
            learning_rate: lr.
        """
        self._step += 1
        torch._fused_adam_(
            self.weights,
            list(gradients),
            self._first,
            self._second,
            [],
            [self._step] * len(self.weights),
            lr=learning_rate,
            beta1=_BETAS[0],
            beta2=_BETAS[1],
            weight_decay=self._decay,
            eps=_EPSILON,
            amsgrad=False,
            maximize=False,
        )

    def state_dict(self) -> dict[str, Any]:
        """Returns moments and number of steps of all weights, in the format of torch's optimisers."""
        moments = enumerate(zip(self._first, self._second, strict=True))
        return {"state": {i: {"step": self._step, "exp_avg": m, "exp_avg_sq": v} for i, (m, v) in moments}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state_dict`; an empty one changes nothing."""
        for i, slot in state["state"].items():
            self._step.copy_(slot["step"])
            self._first[i].copy_(slot["exp_avg"])
            self._second[i].copy_(slot["exp_avg_sq"])
