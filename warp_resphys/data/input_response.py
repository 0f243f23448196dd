"""Response of an input to its commands: a factor, a delay, a first-order lag, a slew rate, and exponential means.

Every call continues from a memory, so that a series gives the same result at once and step by step. Both NumPy arrays
and torch tensors are accepted; tensors are differentiable.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

Array = Any  # of NumPy or torch
Memory = Mapping[str, Array]
Number = torch.Tensor | float | None

RESPONSES = ("factor", "delay", "rise", "slew")  # of an input to its commands, in the order in which they act
_LEAST_SLEW = 1e-12  # s/unit
_FASTEST = 1e-2  # of a step: shortest time constant; shorter ones count as this one


class InputResponse:
    """Response of an input to its commands, exact for commands that are constant during steps.

    In a step in which the delayed command changes, the input is its mean over the step. The exponential means are the
    internal variables of Maxwell elements driven by the input: the creep of a viscoelastic body depends on the duration
    of an input, which the state does not contain.

    Args:
        time_step: h [s].
        factor: on the commands; a number, or (1 or B,) for commands (T, B, C); None for no factor.
        delay: zero or more [s], not differentiable at whole numbers of steps; None for no delay.
        rise: time constant of the lag [s]; None for no lag.
        slew: reciprocal of the slew rate [s/unit], the largest change of the input in a second, as of a valve whose
            flow is choked; a number, or (1 or B,). None or zero for no limit.
        filters: F time constants of the exponential means [s].
    """

    def __init__(
        self,
        time_step: float,
        factor: Number = None,
        delay: Number = None,
        rise: Number = None,
        slew: Number = None,
        filters: Sequence[float] = (),
    ) -> None:
        self.filters, self._factor = tuple(filters), factor
        self._late = None if delay is None else delay / time_step
        self._length = 0 if self._late is None else int(_whole(self._late).max()) + 1
        follows = rise is not None or slew is not None
        self._kept_lag = _share_kept(0.0 if rise is None else rise, time_step) if follows else None
        self._reach = None if slew is None else _column(time_step / _at_least(slew, _LEAST_SLEW))
        self._kept_means = [_share_kept(time, time_step) for time in self.filters]

    def steady(self, commands: Array) -> dict[str, Array]:
        """Returns the memory under constant commands (..., C); its entries are (..., C) or (L, ..., C)."""
        scaled, like = self.scaled(commands), _library(commands)
        memory = {} if self._late is None else {"queue": like.broadcast_to(scaled, (self._length, *scaled.shape))}
        memory |= {} if self._kept_lag is None else {"behind": scaled}
        means = {"means": like.broadcast_to(scaled, (len(self.filters), *scaled.shape))} if self.filters else {}
        return memory | means

    def __call__(self, memory: Memory, commands: Array) -> tuple[Array, Array, dict[str, Array]]:
        """Returns the input during T steps.

        Args:
            memory: before the steps, from `steady` or an earlier call.
            commands: (T, ..., C) during the steps.

        Returns:
            The input (T, ..., C), its means at the ends of the steps (F, T, ..., C), and the memory after the steps.
        """
        acting, later, like = self.scaled(commands), dict[str, Array](), _library(commands)
        if self._late is not None:
            queue = like.concatenate([memory["queue"], acting])
            acting, later["queue"] = self._delayed(queue, len(acting)), queue[len(acting) :]
        if self._kept_lag is not None:
            acting = _lagged(memory["behind"], acting, self._kept_lag, self._reach)
            later["behind"] = acting[-1]
        if not self.filters:
            return acting, acting[None][:0], later
        means = like.stack([_lagged(x, acting, k) for x, k in zip(memory["means"], self._kept_means, strict=True)])
        return acting, means, later | {"means": means[:, -1]}

    def from_rest(self, commands: Array) -> tuple[Array, Array]:
        """Returns the input (T, ..., C) and its means (F, T, ..., C) under commands (T, ..., C), from zero input."""
        return self(self.steady(0.0 * commands[0]), commands)[:2]

    def scaled(self, commands: Array) -> Array:
        """Returns commands (..., C) times the factor: the input under constant commands."""
        return commands if self._factor is None else commands * _column(self._factor)

    def _delayed(self, queue: Array, count: int) -> Array:
        """Delayed commands (T, ..., C), from a queue (L + T, ..., C)."""
        late, first = self._late, self._length
        if not isinstance(late, torch.Tensor):
            assert late is not None
            share, first = late - int(late), first - int(late)
            return (1.0 - share) * queue[first : first + count] + share * queue[first - 1 : first - 1 + count]
        rows = torch.arange(queue.shape[1], device=queue.device)
        now = first + torch.arange(count, device=queue.device)[:, None] - _whole(late) + 0 * rows
        share = _column(late - _whole(late))
        return (1.0 - share) * queue[now, rows] + share * queue[now - 1, rows]


def response_of(name: str, parameters: Mapping[str, torch.Tensor]) -> tuple[Number, Number, Number, Number]:
    """Returns the identified factor, delay, rise and slew of an input; None for those that were not identified."""
    factor, delay, rise, slew = (parameters.get(f"{name}_{word}") for word in RESPONSES)
    return factor, delay, rise, slew


def with_means(acting: Array, means: Array) -> Array:
    """Concatenates inputs (..., C) and their means (F, ..., C) to (..., C (1 + F)), as the context of a network."""
    return _library(acting).concatenate([acting, *means], -1)


def _lagged(behind: Array, series: Array, kept: Array, reach: Array = None) -> Array:
    """First-order lag (T, ..., C) of a series (T, ..., C), from (..., C) on.

    Args:
        behind: value before the series.
        series: to follow.
        kept: decay in a step.
        reach: largest change in a step; None for no limit.
    """
    lagged = []
    for now in series:
        change = (1.0 - kept) * (now - behind)
        if reach is not None:
            change = _library(series).clip(change, -reach, reach)
        behind = behind + change
        lagged.append(behind)
    return _library(series).stack(lagged)


def _share_kept(time: torch.Tensor | float, step: float) -> Array:
    """Decay exp(-step / time) of a lag in a step; (B, 1) for time constants (B,) [s]."""
    if isinstance(time, torch.Tensor):
        return _column(torch.exp(-step / time.clamp_min(_FASTEST * step)))
    return math.exp(-step / max(time, _FASTEST * step))


def _at_least(value: torch.Tensor | float, least: float) -> Any:
    return value.clamp_min(least) if isinstance(value, torch.Tensor) else max(value, least)


def _column(values: torch.Tensor | float) -> Array:
    return values[:, None] if isinstance(values, torch.Tensor) else values


def _whole(steps: torch.Tensor | float) -> Array:
    """Rounds down to whole numbers of steps."""
    return steps.detach().floor().clamp_min(0.0).long() if isinstance(steps, torch.Tensor) else np.array(int(steps))


def _library(values: Array) -> Any:
    return torch if isinstance(values, torch.Tensor) else np
