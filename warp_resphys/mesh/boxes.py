"""Hexahedral meshes of unions of boxes, as for many moulded bodies."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..io.errors import MeshError
from .mesh import Mesh, box_hexahedra, connected_parts, quadratic

FloatArray = NDArray[np.float64]

_APART = 1e-9  # distance below which planes are merged [m]


def boxes_hexahedra(boxes: Sequence[tuple[ArrayLike, ArrayLike]], size: float, nodes: int = 8) -> Mesh:
    """Returns a hexahedral mesh of a union of axis-aligned boxes.

    Every face of a box is extended to a plane of the whole mesh, so that boxes that touch or overlap share cells.

    Args:
        boxes: lower and upper corner of each box [m].
        size: largest edge length of a cell [m].
        nodes: nodes of a hexahedron: 8, 20 or 27.

    Raises:
        MeshError: no box, a box without volume, or a size that is not positive.
    """
    if not boxes:
        raise MeshError("a body of boxes needs one box or more")
    if not (np.isfinite(size) and size > 0.0):
        raise MeshError(f"the size of cells must be a positive length in metres, not {size}")
    corners = np.array([(np.asarray(low, dtype=np.float64), np.asarray(high)) for low, high in boxes])
    for number, (low, high) in enumerate(corners, 1):
        if not (np.isfinite([low, high]).all() and (high - low > _APART).all()):
            raise MeshError(f"box {number} reaches from {low.tolist()} to {high.tolist()} m: it has no volume")
    lines = [_lines(corners[:, :, axis], size) for axis in range(3)]
    grid = box_hexahedra((1.0, 1.0, 1.0), [len(planes) - 1 for planes in lines])
    places = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    centres = places[grid.cells].mean(axis=1)[:, None]
    inside = ((centres > corners[:, 0]) & (centres < corners[:, 1])).all(axis=2).any(axis=1)
    if len(np.unique(connected_parts(grid.cells[inside]))) > 1:
        raise MeshError("the boxes do not form one body: let each touch another one by a part of a face")
    used, cells = np.unique(grid.cells[inside], return_inverse=True)
    mesh = Mesh(places[used], cells.reshape(-1, 8))
    return mesh if nodes == 8 else quadratic(mesh, f"hexahedron{nodes}")


def _lines(ends: FloatArray, size: float) -> FloatArray:
    """Returns the coordinates of the mesh planes normal to an axis, ascending [m]."""
    planes = np.unique(ends)
    planes = planes[np.diff(planes, prepend=-np.inf) > _APART]
    parts = [np.linspace(a, b, int(np.ceil((b - a) / size - 1e-9)), endpoint=False) for a, b in pairwise(planes)]
    return np.concatenate([*parts, planes[-1:]])
