"""Location of points in the cells of a mesh."""

from dataclasses import dataclass

import numpy as np

from ..io.errors import InputError
from .elements import Array, Element
from .mesh import FloatArray, IntArray, Mesh

_ITERATIONS = 20
_CANDIDATES = 12  # smallest number of cells searched for a point


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
    element, nodes = mesh.element, mesh.vertices[mesh.cells]  # (M, K, 3)
    low, high = nodes.min(axis=1), nodes.max(axis=1)
    cells, weights, gradients, outside, away = [], [], [], [], []
    for point in points:
        distance = np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0.0), axis=1)
        limit = np.partition(distance, min(_CANDIDATES, len(distance)) - 1)[min(_CANDIDATES, len(distance)) - 1]
        near = np.flatnonzero(distance <= limit)
        place = _reference_coordinates(element, nodes[near], point)
        clipped = _clip_to_cell(element, place)
        distances = np.linalg.norm(np.einsum("ck,cki->ci", element.shape(clipped)[0], nodes[near]) - point, axis=1)
        best = int(np.argmin(distances))
        cells.append(near[best])
        (values,), (slopes,) = element.shape(place[best : best + 1])
        weights.append(values)
        gradients.append(slopes @ np.linalg.pinv(nodes[near[best]].T @ slopes))
        error = float(np.linalg.norm(weights[-1] @ nodes[near[best]] - point))
        size = float(np.linalg.norm(high[near[best]] - low[near[best]]))
        away.append(distances[best])
        outside.append(np.inf if error > 1e-6 * size else distances[best] if distances[best] > 1e-9 * size else 0.0)
    return Location(*map(np.array, (cells, weights, gradients, outside, away)))


def _reference_coordinates(element: Element, nodes: Array, point: Array) -> Array:
    """Returns the reference coordinates (C, 3) of a point in cells (C, K, 3), which need not contain it."""
    place = np.full((len(nodes), 3), 0.25 if element.is_simplex else 0.0)
    for _ in range(_ITERATIONS):
        values, slopes = element.shape(place)
        error = point - np.einsum("ck,cki->ci", values, nodes)
        jacobian = np.einsum("cki,ckj->cij", nodes, slopes)
        step = np.einsum("cij,cj->ci", np.linalg.pinv(jacobian), error)
        place = np.clip(place + step, -3.0, 3.0)  # The map may fold farther outside.
        if np.abs(step).max() < 1e-12:
            break
    return place


def _clip_to_cell(element: Element, place: Array) -> Array:
    """Returns reference coordinates (C, 3), moved to the boundary of the reference cell if outside."""
    if not element.is_simplex:
        return np.clip(place, -1.0, 1.0)
    barycentric = np.maximum(np.column_stack([1.0 - place.sum(axis=1), place]), 0.0)
    return np.asarray(barycentric[:, 1:] / barycentric.sum(axis=1, keepdims=True))
