"""Prediction intervals of roll-outs: how far observed markers will be from the predicted ones.

Posteriors of parameters and ensembles of networks do not contain the physics that a model lacks,
which is most of its error. So intervals are calibrated on the model's errors in trials that it was
not trained on (split conformal prediction: Vovk, Gammerman and Shafer, Algorithmic Learning in a
Random World, 2005; scaled as by Lei et al. 2018). For trials of the same distribution they have the
stated coverage, whatever the model.

The half-width of a marker's coordinates is a quantile times a scale, the deviation of a normal
distribution whose variance has a constant part and parts that grow with the square of the marker's
displacement: one just after a change of the inputs, one soon after it, and one long after it; and,
if it is known, the variance due to the posterior of the parameters, which grows outside of the
training. The sizes of the parts are those of the largest likelihood.

Beyond the largest displacement of the training and calibration, half-widths also grow with the
excess, as the errors of the training trial with the largest displacement did, less what the
half-widths contain, for a simulator whose parameters are identified without it, to first order. As
this is a single trial, the growth is Student's quantile with one degree of freedom times the root
mean square. A learned force or actuator has the growth of the simulator below, as it was trained on
the trial; other models have none.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NotRequired, TypedDict

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from scipy.stats import norm
from scipy.stats import t as student

from ..data.driving import since_change
from ..data.rigid_bodies import as_markers
from ..data.trials import Trials
from ..io.arrays import BoolArray, FloatArray

LEVEL: Final = 0.9
# s after a change of the inputs: between just after, soon after and long after it
TIMES: Final = (0.1, 0.5)
_QUARTERS: Final = 4  # parts of a single trial
_LEVELS: Final = (
    11  # number of quantiles that are tried, from the wanted level to the largest value
)
_LEAST: Final = 1e-3  # of the mean variance: part that is always there
_PENALTY: Final = (
    1e-3  # of the negative log-likelihood, for each part as large as the mean variance
)
_LEAST_EXCESS: Final = (
    3.0  # beyond the training, over the deviation of the errors within: less shows no growth
)
_SMALLEST: Final = -12.0  # logarithm of a part over the mean variance


class PlainIntervals(TypedDict):
    """`Intervals` as JSON data."""

    factor: list[float]
    variance: list[float]
    reach: NotRequired[float]
    growth: NotRequired[float]


class ModelIntervals(TypedDict, total=False):
    """Prediction intervals of a model in errors.json; over folds, without `PlainIntervals`."""

    factor: list[float]
    variance: list[float]
    reach: float
    growth: float
    coverage: float  # share of the coordinates inside their interval
    half_width_mm: float  # mean
    by_trial: dict[str, float]  # coverage
    without_spread: (
        PlainIntervals  # for robots, which do not know the variance due to the parameters
    )


class IntervalTable(TypedDict):
    """Prediction intervals in errors.json."""

    level: float
    calibrated_on: str
    models: dict[str, ModelIntervals]


@dataclass(frozen=True)
class Predicted:
    """A predicted trial, and its observation.

    Attributes:
        simulated: (T, M, 3) [m].
        observed: (T, M, 3) [m], NaN where a marker was not seen.
        since: (T,) since the last change of the inputs [s]; infinite for a pose.
        spread: (T, M) variance due to the posterior of the parameters [m^2]; None if it is not
            known.
    """

    simulated: FloatArray
    observed: FloatArray
    since: FloatArray
    spread: FloatArray | None = None

    @property
    def seen(self) -> BoolArray:
        """(T, M) whether a marker was seen."""
        return np.asarray(np.isfinite(self.observed).all(-1))

    def quarters(self) -> "list[Predicted]":
        """The four quarters of the frames; the whole of fewer frames."""
        count = _QUARTERS if len(self.since) >= _QUARTERS else 1
        spreads = [None] * count if self.spread is None else np.array_split(self.spread, count)
        series = (
            np.array_split(values, count) for values in (self.simulated, self.observed, self.since)
        )
        return [Predicted(*parts) for parts in zip(*series, spreads, strict=True)]

    @property
    def errors(self) -> FloatArray:
        """(T, M, 3) absolute errors [m], NaN where a marker was not seen."""
        with np.errstate(invalid="ignore", over="ignore"):
            return np.asarray(np.abs(self.simulated - self.observed))


@dataclass(frozen=True)
class Intervals:
    """Half-widths of the intervals of M markers.

    Attributes:
        factor: (M,) half-width over the scale.
        variance: constant part of the squared scale [m^2]; its parts over the squared displacement:
            just after, soon after and long after a change of the inputs; and its part over the
            variance due to the parameters.
        reach: largest displacement of training and calibration [m].
        growth: of the half-width per displacement beyond it.
    """

    factor: tuple[float, ...]
    variance: tuple[float, ...]
    reach: float = 0.0
    growth: float = 0.0

    @classmethod
    def calibrated(
        cls, predicted: Mapping[str, Predicted], rest: FloatArray, level: float = LEVEL
    ) -> "Intervals | None":
        """Calibrates intervals on trials that the model was not trained on.

        None if a roll-out diverged.

        The quantile is the lowest for which intervals from all trials but one have the wanted mean
        coverage on the trial left out; the largest deviation if there is no such quantile, or only
        one pose. The quarters of a single motion count as trials. All trials have equal weight.
        Markers that are seen in no trial get the largest quantile of the others, without a
        guarantee.

        Args:
            predicted: trials that the model predicted, by name.
            rest: (M, 3) markers on the undeformed body [m].
            level: wanted coverage, a share of the coordinates.
        """
        trials = [trial for trial in predicted.values() if trial.seen.any()]
        if not trials or not all(
            np.isfinite(trial.simulated[trial.seen]).all() for trial in trials
        ):
            return None
        if len(trials) == 1:
            trials = [quarter for quarter in trials[0].quarters() if quarter.seen.any()]
        parts = [
            _parts(np.linalg.norm(t.simulated - rest, axis=-1), t.since, t.spread) for t in trials
        ]
        errors = [trial.errors for trial in trials]

        def scaled(kept: Sequence[int]) -> tuple[FloatArray, list[FloatArray]]:
            """Sizes of the parts of the variance from some trials,
            and the errors of all over that scale.
            """
            sizes = _variance([parts[k] for k in kept], [errors[k] for k in kept])
            return sizes, [
                error / np.sqrt(part @ sizes)[..., None]
                for part, error in zip(parts, errors, strict=True)
            ]

        every, left_out = [*range(len(trials))], []
        for out in every if len(trials) > 1 else ():
            others = [number for number in every if number != out]
            _, scores = scaled(others)
            left_out.append((scores[out], [scores[k] for k in others]))
        variance, scores = scaled(every)
        factor = _quantiles(scores, _level(left_out, level))
        factor[~np.isfinite(factor)] = factor[np.isfinite(factor)].max()
        return cls(tuple(factor.tolist()), tuple(variance.tolist()))

    def half_widths(
        self,
        simulated: FloatArray,
        rest: FloatArray,
        since: ArrayLike | None = None,
        spread: FloatArray | None = None,
    ) -> FloatArray:
        """Half-widths (..., M) for the coordinates of simulated markers.

        Args:
            simulated: (..., M, 3) [m].
            rest: (M, 3) [m].
            since: (...,) since the last change of the inputs [s]; None for the time at which
                intervals are widest.
            spread: (..., M) variance due to the posterior of the parameters [m^2]; None for none.
        """
        moved, variance = np.linalg.norm(simulated - rest, axis=-1), np.array(self.variance)
        if since is None:
            variance[1:4] = variance[1:4].max()
        times = np.zeros(moved.shape[:-1]) if since is None else np.asarray(since)
        within = np.sqrt(_parts(moved, times, spread) @ variance) * np.array(self.factor)
        return np.asarray(np.hypot(within, self.growth * np.maximum(moved - self.reach, 0.0)))

    def growing(
        self, beyond: Predicted, before: float, reach: float, rest: FloatArray, level: float = LEVEL
    ) -> "Intervals":
        """Returns intervals that grow beyond their reach as the errors of a trial did,
        if its excess is large enough.

        Args:
            beyond: the training trial with the largest displacement, predicted by a model
                identified without it.
            before: largest displacement of that model's training [m].
            reach: largest displacement of training and calibration [m].
            rest: (M, 3) [m].
            level: wanted coverage, a share of the coordinates.
        """
        moved = np.linalg.norm(beyond.simulated - rest, axis=-1)
        excess = np.where(beyond.seen, np.maximum(moved - before, 0.0), 0.0)
        at, total = excess > 0.0, float(np.square(excess).sum())
        widths = replace(self, growth=0.0).half_widths(
            beyond.simulated, rest, beyond.since, beyond.spread
        )
        # Variance of normal errors.
        within = float(np.square(widths[at] / norm.ppf(0.5 + 0.5 * level)).sum())
        errors = max(float(np.square(beyond.errors[at]).mean(-1).sum()) - within, 0.0)
        if total <= _LEAST_EXCESS**2 * within:
            return replace(self, reach=reach)
        return replace(
            self,
            reach=reach,
            growth=math.sqrt(errors / total) * float(student.ppf(0.5 + 0.5 * level, 1)),
        )

    def plain(self) -> PlainIntervals:
        """Returns the intervals as JSON data."""
        return {
            "factor": list(self.factor),
            "variance": list(self.variance),
            "reach": self.reach,
            "growth": self.growth,
        }

    @classmethod
    def from_plain(cls, plain: PlainIntervals | ModelIntervals | None) -> "Intervals | None":
        """Returns the intervals that `plain` wrote; None without any, as in summaries of folds."""
        if not plain or "variance" not in plain:
            return None
        beyond = plain.get("reach", 0.0), plain.get("growth", 0.0)  # earlier versions had none
        return cls(tuple(plain["factor"]), tuple(plain["variance"]), *beyond)

    def covered(self, trial: Predicted, rest: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Measures a trial that was not used for calibration.

        Args:
            trial: predicted by the same model.
            rest: (M, 3) [m].

        Returns:
            (K,) share of the coordinates inside their interval, and (K,) half-widths [m], of the K
            markers and frames that were seen.
        """
        seen, width = trial.seen, self.half_widths(trial.simulated, rest, trial.since, trial.spread)
        with np.errstate(invalid="ignore"):
            inside = (trial.errors <= width[..., None])[seen].mean(-1)
        return inside, width[seen]


