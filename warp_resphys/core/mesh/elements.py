"""Finite elements: nodes in VTK order, shape functions, quadrature and faces.

An element is one entry of `ELEMENTS`. Its shape functions are the polynomials with given exponents
that are one at one node and zero at the others.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...io.arrays import FloatArray, IntArray

Array = FloatArray
Rule = tuple[Array, Array]  # points (Q, d) and weights (Q,)


def _products(values: NDArray[Any], dimension: int) -> NDArray[Any]:
    """Returns all combinations of values, (n^d, d), with the last coordinate varying fastest."""
    return np.stack(np.meshgrid(*[values] * dimension, indexing="ij"), axis=-1).reshape(
        -1, dimension
    )


def gauss_box(order: int, dimension: int = 3) -> Rule:
    """Returns the product Gauss rule on [-1, 1]^d, exact up
    to degree 2 order - 1 in each coordinate.
    """
    x, w = np.polynomial.legendre.leggauss(order)
    return _products(x, dimension), np.prod(_products(w, dimension), axis=-1)


def conical_simplex(order: int, dimension: int = 3) -> Rule:
    """Returns the conical product Gauss rule on the unit simplex (Stroud 1971),
    exact up to degree 2 order - d.
    """
    x, w = np.polynomial.legendre.leggauss(order)
    points = _products((x + 1.0) / 2.0, dimension)
    weights = np.prod(_products(w / 2.0, dimension), axis=-1)
    left = np.ones_like(weights)
    for axis in range(dimension):
        inner = 1.0 - points[:, axis]
        points[:, axis] *= left
        weights = weights * inner ** (dimension - 1 - axis)
        left = left * inner
    return points, weights


def degree_two_tetrahedron() -> Rule:
    """Returns the 4-point rule of degree 2 on the unit tetrahedron (Keast 1986)."""
    a, b = (5.0 - np.sqrt(5.0)) / 20.0, (5.0 + 3.0 * np.sqrt(5.0)) / 20.0
    return a + (b - a) * _TETRAHEDRON, np.full(4, 1.0 / 24.0)


@dataclass(frozen=True, eq=False)
class Shape:
    """Shape functions of a reference cell or face."""

    nodes: Array  # (K, d) reference coordinates
    exponents: IntArray  # (K, d) exponents of the monomials that span the shape functions

    @cached_property
    def _coefficients(self) -> Array:
        return np.asarray(np.linalg.inv(_monomials(self.nodes, self.exponents)))

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Returns values (Q, K) and reference gradients (Q, K, d) at points (Q, d)."""
        slopes = []
        for axis in range(self.exponents.shape[1]):
            lower = self.exponents.copy()
            lower[:, axis] = np.maximum(lower[:, axis] - 1, 0)
            slopes.append(
                (_monomials(points, lower) * self.exponents[:, axis]) @ self._coefficients
            )
        return _monomials(points, self.exponents) @ self._coefficients, np.stack(slopes, axis=-1)


def _monomials(points: Array, exponents: IntArray) -> Array:
    """Returns x^a y^b z^c, (Q, K)."""
    # (E, Q, d)
    powers = np.cumprod([np.ones_like(points), *[points] * int(exponents.max())], axis=0)
    return np.asarray(
        np.prod([powers[exponent, :, axis] for axis, exponent in enumerate(exponents.T)], axis=0).T
    )


