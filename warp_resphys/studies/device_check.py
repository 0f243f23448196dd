"""Compares results of a device with those of the CPU, and writes a page of results."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import torch
import trimesh
import warp as wp

from ..dynamics.nonlinear_solver import SOLVERS, SolverName, SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.base import Energy
from ..energies.catalogue import make_material
from ..energies.contact import Contact
from ..energies.obstacles import Box, Cylinder, DistanceGrid
from ..energies.surfaces import SurfaceContact
from ..experiment.build import choose_device
from ..experiment.files import METRICS
from ..fem.body import Body
from ..fem.scene import Scene
from ..io.errors import ResphysError
from ..io.machine import hardware
from ..io.settings import Many, Natural, Positive, Settings, Word
from ..io.stages import run_lock
from ..linalg.choice import LINEAR_SOLVERS
from ..mesh.mesh import Mesh, select_vertices
from ..stepping.inputs import Inputs
from ..stepping.state import State
from .beam import ELEMENT_NAMES, Divisions, Element, beam_mesh, clamped
from .gradient_check import check_gradients, pose
from .runs import Results, Run, made, run_all
from .tables import Sheet, show

PAGE = "check.html"
POSITION_BOUND: Final = {torch.float64: 1e-8, torch.float32: 1e-5}  # m, over a trajectory
GRADIENT_BOUND: Final = 1e-6  # relative
RATIOS: Final = (0.45, 0.499)
_TOLERANCE: Final = {torch.float64: 1e-9, torch.float32: 1e-5}  # of the solvers that are compared
_MATERIAL: Final = {"youngs_modulus": 2.64e5, "density": 1070.0, "mass_damping": 0.5, "stiffness_damping": 0.002}
_CHANGE: Final = 1e-3  # of differences in contact, which begins and ends
_CPU_ONLY: Final = {"banded", "bordered"}


class CheckSettings(Settings):
    """The group ``check``; ``conf/verify_device.yaml`` explains its keys."""

    steps: Natural
    experiments: Many[Word]
    overrides: Many[Word]
    smaller: dict[Word, Many[Word]]
    minutes: Positive
    results: Word | None


class DeviceCheck(Settings):
    """The configuration ``verify_device``: checks of a device."""

    device: Word
    check: CheckSettings


class Check(NamedTuple):
    """A comparison and its outcome."""

    name: str
    result: str
    expected: str
    passed: bool


@dataclass(frozen=True)
class CheckGroup:
    """Checks of one kind and their duration [s]."""

    title: str
    checks: Sequence[Check]
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def sheet(self, title: str) -> Sheet:
        """The checks as a table."""
        rows = [[c.name, c.result, c.expected, "passed" if c.passed else "FAILED"] for c in self.checks]
        failed = [number for number, check in enumerate(self.checks) if not check.passed]
        return Sheet(title, ["check", "result", "expected", ""], rows, failed, note=f"{self.seconds:.0f} s")


def bounded(name: str, measure: Callable[[], float], bound: float, unit: str = "") -> Check:
    """Checks that a figure does not exceed a bound; an error while it is measured is a failure."""
    unit = f" {unit}" if unit else ""
    try:
        figure = measure()
    except (ResphysError, RuntimeError) as error:
        return Check(name, (str(error).strip() or repr(error)).splitlines()[0], "no error", False)
    return Check(name, f"{figure:.1e}{unit}", f"{bound:.0e}{unit}", figure <= bound)


def check_device(settings: DeviceCheck, folder: Path) -> None:
    """Prints the checks, and writes a page; exits with 1 where a check failed.

    Raises:
        InputError: an unknown device.
        RunsInterrupted: Ctrl-C in an experiment.
    """
    wp.config.log_level = wp.LOG_WARNING
    device, check = choose_device(settings.device), settings.check
    if device.type == "cpu":
        torch.set_num_threads(1)  # As in runs.
    work = {
        "Trajectories beside the CPU's": lambda: trajectory_checks(device, check.steps),
        "Gradients beside differences": lambda: gradient_checks(device),
        "Contact with obstacles": lambda: contact_checks(device, check.steps),
        "Memory of torch and Warp": lambda: memory_checks(device, check.steps),
    }
    if check.experiments:
        work["Experiments, one epoch and their roll-outs"] = lambda: experiment_checks(check, str(device), folder)
    with run_lock(folder):
        sections = [run_checks(title, checks) for title, checks in work.items()]
        place = hardware()["GPU" if device.type == "cuda" else "processor"]
        count = sum(len(section.checks) for section in sections)
        failed = sum(not check.passed for section in sections for check in section.checks)
        outcome = (
            f"{failed} of {count} checks on {place} failed." if failed else f"{count} checks on {place}: all passed."
        )
        tables = [section.sheet(section.title) for section in sections]
        date = f"{datetime.now():%Y-%m-%d}"
        parts = [*(table.for_page() for table in tables), made("verify device")]
        results = Results("Check of a device", date, outcome, parts)
        results.write(folder / PAGE, check.results, f"{date}-check-{device.type}")
    if failed:
        raise SystemExit(1)


def run_checks(title: str, checks: Callable[[], Iterator[Check]]) -> CheckGroup:
    """Runs checks of one kind and prints them."""
    began = time.perf_counter()
    done = list(checks())
    section = CheckGroup(title, done, time.perf_counter() - began)
    show(section.sheet(f"{title}, {section.seconds:.0f} s"))
    return section


def trajectory_checks(
    device: torch.device, steps: int, bounds: Mapping[torch.dtype, float] = POSITION_BOUND
) -> Iterator[Check]:
    """Compares solvers, in float64 and float32, with Newton's method on the CPU with LAPACK's banded factors."""
    for element, mesh in _meshes().items():
        for ratio in RATIOS:
            name, beam = f"{element}, nu {ratio:g}", partial(_beam, mesh, ratio)
            yield from _compared(name, beam, partial(_trajectory, steps=steps), device, SOLVERS, bounds)


def contact_checks(
    device: torch.device, steps: int, bounds: Mapping[torch.dtype, float] = POSITION_BOUND
) -> Iterator[Check]:
    """Compares beams between obstacles and on one another with those on the CPU, and gradients with differences."""
    solvers = [name for name in SOLVERS if name != "projective_dynamics"]  # it has no contact
    beam = partial(beam_between_obstacles, moves=True)
    yield from _compared("positions", beam, partial(pushed, steps=steps), device, solvers, bounds)
    solver = SolverSettings("newton", relative_tolerance=1e-12)
    resting = beam_between_obstacles(moves=False, solver=solver, device=device)
    own = {"q", "v", *(name for name in resting.parameters if name.startswith(("contact_", "obstacle_")))}
    measure = partial(_largest_error, resting, "rest", steps=2, change=_CHANGE, names=own)
    yield bounded("gradients", measure, GRADIENT_BOUND)
    yield from _compared("two beams", beam_on_beam, partial(sliding, steps=steps), device, solvers, bounds)
    upper = beam_on_beam(solver=solver, device=device)
    own = {"q", "v", "surface_stiffness", "surface_friction"}
    measure = partial(_largest_error, upper, "rest", steps=2, change=_CHANGE, names=own)
    yield bounded("gradients of two beams", measure, GRADIENT_BOUND)


def _compared(
    name: str,
    beam: Callable[..., Simulator],
    positions: Callable[[Simulator], torch.Tensor],
    device: torch.device,
    solvers: Sequence[SolverName],
    bounds: Mapping[torch.dtype, float],
) -> Iterator[Check]:
    """Compares the positions of a roll-out on a device, by solver, with those of Newton's method on the CPU."""
    exact = SolverSettings("newton", relative_tolerance=1e-11, linear_solver="banded")
    reference = positions(beam(solver=exact))
    others = [name for name in LINEAR_SOLVERS if name != "auto" and (device.type == "cpu" or name not in _CPU_ONLY)]
    cases = [
        *((solver, "auto", torch.float64) for solver in solvers),
        *(("quasi_newton", linear, torch.float64) for linear in others),
        ("quasi_newton", "auto", torch.float32),
    ]
    for solver, linear, dtype in cases:
        settings = SolverSettings(solver, _TOLERANCE[dtype], max_iterations=100_000, linear_solver=linear)
        case = partial(beam, solver=settings, device=device, dtype=dtype)
        title = f"{name}, {solver}, {linear}, {str(dtype).removeprefix('torch.')}"
        yield bounded(title, partial(_departure, case, positions, reference), bounds[dtype], "m")


