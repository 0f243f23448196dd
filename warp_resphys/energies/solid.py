"""The solid: elastic energy of a material, and its viscosity (Kelvin-Voigt and generalised Maxwell)."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import scipy.sparse
import torch
import warp as wp
from typing_extensions import override

from ..fem.elements import Discretisation, Points
from ..io.errors import InputError
from ..kernels import solid as kernels
from ..mesh.mesh import Mesh
from .base import Energy, PointSet, Quantity, Term, Values
from .launcher import Launcher, warp_view
from .materials import Material


def device_matrix(matrix: scipy.sparse.sparray, device: torch.device, dtype: torch.dtype) -> torch.Tensor:
    """A sparse matrix on a device."""
    coo = matrix.tocoo()
    indices = torch.as_tensor(np.stack([coo.row, coo.col]).astype(np.int64))
    tensor = torch.sparse_coo_tensor(indices, torch.as_tensor(coo.data), coo.shape, check_invariants=False)
    return tensor.to(device=device, dtype=dtype).coalesce()


def spread(operator: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """(1 or B, rows): a sparse (rows, M) operator applied to (1 or B, 1 or M) element values.

    Raises:
        InputError: values for another number of elements.
    """
    m = operator.shape[1]
    if values.shape[1] not in (1, m):
        raise InputError(
            f"a material parameter has {values.shape[1]} values for {m} elements: give one value, one an element "
            f"({m}), or one an environment with shape (B, 1)."
        )
    return torch.sparse.mm(operator, values.expand(-1, m).mT).mT


class Solid(Energy):
    """The energy of a material in a discretised body.

    The step's values are ``stiffness`` (B, P, T), the moduli times the points' volumes [J]; and, see
    `dynamics.viscosity`, ``viscosity`` (B, 2), c and d; ``strain_offset`` (B, P, 3, 3), W; and ``dilation_offset``
    (B, P), w.

    Args:
        discretisation: of the body.
        material: its law and constants.
        device: of its operators.
        dtype: of its operators.
    """

    def __init__(
        self, discretisation: Discretisation, material: Material, device: torch.device, dtype: torch.dtype
    ) -> None:
        self.material, self._sets = material, discretisation.point_sets
        volumes = {
            "shape": scipy.sparse.vstack([s.shape_volume for s in self._sets]),
            "volume": scipy.sparse.vstack([s.volume_volume for s in self._sets]),
        }
        self._volumes = {rule: device_matrix(matrix, device, dtype) for rule, matrix in volumes.items()}

    @override
    def points(self, mesh: Mesh) -> tuple[Points, ...]:
        return self._sets

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "SolidTerm":
        carried = torch.stack([volumes.sum(1).to_dense() for volumes in self._volumes.values()])
        rules = list(self._volumes)
        return SolidTerm(launcher, sets, self.material, carried[[rules.index(each) for each in self.material.rules]].T)

    @property
    def quantities(self) -> Mapping[str, Quantity]:
        """The material's constants, density and mass damping included."""
        return self.material.quantities

    @override
    def prepare(self, constants: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        moduli = torch.broadcast_tensors(*self.material.moduli(constants))
        rules = self.material.rules
        spreads = [spread(self._volumes[rule], each) for rule, each in zip(rules, moduli, strict=True)]
        return {"stiffness": torch.stack(spreads, dim=-1)}


class SolidTerm(Term):
    """Kernels of a material, on the points of all its sets.

    Args:
        launcher: of the potential.
        sets: the solid's points.
        material: whose law it is.
        carried: (P, T) volumes that the points carry for each modulus [m^3].
    """

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], material: Material, carried: torch.Tensor) -> None:
        super().__init__(launcher, sets)
        law = type(material).law
        self._kernels, self._vector = kernels.solid_kernels(law), law.moduli
        self._moduli = len(material.rules)
        self._carried = carried.double().cpu().numpy()
        self._curvature = torch.as_tensor(material.curvature, device=launcher.device, dtype=torch.float64)

    @property
    @override
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        points = self.n_points
        viscous = {"viscosity": (2,), "strain_offset": (points, 3, 3), "dilation_offset": (points,)}
        return {"stiffness": (points, self._moduli), **viscous}

    def _arguments(self, s: PointSet, values: Values, positions: Any) -> list[Any]:
        """What the kernels of this energy have in common."""
        own, stiffness, strain = self.launcher, values["stiffness"], values["strain_offset"]
        viscosity, dilation = values["viscosity"], values["dilation_offset"]
        assert stiffness is not None
        assert viscosity is not None
        assert strain is not None
        assert dilation is not None
        views = [
            own.points_view(stiffness, s.own, self._vector),
            warp_view(viscosity, wp.vec2d),
            own.points_view(strain, s.own, wp.mat33d),
            own.points_view(dilation, s.own, wp.float64),
        ]
        return [s.nodes, s.gradients, *views, s.points_per_cell, positions]

    @override
    def step(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        asleep = warp_view(self.launcher.asleep, wp.int32)
        return self._kernels.local_step, [*self._arguments(s, values, positions), asleep]

    @override
    def tangent(self, s: PointSet, values: Values, positions: Any, positive: Any) -> tuple[Any, list[Any]]:
        return self._kernels.tangent, [*self._arguments(s, values, positions), positive]

    @override
    def curvature(self, values: Values) -> torch.Tensor:
        stiffness = values["stiffness"]
        assert stiffness is not None
        return stiffness @ self._curvature

    @override
    def adjoint(
        self, values: Values, positions: torch.Tensor, direction: torch.Tensor
    ) -> Callable[[], dict[str, torch.Tensor]]:
        own, shapes = self.launcher, self.shapes
        out = {name: own.zeros(*shape) for name, shape in shapes.items()}
        out["viscosity"] = own.zeros(self.n_points, 2)
        types = {"stiffness": self._vector, "viscosity": wp.vec2d, "strain_offset": wp.mat33d}
        types["dilation_offset"] = wp.float64
        commands = []
        for s in self.sets:
            carried = own.upload(self._carried[s.own], self._vector)
            inputs = [*self._arguments(s, values, warp_view(positions, wp.vec3d)), carried]
            inputs.append(warp_view(direction, wp.vec3d))
            outputs = [own.points_view(out[name], s.own, kind) for name, kind in types.items()]
            commands.append(own.record(self._kernels.adjoint, (own.batch, s.n_points), inputs, outputs))

        def differentiate() -> dict[str, torch.Tensor]:
            own.launch(*commands)
            return {name: each.sum(1) if name == "viscosity" else each.clone() for name, each in out.items()}

        return differentiate

    def strain(self, positions: torch.Tensor) -> torch.Tensor:
        """(B, P, 3, 3) Green strain of (B, N, 3) positions."""
        own = self.launcher
        out = own.zeros(self.n_points, 3, 3)
        for s in self.sets:
            inputs = [s.nodes, s.gradients, s.points_per_cell, warp_view(positions.contiguous(), wp.vec3d)]
            outputs = [own.points_view(out, s.own, wp.mat33d)]
            own.launch(own.record(kernels.strain, (own.batch, s.n_points), inputs, outputs))
        return out

    def strain_adjoint(self, positions: torch.Tensor, adjoint: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) transposed derivative of `strain` applied to (B, P, 3, 3)."""
        own = self.launcher
        out, stress = torch.zeros_like(positions), own.zeros(self.n_points, 3, 3)
        adjoint = adjoint.contiguous()
        for s in self.sets:
            inputs = [s.nodes, s.gradients, s.points_per_cell, warp_view(positions.contiguous(), wp.vec3d)]
            inputs.append(own.points_view(adjoint, s.own, wp.mat33d))
            view = own.points_view(stress, s.own, wp.mat33d)
            launch = own.record(kernels.strain_adjoint, (own.batch, s.n_points), inputs, [view])
            own.launch(launch, own.gather(s, view, out))
        return out


class GreenStrain(torch.autograd.Function):
    """E = (F^T F - I) / 2 at every point, (B, N, 3) to (B, P, 3, 3)."""

    @override
    @staticmethod
    def forward(ctx: Any, term: SolidTerm, positions: torch.Tensor) -> torch.Tensor:
        ctx.term = term
        ctx.save_for_backward(positions)
        return term.strain(positions.detach().double())

    @override
    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[None, torch.Tensor]:
        (positions,) = ctx.saved_tensors
        return None, ctx.term.strain_adjoint(positions.to(gradient.dtype), gradient)
