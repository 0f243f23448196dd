"""A soft block in contact beside Newton's vertex block descent (VBD) and MuJoCo's flexes: time at equal error.

=====  ================================================================================================================
slide  a block that rests on a floor is given a speed v, and stops after v^2 / (2 mu g); the error is that of the way
grip   walls squeeze a block, which their friction holds; the error is the mean distance of its vertices at the end from
       where this simulator leads with almost rigid walls and almost dry friction
=====  ================================================================================================================

All simulate the same tetrahedra with the same energy, stable neo-Hookean, the same lumped masses, and implicit steps of
first order. Contact acts at vertices. What differs is its law: here a barrier, which begins at a distance D and keeps
every vertex outside; in VBD a penalty of a stiffness a vertex, and in MuJoCo a soft constraint with a time constant,
which begin at the surface, so that vertices penetrate it. MuJoCo Warp is MuJoCo for GPUs.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Final, Literal

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.contact import Contact
from ..energies.materials import StableNeoHookean
from ..energies.obstacles import HalfSpace
from ..experiment.build import choose_device
from ..fem.body import Body
from ..io.files import write_json
from ..io.machine import hardware
from ..io.progress import Progress
from ..io.settings import Many, Natural, NotNegative, Positive, Settings, Share, Some, Vector, Word, setting
from ..mesh.mesh import Mesh, box_tetrahedra
from ..mesh.quality import cell_volumes
from ..stepping.state import State
from .beam import Divisions
from .peers import advance, at_equal_error, graph_of, newton_model, newton_positions, peer_package
from .tables import Sheet, show
from .timing import now

Array = NDArray[np.float64]
Run = Callable[[Array, Array, int], tuple[float, Array]]  # q, v (N, 3), T to seconds a step and positions (T, N, 3)
G: Final = 9.81  # [m/s^2]
_AWAY: Final = 1.0  # of obstacles from the body at rest, before they grow to the planes [m]
_MOST_CONTACTS: Final = 2048  # of MuJoCo Warp
_OURS: Final = "warp_resphys"


class ProgramSetting(Settings):
    """A setting of a program."""

    time_step: Positive = setting(unit="s")

    def __str__(self) -> str:
        return ", ".join(map(str, self.model_dump(exclude={"time_step"}).values()))


class BarrierSetting(ProgramSetting):
    """A setting of this simulator."""

    distance: Positive = setting(unit="m")
    tolerance: Positive


class VbdSetting(ProgramSetting):
    """A setting of Newton's VBD."""

    stiffness: Positive = setting(unit="N/m")
    damping: NotNegative = setting(unit="N s/m")
    iterations: Natural


class FlexSetting(ProgramSetting):
    """A setting of MuJoCo and of MuJoCo Warp."""

    solver: Literal["CG", "Newton"]
    tolerance: Positive
    time_constant: Positive = setting(unit="s")
    impedance: Share


class PeerContactStudy(Settings):
    """The configuration ``benchmark_peers_contact``, which explains its keys."""

    size: Vector = setting(unit="m")
    divisions: Divisions
    youngs_modulus: Positive = setting(unit="Pa")
    poissons_ratio: float
    density: Positive = setting(unit="kg/m^3")
    friction: Positive
    slip_speed: Positive = setting(unit="m/s")
    stiffness: Positive = setting(unit="Pa")
    speed: Positive = setting(unit="m/s")
    squeeze: Share
    settling: Positive = setting(unit="s")
    duration: Positive = setting(unit="s")
    reference: BarrierSetting
    peers: Many[Literal["newton", "mujoco", "mujoco_warp"]]
    barrier: Some[BarrierSetting]
    vbd: Some[VbdSetting]
    flex: Some[FlexSetting]
    impratio: Positive
    repeats: Natural
    device: Word

    @property
    def mesh(self) -> Mesh:
        """The block, with a corner in the origin."""
        return box_tetrahedra(self.size, self.divisions)


