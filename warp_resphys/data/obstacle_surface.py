"""Surfaces of rigid obstacles, for pictures of bodies that touch them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from ..energies.contact.contact_points import GROWTH, MOTION, SHIFT, TURN
from ..energies.contact.obstacle_contact import Contact
from ..energies.contact.obstacles import surface_of
from ..fem.bodies import Body
from ..io.arrays import FloatArray, IntArray
from .registration import RigidTransform

_NEAR: Final = 0.2  # Width of the space around a body in which its obstacles are shown, over its size.


@dataclass(frozen=True, eq=False)
class ObstacleSurface:
    """Triangles of all O obstacles of a body, at rest or at T times."""

    # (P, 3) in the axes of the obstacles [m].
    local: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    triangles: IntArray = field(default_factory=lambda: np.empty((0, 3), dtype=np.int64))  # (S, 3).
    owners: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (P,) obstacle of each point.
    # (O, 12) or (T, O, 12): for every obstacle its position [m] and a rotation by rows, from its axes.
    poses: FloatArray = field(default_factory=lambda: np.empty((0, 12)))
    # (O, 6) shift of every obstacle from its place [m], and rotation vector from its configured axes [rad].
    offsets: FloatArray = field(default_factory=lambda: np.empty((0, 6)))
    axes: FloatArray = field(default_factory=lambda: np.empty((0, 3, 3)))  # (O, 3, 3) configured ones.

    @classmethod
    def of(cls, body: Body, parameters: Mapping[str, Any] | None = None) -> "ObstacleSurface":
        """Returns the obstacles of a body, none of which has moved by inputs.

        Args:
            body: With or without obstacles.
            parameters: Identified values by name, such as `obstacle_x_bar`; others are zero.
        """
        known, points, triangles = parameters or {}, [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int64)]
        energies = [energy for _, part, _ in body.members for energy in part.energies]
        contacts = [energy for energy in energies if isinstance(energy, Contact)]
        obstacles = [item for contact in contacts for item in contact.obstacles.items()]
        for name, obstacle in obstacles:
            corners, faces = surface_of(obstacle, _value(known, GROWTH.name, name), body.vertices)
            triangles.append(faces + sum(map(len, points)))
            points.append(corners)
        offsets = np.array(
            [[_value(known, q.name, name) for q in (*SHIFT, *TURN)] for name, _ in obstacles], dtype=np.float64
        ).reshape(-1, 6)
        places = offsets[:, :3] + np.reshape([o.position for _, o in obstacles], (-1, 3))
        axes = np.reshape([o.turn for _, o in obstacles], (-1, 3, 3))
        owners = np.repeat(np.arange(len(obstacles)), [len(corners) for corners in points[1:]])
        poses = _poses(places, offsets[:, 3:], axes)
        return cls(np.concatenate(points), np.concatenate(triangles), owners, poses, offsets, axes)

    def moved(self, inputs: Mapping[str, FloatArray]) -> "ObstacleSurface":
        """Returns the obstacles where inputs (O,) or (T, O) of contact by name put them; itself without such inputs."""
        by_axis = [inputs.get(quantity.name) for quantity in MOTION]
        if all(values is None for values in by_axis):
            return self
        still = np.zeros(len(self.offsets))
        moves = np.stack(np.broadcast_arrays(*(still if values is None else values for values in by_axis)), axis=-1)
        places, turns = self.places + moves[..., :3], self.offsets[:, 3:] + moves[..., 3:]
        return replace(self, poses=_poses(places, turns, self.axes))

    @property
    def places(self) -> FloatArray:
        """(..., O, 3) positions of the obstacles [m]."""
        return self.poses[..., :3]

    @property
    def moves(self) -> bool:
        """Whether it has poses at several times."""
        return self.poses.ndim == 3

    @property
    def points(self) -> FloatArray:
        """(P, 3) or (T, P, 3) [m] corners of the triangles."""
        turns = self.poses[..., 3:].reshape(*self.poses.shape[:-1], 3, 3)
        at = self.owners
        return np.einsum("...pij,pj->...pi", turns[..., at, :, :], self.local) + self.places[..., at, :]

    def at(self, frames: Any) -> "ObstacleSurface":
        """Returns the obstacles at one or some of their times."""
        return replace(self, poses=self.poses[frames]) if self.moves else self

    def carried(self, frame: RigidTransform) -> "ObstacleSurface":
        """Returns the obstacles in another frame."""
        turns = frame.rotation @ self.poses[..., 3:].reshape(*self.poses.shape[:-1], 3, 3)
        poses = np.concatenate([frame.apply(self.places), turns.reshape(*self.poses.shape[:-1], 9)], axis=-1)
        return replace(self, poses=poses)

    def near(self, points: FloatArray) -> FloatArray:
        """Returns corners (Q, 3) [m] of the surface within the frame of points (P, 3) of a body and a margin."""
        low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        margin = _NEAR * (high - low).max()
        return np.clip(self.points.reshape(-1, 3), low - margin, high + margin)


def _poses(places: FloatArray, turns: FloatArray, axes: FloatArray) -> FloatArray:
    """Returns poses (..., O, 12) of obstacles at places (..., O, 3), turned by (..., O, 3) from axes (O, 3, 3)."""
    matrices = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(*turns.shape, 3) @ axes
    return np.concatenate([places, matrices.reshape(*places.shape[:-1], 9)], axis=-1)


def _value(parameters: Mapping[str, Any], name: str, part: str) -> float:
    """Returns the value of a parameter for an obstacle."""
    return float(parameters.get(f"{name}_{part}", parameters.get(name, 0.0)))
