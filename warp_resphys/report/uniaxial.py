"""Moduli at small strains of a law of convex terms, and its stress in uniaxial tension and compression.

The energy and its constants are those of `kernels.materials.convex`; here it is a function of three principal
stretches, along axes of which one is the direction of fibres. Uniaxial: the sides are free of stress, so that the
nominal stress is dW/ds_1 at dW/ds_2 = dW/ds_3 = 0. Viscosity and relaxing branches carry no stress in slow loading.
Verified against the kernels in `tests/report/test_law_section.py`.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy.optimize
import torch

from ..energies.catalogue import make_material
from ..io.arrays import FloatArray
from ..settings.body import MaterialSettings

ALONG: Final = (1.0, 0.0, 0.0)  # Direction of fibres, in axes of which the first is that of the load.
ACROSS: Final = (0.0, 1.0, 0.0)


class SmallStrain(NamedTuple):
    """Moduli of an isotropic solid at small strains, after relaxation."""

    mu: float  # Shear modulus [Pa].
    lame: float  # Lamé's first constant [Pa].

    @property
    def youngs_modulus(self) -> float:
        """Young's modulus [Pa]."""
        return self.mu * (3.0 * self.lame + 2.0 * self.mu) / (self.lame + self.mu)

    @property
    def poissons_ratio(self) -> float:
        """Poisson's ratio."""
        return 0.5 * self.lame / (self.lame + self.mu)


def small_strain(constants: Mapping[str, float]) -> SmallStrain:
    """Return the moduli of a law without its fibres, from its constants by name."""
    ogden, value = ogden_terms(constants), constants.get
    mu = 2.0 * (value("c10", 0.0) + value("c01", 0.0)) + sum(ogden.values())
    lame = 2.0 * (value("dilation", 0.0) + value("bulk_1", 0.0))
    return SmallStrain(mu, lame + sum(2.0 * (1.0 + 2.0 / n) * own for n, own in ogden.items() if n < 0))


def small_strain_of(material: MaterialSettings) -> SmallStrain | None:
    """Return the moduli of a material at small strains; None for one with regions."""
    if material.regions:
        return None
    own = make_material(material.model, **material.constants)
    if material.model == "law":
        return small_strain({name: float(torch.as_tensor(value)) for name, value in own.constants.items()})
    tensors = {n: torch.as_tensor(x, dtype=torch.float64).reshape(1, -1) for n, x in own.constants.items()}
    mu, lame = np.asarray(own.law.LAME).T @ [float(modulus) for modulus in own.moduli(tensors)]
    return SmallStrain(float(mu), float(lame))


def ogden_terms(constants: Mapping[str, float]) -> dict[int, float]:
    """Return the moduli of Ogden's terms [Pa], by exponent."""
    found = {name: re.fullmatch(r"ogden_(m?)(\d+)", name) for name in constants}
    return {int(m[2]) * (-1 if m[1] else 1): constants[name] for name, m in found.items() if m}


def families(constants: Mapping[str, float]) -> int:
    """Return the number of families of fibres."""
    return sum(name.startswith("fibre_tension_") for name in constants)


def uniaxial_stress(
    constants: Mapping[str, float], stretches: FloatArray, direction: Sequence[float] | None = None
) -> FloatArray:
    """Return the nominal stress (S,) [Pa] at stretches (S,); NaN where no state with free sides was found.

    Args:
        constants: Of the law, by name.
        stretches: Ratio of the length to that at rest.
        direction: Of the first family of fibres, `ALONG` or `ACROSS` the load; None leaves fibres out.
    """
    stress = np.full(len(stretches), np.nan)
    order = np.argsort(np.abs(stretches - 1.0))  # From rest outwards, each from the nearest state that is known.
    known: dict[float, FloatArray] = {1.0: np.ones(2)}
    for at in order:
        stretch = float(stretches[at])
        nearest = min(known, key=lambda other: abs(other - stretch))
        guess = known[nearest] * (stretch / nearest) ** -0.5
        solved = scipy.optimize.root(lambda sides, s=stretch: _slopes(constants, s, sides, direction)[1:], guess)
        slopes = _slopes(constants, stretch, solved.x, direction)
        if np.abs(slopes[1:]).max() < 1e-6 * small_strain(constants).mu:
            known[stretch], stress[at] = solved.x, slopes[0]
    return stress


def _slopes(
    constants: Mapping[str, float], stretch: float, sides: FloatArray, direction: Sequence[float] | None
) -> FloatArray:
    """Derivatives (3,) [Pa] of the energy by the principal stretches."""
    value = constants.get
    s = np.array([stretch, *sides])
    other = np.array([s[1] * s[2], s[0] * s[2], s[0] * s[1]])  # Derivatives of J.
    j, squares = float(np.prod(s)) - 1.0, s * s
    first, second = float(squares.sum()), float((other * other).sum())
    a, b = first - 3.0 - 2.0 * j + j * j, second - 3.0 - 4.0 * j
    a_slope, b_slope = 2.0 * s + 2.0 * (j - 1.0) * other, 2.0 * s * (first - squares) - 4.0 * other
    slopes = a_slope * (value("c10", 0.0) + 2.0 * value("c20", 0.0) * a + 3.0 * value("c30", 0.0) * a * a)
    slopes += b_slope * (value("c01", 0.0) + 2.0 * value("c02", 0.0) * b)
    slopes += other * (2.0 * (value("dilation", 0.0) + value("bulk_1", 0.0)) * j + 4.0 * value("bulk_2", 0.0) * j**3)
    for n, mu in ogden_terms(constants).items():
        if n > 0:
            own = n * s ** (n - 1) + n * (j - 1.0) * other
        else:
            powers = s ** (-n)
            own = -n * s ** (-n - 1) * (powers.sum() - powers) + 2.0 * n * other
        slopes += 2.0 * mu / n**2 * own
    if direction is not None:
        slopes += _fibre_slopes(constants, s, np.square(np.asarray(direction, dtype=np.float64)))
    return slopes


def _fibre_slopes(constants: Mapping[str, float], s: FloatArray, along: FloatArray) -> FloatArray:
    """Derivatives (3,) [Pa] of the energy of the first family, with squared cosines of its direction (3,)."""
    tension, stiffening, compression, slack, toe = (
        constants.get(f"fibre_{name}_1", 0.0) for name in ("tension", "stiffening", "compression", "slack", "toe")
    )
    length = float(np.sqrt(along @ (s * s)))
    q = length * length - 1.0
    strain = max(length - 1.0 - slack, 0.0)
    t = min(strain / toe, 1.0) if toe > 0.0 else 1.0
    force = toe * t**3 * (1.0 - 0.5 * t) if t < 1.0 else strain - 0.5 * toe
    by_length = tension * force
    by_length += 2.0 * length * (3.0 * stiffening * max(q, 0.0) ** 2 - 2.0 * compression * max(-q, 0.0))
    return by_length * along * s / length
