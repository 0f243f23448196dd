"""Stages: roll-outs of the test trials by every model, their errors, and how long they take."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, pstdev
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..data.trials import Trials
from ..io.errors import ConvergenceError
from ..io.fan_out import ALONE, Workers
from ..io.files import atomic_hdf5, create, read_array, read_hdf5, write_json
from ..io.progress import Progress
from ..io.stages import StageContext
from ..learning.intervals import LEVEL, Intervals
from ..learning.metrics import errors_per_marker, marker_errors, median_filter, summarise, summarise_each
from ..learning.replay import Start
from ..settings.run import models_of
from ..settings.stages import EvaluateStage, MeshCheckStage, TimeStage
from ..stepping.state import State
from .build import finer
from .experiment import LEARNED, Experiment
from .files import ERRORS, MESH_CHECK, ROLLOUTS, STATIC, TIMES, read_dataset, reconstruction_file
from .models import POSE_STEPS, SIMFREE, ModelRollout, first_frame, learned_of
from .parts import TrialPart, padded, remove_parts, split_into_parts, work_on

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

INTERVAL_MODELS = ("sysid", "simfree", "resphys")  # that have prediction intervals
_FILM_FRAMES = 256  # at most
_FILTERED_SECONDS = 4.0  # that trials must last for the median filter over a second


def evaluate(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes rollouts.h5, what is observed of every model's roll-outs of the test trials, and errors.json."""
    settings: EvaluateStage = context.settings
    experiment, compared = Experiment(settings, context.run_dir, "count"), _models(settings)
    names = [name for group in settings.groups.values() for name in group]
    filmed = _film_trial(experiment, settings.groups["1"])
    parts = _parts(context, experiment, names, compared, filmed)
    with_intervals = [model for model in INTERVAL_MODELS if model in compared]
    calibrating = _parts(context, experiment, settings.calibration, with_intervals, filmed, "calibration_")
    work_on([part for each in (parts, calibrating) for some in each.values() for part in some], _rolled_out, workers)
    order = [name for some in experiment.alike(names) for name in some]
    rows = [order.index(name) for name in names]
    observed = {model: _all_observed(experiment, model, some)[rows] for model, some in parts.items()}
    shown = _film_steps(int(float(experiment.trials([filmed]).times.max()) / settings.time_step + 1e-6))
    attributes = {"names": names, "time_step": settings.time_step, "film_trial": filmed}
    with atomic_hdf5(context.run_dir / ROLLOUTS, "rollouts", attributes) as file:
        for model, values in observed.items():
            create(file, f"{model}_observed", values, "m", time_axis=1)
            bodies = next(part.read("film") for part in parts[model] if filmed in part.names)
            substeps = round(settings.time_step / experiment.model_simulator(model).time_step)
            create(file, f"{model}_film", bodies[np.minimum(substeps * shown, len(bodies) - 1)], "m")
        create(file, "film_steps", shown)
    left = {
        model: np.concatenate([part.read("left")[:, -1] for part in some])[rows]
        for model, some in parts.items()
        if model in LEARNED and settings.range_guard
    }
    found = summary(context, experiment, settings.groups, observed, left)
    if settings.calibration:
        found |= _intervals(experiment, calibrating, observed)
    write_json(context.run_dir / ERRORS, found)
    remove_parts(context)


def _models(settings: EvaluateStage) -> list[str]:
    """The models that are compared."""
    return models_of(settings.published, settings.identified, settings.correct_uncorrected)


def _parts(
    context: StageContext,
    experiment: Experiment,
    names: Sequence[str],
    models: Sequence[str],
    filmed: str,
    label: str = "",
) -> dict[str, list[TrialPart]]:
    """The roll-outs of some trials, by model."""
    found: dict[str, list[TrialPart]] = {model: [] for model in models}
    for number, some in enumerate(experiment.alike(names)):
        for model, parts in found.items():
            rests = POSE_STEPS if model == SIMFREE and experiment.begins(some[0]) == STATIC else 0
            frames = 1 + (
                rests or int(float(experiment.trials(some).times.max()) / experiment.model_simulator(model).time_step)
            )
            parts += split_into_parts(
                context, some, frames, f"{label}{model}{number}", (model, filmed), experiment.settings.batch
            )
    return found


def _all_observed(experiment: Experiment, model: str, parts: Sequence[TrialPart]) -> FloatArray:
    """(R, T, M, 3) what is observed of a model's roll-outs [m], in the order of the parts."""
    return padded([_observed(experiment, model, part) for part in parts], experiment.dataset.observed.shape[1])


