"""The incremental potential of a time step, evaluated by Warp kernels on torch's memory.

One time step of every integrator, and a static equilibrium too, is the minimum over x of

    sum_i k_i / 2 |x_i - y_i|^2 - f . x + sum_e E_e(x)

with the mass over the square of the effective time step k, the inertial target y, the loads f, and
the energies E_e: those of the solid, elastic and dissipative, and others such as -p V of chambers
under pressure.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from ...io.errors import InputError
from ...kernels import points as kernels
from ...kernels import reductions
from ..fem.coordinates import Coordinates, DeviceCoordinates
from .base import PlacedEnergy
from .launcher import CapturedGraph, Launcher, LaunchSequence, warp_view
from .term import PairTangents, PointSet, Term, Values

Names = Sequence[tuple[int, str]]  # number of an energy, and name of a value of its term


@dataclass(frozen=True)
class StepTerms:
    """The data of a step in the incremental potential (equation in the module's docstring)."""

    target: torch.Tensor  # (B, N, 3) y [m]
    inertia: torch.Tensor  # (B, N) k [N/m]
    force: torch.Tensor  # (B, N, 3) f [N]
    # values of each energy's term by name (`Term.values`), with a first axis of 1 or B; None if not
    # needed
    values: Sequence[Values] = ()

    @classmethod
    def of(cls, names: Names, target: Any, inertia: Any, force: Any, *values: Any) -> "StepTerms":
        """Returns terms with values by energy and name, from a list of them."""
        count = 1 + max((energy for energy, _ in names), default=-1)
        by_energy: list[dict[str, torch.Tensor | None]] = [{} for _ in range(count)]
        for (energy, name), value in zip(names, values, strict=True):
            by_energy[energy][name] = value
        return cls(target, inertia, force, by_energy)


class IncrementalPotential(Launcher):
    """Energy, residual, Hessian and adjoint products for a batch.

    Holds the buffers of its recorded kernel launches. Evaluations refer to the last `set_terms`.

    Args:
        energies: energies of the body.
        coordinates: map from control vertices to the N vertices.
        eliminated: (H,) vertices that are not unknowns: the fixed and the dependent ones.
        batch: number of environments B.
        device: device of every buffer.

    Attributes:
        energies: terms of the energies.
        stiffness: (B,) sum of the solids' moduli times volumes, the scale of the energy's rounding
            error [J].
        value_names: number of the energy and name of every value of the terms.
        sets: sets of points of all energies.
        free_mask: (N,) one at free vertices, zero at fixed ones.
        coordinates: the map on the potential's device, in float64.
        evaluation: launches that evaluate at ``positions`` and set ``residual`` and what follows
            here. Environments that are not ``active`` keep energies, norm of the residual and
            ``held_gradient``, and have no valid ``residual``.
        held_gradient: (B, N, 3) gradient of the energies at fixed vertices, and its part normal to
            symmetry planes at vertices that slide in them; zero at others [N].
        energy: (B,) [J].
        energy_size: (B,) sum of the absolute values of the energies [J].
        balance: (B,) norm of inertia less all loads [N].
        residual_norm: (B,) norm of the residual [N].
        low_rank: (B, 3 N, r) columns C of the last `update_tangent`; the Hessian has C C^T besides
            `tangents`. Or None.
        tangent_active: (B,) zero for environments whose tangent is not updated.
        clamp: (B,) non-zero for environments with eigenvalues clamped at zero.
        last_pair_tangents: `pair_tangents` of the last `update_tangent`.
        all_active: whether the last `update_tangent` was for all environments.
        tangent_launches: launches that set `tangents`, available after their first use.
        on_direction: is called before each global step of a minimisation, unless a GPU runs all of
            it.
    """

    tangent_launches: CapturedGraph | LaunchSequence

    def __init__(
        self,
        energies: Sequence[PlacedEnergy],
        coordinates: Coordinates,
        eliminated: torch.Tensor,
        batch: int,
        device: torch.device,
    ) -> None:
        super().__init__(batch, device)
        self.on_direction: Callable[[], None] = lambda: None
        self.n_vertices = n_vertices = coordinates.n_vertices
        self.coordinates = DeviceCoordinates(
            coordinates, torch.empty(0, device=device, dtype=torch.float64)
        )
        self.energies: list[Term] = []
        self.sets: list[PointSet] = []
        self._n_points = 0
        self.last_pair_tangents: list[PairTangents] = []
        self._is_load = [placed.energy.is_load for placed in energies]
        for placed in energies:
            start, sets = self._n_points, list[PointSet]()
            for points in placed.points:
                first, self._n_points = self._n_points, self._n_points + points.n_points
                in_energy = slice(first - start, self._n_points - start)
                sets.append(
                    PointSet(self, points, n_vertices, slice(first, self._n_points), in_energy)
                )
            self.energies.append(placed.energy.term(self, sets))
            self.sets += sets
        self.free_mask = torch.ones(n_vertices, device=device, dtype=torch.float64)
        self.free_mask[eliminated] = 0.0
        starts = (term.feasible() for term in self.energies)
        self._feasible = [start for start in starts if start is not None]
        fields = self.zeros(n_vertices, 3), self.zeros(n_vertices), self.zeros(n_vertices, 3)
        self.terms = StepTerms(*fields, [term.values for term in self.energies])
        self.value_names = tuple(
            (k, name) for k, term in enumerate(self.energies) for name in term.values
        )
        self.stiffness = self.zeros()
        self.positions = self.zeros(n_vertices, 3)
        self._position_view = warp_view(self.positions, wp.vec3d)
        self.residual, self.held_gradient = self.zeros(n_vertices, 3), self.zeros(n_vertices, 3)
        self._point_energy = self.zeros(self._n_points)
        self._vertex_energy = self.zeros(n_vertices)
        self.energy, self.energy_size = self.zeros(), self.zeros()
        self.balance, self.residual_norm = self.zeros(), self.zeros()
        self._record_evaluation()
        self._tangents: list[torch.Tensor] = []
        self.tangent_active, self.clamp = (
            torch.zeros(batch, device=device, dtype=torch.int32) for _ in range(2)
        )
        self.all_active = True
        self.low_rank: torch.Tensor | None = None
        # The same, with components normal to symmetry planes
        self._stiff_columns: torch.Tensor | None = None
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
        active = warp_view(self.active, wp.int32)
        self._internal_commands: list[Any] = []
        self._load_commands: list[Any] = []
        for term, is_load in zip(self.energies, self._is_load, strict=True):
            commands = self._load_commands if is_load else self._internal_commands
            commands += term.before(self._position_view, active)
            for s in term.sets:
                energy = warp_view(self._point_energy[:, s.in_body], wp.float64)
                kernel, inputs, by_cells = term.step(s, self._position_view)
                if by_cells:
                    outputs = [warp_view(self.residual, wp.vec3d), energy]
                    commands.append(self.record(kernel, (b, s.cells), [active, *inputs], outputs))
                    continue
                stress = s.stress_view(self.zeros(s.n_points, 3, s.width))
                commands += [
                    self.record(kernel, (b, s.n_points), [active, *inputs], [stress, energy]),
                    self.gather(s, stress, self.residual),
                ]
        free, residual = warp_view(self.free_mask, wp.float64), warp_view(self.residual, wp.vec3d)
        sums, c = [warp_view(self.held_gradient, wp.vec3d)], self.coordinates
        if c.slides:  # removes the residual normal to symmetry planes
            planes = [
                self.upload(c.sliding.cpu().numpy().astype(np.int32), int),
                warp_view(c.projections, wp.mat33d),
            ]
            for first, commands in enumerate((self._internal_commands, self._load_commands)):
                inputs = [active, *planes, first]
                commands.append(
                    self.record(kernels.project, (b, len(c.sliding)), inputs, [residual, *sums])
                )
        self._load_commands.append(
            self.record_blocks(
                reductions.masked_norm, b, [free, residual], [warp_view(self.balance, wp.float64)]
            )
        )
        energies = [
            warp_view(values, wp.float64) for values in (self._vertex_energy, self._point_energy)
        ]
        sums += [
            warp_view(values, wp.float64)
            for values in (self.energy, self.energy_size, self.residual_norm)
        ]
        self._internal_commands.append(
            self.record_blocks(reductions.totals, b, [active, free, *energies, residual], sums)
        )
        self.evaluation = [self._inertia_command, *self._load_commands, *self._internal_commands]
        self._evaluation = self.capture(*self.evaluation)

    def restrict(self, field: torch.Tensor) -> torch.Tensor:
        """Returns a field (B, N, 3, ...) that is zero at vertices
        without unknowns and normal to symmetry planes.
        """
        mask = self.free_mask.view(-1, *[1] * (field.ndim - 2))
        return self.coordinates.restrict(field * mask)

    def set_terms(self, terms: StepTerms) -> None:
        """Copies a step's terms into the buffers, with zero inertia and load at fixed vertices."""
        mine = self.terms
        mine.target.copy_(terms.target.detach())
        if self.coordinates.slides:
            mine.target.copy_(self.coordinates.hold(mine.target))
        torch.mul(terms.inertia.detach(), self.free_mask, out=mine.inertia)
        torch.mul(
            self.coordinates.restrict(terms.force.detach().double()),
            self.free_mask[:, None],
            out=mine.force,
        )
        for term, values in zip(self.energies, terms.values, strict=True):
            for name, buffer in term.values.items():
                value = values[name]
                if value is not None:
                    buffer.copy_(value.detach())
        for positions, moved in self._feasible[1:]:
            self._feasible[0][0][:, moved] = positions[:, moved]
        for term in self.energies:
            term.set_step()
        stiffnesses = [term.total_stiffness() for term in self.energies]
        totals = [stiffness for stiffness in stiffnesses if stiffness is not None]
        if totals:
            self.stiffness.copy_(totals[0] if len(totals) == 1 else torch.stack(totals).sum(0))

    @property
    def inertia(self) -> torch.Tensor:
        """(B, N) inertia of the current terms [N/m], zero at fixed vertices."""
        return self.terms.inertia

    def evaluate(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the energy (B,) [J] and `balance` (B,) [N] at ``positions``.

        Sets ``residual`` [N].

        The residual is the potential's gradient, zero at fixed vertices.
        """
        self.launch(self._evaluation)
        return self.energy.clone(), self.balance.clone()

    def update_tangent(
        self, clamp: torch.Tensor | None = None, active: torch.Tensor | None = None
    ) -> None:
        """Computes dP/dF at ``positions``.

        Args:
            clamp: (B,) environments whose eigenvalues are clamped at zero; None: no environment.
            active: (B,) environments whose tangent is computed; None: all.
        """
        self._prepare_tangents()
        self.all_active = active is None
        self.clamp.zero_() if clamp is None else self.clamp.copy_(clamp)
        self.tangent_active.fill_(1) if active is None else self.tangent_active.copy_(active)
        self.launch(self.tangent_launches)
        self.last_pair_tangents = self.pair_tangents()
        parts = (term.low_rank(self._position_view) for term in self.energies)
        columns = [part for part in parts if part is not None]
        self.low_rank = self._stiff_columns = torch.cat(columns, 2) if columns else None
        if self.low_rank is not None and self.coordinates.slides:
            whole = self.low_rank.unflatten(1, (self.n_vertices, 3))
            self.low_rank = self.coordinates.restrict(whole).flatten(1, 2)

    def pair_tangents(
        self, clamp: bool = False, active: torch.Tensor | None = None
    ) -> list[PairTangents]:
        """Returns parts of the Hessian at ``positions`` that couple vertices of different cells.

        Args:
            clamp: whether negative eigenvalues are left out.
            active: (B,) zero for environments that are left out; None: those of ``active``.
        """
        chosen = self.active if active is None else active
        parts = (term.pair_tangents(self._position_view, clamp, chosen) for term in self.energies)
        return [part for part in parts if part is not None]

    @property
    def feasible(self) -> torch.Tensor | None:
        """Buffer (B, N, 3) of positions of finite energy [m],
        or None if all are (`Term.feasible`).
        """
        return self._feasible[0][0] if self._feasible else None

    def improved_start(self, start: torch.Tensor) -> torch.Tensor:
        """Returns positions (B, N, 3) at which a solve starts instead of `start`
        (`Term.improve_start`), in planes.
        """
        positions = start.to(torch.float64, copy=True, memory_format=torch.contiguous_format)
        for term in self.energies:
            term.improve_start(warp_view(positions, wp.vec3d))
        return self.coordinates.hold(positions)

    def check_start(self, follows: bool) -> None:
        """Checks `feasible`, with fixed vertices where they were before (`Term.check_start`).

        Args:
            follows: whether the step begins where the last one ended.

        Raises:
            InputError: the solve cannot start there.
        """
        if self.feasible is not None:
            for term in self.energies:
                term.check_start(self.feasible, follows)

    def place_fixed(self, fixed: torch.Tensor, places: torch.Tensor, least: float) -> bool:
        """Moves the fixed vertices of `feasible` to their places,
        or towards them as far as bodies let them.

        Args:
            fixed: (D,) fixed vertices.
            places: (1 or B, D, 3) their positions in the solve [m].
            least: share of the way that must be free.

        Returns:
            Whether they arrived.

        Raises:
            InputError: less is free.
        """
        feasible = self.feasible
        if feasible is None:
            return True
        origin = feasible.clone()
        feasible[:, fixed] = places.to(feasible)
        if not (self.has_pairs and len(fixed)):
            return True
        way, share = feasible - origin, self.zeros() + 1.0
        for term in self.energies:
            term.free_way(origin, feasible, share)
        if bool((share < least).any()):
            b = int(share.argmin())
            vertex = int(way[b].norm(dim=-1).argmax())
            raise InputError(
                "fixed vertices move through the gap between surfaces in a step, in environment "
                f"{b} by up to {1e3 * float(way[b, vertex].norm()):.3g} mm, at vertex {vertex}: "
                "move them less in a step, or go there by several equilibria, one after another."
            )
        arrived = bool((share == 1.0).all())
        if not arrived:
            feasible.copy_(origin + share[:, None, None] * way)
        return arrived

    def bounds(self, origin: Any, positions: Any, share: Any) -> list[Any]:
        """Returns launches that bound the way between two arrays of positions (`Term.bounds`)."""
        return [
            launch for term in self.energies for launch in term.bounds(origin, positions, share)
        ]

    @property
    def couples_cells(self) -> bool:
        """Whether there may be `low_rank` columns or `pair_tangents`."""
        return any(term.couples_cells for term in self.energies)

    @property
    def has_pairs(self) -> bool:
        """Whether there may be `pair_tangents`."""
        return any(term.has_pairs for term in self.energies)

    @property
    def tangents(self) -> list[torch.Tensor]:
        """Blocks of dP/dF (B, P, blocks, 3, 3) [J] for each of `sets` (``kernels``),
        from the last `update_tangent`.
        """
        return self._prepare_tangents()

    def _prepare_tangents(self) -> list[torch.Tensor]:
        """Returns the tangents, whose buffers and launches are made at the first use."""
        if not self._tangents:
            self._tangents = [self.zeros(s.n_points, s.blocks, 3, 3) for s in self.sets]
            self._record_tangents(iter(self._tangents))
        return self._tangents

    def _record_tangents(self, blocks: Iterator[torch.Tensor]) -> None:
        self._product = self.zeros(self.n_vertices, 3)
        tangents, products = [], []
        masks = [warp_view(self.tangent_active, wp.int32), warp_view(self.clamp, wp.int32)]
        direction = warp_view(self._direction, wp.vec3d)
        for term in self.energies:
            tangents += term.before(self._position_view, masks[0])
            for s in term.sets:
                tangent = warp_view(next(blocks), wp.mat33d)
                kernel, inputs, by_cells = term.tangent(s, self._position_view)
                threads = s.cells if by_cells else s.n_points
                tangents.append(
                    self.record(kernel, (self.batch, threads), [*masks, *inputs], [tangent])
                )
                stress = s.stress_view(self.zeros(s.n_points, 3, s.width))
                products += [
                    self.product(s, tangent, direction, stress),
                    self.gather(s, stress, self._product),
                ]
        self.tangent_launches, self._product_commands = (
            self.capture(*tangents),
            self.capture(*products),
        )

    def stiffness_product(self, direction: torch.Tensor) -> torch.Tensor:
        """Returns the product (B, N, 3) of the stiffness with a displacement, at all vertices [N].

        The stiffness, of the last `update_tangent`, is the Hessian without inertia.
        """
        self._direction.copy_(direction)
        self._product.zero_()
        self.launch(self._product_commands)
        product = self._product.clone()
        columns = self._stiff_columns
        if columns is not None:
            along = torch.einsum("bnr,bn->br", columns, self._direction.flatten(1))
            product += torch.einsum("bnr,br->bn", columns, along).view_as(product)
        if self.last_pair_tangents:
            whole, between = self.coordinates.expand(self._direction), torch.zeros_like(product)
            for part in self.last_pair_tangents:
                row = part.environment[:, None].expand_as(part.nodes)
                ways = whole[row, part.nodes]
                forces = torch.einsum("aij,aj->ai", part.blocks, ways.flatten(1)).view_as(ways)
                between.index_put_((row, part.nodes), forces, accumulate=True)
            product += self.coordinates.reduce(between)
        return product

    def value_adjoint(self, adjoint: torch.Tensor) -> list[dict[str, torch.Tensor]]:
        """Returns -z . d residual / d value, (B, *shape),
        at ``positions`` for the values of each term, by name.

        Args:
            adjoint: (B, N, 3) z [m].
        """
        self.prepare_adjoint()
        self._direction.copy_(adjoint)
        return [differentiate() for differentiate in self._adjoints]

    def prepare_adjoint(self) -> None:
        """Makes buffers and launches of `value_adjoint`, unless they exist."""
        if not self._adjoints:
            self._adjoints = [
                term.adjoint(self.positions, self._direction) for term in self.energies
            ]
