"""Whether a device computes what the CPU does, and how fast: one command, and a page on what it found."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Final

import torch
import warp as wp

from ..dynamics.nonlinear_solver import SOLVERS, SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.materials import make_material
from ..experiment.build import choose_device
from ..experiment.files import METRICS
from ..experiment.schema import NATURAL, POSITIVE, WORD, Group, check, optional
from ..fem.body import Body
from ..io.errors import ResphysError
from ..io.files import write_json
from ..io.stages import run_lock
from ..linalg.choice import LINEAR_SOLVERS
from ..mesh.mesh import Mesh, box_hexahedra, box_tetrahedra, select_vertices
from ..report.page import Cell, Part, Row, Table
from ..stepping.inputs import Inputs
from .benchmark import run_benchmark
from .benchmark_tables import benchmark_sheets, machine
from .command import WORDS, show, table_of
from .gradient_check import check_gradients, pose
from .runs import Results, Run, made, run_all

PAGE = "check.html"
POSITION_BOUND: Final = {torch.float64: 1e-8, torch.float32: 1e-5}  # m, over a trajectory
GRADIENT_BOUND: Final = 1e-6  # relative
_TOLERANCE: Final = {torch.float64: 1e-9, torch.float32: 1e-5}  # of the solvers that are compared
_SIZE: Final = (0.1, 0.03, 0.03)  # m
_MATERIAL: Final = {"youngs_modulus": 2.64e5, "density": 1070.0, "mass_damping": 0.5, "stiffness_damping": 0.002}
_CPU_ONLY: Final = {"banded"}
_KEYS: Final = Group(
    {"steps": NATURAL, "experiments": WORDS, "overrides": WORDS, "minutes": POSITIVE, "results": optional(WORD)}
)


@dataclass
class Section:
    """Checks of one kind."""

    title: str
    rows: list[tuple[str, str, str, bool]] = field(default_factory=list)  # what, found, asked, whether it passed
    seconds: float = 0.0

    def bound(self, name: str, found: float, most: float, unit: str = "") -> None:
        """A figure that must not exceed another."""
        unit = f" {unit}" if unit else ""
        self.rows.append((name, f"{found:.1e}{unit}", f"{most:.0e}{unit}", found <= most))

    def attempt(self, name: str, measure: Callable[[], tuple[float, float, str]]) -> None:
        """A figure, its bound and their unit; or the error that comes in its place."""
        try:
            self.bound(name, *measure())
        except (ResphysError, RuntimeError) as error:
            self.rows.append((name, (str(error).strip() or repr(error)).splitlines()[0], "no error", False))

    @property
    def passed(self) -> bool:
        """Whether all did."""
        return all(row[3] for row in self.rows)


def check_device(config: Mapping[str, Any], folder: Path) -> None:
    """Prints the checks and the benchmark, and writes a page; exits with 1 where a check failed.

    Raises:
        InputError: a value that cannot be used.
        RunsInterrupted: Ctrl-C in an experiment.
    """
    settings = config["check"]
    check("check", settings, _KEYS)
    wp.config.log_level = wp.LOG_WARNING
    device = choose_device(config["device"])
    config = {**config, "device": str(device)}
    sections: list[Section] = []
    with run_lock(folder):
        for title, work in _SECTIONS.items():
            with _timed(title, sections) as section:
                work(section, device, settings["steps"])
            show(_table(section))
        if settings["experiments"]:
            with _timed("Experiments, one epoch and their roll-outs", sections) as section:
                _run_experiments(section, settings, str(device), folder)
            show(_table(section))
        measured = run_benchmark(config)
        write_json(folder / "benchmark.json", measured)
        show(*(sheet.for_terminal() for sheet in benchmark_sheets(measured)))
        _write(sections, measured, config, folder)
    if not all(section.passed for section in sections):
        raise SystemExit(1)


@contextmanager
def _timed(title: str, sections: list[Section]) -> Iterator[Section]:
    section = Section(title)
    sections.append(section)
    began = time.perf_counter()
    yield section
    section.seconds = time.perf_counter() - began


def _meshes() -> dict[str, Mesh]:
    return {
        "8-node hexahedra": box_hexahedra(_SIZE, (10, 3, 3)),
        "10-node tetrahedra": box_tetrahedra(_SIZE, (5, 2, 2), order=2),
    }


def _beam(mesh: Mesh, poissons_ratio: float, **options: Any) -> Simulator:
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0))
    return Simulator(body, make_material("corotated", **_MATERIAL, poissons_ratio=poissons_ratio), 0.01, **options)


def _trajectory(simulator: Simulator, steps: int, batch: int = 2) -> torch.Tensor:
    """(T + 1, B, N, 3) of a beam that is let go from a bend, and one that is let go from a smaller one [m]."""
    with torch.no_grad():
        return simulator.rollout(pose(simulator, "bent", batch), steps, Inputs()).q


def _trajectories(section: Section, device: torch.device, steps: int) -> None:
    """Every solver in both types against Newton's method on the CPU with LAPACK's banded factors."""
    for element, mesh in _meshes().items():
        for ratio in (0.45, 0.499):
            exact = SolverSettings("newton", relative_tolerance=1e-11, linear_solver="banded")
            reference = _trajectory(_beam(mesh, ratio, solver=exact), steps)
            cases = [(solver, "auto", torch.float64) for solver in SOLVERS]
            others = [
                name for name in LINEAR_SOLVERS if name != "auto" and (device.type == "cpu" or name not in _CPU_ONLY)
            ]
            cases += [("quasi_newton", name, torch.float64) for name in others]
            cases += [("quasi_newton", "auto", torch.float32)]
            for solver, linear, dtype in cases:
                name = f"{element}, nu {ratio:g}, {solver}, {linear}, {str(dtype).removeprefix('torch.')}"
                section.attempt(name, partial(_departure, mesh, ratio, solver, linear, dtype, device, reference))


def _departure(
    mesh: Mesh,
    ratio: float,
    solver: str,
    linear: str,
    dtype: torch.dtype,
    device: torch.device,
    reference: torch.Tensor,
) -> tuple[float, float, str]:
    settings = SolverSettings(
        solver, relative_tolerance=_TOLERANCE[dtype], linear_solver=linear, max_iterations=100_000
    )
    simulator = _beam(mesh, ratio, solver=settings, device=device, dtype=dtype)
    found = _trajectory(simulator, len(reference) - 1).cpu().double()
    return float(torch.linalg.vector_norm(found - reference, dim=-1).max()), POSITION_BOUND[dtype], "m"


def _gradients(section: Section, device: torch.device, steps: int) -> None:
    """Adjoints against central differences, for every input and parameter."""
    del steps
    mesh = _meshes()["8-node hexahedra"]
    for ratio in (0.45, 0.499):
        for name in ("rest", "twisted"):
            settings = SolverSettings("quasi_newton", relative_tolerance=1e-12)

            def largest(
                ratio: float = ratio, name: str = name, settings: SolverSettings = settings
            ) -> tuple[float, float, str]:
                rows = check_gradients(_beam(mesh, ratio, solver=settings, device=device), name)
                return max(row.relative_error for row in rows), GRADIENT_BOUND, ""

            section.attempt(f"nu {ratio:g}, {name}", largest)


def _shared_memory(section: Section, device: torch.device, steps: int) -> None:
    """What kernels write is in torch's memory, where it was from the start, and nothing leaves the device."""
    simulator = _beam(_meshes()["8-node hexahedra"], 0.45, device=device)
    potential = simulator.workspace(2).parts[0][1].potential
    names = ("residual", "tangent", "energy")  # zero until a kernel has written them
    before = {name: getattr(potential, name) for name in names}
    addresses = {name: tensor.data_ptr() for name, tensor in before.items()}
    empty = {name: not bool(tensor.any()) for name, tensor in before.items()}
    end = simulator.rollout(simulator.rest_state(2), steps, Inputs())
    for name in names:
        tensor = getattr(potential, name)
        same = empty[name] and bool(tensor.any()) and tensor.data_ptr() == addresses[name]
        section.rows.append((f"{name}, written by kernels", "shared" if same else "copied", "shared", same))
    for name, tensor in {"positions": end.q, "velocities": end.v}.items():
        there = tensor.device.type == device.type
        section.rows.append((f"{name} of a roll-out", tensor.device.type, device.type, there))


