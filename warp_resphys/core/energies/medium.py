r"""Surrounding medium: drag, added mass and buoyancy.

The force per area on a surface with normal n and velocity v is, for the density rho of the medium,

    -c v - rho / 2 (C_n |v . n| (v . n) n + C_t |v_t| v_t) - rho l (n . dv/dt) n,
    v_t = v - (v . n) n

(the resistive force of Taylor, Proc. R. Soc. A 214, 1952, for swimming, and a reactive one;
Lighthill 1971). c is the linear drag of creeping flow [N s/m^3], C_n and C_t are normal and
tangential drag coefficients, and l is the thickness of the layer of medium that moves with the
surface [m]. The force acts at the end of an implicit stage, with areas and normals of its start, so
that it derives from a convex potential and drag is dissipative.
"""

from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from typing_extensions import override

from ...io.errors import InputError
from ...kernels import fluid_drag as kernels
from ..fem.integration_points import Points
from ..mesh.elements import FACES
from ..mesh.volume_mesh import Mesh, boundary_faces
from ..stepping.quantity import Parameter, parameter
from .base import BoundEnergy, Energy, EnergySite, EnergyStep
from .launcher import Launcher
from .term import Adjoint, PointSet, Term


@dataclass(frozen=True)
class FacePoints(Points):
    """Points on faces of a surface."""

    slopes: NDArray[np.float64]  # (Q, K, 2) derivatives of the shape functions of a face
    weights: NDArray[np.float64]  # (Q,)


@dataclass(frozen=True)
class Medium(Energy):
    """Drag, added mass and buoyancy on the surface of a body (equation in the module's docstring).

    Parameters are ``medium_density`` [kg/m^3], ``drag_linear`` [N s/m^3], ``drag_normal``,
    ``drag_tangential`` and ``added_layer`` [m].

    Raises:
        InputError: a value out of range, or faces that do not belong to the surface.
    """

    # rho, c, C_n, C_t and l: numbers or (B, 1) values
    density: Parameter = parameter(MISSING, "medium_density", "kg/m^3", closed=True)
    linear: Parameter = parameter(0.0, "drag_linear", "N s/m^3", closed=True)
    normal: Parameter = parameter(0.0, "drag_normal", "", closed=True)
    tangential: Parameter = parameter(0.0, "drag_tangential", "", closed=True)
    layer: Parameter = parameter(0.0, "added_layer", "m", closed=True)
    buoyancy: bool = True  # whether buoyancy acts
    # (F, n) faces, among `boundary_faces`, that the medium acts on; None: all
    faces: NDArray[np.int64] | None = None

    @override
    def points(self, mesh: Mesh) -> tuple[FacePoints, ...]:
        """Returns the points of a rule that integrates quadratic fields over the faces."""
        surface = boundary_faces(mesh)
        faces = surface if self.faces is None else np.asarray(self.faces)
        boundary = {tuple(sorted(face)) for face in surface.tolist()}
        if not len(faces) or not all(tuple(sorted(face)) in boundary for face in faces.tolist()):
            raise InputError(
                "the faces that a medium acts on must belong to the body's surface "
                "(boundary_faces)."
            )
        face = FACES[faces.shape[1]]
        places, weights = face.rule(2)
        values, slopes = face.shape(places)
        operator = np.tile(values[..., None], (len(faces), 1, 1, 1))
        return (FacePoints(faces, operator, np.asarray(slopes), np.asarray(weights)),)

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "MediumTerm":
        return MediumTerm(launcher, sets)

    @override
    def bind(self, site: EnergySite) -> "BoundMedium":
        return BoundMedium(self, site)


