"""The study of how many markers a reconstruction needs: its stages, and what it reports.

One motion is observed through random subsets of the surface vertices alone, and reconstructed from each of them.
"""

from collections.abc import Generator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ..data.markers import MarkerMap
from ..dynamics.integrator import State
from ..io.files import atomic_hdf5, create, read_array, read_hdf5, read_json, write_json, write_text
from ..io.memory import WorkersMemory
from ..io.processes import Advance, in_processes
from ..io.progress import Progress
from ..io.resumable import Field, ResumableHDF5
from ..io.stages import Stage, StageContext, package_versions, resources_used
from ..learning.reconstruction import make_reconstructor
from ..mesh.mesh import surface_vertices
from ..report.ablation_page import AblationReport, write_ablation_report
from ..report.page import number_text
from .build import build_mesh, build_simulator, choose_device
from .files import METRICS, REPORT
from .parts import processes_for
from .simulate import held_state

MOTION = "motion.h5"
DRAWS = "ablation.h5"
SUMMARY = "ablation.json"
TABLE = "ablation.csv"
_STAGES = ("generate", "ablation", "report")
_MM = 1e3


def ablation_stages(config: Mapping[str, Any], base: Mapping[str, Any], shown: Mapping[str, Any]) -> list[Stage]:
    """The stages of the study.

    Args:
        config: the whole configuration.
        base: the settings that every simulation depends on.
        shown: what the report says of the configuration.
    """

    def pick(*keys: str) -> dict[str, Any]:
        return {**base, **{key: config[key] for key in keys}}

    own = dict(config["ablation"])
    processes = min(processes_for(config, own.pop("processes")), len(own["counts"]))
    return [
        Stage("generate", generate_motion, (MOTION,), pick("target", "simulation", "data")),
        Stage(
            "ablation",
            partial(ablate, processes=processes),
            (DRAWS, SUMMARY, TABLE),
            {**pick("simulation", "reconstruction", "seed"), "ablation": own},
            ("generate",),
        ),
        Stage("report", report_ablation, (REPORT,), {"config": shown}, ("ablation",)),
    ]


def print_ablation(config: Mapping[str, Any], folder: Path) -> None:
    """Writes metrics.json and prints the errors."""
    metrics = collect_metrics(folder, config)
    write_json(folder / METRICS, metrics)
    table = Table("markers", "median [mm]", "quartiles [mm]", title="Error of the reconstructed motion, all vertices")
    for row in metrics["by_markers"]:
        quartiles = f"{number_text(row['lower_quartile_mm'])} to {number_text(row['upper_quartile_mm'])}"
        table.add_row(str(row["markers"]), number_text(row["median_mm"]), quartiles)
    console = Console()
    console.print(table)
    console.print(f"Report: {folder / REPORT}", soft_wrap=True)


def generate_motion(context: StageContext) -> None:
    """Writes motion.h5: q (T + 1, N, 3) from the held state on, and what the uncorrected simulator makes of it."""
    settings = context.settings
    data = settings["data"]
    target, simulation = (build_simulator(settings, name) for name in ("target", "simulation"))
    with torch.no_grad():
        start = held_state(target, data["load"], 1e-3 * np.array(data["weights_g"]["observed"]))
        motion = {"q": target.rollout(start, data["steps"]).q[:, 0]}
        motion["uncorrected_q"] = simulation.rollout(start, data["steps"]).q[:, 0]
    attributes = {"fingerprint": context.fingerprint, "time_step": settings["time_step"]}
    with atomic_hdf5(context.run_dir / MOTION, "motion", attributes) as file:
        for name, q in motion.items():
            create(file, name, q.cpu().numpy(), "m")


def ablate(context: StageContext, processes: int = 1) -> None:
    """Writes ablation.h5, with the sets of markers and the error of each at every step, and tables of the errors.

    Args:
        context: of the stage.
        processes: that share the numbers of markers; 1 for this one alone.
    """
    settings = context.settings
    counts, draws = settings["ablation"]["counts"], settings["ablation"]["draws"]
    motion, uncorrected = read_fields(context.run_dir / MOTION, "motion", "q", "uncorrected_q")
    steps = len(motion) - 1
    fields = {
        "count": Field((), "1", "int64"),
        "markers": Field((draws, max(counts)), "1", "int64"),  # -1 where a set is smaller
        "error": Field((draws, steps), "m"),
        "misfit": Field((draws, steps), "m"),
    }
    with (
        ResumableHDF5(context.run_dir / DRAWS, "marker ablation", context.fingerprint, len(counts), fields) as file,
        Progress("ablation", len(counts) * steps, "frames", file.done * steps) as progress,
    ):
        done = [int(file.read(step)["count"]) for step in range(file.done)]
        left = [(settings, context.run_dir / MOTION, count) for count in counts if count not in done]
        with closing(_each_count(left, processes, progress.advance, context.memory)) as results:
            for count, (vertices, error, misfit) in results:
                padded = np.pad(vertices, ((0, 0), (0, max(counts) - count)), constant_values=-1)
                file.append(count=count, markers=padded, error=error, misfit=misfit)
                done.append(count)
        file.finish(order=[counts.index(count) for count in done])
    error, misfit = (_MM * values.mean(-1) for values in read_fields(file.path, "marker ablation", "error", "misfit"))
    distance = np.linalg.norm(uncorrected[1:] - motion[1:], axis=-1).mean()
    rows = [summarise_draws(count, e, m) for count, e, m in zip(counts, error, misfit, strict=True)]
    write_json(context.run_dir / SUMMARY, {"uncorrected_mm": _MM * float(distance), "by_markers": rows})
    lines = ["markers,draw,error_mm,misfit_mm"]
    for count, e, m in zip(counts, error, misfit, strict=True):
        lines += [f"{count},{i},{a:.9g},{b:.9g}" for i, (a, b) in enumerate(zip(e, m, strict=True))]
    write_text(context.run_dir / TABLE, "\n".join(lines) + "\n")


