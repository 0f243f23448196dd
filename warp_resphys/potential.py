"""The incremental potential of a time step, evaluated by Warp kernels on torch's memory.

One time step of every integrator, and a static equilibrium too, is the minimum over x of

    sum_i k_i / 2 |x_i - y_i|^2 - f . x + E(x) - sum_c p_c V_c(x) + c/2 sum_p |E_p(x) - E_p^ref|^2_C

with k the inertia over the square of the effective time step, y where inertia alone would go, f the loads, E the
elastic energy of the solid and of fibres, p_c and V_c the gauge pressure in each chamber and its volume, and the last
term the Kelvin-Voigt dissipation potential of the Green strain E_p with viscosity c.
"""

from typing import Any

import numpy as np
import torch
import warp as wp

from .body import Body
from .kernels.assembly import assembly_kernels
from .kernels.elasticity import elasticity_kernels
from .kernels.surface import surface_kernels
from .kernels.tangent import tangent_kernels
from .launcher import Launcher, warp_view
from .point_terms import PointTerm, Pressure, Solid, StepTerms, SurfaceTerm, point_terms


class IncrementalPotential(Launcher):
    """Energy, residual, Hessian and adjoint products of a batch of one body.

    Holds the buffers that its recorded kernel launches work on. Evaluations refer to the last `set_terms`.

    Args:
        body: the body.
        model: material model (an integer of ``kernels.elasticity``).
        batch: environments B.
        device: of every buffer.
        dtype: ``torch.float64`` or ``torch.float32``.

    Attributes:
        n_points: P of the solid, which come first among all points.
        sets: the energies, each on its own points; solids first.
    """

    def __init__(self, body: Body, model: int, batch: int, device: torch.device, dtype: torch.dtype) -> None:
        super().__init__(batch, device, dtype)
        self.body = body
        self._elastic = elasticity_kernels(self.scalar)
        self._second = tangent_kernels(self.scalar)
        # All kernels join their Warp module before its first load: it would be compiled again otherwise.
        surface_kernels(self.scalar)
        assembly_kernels(self.scalar)
        self.n_vertices = body.n_vertices
        self.sets = point_terms(body, model, self)
        self.n_points = sum(s.n_points for s in self.solids)
        self._n_all_points = sum(s.n_points for s in self.sets)
        self.free_mask = torch.ones(body.n_vertices, device=device, dtype=dtype)
        self.free_mask[torch.as_tensor(body.fixed_vertices, device=device)] = 0.0
        self.terms = self._allocate_terms()
        self.positions = self.zeros(self.n_vertices, 3)
        self.residual = self.zeros(self.n_vertices, 3)
        self._stress = self.zeros(self._n_all_points, 3, 3)
        self._point_energy = self.zeros(self._n_all_points)
        self._vertex_energy = self.zeros(self.n_vertices)
        self._record_evaluation()
        self._tangent: torch.Tensor | None = None
        self._direction = self.zeros(self.n_vertices, 3)
        self._adjoint_commands: list[Any] = []

    @property
    def solids(self) -> list[Solid]:
        """The energies of the solid."""
        return [s for s in self.sets if isinstance(s, Solid)]

    def _allocate_terms(self) -> StepTerms:
        n, p, chambers = self.n_vertices, self.n_points, len(self.body.chambers)
        return StepTerms(
            target=self.zeros(n, 3),
            inertia=self.zeros(n),
            force=self.zeros(n, 3),
            shape_stiffness=self.zeros(p),
            volume_stiffness=self.zeros(p),
            viscosity=self.zeros(),
            reference_strain=self.zeros(p, 3, 3),
            pressure=self.zeros(chambers) if chambers else None,
            fibre_stiffness=self.zeros(chambers) if self.body.fibres is not None else None,
        )

    def gather(self, s: PointTerm, stress: torch.Tensor, out: torch.Tensor) -> Any:
        """Recorded launch that adds a point set's transposed operator of its stress (B, all points) to (B, N, 3)."""
        inputs = [s.nodes, s.gradients, s.points_per_cell, s.start, s.incident]
        inputs.append(self.points_view(stress, s.part, self.mat33))
        kernel = self._elastic.gather
        return self.record(kernel, (self.batch, self.n_vertices), inputs, [warp_view(out, self.vec3)])

    def _record_evaluation(self) -> None:
        t, k, b = self.terms, self._elastic, self.batch
        self._inertia_command = self.record(
            k.inertia_residual,
            (b, self.n_vertices),
            [
                warp_view(t.inertia, self.scalar),
                warp_view(t.target, self.vec3),
                warp_view(t.force, self.vec3),
                warp_view(self.positions, self.vec3),
            ],
            [warp_view(self.residual, self.vec3), warp_view(self._vertex_energy, self.scalar)],
        )
        self._elastic_commands: list[Any] = []
        self._pressure_commands: list[Any] = []
        for s in self.sets:
            outputs = [
                self.points_view(self._stress, s.part, self.mat33),
                self.points_view(self._point_energy, s.part, self.scalar),
            ]
            kernel, inputs = s.step(t, warp_view(self.positions, self.vec3))
            step = self.record(kernel, (b, s.n_points), inputs, outputs)
            commands = self._pressure_commands if isinstance(s, Pressure) else self._elastic_commands
            commands += [step, self.gather(s, self._stress, self.residual)]

    def set_terms(self, terms: StepTerms) -> None:
        """Copies a step's terms into the buffers; fixed vertices get neither inertia nor load."""
        self.terms.set_to(terms, self.free_mask)

    @property
    def force(self) -> torch.Tensor:
        """(B, N, 3) loads of the current terms [N]."""
        return self.terms.force

    @property
    def inertia(self) -> torch.Tensor:
        """(B, N) inertia of the current terms [N/m], zero at fixed vertices."""
        return self.terms.inertia

    def evaluate(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Energy (B,) [J] and norm of inertia less loads and pressure (B,) [N] at ``positions``; sets ``residual`` [N].

        The residual is the potential's gradient, zero at fixed vertices.
        """
        self.launch(self._inertia_command, *self._pressure_commands)
        if self._pressure_commands:
            self.residual.mul_(self.free_mask[:, None])
        balance = torch.linalg.vector_norm(self.residual.view(self.batch, -1), dim=1)
        self.launch(*self._elastic_commands)
        self.residual.mul_(self.free_mask[:, None])
        return self._point_energy.sum(1).add_(self._vertex_energy.sum(1)), balance

    def energy_rounding(self) -> torch.Tensor:
        """(B,) how far rounding may have moved the energy last evaluated [J].

        Terms of the size of the stiffness cancel in the energy of a small strain.
        """
        t = self.terms
        stiffness = t.shape_stiffness.sum(1) + t.volume_stiffness.sum(1)
        energy = self._point_energy.abs().sum(1) + self._vertex_energy.abs().sum(1)
        return 8.0 * torch.finfo(self.dtype).eps * (stiffness + 100.0 * energy)

    def residual_rounding(self) -> torch.Tensor:
        """(B,) norm by which the residual last evaluated changes when every coordinate moves by one rounding unit [N].

        Each goes up or down at random. The least residuals that solves reach are a sixth to a third of the result.
        """
        positions, residual = self.positions.clone(), self.residual.clone()
        signs = np.random.default_rng(0).choice([-1.0, 1.0], positions.shape[1:])
        self.positions.addcmul_(positions, positions.new_tensor(signs), value=torch.finfo(self.dtype).eps)
        self.evaluate()
        change = torch.linalg.vector_norm((self.residual - residual).view(self.batch, -1), dim=1)
        self.positions.copy_(positions)
        self.residual.copy_(residual)
        return change

    def update_tangent(self, positive: torch.Tensor | None = None) -> None:
        """Computes dP/dF at ``positions``.

        Args:
            positive: (B,) environments whose eigenvalues are clamped at zero; none where left out.
        """
        self._prepare_tangent()
        self._positive.zero_()
        if positive is not None:
            self._positive.copy_(positive)
        self.launch(*self._tangent_commands)

    @property
    def tangent(self) -> torch.Tensor:
        """(B, P, 6, 3, 3) blocks of dP/dF of the last `update_tangent` [J]; see ``kernels.tangent``."""
        return self._prepare_tangent()

    def _prepare_tangent(self) -> torch.Tensor:
        """Buffers and launches of second derivatives, made at their first use."""
        if self._tangent is None:
            self._tangent = self.zeros(self._n_all_points, 6, 3, 3)
            self._record_tangent(self._tangent)
        return self._tangent

    def _record_tangent(self, blocks: torch.Tensor) -> None:
        self._positive = torch.zeros(self.batch, device=self.device, dtype=torch.int32)
        self._product_stress = self.zeros(self._n_all_points, 3, 3)
        self._product = self.zeros(self.n_vertices, 3)
        self._tangent_commands, self._product_commands = [], []
        positive = warp_view(self._positive, wp.int32)
        for s in self.sets:
            tangent = self.points_view(blocks, s.part, self.mat33)
            kernel, inputs = s.tangent(self.terms, warp_view(self.positions, self.vec3), positive)
            self._tangent_commands.append(self.record(kernel, (self.batch, s.n_points), inputs, [tangent]))
            self._product_commands += self._product_launches(s, blocks)

    def _product_launches(self, s: PointTerm, blocks: torch.Tensor) -> list[Any]:
        """Recorded launches that add a set's part of the stiffness product with ``_direction`` to ``_product``."""
        inputs = [s.nodes, s.gradients, s.points_per_cell, self.points_view(blocks, s.part, self.mat33)]
        inputs.append(warp_view(self._direction, self.vec3))
        product = [self.points_view(self._product_stress, s.part, self.mat33)]
        launch = self.record(self._second.tangent_product, (self.batch, s.n_points), inputs, product)
        return [launch, self.gather(s, self._product_stress, self._product)]

    def _record_adjoint(self) -> None:
        scalars = [self.zeros(self.n_points) for _ in range(3)]
        self._adjoints = [*scalars, self.zeros(self.n_points, 3, 3)]
        types = [self.scalar] * 3 + [self.mat33]
        for s in self.solids:
            outputs = [self.points_view(o, s.part, t) for o, t in zip(self._adjoints, types, strict=True)]
            inputs = [*s.arguments(self.terms, warp_view(self.positions, self.vec3))]
            inputs.append(warp_view(self._direction, self.vec3))
            dim = (self.batch, s.n_points)
            self._adjoint_commands.append(self.record(self._elastic.stiffness_adjoint, dim, inputs, outputs))

    def stiffness_product(self, direction: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) product of the internal forces' stiffness with a displacement, all vertices included [N].

        Uses the last `update_tangent`.
        """
        self._direction.copy_(direction)
        self._product.zero_()
        self.launch(*self._product_commands)
        return self._product.clone()

    def parameter_adjoint(self, adjoint: torch.Tensor) -> dict[str, torch.Tensor]:
        """-z . d residual / d theta at ``positions`` for the terms of the last `set_terms`.

        Args:
            adjoint: (B, N, 3) z = H^-1 dL/dx, zero at fixed vertices [m].

        Returns:
            ``shape_stiffness`` and ``volume_stiffness`` (B, P), ``viscosity`` (B,), ``reference_strain`` (B, P, 3, 3),
            and ``pressure`` and ``fibre_stiffness`` (B, C) where there are chambers and fibres.
        """
        if not self._adjoint_commands:
            self._record_adjoint()
        self._direction.copy_(adjoint)
        self.launch(*self._adjoint_commands)
        out = [values.clone() for values in self._adjoints]
        names = ("shape_stiffness", "volume_stiffness", "viscosity", "reference_strain")
        result = dict(zip(names, out, strict=True))
        result["viscosity"] = result["viscosity"].sum(1)
        for s in self.sets:
            if isinstance(s, SurfaceTerm):
                result[s.parameter] = s.parameter_adjoint(self.positions, self._direction)
        return result

    def strain(self, positions: torch.Tensor) -> torch.Tensor:
        """(B, P, 3, 3) Green strain of (B, N, 3) positions."""
        out = self.zeros(self.n_points, 3, 3)
        x = warp_view(positions.contiguous(), self.vec3)
        for s in self.solids:
            inputs = [s.nodes, s.gradients, s.points_per_cell, x]
            outputs = [self.points_view(out, s.part, self.mat33)]
            self.launch(self.record(self._elastic.strain, (self.batch, s.n_points), inputs, outputs))
        return out

    def strain_adjoint(self, positions: torch.Tensor, adjoint: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) transposed derivative of `strain` applied to (B, P, 3, 3)."""
        out = self.zeros(self.n_vertices, 3)
        stress = self.zeros(self.n_points, 3, 3)
        x = warp_view(positions.contiguous(), self.vec3)
        adjoint = adjoint.contiguous()
        for s in self.solids:
            inputs = [s.nodes, s.gradients, s.points_per_cell, x]
            inputs.append(self.points_view(adjoint, s.part, self.mat33))
            outputs = [self.points_view(stress, s.part, self.mat33)]
            launch = self.record(self._elastic.strain_adjoint, (self.batch, s.n_points), inputs, outputs)
            self.launch(launch, self.gather(s, stress, out))
        return out
