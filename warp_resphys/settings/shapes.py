"""Settings of other bodies of the same material."""

from typing import Self

from pydantic import model_validator

from ..io.settings import Many, setting
from .body import BodySettings
from .mesh import MeshSettings
from .trials import HeldSettings


class ShapeSettings(BodySettings):
    """Another body of the same material, simulated beside a target of its own: held, released, and compared.

    It has its own actuators alone.
    """

    target_mesh: MeshSettings | None = setting(None, "mesh of its target; null: the same")
    held: HeldSettings | None = setting(None, "how it is held before its release")
    inputs: Many[float] | None = setting(None, "inputs before the release, one per chamber, tendon or muscle")

    @model_validator(mode="after")
    def _begins(self) -> Self:
        if self.held is None and self.inputs is None:
            raise ValueError(
                "held is null, and so is inputs: give one of them, what bends the body before its release."
            )
        if self.held is not None and self.inputs is not None:
            raise ValueError("inputs is set, but held is set as well: take one of them out.")
        if self.held is not None and not self.held.twist_deg and self.held.at is None:
            raise ValueError("held.at is null: name the vertices that carry the weight, as in {x: 0.2}.")
        return self

    @property
    def target_body(self) -> BodySettings:
        """The body of its target."""
        return BodySettings.of(self, mesh=self.target_mesh or self.mesh)
