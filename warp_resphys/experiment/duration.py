"""The expected duration of a run: the time of a step and of a reconstructed one, times their numbers.

The steps are the first ones of bodies that begin under inputs; others fall from rest under the inputs in the middle of
the trials. The reconstructed forces support a fifth of their weight. Reports, laws of materials, other bodies and
control have no estimate.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch

from ..data.trials import UNDER_INPUTS, evenly
from ..io.errors import number_of
from ..io.fan_out import ALONE, Workers
from ..io.resuming import Stage
from ..learning.evaluation import left_out_in_turn
from ..learning.residuals.reconstruction import make_reconstructor
from ..report.wording import duration_text
from ..settings.learning import Bounds
from ..settings.stage_keys import StageSettings
from .experiment import MODELS, SIMFREE, Experiment
from .mesh_check import CHECKED_SECONDS

_LEAST_SECONDS = 60.0  # of the estimates that are shown
_SHORT = 8e6  # steps times vertices that take less than that
_RECONSTRUCTION = 8.0  # steps that take as long as a reconstructed one, before that is timed
_VARIED = 0.2  # time of one more set of parameters, over that of a step
_ITERATION = 2.0  # of L-BFGS: losses with their gradients, over roll-outs
_PARTS = 6  # inputs by which motions are linearised
_BATCH = 1e-3  # time of a batch of a small network [s]
_SUPPORTED, _MOST_TRIALS, _MOST_STEPS = 0.2, 16, 5  # share of the weight; trials and steps that are timed


def announcement(
    stages: Sequence[Stage], folder: Path, quick: bool, workers: Workers = ALONE, times: float = 1.0
) -> str:
    """Returns the expected duration of stages in words, and what makes them shorter; empty for less than a minute.

    Args:
        stages: of one split, in a folder with its dataset.
        folder: of the split.
        quick: whether the run is a first look already.
        workers: of reconstructions and roll-outs.
        times: factor of the duration, as of several folds.
    """
    folder.mkdir(parents=True, exist_ok=True)  # The dataset of a fold lies beside it.
    known = {one.name: one.settings for one in stages if isinstance(one.settings, StageSettings)}
    experiments = {name: Experiment(settings, folder, "count") for name, settings in known.items()}
    works = {name: work for name, one in experiments.items() if (work := work_of(name, one)) is not None}
    amount = times * sum(steps + _RECONSTRUCTION * forces for steps, forces, _ in works.values())
    vertices = next(iter(experiments.values())).body.n_vertices if works else 0
    if not works or amount * vertices < _SHORT:
        return ""
    paces, seconds = dict[bool, float](), dict[str, float]()
    for name, (steps, forces, training) in works.items():
        for reconstructed, number in ((False, steps), (True, forces)):
            if number and reconstructed not in paces:
                paces[reconstructed] = pace_of(experiments[name], reconstructed)
        one = known[name]  # workers share trials that are reconstructed, and test trials
        names = one.groups["1"] if name == "evaluate" else one.reconstructed
        shared = min(workers.count, max(math.ceil(len(names) / (one.batch or len(names) or 1)), 1))
        seconds[name] = times * (steps * paces.get(False, 0.0) + forces * paces.get(True, 0.0) + training) / shared
    if sum(seconds.values()) < _LEAST_SECONDS:
        return ""
    longest = sorted(seconds, key=lambda name: -seconds[name])[:3]
    parts = ", ".join(f"{name} {duration_text(seconds[name])}" for name in longest)
    others = [name for name in known if name not in seconds]
    without = f", without {', '.join(others)}" if others else ""
    shorter = ["a coarser mesh", "fewer or shorter trials"]
    most = len(known["identify"].identify.parameters) if "identify" in known else 0
    shorter += [f"fewer of the {number_of(most, 'parameter')} of identify.parameters"] if most > 1 else []
    shorter += [] if quick else ["or at first budget=quick"]
    took = f"about {duration_text(sum(seconds.values()))} more for {vertices:,} vertices"
    return f"{took}{without} (longest: {parts}); shorter with {', '.join(shorter)}."


def work_of(stage: str, experiment: Experiment) -> tuple[float, float, float] | None:
    """Returns the numbers of steps and of reconstructed steps of single trials, and the time of other training [s]."""
    settings = experiment.settings
    train, judged = settings.split.train, settings.split.validation or settings.split.train
    if stage.startswith("reconstruct_"):
        return 0.0, steps_of(experiment, settings.model, settings.reconstructed), 0.0
    if stage == "train_actuator":
        actuator, folds = settings.actuator, left_out_in_turn(experiment.trials, train, settings.split.validation)
        trained, rolled = (steps_of(experiment, "actuator", names) for names in (train, judged))
        epoch = (2.0 + _VARIED * _PARTS) * trained + rolled
        return (1 + len(folds)) * actuator.epochs * epoch, 0.0, 0.0
    if stage.startswith("train_"):
        model, training = settings.model, settings.training
        trained, rolled = (steps_of(experiment, model, names) for names in (train, judged))
        loop, trainer, times = training.in_the_loop, training.trainer, 1  # fits: the one used, those that test it
        if model != SIMFREE and trainer.gate:
            times += len(left_out_in_turn(experiment.trials, train, settings.split.validation))
        if loop is not None:
            if loop.hold_out and not settings.split.validation:
                times = len(train)
            return times * (loop.epochs + 1) * (_ITERATION * trained + rolled), 0.0, 0.0
        replayed = 0.0 if model == SIMFREE else trainer.epochs / trainer.rollout_every * rolled
        return times * replayed, 0.0, times * trainer.epochs * math.ceil(trained / trainer.batch_size) * _BATCH
    if stage == "evaluate":
        tested = [name for names in (*settings.groups.values(), settings.calibration) for name in names]
        rolled = sum(steps_of(experiment, model, tested) for model in experiment.models if model != SIMFREE)
        if settings.identify is None or settings.markers is None:
            return rolled, 0.0, 0.0
        counted = [*settings.groups["1"], *settings.calibration]  # differentiated, for intervals and free fits
        return rolled + _differentiated(experiment, settings.identify.parameters, "sysid", counted), 0.0, 0.0
    if stage == "mesh_check":
        return (1.0 + settings.mesh_check**3) * CHECKED_SECONDS / settings.time_step, 0.0, 0.0
    if stage == "time":  # three rows, one trial at a time, which takes twice as long
        return 6.0 * steps_of(experiment, "simulation", experiment.trials.moving(settings.groups["1"])), 0.0, 0.0
    if stage == "identify":
        wanted = settings.identify
        names = train if wanted.trials is None else tuple(evenly(train, wanted.trials))
        evaluations = wanted.starts * min(wanted.max_evaluations, 3.0 + wanted.max_evaluations / 3.0)
        searches = {"sysid": wanted.parameters, "sysid_elastic": wanted.elastic or {}}
        each = [
            _differentiated(experiment, ranges, model, names, wanted.seconds)
            for model, ranges in searches.items()
            if ranges
        ]
        return evaluations * sum(each), 0.0, 0.0
    return None


def _differentiated(
    experiment: Experiment, ranges: Mapping[str, Bounds], model: str, names: Sequence[str], longest: float | None = None
) -> float:
    """Returns the number of steps that take as long as trials with their derivatives by all parameters."""
    parts = max((inputs.shape[-1] for inputs in experiment.trials.inputs.values()), default=1)
    parameters = sum(parts if limits.by_part else 1 for limits in ranges.values())
    return (1.0 + _VARIED * parameters) * steps_of(experiment, model, names, longest)


def steps_of(experiment: Experiment, model: str, names: Sequence[str], longest: float | None = None) -> float:
    """Returns the number of steps of a model's simulator in trials, the longest of those that begin alike; 1 a pose."""
    settings, kind = experiment.settings, MODELS[model][0]
    time_step, total = experiment.settings_of("simulation" if kind == "law" else kind).time_step, 0.0
    for batch in experiment.trials.batches(names):
        limits = [experiment.trials.seconds(batch), settings.trial_seconds, longest]
        seconds = min(limit for limit in limits if limit is not None)
        total += len(batch) * max(math.ceil(seconds / time_step - 1e-6), 1)
    return total