@dataclass(frozen=True, eq=False)
class Face:
    """A kind of face."""

    shape: Shape  # shape functions on the reference triangle or square
    corners: int  # number of corners, which are the first nodes
    triangles: IntArray  # (T, 3) nodes of its triangles, with the face's orientation

    def rule(self, degree: int) -> Rule:
        """Returns a rule that is exact for linear fields on linear faces,
        and for a degree on quadratic ones.
        """
        quadratic = len(self.shape.nodes) > self.corners
        if self.corners == 4:
            return gauss_box(degree // 2 + 1 if quadratic else 2, 2)
        return (
            conical_simplex(degree // 2 + 1, 2)
            if quadratic
            else (np.full((1, 2), 1.0 / 3.0), np.full(1, 0.5))
        )


@dataclass(frozen=True, eq=False)
class Element:
    """A kind of cell."""

    name: str
    shape: Shape  # shape functions, those of the corners first
    parents: list[list[int]]  # for each other node, the corners whose mean it is
    rule: Rule  # points and weights of the shape term of an energy
    faces: IntArray  # (F, n) nodes, counter-clockwise seen from outside, corners first
    # (m, 3) exponents of the polynomials onto which the deformation gradient of the volume term is
    # projected against locking; None: means over the cells around each vertex
    volume_modes: IntArray | None
    # points and weights of the volume term; None: one point with the element's volume
    volume_rule: Rule | None = None
    # rule that is exact for products of shape functions, for masses in proportion to the diagonal
    # of the consistent mass matrix; None: row sums
    mass_rule: Rule | None = None

    @property
    def nodes(self) -> int:
        """Number of nodes K."""
        return len(self.shape.nodes)

    @property
    def is_simplex(self) -> bool:
        """Whether the cell is a tetrahedron."""
        return self.face.corners == 3

    @property
    def linear(self) -> str:
        """Name of the linear element with the same corners."""
        return BY_NODES[self.nodes - len(self.parents)].name

    @property
    def file_type(self) -> str:
        """Name in meshio."""
        return self.name.replace("tetrahedron", "tetra")

    @property
    def face(self) -> Face:
        """Kind of the faces."""
        return FACES[self.faces.shape[1]]

    @cached_property
    def mirrored(self) -> IntArray:
        """(K,) order of the nodes of a mirrored cell, whose volume is negative otherwise."""
        swapped = self.shape.nodes[:, [1, 0, 2]]
        return np.abs(swapped[:, None] - self.shape.nodes).sum(axis=2).argmin(axis=1)

    @cached_property
    def edges(self) -> IntArray:
        """(E, 2) corners of the edges, ascending."""
        corners = self.faces[:, : self.face.corners]
        pairs = np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2)
        return np.unique(np.sort(pairs, axis=1), axis=0)


def _exponents(most: int, *, total: int | None = None, others: int = 3) -> IntArray:
    """Returns exponents (n, d) up to `most` in each coordinate, with sums up to `total`."""
    grid = _products(np.arange(most + 1), others)
    return grid if total is None else grid[grid.sum(axis=1) <= total]


def _serendipity(exponents: IntArray) -> IntArray:
    """Returns the exponents with a superlinear degree of at most two (Arnold and Awanou 2011)."""
    return exponents[np.where(exponents > 1, exponents, 0).sum(axis=1) <= 2]


def _between(corners: Array, parents: list[list[int]]) -> Array:
    """Returns the corners followed by the means of groups of corners."""
    return np.concatenate(
        [corners, *(corners[group].mean(axis=0, keepdims=True) for group in parents)]
    )


_TETRAHEDRON = np.concatenate([np.zeros((1, 3)), np.eye(3)])
_TETRAHEDRON_EDGES = [[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]]
_TETRAHEDRON_FACES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
_HEXAHEDRON = np.array(
    [
        [-1, -1, -1],
        [1, -1, -1],
        [1, 1, -1],
        [-1, 1, -1],
        [-1, -1, 1],
        [1, -1, 1],
        [1, 1, 1],
        [-1, 1, 1],
    ],
    dtype=float,
)
_HEXAHEDRON_EDGES = [
    *([0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4]),
    *([0, 4], [1, 5], [2, 6], [3, 7]),
]
_HEXAHEDRON_MIDDLES = [
    *([0, 4, 7, 3], [1, 2, 6, 5], [0, 1, 5, 4], [3, 7, 6, 2], [0, 3, 2, 1], [4, 5, 6, 7]),
    list(range(8)),
]
_HEXAHEDRON_FACES = [
    [0, 3, 2, 1],
    [4, 5, 6, 7],
    [0, 1, 5, 4],
    [1, 2, 6, 5],
    [2, 3, 7, 6],
    [3, 0, 4, 7],
]
_TRIANGLE, _TRIANGLE_EDGES = _TETRAHEDRON[:3, :2], [[0, 1], [1, 2], [2, 0]]
_SQUARE, _SQUARE_EDGES = _HEXAHEDRON[:4, :2], [[0, 1], [1, 2], [2, 3], [3, 0]]
_CONSTANT = np.zeros((1, 3), dtype=np.int64)
_LINEAR = np.concatenate([_CONSTANT, np.eye(3, dtype=np.int64)])


def _element(
    name: str, corners: Array, exponents: IntArray, parents: list[list[int]], **rules: Any
) -> Element:
    """Returns an element with nodes at the corners and at the means of groups of corners."""
    place = {frozenset(group): len(corners) + number for number, group in enumerate(parents)}
    faces = []
    for face in _TETRAHEDRON_FACES if len(corners) == 4 else _HEXAHEDRON_FACES:
        groups = map(frozenset, [*zip(face, face[1:] + face[:1], strict=True), face])
        faces.append([*face, *(place[group] for group in groups if group in place)])
    shape = Shape(_between(corners, parents), exponents)
    return Element(name, shape, parents, faces=np.array(faces, dtype=np.int64), **rules)


FACES: dict[int, Face] = {
    len(exponents): Face(
        Shape(_between(corners, parents), exponents), len(corners), np.array(triangles)
    )
    for corners, parents, exponents, triangles in (
        (_TRIANGLE, [], _exponents(1, total=1, others=2), [[0, 1, 2]]),
        (_SQUARE, [], _exponents(1, others=2), [[0, 1, 2], [0, 2, 3]]),
        (
            *(_TRIANGLE, _TRIANGLE_EDGES, _exponents(2, total=2, others=2)),
            [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]],
        ),
        (
            *(_SQUARE, _SQUARE_EDGES, _serendipity(_exponents(2, others=2))),
            [[0, 4, 7], [4, 1, 5], [5, 2, 6], [6, 3, 7], [4, 5, 6], [4, 6, 7]],
        ),
        (
            *(_SQUARE, [*_SQUARE_EDGES, [0, 1, 2, 3]], _exponents(2, others=2)),
            [
                [0, 4, 8],
                [0, 8, 7],
                [4, 1, 5],
                [4, 5, 8],
                [8, 5, 2],
                [8, 2, 6],
                [7, 8, 6],
                [7, 6, 3],
            ],
        ),
    )
}

