r"""Tendons (cables) that slide through guides in a body, with or without friction.

A tendon is straight between its guides, so that its length L is the sum of their distances; it ends at its first and
last guide. A commanded tension T has the potential T L. A commanded contraction c acts through a tension-only spring of
stiffness k, relative to the length at rest L_0:

    E = T L + k s(L - L_0 + c),     tension  T + k s'(L - L_0 + c),

with s(e) = max(e, 0)^2 / 2, smoothed over a short distance so that a slack tendon tightens smoothly. A tendon commanded
by tension has k = 0, one commanded by length has T = 0, and a passive cable has T = 0 and c = 0.

Without friction the tension is the same in all segments of a tendon: its change, k s'' g g^T with the gradient g of the
length, couples all vertices near the tendon. It is a low-rank correction to a Hessian that stays as sparse as the mesh.
With friction (`tendon_forces`) there is such a correction for every guide.

The routing may be a parameter, too: the guides move in the undeformed body along up to two given directions, from X to
X + o_1 d_1 + o_2 d_2. A guide is at sum_a N_a(X) x_a; the shape functions N_a are extrapolated linearly from X, so that
offsets must be small compared with the cells. L_0 is the length of the offset tendon.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ..io.errors import InputError
from ..kernels import tendon_segments as kernels
from ..mesh.surface import locate
from ..mesh.volume_mesh import Mesh
from ..stepping.quantity import Parameter, Quantity
from .base import BoundEnergy, Energy, EnergySite
from .launcher import Launcher
from .tendon_forces import (
    BRISTLE,
    CONTRACTION,
    FRICTION,
    OFFSETS,
    ROUTE,
    STIFFNESS,
    TENSION,
    BoundTendons,
    TendonPoints,
    TendonTerm,
)
from .term import PointSet


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
            raise InputError(f"fixed guides are way for {len(self.fixed_guides)} of {self.count} tendons: give all.")
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
            raise InputError(f"tendons are called {', '.join(self.names)}: give each a name of its ways.")
        if not len(self.directions):
            return
        if len(self.directions) != self.count:
            raise InputError(f"{len(self.directions)} tendons have directions of offsets, but there are {self.count}.")
        counts = [len(ways) for ways in self.directions]
        if set(counts) not in ({1}, {2}):
            raise InputError(f"the tendons have {counts} directions of offsets: give each one, or each two.")
        for number, (route, ways) in enumerate(zip(self.guides, self.directions, strict=True), 1):
            for way in ways:
                try:
                    direction = np.asarray(way, dtype=np.float64)
                except (TypeError, ValueError):
                    raise InputError(f"tendon {number} has a direction that is not an array: {way!r}.") from None
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
            route + sum(o * np.asarray(d, dtype=np.float64) for o, d in zip(amounts, directions, strict=True))
            for route, amounts, directions in zip(self.guides, all_offsets, self.directions, strict=True)
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
    def defaults(self) -> Mapping[str, Parameter]:
        values: dict[str, Parameter] = {"tendon_stiffness": self.stiffness}
        if self.friction is not None:
            values |= {FRICTION.name: self.friction, BRISTLE.name: self.bristle_length}
        return values | {offset.name: 0.0 for offset in OFFSETS[: self.offset_count]}

    @override
    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Implements `Energy.prepare`, with the offsets as ``tendon_route`` (1 or B, T, 3)."""
        values = super().prepare(parameters)
        one = torch.ones_like(values[STIFFNESS.name])
        offsets = [values.pop(offset.name) / kernels.OFFSET_UNIT for offset in OFFSETS[: self.offset_count]]
        parts = [one, *offsets, *(torch.zeros_like(one),) * (len(OFFSETS) - len(offsets))]
        return values | {ROUTE: torch.stack(torch.broadcast_tensors(*parts), -1)}

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
            in_world = np.isin(np.arange(len(route)), self.fixed_guides[number] if len(self.fixed_guides) else ())
            places = locate(
                mesh, np.where(in_world[:, None], route[~in_world][:1], route)
            )  # those in the world have no place
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
            weights[in_world] = 0.0
            for first in range(len(route) - 1):
                own_nodes, own_operators = _difference(
                    mesh, places.cells[first : first + 2], weights[first : first + 2]
                )
                nodes.append(own_nodes)
                operators.append(own_operators)
            tendon += [number] * (len(route) - 1)
            rest.append(np.diff(shape, axis=0))
            anchors.append(np.diff(np.where(in_world[:, None, None], shape, 0.0), axis=0))
        most = max(map(len, nodes))
        # Lists are padded with their first vertex and a zero operator.
        padded = np.array(
            [np.pad(vertices, (0, most - len(vertices)), constant_values=vertices[0]) for vertices in nodes]
        )
        operator = np.zeros((len(nodes), 1, most, 3))
        for row, vertices in enumerate(operators):
            operator[row, 0, : len(vertices)] = vertices
        lines = (np.concatenate(rest), np.concatenate(anchors), self.offset_count)
        return (TendonPoints(padded, operator, np.array(tendon), np.ones(len(tendon)), *lines),)

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "TendonTerm":
        return TendonTerm(launcher, sets, self.count, self.toe, self.friction is not None)


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
