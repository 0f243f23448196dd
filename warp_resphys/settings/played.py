"""Settings of simulations that stand in for real bodies:
a laboratory, and other bodies of the same material.
"""

from typing import Annotated, Self

from pydantic import ConfigDict, Field, model_validator

from ..io.settings import Many, NotNegative, Positive, Settings, setting
from .body import BodySettings, TargetSettings
from .meshing import MeshSettings
from .performed import HeldSettings, Trials, TrialTable


class SequenceSettings(Settings):
    """Random inputs of a laboratory, `data.input_response.draw_inputs`."""

    mean: float = setting(8e3, "mean, in the unit of the input")
    deviation: Positive = setting(9e3, "standard deviation, in the unit of the input")
    correlation_time: Positive = setting(0.4, "correlation time of the random process", "s")
    correlation: float | Many[Many[float]] = setting(0.0, "correlation of different parts")
    rest: NotNegative = setting(0.1, "duration without inputs at the start and at the end", "s")


class PlaySettings(TargetSettings):
    """A simulation that stands in for the real body, and its cameras."""

    model_config = ConfigDict(json_schema_extra={"additionalProperties": False})

    sequences: SequenceSettings = setting(SequenceSettings(), "random inputs")
    rate: Positive | None = setting(
        None, "frame rate of the cameras; null: one frame per time step", "Hz"
    )
    noise: NotNegative = setting(description="noise of a coordinate of a marker", unit="m")
    placement_noise: NotNegative = setting(
        description="noise of a coordinate of a marker's position on the body", unit="m"
    )
    orientation_noise: Annotated[float, Field(ge=0.0, le=45.0)] = setting(
        0.0, "noise of a component of a rigid body's rotation", unit="degrees"
    )
    zero_noise: NotNegative = setting(0.0, "noise of the zero of recorded inputs")
    tilt: Annotated[float, Field(ge=0.0, le=20.0)] = setting(
        0.0, "tilt of the body from level", "degrees"
    )
    held_seconds: Annotated[float, Field(ge=0.25)] | None = setting(
        None, "recorded duration before the release", "s"
    )
    seconds: Positive | None = setting(None, "recorded after the release", "s")


class LaboratorySettings(PlaySettings):
    """The simulation that stands in for the real body, and its trials."""

    trials: TrialTable = setting({}, "trials by name: payloads and beginnings")
    train: Trials | None = setting(None, "training trials, in place of those of data")
    validation: Trials | None = setting(None, "validation trials")
    test: Trials | None = setting(None, "test trials")

    @model_validator(mode="after")
    def _is_split_whole(self) -> Self:
        parts = {"train": self.train, "validation": self.validation, "test": self.test}
        missing = [name for name, trials in parts.items() if trials is None]
        if 0 < len(missing) < len(parts):
            raise ValueError(f"{missing[0]} is missing: a split has train, validation and test.")
        return self


class ShapeSettings(BodySettings):
    """Another body of the same material, simulated beside a target of its own:
    held, released, and compared.

    It has its own actuators alone.
    """

    target_mesh: MeshSettings | None = setting(None, "mesh of its target; null: the same")
    held: HeldSettings | None = setting(None, "how it is held before its release")
    inputs: Many[float] | None = setting(
        None, "inputs before the release, one per chamber, tendon or muscle"
    )

    @model_validator(mode="after")
    def _begins(self) -> Self:
        if self.held is None and self.inputs is None:
            raise ValueError(
                "held is null, and so is inputs: give one of them, "
                "what bends the body before its release."
            )
        if self.held is not None and self.inputs is not None:
            raise ValueError("inputs is set, but held is set as well: take one of them out.")
        if self.held is not None and not self.held.twist_deg and self.held.at is None:
            raise ValueError(
                "held.at is null: name the vertices that carry the weight, as in {x: 0.2}."
            )
        return self

    @property
    def target_body(self) -> BodySettings:
        """The body of its target."""
        return BodySettings.of(self, mesh=self.target_mesh or self.mesh)
