"""Stages: roll-outs of the test trials with every model, their errors and their computing time."""

import math
from collections.abc import Sequence
from itertools import chain

import numpy as np

from ..io.fan_out import ALONE, Workers
from ..io.parts import Parts, TrialPart
from ..io.resuming import StageContext
from ..io.safe_files import atomic_hdf5, create, write_json
from ..learning.error_tables import ComparedModels, amplitudes
from ..learning.evaluation import rollout_parts
from ..learning.without_physics import without_physics
from ..settings.stage_keys import StageSettings
from .experiment import LEARNED, Experiment
from .files import ERRORS, ROLLOUTS
from .prediction_intervals import INTERVAL_MODELS, intervals_of, linearised, remaining, spreads_of

_FILM_FRAMES = 256  # maximum
CHECKED_SECONDS, _CHECKED_POSES = 0.5, 3  # that are simulated with a finer mesh
_WARM_UP = 20  # steps before computing times are measured


def evaluate(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes rollouts.h5, the observed points of every model's roll-outs of the test trials, and errors.json."""
    settings: StageSettings = context.settings
    experiment = Experiment(settings, context.run_dir, "count")
    compared = experiment.models
    names = [name for group in settings.groups.values() for name in group]
    sizes = amplitudes(experiment.dataset, settings.groups["1"])
    filmed = max(sizes, key=sizes.__getitem__)  # the largest motion

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
    observed, plain, missing = without_physics(experiment.motions, names, settings.split.train)
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
    found = experiment.reconstructed("resphys") if experiment.dataset.bound is None and not settings.with_law else None
    (reconstructed,) = (None,) if found is None else found.of(test, "q")
    tested = ComparedModels(
        experiment.motions, settings.split.train, settings.groups, observed, left, reconstructed, settings.horizons
    )
    errors = tested.errors() | {"baselines": plain}
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
