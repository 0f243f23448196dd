"""Settings of control: paths, models for planning, and limits of the inputs."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from ..core.mesh.place import Direction
from ..io.settings import (
    Count,
    Natural,
    NotNegative,
    Positive,
    Settings,
    Some,
    Vector,
    Word,
    setting,
)
from .performed import different

Model = Literal[
    "published",
    "simulation",
    "sysid_elastic",
    "sysid",
    "law",
    "actuator",
    "simfree",
    "resphys_uncorrected",
    "resphys",
]
Models = Annotated[Some[Model], AfterValidator(different)]
Shape = Annotated[
    str,
    Field(
        pattern="^(circle|eight|[A-Z])$",
        json_schema_extra={"wanted": "circle, eight or a capital letter"},
    ),
]
Numbers = Annotated[Some[Positive], AfterValidator(different)]


class LimitsOfInputs(Settings):
    """Limits of each input, in its unit."""

    low: NotNegative = 0.0
    high: Positive = setting(description="at most data.input_limit")
    rate: Positive = setting(description="largest rate of change, in its unit a second")

    @property
    def range(self) -> float:
        """The upper less the lower bound."""
        return self.high - self.low


class PlanSettings(Settings):
    """Plans of whole motions."""

    corrections: Count = setting(3, "with the robot's simulator")
    reach: Positive = setting(1.0e-3, "largest distance of a path from reachable points", "m")


class FeedbackSettings(Settings):
    """Feedback by a measured Jacobian."""

    gains: Numbers = setting((0.5, 1.0, 2.0), unit="1/s")
    settles: Positive = setting(
        1.5, "time after a change of inputs after which the Jacobian is measured", "s"
    )


class ReductionSettings(Settings):
    """Samples for reduced models."""

    modes: Annotated[Some[Natural], AfterValidator(different)] = setting(
        (4, 6, 8), "numbers of coordinates, of which the best is chosen"
    )
    equilibria: Natural = setting(192, "states at rest")
    tangents: Natural = setting(96, "number of these states whose vibrations are computed")
    motions: Natural = setting(6, "number of motions for the fit, and as many for its error")
    seconds: Positive = setting(2.5, "duration of a motion", "s")

    @property
    def tenths(self) -> int:
        """Tenths of a second of a motion."""
        return max(round(10 * self.seconds), 4)

    @property
    def total(self) -> int:
        """Units of progress: equilibria, tangents, and tenths of a second of the motions."""
        return self.equilibria + self.tangents + self.tenths


class FigureSettings(Settings):
    """Paths, such as figures and letters, for the mean of some markers."""

    tracked: Annotated[Some[Word], AfterValidator(different)] = setting(
        description="names of the markers"
    )
    shapes: Annotated[Some[Shape], AfterValidator(different)] = setting(
        ("eight", "circle", "R", "E", "S"), "circle, eight or capital letters"
    )
    seconds: Numbers = setting(
        (4.0, 2.0), "durations of a path, beside a quarter of that before it", "s"
    )
    centre: Vector = setting(description="centre of the figure", unit="m")
    size: Positive = setting(0.05, "length of the larger side", "m")
    right: Direction = setting((1.0, 0.0, 0.0), "direction to the right in the plane of the figure")
    up: Direction = setting((0.0, 1.0, 0.0), "upward direction in the plane of the figure")
    limits: LimitsOfInputs


class ControlSettings(FigureSettings):
    """Control along paths."""

    models: Models = setting(
        ("simulation", "sysid", "resphys"),
        "models for plans of whole motions; others are compared with the last",
    )
    receding: Models = setting(("resphys",), "those with a receding horizon")
    plan: PlanSettings = PlanSettings()
    horizon: Positive = setting(0.3, "of plans with a receding horizon", "s")
    feedback: FeedbackSettings = FeedbackSettings()
    reduction: ReductionSettings = ReductionSettings()
