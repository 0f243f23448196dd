"""The energies at points: the solid, pressure in chambers, and fibres, each as kernels and their arguments."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from typing_extensions import override

from ..fem.body import Body
from ..fem.elements import Points
from ..fem.surface_elements import SurfacePoints
from ..kernels.elasticity import elasticity_kernels
from ..kernels.surface import surface_kernels
from ..kernels.tangent import tangent_kernels
from .launcher import Launcher, warp_view


@dataclass(frozen=True)
class StepTerms:
    """What distinguishes one step's potential from the next; see the equation of `potential`.

    Attributes:
        target: (B, N, 3) y [m].
        inertia: (B, N) k [N/m].
        force: (B, N, 3) f [N].
        shape_stiffness: (1 or B, P) mu times volume [J].
        volume_stiffness: (1 or B, P) lambda times volume [J].
        viscosity: (B,) stiffness damping over the effective time step.
        reference_strain: (B, P, 3, 3) strain that the strain rate starts from; None without viscosity.
        pressure: (B, C) gauge pressure in each chamber [Pa]; None for none.
        fibre_stiffness: (1 or B, C) stiffness of the fibres around each chamber [N/m]; None for none.
    """

    target: torch.Tensor
    inertia: torch.Tensor
    force: torch.Tensor
    shape_stiffness: torch.Tensor
    volume_stiffness: torch.Tensor
    viscosity: torch.Tensor
    reference_strain: torch.Tensor | None = None
    pressure: torch.Tensor | None = None
    fibre_stiffness: torch.Tensor | None = None

    def tensors(self) -> tuple[torch.Tensor | None, ...]:
        """The terms in the order of their declaration."""
        return (
            self.target,
            self.inertia,
            self.force,
            self.shape_stiffness,
            self.volume_stiffness,
            self.viscosity,
            self.reference_strain,
            self.pressure,
            self.fibre_stiffness,
        )

    def set_to(self, terms: "StepTerms", free_mask: torch.Tensor) -> None:
        """Copies another step's terms into these buffers; fixed vertices get neither inertia nor load.

        Args:
            terms: the other's.
            free_mask: (N,) one at free vertices, zero at fixed ones.
        """
        self.target.copy_(terms.target.detach())
        torch.mul(terms.inertia.detach(), free_mask, out=self.inertia)
        torch.mul(terms.force.detach(), free_mask[:, None], out=self.force)
        self.shape_stiffness.copy_(terms.shape_stiffness.detach())
        self.volume_stiffness.copy_(terms.volume_stiffness.detach())
        self.viscosity.copy_(terms.viscosity.detach())
        if terms.reference_strain is not None and self.reference_strain is not None:
            self.reference_strain.copy_(terms.reference_strain.detach())
        for name in ("pressure", "fibre_stiffness"):
            mine, values = getattr(self, name), getattr(terms, name)
            if mine is not None:
                mine.zero_() if values is None else mine.copy_(values.detach())


class PointTerm(ABC):
    """One energy on the points of a set.

    Args:
        launcher: of the potential.
        points: the set.
        n_vertices: N.
        part: where the set lies among the points of all terms.

    Attributes:
        cells: C.
        points_per_cell: Q.
        nodes_per_cell: K.
        n_points: P = C Q.
        nodes: (C, K).
        gradients: (P, K) operators.
        start: (N + 1) where a vertex's entries of ``incident`` begin.
        incident: cell K + local node of every cell that a vertex belongs to.
    """

    def __init__(self, launcher: Launcher, points: Points, n_vertices: int, part: slice) -> None:
        self.launcher, self.part, self.n_points = launcher, part, points.n_points
        self.cells, self.points_per_cell, self.nodes_per_cell, _ = points.gradients.shape
        self.operators = points.gradients
        owner = points.nodes.ravel()
        # A padded node repeats its patch's own vertex with a zero gradient and contributes nothing.
        entries = np.flatnonzero(np.abs(points.gradients).sum(axis=(1, 3)).ravel() > 0.0)
        order = entries[np.argsort(owner[entries], kind="stable")]
        start = np.searchsorted(owner[order], np.arange(n_vertices + 1))
        self.nodes = launcher.upload(points.nodes.astype(np.int32), int)
        self.gradients = launcher.upload(points.gradients.reshape(-1, self.nodes_per_cell, 3), launcher.vec3)
        self.start = launcher.upload(start.astype(np.int32), int)
        self.incident = launcher.upload(order.astype(np.int32), int)

    @abstractmethod
    def step(self, terms: StepTerms, positions: Any) -> tuple[Any, list[Any]]:
        """Kernel of stress and energy, and its inputs."""

    @abstractmethod
    def tangent(self, terms: StepTerms, positions: Any, positive: Any) -> tuple[Any, list[Any]]:
        """Kernel of the tangent's blocks, and its inputs."""

    @abstractmethod
    def curvature(self, terms: StepTerms) -> torch.Tensor:
        """(B, P) an upper bound of the tangent's eigenvalues for small strains, times the volume [J]."""


