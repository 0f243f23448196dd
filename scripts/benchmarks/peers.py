"""A soft block in contact beside Newton's vertex block descent (VBD)
and MuJoCo's flexes: time at equal error.

=====  =====================================================================================
slide  a block that rests on a floor is given a speed v, and stops after v^2 / (2 mu g); the
       error is that of the way
grip   walls squeeze a block, which their friction holds; the error is the mean distance of
       its vertices at the end from where this simulator leads with almost rigid walls and
       almost dry friction
=====  =====================================================================================

All simulate the same tetrahedra of a stable neo-Hookean solid with implicit steps of first order,
VBD in float32. Contact acts at vertices: here by a barrier from a distance D on, which keeps every
vertex outside, in the peers by penalties from the surface on, which vertices penetrate.
"""

import argparse
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, Final

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from warp_resphys.core.dynamics.simulator import Simulator
from warp_resphys.core.dynamics.solver_settings import SolverSettings
from warp_resphys.core.energies.contact.obstacle_contact import Contact
from warp_resphys.core.energies.contact.touching_bodies import HalfSpace
from warp_resphys.core.energies.materials import StableNeoHookean
from warp_resphys.core.fem.bodies import Body
from warp_resphys.core.mesh.boxes import box_tetrahedra
from warp_resphys.core.mesh.quality import cell_volumes
from warp_resphys.core.mesh.volume_mesh import Mesh
from warp_resphys.core.stepping.state import State
from warp_resphys.experiment.build import choose_device
from warp_resphys.io.errors import InputError

from .measuring import now, take_turns

Array = NDArray[np.float64]
# q, v (N, 3), T to seconds a step and positions (T, N, 3)
Run = Callable[[Array, Array, int], tuple[float, Array]]
OURS: Final = "warp_resphys"
SIZE: Final = (0.06, 0.04, 0.03)  # of the block [m]
MODULUS: Final = 30e3  # [Pa]
RATIO: Final = 0.45
DENSITY: Final = 1070.0  # [kg/m^3]
G: Final = 9.81  # [m/s^2]
FRICTION, SLIP_SPEED = 0.5, 1e-3  # 1, [m/s]
STIFFNESS: Final = 1e5  # [Pa]
SPEED: Final = 1.0  # [m/s]
SQUEEZE: Final = 0.1  # share of the width by which walls squeeze the block that is held
SETTLING, DURATION = 0.1, 0.25  # before the block is given its speed, and after [s]
# Of the programs, the time step [s] first.
SETTINGS: Final[Mapping[str, Sequence[tuple[Any, ...]]]] = {
    OURS: [  # distance at which contact begins [m], relative residual
        (4e-3, 1e-4, 1e-2),
        (2e-3, 1e-3, 1e-2),
        (2e-3, 1e-4, 1e-2),
        (1e-3, 1e-3, 1e-2),
        (1e-3, 1e-4, 1e-2),
        (1e-3, 2e-5, 1e-2),
        (5e-4, 1e-4, 1e-2),
        (5e-4, 5e-6, 1e-2),
    ],
    "newton": [  # iterations, stiffness [N/m] and damping [N s/m] of contact at a vertex
        (2e-3, 10, 1e3, 0.0),
        (1e-3, 10, 1e4, 0.0),
        (5e-4, 5, 1e4, 0.0),
        (5e-4, 5, 1e4, 10.0),
        (5e-4, 10, 1e4, 0.0),
        (2e-4, 5, 1e4, 0.0),
    ],
    "mujoco": [  # solver, its tolerance, time constant of contact [s], its impedance
        (4e-3, "CG", 1e-5, 4e-3, 0.99),
        (2e-3, "CG", 1e-5, 4e-3, 0.9),
        (2e-3, "NEWTON", 1e-6, 2e-3, 0.99),
        (2e-3, "CG", 1e-5, 2e-3, 0.99),
        (1e-3, "CG", 1e-5, 1e-3, 0.99),
        (5e-4, "CG", 1e-5, 5e-4, 0.99),
    ],
}
_AWAY: Final = 1.0  # of obstacles from the body at rest, before they grow to the planes [m]