class BoundMedium(BoundEnergy):
    """A medium in a simulator: reference positions, areas and normals of a step, and buoyancy."""

    def __init__(self, medium: Medium, site: EnergySite) -> None:
        super().__init__(medium, site)
        (points,) = site.points
        assert isinstance(points, FacePoints)
        self._nodes = torch.as_tensor(points.nodes, device=site.rest_positions.device)  # (F, K)
        self._shape_values = site.tensor(points.gradients[0, :, :, 0])  # (Q, K)
        self._slopes = site.tensor(points.slopes)  # (Q, K, 2)
        self._weights = site.tensor(points.weights)  # (Q,)
        volume = site.tensor(site.load_volume.sum(axis=1))  # (N,) [m^3]
        self._volume = volume if medium.buoyancy else None

    @override
    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        """Returns values with the areas and normals of the start of the step."""
        stage = step.stage
        h, batch = stage.step, step.state.batch
        tangents = torch.einsum("qkd,bfki->bfqdi", self._slopes, step.state.q[:, self._nodes])
        area = torch.linalg.cross(tangents[..., 0, :], tangents[..., 1, :]) * self._weights[:, None]
        names = ("medium_density", "drag_linear", "drag_normal", "drag_tangential", "added_layer")
        density, linear, normal, tangential, layer = map(step.value, names)
        drag = 0.5 * density / h**2
        coefficients = torch.cat(
            torch.broadcast_tensors(
                linear / h, drag * normal, drag * tangential, density * layer / h**2
            ),
            1,
        )
        return {
            "medium_reference": self._at_points(stage.velocity_reference),
            "medium_target": self._at_points(stage.target),
            "medium_area": area.flatten(1, 2),
            "medium_coefficients": coefficients[:, None].expand(batch, -1, -1),
        }

    @override
    def at_rest(self, batch: int) -> dict[str, torch.Tensor | None]:
        zeros = self._weights.new_zeros(batch, 1, 1)
        places = zeros.expand(-1, len(self._nodes) * len(self._weights), 3)
        names = ("medium_reference", "medium_target", "medium_area")
        return {**dict.fromkeys(names, places), "medium_coefficients": zeros.expand(-1, 1, 4)}

    @override
    def load(self, step: EnergyStep) -> torch.Tensor | None:
        """Returns the buoyancy, minus the weight of the displaced medium."""
        if self._volume is None:
            return None
        displaced = step.value("medium_density") * self._volume
        return -displaced[..., None] * step.gravity[:, None]

    def _at_points(self, field: torch.Tensor) -> torch.Tensor:
        """Interpolates a vertex field (B, N, 3) to the points (B, P, 3)."""
        return torch.einsum("qk,bfki->bfqi", self._shape_values, field[:, self._nodes]).flatten(
            1, 2
        )


class MediumTerm(Term):
    """Kernels of the medium."""

    _kernels = kernels

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet]) -> None:
        (s,) = sets
        places = dict.fromkeys(
            ("medium_reference", "medium_target", "medium_area"), (s.n_points, 3)
        )
        super().__init__(launcher, sets, {**places, "medium_coefficients": (1, 4)})
        self._nodes = torch.as_tensor(s.source.nodes, device=s.device)  # (C, K)
        self._weights = torch.as_tensor(s.source.gradients[..., 0], device=s.device)  # (C, Q, K)

    @override
    def _arguments(self, s: PointSet, positions: Any) -> list[Any]:
        *places, coefficients = self.values
        views = [self.view(name, wp.vec3d) for name in places]
        return [s.points, *views, self.view(coefficients, wp.vec4d), positions]

    @override
    def curvature(self) -> torch.Tensor:
        coefficients = self.values["medium_coefficients"]
        return self.values["medium_area"].norm(dim=-1) * (
            coefficients[..., 0] + coefficients[..., 3]
        )

    @override
    def adjoint(self, positions: torch.Tensor, direction: torch.Tensor) -> Adjoint:
        """Implements `Term.adjoint` by differentiating the forces in torch."""

        def at_points(field: torch.Tensor) -> torch.Tensor:
            return torch.einsum("cqk,bcki->bcqi", self._weights, field[:, self._nodes]).flatten(
                1, 2
            )

        def differentiate() -> dict[str, torch.Tensor]:
            with torch.enable_grad():
                leaves = {
                    name: value.detach().requires_grad_() for name, value in self.values.items()
                }
                loss = -(
                    _forces(at_points(positions), *leaves.values()) * at_points(direction)
                ).sum()
                slopes = torch.autograd.grad(loss, list(leaves.values()))
            return dict(zip(leaves, slopes, strict=True))

        return differentiate


def _forces(
    x: torch.Tensor,
    reference: torch.Tensor,
    target: torch.Tensor,
    area: torch.Tensor,
    coefficients: torch.Tensor,
) -> torch.Tensor:
    """The derivative (B, P, 3) of the energy in `kernels.fluid_drag` by positions of points."""
    size = area.norm(dim=-1, keepdim=True)
    n, d = area / size.clamp_min(1e-30), x - reference
    across, inertial = ((way * n).sum(-1, keepdim=True) for way in (d, x - target))
    along = d - across * n
    square = along.square().sum(-1, keepdim=True)
    slip = torch.where(square > 0.0, square.clamp_min(1e-300).sqrt(), 0.0)
    linear, normal, tangential, mass = coefficients[..., None].unbind(-2)
    return size * (
        linear * d
        + (normal * across.abs() * across + mass * inertial) * n
        + tangential * slip * along
    )
