"""Meshes of several regions."""

import numpy as np

from warp_resphys import Mesh, box_hexahedra


def beam(cells=(10, 3, 3)):
    mesh = box_hexahedra((0.1, 0.03, 0.03), cells)
    cap = np.arange(len(mesh.cells) - 2 * cells[1] * cells[2], len(mesh.cells))
    return Mesh(mesh.vertices, mesh.cells, {"beam": np.arange(cap[0]), "cap": cap})


def two_boxes(gap=0.0):
    """A box of 2 x 2 cells in section, and one of 3 x 3 that begins where it ends."""
    one = box_hexahedra((0.05, 0.03, 0.03), (5, 2, 2))
    two = box_hexahedra((0.05, 0.03, 0.03), (5, 3, 3))
    vertices = np.concatenate([one.vertices, two.vertices + [0.05 + gap, 0.0, 0.0]])
    cells = np.concatenate([one.cells, two.cells + len(one.vertices)])
    first = np.arange(len(one.cells))
    mesh = Mesh(vertices, cells, {"left": first, "right": np.arange(len(first), len(cells))})
    ends = np.flatnonzero(
        np.isclose(vertices[:, 0], 0.05 + gap) & (np.arange(len(vertices)) >= len(one.vertices))
    )
    return mesh, ends
