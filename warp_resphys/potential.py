"""The incremental potential of a time step, evaluated by Warp kernels on torch's memory.

One time step of every integrator, and a static equilibrium too, is the minimum over x of

    sum_i k_i / 2 |x_i - y_i|^2 - f . x + E(x) + c/2 sum_p |E_p(x) - E_p^ref|^2_C

with k the inertia over the square of the effective time step, y where inertia alone would go, f the loads, E the
elastic energy, and the last term the Kelvin-Voigt dissipation potential of the Green strain E_p with viscosity c.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from .body import Body
from .kernels.assembly import assembly_kernels
from .kernels.elasticity import elasticity_kernels
from .kernels.tangent import tangent_kernels
from .linear_solver import LinearSolver

_SCALARS = {torch.float64: wp.float64, torch.float32: wp.float32}


def warp_view(tensor: torch.Tensor, dtype: Any) -> Any:
    """A Warp array on a tensor's own memory, without a gradient."""
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


@dataclass(frozen=True)
class StepTerms:
    """What distinguishes one step's potential from the next; see the module's equation.

    Attributes:
        target: (B, N, 3) y [m].
        inertia: (B, N) k [N/m].
        force: (B, N, 3) f [N].
        shape_stiffness: (1 or B, P) mu times volume [J].
        volume_stiffness: (1 or B, P) lambda times volume [J].
        viscosity: (B,) stiffness damping over the effective time step.
        reference_strain: (B, P, 3, 3) strain that the strain rate starts from; None without viscosity.
    """

    target: torch.Tensor
    inertia: torch.Tensor
    force: torch.Tensor
    shape_stiffness: torch.Tensor
    volume_stiffness: torch.Tensor
    viscosity: torch.Tensor
    reference_strain: torch.Tensor | None = None

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
        )


class BlockPattern:
    """Which pairs of vertices the Hessian couples, and which cell blocks make up each pair.

    Attributes:
        rows: (E,) row of each block, an index into ``free``.
        cols: (E,) its column; ``rows >= cols``.
        free: (F,) vertices that are not fixed.
    """

    def __init__(self, body: Body) -> None:
        n = body.n_vertices
        is_free = np.ones(n, dtype=bool)
        is_free[body.fixed_vertices] = False
        self.free = np.flatnonzero(is_free)
        reduced = np.where(is_free, np.cumsum(is_free) - 1, -1)
        sources: list[NDArray[np.int64]] = []
        pairs: list[NDArray[np.int64]] = []
        self.offsets: list[int] = []
        self.n_cell_blocks = 0
        for points in body.discretisation.point_sets:
            a, c = np.tril_indices(points.nodes.shape[1])
            pair = np.stack([reduced[points.nodes[:, a]], reduced[points.nodes[:, c]]], axis=-1).reshape(-1, 2)
            used = (np.abs(points.gradients).sum(axis=(1, 3)) > 0.0)[:, a] & (
                np.abs(points.gradients).sum(axis=(1, 3)) > 0.0
            )[:, c]
            keep = (pair >= 0).all(axis=1) & used.ravel()
            # A padded node repeats its patch's own vertex with a zero gradient and contributes nothing.
            sources.append(self.n_cell_blocks + np.flatnonzero(keep))
            pairs.append(pair[keep])
            self.offsets.append(self.n_cell_blocks)
            self.n_cell_blocks += len(pair)
        self._collect(np.concatenate(sources), np.concatenate(pairs))

    def _collect(self, source: NDArray[np.int64], pair: NDArray[np.int64]) -> None:
        """Sorts the cell blocks by matrix block; a block above the diagonal enters transposed."""
        n = len(self.free)
        source = np.where(pair[:, 0] < pair[:, 1], -1 - source, source)
        diagonal = np.arange(n) * (n + 1)
        key = pair.max(axis=1) * n + pair.min(axis=1)
        blocks, inverse = np.unique(np.concatenate([key, diagonal]), return_inverse=True)
        order = np.argsort(inverse[: len(key)], kind="stable")
        self.rows, self.cols = blocks // n, blocks % n
        self.contribution = source[order]
        self.start = np.searchsorted(inverse[: len(key)][order], np.arange(len(blocks) + 1))
        self.diagonal_vertex = np.where(self.rows == self.cols, self.free[self.rows], -1)


