"""Sag, period and decay of a decaying oscillation.

One estimator serves measured and simulated signals: a damped cosine fitted by least squares from the first
turning point on. It averages over every sample of several periods, so neither the frame rate nor the noise
limits the period, as they do where single extremes or zero crossings are compared; the turning points only
start the fit.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ..io.errors import InputError

FloatArray = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Oscillation:
    """Parameters of a decaying oscillation x(t) = c + b t + exp(-d t) (p cos w t + r sin w t)."""

    sag: float  # Mean of the settled end of the signal [m], signed as the signal is
    tail_spread: float  # Standard deviation of that end [m]: small where the signal has settled
    period: float  # 2 pi / w [s]
    decay_rate: float  # d, of the envelope exp(-d t) [1/s]
    damping_ratio: float  # d / sqrt(d^2 + w^2)
    fit_residual: float  # Root mean square residual of the fit [m]


def measure_oscillation(
    displacement: FloatArray, rate: float, *, window: float = 1.4, tail: float = 1.0
) -> Oscillation:
    """Measures sag, period and decay.

    The fit spans `window` from the first turning point, so that the release itself has no influence. Its
    linear term models the creep of a viscoelastic body. For a given decay and frequency the other four
    coefficients are linear (variable projection), which leaves a fit of two unknowns.

    Args:
        displacement: (T,) [m], from the release on.
        rate: Samples a second [Hz].
        window: Length of the fit [s]; shorter if the signal is.
        tail: Length of the end whose mean is the sag [s].

    Raises:
        InputError: The signal is not finite, too short, or does not oscillate.
    """
    signal = np.asarray(displacement, dtype=np.float64)
    if signal.ndim != 1 or not np.isfinite(signal).all():
        raise InputError("An oscillation is measured on one finite displacement over time.")
    settled = round(tail * rate)
    if settled < 1 or len(signal) <= settled:
        raise InputError(
            f"The signal lasts {len(signal) / rate:.2f} s, which leaves nothing but the {tail:g} s that give "
            "its sag: give a longer one, or a shorter tail."
        )
    turns = turning_points(signal)
    stop = min(len(signal), turns[0] + round(window * rate) + 1) if len(turns) else 0
    turns = turns[turns < stop]
    if len(turns) < 4:
        raise InputError(
            f"The signal turns {len(turns)} times within {window:g} s, and a period needs 4: it swings "
            "too little or too slowly to be compared."
        )
    decay_rate, frequency, residual = _fit_damped_cosine(signal, turns, stop, rate)
    return Oscillation(
        sag=float(signal[-settled:].mean()),
        tail_spread=float(signal[-settled:].std()),
        period=2.0 * np.pi / frequency,
        decay_rate=decay_rate,
        damping_ratio=decay_rate / float(np.hypot(decay_rate, frequency)),
        fit_residual=residual,
    )


def turning_points(signal: FloatArray, threshold: float = 0.05) -> NDArray[np.int64]:
    """Sorted indices of the extremes of (T,) with a prominence above a share of its range, unlike noise."""
    from scipy.signal import find_peaks

    prominence = threshold * np.ptp(signal)
    if prominence == 0.0:
        return np.empty(0, dtype=np.int64)
    upper, _ = find_peaks(signal, prominence=prominence)
    lower, _ = find_peaks(-signal, prominence=prominence)
    return np.sort(np.concatenate([upper, lower])).astype(np.int64)


def _fit_damped_cosine(
    signal: FloatArray, turns: NDArray[np.int64], stop: int, rate: float
) -> tuple[float, float, float]:
    """Decay rate [1/s], angular frequency [rad/s] and residual [m] of the fit to signal[turns[0]:stop]."""
    values = signal[turns[0] : stop]
    time = np.arange(len(values)) / rate  # (T,) [s]
    swings = np.abs(np.diff(signal[turns]))
    middles = 0.5 * (turns[1:] + turns[:-1]) / rate
    start = np.array([-np.polyfit(middles, np.log(swings), 1)[0], np.pi * rate / np.mean(np.diff(turns))])

    def residual(parameters: FloatArray) -> FloatArray:
        envelope = np.exp(-parameters[0] * time)
        phase = parameters[1] * time
        columns = [np.ones_like(time), time, envelope * np.cos(phase), envelope * np.sin(phase)]
        basis = np.stack(columns, axis=1)
        coefficients = np.linalg.lstsq(basis, values, rcond=None)[0]
        remaining: FloatArray = (basis @ coefficients - values) / np.ptp(values)
        return remaining

    fit = least_squares(residual, start, x_scale=np.array([0.1 * start[1], start[1]]), xtol=1e-12, ftol=1e-12)
    scale = float(np.ptp(values))
    return float(fit.x[0]), float(fit.x[1]), scale * float(np.sqrt(np.mean(np.square(residual(fit.x)))))
