"""Settings of markers and rigid bodies: their places,
how they follow the body, and their registration.
"""

import math
from itertools import product
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from ..core.mesh.place import Place
from ..io.classes import ClassSettings
from ..io.settings import Many, NotNegative, Positive, Settings, Some, Vector, Word, setting
from .performed import CORNERS, Axis, different


class RigidBodySettings(Settings):
    """Recorded pose of a rigid body, whose mounting
    on the body is estimated from the frames at rest.

    An error of `position_deviation` counts as much as one of `orientation_deviation`.
    """

    part: Word | None = setting(None, "rigid part that it is mounted on")
    at: Place | None = setting(None, "vertices of a stiff plate that it is mounted on instead")
    position_deviation: Annotated[float, Field(gt=0.0, le=0.05)] = setting(
        1.0e-3, "expected error of a position", "m"
    )
    orientation_deviation: Annotated[float, Field(gt=0.0, le=45.0)] = setting(
        1.0, "expected error of an orientation", "degrees"
    )

    @model_validator(mode="after")
    def _is_mounted(self) -> Self:
        if (self.part is None) == (self.at is None):
            raise ValueError(
                "part and at: give one of them, "
                "a rigid part or the vertices of a plate, as {x: 0.1}."
            )
        return self

    @property
    def length(self) -> float:
        """Length that an error of one radian counts as [m]."""
        return self.position_deviation / math.radians(self.orientation_deviation)


class ForceSensorSettings(Settings):
    """A load cell or force-torque sensor, whose readings are columns such
    as ``load.fz [N]`` of the recordings.
    """

    at: Word | None = setting(
        None, "fixed region that it holds, or obstacle that it carries; null: all fixed vertices"
    )
    axes: Annotated[
        Some[Literal["fx", "fy", "fz", "tx", "ty", "tz"]], AfterValidator(different)
    ] = setting(("fx", "fy", "fz"), "forces and moments that it measures")
    noise: Positive = setting(description="standard deviation of a force", unit="N")
    moment_noise: Positive | None = setting(None, "standard deviation of a moment", "N m")
    origin: Vector = setting(
        (0.0, 0.0, 0.0), "point about which moments are measured, on the body at rest", "m"
    )
    rotation: Vector = setting(
        (0.0, 0.0, 0.0), "rotation vector of its axes in the frame of the body at rest", "degrees"
    )
    on_body: bool = setting(
        False, "readings are forces on the body, such as a testing machine's, not on the sensor"
    )
    zero: NotNegative = setting(
        0.0, "standard deviation of its unknown zero in each trial, over the noise"
    )
    drift: NotNegative = setting(
        0.0, "standard deviation of the drift of the zero per second, over the noise", "1/s"
    )

    @model_validator(mode="after")
    def _has_noise(self) -> Self:
        if self.moment_noise is None and any(axis.startswith("t") for axis in self.axes):
            raise ValueError("axes names moments: give moment_noise, in N m, as well.")
        return self


class BindingSettings(Settings):
    """Positions of markers on the undeformed body, and how they are bound to it."""

    tracked: dict[str, Vector] = setting({}, "positions by name; errors are measured on these", "m")
    rigid_bodies: dict[str, RigidBodySettings] = setting(
        {}, "recorded poses (positions with quaternions) by name; errors are measured on these, too"
    )
    reference: dict[str, Vector] = setting(
        {}, "positions of fixed markers, for the registration", "m"
    )
    bind: Literal["normal", "frame", "rigid", "patch"] = setting(
        "normal", "how tracked markers follow the body"
    )
    bind_to: Place | None = setting(None, "vertices that rigid markers follow")
    patch: Positive = setting(0.02, "radius of a patch", "m")
    largest_distance: Positive = setting(0.02, "largest distance from the surface of the body", "m")
    observation: ClassSettings | None = setting(
        None, "observation of tracked markers by a class of another package, in place of bind"
    )

    @model_validator(mode="after")
    def _binds_once(self) -> Self:
        if self.observation is not None and (self.bind != "normal" or self.bind_to is not None):
            raise ValueError(
                "observation takes the place of bind and bind_to: leave these two out."
            )
        return self

    @property
    def observed(self) -> tuple[str, ...]:
        """Labels of the M observed points: tracked markers, then four points of each rigid body."""
        return (
            *self.tracked,
            *(f"{name} {corner}" for name, corner in product(self.rigid_bodies, CORNERS)),
        )


class MarkerSettings(BindingSettings):
    """Markers and tolerances of their registration."""

    plane: (
        Annotated[Many[Axis], Field(min_length=2, max_length=2), AfterValidator(different)] | None
    ) = setting(None, "axes that a single camera sees; null: all")
    frame: Literal["body", "own"] = setting(
        "body", "own: markers measure the shape alone, as for swimming"
    )
    labels: Literal["recorded", "assigned"] = setting(
        "recorded", "assigned: names are assigned by position"
    )
    register_with: Annotated[Many[Word], AfterValidator(different)] | None = setting(
        None,
        "markers for registration; null: all of a body at rest; []: "
        "none, as recordings are in the body's frame",
    )
    largest_residual: Positive = setting(0.004, "largest residual of the registration", "m")
    largest_distortion: Positive = setting(
        0.001, "largest motion of a reference marker in a session", "m"
    )
    largest_shift: Positive | None = setting(
        None, "largest shift of a reference marker; null: any", "m"
    )

    @model_validator(mode="after")
    def _are_bound(self) -> Self:
        both = [label for label in self.tracked if label in self.reference]
        if both:
            raise ValueError(
                f"tracked and markers.reference both have '{both[0]}': it moves or is fixed."
            )
        unknown = [
            label
            for label in self.register_with or ()
            if label not in (*self.tracked, *self.reference)
        ]
        if unknown:
            raise ValueError(
                f"register_with names '{unknown[0]}', which is in neither tracked nor reference: "
                f"choose from {', '.join((*self.tracked, *self.reference))}."
            )
        if not self.tracked and not self.rigid_bodies:
            raise ValueError(
                "tracked is empty: name the markers that errors are measured on, with their places."
            )
        both = [name for name in self.rigid_bodies if name in (*self.tracked, *self.reference)]
        if both:
            raise ValueError(
                f"rigid_bodies has '{both[0]}', which is a marker in tracked or reference, too: "
                "its place is not given, but estimated, so name it in rigid_bodies alone."
            )
        if self.rigid_bodies and (
            self.plane is not None or self.frame == "own" or self.labels == "assigned"
        ):
            raise ValueError(
                "rigid_bodies need recordings in three dimensions, in the frame of the body, "
                "with names: leave plane, frame and labels out."
            )
        if self.tracked and self.bind == "rigid" and self.bind_to is None:
            raise ValueError(
                "bind is rigid: set markers.bind_to to the vertices that they follow, as {x: 0.1}."
            )
        return self
