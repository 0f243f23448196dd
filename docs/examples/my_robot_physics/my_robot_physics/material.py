r"""The rubber of eight chains by Arruda and Boyce (J. Mech. Phys. Solids 41, 1993),
by its series of five terms.

    W = mu' sum_i c_i (I^i - 3^i) / L^(2 (i - 1)),  c = 1/2, 1/20, 11/1050, 19/7000, 519/673750

I is the first invariant and L the stretch at which the chains lock. So that the rest shape is free
of stress and inverted cells have finite energies, I = ||F||^2 - 2 (J - 1) + (J - 1)^2, which is the
first invariant where the volume is constant. mu' follows from the shear modulus mu at rest.
tests/test_material.py compares it with the closed form in uniaxial tension, and its gradients with
differences.
"""

from dataclasses import dataclass

import warp as wp

from warp_resphys.core.energies.materials import DensityMaterial
from warp_resphys.core.stepping.quantity import Parameter, parameter

# Written in a function, quotients would be computed in single precision.
C1, C2, C3, C4, C5 = (
    wp.constant(wp.float64(c)) for c in (1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750)
)
# Of mu / mu'.
M1, M2, M3, M4 = (wp.constant(wp.float64(m)) for m in (3 / 5, 99 / 175, 513 / 875, 42039 / 67375))
TWO_THIRDS = wp.constant(wp.float64(2 / 3))
ONE, TWO, THREE, HALF = (wp.constant(wp.float64(n)) for n in (1.0, 2.0, 3.0, 0.5))


@wp.func
def shape_energy(f: wp.mat33d, p: wp.vec3d) -> wp.float64:
    """W [J/m^3] for the deformation gradient and the parameters in their order: mu, L, K."""
    change = wp.determinant(f) - ONE
    i = wp.ddot(f, f) - TWO * change + change * change
    s = ONE / (p[1] * p[1])
    terms = C1 * (i - THREE) + s * C2 * (i * i - THREE * THREE)
    power, three, factor = i * i, THREE * THREE, s
    power, three, factor = power * i, three * THREE, factor * s
    terms += factor * C3 * (power - three)
    power, three, factor = power * i, three * THREE, factor * s
    terms += factor * C4 * (power - three)
    power, three, factor = power * i, three * THREE, factor * s
    terms += factor * C5 * (power - three)
    return p[0] * terms / (ONE + s * (M1 + s * (M2 + s * (M3 + s * M4))))


@wp.func
def volume_energy(f: wp.mat33d, p: wp.vec3d) -> wp.float64:
    """(K - 2/3 mu) / 2 (J - 1)^2, which is integrated at fewer points, against locking."""
    change = wp.determinant(f) - ONE
    return HALF * (p[2] - TWO_THIRDS * p[0]) * change * change


@dataclass(frozen=True)
class ArrudaBoyce(DensityMaterial):
    """Rubber whose chains lock; far below the locking stretch it is neo-Hookean."""

    model = "arruda_boyce"
    energy_density = shape_energy
    volume_energy = volume_energy

    shear_modulus: Parameter = parameter(60e3, "shear_modulus", "Pa")  # mu [Pa]
    locking_stretch: Parameter = parameter(2.0, "locking_stretch", "", lower=1.0)  # L
    bulk_modulus: Parameter = parameter(1e6, "bulk_modulus", "Pa")  # K [Pa]

    def lame(self, parameters):
        """Returns mu and lambda at small strains [Pa]."""
        mu = parameters["shear_modulus"]
        return mu, parameters["bulk_modulus"] - 2.0 / 3.0 * mu
