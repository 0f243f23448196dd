"""Roll-out errors of the experiments, and the published numbers to compare them with."""

import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile
from typing import Final, NamedTuple, NotRequired, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, stdtrit

from ..io.errors import InputError

# Of the bootstrap: samples, and probability outside of its interval at either end.
_DRAWS, _TAIL = 10_000, 0.05


class PublishedError(NamedTuple):
    """A published roll-out error [mm]: mean and standard deviation
    over the authors' test trajectories.
    """

    mean: float
    std: float


class ErrorSummary(TypedDict):
    """One model's roll-out error [mm] on one split, ready for `metrics.json`.

    `mean` and `std` are None when a roll-out diverged: a mean over the survivors would flatter the
    model.
    """

    mean: float | None
    std: float | None
    trajectories: int
    diverged: int


class TrialErrors(TypedDict):
    """Errors of the models in a test trial."""

    name: str
    errors_mm: dict[str, float | None]  # mean by model; None where the roll-out diverged
    amplitude_mm: NotRequired[float]  # root mean square displacement of the observed points


class Gain(NamedTuple):
    """Relative reduction of the mean error by one model compared
    with another, on the same trials.
    """

    share: float  # of the other model's error; negative for an increase
    lower: float  # lower end of the 90 % interval over resampled trials
    upper: float  # upper end
    trials: int


def paired_gain(before: Sequence[float], after: Sequence[float]) -> Gain:
    """Returns the gain of a model and its interval from a paired bootstrap over trials.

    Percentiles are expanded for small samples as with Student's t (Hesterberg, The American
    Statistician 69 (2015) 371): with two or three trials, the interval reaches from the worst to
    the best.

    Args:
        before: error of each trial with the other model, positive.
        after: error of each trial with this model, in the same unit.
    """
    pairs = np.array([before, after], dtype=np.float64)
    drawn, tail = _resampled(pairs)
    lower, upper = np.quantile(1.0 - drawn[1] / drawn[0], [tail, 1.0 - tail])
    means = pairs.mean(axis=1)
    return Gain(float(1.0 - means[1] / means[0]), float(lower), float(upper), pairs.shape[1])


def mean_interval(errors: Sequence[float]) -> tuple[float, float]:
    """Returns the 90 % interval of a model's mean error
    over resampled trials, see `paired_gain`.
    """
    drawn, tail = _resampled(np.array([errors], dtype=np.float64))
    lower, upper = np.quantile(drawn[0], [tail, 1.0 - tail])
    return float(lower), float(upper)


