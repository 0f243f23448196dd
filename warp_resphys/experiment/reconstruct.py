"""Reconstructs the residual forces with which a simulator follows the observed trials; how many markers that needs.

For the number of markers, one simulated motion is reconstructed from random subsets of its surface vertices.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..data.markers import MarkerMap
from ..dynamics.simulator import Simulator
from ..io.fan_out import ALONE, Workers
from ..io.files import atomic_hdf5, create, read_array, read_hdf5, read_json, write_json
from ..io.progress import show
from ..io.stages import Stage, StageContext, package_versions, resources_used
from ..learning.metrics import mean_distance
from ..learning.reconstruction import follow, make_reconstructor, without_ringing
from ..mesh.volume_mesh import surface_vertices
from ..settings.run import RunSettings
from ..settings.stages import SIMULATOR, StageSettings
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .build import build_body, build_simulator, simulation_device
from .experiment import Experiment
from .files import METRICS, RECONSTRUCTION, REPORT, read_if_there, reconstruction_file
from .parts import Arrays, Report, TrialPart, read_parts, remove_parts, split_into_parts, work_on, workers_for
from .simulate import build_target, weights

_UNITS = {"q": "m", "v": "m/s", "force": "N", "error": "mm"}
_STATIC_STEP = 1e6  # s, time step for static poses, in which inertia is negligible
MOTION = "motion.h5"
DRAWS = "ablation.h5"
SUMMARY = "ablation.json"
_STAGES = ("generate", "ablation", "report")
_MM = 1e3


def reconstruct(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes reconstruction_<model>.h5: q, v and force (R, K + 1, N, 3), and adds to reconstruction.json.

    The force of a frame is the force during the step that ends there; it is zero in the first frame. Forces from
    markers are stored in single precision, which rounds positions to 1e-8 m. The summary has the distance between
    reconstructed and observed points.
    """
    settings: StageSettings = context.settings
    experiment, model = Experiment(settings, context.run_dir), settings.model
    parts: list[TrialPart] = []
    for number, names in enumerate(experiment.dataset.batches(settings.reconstructed)):
        last = experiment.dataset.seconds(names) / experiment.model_simulator(model).time_step
        frames = max(experiment.motions.learned_steps(int(last + 1e-6)), 1) + 1
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
    simulator = without_ringing(experiment.model_simulator(settings.model), experiment.motions.observe)
    identified = experiment.identified(settings.model)
    replay = experiment.motions.replay(simulator, part.names, identified)
    start = experiment.motions.start(replay, identified)
    constants, inputs, resting = replay.prepare(identified.values(simulator))
    observed = experiment.motions.targets(replay, start)
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


def ablation_stages(run: RunSettings, files: Mapping[str, str]) -> list[Stage]:
    """Stages of the study.

    Args:
        run: settings with the group ``ablation``.
        files: of the bodies, see `settings.stages.StageSettings`.
    """
    assert run.ablation is not None
    own = run.ablation
    workers = workers_for(run.parallel, own.processes, run.device).at_most(len(own.counts))
    keys = (*SIMULATOR, "simulation")
    generated = StageSettings.reading(run, *keys, "target", "data", files=files)
    drawn = (f"ablation.{name}" for name in ("counts", "draws", "modes"))
    ablated = StageSettings.reading(run, *keys, *drawn, "reconstruction", "seed", files=files)
    return [
        Stage("generate", generate_motion, (MOTION,), generated),
        Stage("ablation", partial(ablate, workers=workers), (DRAWS, SUMMARY), ablated, ("generate",)),
        Stage("report", report_ablation, (REPORT,), run, ("ablation",)),
    ]


def print_ablation(run: RunSettings, folder: Path) -> None:
    """Writes metrics.json and prints the errors."""
    metrics = _metrics(folder, run)
    write_json(folder / METRICS, metrics)
    from ..report.ablation_page import ablation_table, verdict  # matplotlib

    rows = metrics["by_markers"]
    show(run.heading, ablation_table(rows), verdict(rows, metrics["uncorrected_mm"]), f"Report: {folder / REPORT}")


def generate_motion(context: StageContext) -> None:
    """Writes motion.h5: q (T + 1, N, 3) from the held state on, by the target and the uncorrected simulator."""
    settings: StageSettings = context.settings
    data = settings.data
    target, simulation = build_target(settings, settings.target), build_simulator(settings, settings.simulation)
    with torch.no_grad():
        total = 1e-3 * np.array(data.weights_g.observed)[:, None] * np.asarray(target.simulator.gravity)
        held = target.simulator.static_equilibrium(Inputs(weights(target.simulator, data.load, total)))
        moved = target.simulator.rollout(held, data.steps * target.substeps).q[:: target.substeps, 0]
        start = State(target.seen(held.q), target.seen(held.v))
        motion = {"q": target.seen(moved), "uncorrected_q": simulation.rollout(start, data.steps).q[:, 0]}
    attributes = {"fingerprint": context.fingerprint, "time_step": settings.time_step}
    with atomic_hdf5(context.run_dir / MOTION, "motion", attributes) as file:
        for name, q in motion.items():
            create(file, name, q.cpu().numpy(), "m")


