"""Kernels of an energy for a batch: the values of a step that they read,
and their launches at sets of points.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from typing_extensions import override

from ...kernels.laws import Law, point_kernels
from ...kernels.points import MatrixPoints, PartValues, VectorPoints
from ..fem.integration_points import Points
from .launcher import Launcher, struct_of, warp_view

Values = Mapping[str, torch.Tensor | None]
Adjoint = Callable[[], dict[str, torch.Tensor]]  # computes derivatives by values, by name
Shapes = Mapping[str, tuple[int, ...]]


def value_of(values: Values, name: str) -> torch.Tensor:
    """Returns a value that is never None."""
    value = values[name]
    assert value is not None
    return value


@dataclass(frozen=True)
class PairTangents:
    """Second derivatives of energies of four vertices each.

    Attributes:
        environment: (A,) environments.
        nodes: (A, 4) vertices.
        blocks: (A, 12, 12) second derivatives by the 12 coordinates [N/m].
    """

    environment: torch.Tensor
    nodes: torch.Tensor
    blocks: torch.Tensor


class PointSet:
    """A set of points on a launcher's device.

    Attributes:
        source: the points on the host.
        in_body: range of these points among the points of all energies.
        in_energy: range of these points among those of their energy.
        cells: C.
        points_per_cell: Q.
        nodes_per_cell: K.
        n_points: P = C Q.
        n_vertices: N.
        device: device of the launcher.
        width: components of an operator: 3, or 1 if the energy is a function of a vector.
        points: the points on the device (``kernels.points``).
        start: (N + 1) first entry of each vertex in ``incident``.
        incident: cell K + local node, for every cell of a vertex.
    """

    def __init__(
        self, launcher: Launcher, points: Points, n_vertices: int, in_body: slice, in_energy: slice
    ) -> None:
        self.source, self.n_points = points, points.n_points
        self.in_body, self.in_energy = in_body, in_energy
        self.n_vertices, self.device = n_vertices, launcher.device
        self.cells, self.points_per_cell, self.nodes_per_cell, self.width = points.gradients.shape
        vertex = points.nodes.ravel()
        # Padded nodes have a zero gradient.
        entries = np.flatnonzero(np.abs(points.gradients).sum(axis=(1, 3)).ravel() > 0.0)
        order = entries[np.argsort(vertex[entries], kind="stable")]
        start = np.searchsorted(vertex[order], np.arange(n_vertices + 1))
        nodes = launcher.upload(points.nodes.astype(np.int32), int)
        shape = (-1, self.nodes_per_cell) if self.width == 1 else (-1, self.nodes_per_cell, 3)
        kind, scalar = (VectorPoints, wp.float64) if self.width == 1 else (MatrixPoints, wp.vec3d)
        operators = launcher.upload(points.gradients.reshape(shape), scalar)
        self.points = struct_of(
            kind, nodes=nodes, operators=operators, per_cell=self.points_per_cell
        )
        self.start = launcher.upload(start.astype(np.int32), int)
        self.incident = launcher.upload(order.astype(np.int32), int)

    @property
    def first(self) -> int:
        """Number of the first point among those of the energy."""
        return int(self.in_energy.start)

    @property
    def blocks(self) -> int:
        """Number of 3 x 3 blocks in a point's tangent."""
        return 1 if self.width == 1 else 6

    def stress_view(self, stress: torch.Tensor) -> Any:
        """Returns the Warp array of a stress (B, P, 3, width)."""
        return (
            warp_view(stress[..., 0], wp.vec3d) if self.width == 1 else warp_view(stress, wp.mat33d)
        )


class Kernel(NamedTuple):
    """A kernel and its inputs.

    Attributes:
        kernel: for (B, P) points, or (B, C) cells.
        inputs: after ``active``, and for a tangent after ``clamp`` too.
        by_cells: whether there is one thread per cell. Then ``step`` adds forces to a residual
            (B, N) directly, so that there is no stress of the points.
    """

    kernel: Any
    inputs: list[Any]
    by_cells: bool = False


class Slope(NamedTuple):
    """An output of the kernel ``adjoint``: the derivative by a value, at every point."""

    name: str
    shape: tuple[int, ...]  # without the batch, the points first
    kind: Any = wp.float64


