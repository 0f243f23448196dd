"""Energies given as one Warp function, from which kernels and derivatives follow.

For example::

    class Spring(PointwiseEnergy):                       # k/2 (|x| - L)^2 between two vertices
        stiffness: float = parameter(20.0, "spring_stiffness", "N/m")
        length: float = parameter(0.1, "spring_length", "m")
        density = spring                                 # a Warp function of x (vec3d) and the values (vec2d)
        ...
        def points(self, mesh):
            return (between(self.pairs),)

The function takes the kinematic variable of a point, a vector (a position, a difference of positions) or a matrix (a
deformation gradient), and the values at the point: parameters and inputs, in the order of their declaration.
`kernels.energy_functions` describes the accuracy of the derivatives.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ..fem.integration_points import Points, physical_gradients
from ..io.errors import InputError
from ..kernels.energy_functions import derived_law
from ..kernels.laws import Law, point_kernels
from ..kernels.points import PartValues
from ..mesh.volume_mesh import Mesh
from .base import Energy
from .launcher import Launcher, struct_of
from .term import PartPoints, PartTerm, PointSet, Slope


class ReadingTerm(PartTerm):
    """A term whose kernels read any number of values at each point (``kernels.points.value_reader``).

    Args:
        launcher: launcher of the potential.
        sets: one set of points.
        law: energy of a point as a function of the values.
        shapes: shapes of the values in the order of the vector: (count,) or (count, n) for one or n values per part.
        count: number of parts.
        arrays: names of arrays, of any shape, that every point reads completely.
        constants: numbers that are the last values at every point.
        stiffness: returns an upper bound (B, count) of the eigenvalues of a point of weight one from the values; zero
            if omitted: the constant matrix of projective dynamics does not contain the energy.
    """

    def __init__(
        self,
        launcher: Launcher,
        sets: Sequence[PointSet],
        law: Law,
        shapes: Mapping[str, tuple[int, ...]],
        count: int,
        arrays: Sequence[str] = (),
        constants: Sequence[float] = (),
        stiffness: Callable[[Mapping[str, torch.Tensor]], torch.Tensor] | None = None,
    ) -> None:
        super().__init__(launcher, sets, shapes, count)
        self._kernels, self._law, self._shapes = point_kernels(law), law, dict(shapes)
        self._arrays, self._stiffness = frozenset(arrays), stiffness
        self._constants = launcher.zeros(len(constants)) + torch.tensor(
            constants, device=launcher.device, dtype=torch.float64
        )
        part = self.part_of.cpu().numpy()
        self._one_each = np.array_equal(part, np.arange(count))
        self._columns = {name: self._columns_of(name, part) for name in self._shapes}
        of_constants = np.tile(np.arange(len(constants))[:, None], len(part))
        columns = np.concatenate([*self._columns.values(), of_constants])
        self._column = launcher.upload(columns.astype(np.int32), int)
        sizes = [int(np.prod(shape)) for name, shape in self._shapes.items() for _ in self._columns[name]]
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
        pointers = [self.values[name].data_ptr() for name in self._shapes for _ in self._columns[name]]
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


class PointwiseEnergy(Energy):
    """The sum over points of a weight times a function of the point's kinematic variable and values.

    Attributes:
        density: the Warp function e(f, v) [J over the unit of the weight], of a ``wp.vec3d`` or a ``wp.mat33d`` and a
            vector of float64.
        size: typical size of f, for the step of finite differences.
    """

    density: ClassVar[Any]
    size: ClassVar[float] = 1.0

    @abstractmethod
    @override
    def points(self, mesh: Mesh) -> tuple[PartPoints, ...]:
        """Returns a tuple with one set of points, from `at_vertices`, `between` or `in_cells` for example."""

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "PointwiseTerm":
        return PointwiseTerm(launcher, sets, self)


class PointwiseTerm(ReadingTerm):
    """Kernels of a pointwise energy."""

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], energy: PointwiseEnergy) -> None:
        density = energy.density
        law = derived_law(f"pointwise.{density.module.name}.{density.key}.{energy.size:g}", density, energy.size)
        names = [quantity.name for quantity in (*energy.parameters, *energy.inputs)]
        arrays = {q.name: q.shape for q in energy.parameters if q.shape}
        values = len(names) - len(arrays) + sum(int(np.prod(shape)) for shape in arrays.values())
        if law.values._length_ != values:
            raise InputError(
                f"the density of {type(energy).__name__} takes {law.values._length_} values, but the energy has "
                f"{values}: {', '.join(names)}."
            )
        shapes: dict[str, tuple[int, ...]] = {name: arrays.get(name, (energy.count,)) for name in names}
        super().__init__(launcher, sets, law, shapes, energy.count, list(arrays))


def one_part_each(points: Points) -> PartPoints:
    """Returns points of weight one that are a part each, in their order."""
    count = points.n_points
    return PartPoints(points.nodes, points.gradients, np.arange(count), np.ones(count))


def at_vertices(vertices: ArrayLike, part: ArrayLike = 0) -> PartPoints:
    """Returns points of weight one at vertices (P,); the kinematic variable is the position.

    Args:
        vertices: vertex numbers.
        part: part of each point, or of all.
    """
    nodes = np.asarray(vertices, dtype=np.int64).reshape(-1, 1)
    return _unweighted(nodes, np.ones((len(nodes), 1, 1, 1)), part)


def between(pairs: ArrayLike, part: ArrayLike = 0) -> PartPoints:
    """Returns points of weight one for pairs of vertices (P, 2); the kinematic variable is the vector between them.

    Args:
        pairs: vertex numbers.
        part: part of each point, or of all.
    """
    nodes = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    return _unweighted(nodes, np.tile(np.array([-1.0, 1.0])[:, None], (len(nodes), 1, 1, 1)), part)


def _unweighted(nodes: NDArray[np.int64], operators: NDArray[np.float64], part: ArrayLike) -> PartPoints:
    return PartPoints(nodes, operators, np.broadcast_to(part, len(nodes)).astype(np.int64), np.ones(len(nodes)))


def in_cells(mesh: Mesh, cells: ArrayLike) -> PartPoints:
    """Returns the quadrature points of cells, weighted by volume [m^3]; the variable is the deformation gradient.

    Args:
        mesh: the rest shape.
        cells: (M',) cell indices.
    """
    points, weights = mesh.element.rule
    nodes = mesh.cells[np.asarray(cells, dtype=np.int64)]
    gradients, determinants = physical_gradients(mesh.vertices, nodes, mesh.element.shape(points)[1])
    volumes = (determinants * weights).ravel()
    return PartPoints(nodes, gradients, np.zeros(len(volumes), dtype=np.int64), volumes)
