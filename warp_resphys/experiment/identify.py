"""Stage: identifies the physical parameters from the training trials."""

import math

import numpy as np

from ..data.rigid_bodies import corners_of
from ..data.trials import Trials, evenly
from ..io.parts import Checkpoint
from ..io.resuming import StageContext
from ..io.safe_files import write_json
from ..learning import identification
from ..learning.placement import Accuracy
from ..settings.stage_keys import StageSettings
from .experiment import MODELS, Experiment
from .files import IDENTIFICATION


def identify(context: StageContext) -> None:
    """Writes identification.json: all configured parameters, and optionally E and nu alone.

    E and nu alone are identified with the integrator of the uncorrected simulator, as published; all parameters with
    the identified simulator. ``identify.trials`` and ``identify.seconds`` restrict the number and length of the
    training trials. An interrupted run keeps its finished searches.
    """
    settings: StageSettings = context.settings
    wanted, names = settings.identify, settings.split.train
    experiment, kept, found = Experiment(settings, context.run_dir), Checkpoint(context), {}
    names = names if wanted.trials is None else tuple(evenly(names, wanted.trials))
    for model, parameters in {"sysid": wanted.parameters, "sysid_elastic": wanted.elastic or {}}.items():
        if not parameters:
            continue
        result = identification.identify(
            *(experiment.simulator(MODELS[model][0]), experiment.motions, parameters, wanted.first_guess),
            names=names,
            held_out=[name for name in settings.split.names if name not in names],
            accuracy=_accuracy(settings, experiment.dataset) if model == "sysid" else None,
            seconds=min(filter(None, (settings.trial_seconds, wanted.seconds)), default=None),
            starts=wanted.starts,
            candidates=wanted.candidates,
            max_evaluations=wanted.max_evaluations,
            tolerance=wanted.tolerance,
            seed=settings.seed,
            once=kept.within(model),
            title=context.name,
        )
        found[model] = result.plain()
    write_json(context.run_dir / IDENTIFICATION, found)
    kept.path.unlink(missing_ok=True)


def _accuracy(settings: StageSettings, dataset: Trials) -> Accuracy | None:
    """Prior standard deviations of marker places; None if they are not identified."""
    wanted, markers, bound = settings.identify.placement, settings.markers, dataset.bound
    if wanted is None or markers is None or bound is None:
        return None
    turn, mounting = (None if x is None else math.radians(x) for x in (wanted.turn, wanted.mounting))
    centre = np.mean([*markers.reference.values()] or [*markers.tracked.values()], axis=0).tolist()
    bodies = tuple((own.start, bound[own] - bound[own].mean(axis=0)) for own in corners_of(dataset.labels).values())
    return Accuracy(wanted.markers, wanted.shift, turn, wanted.between_sessions, mounting, bodies, centre)
