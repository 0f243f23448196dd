"""Stages: roll-outs of the test trials with every model, their errors and their computing time."""

import math
import time
from collections.abc import Mapping, Sequence
from itertools import chain
from statistics import mean, pstdev
from typing import Any

import numpy as np
import torch

from ..data.rigid_bodies import angles, as_markers, corners_of, owners
from ..data.trials import STATIC, Trials
from ..dynamics.simulator import Simulator
from ..io.arrays import FloatArray, IntArray
from ..io.errors import ConvergenceError, InputError
from ..io.fan_out import ALONE, Workers
from ..io.files import atomic_hdf5, create, read_array, read_hdf5, write_json
from ..io.parts import Parts, TrialPart
from ..io.progress import Progress
from ..io.stages import StageContext
from ..learning.correction import Learned
from ..learning.evaluation import TrialRollout, first_frame, rollout_parts
from ..learning.metrics import PHASES, errors_per_marker, marker_errors, summarise, summarise_trajectories
from ..learning.replay import Replay
from ..settings.stages import StageSettings
from .build import finer
from .checks import check_memory
from .experiment import LEARNED, Experiment
from .files import ERRORS, MESH_CHECK, ROLLOUTS, TIMES, first_change, phases_of, reconstruction_file
from .prediction_intervals import INTERVAL_MODELS, counted, intervals_of, linearised, remaining, spreads_of
from .without_physics import without_physics

_FILM_FRAMES = 256  # maximum
CHECKED_SECONDS, _CHECKED_POSES = 0.5, 3  # that are simulated with a finer mesh
_WARM_UP = 20  # steps before computing times are measured


