"""A beam beside Newton's solver by vertex block descent (VBD): the time of a step at equal error.

Both simulate the same tetrahedra. Their energies and masses differ slightly, so each is compared with its own converged
solution: the error is the mean distance of the vertices from it, over all steps. Both launch their kernels as graphs.
Our steps are those of a roll-out without gradients in float64; the peer computes in float32.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.materials import StableNeoHookean
from ..io.errors import InputError
from ..io.files import write_json
from ..io.machine import hardware
from ..io.progress import Progress
from ..io.settings import Natural, Positive, Settings, Some, Word, setting
from ..mesh.mesh import Mesh, select_vertices
from .beam import BeamStudy, Divisions, beam_mesh, clamped
from .tables import Sheet, show
from .timing import now

Positions = NDArray[np.float64]  # (T, N, 3) [m]
Run = Callable[[], tuple[float, Positions]]  # returns seconds of a step and the positions of the vertices
_CONVERGED: Final = 1e-11  # relative residual of our reference
_IN_A_GRAPH: Final = 1000  # most iterations a step: CUDA refuses a graph of ten times as many


class TimeStep(Settings):
    """Time steps of one length."""

    size: Positive = setting(unit="s")
    count: Natural
    iterations: Some[Natural]  # of the peer


class PeerStudy(BeamStudy):
    """The configuration ``benchmark_peers``, which explains its keys."""

    divisions: Divisions
    density: Positive = setting(unit="kg/m^3")
    time_steps: Some[TimeStep]
    converged_iterations: Natural
    tolerances: Some[Positive]
    device: Word


def peer_study(study: PeerStudy, folder: Path) -> None:
    """Prints a table for every Poisson's ratio and time step, and writes peer_study.json.

    Raises:
        InputError: Newton is not installed.
    """
    peer_package("newton")
    results = []
    for ratio in study.poissons_ratios:
        for step in study.time_steps:
            results.append({"poissons_ratio": ratio, "time_step": step.size, "rows": _compare(study, ratio, step)})
            write_json(folder / "peer_study.json", {"hardware": hardware(), "found": results})
    show(*map(_table, results), f"Written: {folder / 'peer_study.json'}")


def peer_package(name: str) -> Any:
    """Returns the package of a peer.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError:
        message = f"The package {name} is not installed: run pip install 'warp-resphys[peer]'."
        raise InputError(message) from None


def newton_model(mesh: Mesh, density: float, modulus: float, ratio: float, gravity: float) -> Any:
    """Returns a builder of Newton with tetrahedra, whose contact begins at the surface. Gravity acts along -z."""
    newton = peer_package("newton")
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, -gravity))
    builder.add_soft_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*vertex) for vertex in mesh.vertices],
        indices=mesh.cells.ravel().tolist(),
        density=density,
        k_mu=modulus / (2.0 * (1.0 + ratio)),
        k_lambda=modulus * ratio / ((1.0 + ratio) * (1.0 - 2.0 * ratio)),
        k_damp=0.0,
        add_surface_mesh_edges=False,
        particle_radius=0.0,
    )
    return builder


def graph_of(steps: Callable[[], None], device: torch.device) -> Callable[[], object]:
    """Takes steps once, which compiles their kernels, and returns what launches them as a graph."""
    steps()
    with wp.ScopedCapture(device=str(device)) as capture:
        steps()
    return partial(wp.capture_launch, capture.graph)


def newton_positions(states: Sequence[Any]) -> list[Positions]:
    """Positions (N, 3) after a first step, whose state is the last one, and a second."""
    return [state.particle_q.numpy().astype(np.float64) for state in reversed(states)]


def advance(
    launch: Callable[[], object], read: Callable[[], list[Positions]], steps: int, device: torch.device
) -> tuple[float, Positions]:
    """Launches steps until there are enough, and returns seconds a step and the positions (T, N, 3) after every one."""
    seconds, positions = 0.0, list[Positions]()
    while len(positions) < steps:
        began = now(device)
        launch()
        seconds += now(device) - began
        positions += read()
    return seconds / len(positions), np.array(positions[:steps])