def coverage(covered: Mapping[str, tuple[FloatArray, FloatArray]]) -> ModelIntervals:
    """Summarises trials with equal weight, from `Intervals.covered`.

    Those without a seen marker are left out.
    """
    seen = {name: (float(x.mean()), float(w.mean())) for name, (x, w) in covered.items() if len(x)}
    inside, widths = np.mean([*seen.values()], axis=0)
    by_trial = {name: share for name, (share, _) in seen.items()}
    return {"coverage": float(inside), "half_width_mm": 1e3 * float(widths), "by_trial": by_trial}


def _parts(moved: FloatArray, since: FloatArray, spread: FloatArray | None) -> FloatArray:
    """(..., M, 5) parts of a variance.

    Args:
        moved: (..., M) displacements [m].
        since: (...,) since a change of the inputs [s].
        spread: (..., M) due to the parameters [m^2]; None for none.
    """
    just, soon = (np.exp(-since / time)[..., None] for time in TIMES)
    squares, known = moved**2, np.zeros_like(moved) if spread is None else spread
    return np.stack(
        [
            np.ones_like(moved),
            just * squares,
            (soon - just) * squares,
            (1.0 - soon) * squares,
            known,
        ],
        -1,
    )


def _variance(parts: Sequence[FloatArray], errors: Sequence[FloatArray]) -> FloatArray:
    """(5,) sizes of the parts of the variance, those of the largest likelihood of normal errors.

    The part due to the parameters counts at least once.

    Args:
        parts: (T, M, 5) of each trial.
        errors: (T, M, 3) of each trial [m], NaN where a marker was not seen.
    """
    seen = [np.isfinite(error).all(-1) for error in errors]
    rows = np.concatenate([part[visible] for part, visible in zip(parts, seen, strict=True)])
    squares = np.concatenate(
        [np.square(e[visible]).mean(-1) for e, visible in zip(errors, seen, strict=True)]
    )
    weights = np.concatenate(
        [np.full(count, 1.0 / (count * len(seen))) for count in map(np.count_nonzero, seen)]
    )
    mean, sizes = max(float(weights @ squares), np.finfo(float).tiny), weights @ rows
    used = np.flatnonzero(sizes > 0.0)
    columns = rows[:, used] / sizes[used]
    relative = squares / mean
    least = rows[:, -1] / mean + _LEAST

    def loss(logarithms: FloatArray) -> tuple[float, FloatArray]:
        variances = np.exp(logarithms)
        variance = columns @ variances + least
        slope = weights * (1.0 / variance - relative / variance**2)
        value = weights @ (np.log(variance) + relative / variance) + _PENALTY * variances.sum()
        return float(value), (slope @ columns + _PENALTY) * variances

    starts = (np.full(len(used), value) for value in (-np.log(len(used)), -3.0))
    bounds = [(_SMALLEST, 3.0)] * len(used)
    ends = [minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts]
    result = np.zeros(len(sizes))
    result[used] = mean * np.exp(min(ends, key=lambda end: float(end.fun)).x) / sizes[used]
    result[[0, -1]] += _LEAST * mean, 1.0
    return result


