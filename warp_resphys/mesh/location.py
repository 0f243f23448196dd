"""Where points lie in the cells of a mesh at rest."""

from dataclasses import dataclass

import numpy as np

from ..io.errors import InputError
from .elements import Array, Element
from .mesh import FloatArray, IntArray, Mesh

_ITERATIONS = 20
_CANDIDATES = 12  # cells, at least, in which a point is looked for


@dataclass(frozen=True)
class Location:
    """Points as sums over the nodes of cells, x = sum_a w_a x_a."""

    cells: IntArray  # (P,) the cell of each
    weights: FloatArray  # (P, K) of its nodes; their sum is one
    gradients: FloatArray  # (P, K, 3) by where the point is [1/m]
    outside: FloatArray  # (P,) how far from the cell [m]; zero inside, infinite where its shape functions do not reach


def locate(mesh: Mesh, points: FloatArray) -> Location:
    """Finds the cells that points lie in, or those nearest to them, whose shape functions go on outside.

    Reference coordinates come from Newton's method on the map of each cell whose nodes are near.

    Args:
        mesh: at rest.
        points: (P, 3) [m].

    Raises:
        InputError: a point that is not finite.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise InputError("a point to locate in a mesh is not finite.")
    element, nodes = mesh.element, mesh.vertices[mesh.cells]  # (M, K, 3)
    low, high = nodes.min(axis=1), nodes.max(axis=1)
    cells, weights, gradients, outside = [], [], [], []
    for point in points:
        distance = np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0.0), axis=1)
        limit = np.partition(distance, min(_CANDIDATES, len(distance)) - 1)[min(_CANDIDATES, len(distance)) - 1]
        near = np.flatnonzero(distance <= limit)
        place = _reference_coordinates(element, nodes[near], point)
        held = _held_inside(element, place)
        away = np.linalg.norm(np.einsum("ck,cki->ci", element.shape(held)[0], nodes[near]) - point, axis=1)
        best = int(np.argmin(away))
        cells.append(near[best])
        (values,), (slopes,) = element.shape(place[best : best + 1])
        weights.append(values)
        gradients.append(slopes @ np.linalg.pinv(nodes[near[best]].T @ slopes))
        missed = float(np.linalg.norm(weights[-1] @ nodes[near[best]] - point))
        size = float(np.linalg.norm(high[near[best]] - low[near[best]]))
        # What no continuation of the cell reaches is as far outside as can be.
        outside.append(np.inf if missed > 1e-6 * size else away[best] if away[best] > 1e-9 * size else 0.0)
    return Location(np.array(cells), np.array(weights), np.array(gradients), np.array(outside))


def _is_simplex(element: Element) -> bool:
    return len(element.shape.nodes) - len(element.parents) == 4


def _reference_coordinates(element: Element, nodes: Array, point: Array) -> Array:
    """(C, 3) of a point in cells (C, K, 3), which may lie far outside of them."""
    place = np.full((len(nodes), 3), 0.25 if _is_simplex(element) else 0.0)
    for _ in range(_ITERATIONS):
        values, slopes = element.shape(place)
        miss = point - np.einsum("ck,cki->ci", values, nodes)
        jacobian = np.einsum("cki,ckj->cij", nodes, slopes)
        step = np.einsum("cij,cj->ci", np.linalg.pinv(jacobian), miss)
        place = np.clip(place + step, -3.0, 3.0)  # Beyond, the polynomials fold.
        if np.abs(step).max() < 1e-12:
            break
    return place


def _held_inside(element: Element, place: Array) -> Array:
    """Reference coordinates (C, 3), those outside of the reference cell moved to its boundary."""
    if not _is_simplex(element):
        return np.clip(place, -1.0, 1.0)
    shares = np.maximum(np.column_stack([1.0 - place.sum(axis=1), place]), 0.0)
    return np.asarray(shares[:, 1:] / shares.sum(axis=1, keepdims=True))
