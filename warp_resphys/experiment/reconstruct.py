"""Stage: reconstructs the residual forces with which a simulator follows the observed trials."""

from dataclasses import replace

import numpy as np
import torch

from ..io.fan_out import ALONE, Workers
from ..io.files import atomic_hdf5, create, write_json
from ..io.stages import StageContext
from ..learning.metrics import mean_distance
from ..learning.reconstruction import follow, make_reconstructor, without_ringing
from ..settings.stages import StageSettings
from .experiment import Experiment
from .files import RECONSTRUCTION, read_if_there, reconstruction_file
from .parts import Arrays, Report, TrialPart, read_parts, remove_parts, split_into_parts, work_on

_UNITS = {"q": "m", "v": "m/s", "force": "N", "error": "mm"}
_STATIC_STEP = 1e6  # s, time step for static poses, in which inertia is negligible


def reconstruct(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes reconstruction_<model>.h5: q, v and force (R, K + 1, N, 3), and adds to reconstruction.json.

    The force of a frame is the force during the step that ends there; it is zero in the first frame. Forces from
    markers are stored in single precision, which rounds positions to 1e-8 m. The summary has the distance between
    reconstructed and observed points.
    """
    settings: StageSettings = context.settings
    experiment, model = Experiment(settings, context.run_dir), settings.model
    parts: list[TrialPart] = []
    for number, names in enumerate(experiment.batches(settings.reconstructed)):
        last = float(experiment.trials(names).times.max()) / experiment.model_simulator(model).time_step
        frames = max(experiment.learned_steps(int(last + 1e-6)), 1) + 1
        parts += split_into_parts(context, names, frames, f"part{number}", batch=settings.batch)
    work_on(parts, _of_trials, workers)
    order = [name for part in parts for name in part.names]
    with atomic_hdf5(context.run_dir / reconstruction_file(model), "reconstruction", {"names": order}) as file:
        for name, unit in _UNITS.items():  # One array at a time, as many trials take much memory.
            values = read_parts(parts, name)
            create(file, name, values, unit, time_axis=1)
    summary = {"mean_mm": float(np.nanmean(values)), "max_mm": float(np.nanmax(values))}  # of the last, the errors
    write_json(context.run_dir / RECONSTRUCTION, {**read_if_there(context.run_dir / RECONSTRUCTION), model: summary})
    remove_parts(context)


def _of_trials(part: TrialPart, report: Report) -> Arrays:
    """Reconstruction of trials that begin in the same way: states, forces, and mean distances (R, K + 1) [mm]."""
    settings: StageSettings = part.context.settings
    experiment = Experiment(settings, part.context.run_dir)
    simulator = without_ringing(experiment.model_simulator(settings.model), experiment.observe)
    replay = experiment.replay(simulator, part.names, settings.model)
    start = experiment.start(replay, settings.model)
    constants, inputs, resting = replay.prepare(experiment.parameters(settings.model))
    observed = experiment.targets(replay, start)
    state = replay.initial_state(start, constants, resting)
    if replay.is_static:  # One very long step leads to the static pose.
        simulator = replace(simulator, time_step=_STATIC_STEP, integrator="implicit_euler")
        observed = torch.cat([torch.full_like(observed, torch.nan), observed], 1)
        inputs = resting
    method = make_reconstructor(simulator, **dict(settings.reconstruction), observation=replay.observe)
    states, forces = [state], [torch.zeros_like(state.q)]
    report()
    for step in follow(method.with_constants(constants), state, observed[:, 1:].unbind(1), inputs):
        states.append(step.state)
        forces.append(step.force)
        report(iterations=step.iterations)
    reached = torch.stack([replay.observe(state.q) for state in states], 1).cpu().numpy()
    error = mean_distance(reached, observed.cpu().numpy())
    series = {"q": [state.q for state in states], "v": [state.v for state in states], "force": forces}
    arrays = {name: torch.stack(values, 1).cpu().numpy() for name, values in series.items()}
    dtype = "float64" if experiment.dataset.bound is None else "float32"
    return {name: (values.astype(dtype), _UNITS[name]) for name, values in {**arrays, "error": error}.items()}
