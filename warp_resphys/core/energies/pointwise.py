"""Energies given as one Warp function, from which kernels and derivatives follow.

For example::

    class Spring(PointwiseEnergy):  # k/2 (|x| - L)^2 between two vertices
        stiffness: float = parameter(20.0, "spring_stiffness", "N/m")
        length: float = parameter(0.1, "spring_length", "m")
        density = spring  # a Warp function of x (vec3d) and the values (vec2d)
        ...
        def points(self, mesh):
            return (between(self.pairs),)

The function takes the kinematic variable of a point, a vector (a position, a difference of
positions) or a matrix (a deformation gradient), and the values at the point: parameters and inputs,
in the order of their declaration. `kernels.energy_functions` describes the accuracy of the
derivatives.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from ...io.errors import InputError
from ...kernels.energy_functions import derived_law
from ..fem.integration_points import Points, physical_gradients
from ..mesh.volume_mesh import Mesh
from .base import Energy
from .launcher import Launcher
from .term import LawTerm, PartPoints, PointLaw, PointSet


class PointwiseEnergy(Energy):
    """The sum over points of a weight times a function
    of the point's kinematic variable and values.

    Attributes:
        density: the Warp function e(f, v) [J over the unit of the weight], of a ``wp.vec3d`` or a
            ``wp.mat33d`` and a vector of float64.
        size: typical size of f, for the step of finite differences.
    """

    density: ClassVar[Any]
    size: ClassVar[float] = 1.0

    @abstractmethod
    @override
    def points(self, mesh: Mesh) -> tuple[PartPoints, ...]:
        """Returns a tuple with one set of points, from `at_vertices`,
        `between` or `in_cells` for example.
        """

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "PointwiseTerm":
        return PointwiseTerm(launcher, sets, self)


class PointwiseTerm(LawTerm):
    """Kernels of a pointwise energy."""

    def __init__(
        self, launcher: Launcher, sets: Sequence[PointSet], energy: PointwiseEnergy
    ) -> None:
        density = energy.density
        law = derived_law(
            f"pointwise.{density.module.name}.{density.key}.{energy.size:g}", density, energy.size
        )
        names = [quantity.name for quantity in (*energy.parameters, *energy.inputs)]
        arrays = {q.name: q.shape for q in energy.parameters if q.shape}
        values = len(names) - len(arrays) + sum(int(np.prod(shape)) for shape in arrays.values())
        if law.values._length_ != values:
            raise InputError(
                f"the density of {type(energy).__name__} takes {law.values._length_} values, but "
                f"the energy has {values}: {', '.join(names)}."
            )
        shapes: dict[str, tuple[int, ...]] = {
            name: arrays.get(name, (energy.count,)) for name in names
        }
        super().__init__(launcher, sets, PointLaw(law), shapes, energy.count, list(arrays))


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
    """Returns points of weight one for pairs of vertices (P, 2).

    The kinematic variable is the vector between them.

    Args:
        pairs: vertex numbers.
        part: part of each point, or of all.
    """
    nodes = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    return _unweighted(nodes, np.tile(np.array([-1.0, 1.0])[:, None], (len(nodes), 1, 1, 1)), part)


def _unweighted(
    nodes: NDArray[np.int64], operators: NDArray[np.float64], part: ArrayLike
) -> PartPoints:
    return PartPoints(
        nodes, operators, np.broadcast_to(part, len(nodes)).astype(np.int64), np.ones(len(nodes))
    )


def in_cells(mesh: Mesh, cells: ArrayLike) -> PartPoints:
    """Returns the quadrature points of cells, weighted by volume [m^3].

    The variable is the deformation gradient.

    Args:
        mesh: the rest shape.
        cells: (M',) cell indices.
    """
    points, weights = mesh.element.rule
    nodes = mesh.cells[np.asarray(cells, dtype=np.int64)]
    gradients, determinants = physical_gradients(
        mesh.vertices, nodes, mesh.element.shape(points)[1]
    )
    volumes = (determinants * weights).ravel()
    return PartPoints(nodes, gradients, np.zeros(len(volumes), dtype=np.int64), volumes)
