"""A medium around a body over a step: where its surface was, where it points, and what carries the body."""

from dataclasses import dataclass
from typing import Any

import torch

from ..energies.medium import FacePoints
from .constants import Constants
from .inputs import Inputs
from .integrator import ImplicitStage, State


@dataclass(frozen=True)
class Surrounding:
    """See `energies.medium`."""

    nodes: torch.Tensor  # (F, K) vertices of the faces
    shares: torch.Tensor  # (Q, K) of the vertices in the points
    slopes: torch.Tensor  # (Q, K, 2)
    weights: torch.Tensor  # (Q,)
    volume: torch.Tensor | None  # (N,) that each vertex stands for [m^3]; None where the medium carries nothing

    @classmethod
    def of(cls, points: FacePoints, volume: torch.Tensor | None, like: torch.Tensor) -> "Surrounding":
        """That of some points, on the device and in the type of a tensor."""
        shares, slopes, weights = (
            like.new_tensor(each) for each in (points.gradients[0, :, :, 0], points.slopes, points.weights)
        )
        return cls(torch.as_tensor(points.nodes, device=like.device), shares, slopes, weights, volume)

    def values(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants
    ) -> dict[str, torch.Tensor]:
        """See `StepPart`; areas and normals are those of the state."""
        del inputs
        h, batch = stage.step, state.batch
        tangents = torch.einsum("qkd,bfki->bfqdi", self.slopes, state.q[:, self.nodes])
        area = torch.linalg.cross(tangents[..., 0, :], tangents[..., 1, :]) * self.weights[:, None]
        named = ("medium_density", "drag_linear", "drag_normal", "drag_tangential", "added_layer")
        density, linear, normal, tangential, layer = (constants.values[name] for name in named)
        drag = 0.5 * density / h**2
        coefficients = torch.cat(
            torch.broadcast_tensors(linear / h, drag * normal, drag * tangential, density * layer / h**2), 1
        )
        return {
            "medium_reference": self._at_points(stage.velocity_reference),
            "medium_target": self._at_points(stage.target),
            "medium_area": area.flatten(1, 2),
            "medium_coefficients": coefficients[:, None].expand(batch, -1, -1),
        }

    def still(self, batch: int) -> dict[str, torch.Tensor]:
        """See `StepPart`."""
        zeros = self.weights.new_zeros(batch, 1, 1)
        places = dict.fromkeys(
            ("medium_reference", "medium_target", "medium_area"),
            zeros.expand(-1, len(self.nodes) * len(self.weights), 3),
        )
        return {**places, "medium_coefficients": zeros.expand(-1, 1, 4)}

    def load(self, inputs: Inputs, constants: Constants, batch: int, static: bool) -> torch.Tensor | None:
        """Buoyancy: the weight of the medium that the body displaces, upwards."""
        del inputs, batch, static
        if self.volume is None:
            return None
        displaced = constants.values["medium_density"] * self.volume
        return -displaced[..., None] * constants.gravity[:, None]

    def after(
        self, state: State, stage: ImplicitStage, inputs: Inputs, constants: Constants, x: torch.Tensor
    ) -> dict[str, Any]:
        """Nothing is carried on."""
        del state, stage, inputs, constants, x
        return {}

    def _at_points(self, field: torch.Tensor) -> torch.Tensor:
        """(B, P, 3) of (B, N, 3) values at the vertices."""
        return torch.einsum("qk,bfki->bfqi", self.shares, field[:, self.nodes]).flatten(1, 2)