def ablate(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes ablation.h5, with the marker sets and their errors at every step, and a table of the errors.

    Raises:
        ConvergenceError, WorkerError: a step could not be reconstructed.
    """
    counts = list(context.settings.ablation.counts)
    motion, uncorrected = read_motion(context.run_dir)
    parts = {}
    for count in sorted(counts, reverse=True):  # Longest first, to balance the load of the processes.
        (parts[count],) = split_into_parts(context, (str(count),), len(motion), f"markers_{count}", count)
    work_on([*parts.values()], _from_markers, workers)
    draws = {name: np.stack([parts[count].read(name) for count in counts]) for name in ("markers", "error", "misfit")}
    with atomic_hdf5(context.run_dir / DRAWS, "marker ablation", {"fingerprint": context.fingerprint}) as file:
        create(file, "count", counts)
        for name, values in draws.items():
            create(file, name, values, "1" if name == "markers" else "m")
    error, misfit = (_MM * draws[name].mean(-1) for name in ("error", "misfit"))
    distance = np.linalg.norm(uncorrected[1:] - motion[1:], axis=-1).mean()
    rows = [summarise_draws(count, e, m) for count, e, m in zip(counts, error, misfit, strict=True)]
    write_json(context.run_dir / SUMMARY, {"uncorrected_mm": _MM * float(distance), "by_markers": rows})
    remove_parts(context)


def read_motion(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions (T + 1, N, 3) of the motion, and of the uncorrected simulation [m]."""
    with read_hdf5(folder / MOTION, "motion") as file:
        return read_array(file, "q"), read_array(file, "uncorrected_q")


def _from_markers(part: TrialPart, report: Report) -> Arrays:
    """Reconstruction of the motion from random sets of a given number of markers.

    The mean distances (draws, T) of all vertices and of the markers, and the marker sets.
    """
    settings: StageSettings = part.context.settings
    count, draws = part.more, settings.ablation.draws
    simulator = build_simulator(settings, settings.simulation)
    motion, like = simulator.tensor(read_motion(part.context.run_dir)[0]), simulator.rest_positions
    vertices = draw_markers(simulator, count, draws, settings.seed)
    markers = MarkerMap.at_vertices(torch.as_tensor(vertices, device=like.device), like.dtype)
    more = dict(settings.reconstruction) | {"modes": settings.ablation.modes}
    method = make_reconstructor(simulator, **more, observation=markers)
    q = motion[0].expand(draws, *like.shape)
    error, misfit = list[torch.Tensor](), list[torch.Tensor]()
    targets = (markers(one.expand_as(q)) for one in motion[1:])
    report()
    for step, wanted in zip(follow(method, State(q, torch.zeros_like(q)), targets), motion[1:], strict=True):
        away = step.state.q - wanted
        error.append(away.norm(dim=-1).mean(-1))
        misfit.append(markers(away).norm(dim=-1).mean(-1))
        report(iterations=step.iterations)
    padding = max(settings.ablation.counts) - count
    sets = np.pad(vertices, ((0, 0), (0, padding)), constant_values=-1)  # -1 where a set is smaller
    distances = {"error": error, "misfit": misfit}
    series = {name: (torch.stack(values, 1).cpu().numpy(), "m") for name, values in distances.items()}
    return {"markers": (sets, "1"), **series}


def draw_markers(simulator: Simulator, count: int, draws: int, seed: int) -> NDArray[np.int64]:
    """(draws, count) random surface vertices, without repetition within a set.

    They are drawn from the free vertices, or from all if there are too few. A set depends only on the seed and its
    count.
    """
    surface = surface_vertices(simulator.body.mesh)
    free = np.setdiff1d(surface, simulator.body.fixed_vertices)
    pool = free if count <= len(free) else surface
    random = np.random.default_rng([seed, count])
    return np.stack([random.choice(pool, count, replace=False) for _ in range(draws)])


def summarise_draws(count: int, errors_mm: NDArray[np.float64], misfits_mm: NDArray[np.float64]) -> dict[str, Any]:
    """One row of the table: quantiles of the draws' errors, and the errors themselves."""
    lower, median, upper = np.quantile(errors_mm, [0.25, 0.5, 0.75])
    return {
        "markers": count,
        "median_mm": median,
        "lower_quartile_mm": lower,
        "upper_quartile_mm": upper,
        "interquartile_range_mm": upper - lower,
        "largest_mm": errors_mm.max(),
        "misfit_median_mm": np.median(misfits_mm),
        "errors_mm": errors_mm.tolist(),
    }


def report_ablation(context: StageContext) -> None:
    """Writes report.html and its figure."""
    from ..report.ablation_page import write_ablation_report  # matplotlib

    run: RunSettings = context.settings
    body = build_body(run)
    mesh, fixed = body.mesh, body.fixed_vertices
    surface = surface_vertices(mesh)
    counts = {"vertices": len(mesh.vertices), "surface": len(surface), "free": len(np.setdiff1d(surface, fixed))}
    write_ablation_report(context.run_dir / REPORT, _metrics(context.run_dir, run), run, **counts)


def _metrics(folder: Path, run: RunSettings) -> dict[str, Any]:
    """Contents of metrics.json: errors, time and memory of finished stages, versions and device."""
    return {
        **read_json(folder / SUMMARY),
        **resources_used(folder, _STAGES),
        "versions": package_versions(),
        "device": str(simulation_device(run.device)),
    }
