"""Stages of the learning: each reads files, calls a function of the library and writes files."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..core.energies.catalogue import read_law
from ..data.rigid_bodies import corners_of
from ..data.trials import Trials, evenly
from ..io.fan_out import ALONE, Workers
from ..io.resuming import StageContext, package_versions
from ..io.safe_files import atomic_hdf5, create, resume_checkpoint, write_checkpoint, write_json
from ..learning.comparison import Comparison
from ..learning.error_tables import counted
from ..learning.identification import identification, law_search
from ..learning.placement import Accuracy
from ..learning.residuals import reconstruction
from ..learning.residuals.actuator_fit import ActuatorFitting
from ..learning.residuals.fitting import Fitting, Snapshot, fit
from ..settings.stage_keys import StageSettings
from .build import choose_device
from .experiment import LAW, MODELS, SIMFREE, Experiment
from .files import (
    ACTUATOR_FILE,
    ERRORS,
    IDENTIFICATION,
    LAW_FILE,
    RECONSTRUCTION,
    ROLLOUTS,
    read_if_there,
    reconstruction_file,
    training_file,
    weights_file,
)


def identify(context: StageContext) -> None:
    """Writes identification.json: all configured parameters, and optionally E and nu alone.

    E and nu alone are identified with the integrator of the uncorrected simulator, as published;
    all parameters with the identified simulator. ``identify.trials`` and ``identify.seconds``
    restrict the number and length of the training trials. An interrupted run keeps its finished
    searches.

    Raises:
        InputError: values are estimated from the whole of a test trial.
    """
    settings: StageSettings = context.settings
    wanted, names = settings.identify, settings.split.train
    experiment, found = Experiment(settings, context.run_dir), {}
    kept = {
        model: context.run_dir / f"identify_{model}_parts.safetensors"
        for model in ("sysid", "sysid_elastic")
    }
    names = names if wanted.trials is None else tuple(evenly(names, wanted.trials))
    for model, parameters in {
        "sysid": wanted.parameters,
        "sysid_elastic": wanted.elastic or {},
    }.items():
        if not parameters:
            continue
        result = identification.identify(
            experiment.simulator(MODELS[model][0]),
            experiment.motions,
            parameters,
            wanted.first_guess,
            names=names,
            held_out=[name for name in settings.split.names if name not in names],
            accuracy=_accuracy(settings, experiment.trials) if model == "sysid" else None,
            seconds=min(filter(None, (settings.trial_seconds, wanted.seconds)), default=None),
            starts=wanted.starts,
            candidates=wanted.candidates,
            max_evaluations=wanted.max_evaluations,
            tolerance=wanted.tolerance,
            seed=settings.seed,
            kept=kept[model],
        )
        # Raises before any training.
        counted(experiment.motions, names, settings.split.test, result.first_frames)
        found[model] = result.plain()
    write_json(context.run_dir / IDENTIFICATION, found)
    for path in kept.values():
        path.unlink(missing_ok=True)


def _accuracy(settings: StageSettings, trials: Trials) -> Accuracy | None:
    """Prior standard deviations of marker places; None if they are not identified."""
    wanted, markers, bound = settings.identify.placement, settings.markers, trials.bound
    if wanted is None or markers is None or bound is None:
        return None
    turn, mounting = (
        None if x is None else math.radians(x) for x in (wanted.turn, wanted.mounting)
    )
    centre = np.mean([*markers.reference.values()] or [*markers.tracked.values()], axis=0).tolist()
    bodies = tuple(
        (rows.start, bound[rows] - bound[rows].mean(axis=0))
        for rows in corners_of(trials.labels).values()
    )
    return Accuracy(
        wanted.markers, wanted.shift, turn, wanted.between_sessions, mounting, bodies, centre
    )


def identify_law(context: StageContext) -> None:
    """Writes law.json: the law, its posterior, the classes that were tried, and whether it is used.

    A law of another run stays as it is; the parameters of actuators and of the medium are
    identified with it. A run that is interrupted keeps the classes of the weak form and the
    finished searches.

    Raises:
        DataFileError: the file of the law is missing, damaged or of another version.
    """
    settings: StageSettings = context.settings
    experiment, file = Experiment(settings, context.run_dir, "count"), settings.law.file
    kept = context.run_dir / f"{context.name}_parts.safetensors"
    known = None if file is None else read_law(file)
    law = law_search.identify_law(
        experiment.simulator("identified"),
        experiment.motions,
        {} if settings.identify is None else settings.identify.parameters,
        identified=experiment.identified("sysid"),
        train=settings.split.train,
        validation=settings.split.validation,
        settings=settings.law,
        seconds=settings.trial_seconds,
        known=known,
        kept=kept,
    )
    content = law.plain()
    if known is None:
        content["data"], content["versions"] = (
            {"name": settings.name, "trials": law.trials},
            package_versions(),
        )
    else:
        accepted = known.get("accepted_there", known.get("accepted", True))
        content = {**known, **content, "accepted_there": accepted, "file": file}
    write_json(context.run_dir / LAW_FILE, content)
    kept.unlink(missing_ok=True)


def train_actuator(context: StageContext) -> None:
    """Writes actuator.json: the networks that change inputs,
    their test on held-out trials, and the epochs.

    An interrupted training resumes; a cross-validation before it (`left_out_in_turn`) is repeated.
    """
    settings: StageSettings = context.settings
    experiment, name, split = Experiment(settings, context.run_dir), context.name, settings.split
    checkpoint, resumed, save = _kept_training(context)
    below = LAW if experiment.has_law else "sysid"
    made_of = experiment.model_simulator(below), experiment.motions, split.train, split.validation
    fitting = ActuatorFitting(*made_of, experiment.identified(below))
    found, training = fitting.fit(settings.actuator, name, resumed, save)
    networks = {key: network.plain() for key, network in found.actuator.items()}
    write_json(context.run_dir / ACTUATOR_FILE, {**training, "inputs": networks})
    checkpoint.unlink(missing_ok=True)


def reconstruct(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes reconstruction_<model>.h5, see `ReconstructedTrials`, and adds to reconstruction.json.

    The summary has the distance between reconstructed and observed points.
    """
    settings: StageSettings = context.settings
    experiment = Experiment(settings, context.run_dir)
    model = settings.model
    folder = context.run_dir
    parts = context.parts(workers, settings.batch)
    found = reconstruction.reconstruct(
        experiment.model_simulator(model),
        experiment.motions,
        settings.reconstructed,
        parameters=experiment.identified(model),
        settings=settings.reconstruction,
        acts=settings.network.acts,
        parts=parts,
    )
    with atomic_hdf5(
        folder / reconstruction_file(model), "reconstruction", {"names": [*found.names]}
    ) as file:
        # One array at a time, as many trials take much memory.
        for name, unit in reconstruction.UNITS.items():
            create(file, name, found.read(name), unit, time_axis=1)
    errors = found.read("error")
    summary = {"mean_mm": float(np.nanmean(errors)), "max_mm": float(np.nanmax(errors))}
    write_json(folder / RECONSTRUCTION, {**read_if_there(folder / RECONSTRUCTION), model: summary})
    parts.remove()


