"""A world of grippers: two copies of a robot as fingers, which close on a ball that stands on a table, and lift it."""

from dataclasses import replace
from typing import Final

import numpy as np
import torch
from typing_extensions import override

from ..control.worlds import World
from ..energies.contact import Contact
from ..energies.obstacles import HalfSpace
from ..energies.surfaces import SurfaceContact
from ..fem.body import Body, Rigid
from ..io.arrays import BoolArray, FloatArray, IntArray
from ..mesh.mesh import Mesh, boundary_triangles, box_hexahedra
from ..report.obstacles import ObstacleSurface
from ..robot.inputs import BASE
from ..robot.robot import Robot
from ..robot.robot_scene import RobotScene

RISE: Final = 0.02  # of the gripper [m], which lifts a ball
SPEED: Final = 0.02  # of the gripper [m/s]: it rises while it closes
FINGERS: Final = {"left": 0.0, "right": np.pi}  # angles about z [rad]
BALL: Final = "ball"
_RADIUS, _MASS, _YOUNGS_MODULUS = 0.01, 0.01, 1e7  # of the ball [m, kg, Pa]
_GAP, _BELOW = 1.5e-3, 1.5e-3  # between fingers and ball at rest, and from the fingers down to the table [m]
_STIFFNESS, _FRICTION, _DISTANCE, _SLIP_SPEED = 5e4, 0.8, 5e-4, 5e-3  # of all contact [Pa, 1, m, m/s]
_TOLERANCE: Final = 1e-6  # of the solver, relative


def gripper(robot: Robot) -> RobotScene:
    """Returns two copies of a finger, which bends towards x and hangs along -z, on both sides of a rigid ball."""
    mesh = robot.simulator.body.mesh
    at, table = _RADIUS + _GAP + float(mesh.vertices[:, 0].max()), float(mesh.vertices[:, 2].min()) - _BELOW
    robots = {name: (robot, (-at * np.cos(angle), 0, 0, 0, 0, angle)) for name, angle in FINGERS.items()}
    ball = ball_mesh(_RADIUS, 2, mesh.cells.shape[1])
    ball = replace(ball, vertices=ball.vertices + [0.0, 0.0, table + _RADIUS + 0.9 * _DISTANCE])
    below = Contact({"table": HalfSpace(position=(0.0, 0.0, table))}, _STIFFNESS, _FRICTION, _DISTANCE, _SLIP_SPEED)
    density = _MASS / float(Body(ball).discretisation.element_volumes.sum())
    things = {BALL: Body.rigid_body(ball, Rigid(density, _YOUNGS_MODULUS), energies=[below])}
    contact = SurfaceContact(_STIFFNESS, _FRICTION, _DISTANCE, _SLIP_SPEED)
    return RobotScene(robots, things, contact, _TOLERANCE)


def ball_mesh(radius: float, divisions: int, nodes: int = 8) -> Mesh:
    """Returns a mesh of bricks with its middle at the origin."""
    cube = box_hexahedra((2.0, 2.0, 2.0), (divisions,) * 3, nodes=nodes)
    x = cube.vertices - 1.0
    y2, z2 = np.roll(x, 1, axis=1) ** 2, np.roll(x, 2, axis=1) ** 2
    return Mesh(radius * x * np.sqrt(1.0 - y2 / 2.0 - z2 / 2.0 + y2 * z2 / 3.0), cube.cells)


class GraspWorld(World):
    """B grippers, which take the command of both fingers, and their own height.

    The last marker is the middle of the ball.

    Args:
        robot: a finger, loaded with ``on_failure="count"``.
        driven: name of its input, which has one value.
        count: B.
        time_step: h [s], a multiple of the robot's.
    """

    parts, travel = 2, (0.0, 0.0, RISE)

    def __init__(self, robot: Robot, driven: str, count: int, time_step: float) -> None:
        self._scene = gripper(robot)
        self.count, self.time_step, self.input = count, time_step, driven
        self._substeps = round(time_step / robot.time_step)
        self._height = np.zeros(count)
        with torch.no_grad():
            self._state = self._rest = self._scene.begin(count)

    @override
    def begin(self, chosen: BoolArray) -> None:
        self._height = np.where(chosen, 0.0, self._height)
        self._state = self._rest.where(torch.as_tensor(chosen, device=self._rest.body.q.device), self._state)

    @override
    @torch.no_grad()
    def step(self, commands: FloatArray) -> BoolArray:
        height = self._height
        for part in range(1, self._substeps + 1):
            pose = np.zeros((self.count, 6))  # of the base, alike in the frames of both fingers
            pose[:, 2] = height + (commands[:, 1] - height) * part / self._substeps
            inputs = {self.input: commands[:, :1], BASE: pose}
            self._state = self._scene.step(self._state, dict.fromkeys(FINGERS, inputs))
        self._height = commands[:, 1].copy()
        return np.asarray(self._state.lost.cpu().numpy())

    @override
    def markers(self) -> FloatArray:
        fingers = torch.cat(list(self._scene.observe(self._state).values()), 1)
        ball = self._state.body.q[:, self._scene.scene.vertex_slice(BALL)].mean(1, keepdim=True)
        return np.asarray(torch.cat([fingers, ball], 1).double().cpu().numpy())

    @override
    def bodies(self) -> tuple[IntArray, FloatArray]:
        return boundary_triangles(self._scene.scene.mesh), self._state.body.q.double().cpu().numpy()

    @override
    def obstacles(self) -> ObstacleSurface:
        return ObstacleSurface.of(self._scene.scene)