def _compare(study: PeerStudy, ratio: float, step: TimeStep) -> list[dict[str, Any]]:
    """Rows of our solver and of the peer's; their runs take turns."""
    mesh = beam_mesh("tetrahedron4", study.size, study.divisions)
    settings = {
        "quasi_newton": (_ours(study, mesh, ratio, step), _CONVERGED, study.tolerances),
        "VBD": (_theirs(study, mesh, ratio, step), study.converged_iterations, step.iterations),
    }
    cases = []
    for solver, (prepare, best, values) in settings.items():
        _, reference = prepare(best)()
        cases += [(solver, f"{value:g}", prepare(value), reference, list[float]()) for value in values]
    rows = {}
    with Progress(f"nu {ratio:g}, {1e3 * step.size:g} ms", len(cases) * study.repeats, "runs") as progress:
        for _ in range(study.repeats):
            for solver, value, run, reference, seconds in cases:
                duration, positions = run()
                seconds.append(duration)
                error = 1e3 * float(np.linalg.norm(positions - reference, axis=-1).mean())
                row = {"solver": solver, "setting": value, "ms": 1e3 * median(seconds), "error_mm": error}
                rows[solver, value] = row
                progress.advance()
    return list(rows.values())


def _ours(study: PeerStudy, mesh: Mesh, ratio: float, step: TimeStep) -> Callable[[float], Run]:
    """Prepares roll-outs of this simulator for a relative residual."""
    body = clamped(mesh)
    material = StableNeoHookean(density=study.density, youngs_modulus=study.youngs_modulus, poissons_ratio=ratio)

    def prepare(tolerance: float) -> Run:
        solver = SolverSettings(relative_tolerance=tolerance)
        simulator = Simulator(body, material, step.size, solver=solver, device=study.device)
        start = simulator.rest_state()

        @torch.no_grad()
        def run() -> tuple[float, Positions]:
            began = now(start.q.device)
            trajectory = simulator.rollout(start, step.count)
            seconds = (now(start.q.device) - began) / step.count
            return seconds, trajectory.q[1:, 0].cpu().numpy()

        run()  # makes kernels and layouts
        return run

    return prepare


def _theirs(study: PeerStudy, mesh: Mesh, ratio: float, step: TimeStep) -> Callable[[float], Run]:
    """Prepares roll-outs of the peer for a number of iterations a step; a graph holds two steps, if it can."""
    newton, device = peer_package("newton"), torch.device(study.device)
    builder = newton_model(mesh, study.density, study.youngs_modulus, ratio, 9.80709)
    for vertex in select_vertices(mesh, x=0.0):
        builder.particle_mass[vertex] = 0.0
        builder.particle_flags[vertex] &= ~int(newton.ParticleFlags.ACTIVE)
    builder.color()
    model = builder.finalize(device=str(device))

    def prepare(iterations: float) -> Run:
        solver = newton.solvers.SolverVBD(model, iterations=int(iterations))
        control, rest = model.control(), model.state()
        states = [model.state(), model.state()]

        def two_steps() -> None:
            for before, after in (states, reversed(states)):
                before.clear_forces()
                solver.step(before, after, control, None, step.size)

        launch: Callable[[], object] = two_steps
        if iterations <= _IN_A_GRAPH:
            launch = graph_of(two_steps, device)
        else:
            two_steps()  # compiles the kernels

        def run() -> tuple[float, Positions]:
            for state in states:
                state.assign(rest)
            return advance(launch, partial(newton_positions, states), step.count, device)

        return run

    return prepare


def _table(result: Mapping[str, Any]) -> Sheet:
    ours = [row for row in result["rows"] if row["solver"] != "VBD"]
    columns = (
        "solver {solver} | setting {setting} | step [ms] {ms:.3g} | error [mm] {error_mm:.1e} | "
        "ours at that error [ms] {ours}"
    )
    title = f"nu {result['poissons_ratio']:g}, steps of {1e3 * result['time_step']:g} ms"
    return Sheet.of(title, columns, [{**row, "ours": at_equal_error(row, ours)} for row in result["rows"]])


def at_equal_error(row: Mapping[str, Any], ours: Sequence[Mapping[str, Any]], time: str = "ms") -> str:
    """Our least time at no more than the error of a row of a peer's, as text; a dash if none reaches it."""
    if row["solver"] in {own["solver"] for own in ours}:
        return ""
    times = [own[time] for own in ours if own["error_mm"] <= row["error_mm"]]
    return f"{min(times):.3g}" if times else "-"
