"""Checks a device in two minutes: motions beside those on a CPU,
gradients beside differences, and the time of a step.

The motions are those of Newton's method with LAPACK's banded factors on the CPU, whose mean heights
at the end are also stored here. Other solvers, precisions and batches on the device must give the
same.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
import trimesh
import warp as wp

from ..core.dynamics.gradient_check import check_gradients, pose
from ..core.dynamics.simulator import Simulator
from ..core.dynamics.solver_settings import SolverName, SolverSettings
from ..core.energies.contact.obstacle_contact import Contact
from ..core.energies.contact.obstacles import DistanceGrid
from ..core.energies.contact.surface_contact import SurfaceContact
from ..core.energies.contact.touching_bodies import Box, Cylinder
from ..core.energies.fibres import Fibres
from ..core.energies.materials import Corotated
from ..core.energies.pressure import Pressure
from ..core.energies.tendons import Tendons
from ..core.fem.bodies import Body
from ..core.fem.scene import Scene
from ..core.linalg.choice import LINEAR_SOLVERS
from ..core.linalg.pardiso import has_pardiso
from ..core.linalg.solver_names import LinearSolverName
from ..core.mesh.boxes import box_hexahedra, box_tetrahedra
from ..core.mesh.chambers import find_chambers
from ..core.mesh.selection import select_vertices
from ..core.mesh.volume_mesh import Mesh
from ..core.stepping.inputs import Inputs
from ..core.stepping.state import State
from ..experiment.build import choose_device
from ..io.errors import ResphysError
from ..io.progress import Progress, show
from ..io.settings import Settings, Word, setting
from ..report.page import PageTable

SIZE: Final = (0.1, 0.03, 0.03)  # of a beam [m]
BATCH, STEPS = 3, 4  # of a motion
_TIMED, _TIMED_STEPS = (1, 64), 10  # beams in a batch
POSITION_BOUND: Final = {torch.float64: 1e-8, torch.float32: 1e-5}  # m
GRADIENT_BOUND: Final = 1e-6  # relative
_TOLERANCE: Final = {torch.float64: 1e-9, torch.float32: 1e-5}  # of the solvers that are compared
_MATERIAL: Final = Corotated(
    youngs_modulus=2.64e5,
    poissons_ratio=0.45,
    density=1070.0,
    mass_damping=0.5,
    stiffness_damping=2e-3,
)


class CheckSettings(Settings):
    """The configuration ``check``."""

    device: Word = setting(description="auto, cpu or cuda")


class Check(NamedTuple):
    """A comparison and its outcome."""

    name: str
    result: str
    allowed: str
    passed: bool


class Gradients(NamedTuple):
    """Gradients that are compared, with options of `check_gradients`."""

    simulator: Callable[..., Simulator]
    start: str
    change: float = 1.0
    of: tuple[str, ...] = ()  # how parameters begin, besides q and v; empty for all, and the inputs


def check(settings: CheckSettings, folder: Path) -> None:
    """Prints the checks and the times of a step.

    Exits with 1 where a check failed, and refuses an unknown device.
    """
    wp.config.log_level = wp.LOG_WARNING
    device, began = choose_device(settings.device), time.perf_counter()
    if device.type == "cpu":
        torch.set_num_threads(1)
    checks = list[Check]()
    with Progress("check", total=len(MOTIONS) + len(GRADIENTS), unit="parts") as progress:
        for name in MOTIONS:
            checks += motion_checks(name, device)
            progress.advance()
        for name in GRADIENTS:
            checks.append(
                bounded(f"{name}, gradients", partial(gradient_error, name, device), GRADIENT_BOUND)
            )
            progress.advance()
    rows = [
        [one.name, one.result, one.allowed, "passed" if one.passed else "FAILED"] for one in checks
    ]
    failed = [one for one in checks if not one.passed]
    place = torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU"
    show(
        PageTable.plain(f"Largest errors on {place}", ["check", "error", "allowed", ""], rows),
        speed_table(device),
    )
    outcome = (
        f"{len(failed)} of {len(rows)} checks failed"
        if failed
        else f"All {len(rows)} checks passed"
    )
    show(f"{outcome}, in {time.perf_counter() - began:.0f} s.")
    if failed:
        raise SystemExit(1)


def bounded(name: str, measure: Callable[[], float], bound: float, unit: str = "") -> Check:
    """Compares a figure with the bound that it must not exceed.

    An error on the way is a failure.
    """
    try:
        figure = measure()
    except (ResphysError, RuntimeError) as error:
        return Check(name, (str(error).strip() or repr(error)).splitlines()[0], "no error", False)
    return Check(name, f"{figure:.1e} {unit}", f"{bound:.0e} {unit}", figure <= bound)


def motion_checks(name: str, device: torch.device) -> Iterator[Check]:
    """Compares a motion on a device, by solver and precision,
    and alone in its batch, with that on the CPU.
    """
    build, height = MOTIONS[name]
    exact = SolverSettings(name="newton", relative_tolerance=1e-11, linear_solver="banded")
    reference, most = positions(build(solver=exact)), POSITION_BOUND[torch.float64]
    yield bounded(
        f"{name}, height on the CPU",
        lambda: abs(float(reference[-1, ..., 2].mean()) - height),
        most,
        "m",
    )

    def error(environments: slice, **options: Any) -> float:
        moved = positions(build(device=device, **options), environments)
        return float(torch.linalg.vector_norm(moved - reference[:, environments], dim=-1).max())

    # On a GPU, the banded solver is the tiled one.
    absent = ("pardiso",) * (not has_pardiso()) if device.type == "cpu" else ("tiled", "pardiso")
    solvers: list[LinearSolverName] = [linear for linear in LINEAR_SOLVERS if linear not in absent]
    cases: list[tuple[SolverName, LinearSolverName, torch.dtype]] = [
        ("newton", "auto", torch.float64)
    ]
    cases += [("quasi_newton", "auto", torch.float32)]
    cases += [
        ("quasi_newton", linear, torch.float64)
        for linear in (solvers if name in EVERY_SOLVER else solvers[:1])
    ]
    cases += [("projective_dynamics", "auto", torch.float64)] * (name == "hexahedra")
    for solver, linear, dtype in cases:
        settings = SolverSettings(
            name=solver,
            relative_tolerance=_TOLERANCE[dtype],
            max_iterations=100_000,
            linear_solver=linear,
        )
        measure = partial(error, slice(None), solver=settings, dtype=dtype)
        title = f"{name}, {solver}, {linear}, {str(dtype).removeprefix('torch.')}"
        yield bounded(title, measure, POSITION_BOUND[dtype], "m")
    alone = partial(error, slice(BATCH - 1, BATCH), solver=SolverSettings(relative_tolerance=1e-9))
    yield bounded(f"{name}, the last one alone", alone, most, "m")


@torch.no_grad()
def positions(simulator: Simulator, environments: slice = slice(None)) -> torch.Tensor:
    """Positions (STEPS + 1, B, N, 3) of chosen environments,
    which differ in start and inputs, on the CPU [m].

    They begin bent, where that is free of contact, or at rest with a speed. Inputs rise from zero.
    """
    rest, share = simulator.rest_state(BATCH), simulator.tensor(np.linspace(0.0, 1.0, BATCH))
    speed = share[:, None, None] * simulator.tensor([0.0, 0.1, -0.05])
    moving = State(rest.q, (speed * torch.ones_like(rest.v)).index_fill(1, simulator.fixed, 0.0))
    start = (
        moving
        if simulator.inputs or isinstance(simulator.body, Scene)
        else pose(simulator, "bent", BATCH)
    )
    rise = simulator.tensor(np.arange(1, 1 + STEPS) / STEPS)[:, None, None] * (
        0.3 + share[environments, None]
    )
    levels = {
        name: rise * simulator.tensor(level)
        for name, level in LEVELS.items()
        if name in simulator.inputs
    }
    state = State(start.q[environments], start.v[environments])
    return simulator.rollout(state, STEPS, Inputs(**levels)).q.cpu().double()


def gradient_error(name: str, device: torch.device) -> float:
    """Largest relative error of adjoints of two steps on a device, beside central differences."""
    gradients = GRADIENTS[name]
    simulator = gradients.simulator(
        solver=SolverSettings(name="newton", relative_tolerance=1e-12), device=device
    )
    names = (
        {"q", "v", *(name for name in simulator.parameters if name.startswith(gradients.of))}
        if gradients.of
        else None
    )
    rows = check_gradients(
        simulator, gradients.start, steps=2, change=gradients.change, names=names
    )
    return max(row.relative_error for row in rows)


def speed_table(device: torch.device) -> PageTable:
    """Milliseconds of a step of a batch of beams and of its gradient,
    on the CPU and on the device beside it.
    """
    devices = dict.fromkeys((torch.device("cpu"), device))
    rows = []
    for batch in _TIMED:
        for what, *figures in zip(
            ("step", "gradient"), *(milliseconds(one, batch) for one in devices), strict=True
        ):
            faster = [f"{figures[0] / figure:.1f}" for figure in figures[1:]]
            rows.append([f"{what} of {batch}", *(f"{figure:.2f}" for figure in figures), *faster])
    columns = [str(one) for one in devices] + ["times as fast"] * (len(devices) - 1)
    return PageTable.plain(
        "Milliseconds of beams of 480 unknowns, all together", ["", *columns], rows
    )


def milliseconds(device: torch.device, batch: int) -> tuple[float, float]:
    """Milliseconds of a step that keeps what its gradient needs,
    and of the gradient, after a first roll-out.
    """
    simulator = beam(box_hexahedra(SIZE, (10, 3, 3)), device=device)
    start, moments = pose(simulator, "bent", batch), list[float]()

    def note() -> None:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        moments.append(time.perf_counter())

    for _ in range(2):
        q = start.q.clone().requires_grad_()
        note()
        loss = simulator.rollout(State(q, start.v), _TIMED_STEPS).final.q.square().sum()
        note()
        torch.autograd.grad(loss, q)
        note()
    forward, backward = np.diff(moments[-3:]) * 1e3 / _TIMED_STEPS
    return float(forward), float(backward)


def beam(mesh: Mesh, energies: Any = (), poissons_ratio: float = 0.45, **options: Any) -> Simulator:
    """A body whose vertices at x = 0 are fixed."""
    body = Body(mesh, select_vertices(mesh, x=0.0), energies=energies)
    return Simulator(body, replace(_MATERIAL, poissons_ratio=poissons_ratio), 0.01, **options)


def between_obstacles(moves: bool, **options: Any) -> Simulator:
    """A beam between a bar, a plate and a ball on a grid, on which its weight makes it slide."""
    ball = trimesh.creation.icosphere(radius=0.01)
    obstacles = {
        "bar": Cylinder(
            position=(0.05, 0.015, -0.0106), axis=(0.0, 1.0, 0.0), radius=0.01, length=0.06
        ),
        "plate": Box(position=(0.09, 0.015, -0.0107), edges=(0.04, 0.04, 0.02), moves=moves),
        "ball": DistanceGrid.of_surface(
            ball.vertices, ball.faces, 1e-3, position=(0.067, 0.0163, 0.0407)
        ),
    }
    contact = Contact(
        obstacles, stiffness=1e5, friction={"bar": 0.3, "plate": 0.6, "ball": 0.2}, slip_speed=2e-2
    )
    return beam(box_hexahedra(SIZE, (6, 2, 2)), [contact], gravity=(1.0, 4.0, -9.0), **options)


def beam_on_beam(**options: Any) -> Simulator:
    """A beam that its weight presses on a thicker one and along it, with friction."""
    upper, lower = (box_hexahedra((0.1, 0.03, z), (4, 1, 1)) for z in (0.03, 0.05))
    below = replace(lower, vertices=lower.vertices + [0.0013, 0.0017, -0.0507])
    bodies = {
        "upper": Body(upper, select_vertices(upper, x=0.0)),
        "lower": Body(below, select_vertices(lower, x=0.0)),
    }
    scene = Scene(bodies, SurfaceContact(stiffness=1e5, friction=0.3, slip_speed=2e-2))
    return Simulator(scene, _MATERIAL, 0.01, (1.0, 4.0, -9.0), **options)


def actuated(**options: Any) -> Simulator:
    """A beam with a chamber that is wound with fibres, and two tendons."""
    box = box_hexahedra(SIZE, (6, 3, 3))
    outer = np.abs(box.vertices[box.cells].mean(1) / SIZE - 0.5).max(1) > 0.3
    mesh = Mesh(box.vertices, box.cells[outer])
    chambers = find_chambers(mesh)
    tendons = Tendons([np.linspace([0.0, y, 0.03], [0.1, y, 0.03], 7) for y in (0.01, 0.02)], 50.0)
    return beam(
        mesh,
        [Pressure(chambers), Fibres(chambers, (20.0, -20.0), stiffness=2e3), tendons],
        **options,
    )


HEXAHEDRA: Final = partial(beam, box_hexahedra(SIZE, (6, 2, 2)), poissons_ratio=0.499)
TETRAHEDRA: Final = partial(beam, box_tetrahedra(SIZE, (4, 1, 1), order=2))
# At the end.
LEVELS: Final = {
    "pressure": [6e3],
    "tendon_tension": [0.6, 0.2],
    "obstacle_move_z": [0.0, 1e-3, 0.0],
}
EVERY_SOLVER: Final = ("hexahedra", "obstacles")  # motions with all linear solvers
# And mean heights at the end [m].
MOTIONS: Final[Mapping[str, tuple[Callable[..., Simulator], float]]] = {
    "hexahedra": (HEXAHEDRA, 0.012234381155),
    "quadratic tetrahedra": (TETRAHEDRA, 0.011349058659),
    "obstacles": (partial(between_obstacles, moves=True), 0.015409707818),
    "two beams": (beam_on_beam, -0.006969349230),
    "actuators": (actuated, 0.012531685680),
}
# By small changes where contact, fibres and tendons begin to pull.
GRADIENTS: Final[Mapping[str, Gradients]] = {
    "hexahedra at rest": Gradients(HEXAHEDRA, "rest"),
    "twisted hexahedra": Gradients(HEXAHEDRA, "twisted"),
    "obstacles": Gradients(
        partial(between_obstacles, moves=False), "rest", 1e-3, ("contact_", "obstacle_")
    ),
    "two beams": Gradients(beam_on_beam, "rest", 1e-3, ("surface_",)),
    "actuators": Gradients(actuated, "bent", 1e-2),
}