def train(context: StageContext) -> None:
    """Trains a model.

    Writes <model>.safetensors, with the selected weights, and training_<model>.json.

    An interrupted training resumes.
    """
    settings: StageSettings = context.settings
    model, folder, name = settings.model, context.run_dir, context.name
    checkpoint, resumed, save = _kept_training(context)
    learned = fit(
        fitting_of(Experiment(settings, folder), model), settings.training, name, resumed, save
    )
    write_json(folder / training_file(model), learned.training)
    learned.write(folder / weights_file(model), context.fingerprint)
    checkpoint.unlink(missing_ok=True)


def _kept_training(
    context: StageContext,
) -> tuple[Path, Snapshot | None, Callable[[Snapshot], None]]:
    """Returns the file of an interrupted training of a stage,
    its last snapshot or None, and what saves others.
    """
    path = context.run_dir / f"{context.name}.safetensors"

    def save(kept: Snapshot) -> None:
        write_checkpoint(path, "training", kept[0], {**kept[1], "fingerprint": context.fingerprint})

    return path, resume_checkpoint(path, "training", context.fingerprint), save


def fitting_of(experiment: Experiment, model: str) -> Fitting:
    """Returns what the network of a model is fitted to."""
    settings, split, data_driven = experiment.settings, experiment.settings.split, model == SIMFREE
    return Fitting(
        experiment.model_simulator(model),
        experiment.motions,
        experiment.reconstructed("resphys" if data_driven else model),
        split.train,
        split.validation,
        experiment.identified(model),
        data_driven,
        settings.force_frame,
        settings.range_guard,
        experiment.sources(model)[0] == LAW,
        choose_device(settings.device),
    )


def evaluate(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes rollouts.h5, the observed points of every model's roll-outs
    of the test trials, and errors.json.
    """
    settings: StageSettings = context.settings
    experiment = Experiment(settings, context.run_dir, "count")
    parts = context.parts(workers, settings.batch)
    with_points = (
        experiment.has_forces and experiment.trials.bound is None and not settings.with_law
    )
    found = experiment.reconstructed("resphys") if with_points else None
    compared = Comparison(
        {name: experiment.model(name) for name in experiment.models},
        experiment.motions,
        train=settings.split.train,
        groups=settings.groups,
        calibration=settings.calibration,
        horizons=settings.horizons,
        reconstructed=None if found is None else found.of(settings.groups["1"], "q")[0],
        parts=parts,
    )
    errors = compared.errors()
    attributes = {
        "names": compared.names,
        "time_step": settings.time_step,
        "film_trial": compared.filmed,
    }
    with atomic_hdf5(context.run_dir / ROLLOUTS, "rollouts", attributes) as file:
        for model, values in compared.simulated.items():
            create(file, f"{model}_observed", values, "m", time_axis=1)
        for model, values in compared.loads.items():
            create(file, f"{model}_loads", values, "N, N m", time_axis=1)
        for model in compared.models:
            create(file, f"{model}_film", compared.film(model), "m")
        create(file, "film_steps", compared.film_steps)
        for model, spread in compared.spreads.items():
            create(file, f"{model}_spread", spread, "m^2", time_axis=1)
    write_json(context.run_dir / ERRORS, errors)
    parts.remove()
