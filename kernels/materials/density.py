"""Material law from energy densities given as Warp functions of F and any number of parameters.

The energy of a point is V_s W(F, p) + V_v U(F, p): W at the points of the shape term, U at the
fewer points of the volume term. Its values are (V_s, V_v, mu V_s, lambda V_v, p_1, ..., p_n); the
third and fourth serve viscosity. `kernels.energy_functions` describes the derivatives and their
accuracy.
"""

from typing import Any

import warp as wp

from ..constants import ZERO
from ..energy_functions import derived_law
from ..laws import Law
from ..modules import named_module

FIRST = 4  # index of the first parameter among the values


def density_law(name: str, energy_density: Any, volume_energy: Any) -> Law:
    """Returns the law of two Warp functions of (F: mat33d, p: a vector of float64) [J/m^3].

    Args:
        name: name of the material.
        energy_density: W.
        volume_energy: U; not evaluated at points where the second value is zero.
    """
    vector = list(energy_density.input_types.values())[1]
    count = vector._length_
    values = wp.types.vector(FIRST + count, wp.float64)

    @wp.func(module=named_module(f"solid.{name}"))
    def energy(f: wp.mat33d, m: values) -> wp.float64:
        p = m[FIRST:]
        total = ZERO
        if m[0] > ZERO:
            total += m[0] * energy_density(f, p)
        if m[1] > ZERO:
            total += m[1] * volume_energy(f, p)
        return total

    lame = ((0.0, 0.0), (0.0, 0.0), (1.0, 0.0), (0.0, 1.0), *((0.0, 0.0),) * count)
    return derived_law(f"solid.{name}", energy, 1.0, lame)
