"""Kernels of contact between surfaces, and derivatives of its friction
by the state at the start of a step.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from typing_extensions import override

from ....io.errors import InputError
from ....kernels.contact import nearest_points
from ....kernels.contact import surface_pairs as kernels
from ...fem.integration_points import Points
from ...stepping.quantity import Quantity
from ..launcher import HostLaunches, Launcher, warp_view
from ..term import Adjoint, PairTangents, PointSet, Term, Values, value_of
from .pairs import PairList, Surface
from .surface_friction import Grips, NearPairs, Sliding

STIFFNESS = Quantity("surface_stiffness", "Pa", 0.0)
FRICTION = Quantity("surface_friction", "", 0.0, closed=True, per="coefficient")
_TINY = 1e-300  # keeps a division by a length defined


@dataclass(frozen=True)
class SurfacePoints(Points):
    """Vertices of a surface."""

    surface: Surface
    regions: NDArray[np.bool_]  # (F, 2, N) vertices of both regions of pairs of these
    first: int = 0  # number of the body's first vertex

    @override
    def shifted(self, first: int) -> Self:
        return replace(super().shifted(first), first=self.first + first)

    def placed(self, count: int) -> Surface:
        """Returns the surface with the vertex numbers of a simulator of `count` vertices."""
        return self.surface.within(self.first, count)

    def members(self, count: int) -> NDArray[np.bool_]:
        """Returns the vertices (F, 2, `count`) of both regions of pairs, with the same numbers."""
        after = count - self.first - self.regions.shape[2]
        return np.pad(self.regions, [(0, 0), (0, 0), (self.first, after)])


class SurfaceTerm(Term):
    """Kernels of contact between surfaces.

    Args:
        launcher: launcher of the potential.
        sets: the vertices of the surface.
        reach: distance at which contact begins [m].
    """

    couples_cells = has_pairs = True
    _kernels = kernels

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], reach: float) -> None:
        (s,) = sets
        assert isinstance(s.source, SurfacePoints)
        members = s.source.members(s.n_vertices)
        fields = dict.fromkeys(
            ("surface_start", "surface_reference", "surface_place"), (s.n_vertices, 3)
        )
        shapes = {
            STIFFNESS.name: (1,),
            FRICTION.name: (1 + len(members),),
            "surface_slip": (1,),
            **fields,
        }
        super().__init__(launcher, sets, shapes)
        self._reach = reach
        self._list = PairList(launcher, s.source.placed(s.n_vertices), reach)
        # Positions, if some depend.
        self._whole = launcher.zeros(s.n_vertices, 3) if s.nodes_per_cell > 1 else None
        self._members = torch.as_tensor(members, device=launcher.device)
        self._none = torch.zeros(0, device=launcher.device, dtype=torch.int64)
        self._force, self._energy = launcher.zeros(self.n_points, 3), launcher.zeros(self.n_points)
        self._grips: Grips | None = None
        self._bounded = False
        self._steps, self._recorded = 0, dict[int, tuple[tuple[int, int], list[Any]]]()
        self._size(0)

    def _size(self, count: int) -> None:
        """Makes buffers for pairs."""
        new = self._force.new_zeros
        self._pair_force, self._pair_energy = new(count, 4, 3), new(count)
        self._near = torch.zeros(count, device=self.launcher.device, dtype=torch.int32)
        self._sized = self._list.version

    def _expand(self, field: torch.Tensor, out: torch.Tensor | None = None) -> torch.Tensor:
        """Returns a field (B, N, 3) with the values at all vertices of the surface
        from those at control vertices.

        At other vertices it is zero, or what `out` has there.
        """
        if self._whole is None:
            return field
        out = torch.zeros_like(field) if out is None else out
        (s,), launcher = self.sets, self.launcher
        inputs = [self._list.vertex_array, s.points, warp_view(field.contiguous(), wp.vec3d)]
        launcher.run(
            kernels.interpolate, (launcher.batch, self.n_points), inputs, [warp_view(out, wp.vec3d)]
        )
        return out

    @override
    def set_step(self) -> None:
        self._bounded, self._grips = False, None
        slides = self.sliding(self.values["surface_start"], self.values[STIFFNESS.name])
        self._grips = None if slides is None else Grips.of(self._list, slides)
        self._steps += 1

    @override
    def check_start(self, start: torch.Tensor, follows: bool) -> None:
        before, pairs = self.values["surface_start"], self._list
        if not follows:
            when = "at the start of a step, in environment {}"
            pairs.check_apart(before, when, "give a state in which the bodies are apart")
        share = self.launcher.zeros() + 1.0
        self.free_way(before, start, share)
        if bool((share < 1.0).any()):
            b = int(share.argmin())
            way = (start - before)[b].norm(dim=-1)
            raise InputError(
                "an obstacle moves a body through the gap to another one in a step, in "
                f"environment {b} by up to {1e3 * float(way.max()):.3g} mm, at vertex "
                f"{int(way.argmax())}: let it move less in a step, or go there by several "
                "equilibria, one after another."
            )

    @override
    def free_way(self, origin: torch.Tensor, end: torch.Tensor, share: torch.Tensor) -> None:
        pairs = self._list
        if torch.equal(origin, end):
            return
        origin, end = self._expand(origin), self._expand(end)
        if not (pairs.covers(origin) and pairs.covers(end)):
            pairs.find(origin, end - origin)
        if pairs.count:
            self.launcher.launch(self._bound(origin, end, warp_view(share, wp.float64)))

    def _commands(self, positions: Any, active: Any) -> list[Any]:
        """Returns launches of forces and energies at positions."""
        x = self._expand(wp.to_torch(positions), self._whole)
        if not (self._bounded or self._list.covers(x)):
            # By `bounds`, a list holds all pairs up to the next step.
            self._list.find(x, torch.zeros_like(x))
        now = (self._list.version, self._steps)
        if active.ptr not in self._recorded or self._recorded[active.ptr][0] != now:
            self._recorded[active.ptr] = now, self._record(warp_view(x, wp.vec3d), active)
        return self._recorded[active.ptr][1]

    def _record(self, positions: Any, active: Any) -> list[Any]:
        launcher, pairs = self.launcher, self._list
        if self._sized != pairs.version:
            self._size(pairs.count)
        inputs = [
            active,
            pairs.pairs,
            self.view(STIFFNESS.name),
            wp.float64(self._reach),
            positions,
        ]
        pair_out = [
            warp_view(self._pair_force, nearest_points.Corners),
            warp_view(self._pair_energy, wp.float64),
        ]
        sums = [warp_view(self._force, wp.vec3d), warp_view(self._energy, wp.float64)]
        incidence = [warp_view(x, wp.int32) for x in (pairs.start, pairs.incident)]
        size, near = (launcher.batch, self.n_points), warp_view(self._near, wp.int32)
        commands = (
            [launcher.record(kernels.pair_forces, (pairs.count,), inputs, [*pair_out, near])]
            if pairs.count
            else []
        )
        commands.append(
            launcher.record(kernels.gather, size, [*incidence, *pair_out, self.n_points, 0], sums)
        )
        grips = self._grips
        if grips is not None:
            inputs = [active, grips.struct, *self._friction(), positions]
            commands.append(
                launcher.record(kernels.grip_forces, (grips.count,), inputs, grips.outputs)
            )
            inputs = [*grips.incidence, *grips.outputs, self.n_points, 1]
            commands.append(launcher.record(kernels.gather, size, inputs, sums))
        return commands

    def _friction(self) -> list[Any]:
        """Returns coefficient, slip and reference for the kernels of friction."""
        names = (
            (FRICTION.name, wp.float64),
            ("surface_slip", wp.float64),
            ("surface_reference", wp.vec3d),
        )
        return [self.view(name, kind) for name, kind in names]

    @override
    def before(self, positions: Any, active: Any) -> list[Any]:
        return [HostLaunches(lambda: self._commands(positions, active))]

    @override
    def _arguments(self, s: PointSet, positions: Any) -> list[Any]:
        return [warp_view(self._force, wp.vec3d), warp_view(self._energy, wp.float64)]

    def _chosen(self, active: torch.Tensor) -> torch.Tensor:
        """Returns the pairs of active environments that were near at the last evaluation."""
        if self._sized != self._list.version or not self._list.count:
            return torch.zeros(0, device=self.launcher.device, dtype=torch.int64)
        return (self._near * active[self._list.environment]).nonzero().ravel()

    @override
    def pair_tangents(
        self, positions: Any, clamp: bool, active: torch.Tensor
    ) -> PairTangents | None:
        launcher, chosen = self.launcher, self._chosen(active)
        parts = list[PairTangents]()
        if self._whole is not None:
            positions = warp_view(self._expand(wp.to_torch(positions), self._whole), wp.vec3d)
        if len(chosen):
            indices, blocks = chosen.to(torch.int32), self._force.new_zeros(len(chosen), 12, 12)
            inputs = [
                warp_view(indices, wp.int32),
                self._list.pairs,
                self.view(STIFFNESS.name),
                wp.float64(self._reach),
                positions,
            ]
            out = [warp_view(blocks, wp.float64)]
            kernel = kernels.pair_springs if clamp else kernels.pair_tangents
            launcher.run(kernel, (len(chosen),), inputs, out)
            parts.append(
                PairTangents(self._list.environment[chosen], self._list.nodes[chosen], blocks)
            )
        grips = self._grips
        if grips is not None:
            blocks = self._force.new_zeros(grips.count, 12, 12)
            inputs = [grips.struct, *self._friction(), positions]
            launcher.run(
                kernels.grip_tangents, (grips.count,), inputs, [warp_view(blocks, wp.float64)]
            )
            used = active.bool()[grips.environment]
            parts.append(PairTangents(grips.environment[used], grips.nodes[used], blocks[used]))
        if not parts:
            return None
        return PairTangents(
            torch.cat([part.environment for part in parts]),
            torch.cat([part.nodes for part in parts]),
            torch.cat([part.blocks for part in parts]),
        )

    @override
    def feasible(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.values["surface_place"], self._none

    @override
    def bounds(self, origin: Any, positions: Any, share: Any) -> list[Any]:
        return [HostLaunches(lambda: self._bounding(origin, positions, share))]

    def _bounding(self, origin: Any, positions: Any, share: Any) -> list[Any]:
        """Returns the launch that bounds a way, after a search for pairs along it,
        and limits its length.
        """
        launcher, pairs = self.launcher, self._list
        self._bounded = True
        start = self._expand(wp.to_torch(origin))
        end = self._expand(wp.to_torch(positions))
        part = wp.to_torch(share)
        ways = ((end - start) * launcher.active[:, None, None]).nan_to_num(0.0)
        start = torch.where(launcher.active.bool()[:, None, None], start, end)
        part.copy_(
            torch.minimum(part, pairs.longest_way / pairs.lengths(ways).amax(1).clamp_min(_TINY))
        )
        way = part[:, None, None] * ways
        if not (pairs.covers(start) and pairs.covers(start + way)):
            pairs.find(start, way)
        self._ends = start, end  # keeps their memory
        return [self._bound(start, end, share)] if pairs.count else []

    def _bound(self, start: torch.Tensor, end: torch.Tensor, share: Any) -> Any:
        """Returns the launch that bounds the way between positions (B, N, 3)."""
        ends = (warp_view(x.contiguous(), wp.vec3d) for x in (start, end))
        inputs = [warp_view(self.launcher.active, wp.int32), self._list.pairs, *ends]
        return self.launcher.record(nearest_points.bound, (self._list.count,), inputs, [share])

    @override
    def curvature(self) -> torch.Tensor:
        return self._energy.new_zeros(1, self.n_points)

    def _near_at(self, positions: torch.Tensor) -> torch.Tensor:
        """The pairs within reach at positions (B, N, 3), whose forces are then those there."""
        if not self._list.covers(positions):
            self._list.find(positions, torch.zeros_like(positions))
        active = warp_view(self.launcher.active, wp.int32)
        self.launcher.launch(*self._record(warp_view(positions, wp.vec3d), active))
        return self._chosen(self.launcher.active)

    def sliding(self, start: torch.Tensor, stiffness: torch.Tensor) -> Sliding | None:
        """Returns friction for the state at the start of a step,
        or None without pairs within reach.
        """
        chosen = self._near_at(start.detach())
        if not len(chosen):
            return None
        return Sliding.of(self._pairs(chosen, start), self._reach, stiffness, self._regions(chosen))

    def _pairs(self, chosen: torch.Tensor, x: torch.Tensor) -> NearPairs:
        return NearPairs.of(self.launcher, self._list, chosen, x)

    def _regions(self, chosen: torch.Tensor) -> torch.Tensor:
        """Returns the number of the coefficient of friction of pairs:
        that of the first pair of regions they are in.
        """
        nodes, out = self._list.nodes[chosen], torch.zeros_like(chosen)
        first = torch.arange(4, device=nodes.device) <= self._list.kind[chosen, None]
        for number, regions in reversed(list(enumerate(self._members, 1))):
            a, b = (region[nodes] for region in regions)
            matches = torch.where(first, a, b).all(1) | torch.where(first, b, a).all(1)
            out = torch.where(matches, number, out)
        return out

    def forces(self, values: Values, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Returns gaps (B, P) [m], normal forces and friction (B, P, 3)
        on the vertices [N], slides (B, P) [m].

        All are differentiable. Slides are the largest of the pairs of a vertex, negative without
        one that is pressed.

        Args:
            values: the values of the step, with their gradients.
            x: (B, N, 3) solution of the step [m].
        """
        normal, friction = torch.zeros_like(x), torch.zeros_like(x)
        gap = torch.full_like(x[..., 0], self._reach)
        slide = torch.full_like(gap, -1.0)
        start, stiffness = value_of(values, "surface_start"), value_of(values, STIFFNESS.name)
        slides = self.sliding(start, stiffness)
        if slides is not None:
            names = ("surface_reference", FRICTION.name, "surface_slip")
            force = slides.force(x, *(value_of(values, name) for name in names))
            ways = (
                slides.slide(x, value_of(values, names[0])).square().sum(-1).clamp_min(_TINY).sqrt()
            )
            ways = torch.where(slides.weights == 0.0, -1.0, ways[:, None])
            rows = slides.environment[:, None] * x.shape[1] + slides.nodes
            slide = (
                slide.ravel().scatter_reduce(0, rows.ravel(), ways.ravel(), "amax").view_as(slide)
            )
            place = (slides.environment[:, None].expand_as(slides.nodes), slides.nodes)
            friction = friction.index_put(
                place, slides.weights[..., None] * force[:, None], accumulate=True
            )
        chosen = self._near_at(x.detach())
        if len(chosen):
            differentiable = torch.is_grad_enabled()
            with torch.enable_grad():
                leaf = x if x.requires_grad else x.detach().requires_grad_()
                near = self._pairs(chosen, leaf)
                s = (near.d / self._reach).clamp_max(1.0)
                barrier = (near.part * -(s - 1.0).square() * s.log()).sum(1) * self._reach
                energy = (barrier * near.factor * stiffness[near.environment, 0]).sum()
                (slope,) = torch.autograd.grad(energy, leaf, create_graph=differentiable)
            normal = -slope
            entries = near.environment[:, None] * x.shape[1] + near.nodes
            distance = torch.where(near.weights[:, 0] == 0.0, self._reach, near.d[:, :1])
            gap = (
                gap.ravel()
                .scatter_reduce(0, entries.ravel(), distance.ravel(), "amin")
                .view_as(gap)
            )
        vertices = self._list.vertices
        return gap[:, vertices], normal[:, vertices], friction[:, vertices], slide[:, vertices]

    @override
    def adjoint(self, positions: torch.Tensor, direction: torch.Tensor) -> Adjoint:
        launcher = self.launcher
        names = ("surface_start", "surface_reference", STIFFNESS.name, FRICTION.name)

        def differentiate() -> dict[str, torch.Tensor]:
            x, ways = self._expand(positions), self._expand(direction)
            chosen = self._near_at(x)
            environment, nodes = self._list.environment[chosen], self._list.nodes[chosen]
            work = (self._pair_force[chosen] * ways[environment[:, None], nodes]).sum((1, 2))
            by_stiffness = (
                launcher.zeros(1).index_add_(0, environment, -work[:, None])
                / self.values[STIFFNESS.name]
            )
            start, reference, stiffness, friction = leaves = [
                self.values[name].detach().requires_grad_() for name in names
            ]
            slopes = tuple(torch.zeros_like(value) for value in leaves)
            with torch.enable_grad():
                slides = self.sliding(start, stiffness)
                if slides is not None:
                    force = slides.force(x, reference, friction, self.values["surface_slip"])
                    along = ways[slides.environment[:, None], slides.nodes]
                    work = (slides.weights[..., None] * along * force[:, None]).sum()
                    slopes = torch.autograd.grad(work, leaves)
            out = dict(zip(names, slopes, strict=True))
            return out | {STIFFNESS.name: out[STIFFNESS.name] + by_stiffness}

        return differentiate
