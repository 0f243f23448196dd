r"""Tendons (cables) that slide through guides in a body, with or without friction.

A tendon is straight between its guides, so that its length L is the sum of their distances; it ends
at its first and last guide. A commanded tension T has the potential T L. A commanded contraction c
acts through a tension-only spring of stiffness k, relative to the length at rest L_0:

    E = T L + k s(L - L_0 + c),     tension  T + k s'(L - L_0 + c),

with s(e) = max(e, 0)^2 / 2, smoothed over a short distance so that a slack tendon tightens
smoothly. A tendon commanded by tension has k = 0, one commanded by length has T = 0, and a passive
cable has T = 0 and c = 0.

Without friction the tension is the same in all segments of a tendon: its change, k s'' g g^T with
the gradient g of the length, couples all vertices near the tendon. It is a low-rank correction to a
Hessian that stays as sparse as the mesh. With friction (`tendon_forces`) there is such a correction
for every guide.

The routing may be a parameter, too: the guides move in the undeformed body along up to two given
directions, from X to X + o_1 d_1 + o_2 d_2. A guide is at sum_a N_a(X) x_a; the shape functions N_a
are extrapolated linearly from X, so that offsets must be small compared with the cells. L_0 is the
length of the offset tendon.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ...io.arrays import BoolArray, FloatArray
from ...io.errors import InputError, check_type
from ...io.settings import parse
from ...kernels import tendon_segments as kernels
from ..mesh.surface import locate
from ..mesh.volume_mesh import Mesh
from ..stepping.quantity import Parameter, Quantity
from .base import BoundEnergy, Energy, EnergySite
from .launcher import Launcher
from .route import Route
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

    Inputs are ``tendon_tension`` [N] and ``tendon_contraction`` [m]; parameters are
    ``tendon_stiffness`` [N/m], with friction ``tendon_friction`` and ``tendon_bristle_length`` [m],
    and with directions ``tendon_offset_1`` and ``tendon_offset_2`` [m], zero by default; all with
    one value per tendon.

    Raises:
        InputError: no tendon, a route that is none, a value out of range, or different numbers of
            offsets.
    """

    inputs: ClassVar[tuple[Quantity, ...]] = (TENSION, CONTRACTION)
    is_load: ClassVar[bool] = True

    # routes, by name or numbered, or the guides (G, 3) alone, on the undeformed body, in order [m]
    routes: Mapping[str, Route | ArrayLike] | Sequence[Route | ArrayLike]
    # k [N/m], parameter ``tendon_stiffness``: a number, (T,), (B, 1) or (B, T) values; zero for
    # commanded tension
    stiffness: Parameter = 0.0
    toe: float = 1e-4  # elongation at which the spring reaches its full stiffness [m]
    reach: float = 1e-3  # largest distance of a guide from the body [m]
    # coefficient mu in the guides, parameter ``tendon_friction``; None: no friction
    friction: Parameter | None = None
    bristle_length: Parameter = 1e-4  # slide over which friction reverses [m]

    def __post_init__(self) -> None:
        """Checks the values."""
        check_type("Tendons: routes", self.routes, Mapping | Sequence)
        if not len(self.routes):
            raise InputError(
                "there is no tendon: give the guides of each, or leave the tendons out."
            )
        for name, value in (("toe", self.toe), ("reach", self.reach)):
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"the {name} of tendons is {value:g}: it must be positive, in m.")
        STIFFNESS.check(self.stiffness)
        if self.friction is not None:
            FRICTION.check(self.friction)
        elif any(route.entry_angle for route in self.named_routes.values()):
            raise InputError(
                "an entry angle of tendons acts by friction: give their friction, or leave it out."
            )
        BRISTLE.check(self.bristle_length)
        counts = [len(route.offsets) for route in self.named_routes.values()]
        if len({*counts}) > 1:
            raise InputError(
                f"the tendons have {counts} directions of offsets: give each one, or each two."
            )

    @cached_property
    def named_routes(self) -> dict[str, Route]:
        """Routes by name."""
        routes: Mapping[str, Any] = (
            self.routes
            if isinstance(self.routes, Mapping)
            else {f"tendon_{number}": route for number, route in enumerate(self.routes, 1)}
        )
        return {
            name: route
            if isinstance(route, Route)
            else parse(Route, {"guides": np.asarray(route, dtype=np.float64).tolist()}, name)
            for name, route in routes.items()
        }

    @cached_property
    def _lines(self) -> list[tuple[FloatArray, BoolArray, list[FloatArray]]]:
        """Guides of each tendon, which of them stay in the world, and offset directions.

        See `divided`.
        """
        return [divided(route) for route in self.named_routes.values()]

    @override
    def moved(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> "Tendons":
        def turned(route: Route) -> Route:
            offsets = [(np.asarray(way) @ rotation.T).tolist() for way in route.offsets]
            return route.changed(
                guides=np.asarray(route.guides) @ rotation.T + translation, offsets=offsets
            )

        return replace(
            self, routes={name: turned(route) for name, route in self.named_routes.items()}
        )

    def rerouted(self, offsets: ArrayLike) -> "Tendons":
        """Returns tendons with the guides moved by offsets, and without offset parameters.

        Args:
            offsets: (T, D) offsets of the T tendons along their D directions [m].
        """

        def shifted(route: Route, amounts: FloatArray) -> Route:
            steps = [o * np.asarray(way) for o, way in zip(amounts, route.offsets, strict=True)]
            return route.changed(guides=np.asarray(route.guides) + sum(steps), offsets=())

        pairs = zip(self.named_routes.items(), np.asarray(offsets, dtype=np.float64), strict=True)
        return replace(
            self, routes={name: shifted(route, amounts) for (name, route), amounts in pairs}
        )

    @property
    def offset_count(self) -> int:
        """Number of offset directions per tendon."""
        return len(next(iter(self.named_routes.values())).offsets)

    @property
    @override
    def parameters(self) -> tuple[Quantity, ...]:
        friction = () if self.friction is None else (FRICTION, BRISTLE)
        return (STIFFNESS, *friction, *OFFSETS[: self.offset_count])

    @property
    def guides(self) -> list[NDArray[np.float64]]:
        """Guides (G, 3) of each tendon [m]."""
        return [guides for guides, _, _ in self._lines]

    @property
    @override
    def count(self) -> int:
        return len(self.routes)

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return tuple(self.named_routes)

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
        offsets = [
            values.pop(offset.name) / kernels.OFFSET_UNIT for offset in OFFSETS[: self.offset_count]
        ]
        parts = [one, *offsets, *(torch.zeros_like(one),) * (len(OFFSETS) - len(offsets))]
        return values | {ROUTE: torch.stack(torch.broadcast_tensors(*parts), -1)}

    @override
    def bind(self, site: EnergySite) -> BoundEnergy:
        entry = [route.entry_angle for route in self.named_routes.values()]
        return (
            super().bind(site)
            if self.friction is None
            else BoundTendons(self, site, self.toe, entry)
        )

    @override
    def points(self, mesh: Mesh) -> tuple[TendonPoints, ...]:
        """Returns the segments between guides, each attached to the cells that contain its ends.

        Raises:
            InputError: a guide outside of the body.
        """
        nodes, operators = [], []
        tendon = []
        rest, anchors = [], []
        for number, (route, in_world, directions) in enumerate(self._lines):
            # Those in the world have no place.
            places = locate(mesh, np.where(in_world[:, None], route[~in_world][:1], route))
            worst = int(np.argmax(places.outside))
            if places.outside[worst] > self.reach:
                raise InputError(
                    f"guide {worst + 1} of tendon {number + 1}, at {route[worst].tolist()} m, "
                    f"lies {1e3 * places.distance[worst]:.3g} mm outside of the body: move it, "
                    f"raise the reach of {1e3 * self.reach:g} mm, or name it among the fixed "
                    "guides if it stays in the world."
                )
            # (G, K, 3): position, and its derivatives by the offsets
            weights = np.zeros((*places.weights.shape, 3))
            shape = np.zeros((len(route), 3, 3))
            weights[..., 0], shape[..., 0] = places.weights, route
            for k, direction in enumerate(directions):
                step = kernels.OFFSET_UNIT * direction
                weights[..., 1 + k] = np.einsum("gki,gi->gk", places.gradients, step)
                shape[..., 1 + k] = step
            weights[in_world] = 0.0
            for first in range(len(route) - 1):
                tendon_nodes, tendon_operators = _difference(
                    mesh, places.cells[first : first + 2], weights[first : first + 2]
                )
                nodes.append(tendon_nodes)
                operators.append(tendon_operators)
            tendon += [number] * (len(route) - 1)
            rest.append(np.diff(shape, axis=0))
            anchors.append(np.diff(np.where(in_world[:, None, None], shape, 0.0), axis=0))
        most = max(map(len, nodes))
        # Lists are padded with their first vertex and a zero operator.
        padded = np.array(
            [
                np.pad(vertices, (0, most - len(vertices)), constant_values=vertices[0])
                for vertices in nodes
            ]
        )
        operator = np.zeros((len(nodes), 1, most, 3))
        for row, vertices in enumerate(operators):
            operator[row, 0, : len(vertices)] = vertices
        lines = (np.concatenate(rest), np.concatenate(anchors), self.offset_count)
        return (TendonPoints(padded, operator, np.array(tendon), np.ones(len(tendon)), *lines),)

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "TendonTerm":
        return TendonTerm(launcher, sets, self.count, self.toe, self.friction is not None)


def divided(route: Route) -> tuple[FloatArray, BoolArray, list[FloatArray]]:
    """Divides the straight parts of a route in the body into its pieces.

    Returns:
        Guides (G, 3) [m], whether they stay in the world (G,), and D directions of offsets (G, 3).
    """
    guides = np.asarray(route.guides, dtype=np.float64)
    fixed = np.isin(np.arange(len(guides)), route.fixed_guides)
    pieces = np.where(fixed[1:] | fixed[:-1], 1, route.pieces)
    in_world = np.zeros(pieces.sum() + 1, dtype=bool)
    in_world[np.concatenate([[0], np.cumsum(pieces)])[fixed]] = True

    def between(values: FloatArray) -> FloatArray:
        parts = [
            np.linspace(*ends, number, endpoint=False)
            for ends, number in zip(pairwise(values), pieces, strict=True)
        ]
        return np.concatenate([*parts, values[-1:]])

    ways = [
        np.broadcast_to(np.asarray(offset, dtype=np.float64), guides.shape)
        for offset in route.offsets
    ]
    return between(guides), in_world, [between(way) for way in ways]


def _difference(
    mesh: Mesh, cells: NDArray[np.int64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Returns vertices (K',), without duplicates, and operators (K', 3)
    of the vector between two guides.
    """
    vertices, inverse = np.unique(mesh.cells[cells].ravel(), return_inverse=True)
    sums = np.zeros((len(vertices), 3))
    np.add.at(sums, inverse, np.concatenate([-weights[0], weights[1]]))
    used = np.abs(sums).max(axis=1) > 1e-14
    used[0] |= not used.any()  # both guides are fixed in the world
    return vertices[used], sums[used]
