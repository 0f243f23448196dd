"""Study of the number of markers: one simulated motion,
reconstructed from random sets of its surface vertices.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..core.dynamics.simulator import Simulator
from ..core.mesh.volume_mesh import surface_vertices
from ..core.stepping.inputs import Inputs
from ..core.stepping.state import State
from ..data.markers import MarkerMap
from ..io.errors import InputError
from ..io.fan_out import ALONE, Workers
from ..io.parts import Arrays, Report, TrialPart
from ..io.progress import show
from ..io.resuming import Stage, StageContext, package_versions, resources_used, run_stages
from ..io.safe_files import atomic_hdf5, create, read_array, read_hdf5, read_json, write_json
from ..learning.residuals.reconstruction import follow, make_reconstructor
from ..settings.run import RunSettings
from ..settings.stage_keys import SIMULATOR, StageSettings
from .build import build_body, build_simulator, simulation_device
from .digests import files_read
from .files import METRICS, REPORT
from .folds import workers_for
from .simulate import build_target, weights

if TYPE_CHECKING:
    from ..report.pages.ablation_page import AblationMetrics

MOTION = "motion.h5"
DRAWS = "ablation.h5"
SUMMARY = "ablation.json"
_STAGES = ("generate", "ablation", "report")
_MM = 1e3


def ablation_stages(run: RunSettings, files: Mapping[str, str]) -> list[Stage]:
    """Stages of the study.

    Args:
        run: settings with the group ``ablation``.
        files: of the bodies, see `settings.stage_keys.StageSettings`.
    """
    assert run.ablation is not None
    workers = workers_for(run.parallel, run.ablation.processes, run.device).at_most(
        len(run.ablation.counts)
    )
    keys = (*SIMULATOR, "simulation")
    generated = StageSettings.reading(run, *keys, "target", "data", files=files)
    drawn = (f"ablation.{name}" for name in ("counts", "draws"))
    ablated = StageSettings.reading(run, *keys, *drawn, "reconstruction", "seed", files=files)
    return [
        Stage("generate", generate_motion, (MOTION,), generated),
        Stage(
            "ablation", partial(ablate, workers=workers), (DRAWS, SUMMARY), ablated, ("generate",)
        ),
        Stage("report", report_ablation, (REPORT,), run, ("ablation",)),
    ]


def check_ablation(run: RunSettings, simulator: Simulator) -> None:
    """Checks that the body has as many surface vertices as markers,
    and that forces can be reconstructed from them.

    Raises:
        InputError: it has fewer, or a method that does not fit.
    """
    assert run.ablation is not None
    assert run.reconstruction is not None
    most, surface = max(run.ablation.counts), len(surface_vertices(simulator.body.mesh))
    if most > surface:
        raise InputError(
            f"ablation.counts asks for {most} markers, but the mesh has {surface} surface "
            "vertices: use fewer, or refine the mesh."
        )
    probe = MarkerMap.at_vertices(torch.zeros(1, 1, dtype=torch.int64))
    make_reconstructor(simulator, run.reconstruction, probe)


def run_ablation(run: RunSettings, folder: Path) -> None:
    """Runs the stages of the study, and prints the errors."""
    run_stages(ablation_stages(run, files_read(run, run, run.target)), folder)
    print_ablation(run, folder)


def print_ablation(run: RunSettings, folder: Path) -> None:
    """Writes metrics.json and prints the errors."""
    metrics = _metrics(folder, run)
    write_json(folder / METRICS, metrics)
    from ..report.pages.ablation_page import MarkerErrors, ablation_table, verdict  # matplotlib

    rows = [MarkerErrors(**row) for row in metrics["by_markers"]]
    show(
        run.heading,
        ablation_table(rows),
        verdict(rows, metrics["uncorrected_mm"]),
        f"Report: {folder / REPORT}",
    )


def generate_motion(context: StageContext) -> None:
    """Writes motion.h5: q (T + 1, N, 3) from the held state on,
    by the target and the uncorrected simulator.
    """
    settings: StageSettings = context.settings
    data = settings.data
    target = build_target(settings, settings.target)
    simulation = build_simulator(settings, settings.simulation)
    with torch.no_grad():
        total = (
            1e-3 * np.array(data.weights_g.observed)[:, None] * np.asarray(target.simulator.gravity)
        )
        held = target.simulator.static_equilibrium(
            Inputs(weights(target.simulator, data.load, total))
        )
        moved = target.simulator.rollout(held, data.steps * target.substeps).q
        moved = moved[:: target.substeps, 0]
        start = State(target.seen(held.q), target.seen(held.v))
        motion = {
            "q": target.seen(moved),
            "uncorrected_q": simulation.rollout(start, data.steps).q[:, 0],
        }
    attributes = {"fingerprint": context.fingerprint, "time_step": settings.time_step}
    with atomic_hdf5(context.run_dir / MOTION, "motion", attributes) as file:
        for name, q in motion.items():
            create(file, name, q.cpu().numpy(), "m")


def ablate(context: StageContext, workers: Workers = ALONE) -> None:
    """Writes ablation.h5, with the marker sets and their errors at every step,
    and a table of the errors.

    Raises:
        ConvergenceError, WorkerError: a step could not be reconstructed.
    """
    counts = list(context.settings.ablation.counts)
    motion, uncorrected = read_motion(context.run_dir)
    parts = context.parts(workers)
    sets = {
        count: TrialPart(
            f"markers_{count}", (str(count),), len(motion), partial(_from_markers, context, count)
        )
        # Longest first, to balance the load of the processes.
        for count in sorted(counts, reverse=True)
    }
    parts.run([*sets.values()])
    names = ("markers", "error", "misfit")
    draws = {name: np.stack([parts.read(sets[count], name) for count in counts]) for name in names}
    with atomic_hdf5(
        context.run_dir / DRAWS, "marker ablation", {"fingerprint": context.fingerprint}
    ) as file:
        create(file, "count", counts)
        for name, values in draws.items():
            create(file, name, values, "1" if name == "markers" else "m")
    error, misfit = (_MM * draws[name].mean(-1) for name in ("error", "misfit"))
    distance = np.linalg.norm(uncorrected[1:] - motion[1:], axis=-1).mean()
    rows = [summarise_draws(count, e, m) for count, e, m in zip(counts, error, misfit, strict=True)]
    write_json(
        context.run_dir / SUMMARY, {"uncorrected_mm": _MM * float(distance), "by_markers": rows}
    )
    parts.remove()


def read_motion(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions (T + 1, N, 3) of the motion, and of the uncorrected simulation [m]."""
    with read_hdf5(folder / MOTION, "motion") as file:
        return read_array(file, "q"), read_array(file, "uncorrected_q")