class Solid(PointTerm):
    """Elastic and viscous energy of the material."""

    def __init__(self, launcher: Launcher, points: Points, n_vertices: int, part: slice, model: int) -> None:
        super().__init__(launcher, points, n_vertices, part)
        self._model = model

    def arguments(self, terms: StepTerms, positions: Any) -> list[Any]:
        """What the kernels of this energy have in common."""
        own = self.launcher
        strain = terms.reference_strain
        return [
            self._model,
            self.nodes,
            self.gradients,
            own.points_view(terms.shape_stiffness, self.part, own.scalar),
            own.points_view(terms.volume_stiffness, self.part, own.scalar),
            warp_view(terms.viscosity, own.scalar),
            None if strain is None else own.points_view(strain, self.part, own.mat33),
            self.points_per_cell,
            positions,
        ]

    @override
    def step(self, terms: StepTerms, positions: Any) -> tuple[Any, list[Any]]:
        return elasticity_kernels(self.launcher.scalar).local_step, self.arguments(terms, positions)

    @override
    def tangent(self, terms: StepTerms, positions: Any, positive: Any) -> tuple[Any, list[Any]]:
        return tangent_kernels(self.launcher.scalar).tangent, [*self.arguments(terms, positions), positive]

    @override
    def curvature(self, terms: StepTerms) -> torch.Tensor:
        return (2.0 * terms.shape_stiffness + terms.volume_stiffness)[:, self.part]


class SurfaceTerm(PointTerm):
    """An energy on the surfaces of chambers, with one constant a chamber: that term of a step."""

    parameter: ClassVar[str]

    def __init__(self, launcher: Launcher, points: SurfacePoints, n_vertices: int, part: slice) -> None:
        super().__init__(launcher, points, n_vertices, part)
        self.weights = launcher.upload(points.weights, launcher.scalar)
        self.chamber = launcher.upload(points.chamber.astype(np.int32), int)
        own = np.eye(int(points.chamber.max()) + 1)[points.chamber]
        self._own = torch.as_tensor(own, device=launcher.device, dtype=launcher.dtype)  # (P, C) one in its chamber
        self._of_chamber = torch.as_tensor(points.chamber, device=launcher.device)
        self._weight = torch.as_tensor(points.weights, device=launcher.device, dtype=launcher.dtype)

    @abstractmethod
    def adjoint(self, positions: Any, adjoint: Any) -> tuple[Any, list[Any]]:
        """Kernel of each point's part of the loss's derivative by its chamber's constant, and its inputs."""

    def by_chamber(self, values: torch.Tensor) -> torch.Tensor:
        """(B, C) sums of (B, P) values over the points of each chamber, in a fixed order."""
        return values @ self._own

    def parameter_adjoint(self, positions: torch.Tensor, adjoint: torch.Tensor) -> torch.Tensor:
        """(B, C) derivative of the loss by each chamber's constant; see `IncrementalPotential.parameter_adjoint`."""
        own = self.launcher
        kernel, inputs = self.adjoint(warp_view(positions, own.vec3), warp_view(adjoint.contiguous(), own.vec3))
        out = own.zeros(self.n_points)
        own.launch(own.record(kernel, (own.batch, self.n_points), inputs, [warp_view(out, own.scalar)]))
        return self.by_chamber(out)