def _level(left_out: Sequence[tuple[FloatArray, Sequence[FloatArray]]], level: float) -> float:
    """The lowest level of quantiles that cover trials left out as wanted; one if there is none.

    Args:
        left_out: scaled errors (T, M, 3) of each trial, and those of all others with the same
            scale.
        level: wanted mean coverage.
    """

    def covered(quantile: float, out: FloatArray, others: Sequence[FloatArray]) -> float:
        return float((out <= _quantiles(others, quantile)[:, None])[np.isfinite(out)].mean())

    for quantile in np.linspace(level, 1.0, _LEVELS) if left_out else ():
        if np.mean([covered(float(quantile), *trial) for trial in left_out]) >= level:
            return float(quantile)
    return 1.0


def _quantiles(scores: Sequence[FloatArray], level: float) -> FloatArray:
    """(M,) quantiles of the finite values (T, M, 3), all trials with equal weight.

    Infinite where there are none.
    """
    quantiles = np.full(scores[0].shape[1], np.inf)
    for m in range(len(quantiles)):
        of_trials = [score[:, m].ravel() for score in scores]
        used = [trial[np.isfinite(trial)] for trial in of_trials]
        used = [trial for trial in used if len(trial)]
        if used:
            weights = np.concatenate(
                [np.full(len(trial), 1.0 / (len(trial) * len(used))) for trial in used]
            )
            values = np.concatenate(used)
            order = np.argsort(values)
            reached = int(np.searchsorted(np.cumsum(weights[order]), level - 1e-9))
            quantiles[m] = values[order[min(reached, len(values) - 1)]]
    return quantiles


