"""Contact with obstacles: its quantities, and vertices of a surface
with areas and factors of friction.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ....io.errors import InputError, naming
from ...fem.integration_points import Points
from ...mesh.elements import FACES
from ...mesh.volume_mesh import Mesh, boundary_faces, face_triangles
from ...stepping.quantity import Quantity

STIFFNESS = Quantity("contact_stiffness", "Pa", 0.0, per="obstacle")
FRICTION = Quantity("contact_friction", "", 0.0, closed=True, per="obstacle")
GROWTH = Quantity("obstacle_growth", "m", per="obstacle", typical=1e-3)
SHIFT = tuple(Quantity(f"obstacle_{axis}", "m", per="obstacle", typical=1e-2) for axis in "xyz")
TURN = tuple(
    Quantity(f"obstacle_turn_{axis}", "rad", per="obstacle", typical=0.1) for axis in "xyz"
)
MOTION = (
    *(Quantity(f"obstacle_move_{axis}", "m", per="obstacle", typical=1e-2) for axis in "xyz"),
    *(Quantity(f"obstacle_rotate_{axis}", "rad", per="obstacle", typical=0.1) for axis in "xyz"),
)
POSE: Final = ("contact_place", "contact_turn")
FRICTION_VALUES: Final = ("contact_load", "contact_normal", "contact_reference")


@dataclass(frozen=True)
class ContactPoints(Points):
    """Vertices of a surface."""

    areas: NDArray[np.float64]  # (P,) [m^2]
    factors: NDArray[np.float64]  # (P,) of friction


def vertex_areas(mesh: Mesh) -> NDArray[np.float64]:
    """Returns the part of the surface that belongs to every vertex, (N,) [m^2].

    Its sum is that of the surface.
    """
    faces, areas = boundary_faces(mesh), np.zeros(len(mesh.vertices))
    if faces.shape[1] != FACES[faces.shape[1]].corners:
        faces = face_triangles(faces)  # Integrals of quadratic shape functions vanish at corners.
    face = FACES[faces.shape[1]]
    places, weights = face.rule(2)
    values, slopes = face.shape(places)
    tangents = np.einsum("qkd,fki->fqdi", slopes, mesh.vertices[faces])
    sizes = np.linalg.norm(np.cross(tangents[..., 0, :], tangents[..., 1, :]), axis=-1) * weights
    np.add.at(areas, faces, np.einsum("fq,qk->fk", sizes, values))
    return areas


def vertex_factors(mesh: Mesh, factors: Mapping[str, float]) -> NDArray[np.float64]:
    """Returns the factor of friction at every vertex, (N,):
    the mean of its cells', which is one outside all regions.

    Raises:
        InputError: the mesh has no such region, or a cell is in two of them.
    """
    by_cell, named = np.ones(len(mesh.cells)), np.zeros(len(mesh.cells), dtype=bool)
    for name, factor in factors.items():
        with naming("contact.friction_factors: "):
            cells = mesh.region(name)
        if named[cells].any():
            raise InputError(
                f"contact.friction_factors: {name!r} shares cells "
                "with another region: leave one out."
            )
        by_cell[cells], named[cells] = factor, True
    corners, size = mesh.cells.ravel(), len(mesh.vertices)
    counts = np.bincount(corners, minlength=size).clip(1)
    return np.asarray(np.bincount(corners, np.repeat(by_cell, mesh.cells.shape[1]), size) / counts)