def _intervals(
    experiment: Experiment, calibrating: Mapping[str, Sequence[TrialPart]], tested: Mapping[str, FloatArray]
) -> dict[str, Any]:
    """Prediction intervals by model, and how often they hold in the test trials; see `learning.intervals`."""
    settings, rest = experiment.settings, experiment.dataset.bound
    assert isinstance(settings, EvaluateStage)
    assert rest is not None
    names = [name for some in experiment.alike(settings.calibration) for name in some]
    known, target = (
        experiment.dataset.observed[experiment.dataset.rows(names)],
        _counted(experiment, settings.groups["1"]),
    )
    learned = [row for row, name in enumerate(names) if name in settings.split.train]
    known[learned, experiment.learned_steps(known.shape[1] - 1) + 1 :] = np.nan  # The rest may be the test.
    found: dict[str, Any] = {}
    for model, parts in calibrating.items():
        intervals = Intervals.calibrated(list(_all_observed(experiment, model, parts)), list(known), rest)
        if intervals is not None:
            held = intervals.holds(list(tested[model][: len(target)]), list(target), rest)
            found[model] = {**intervals.plain(), **held}
    told = "training" if learned else "validation"
    return {"intervals": {"level": LEVEL, "calibrated_on": told, "models": found}} if found else {}


def _counted(experiment: Experiment, names: Sequence[str]) -> FloatArray:
    """(R, T, M, 3) what was observed in some trials [m], NaN where that was learned from."""
    observed = experiment.dataset.observed[experiment.dataset.rows(names)]
    for row, name in enumerate(names):
        if name in experiment.settings.split.train:
            observed[row, : experiment.learned_steps(observed.shape[1] - 1) + 1] = np.nan
    return observed


def _rolled_out(part: TrialPart) -> ModelRollout:
    """A model over the trials of a part."""
    experiment = Experiment(part.context.settings, part.context.run_dir, "count")
    model, filmed = part.more
    return ModelRollout(experiment, model, part.names, learned_of(experiment, model), filmed=filmed)


def _observed(experiment: Experiment, model: str, part: TrialPart) -> FloatArray:
    """(R, T, M, 3) what is observed of a model's roll-outs at the frames of the trials [m]."""
    series, delay, shift = (torch.from_numpy(part.read(name)) for name in ("points", "delay", "shift"))
    replay = experiment.replay(experiment.model_simulator(model), part.names)
    start = Start(State(series[:, 0], series[:, 0]), delay, shift).to(replay.trials.observed)
    series = (series[:, -1:] if replay.is_static else series).to(replay.trials.observed)
    return np.asarray(replay.at_frames(series, start).cpu().numpy())


def intervals_of_folds(dataset: Path, folders: Mapping[str, Path]) -> dict[str, Any]:
    """The prediction intervals of a cross-validation: those of each fold's model come from what the others left out.

    Args:
        dataset: with the trials.
        folders: of the folds, by the trial that each leaves out.
    """
    data, names = read_dataset(dataset), list(folders)
    if data.bound is None or len(names) < 3:
        return {}
    target = list(data.observed[data.rows(names)])
    found: dict[str, Any] = {}
    for model in INTERVAL_MODELS:
        simulated = []
        for folder in folders.values():
            with read_hdf5(folder / ROLLOUTS, "rollouts") as file:
                simulated += [read_array(file, f"{model}_observed")[0]] if f"{model}_observed" in file else []
        if len(simulated) < len(names):
            continue
        held = []
        for out in range(len(names)):
            others = [[each for row, each in enumerate(all_) if row != out] for all_ in (simulated, target)]
            intervals = Intervals.calibrated(others[0], others[1], data.bound)
            held += [] if intervals is None else [intervals.holds([simulated[out]], [target[out]], data.bound)]
        if len(held) == len(names):
            found[model] = {key: mean(each[key] for each in held) for key in held[0]}
    return {"intervals": {"level": LEVEL, "calibrated_on": "folds", "models": found}} if found else {}


def _film_trial(experiment: Experiment, names: Sequence[str]) -> str:
    """The test trial that moves most; its bodies are drawn."""
    found: dict[str, float] = {}
    for some in experiment.alike(names):
        found |= dict(zip(some, experiment.trials(some).amplitude.tolist(), strict=True))
    return max(names, key=lambda name: found[name])