def _from_markers(context: StageContext, count: int, report: Report) -> Arrays:
    """Reconstruction of the motion from random sets of a given number of markers.

    The mean distances (draws, T) of all vertices and of the markers, and the marker sets.
    """
    settings: StageSettings = context.settings
    draws = settings.ablation.draws
    simulator = build_simulator(settings, settings.simulation)
    motion, like = simulator.tensor(read_motion(context.run_dir)[0]), simulator.rest_positions
    vertices = draw_markers(simulator, count, draws, settings.seed)
    markers = MarkerMap.at_vertices(torch.as_tensor(vertices, device=like.device), like.dtype)
    method = make_reconstructor(simulator, settings.reconstruction, markers)
    q = motion[0].expand(draws, *like.shape)
    error, misfit = list[torch.Tensor](), list[torch.Tensor]()
    targets = (markers(one.expand_as(q)) for one in motion[1:])
    report()
    for step, wanted in zip(
        follow(method, State(q, torch.zeros_like(q)), targets), motion[1:], strict=True
    ):
        away = step.state.q - wanted
        error.append(away.norm(dim=-1).mean(-1))
        misfit.append(markers(away).norm(dim=-1).mean(-1))
        report(iterations=step.iterations)
    padding = max(settings.ablation.counts) - count
    sets = np.pad(vertices, ((0, 0), (0, padding)), constant_values=-1)  # -1 where a set is smaller
    distances = {"error": error, "misfit": misfit}
    series = {
        name: (torch.stack(values, 1).cpu().numpy(), "m") for name, values in distances.items()
    }
    return {"markers": (sets, "1"), **series}


def draw_markers(simulator: Simulator, count: int, draws: int, seed: int) -> NDArray[np.int64]:
    """(draws, count) random surface vertices, without repetition within a set.

    They are drawn from the free vertices, or from all if there are too few. A set depends only on
    the seed and its count.
    """
    surface = surface_vertices(simulator.body.mesh)
    free = np.setdiff1d(surface, simulator.body.fixed_vertices)
    pool = free if count <= len(free) else surface
    random = np.random.default_rng([seed, count])
    return np.stack([random.choice(pool, count, replace=False) for _ in range(draws)])


def summarise_draws(
    count: int, errors_mm: NDArray[np.float64], misfits_mm: NDArray[np.float64]
) -> dict[str, Any]:
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
    from ..report.pages.ablation_page import write_ablation_report  # matplotlib

    run: RunSettings = context.settings
    body = build_body(run)
    mesh, fixed = body.mesh, body.fixed_vertices
    surface = surface_vertices(mesh)
    counts = {
        "vertices": len(mesh.vertices),
        "surface": len(surface),
        "free": len(np.setdiff1d(surface, fixed)),
    }
    write_ablation_report(context.run_dir / REPORT, _metrics(context.run_dir, run), run, **counts)


def _metrics(folder: Path, run: RunSettings) -> "AblationMetrics":
    """Contents of metrics.json: errors, time and memory of finished stages, versions and device."""
    return {
        **read_json(folder / SUMMARY),
        **resources_used(folder, _STAGES),
        "versions": package_versions(),
        "device": str(simulation_device(run.device)),
    }
