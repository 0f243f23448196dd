"""Settings of control: what is followed, on which models it is planned, and within which limits."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from ..io.settings import Count, Natural, NotNegative, Positive, Settings, Share, Some, Vector, Word, setting
from .body import Direction
from .trials import different

Model = Literal["published", "simulation", "sysid_elastic", "sysid", "simfree", "resphys_uncorrected", "resphys"]
Models = Annotated[Some[Model], AfterValidator(different)]
Shape = Annotated[
    str,
    Field(pattern="^(circle|eight|[A-Z])$", json_schema_extra={"wanted": "circle, eight or a capital letter"}),
]
Numbers = Annotated[Some[Positive], AfterValidator(different)]


class LimitsOfInputs(Settings):
    """Limits of each input, in its unit."""

    low: NotNegative = 0.0
    high: Positive = setting(description="at most data.input_limit")
    rate: Positive = setting(description="largest change in a second")


class PlanSettings(Settings):
    """Plans of whole motions."""

    spacing: Positive = setting(0.05, "between the knots of the inputs", "s")
    effort: Positive = setting(1.0e-3, "of inputs that are at their upper limits", "mm^2")
    change: Positive = setting(1.0e-3, "of inputs that change as fast as they may", "mm^2")
    iterations: Natural = setting(6, "on the reduced model")
    corrections: Count = setting(3, "by the robot's simulator")
    gradient: Literal["reduced", "adjoint"] = setting(
        "reduced", "slopes of the corrections: of the reduced model, or of the simulator's adjoint"
    )
    reach: Positive = setting(1.0e-3, "that a figure may be out of reach", "m")


class HorizonSettings(Settings):
    """Plans that are made anew at each step."""

    seconds: Positive = setting(0.3, "that are planned", "s")
    pieces: Natural = setting(6, "of the inputs in that time")
    effort: Positive = setting(1.0e-2, "of inputs that are at their upper limits", "mm^2")
    change: Positive = setting(1.0e-2, "of inputs that change as fast as they may", "mm^2")
    iterations: Natural = setting(1, "at each step")


class EstimateSettings(Settings):
    """Standard deviations that the estimator expects; see `control.estimate.Noise`."""

    observed: Positive = setting(1.0e-4, "of a coordinate of a marker", "m")
    rate: Positive = setting(
        0.3, "of what rates change by in a step beside the model, over their spread in a swing of 1 mm"
    )
    bias: Positive = setting(5.0e-3, "of what the bias wanders by in a second", "m")


class FeedbackSettings(Settings):
    """Feedback by a measured Jacobian."""

    gains: Numbers = setting((0.5, 1.0, 2.0), unit="1/s")
    pressed: Share = setting(0.3, "share of the range by which the Jacobian is measured")
    settles: Positive = setting(1.5, "time in which it is measured", "s")


class ReductionSettings(Settings):
    """Samples from which reduced models are made; see `control.sampling.Sampling`."""

    modes: Annotated[Some[Natural], AfterValidator(different)] = setting(
        (4, 6, 8), "coordinates of the reduced model, of which the number with the least error is taken"
    )
    equilibria: Natural = setting(192, "states at rest")
    tangents: Natural = setting(96, "of these, about which vibrations are found")
    motions: Natural = setting(6, "motions, and as many again that tell the error")
    seconds: Positive = setting(2.5, "of a motion", "s")
    batch: Natural = setting(32, "equilibria that are found at once")


class FigureSettings(Settings):
    """Figures and letters that the mean of some markers follows."""

    tracked: Annotated[Some[Word], AfterValidator(different)] = setting(description="names of the markers")
    shapes: Annotated[Some[Shape], AfterValidator(different)] = setting(
        ("eight", "circle", "R", "E", "S"), "circle, eight or capital letters"
    )
    seconds: Numbers = setting((4.0, 2.0), "that a figure takes, beside a quarter of that before it", "s")
    centre: Vector = setting(description="of the figure", unit="m")
    size: Positive = setting(0.05, "of the larger side", "m")
    right: Direction = setting((1.0, 0.0, 0.0), "of the plane of the figure")
    up: Direction = setting((0.0, 1.0, 0.0), "of the plane of the figure")
    limits: LimitsOfInputs


class ControlSettings(FigureSettings):
    """How figures are followed."""

    models: Models = setting(
        ("simulation", "sysid", "resphys"), "planned on, of whole motions; others are compared with the last"
    )
    receding: Models = setting(("resphys",), "planned on anew at each step; among models")
    plan: PlanSettings = PlanSettings()
    horizon: HorizonSettings = HorizonSettings()
    estimate: EstimateSettings = EstimateSettings()
    feedback: FeedbackSettings = FeedbackSettings()
    reduction: ReductionSettings = ReductionSettings()