@dataclass(frozen=True)
class PeerScene:
    """A block and the planes that it touches.

    Attributes:
        planes: a point (3,) of each plane and its normal (3,).
        speed: given to the block along x after it has settled [m/s].
    """

    study: PeerContactStudy
    planes: tuple[tuple[Array, Array], ...]
    speed: float = 0.0

    @classmethod
    def slide(cls, study: PeerContactStudy) -> "PeerScene":
        """A floor."""
        return cls(study, ((np.zeros(3), np.array([0.0, 0.0, 1.0])),), study.speed)

    @classmethod
    def grip(cls, study: PeerContactStudy) -> "PeerScene":
        """Two walls across y."""
        width, normal = study.size[1], np.array([0.0, 1.0, 0.0])
        near = 0.5 * study.squeeze * width * normal
        return cls(study, ((near, normal), (width * normal - near, -normal)))

    def start(self, clearance: float) -> Array:
        """Positions (N, 3) of the vertices at a distance from the planes [m], squeezed if there are two."""
        q = self.study.mesh.vertices
        if len(self.planes) == 1:
            return np.asarray(q + clearance * self.planes[0][1])
        middle, strain = q.mean(0), self.study.squeeze + 2.0 * clearance / self.study.size[1]
        across = 1.0 + self.study.poissons_ratio * strain
        return np.asarray(middle + (q - middle) * [across, 1.0 - strain, across])

    def gaps(self, q: Array) -> Array:
        """Smallest distance of each vertex from the planes [m]; negative within."""
        return np.asarray(np.min([(q - point) @ normal for point, normal in self.planes], axis=0))

    def measure(self, run: Run, values: ProgramSetting) -> tuple[float, Array, Array]:
        """Seconds a step, and positions (N, 3) after the block has settled and (T, N, 3) after that."""
        clearance = values.distance if isinstance(values, BarrierSetting) else 0.0
        q, first = self.start(clearance), round(self.study.settling / values.time_step)
        before, settled = run(q, 0.0 * q, first)
        steps = round(self.study.duration / values.time_step)
        seconds, positions = run(settled[-1], 0.0 * q + [self.speed, 0.0, 0.0], steps)
        return (before * first + seconds * steps) / (first + steps), settled[-1], positions

    def error(self, settled: Array, end: Array, expected: Array) -> float:
        """The error of the way of a block that slides, or of the shape of one that is held [m]."""
        if self.speed:
            way = float((end - settled)[:, 0].mean())
            return abs(way - self.speed**2 / (2.0 * self.study.friction * G))
        return float(np.linalg.norm(end - expected, axis=-1).mean())


def peers_contact(study: PeerContactStudy, folder: Path) -> None:
    """Prints a table for each scene, and writes peers_contact.json.

    Raises:
        InputError: the package of a peer is not installed.
    """
    wp.config.log_level = wp.LOG_WARNING
    for peer in study.peers:
        peer_package(peer)
    results = {}
    for name, make in (("slide", PeerScene.slide), ("grip", PeerScene.grip)):
        results[name] = _compare(study, name, make, choose_device(study.device))
        write_json(folder / "peers_contact.json", {"hardware": hardware(), "found": results})
    show(*map(_table, results, results.values()), f"Written: {folder / 'peers_contact.json'}")


