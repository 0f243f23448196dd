r"""Tendons (cables) that slide without friction through guides in a body.

A tendon is taut between its guides, so that its length L is the sum of their distances; its ends are its first and its
last guide. A commanded tension T has the potential T L. A commanded contraction c acts through a spring that only
pulls, of stiffness k, on what is left of the length at rest L_0:

    E = T L + k s(L - L_0 + c),     tension  T + k s'(L - L_0 + c),

s being half the square of what is positive, rounded over a short distance so that a slack tendon tightens smoothly. So
a tendon commanded by tension has k = 0, one commanded by length has T = 0, and a passive cable has neither.

The tension is one number for all pieces of a tendon: its change, k s'' g g^T with the gradient g of the length, couples
every vertex near it with every other. That is a correction of low rank to a Hessian that stays as sparse as the mesh.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ..fem.elements import Points
from ..io.errors import InputError
from ..kernels import tendons as kernels
from ..mesh.location import locate
from ..mesh.mesh import Mesh
from .base import Energy, Parameter, PointSet, Quantity, Values, ValueTerm
from .launcher import Launcher, warp_view


@dataclass(frozen=True)
class TendonPoints(Points):
    """The pieces of tendons between their guides, tendon after tendon."""

    tendon: NDArray[np.int64]  # (P,) number of its tendon
    length: NDArray[np.float64]  # (P,) at rest [m]


TENSION = Quantity("tendon_tension", "N", 0.0, closed=True, per="tendon", words="tension", shown_unit="N")
CONTRACTION = Quantity(
    *("tendon_contraction", "m"), per="tendon", typical=1e-3, words="contraction", shown_unit="mm", shown_factor=1e3
)


@dataclass(frozen=True)
class Tendons(Energy):
    """T L, or a spring on the length, of every tendon.

    Its inputs are ``tendon_tension`` [N] and ``tendon_contraction`` [m], its parameter ``tendon_stiffness`` [N/m]; each
    has a value for every tendon.

    Raises:
        InputError: no tendon, one with fewer than two guides, guides that are not finite, or a negative stiffness.
    """

    parameters: ClassVar[tuple[Quantity, ...]] = (Quantity("tendon_stiffness", "N/m", 0.0, closed=True, per="tendon"),)
    inputs: ClassVar[tuple[Quantity, ...]] = (TENSION, CONTRACTION)
    is_load: ClassVar[bool] = True
    implicit_only: ClassVar[bool] = True

    routes: Sequence[ArrayLike]  # (G, 3) places of each tendon's guides on the undeformed body, in their order [m]
    # k [N/m], the parameter ``tendon_stiffness``: a number, (T,) values with one for each tendon, (B, 1), or (B, T);
    # zero for tendons whose tension is commanded
    stiffness: Parameter = 0.0
    toe: float = 1e-4  # by which a tendon is longer than its winch leaves it when it is fully taut [m]
    reach: float = 1e-3  # how far outside of the body a guide may lie [m]
    labels: Sequence[str] = ()  # of the tendons; numbers where left out

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
        self.parameters[0].check(self.stiffness)

    @property
    def guides(self) -> list[NDArray[np.float64]]:
        """(G, 3) of each tendon [m]."""
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
        return {"tendon_stiffness": self.stiffness}

    @override
    def points(self, mesh: Mesh) -> tuple[TendonPoints, ...]:
        """The pieces between guides, each bound to the cells that its ends lie in.

        Raises:
            InputError: a guide outside of the body.
        """
        nodes, weights, tendon, length = [], [], [], []
        for number, route in enumerate(self.guides):
            found = locate(mesh, route)
            worst = int(np.argmax(found.outside))
            if found.outside[worst] > self.reach:
                raise InputError(
                    f"guide {worst + 1} of tendon {number + 1}, at {route[worst].tolist()} m, lies "
                    f"{1e3 * found.outside[worst]:.3g} mm outside of the body: move it, or raise the reach of "
                    f"{1e3 * self.reach:g} mm."
                )
            for first in range(len(route) - 1):
                piece = _difference(mesh, found.cells[first : first + 2], found.weights[first : first + 2])
                nodes.append(piece[0])
                weights.append(piece[1])
            tendon += [number] * (len(route) - 1)
            length += np.linalg.norm(np.diff(route, axis=0), axis=1).tolist()
        most = max(map(len, nodes))
        # What pads a list repeats its first vertex with a zero weight, which contributes nothing.
        padded = np.array([np.pad(each, (0, most - len(each)), constant_values=each[0]) for each in nodes])
        operator = np.zeros((len(nodes), 1, most, 3))
        for row, each in enumerate(weights):
            operator[row, 0, : len(each), 0] = each
        return (TendonPoints(padded, operator, np.array(tendon), np.array(length)),)

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "TendonTerm":
        return TendonTerm(launcher, sets, self)


def _difference(
    mesh: Mesh, cells: NDArray[np.int64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Vertices and weights whose sum is the vector from one place to another, each vertex once."""
    vertices, inverse = np.unique(mesh.cells[cells].ravel(), return_inverse=True)
    sums = np.zeros(len(vertices))
    np.add.at(sums, inverse, np.concatenate([-weights[0], weights[1]]))
    used = np.abs(sums) > 1e-14
    return vertices[used], sums[used]


