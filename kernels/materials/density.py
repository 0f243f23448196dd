"""Material law from energy densities given as Warp functions of F and any number of parameters.

The energy of a point is V_s W(F, p) + V_v U(F, p): W at the points of the shape term, U at the fewer points of the
volume term. Its "moduli" are (V_s, V_v, mu V_s, lambda V_v, p_1, ..., p_n); the third and fourth serve viscosity.
`kernels.energy_functions` describes the derivatives and their accuracy.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

from ..energy_functions import OFFSETS, SHARES, STEP, TWELVE, mat99, write_blocks
from ..modules import named_module

ZERO = wp.float64(0.0)
FIRST = 4  # index of the first parameter among the moduli


@dataclass(frozen=True, eq=False)
class Law:
    """The attributes of a module of ``kernels.materials``."""

    NAME: str
    LAME: tuple[tuple[float, float], ...]
    moduli: Any
    response: Any
    slopes: Any
    tangent: Any


def density_law(name: str, energy_density: Any, volume_energy: Any) -> Law:
    """Returns the law of two Warp functions of (F: mat33d, p: a vector of float64) [J/m^3].

    Args:
        name: name of the material.
        energy_density: W.
        volume_energy: U; not evaluated at points where the second modulus is zero.
    """
    vector = list(energy_density.input_types.values())[1]
    count = vector._length_
    moduli = wp.types.vector(FIRST + count, wp.float64)
    module = named_module(f"solid.{name}")
    wp.set_module_options({"max_unroll": 1}, module)

    @wp.func(module=module)
    def parameters_of(m: moduli) -> vector:
        p = vector()
        for k in range(count):
            p[k] = m[FIRST + k]
        return p

    # Warp emits functions that use wp.grad after all others, so only kernels can call them.
    @wp.func(module=module)
    def response(f: wp.mat33d, m: moduli):
        p = parameters_of(m)
        energy = ZERO
        stress = wp.mat33d()
        if m[0] > ZERO:
            by_matrix, _by_parameters = wp.grad(energy_density)(f, p)
            energy += m[0] * energy_density(f, p)
            stress += m[0] * by_matrix
        if m[1] > ZERO:
            by_matrix, _by_parameters = wp.grad(volume_energy)(f, p)
            energy += m[1] * volume_energy(f, p)
            stress += m[1] * by_matrix
        return energy, stress

    @wp.func(module=module)
    def slopes(f: wp.mat33d, df: wp.mat33d, m: moduli, carried: moduli) -> moduli:
        p = parameters_of(m)
        result = moduli()
        length = wp.sqrt(wp.ddot(df, df))
        if length > ZERO:
            h = STEP / length
            total = vector()
            for k in range(4):
                moved = f + (OFFSETS[k] * h) * df
                if m[0] > ZERO:
                    _by_matrix, by_parameters = wp.grad(energy_density)(moved, p)
                    total += (SHARES[k] * m[0]) * by_parameters
                if m[1] > ZERO:
                    _by_matrix, by_parameters = wp.grad(volume_energy)(moved, p)
                    total += (SHARES[k] * m[1]) * by_parameters
            for k in range(count):
                result[FIRST + k] = total[k] / (TWELVE * h)
        return result

    @wp.func(module=module)
    def tangent(f: wp.mat33d, m: moduli, clamp: bool, out: wp.array[wp.mat33d]):
        p = parameters_of(m)
        hessian = mat99()
        for n in range(3):
            for j in range(3):
                slope = wp.mat33d()
                for k in range(4):
                    moved = f
                    moved[j, n] = f[j, n] + OFFSETS[k] * STEP
                    if m[0] > ZERO:
                        by_matrix, _by_parameters = wp.grad(energy_density)(moved, p)
                        slope += (SHARES[k] * m[0]) * by_matrix
                    if m[1] > ZERO:
                        by_matrix, _by_parameters = wp.grad(volume_energy)(moved, p)
                        slope += (SHARES[k] * m[1]) * by_matrix
                for c in range(3):
                    for i in range(3):
                        hessian[3 * n + j, 3 * c + i] = slope[i, c] / (TWELVE * STEP)
        write_blocks(hessian, 3, clamp, out)

    lame = ((0.0, 0.0), (0.0, 0.0), (1.0, 0.0), (0.0, 1.0), *((0.0, 0.0),) * count)
    return Law(name, lame, moduli, response, slopes, tangent)
