"""What could explain the errors that remain in test trials: gain and zero of the inputs, or marker places.

Every free quantity is fitted to the trial itself, linearised about the identified model, so that the fits tell where an
error comes from and are no predictions: where a scale of the inputs takes most of an error away, the simulator lacks
physics of the actuator, or the recording does not contain what the actuator did.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.rigid_bodies import as_markers
from .experiment import Experiment
from .sensitivity import Sensitivity, responses

FloatArray = NDArray[np.float64]


def free_fits(
    experiment: Experiment,
    observed: Mapping[str, FloatArray],
    simulated: Mapping[str, FloatArray],
    linear: Mapping[str, Sensitivity],
) -> list[dict[str, Any]]:
    """Returns what would remain of the errors of trials if something were free, by trial.

    The keys of ``left_mm`` and ``values`` are: ``scale`` of the inputs (its change) and their ``zero`` (in their unit),
    common to all of a trial's inputs; and the ``places`` of the markers and the frame of the recordings, which all
    tested trials of a session share. What the trials do not determine is left out.

    Args:
        experiment: the experiment.
        observed: (T, M, 3) markers by trial [m], NaN in frames that do not count.
        simulated: (T, M, 3) predicted markers by trial [m].
        linear: derivatives by trial; those without are left out.
    """
    frames = {name: slice(len(own.points)) for name, own in linear.items()}  # one of a pose
    errors = {n: (simulated[n] - seen)[frames[n]] for n, seen in observed.items() if n in linear}
    errors = {name: error for name, error in errors.items() if np.isfinite(error).any()}
    words = responses(experiment)
    columns = {name: _columns(linear[name], words) for name in errors}
    shared = dict[str, FloatArray]()
    for session in dict.fromkeys(map(experiment.dataset.session, errors)):
        members = [name for name in errors if experiment.dataset.session(name) == session]
        if all("places" in columns[name] for name in members):
            sizes = {name: float(np.sqrt(np.nanmean(np.square(errors[name])))) or 1.0 for name in members}
            parts = (
                [own[n] / sizes[n] for n in members] for own in (errors, {n: columns[n]["places"] for n in members})
            )
            fit = _least(*parts)  # Trials count alike.
            shared |= {} if fit is None else dict.fromkeys(members, fit)
    labels = experiment.dataset.labels
    return [_fitted(name, error, columns[name], shared.get(name), labels) for name, error in errors.items()]


def _columns(linear: Sensitivity, words: Mapping[str, str]) -> dict[str, FloatArray]:
    """Derivatives (T, M, 3, K) by what is free; all inputs move together."""
    columns = {}
    for quantity, word in (("scale", "factor"), ("zero", "zero")):
        if own := [linear.by_parameter[name] for name, other in words.items() if other == word]:
            columns[quantity] = np.sum(own, axis=0)[..., None]
    return columns | ({} if linear.by_placement is None else {"places": linear.by_placement})


def _fitted(
    name: str,
    error: FloatArray,
    columns: Mapping[str, FloatArray],
    shared: FloatArray | None,
    labels: Sequence[str],
) -> dict[str, Any]:
    """Entry of a trial, see `free_fits`, from its errors (T, M, 3) [m] and the places that its session shares."""
    left, values = dict[str, float](), dict[str, float]()
    for quantity, slopes in columns.items():
        if quantity != "places" and (own := _least([error], [slopes])) is not None:
            left[quantity] = _mean(error + slopes @ own, labels)
            values[quantity] = float(own[0])
    left |= {} if shared is None else {"places": _mean(error + columns["places"] @ shared, labels)}
    return {"name": name, "as_is_mm": _mean(error, labels), "left_mm": left, "values": values}


def _least(errors: Sequence[FloatArray], columns: Sequence[FloatArray]) -> FloatArray | None:
    """(K,) values with the least squares of errors (T, M, 3) + columns (T, M, 3, K) values; None if not determined."""
    seen = [np.isfinite(error) & np.isfinite(slopes).all(-1) for error, slopes in zip(errors, columns, strict=True)]
    right = np.concatenate([error[where] for error, where in zip(errors, seen, strict=True)])
    matrix = np.concatenate([slopes[where] for slopes, where in zip(columns, seen, strict=True)])
    if len(right) <= 2 * matrix.shape[1] or not matrix.any():
        return None
    return np.asarray(np.linalg.lstsq(matrix, -right)[0])


def _mean(error: FloatArray, labels: Sequence[str]) -> float:
    """Mean length of errors (T, M, 3) of markers and rigid bodies that were seen [mm]."""
    return float(1e3 * np.nanmean(np.linalg.norm(as_markers(error, labels), axis=-1)))