_ONE_POINT: dict[str, Any] = {
    "rule": (np.full((1, 3), 0.25), np.full(1, 1.0 / 6.0)),
    "volume_modes": None,
}
_KEAST: dict[str, Any] = {
    "rule": degree_two_tetrahedron(),
    "volume_modes": _CONSTANT,
    "mass_rule": conical_simplex(4),
}
_TRILINEAR: dict[str, Any] = {"rule": gauss_box(2), "volume_modes": _CONSTANT}
# Four of the eight Gauss points, which integrate quadratic polynomials: as many points as linear
# modes.
_FOUR_POINTS = _HEXAHEDRON[[0, 2, 5, 7]] / np.sqrt(3.0), np.full(4, 2.0)
_TRIQUADRATIC: dict[str, Any] = {
    "rule": gauss_box(3),
    "mass_rule": gauss_box(3),
    "volume_modes": _LINEAR,
    "volume_rule": _FOUR_POINTS,
}
_MIDDLES = [*_HEXAHEDRON_EDGES, *_HEXAHEDRON_MIDDLES]

ELEMENTS: dict[str, Element] = {
    element.name: element
    for element in (
        _element("tetrahedron", _TETRAHEDRON, _exponents(1, total=1), [], **_ONE_POINT),
        _element(
            "tetrahedron10", _TETRAHEDRON, _exponents(2, total=2), _TETRAHEDRON_EDGES, **_KEAST
        ),
        _element("hexahedron", _HEXAHEDRON, _exponents(1), [], **_TRILINEAR),
        _element(
            "hexahedron20",
            _HEXAHEDRON,
            _serendipity(_exponents(2)),
            _HEXAHEDRON_EDGES,
            **_TRIQUADRATIC,
        ),
        _element("hexahedron27", _HEXAHEDRON, _exponents(2), _MIDDLES, **_TRIQUADRATIC),
    )
}
BY_NODES: dict[int, Element] = {element.nodes: element for element in ELEMENTS.values()}
