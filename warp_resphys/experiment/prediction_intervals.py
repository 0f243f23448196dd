"""Prediction intervals of the models of an experiment, and what would remain of their errors by free fits."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..data.driving import since_change
from ..data.rigid_bodies import as_markers
from ..data.trials import Trials
from ..io.arrays import FloatArray
from ..io.safe_files import read_array, read_hdf5
from ..learning.baselines import BASELINES
from ..learning.error_tables import counted
from ..learning.identification.sensitivity import (
    Sensitivity,
    free_fits,
    left_out_changes,
    parameter_spread,
    sensitivities,
)
from ..learning.intervals import LEVEL, Intervals, Predicted, coverage
from ..learning.without_physics import without_physics
from .experiment import SIMFREE, Experiment
from .files import ROLLOUTS

Linear = Mapping[str, Mapping[str, Sensitivity]]  # derivatives by model and trial

INTERVAL_MODELS = ("sysid", "law", "simfree", "resphys")  # models with prediction intervals, beside the baselines


def linearised(experiment: Experiment, names: Sequence[str], uncertain: bool = False) -> Linear:
    """Derivatives of trials by the parameters of each model's simulator, see `sensitivities`; empty without markers.

    Args:
        experiment: the experiment.
        names: names of the trials.
        uncertain: whether models are left out whose parameters have no uncertainty.
    """
    made: dict[str, dict[str, Sensitivity]] = {}
    own: dict[str, dict[str, Sensitivity]] = {}
    for model in INTERVAL_MODELS if experiment.dataset.bound is not None else ():
        if model == SIMFREE or model not in experiment.models:
            continue
        identified = experiment.identified(model)
        if not uncertain or identified.uncertainty is not None:
            kind, simulator = experiment.sources(model)[0], experiment.model_simulator(model)
            if kind not in made:
                batch = experiment.settings.batch
                made[kind] = sensitivities(simulator, experiment.motions, names, identified, batch)
            own[model] = made[kind]
    return own


def spreads_of(
    experiment: Experiment, names: Sequence[str], linear: Linear, left_out: bool = False
) -> dict[str, FloatArray]:
    """Variances (R, T, M) of markers and rigid bodies due to the parameters [m^2], by model, see `parameter_spread`."""
    dataset, identified = experiment.dataset, experiment.identified
    spreads = {m: parameter_spread(dataset, names, identified(m), own, left_out) for m, own in linear.items()}
    return {model: spread for model, spread in spreads.items() if spread is not None}


def remaining(
    experiment: Experiment, names: Sequence[str], linear: Linear, simulated: Mapping[str, FloatArray]
) -> dict[str, Any]:
    """Entry ``free_fits`` of errors.json, see `free_fits`, by model; empty if nothing could be fitted."""
    observed = dict(zip(names, counted(experiment.motions, experiment.settings.split.train, names), strict=True))
    fits = {}
    for model, own in linear.items():
        predicted = dict(zip(names, simulated[model][: len(names)], strict=True))
        fits[model] = free_fits(experiment.dataset, observed, predicted, own)
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
    settings, dataset = experiment.settings, experiment.dataset
    test, observed = settings.groups["1"], dataset.observed[dataset.rows(names)]
    target, rest = counted(experiment.motions, settings.split.train, test), _rest(dataset)
    learned = [row for row, name in enumerate(names) if name in settings.split.train]
    observed[learned, experiment.motions.learned_steps(observed.shape[1] - 1) + 1 :] = np.nan  # The rest may be tested.
    linear = linearised(experiment, names, uncertain=True)
    changes = {m: left_out_changes(dataset, names, experiment.identified(m), own) for m, own in linear.items()}
    simulated, *_ = without_physics(experiment.motions, names, settings.split.train, left_out=True)
    simulated |= {m: x if (change := changes.get(m)) is None else x + change for m, x in calibrating.items()}
    calibrating_spreads = spreads_of(experiment, names, linear, left_out=True)
    models: dict[str, Any] = {}
    for model in (model for model in simulated if model in tested):
        trials = _predicted(dataset, names, simulated[model], observed, calibrating_spreads.get(model))
        if (intervals := Intervals.calibrated(trials, rest)) is None:
            continue
        new = _predicted(dataset, test, tested[model][: len(test)], target, spreads.get(model))
        models[model] = {**intervals.plain(), **coverage({n: intervals.covered(t, rest) for n, t in new.items()})}
        alone = Intervals.calibrated({name: replace(trial, spread=None) for name, trial in trials.items()}, rest)
        models[model] |= {"without_spread": alone.plain()} if model in spreads and alone is not None else {}
    without = any(change is not None for change in changes.values())
    split = "left_out" if without else "training" if learned else "validation"
    return {"intervals": {"level": LEVEL, "calibrated_on": split, "models": models}} if models else {}


def intervals_of_folds(dataset: Path, folders: Mapping[str, Path]) -> dict[str, Any]:
    """Prediction intervals of a cross-validation; each fold is calibrated on the test trials of the other folds.

    Args:
        dataset: path of the dataset.
        folders: folders of the folds, by the trial that a fold leaves out.
    """
    data, names, models = Trials.read(dataset), list(folders), dict[str, Any]()
    if data.bound is None or len(names) < 3:
        return {}
    for model in (*BASELINES, *INTERVAL_MODELS):
        series: dict[str, list[FloatArray]] = {"observed": [], "spread": []}
        for folder in folders.values():
            with read_hdf5(folder / ROLLOUTS, "rollouts") as file:
                for key, rows in series.items():
                    rows += [read_array(file, f"{model}_{key}")[0]] if f"{model}_{key}" in file else []
        if len(series["observed"]) < len(names):
            continue
        spreads = series["spread"] if len(series["spread"]) == len(names) else None
        trials = _predicted(data, names, series["observed"], data.observed[data.rows(names)], spreads)
        covered = {}
        for out, trial in trials.items():
            others = {name: other for name, other in trials.items() if name != out}
            if (intervals := Intervals.calibrated(others, _rest(data))) is not None:
                covered[out] = intervals.covered(trial, _rest(data))
        if len(covered) == len(names):
            models[model] = coverage(covered)
    return {"intervals": {"level": LEVEL, "calibrated_on": "folds", "models": models}} if models else {}


def half_widths_of(
    dataset: Trials,
    names: Sequence[str],
    errors: Mapping[str, Any],
    simulated: Mapping[str, FloatArray],
    spreads: Mapping[str, FloatArray],
) -> dict[str, FloatArray]:
    """Half-widths (R, T, M) of the intervals of markers and rigid bodies [m], by model that has intervals.

    Args:
        dataset: with the trials.
        names: names of R trials.
        errors: content of errors.json.
        simulated: (R, T, M, 3) [m] by model.
        spreads: (R, T, M) variances due to the parameters [m^2], by model.
    """
    known = {m: Intervals.from_plain(own) for m, own in errors.get("intervals", {}).get("models", {}).items()}
    since = since_change(dataset, names)
    return {
        model: own.half_widths(as_markers(simulated[model], dataset.labels), _rest(dataset), since, spreads.get(model))
        for model, own in known.items()
        if own is not None and model in simulated
    }


def _rest(dataset: Trials) -> FloatArray:
    """(M, 3) markers on the undeformed body [m]; a rigid body is one."""
    assert dataset.bound is not None
    return as_markers(dataset.bound, dataset.labels)


def _predicted(
    dataset: Trials,
    names: Sequence[str],
    simulated: Sequence[FloatArray] | FloatArray,
    observed: FloatArray,
    spreads: Sequence[FloatArray] | FloatArray | None = None,
) -> dict[str, Predicted]:
    """Trials as they were predicted and observed; rigid bodies count as one marker."""
    known = [None] * len(names) if spreads is None else spreads
    rows = zip(names, simulated, observed, since_change(dataset, names), known, strict=True)
    return {
        name: Predicted(as_markers(x, dataset.labels), as_markers(y, dataset.labels), since, spread)
        for name, x, y, since, spread in rows
    }