def evaluate(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes rollouts.h5, the observed points of every model's roll-outs of the test trials, and errors.json."""
    settings: StageSettings = context.settings
    experiment = Experiment(settings, context.run_dir, "count")
    compared = experiment.models
    names = [name for group in settings.groups.values() for name in group]
    amplitudes = _amplitudes(experiment, settings.groups["1"])
    filmed = max(amplitudes, key=lambda name: amplitudes[name])  # the largest motion

    def roll_out(model: str, names: Sequence[str], label: str) -> list[TrialPart]:
        made = experiment.model_simulator(model), experiment.motions, names, experiment.learned(model)
        return rollout_parts(*made, experiment.identified(model), settings.batch, filmed, f"{label}{model}")

    with_intervals = [model for model in INTERVAL_MODELS if model in compared]
    cut_up = {model: roll_out(model, names, "") for model in compared}
    calibrating = {model: roll_out(model, settings.calibration, "calibration_") for model in with_intervals}
    parts = Parts.of(context, workers)
    parts.run([*chain(*cut_up.values(), *calibrating.values())])
    order = [*chain(*experiment.dataset.batches(names))]
    rows = [order.index(name) for name in names]
    observed, plain, missing = without_physics(experiment, names)
    frames = experiment.dataset.observed.shape[1]
    observed |= {model: parts.joined(own, "observed", frames)[rows] for model, own in cut_up.items()}
    test = settings.groups["1"]
    linear = linearised(experiment, test)
    spreads = spreads_of(experiment, test, linear)
    steps = int(experiment.dataset.seconds([filmed]) / settings.time_step + 1e-6)
    shown = np.arange(0, steps + 1, max(-(-steps // _FILM_FRAMES), 1))
    attributes = {"names": names, "time_step": settings.time_step, "film_trial": filmed}
    with atomic_hdf5(context.run_dir / ROLLOUTS, "rollouts", attributes) as file:
        for model, values in observed.items():
            create(file, f"{model}_observed", values, "m", time_axis=1)
            if model not in cut_up:
                continue
            bodies = next(parts.read(part, "film") for part in cut_up[model] if filmed in part.names)
            substeps = round(settings.time_step / experiment.model_simulator(model).time_step)
            create(file, f"{model}_film", bodies[np.minimum(substeps * shown, len(bodies) - 1)], "m")
        create(file, "film_steps", shown)
        for model, spread in spreads.items():
            create(file, f"{model}_spread", spread, "m^2", time_axis=1)
    left = {
        model: np.concatenate([parts.read(part, "left") for part in own])[rows]
        for model, own in cut_up.items()
        if model in LEARNED and settings.range_guard
    }
    errors = summary(context, experiment, settings.groups, observed, left) | {"baselines": plain}
    errors |= {"missing_baselines": missing} if missing else {}
    sideways = np.concatenate([parts.read(part, "sideways") for part in cut_up["resphys"]])
    if known := {name: size for name, size in zip(order, sideways.tolist(), strict=True) if math.isfinite(size)}:
        errors["sideways_mm"] = {name: known[name] for name in test if name in known}
    errors |= remaining(experiment, test, linear, observed)
    if settings.calibration:
        calibrated = [*chain(*experiment.dataset.batches(settings.calibration))]
        known = {model: parts.joined(own, "observed", frames) for model, own in calibrating.items()}
        errors |= intervals_of(experiment, calibrated, known, observed, spreads)
    write_json(context.run_dir / ERRORS, errors)
    parts.remove()


def _amplitudes(experiment: Experiment, names: Sequence[str]) -> dict[str, float]:
    """Root mean square displacement of the observed points [m], by trial."""
    amplitudes, dataset = dict[str, float](), experiment.dataset
    for name, row in zip(names, dataset.rows(names), strict=True):
        frames = slice(1 if dataset.begin_of(name) == STATIC else None)
        shown, held = (as_markers(own, dataset.labels) for own in (dataset.observed[row, frames], dataset.held[row]))
        amplitudes[name] = float(np.sqrt(np.nanmean(np.square(shown - held).sum(-1))))
    return amplitudes


def summary(
    context: StageContext,
    experiment: Experiment,
    groups: Mapping[str, Sequence[str]],
    simulated: Mapping[str, FloatArray],
    left: Mapping[str, IntArray],
) -> dict[str, Any]:
    """Contents of errors.json; a rigid body counts as one marker, and has errors of its orientation as well.

    Args:
        context: context of the stage.
        experiment: the experiment.
        groups: names of the trials by input scale, original inputs first.
        simulated: by model, (R, T, M, 3) observed points of its roll-outs [m], NaN where a roll-out diverged.
        left: by model, (R,) the step at which a trial left the training range, or -1.
    """
    settings, dataset = experiment.settings, experiment.dataset
    names, every = groups["1"], [name for group in groups.values() for name in group]
    count, step = len(names), settings.time_step
    points = counted(experiment, every)
    observed = as_markers(points, dataset.labels)
    first = [first_frame(dataset, [name]) for name in every]
    models = {model: as_markers(values, dataset.labels) for model, values in simulated.items()}
    if dataset.bound is None and not settings.with_law:
        models["reconstruction"] = _reconstructed(context, names)
    test = {model: values[:count] for model, values in models.items()}
    errors = {model: _errors(x, observed, first) for model, x in test.items()}
    amplitudes = {name: 1e3 * size for name, size in _amplitudes(experiment, names).items()}
    content: dict[str, Any] = {
        "errors_mm": {model: summarise(rows) for model, rows in errors.items()},
        "per_trajectory": [
            {**row, "amplitude_mm": amplitudes[row["name"]]} for row in summarise_trajectories(tuple(names), errors)
        ],
    }
    if "reconstruction" in test:
        target = test["reconstruction"]
        against = {model: _errors(x, target, first) for model, x in test.items() if model != "reconstruction"}
        content["errors_vs_reconstruction_mm"] = {model: summarise(rows) for model, rows in against.items()}
    if dataset.bound is not None:
        seen = observed[:count]
        labels = owners(dataset.labels)
        content["per_marker"] = {model: errors_per_marker(x, seen, labels) for model, x in test.items()}
    if bodies := corners_of(dataset.labels):
        content["orientations_deg"] = {
            model: {name: _mean_angle(x[:count, :, own], points[:count, :, own]) for name, own in bodies.items()}
            for model, x in simulated.items()
        }
    content |= _by_horizon(settings, test, observed) | _by_phase(dataset, names, test, observed)
    if left:
        content["range"] = {model: _range(rows[:count], names, step) for model, rows in left.items()}
    if len(groups) > 1:
        at = {scale: slice(i * count, (i + 1) * count) for i, scale in enumerate(groups)}
        content["scales"] = {
            scale: {m: summarise(_errors(models[m][rows], observed[rows], first)) for m in simulated}
            for scale, rows in at.items()
        }
        if left:
            content["scales_range"] = {
                scale: {m: _range(steps[rows], groups[scale], step) for m, steps in left.items()}
                for scale, rows in at.items()
            }
    return content


def _mean_angle(simulated: FloatArray, observed: FloatArray) -> float | None:
    """Mean over trials of the error of a rigid body's orientation, where seen [degrees]; None if a roll-out diverged.

    Args:
        simulated: (R, T, 4, 3) its points [m].
        observed: (R, T, 4, 3) [m], NaN where it was not seen.
    """
    seen = np.asarray(np.isfinite(observed).all(axis=(-2, -1)))
    off = np.degrees(angles(observed, simulated))
    means = [own[at].mean() for own, at in zip(off, seen, strict=True) if at.any()]
    return float(np.mean(means)) if means and np.isfinite(means).all() else None


def _errors(simulated: FloatArray, observed: FloatArray, first: Sequence[int]) -> list[FloatArray]:
    trials = zip(simulated, observed, first, strict=False)
    return [marker_errors(x[start:], y[start:]) for x, y, start in trials]


def _reconstructed(context: StageContext, names: Sequence[str]) -> FloatArray:
    """(R, T, N, 3) reconstructed positions of the test trials [m]."""
    with read_hdf5(context.run_dir / reconstruction_file("resphys"), "reconstruction") as file:
        order = [str(name) for name in file.attrs["names"]]
        return read_array(file, "q")[[order.index(name) for name in names]]


def _by_horizon(settings: StageSettings, test: Mapping[str, FloatArray], observed: FloatArray) -> dict[str, Any]:
    """Entry ``horizons``: errors of the first seconds of the roll-outs, by duration and model; empty without any."""
    found = {}
    for seconds in settings.horizons:
        frames, first = slice(round(seconds / settings.time_step) + 1), [0] * len(observed)
        found[f"{seconds:g}"] = {
            m: summarise(_errors(x[:, frames], observed[:, frames], first)) for m, x in test.items()
        }
    return {"horizons": found} if found else {}


def _by_phase(
    dataset: Trials, names: Sequence[str], test: Mapping[str, FloatArray], observed: FloatArray
) -> dict[str, Any]:
    """Entry ``phases``: errors by phase of the inputs and model; empty without inputs."""
    at = phases_of(dataset, names)
    seen = np.isfinite(observed[: len(names)]).all(-1).any(-1)
    frames = {phase: (at == phase) & seen for phase in PHASES}
    found = {
        phase: {
            model: summarise(marker_errors(x[k, own], observed[k, own]) for k, own in enumerate(rows) if own.any())
            for model, x in test.items()
        }
        for phase, rows in frames.items()
        if rows.any()
    }
    return {"phases": found} if found else {}


def _range(left: IntArray, names: Sequence[str], step: float) -> dict[str, Any]:
    gone = {name: float(step * at) for name, at in zip(names, left, strict=True) if at >= 0}
    return {"left": len(gone), "first_s": gone}


def time_models(context: StageContext) -> None:
    """Writes times.json: computing time per test trial [s], mean and standard deviation over the trials.

    The rows are those of the published table: the uncorrected simulator, the simulator with the true parameters if
    the target has its mesh and time step, the simulator with the learned force, and the network alone. Trials run one
    at a time, once, after the first steps of the first trial, which load kernels.
    """
    settings: StageSettings = context.settings
    experiment = Experiment(settings, context.run_dir, "count")
    names = experiment.dataset.moving(settings.groups["1"])
    simulator = experiment.model_simulator("resphys")
    learned = experiment.learned("resphys")
    replays = {name: experiment.motions.replay(simulator, [name], experiment.identified("resphys")) for name in names}
    starts = {name: experiment.motions.start(replay) for name, replay in replays.items()}
    uncorrected = experiment.simulator("simulation")
    rows: dict[str, tuple[str, Learned | None, Simulator]] = {"simulation": ("simulation", None, uncorrected)}
    target, shared = settings.target, ("mesh", "parts", "time_step")
    if target is not None and all(getattr(target, key) == getattr(settings, key) for key in shared):
        rows["target"] = ("simulation", None, experiment.simulator("target"))
    rows |= {"resphys": ("resphys", learned, simulator), "inference": ("resphys", learned, simulator)}
    times: dict[str, dict[str, float]] = {}
    steps = 0
    with Progress(context.name, len(rows) * len(names), "trials") as progress, torch.no_grad():
        for row, (model, network, stepping) in rows.items():
            identified, motions = experiment.identified(model), experiment.motions
            runs = [TrialRollout(stepping, motions, [name], identified, start=starts[name]) for name in names]
            seconds = []
            for number, run in enumerate((runs[0], *runs)):
                steps = min(run.steps, _WARM_UP) if number == 0 else run.steps
                predictor = None if network is None else run.predictor(network)
                state = run.begin(predictor)
                rolled = run.roll(predictor)
                next(rolled)
                before = time.perf_counter()
                for step in range(steps):
                    if row == "inference" and predictor is not None:
                        predictor(state, step)
                    else:
                        next(rolled)
                seconds.append(time.perf_counter() - before)
            progress.advance(len(names))
            times[row] = {"mean": mean(seconds[1:]), "std": pstdev(seconds[1:])}
    write_json(context.run_dir / TIMES, {"steps": steps, "seconds": times})


def check_mesh(context: StageContext) -> None:
    """Writes mesh_check.json: change of the simulation of test trials with a finer mesh, see `finer`.

    The trial with the largest motion is simulated for half a second from where its inputs begin; of poses, a few are.
    The finer mesh uses the parameters that were identified on the original mesh.
    """
    settings: StageSettings = context.settings
    times, parts = settings.mesh_check, settings.parts
    refined = {name: part.model_copy(update={"mesh": finer(part.mesh, times)}) for name, part in parts.items()}
    other = settings.model_copy(update={"mesh": finer(settings.mesh, times), "parts": refined})
    model = "simulation" if settings.identified is None else "sysid"
    content: dict[str, Any] = {"model": model}
    try:
        check_memory({"": other})
        experiments = [Experiment(meshed, context.run_dir) for meshed in (settings, other)]
        meshes = [experiment.body.mesh for experiment in experiments]
        if len(meshes[0].vertices) == len(meshes[1].vertices):
            raise InputError("its cells are given, and quadratic already; compare it with a finer one.")
        content |= {"cells": [len(mesh.cells) for mesh in meshes], "vertices": [len(m.vertices) for m in meshes]}
        amplitudes = _amplitudes(experiments[0], settings.groups["1"])
        moving = experiments[0].dataset.moving([*amplitudes])
        names = [max(moving, key=amplitudes.__getitem__)] if moving else [*amplitudes][:_CHECKED_POSES]
        shown, observed = list[FloatArray](), np.empty(0)
        with Progress(context.name, 2, "meshes") as progress, torch.no_grad():
            for experiment in experiments:
                replay = experiment.motions.replay(
                    experiment.model_simulator(model), names, experiment.identified(model)
                )
                if moving:
                    seconds = first_change(experiment.dataset, names[0]) + CHECKED_SECONDS
                    replay = Replay(replay.simulator, replay.observe, replay.trials.first(seconds))
                points = (
                    replay(
                        experiment.motions.start(replay, experiment.identified(model)), experiment.parameters(model)
                    )[0]
                    .cpu()
                    .numpy()
                )
                shown.append(as_markers(points, experiment.dataset.labels))
                observed = as_markers(replay.trials.observed.cpu().numpy(), experiment.dataset.labels)
                progress.advance()
        where = np.where(np.isfinite(observed), shown[1], np.nan)
        pairs = ((shown[0], observed), (shown[1], observed), (shown[0], where))
        means = [summarise(_errors(x, y, [0] * len(names)))["mean"] for x, y in pairs]
        content |= {"trials": names, "errors_mm": means[:2], "moved_mm": means[2]}
    except (ConvergenceError, InputError) as error:
        content["failed"] = str(error)
    write_json(context.run_dir / MESH_CHECK, content)
