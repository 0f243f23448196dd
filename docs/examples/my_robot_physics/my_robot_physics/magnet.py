"""A magnetised body in a uniform field, as an actuator: Zhao et al., J. Mech. Phys.

Solids 124 (2019).

    e = -B b . F M d  [J/m^3]

with the magnetisation M [A/m] along d at rest, and the field B [T], the input, along b in the
world. tests/test_magnet.py compares the deflection of a beam with beam theory, and gradients with
differences.
"""

from dataclasses import MISSING, dataclass, replace
from typing import ClassVar

import numpy as np
import warp as wp

from warp_resphys.core.energies.pointwise import PointwiseEnergy, in_cells
from warp_resphys.core.mesh.place import Direction
from warp_resphys.core.mesh.selection import select_cells
from warp_resphys.core.stepping.quantity import Quantity, parameter
from warp_resphys.io.settings import Positive
from warp_resphys.settings.meshing import BoxSettings

# The name is that of the input in Python, and in identified parameters such as
# magnetic_field_factor.
FIELD = Quantity(
    "magnetic_field",
    "T",
    per="coil",
    typical=0.02,
    words="field",
    shown_unit="mT",
    shown_factor=1e3,
)
vec5 = wp.types.vector(5, wp.float64)


@wp.func
def magnetic_energy(x: wp.vec3d, p: vec5) -> wp.float64:
    """Energy [J/m^3] for x = F d and the values in their order: M, b, B."""
    return -p[0] * p[4] * (p[1] * x[0] + p[2] * x[1] + p[3] * x[2])


@dataclass(frozen=True)
class Magnet(PointwiseEnergy):
    """Magnetised cells in the field of a coil."""

    inputs: ClassVar = (FIELD,)
    density: ClassVar = magnetic_energy
    magnetisation: Positive = parameter(MISSING, "magnetisation", "A/m", closed=True)  # M
    along: Direction = (1.0, 0.0, 0.0)  # d, at rest; it is scaled to length one
    # b, in the world; it is scaled to length one
    field_direction: Direction = parameter(
        (0.0, 0.0, 1.0), "field_direction", "", -np.inf, shape=(3,)
    )
    within: BoxSettings | None = None  # the cells that are magnetised; None: all

    def __post_init__(self):
        """Scales both directions to length one."""
        for name in ("along", "field_direction"):
            direction = np.array(getattr(self, name))
            object.__setattr__(self, name, tuple(direction / np.linalg.norm(direction)))
        super().__post_init__()

    def points(self, mesh):
        """Returns the quadrature points of the cells, with F d as the variable of the energy."""
        within = {} if self.within is None else self.within.arguments()
        points = in_cells(mesh, select_cells(mesh, **within))
        return (replace(points, gradients=points.gradients @ np.array(self.along)[:, None]),)
