"""Chamber surfaces as points, for the energies of pressure and of fibres.

Both are of the form that `elements` gives to the volume: a point has an operator g_a for each node of its face, and its
matrix F = sum_a x_a g_a^T holds all that the energy depends on.

- Pressure: g_a holds the shape function and its two reference gradients, so that F has the columns x, t1 and t2, the
  place and the tangents of the deformed face. The enclosed volume is the sum of -w/3 x . (t1 x t2) = -w/3 det F, as the
  faces look into the chamber.
- Fibres: g_a holds the derivative along a fibre, so that the first column of F is the deformed fibre, its length the
  stretch.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..io.errors import InputError, MeshError
from ..mesh.chambers import Chamber
from ..mesh.mesh import Mesh
from ..mesh.shape_functions import (
    Array,
    gauss_quadrilateral,
    gauss_triangle,
    quadrilateral_shape,
    triangle6_shape,
    triangle_shape,
)
from .elements import Points

_CAP = 0.7  # cosine between a face's normal and the chamber's axis from which on the face is an end, without fibres
_ALIGNED = 0.8  # cosine between a chamber's axis and the direction that fibres are wound around, at least
_LARGEST_ANGLE = 85.0  # degrees


@dataclass(frozen=True)
class Fibres:
    """Inextensible thread wound around every chamber, in its surface: it holds a chamber from growing wide.

    The energy of an area of the surface is ``k/2 s(lambda - 1)^2`` for each family of windings, lambda being the
    stretch along it and k the stiffness of one thread [N] over the distance of its turns [m] (`Material`). A thread
    cannot push: s is zero for lambda < 1, and reaches its full slope at the strain `toe`.

    Attributes:
        angles: (A,) of each family of windings from the direction around the chamber, in degrees; two opposite ones
            make a double helix.
        toe: strain over which a thread tightens.
        axis: about along the chambers, which are wound around the one of their principal directions that is nearest to
            it; None for that in which each reaches furthest.
    """

    angles: Sequence[float] = (0.0,)
    toe: float = 1e-3
    axis: Sequence[float] | None = None

    def __post_init__(self) -> None:
        """Checks the angles and the strain.

        Raises:
            InputError: no angle, one that is not across the chamber, or a strain that is not positive.
        """
        angles = np.asarray(self.angles, dtype=np.float64)
        if angles.ndim != 1 or not angles.size or not (np.abs(angles) <= _LARGEST_ANGLE).all():
            raise InputError(
                f"fibre angles are {list(self.angles)}: give one or more, within {_LARGEST_ANGLE:g} degrees of the "
                "direction around the chamber."
            )
        if not (np.isfinite(self.toe) and self.toe > 0.0):
            raise InputError(f"the strain over which fibres tighten is {self.toe:g}: it must be positive.")


@dataclass(frozen=True)
class SurfacePoints(Points):
    """Points on the surfaces of chambers.

    Attributes:
        weights: (P,) of each point: one third of the quadrature weight for pressure, the area for fibres [m^2].
        chamber: (P,) number of its chamber.
    """

    weights: Array
    chamber: NDArray[np.int64]


def pressure_points(chambers: Sequence[Chamber]) -> SurfacePoints:
    """The points at which the volume of chambers is integrated, exactly."""
    shape, (points, weights) = _face_rule(chambers, 4)
    values, gradients = shape(points)
    nodes = np.concatenate([chamber.faces for chamber in chambers])
    operator = np.concatenate([values[..., None], gradients], axis=2)  # (Q, K, 3)
    count = len(nodes)
    return SurfacePoints(
        nodes,
        np.broadcast_to(operator, (count, *operator.shape)).copy(),
        np.tile(weights / 3.0, count),
        _owners(chambers, len(weights)),
    )


def fibre_points(mesh: Mesh, chambers: Sequence[Chamber], fibres: Fibres) -> SurfacePoints:
    """The points at which the energy of fibres is integrated; the ends of chambers have none.

    Raises:
        MeshError: a chamber that has no direction near that of the fibres.
    """
    shape, (points, weights) = _face_rule(chambers, 2)
    _, gradients = shape(points)
    operators, areas = [], []
    for chamber in chambers:
        x = mesh.vertices[chamber.faces]
        axis = _long_axis(chamber, mesh, fibres.axis)
        t1, t2 = np.einsum("fki,qkj->jfqi", x, gradients)
        normal = np.cross(t1, t2)
        area = np.linalg.norm(normal, axis=-1)
        normal /= area[..., None]
        around = np.cross(axis, normal)
        size = np.linalg.norm(around, axis=-1, keepdims=True)
        around /= np.maximum(size, 1e-12)
        along = np.cross(normal, around)
        wound = np.abs(normal @ axis) < _CAP
        # Dual tangents: the surface gradient of a shape function is its reference gradient times these.
        dual = np.stack([np.cross(t2, normal), np.cross(normal, t1)], axis=-1) / area[..., None, None]
        for angle in np.radians(fibres.angles):
            direction = np.cos(angle) * around + np.sin(angle) * along
            slopes = np.einsum("qkj,fqij,fqi->fqk", gradients, dual, direction)
            operators.append(np.where(wound[..., None], slopes, 0.0))
            areas.append(np.where(wound, area * weights, 0.0))
    slopes = np.concatenate(operators)  # (C, Q, K)
    operator = np.zeros((*slopes.shape, 3))
    operator[..., 0] = slopes
    families = len(fibres.angles)
    nodes = np.concatenate([np.tile(chamber.faces, (families, 1)) for chamber in chambers])
    numbers = np.repeat(np.arange(len(chambers)), [families * len(c.faces) * len(weights) for c in chambers])
    return SurfacePoints(nodes, operator, np.concatenate(areas).ravel(), numbers)


def _face_rule(
    chambers: Sequence[Chamber], degree: int
) -> tuple[Callable[[Array], tuple[Array, Array]], tuple[Array, Array]]:
    """Shape functions of the faces, and a rule exact for linear faces and for a polynomial degree on quadratic ones."""
    corners = chambers[0].faces.shape[1]
    if corners == 4:
        return quadrilateral_shape, gauss_quadrilateral()
    return (triangle_shape, gauss_triangle(1)) if corners == 3 else (triangle6_shape, gauss_triangle(degree))


def _owners(chambers: Sequence[Chamber], points: int) -> NDArray[np.int64]:
    return np.repeat(np.arange(len(chambers)), [len(chamber.faces) * points for chamber in chambers])


def _long_axis(chamber: Chamber, mesh: Mesh, near: Sequence[float] | None) -> Array:
    """(3,) the principal direction of a chamber that is nearest to one, or in which it reaches furthest."""
    vertices = mesh.vertices[chamber.vertices]
    directions: Array = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2]
    if near is None:
        return directions[0]
    aligned = np.abs(directions @ np.asarray(near, dtype=np.float64)) / np.linalg.norm(near)
    if aligned.max() < _ALIGNED:
        raise MeshError(
            f"{chamber.name} has no direction near {list(near)}, around which fibres could be wound: give the "
            "direction of the chambers (chambers.axis)."
        )
    return directions[aligned.argmax()]