def _resampled(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Means (P, draws) of resampled columns of (P, R),
    and the probability outside of an interval at either end.
    """
    count = values.shape[1]
    rows = np.random.default_rng(0).integers(count, size=(_DRAWS, count))
    tail = (
        float(ndtr(math.sqrt(count / (count - 1)) * stdtrit(count - 1, _TAIL)))
        if count > 1
        else 0.5
    )
    return values[:, rows].mean(axis=2), tail


# J. Gao, M. Y. Michelis, A. Spielberg, R. K. Katzschmann, "Sim-to-Real of Soft Robots with Learned
# Residual Physics", IEEE Robotics and Automation Letters, 2024: the tables of sim-to-sim results
# (beam_oscillation, beam_twist), the sim-to-real results (beam_real, sopra) and the extrapolation
# to 10 s after training on 5 s.
PUBLISHED_MM: Final[Mapping[str, Mapping[str, PublishedError]]] = {
    "beam_oscillation": {
        "simulation": PublishedError(4.488, 1.468),
        "simfree": PublishedError(0.035, 0.070),
        "resphys": PublishedError(0.004, 0.010),
    },
    "beam_twist": {
        "simulation": PublishedError(4.362, 1.541),
        "simfree": PublishedError(0.038, 0.147),
        "resphys": PublishedError(0.004, 0.011),
    },
    "beam_real": {
        "simulation": PublishedError(5.46, 1.78),
        "sysid": PublishedError(1.32, 1.38),
        "simfree": PublishedError(0.63, 0.49),
        "resphys": PublishedError(0.52, 0.48),
    },
    "sopra": {
        "simulation": PublishedError(7.50, 3.69),
        "sysid": PublishedError(7.31, 3.54),
        "simfree": PublishedError(8.35, 4.03),
        "resphys": PublishedError(5.77, 3.00),
    },
    "sopra_extrapolation": {
        "sysid": PublishedError(7.57, 3.59),
        "simfree": PublishedError(9.89, 5.02),
        "resphys": PublishedError(6.10, 3.22),
    },
}
# Errors of the extrapolation after the trained length and after the whole length [s].
PUBLISHED_WINDOWS_MM: Final[Mapping[str, Mapping[str, Mapping[str, PublishedError]]]] = {
    "sopra_extrapolation": {
        "5": {
            "sysid": PublishedError(7.51, 3.63),
            "simfree": PublishedError(9.54, 5.60),
            "resphys": PublishedError(5.79, 3.09),
        },
        "10": PUBLISHED_MM["sopra_extrapolation"],
    }
}


def mean_distance(
    simulated: NDArray[np.float64], observed: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the mean distance of the seen markers or vertices (the paper's eq. 4 and 7).

    Args:
        simulated: (..., M, 3) [m], not finite where the roll-out diverged.
        observed: (..., M, 3) [m], NaN where a marker was not seen.

    Returns:
        (...) [mm]; NaN where no marker was seen, infinite where a simulated one has diverged.
    """
    seen = np.asarray(np.isfinite(observed).all(-1))
    with np.errstate(invalid="ignore", over="ignore"):
        distance = 1e3 * np.linalg.norm(simulated - observed, axis=-1)
        distance = np.where(seen, np.where(np.isfinite(distance), distance, np.inf), 0.0)
        return np.where(seen.any(-1), distance.sum(-1) / np.maximum(seen.sum(-1), 1), np.nan)


def marker_errors(
    simulated: NDArray[np.float64], observed: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns `mean_distance` [mm] of the frames (T, M, 3) in which a marker was seen, (T',)."""
    errors = mean_distance(simulated, observed)
    return errors[~np.isnan(errors)]


def errors_per_marker(
    simulated: NDArray[np.float64], observed: NDArray[np.float64], labels: Sequence[str]
) -> dict[str, float | None]:
    """Returns the mean over trials of the error of every marker that was seen [mm].

    None where a roll-out diverged.

    Args:
        simulated: (R, T, M, 3) [m], NaN where a roll-out diverged.
        observed: (R, T, M, 3) [m], NaN where a marker was not seen.
        labels: M names.
    """
    means: dict[str, float | None] = {}
    for m, label in enumerate(labels):
        errors = [
            marker_errors(x[:, m : m + 1], y[:, m : m + 1])
            for x, y in zip(simulated, observed, strict=True)
        ]
        of_trials = [of_trial.mean() for of_trial in errors if len(of_trial)]
        if of_trials:
            means[label] = _finite_mean(np.array(of_trials))
    return means


def summarise(errors: Iterable[NDArray[np.float64]]) -> ErrorSummary:
    """Returns the mean error over trajectories of that over steps
    and vertices (E_q of the paper), and its deviation.

    Every trajectory counts alike, whatever its length. The deviation is that of the mean over the
    vertices, over trajectories and steps.

    Args:
        errors: One array (T,) for each trajectory, from `marker_errors` [mm]; T may differ.

    Raises:
        InputError: There is no trajectory, or one has no step.
    """
    rows = [np.asarray(row, dtype=np.float64) for row in errors]
    if not rows or any(row.size == 0 for row in rows):
        raise InputError(
            "no roll-out error to summarise: the test split needs a trajectory of at least one step"
        )
    diverged = sum(not np.isfinite(row).all() for row in rows)
    pooled = np.concatenate(rows)  # (sum of T,) [mm]
    return {
        "mean": None if diverged else float(np.mean([row.mean() for row in rows])),
        "std": None if diverged else float(pooled.std()),
        "trajectories": len(rows),
        "diverged": diverged,
    }


def summarise_trajectories(
    names: Sequence[str], errors: Mapping[str, Iterable[NDArray[np.float64]]]
) -> list[TrialErrors]:
    """Returns `per_trajectory` of `metrics.json`: the mean error of each model on every trajectory.

    Args:
        names: R names of the trajectories.
        errors: For each model R arrays (T,), or one (R, T) [mm].

    Raises:
        InputError: A model has a different number of trajectories than names.
    """
    means = {model: [_finite_mean(row) for row in rows] for model, rows in errors.items()}
    for model, rows in means.items():
        if len(rows) != len(names):
            raise InputError(
                f"{model} has {len(rows)} roll-outs for {len(names)} test trajectories"
            )
    return [
        {"name": name, "errors_mm": {m: rows[i] for m, rows in means.items()}}
        for i, name in enumerate(names)
    ]


def summarise_folds(folds: Sequence[Mapping[str, ErrorSummary]]) -> dict[str, ErrorSummary]:
    """Returns the errors of a cross-validation: mean over trials, deviation of the folds' means.

    The models are those of all folds: a law is used in some folds alone.
    """
    shared = set(folds[0]).intersection(*folds)
    return {
        model: _over_folds([fold[model] for fold in folds]) for model in folds[0] if model in shared
    }


def published_errors(name: str) -> Mapping[str, PublishedError]:
    """Returns the published errors of the experiment with the longest name that starts `name`.

    Empty without one.
    """
    experiments = [experiment for experiment in PUBLISHED_MM if name.startswith(experiment)]
    return PUBLISHED_MM[max(experiments, key=len)] if experiments else {}


def median_filter(values: ArrayLike, time_step: float, window: float = 1.0) -> NDArray[np.float64]:
    """Returns the running median over a centred time window,
    as in the published figures of the arm.

    The window is cut off at both ends of the series. NaN is ignored, unless the whole window is
    NaN.

    Args:
        values: (..., T) at equal steps.
        time_step: Of the series [s].
        window: Length of the window [s].

    Raises:
        InputError: The step or the window is not positive.
    """
    if not (time_step > 0.0 and window > 0.0):
        raise InputError(
            f"a median filter of {window} s at steps of {time_step} s: both must be positive"
        )
    rows = np.asarray(values, dtype=np.float64)
    half = int(0.5 * window / time_step + 1e-9)
    blank = np.full((*rows.shape[:-1], half), np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.concatenate([blank, rows, blank], axis=-1), 2 * half + 1, -1
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # Windows of NaN alone.
        return np.asarray(np.nanmedian(windows, axis=-1))


def _over_folds(summaries: Sequence[ErrorSummary]) -> ErrorSummary:
    means = [summary["mean"] for summary in summaries if summary["mean"] is not None]
    complete = len(means) == len(summaries)
    counts = [summary["trajectories"] for summary in summaries]
    return {
        "mean": float(np.average(means, weights=counts)) if complete else None,
        "std": float(np.std(means)) if complete and len(means) > 1 else None,
        "trajectories": sum(counts),
        "diverged": sum(summary["diverged"] for summary in summaries),
    }


def _finite_mean(values: NDArray[np.float64]) -> float | None:
    mean = float(np.mean(values))
    return mean if math.isfinite(mean) else None


def autocorrelation(series: NDArray[np.float64]) -> list[float]:
    """Returns the autocorrelation of (T, C) values at lags of 1,
    2, ... frames, up to its first zero.
    """
    products = [
        float((series[lag:] * series[: len(series) - lag]).sum()) for lag in range(len(series) // 2)
    ]
    if not products or products[0] <= 0.0:
        return []
    return [value / products[0] for value in takewhile(lambda value: value > 0.0, products[1:])]


def redundancy(series: NDArray[np.float64]) -> float:
    """Returns the number of correlated frames of a series (T, C) with as much information
    as one independent frame.
    """
    return 1.0 + 2.0 * sum(autocorrelation(series))
