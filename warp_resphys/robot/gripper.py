"""A gripper of two copies of a robot, on a thing that stands on a table."""

from dataclasses import replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..energies.contact import Contact
from ..energies.obstacles import HalfSpace
from ..energies.surfaces import SurfaceContact
from ..experiment.build import build_body
from ..experiment.laboratory import make_setup
from ..experiment.simulate import target_settings
from ..fem.body import Body, Rigid
from ..io.settings import NotNegative, Positive, Settings, parse, setting
from ..io.stages import finished_record
from ..mesh.mesh import Mesh, box_hexahedra
from ..settings.stages import LaboratoryStage
from .description import Description
from .inputs import BASE, Given
from .loading import load
from .robot import Robot
from .robot_scene import RobotScene

FINGERS: Final = {"left": 0.0, "right": np.pi}  # angles about z [rad]
THING: Final = "thing"
_LABORATORY: Final = "laboratory"
_STIFFNESS: Final = 1e7  # of the thing [Pa]
Thing = Literal["ball", "cylinder", "box"]


class GripperSettings(Settings):
    """A thing between two fingers, and what holds it."""

    size: Positive = setting(0.02, "diameter or edge of the thing", "m")
    mass: Positive = setting(0.01, "of the thing", "kg")
    gap: Positive = setting(1.5e-3, "between the fingers and the thing at rest", "m")
    below: Positive = setting(1.5e-3, "distance of the table from the fingers", "m")
    friction: NotNegative = setting(0.8, "coefficient, everywhere")
    stiffness: Positive = setting(5e4, "of the contact", "Pa")
    distance: Positive = setting(5e-4, "at which contact begins", "m")
    slip_speed: Positive = setting(5e-3, "at which friction is fully developed", "m/s")
    relative_tolerance: Positive = setting(1e-6, "of the solver")


def laboratory_robot(run: str | Path, on_failure: str = "raise") -> Robot:
    """Returns the simulated laboratory of a run, upright, as a robot with its own markers.

    Raises:
        DataFileError: the run has no laboratory, or is unfinished.
    """
    folder = Path(run).expanduser()
    settings = parse(LaboratoryStage, finished_record(folder, _LABORATORY)["settings"]).changed(device="cpu")
    target, setup = target_settings(settings, settings.laboratory), make_setup(settings)
    description = Description(
        name=_LABORATORY,
        model=_LABORATORY,
        settings=target,
        material=settings.laboratory.material,
        mesh=build_body(target, settings.payload_at).mesh,
        markers=load(run, "simulation").description.markers,
        labels=tuple(settings.binding.observed),
        bound=torch.from_numpy(setup.tracked),
    )
    return Robot(description, on_failure=on_failure)


def gripper(robot: Robot, settings: GripperSettings, thing: Thing | None = "ball") -> RobotScene:
    """Returns two copies of a finger, which bends towards x and hangs along -z, on both sides of a rigid thing.

    Args:
        robot: the finger.
        settings: of thing, table and contact.
        thing: between the fingers; None for nothing, and no contact.
    """
    mesh = robot.simulator.body.mesh
    at = 0.5 * settings.size + settings.gap + float(mesh.vertices[:, 0].max())
    robots = {name: (robot, (-at * np.cos(angle), 0, 0, 0, 0, angle)) for name, angle in FINGERS.items()}
    if thing is None:
        return RobotScene(robots, relative_tolerance=settings.relative_tolerance)
    contact = SurfaceContact(settings.stiffness, settings.friction, settings.distance, settings.slip_speed)
    objects = {THING: _thing(settings, thing, float(mesh.vertices[:, 2].min()) - settings.below, mesh.cells.shape[1])}
    return RobotScene(robots, objects, contact, settings.relative_tolerance)


def finger_inputs(driven: str, command: Given, moved: ArrayLike) -> dict[str, dict[str, Given]]:
    """Returns inputs of both fingers of a gripper, which take the same command.

    Args:
        driven: name of the input.
        command: (C,) or (B, C).
        moved: (3,) or (B, 3) displacement of the gripper [m].
    """
    way = np.asarray(moved, dtype=np.float64)
    still = np.zeros_like(way)
    turns = {name: Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix() for name, angle in FINGERS.items()}
    return {name: {driven: command, BASE: np.concatenate([way @ turn, still], axis=-1)} for name, turn in turns.items()}


def thing_mesh(thing: Thing, radius: float, divisions: int, nodes: int = 8) -> Mesh:
    """Returns a mesh of bricks with its middle at the origin; a cylinder lies along y."""
    cube = box_hexahedra((2.0, 2.0, 2.0), (divisions,) * 3, nodes=nodes)
    x = cube.vertices - 1.0
    shrunk = np.ones_like(x)
    if thing == "cylinder":  # squares become circles
        shrunk[:, [0, 2]] = np.sqrt(1.0 - 0.5 * x[:, [2, 0]] ** 2)
    elif thing == "ball":
        y2, z2 = np.roll(x, 1, axis=1) ** 2, np.roll(x, 2, axis=1) ** 2
        shrunk = np.sqrt(1.0 - y2 / 2.0 - z2 / 2.0 + y2 * z2 / 3.0)
    return Mesh(radius * x * shrunk, cube.cells)


def _thing(settings: GripperSettings, thing: Thing, height: float, nodes: int) -> Body:
    """A rigid thing on a table at a height [m]."""
    mesh, radius = thing_mesh(thing, 0.5 * settings.size, 2, nodes), 0.5 * settings.size
    places = mesh.vertices + [0.0, 0.0, height + radius + 0.9 * settings.distance]
    mesh = replace(mesh, vertices=places)
    below = {"table": HalfSpace(position=(0.0, 0.0, height))}
    table = Contact(below, settings.stiffness, settings.friction, settings.distance, settings.slip_speed)
    density = settings.mass / float(Body(mesh).discretisation.element_volumes.sum())
    return Body.rigid_body(mesh, Rigid(density, _STIFFNESS), energies=[table])
