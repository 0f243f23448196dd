"""A magnetised body in a uniform field, as an actuator: Zhao et al., J. Mech. Phys. Solids 124 (2019).

    e = -B b . F M d  [J/m^3]

with the magnetisation M [A/m] along d at rest, and the field B [T], the input, along b in the world.
tests/test_magnet.py compares the deflection of a beam with beam theory, and gradients with differences.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import warp as wp

from warp_resphys.energies.pointwise import PointwiseEnergy, in_cells
from warp_resphys.io.settings import Positive, setting
from warp_resphys.mesh.mesh import Mesh, select_cells
from warp_resphys.settings.extensions import EnergySettings
from warp_resphys.settings.mesh import BoxSettings, Direction
from warp_resphys.stepping.quantity import Quantity

FIELD = Quantity(
    "magnetic_field", "T", per="coil", typical=0.02, words="field", shown_unit="mT", shown_factor=1e3
)  # the name is that of the input in Python, and in identified parameters such as magnetic_field_factor
vec5 = wp.types.vector(5, wp.float64)


@wp.func
def magnetic_energy(x: wp.vec3d, p: vec5) -> wp.float64:
    """Energy [J/m^3] for x = F d and the values in their order: M, b, B."""
    return -p[0] * p[4] * (p[1] * x[0] + p[2] * x[1] + p[3] * x[2])


@dataclass(frozen=True)
class Magnet(PointwiseEnergy):
    """Magnetised cells in the field of a coil."""

    parameters: ClassVar = (
        Quantity("magnetisation", "A/m", 0.0, closed=True),
        Quantity("field_direction", "", shape=(3,)),
    )
    inputs: ClassVar = (FIELD,)
    density: ClassVar = magnetic_energy
    cells: np.ndarray  # (M',) magnetised cells
    along: tuple[float, float, float]  # d, of length one
    field_direction: tuple[float, float, float]  # b, of length one
    magnetisation: float  # M [A/m]

    def points(self, mesh):
        """Returns the quadrature points of the cells, with F d as the variable of the energy."""
        points = in_cells(mesh, self.cells)
        return (replace(points, gradients=points.gradients @ np.array(self.along)[:, None]),)


class MagnetSettings(EnergySettings):
    """A magnetised body in the field of a coil."""

    magnetisation: Positive = setting(description="M", unit="A/m")
    along: Direction = setting((1.0, 0.0, 0.0), "direction of the magnetisation at rest")
    field: Direction = setting((0.0, 0.0, 1.0), "direction of the coil's field in the world")
    within: BoxSettings = setting(BoxSettings(), "cells that are magnetised")

    def build(self, mesh: Mesh) -> Magnet:
        """Returns the energy of a body."""
        along, field = (tuple(np.asarray(d) / np.linalg.norm(d)) for d in (self.along, self.field))
        return Magnet(select_cells(mesh, **self.within.arguments()), along, field, self.magnetisation)

    @property
    def drive(self) -> Quantity:
        """Input that drives the body in recordings and laboratories."""
        return FIELD
