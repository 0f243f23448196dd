"""Prediction intervals of the models of an experiment, and what would remain of their errors by free fits."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.rigid_bodies import as_markers
from ..io.files import read_array, read_hdf5
from ..learning.baselines import BASELINES
from ..learning.intervals import LEVEL, Covered, Intervals, Predicted, coverage
from ..settings.stages import EvaluateStage
from .experiment import Experiment
from .files import ROLLOUTS, Dataset, read_dataset, since_change
from .free_fits import free_fits
from .models import SIMFREE
from .sensitivity import Sensitivity, sensitivities
from .spread import left_out_changes, parameter_spread
from .without_physics import without_physics

FloatArray = NDArray[np.float64]
Linear = Mapping[str, Mapping[str, Sensitivity]]  # derivatives by model and trial

INTERVAL_MODELS = ("sysid", "law", "simfree", "resphys")  # models with prediction intervals, beside the baselines


def linearised(
    experiment: Experiment, names: Sequence[str], uncertain: bool = False
) -> dict[str, dict[str, Sensitivity]]:
    """Derivatives of trials by the parameters of each model's simulator, see `sensitivities`; empty without markers.

    Args:
        experiment: the experiment.
        names: names of the trials.
        uncertain: whether models are left out whose parameters have no uncertainty.
    """
    own: dict[str, dict[str, Sensitivity]] = {}
    if experiment.dataset.bound is None:
        return own
    made: dict[str, dict[str, Sensitivity]] = {}
    for model in [model for model in INTERVAL_MODELS if model in experiment.models and model != SIMFREE]:
        kind = experiment.sources(model)[0]
        if uncertain and not experiment.identification(model).get("uncertainty"):
            continue
        made[kind] = made[kind] if kind in made else sensitivities(experiment, model, names)
        own[model] = made[kind]
    return own


def spreads_of(
    experiment: Experiment, names: Sequence[str], linear: Linear, left_out: bool = False
) -> dict[str, FloatArray]:
    """Variances (R, T, M) of markers and rigid bodies due to the parameters [m^2], by model, see `parameter_spread`."""
    spreads = {model: parameter_spread(experiment, model, names, own, left_out) for model, own in linear.items()}
    return {model: spread for model, spread in spreads.items() if spread is not None}


def remaining(
    experiment: Experiment, names: Sequence[str], linear: Linear, simulated: Mapping[str, FloatArray]
) -> dict[str, Any]:
    """Entry ``free_fits`` of errors.json, see `free_fits`, by model; empty if nothing could be fitted."""
    observed = dict(zip(names, counted(experiment, names), strict=True))
    fits = {
        model: free_fits(experiment, observed, dict(zip(names, simulated[model][: len(names)], strict=True)), own)
        for model, own in linear.items()
    }
    return {"free_fits": fits} if any(fits.values()) else {}


def intervals_of(
    experiment: Experiment,
    names: Sequence[str],
    calibrating: Mapping[str, FloatArray],
    tested: Mapping[str, FloatArray],
    spreads: Mapping[str, FloatArray],
) -> dict[str, Any]:
    """Prediction intervals by model and their coverage of the test trials, see `learning.intervals`.

    Trials of the training are predicted as if the parameters were identified without them (`left_out_changes`). The
    intervals of a robot, which does not know the variance due to the parameters, are `without_spread`.
    """
    settings, bound = experiment.settings, experiment.dataset.bound
    assert isinstance(settings, EvaluateStage)
    assert bound is not None
    rest = as_markers(bound, experiment.dataset.labels)
    observed = experiment.dataset.observed[experiment.dataset.rows(names)]
    test = settings.groups["1"]
    target = counted(experiment, test)
    predicted = partial(_predicted, experiment.dataset)
    learned = [row for row, name in enumerate(names) if name in settings.split.train]
    observed[learned, experiment.learned_steps(observed.shape[1] - 1) + 1 :] = np.nan  # The rest may be tested.
    models: dict[str, Any] = {}
    simulated, _ = without_physics(experiment, names, left_out=True)
    linear = linearised(experiment, names, uncertain=True)
    changes = {model: left_out_changes(experiment, model, names, own) for model, own in linear.items()}
    simulated |= {m: x if (change := changes.get(m)) is None else x + change for m, x in calibrating.items()}
    calibrating_spreads = spreads_of(experiment, names, linear, left_out=True)
    for model in (model for model in simulated if model in tested):
        trials = predicted(names, [*simulated[model]], [*observed], calibrating_spreads.get(model))
        intervals = Intervals.calibrated(trials, rest)
        if intervals is None:
            continue
        new = predicted(test, [*tested[model]], [*target], spreads.get(model))
        covered = [intervals.covered(trial, rest) for trial in new]
        models[model] = {**intervals.plain(), **coverage(covered), "by_trial": _by_trial(test, covered)}
        alone = Intervals.calibrated([replace(trial, spread=None) for trial in trials], rest)
        models[model] |= {"without_spread": alone.plain()} if model in spreads and alone is not None else {}
    without = any(change is not None for change in changes.values())
    split = "left_out" if without else "training" if learned else "validation"
    return {"intervals": {"level": LEVEL, "calibrated_on": split, "models": models}} if models else {}


def counted(experiment: Experiment, names: Sequence[str]) -> FloatArray:
    """(R, T, M, 3) observed points of tested trials [m], NaN in frames that were used for training."""
    observed = experiment.dataset.observed[experiment.dataset.rows(names)]
    for row, name in enumerate(names):
        if name in experiment.settings.split.train:
            observed[row, : experiment.learned_steps(observed.shape[1] - 1) + 1] = np.nan
    return observed


def intervals_of_folds(dataset: Path, folders: Mapping[str, Path]) -> dict[str, Any]:
    """Prediction intervals of a cross-validation; each fold is calibrated on the test trials of the other folds.

    Args:
        dataset: path of the dataset.
        folders: folders of the folds, by the trial that a fold leaves out.
    """
    data, names = read_dataset(dataset), list(folders)
    if data.bound is None or len(names) < 3:
        return {}
    target, rest = list(data.observed[data.rows(names)]), as_markers(data.bound, data.labels)
    models: dict[str, Any] = {}
    for model in (*BASELINES, *INTERVAL_MODELS):
        simulated, spreads = list[FloatArray](), list[FloatArray]()
        for folder in folders.values():
            with read_hdf5(folder / ROLLOUTS, "rollouts") as file:
                simulated += [read_array(file, f"{model}_observed")[0]] if f"{model}_observed" in file else []
                spreads += [read_array(file, f"{model}_spread")[0]] if f"{model}_spread" in file else []
        if len(simulated) < len(names):
            continue
        trials = _predicted(data, names, simulated, target, spreads if len(spreads) == len(names) else None)
        covered = list[Covered]()
        for out, trial in enumerate(trials):
            intervals = Intervals.calibrated(trials[:out] + trials[out + 1 :], rest)
            covered += [] if intervals is None else [intervals.covered(trial, rest)]
        if len(covered) == len(names):
            models[model] = {**coverage(covered), "by_trial": _by_trial(names, covered)}
    return {"intervals": {"level": LEVEL, "calibrated_on": "folds", "models": models}} if models else {}


def _predicted(
    dataset: Dataset,
    names: Sequence[str],
    simulated: Sequence[FloatArray],
    observed: Sequence[FloatArray],
    spreads: Sequence[FloatArray] | NDArray[np.float64] | None = None,
) -> list[Predicted]:
    """Trials as they were predicted and observed; rigid bodies count as one marker."""
    labels = dataset.labels
    rows = zip(simulated[: len(names)], observed, since_change(dataset, names), strict=True)
    known = [None] * len(names) if spreads is None else spreads
    return [
        Predicted(as_markers(x, labels), as_markers(y, labels), since, spread)
        for (x, y, since), spread in zip(rows, known, strict=True)
    ]


def _by_trial(names: Sequence[str], covered: Sequence[Covered]) -> dict[str, float]:
    """Share of the coordinates inside their interval, by trial in which a marker was seen."""
    return {n: float(own.inside.mean()) for n, own in zip(names, covered, strict=True) if len(own.inside)}
