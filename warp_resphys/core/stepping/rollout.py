"""The roll-out of everything that moves step by step.

A stepper is a function (state, inputs of a step) -> next state: the ``step`` of a simulator, a
corrected simulator, a robot, a scene, a reduced model or a world. All that a step depends on is in
the state and the inputs, so that a roll-out is differentiable, and continues from any of its
states. Where a step depends on its number, its inputs are that number.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import accumulate
from typing import TypeVar

import torch

S = TypeVar("S")  # a state
I = TypeVar("I")  # noqa: E741  # inputs of a step
O = TypeVar("O")  # noqa: E741  # what is observed in a state

Stepper = Callable[[S, I], S]


def states(step: Stepper[S, I], state: S, inputs: Iterable[I]) -> Iterator[S]:
    """Yields the initial state and the state after every step, as they are needed.

    Args:
        step: the stepper.
        state: initial state.
        inputs: inputs of the T steps, in turn.
    """
    return accumulate(inputs, step, initial=state)


def rollout(
    step: Stepper[S, I], state: S, inputs: Iterable[I], observe: Callable[[S], O]
) -> list[O]:
    """Simulates T steps and returns T + 1 observations:
    of the initial state, and of the state after every step.

    Args:
        step: the stepper.
        state: initial state.
        inputs: inputs of the T steps, in turn, such as `Inputs.by_step`, or ``range(T)`` for their
            numbers.
        observe: what is kept of a state.
    """
    return [observe(now) for now in states(step, state, inputs)]


def on_steps(times: torch.Tensor, step: float) -> bool:
    """Returns whether all times (...,) are whole numbers of steps [s]."""
    position = times.detach() / step
    return bool(((position - position.round()).abs() < 1e-6).all())


def sample(series: torch.Tensor, times: torch.Tensor, step: float) -> torch.Tensor:
    """(B, T, ...) values at the given times, by cubic Hermite interpolation
    with central differences as slopes.

    Args:
        series: (B, K + 1, ...) values at the times 0, h, ..., K h, with K at least 2 if a time is
            between them.
        times: (B, T) [s], from zero; beyond the end the last value stays.
        step: h [s].
    """
    last = series.shape[1] - 1
    position = (times / step).clamp(0.0, float(last))
    batch = torch.arange(len(series), device=series.device)[:, None]
    if not times.requires_grad and on_steps(times, step):
        return series[batch, position.round().long()]
    slopes = torch.gradient(series, dim=1, edge_order=2)[0]
    index = position.floor().long().clamp(max=last - 1)
    s = (position - index).reshape(*times.shape, *[1] * (series.ndim - 2))
    a = series[batch, index]
    b = series[batch, index + 1]
    da = slopes[batch, index]
    db = slopes[batch, index + 1]
    return (
        (1.0 + 2.0 * s) * (1.0 - s) ** 2 * a
        + s * (1.0 - s) ** 2 * da
        + s**2 * (3.0 - 2.0 * s) * b
        + s**2 * (s - 1.0) * db
    )
