"""Settings of rigid obstacles, and of contact with them."""

from typing import Annotated, Literal

from pydantic import Field

from ..io.settings import NotNegative, Positive, Settings, Vector, Word, setting
from .mesh import Direction, LengthUnit


class _Placed(Settings):
    position: Vector = setting((0.0, 0.0, 0.0), "position of its centre; of a half-space, a point of its plane", "m")
    axis: Direction = setting((0.0, 0.0, 1.0), "direction of its z axis: a half-space's normal, a cylinder's axis")
    moves: bool = setting(False, "moves by `data.obstacle_motion` or inputs of a robot")


class HalfSpaceSettings(_Placed):
    """All points below a plane, such as a floor."""

    shape: Literal["half_space"]


class SphereSettings(_Placed):
    """A sphere."""

    shape: Literal["sphere"]
    radius: Positive = setting(unit="m")


class CapsuleSettings(_Placed):
    """All points within a radius of a segment."""

    shape: Literal["capsule"]
    radius: Positive = setting(unit="m")
    length: Positive = setting(description="length along its axis, without the half-spheres", unit="m")


class CylinderSettings(_Placed):
    """A cylinder with flat ends."""

    shape: Literal["cylinder"]
    radius: Positive = setting(unit="m")
    length: Positive = setting(description="length along its axis", unit="m")


class CuboidSettings(_Placed):
    """A cuboid with edges along the axes of the world, unless its axis turns it."""

    shape: Literal["box"]
    edges: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)] = setting(
        description="their lengths", unit="m"
    )


class SurfaceSettings(_Placed):
    """The interior of a closed surface, by its distances on a grid."""

    shape: Literal["surface"]
    path: Word = setting(description="path of an STL, OBJ or PLY file; its z axis is along `axis`")
    units: LengthUnit = setting("mm", "unit of the file")
    spacing: Positive = setting(1.0e-3, "spacing of the grid, which rounds edges", "m")


ObstacleSettings = Annotated[
    HalfSpaceSettings | SphereSettings | CapsuleSettings | CylinderSettings | CuboidSettings | SurfaceSettings,
    Field(discriminator="shape"),
]


class FrictionPairSettings(Settings):
    """Friction between two regions of the mesh, or within one, by `energies.surfaces.FrictionPair`."""

    first: Word = setting(description="name of a region")
    second: Word = setting(description="name of a region, which may be the same")
    friction: NotNegative = setting(description="coefficient of friction")


class SurfaceContactSettings(Settings):
    """Contact of the body with itself, and of its parts with one another, by `energies.surfaces`."""

    stiffness: Positive = setting(1.0e5, "stiffness of the barrier", "Pa")
    friction: NotNegative = setting(0.0, "coefficient of friction")
    distance: Positive = setting(1.0e-3, "gap at which contact begins", "m")
    slip_speed: Positive = setting(1.0e-3, "speed at which friction is fully developed", "m/s")
    pairs: dict[str, FrictionPairSettings] = setting({}, "friction of pairs of regions, by name, the first that fits")


class ContactSettings(Settings):
    """Contact of the body with its obstacles, by `energies.contact`."""

    stiffness: Positive | dict[str, Positive] = setting(1.0e5, "stiffness of the barrier, or one per obstacle", "Pa")
    friction: NotNegative | dict[str, NotNegative] = setting(0.0, "coefficient, or one per obstacle")
    distance: Positive = setting(1.0e-3, "gap at which contact begins", "m")
    slip_speed: Positive = setting(1.0e-3, "speed at which friction is fully developed", "m/s")
    friction_factors: dict[str, NotNegative] = setting({}, "factors of the friction of regions of the mesh, by name")
