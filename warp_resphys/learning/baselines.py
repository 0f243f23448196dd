"""Predictions without physics: a body at rest, interpolation and regression over trials,
a linear model in time.

They have what simulators have, the inputs of a trial and the points before time zero, learn from
the same trials, and predict all frames: what learns each frame by itself holds its last value after
the end of the longest training trial. Their settings are chosen by leaving training trials out.
"""

from collections.abc import Sequence
from itertools import product
from typing import Final

import numpy as np
import scipy.linalg

from ..io.arrays import FloatArray
from .plain_trials import PlainTrials, Prediction, degrees, driving_terms
from .regression import distinguished, interpolation, regression

REST: Final = "rest"
BASELINES: Final = (REST, "interpolation", "regression", "linear")  # names of the predictions

_MODES: Final = (2, 4, 8, 16)
_LINEAR_RIDGES: Final = (1e-9, 1e-6, 1e-4, 1e-2)
_EXACT: Final = 1e-8  # least singular value of a fit of other coordinates, relative to the largest
_FOLDS: Final = 4
_LARGEST: Final = (
    1e3  # coordinate of a linear model, over the root mean square displacement in its training
)


def predictions(trials: PlainTrials, asked: PlainTrials) -> dict[str, Prediction]:
    """Predicts trials without physics.

    Coordinates that no training trial shows are NaN.

    Args:
        trials: training trials.
        asked: trials to predict; their values are not used.

    Returns:
        ``rest``: nothing moves. ``interpolation``: straight lines from zero inputs through the
        trials, frame by frame, constant beyond the outermost; the mean of trials that nothing
        distinguishes. ``regression``: ridge regression, see `regression`, where `distinguished`.
        ``linear``: a linear state-space model with powers and products of the inputs (Proctor,
        Brunton and Kutz, SIAM Journal on Applied Dynamical Systems 15(1), 2016), for motions.
    """
    result = {REST: at_rest(asked), "interpolation": interpolation(trials, asked)}
    if distinguished(trials):
        result["regression"] = regression(trials, asked)
    if trials.values.shape[1] > 2:
        result["linear"] = linear(trials, asked)
    return result


def at_rest(asked: PlainTrials) -> Prediction:
    """Predicts that nothing moves."""
    return Prediction(np.broadcast_to(asked.origin[:, None], asked.values.shape).copy())


def linear(trials: PlainTrials, asked: PlainTrials) -> Prediction:
    """Predicts motions by a linear model of the displacements in two frames, in principal
    components, and of inputs.

    The model is linear in the powers and products of the inputs up to a degree. The degree, the
    number of components and the ridge are those of the least error of roll-outs of trials that are
    left out; a single training trial is itself rolled out, with a degree of one. Coordinates that
    some trials do not show follow from the components.
    """
    seen = np.asarray(np.isfinite(trials.moved).any(1))  # (R, P)
    common = seen.all(0)
    if not common.any():
        # The trials that show the coordinate that most of them and the others show.
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
    z = [
        np.concatenate([start[None], path @ basis])
        for start, path in zip(starts, moved, strict=True)
    ]
    squares = [np.square(path / size).sum() for path in moved]
    sizes, folds = sorted({min(m, most) for m in _MODES}), min(_FOLDS, len(moved))
    best, chosen = np.inf, (1, 1, _LINEAR_RIDGES[-1])
    for degree in degrees(trials):
        driving = driving_terms(trials, trials, degree)
        sums = [_sums(path, acting) for path, acting in zip(z, driving, strict=True)]
        for modes, ridge in product(sizes, _LINEAR_RIDGES):
            error = 0.0
            for fold in range(folds):
                out = [k for k in range(len(z)) if k % folds == fold]
                kept = [k for k in range(len(z)) if folds == 1 or k % folds != fold]
                matrix = _fitted([sums[k] for k in kept], most, modes, ridge)
                rolled = _rolled(matrix, starts[out, :modes], driving[out])
                # The components that are left out do not move.
                for row, k in zip(rolled, out, strict=True):
                    known = z[k][1:, :modes]
                    off = (
                        np.square(row[: len(known)] - known).sum()
                        + squares[k]
                        - np.square(known).sum()
                    )
                    error += float(np.sqrt(max(off, 0.0) / len(known)))
            if error < best * (1.0 - 1e-9):
                best, chosen = error, (degree, modes, ridge)
    degree, modes, ridge = chosen
    driving = driving_terms(trials, trials, degree)
    matrix = _fitted(
        [_sums(path, acting) for path, acting in zip(z, driving, strict=True)], most, modes, ridge
    )
    rolled = _rolled(
        matrix, (asked.displaced[:, shown] @ basis)[:, :modes], driving_terms(asked, trials, degree)
    )
    values = np.full(asked.values.shape, np.nan)
    values[..., shown] = asked.origin[:, None, shown] + rolled @ basis[:, :modes].T * size**2
    for column in np.flatnonzero(seen.any(0) & ~shown):
        there = [
            np.isfinite(path[: len(of) - 1, column])
            for path, of in zip(trials.moved, z, strict=True)
        ]
        known = np.concatenate([of[1:, :modes][where] for of, where in zip(z, there, strict=True)])
        wanted = np.concatenate(
            [
                path[: len(where), column][where]
                for path, where in zip(trials.moved, there, strict=True)
            ]
        )
        values[..., column] = (
            asked.origin[:, None, column] + rolled @ np.linalg.lstsq(known, wanted, rcond=_EXACT)[0]
        )
    powers = f"degree {degree}, " if degree > 1 else ""
    return Prediction(
        values, f"{powers}{modes} component{'s' if modes > 1 else ''}, ridge {ridge:g}"
    )


def _without_gaps(moved: FloatArray) -> FloatArray:
    """(T', P) displacements (T, P) up to the last frame that shows any.

    Coordinates that are never seen do not move.
    """
    seen = np.isfinite(moved)
    last = int(np.flatnonzero(seen.any(1))[-1]) + 1
    frames, result = np.arange(last), np.nan_to_num(moved[:last])
    for column in np.flatnonzero(seen[:last].any(0) & ~seen[:last].all(0)):
        at = np.flatnonzero(seen[:last, column])
        result[:, column] = np.interp(frames, at, moved[at, column])
    return result


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


def _fitted(
    sums: Sequence[tuple[FloatArray, FloatArray]], most: int, modes: int, ridge: float
) -> FloatArray:
    """The matrix from coordinates of two frames, and what drives both ends
    of the next interval, to the next frame.

    Args:
        sums: normal equations of each trial.
        most: number of their coordinates.
        modes: number of coordinates of the matrix.
        ridge: over the mean of the diagonal.
    """
    gram, moment = (np.sum(parts, axis=0) for parts in zip(*sums, strict=True))
    kept = np.r_[:modes, most : most + modes, 2 * most : len(gram)]
    gram = gram[np.ix_(kept, kept)]
    # Too few frames predict no motion.
    gram += (ridge * np.trace(gram) / len(gram) or 1.0) * np.eye(len(gram))
    return np.asarray(np.linalg.solve(gram, moment[kept, :modes]))


def _rolled(matrix: FloatArray, starts: FloatArray, driving: FloatArray) -> FloatArray:
    """(R, T, m) coordinates from rest in (R, m) starts; too large ones stay where they are."""
    states = [starts, starts]
    for t in range(driving.shape[1] - 1):
        row = _rows(states[-1][:, None], states[-2][:, None], driving[:, t : t + 2])[:, 0]
        states.append(np.clip(row @ matrix, -_LARGEST, _LARGEST))
    return np.stack(states[1:], 1)
