"""A gripper of two fingers: a learned force, trained on one finger in free air, in a grasp."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..control.sampling import driven_input
from ..energies.contact import Contact
from ..energies.materials import Corotated
from ..energies.obstacles import HalfSpace
from ..energies.surfaces import SurfaceContact
from ..experiment.build import build_body
from ..experiment.laboratory import make_setup
from ..experiment.target import target_settings
from ..fem.body import Body
from ..io.errors import InputError
from ..io.files import write_json
from ..io.machine import hardware
from ..io.progress import Progress
from ..io.settings import NotNegative, Positive, Settings, Some, Word, parse, setting
from ..io.stages import finished_record
from ..mesh.mesh import Mesh, box_hexahedra
from ..robot.description import Description
from ..robot.loading import load
from ..robot.robot import Robot
from ..robot.robot_scene import RobotScene
from ..settings.stages import LaboratoryStage
from .gripper import ball_mesh
from .tables import Sheet, show

LABORATORY: Final = "laboratory"
_TURN: Final = np.array([0.0, 0.0, np.pi])  # of the finger on the other side, as a rotation vector
Thing = Literal["ball", "cylinder", "box"]


class GraspStudy(Settings):
    """The configuration ``benchmark_grasp``, which explains its keys."""

    run: Word
    models: Some[Word]
    things: Some[Thing]
    size: Positive = setting(unit="m")
    mass: Positive = setting(unit="kg")
    gap: Positive = setting(unit="m")
    height: float = setting(unit="m")
    tension: Positive = setting(unit="N")
    closing: Positive = setting(unit="s")
    rise: NotNegative = setting(unit="m")
    lifting: Positive = setting(unit="s")
    shaking: Positive = setting(unit="s")
    shake: NotNegative = setting(unit="m")
    shakes: Positive = setting(unit="Hz")
    stiffness: Positive = setting(unit="Pa")
    friction: NotNegative
    distance: Positive = setting(unit="m")
    slip_speed: Positive = setting(unit="m/s")
    relative_tolerance: Positive

    def steps(self, time_step: float) -> int:
        """Number of steps of a grasp."""
        return round((self.closing + self.lifting + self.shaking) / time_step)

    def base(self, time: float) -> NDArray[np.float64]:
        """Displacement (3,) of the bases at a time [s], which rise, and then swing along y [m]."""
        way = min(max((time - self.closing) / self.lifting, 0.0), 1.0)
        after = max(time - self.closing - self.lifting, 0.0)
        swing = self.shake * math.sin(2.0 * math.pi * self.shakes * after) * min(self.shakes * after, 1.0)
        return np.array([0.0, swing, self.rise * (0.5 - 0.5 * math.cos(math.pi * way))])


def laboratory_robot(run: str | Path) -> Robot:
    """Returns the simulated laboratory of a run, upright, as a robot with its own markers.

    Raises:
        DataFileError: the run has no laboratory, or is unfinished.
    """
    folder = Path(run).expanduser()
    settings = parse(LaboratoryStage, finished_record(folder, "laboratory")["settings"]).changed(device="cpu")
    target, setup = target_settings(settings, settings.laboratory), make_setup(settings)
    description = Description(
        name=LABORATORY,
        model=LABORATORY,
        settings=target,
        material=settings.laboratory.material,
        mesh=build_body(target, settings.payload_at).mesh,
        markers=load(run, "simulation").description.markers,
        labels=tuple(settings.binding.observed),
        bound=torch.from_numpy(setup.tracked),
    )
    return Robot(description)


def thing_body(study: GraspStudy, thing: Thing, nodes: int) -> tuple[Body, Corotated]:
    """A hard thing that stands on a table below the fingers, and its material."""
    r, n = 0.5 * study.size, 2
    if thing == "ball":
        mesh = ball_mesh(r, n, nodes)
    elif thing == "cylinder":  # along y: squares become circles
        box = box_hexahedra((2.0, 2.0, 2.0), (n, n, n), nodes=nodes)
        x = box.vertices - 1.0
        shrunk = np.sqrt(1.0 - 0.5 * x[:, [2, 1, 0]] ** 2)
        shrunk[:, 1] = 1.0
        mesh = replace(box, vertices=r * x * shrunk)
    else:
        box = box_hexahedra((study.size,) * 3, (n, n, n), nodes=nodes)
        mesh = replace(box, vertices=box.vertices - r)
    place = np.array([0.0, 0.0, study.height + r + 0.9 * study.distance])
    mesh = Mesh(mesh.vertices + place, mesh.cells)
    table = Contact(
        {"table": HalfSpace(position=(0.0, 0.0, study.height))},
        study.stiffness,
        study.friction,
        study.distance,
        study.slip_speed,
    )
    volume = float(Body(mesh).discretisation.element_volumes.sum())
    return Body(mesh, energies=[table]), Corotated(density=study.mass / volume, youngs_modulus=5e6, poissons_ratio=0.3)


@dataclass(frozen=True)
class Grasp:
    """A grasp by two fingers.

    Attributes:
        markers: (T, 2 M, 3) markers of both fingers at the steps of the models [m].
        height: (T,) rise of the middle of the thing [m]; None without one.
        left: whether the learned force was evaluated outside its training range.
    """

    markers: NDArray[np.float64]
    height: NDArray[np.float64] | None = None
    left: bool = False

    @classmethod
    @torch.no_grad()
    def of(cls, study: GraspStudy, robot: Robot, thing: Thing | None, driven: str, time_step: float) -> "Grasp":
        """Closes two copies of a finger by one of its inputs, and raises them."""
        mesh = robot.simulator.body.mesh
        at = 0.5 * study.size + study.gap + float(mesh.vertices[:, 0].max())
        poses = {"left": (-at, 0, 0, 0, 0, 0), "right": (at, 0, 0, *_TURN)}
        objects = {} if thing is None else {"thing": thing_body(study, thing, mesh.cells.shape[1])}
        contact = SurfaceContact(study.stiffness, study.friction, study.distance, study.slip_speed)
        robots = {name: (robot, pose) for name, pose in poses.items()}
        gripper = RobotScene(robots, objects, contact if objects else None, study.relative_tolerance)
        state, seen, heights = gripper.begin(), list[NDArray[np.float64]](), list[float]()
        substeps = round(time_step / robot.time_step)
        for step in range(study.steps(time_step)):
            pull = study.tension * min((step + 1) * time_step / study.closing, 1.0)
            for part in range(substeps):
                moved = study.base((step + (part + 1) / substeps) * time_step)
                own = {n: [*(Rotation.from_rotvec(pose[3:]).inv().apply(moved)), 0, 0, 0] for n, pose in poses.items()}
                state = gripper.step(state, {name: {driven: [pull], "base": base} for name, base in own.items()})
            seen.append(torch.cat(list(gripper.observe(state).values()), 1)[0].double().numpy())
            if objects:
                heights.append(float(state.body.q[0, gripper.scene.vertex_slice("thing"), 2].mean()))
        left = any(bool(own.left.any()) for own in state.robots.values())
        start = float(gripper.scene.bodies["thing"].vertices[:, 2].mean()) if objects else 0.0
        return cls(np.stack(seen), np.array(heights) - start if objects else None, left)


def grasp_study(study: GraspStudy, folder: Path) -> None:
    """Prints errors of the fingers' markers in free air and in grasps, and writes grasp_study.json.

    Raises:
        InputError: a run whose robot has more than one input, or other wrong settings.
        DataFileError: the run is missing, unfinished or has no laboratory.
    """
    real, robots = laboratory_robot(study.run), {name: load(study.run, name) for name in study.models}
    first = next(iter(robots.values()))
    driven, h = driven_input(first), first.time_step
    if len(driven.parts) != 1:
        raise InputError(f"{study.run} has the inputs {', '.join(driven.parts)}: a finger of a gripper has one.")
    base = np.array([study.base((step + 1) * h) for step in range(study.steps(h))])
    rows, free = list[dict[str, Any]](), Grasp(np.zeros((0, 0, 3)))
    with Progress("grasps", (len(study.things) + 1) * (1 + len(robots)), "grasps") as progress:
        for thing in (None, *study.things):
            truth = Grasp.of(study, real, thing, driven.name, h)
            progress.advance()
            if thing is None:
                free = truth
                others = {"no tension": Grasp(truth.markers[:1] + base[:, None])}
            else:
                others = {"laboratory in free air": free}
            for name, robot in robots.items():
                others[name] = Grasp.of(study, robot, thing, driven.name, h)
                progress.advance()
            rows += [_row(thing, name, truth, grasp) for name, grasp in others.items()]
            write_json(folder / "grasp_study.json", {"hardware": hardware(), "study": study.plain(), "rows": rows})
    columns = (
        "between the fingers {thing} | model {model} | error [mm] {error_mm:.2f} | at the end [mm] {end_mm:.2f} | "
        "lifted [mm] {lifted} | in the laboratory [mm] {real} | left its training {left}"
    )
    show(Sheet.of("Two fingers, beside those of the laboratory", columns, rows))


def _row(thing: Thing | None, model: str, truth: Grasp, grasp: Grasp) -> dict[str, Any]:
    error = 1e3 * np.linalg.norm(grasp.markers - truth.markers, axis=2).mean(axis=1)
    lifted, real = (None if own.height is None else f"{1e3 * own.height[-1]:.1f}" for own in (grasp, truth))
    return {
        "thing": thing or "nothing",
        "model": model,
        "error_mm": float(error.mean()),
        "end_mm": float(error[-1]),
        "lifted": lifted or "",
        "real": real or "",
        "left": "yes" if grasp.left else "",
    }
