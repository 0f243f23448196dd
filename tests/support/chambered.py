"""Small bodies with closed chambers."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from support.clamped import clamped
from warp_resphys import Body, Fibres, Mesh, Pressure, box_hexahedra, box_tetrahedra, quadratic
from warp_resphys.mesh import find_chambers

SIZE, DIVISIONS = (0.06, 0.03, 0.02), (6, 3, 3)
# Removed bricks (i, j, k): a chamber of two bricks and one of a single brick.
HOLLOW = [(1, 1, 1), (2, 1, 1), (4, 1, 1)]
BRICK = np.prod(SIZE) / np.prod(DIVISIONS)  # m^3
KINDS = ("hexahedron", "tetrahedron", "tetrahedron10")


def hollow_box(kind: str) -> Mesh:
    """A box along x with a chamber of two bricks and one of a single brick."""
    make = box_hexahedra if kind == "hexahedron" else box_tetrahedra
    full = make(SIZE, DIVISIONS)
    centres = full.vertices[full.cells].mean(axis=1)
    brick = np.floor(centres / (np.array(SIZE) / DIVISIONS)).astype(int)
    solid = np.array([tuple(b) not in HOLLOW for b in brick])
    mesh = Mesh(full.vertices, full.cells[solid])
    return quadratic(mesh) if kind == "tetrahedron10" else mesh


def chambered(kind: str, fibres: Mapping[str, Any] | None = None) -> Body:
    """The hollow box as a body clamped at x = 0, with fibres of these settings."""
    mesh = hollow_box(kind)
    chambers = find_chambers(mesh, (1.0, 0.0, 0.0))
    energies = [Pressure(chambers), *([] if fibres is None else [Fibres(chambers, **fibres)])]
    return clamped(mesh, energies=energies)
