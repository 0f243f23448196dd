"""Base of the functions with a hand-written adjoint,
which have first derivatives in reverse mode and no others.

Torch's ``once_differentiable`` is not enough: it gives zero second derivatives where the incoming
gradient is constant.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch.autograd import forward_ad
from typing_extensions import override

from ...io.errors import DerivativeError

Backward = Callable[..., Any]

_FORWARD = (
    "forward-mode derivatives of a simulation are not available: use backward or "
    "torch.autograd.grad."
)


def refuse_transforms(*values: Any) -> None:
    """Raises DerivativeError within ``torch.func``, for batched gradients,
    and for values with a forward derivative.
    """
    tensors = [value for value in values if isinstance(value, torch.Tensor)]
    if forward_ad._current_level >= 0 and any(
        forward_ad.unpack_dual(x).tangent is not None for x in tensors
    ):
        raise DerivativeError(_FORWARD)
    batched = torch._C._functorch.is_legacy_batchedtensor
    if torch._C._are_functorch_transforms_active() or any(map(batched, tensors)):
        raise DerivativeError(
            "torch.func and batched gradients (vmap, jacrev, jvp, is_grads_batched, vectorize) "
            "do not work through a simulation: use backward, torch.autograd.grad or "
            "torch.autograd.functional.jacobian; environments are the first axis of a state."
        )


class AdjointFunction(torch.autograd.Function):
    """A function whose `backward` is decorated by `first_derivatives`."""

    @override
    @classmethod
    def apply(cls, *arguments: Any, **named: Any) -> Any:
        """Applies the function, or raises DerivativeError (`refuse_transforms`)."""
        refuse_transforms()
        return super().apply(*arguments, **named)

    @override
    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        """Raises DerivativeError."""
        raise DerivativeError(_FORWARD)


def first_derivatives(backward: Backward) -> Backward:
    """Decorates a backward pass without derivatives:
    its results raise DerivativeError when they are differentiated.

    The function must save its inputs or its outputs, from which the results would depend on the
    inputs.
    """

    @wraps(backward)
    def once(ctx: Any, *gradients: torch.Tensor) -> Any:
        refuse_transforms(*gradients)
        with torch.no_grad():
            slopes = backward(ctx, *gradients)
        if not torch.is_grad_enabled():
            return slopes
        slopes = slopes if isinstance(slopes, tuple) else (slopes,)
        return _Ended.apply(len(slopes), *slopes, *gradients, *ctx.saved_tensors)

    return once


class _Ended(torch.autograd.Function):
    """The first of some values, as constants whose derivatives by all of them are refused."""

    @override
    @staticmethod
    def forward(
        ctx: Any, count: int, *values: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, ...]:
        return values[:count]

    @override
    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> Any:
        raise DerivativeError(
            "second derivatives of a simulation are not available: torch cannot differentiate "
            "its gradient; take differences of gradients instead of hessian or create_graph=True."
        )
