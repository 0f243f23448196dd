"""A beam beside Newton's solver by vertex block descent (VBD): the time of a step at equal error.

Both step the same tetrahedra. Their energies and masses are not quite the same, so each is judged by its own converged
solution: an error is the mean distance of the vertices from there, over all steps. Both make their launches as graphs;
a step of ours is one of a roll-out without gradients, in float64, the peer's are in float32.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
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
from ..experiment.schema import NATURAL, NATURALS, NUMBERS, POSITIVE, Group, Kind, check
from ..fem.body import Body
from ..io.errors import InputError
from ..io.files import write_json
from ..io.machine import hardware
from ..io.progress import Progress
from ..mesh.mesh import box_tetrahedra, select_vertices
from .benchmark import now
from .command import show, table_of

Positions = NDArray[np.float64]  # (T, N, 3) [m]
_CONVERGED: Final = 1e-11  # relative residual of our reference
_TIME_STEP: Final = Group({"size": POSITIVE, "count": NATURAL, "iterations": NATURALS})
_BOX: Final = Kind(lambda value: NUMBERS.fits(value) and len(value) == 3, "three lengths")
_LIST: Final = Kind(lambda value: isinstance(value, list) and bool(value), "a list of time steps")


@dataclass
class _Case:
    """A solver with a setting, and what was measured of it."""

    solver: str
    setting: str
    run: Callable[[], tuple[float, Positions]]  # seconds of a step, and where the vertices were
    reference: Positions
    seconds: list[float] = field(default_factory=list)
    error: float = 0.0  # mean distance [m]

    def measure(self) -> None:
        seconds, found = self.run()
        self.seconds.append(seconds)
        self.error = float(np.linalg.norm(found - self.reference, axis=-1).mean())

    def row(self) -> dict[str, Any]:
        return {
            "solver": self.solver,
            "setting": self.setting,
            "ms": 1e3 * median(self.seconds),
            "error_mm": 1e3 * self.error,
        }


def peer_study(config: Mapping[str, Any], folder: Path) -> None:
    """Prints a table for every Poisson's ratio and time step, and writes peer_study.json.

    Raises:
        InputError: a value that cannot be used, or Newton is not installed.
    """
    _check(config)
    _newton()
    found = []
    for ratio in config["poissons_ratios"]:
        for step in config["time_steps"]:
            rows = _compared(config, ratio, step)
            found.append({"poissons_ratio": ratio, "time_step": step["size"], "rows": rows})
            write_json(folder / "peer_study.json", {"hardware": hardware(), "found": found})
    show(*map(_table, found), f"Written: {folder / 'peer_study.json'}")


def _check(config: Mapping[str, Any]) -> None:
    check("size", config["size"], _BOX)
    check("divisions", config["divisions"], NATURALS)
    for key in ("poissons_ratios", "tolerances"):
        check(key, config[key], NUMBERS)
    for key in ("youngs_modulus", "density"):
        check(key, config[key], POSITIVE)
    for key in ("repeats", "converged_iterations"):
        check(key, config[key], NATURAL)
    check("time_steps", config["time_steps"], _LIST)
    for number, each in enumerate(config["time_steps"]):
        check(f"time_steps.{number}", each, _TIME_STEP)


def _newton() -> Any:
    try:
        import newton
    except ModuleNotFoundError:
        raise InputError("Newton is not installed: run pip install 'warp-resphys[peer]'.") from None
    return newton


def _compared(config: Mapping[str, Any], ratio: float, step: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows of ours and of the peer's, whose settings take turns."""
    ours, theirs = (
        _Ours(config, ratio, step["size"], step["count"]),
        _Theirs(config, ratio, step["size"], step["count"]),
    )
    converged = ours.runner(_CONVERGED)()[1]
    cases = [_Case("quasi_newton", f"{each:g}", ours.runner(each), converged) for each in config["tolerances"]]
    converged = theirs.runner(config["converged_iterations"])()[1]
    cases += [_Case("VBD", str(each), theirs.runner(each), converged) for each in step["iterations"]]
    with Progress(f"nu {ratio:g}, {1e3 * step['size']:g} ms", len(cases) * config["repeats"], "runs") as progress:
        for _ in range(config["repeats"]):
            for case in cases:
                case.measure()
                progress.advance()
    return [case.row() for case in cases]


