"""Interpolation and ridge regression of trials without physics,
whose form is chosen by leaving trials out.

They learn either each frame by itself, of which whole trials are the points, with their inputs,
loads and displacements before time zero; or all frames of motions alike, from exponential means of
the inputs until then.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Final

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.distance import cdist

from ..io.arrays import BoolArray, FloatArray
from .plain_trials import PlainTrials, Prediction, degrees, driving_terms

Kernel = Callable[[FloatArray, FloatArray], FloatArray]
# Mean error of a trial that is left out, and the model.
Chosen = tuple[float, Callable[[PlainTrials], Prediction]]
# Columns (P,), and normal equations (R, D, D) and (R, D, P') of trials.
Sums = tuple[BoolArray, FloatArray, FloatArray]

_RIDGES: Final = (1e-8, 1e-4, 1e-2, 1e-1)  # of a regression, over the mean of the kernel's diagonal
# Of Gaussian kernels, over the median distance between trials.
_WIDTHS: Final = (0.25, 0.5, 1.0, 2.0)
_EXACT: Final = 1e-8  # ridge of an interpolation
# s: time constants of exponential means of inputs; a regression has the first ones
_MEANS: Final = (0.1, 0.5, 3.0)
_MEAN_RIDGES: Final = (1e-6, 1e-4, 1e-3, 1e-2)  # over the mean square of each feature


def interpolation(trials: PlainTrials, asked: PlainTrials) -> Prediction:
    """Predicts motions by straight lines from zero inputs through the trials.

    By their mean if nothing differs.
    """
    return _predicted(trials, asked, _spline, _EXACT, 0.0 if trials.features(trials).any() else 1.0)


def distinguished(trials: PlainTrials) -> bool:
    """Returns whether there are three trials or more, whose inputs,
    loads or displacements before time zero differ.
    """
    return len(trials.values) > 2 and bool(np.ptp(trials.features(trials), axis=0).any())


def _spline(a: FloatArray, b: FloatArray) -> FloatArray:
    """The covariance of Brownian motion: in one dimension straight lines
    from zero to the outermost trial.
    """
    return np.linalg.norm(a, axis=1)[:, None] + np.linalg.norm(b, axis=1)[None] - cdist(a, b)


def _quadratic(a: FloatArray, b: FloatArray) -> FloatArray:
    products = a @ b.T
    return np.asarray(products + products**2)


def _kernels(features: FloatArray) -> dict[str, Kernel]:
    def gaussian(size: float) -> Kernel:
        return lambda a, b: np.exp(-0.5 * np.square(cdist(a, b) / size))

    apart = cdist(features, features)
    typical = float(np.median(apart[apart > 1e-6 * apart.max()]))
    kernels: dict[str, Kernel] = {
        "linear": lambda a, b: a @ b.T,
        "quadratic": _quadratic,
        "straight lines": _spline,
    }
    return kernels | {
        f"Gaussian, {w:g} of the distance between trials": gaussian(w * typical) for w in _WIDTHS
    }


def regression(trials: PlainTrials, asked: PlainTrials) -> Prediction:
    """Predicts motions by the ridge regression of the least mean error
    of a training trial that is left out.
    """
    _, model = min([_by_trial(trials), *_by_means(trials)], key=lambda chosen: chosen[0])
    return model(asked)


def _whole(trials: PlainTrials) -> BoolArray:
    """(T, P) values that all trials show, by which a regression is chosen.

    If there are none, those that any shows.
    """
    seen = np.isfinite(trials.values)
    return np.asarray(seen.all(0) if seen.all(0).any() else seen.any(0))


def _by_trial(trials: PlainTrials) -> Chosen:
    """Kernel regression over trials, each frame by itself.

    The error of one that is left out has a closed form.
    """
    features = trials.features(trials)
    flat = np.nan_to_num(trials.moved[:, _whole(trials)])
    products = flat @ flat.T
    best, chosen = np.inf, ("straight lines", 0.0, _EXACT)
    kernels = _kernels(features)
    for (name, kernel), constant, ridge in product(kernels.items(), (0.0, 1.0), _RIDGES):
        inverse = np.linalg.inv(
            _scaled(kernel, features, constant)(features, features) + ridge * np.eye(len(features))
        )
        left_out = np.einsum("ij,jk,ik->i", inverse, products, inverse) / np.diag(inverse) ** 2
        error = float(np.sqrt(np.maximum(left_out, 0.0)).mean())
        if error < best * (1.0 - 1e-9):
            best, chosen = error, (name, constant, ridge)
    name, constant, ridge = chosen
    settings = f"{name}{' with a constant' if constant else ''}, ridge {ridge:g}"
    return best, lambda asked: replace(
        _predicted(trials, asked, kernels[name], ridge, constant), settings=settings
    )


def _by_means(trials: PlainTrials) -> list[Chosen]:
    """Ridge regressions of all frames alike on `_Means` of the inputs of motions."""
    found = list[Chosen]()
    rows = np.arange(len(trials.values))
    whole = _whole(trials)
    if trials.values.shape[1] < 2 or not trials.inputs.any():
        return found
    for length, degree in product(range(1, len(_MEANS) + 1), degrees(trials)[:2]):
        means = _Means(trials, _MEANS[:length], degree)
        features, places = means(trials), trials.values - means.origin(trials)
        sums = _sums_of_means(features, places)
        for ridge in _MEAN_RIDGES:
            off = (features[r] @ _weights(sums, rows != r, ridge) - places[r] for r in rows)
            left_out = [float(np.linalg.norm(np.nan_to_num(values[whole]))) for values in off]
            model = partial(means.prediction, weights=_weights(sums, rows >= 0, ridge), ridge=ridge)
            found.append((float(np.mean(left_out)), model))
    return found


@dataclass(frozen=True)
class _Means:
    """Exponential means of the inputs that act in training trials,
    and products of the fastest ones and of loads.

    Bodies that begin under inputs are displaced already, so that places count from those of the
    frame of the body.
    """

    trials: PlainTrials
    constants: tuple[float, ...]
    degree: int

    def __call__(self, motions: PlainTrials) -> FloatArray:
        """(R, T, D) features, the last of which is a constant."""
        kept = np.exp(-motions.interval / np.array(self.constants))
        means = [
            lfilter([1.0 - k], [1.0, -k], motions.inputs, 1, k * motions.before[:, None])[0]
            for k in kept
        ]
        fastest = driving_terms(replace(motions, inputs=means[0]), self.trials, self.degree)
        acting = self.trials.inputs.any((0, 1))
        return np.concatenate([*(mean[..., acting] for mean in means[1:]), fastest], 2)

    def origin(self, motions: PlainTrials) -> FloatArray:
        """(R, 1, P) from where places count [m]."""
        return (0.0 if self.trials.before.any() else 1.0) * motions.origin[:, None]

    def prediction(self, asked: PlainTrials, weights: FloatArray, ridge: float) -> Prediction:
        """Predicts trials by weights (D, P)."""
        words = ", ".join(f"{constant:g}" for constant in self.constants)
        settings = (
            f"means of {words} s{' with products' if self.degree > 1 else ''}, ridge {ridge:g}"
        )
        return Prediction(self.origin(asked) + self(asked) @ weights, settings)


def _sums_of_means(
    features: FloatArray, places: FloatArray
) -> list[tuple[BoolArray, FloatArray, FloatArray]]:
    """Columns (P,) that the same frames show, and their (R, D, D)
    and (R, D, P') normal equations of each trial.
    """
    seen = np.isfinite(places)
    patterns, which = np.unique(seen.reshape(-1, seen.shape[-1]), axis=1, return_inverse=True)
    found = []
    for number, frames in enumerate(patterns.T):
        columns = which.ravel() == number
        shown = np.where(frames.reshape(seen.shape[:2])[..., None], features, 0.0)
        known = np.nan_to_num(places[..., columns])
        found.append((columns, shown.swapaxes(1, 2) @ shown, shown.swapaxes(1, 2) @ known))
    return found


def _weights(
    sums: Sequence[tuple[BoolArray, FloatArray, FloatArray]], rows: BoolArray, ridge: float
) -> FloatArray:
    """(D, P) weights from some of the trials; NaN for values that none of them shows."""
    weights = np.full((sums[0][1].shape[1], len(sums[0][0])), np.nan)
    for columns, grams, moments in sums:
        gram, diagonal = grams[rows].sum(0), np.einsum("rdd->d", grams[rows])
        diagonal[:-1] *= ridge  # The constant is free.
        diagonal[-1] = 0.0
        if gram[-1, -1] > 0.0:
            least = 1e-12 * np.trace(gram)  # for inputs that act in other trials alone
            weights[:, columns] = np.linalg.solve(
                gram + np.diag(diagonal + least), moments[rows].sum(0)
            )
    return weights


def _scaled(kernel: Kernel, features: FloatArray, constant: float) -> Kernel:
    """The kernel over the mean of its diagonal at the training features, plus a constant."""
    scale = max(float(np.trace(kernel(features, features))) / len(features), 1e-12)
    return lambda a, b: kernel(a, b) / scale + constant


def _predicted(
    trials: PlainTrials, asked: PlainTrials, kernel: Kernel, ridge: float, constant: float
) -> Prediction:
    features, moved = trials.features(trials), trials.moved
    scaled = _scaled(kernel, features, constant)
    gram = scaled(features, features) + ridge * np.eye(len(features))
    across = scaled(asked.features(trials), features)
    flat = moved.reshape(len(moved), -1)
    seen = np.isfinite(flat)
    whole = seen.all(0)
    result = np.full((len(across), flat.shape[1]), np.nan)
    result[:, whole] = across @ np.linalg.solve(gram, flat[:, whole])
    patterns, which = np.unique(seen[:, ~whole], axis=1, return_inverse=True)
    for number, rows in enumerate(patterns.T):
        columns = np.flatnonzero(~whole)[which.ravel() == number]
        if rows.any():
            result[:, columns] = across[:, rows] @ np.linalg.solve(
                gram[np.ix_(rows, rows)], flat[np.ix_(rows, columns)]
            )
    return Prediction(asked.origin[:, None] + _held(result.reshape(len(across), *moved.shape[1:])))


def _held(values: FloatArray) -> FloatArray:
    """(Q, T, P) values, the last one where a frame has none,
    and before the first frame the first one.
    """
    seen = np.isfinite(values)
    frames = np.arange(values.shape[1])[:, None]
    last = np.maximum.accumulate(np.where(seen, frames, seen.argmax(1)[:, None]), axis=1)
    return np.take_along_axis(values, last, 1)
