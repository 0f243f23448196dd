"""Inputs that drive a body, such as pressures: smooth random sequences, waves, and a check of recorded ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..io.errors import DataFileError, InputError
from ..stepping.quantity import Quantity

FloatArray = NDArray[np.float64]

_JITTER = 1e-9  # of the variance, on the diagonal of a smooth covariance
NO_INPUT = 0.01  # of the limit: zero error of a gauge, below which an input counts as none
_SLACK = 1.005  # factor by which a measured input may exceed the limit


@dataclass(frozen=True)
class InputSequences:
    """A distribution of inputs over time, such as pressures: a Gaussian process, clipped to the range of the body.

    The input of a part is normally distributed, correlated in time by ``exp(-(t - t')^2 / (2 correlation_time^2))`` and
    with the other parts by `correlation`. It is conditioned on zero value and slope at the start and the end, where the
    body rests (Rasmussen and Williams 2006, section 2.2); then it is clipped to the range from zero to the limit.
    """

    mean: float = 8e3  # [Pa], or the unit of the input
    deviation: float = 9e3  # in the unit of the input
    correlation_time: float = 0.4  # [s]; the longer, the smoother
    correlation: float | Sequence[Sequence[float]] = 0.0  # between every two parts, less than 1; or a (C, C) matrix
    limit: float = 20e3  # in the unit of the input
    rest: float = 0.1  # without input before the start and after the end [s]

    def draw(self, steps: int, time_step: float, parts: int, random: np.random.Generator) -> FloatArray:
        """Draws a sequence (K + 1, C) for C parts at the times 0, h, ..., K h [s].

        Raises:
            InputError: there is no time between the rests, or the correlations are not those of a distribution.
        """
        times = time_step * np.arange(steps + 1)
        inside = (times >= self.rest - 1e-9) & (times <= times[-1] - self.rest + 1e-9)
        if inside.sum() < 3:
            raise InputError(
                f"{times[-1]:g} s leave no time between two rests of {self.rest:g} s: simulate longer, or rest less."
            )
        bridge, root = self._conditioned(inside.sum(), time_step)
        normal = root @ random.standard_normal((inside.sum(), parts))
        drawn = np.zeros((steps + 1, parts))
        drawn[inside] = self.mean * bridge[:, None] + self.deviation * normal @ self._between(parts).T
        drawn[np.flatnonzero(inside)[[0, -1]]] = 0.0  # exact, without rounding
        return np.clip(drawn, 0.0, self.limit)

    def _covariance(self, first: FloatArray, second: FloatArray) -> FloatArray:
        scaled = (first[:, None] - second[None]) / self.correlation_time
        return np.asarray(np.exp(-0.5 * scaled**2))

    def _conditioned(self, count: int, step: float) -> tuple[FloatArray, FloatArray]:
        """Conditional mean (count,) of a mean of one, and factor L (count, count) of the covariance L L^T over time."""
        times = step * np.arange(count, dtype=np.float64)
        close = 0.05 * self.correlation_time  # zero at two times close to each end leaves no slope
        ends = np.array([times[0] - close, times[0], times[-1], times[-1] + close])
        across, fixed = self._covariance(times, ends), self._covariance(ends, ends) + _JITTER * np.eye(4)
        bridge = 1.0 - across @ np.linalg.solve(fixed, np.ones(4))
        covariance = self._covariance(times, times) - across @ np.linalg.solve(fixed, across.T)
        values, vectors = np.linalg.eigh(covariance)
        return bridge, vectors * np.sqrt(np.maximum(values, 0.0))

    def _between(self, parts: int) -> FloatArray:
        """Cholesky factor (C, C) of the correlations between parts."""
        matrix: FloatArray = np.asarray(self.correlation, dtype=np.float64)
        if matrix.ndim == 0:
            matrix = np.eye(parts) + (1.0 - np.eye(parts)) * matrix
        if matrix.shape != (parts, parts):
            raise InputError(
                f"correlation is {np.asarray(self.correlation).tolist()}: give one number, or a matrix of "
                f"{parts} rows and {parts} columns, one for each part that is driven."
            )
        try:
            return np.asarray(np.linalg.cholesky(matrix))
        except np.linalg.LinAlgError:
            raise InputError(
                f"no inputs of {parts} parts have the correlation {self.correlation}: it must lie above "
                f"{-1.0 / max(parts - 1, 1):.3g} and below 1, or be a positive definite matrix."
            ) from None


@dataclass(frozen=True)
class InputWaves:
    """Periodic inputs, such as a gait: sinusoids of one frequency f, clipped to the range from zero to the limit.

    The input of a part with the phase p is ``mean + amplitude sin(2 pi f (t - start) + p)`` from the start on, times a
    factor that grows from zero to one over the ramp, with zero slope at both ends.
    """

    frequency: float  # f [Hz]
    phases: Sequence[float]  # of each part [rad]
    mean: float  # in the unit of the input
    amplitude: float  # in the unit of the input
    limit: float  # in the unit of the input
    start: float = 0.0  # [s]
    ramp: float = 0.0  # [s]

    def series(self, steps: int, time_step: float) -> FloatArray:
        """Returns the inputs (K + 1, C) of C parts at the times 0, h, ..., K h [s]."""
        since = time_step * np.arange(steps + 1)[:, None] - self.start
        turns = 2.0 * np.pi * self.frequency * since + np.asarray(self.phases, dtype=np.float64)
        grown = np.clip(since / self.ramp, 0.0, 1.0) if self.ramp else (since >= 0.0).astype(np.float64)
        rise = grown**2 * (3.0 - 2.0 * grown)
        return np.asarray(rise * np.clip(self.mean + self.amplitude * np.sin(turns), 0.0, self.limit))


def check_inputs(values: FloatArray, quantity: Quantity, parts: int, limit: float, source: str | Path) -> FloatArray:
    """Checks recorded inputs (T, C) against a body with this number of parts, and returns them.

    Values below the quantity's range by no more than the error of a gauge are clipped to it.

    Raises:
        DataFileError: a different number of parts, or a value above the limit or below the quantity's range.
    """
    words, per = quantity.words, quantity.per
    if values.shape[1] != parts:
        raise DataFileError(
            f"{source} has {quantity.plural} of {values.shape[1]} {per}s, but the body has {parts}: take the body of "
            f"that robot, or set data.parts to the body's {per} of each column of the file."
        )
    frame, part = np.unravel_index(np.abs(values).argmax(), values.shape)
    highest = float(values[frame, part])
    if abs(highest) > _SLACK * limit:
        raise DataFileError(
            f"{source}: the {words} of {per} {part + 1} is {quantity.shown(highest)} in frame {frame}, beyond "
            f"data.input_limit of {quantity.shown(limit)}: raise the limit if the robot takes that, or check the unit "
            "of the file."
        )
    low = np.unravel_index(values.argmin(), values.shape)
    if values[low] < quantity.lower - NO_INPUT * limit:
        raise DataFileError(
            f"{source}: the {words} of {per} {low[1] + 1} is {quantity.shown(float(values[low]))} in frame {low[0]}: "
            f"it must be {quantity.valid_range}, so check the zero of the gauge."
        )
    return np.maximum(values, quantity.lower)