def intervals_of_each_other(
    trials: Trials,
    names: Sequence[str],
    simulated: Sequence[FloatArray],
    spreads: Sequence[FloatArray] | None,
) -> ModelIntervals | None:
    """Coverage of intervals of which each trial's are calibrated on the others.

    None if some cannot be calibrated.

    Args:
        trials: with those of the names.
        names: names of R trials.
        simulated: (T, M, 3) of each trial, by models that have not learned from it [m].
        spreads: (T, M) variances due to the parameters [m^2]; None if they are not known.
    """
    predicted = predicted_trials(
        trials, names, simulated, trials.observed[trials.rows(names)], spreads
    )
    covered, rest = dict[str, tuple[FloatArray, FloatArray]](), rest_places(trials)
    for out, trial in predicted.items():
        intervals = Intervals.calibrated(
            {name: other for name, other in predicted.items() if name != out}, rest
        )
        if intervals is None:
            return None
        covered[out] = intervals.covered(trial, rest)
    return coverage(covered)


def half_widths_of(
    trials: Trials,
    names: Sequence[str],
    intervals: Mapping[str, ModelIntervals],
    simulated: Mapping[str, FloatArray],
    spreads: Mapping[str, FloatArray],
) -> dict[str, FloatArray]:
    """Half-widths (R, T, M) of the intervals of markers and rigid bodies [m],
    by model that has intervals.

    Args:
        trials: with those of the names.
        names: names of R trials.
        intervals: by model, as in errors.json.
        simulated: (R, T, M, 3) [m] by model.
        spreads: (R, T, M) variances due to the parameters [m^2], by model.
    """
    known = {model: Intervals.from_plain(plain) for model, plain in intervals.items()}
    since = since_change(trials, names)
    return {
        model: of_model.half_widths(
            as_markers(simulated[model], trials.labels),
            rest_places(trials),
            since,
            spreads.get(model),
        )
        for model, of_model in known.items()
        if of_model is not None and model in simulated
    }


def rest_places(trials: Trials) -> FloatArray:
    """(M, 3) markers on the undeformed body [m]; a rigid body is one."""
    assert trials.bound is not None
    return as_markers(trials.bound, trials.labels)


def predicted_trials(
    trials: Trials,
    names: Sequence[str],
    simulated: Sequence[FloatArray] | FloatArray,
    observed: FloatArray,
    spreads: Sequence[FloatArray] | FloatArray | None = None,
) -> dict[str, Predicted]:
    """Trials as they were predicted and observed; rigid bodies count as one marker."""
    known = [None] * len(names) if spreads is None else spreads
    rows = zip(names, simulated, observed, since_change(trials, names), known, strict=True)
    return {
        name: Predicted(as_markers(x, trials.labels), as_markers(y, trials.labels), since, spread)
        for name, x, y, since, spread in rows
    }