@dataclass(frozen=True)
class Scene:
    """A block and the planes that it touches: a point (3,) of each and its normal (3,)."""

    mesh: Mesh
    planes: tuple[tuple[Array, Array], ...]
    speed: float = 0.0  # of the block that slides [m/s]

    @classmethod
    def of(cls, name: str, divisions: tuple[int, int, int]) -> "Scene":
        """Returns the scene slide, a block on a floor, or grip, a block between two walls."""
        mesh = box_tetrahedra(SIZE, divisions)
        y = np.array([0.0, 1.0, 0.0])
        z = np.array([0.0, 0.0, 1.0])
        if name == "slide":
            return cls(mesh, ((np.zeros(3), z),), SPEED)
        near = 0.5 * SQUEEZE * SIZE[1] * y
        return cls(mesh, ((near, y), (SIZE[1] * y - near, -y)))

    def start(self, clearance: float) -> Array:
        """Returns positions (N, 3) of the vertices at a distance from the planes [m],
        squeezed if there are two.
        """
        q = self.mesh.vertices
        if len(self.planes) == 1:
            return np.asarray(q + clearance * self.planes[0][1])
        middle, strain = q.mean(0), SQUEEZE + 2.0 * clearance / SIZE[1]
        across = 1.0 + RATIO * strain
        return np.asarray(middle + (q - middle) * [across, 1.0 - strain, across])

    def measure(self, run: Run, time_step: float, clearance: float) -> tuple[float, Array, Array]:
        """Returns seconds a step, and positions (N, 3)
        after the block has settled and (T, N, 3) after that.
        """
        q = self.start(clearance)
        first = round(SETTLING / time_step)
        steps = round(DURATION / time_step)
        before, settled = run(q, 0.0 * q, first)
        seconds, positions = run(settled[-1], 0.0 * q + [self.speed, 0.0, 0.0], steps)
        return (before * first + seconds * steps) / (first + steps), settled[-1], positions

    def compare(
        self, run: Run, time_step: float, clearance: float, expected: Array
    ) -> dict[str, float]:
        """Runs the scene once: time of a step, the same over the simulated time,
        error and penetration.
        """
        seconds, settled, q = self.measure(run, time_step, clearance)
        gap = min(float(((q - point) @ normal).min()) for point, normal in self.planes)
        if self.speed:
            error = abs(
                float((q[-1] - settled)[:, 0].mean()) - self.speed**2 / (2.0 * FRICTION * G)
            )
        else:
            error = float(np.linalg.norm(q[-1] - expected, axis=-1).mean())
        figures = {"time_ms": 1e3 * seconds, "load": seconds / time_step}
        return {**figures, "error_mm": 1e3 * error, "penetration_um": 1e6 * max(-gap, 0.0)}


def measure_peers(arguments: argparse.Namespace) -> dict[str, Any]:
    """Compares the programs in both scenes; their runs take turns.

    Raises:
        InputError: the package of a peer is not installed.
    """
    for peer in arguments.programs:
        try:
            import_module(peer)
        except ModuleNotFoundError:
            message = f"The package {peer} is not installed: run pip install 'warp-resphys[peer]'."
            raise InputError(message) from None
    device, tables = choose_device(arguments.device), dict[str, Any]()
    for name in ("slide", "grip"):
        scene = Scene.of(name, tuple(arguments.divisions))
        rigid = ours(scene, device, 5e-4, 1e-5, 1e-8, slip_share=0.1)
        expected = (
            scene.measure(rigid, 5e-4, 1e-5)[2][-1] if name == "grip" else scene.mesh.vertices
        )
        heads, tasks = list[dict[str, Any]](), list[Callable[[], dict[str, float]]]()
        for program in (OURS, *arguments.programs):
            for h, *values in SETTINGS[program]:
                heads.append(
                    {"program": program, "step_ms": 1e3 * h, "setting": ", ".join(map(str, values))}
                )
                run = MAKERS[program](scene, device, h, *values)
                clearance = values[0] if program == OURS else 0.0
                tasks.append(partial(scene.compare, run, h, clearance, expected))
        figures, _ = take_turns(name, tasks, arguments.repeats)
        rows = [{**head, **measured} for head, measured in zip(heads, figures, strict=True)]
        tables[name] = [
            {**row, "our_load_at_that_error": at_equal_error(row, rows)} for row in rows
        ]
    return tables


