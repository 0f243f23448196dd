"""The world of arms of six joints, each of which carries a gripper of two soft fingers,
and a ball on a table.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from typing_extensions import override

from ..control.worlds import World
from ..core.energies.contact.obstacle_surface import ObstacleSurface
from ..core.mesh.volume_mesh import boundary_triangles
from ..core.stepping.rollout import states
from ..coupling.geoms import GeomSurfaces
from ..coupling.mount import Mount, MountedState
from ..coupling.mounting_body import mujoco_package
from ..io.arrays import FloatArray, IntArray
from ..robot.robot import Robot
from .grippers import BALL, FINGERS, finger_forces, gripper, squeeze_of

ARM: Final = Path(__file__).with_name("arm.xml")
FLANGE: Final = "flange"
PALM: Final = (0.0, 0.0, -0.025, 0.0, 0.0, 0.0)  # pose of the gripper on the flange [m, rad]
JOINT_SPEED: Final = 1.5  # largest speed of a joint [rad/s]
_AWAY: Final = 0.3  # distance of the arm's foot from the ball [m]
_DIVISIONS: Final = 3  # of the ball
_TABLE: Final = (4.2, 3.2, 1.0)  # size of the table in pictures, relative to that of fingers alone
_TO_FOOT: Final = (0.13, 0.0, 0.0)  # its shift towards the foot [m]
_STEP: Final = 0.0025  # largest time step of the arm [s]


class ArmWorld(World[MountedState]):
    """B arms, which take the command of both fingers, and the angles of their joints [rad].

    The last two markers are the place between the fingers that holds a ball, and the middle of the
    ball.

    Args:
        robot: a finger, loaded with ``on_failure="count"``; the mount steps it by implicit Euler.
        driven: name of its input, which has one value.
        count: B.
        time_step: h [s], a multiple of the robot's.

    Attributes:
        mount: of the gripper on the arm.
        ball: which vertices are those of the ball.
        held: (3,) place of a held ball in the frame of the gripper [m].
        low: (6,) least angles of the joints [rad].
        high: (6,) greatest angles of the joints [rad].

    Raises:
        InputError: MuJoCo is not installed.
    """

    parts = 7

    def __init__(self, robot: Robot, driven: str, count: int, time_step: float) -> None:
        mujoco = mujoco_package()
        self._scene = scene = gripper(robot.integrated_by("implicit_euler"), _DIVISIONS)
        self.count, self.input = count, driven
        self.time_step = time_step
        self._substeps = round(time_step / robot.time_step)
        self.ball = scene.scene.vertex_slice(BALL)
        ball = scene.simulator.rest_positions[self.ball].cpu().numpy()
        model = mujoco.MjModel.from_xml_path(str(ARM))
        model.opt.timestep = robot.time_step / np.ceil(robot.time_step / _STEP - 1e-9)
        model.opt.gravity[:] = scene.simulator.gravity
        model.body("base").pos[:] = -_AWAY, 0.0, ball[:, 2].min()
        self.held, (self.low, self.high) = ball.mean(axis=0), model.actuator_ctrlrange.T
        self.mount, self._surfaces = Mount(scene, model, FLANGE, PALM), GeomSurfaces(model)
        self.rest = self.mount.begin([mujoco.MjData(model)] * count)

    @override
    def step(self, state: MountedState, commands: FloatArray) -> MountedState:
        inputs = {name: {self.input: commands[:, :1]} for name in FINGERS}

        def step(before: MountedState, _: int) -> MountedState:
            return self.mount.step(before, commands[:, 1:], **inputs)

        *_, after = states(step, state, range(self._substeps))
        return after

    @override
    def markers(self, state: MountedState) -> FloatArray:
        fingers = (
            torch.cat(list(self._scene.observe(state.robot).values()), 1).double().cpu().numpy()
        )
        held = state.pose[:, :3] + Rotation.from_rotvec(state.pose[:, 3:]).apply(self.held)
        ball = state.robot.q[:, self.ball].mean(1).double().cpu().numpy()
        return np.concatenate([fingers, held[:, None], ball[:, None]], axis=1)

    @override
    def forces(self, state: MountedState) -> FloatArray:
        return finger_forces(self._scene, state.robot).reshape(self.count, -1)

    @override
    def squeeze(self, state: MountedState) -> FloatArray:
        return squeeze_of(self._scene, state.robot)

    @override
    def bodies(self, state: MountedState) -> tuple[IntArray, FloatArray]:
        return boundary_triangles(self._scene.scene.mesh), state.robot.q.double().cpu().numpy()

    @override
    def rigid(self, state: MountedState) -> tuple[IntArray, FloatArray]:
        arms: list[Any] = [self.mount.data(state, number) for number in range(self.count)]
        return self._surfaces.triangles, np.stack([self._surfaces.points(arm) for arm in arms])

    @override
    def obstacles(self) -> ObstacleSurface:
        table = ObstacleSurface.of(self._scene.scene)
        return replace(table, local=table.local * _TABLE - _TO_FOOT)