class TendonTerm(ValueTerm):
    """Kernels of tendons.

    Args:
        launcher: of the potential.
        sets: the pieces.
        tendons: whose they are.
    """

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], tendons: Tendons) -> None:
        (s,) = sets
        assert isinstance(s.source, TendonPoints)
        numbers = s.source.tendon
        super().__init__(launcher, sets, "tendon_tension", numbers, np.ones(len(numbers)), tendons.count)
        self._toe = wp.float64(tendons.toe)
        self._first = launcher.upload(np.searchsorted(numbers, np.arange(tendons.count + 1)).astype(np.int32), int)
        self._rest_length = launcher.upload(np.bincount(numbers, s.source.length), wp.float64)
        self._tension, self._spring = launcher.zeros(tendons.count), launcher.zeros(tendons.count, 3)
        self._direction = launcher.zeros(s.n_points, 3)
        self._piece_length = torch.as_tensor(s.source.length, device=launcher.device)
        # (P, N) how a vertex moves a piece
        operator = np.zeros((s.n_points, s.n_vertices))
        np.add.at(operator, (np.arange(s.n_points)[:, None], s.source.nodes), s.source.gradients[:, 0, :, 0])
        self._operator = torch.as_tensor(operator, device=launcher.device)

    @property
    @override
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        return dict.fromkeys(("tendon_tension", "tendon_contraction", "tendon_stiffness"), (self.count,))

    @override
    def before(self, values: Values, positions: Any) -> list[Any]:
        (s,) = self.sets
        tension, contraction, stiffness = self.views(values)
        inputs = [s.nodes, s.gradients, self._first, self._rest_length, tension, contraction, stiffness, self._toe]
        outputs = [warp_view(self._tension, wp.float64), warp_view(self._spring, wp.vec3d)]
        return [
            self.launcher.record(kernels.pull, (self.launcher.batch, self.count), [*inputs, positions], outputs),
        ]

    @override
    def step(self, s: PointSet, values: Values, positions: Any) -> tuple[Any, list[Any]]:
        tension, _, stiffness = self.views(values)
        found = [warp_view(self._tension, wp.float64), warp_view(self._spring, wp.vec3d)]
        return kernels.local_step, [
            *(s.nodes, s.gradients, self._first, self.part, tension, stiffness),
            *(*found, positions),
        ]

    @override
    def tangent(self, s: PointSet, values: Values, positions: Any, positive: Any) -> tuple[Any, list[Any]]:
        del positive  # A tendon only pulls: its tangent has no negative eigenvalues.
        return kernels.tangent, [s.nodes, s.gradients, self.part, warp_view(self._tension, wp.float64), positions]

    @override
    def low_rank(self, values: Values, positions: Any) -> torch.Tensor | None:
        stiffness = values["tendon_stiffness"]
        assert stiffness is not None
        if not bool((stiffness > 0.0).any()):
            return None
        own, (s,) = self.launcher, self.sets
        inputs, out = [s.nodes, s.gradients, positions], warp_view(self._direction, wp.vec3d)
        own.launch(own.record(kernels.directions, (own.batch, s.n_points), inputs, [out]))
        by_tendon = (self._direction[:, :, :, None] * self._own[:, None]).flatten(2)  # (B, P, 3 T)
        gradient = (self._operator.mT @ by_tendon).unflatten(2, (3, self.count)).flatten(1, 2)
        return gradient * (stiffness * self._spring[..., 2]).sqrt()[:, None]

    @override
    def curvature(self, values: Values) -> torch.Tensor:
        tension, stiffness = values["tendon_tension"], values["tendon_stiffness"]
        assert tension is not None
        assert stiffness is not None
        # The square of a sum of n lengths is at most n times the sum of their squares.
        return tension[:, self.part_of] / self._piece_length + (stiffness * self._own.sum(0))[:, self.part_of]

    @override
    def slope(self, s: PointSet, positions: Any, direction: Any) -> tuple[Any, list[Any]]:
        return kernels.shortening, [s.nodes, s.gradients, positions, direction]

    @override
    def adjoint(
        self, values: Values, positions: torch.Tensor, direction: torch.Tensor
    ) -> Callable[[], dict[str, torch.Tensor]]:
        """See `Term.adjoint`; all three act through the tension alone."""
        shortening = super().adjoint(values, positions, direction)
        before = self.before(values, warp_view(positions, wp.vec3d))

        def differentiate() -> dict[str, torch.Tensor]:
            self.launcher.launch(*before)
            by_tension, stiffness = shortening()[self.value], values["tendon_stiffness"]
            assert stiffness is not None
            by_contraction = stiffness * self._spring[..., 2] * by_tension
            by_stiffness = self._spring[..., 1] * by_tension
            return dict(zip(self.shapes, (by_tension, by_contraction, by_stiffness), strict=True))

        return differentiate
