"""Grippers of two fingers on both sides of a ball, and their world."""

from dataclasses import replace
from typing import Final

import numpy as np
import torch
from typing_extensions import override

from ..control.worlds import G, World, total_force
from ..core.energies.contact.obstacle_contact import Contact
from ..core.energies.contact.obstacle_surface import ObstacleSurface
from ..core.energies.contact.surface_contact import SurfaceContact
from ..core.energies.contact.touching_bodies import HalfSpace
from ..core.fem.bodies import Body
from ..core.fem.rigid_region import Rigid
from ..core.mesh.boxes import box_hexahedra
from ..core.mesh.volume_mesh import Mesh, boundary_triangles
from ..core.stepping.rollout import states
from ..core.stepping.state import State
from ..io.arrays import FloatArray, IntArray
from ..robot.actuation import BASE, Given
from ..robot.robot import Robot
from ..robot.robot_scene import RobotScene

RISE: Final = 0.02  # of the gripper [m], which lifts a ball
SPEED: Final = 0.02  # of the gripper [m/s]: it rises while it closes
FINGERS: Final = {"left": 0.0, "right": np.pi}  # angles about z [rad]
BALL: Final = "ball"
_GRIPPER: Final = "gripper"  # owner of the memory variable of the height
# Of the ball.
_RADIUS: Final = 0.01  # m
_MASS: Final = 0.01  # kg
_YOUNGS_MODULUS: Final = 1e7  # Pa
# Between fingers and ball at rest, and from the fingers down to the table [m].
_GAP, _BELOW = 1.5e-3, 1.5e-3
# Of all contact.
_STIFFNESS: Final = 5e4  # Pa
_FRICTION: Final = 0.8
_DISTANCE: Final = 5e-4  # m
_SLIP_SPEED: Final = 5e-3  # m/s
_TOLERANCE: Final = 1e-6  # of the solver, relative


def gripper(robot: Robot, divisions: int = 2) -> RobotScene:
    """Returns two copies of a finger, which bends towards x and hangs along -z,
    on both sides of a rigid ball.

    Args:
        robot: the finger.
        divisions: of the ball; with an odd number it stands on a face, and does not roll.
    """
    mesh = robot.simulator.body.mesh
    at = _RADIUS + _GAP + float(mesh.vertices[:, 0].max())
    table = float(mesh.vertices[:, 2].min()) - _BELOW
    robots = {
        name: (robot, (-at * np.cos(angle), 0, 0, 0, 0, angle)) for name, angle in FINGERS.items()
    }
    ball = ball_mesh(_RADIUS, divisions, mesh.cells.shape[1])
    lift = table + 0.9 * _DISTANCE - float(ball.vertices[:, 2].min())
    ball = replace(ball, vertices=ball.vertices + [0.0, 0.0, lift])
    below = Contact(
        {"table": HalfSpace(position=(0.0, 0.0, table))},
        _STIFFNESS,
        _FRICTION,
        _DISTANCE,
        _SLIP_SPEED,
    )
    density = _MASS / float(Body(ball).discretisation.element_volumes.sum())
    things = {
        BALL: Body.rigid_body(
            ball, Rigid(density=density, stiffness=_YOUNGS_MODULUS), energies=[below]
        )
    }
    contact = SurfaceContact(_STIFFNESS, _FRICTION, _DISTANCE, _SLIP_SPEED)
    return RobotScene(robots, things, contact, _TOLERANCE)


def ball_mesh(radius: float, divisions: int, nodes: int = 8) -> Mesh:
    """Returns a mesh of bricks with its middle at the origin."""
    cube = box_hexahedra((2.0, 2.0, 2.0), (divisions,) * 3, nodes=nodes)
    x = cube.vertices - 1.0
    y2, z2 = np.roll(x, 1, axis=1) ** 2, np.roll(x, 2, axis=1) ** 2
    return Mesh(radius * x * np.sqrt(1.0 - y2 / 2.0 - z2 / 2.0 + y2 * z2 / 3.0), cube.cells)


def finger_forces(scene: RobotScene, state: State) -> FloatArray:
    """Returns the forces (B, 2, 3) that hold the fingers at their bases,
    over the weight of the ball.
    """
    return np.stack([total_force(scene.simulator, state, name) for name in FINGERS], axis=1) / (
        G * _MASS
    )


def squeeze_of(scene: RobotScene, state: State) -> FloatArray:
    """Returns the force (B,) of the fingers beyond the least that holds the ball, over its weight.

    In equilibrium a finger presses with what holds its base along the line between both bases. The
    least is half the weight over the coefficient of friction.
    """
    fixed = (scene.simulator.body.fixed_in(name) for name in FINGERS)
    left, right = (state.q[:, at].mean(1).double().cpu().numpy() for at in fixed)
    along = (right - left) / np.linalg.norm(right - left, axis=1, keepdims=True)
    held = finger_forces(scene, state)
    pressing = 0.5 * ((held[:, 0] - held[:, 1]) * along).sum(axis=1)
    return np.asarray(np.maximum(pressing - 0.5 / _FRICTION, 0.0))


class GraspWorld(World[State]):
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
        self.count, self.input = count, driven
        self.time_step = time_step
        self._substeps = round(time_step / robot.time_step)
        with torch.no_grad():
            rest = self._scene.begin(count)
            self.rest = rest.with_memory({"height": rest.q.new_zeros(count)}, _GRIPPER)

    @override
    @torch.no_grad()
    def step(self, state: State, commands: FloatArray) -> State:
        height = torch.as_tensor(commands[:, 1]).to(state.q)
        # Of the base, alike in the frames of both fingers.
        poses = state.q.new_zeros(self._substeps, self.count, 6)
        for part, pose in enumerate(poses, 1):
            pose[:, 2] = torch.lerp(
                state.memory_of(_GRIPPER)["height"], height, part / self._substeps
            )

        def step(before: State, pose: torch.Tensor) -> State:
            inputs: dict[str, Given] = {self.input: commands[:, :1], BASE: pose}
            return self._scene.step(before, dict.fromkeys(FINGERS, inputs))

        *_, after = states(step, state, poses)
        return after.with_memory({"height": height}, _GRIPPER)

    @override
    def markers(self, state: State) -> FloatArray:
        fingers = torch.cat(list(self._scene.observe(state).values()), 1)
        ball = state.q[:, self._scene.scene.vertex_slice(BALL)].mean(1, keepdim=True)
        return np.asarray(torch.cat([fingers, ball], 1).double().cpu().numpy())

    @override
    def forces(self, state: State) -> FloatArray:
        return finger_forces(self._scene, state).reshape(self.count, -1)

    @override
    def squeeze(self, state: State) -> FloatArray:
        return squeeze_of(self._scene, state)

    @override
    def bodies(self, state: State) -> tuple[IntArray, FloatArray]:
        return boundary_triangles(self._scene.scene.mesh), state.q.double().cpu().numpy()

    @override
    def obstacles(self) -> ObstacleSurface:
        return ObstacleSurface.of(self._scene.scene)