def at_equal_error(row: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    """Returns our least load at no more than the error of a peer's row, as text.

    A dash if no row reaches it.
    """
    loads = [
        other["load"]
        for other in rows
        if other["program"] == OURS and other["error_mm"] <= row["error_mm"]
    ]
    return "" if row["program"] == OURS else f"{min(loads):.3g}" if loads else "-"


def ours(
    scene: Scene,
    device: torch.device,
    h: float,
    distance: float,
    tolerance: float,
    slip_share: float = 1,
) -> Run:
    """Prepares roll-outs of this simulator with steps of h.

    The solver stops at a relative residual.
    """
    planes = {
        f"plane{number}": HalfSpace(position=tuple(point - _AWAY * normal), axis=tuple(normal))
        for number, (point, normal) in enumerate(scene.planes)
    }
    contact = Contact(planes, STIFFNESS, FRICTION, distance, slip_share * SLIP_SPEED)
    material = StableNeoHookean(density=DENSITY, youngs_modulus=MODULUS, poissons_ratio=RATIO)
    body = Body(scene.mesh, energies=[contact])
    solver = SolverSettings(relative_tolerance=tolerance)
    s = Simulator(body, material, h, (0.0, 0.0, -G), solver=solver, device=device)

    @torch.no_grad()
    def run(q: Array, v: Array, steps: int) -> tuple[float, Array]:
        start, began = State(s.tensor(q[None]), s.tensor(v[None])), now(device)
        path = s.rollout(start, steps, None, {"obstacle_growth": _AWAY})
        return (now(device) - began) / steps, path.q[1:, 0].cpu().numpy()

    run(scene.start(distance), 0.0 * scene.mesh.vertices, 1)  # makes kernels and layouts
    return run


def vbd(
    scene: Scene, device: torch.device, h: float, iterations: int, stiffness: float, damping: float
) -> Run:
    """Prepares roll-outs of Newton's VBD with steps of h, as graphs of two steps."""
    newton: Any = import_module("newton")
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, -G))
    builder.add_soft_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*vertex) for vertex in scene.mesh.vertices],
        indices=scene.mesh.cells.ravel().tolist(),
        density=DENSITY,
        k_mu=MODULUS / (2.0 * (1.0 + RATIO)),
        k_lambda=MODULUS * RATIO / ((1.0 + RATIO) * (1.0 - 2.0 * RATIO)),
        k_damp=0.0,
        add_surface_mesh_edges=False,
        particle_radius=0.0,
    )
    for point, normal in scene.planes:
        builder.add_shape_plane((*normal.tolist(), -float(point @ normal)), width=0.0, length=0.0)
    builder.color()
    model = builder.finalize(device=str(device))
    for name, value in {"ke": stiffness, "kd": damping, "mu": FRICTION}.items():
        setattr(model, f"soft_contact_{name}", value)
        getattr(model, f"shape_material_{name}").fill_(value)
    collisions = newton.CollisionPipeline(model)
    contacts = collisions.contacts()
    control = model.control()
    states = [model.state(), model.state()]
    solver = newton.solvers.SolverVBD(model, iterations=iterations, friction_epsilon=SLIP_SPEED)

    def two_steps() -> None:
        for before, after in (states, reversed(states)):
            before.clear_forces()
            collisions.collide(before, contacts)
            solver.step(before, after, control, contacts, h)

    two_steps()  # compiles the kernels
    with wp.ScopedCapture(device=str(device)) as capture:
        two_steps()

    def run(q: Array, v: Array, steps: int) -> tuple[float, Array]:
        states[0].particle_q.assign(q.astype(np.float32))
        states[0].particle_qd.assign(v.astype(np.float32))
        seconds, positions = 0.0, list[Array]()
        while len(positions) < steps:
            began = now(device)
            wp.capture_launch(capture.graph)
            seconds += now(device) - began  # the first state is the one after the second step
            positions += [state.particle_q.numpy().astype(np.float64) for state in reversed(states)]
        return seconds / len(positions), np.array(positions[:steps])

    return run


