"""Meshes of boxes, and of unions of boxes."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from ...io.errors import MeshError
from .elements import ELEMENTS
from .volume_mesh import Mesh, connected_parts, quadratic

_APART = 1e-9  # distance below which planes are merged [m]
# Steps along x, y and z from the lowest corner.
_BRICK_CORNERS = (ELEMENTS["hexahedron"].shape.nodes.astype(np.int64) + 1) // 2
# Kuhn's six tetrahedra around the diagonal from corner 0 to corner 6. The diagonals of opposite
# faces are parallel, so that neighbouring bricks conform.
_BRICK_TETRAHEDRA = np.array(
    [[0, a, b, 6] for a, b in ((1, 2), (2, 3), (3, 7), (7, 4), (4, 5), (5, 1))]
)


def box_hexahedra(
    size: Sequence[float] = (0.1, 0.03, 0.03), divisions: Sequence[int] = (10, 3, 3), nodes: int = 8
) -> Mesh:
    """Returns a box of equal bricks with one corner at the origin.

    Vertex (i, j, k) has index (i (ny + 1) + j) (nz + 1) + k; cells are numbered the same way.

    Args:
        size: Lengths along x, y and z [m].
        divisions: Numbers of bricks (nx, ny, nz) along the axes.
        nodes: Nodes of a hexahedron: 8, 20 or 27; corners are numbered first.

    Raises:
        MeshError: A length is not positive and finite, a number is not a positive integer, or the
            element is unknown.
    """
    if nodes not in (8, 20, 27):
        raise MeshError(f"hexahedra have 8, 20 or 27 nodes, not {nodes}")
    sides, counts = np.asarray(size), np.asarray(divisions)
    if (
        sides.shape != (3,)
        or sides.dtype.kind not in "fiu"
        or not 0 < sides.min() <= sides.max() < np.inf
    ):
        raise MeshError(f"the size of a box must be three positive lengths in metres, not {size}")
    if counts.shape != (3,) or counts.dtype.kind not in "iu" or np.any(counts < 1):
        raise MeshError(f"the divisions of a box must be three positive integers, not {divisions}")
    axes = [
        np.linspace(0.0, length, count + 1) for length, count in zip(sides, counts, strict=True)
    ]
    vertices = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.arange(len(vertices)).reshape(counts + 1)
    mesh = Mesh(vertices, index[:-1, :-1, :-1].reshape(-1, 1) + index[tuple(_BRICK_CORNERS.T)])
    return mesh if nodes == 8 else quadratic(mesh, f"hexahedron{nodes}")


def box_tetrahedra(
    size: Sequence[float] = (0.1, 0.03, 0.03), divisions: Sequence[int] = (10, 3, 3), order: int = 1
) -> Mesh:
    """Returns a box whose bricks are split into six conforming tetrahedra
    of equal volume each (Kuhn 1960).

    The first vertices are those of `box_hexahedra` with the same size and divisions; order 2 gives
    10-node cells.

    Raises:
        MeshError: As in `box_hexahedra`, or the order is neither 1 nor 2.
    """
    if order not in (1, 2):
        raise MeshError(f"the order of tetrahedra must be 1 or 2, not {order}")
    bricks = box_hexahedra(size, divisions)
    mesh = Mesh(bricks.vertices, bricks.cells[:, _BRICK_TETRAHEDRA].reshape(-1, 4))
    return quadratic(mesh) if order == 2 else mesh


def boxes_hexahedra(
    boxes: Sequence[tuple[ArrayLike, ArrayLike]], size: float, nodes: int = 8
) -> Mesh:
    """Returns a hexahedral mesh of a union of axis-aligned boxes.

    Every face of a box is extended to a plane of the whole mesh, so that boxes that touch or
    overlap share cells.

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
    corners = np.array(
        [(np.asarray(low, dtype=np.float64), np.asarray(high)) for low, high in boxes]
    )
    for number, (low, high) in enumerate(corners, 1):
        if not (np.isfinite([low, high]).all() and (high - low > _APART).all()):
            raise MeshError(
                f"box {number} reaches from {low.tolist()} to {high.tolist()} m: it has no volume"
            )
    lines = []  # coordinates of the planes normal to every axis
    for axis in range(3):
        planes = np.unique(corners[:, :, axis])
        planes = planes[np.diff(planes, prepend=-np.inf) > _APART]
        parts = [
            np.linspace(a, b, int(np.ceil((b - a) / size - 1e-9)), endpoint=False)
            for a, b in pairwise(planes)
        ]
        lines.append(np.concatenate([*parts, planes[-1:]]))
    grid = box_hexahedra((1.0, 1.0, 1.0), [len(planes) - 1 for planes in lines])
    places = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    centres = places[grid.cells].mean(axis=1)[:, None]
    inside = ((centres > corners[:, 0]) & (centres < corners[:, 1])).all(axis=2).any(axis=1)
    if len(np.unique(connected_parts(grid.cells[inside]))) > 1:
        raise MeshError(
            "the boxes do not form one body: let each touch another one by a part of a face"
        )
    used, cells = np.unique(grid.cells[inside], return_inverse=True)
    mesh = Mesh(places[used], cells.reshape(-1, 8))
    return mesh if nodes == 8 else quadratic(mesh, f"hexahedron{nodes}")
