"""Rigid obstacles, and the friction between pairs of regions."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from typing_extensions import override

from ....io.arrays import FloatArray
from ....io.settings import NotNegative, Positive, Settings, Vector, Word, setting
from ...mesh.place import Direction, LengthUnit


class Obstacle(Settings):
    """A rigid body."""

    position: Vector = setting(
        (0.0, 0.0, 0.0), "position of its centre; of a half-space, a point of its plane", "m"
    )
    axis: Direction = setting(
        (0.0, 0.0, 1.0), "direction of its z axis: a half-space's normal, a cylinder's axis"
    )
    moves: bool = setting(False, "moves by `data.obstacle_motion` or inputs of a robot")

    @property
    def size(self) -> tuple[float, float, float]:
        """Sizes as in `kernels.contact.signed_distances` [m]."""
        return (0.0, 0.0, 0.0)

    @property
    def turn(self) -> FloatArray:
        """(3, 3) rotation from its axes to those of the world."""
        z = np.asarray(self.axis, dtype=float) / np.linalg.norm(self.axis)
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - (x @ z) * z
        x /= np.linalg.norm(x)
        return np.stack([x, np.cross(z, x), z], axis=1)


class HalfSpace(Obstacle):
    """All points below a plane, such as a floor."""

    shape: Literal["half_space"] = "half_space"


class Sphere(Obstacle):
    """A sphere."""

    shape: Literal["sphere"] = "sphere"
    radius: Positive = setting(unit="m")

    @property
    @override
    def size(self) -> tuple[float, float, float]:
        return (self.radius, 0.0, 0.0)


class _Rod(Obstacle):
    """A shape of revolution."""

    radius: Positive = setting(unit="m")
    length: Positive = setting(
        description="length along its axis, of a capsule without the half-spheres", unit="m"
    )

    @property
    @override
    def size(self) -> tuple[float, float, float]:
        return (self.radius, self.radius, 0.5 * self.length)


class Capsule(_Rod):
    """All points within a radius of a segment."""

    shape: Literal["capsule"] = "capsule"


class Cylinder(_Rod):
    """A cylinder with flat ends."""

    shape: Literal["cylinder"] = "cylinder"


class Box(Obstacle):
    """A cuboid with edges along the axes of the world, unless its axis turns it."""

    shape: Literal["box"] = "box"
    edges: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)] = setting(
        description="their lengths", unit="m"
    )

    @property
    @override
    def size(self) -> tuple[float, float, float]:
        x, y, z = self.edges
        return (0.5 * x, 0.5 * y, 0.5 * z)


class SurfaceFile(Obstacle):
    """The interior of a closed surface, by its distances on a grid."""

    shape: Literal["surface"] = "surface"
    path: Word = setting(description="path of an STL, OBJ or PLY file; its z axis is along `axis`")
    units: LengthUnit = setting("mm", "unit of the file")
    spacing: Positive = setting(1.0e-3, "spacing of the grid, which rounds edges", "m")


class FrictionPair(Settings):
    """Friction between two regions of the mesh, or within one; in a `Scene`, bodies are regions.

    A vertex, an edge or a triangle is in a region if all of its vertices are.
    """

    first: Word = setting(description="name of a region")
    second: Word = setting(description="name of a region, which may be the same")
    friction: NotNegative = setting(description="coefficient of friction")