class Term(ABC):
    """An energy's kernels for a batch.

    Subclasses have the module of kernels ``_kernels``, with ``local_step``, ``tangent`` and
    ``adjoint``, and what these take: `_arguments` and `_slopes`.

    Args:
        launcher: launcher of the potential.
        sets: points of the energy.
        shapes: shape of every value of a step, without the batch, by name.

    Attributes:
        values: buffers (B, *shape) of the values of a step, which recorded launches read.
        couples_cells: whether the term may have `low_rank` columns or `pair_tangents`.
        has_pairs: whether it may have the latter.
    """

    couples_cells = False
    has_pairs = False
    _kernels: Any

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], shapes: Shapes) -> None:
        self.launcher, self.sets = launcher, tuple(sets)
        self.n_points = sum(s.n_points for s in self.sets)
        self.values = {name: launcher.zeros(*shape) for name, shape in shapes.items()}

    def view(self, name: str, kind: Any = wp.float64) -> Any:
        """Returns a value as a kernel argument."""
        return warp_view(self.values[name], kind)

    @abstractmethod
    def _arguments(self, s: PointSet, positions: Any) -> list[Any]:
        """Inputs that the kernels ``local_step``, ``tangent`` and ``adjoint`` have in common."""

    def step(self, s: PointSet, positions: Any) -> Kernel:
        """Returns the kernel of stress and energy."""
        return Kernel(self._kernels.local_step, self._arguments(s, positions))

    def tangent(self, s: PointSet, positions: Any) -> Kernel:
        """Returns the kernel of the tangent's blocks (B, P, blocks)."""
        return Kernel(self._kernels.tangent, self._arguments(s, positions))

    @abstractmethod
    def curvature(self) -> torch.Tensor:
        """Returns an upper bound (1 or B, P) of the tangent's eigenvalues
        at small strains, times the volume [J].
        """

    def adjoint(self, positions: torch.Tensor, direction: torch.Tensor) -> Adjoint:
        """Returns a function that computes -z . d residual / d value at positions x,
        by name, from the buffers.

        Args:
            positions: (B, N, 3) buffer of x [m].
            direction: (B, N, 3) buffer of z [m].
        """
        batch, outputs = self.launcher, self._slopes()
        commands = []
        out = {o.name: batch.zeros(*o.shape) for o in outputs}
        x, z = (warp_view(field, wp.vec3d) for field in (positions, direction))
        for s in self.sets:
            views = [warp_view(out[o.name].narrow(1, s.first, s.n_points), o.kind) for o in outputs]
            inputs = self._adjoint_inputs(s, x, z)
            commands.append(
                batch.record(self._kernels.adjoint, (batch.batch, s.n_points), inputs, views)
            )

        def differentiate() -> dict[str, torch.Tensor]:
            batch.launch(*commands)
            return self._by_values(out)

        return differentiate

    def _slopes(self) -> Sequence[Slope]:
        """Returns the outputs of the kernel ``adjoint``."""
        return ()

    def _adjoint_inputs(self, s: PointSet, positions: Any, direction: Any) -> list[Any]:
        """Returns the inputs of the kernel ``adjoint``."""
        return [*self._arguments(s, positions), direction]

    def _by_values(self, out: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Returns derivatives by values from those at points, summed where these share a value."""
        sums = ((name, slope, self.values[name].shape) for name, slope in out.items())
        return {
            name: slope.clone() if slope.shape == shape else slope.sum(1)
            for name, slope, shape in sums
        }

    def total_stiffness(self) -> torch.Tensor | None:
        """Returns the sum (B,) of a solid's moduli times volumes,
        the scale of its energy's rounding error [J].
        """
        return None

    def before(self, positions: Any, active: Any) -> list[Any]:
        """Returns launches to be made before the kernels of `step` and `tangent`,
        at the same positions.
        """
        del positions, active
        return []

    def low_rank(self, positions: Any) -> torch.Tensor | None:
        """Returns columns C (B, 3 N, r) of the part C C^T of the Hessian
        that couples many cells, or None.
        """
        del positions
        return None

    def pair_tangents(
        self, positions: Any, clamp: bool, active: torch.Tensor
    ) -> PairTangents | None:
        """Returns the part of the Hessian that couples vertices of different cells, or None.

        Args:
            positions: Warp array (B, N) of the positions [m].
            clamp: whether negative eigenvalues are left out.
            active: (B,) zero for environments that are left out.
        """
        del positions, clamp, active
        return None

    def set_step(self) -> None:
        """Prepares a step, after its values have been copied to the buffers."""
        return None

    def improve_start(self, positions: Any) -> None:
        """Changes positions (B, N) at which a solve may start,
        a Warp array, so that it takes fewer iterations.
        """
        del positions

    def check_start(self, start: torch.Tensor, follows: bool) -> None:
        """Raises InputError where a solve cannot start at positions.

        Args:
            start: (B, N, 3) `feasible` positions of all terms, fixed vertices where they were
                before [m].
            follows: whether the step begins where the last one ended.
        """
        del start, follows

    def free_way(self, origin: torch.Tensor, end: torch.Tensor, share: torch.Tensor) -> None:
        """Lowers the share (B,) of the way of fixed vertices,
        between positions (B, N, 3) [m], that others leave free.

        Up to that share, no barrier is passed, although no other vertex moves.
        """
        del origin, end, share

    def feasible(self) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Returns positions of finite energy, if there are others; a solve does not pass by those.

        Returns:
            Positions (B, N, 3) [m], and the vertices (V,) that this term may have moved there.
        """
        return None

    def bounds(self, origin: Any, positions: Any, share: Any) -> list[Any]:
        """Returns launches that lower the share (B) of the way
        from one array of positions (B, N) to another.

        Up to that share, which depends on no other term and no order, no barrier is passed.
        """
        del origin, positions, share
        return []


@dataclass(frozen=True)
class PartPoints(Points):
    """Weighted points that belong to the parts of an energy, such as chambers or tendons."""

    part: NDArray[np.int64]  # (P,) index of the part
    weights: NDArray[np.float64]  # (P,) of the point's energy: a volume, area, length, or one


class PartTerm(Term):
    """A term on one set of `PartPoints` of ``count`` parts, each with its values.

    Attributes:
        count: number of parts.
        weights, weight: (P,) weights of the points, for kernels and for torch.
        part, part_of: (P,) part of each point, likewise.
    """

    def __init__(
        self, launcher: Launcher, sets: Sequence[PointSet], shapes: Shapes, count: int
    ) -> None:
        super().__init__(launcher, sets, shapes)
        (s,) = sets
        assert isinstance(s.source, PartPoints)
        self.count = count
        self.weights = launcher.upload(s.source.weights, wp.float64)
        self.part = launcher.upload(s.source.part.astype(np.int32), int)
        self.part_of = torch.as_tensor(s.source.part, device=launcher.device)
        self.weight = torch.as_tensor(s.source.weights, device=launcher.device)

    @cached_property
    def one_hot(self) -> torch.Tensor:
        """Part of each point as a matrix (P, count)."""
        return torch.eye(self.count, device=self.launcher.device, dtype=torch.float64)[self.part_of]


class PointLaw(NamedTuple):
    """A law of points with what does not change.

    Attributes:
        law: energy of a point as a function of the values.
        constants: numbers that are the last values at every point.
        stiffness: returns an upper bound (B, count) of the eigenvalues of a point of weight one
            from the values; zero if omitted: the constant matrix of projective dynamics does not
            contain the energy.
    """

    law: Law
    constants: Sequence[float] = ()
    stiffness: Callable[[Mapping[str, torch.Tensor]], torch.Tensor] | None = None


class LawTerm(PartTerm):
    """A term whose points follow a law of any number of values (``kernels.laws``).

    Args:
        launcher: launcher of the potential.
        sets: one set of points.
        point_law: law of the points.
        shapes: shapes of the values in the order of the vector: (count,) or (count, n) for one or n
            values per part.
        count: number of parts.
        arrays: names of arrays, of any shape, that every point reads completely.
    """

    def __init__(
        self,
        launcher: Launcher,
        sets: Sequence[PointSet],
        point_law: PointLaw,
        shapes: Shapes,
        count: int,
        arrays: Sequence[str] = (),
    ) -> None:
        super().__init__(launcher, sets, shapes, count)
        self._law, self._stiffness = point_law.law, point_law.stiffness
        self._kernels = point_kernels(self._law)
        constants = point_law.constants
        self._shapes, self._arrays = dict(shapes), frozenset(arrays)
        self._constants = launcher.zeros(len(constants)) + torch.tensor(
            constants, device=launcher.device, dtype=torch.float64
        )
        part = self.part_of.cpu().numpy()
        self._one_each = np.array_equal(part, np.arange(count))
        self._columns = {name: self._columns_of(name, part) for name in self._shapes}
        of_constants = np.tile(np.arange(len(constants))[:, None], len(part))
        columns = np.concatenate([*self._columns.values(), of_constants])
        self._column = launcher.upload(columns.astype(np.int32), int)
        sizes = [
            int(np.prod(shape)) for name, shape in self._shapes.items() for _ in self._columns[name]
        ]
        sizes += [len(constants)] * len(constants)
        self._sizes = launcher.upload(np.array(sizes, dtype=np.int32), int)

    def _columns_of(self, name: str, part: NDArray[np.int64]) -> NDArray[np.int64]:
        """Returns the columns (n, P) of the values of each point in a row of their array."""
        if name in self._arrays:
            return np.tile(np.arange(int(np.prod(self._shapes[name])))[:, None], len(part))
        n = int(np.prod(self._shapes[name][1:]))
        return np.stack([part * n + k for k in range(n)])

    @override
    def _arguments(self, s: PointSet, positions: Any) -> list[Any]:
        pointers = [
            self.values[name].data_ptr() for name in self._shapes for _ in self._columns[name]
        ]
        pointers += [self._constants.data_ptr()] * self._constants.shape[1]
        addresses = self.launcher.upload(np.array(pointers, dtype=np.uint64), wp.uint64)
        where = {"addresses": addresses, "sizes": self._sizes, "places": self._column}
        return [s.points, struct_of(PartValues, weights=self.weights, **where), positions]

    @override
    def curvature(self) -> torch.Tensor:
        if self._stiffness is None:
            return torch.zeros_like(self.weight)[None]
        return self.weight * self._stiffness(self.values)[:, self.part_of]

    @override
    def _slopes(self) -> list[Slope]:
        return [Slope("", (self.n_points, self._law.values._length_), self._law.values)]

    @override
    def _by_values(self, out: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        slopes, first = {}, 0
        for name, shape in self._shapes.items():
            slope = out[""][..., first : first + len(self._columns[name])]
            if name in self._arrays:
                slope = slope.sum(1)
            elif not self._one_each:
                slope = torch.einsum("bpn,pc->bcn", slope, self.one_hot)
            slopes[name] = slope.reshape(self.launcher.batch, *shape).clone()
            first += len(self._columns[name])
        return slopes
