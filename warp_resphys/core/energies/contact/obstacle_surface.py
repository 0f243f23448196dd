"""Surfaces of rigid obstacles, for pictures and files of bodies that touch them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ....io.arrays import Brief, FloatArray, IntArray
from ...fem.bodies import Body
from .contact_points import GROWTH, MOTION, SHIFT, TURN
from .obstacle_contact import Contact
from .obstacle_poses import Pose
from .obstacles import Obstacle, surface_of

# Width of the space around a body in which its obstacles are shown, over its size.
_NEAR: Final = 0.2


@dataclass(frozen=True, eq=False)
class ObstacleSurface(Brief):
    """Triangles of all O obstacles of a body, at rest or at T times."""

    names: tuple[str, ...] = ()  # Of the obstacles, with their bodies' if there are several.
    # (P, 3) in the axes of the obstacles [m].
    local: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    triangles: IntArray = field(default_factory=lambda: np.empty((0, 3), dtype=np.int64))  # (S, 3).
    owners: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (P,) obstacles.
    # (O, 12) or (T, O, 12): for every obstacle its position [m] and a rotation by rows, from its
    # axes.
    poses: FloatArray = field(default_factory=lambda: np.empty((0, 12)))
    # (O, 6) shift of every obstacle from its place [m], and rotation vector from its configured
    # axes [rad].
    offsets: FloatArray = field(default_factory=lambda: np.empty((0, 6)))
    axes: FloatArray = field(default_factory=lambda: np.empty((0, 3, 3)))  # (O, 3, 3) configured.

    @classmethod
    def of(cls, body: Body, parameters: Mapping[str, Any] | None = None) -> "ObstacleSurface":
        """Returns the obstacles of a body, none of which has moved by inputs.

        Args:
            body: With or without obstacles.
            parameters: Identified values by name, such as `obstacle_x_bar`; others are zero.
        """
        known, obstacles = parameters or {}, _obstacles(body)
        values = [
            [_value(known, prefix, x, q.name) for q in (GROWTH, *SHIFT, *TURN)]
            for prefix, x, _ in obstacles
        ]
        return cls._made(body, obstacles, np.reshape(np.array(values, dtype=np.float64), (-1, 7)))

    @classmethod
    def along(cls, body: Body, poses: Sequence[Pose], environment: int = 0) -> "ObstacleSurface":
        """Returns the obstacles of a body at their T poses in an environment of a roll-out."""
        if not poses:
            return cls()
        fields = [(pose.place[environment], pose.turn[environment].flatten(1)) for pose in poses]
        series = (
            torch.stack([torch.cat(field, 1) for field in fields]).detach().cpu().double().numpy()
        )
        values = np.zeros((series.shape[1], 7))
        values[:, 0] = poses[0].growth[environment].detach().cpu()
        return replace(cls._made(body, _obstacles(body), values), poses=series)

    @classmethod
    def _made(
        cls, body: Body, obstacles: Sequence[tuple[str, str, Obstacle]], values: FloatArray
    ) -> "ObstacleSurface":
        """Obstacles by prefixes of their bodies and their names, with growth and offsets (O, 7)."""
        points, triangles = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int64)]
        for (_, _, obstacle), growth in zip(obstacles, values[:, 0], strict=True):
            corners, faces = surface_of(obstacle, float(growth), body.vertices)
            triangles.append(faces + sum(map(len, points)))
            points.append(corners)
        offsets = values[:, 1:]
        places = offsets[:, :3] + np.reshape([o.position for *_, o in obstacles], (-1, 3))
        axes = np.reshape([o.turn for *_, o in obstacles], (-1, 3, 3))
        owners = np.repeat(np.arange(len(obstacles)), [len(corners) for corners in points[1:]])
        poses = _poses(places, offsets[:, 3:], axes)
        names = tuple(f"{prefix}{name}" for prefix, name, _ in obstacles)
        return cls(
            names, np.concatenate(points), np.concatenate(triangles), owners, poses, offsets, axes
        )

    def moved(self, inputs: Mapping[str, FloatArray]) -> "ObstacleSurface":
        """Returns the obstacles where inputs (O,) or (T, O) of contact by name put them.

        Itself without such inputs.
        """
        by_axis = [inputs.get(quantity.name) for quantity in MOTION]
        if all(values is None for values in by_axis):
            return self
        still = np.zeros(len(self.offsets))
        moves = np.stack(
            np.broadcast_arrays(*(still if values is None else values for values in by_axis)),
            axis=-1,
        )
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
        return (
            np.einsum("...pij,pj->...pi", turns[..., at, :, :], self.local)
            + self.places[..., at, :]
        )

    def at(self, frames: Any) -> "ObstacleSurface":
        """Returns the obstacles at one or some of their times."""
        return replace(self, poses=self.poses[frames]) if self.moves else self

    def carried(self, rotation: FloatArray, translation: FloatArray) -> "ObstacleSurface":
        """Returns the obstacles in another frame, by a map p -> R p + t."""
        turns = rotation @ self.poses[..., 3:].reshape(*self.poses.shape[:-1], 3, 3)
        places = self.places @ rotation.T + translation
        return replace(
            self, poses=np.concatenate([places, turns.reshape(*self.poses.shape[:-1], 9)], axis=-1)
        )

    @property
    def solids(self) -> dict[str, tuple[FloatArray, IntArray]]:
        """Corners (..., P, 3) [m] and triangles (S, 3) of each obstacle by name."""
        points, solids = self.points, dict[str, tuple[FloatArray, IntArray]]()
        for number, name in enumerate(self.names):
            corners = np.flatnonzero(self.owners == number)
            own = self.owners[self.triangles[:, 0]] == number
            solids[name] = points[..., corners, :], np.searchsorted(corners, self.triangles[own])
        return solids

    def near(self, points: FloatArray) -> FloatArray:
        """Returns corners (Q, 3) [m] of the surface within the frame
        of points (P, 3) of a body and a margin.
        """
        low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        margin = _NEAR * (high - low).max()
        return np.clip(self.points.reshape(-1, 3), low - margin, high + margin)


def _poses(places: FloatArray, turns: FloatArray, axes: FloatArray) -> FloatArray:
    """Returns poses (..., O, 12) of obstacles at places (..., O, 3),
    turned by (..., O, 3) from axes (O, 3, 3).
    """
    matrices = (
        Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(*turns.shape, 3) @ axes
    )
    return np.concatenate([places, matrices.reshape(*places.shape[:-1], 9)], axis=-1)


def _obstacles(body: Body) -> list[tuple[str, str, Obstacle]]:
    """The obstacles of a body or a scene, with the prefixes of their bodies and their names."""
    energies = [
        (f"{name}_" if name else "", energy)
        for name, part, _ in body.members
        for energy in part.energies
    ]
    contacts = [(prefix, energy) for prefix, energy in energies if isinstance(energy, Contact)]
    return [(prefix, *item) for prefix, contact in contacts for item in contact.obstacles.items()]


def _value(parameters: Mapping[str, Any], prefix: str, part: str, name: str) -> float:
    """Returns the value of a parameter for an obstacle."""
    return float(parameters.get(f"{prefix}{name}_{part}", parameters.get(f"{prefix}{name}", 0.0)))
