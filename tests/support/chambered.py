"""Small bodies with closed chambers, and forces of pressure."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from support.clamped import clamped
from warp_resphys import Body, Fibres, Mesh, Pressure, box_hexahedra, box_tetrahedra, quadratic
from warp_resphys.core.energies.base import PlacedEnergy
from warp_resphys.core.energies.potential import IncrementalPotential, StepTerms
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


def force_of(s, q, pressure):
    """Forces of the pressure alone."""
    energy, none = s.body.energies[0], torch.zeros(0, dtype=torch.int64)
    placed = [PlacedEnergy(energy, energy.points(s.body.mesh))]
    potential = IncrementalPotential(placed, s.body.coordinates, none, len(q), q.device)
    zeros = torch.zeros_like(q)
    potential.set_terms(
        StepTerms(zeros, zeros[..., 0], zeros, [{"pressure": pressure, "apex": None}])
    )
    potential.positions.copy_(q)
    potential.evaluate()
    return -potential.residual