class _Ours:
    """This simulator."""

    def __init__(self, config: Mapping[str, Any], ratio: float, step: float, steps: int) -> None:
        mesh = box_tetrahedra(config["size"], config["divisions"], order=1)
        self._body = Body(mesh, fixed=select_vertices(mesh, x=0.0))
        self._material = StableNeoHookean(
            density=config["density"], youngs_modulus=config["youngs_modulus"], poissons_ratio=ratio
        )
        self._step, self._steps, self._device = step, steps, config["device"]

    def runner(self, tolerance: float) -> Callable[[], tuple[float, Positions]]:
        """Makes roll-outs to a relative residual."""
        settings = SolverSettings(relative_tolerance=tolerance)
        simulator = Simulator(self._body, self._material, self._step, solver=settings, device=self._device)
        start = simulator.rest_state()

        @torch.no_grad()
        def run() -> tuple[float, Positions]:
            began = now(start.q.device)
            trajectory = simulator.rollout(start, self._steps)
            seconds = (now(start.q.device) - began) / self._steps
            return seconds, trajectory.q[1:, 0].cpu().numpy()

        run()  # Kernels and layouts are made once.
        return run


class _Theirs:
    """The peer's, of the same vertices and tetrahedra."""

    def __init__(self, config: Mapping[str, Any], ratio: float, step: float, steps: int) -> None:
        newton = _newton()
        mesh = box_tetrahedra(config["size"], config["divisions"], order=1)
        modulus = config["youngs_modulus"]
        builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, -9.80709))
        builder.add_soft_mesh(
            pos=wp.vec3(0.0, 0.0, 0.0),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(0.0, 0.0, 0.0),
            vertices=[wp.vec3(*each) for each in mesh.vertices],
            indices=mesh.cells.ravel().tolist(),
            density=config["density"],
            k_mu=modulus / (2.0 * (1.0 + ratio)),
            k_lambda=modulus * ratio / ((1.0 + ratio) * (1.0 - 2.0 * ratio)),
            k_damp=0.0,
            add_surface_mesh_edges=False,
        )
        for vertex in select_vertices(mesh, x=0.0):
            builder.particle_mass[vertex] = 0.0
            builder.particle_flags[vertex] &= ~int(newton.ParticleFlags.ACTIVE)
        builder.color()
        self._newton, self._device = newton, torch.device(config["device"])
        self._model = builder.finalize(device=str(self._device))
        self._step, self._steps = step, steps

    def runner(self, iterations: int) -> Callable[[], tuple[float, Positions]]:
        """Makes roll-outs with so many iterations a step, two steps a graph."""
        solver = self._newton.solvers.SolverVBD(self._model, iterations=iterations)
        control, rest = self._model.control(), self._model.state()
        states = [self._model.state(), self._model.state()]

        def step(k: int) -> None:
            states[k].clear_forces()
            solver.step(states[k], states[1 - k], control, None, self._step)

        for k in (0, 1):  # Kernels are compiled before a graph is made of them.
            step(k)
        with wp.ScopedCapture(device=str(self._device)) as capture:
            for k in (0, 1):
                step(k)

        def run() -> tuple[float, Positions]:
            for state in states:
                state.assign(rest)
            seconds, found = 0.0, []
            for _ in range(-(-self._steps // 2)):
                began = now(self._device)
                wp.capture_launch(capture.graph)
                wp.synchronize_device(str(self._device))
                seconds += now(self._device) - began
                found += [states[1 - k].particle_q.numpy().astype(np.float64) for k in (0, 1)]
            return seconds / len(found), np.array(found[: self._steps])

        return run


def _table(found: Mapping[str, Any]) -> Any:
    ours = [row for row in found["rows"] if row["solver"] != "VBD"]
    cells = []
    for row in found["rows"]:
        cells.append(
            [row["solver"], row["setting"], f"{row['ms']:.3g}", f"{row['error_mm']:.1e}", at_equal_error(row, ours)]
        )
    title = f"nu {found['poissons_ratio']:g}, steps of {1e3 * found['time_step']:g} ms"
    return table_of(title, ["solver", "setting", "step [ms]", "error [mm]", "ours at that error [ms]"], cells)


def at_equal_error(row: Mapping[str, Any], ours: Sequence[Mapping[str, Any]]) -> str:
    """The least time of ours with no more than a row's error, for a row of the peer's; a dash if there is none."""
    if row["solver"] != "VBD":
        return ""
    times = [each["ms"] for each in ours if each["error_mm"] <= row["error_mm"]]
    return f"{min(times):.3g}" if times else "-"
