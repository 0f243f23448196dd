"""Inextensible fibres wound around chambers, in their surface.

The operator g_a of a point is the derivative of a shape function along a fibre, so that sum_a g_a
x_a is the deformed unit fibre and its length the stretch.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from ...io.errors import InputError, MeshError
from ...kernels.axial import THREAD
from ..mesh.chambers import Chamber, face_rule
from ..mesh.volume_mesh import Mesh
from ..stepping.quantity import Parameter, parameter
from .base import Energy
from .launcher import Launcher
from .term import LawTerm, PartPoints, PointLaw, PointSet

# Cosine between face normal and chamber axis above which a face is an end cap, without fibres.
_CAP = 0.7
_ALIGNED = 0.8  # smallest cosine between a chamber's principal direction and the given axis
_LARGEST_ANGLE = 85.0  # degrees


@dataclass(frozen=True)
class Fibres(Energy):
    """Inextensible fibres wound around every chamber, in its surface, against radial expansion.

    The energy per area of the surface is ``k s(lambda - 1)`` for each family of windings, with the
    stretch lambda along the fibre and k the stiffness of one fibre [N] over the spacing of its
    turns [m]. Fibres carry no compression: s(x) is zero for x < 0, and its derivative, the force,
    reaches its full slope at the strain `toe`.
    """

    chambers: Sequence[Chamber]  # chambers with fibres
    angles: Sequence[float] = (0.0,)  # (A,) of each family to the circumference [deg], as in +a, -a
    toe: float = 1e-3  # strain at which a fibre reaches its full stiffness
    # fibres are wound around the principal direction of a chamber nearest to this axis; None:
    # around its longest one
    axis: Sequence[float] | None = None
    # k [N/m]: a number, (C,), (B, 1) or (B, C) values
    stiffness: Parameter = parameter(0.0, "fibre_stiffness", "N/m", closed=True, per="chamber")

    @override
    def moved(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> "Fibres":
        return (
            self
            if self.axis is None
            else replace(self, axis=(rotation @ np.asarray(self.axis)).tolist())
        )

    def __post_init__(self) -> None:
        """Checks the values.

        Raises:
            InputError: no chamber, no angle, an angle that is not across the chamber, a strain that
                is not positive, or a negative stiffness.
        """
        if not self.chambers:
            raise InputError(
                "fibres are wound around chambers, but there are none: leave the fibres out."
            )
        angles = np.asarray(self.angles, dtype=np.float64)
        if angles.ndim != 1 or not angles.size or not (np.abs(angles) <= _LARGEST_ANGLE).all():
            raise InputError(
                f"fibre angles are {list(self.angles)}: give one or more, within "
                f"{_LARGEST_ANGLE:g} degrees of the direction around the chamber."
            )
        if not (np.isfinite(self.toe) and self.toe > 0.0):
            raise InputError(
                f"the strain over which fibres tighten is {self.toe:g}: it must be positive."
            )
        super().__post_init__()

    @property
    @override
    def count(self) -> int:
        return len(self.chambers)

    @override
    def points(self, mesh: Mesh) -> tuple[PartPoints, ...]:
        """Returns the integration points, with zero weight on the end caps.

        Raises:
            MeshError: a chamber without a principal direction near `axis`.
        """
        shape, (points, weights) = face_rule(self.chambers, 2)
        _, gradients = shape(points)
        operators, areas = [], []
        for chamber in self.chambers:
            x = mesh.vertices[chamber.faces]
            axis = _long_axis(chamber, mesh, self.axis)
            t1, t2 = np.einsum("fki,qkj->jfqi", x, gradients)
            normal = np.cross(t1, t2)
            area = np.linalg.norm(normal, axis=-1)
            normal /= area[..., None]
            around = np.cross(axis, normal)
            size = np.linalg.norm(around, axis=-1, keepdims=True)
            around /= np.maximum(size, 1e-12)
            along = np.cross(normal, around)
            wound = np.abs(normal @ axis) < _CAP
            # Dual tangents: the surface gradient of a shape function is its reference gradient
            # times these.
            dual = (
                np.stack([np.cross(t2, normal), np.cross(normal, t1)], axis=-1)
                / area[..., None, None]
            )
            for angle in np.radians(self.angles):
                direction = np.cos(angle) * around + np.sin(angle) * along
                slopes = np.einsum("qkj,fqij,fqi->fqk", gradients, dual, direction)
                operators.append(np.where(wound[..., None], slopes, 0.0))
                areas.append(np.where(wound, area * weights, 0.0))
        families = len(self.angles)
        nodes = np.concatenate([np.tile(chamber.faces, (families, 1)) for chamber in self.chambers])
        counts = [families * len(c.faces) * len(weights) for c in self.chambers]
        part = np.repeat(np.arange(len(self.chambers)), counts)
        return (
            PartPoints(
                nodes, np.concatenate(operators)[..., None], part, np.concatenate(areas).ravel()
            ),
        )

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> LawTerm:
        shapes = {"fibre_stiffness": (self.count,)}
        law = PointLaw(THREAD, [self.toe], stiffness=lambda v: v["fibre_stiffness"])
        return LawTerm(launcher, sets, law, shapes, self.count)


def _long_axis(chamber: Chamber, mesh: Mesh, near: Sequence[float] | None) -> NDArray[np.float64]:
    """Returns the principal direction (3,) of a chamber nearest to an axis, or its longest one."""
    vertices = mesh.vertices[chamber.vertices]
    directions: NDArray[np.float64] = np.linalg.svd(
        vertices - vertices.mean(axis=0), full_matrices=False
    )[2]
    if near is None:
        return directions[0]
    aligned = np.abs(directions @ np.asarray(near, dtype=np.float64)) / np.linalg.norm(near)
    if aligned.max() < _ALIGNED:
        raise MeshError(
            f"{chamber.name} has no direction near {list(near)}, around which fibres could be "
            "wound: give the direction of the chambers (chambers.axis)."
        )
    return directions[aligned.argmax()]
