"""Blocks of cells as mesh files have them, and arrays that `decoding.decode` returns of them."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray, IntArray
from .errors import DecodingError

# Of the faces that can have a name.
_CORNERS = {"triangle": 3, "triangle6": 3, "quad": 4, "quad8": 4, "quad9": 4}


class Block(NamedTuple):
    """Cells of one kind."""

    kind: str  # meshio's name of the kind
    dimension: int
    nodes: IntArray  # (m, k) rows of the points, in VTK's order; (m, 0) for polyhedra
    groups: Mapping[str, IntArray]  # cells of the block, (n,), by the name of a group


def mesh_arrays_of(points: FloatArray, blocks: Sequence[Block]) -> dict[str, NDArray[Any]]:
    """Sorts blocks into volume cells, named surfaces and named regions.

    Returns:
        `points` (N, 3); `types`, names of all kinds of cells; `solid/KIND` (M, k), the volume cells
        of a kind; `surface/NAME` (F, 4), the corners of the faces of a named surface, the last one
        twice in triangles; and `region/NAME` (m,), the numbers of the volume cells of a named
        region.
    """
    parts: dict[str, list[IntArray]] = {}
    first = 0
    for block in blocks:
        if block.dimension == 3 and len(block.nodes):
            parts.setdefault(f"solid/{block.kind}", []).append(block.nodes)
        for name, cells in block.groups.items():
            if block.dimension == 2 and block.kind in _CORNERS and len(cells):
                parts.setdefault(f"surface/{name}", []).append(
                    block.nodes[cells, : _CORNERS[block.kind]]
                )
            if block.dimension == 3 and len(cells):
                parts.setdefault(f"region/{name}", []).append(first + cells)
        first += len(block.nodes) if block.dimension == 3 else 0
    types = np.array([block.kind for block in blocks if len(block.nodes)], dtype=np.str_)
    arrays: dict[str, NDArray[Any]] = {"points": points, "types": types}
    for name, blocks_of in parts.items():
        if name.startswith("surface/"):  # of prisms, with triangles beside quadrilaterals
            blocks_of = [
                np.pad(faces, ((0, 0), (0, 4 - faces.shape[1])), mode="edge") for faces in blocks_of
            ]
        arrays[name] = np.concatenate(blocks_of)
    return arrays


def rows_of(numbers: IntArray, nodes: IntArray) -> IntArray:
    """Returns the rows of the points (N,) with numbers of a file's nodes, in the shape of `nodes`.

    Raises:
        DecodingError: a cell has a node that the file lacks.
    """
    order = np.argsort(numbers, kind="stable")
    at = np.minimum(np.searchsorted(numbers, nodes, sorter=order), len(numbers) - 1)
    rows = order[at] if len(numbers) else np.zeros_like(nodes)
    missing = nodes[numbers[rows] != nodes] if len(numbers) else nodes
    if missing.size:
        raise DecodingError(
            f"node {missing.flat[0]} of a cell is not in the file; save the mesh again"
        )
    return rows
