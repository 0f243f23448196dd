"""Surfaces of rigid obstacles, for pictures of bodies that touch them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from ..energies.contact import GROWTH, SHIFT, TURN, Contact
from ..energies.obstacle_surfaces import surface_of
from ..fem.body import Body
from .render import FloatArray, IntArray

OBSTACLE: Final = "#b9b2a6"  # Colour of obstacles: a warm grey beside the blue of bodies.
OBSTACLE_LIGHT: Final = (0.62, 0.42)
_NEAR: Final = 0.2  # Width of the space around a body in which its obstacles are shown, over its size.


@dataclass(frozen=True, eq=False)
class ObstacleSurface:
    """Triangles of all obstacles of a body."""

    points: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # (P, 3) [m].
    triangles: IntArray = field(default_factory=lambda: np.empty((0, 3), dtype=np.int64))  # (S, 3).

    @classmethod
    def of(cls, body: Body, parameters: Mapping[str, Any] | None = None) -> "ObstacleSurface":
        """Returns the obstacles of a body, none of which moves by inputs.

        Args:
            body: With or without obstacles.
            parameters: Identified values by name, such as `obstacle_x_bar`; others are zero.
        """
        known, points, triangles = parameters or {}, [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int64)]
        for contact in (energy for energy in body.energies if isinstance(energy, Contact)):
            for name, obstacle in contact.obstacles.items():
                shift, turn = (
                    np.array([_value(known, q.name, name) for q in quantities]) for quantities in (SHIFT, TURN)
                )
                growth, matrix = (
                    _value(known, GROWTH.name, name),
                    Rotation.from_rotvec(turn).as_matrix() @ obstacle.turn,
                )
                own, faces = surface_of(obstacle, growth, body.mesh.vertices)
                triangles.append(faces + sum(map(len, points)))
                points.append(own @ matrix.T + obstacle.position + shift)
        return cls(np.concatenate(points), np.concatenate(triangles))

    def near(self, points: FloatArray) -> FloatArray:
        """Returns corners (Q, 3) [m] of the surface within the frame of points (P, 3) of a body and a margin."""
        low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        margin = _NEAR * (high - low).max()
        return np.clip(self.points, low - margin, high + margin)


def _value(parameters: Mapping[str, Any], name: str, part: str) -> float:
    """Returns the value of a parameter for an obstacle."""
    return float(parameters.get(f"{name}_{part}", parameters.get(name, 0.0)))