def read_fields(path: Path, kind: str, *names: str) -> list[NDArray[np.float64]]:
    """The named datasets of a file."""
    with read_hdf5(path, kind) as file:
        return [read_array(file, name) for name in names]


_Task = tuple[Mapping[str, Any], Path, int]


def _each_count(
    tasks: Sequence[_Task], processes: int, advance: Advance, memory: WorkersMemory
) -> Generator[tuple[int, Any], None, None]:
    """Yields each number of markers with what `reconstruct_count` makes of it, in the order in which they finish."""
    if processes == 1:
        for task in tasks:
            yield task[-1], reconstruct_count(task, advance)
        return
    tasks = sorted(tasks, key=lambda task: -task[-1])  # The longest first, so that no process is left with it.
    with closing(in_processes(reconstruct_count, tasks, processes, advance, memory)) as results:
        for number, result in results:
            yield tasks[number][-1], result


def reconstruct_count(
    task: _Task, advance: Advance
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Sets of markers (draws, count), and the mean distances (draws, T) of all vertices and of the markers [m].

    Args:
        task: settings of the stage, file of the motion, number of markers.
        advance: told of each step.
    """
    settings, path, count = task
    wp.config.log_level = wp.LOG_WARNING
    simulator = build_simulator(settings, "simulation")
    (motion,) = read_fields(path, "motion", "q")
    vertices = draw_markers(simulator, count, settings["ablation"]["draws"], settings["seed"])
    return vertices, *_reconstruct(simulator, settings, vertices, simulator.tensor(motion), advance)


def draw_markers(simulator: Any, count: int, draws: int, seed: int) -> NDArray[np.int64]:
    """(draws, count) vertices of the surface, each set without repetition.

    They are drawn from those that are free, or from all where these are too few. A set depends on the seed and its
    count alone, not on the other counts.
    """
    surface = surface_vertices(simulator.body.mesh)
    free = np.setdiff1d(surface, simulator.body.fixed_vertices)
    pool = free if count <= len(free) else surface
    random = np.random.default_rng([seed, count])
    return np.stack([random.choice(pool, count, replace=False) for _ in range(draws)])


def _reconstruct(
    simulator: Any, settings: Mapping[str, Any], vertices: NDArray[np.int64], motion: torch.Tensor, advance: Advance
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean distances (draws, T) from the motion (T + 1, N, 3), of all vertices and of the markers [m]."""
    markers = MarkerMap.at_vertices(torch.as_tensor(vertices, device=motion.device), motion.dtype)
    modes = settings["ablation"]["modes"]
    reconstructor = make_reconstructor(simulator, **settings["reconstruction"], modes=modes, markers=markers)
    q = motion[0].expand(len(vertices), -1, -1).clone()
    state, force = State(q, torch.zeros_like(q)), torch.zeros_like(q)
    errors, misfits = [], []
    for frame in motion[1:]:
        observed = markers(frame.expand_as(q))
        result = reconstructor.step(state, observed, first_guess=force)
        state, force = result.state.detach(), result.force
        errors.append((state.q - frame).norm(dim=-1).mean(-1))
        misfits.append((markers(state.q) - observed).norm(dim=-1).mean(-1))
        advance(markers=vertices.shape[1], iterations=result.iterations)
    return torch.stack(errors, 1).cpu().numpy(), torch.stack(misfits, 1).cpu().numpy()


def summarise_draws(count: int, errors_mm: NDArray[np.float64], misfits_mm: NDArray[np.float64]) -> dict[str, Any]:
    """One row of the table: the spread of the draws' errors, and the errors themselves."""
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
    config = context.settings["config"]
    mesh = build_mesh(config["mesh"])
    surface = surface_vertices(mesh)
    fixed = build_simulator(config).body.fixed_vertices
    data = AblationReport(
        title=config["title"],
        experiment=config["name"],
        metrics=collect_metrics(context.run_dir, config),
        settings=config,
        vertices=len(mesh.vertices),
        surface=len(surface),
        free_surface=len(np.setdiff1d(surface, fixed)),
    )
    write_ablation_report(context.run_dir / REPORT, data)


def collect_metrics(folder: Path, config: Mapping[str, Any]) -> dict[str, Any]:
    """Errors, time and memory of the stages that are done, versions and device."""
    return {
        **read_json(folder / SUMMARY),
        **resources_used(folder, _STAGES),
        "versions": package_versions(),
        "device": str(choose_device("cpu" if config["device"] == "auto" else config["device"])),
    }