_SECTIONS: Final[Mapping[str, Callable[[Section, torch.device, int], None]]] = {
    "Trajectories beside the CPU's": _trajectories,
    "Gradients beside differences": _gradients,
    "Memory of torch and Warp": _shared_memory,
}


def _run_experiments(section: Section, settings: Mapping[str, Any], device: str, folder: Path) -> None:
    """Each through the ordinary command, in a folder below that of the check."""
    overrides = (*settings["overrides"], f"device={device}")
    runs = [
        Run(name, "", (f"experiment={name}", *overrides), folder / "runs" / name, settings["minutes"])
        for name in settings["experiments"]
    ]
    for run in run_all(runs, folder / "logs"):
        found = run.failure or "finished"
        section.rows.append(
            (run.experiment, found, "finished", run.failure is None and (run.folder / METRICS).is_file())
        )


def _table(section: Section) -> Any:
    table = table_of(f"{section.title}, {section.seconds:.0f} s", ["check", "found", "asked", ""], [])
    for name, found, asked, passed in section.rows:
        table.add_row(name, found, asked, "passed" if passed else "FAILED", style=None if passed else "red")
    return table


def _write(sections: Sequence[Section], measured: Mapping[str, Any], config: Mapping[str, Any], folder: Path) -> None:
    checks = [
        Part(
            section.title,
            [
                Table(
                    "Check",
                    ["Found", "Asked", ""],
                    [
                        Row(name, [Cell(found), Cell(asked), Cell("passed" if passed else "FAILED")])
                        for name, found, asked, passed in section.rows
                    ],
                    note=f"{section.seconds:.0f} s",
                )
            ],
        )
        for section in sections
    ]
    speed = [sheet.for_page() for sheet in benchmark_sheets(measured)]
    failed = sum(not row[3] for section in sections for row in section.rows)
    count = sum(len(section.rows) for section in sections)
    where = machine(measured)
    verdict = (
        f"{count} checks on {where}: all passed." if not failed else f"{failed} of {count} checks on {where} failed."
    )
    date = f"{datetime.now():%Y-%m-%d}"
    results = Results("Check of a device", date, verdict, [*checks, *speed, made("verify device")])
    copies = config["check"]["results"]
    results.write(folder / PAGE, copies, f"{date}-check-{choose_device(config['device']).type}")
