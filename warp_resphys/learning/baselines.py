"""Predictions without physics: a body at rest, interpolation and regression over trials, a linear model in time.

They have what simulators have, the inputs of a trial and the points before time zero, and learn from the same trials.
Their settings are chosen by leaving training trials out.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

FloatArray = NDArray[np.float64]
Kernel = Callable[[FloatArray, FloatArray], FloatArray]

REST: Final = "rest"
BASELINES: Final = (REST, "interpolation", "regression", "linear")  # names of the predictions

_RIDGES: Final = (1e-8, 1e-4, 1e-2, 1e-1)  # of a regression, over the mean of the kernel's diagonal
_WIDTHS: Final = (0.25, 0.5, 1.0, 2.0)  # of Gaussian kernels, over the median distance between trials
_EXACT: Final = 1e-8  # ridge of an interpolation
_MODES: Final = (2, 4, 8, 16)
_LINEAR_RIDGES: Final = (1e-9, 1e-6, 1e-4, 1e-2)
_FOLDS: Final = 4
_LARGEST: Final = 1e3  # coordinate of a linear model, over the root mean square displacement in its training


@dataclass(frozen=True)
class PlainTrials:
    """R trials of which T frames of P coordinates were observed; a static pose is a trial of one frame.

    Attributes:
        values: (R, T, P) [m], NaN where a coordinate was not seen.
        origin: (R, P) where the body is at rest [m].
        first: (R, P) before time zero [m].
        inputs: (R, T, C) during each frame, of the size of one.
        known: (R, F) what else distinguishes trials, such as a load, of the size of one.
    """

    values: FloatArray
    origin: FloatArray
    first: FloatArray
    inputs: FloatArray
    known: FloatArray

    def select(self, rows: NDArray[np.bool_]) -> "PlainTrials":
        """Returns some of the trials."""
        return PlainTrials(self.values[rows], self.origin[rows], self.first[rows], self.inputs[rows], self.known[rows])

    @property
    def moved(self) -> FloatArray:
        """(R, T, P) displacements [m]."""
        return self.values - self.origin[:, None]

    def features(self, like: "PlainTrials") -> FloatArray:
        """(R, T C + F + P) what distinguishes trials: inputs at all frames, loads, and displacements before time zero.

        Args:
            like: the training trials, whose mean displacement before time zero is the unit of displacements.
        """
        frames = self.inputs.shape[1]
        parts = [self.inputs.reshape(len(self.inputs), -1) / np.sqrt(frames), self.known]
        size = np.linalg.norm(like.displaced, axis=1).mean()
        return np.concatenate([*parts, *([self.displaced / size] if size > 0.0 else [])], 1)

    @property
    def displaced(self) -> FloatArray:
        """(R, P) displacements before time zero [m], zero where they are not known."""
        return np.nan_to_num(self.first - self.origin)


@dataclass(frozen=True)
class Prediction:
    """Predicted motions (Q, T, P) [m], and the settings that were chosen, in words."""

    values: FloatArray
    settings: str = ""


def predictions(trials: PlainTrials, asked: PlainTrials) -> dict[str, Prediction]:
    """Predicts trials without physics.

    Args:
        trials: training trials.
        asked: trials to predict; their values are not used.

    Returns:
        ``rest``: nothing moves. ``interpolation``: straight lines from zero inputs through the trials, frame by frame,
        constant beyond the outermost, if inputs or loads distinguish them. ``regression``: kernel ridge regression in
        their place, with three trials or more. ``linear``: a linear state-space model with inputs (Proctor, Brunton and
        Kutz, SIAM Journal on Applied Dynamical Systems 15(1), 2016), for motions.
    """
    result = {REST: Prediction(np.broadcast_to(asked.origin[:, None], asked.values.shape).copy())}
    if np.ptp(trials.features(trials), axis=0).any():
        result["interpolation"] = _predicted(trials, asked, _spline, _EXACT, 0.0)
        if len(trials.values) > 2:
            result["regression"] = regression(trials, asked)
    if trials.values.shape[1] > 2:
        result["linear"] = linear(trials, asked)
    return result


def _spline(a: FloatArray, b: FloatArray) -> FloatArray:
    """The covariance of Brownian motion: in one dimension straight lines from zero to the outermost trial."""
    return np.linalg.norm(a, axis=1)[:, None] + np.linalg.norm(b, axis=1)[None] - cdist(a, b)


def _quadratic(a: FloatArray, b: FloatArray) -> FloatArray:
    products = a @ b.T
    return np.asarray(products + products**2)


def _kernels(features: FloatArray) -> dict[str, Kernel]:
    def gaussian(size: float) -> Kernel:
        return lambda a, b: np.exp(-0.5 * np.square(cdist(a, b) / size))

    apart = cdist(features, features)
    typical = float(np.median(apart[apart > 1e-6 * apart.max()]))
    kernels: dict[str, Kernel] = {"linear": lambda a, b: a @ b.T, "quadratic": _quadratic, "straight lines": _spline}
    return kernels | {f"Gaussian, {w:g} of the distance between trials": gaussian(w * typical) for w in _WIDTHS}


def regression(trials: PlainTrials, asked: PlainTrials) -> Prediction:
    """Predicts motions by kernel ridge regression of the displacements, at each frame by itself.

    The kernel, a constant and the ridge are those of the least mean error of a training trial that is left out, which
    has a closed form.
    """
    features, moved = trials.features(trials), trials.moved.reshape(len(trials.values), -1)
    seen = np.isfinite(moved)
    whole = seen.all(0) if seen.all(0).any() else seen.any(0)
    flat = np.where(seen, moved, 0.0)[:, whole]
    products = flat @ flat.T
    best, chosen = np.inf, ("straight lines", 0.0, _EXACT)
    kernels = _kernels(features)
    for (name, kernel), constant, ridge in product(kernels.items(), (0.0, 1.0), _RIDGES):
        inverse = np.linalg.inv(_scaled(kernel, features, constant)(features, features) + ridge * np.eye(len(features)))
        left_out = np.einsum("ij,jk,ik->i", inverse, products, inverse) / np.diag(inverse) ** 2
        error = float(np.sqrt(np.maximum(left_out, 0.0)).mean())
        if error < best * (1.0 - 1e-9):
            best, chosen = error, (name, constant, ridge)
    name, constant, ridge = chosen
    predicted = _predicted(trials, asked, kernels[name], ridge, constant)
    return Prediction(predicted.values, f"{name}{' with a constant' if constant else ''}, ridge {ridge:g}")


def _scaled(kernel: Kernel, features: FloatArray, constant: float) -> Kernel:
    """The kernel over the mean of its diagonal at the training features, plus a constant."""
    scale = max(float(np.trace(kernel(features, features))) / len(features), 1e-12)
    return lambda a, b: kernel(a, b) / scale + constant


def _predicted(trials: PlainTrials, asked: PlainTrials, kernel: Kernel, ridge: float, constant: float) -> Prediction:
    features, moved = trials.features(trials), trials.moved
    scaled = _scaled(kernel, features, constant)
    gram, across = scaled(features, features) + ridge * np.eye(len(features)), scaled(asked.features(trials), features)
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
    return Prediction(asked.origin[:, None] + result.reshape(len(across), *moved.shape[1:]))


def linear(trials: PlainTrials, asked: PlainTrials) -> Prediction:
    """Predicts motions by a linear model of the displacements in two frames and the inputs, in principal components.

    The number of components and the ridge are those of the least error of roll-outs of trials that are left out, or of
    the only training trial. Coordinates that a trial never shows are not predicted.
    """
    shown = np.isfinite(trials.moved).any(1).all(0)
    if trials.displaced.any():  # then the start of a coordinate must be known
        shown &= np.isfinite(trials.first).all(0) & np.isfinite(asked.first).all(0)
    values = np.full(asked.values.shape, np.nan)
    if not shown.any():
        return Prediction(values)
    moved = [_without_gaps(own) for own in trials.moved[..., shown]]
    everything = np.concatenate(moved)
    size = float(np.sqrt(np.square(everything).sum(1).mean())) or 1.0
    count = everything.shape[1]
    if len(everything) < count:
        vectors = np.linalg.svd(everything, full_matrices=False)[2][: _MODES[-1]].T
    else:
        largest = [max(count - _MODES[-1], 0), count - 1]
        vectors = scipy.linalg.eigh(everything.T @ everything, subset_by_index=largest)[1][:, ::-1]
    basis = vectors / size
    starts, driving = trials.displaced[:, shown] @ basis, _driving(trials)
    z = [np.concatenate([start[None], own @ basis]) for start, own in zip(starts, moved, strict=True)]
    squares = [np.square(own / size).sum() for own in moved]
    folds, best, chosen = min(_FOLDS, len(moved)), np.inf, (1, _LINEAR_RIDGES[-1])
    for modes, ridge in product(sorted({min(m, basis.shape[1]) for m in _MODES}), _LINEAR_RIDGES):
        error = 0.0
        for fold in range(folds):
            out = [k for k in range(len(z)) if k % folds == fold]
            kept = [k for k in range(len(z)) if folds == 1 or k % folds != fold]
            matrix = _fitted([z[k][:, :modes] for k in kept], driving[kept], ridge)
            rolled = _rolled(matrix, starts[out, :modes], driving[out])
            for row, k in zip(rolled, out, strict=True):  # the components that are left out do not move
                seen = z[k][1:, :modes]
                off = np.square(row[: len(seen)] - seen).sum() + squares[k] - np.square(seen).sum()
                error += float(np.sqrt(max(off, 0.0) / len(seen)))
        if error < best * (1.0 - 1e-9):
            best, chosen = error, (modes, ridge)
    modes, ridge = chosen
    matrix = _fitted([own[:, :modes] for own in z], driving, ridge)
    rolled = _rolled(matrix, (asked.displaced[:, shown] @ basis)[:, :modes], _driving(asked))
    settings = f"{modes} component{'s' if modes > 1 else ''}, ridge {ridge:g}"
    values[..., shown] = asked.origin[:, None, shown] + rolled @ basis[:, :modes].T * size**2
    return Prediction(values, settings)


def _without_gaps(moved: FloatArray) -> FloatArray:
    """(T', P) displacements (T, P) up to the last frame that shows any; coordinates that are never seen do not move."""
    seen = np.isfinite(moved)
    last = int(np.flatnonzero(seen.any(1))[-1]) + 1
    frames, result = np.arange(last), np.nan_to_num(moved[:last])
    for column in np.flatnonzero(seen[:last].any(0) & ~seen[:last].all(0)):
        at = np.flatnonzero(seen[:last, column])
        result[:, column] = np.interp(frames, at, moved[at, column])
    return result


def _driving(motions: PlainTrials) -> FloatArray:
    frames = motions.inputs.shape[1]
    known = np.broadcast_to(motions.known[:, None], (len(motions.known), frames, motions.known.shape[1]))
    return np.concatenate([motions.inputs, known, np.ones((len(known), frames, 1))], 2)


def _rows(z: FloatArray, before: FloatArray, driving: FloatArray) -> FloatArray:
    return np.concatenate([z, before, driving[..., :-1, :], driving[..., 1:, :]], -1)


def _fitted(series: Sequence[FloatArray], driving: FloatArray, ridge: float) -> FloatArray:
    """The matrix from coordinates of two frames, and what drives both ends of the next interval, to the next frame.

    Args:
        series: (1 + T', m) coordinates before time zero and at the frames of each trial.
        driving: (R, T, D) of these trials.
        ridge: over the mean of the diagonal.
    """
    rows = [_rows(z[1:-1], z[:-2], own[: len(z) - 1]) for z, own in zip(series, driving, strict=True)]
    known, wanted = np.concatenate(rows), np.concatenate([z[2:] for z in series])
    gram = known.T @ known
    gram += (ridge * np.trace(gram) / len(gram) or 1.0) * np.eye(len(gram))  # Too few frames predict no motion.
    return np.asarray(np.linalg.solve(gram, known.T @ wanted))


def _rolled(matrix: FloatArray, starts: FloatArray, driving: FloatArray) -> FloatArray:
    """(R, T, m) coordinates from rest in (R, m) starts; too large ones stay where they are."""
    states = [starts, starts]
    for t in range(driving.shape[1] - 1):
        row = _rows(states[-1][:, None], states[-2][:, None], driving[:, t : t + 2])[:, 0]
        states.append(np.clip(row @ matrix, -_LARGEST, _LARGEST))
    return np.stack(states[1:], 1)
