"""The incremental potential of a time step, evaluated by Warp kernels on torch's memory.

One time step of every integrator, and a static equilibrium too, is the minimum over x of

    sum_i k_i / 2 |x_i - y_i|^2 - f . x + sum_e E_e(x)

with k the inertia over the square of the effective time step, y where inertia alone would go, f the loads, and E_e the
energies: the solid's, elastic and dissipative, and those of the body's other energies, such as -p V of chambers under
pressure.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
import warp as wp

from ..kernels import points as kernels
from ..kernels import reductions
from .base import PointSet, Term
from .launcher import Launcher, Launches, warp_view
from .placed import Placed


@dataclass(frozen=True)
class StepTerms:
    """What distinguishes one step's potential from the next; see the equation of `potential`."""

    target: torch.Tensor  # (B, N, 3) y [m]
    inertia: torch.Tensor  # (B, N) k [N/m]
    force: torch.Tensor  # (B, N, 3) f [N]
    # what the energies' terms need, by name; see their `Term.shapes`. The first axis is 1 or B. None leaves out
    # what another value makes needless
    values: dict[str, torch.Tensor | None] = field(default_factory=dict)


class IncrementalPotential(Launcher):
    """Energy, residual, Hessian and adjoint products of a batch of one body.

    Holds the buffers that its recorded kernel launches work on. Evaluations refer to the last `set_terms`.

    Args:
        energies: of the body.
        n_vertices: N.
        fixed: (D,) fixed vertices.
        batch: environments B.
        device: of every buffer.

    Attributes:
        energies: their terms.
        own_values: the buffers of the current values of each of them, by the energy's own names.
        stiffness: (B,) sum of the solids' moduli times volumes [J], by which rounding of the energy is judged.
        sets: the sets of points of all of them.
        free_mask: (N,) one at free vertices, zero at fixed ones.
        evaluation: launches that set ``residual``, and the sums of it and of the energy, at ``positions``:
        energy: (B,) of the last evaluation [J].
        energy_size: (B,) sum of the absolute values of what it is the sum of [J].
        balance: (B,) norm of inertia less all loads there [N].
        residual_norm: (B,) norm of the residual there [N].
        low_rank: (B, 3 N, r) columns C of the last `update_tangent`: what the Hessian has beside `tangent` is C C^T.
            None for nothing.
        tangent_active: (B,) zero for environments whose tangent stays as it is.
        clamp: (B,) not zero for environments whose tangent has its eigenvalues clamped at zero.
        all_active: whether the last `update_tangent` was for all environments.
        tangent_launches: launches that set `tangents`; made with them.
    """

    tangent_launches: Launches

    def __init__(
        self,
        energies: Sequence[Placed],
        n_vertices: int,
        fixed: torch.Tensor,
        batch: int,
        device: torch.device,
    ) -> None:
        super().__init__(batch, device)
        self.n_vertices = n_vertices
        self.energies: list[Term] = []
        self.sets: list[PointSet] = []
        self._loads: list[bool] = []
        first = 0
        self._placed = tuple(energies)
        for each in energies:
            energy, start, mine = each.energy, first, list[PointSet]()
            for points in each.points:
                part = slice(first, first + points.n_points)
                own = slice(part.start - start, part.stop - start)
                mine.append(PointSet(self, points, n_vertices, part, own))
                first = part.stop
            self.energies.append(energy.term(self, mine))
            self.sets += mine
            self._loads.append(energy.is_load)
        self._n_points = first
        self.free_mask = torch.ones(n_vertices, device=device, dtype=torch.float64)
        self.free_mask[fixed] = 0.0
        pairs = list(zip(energies, self.energies, strict=True))
        shapes = {name: shape for each, term in pairs for name, shape in each.named(term.shapes).items()}
        values: dict[str, torch.Tensor | None] = {name: self.zeros(*shape) for name, shape in shapes.items()}
        self.own_values = [each.own_values(values, term) for each, term in pairs]
        self.terms = StepTerms(self.zeros(n_vertices, 3), self.zeros(n_vertices), self.zeros(n_vertices, 3), values)
        self.stiffness = self.zeros()
        self.positions = self.zeros(n_vertices, 3)
        self._position_view = warp_view(self.positions, wp.vec3d)
        self.residual = self.zeros(n_vertices, 3)
        self._stress = [self.zeros(s.n_points, 3, s.width) for s in self.sets]
        self._point_energy = self.zeros(self._n_points)
        self._vertex_energy = self.zeros(n_vertices)
        self.energy, self.energy_size, self.balance, self.residual_norm = (self.zeros() for _ in range(4))
        self._record_evaluation()
        self._tangents: list[torch.Tensor] = []
        self.tangent_active, self.clamp = (torch.zeros(batch, device=device, dtype=torch.int32) for _ in range(2))
        self.all_active = True
        self.low_rank: torch.Tensor | None = None
        self._direction = self.zeros(n_vertices, 3)
        self._adjoints: list[Callable[[], dict[str, torch.Tensor]]] = []

    def _record_evaluation(self) -> None:
        t, b = self.terms, self.batch
        self._inertia_command = self.record(
            kernels.inertia_residual,
            (b, self.n_vertices),
            [
                warp_view(t.inertia, wp.float64),
                warp_view(t.target, wp.vec3d),
                warp_view(t.force, wp.vec3d),
                self._position_view,
            ],
            [warp_view(self.residual, wp.vec3d), warp_view(self._vertex_energy, wp.float64)],
        )
        active, stresses = warp_view(self.active, wp.int32), iter(self._stress)
        self._internal_commands: list[Any] = []
        self._load_commands: list[Any] = []
        for term, values, is_load in zip(self.energies, self.own_values, self._loads, strict=True):
            commands = self._load_commands if is_load else self._internal_commands
            commands += term.before(values, self._position_view, active)
            for s in term.sets:
                stress = s.stress_view(next(stresses))
                outputs = [stress, self.points_view(self._point_energy, s.part, wp.float64)]
                kernel, inputs = term.step(s, values, self._position_view)
                commands += [
                    self.record(kernel, (b, s.n_points), [active, *inputs], outputs),
                    self.gather(s, stress, self.residual),
                ]
        free, residual = warp_view(self.free_mask, wp.float64), warp_view(self.residual, wp.vec3d)
        self._load_commands.append(
            self.record_blocks(reductions.masked_norm, b, [free, residual], [warp_view(self.balance, wp.float64)])
        )
        energies = [warp_view(each, wp.float64) for each in (self._vertex_energy, self._point_energy)]
        sums = [warp_view(each, wp.float64) for each in (self.energy, self.energy_size, self.residual_norm)]
        self._internal_commands.append(self.record_blocks(reductions.totals, b, [free, *energies, residual], sums))
        self.evaluation = [self._inertia_command, *self._load_commands, *self._internal_commands]
        self._evaluation = self.capture(*self.evaluation)

    def set_terms(self, terms: StepTerms) -> None:
        """Copies a step's terms into the buffers; fixed vertices get neither inertia nor load."""
        own = self.terms
        own.target.copy_(terms.target.detach())
        torch.mul(terms.inertia.detach(), self.free_mask, out=own.inertia)
        torch.mul(terms.force.detach(), self.free_mask[:, None], out=own.force)
        for name, buffer in own.values.items():
            value = terms.values[name]
            if value is not None and buffer is not None:
                buffer.copy_(value.detach())
        self.stiffness.zero_()
        for term, values in zip(self.energies, self.own_values, strict=True):
            if (total := term.total_stiffness(values)) is not None:
                self.stiffness += total

    @property
    def force(self) -> torch.Tensor:
        """(B, N, 3) loads of the current terms [N]."""
        return self.terms.force

    @property
    def inertia(self) -> torch.Tensor:
        """(B, N) inertia of the current terms [N/m], zero at fixed vertices."""
        return self.terms.inertia

    def evaluate(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Energy (B,) [J] and norm of inertia less all loads (B,) [N] at ``positions``; sets ``residual`` [N].

        The residual is the potential's gradient, zero at fixed vertices.
        """
        self.launch(self._evaluation)
        return self.energy.clone(), self.balance.clone()

    def update_tangent(self, clamp: torch.Tensor | None = None, active: torch.Tensor | None = None) -> None:
        """Computes dP/dF at ``positions``.

        Args:
            clamp: (B,) environments whose eigenvalues are clamped at zero; none where left out.
            active: (B,) environments whose tangent is computed; all where left out.
        """
        self._prepare_tangents()
        self.all_active = active is None
        self.clamp.zero_() if clamp is None else self.clamp.copy_(clamp)
        self.tangent_active.fill_(1) if active is None else self.tangent_active.copy_(active)
        self.launch(self.tangent_launches)
        pairs = zip(self.energies, self.own_values, strict=True)
        found = [term.low_rank(values, self._position_view) for term, values in pairs]
        columns = [each for each in found if each is not None]
        self.low_rank = torch.cat(columns, 2) if columns else None

    @property
    def couples_cells(self) -> bool:
        """Whether there may be `low_rank` columns."""
        return any(term.couples_cells for term in self.energies)

    @property
    def tangents(self) -> list[torch.Tensor]:
        """For each of `sets`, (B, P, blocks, 3, 3) of dP/dF [J] from the last `update_tangent`; see ``kernels``."""
        return self._prepare_tangents()

    def _prepare_tangents(self) -> list[torch.Tensor]:
        """Buffers and launches of second derivatives, made at their first use."""
        if not self._tangents:
            self._tangents = [self.zeros(s.n_points, s.blocks, 3, 3) for s in self.sets]
            self._record_tangents(iter(self._tangents))
        return self._tangents

    def _record_tangents(self, blocks: Iterator[torch.Tensor]) -> None:
        self._product = self.zeros(self.n_vertices, 3)
        tangents, products = [], []
        masks = [warp_view(self.tangent_active, wp.int32), warp_view(self.clamp, wp.int32)]
        direction = warp_view(self._direction, wp.vec3d)
        for term, values in zip(self.energies, self.own_values, strict=True):
            tangents += term.before(values, self._position_view, masks[0])
            for s in term.sets:
                tangent = warp_view(next(blocks), wp.mat33d)
                kernel, inputs = term.tangent(s, values, self._position_view)
                tangents.append(self.record(kernel, (self.batch, s.n_points), [*masks, *inputs], [tangent]))
                stress = s.stress_view(self.zeros(s.n_points, 3, s.width))
                products += [
                    self.product(s, tangent, direction, stress),
                    self.gather(s, stress, self._product),
                ]
        self.tangent_launches, self._product_commands = self.capture(*tangents), self.capture(*products)

    def stiffness_product(self, direction: torch.Tensor) -> torch.Tensor:
        """(B, N, 3) product of the internal forces' stiffness with a displacement, all vertices included [N].

        Uses the last `update_tangent`.
        """
        self._direction.copy_(direction)
        self._product.zero_()
        self.launch(self._product_commands)
        product = self._product.clone()
        if self.low_rank is not None:
            along = torch.einsum("bnr,bn->br", self.low_rank, self._direction.flatten(1))
            product += torch.einsum("bnr,br->bn", self.low_rank, along).view_as(product)
        return product

    def value_adjoint(self, adjoint: torch.Tensor) -> dict[str, torch.Tensor]:
        """-z . d residual / d value at ``positions`` for every value of the last `set_terms`, by name, (B, *shape).

        Args:
            adjoint: (B, N, 3) z = H^-1 dL/dx, zero at fixed vertices [m].
        """
        self.prepare_adjoint()
        self._direction.copy_(adjoint)
        slopes: dict[str, torch.Tensor] = {}
        for each, differentiate in zip(self._placed, self._adjoints, strict=True):
            slopes |= each.named(differentiate())
        return slopes

    def prepare_adjoint(self) -> None:
        """Buffers and launches of `value_adjoint`, made at their first use."""
        if not self._adjoints:
            pairs = zip(self.energies, self.own_values, strict=True)
            self._adjoints = [t.adjoint(values, self.positions, self._direction) for t, values in pairs]