class Pressure(SurfaceTerm):
    """-p V of every chamber."""

    parameter = "pressure"

    def arguments(self, pressure: torch.Tensor | None, positions: Any) -> list[Any]:
        """What the kernels of (B, C) pressures have in common."""
        assert pressure is not None
        surface = [self.nodes, self.gradients, self.weights, self.chamber]
        return [*surface, warp_view(pressure, self.launcher.scalar), self.points_per_cell, positions]

    @override
    def step(self, terms: StepTerms, positions: Any) -> tuple[Any, list[Any]]:
        return surface_kernels(self.launcher.scalar).pressure_step, self.arguments(terms.pressure, positions)

    @override
    def tangent(self, terms: StepTerms, positions: Any, positive: Any) -> tuple[Any, list[Any]]:
        inputs = [*self.arguments(terms.pressure, positions), positive]
        return surface_kernels(self.launcher.scalar).pressure_tangent, inputs

    @override
    def curvature(self, terms: StepTerms) -> torch.Tensor:
        return torch.zeros_like(self._weight)[None]

    @override
    def adjoint(self, positions: Any, adjoint: Any) -> tuple[Any, list[Any]]:
        inputs = [self.nodes, self.gradients, self.weights, self.points_per_cell, positions, adjoint]
        return surface_kernels(self.launcher.scalar).pressure_adjoint, inputs


class FibreTension(SurfaceTerm):
    """Energy of the thread around every chamber."""

    parameter = "fibre_stiffness"

    def __init__(self, launcher: Launcher, points: SurfacePoints, n_vertices: int, part: slice, toe: float) -> None:
        super().__init__(launcher, points, n_vertices, part)
        self._toe = launcher.scalar(toe)

    def _arguments(self, terms: StepTerms, positions: Any) -> list[Any]:
        assert terms.fibre_stiffness is not None
        stiffness = warp_view(terms.fibre_stiffness, self.launcher.scalar)
        surface = [self.nodes, self.gradients, self.weights, self.chamber]
        return [*surface, stiffness, self._toe, self.points_per_cell, positions]

    @override
    def step(self, terms: StepTerms, positions: Any) -> tuple[Any, list[Any]]:
        return surface_kernels(self.launcher.scalar).fibre_step, self._arguments(terms, positions)

    @override
    def tangent(self, terms: StepTerms, positions: Any, positive: Any) -> tuple[Any, list[Any]]:
        return surface_kernels(self.launcher.scalar).fibre_tangent, self._arguments(terms, positions)

    @override
    def curvature(self, terms: StepTerms) -> torch.Tensor:
        assert terms.fibre_stiffness is not None
        return self._weight * terms.fibre_stiffness[:, self._of_chamber]

    @override
    def adjoint(self, positions: Any, adjoint: Any) -> tuple[Any, list[Any]]:
        inputs = [self.nodes, self.gradients, self.weights, self._toe, self.points_per_cell, positions, adjoint]
        return surface_kernels(self.launcher.scalar).fibre_adjoint, inputs


def point_terms(body: Body, model: int, launcher: Launcher) -> list[PointTerm]:
    """Every energy of a body, the solid's first; the order is that of ``Body.point_sets``."""
    sets = body.point_sets
    ends = np.cumsum([points.n_points for points in sets])
    parts = [slice(int(end) - points.n_points, int(end)) for points, end in zip(sets, ends, strict=True)]
    terms: list[PointTerm] = []
    for points, part in zip(sets, parts, strict=True):
        if points is body.pressure_points:
            terms.append(Pressure(launcher, points, body.n_vertices, part))
        elif points is body.fibre_points and body.fibres is not None:
            terms.append(FibreTension(launcher, points, body.n_vertices, part, body.fibres.toe))
        else:
            terms.append(Solid(launcher, points, body.n_vertices, part, model))
    return terms