def _compare(
    study: PeerContactStudy, name: str, make: Callable[[PeerContactStudy], PeerScene], device: torch.device
) -> list[dict[str, Any]]:
    """Rows of all programs, whose runs take turns."""
    scene, dry = make(study), make(study.changed(slip_speed=0.1 * study.slip_speed))
    expected = dry.measure(_barrier(dry, study.reference, device), study.reference)[2][-1]
    programs: dict[str, tuple[Callable[..., Run], tuple[ProgramSetting, ...]]] = {
        _OURS: (_barrier, study.barrier),
        "newton": (_vbd, study.vbd),
        "mujoco": (_mujoco, study.flex),
        "mujoco_warp": (_mujoco_warp, study.flex),
    }
    cases = [
        (program, values, programs[program][0](scene, values, device), list[float]())
        for program in (_OURS, *study.peers)
        for values in programs[program][1]
    ]
    rows = {}
    with Progress(name, len(cases) * study.repeats, "runs") as progress:
        for _ in range(study.repeats):
            for program, values, run, times in cases:
                seconds, settled, positions = scene.measure(run, values)
                times.append(seconds)
                row = {"solver": program, "step_ms": 1e3 * values.time_step, "setting": str(values)}
                row |= {"ms": 1e3 * median(times), "load": median(times) / values.time_step}
                row["penetration_um"] = 1e6 * max(-float(scene.gaps(positions).min()), 0.0)
                row["error_mm"] = 1e3 * scene.error(settled, positions[-1], expected)
                rows[program, values] = row
                progress.advance()
    return list(rows.values())


def _barrier(scene: PeerScene, values: BarrierSetting, device: torch.device) -> Run:
    study = scene.study
    planes = {
        f"plane{number}": HalfSpace(position=tuple(point - _AWAY * normal), axis=tuple(normal))
        for number, (point, normal) in enumerate(scene.planes)
    }
    contact = Contact(planes, study.stiffness, study.friction, values.distance, study.slip_speed)
    material = StableNeoHookean(
        density=study.density, youngs_modulus=study.youngs_modulus, poissons_ratio=study.poissons_ratio
    )
    solver, body = SolverSettings(relative_tolerance=values.tolerance), Body(study.mesh, energies=[contact])
    s = Simulator(body, material, values.time_step, (0.0, 0.0, -G), solver=solver, device=device)

    @torch.no_grad()
    def run(q: Array, v: Array, steps: int) -> tuple[float, Array]:
        start, began = State(s.tensor(q[None]), s.tensor(v[None])), now(device)
        trajectory = s.rollout(start, steps, None, {"obstacle_growth": _AWAY})
        seconds = (now(device) - began) / steps
        return seconds, trajectory.q[1:, 0].cpu().numpy()

    run(scene.start(values.distance), 0.0 * study.mesh.vertices, 1)  # makes kernels and layouts
    return run


def _vbd(scene: PeerScene, values: VbdSetting, device: torch.device) -> Run:
    newton, study = peer_package("newton"), scene.study
    builder = newton_model(study.mesh, study.density, study.youngs_modulus, study.poissons_ratio, G)
    for point, normal in scene.planes:
        builder.add_shape_plane((*normal.tolist(), -float(point @ normal)), width=0.0, length=0.0)
    builder.color()
    model = builder.finalize(device=str(device))
    for name, value in {"ke": values.stiffness, "kd": values.damping, "mu": study.friction}.items():
        setattr(model, f"soft_contact_{name}", value)
        getattr(model, f"shape_material_{name}").fill_(value)
    collisions = newton.CollisionPipeline(model)
    contacts, control, states = collisions.contacts(), model.control(), [model.state(), model.state()]
    solver = newton.solvers.SolverVBD(model, iterations=values.iterations, friction_epsilon=study.slip_speed)

    def two_steps() -> None:
        for before, after in (states, reversed(states)):
            before.clear_forces()
            collisions.collide(before, contacts)
            solver.step(before, after, control, contacts, values.time_step)

    launch = graph_of(two_steps, device)

    def run(q: Array, v: Array, steps: int) -> tuple[float, Array]:
        states[0].particle_q.assign(q.astype(np.float32))
        states[0].particle_qd.assign(v.astype(np.float32))
        return advance(launch, partial(newton_positions, states), steps, device)

    return run