class IncrementalPotential:
    """Energy, residual, Hessian and adjoint products of a batch of one body.

    Holds the buffers that its recorded kernel launches work on. Evaluations refer to the last `set_terms`.

    Args:
        body: the body.
        model: material model (an integer of ``kernels.elasticity``).
        batch: environments B.
        device: of every buffer.
        dtype: ``torch.float64`` or ``torch.float32``.
    """

    def __init__(self, body: Body, model: int, batch: int, device: torch.device, dtype: torch.dtype) -> None:
        self.body, self.batch, self.device, self.dtype = body, batch, device, dtype
        self._model = model
        scalar = _SCALARS[dtype]
        self._elastic, self._assembly = elasticity_kernels(scalar), assembly_kernels(scalar)
        self._second = tangent_kernels(scalar)
        self._scalar, self._vec3, self._mat33 = scalar, self._elastic.vec3, self._elastic.mat33
        self.n_vertices = body.n_vertices
        self.n_points = sum(points.n_points for points in body.discretisation.point_sets)
        self._sets = [self._upload(points) for points in body.discretisation.point_sets]
        self._slices = self._point_slices()
        norms = [np.sqrt((points.gradients**2).sum(axis=(2, 3))).ravel() for points in body.discretisation.point_sets]
        self._gradient_norms = torch.as_tensor(np.concatenate(norms), device=device, dtype=dtype)  # (P,) [1/m]
        self.free_mask = torch.ones(body.n_vertices, device=device, dtype=dtype)
        self.free_mask[torch.as_tensor(body.fixed_vertices, device=device)] = 0.0
        self._terms = self._allocate_terms()
        self.positions = self._zeros(self.n_vertices, 3)
        self.residual = self._zeros(self.n_vertices, 3)
        self._stress = self._zeros(self.n_points, 3, 3)
        self._point_energy = self._zeros(self.n_points)
        self._vertex_energy = self._zeros(self.n_vertices)
        self._viscous = False
        self._record_evaluation()
        self._tangent: torch.Tensor | None = None
        self._direction = self._zeros(self.n_vertices, 3)
        self._adjoint_commands: list[Any] = []

    def _zeros(self, *shape: int) -> torch.Tensor:
        return torch.zeros(self.batch, *shape, device=self.device, dtype=self.dtype)

    def _array(self, values: NDArray[Any], dtype: Any) -> Any:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=str(self.device))

    def _upload(self, points: Any) -> dict[str, Any]:
        c, q, k, _ = points.gradients.shape
        owner = points.nodes.ravel()
        used = np.repeat((np.abs(points.gradients).sum(axis=(1, 3)) > 0.0).ravel(), 1)
        entries = np.flatnonzero(used)
        order = entries[np.argsort(owner[entries], kind="stable")]
        start = np.searchsorted(owner[order], np.arange(self.n_vertices + 1))
        return {
            "cells": c,
            "points_per_cell": q,
            "n_points": points.n_points,
            "k": k,
            "nodes": self._array(points.nodes.astype(np.int32), int),
            "gradients": self._array(points.gradients.reshape(c * q, k, 3), self._vec3),
            "start": self._array(start.astype(np.int32), int),
            "incident": self._array(order.astype(np.int32), int),
        }

    def _point_slices(self) -> list[slice]:
        ends = np.cumsum([s["n_points"] for s in self._sets])
        return [slice(int(end) - s["n_points"], int(end)) for s, end in zip(self._sets, ends, strict=True)]

    def _allocate_terms(self) -> StepTerms:
        n, p = self.n_vertices, self.n_points
        return StepTerms(
            target=self._zeros(n, 3),
            inertia=self._zeros(n),
            force=self._zeros(n, 3),
            shape_stiffness=self._zeros(p),
            volume_stiffness=self._zeros(p),
            viscosity=self._zeros(),
            reference_strain=self._zeros(p, 3, 3),
        )

    def _points(self, tensor: torch.Tensor, part: slice, dtype: Any) -> Any:
        return warp_view(tensor[:, part], dtype)

    def _energy_arguments(self, s: dict[str, Any], part: slice) -> list[Any]:
        t = self._terms
        return [
            self._model,
            s["nodes"],
            s["gradients"],
            self._points(t.shape_stiffness, part, self._scalar),
            self._points(t.volume_stiffness, part, self._scalar),
            warp_view(t.viscosity, self._scalar),
            self._points(t.reference_strain, part, self._mat33) if t.reference_strain is not None else None,
            s["points_per_cell"],
            warp_view(self.positions, self._vec3),
        ]

    def _record(self, kernel: Any, dim: tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> Any:
        return wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=str(self.device), record_cmd=True)

    def _gather(self, s: dict[str, Any], stress: torch.Tensor, part: slice, out: torch.Tensor) -> Any:
        """Recorded launch that adds a point set's transposed gradient of the stress to (B, N, 3)."""
        k = self._elastic
        inputs = [s["nodes"], s["gradients"], s["points_per_cell"], s["start"], s["incident"]]
        inputs.append(self._points(stress, part, self._mat33))
        return self._record(k.gather, (self.batch, self.n_vertices), inputs, [warp_view(out, self._vec3)])

    def _record_evaluation(self) -> None:
        t, k, b = self._terms, self._elastic, self.batch
        self._inertia_command = self._record(
            k.inertia_residual,
            (b, self.n_vertices),
            [
                warp_view(t.inertia, self._scalar),
                warp_view(t.target, self._vec3),
                warp_view(t.force, self._vec3),
                warp_view(self.positions, self._vec3),
            ],
            [warp_view(self.residual, self._vec3), warp_view(self._vertex_energy, self._scalar)],
        )
        self._elastic_commands = []
        for s, part in zip(self._sets, self._slices, strict=True):
            outputs = [
                self._points(self._stress, part, self._mat33),
                self._points(self._point_energy, part, self._scalar),
            ]
            step = self._record(k.local_step, (b, s["n_points"]), self._energy_arguments(s, part), outputs)
            self._elastic_commands += [step, self._gather(s, self._stress, part, self.residual)]

    def _launch(self, *commands: Any) -> None:
        if self.device.type == "cpu":
            for command in commands:
                command.launch()
            return
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
        for command in commands:
            command.launch(stream)

    def set_terms(self, terms: StepTerms) -> None:
        """Copies a step's terms into the buffers; fixed vertices get neither inertia nor load."""
        t = self._terms
        t.target.copy_(terms.target.detach())
        torch.mul(terms.inertia.detach(), self.free_mask, out=t.inertia)
        torch.mul(terms.force.detach(), self.free_mask[:, None], out=t.force)
        t.shape_stiffness.copy_(terms.shape_stiffness.detach())
        t.volume_stiffness.copy_(terms.volume_stiffness.detach())
        t.viscosity.copy_(terms.viscosity.detach())
        self._viscous = terms.reference_strain is not None
        if terms.reference_strain is not None and t.reference_strain is not None:
            t.reference_strain.copy_(terms.reference_strain.detach())

    @property
    def force(self) -> torch.Tensor:
        """(B, N, 3) loads of the current terms [N]."""
        return self._terms.force

    @property
    def inertia(self) -> torch.Tensor:
        """(B, N) inertia of the current terms [N/m], zero at fixed vertices."""
        return self._terms.inertia

    def evaluate(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Energy (B,) [J] and the norm of inertia less loads (B,) [N] at ``positions``; sets ``residual`` [N].

        The residual is the potential's gradient, zero at fixed vertices.
        """
        self._launch(self._inertia_command)
        balance = torch.linalg.vector_norm(self.residual.view(self.batch, -1), dim=1)
        self._launch(*self._elastic_commands)
        self.residual.mul_(self.free_mask[:, None])
        return self._point_energy.sum(1).add_(self._vertex_energy.sum(1)), balance

    def energy_rounding(self) -> torch.Tensor:
        """(B,) how far rounding may have moved the energy last evaluated [J].

        Terms of the size of the stiffness cancel in the energy of a small strain.
        """
        t = self._terms
        stiffness = t.shape_stiffness.sum(1) + t.volume_stiffness.sum(1)
        energy = self._point_energy.sum(1) + self._vertex_energy.abs().sum(1)
        return 8.0 * torch.finfo(self.dtype).eps * (stiffness + 100.0 * energy)

    def residual_rounding(self) -> torch.Tensor:
        """(B,) norm that rounding may give the residual, with a margin [N].

        A relative error eps of positions and stresses errs by eps (1 + |x| |grad N|) in a point's stress over its
        stiffness, and |grad N| carries that to the force. Residuals at rest are a fiftieth to a half of the result.
        """
        t = self._terms
        stiffness = (2.0 * t.shape_stiffness + t.volume_stiffness.abs()) * (1.0 + t.viscosity[:, None])
        reach = self.positions.abs().amax(dim=(1, 2))[:, None]
        forces = stiffness * self._gradient_norms * (1.0 + reach * self._gradient_norms)
        return 4.0 * torch.finfo(self.dtype).eps * torch.linalg.vector_norm(forces, dim=1)

    def update_tangent(self, positive: torch.Tensor | None = None) -> None:
        """Computes dP/dF at ``positions``.

        Args:
            positive: (B,) environments whose eigenvalues are clamped at zero; none where left out.
        """
        if self._tangent is None:
            self._record_tangent()
        self._positive.zero_()
        if positive is not None:
            self._positive.copy_(positive)
        self._launch(*self._tangent_commands)

    def _record_tangent(self) -> None:
        self._tangent = self._zeros(self.n_points, 6, 3, 3)
        self._positive = torch.zeros(self.batch, device=self.device, dtype=torch.int32)
        self._product_stress = self._zeros(self.n_points, 3, 3)
        self._product = self._zeros(self.n_vertices, 3)
        self._tangent_commands, self._product_commands = [], []
        k = self._second
        for s, part in zip(self._sets, self._slices, strict=True):
            tangent = self._points(self._tangent, part, self._mat33)
            inputs = [*self._energy_arguments(s, part), warp_view(self._positive, wp.int32)]
            self._tangent_commands.append(self._record(k.tangent, (self.batch, s["n_points"]), inputs, [tangent]))
            inputs = [s["nodes"], s["gradients"], s["points_per_cell"], tangent]
            inputs.append(warp_view(self._direction, self._vec3))
            product = [self._points(self._product_stress, part, self._mat33)]
            launch = self._record(k.tangent_product, (self.batch, s["n_points"]), inputs, product)
            self._product_commands += [launch, self._gather(s, self._product_stress, part, self._product)]

    def _record_adjoint(self) -> None:
        scalars = [self._zeros(self.n_points) for _ in range(3)]
        self._adjoints = [*scalars, self._zeros(self.n_points, 3, 3)]
        types = [self._scalar] * 3 + [self._mat33]
        for s, part in zip(self._sets, self._slices, strict=True):
            outputs = [self._points(o, part, t) for o, t in zip(self._adjoints, types, strict=True)]
            inputs = [*self._energy_arguments(s, part), warp_view(self._direction, self._vec3)]
            dim = (self.batch, s["n_points"])
            self._adjoint_commands.append(self._record(self._elastic.stiffness_adjoint, dim, inputs, outputs))

    def stiffness_product(self, direction: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) product of the internal forces' stiffness with a displacement, all vertices included [N].

        Uses the last `update_tangent`.
        """
        self._direction.copy_(direction)
        self._product.zero_()
        self._launch(*self._product_commands)
        return self._product.clone()

    def hessian_values(self, solver: LinearSolver, pattern: BlockPattern) -> torch.Tensor:
        """(B, n_values) the Hessian in a solver's layout, from the last `update_tangent`."""
        return self.scatterer(solver, pattern)()

    def scatterer(self, solver: LinearSolver, pattern: BlockPattern) -> "HessianAssembly":
        """Recorded launches that assemble for a solver."""
        if self._tangent is None:
            self._record_tangent()
        return HessianAssembly(self, solver, pattern)

    def parameter_adjoint(self, adjoint: torch.Tensor) -> dict[str, torch.Tensor]:
        """-z . d residual / d theta at ``positions`` for the terms of the last `set_terms`.

        Args:
            adjoint: (B, N, 3) z = H^-1 dL/dx, zero at fixed vertices [m].

        Returns:
            ``shape_stiffness`` and ``volume_stiffness`` (B, P), ``viscosity`` (B,), ``reference_strain`` (B, P, 3, 3).
        """
        if not self._adjoint_commands:
            self._record_adjoint()
        self._direction.copy_(adjoint)
        self._launch(*self._adjoint_commands)
        out = [values.clone() for values in self._adjoints]
        names = ("shape_stiffness", "volume_stiffness", "viscosity", "reference_strain")
        result = dict(zip(names, out, strict=True))
        result["viscosity"] = result["viscosity"].sum(1)
        return result

    def strain(self, positions: torch.Tensor) -> torch.Tensor:
        """(B, P, 3, 3) Green strain of (B, N, 3) positions."""
        out = self._zeros(self.n_points, 3, 3)
        x = warp_view(positions.contiguous(), self._vec3)
        for s, part in zip(self._sets, self._slices, strict=True):
            inputs = [s["nodes"], s["gradients"], s["points_per_cell"], x]
            outputs = [self._points(out, part, self._mat33)]
            self._launch(self._record(self._elastic.strain, (self.batch, s["n_points"]), inputs, outputs))
        return out

    def strain_adjoint(self, positions: torch.Tensor, adjoint: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) transposed derivative of `strain` applied to (B, P, 3, 3)."""
        out = self._zeros(self.n_vertices, 3)
        stress = self._zeros(self.n_points, 3, 3)
        x = warp_view(positions.contiguous(), self._vec3)
        adjoint = adjoint.contiguous()
        for s, part in zip(self._sets, self._slices, strict=True):
            inputs = [s["nodes"], s["gradients"], s["points_per_cell"], x]
            inputs.append(self._points(adjoint, part, self._mat33))
            outputs = [self._points(stress, part, self._mat33)]
            launch = self._record(self._elastic.strain_adjoint, (self.batch, s["n_points"]), inputs, outputs)
            self._launch(launch, self._gather(s, stress, part, out))
        return out


class HessianAssembly:
    """Recorded launches from the tangent of a potential to the value array of a linear solver."""

    def __init__(self, potential: IncrementalPotential, solver: LinearSolver, pattern: BlockPattern) -> None:
        p, k = potential, potential._assembly
        self._potential = p
        blocks = p._zeros(pattern.n_cell_blocks, 3, 3)
        self._values = p._zeros(solver.n_values)
        self._commands = []
        for s, part, offset in zip(p._sets, p._slices, pattern.offsets, strict=True):
            inputs = [s["gradients"], s["points_per_cell"]]
            inputs += [p._points(p._tangent, part, p._mat33), offset]
            self._commands.append(
                p._record(k.cell_blocks, (p.batch, s["cells"], s["k"]), inputs, [warp_view(blocks, p._mat33)])
            )
        inputs = [
            p._array(pattern.start.astype(np.int32), int),
            p._array(pattern.contribution.astype(np.int32), int),
            p._array(pattern.diagonal_vertex.astype(np.int32), int),
            p._array(solver.address, int),
            warp_view(blocks, p._mat33),
            warp_view(p._terms.inertia, p._scalar),
        ]
        dim = (p.batch, len(pattern.rows))
        self._commands.append(p._record(k.scatter_blocks, dim, inputs, [warp_view(self._values, p._scalar)]))

    def __call__(self) -> torch.Tensor:
        """(B, n_values) from the potential's last `update_tangent`; overwritten by the next call."""
        self._potential._launch(*self._commands)
        return self._values
