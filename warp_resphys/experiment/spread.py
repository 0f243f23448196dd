"""How uncertain predicted markers are because the identified parameters are, and predictions without a trial."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..data.rigid_bodies import as_markers, owners
from ..learning.parameters import own_name
from .experiment import Experiment
from .sensitivity import Sensitivity

FloatArray = NDArray[np.float64]


def parameter_spread(
    experiment: Experiment, model: str, names: Sequence[str], linear: Mapping[str, Sensitivity], left_out: bool = False
) -> FloatArray | None:
    """Returns the variance of predicted markers under the posterior of a model's identified parameters.

    The variance is to first order, J S J^T with the derivatives J of the markers by the parameters and the covariance S
    of these, so that it grows with the distance from the trials that determine them. In a session without identified
    trials, the prior of its placement adds its variance. The ranges of the parameters limit their covariance.

    Args:
        experiment: the experiment.
        model: with identified parameters.
        names: names of the R trials; those without derivatives have no spread.
        linear: derivatives by trial, from `sensitivities`.
        left_out: whether the posterior of a trial that was identified from is that without it.

    Returns:
        Means (R, T, M) over the coordinates, of markers and of the positions of rigid bodies [m^2]; None if the
        uncertainty of the parameters is not known.
    """
    identified = experiment.identification(model)
    uncertainty, placement = identified.get("uncertainty"), identified.get("placement") or {}
    if uncertainty is None:
        return None
    parameters, own = [*uncertainty["deviation"]], identified.get("own_deviation", {})
    ranges = [uncertainty.get("ranges", {}).get(name, np.inf) for name in parameters]
    labels = experiment.dataset.labels
    spread = np.zeros((len(names), experiment.dataset.observed.shape[1], len(owners(labels))))
    for row, name in enumerate(names):
        if name in linear:
            posterior = uncertainty.get("left_out", {}).get(name, uncertainty) if left_out else uncertainty
            deviation = np.array([posterior["deviation"][parameter] for parameter in parameters])
            correlation = np.array(posterior["correlation"])
            session = experiment.dataset.session(name)
            for at, parameter in enumerate(parameters):
                of_trial = (own.get(own_name(parameter, owner)) for owner in (name, session))
                if (known := next((value for value in of_trial if value is not None), None)) is not None:
                    deviation[at], correlation[at], correlation[:, at] = known, 0.0, 0.0
                    correlation[at, at] = 1.0
            root = deviation[:, None] * _root(correlation, deviation / ranges)
            slopes = np.stack([linear[name].by_parameter[parameter] for parameter in parameters])
            moved = as_markers(np.einsum("eTmc,ei->iTmc", slopes, root), labels)
            spread[row, : moved.shape[1]] = np.nan_to_num(np.square(moved).sum(0).mean(-1))
            places = linear[name].by_placement
            if "sessions" in placement and session not in placement["sessions"] and places is not None:
                moved = as_markers(places @ np.array(placement["new_session"]), labels, -3)
                spread[row, : len(moved)] += np.nan_to_num(np.square(moved).sum(-1).mean(-1))
    return spread


def left_out_changes(
    experiment: Experiment, model: str, names: Sequence[str], linear: Mapping[str, Sensitivity]
) -> FloatArray | None:
    """Returns by what predictions of trials change if a model's parameters are identified without them, to first order.

    Args:
        experiment: the experiment.
        model: with identified parameters.
        names: names of the R trials; those from which nothing was identified do not change.
        linear: derivatives by trial, from `sensitivities`.

    Returns:
        (R, T, M, 3) [m]; None if no trial changes.
    """
    left_out = (experiment.identification(model).get("uncertainty") or {}).get("left_out", {})
    changes = np.zeros((len(names), *experiment.dataset.observed.shape[1:]))
    used = [
        (row, linear[name], left_out[name]) for row, name in enumerate(names) if name in left_out and name in linear
    ]
    for row, slopes, without in used:
        count = len(slopes.points)
        changes[row, :count] = sum(slopes.by_parameter[name] * change for name, change in without["change"].items())
        if without["placement"] is not None and slopes.by_placement is not None:
            changes[row, :count] += slopes.by_placement @ np.array(without["placement"])
    return changes if used else None


def _root(correlation: FloatArray, shares: FloatArray) -> FloatArray:
    """R with R R^T the covariance of parameters over their standard deviations, which their ranges limit.

    A range counts as a normal distribution of the variance of a uniform one: where the data leave a parameter open, the
    linearised posterior would reach far beyond it.

    Args:
        correlation: (P, P) of the posterior.
        shares: (P,) standard deviations over the ranges.
    """
    limited = np.linalg.solve(np.eye(len(shares)) + correlation * (12.0 * shares**2), correlation)
    sizes, vectors = np.linalg.eigh(0.5 * (limited + limited.T))
    return np.asarray(vectors * np.sqrt(np.maximum(sizes, 0.0)))