def _flex(scene: PeerScene, values: FlexSetting) -> Any:
    """A model of MuJoCo: every vertex is a body on three slides, as its `flexcomp` has it."""
    mujoco, study = peer_package("mujoco"), scene.study
    mujoco.set_mju_user_warning(warnings.warn)  # its own writes a file
    spec, mesh = mujoco.MjSpec(), study.mesh
    spec.memory = 1 << 28
    option = spec.option
    option.timestep, option.gravity, option.impratio = values.time_step, (0.0, 0.0, -G), study.impratio
    option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_DISCRETE, mujoco.mjtCone.mjCONE_ELLIPTIC
    option.solver, option.tolerance = getattr(mujoco.mjtSolver, f"mjSOL_{values.solver.upper()}"), values.tolerance
    for point, normal in scene.planes:
        plane = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, pos=point, size=(0.0, 0.0, 0.01), priority=1)
        plane.alt.type, plane.alt.zaxis = mujoco.mjtOrientation.mjORIENTATION_ZAXIS, normal
        plane.friction, plane.solref = (study.friction, 0.0, 0.0), (values.time_constant, 1.0)
        plane.solimp = (values.impedance, values.impedance, 1e-3, 0.5, 2.0)
    masses = np.bincount(mesh.cells.ravel(), np.repeat(0.25 * study.density * cell_volumes(mesh), 4))
    names = [f"vertex{number}" for number in range(len(masses))]
    for name, vertex, mass in zip(names, mesh.vertices, masses, strict=True):
        body = spec.worldbody.add_body(name=name, pos=vertex, mass=mass, inertia=(1e-9,) * 3, explicitinertial=True)
        for axis in np.eye(3):
            body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    flex = spec.add_flex(name="block", dim=3, young=study.youngs_modulus, poisson=study.poissons_ratio, radius=0.0)
    flex.elastic3d, flex.selfcollide = 1, mujoco.mjtFlexSelf.mjFLEXSELF_NONE
    flex.vertbody, flex.elem, flex.contype, flex.conaffinity = names, mesh.cells.ravel().tolist(), 1, 1
    return spec.compile()


def _mujoco(scene: PeerScene, values: FlexSetting, device: torch.device) -> Run:
    model, mujoco, rest = _flex(scene, values), peer_package("mujoco"), scene.study.mesh.vertices
    data = mujoco.MjData(model)

    def run(q: Array, v: Array, steps: int) -> tuple[float, Array]:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = (q - rest).ravel(), v.ravel()
        step = partial(mujoco.mj_step, model, data)
        return advance(step, lambda: [rest + data.qpos.reshape(-1, 3)], steps, torch.device("cpu"))

    return run


def _mujoco_warp(scene: PeerScene, values: FlexSetting, device: torch.device) -> Run:
    model, mujoco, rest = _flex(scene, values), peer_package("mujoco"), scene.study.mesh.vertices
    mjw = peer_package("mujoco_warp")
    with wp.ScopedDevice(str(device)):
        most = {"nconmax": _MOST_CONTACTS, "njmax": 4 * _MOST_CONTACTS}
        on_device, data = mjw.put_model(model), mjw.put_data(model, mujoco.MjData(model), **most)
        launch = graph_of(partial(mjw.step, on_device, data), device)

    def run(q: Array, v: Array, steps: int) -> tuple[float, Array]:
        data.qpos.assign((q - rest).reshape(1, -1).astype(np.float32))
        data.qvel.assign(v.reshape(1, -1).astype(np.float32))
        data.qacc_warmstart.zero_()
        return advance(launch, lambda: [rest + data.qpos.numpy().reshape(-1, 3)], steps, device)

    return run


def _table(name: str, rows: list[dict[str, Any]]) -> Sheet:
    ours = [row for row in rows if row["solver"] == _OURS]
    columns = (
        "program {solver} | step [ms] {step_ms:g} | setting {setting} | time of it [ms] {ms:.3g} | "
        "time / simulated {load:.2f} | error [mm] {error_mm:.2g} | penetration [um] {penetration_um:.3g} | "
        "ours at that error {ours}"
    )
    return Sheet.of(name, columns, [{**row, "ours": at_equal_error(row, ours, "load")} for row in rows])
