"""Location of points in the cells of a mesh."""

from dataclasses import dataclass

import numpy as np

from ..io.arrays import FloatArray, IntArray
from ..io.errors import InputError
from .elements import Array, Element
from .mesh import Mesh

_ITERATIONS = 20
_CANDIDATES = 12  # smallest number of cells searched for a point
_TOGETHER = 256  # points located at the same time


@dataclass(frozen=True)
class Location:
    """Points as weighted sums of the nodes of cells, x = sum_a w_a x_a."""

    cells: IntArray  # (P,) cell of each point
    weights: FloatArray  # (P, K) weights of its nodes, with sum one
    gradients: FloatArray  # (P, K, 3) derivatives of the weights by the position of the point [1/m]
    outside: FloatArray  # (P,) distance from the cell [m]; zero inside, infinite where the extrapolation fails
    distance: FloatArray  # (P,) distance from the cell [m], there too


def locate(mesh: Mesh, points: FloatArray) -> Location:
    """Finds the cell that contains each point, or the nearest one, with extrapolated shape functions.

    Reference coordinates are found by Newton's method in the nearby cells.

    Args:
        mesh: the rest shape.
        points: (P, 3) [m].

    Raises:
        InputError: a point that is not finite.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise InputError("a point to locate in a mesh is not finite.")
    nodes = mesh.vertices[mesh.cells]  # (M, K, 3)
    low, high = nodes.min(axis=1), nodes.max(axis=1)
    parts = [
        _located(mesh.element, nodes, low, high, points[k : k + _TOGETHER]) for k in range(0, len(points), _TOGETHER)
    ]
    if not parts:
        none, k = np.zeros(0), mesh.cells.shape[1]
        return Location(np.zeros(0, dtype=np.int64), np.zeros((0, k)), np.zeros((0, k, 3)), none, none)
    return Location(*map(np.concatenate, zip(*parts, strict=True)))


def _located(
    element: Element, nodes: FloatArray, low: FloatArray, high: FloatArray, points: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """The fields of the `Location` of points (P, 3) in cells (M, K, 3) with the corners (M, 3) of their boxes."""
    near, last = list[IntArray](), min(_CANDIDATES, len(nodes)) - 1
    for point in points:  # cells whose boxes are nearest
        away = np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0.0), axis=1)
        near.append(np.flatnonzero(away <= np.partition(away, last)[last]))
    cells, ends = np.concatenate(near), np.cumsum([len(own) for own in near])
    targets = np.repeat(points, np.diff(ends, prepend=0), axis=0)
    place = _reference_coordinates(element, nodes[cells], targets)
    within = np.clip(place, -1.0, 1.0)
    if element.is_simplex:
        barycentric = np.maximum(np.column_stack([1.0 - place.sum(axis=1), place]), 0.0)
        within = barycentric[:, 1:] / barycentric.sum(axis=1, keepdims=True)
    values, _ = element.shape(within)
    distances = np.linalg.norm(np.einsum("ck,cki->ci", values, nodes[cells]) - targets, axis=1)
    best = [own[np.argmin(distances[own])] for own in np.split(np.arange(ends[-1]), ends[:-1])]
    cells, distances = cells[best], distances[best]
    weights, slopes = element.shape(place[best])
    gradients = slopes @ np.linalg.pinv(np.einsum("pki,pkj->pij", nodes[cells], slopes))
    error = np.linalg.norm(np.einsum("pk,pki->pi", weights, nodes[cells]) - points, axis=1)
    size = np.linalg.norm(high[cells] - low[cells], axis=1)
    outside = np.where(distances > 1e-9 * size, distances, 0.0)
    return cells, weights, gradients, np.where(error > 1e-6 * size, np.inf, outside), distances


def _reference_coordinates(element: Element, nodes: Array, points: Array) -> Array:
    """Returns reference coordinates (C, 3) of a point (C, 3) in each cell (C, K, 3), which need not contain it."""
    place = np.full((len(nodes), 3), 0.25 if element.is_simplex else 0.0)
    left = np.arange(len(nodes))
    for _ in range(_ITERATIONS):
        values, slopes = element.shape(place[left])
        error = points[left] - np.einsum("ck,cki->ci", values, nodes[left])
        jacobian = np.einsum("cki,ckj->cij", nodes[left], slopes)
        step = np.einsum("cij,cj->ci", np.linalg.pinv(jacobian), error)
        place[left] = np.clip(place[left] + step, -3.0, 3.0)  # The map may fold farther outside.
        left = left[np.abs(step).max(axis=1) >= 1e-12]
        if not len(left):
            break
    return place
