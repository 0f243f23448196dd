"""Finite elements: nodes, shape functions, quadrature and faces of each kind of cell. Nodes are in VTK's order.

An element is one entry of `ELEMENTS`; nothing else knows it by name. Its shape functions are the polynomials of given
exponents that are one at one node and zero at the others.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Rule = tuple[Array, Array]  # points (Q, d) and weights (Q,)


def gauss_box(order: int, dimension: int = 3) -> Rule:
    """Product of Gauss rules on [-1, 1]^d, exact up to the degree 2 order - 1 in each coordinate."""
    x, w = np.polynomial.legendre.leggauss(order)
    points = np.stack(np.meshgrid(*[x] * dimension, indexing="ij"), axis=-1).reshape(-1, dimension)
    return points, np.prod(np.stack(np.meshgrid(*[w] * dimension, indexing="ij"), axis=-1), axis=-1).ravel()


def conical_simplex(order: int, dimension: int = 3) -> Rule:
    """Conical product of Gauss rules on the unit simplex (Stroud 1971), exact up to the degree 2 order - d."""
    x, w = np.polynomial.legendre.leggauss(order)
    x, w = (x + 1.0) / 2.0, w / 2.0
    grid = [g.ravel() for g in np.meshgrid(*[x] * dimension, indexing="ij")]
    weights = np.prod(np.stack(np.meshgrid(*[w] * dimension, indexing="ij"), axis=-1), axis=-1).ravel()
    points, left = np.empty((len(weights), dimension)), np.ones_like(weights)
    for axis, a in enumerate(grid):
        points[:, axis] = a * left
        weights = weights * (1.0 - a) ** (dimension - 1 - axis)
        left = left * (1.0 - a)
    return points, weights


def degree_two_tetrahedron() -> Rule:
    """4-point rule of degree 2 on the unit tetrahedron (Keast 1986)."""
    a, b = (5.0 - np.sqrt(5.0)) / 20.0, (5.0 + 3.0 * np.sqrt(5.0)) / 20.0
    return a + (b - a) * _TETRAHEDRON, np.full(4, 1.0 / 24.0)


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape functions of a reference cell or face.

    Attributes:
        nodes: (K, d) reference coordinates.
        exponents: (K, d) of the monomials that span them.
    """

    nodes: Array
    exponents: IntArray

    @cached_property
    def _coefficients(self) -> Array:
        return np.asarray(np.linalg.inv(_monomials(self.nodes, self.exponents)))

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Values (Q, K) and reference gradients (Q, K, d) at points (Q, d)."""
        slopes = []
        for axis in range(self.exponents.shape[1]):
            lower = self.exponents.copy()
            lower[:, axis] = np.maximum(lower[:, axis] - 1, 0)
            slopes.append((_monomials(points, lower) * self.exponents[:, axis]) @ self._coefficients)
        return _monomials(points, self.exponents) @ self._coefficients, np.stack(slopes, axis=-1)


def _monomials(points: Array, exponents: IntArray) -> Array:
    """(Q, K) x^a y^b z^c."""
    return np.asarray(np.prod(points[:, None, :] ** exponents, axis=-1), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Face:
    """A kind of face.

    Attributes:
        shape: functions on the reference triangle or square.
        corners: nodes that come first.
        triangles: (T, 3) that it is split into, counter-clockwise as it is.
    """

    shape: Shape
    corners: int
    triangles: IntArray

    def rule(self, degree: int) -> Rule:
        """A rule that is exact for linear faces, and for a polynomial degree on quadratic ones."""
        quadratic = len(self.shape.nodes) > self.corners
        if self.corners == 4:
            return gauss_box(degree // 2 + 1 if quadratic else 2, 2)
        return conical_simplex(degree // 2 + 1 if quadratic else 1, 2)


@dataclass(frozen=True, eq=False)
class Element:
    """A kind of cell.

    Attributes:
        name: of the kind.
        file_type: meshio's name.
        shape: its shape functions.
        rule: points and weights of the shape term of an energy.
        faces: (F, n) nodes, counter-clockwise seen from outside, corners first.
        linear: the name of the element with its corners alone.
        volume_modes: (m, 3) exponents of the polynomials that the deformation gradient of the volume term is projected
            on, so that the element does not lock; None for means over the cells around each vertex.
        volume_rule: points and weights of the volume term; where None, one point with the element's volume.
        mass_rule: a rule that is exact for products of two shape functions, by which masses are lumped in proportion to
            the consistent mass matrix's diagonal; None for row sums.
        regular_jacobian: makes the scaled Jacobian of the regular cell one.
    """

    name: str
    file_type: str
    shape: Shape
    rule: Rule
    faces: IntArray
    linear: str
    volume_modes: IntArray | None
    volume_rule: Rule | None = None
    mass_rule: Rule | None = None
    regular_jacobian: float = 1.0

    @property
    def nodes(self) -> int:
        """K."""
        return len(self.shape.nodes)

    @property
    def face(self) -> Face:
        """The kind of its faces."""
        return FACES[self.faces.shape[1]]

    @cached_property
    def edges(self) -> IntArray:
        """(E, 2) corners of the edges, in ascending order."""
        corners = self.faces[:, : self.face.corners]
        pairs = np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2)
        return np.unique(np.sort(pairs, axis=1), axis=0)

    @cached_property
    def parents(self) -> list[IntArray]:
        """For each node that is no corner, the corners in whose middle it lies."""
        corners = ELEMENTS[self.linear]
        values = corners.shape(self.shape.nodes[corners.nodes :])[0]
        return [np.flatnonzero(row > 1e-9) for row in values]


def _exponents(most: int, *, total: int | None = None, others: int = 3) -> IntArray:
    """(n, d) exponents up to `most` in each coordinate, and up to `total` together."""
    grid = np.stack(np.meshgrid(*[np.arange(most + 1)] * others, indexing="ij"), axis=-1).reshape(-1, others)
    return grid if total is None else grid[grid.sum(axis=1) <= total]


def _between(nodes: Array, groups: list[list[int]]) -> Array:
    """Nodes, and after them the means of groups of them."""
    return np.concatenate([nodes, [nodes[group].mean(axis=0) for group in groups]])


_TETRAHEDRON = np.concatenate([np.zeros((1, 3)), np.eye(3)])
_TETRAHEDRON_EDGES = [[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]]
_TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
_HEXAHEDRON = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=float
)
_HEXAHEDRON_EDGES = [
    *([0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4]),
    *([0, 4], [1, 5], [2, 6], [3, 7]),
]
_HEXAHEDRON_FACES = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
_HEXAHEDRON20 = _between(_HEXAHEDRON, _HEXAHEDRON_EDGES)
_HEXAHEDRON27 = _between(
    _HEXAHEDRON,
    [
        *_HEXAHEDRON_EDGES,
        *([0, 4, 7, 3], [1, 2, 6, 5], [0, 1, 5, 4], [3, 7, 6, 2], [0, 3, 2, 1], [4, 5, 6, 7]),
        list(range(8)),
    ],
)
_TRIANGLE = _TETRAHEDRON[:3, :2]
_TRIANGLE_EDGES = [[0, 1], [1, 2], [2, 0]]
_SQUARE = _HEXAHEDRON[:4, :2]
_SQUARE_EDGES = [[0, 1], [1, 2], [2, 3], [3, 0]]
_CONSTANT = np.zeros((1, 3), dtype=np.int64)
_LINEAR = np.concatenate([_CONSTANT, np.eye(3, dtype=np.int64)])


# Four of the eight Gauss points, which integrate quadratic polynomials: as many as there are linear modes.
_FOUR_POINTS = _HEXAHEDRON[[0, 2, 5, 7]] / np.sqrt(3.0), np.full(4, 2.0)


def _with_middles(faces: IntArray, nodes: Array, *, centres: bool = False) -> IntArray:
    """Faces with the nodes in the middle of their edges, and in their own."""
    rows = []
    for face in faces:
        groups = [[a, b] for a, b in zip(face, np.roll(face, -1), strict=True)] + ([list(face)] if centres else [])
        middles = [int(np.linalg.norm(nodes - nodes[group].mean(axis=0), axis=1).argmin()) for group in groups]
        rows.append([*face, *middles])
    return np.array(rows, dtype=np.int64)


def _serendipity(exponents: IntArray) -> IntArray:
    """Those whose degree, without coordinates that enter linearly, is at most two (Arnold and Awanou 2011)."""
    return exponents[np.where(exponents > 1, exponents, 0).sum(axis=1) <= 2]


FACES: dict[int, Face] = {
    len(shape.nodes): Face(shape, corners, np.array(triangles))
    for shape, corners, triangles in (
        (Shape(_TRIANGLE, _exponents(1, total=1, others=2)), 3, [[0, 1, 2]]),
        (Shape(_SQUARE, _exponents(1, others=2)), 4, [[0, 1, 2], [0, 2, 3]]),
        (
            Shape(_between(_TRIANGLE, _TRIANGLE_EDGES), _exponents(2, total=2, others=2)),
            3,
            [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]],
        ),
        (
            Shape(_between(_SQUARE, _SQUARE_EDGES), _serendipity(_exponents(2, others=2))),
            4,
            [[0, 4, 7], [4, 1, 5], [5, 2, 6], [6, 3, 7], [4, 5, 6], [4, 6, 7]],
        ),
        (
            Shape(_between(_SQUARE, [*_SQUARE_EDGES, [0, 1, 2, 3]]), _exponents(2, others=2)),
            4,
            [[0, 4, 8], [0, 8, 7], [4, 1, 5], [4, 5, 8], [8, 5, 2], [8, 2, 6], [7, 8, 6], [7, 6, 3]],
        ),
    )
}

ELEMENTS: dict[str, Element] = {
    element.name: element
    for element in (
        Element(
            "tetrahedron",
            "tetra",
            Shape(_TETRAHEDRON, _exponents(1, total=1)),
            (np.full((1, 3), 0.25), np.full(1, 1.0 / 6.0)),
            _TETRAHEDRON_FACES,
            "tetrahedron",
            volume_modes=None,
            regular_jacobian=float(np.sqrt(2.0)),
        ),
        Element(
            "tetrahedron10",
            "tetra10",
            Shape(_between(_TETRAHEDRON, _TETRAHEDRON_EDGES), _exponents(2, total=2)),
            degree_two_tetrahedron(),
            _with_middles(_TETRAHEDRON_FACES, _between(_TETRAHEDRON, _TETRAHEDRON_EDGES)),
            "tetrahedron",
            volume_modes=_CONSTANT,
            mass_rule=conical_simplex(4),
            regular_jacobian=float(np.sqrt(2.0)),
        ),
        Element(
            "hexahedron",
            "hexahedron",
            Shape(_HEXAHEDRON, _exponents(1)),
            gauss_box(2),
            _HEXAHEDRON_FACES,
            "hexahedron",
            volume_modes=_CONSTANT,
        ),
        Element(
            "hexahedron20",
            "hexahedron20",
            Shape(_HEXAHEDRON20, _serendipity(_exponents(2))),
            gauss_box(3),
            _with_middles(_HEXAHEDRON_FACES, _HEXAHEDRON20),
            "hexahedron",
            volume_modes=_LINEAR,
            volume_rule=_FOUR_POINTS,
            mass_rule=gauss_box(3),
        ),
        Element(
            "hexahedron27",
            "hexahedron27",
            Shape(_HEXAHEDRON27, _exponents(2)),
            gauss_box(3),
            _with_middles(_HEXAHEDRON_FACES, _HEXAHEDRON27, centres=True),
            "hexahedron",
            volume_modes=_LINEAR,
            volume_rule=_FOUR_POINTS,
            mass_rule=gauss_box(3),
        ),
    )
}
BY_NODES: dict[int, Element] = {element.nodes: element for element in ELEMENTS.values()}
