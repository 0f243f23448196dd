"""Meshes of several regions."""

import numpy as np

from warp_resphys import Mesh, box_hexahedra


def beam(cells=(10, 3, 3)):
    mesh = box_hexahedra((0.1, 0.03, 0.03), cells)
    cap = np.arange(len(mesh.cells) - 2 * cells[1] * cells[2], len(mesh.cells))
    return Mesh(mesh.vertices, mesh.cells, {"beam": np.arange(cap[0]), "cap": cap})
