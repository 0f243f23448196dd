"""Rubber of convex terms with non-negative coefficients, with families of fibres."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from numbers import Integral
from typing import Any, ClassVar, NamedTuple

import torch
from typing_extensions import override

from ...io.errors import InputError
from ...kernels.materials.convex import ISOTROPIC, convex_law
from ..stepping.quantity import Parameter, Quantity, parameter
from .materials import PRONY_TIME_QUANTITY, Material


def _modulus(name: str) -> Quantity:
    return Quantity(name, "Pa", 0.0, closed=True, per="element")


class FibreFamily(NamedTuple):
    """Fibres along e = (cos beta cos alpha, cos beta sin alpha, sin beta) at rest,
    of stretch l = |F e|, q = l^2 - 1.

    Numbers, or a value for each element of a curved body. The axes are those of the mesh.

    Args:
        azimuth: alpha [rad].
        elevation: beta [rad].
        slack: strain up to which a fibre is wavy; it pulls beyond the stretch 1 + slack.
        toe: strain beyond the slack over which the fibre tightens.
        tension: coefficient [Pa] of (l - 1 - slack)^2 / 2.
        stiffening: coefficient [Pa] of q^3 where q > 0.
        compression: coefficient [Pa] of q^2 where q < 0; not convex.
    """

    azimuth: Parameter = 0.0
    elevation: Parameter = 0.0
    slack: Parameter = 0.0
    toe: Parameter = 0.02
    tension: Parameter = 0.0
    stiffening: Parameter = 0.0
    compression: Parameter = 0.0


@dataclass(frozen=True)
class ConvexMaterial(Material):
    """Rubber of terms with non-negative coefficients:
    powers of invariants, Ogden's terms, and families of fibres.

    With c10 and c01 alone it is `MooneyRivlin`, with c10, c20 and c30 the rubber of Yeoh (1993),
    with `ogden` alone that of Ogden (1972). Viscosities and branches have moduli of their own,
    independent of the elastic coefficients, so that forces are linear in all coefficients. The
    elastic energy is polyconvex; viscosities and branches are functions of the strain of Green, and
    outside of that argument. Coefficients are zero by default, but for `bulk_1`.

    Attributes:
        c10, c20, c30: coefficients [Pa] of a, a^2 and a^3, with a of `kernels.materials.convex`,
            near I1 - 3.
        c01, c02: coefficients [Pa] of b and b^2, near I2 - 3.
        dilation: coefficient [Pa] of (J - 1)^2 at the points where shape is integrated.
        bulk_1, bulk_2: coefficients [Pa] of (J - 1)^2 and (J - 1)^4 at the volume points.
        shear_viscosity, bulk_viscosity: eta and zeta [Pa s] of the stress 2 eta E' + zeta tr(E') I,
            with the rate E' of Green's strain; the pressure in a pure change of volume is (zeta + 2
            eta / 3) tr(E').
        ogden: shear moduli [Pa] of Ogden's terms at small strains, by exponent, a whole number.
        fibres: families of fibres, see `FibreFamily`.
        prony: moduli [Pa] and relaxation times [s] of branches.
    """

    model = "law"
    groups: ClassVar[Mapping[str, tuple[Quantity, ...]]] = {
        "prony": (Quantity("prony_modulus", "Pa", 0.0, closed=True), PRONY_TIME_QUANTITY),
        "fibres": (
            Quantity("fibre_azimuth", "rad", per="element"),
            Quantity("fibre_elevation", "rad", per="element"),
            Quantity("fibre_slack", "", 0.0, closed=True, per="element"),
            Quantity("fibre_toe", "", 0.0, per="element"),
            *map(_modulus, ("fibre_tension", "fibre_stiffening", "fibre_compression")),
        ),
    }

    c10: Parameter = parameter(0.0, "c10", "Pa", closed=True)
    c20: Parameter = parameter(0.0, "c20", "Pa", closed=True)
    c30: Parameter = parameter(0.0, "c30", "Pa", closed=True)
    c01: Parameter = parameter(0.0, "c01", "Pa", closed=True)
    c02: Parameter = parameter(0.0, "c02", "Pa", closed=True)
    dilation: Parameter = parameter(0.0, "dilation", "Pa", closed=True)
    bulk_1: Parameter = parameter(22e6, "bulk_1", "Pa", closed=True)
    bulk_2: Parameter = parameter(0.0, "bulk_2", "Pa", closed=True)
    shear_viscosity: Parameter = parameter(
        0.0, "shear_viscosity", "Pa s", closed=True, kw_only=True
    )
    bulk_viscosity: Parameter = parameter(0.0, "bulk_viscosity", "Pa s", closed=True, kw_only=True)
    ogden: Mapping[int, Parameter] = field(default_factory=dict, kw_only=True)
    fibres: Sequence[FibreFamily] = field(default=(), kw_only=True)
    stiffness_damping: Parameter = field(default=0.0, init=False, repr=False)  # viscosities instead

    def __post_init__(self) -> None:
        """Builds the law.

        Raises:
            InputError: a coefficient is negative or not finite, or an exponent is not a whole
                number of at least 3 in size.
        """
        wrong = [n for n in self.ogden if not isinstance(n, Integral) or -3 < n < 3]
        if wrong:
            raise InputError(
                f"ogden has the exponent {wrong[0]}: give whole numbers from 3 up or from -3 down."
            )
        terms, families = len(self.ogden), len(self.fibres)
        law = {
            "law": convex_law(tuple(self.ogden), families),
            "rules": (*("shape",) * 6, "volume", "volume", "shape", "volume", *("shape",) * terms)
            + (*("mean",) * 5, *("shape",) * 3) * families,
            "curvature": (4.0, 0.0, 0.0, 4.0, 0.0, 2.0, 2.0, 0.0, 0.0, 0.0, *(2.0,) * terms)
            + (*(0.0,) * 5, 1.0, 0.0, 8.0) * families,
        }
        for name, value in law.items():
            object.__setattr__(self, name, value)
        super().__post_init__()

    def __getstate__(self) -> dict[str, Any]:
        """Returns the arguments, of which a copy is built:
        the kernel's functions belong to a process.
        """
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Builds a copy from its arguments."""
        vars(self).update(state)
        self.__post_init__()

    @property
    @override
    def numbered(self) -> dict[str, tuple[Quantity, Parameter]]:
        """As of every material, and ``ogden_3``, ``ogden_m3`` for the exponent -3, ..."""
        ogden = {name: (_modulus(name), self.ogden[n]) for n, name in self._ogden.items()}
        return {**super().numbered, **ogden}

    @property
    def _ogden(self) -> dict[int, str]:
        return {n: f"ogden_{n}".replace("-", "m") for n in self.ogden}

    @override
    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> "Material":
        found = {name: re.fullmatch(r"ogden_(m?)(\d+)", name) for name in parameters}
        ogden = {
            int(m[2]) * (-1 if m[1] else 1): parameters[name] for name, m in found.items() if m
        }
        others = {name: value for name, value in parameters.items() if not found[name]}
        return cls(**cls._arguments(others), ogden=ogden)

    @override
    def viscosity(
        self, parameters: Mapping[str, torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        return parameters["shear_viscosity"], parameters["bulk_viscosity"]

    @override
    def moduli(self, parameters: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Returns the coefficients, units of viscosity, Ogden's terms,
        and direction and parameters of each family.
        """
        moduli = [parameters[name] for name in list(self.unnumbered())[:ISOTROPIC]]
        moduli += [torch.ones_like(moduli[0])] * 2
        moduli += [parameters[name] for name in self._ogden.values()]
        for azimuth, elevation, *coefficients in self.group("fibres", parameters):
            level = elevation.cos()
            moduli += [level * azimuth.cos(), level * azimuth.sin(), elevation.sin(), *coefficients]
        return tuple(moduli)
