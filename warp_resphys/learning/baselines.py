"""Predictions without physics: a body at rest, interpolation and regression over trials, a linear model in time.

They have what simulators have, the inputs of a trial and the points before time zero, learn from the same trials, and
predict all frames: interpolation and regression hold their last value after the end of the longest training trial.
Their settings are chosen by leaving training trials out.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, product
from typing import Final

import numpy as np
import scipy.linalg
from scipy.spatial.distance import cdist

from ..io.arrays import BoolArray, FloatArray, IntArray

Kernel = Callable[[FloatArray, FloatArray], FloatArray]

REST: Final = "rest"
BASELINES: Final = (REST, "interpolation", "regression", "linear")  # names of the predictions

_RIDGES: Final = (1e-8, 1e-4, 1e-2, 1e-1)  # of a regression, over the mean of the kernel's diagonal
_WIDTHS: Final = (0.25, 0.5, 1.0, 2.0)  # of Gaussian kernels, over the median distance between trials
_EXACT: Final = 1e-8  # ridge of an interpolation
_MODES: Final = (2, 4, 8, 16)
_LINEAR_RIDGES: Final = (1e-9, 1e-6, 1e-4, 1e-2)
_DEGREES: Final = (1, 2, 3)  # of a linear model in the inputs
_MOST_TERMS: Final = 100  # products of inputs
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

    def select(self, rows: BoolArray) -> "PlainTrials":
        """Returns some of the trials."""
        return PlainTrials(self.values[rows], self.origin[rows], self.first[rows], self.inputs[rows], self.known[rows])

    @property
    def moved(self) -> FloatArray:
        """(R, T, P) displacements [m]."""
        return self.values - self.origin[:, None]

    def features(self, like: "PlainTrials") -> FloatArray:
        """(R, T' C + F + P) what distinguishes trials: inputs, loads, and displacements before time zero.

        Args:
            like: the training trials, whose mean displacement before time zero is the unit of displacements. Inputs
                count in the T' frames up to their end.
        """
        frames = int(np.flatnonzero(np.isfinite(like.values).any((0, 2)))[-1]) + 1
        parts = [self.inputs[:, :frames].reshape(len(self.inputs), -1) / np.sqrt(frames), self.known]
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

    Coordinates that no training trial shows are NaN.

    Args:
        trials: training trials.
        asked: trials to predict; their values are not used.

    Returns:
        ``rest``: nothing moves. ``interpolation``: straight lines from zero inputs through the trials, frame by frame,
        constant beyond the outermost; the mean of trials that nothing distinguishes. ``regression``: kernel ridge
        regression in their place, where `distinguished`. ``linear``: a linear state-space model with powers and
        products of the inputs (Proctor, Brunton and Kutz, SIAM Journal on Applied Dynamical Systems 15(1), 2016), for
        motions.
    """
    result = {REST: at_rest(asked)}
    constant = 0.0 if trials.features(trials).any() else 1.0
    result["interpolation"] = _predicted(trials, asked, _spline, _EXACT, constant)
    if distinguished(trials):
        result["regression"] = regression(trials, asked)
    if trials.values.shape[1] > 2:
        result["linear"] = linear(trials, asked)
    return result


def at_rest(asked: PlainTrials) -> Prediction:
    """Predicts that nothing moves."""
    return Prediction(np.broadcast_to(asked.origin[:, None], asked.values.shape).copy())


def distinguished(trials: PlainTrials) -> bool:
    """Returns whether there are three trials or more, whose inputs, loads or displacements before time zero differ."""
    return len(trials.values) > 2 and bool(np.ptp(trials.features(trials), axis=0).any())


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
    return Prediction(asked.origin[:, None] + _held(result.reshape(len(across), *moved.shape[1:])))


def _held(values: FloatArray) -> FloatArray:
    """(Q, T, P) values, the last one where a frame has none, and before the first frame the first one."""
    seen = np.isfinite(values)
    frames = np.arange(values.shape[1])[:, None]
    last = np.maximum.accumulate(np.where(seen, frames, seen.argmax(1)[:, None]), axis=1)
    return np.take_along_axis(values, last, 1)


def linear(trials: PlainTrials, asked: PlainTrials) -> Prediction:
    """Predicts motions by a linear model of the displacements in two frames, in principal components, and of inputs.

    The model is linear in the powers and products of the inputs up to a degree. The degree, the number of components
    and the ridge are those of the least error of roll-outs of trials that are left out; a single training trial is
    itself rolled out, with a degree of one. Coordinates that some trials do not show follow from the components.
    """
    seen = np.asarray(np.isfinite(trials.moved).any(1))  # (R, P)
    if not (common := seen.all(0)).any():  # The trials that show the coordinate that most of them and the others show.
        wanted = seen.sum(0) * (1.0 + len(seen) * np.isfinite(asked.first).any(0))
        return linear(trials.select(seen[:, wanted.argmax()]), asked)
    begun = np.isfinite(np.concatenate([trials.first, asked.first])).all(0)
    shown = common & begun if trials.displaced.any() and (common & begun).any() else common
    moved = [_without_gaps(path) for path in trials.moved[..., shown]]
    everything = np.concatenate(moved)
    size = float(np.sqrt(np.square(everything).sum(1).mean())) or 1.0
    count = everything.shape[1]
    if len(everything) < count:
        vectors = np.linalg.svd(everything, full_matrices=False)[2][: _MODES[-1]].T
    else:
        largest = [max(count - _MODES[-1], 0), count - 1]
        vectors = scipy.linalg.eigh(everything.T @ everything, subset_by_index=largest)[1][:, ::-1]
    basis = vectors / size
    starts, most = trials.displaced[:, shown] @ basis, basis.shape[1]
    z = [np.concatenate([start[None], path @ basis]) for start, path in zip(starts, moved, strict=True)]
    squares = [np.square(path / size).sum() for path in moved]
    sizes, folds = sorted({min(m, most) for m in _MODES}), min(_FOLDS, len(moved))
    best, chosen = np.inf, (1, 1, _LINEAR_RIDGES[-1])
    for degree in _degrees(trials):
        driving = _driving(trials, trials, degree)
        sums = [_sums(path, acting) for path, acting in zip(z, driving, strict=True)]
        for modes, ridge in product(sizes, _LINEAR_RIDGES):
            error = 0.0
            for fold in range(folds):
                out = [k for k in range(len(z)) if k % folds == fold]
                kept = [k for k in range(len(z)) if folds == 1 or k % folds != fold]
                matrix = _fitted([sums[k] for k in kept], most, modes, ridge)
                rolled = _rolled(matrix, starts[out, :modes], driving[out])
                for row, k in zip(rolled, out, strict=True):  # the components that are left out do not move
                    known = z[k][1:, :modes]
                    off = np.square(row[: len(known)] - known).sum() + squares[k] - np.square(known).sum()
                    error += float(np.sqrt(max(off, 0.0) / len(known)))
            if error < best * (1.0 - 1e-9):
                best, chosen = error, (degree, modes, ridge)
    degree, modes, ridge = chosen
    driving = _driving(trials, trials, degree)
    matrix = _fitted([_sums(path, acting) for path, acting in zip(z, driving, strict=True)], most, modes, ridge)
    rolled = _rolled(matrix, (asked.displaced[:, shown] @ basis)[:, :modes], _driving(asked, trials, degree))
    values = np.full(asked.values.shape, np.nan)
    values[..., shown] = asked.origin[:, None, shown] + rolled @ basis[:, :modes].T * size**2
    for column in np.flatnonzero(seen.any(0) & ~shown):
        there = [np.isfinite(path[: len(of) - 1, column]) for path, of in zip(trials.moved, z, strict=True)]
        known = np.concatenate([of[1:, :modes][where] for of, where in zip(z, there, strict=True)])
        wanted = np.concatenate(
            [path[: len(where), column][where] for path, where in zip(trials.moved, there, strict=True)]
        )
        values[..., column] = asked.origin[:, None, column] + rolled @ np.linalg.lstsq(known, wanted, rcond=_EXACT)[0]
    powers = f"degree {degree}, " if degree > 1 else ""
    return Prediction(values, f"{powers}{modes} component{'s' if modes > 1 else ''}, ridge {ridge:g}")


def _without_gaps(moved: FloatArray) -> FloatArray:
    """(T', P) displacements (T, P) up to the last frame that shows any; coordinates that are never seen do not move."""
    seen = np.isfinite(moved)
    last = int(np.flatnonzero(seen.any(1))[-1]) + 1
    frames, result = np.arange(last), np.nan_to_num(moved[:last])
    for column in np.flatnonzero(seen[:last].any(0) & ~seen[:last].all(0)):
        at = np.flatnonzero(seen[:last, column])
        result[:, column] = np.interp(frames, at, moved[at, column])
    return result


def _degrees(trials: PlainTrials) -> list[int]:
    """Degrees of a linear model in the inputs, fewer than trials, among which leaving trials out can choose."""
    count = len(_acting(trials))
    few = [degree for degree in _DEGREES if math.comb(count + degree, degree) <= _MOST_TERMS + 1]
    return [1, *(degree for degree in few if 1 < degree < len(trials.values) and count)]


def _acting(trials: PlainTrials) -> IntArray:
    """(A,) columns of inputs and loads that act in any trial."""
    return np.flatnonzero(np.concatenate([trials.inputs.any((0, 1)), trials.known.any(0)]))


def _driving(motions: PlainTrials, trials: PlainTrials, degree: int) -> FloatArray:
    """(R, T, D) powers and products of the inputs and loads of motions that act in training trials, and a constant."""
    frames = motions.inputs.shape[1]
    known = np.broadcast_to(motions.known[:, None], (len(motions.known), frames, motions.known.shape[1]))
    inputs = np.concatenate([motions.inputs, known], 2)
    chosen = (c for d in range(1, degree + 1) for c in combinations_with_replacement(_acting(trials).tolist(), d))
    columns = [inputs[..., list(term)].prod(-1) for term in chosen]
    return np.stack([*columns, np.ones(inputs.shape[:2])], 2)


def _rows(z: FloatArray, before: FloatArray, driving: FloatArray) -> FloatArray:
    return np.concatenate([z, before, driving[..., :-1, :], driving[..., 1:, :]], -1)


def _sums(z: FloatArray, driving: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Matrix and right-hand side of the normal equations of a trial, from two frames to the next.

    Args:
        z: (1 + T', m) coordinates before time zero and at the frames.
        driving: (T, D) what drives both ends of each interval.
    """
    rows = _rows(z[1:-1], z[:-2], driving[: len(z) - 1])
    return rows.T @ rows, rows.T @ z[2:]


def _fitted(sums: Sequence[tuple[FloatArray, FloatArray]], most: int, modes: int, ridge: float) -> FloatArray:
    """The matrix from coordinates of two frames, and what drives both ends of the next interval, to the next frame.

    Args:
        sums: normal equations of each trial.
        most: number of their coordinates.
        modes: number of coordinates of the matrix.
        ridge: over the mean of the diagonal.
    """
    gram, moment = (np.sum(parts, axis=0) for parts in zip(*sums, strict=True))
    kept = np.r_[:modes, most : most + modes, 2 * most : len(gram)]
    gram = gram[np.ix_(kept, kept)]
    gram += (ridge * np.trace(gram) / len(gram) or 1.0) * np.eye(len(gram))  # Too few frames predict no motion.
    return np.asarray(np.linalg.solve(gram, moment[kept, :modes]))


def _rolled(matrix: FloatArray, starts: FloatArray, driving: FloatArray) -> FloatArray:
    """(R, T, m) coordinates from rest in (R, m) starts; too large ones stay where they are."""
    states = [starts, starts]
    for t in range(driving.shape[1] - 1):
        row = _rows(states[-1][:, None], states[-2][:, None], driving[:, t : t + 2])[:, 0]
        states.append(np.clip(row @ matrix, -_LARGEST, _LARGEST))
    return np.stack(states[1:], 1)
