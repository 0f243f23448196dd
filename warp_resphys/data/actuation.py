"""Inputs that drive a body, such as pressures: smooth random sequences, waves, and a check of recorded ones."""

from pathlib import Path

import numpy as np

from ..io.arrays import FloatArray
from ..io.errors import DataFileError, InputError
from ..settings.trials import SequenceSettings, WaveSettings
from ..stepping.quantity import Quantity

_JITTER = 1e-9  # of the variance, on the diagonal of a smooth covariance
NO_INPUT = 0.01  # of the limit: zero error of a gauge, below which an input counts as none
_SLACK = 1.005  # factor by which a measured input may exceed the limit


def draw_inputs(
    sequences: SequenceSettings, limit: float, steps: int, time_step: float, parts: int, random: np.random.Generator
) -> FloatArray:
    """Draws inputs (K + 1, C) of C parts at the times 0, h, ..., K h [s] from a clipped Gaussian process.

    The input of a part is normally distributed, correlated in time by ``exp(-(t - t')^2 / (2 correlation_time^2))`` and
    with the other parts by the correlation, less than one between every two parts, or a (C, C) matrix. It is
    conditioned on zero value and slope at the start and the end, where the body rests (Rasmussen and Williams 2006,
    section 2.2); then it is clipped to the range from zero to the limit.

    Raises:
        InputError: there is no time between the rests, or the correlations are not those of a distribution.
    """
    at, rest, scale = time_step * np.arange(steps + 1), sequences.rest, sequences.correlation_time
    inside = (at >= rest - 1e-9) & (at <= at[-1] - rest + 1e-9)
    if inside.sum() < 3:
        raise InputError(f"{at[-1]:g} s leave no time between two rests of {rest:g} s: simulate longer, or rest less.")
    times = time_step * np.arange(inside.sum(), dtype=np.float64)
    ends = np.array([times[0], times[0], times[-1], times[-1]])
    ends += 0.05 * scale * np.array([-1.0, 0.0, 0.0, 1.0])  # zero at two times close to each end leaves no slope

    def covariance(first: FloatArray, second: FloatArray) -> FloatArray:
        return np.asarray(np.exp(-0.5 * ((first[:, None] - second[None]) / scale) ** 2))

    across, fixed = covariance(times, ends), covariance(ends, ends) + _JITTER * np.eye(4)
    bridge = 1.0 - across @ np.linalg.solve(fixed, np.ones(4))  # conditional mean of a mean of one
    values, vectors = np.linalg.eigh(covariance(times, times) - across @ np.linalg.solve(fixed, across.T))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    matrix: FloatArray = np.asarray(sequences.correlation, dtype=np.float64)
    if matrix.ndim == 0:
        matrix = np.eye(parts) + (1.0 - np.eye(parts)) * matrix
    if matrix.shape != (parts, parts):
        raise InputError(
            f"correlation is {np.asarray(sequences.correlation).tolist()}: give one number, or a matrix of {parts} "
            f"rows and {parts} columns, one for each part that is driven."
        )
    try:
        between = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise InputError(
            f"no inputs of {parts} parts have the correlation {sequences.correlation}: it must lie above "
            f"{-1.0 / max(parts - 1, 1):.3g} and below 1, or be a positive definite matrix."
        ) from None
    normal = root @ random.standard_normal((inside.sum(), parts))
    drawn = np.zeros((steps + 1, parts))
    drawn[inside] = sequences.mean * bridge[:, None] + sequences.deviation * normal @ between.T
    drawn[np.flatnonzero(inside)[[0, -1]]] = 0.0  # exact, without rounding
    return np.clip(drawn, 0.0, limit)


def wave_inputs(waves: WaveSettings, limit: float, steps: int, time_step: float) -> FloatArray:
    """Returns periodic inputs (K + 1, C), such as a gait, at the times 0, h, ..., K h [s].

    The input of a part with the phase p is ``mean + amplitude sin(2 pi f (t - start) + p)`` from the start on, clipped
    to the range from zero to the limit, times a factor that grows from zero to one over the ramp, with zero slope at
    both ends.
    """
    since = time_step * np.arange(steps + 1)[:, None] - waves.start
    turns = 2.0 * np.pi * waves.frequency * since + np.asarray(waves.phases, dtype=np.float64)
    grown = np.clip(since / waves.ramp, 0.0, 1.0) if waves.ramp else (since >= 0.0).astype(np.float64)
    rise = grown**2 * (3.0 - 2.0 * grown)
    return np.asarray(rise * np.clip(waves.mean + waves.amplitude * np.sin(turns), 0.0, limit))


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