def pace_of(experiment: Experiment, reconstructed: bool) -> float:
    """Returns the time of a step of one of several trials, or of the reconstruction of its forces [s]."""
    settings = experiment.settings
    names = experiment.trials.batches(settings.split.train)[0][: min(settings.batch or _MOST_TRIALS, _MOST_TRIALS)]
    replay = experiment.motions.replay(experiment.simulator("simulation"), names)
    simulator, (constants, inputs, resting) = replay.simulator, replay.prepare()
    if replay.is_static:
        simulator = replace(simulator, time_step=1e6, integrator="implicit_euler")
    state, method, seconds = simulator.rest_state(len(names)), None, list[float]()
    if reconstructed:
        method = make_reconstructor(simulator, settings.reconstruction, replay.observe)
        method = method.with_constants(constants)
    support = -_SUPPORTED * constants.load_mass[..., None] * constants.gravity[:, None] * torch.ones_like(state.q)
    first = round(float(replay.trials.times.max()) / simulator.time_step) // 2  # where inputs act
    if experiment.trials.begin_of(names[0]) == UNDER_INPUTS:
        state, first = simulator.static_equilibrium(resting, constants), 0
    for k in range(_MOST_STEPS):
        acting = resting if replay.is_static else inputs.at(first + k)
        begin = time.perf_counter()
        with torch.no_grad():
            target = simulator.step(state, acting if method is None else acting.plus(support), constants)
        if method is not None:
            begin = time.perf_counter()
            target = method.step(state, replay.observe(target.q), acting).state.detach()
        state = state if replay.is_static else target
        seconds.append(time.perf_counter() - begin)
        if sum(seconds[1:]) > 0.5 or seconds[0] > 2.0:
            break
    return fmean(seconds[1:] or seconds) / len(names)  # The first step may compile kernels.