def _departure(
    beam: Callable[[], Simulator], positions: Callable[[Simulator], torch.Tensor], reference: torch.Tensor
) -> float:
    """Largest distance [m] of a beam's vertices from those of a reference (T + 1, 2, N, 3) [m]."""
    return float(torch.linalg.vector_norm(positions(beam()).cpu().double() - reference, dim=-1).max())


def gradient_checks(device: torch.device) -> Iterator[Check]:
    """Compares adjoints with central differences, for every input and parameter."""
    solver = SolverSettings("quasi_newton", relative_tolerance=1e-12)
    for ratio in RATIOS:
        simulator = _beam(_meshes()["8-node hexahedra"], ratio, solver=solver, device=device)
        for name in ("rest", "twisted"):
            yield bounded(f"nu {ratio:g}, {name}", partial(_largest_error, simulator, name), GRADIENT_BOUND)


def _largest_error(simulator: Simulator, pose_name: str, **options: Any) -> float:
    return max(row.relative_error for row in check_gradients(simulator, pose_name, **options))


def memory_checks(device: torch.device, steps: int) -> Iterator[Check]:
    """Checks that kernels write into torch's memory, at the same address, and that states stay on the device."""
    simulator = _beam(_meshes()["8-node hexahedra"], 0.45, device=device)
    potential = simulator.workspace(2).parts[0][1].potential
    written: dict[str, Callable[[], torch.Tensor]] = {  # zero until a kernel has written them
        "residual": lambda: potential.residual,
        "tangent": lambda: potential.tangents[0],
        "energy": lambda: potential.energy,
    }
    before = {name: tensor() for name, tensor in written.items()}
    addresses = {name: tensor.data_ptr() for name, tensor in before.items()}
    empty = {name: not bool(tensor.any()) for name, tensor in before.items()}
    end = simulator.rollout(simulator.rest_state(2), steps, Inputs())
    for name, read in written.items():
        tensor = read()
        same = empty[name] and bool(tensor.any()) and tensor.data_ptr() == addresses[name]
        yield Check(f"{name}, written by kernels", "shared" if same else "copied", "shared", same)
    for name, tensor in {"positions": end.q, "velocities": end.v}.items():
        place = tensor.device.type
        yield Check(f"{name} of a roll-out", place, device.type, place == device.type)


