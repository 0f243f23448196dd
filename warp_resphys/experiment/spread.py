"""How uncertain predicted markers are because the identified parameters are."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..learning.parameters import own_name
from .experiment import Experiment
from .sensitivity import Sensitivity

FloatArray = NDArray[np.float64]


def parameter_spread(
    experiment: Experiment, model: str, names: Sequence[str], linear: Mapping[str, Sensitivity]
) -> FloatArray | None:
    """Returns the variance of predicted markers under the posterior of a model's identified parameters.

    The variance is to first order, J S J^T with the derivatives J of the markers by the parameters and the covariance S
    of these, so that it grows with the distance from the trials that determine them. In a session without identified
    trials, the prior of the marker places adds its variance. The ranges of the parameters limit their covariance.

    Args:
        experiment: the experiment.
        model: with identified parameters.
        names: names of the R trials; those without derivatives have no spread.
        linear: derivatives by trial, from `sensitivities`.

    Returns:
        Means (R, T, M) over the coordinates [m^2]; None if the uncertainty of the parameters is not known.
    """
    identified = experiment.identification(model)
    uncertainty, placement = identified.get("uncertainty"), identified.get("placement") or {}
    if uncertainty is None:
        return None
    parameters, own = [*uncertainty["deviation"]], identified.get("own_deviation", {})
    ranges = [uncertainty.get("ranges", {}).get(name, np.inf) for name in parameters]
    spread = np.zeros((len(names), *experiment.dataset.observed.shape[1:3]))
    for row, name in enumerate(names):
        if name in linear:
            deviation = np.array([uncertainty["deviation"][parameter] for parameter in parameters])
            correlation = np.array(uncertainty["correlation"])
            session = experiment.dataset.session(name)
            for at, parameter in enumerate(parameters):
                of_trial = (own.get(own_name(parameter, owner)) for owner in (name, session))
                if (known := next((value for value in of_trial if value is not None), None)) is not None:
                    deviation[at], correlation[at], correlation[:, at] = known, 0.0, 0.0
                    correlation[at, at] = 1.0
            root = deviation[:, None] * _root(correlation, deviation / ranges)
            slopes = np.stack([linear[name].by_parameter[parameter] for parameter in parameters])
            moved = np.einsum("eTmc,ei->iTmc", slopes, root)
            spread[row, : moved.shape[1]] = np.nan_to_num(np.square(moved).sum(0).mean(-1))
        if "sessions" in placement and experiment.dataset.session(name) not in placement["sessions"]:
            spread[row] += sum(size**2 for size in placement["prior"])
    return spread


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
