"""Inputs of a body: drawn and checked, and their response to commands.

The response has backlash, zero, dead band, factor, curve, delay, lag, slew rate, a learned change
and means.

Every call continues from a memory, so that a series gives the same result at once and step by step.
Both NumPy arrays and torch tensors are accepted; tensors are differentiable.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from ..core.stepping.quantity import Quantity
from ..io.arrays import FloatArray
from ..io.errors import DataFileError, InputError
from ..settings.performed import WaveSettings
from ..settings.played import SequenceSettings
from .input_network import InputNetwork

Array = Any  # of NumPy or torch
Memory = Mapping[str, Array]
Number = torch.Tensor | FloatArray | float | None

# Of the characteristic curve, in octaves of the typical command.
SLOPES = tuple(f"slope_{k}" for k in range(1, 9))
# Of an input to its commands.
RESPONSES = ("factor", "delay", "rise", "slew", "dead_band", "zero", "backlash", *SLOPES)
UNITS = ("factor", *SLOPES)  # that are one where they have no effect; the others are zero
# Of the typical command, where the second slope begins; the next knots are each twice as large.
_FIRST_KNOT = 0.25
_ROUNDED = 0.1  # of a knot: width over which the slope changes
_LEAST_SLEW = 1e-12  # s/unit
_FASTEST = 1e-2  # of a step: shortest time constant; shorter ones count as this one
_JITTER = 1e-9  # of the variance, on the diagonal of a smooth covariance
NO_INPUT = 0.01  # of the limit: zero error of a gauge, below which an input counts as none
_SLACK = 1.005  # factor by which a measured input may exceed the limit


def draw_inputs(
    sequences: SequenceSettings,
    limit: float,
    steps: int,
    time_step: float,
    parts: int,
    random: np.random.Generator,
) -> FloatArray:
    """Draws inputs (K + 1, C) of C parts at the times 0, h,
    ..., K h [s] from a clipped Gaussian process.

    The input of a part is normally distributed, correlated in time by ``exp(-(t - t')^2 / (2
    correlation_time^2))`` and with the other parts by the correlation, less than one between every
    two parts, or a (C, C) matrix. It is conditioned on zero value and slope at the start and the
    end, where the body rests (Rasmussen and Williams 2006, section 2.2); then it is clipped to the
    range from zero to the limit.

    Raises:
        InputError: there is no time between the rests, or the correlations are not those of a
            distribution.
    """
    at = time_step * np.arange(steps + 1)
    rest, scale = sequences.rest, sequences.correlation_time
    inside = (at >= rest - 1e-9) & (at <= at[-1] - rest + 1e-9)
    if inside.sum() < 3:
        raise InputError(
            f"{at[-1]:g} s leave no time between two rests of {rest:g} s: "
            "simulate longer, or rest less."
        )
    times = time_step * np.arange(inside.sum(), dtype=np.float64)
    ends = np.array([times[0], times[0], times[-1], times[-1]])
    # Zero at two times close to each end leaves no slope.
    ends += 0.05 * scale * np.array([-1.0, 0.0, 0.0, 1.0])

    def covariance(first: FloatArray, second: FloatArray) -> FloatArray:
        return np.asarray(np.exp(-0.5 * ((first[:, None] - second[None]) / scale) ** 2))

    across, fixed = covariance(times, ends), covariance(ends, ends) + _JITTER * np.eye(4)
    bridge = 1.0 - across @ np.linalg.solve(fixed, np.ones(4))  # conditional mean of a mean of one
    values, vectors = np.linalg.eigh(
        covariance(times, times) - across @ np.linalg.solve(fixed, across.T)
    )
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    matrix: FloatArray = np.asarray(sequences.correlation, dtype=np.float64)
    if matrix.ndim == 0:
        matrix = np.eye(parts) + (1.0 - np.eye(parts)) * matrix
    if matrix.shape != (parts, parts):
        raise InputError(
            f"correlation is {np.asarray(sequences.correlation).tolist()}: give one number, or a "
            f"matrix of {parts} rows and {parts} columns, one for each part that is driven."
        )
    try:
        between = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise InputError(
            f"no inputs of {parts} parts have the correlation {sequences.correlation}: it must "
            f"lie above {-1.0 / max(parts - 1, 1):.3g} and below 1, "
            "or be a positive definite matrix."
        ) from None
    normal = root @ random.standard_normal((inside.sum(), parts))
    drawn = np.zeros((steps + 1, parts))
    drawn[inside] = sequences.mean * bridge[:, None] + sequences.deviation * normal @ between.T
    drawn[np.flatnonzero(inside)[[0, -1]]] = 0.0  # exact, without rounding
    return np.clip(drawn, 0.0, limit)


def wave_inputs(waves: WaveSettings, limit: float, steps: int, time_step: float) -> FloatArray:
    """Returns periodic inputs (K + 1, C), such as a gait, at the times 0, h, ..., K h [s].

    The input of a part with the phase p is ``mean + amplitude sin(2 pi f (t - start) + p)`` from
    the start on, clipped to the range from zero to the limit, times a factor that grows from zero
    to one over the ramp, with zero slope at both ends.
    """
    since = time_step * np.arange(steps + 1)[:, None] - waves.start
    turns = 2.0 * np.pi * waves.frequency * since + np.asarray(waves.phases, dtype=np.float64)
    grown = (
        np.clip(since / waves.ramp, 0.0, 1.0) if waves.ramp else (since >= 0.0).astype(np.float64)
    )
    rise = grown**2 * (3.0 - 2.0 * grown)
    return np.asarray(rise * np.clip(waves.mean + waves.amplitude * np.sin(turns), 0.0, limit))


def check_inputs(
    values: FloatArray, quantity: Quantity, limit: float, source: str | Path
) -> FloatArray:
    """Checks recorded inputs (T, C), and returns them.

    Values below the quantity's range by no more than the error of a gauge are clipped to it.

    Raises:
        DataFileError: a value above the limit or below the quantity's range.
    """
    words, per = quantity.words, quantity.per
    frame, part = np.unravel_index(np.abs(values).argmax(), values.shape)
    highest = float(values[frame, part])
    if abs(highest) > _SLACK * limit:
        raise DataFileError(
            f"{source}: the {words} of {per} {part + 1} is {quantity.shown(highest)} in frame "
            f"{frame}, beyond data.input_limit of {quantity.shown(limit)}: raise the limit if "
            "the robot takes that, or check the unit of the file."
        )
    low = np.unravel_index(values.argmin(), values.shape)
    if values[low] < quantity.lower - NO_INPUT * limit:
        raise DataFileError(
            f"{source}: the {words} of {per} {low[1] + 1} is "
            f"{quantity.shown(float(values[low]))} in frame {low[0]}: it must be "
            f"{quantity.valid_range}, so check the zero of the gauge."
        )
    return np.maximum(values, quantity.lower)


class InputResponse:
    """Response of an input to its commands, exact for commands that are constant during steps.

    In a step in which the delayed command changes, the input is its mean over the step. The
    exponential means are the internal variables of Maxwell elements driven by the input: the creep
    of a viscoelastic body depends on the duration of an input, which the state does not contain.

    Parameters are numbers, (1 or B,) for commands (T, B, C), or (1 or B, C) and (C,) where parts
    differ.

    Args:
        time_step: h [s].
        factor: on the commands; None for no factor.
        delay: zero or more [s], not differentiable at whole numbers of steps; None for no delay.
        rise: time constant of the lag [s]; None for no lag.
        typical: typical command, which the octaves of the characteristic curve follow.
        filters: F time constants of the exponential means [s].
        network: changes the input further; None for no change.
        nonlinear: by name; None, or left out, for no effect. ``slew`` is the reciprocal of the slew
            rate [s/unit], the largest change of the input in a second, as of a valve whose flow is
            choked; zero for no limit. ``dead_band`` is the largest command without an effect, as of
            a tendon that hangs slack; larger ones act less by it. Zero or more. ``zero`` is the
            command at which nothing acts, as of a gauge or a winch that was not zeroed.
            ``backlash`` is the fall of the commands after which they act again when they turn back,
            as of gears that are loaded in one direction; at rest, commands have risen to their
            values. Zero or more. ``lower`` is the least input; with a zero, lower ones count as
            this one. Slopes of the characteristic curve have the names in `SLOPES`; those left out
            are one. `_curved` describes it.
    """

    def __init__(
        self,
        time_step: float,
        factor: Number = None,
        delay: Number = None,
        rise: Number = None,
        typical: float = 1.0,
        filters: Sequence[float] = (),
        network: InputNetwork | None = None,
        **nonlinear: Number,
    ) -> None:
        self._network, self._kept_felt = network, list[Array]()
        if network is not None:
            self._kept_felt = [_share_kept(time, time_step) for time in network.filters]
        self.filters, self._factor = tuple(filters), factor
        self._dead_band, self._backlash = nonlinear.get("dead_band"), nonlinear.get("backlash")
        self._zero, self._lower = nonlinear.get("zero"), nonlinear.get("lower", -math.inf)
        self._typical = typical
        self._slopes = {name: value for name, value in nonlinear.items() if name in SLOPES}
        slew = nonlinear.get("slew")
        self._late = None if delay is None else delay / time_step
        self._length = 0 if self._late is None else int(_whole(self._late).max()) + 1
        follows = rise is not None or slew is not None
        self._kept_lag = _share_kept(0.0 if rise is None else rise, time_step) if follows else None
        self._reach = None if slew is None else _column(time_step / _at_least(slew, _LEAST_SLEW))
        self._kept_means = [_share_kept(time, time_step) for time in self.filters]

    def steady(self, commands: Array) -> dict[str, Array]:
        """Returns the memory under constant commands (..., C).

        Its entries are (..., C) or (L, ..., C).
        """
        scaled, like = self._scaled(commands), _library(commands)
        memory = {} if self._backlash is None else {"geared": commands}
        memory |= (
            {}
            if self._late is None
            else {"queue": like.broadcast_to(scaled, (self._length, *scaled.shape))}
        )
        memory |= {} if self._kept_lag is None else {"behind": scaled}
        still = self.still(commands) if self.filters else scaled
        for name, values, count in (
            ("felt", scaled, len(self._kept_felt)),
            ("means", still, len(self.filters)),
        ):
            memory |= {name: like.broadcast_to(values, (count, *values.shape))} if count else {}
        return memory

    def __call__(self, memory: Memory, commands: Array) -> tuple[Array, Array, dict[str, Array]]:
        """Returns the input during T steps.

        Args:
            memory: before the steps, from `steady` or an earlier call.
            commands: (T, ..., C) during the steps.

        Returns:
            The input (T, ..., C), its means at the ends of the steps (F, T, ..., C), and the memory
            after the steps.
        """
        later, like = dict[str, Array](), _library(commands)
        if self._backlash is not None:
            commands = _geared(memory["geared"], commands, _column(self._backlash))
            later["geared"] = commands[-1]
        acting = self._scaled(commands)
        if self._late is not None:
            queue = like.concatenate([memory["queue"], acting])
            acting, later["queue"] = self._delayed(queue, len(acting)), queue[len(acting) :]
        if self._kept_lag is not None:
            acting = _lagged(memory["behind"], acting, self._kept_lag, self._reach)
            later["behind"] = acting[-1]
        if self._network is not None:
            felt = (
                _means(memory["felt"], acting, self._kept_felt)
                if self._kept_felt
                else acting[None][:0]
            )
            acting = self._changed(acting, felt)
            later = later | ({"felt": felt[:, -1]} if len(felt) else {})
        if not self.filters:
            return acting, acting[None][:0], later
        means = _means(memory["means"], acting, self._kept_means)
        return acting, means, later | {"means": means[:, -1]}

    def from_rest(self, commands: Array) -> tuple[Array, Array]:
        """Returns the input (T, ..., C) and its means (F, T, ..., C)
        under commands (T, ..., C), from zero input.
        """
        return self(self.steady(0.0 * commands[0]), commands)[:2]

    def still(self, commands: Array) -> Array:
        """Returns the input under constant commands (..., C)."""
        scaled = self._scaled(commands)
        return (
            scaled
            if self._network is None
            else self._changed(scaled, [scaled] * len(self._kept_felt))
        )

    def _changed(self, acting: Array, means: Any) -> Array:
        """Inputs (..., C) with what the network adds for them and their means (F, ..., C),
        from the least input on.
        """
        assert self._network is not None
        changed = acting + self._network.added(with_means(acting, means))
        return _library(changed).where(changed > self._lower, changed, 0.0 * changed + self._lower)

    def _scaled(self, commands: Array) -> Array:
        """Commands (..., C) beyond zero and dead band, with factor, on the curve."""
        if self._zero is not None:
            moved = commands - _column(self._zero)
            commands = _library(commands).where(
                moved > self._lower, moved, 0.0 * moved + self._lower
            )
        if self._dead_band is not None:
            like = _library(commands)
            beyond = abs(commands) - _column(self._dead_band)
            commands = like.sign(commands) * like.where(beyond > 0.0, beyond, 0.0 * beyond)
        scaled = commands if self._factor is None else commands * _column(self._factor)
        return _curved(scaled, self._typical, self._slopes) if self._slopes else scaled

    def _delayed(self, queue: Array, count: int) -> Array:
        """Delayed commands (T, ..., C), from a queue (L + T, ..., C)."""
        late, first = self._late, self._length
        if isinstance(late, float | int):
            share, first = late - int(late), first - int(late)
            return (1.0 - share) * queue[first : first + count] + share * queue[
                first - 1 : first - 1 + count
            ]
        whole = _column(_whole(late))
        share = _column(late) - whole
        now: Any = first + np.arange(count).reshape(-1, *[1] * (queue.ndim - 1))
        if isinstance(queue, torch.Tensor):
            now = torch.as_tensor(now, device=queue.device)
        taken: Any = torch.take_along_dim if isinstance(queue, torch.Tensor) else np.take_along_axis
        now = now - whole
        return (1.0 - share) * taken(queue, now, 0) + share * taken(queue, now - 1, 0)


def response_of(
    quantity: Quantity,
    parameters: Mapping[str, Any],
    parts: Sequence[str],
    actuator: Mapping[str, InputNetwork] = MappingProxyType({}),
) -> dict[str, Any]:
    """Returns the arguments of `InputResponse` for what was identified
    of an input, besides its filters.

    Args:
        quantity: the input.
        parameters: numbers or (B,) by name, such as ``pressure_factor``, or ``pressure_factor_1``
            of the part ``1``.
        parts: names of its parts.
        actuator: learned changes by input.
    """
    known = dict[str, Any]()
    for word in RESPONSES:
        name = f"{quantity.name}_{word}"
        of_parts = [parameters.get(f"{name}_{part}") for part in parts]
        if name in parameters:
            known[word] = parameters[name]
        one = next((value for value in of_parts if value is not None), None)
        if one is not None:
            common = known.get(word, 0.0 * one + (1.0 if word in UNITS else 0.0))
            values = [common if value is None else value for value in of_parts]
            like = _library(one)
            known[word] = like.stack(
                like.broadcast_tensors(*values) if like is torch else values, -1
            )
    known |= {"network": actuator[quantity.name]} if quantity.name in actuator else {}
    return {**known, "lower": quantity.lower, "typical": quantity.typical}


def with_means(acting: Array, means: Array) -> Array:
    """Concatenates inputs (..., C) and their means (F, ..., C) to (..., C (1 + F)),
    as the context of a network.
    """
    return _library(acting).concatenate([acting, *means], -1)


def _curved(commands: Array, typical: float, slopes: Mapping[str, Any]) -> Array:
    """Returns commands (..., C) along a characteristic curve of an actuator.

    The curve is odd and monotone, with slopes that are constant in octaves of the typical command:
    it is the derivative of a convex network of one layer and one input, whose units are rounded
    ramps that begin at the knots. Where all slopes are one, it is the command.

    Args:
        commands: to convert.
        typical: typical command.
        slopes: by the names in `SLOPES`.
    """
    like, sizes = _library(commands), abs(commands)
    result = commands * _column(slopes.get(SLOPES[0], 1.0))
    for number, (before, word) in enumerate(pairwise(SLOPES)):
        if before in slopes or word in slopes:
            knot = typical * _FIRST_KNOT * 2.0**number
            width = _ROUNDED * knot
            ramp = width * (
                like.logaddexp(0.0 * sizes, (sizes - knot) / width)
                - math.log1p(math.exp(-knot / width))
            )
            bend = _column(slopes.get(word, 1.0)) - _column(slopes.get(before, 1.0))
            result = result + like.sign(commands) * ramp * bend
    return result


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


def _means(before: Array, series: Array, kept: Sequence[Array]) -> Array:
    """Exponential means (F, T, ..., C) of a series (T, ..., C) from (F, ..., C) on,
    with F decays in a step.
    """
    return _library(series).stack(
        [_lagged(x, series, k) for x, k in zip(before, kept, strict=True)]
    )


def _geared(output: Array, series: Array, width: Array) -> Array:
    """The play (T, ..., C) of gears whose output rises
    with a series (T, ..., C) and falls by the backlash later.
    """
    geared, like = list[Array](), _library(series)
    for now in series:
        output = like.where(
            output < now, now, like.where(output > now + width, now + width, output)
        )
        geared.append(output)
    return like.stack(geared)


def _share_kept(time: Array, step: float) -> Array:
    """Decay exp(-step / time) of a lag in a step; (B, 1) for time constants (B,) [s]."""
    if isinstance(time, float | int):
        return math.exp(-step / max(time, _FASTEST * step))
    return _column(_library(time).exp(-step / _at_least(time, _FASTEST * step)))


def _at_least(value: Array, least: float) -> Array:
    return value.clamp_min(least) if isinstance(value, torch.Tensor) else np.maximum(value, least)


def _column(values: Array) -> Array:
    """Returns numbers, (C,) or (B, C) unchanged, and tensors (B,) as (B, 1)."""
    return values[:, None] if isinstance(values, torch.Tensor) and values.ndim == 1 else values


def _whole(steps: Array) -> Array:
    """Rounds down to whole numbers of steps."""
    whole = _at_least(steps.detach() if isinstance(steps, torch.Tensor) else steps, 0.0)
    return whole.long() if isinstance(whole, torch.Tensor) else np.asarray(whole).astype(int)


def _library(values: Array) -> Any:
    return torch if isinstance(values, torch.Tensor) else np