def experiment_checks(settings: CheckSettings, device: str, folder: Path) -> Iterator[Check]:
    """Checks that experiments finish, by the command ``run``, in folders below that of the check."""
    runs = []
    for name in settings.experiments:
        overrides = (*settings.overrides, *settings.smaller.get(name, ()), f"device={device}")
        runs.append(Run(name, "", (f"experiment={name}", *overrides), folder / "runs" / name, settings.minutes))
    for run in run_all(runs, folder / "logs"):
        finished = run.failure is None and (run.folder / METRICS).is_file()
        yield Check(run.experiment, run.failure or "finished", "finished", finished)


def _meshes() -> dict[str, Mesh]:
    size = (0.1, 0.03, 0.03)  # m
    divisions: dict[Element, Divisions] = {"hexahedron8": (10, 3, 3), "tetrahedron10": (5, 2, 2)}
    return {ELEMENT_NAMES[element]: beam_mesh(element, size, counts) for element, counts in divisions.items()}


def _beam(mesh: Mesh, poissons_ratio: float, energies: Sequence[Energy] = (), **options: Any) -> Simulator:
    material = make_material("corotated", **_MATERIAL, poissons_ratio=poissons_ratio)
    return Simulator(clamped(mesh, energies=energies), material, 0.01, **options)


