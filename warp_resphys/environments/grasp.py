"""A world of grippers: two fingers of a run on a thing that they close on and lift."""

from typing import Final

import numpy as np
import torch
from typing_extensions import override

from ..control.world import BoolArray, FloatArray, IntArray, World
from ..mesh.mesh import boundary_triangles
from ..report.obstacles import ObstacleSurface
from ..robot.gripper import THING, GripperSettings, Thing, finger_inputs, gripper
from ..robot.robot import Robot

RISE: Final = 0.02  # of the gripper [m], which lifts a thing
SPEED: Final = 0.02  # of the gripper [m/s]: it rises while it closes


class GraspWorld(World):
    """B grippers, which take the command of both fingers, and their own height.

    The last marker is the middle of the thing.

    Args:
        robot: a finger, loaded with ``on_failure="count"``.
        driven: name of its input, which has one value.
        count: B.
        time_step: h [s], a multiple of the robot's.
        settings: of thing, table and contact.
        thing: that is grasped.
    """

    parts, travel = 2, (0.0, 0.0, RISE)

    def __init__(
        self,
        robot: Robot,
        driven: str,
        count: int,
        time_step: float,
        settings: GripperSettings | None = None,
        thing: Thing = "ball",
    ) -> None:
        self._scene = gripper(robot, settings or GripperSettings(), thing)
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
            moved = np.zeros((self.count, 3))
            moved[:, 2] = height + (commands[:, 1] - height) * part / self._substeps
            self._state = self._scene.step(self._state, finger_inputs(self.input, commands[:, :1], moved))
        self._height = commands[:, 1].copy()
        return np.asarray(self._state.lost.cpu().numpy())

    @override
    def markers(self) -> FloatArray:
        fingers = torch.cat(list(self._scene.observe(self._state).values()), 1)
        thing = self._state.body.q[:, self._scene.scene.vertex_slice(THING)].mean(1, keepdim=True)
        return np.asarray(torch.cat([fingers, thing], 1).double().cpu().numpy())

    @override
    def bodies(self) -> tuple[IntArray, FloatArray]:
        return boundary_triangles(self._scene.scene.mesh), self._state.body.q.double().cpu().numpy()

    @override
    def obstacles(self) -> ObstacleSurface:
        return ObstacleSurface.of(self._scene.scene)
