r"""Tendons (cables) that slide through guides in a body, with or without friction.

A tendon is straight between its guides, so that its length L is the sum of their distances; it ends at its first and
last guide. A commanded tension T has the potential T L. A commanded contraction c acts through a tension-only spring of
stiffness k, relative to the length at rest L_0:

    E = T L + k s(L - L_0 + c),     tension  T + k s'(L - L_0 + c),

with s(e) = max(e, 0)^2 / 2, smoothed over a short distance so that a slack tendon tightens smoothly. A tendon commanded
by tension has k = 0, one commanded by length has T = 0, and a passive cable has T = 0 and c = 0.

Without friction the tension is the same in all segments of a tendon: its change, k s'' g g^T with the gradient g of the
length, couples all vertices near the tendon. It is a low-rank correction to a Hessian that stays as sparse as the mesh.
With friction (`tendon_friction`) there is such a correction for every guide.

The routing may be a parameter, too: the guides move in the undeformed body along up to two given directions, from X to
X + o_1 d_1 + o_2 d_2. A guide is at sum_a N_a(X) x_a; the shape functions N_a are extrapolated linearly from X, so that
offsets must be small compared with the cells. L_0 is the length of the offset tendon.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ..io.errors import InputError
from ..kernels import tendon_segments as kernels
from ..mesh.mesh import Mesh
from ..mesh.surface import locate
from ..stepping.quantity import Parameter, Quantity
from .base import Adjoint, BoundEnergy, Energy, EnergySite, PointSet, Values, value_of
from .launcher import Launcher, warp_view
from .pointwise import PartTerm
from .tendon_friction import (
    BRISTLE,
    CONTRACTION,
    FRICTION,
    OFFSETS,
    STEP_VALUES,
    STIFFNESS,
    TENSION,
    BoundTendons,
    TendonPoints,
    beyond,
    friction_after,
)


@dataclass(frozen=True)
class Tendons(Energy):
    """Tendons (energy in the module's docstring).

    Inputs are ``tendon_tension`` [N] and ``tendon_contraction`` [m]; parameters are ``tendon_stiffness`` [N/m], with
    friction ``tendon_friction`` and ``tendon_bristle_length`` [m], and with directions ``tendon_offset_1`` and
    ``tendon_offset_2`` [m], zero by default; all with one value per tendon.

    Raises:
        InputError: no tendon, one with fewer than two guides, guides that are not finite, a negative stiffness,
            friction or angle, or directions of offsets that do not fit the guides.
    """

    inputs: ClassVar[tuple[Quantity, ...]] = (TENSION, CONTRACTION)
    is_load: ClassVar[bool] = True

    routes: Sequence[ArrayLike]  # (G, 3) guides of each tendon on the undeformed body, in order [m]
    # k [N/m], parameter ``tendon_stiffness``: a number, (T,), (B, 1) or (B, T) values; zero for commanded tension
    stiffness: Parameter = 0.0
    toe: float = 1e-4  # elongation at which the spring reaches its full stiffness [m]
    reach: float = 1e-3  # largest distance of a guide from the body [m]
    labels: Sequence[str] = ()  # names of the tendons; numbered if empty
    # offset directions of each tendon, one or two for all tendons: (3,) for all guides of a tendon, or (G, 3) one per
    # guide; displacement of the guide per metre of offset
    directions: Sequence[Sequence[ArrayLike]] = ()
    fixed_guides: Sequence[Sequence[int]] = ()  # numbers of the guides of each tendon, from 0, that stay in the world
    friction: Parameter | None = None  # coefficient mu in the guides, parameter ``tendon_friction``; None: no friction
    bristle_length: Parameter = 1e-4  # slide over which friction reverses [m]
    entry_angle: ArrayLike = 0.0  # of contact before the first guide, such as around pulleys: one, or (T,) [rad]

    @override
    def moved(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> "Tendons":
        directions = [[np.asarray(way) @ rotation.T for way in ways] for ways in self.directions]
        return replace(self, routes=[route @ rotation.T + translation for route in self.guides], directions=directions)

    def __post_init__(self) -> None:
        """Checks the values."""
        if not len(self.routes):
            raise InputError("there is no tendon: give the guides of each, or leave the tendons out.")
        for number, route in enumerate(self.guides, 1):
            if route.ndim != 2 or route.shape[1] != 3 or len(route) < 2:
                raise InputError(f"tendon {number} has guides of shape {route.shape}: it needs two or more places.")
            if not np.isfinite(route).all():
                raise InputError(f"tendon {number} has a guide that is not finite.")
            if (np.linalg.norm(np.diff(route, axis=0), axis=1) == 0.0).any():
                raise InputError(f"tendon {number} has two guides in a row at one place: leave one of them out.")
        for name, value in (("toe", self.toe), ("reach", self.reach)):
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"the {name} of tendons is {value:g}: it must be positive, in m.")
        if self.labels and len(self.labels) != len(self.routes):
            raise InputError(f"there are {len(self.labels)} names for {len(self.routes)} tendons.")
        STIFFNESS.check(self.stiffness)
        if self.friction is not None:
            FRICTION.check(self.friction)
        elif np.any(self.entry_angle):
            raise InputError("an entry angle of tendons acts by friction: give their friction, or leave it out.")
        BRISTLE.check(self.bristle_length)
        if len(self.fixed_guides) not in (0, self.count):
            raise InputError(f"fixed guides are given for {len(self.fixed_guides)} of {self.count} tendons: give all.")
        for number, (route, fixed) in enumerate(zip(self.guides, self.fixed_guides, strict=False), 1):
            if not set(fixed) <= set(range(len(route))):
                most = len(route) - 1
                raise InputError(f"fixed guides of tendon {number} are {list(fixed)}: it has guides 0 to {most}.")
            if len(set(fixed)) == len(route):
                raise InputError(f"all guides of tendon {number} are fixed in the world: it does not pull on the body.")
        angles = np.asarray(self.entry_angle, dtype=np.float64)
        if angles.shape not in ((), (self.count,)) or not (np.isfinite(angles) & (angles >= 0.0)).all():
            raise InputError(
                f"the entry angle of tendons is {self.entry_angle}: give one angle, or {self.count}, of zero or more, "
                "in rad."
            )
        if len(set(self.names)) != self.count:
            raise InputError(f"tendons are called {', '.join(self.names)}: give each a name of its own.")
        if not len(self.directions):
            return
        if len(self.directions) != self.count:
            raise InputError(f"{len(self.directions)} tendons have directions of offsets, but there are {self.count}.")
        counts = [len(own) for own in self.directions]
        if set(counts) not in ({1}, {2}):
            raise InputError(f"the tendons have {counts} directions of offsets: give each one, or each two.")
        for number, (route, own) in enumerate(zip(self.guides, self.directions, strict=True), 1):
            for given in own:
                try:
                    direction = np.asarray(given, dtype=np.float64)
                except (TypeError, ValueError):
                    raise InputError(f"tendon {number} has a direction that is not an array: {given!r}.") from None
                if direction.shape not in ((3,), route.shape):
                    raise InputError(
                        f"tendon {number} has a direction of offsets of shape {direction.shape}: give three numbers, "
                        f"or three for each of its {len(route)} guides."
                    )
                if not np.isfinite(direction).all() or not direction.any():
                    raise InputError(f"tendon {number} has a direction of offsets that is zero or not finite.")

    def rerouted(self, offsets: ArrayLike) -> "Tendons":
        """Returns tendons with the guides moved by offsets, and without offset parameters.

        Args:
            offsets: (T, D) offsets of the T tendons along their D directions [m].
        """
        all_offsets = np.asarray(offsets, dtype=np.float64)
        routes = [
            route + sum(o * np.asarray(d, dtype=np.float64) for o, d in zip(own, directions, strict=True))
            for route, own, directions in zip(self.guides, all_offsets, self.directions, strict=True)
        ]
        return replace(self, routes=routes, directions=())

    @property
    def offset_count(self) -> int:
        """Number of offset directions per tendon."""
        return len(self.directions[0]) if len(self.directions) else 0

    @property
    @override
    def parameters(self) -> tuple[Quantity, ...]:
        friction = () if self.friction is None else (FRICTION, BRISTLE)
        return (STIFFNESS, *friction, *OFFSETS[: self.offset_count])

    @property
    def guides(self) -> list[NDArray[np.float64]]:
        """Guides (G, 3) of each tendon [m]."""
        return [np.asarray(route, dtype=np.float64) for route in self.routes]

    @property
    @override
    def count(self) -> int:
        return len(self.routes)

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return tuple(self.labels) or tuple(f"tendon_{number + 1}" for number in range(self.count))

    @property
    @override
    def constants(self) -> Mapping[str, Parameter]:
        values: dict[str, Parameter] = {"tendon_stiffness": self.stiffness}
        if self.friction is not None:
            values |= {FRICTION.name: self.friction, BRISTLE.name: self.bristle_length}
        return values | {offset.name: 0.0 for offset in OFFSETS[: self.offset_count]}

    @override
    def prepare(self, constants: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Implements `Energy.prepare`; offsets without a direction are zero."""
        values = super().prepare(constants)
        zero = torch.zeros_like(values["tendon_stiffness"])
        return values | {offset.name: zero for offset in OFFSETS[self.offset_count :]}

    @override
    def bind(self, site: EnergySite) -> BoundEnergy:
        return super().bind(site) if self.friction is None else BoundTendons(self, site, self.toe, self.entry_angle)

    @override
    def points(self, mesh: Mesh) -> tuple[TendonPoints, ...]:
        """Returns the segments between guides, each attached to the cells that contain its ends.

        Raises:
            InputError: a guide outside of the body.
        """
        nodes, operators, tendon, rest, anchors = [], [], [], [], []
        for number, route in enumerate(self.guides):
            held = np.isin(np.arange(len(route)), self.fixed_guides[number] if len(self.fixed_guides) else ())
            places = locate(mesh, np.where(held[:, None], route[~held][:1], route))  # those in the world have no place
            worst = int(np.argmax(places.outside))
            if places.outside[worst] > self.reach:
                raise InputError(
                    f"guide {worst + 1} of tendon {number + 1}, at {route[worst].tolist()} m, lies "
                    f"{1e3 * places.distance[worst]:.3g} mm outside of the body: move it, raise the reach of "
                    f"{1e3 * self.reach:g} mm, or name it among the fixed guides if it stays in the world."
                )
            weights = np.zeros((*places.weights.shape, 3))  # (G, K, 3): position, and its derivatives by the offsets
            shape = np.zeros((len(route), 3, 3))
            weights[..., 0], shape[..., 0] = places.weights, route
            for k in range(self.offset_count):
                step = kernels.OFFSET_UNIT * np.broadcast_to(self.directions[number][k], route.shape)
                weights[..., 1 + k] = np.einsum("gki,gi->gk", places.gradients, step)
                shape[..., 1 + k] = step
            weights[held] = 0.0
            for first in range(len(route) - 1):
                own_nodes, own_operators = _difference(
                    mesh, places.cells[first : first + 2], weights[first : first + 2]
                )
                nodes.append(own_nodes)
                operators.append(own_operators)
            tendon += [number] * (len(route) - 1)
            rest.append(np.diff(shape, axis=0))
            anchors.append(np.diff(np.where(held[:, None, None], shape, 0.0), axis=0))
        most = max(map(len, nodes))
        # Lists are padded with their first vertex and a zero operator.
        padded = np.array([np.pad(own, (0, most - len(own)), constant_values=own[0]) for own in nodes])
        operator = np.zeros((len(nodes), 1, most, 3))
        for row, own in enumerate(operators):
            operator[row, 0, : len(own)] = own
        lines = (np.concatenate(rest), np.concatenate(anchors))
        return (TendonPoints(padded, operator, np.array(tendon), np.ones(len(tendon)), *lines),)

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "TendonTerm":
        return TendonTerm(launcher, sets, self)


def _difference(
    mesh: Mesh, cells: NDArray[np.int64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Returns vertices (K',), without duplicates, and operators (K', 3) of the vector between two guides."""
    vertices, inverse = np.unique(mesh.cells[cells].ravel(), return_inverse=True)
    sums = np.zeros((len(vertices), 3))
    np.add.at(sums, inverse, np.concatenate([-weights[0], weights[1]]))
    used = np.abs(sums).max(axis=1) > 1e-14
    used[0] |= not used.any()  # both guides are fixed in the world
    return vertices[used], sums[used]


class TendonTerm(PartTerm):
    """Kernels of tendons, on the set of their segments."""

    couples_cells = True
    _kernels = kernels

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], tendons: Tendons) -> None:
        (s,) = sets
        assert isinstance(s.source, TendonPoints)
        numbers = s.source.part
        names = ("tendon_tension", "tendon_contraction", "tendon_stiffness", *(offset.name for offset in OFFSETS))
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(names, (tendons.count,))
        self._rubs = tendons.friction is not None
        if self._rubs:
            shapes |= {BRISTLE.name: (tendons.count,), **dict.fromkeys(STEP_VALUES, (s.n_points,))}
        super().__init__(launcher, sets, shapes, tendons.count)
        self._beyond = torch.as_tensor(beyond(numbers), device=launcher.device)
        self._toe = wp.float64(tendons.toe)
        self._first = launcher.upload(np.searchsorted(numbers, np.arange(tendons.count + 1)).astype(np.int32), int)
        self._rest = launcher.upload(s.source.rest, wp.mat33d)
        self._anchors = launcher.upload(s.source.anchors, wp.mat33d)
        self._along, self._tension = launcher.zeros(tendons.count, 3), launcher.zeros(s.n_points)
        self._spring, self._friction = launcher.zeros(tendons.count, 3), launcher.zeros(s.n_points, 3)
        self._direction = launcher.zeros(s.n_points, 3, 3)
        self._directions: Any = None  # the launch that fills it, made at its first use
        self._segment_length = torch.as_tensor(np.linalg.norm(s.source.rest[..., 0], axis=1), device=launcher.device)
        columns = 1 + tendons.offset_count
        operator = np.zeros((s.n_points, s.n_vertices, columns))
        rows = np.arange(s.n_points)[:, None]
        np.add.at(operator, (rows, s.source.nodes), s.source.gradients[:, 0, :, :columns])
        self._operator = torch.as_tensor(np.moveaxis(operator, -1, 0).copy(), device=launcher.device)  # (.., P, N)

    @property
    def _pull(self) -> tuple[Any, Any]:
        """Outputs of `before`: c of each tendon and the tension of each segment."""
        return warp_view(self._along, wp.vec3d), warp_view(self._tension, wp.float64)

    @override
    def before(self, values: Values, positions: Any, active: Any) -> list[Any]:
        (s,) = self.sets
        tension, contraction, stiffness, first, second, *rubbing = self.views(values)
        if self._rubs:
            bristles, *friction = rubbing
        else:
            zeros, ones = self.launcher.zeros(s.n_points), self.launcher.zeros(self.count) + 1.0
            bristles, *friction = (warp_view(own, wp.float64) for own in (ones, *(zeros,) * 4))
        runs = [s.points, self._anchors, self._first, self._rest, first, second]
        inputs = [active, *runs, tension, contraction, stiffness, self._toe, *friction, bristles, positions]
        outputs = [*self._pull, warp_view(self._spring, wp.vec3d), warp_view(self._friction, wp.vec3d)]
        return [self.launcher.record(kernels.pull, (self.launcher.batch, self.count), inputs, outputs)]

    @override
    def _arguments(self, s: PointSet, values: Values, positions: Any) -> list[Any]:
        tension, _, stiffness, *_ = self.views(values)
        runs = [s.points, self._anchors, self._first, self.part]
        forces = [warp_view(own, wp.vec3d) for own in (self._spring, self._friction)]
        return [*runs, tension, stiffness, *self._pull, *forces, positions]

    @override
    def tangent(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        return kernels.tangent, [s.points, self._anchors, self.part, *self._pull, positions]

    @override
    def low_rank(self, values: Values, positions: Any) -> torch.Tensor | None:
        stiffness, slopes = value_of(values, "tendon_stiffness"), self._friction[..., 2]
        sprung, rubs = bool((stiffness > 0.0).any()), self._rubs and bool((slopes > 0.0).any())
        if not (sprung or rubs):
            return None
        own, (s,) = self.launcher, self.sets
        if self._directions is None:
            inputs = [s.points, self._anchors, self.part, self._pull[0], positions]
            out = [warp_view(self._direction, wp.mat33d)]
            self._directions = own.record(kernels.directions, (own.batch, s.n_points), inputs, out)
        own.launch(self._directions)
        columns = self._direction.movedim(-1, 1)[:, : len(self._operator)]  # (B, .., P, 3)
        weights = []  # (B, P, r) of the segments' lengths in the columns
        if sprung:
            weights.append(self._one_hot * (stiffness * self._spring[..., 2]).sqrt()[:, None])
        if rubs:
            weights.append(self._beyond * slopes.sqrt()[:, None])
        by_column = columns[..., None] * torch.cat(weights, -1)[:, None, :, None]  # (B, .., P, 3, r)
        gradient = (self._operator.mT @ by_column.flatten(3)).sum(1)  # (B, N, 3 r)
        return gradient.unflatten(2, (3, -1)).flatten(1, 2)

    @override
    def curvature(self, values: Values) -> torch.Tensor:
        tension, stiffness = value_of(values, "tendon_tension"), value_of(values, "tendon_stiffness")
        # |F c|^2 <= |c|^2 |F|^2, and the square of a sum of n lengths is at most n times the sum of their squares.
        columns = 1.0 + sum((value_of(values, o.name) / kernels.OFFSET_UNIT).square() for o in OFFSETS)
        stretching = (tension * columns)[:, self.part_of] / self._segment_length
        if self._rubs:  # A guide's slope is at most the sum of its bounds over the bristle length.
            _, drop, rise, _ = (value_of(values, name) for name in STEP_VALUES)
            slopes = (drop + rise) / value_of(values, BRISTLE.name)[:, self.part_of] * self._beyond.sum(0)
            stretching = stretching + columns[:, self.part_of] * (slopes @ self._beyond.mT)
        return stretching + (stiffness * columns * self._one_hot.sum(0))[:, self.part_of]

    @override
    def adjoint(self, values: Values, positions: torch.Tensor, direction: torch.Tensor) -> Adjoint:
        own, (s,) = self.launcher, self.sets
        views = [warp_view(field, wp.vec3d) for field in (positions, direction)]
        shorter = own.zeros(s.n_points)
        by_offset, longer, at_rest = (own.zeros(s.n_points, 2) for _ in range(3))
        inputs = [s.points, self._anchors, self.part, self._rest, *self._pull, *views]
        outputs = [warp_view(shorter, wp.float64), *(warp_view(x, wp.vec2d) for x in (by_offset, longer, at_rest))]
        launches = [
            *self.before(values, views[0], warp_view(own.active, wp.int32)),
            own.record(kernels.adjoint, (own.batch, s.n_points), inputs, outputs),
        ]

        def differentiate() -> dict[str, torch.Tensor]:
            own.launch(*launches)
            stiffness = value_of(values, "tendon_stiffness")
            by_tension = self.sum_parts(shorter)
            by_contraction = stiffness * self._spring[..., 2] * by_tension
            by_stiffness = self._spring[..., 1] * by_tension
            by_offsets = [
                self.sum_parts(held) + by_contraction * self.sum_parts(taut)
                for held, taut in zip(by_offset.unbind(-1), (longer - at_rest).unbind(-1), strict=True)
            ]
            if not self._rubs:
                return dict(zip(self.shapes, (by_tension, by_contraction, by_stiffness, *by_offsets), strict=True))
            past = shorter @ self._beyond  # (B, P) of the tendon beyond each guide
            by_length = -self._friction[..., 2] * past
            by_offsets = [
                total - self.sum_parts((by_length @ self._beyond.mT) * taut)
                for total, taut in zip(by_offsets, longer.unbind(-1), strict=True)
            ]
            by_friction = self._friction_slopes(values, past)
            slopes = (by_tension, by_contraction, by_stiffness, *by_offsets, *by_friction, by_length)
            return dict(zip(self.shapes, slopes, strict=True))

        return differentiate

    def _friction_slopes(self, values: Values, past: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Returns the derivatives by bristle length, hold, drop and rise; ``past`` (B, P) is -z . d length beyond."""
        length, hold, drop, rise, _ = (value_of(values, name) for name in (BRISTLE.name, *STEP_VALUES))
        with torch.enable_grad():
            length, hold, drop, rise = leaves = [x.detach().requires_grad_() for x in (length, hold, drop, rise)]
            slide = self._friction[..., 1].clone()
            friction = friction_after(slide, hold, drop, rise, length[:, self.part_of])
            return torch.autograd.grad(friction, leaves, past)
