"""Nominal stress of isotropic rubber in homogeneous deformations
that keep the volume, in closed form.

A test deforms its specimen along a path of principal stretches s(x) with s_1 s_2 s_3 = 1, where x
is the nominal strain or the angle of shear. As the pressure does no work, the stress that a load
cell shows over the undeformed cross-section is d/dx W(s(x)) (Ogden, Non-linear Elastic
Deformations, 1984, section 7.2). With the energy of `kernels.materials.convex` it is linear in the
coefficients:

    tension, compression   s = (1 + x, (1 + x)^-1/2, (1 + x)^-1/2)   compression counts strain and
                                                                     stress as positive
    biaxial                s = (1 + x, 1 + x, (1 + x)^-2)            stress of each of the two
                                                                     directions
    planar                 s = (1 + x, 1, 1 / (1 + x))               a wide strip, "pure shear"
    shear                  s_1 - 1 / s_1 = x, s_2 = 1                simple shear

Relaxing branches and viscosity act through Green's strain E, as in `energies.viscosity`: the stress
is S : dE/dx with S = 2 m H of a branch and S = 2 eta dE/dt of viscosity.
`tests/energies/test_isochoric.py` compares with the simulator.
"""

import re
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from ...io.arrays import FloatArray

KINDS: Final = ("tension", "compression", "biaxial", "planar", "shear")
TERMS: Final = re.compile(r"c10|c20|c30|c01|c02|ogden_m?\d+")  # elastic coefficients with a column


class DeformationPath(NamedTuple):
    """A path of deformation at N strains x, with its derivatives by x."""

    stretches: FloatArray  # (N, 3)
    stretch_slopes: FloatArray  # (N, 3)
    green: FloatArray  # (N, 3, 3) Green's strain
    green_slopes: FloatArray  # (N, 3, 3)
    work: float  # number of directions that are loaded alike, over which the work is shared


def path_of(kind: str, strain: FloatArray) -> DeformationPath:
    """Returns the path of a kind of test at strains (N,)."""
    if kind == "shear":
        one, zero = np.ones_like(strain), np.zeros_like(strain)
        root = np.sqrt(1.0 + 0.25 * strain**2)
        first = 0.5 * strain + root
        slope = first / (2.0 * root)
        stretches, slopes = (first, one, 1.0 / first), (slope, zero, -slope / first**2)
        green, by_x = np.zeros((2, len(strain), 3, 3))
        green[:, 0, 1] = green[:, 1, 0] = 0.5 * strain
        green[:, 1, 1] = 0.5 * strain**2
        by_x[:, 0, 1] = by_x[:, 1, 0] = 0.5
        by_x[:, 1, 1] = strain
        return DeformationPath(np.stack(stretches, 1), np.stack(slopes, 1), green, by_x, 1.0)
    along, sign = (1.0 - strain, -1.0) if kind == "compression" else (1.0 + strain, 1.0)
    powers = {"biaxial": (1.0, 1.0, -2.0), "planar": (1.0, 0.0, -1.0)}.get(kind, (1.0, -0.5, -0.5))
    s = np.stack([along**p for p in powers], 1)
    slope = sign * np.stack([p * along ** (p - 1.0) for p in powers], 1)
    axes = np.eye(3)
    green, by_x = 0.5 * (s**2 - 1.0)[..., None] * axes, (s * slope)[..., None] * axes
    return DeformationPath(s, slope, green, by_x, 2.0 if kind == "biaxial" else 1.0)


def stress_columns(
    kind: str, strain: FloatArray, terms: tuple[str, ...], seconds: FloatArray | None = None
) -> dict[str, FloatArray]:
    """Returns the nominal stress (N,) of a coefficient of one, by its name.

    It is zero for volume terms.

    Args:
        kind: one of `KINDS`.
        strain: (N,) nominal strains, or angles of shear [rad]; positive in compression, too.
        terms: names of `energies.convex_material.ConvexMaterial`: elastic coefficients,
            ``shear_viscosity``, and ``prony_TIME`` for a branch with a relaxation time [s].
        seconds: (N,) rising times of the strains [s], which viscosity and branches need; they are
            relaxed at the first.
    """
    path = path_of(kind, strain)
    columns = {}
    for term in terms:
        if term == "shear_viscosity" or term.startswith("prony_"):
            assert seconds is not None
            rate = None if term == "shear_viscosity" else float(term.removeprefix("prony_"))
            carried = (
                _rate(path.green, seconds)
                if rate is None
                else _unrelaxed(path.green, seconds, rate)
            )
            column = 2.0 * np.einsum("nij,nij->n", carried, path.green_slopes)
        else:
            column = _elastic(term, path) if TERMS.fullmatch(term) else np.zeros_like(strain)
        columns[term] = column / path.work
    return columns


def stress(kind: str, strain: FloatArray, parameters: Mapping[str, float]) -> FloatArray:
    """Returns the nominal stress (N,) [Pa] of a law in slow loading; see `stress_columns`."""
    known = {name: value for name, value in parameters.items() if TERMS.fullmatch(name)}
    columns = stress_columns(kind, strain, tuple(known))
    return np.asarray(
        sum((value * columns[name] for name, value in known.items()), np.zeros_like(strain))
    )


def shear_modulus(parameters: Mapping[str, float]) -> float:
    """Returns the shear modulus of a law at small strains [Pa], after relaxation."""
    return float(stress("shear", np.array([1e-6]), parameters)[0] / 1e-6)


def bulk_of(parameters: Mapping[str, float], poissons_ratio: float) -> float:
    """Returns ``bulk_1`` of `energies.convex_material.ConvexMaterial` [Pa]
    for a Poisson's ratio at small strains.
    """
    return shear_modulus(parameters) * poissons_ratio / (1.0 - 2.0 * poissons_ratio)


def _elastic(term: str, path: DeformationPath) -> FloatArray:
    s, slope = path.stretches, path.stretch_slopes
    ogden = re.fullmatch(r"ogden_(m?)(\d+)", term)
    if ogden:
        n = int(ogden[2]) * (-1 if ogden[1] else 1)
        return np.asarray((2.0 / n * s ** (n - 1) * slope).sum(1))
    power = int(term[1]) + int(term[2])  # of a (c10, c20, c30) or b (c01, c02)
    size = 2.0 if term[2] == "0" else -2.0  # s_1 s_2 s_3 = 1: I2 is the sum of s^-2
    invariant, change = (s**size).sum(1) - 3.0, (size * s ** (size - 1.0) * slope).sum(1)
    return np.asarray(power * invariant ** (power - 1) * change)


def _rate(green: FloatArray, seconds: FloatArray) -> FloatArray:
    """Returns the rates (N, 3, 3) of strains at times (N,), of the interval before each.

    Zero at the first.
    """
    change = np.diff(green, axis=0) / np.diff(seconds)[:, None, None]
    return np.concatenate([np.zeros_like(green[:1]), change])


def _unrelaxed(green: FloatArray, seconds: FloatArray, time: float) -> FloatArray:
    """Returns the strain H (N, 3, 3) of a branch that has not relaxed,
    with a constant rate in each interval.
    """
    spans = np.diff(seconds) / time
    decay, gain = np.exp(-spans), -np.expm1(-spans) / spans
    result = np.zeros_like(green)
    for k in range(1, len(green)):
        result[k] = decay[k - 1] * result[k - 1] + gain[k - 1] * (green[k] - green[k - 1])
    return result