def _film_steps(steps: int) -> IntArray:
    """Steps whose bodies are kept for pictures."""
    return np.arange(0, steps + 1, max(-(-steps // _FILM_FRAMES), 1))


def summary(
    context: StageContext,
    experiment: Experiment,
    groups: Mapping[str, Sequence[str]],
    simulated: Mapping[str, FloatArray],
    left: Mapping[str, IntArray],
) -> dict[str, Any]:
    """What errors.json says.

    Args:
        context: of the stage.
        experiment: of the experiment.
        groups: names of the trials by pressure scale, the nominal ones first.
        simulated: by model, (R, T, M, 3) what is observed of its roll-outs [m], NaN where one diverged.
        left: by model, (R,) the step at which a trial left the range of the training, or -1.
    """
    settings, dataset = experiment.settings, experiment.dataset
    assert isinstance(settings, EvaluateStage)
    names, every = groups["1"], [name for group in groups.values() for name in group]
    count, step = len(names), settings.time_step
    observed = _counted(experiment, every)
    first = [first_frame(experiment, [name]) for name in every]
    models = dict(simulated)
    if dataset.bound is None:
        models["reconstruction"] = _reconstructed(context, names)
    test = {model: values[:count] for model, values in models.items()}
    errors = {model: _errors(x, observed, first) for model, x in test.items()}
    found: dict[str, Any] = {
        "errors_mm": {model: summarise(rows) for model, rows in errors.items()},
        "per_trajectory": summarise_each(tuple(names), errors),
    }
    if dataset.bound is None:
        target = test["reconstruction"]
        against = {model: _errors(x, target, first) for model, x in test.items() if model != "reconstruction"}
        found["errors_vs_reconstruction_mm"] = {model: summarise(rows) for model, rows in against.items()}
    else:
        seen = observed[:count]
        found["per_marker"] = {model: errors_per_marker(x, seen, dataset.labels) for model, x in test.items()}
    found |= _over_time(settings, test, observed, errors)
    if left:
        found["range"] = {model: _range(rows[:count], names, step) for model, rows in left.items()}
    if len(groups) > 1:
        at = {scale: slice(i * count, (i + 1) * count) for i, scale in enumerate(groups)}
        found["scales"] = {
            scale: {m: summarise(_errors(x[rows], observed[rows], first)) for m, x in simulated.items()}
            for scale, rows in at.items()
        }
        if left:
            found["scales_range"] = {
                scale: {m: _range(each[rows], groups[scale], step) for m, each in left.items()}
                for scale, rows in at.items()
            }
    sideways = _sideways(experiment, names)
    return {**found, **({"sideways_mm": sideways} if sideways else {})}


def _errors(simulated: FloatArray, observed: FloatArray, first: Sequence[int]) -> list[FloatArray]:
    each = zip(simulated, observed, first, strict=False)
    return [marker_errors(x[start:], y[start:]) for x, y, start in each]


def _reconstructed(context: StageContext, names: Sequence[str]) -> FloatArray:
    """(R, T, N, 3) positions of the test trials with the forces that fit them [m]."""
    with read_hdf5(context.run_dir / reconstruction_file("resphys"), "reconstruction") as file:
        order = [str(name) for name in file.attrs["names"]]
        return read_array(file, "q")[[order.index(name) for name in names]]


def _over_time(
    settings: EvaluateStage,
    test: Mapping[str, FloatArray],
    observed: FloatArray,
    errors: Mapping[str, Sequence[FloatArray]],
) -> dict[str, Any]:
    """Errors up to horizons, how they grow, and the largest of long trials without what is short."""
    step, horizons = settings.time_step, settings.horizons
    found: dict[str, Any] = {}
    if horizons:
        first = [0] * len(observed)
        found["horizons"] = {
            f"{seconds:g}": {m: summarise(_errors(x[:, :frames], observed[:, :frames], first)) for m, x in test.items()}
            for seconds in horizons
            for frames in [round(seconds / step) + 1]
        }
    if len(horizons) > 1:
        near, far = (found["horizons"][f"{seconds:g}"] for seconds in (horizons[0], horizons[-1]))
        found["growth"] = {model: _growth(near[model], far[model]) for model in test}
    if horizons and horizons[-1] >= _FILTERED_SECONDS:
        found["median_filtered"] = {model: _largest_filtered(rows, step) for model, rows in errors.items()}
    return found


def _largest_filtered(errors: Sequence[FloatArray], step: float) -> float | None:
    """Largest error of any trial after a median over a second of time [mm]; None where a roll-out diverged."""
    diverged = not all(np.isfinite(each).all() for each in errors)
    return None if diverged else max(float(median_filter(each, step).max()) for each in errors)


def _growth(first: Mapping[str, Any], last: Mapping[str, Any]) -> float | None:
    """By how much of itself the mean error grows; None where a roll-out diverged."""
    return None if None in (first["mean"], last["mean"]) else float(last["mean"] / first["mean"] - 1.0)


def _range(left: IntArray, names: Sequence[str], step: float) -> dict[str, Any]:
    gone = {name: float(step * at) for name, at in zip(names, left, strict=True) if at >= 0}
    return {"left": len(gone), "first_s": gone}


def _sideways(experiment: Experiment, names: Sequence[str]) -> dict[str, float]:
    """How far sideways bodies were held [mm], as the identified simulator has it, where that was estimated."""
    if experiment.settings.release.sideways <= 0.0:
        return {}
    simulator = experiment.model_simulator("resphys")
    found: dict[str, float] = {}
    for some in experiment.alike(names):
        if experiment.begins(some[0]) != "released":
            continue
        shift = experiment.start(experiment.replay(simulator, some, "resphys")).shift
        if shift is not None:
            found |= dict(zip(some, (1e3 * shift.norm(dim=2).mean(1)).tolist(), strict=True))
    return found


def time_models(context: StageContext) -> None:
    """Writes times.json: seconds a test trial, mean and standard deviation over the trials.

    The published table's rows: the uncorrected simulator, the simulator with the true parameters where these are known,
    the simulator with the learned force, and the network alone. One trial at a time, each once, after a run of the
    first to warm up.
    """
    settings: TimeStage = context.settings
    experiment = Experiment(settings, context.run_dir, "count")
    names = experiment.moving(settings.groups["1"])
    simulator = experiment.model_simulator("resphys")
    learned = learned_of(experiment, "resphys")
    starts = {name: experiment.start(experiment.replay(simulator, [name], "resphys")) for name in names}
    rows: dict[str, tuple[str, Any, Any]] = {"simulation": ("simulation", None, experiment.simulator("simulation"))}
    if settings.target is not None:
        rows["target"] = ("simulation", None, experiment.simulator("target"))
    rows |= {"resphys": ("resphys", learned, simulator), "inference": ("resphys", learned, simulator)}
    times: dict[str, dict[str, float]] = {}
    steps = 0
    with Progress(context.name, len(rows) * len(names), "trials") as progress, torch.no_grad():
        for row, (model, known, stepping) in rows.items():
            runs = [ModelRollout(experiment, model, [name], known, starts[name], stepping) for name in names]
            seconds = []
            for run in (runs[0], *runs):
                state, steps = run.begin(), run.frames - 1
                predictor, before = run.predictor, time.perf_counter()
                for step in range(steps):
                    if row == "inference" and predictor is not None:
                        predictor(state, step)
                    else:
                        state = run.rollout.step(state)
                seconds.append(time.perf_counter() - before)
            progress.advance(len(names))
            times[row] = {"mean": mean(seconds[1:]), "std": pstdev(seconds[1:])}
    write_json(context.run_dir / TIMES, {"steps": steps, "seconds": times})


def check_mesh(context: StageContext) -> None:
    """Writes mesh_check.json: what a finer mesh changes in what the simulator to correct makes of the test trials.

    Its constants stay those that were identified on the mesh as it is.
    """
    settings: MeshCheckStage = context.settings
    other = settings.model_copy(update={"mesh": finer(settings.mesh, settings.mesh_check)})
    experiments = [Experiment(each, context.run_dir) for each in (settings, other)]
    model = "simulation" if settings.identified is None else "sysid"
    groups = experiments[0].alike(settings.groups["1"])
    found: dict[str, Any] = {"cells": [len(each.body.mesh.cells) for each in experiments], "model": model}
    errors: list[list[FloatArray]] = [[], []]
    moved: list[FloatArray] = []
    with Progress(context.name, 2 * sum(map(len, groups)), "trials") as progress:
        try:
            for names in groups:
                shown = []
                for experiment, each in zip(experiments, errors, strict=True):
                    markers, trials = _simulated(experiment, model, names)
                    seen = trials.seen.cpu().numpy()
                    each += _distances(markers, trials.observed.cpu().numpy(), seen)
                    shown.append(markers)
                    progress.advance(len(names))
                moved += _distances(shown[0], shown[1], seen)
        except ConvergenceError as error:
            found["failed"] = str(error)
        else:
            found["moved_mm"] = float(np.mean([each.mean() for each in moved]))
            found["errors_mm"] = [float(np.mean([each.mean() for each in some])) for some in errors]
    write_json(context.run_dir / MESH_CHECK, found)


def _simulated(experiment: Experiment, model: str, names: Sequence[str]) -> tuple[FloatArray, Trials]:
    """(R, T, M, 3) markers of trials that begin alike, by a model without a force [m], and what was observed."""
    replay = experiment.replay(experiment.model_simulator(model), names, model)
    with torch.no_grad():
        markers = replay(experiment.start(replay, model), experiment.parameters(model))[0]
    return np.asarray(markers.cpu().numpy()), replay.trials


def _distances(left: FloatArray, right: FloatArray, seen: NDArray[np.bool_]) -> list[FloatArray]:
    """By trial, the distances of (R, T, M, 3) markers that were seen [mm]."""
    return [1e3 * np.linalg.norm(a - b, axis=-1)[s] for a, b, s in zip(left, right, seen, strict=True)]