def flex(
    scene: Scene,
    _: torch.device,
    h: float,
    solver: str,
    tolerance: float,
    reaction: float,
    limit: float,
) -> Run:
    """Prepares roll-outs of MuJoCo with steps of h, on the CPU: vertices are bodies on three
    slides, as in `flexcomp`.

    Contact has a time constant, ``reaction`` [s], and an impedance, ``limit``.
    """
    mujoco: Any = import_module("mujoco")
    mesh = scene.mesh
    mujoco.set_mju_user_warning(warnings.warn)  # its own writes a file
    spec = mujoco.MjSpec()
    spec.memory = 1 << 28
    option = spec.option
    option.timestep = h
    option.gravity = (0.0, 0.0, -G)
    option.impratio = 10.0  # as advised for grasping
    option.integrator, option.cone = (
        mujoco.mjtIntegrator.mjINT_DISCRETE,
        mujoco.mjtCone.mjCONE_ELLIPTIC,
    )
    option.solver, option.tolerance = getattr(mujoco.mjtSolver, f"mjSOL_{solver}"), tolerance
    for point, normal in scene.planes:
        plane = spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE, pos=point, size=(0.0, 0.0, 0.01), priority=1
        )
        plane.alt.type, plane.alt.zaxis = mujoco.mjtOrientation.mjORIENTATION_ZAXIS, normal
        plane.friction, plane.solref = (FRICTION, 0.0, 0.0), (reaction, 1.0)
        plane.solimp = (limit, limit, 1e-3, 0.5, 2.0)
    masses = np.bincount(mesh.cells.ravel(), np.repeat(0.25 * DENSITY * cell_volumes(mesh), 4))
    names = [f"vertex{number}" for number in range(len(masses))]
    for name, vertex, mass in zip(names, mesh.vertices, masses, strict=True):
        body = spec.worldbody.add_body(
            name=name, pos=vertex, mass=mass, inertia=(1e-9,) * 3, explicitinertial=True
        )
        for axis in np.eye(3):
            body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    block = spec.add_flex(name="block", dim=3, young=MODULUS, poisson=RATIO, radius=0.0)
    block.elastic3d, block.selfcollide = 1, mujoco.mjtFlexSelf.mjFLEXSELF_NONE
    block.vertbody = names
    block.elem = mesh.cells.ravel().tolist()
    block.contype = block.conaffinity = 1
    model, rest = spec.compile(), mesh.vertices
    data = mujoco.MjData(model)

    def run(q: Array, v: Array, steps: int) -> tuple[float, Array]:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = (q - rest).ravel(), v.ravel()
        began, positions = now(), list[Array]()
        for _ in range(steps):
            mujoco.mj_step(model, data)
            positions.append(rest + data.qpos.reshape(-1, 3))
        return (now() - began) / steps, np.array(positions)

    return run


MAKERS: Final[Mapping[str, Callable[..., Run]]] = {OURS: ours, "newton": vbd, "mujoco": flex}
