"""Stage: the simulation of test trials with a finer mesh."""

import numpy as np
import torch

from ..data.driving import first_change
from ..data.rigid_bodies import as_markers
from ..io.arrays import FloatArray
from ..io.errors import ConvergenceError, InputError
from ..io.progress import Progress
from ..io.resuming import StageContext
from ..io.safe_files import write_json
from ..learning.error_tables import amplitudes
from ..learning.metrics import marker_errors, summarise
from ..report.data import MeshCheck
from ..settings.stage_keys import StageSettings
from .build import finer
from .experiment import Experiment
from .files import MESH_CHECK

CHECKED_SECONDS, _CHECKED_POSES = 0.5, 3  # that are simulated with a finer mesh


def check_mesh(context: StageContext) -> None:
    """Writes mesh_check.json: change of the simulation of test trials
    with a finer mesh, see `finer`.

    The trial with the largest motion is simulated for half a second from where its inputs begin; of
    poses, a few are. The finer mesh uses the parameters that were identified on the original mesh.
    """
    settings: StageSettings = context.settings
    times, parts = settings.mesh_check, settings.parts
    refined = {
        name: part.model_copy(update={"mesh": finer(part.mesh, times)})
        for name, part in parts.items()
    }
    other = settings.model_copy(update={"mesh": finer(settings.mesh, times), "parts": refined})
    model = "simulation" if settings.identify is None else "sysid"
    content: MeshCheck = {"model": model}
    try:
        experiments = [Experiment(meshed, context.run_dir) for meshed in (settings, other)]
        meshes = [experiment.body.mesh for experiment in experiments]
        if len(meshes[0].vertices) == len(meshes[1].vertices):
            raise InputError(
                "its cells are given, and quadratic already; compare it with a finer one."
            )
        content |= {
            "cells": [len(mesh.cells) for mesh in meshes],
            "vertices": [len(m.vertices) for m in meshes],
        }
        sizes = amplitudes(experiments[0].trials, settings.groups["1"])
        moving = experiments[0].trials.moving([*sizes])
        names = [max(moving, key=sizes.__getitem__)] if moving else [*sizes][:_CHECKED_POSES]
        shown, observed = list[FloatArray](), np.empty(0)
        with Progress(context.name, 2, "meshes") as progress, torch.no_grad():
            for experiment in experiments:
                motions, identified = experiment.motions, experiment.identified(model)
                replay = motions.replay(experiment.model_simulator(model), names, identified)
                if moving:
                    seconds = first_change(experiment.trials, names[0]) + CHECKED_SECONDS
                    replay = replay.changed(trials=replay.trials.first(seconds))
                points = (
                    replay(motions.start(replay, identified), experiment.parameters(model))[0]
                    .cpu()
                    .numpy()
                )
                shown.append(as_markers(points, experiment.trials.labels))
                observed = as_markers(
                    replay.trials.observed.cpu().numpy(), experiment.trials.labels
                )
                progress.advance()
        where = np.where(np.isfinite(observed), shown[1], np.nan)
        pairs = ((shown[0], observed), (shown[1], observed), (shown[0], where))
        means = [summarise(map(marker_errors, x, y))["mean"] for x, y in pairs]
        content |= {"trials": names, "errors_mm": means[:2], "moved_mm": means[2]}
    except (ConvergenceError, InputError) as error:
        content["failed"] = str(error)
    write_json(context.run_dir / MESH_CHECK, content)