def beam_between_obstacles(moves: bool, **options: Any) -> Simulator:
    """A beam, 30 mm thick, between a bar, a plate and a ball on a grid, on which its weight makes it slide."""
    ball = trimesh.creation.icosphere(radius=0.01)
    obstacles = {
        "bar": Cylinder(position=(0.05, 0.015, -0.0106), axis=(0.0, 1.0, 0.0), radius=0.01, length=0.06),
        "plate": Box(position=(0.09, 0.015, -0.0107), edges=(0.04, 0.04, 0.02), moves=moves),
        "ball": DistanceGrid.of_surface(ball.vertices, ball.faces, 1e-3, position=(0.067, 0.0163, 0.0407)),
    }
    contact = Contact(obstacles, stiffness=1e5, friction={"bar": 0.3, "plate": 0.6, "ball": 0.2}, slip_speed=2e-2)
    mesh = beam_mesh("hexahedron8", (0.1, 0.03, 0.03), (6, 2, 2))
    return _beam(mesh, 0.45, [contact], gravity=(1.0, 4.0, -9.0), **options)


def beam_on_beam(**options: Any) -> Simulator:
    """A beam that its weight presses on a thicker one and along it, with friction."""
    upper, lower = (beam_mesh("hexahedron8", (0.1, 0.03, z), (4, 1, 1)) for z in (0.03, 0.05))
    below = replace(lower, vertices=lower.vertices + [0.0013, 0.0017, -0.0507])
    bodies = {"upper": clamped(upper), "lower": Body(below, fixed=select_vertices(below, x=0.0013))}
    scene = Scene(bodies, SurfaceContact(stiffness=1e5, friction=0.3, slip_speed=2e-2))
    material = make_material("corotated", **_MATERIAL, poissons_ratio=0.45)
    return Simulator(scene, material, 0.01, (1.0, 4.0, -9.0), **options)


def sliding(simulator: Simulator, steps: int) -> torch.Tensor:
    """Positions (T + 1, 2, N, 3) [m] of bodies that begin at rest, and with a speed."""
    rest = simulator.rest_state(2)
    speed = simulator.tensor([[0.0, 0.0, 0.0], [0.0, 0.1, -0.05]])[:, None]
    with torch.no_grad():
        v = (speed * torch.ones_like(rest.v)).index_fill(1, simulator.fixed, 0.0)
        return simulator.rollout(State(rest.q, v), steps).q


def pushed(simulator: Simulator, steps: int) -> torch.Tensor:
    """Positions (T + 1, 2, N, 3) [m] of two beams on plates that rise and move aside at different speeds."""
    ways = simulator.tensor([1e-4, 2e-4]) * torch.arange(1, 1 + steps, device=simulator.device)[:, None]
    plate = simulator.tensor([0.0, 1.0, 0.0])
    rise = ways[..., None] * plate  # (T, 2, 3)
    with torch.no_grad():
        inputs = Inputs(obstacle_move_z=rise, obstacle_move_y=2.0 * rise)
        return simulator.rollout(simulator.rest_state(2), steps, inputs).q


def _trajectory(simulator: Simulator, steps: int) -> torch.Tensor:
    """Positions (T + 1, 2, N, 3) [m] of two beams that are released from different bends."""
    with torch.no_grad():
        return simulator.rollout(pose(simulator, "bent", 2), steps, Inputs()).q
