r"""Contact of bodies with one another and with themselves: a barrier between surfaces, and Coulomb friction.

A surface consists of triangles. A vertex and a triangle, or two edges, at the distance d < D, have the energy

    a kappa D B(d / D),     B(s) = -(s - 1)^2 ln s,

with the area a that the pair stands for, and friction as in `energies.contact`: with the normal force, the normal and
the nearest points of the start of a step, it acts against the relative slide of these points since then. Where the
nearest point is on an edge or at a vertex that several triangles have in common, their energies are summed so that it
counts once (inclusion and exclusion). Edges that are almost parallel have a factor that vanishes for parallel ones,
where their nearest points are not unique (incremental potential contact; Li et al. 2020).

Vertices have half of the area of the surface in these pairs, edges a quarter. Triangles and edges that share a vertex
are no pair.

M. Li et al.: Incremental potential contact. ACM Transactions on Graphics 39 (4), 2020.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
import warp as wp
from typing_extensions import override

from ..fem.elements import Points
from ..io.errors import InputError
from ..kernels import surfaces as kernels
from ..mesh.mesh import Mesh
from ..stepping.quantity import Parameter, Quantity
from .base import (
    Adjoint,
    BoundEnergy,
    Energy,
    EnergySite,
    EnergyStep,
    PairTangents,
    PointSet,
    Term,
    Values,
    value_of,
)
from .launcher import HostLaunches, Launcher, warp_view
from .pairs import PairList, Surface

STIFFNESS = Quantity("surface_stiffness", "Pa", 0.0)
FRICTION = Quantity("surface_friction", "", 0.0, closed=True)
_FEATURES = int(kernels.EDGE_FEATURES)


@dataclass(frozen=True)
class SurfacePoints(Points):
    """Vertices of a surface."""

    surface: Surface


@dataclass(frozen=True)
class SurfaceContact(Energy):
    """Contact of a body with itself or, as `Scene.contact`, of all bodies with one another and with themselves.

    Parameters are ``surface_stiffness`` [Pa] and ``surface_friction`` (equations in the module's docstring).

    Raises:
        InputError: a value out of range.
    """

    is_barrier: ClassVar[bool] = True

    stiffness: Parameter = 1e5  # kappa [Pa]
    friction: Parameter = 0.0  # mu
    distance: float = 1e-3  # D [m]
    slip_speed: float = 1e-3  # v_s [m/s]

    def __post_init__(self) -> None:
        """Checks the values."""
        for name in ("distance", "slip_speed"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise InputError(f"contact.{name} is {getattr(self, name):g}: it must be positive.")
        STIFFNESS.check(self.stiffness)
        FRICTION.check(self.friction)

    @property
    @override
    def parameters(self) -> tuple[Quantity, ...]:
        return (STIFFNESS, FRICTION)

    @property
    @override
    def constants(self) -> Mapping[str, Parameter]:
        return {STIFFNESS.name: self.stiffness, FRICTION.name: self.friction}

    @override
    def points(self, mesh: Mesh) -> tuple[Points, ...]:
        surface = Surface.of(mesh)
        vertices = surface.vertices
        return (SurfacePoints(vertices[:, None], np.ones((len(vertices), 1, 1, 1)), surface),)

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "SurfaceTerm":
        return SurfaceTerm(launcher, sets, self)

    @override
    def bind(self, site: EnergySite) -> "BoundSurfaceContact":
        return BoundSurfaceContact(self, site)


class BoundSurfaceContact(BoundEnergy):
    """Contact of surfaces in a simulator."""

    rate_independent = True

    def __init__(self, contact: SurfaceContact, site: EnergySite) -> None:
        super().__init__(contact, site)
        self._contact = contact
        body, rest = site.body, site.rest_positions
        if len(body.coordinates.dependent) or len(body.coordinates.sliding):
            raise InputError(
                "contact between surfaces moves every vertex on its own: leave out symmetry planes, glue and rigid "
                "parts; a rigid thing can be an obstacle, or a body of a stiff material."
            )
        (points,) = site.points
        self._fixed = torch.as_tensor(body.fixed_vertices + site.first, device=rest.device)
        launcher = Launcher(1, rest.device)
        pairs = PairList(launcher, _surface(points, len(rest)), contact.distance)
        self._check_rest(pairs, rest.double()[None])

    def _check_rest(self, pairs: PairList, rest: torch.Tensor) -> None:
        """Raises InputError where surfaces cross at rest, or parts of one piece are within reach of one another."""
        count, edge = pairs.crossings(rest)
        if int(count):
            vertex = int(pairs.surface.edges[int(edge), 0])
            raise InputError(
                f"the surfaces of the bodies cross at rest, near vertex {vertex}: move the bodies apart, or mend the "
                "mesh."
            )
        pairs.find(rest, torch.zeros_like(rest))
        piece, ends = torch.as_tensor(pairs.surface.pieces, device=rest.device), pairs.nodes
        gaps = pairs.distances(rest)
        close = (gaps < self._contact.distance) & (piece[ends[:, 0]] == piece[ends[:, 3]])
        if bool(close.any()):
            worst = int(torch.where(close, gaps, torch.inf).argmin())
            raise InputError(
                f"contact.distance is {1e3 * self._contact.distance:g} mm, but at rest the surface of a body is "
                f"{1e3 * float(gaps[worst]):.3g} mm from itself, between vertices {int(ends[worst, 0])} and "
                f"{int(ends[worst, 3])}: take less than that."
            )

    @override
    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        state, stage = step.state, step.stage
        place = state.q.detach()
        if step.inputs.fixed_positions is not None:
            place = place.index_copy(1, self._fixed, step.inputs.fixed_positions.detach())
        duration = stage.step if math.isfinite(stage.step) else self.site.time_step
        return {
            "surface_start": state.q,
            "surface_reference": stage.velocity_reference,
            "surface_slip": state.q.new_full((state.batch, 1), self._contact.slip_speed * duration),
            "surface_place": place,
        }


def _surface(points: Points, count: int) -> Surface:
    """Returns the surface with the vertex numbers of a simulator of `count` vertices."""
    assert isinstance(points, SurfacePoints)
    return points.surface.within(int(points.nodes[0, 0] - points.surface.vertices[0]), count)


class SurfaceTerm(Term):
    """Kernels of contact between surfaces."""

    couples_cells = True
    _kernels = kernels

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], contact: SurfaceContact) -> None:
        super().__init__(launcher, sets)
        (s,) = sets
        self._vertices, self._reach = s.n_vertices, contact.distance
        self._list = PairList(launcher, _surface(s.source, s.n_vertices), contact.distance)
        self._moved = torch.as_tensor(s.source.nodes[:, 0], device=launcher.device)
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

    @property
    @override
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        n = self._vertices
        fields = dict.fromkeys(("surface_start", "surface_reference", "surface_place"), (n, 3))
        return {STIFFNESS.name: (1,), FRICTION.name: (1,), "surface_slip": (1,), **fields}

    @override
    def set_step(self, values: Values) -> None:
        start, place = value_of(values, "surface_start"), value_of(values, "surface_place")
        self._bounded, self._grips = False, None
        if not self._list.covers(start):
            count, edge = self._list.crossings(start)
            if bool(count.any()):
                vertex = int(self._list.surface.edges[int(edge[count > 0][0]), 0])
                raise InputError(f"the surfaces of the bodies cross at the start of a step, near vertex {vertex}.")
            self._list.find(start, torch.zeros_like(start))
        if not torch.equal(start, place):
            self._check_way(start, place)
        self._grips = self._grips_at(values)
        self._steps += 1

    def _check_way(self, start: torch.Tensor, place: torch.Tensor) -> None:
        """Raises InputError where fixed vertices pass through a surface in a step."""
        share = self.launcher.zeros() + 1.0
        views = [warp_view(x, wp.vec3d) for x in (start, place)]
        self.launcher.launch(*self._bounding(*views, warp_view(share, wp.float64)))
        if bool((share < 1.0).any()):
            raise InputError(
                "fixed vertices, or an obstacle, move through the gap between surfaces in a step: move them less in a "
                "step."
            )

    def _commands(self, values: Values, positions: Any, active: Any) -> list[Any]:
        """Returns launches of forces and energies at positions."""
        if not self._bounded:  # by `bounds`, whose list holds all pairs up to the next step
            x = wp.to_torch(positions)
            if not self._list.covers(x):
                self._list.find(x, torch.zeros_like(x))
        now = (self._list.version, self._steps)
        if active.ptr not in self._recorded or self._recorded[active.ptr][0] != now:
            self._recorded[active.ptr] = now, self._record(values, positions, active)
        return self._recorded[active.ptr][1]

    def _record(self, values: Values, positions: Any, active: Any) -> list[Any]:
        own, ours = self.launcher, self._list
        if self._sized != ours.version:
            self._size(ours.count)
        stiffness = warp_view(value_of(values, STIFFNESS.name), wp.float64)
        inputs = [active, ours.pairs, stiffness, wp.float64(self._reach), positions]
        pair_out = [warp_view(self._pair_force, kernels.Corners), warp_view(self._pair_energy, wp.float64)]
        sums = [warp_view(self._force, wp.vec3d), warp_view(self._energy, wp.float64)]
        incidence = [warp_view(x, wp.int32) for x in (ours.start, ours.incident)]
        size, near = (own.batch, self.n_points), warp_view(self._near, wp.int32)
        commands = [own.record(kernels.pair_forces, (ours.count,), inputs, [*pair_out, near])] if ours.count else []
        commands.append(own.record(kernels.gather, size, [*incidence, *pair_out, self.n_points, 0], sums))
        if (grips := self._grips) is not None:
            inputs = [active, grips.struct, *self._friction(values), positions]
            commands.append(own.record(kernels.grip_forces, (grips.count,), inputs, grips.outputs))
            inputs = [*grips.incidence, *grips.outputs, self.n_points, 1]
            commands.append(own.record(kernels.gather, size, inputs, sums))
        return commands

    def _friction(self, values: Values) -> list[Any]:
        """Returns coefficient, slip and reference for the kernels of friction."""
        names = ((FRICTION.name, wp.float64), ("surface_slip", wp.float64), ("surface_reference", wp.vec3d))
        return [warp_view(value_of(values, name), kind) for name, kind in names]

    @override
    def before(self, values: Values, positions: Any, active: Any) -> list[Any]:
        return [HostLaunches(lambda: self._commands(values, positions, active))]

    @override
    def _arguments(self, s: PointSet, values: Values, positions: Any) -> list[Any]:
        return [warp_view(self._force, wp.vec3d), warp_view(self._energy, wp.float64)]

    def _chosen(self) -> torch.Tensor:
        """Returns the pairs that were near at the last evaluation."""
        if self._sized != self._list.version or not self._list.count:
            return torch.zeros(0, device=self.launcher.device, dtype=torch.int64)
        return (self._near * self.launcher.active[self._list.environment]).nonzero().ravel()

    @override
    def pair_tangents(self, values: Values, positions: Any, clamp: bool) -> PairTangents | None:
        own, chosen, parts = self.launcher, self._chosen(), list[PairTangents]()
        if len(chosen):
            indices, blocks = chosen.to(torch.int32), self._force.new_zeros(len(chosen), 12, 12)
            stiffness = warp_view(value_of(values, STIFFNESS.name), wp.float64)
            inputs = [warp_view(indices, wp.int32), self._list.pairs, stiffness, wp.float64(self._reach), positions]
            out = [warp_view(blocks, wp.float64)]
            own.launch(own.record(kernels.pair_tangents, (len(chosen),), inputs, out))
            if clamp:
                sizes, axes = torch.linalg.eigh(blocks)
                blocks = (axes * sizes.clamp_min(0.0)[:, None]) @ axes.mT
            parts.append(PairTangents(self._list.environment[chosen], self._list.nodes[chosen], blocks))
        if (grips := self._grips) is not None:
            blocks = self._force.new_zeros(grips.count, 12, 12)
            inputs = [grips.struct, *self._friction(values), positions]
            own.launch(own.record(kernels.grip_tangents, (grips.count,), inputs, [warp_view(blocks, wp.float64)]))
            parts.append(PairTangents(grips.environment, grips.nodes, blocks))
        if not parts:
            return None
        names = ("environment", "nodes", "blocks")
        return PairTangents(*(torch.cat([getattr(part, name) for part in parts]) for name in names))

    @override
    def feasible(self, values: Values) -> tuple[torch.Tensor, torch.Tensor]:
        return value_of(values, "surface_place"), self._moved[:0]

    @override
    def bounds(self, values: Values, origin: Any, positions: Any, share: Any) -> list[Any]:
        return [HostLaunches(lambda: self._bounding(origin, positions, share))]

    def _bounding(self, origin: Any, positions: Any, share: Any) -> list[Any]:
        """Returns the launch that bounds a way, after a search for pairs along it, and limits its length."""
        own, ours, self._bounded = self.launcher, self._list, True
        start, end, part = wp.to_torch(origin), wp.to_torch(positions), wp.to_torch(share)
        start = torch.where(own.active.bool()[:, None, None], start, end)
        ways = (end - start)[:, ours.vertices].norm(dim=-1).amax(1)
        part.copy_(torch.minimum(part, ours.longest_way / ways.clamp_min(1e-300)))
        way = part[:, None, None] * (end - start)
        if not (ours.covers(start) and ours.covers(start + way)):
            ours.find(start, way)
        if not ours.count:
            return []
        inputs = [warp_view(own.active, wp.int32), ours.pairs, origin, positions]
        return [own.record(kernels.bound, (ours.count,), inputs, [share])]

    @override
    def curvature(self, values: Values) -> torch.Tensor:
        return value_of(values, STIFFNESS.name).new_zeros(1, self.n_points)

    def _grips_at(self, values: Values) -> "Grips | None":
        """Returns friction with the loads, normals and nearest points of the start of the step."""
        start = value_of(values, "surface_start")
        lagged = self._lagged(self._near_at(values, start), start, value_of(values, STIFFNESS.name))
        return None if lagged is None else Grips.of(self.launcher, self._list, *lagged)

    def _near_at(self, values: Values, positions: torch.Tensor) -> torch.Tensor:
        """Returns the pairs within reach at positions (B, N, 3), whose forces are then those there."""
        if not self._list.covers(positions):
            self._list.find(positions, torch.zeros_like(positions))
        active = warp_view(self.launcher.active, wp.int32)
        self.launcher.launch(*self._record(values, warp_view(positions, wp.vec3d), active))
        return self._chosen()

    def _lagged(
        self, chosen: torch.Tensor, start: torch.Tensor, stiffness: torch.Tensor
    ) -> tuple[torch.Tensor, ...] | None:
        """Returns environments, vertices, weights, normals and loads of friction, differentiable, or None."""
        if not len(chosen):
            return None
        own, ours = self.launcher, self._list
        indices, features = chosen.to(torch.int32), kernels.Features()
        w, t, s = (self._force.new_zeros(len(chosen), _FEATURES, 4) for _ in range(3))
        coefficient = self._force.new_zeros(len(chosen), _FEATURES)
        features.coefficient = warp_view(coefficient, wp.float64)
        features.w, features.t, features.s = (warp_view(x, wp.vec4d) for x in (w, t, s))
        inputs = [warp_view(indices, wp.int32), ours.pairs, wp.float64(self._reach), warp_view(start, wp.vec3d)]
        own.launch(own.record(kernels.pair_features, (len(chosen), _FEATURES), [*inputs, features], []))
        environment, nodes = ours.environment[chosen], ours.nodes[chosen]
        x = start[environment[:, None], nodes]
        # Weights that do not change at the start, but whose derivatives are those of the nearest points.
        r, e, f = w @ x, t @ x, s @ x
        ee = (e * e).sum(-1) + (t == 0.0).all(-1).double()
        ff, ef = (f * f).sum(-1) + (s == 0.0).all(-1).double(), (e * f).sum(-1)
        whole = torch.maximum(ee * ff - ef * ef, 1e-12 * ee * ff)
        er, fr = (e * r).sum(-1), (f * r).sum(-1)
        first, second = (fr * ef - er * ff) / whole, (er * ef - fr * ee) / whole
        w = w + first[..., None] * t + second[..., None] * s
        r = w @ x
        d = r.norm(dim=-1)
        n, q = r / d[..., None], (d / self._reach).clamp_max(1.0)
        pressure = coefficient * (2.0 * (q - 1.0) * q.log() + (q - 1.0).square() / q)
        cross = torch.linalg.cross(x[:, 1] - x[:, 0], x[:, 3] - x[:, 2]).square().sum(-1)
        share = (cross / ours.parallel[chosen]).clamp_max(1.0)
        factor = torch.where(ours.kind[chosen] == 0, 1.0, (2.0 - share) * share)
        factor = factor * ours.area[chosen] * stiffness[environment, 0]
        load = factor * ((pressure[..., None] * n).sum(1) * n[:, 0]).sum(-1)
        kept = load > 0.0
        return (
            tuple(value[kept] for value in (environment, nodes, w[:, 0], n[:, 0], load)) if bool(kept.any()) else None
        )

    @override
    def adjoint(self, values: Values, positions: torch.Tensor, direction: torch.Tensor) -> Adjoint:
        own = self.launcher
        names = ("surface_start", "surface_reference", STIFFNESS.name, FRICTION.name)

        def differentiate() -> dict[str, torch.Tensor]:
            chosen = self._near_at(values, positions)
            environment, nodes = self._list.environment[chosen], self._list.nodes[chosen]
            work = (self._pair_force[chosen] * direction[environment[:, None], nodes]).sum((1, 2))
            by_stiffness = own.zeros(1).index_add_(0, environment, -work[:, None]) / value_of(values, STIFFNESS.name)
            given = [value_of(values, name).detach().requires_grad_() for name in names]
            with torch.enable_grad():
                loss = self._friction_work(values, positions, direction, *given)
            slopes = [torch.zeros_like(value) for value in given] if loss is None else torch.autograd.grad(loss, given)
            out = dict(zip(names, slopes, strict=True))
            out[STIFFNESS.name] = out[STIFFNESS.name] + by_stiffness
            return out

        return differentiate

    def _friction_work(
        self,
        values: Values,
        positions: torch.Tensor,
        direction: torch.Tensor,
        start: torch.Tensor,
        reference: torch.Tensor,
        stiffness: torch.Tensor,
        friction: torch.Tensor,
    ) -> torch.Tensor | None:
        """Returns -z . g of friction at fixed positions, or None without friction."""
        lagged = self._lagged(self._near_at(values, start.detach()), start, stiffness)
        if lagged is None:
            return None
        environment, nodes, w, n, load = lagged
        row = environment[:, None]
        way = (w[:, :, None] * (positions[row, nodes] - reference[row, nodes])).sum(1)
        u = way - (way * n).sum(-1, keepdim=True) * n
        along = ((w[:, :, None] * direction[row, nodes]).sum(1) * u).sum(-1)
        slip, square = value_of(values, "surface_slip")[environment, 0], u.square().sum(-1)
        y = torch.where(square > 0.0, square.clamp_min(1e-300).sqrt(), 0.0)
        factor = torch.where(y < slip, (2.0 - y / slip) / slip, 1.0 / y.clamp_min(1e-300))
        return -(friction[environment, 0] * load * factor * along).sum()


@dataclass(frozen=True)
class Grips:
    """Friction of pairs in a step.

    Attributes:
        environment: (G,) environments.
        nodes: (G, 4) vertices.
        struct: arrays for the kernels.
        outputs: arrays of gradients and energies.
        incidence: for ``kernels.surfaces.gather``.
        kept: tensors that own the memory.
    """

    environment: torch.Tensor
    nodes: torch.Tensor
    struct: Any
    outputs: list[Any]
    incidence: list[Any]
    kept: tuple[torch.Tensor, ...]

    @property
    def count(self) -> int:
        """Number of pairs G."""
        return len(self.environment)

    @classmethod
    def of(
        cls,
        launcher: Launcher,
        pairs: PairList,
        environment: torch.Tensor,
        nodes: torch.Tensor,
        weights: torch.Tensor,
        normal: torch.Tensor,
        load: torch.Tensor,
    ) -> "Grips":
        """Returns friction of pairs (G, ...) (`kernels.surfaces.Grips`)."""
        struct = kernels.Grips()
        kept = [environment.to(torch.int32), nodes.to(torch.int32), weights.contiguous(), normal.contiguous(), load]
        types = {
            "environment": wp.int32,
            "nodes": wp.vec4i,
            "weights": wp.vec4d,
            "normal": wp.vec3d,
            "load": wp.float64,
        }
        for (name, kind), value in zip(types.items(), kept, strict=True):
            setattr(struct, name, warp_view(value, kind))
        sums = load.new_zeros(len(load), 4, 3), torch.zeros_like(load)
        incidence = pairs.incidence(environment, nodes)
        outputs = [warp_view(sums[0], kernels.Corners), warp_view(sums[1], wp.float64)]
        own = [warp_view(x, wp.int32) for x in incidence]
        return cls(environment, nodes, struct, outputs, own, (*kept, *sums, *incidence))
