"""Settings of contact: rigid obstacles, friction between regions, and the barriers."""

from typing import Annotated

from pydantic import Field

from ..core.energies.contact.touching_bodies import (
    Box,
    Capsule,
    Cylinder,
    FrictionPair,
    HalfSpace,
    Sphere,
    SurfaceFile,
)
from ..io.settings import NotNegative, Positive, Settings, setting

ObstacleSettings = Annotated[
    HalfSpace | Sphere | Capsule | Cylinder | Box | SurfaceFile, Field(discriminator="shape")
]


class SurfaceContactSettings(Settings):
    """Contact of the body with itself, and of its parts with one another, by
    `energies.contact.surface_contact`.
    """

    stiffness: Positive = setting(1.0e5, "stiffness of the barrier", "Pa")
    friction: NotNegative = setting(0.0, "coefficient of friction")
    distance: Positive = setting(1.0e-3, "gap at which contact begins", "m")
    slip_speed: Positive = setting(1.0e-3, "speed at which friction is fully developed", "m/s")
    pairs: dict[str, FrictionPair] = setting(
        {}, "friction of pairs of regions, by name, the first that fits"
    )


class ContactSettings(Settings):
    """Contact of the body with its obstacles, by `energies.contact.obstacle_contact`."""

    stiffness: Positive | dict[str, Positive] = setting(
        1.0e5, "stiffness of the barrier, or one per obstacle", "Pa"
    )
    friction: NotNegative | dict[str, NotNegative] = setting(
        0.0, "coefficient, or one per obstacle"
    )
    distance: Positive = setting(1.0e-3, "gap at which contact begins", "m")
    slip_speed: Positive = setting(1.0e-3, "speed at which friction is fully developed", "m/s")
    friction_factors: dict[str, NotNegative] = setting(
        {}, "factors of the friction of regions of the mesh, by name"
    )
