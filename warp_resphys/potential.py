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
from .elements import PointSet
from .kernels.assembly import assembly_kernels
from .kernels.elasticity import elasticity_kernels
from .kernels.tangent import tangent_kernels

SCALARS: dict[torch.dtype, Any] = {torch.float64: wp.float64, torch.float32: wp.float32}


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


@dataclass(frozen=True)
class DevicePoints:
    """A point set as Warp arrays.

    Attributes:
        cells: C.
        points_per_cell: Q.
        nodes_per_cell: K.
        n_points: P = C Q.
        nodes: (C, K).
        gradients: (P, K) [1/m].
        start: (N + 1) where a vertex's entries of ``incident`` begin.
        incident: cell K + local node of every cell that a vertex belongs to.
    """

    cells: int
    points_per_cell: int
    nodes_per_cell: int
    n_points: int
    nodes: Any
    gradients: Any
    start: Any
    incident: Any


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
        scalar = SCALARS[dtype]
        self._elastic = elasticity_kernels(scalar)
        self._second = tangent_kernels(scalar)
        assembly_kernels(
            scalar
        )  # Joins the Warp module before its first load, which would be compiled twice otherwise.
        self.scalar, self.vec3, self.mat33 = scalar, self._elastic.vec3, self._elastic.mat33
        self.n_vertices = body.n_vertices
        self.n_points = sum(points.n_points for points in body.discretisation.point_sets)
        self.uploaded_sets = [self._upload_points(points) for points in body.discretisation.point_sets]
        self.point_slices = self._point_slices()
        norms = [np.sqrt((points.gradients**2).sum(axis=(2, 3))).ravel() for points in body.discretisation.point_sets]
        self._gradient_norms = torch.as_tensor(np.concatenate(norms), device=device, dtype=dtype)  # (P,) [1/m]
        self.free_mask = torch.ones(body.n_vertices, device=device, dtype=dtype)
        self.free_mask[torch.as_tensor(body.fixed_vertices, device=device)] = 0.0
        self.terms = self._allocate_terms()
        self.positions = self.zeros(self.n_vertices, 3)
        self.residual = self.zeros(self.n_vertices, 3)
        self._stress = self.zeros(self.n_points, 3, 3)
        self._point_energy = self.zeros(self.n_points)
        self._vertex_energy = self.zeros(self.n_vertices)
        self._record_evaluation()
        self._tangent: torch.Tensor | None = None
        self._direction = self.zeros(self.n_vertices, 3)
        self._adjoint_commands: list[Any] = []
        self._stream: tuple[torch.cuda.Stream, Any] | None = None

    def zeros(self, *shape: int) -> torch.Tensor:
        """(B, *shape) on the potential's device, in its type."""
        return torch.zeros(self.batch, *shape, device=self.device, dtype=self.dtype)

    def upload(self, values: NDArray[Any], dtype: Any) -> Any:
        """A Warp array with a copy of the values."""
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=str(self.device))

    def _upload_points(self, points: PointSet) -> DevicePoints:
        c, q, k, _ = points.gradients.shape
        owner = points.nodes.ravel()
        # A padded node repeats its patch's own vertex with a zero gradient and contributes nothing.
        entries = np.flatnonzero(np.abs(points.gradients).sum(axis=(1, 3)).ravel() > 0.0)
        order = entries[np.argsort(owner[entries], kind="stable")]
        start = np.searchsorted(owner[order], np.arange(self.n_vertices + 1))
        return DevicePoints(
            cells=c,
            points_per_cell=q,
            nodes_per_cell=k,
            n_points=points.n_points,
            nodes=self.upload(points.nodes.astype(np.int32), int),
            gradients=self.upload(points.gradients.reshape(c * q, k, 3), self.vec3),
            start=self.upload(start.astype(np.int32), int),
            incident=self.upload(order.astype(np.int32), int),
        )

    def _point_slices(self) -> list[slice]:
        ends = np.cumsum([s.n_points for s in self.uploaded_sets])
        return [slice(int(end) - s.n_points, int(end)) for s, end in zip(self.uploaded_sets, ends, strict=True)]

    def _allocate_terms(self) -> StepTerms:
        n, p = self.n_vertices, self.n_points
        return StepTerms(
            target=self.zeros(n, 3),
            inertia=self.zeros(n),
            force=self.zeros(n, 3),
            shape_stiffness=self.zeros(p),
            volume_stiffness=self.zeros(p),
            viscosity=self.zeros(),
            reference_strain=self.zeros(p, 3, 3),
        )

    def points_view(self, tensor: torch.Tensor, part: slice, dtype: Any) -> Any:
        """Warp array on the points of one set."""
        return warp_view(tensor[:, part], dtype)

    def _energy_arguments(self, s: DevicePoints, part: slice) -> list[Any]:
        t = self.terms
        return [
            self._model,
            s.nodes,
            s.gradients,
            self.points_view(t.shape_stiffness, part, self.scalar),
            self.points_view(t.volume_stiffness, part, self.scalar),
            warp_view(t.viscosity, self.scalar),
            self.points_view(t.reference_strain, part, self.mat33) if t.reference_strain is not None else None,
            s.points_per_cell,
            warp_view(self.positions, self.vec3),
        ]

    def record(self, kernel: Any, dim: tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> Any:
        """A launch to be made by `launch`, as often as needed."""
        return wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=str(self.device), record_cmd=True)

    def _gather(self, s: DevicePoints, stress: torch.Tensor, part: slice, out: torch.Tensor) -> Any:
        """Recorded launch that adds a point set's transposed gradient of the stress to (B, N, 3)."""
        k = self._elastic
        inputs = [s.nodes, s.gradients, s.points_per_cell, s.start, s.incident]
        inputs.append(self.points_view(stress, part, self.mat33))
        return self.record(k.gather, (self.batch, self.n_vertices), inputs, [warp_view(out, self.vec3)])

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
        self._elastic_commands = []
        for s, part in zip(self.uploaded_sets, self.point_slices, strict=True):
            outputs = [
                self.points_view(self._stress, part, self.mat33),
                self.points_view(self._point_energy, part, self.scalar),
            ]
            step = self.record(k.local_step, (b, s.n_points), self._energy_arguments(s, part), outputs)
            self._elastic_commands += [step, self._gather(s, self._stress, part, self.residual)]

    def launch(self, *commands: Any) -> None:
        """Makes recorded launches, on torch's stream."""
        if self.device.type == "cpu":
            for command in commands:
                command.launch()
            return
        handle = torch.cuda.current_stream(self.device)
        if self._stream is None or self._stream[0] != handle:
            self._stream = (handle, wp.stream_from_torch(handle))
        stream = self._stream[1]
        for command in commands:
            command.launch(stream)

    def set_terms(self, terms: StepTerms) -> None:
        """Copies a step's terms into the buffers; fixed vertices get neither inertia nor load."""
        t = self.terms
        t.target.copy_(terms.target.detach())
        torch.mul(terms.inertia.detach(), self.free_mask, out=t.inertia)
        torch.mul(terms.force.detach(), self.free_mask[:, None], out=t.force)
        t.shape_stiffness.copy_(terms.shape_stiffness.detach())
        t.volume_stiffness.copy_(terms.volume_stiffness.detach())
        t.viscosity.copy_(terms.viscosity.detach())
        if terms.reference_strain is not None and t.reference_strain is not None:
            t.reference_strain.copy_(terms.reference_strain.detach())

    @property
    def force(self) -> torch.Tensor:
        """(B, N, 3) loads of the current terms [N]."""
        return self.terms.force

    @property
    def inertia(self) -> torch.Tensor:
        """(B, N) inertia of the current terms [N/m], zero at fixed vertices."""
        return self.terms.inertia

    def evaluate(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Energy (B,) [J] and the norm of inertia less loads (B,) [N] at ``positions``; sets ``residual`` [N].

        The residual is the potential's gradient, zero at fixed vertices.
        """
        self.launch(self._inertia_command)
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
        energy = self._point_energy.sum(1) + self._vertex_energy.abs().sum(1)
        return 8.0 * torch.finfo(self.dtype).eps * (stiffness + 100.0 * energy)

    def residual_rounding(self) -> torch.Tensor:
        """(B,) norm that rounding may give the residual, with a margin [N].

        A relative error eps of positions and stresses errs by eps (1 + |x| |grad N|) in a point's stress over its
        stiffness, and |grad N| carries that to the force. Residuals at rest are a fiftieth to a half of the result.
        """
        t = self.terms
        stiffness = (2.0 * t.shape_stiffness + t.volume_stiffness.abs()) * (1.0 + t.viscosity[:, None])
        reach = self.positions.abs().amax(dim=(1, 2))[:, None]
        forces = stiffness * self._gradient_norms * (1.0 + reach * self._gradient_norms)
        return 4.0 * torch.finfo(self.dtype).eps * torch.linalg.vector_norm(forces, dim=1)

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
            self._tangent = self.zeros(self.n_points, 6, 3, 3)
            self._record_tangent(self._tangent)
        return self._tangent

    def _record_tangent(self, blocks: torch.Tensor) -> None:
        self._positive = torch.zeros(self.batch, device=self.device, dtype=torch.int32)
        self._product_stress = self.zeros(self.n_points, 3, 3)
        self._product = self.zeros(self.n_vertices, 3)
        self._tangent_commands, self._product_commands = [], []
        k = self._second
        for s, part in zip(self.uploaded_sets, self.point_slices, strict=True):
            tangent = self.points_view(blocks, part, self.mat33)
            inputs = [*self._energy_arguments(s, part), warp_view(self._positive, wp.int32)]
            self._tangent_commands.append(self.record(k.tangent, (self.batch, s.n_points), inputs, [tangent]))
            inputs = [s.nodes, s.gradients, s.points_per_cell, tangent]
            inputs.append(warp_view(self._direction, self.vec3))
            product = [self.points_view(self._product_stress, part, self.mat33)]
            launch = self.record(k.tangent_product, (self.batch, s.n_points), inputs, product)
            self._product_commands += [launch, self._gather(s, self._product_stress, part, self._product)]

    def _record_adjoint(self) -> None:
        scalars = [self.zeros(self.n_points) for _ in range(3)]
        self._adjoints = [*scalars, self.zeros(self.n_points, 3, 3)]
        types = [self.scalar] * 3 + [self.mat33]
        for s, part in zip(self.uploaded_sets, self.point_slices, strict=True):
            outputs = [self.points_view(o, part, t) for o, t in zip(self._adjoints, types, strict=True)]
            inputs = [*self._energy_arguments(s, part), warp_view(self._direction, self.vec3)]
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
            ``shape_stiffness`` and ``volume_stiffness`` (B, P), ``viscosity`` (B,), ``reference_strain`` (B, P, 3, 3).
        """
        if not self._adjoint_commands:
            self._record_adjoint()
        self._direction.copy_(adjoint)
        self.launch(*self._adjoint_commands)
        out = [values.clone() for values in self._adjoints]
        names = ("shape_stiffness", "volume_stiffness", "viscosity", "reference_strain")
        result = dict(zip(names, out, strict=True))
        result["viscosity"] = result["viscosity"].sum(1)
        return result

    def strain(self, positions: torch.Tensor) -> torch.Tensor:
        """(B, P, 3, 3) Green strain of (B, N, 3) positions."""
        out = self.zeros(self.n_points, 3, 3)
        x = warp_view(positions.contiguous(), self.vec3)
        for s, part in zip(self.uploaded_sets, self.point_slices, strict=True):
            inputs = [s.nodes, s.gradients, s.points_per_cell, x]
            outputs = [self.points_view(out, part, self.mat33)]
            self.launch(self.record(self._elastic.strain, (self.batch, s.n_points), inputs, outputs))
        return out

    def strain_adjoint(self, positions: torch.Tensor, adjoint: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) transposed derivative of `strain` applied to (B, P, 3, 3)."""
        out = self.zeros(self.n_vertices, 3)
        stress = self.zeros(self.n_points, 3, 3)
        x = warp_view(positions.contiguous(), self.vec3)
        adjoint = adjoint.contiguous()
        for s, part in zip(self.uploaded_sets, self.point_slices, strict=True):
            inputs = [s.nodes, s.gradients, s.points_per_cell, x]
            inputs.append(self.points_view(adjoint, part, self.mat33))
            outputs = [self.points_view(stress, part, self.mat33)]
            launch = self.record(self._elastic.strain_adjoint, (self.batch, s.n_points), inputs, outputs)
            self.launch(launch, self._gather(s, stress, part, out))
        return out
