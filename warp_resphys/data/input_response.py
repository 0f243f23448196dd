"""The input that acts on a body, from what was commanded: a factor, a delay, a first-order lag, and exponential means.

Each call continues from a memory, so that a series at once and step by step give the same. NumPy arrays and torch
tensors are taken alike; tensors are differentiable.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

Array = Any  # of NumPy or torch
Memory = Mapping[str, Array]
Number = torch.Tensor | float | None

_FASTEST = 1e-2  # of a step: shorter time constants are taken as this one


class InputResponse:
    """How an input follows its commands, exact where these are constant during steps.

    A step in which a delayed command gives way to the next has the mean of both over its time. The means are the
    internal variables of Maxwell elements that the input drives: how far a viscoelastic body creeps depends on how long
    an input has lasted, which its state shows badly.

    Args:
        time_step: h [s].
        factor: on the commands; a number, or (1 or B,) for commands (T, B, C). None leaves out the effect; likewise:
        delay: zero or more [s]; differentiable but at whole numbers of steps.
        rise: time constant of the lag [s].
        filters: F time constants of the exponential means [s].
    """

    def __init__(
        self,
        time_step: float,
        factor: Number = None,
        delay: Number = None,
        rise: Number = None,
        filters: Sequence[float] = (),
    ) -> None:
        self.filters, self._factor = tuple(filters), factor
        self._late = None if delay is None else delay / time_step
        self._length = 0 if self._late is None else int(_whole(self._late).max()) + 1
        self._kept_lag = None if rise is None else _share_kept(rise, time_step)
        self._kept_means = [_share_kept(each, time_step) for each in self.filters]

    def still(self, commands: Array) -> dict[str, Array]:
        """The memory after commands (..., C) that have lasted for long; its entries are (..., C) or (L, ..., C)."""
        given, like = self.scaled(commands), _library(commands)
        memory = {} if self._late is None else {"queue": like.broadcast_to(given, (self._length, *given.shape))}
        memory |= {} if self._kept_lag is None else {"behind": given}
        means = {"means": like.broadcast_to(given, (len(self.filters), *given.shape))} if self.filters else {}
        return memory | means

    def __call__(self, memory: Memory, commands: Array) -> tuple[Array, Array, dict[str, Array]]:
        """The input during T steps.

        Args:
            memory: before them, from `still` or an earlier call.
            commands: (T, ..., C) during the steps.

        Returns:
            (T, ..., C) the input, (F, T, ..., C) its means at the ends of the steps, and the memory after them.
        """
        acting, later, like = self.scaled(commands), dict[str, Array](), _library(commands)
        if self._late is not None:
            queue = like.concatenate([memory["queue"], acting])
            acting, later["queue"] = self._delayed(queue, len(acting)), queue[len(acting) :]
        if self._kept_lag is not None:
            acting = _lagged(memory["behind"], acting, self._kept_lag)
            later["behind"] = acting[-1]
        if not self.filters:
            return acting, acting[None][:0], later
        means = like.stack([_lagged(x, acting, k) for x, k in zip(memory["means"], self._kept_means, strict=True)])
        return acting, means, later | {"means": means[:, -1]}

    def from_rest(self, commands: Array) -> tuple[Array, Array]:
        """(T, ..., C) the input and (F, T, ..., C) its means under commands (T, ..., C), with none before these."""
        return self(self.still(0.0 * commands[0]), commands)[:2]

    def scaled(self, commands: Array) -> Array:
        """(..., C) commands times the factor: the input where they have always been given."""
        return commands if self._factor is None else commands * _column(self._factor)

    def _delayed(self, queue: Array, count: int) -> Array:
        """(T, ..., C) delayed commands, of (L + T, ..., C)."""
        late, first = self._late, self._length
        if not isinstance(late, torch.Tensor):
            assert late is not None
            share, first = late - int(late), first - int(late)
            return (1.0 - share) * queue[first : first + count] + share * queue[first - 1 : first - 1 + count]
        rows = torch.arange(queue.shape[1], device=queue.device)
        now = first + torch.arange(count, device=queue.device)[:, None] - _whole(late) + 0 * rows
        share = _column(late - _whole(late))
        return (1.0 - share) * queue[now, rows] + share * queue[now - 1, rows]


def response_of(name: str, parameters: Mapping[str, torch.Tensor]) -> tuple[Number, Number, Number]:
    """Factor, delay and rise of an input, as they are named among identified parameters; None where one is not."""
    factor, delay, rise = (parameters.get(f"{name}_{word}") for word in ("factor", "delay", "rise"))
    return factor, delay, rise


def with_means(acting: Array, means: Array) -> Array:
    """(..., C (1 + F)) inputs (..., C), then their means (F, ..., C), as networks take them."""
    return _library(acting).concatenate([acting, *means], -1)


def _lagged(behind: Array, series: Array, kept: Array) -> Array:
    """(T, ..., C) a series that follows another one (T, ..., C) from (..., C) on, keeping a share of its distance."""
    found = []
    for now in series:
        behind = now + kept * (behind - now)
        found.append(behind)
    return _library(series).stack(found)


def _share_kept(time: torch.Tensor | float, step: float) -> Array:
    """Share of the distance from its goal that a lag of a time constant [s] keeps in a step; (B, 1) of (B,)."""
    if isinstance(time, torch.Tensor):
        return _column(torch.exp(-step / time.clamp_min(_FASTEST * step)))
    return math.exp(-step / max(time, _FASTEST * step))


def _column(values: torch.Tensor | float) -> Array:
    return values[:, None] if isinstance(values, torch.Tensor) else values


def _whole(steps: torch.Tensor | float) -> Array:
    """The whole numbers of steps."""
    return steps.detach().floor().clamp_min(0.0).long() if isinstance(steps, torch.Tensor) else np.array(int(steps))


def _library(values: Array) -> Any:
    return torch if isinstance(values, torch.Tensor) else np
