"""How uncertain predicted markers are because the identified parameters are."""

import logging
from collections.abc import Sequence

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray

from ..io.errors import ConvergenceError, listed
from ..io.progress import Progress
from ..learning.parameters import split_name
from .experiment import Experiment

log = logging.getLogger(__name__)

FloatArray = NDArray[np.float64]

_DIFFERENCE = 1e-3  # of a parameter, for derivatives, over its standard deviation


def parameter_spread(experiment: Experiment, model: str, names: Sequence[str]) -> FloatArray | None:
    """Returns the variance of predicted markers under the posterior of a model's identified parameters.

    The variance is to first order, J S J^T with the derivatives J of the markers by the parameters and the covariance S
    of these, so that it grows with the distance from the trials that determine them. In a session without identified
    trials, the prior of the marker places adds its variance; values of single trials add theirs. The ranges of the
    parameters limit their covariance.

    Args:
        experiment: the experiment; trials that cannot be simulated have no spread, which a warning says.
        model: with identified parameters.
        names: names of the R trials.

    Returns:
        Means (R, T, M) over the coordinates [m^2]; None if the uncertainty of the parameters is not known.
    """
    identified = experiment.identification(model)
    uncertainty = identified.get("uncertainty")
    if uncertainty is None:
        return None
    values, parameters = identified["parameters"], [*uncertainty["deviation"]]
    own, placement = identified.get("own", {}), identified.get("placement") or {}
    own_deviation = identified.get("own_deviation", {})
    apart = [*dict.fromkeys(split_name(name)[0] for name in own_deviation)]  # of which trials have their own values
    deviation = np.array([uncertainty["deviation"][name] for name in parameters])
    ranges = uncertainty.get("ranges", {})
    root = _root(np.array(uncertainty["correlation"]), deviation / [ranges.get(name, np.inf) for name in parameters])
    root = scipy.linalg.block_diag(root, np.eye(len(apart)))
    spread = np.zeros((len(names), *experiment.dataset.observed.shape[1:3]))
    with Progress("evaluate: uncertainty of the parameters", len(names), "trials") as progress, torch.no_grad():
        for whole in experiment.batches(names):
            size = experiment.settings.batch or len(whole)
            for batch in (whole[first : first + size] for first in range(0, len(whole), size)):
                replay = experiment.replay(experiment.model_simulator(model), batch, model)
                start = experiment.start(replay, model)
                steps = np.zeros((1 + len(root), len(parameters)))
                steps[1 : 1 + len(parameters)] = _DIFFERENCE * np.diag(deviation)
                sets = {}
                for name, value in own.items():
                    moves = np.zeros(len(steps))
                    if name in own_deviation:
                        moves[1 + len(parameters) + apart.index(split_name(name)[0])] = _DIFFERENCE
                    sets[name] = replay.simulator.tensor(value + moves * own_deviation.get(name, 0.0))
                sets |= {
                    name: replay.simulator.tensor(np.full(len(steps), values[name]) + steps[:, column])
                    for column, name in enumerate(parameters)
                }
                try:
                    points = (replay if replay.is_static else replay.varied)(start, sets).double().cpu().numpy()
                except ConvergenceError as error:
                    log.warning("evaluate: the posterior does not widen the intervals of %s: %s", listed(batch), error)
                    points = np.zeros((len(steps), *spread[: len(batch)].shape, 3))
                moved = np.einsum("erTmc,ei->irTmc", (points[1:] - points[:1]) / _DIFFERENCE, root)
                rows = [names.index(name) for name in batch]
                spread[rows, : points.shape[2]] = np.nan_to_num(np.square(moved).sum(0).mean(-1))
                if "sessions" in placement and experiment.dataset.session(batch[0]) not in placement["sessions"]:
                    spread[rows] += sum(size**2 for size in placement["prior"])
                progress.advance(len(batch))
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
