r"""Isotropic elastic materials and their constants.

=======================  ==================================================  ====================================
material                 shape terms                                         volume term
=======================  ==================================================  ====================================
`Corotated`              ``mu ||F - R(F)||^2``                               ``lambda / 2 ||F - D(F)||^2``
`StableNeoHookean`       ``mu/2 (||F||^2 - 3) - mu (J - 1) + mu/2 (J-1)^2``  ``lambda / 2 (J - 1)^2``
`MooneyRivlin`           that with c10 = mu/2, ``c01 ((I2 - 3) - 4 (J-1))``  ``lambda / 2 (J - 1)^2``
=======================  ==================================================  ====================================

R is the rotation of the polar decomposition, D the nearest matrix of determinant one, J = det F. The equations and
their sources are in ``kernels.materials``. Shape and volume terms may be integrated at different points.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import ModuleType
from typing import Any, ClassVar

import torch
from typing_extensions import override

from ..io.errors import InputError
from ..kernels.materials import corotated, mooney_rivlin, stable_neo_hookean
from .base import Parameter, Quantity


def constant(default: float, name: str, unit: str, lower: float = 0.0, **more: Any) -> Any:
    """A field of a material: its default, and the quantity that it is; `density`, say, is a common keyword."""
    common = more.pop("common", False)
    quantity = Quantity(name, unit, lower, **{"per": "element", **more})
    return field(default=default, kw_only=common, metadata={"quantity": quantity})


@dataclass(frozen=True)
class Material(ABC):
    """Constants of an elastic material with Rayleigh damping.

    The elastic constants and the density are numbers, (M,) tensors with a value for each element, (B, 1) tensors with a
    value for each environment of a batch, or (B, M) tensors; the damping constants are numbers or (B,) tensors. Tensors
    that require gradients receive them from every simulated quantity.
    """

    law: ClassVar[ModuleType]  # the module of ``kernels.materials``
    # for each modulus of the law, whether it belongs to the ``shape`` or the ``volume`` rule of integration
    rules: ClassVar[tuple[str, ...]]
    # for each modulus, an upper bound of what it adds to the tangent's eigenvalues for small strains
    curvature: ClassVar[tuple[float, ...]]

    density: Parameter = constant(1070.0, "density", "kg/m^3", common=True)  # rho [kg/m^3]
    # force -alpha M v [1/s]
    mass_damping: Parameter = constant(0.0, "mass_damping", "1/s", closed=True, per="", common=True)
    # Kelvin-Voigt viscosity of retardation time beta [s]; for small strains the force -beta K v
    stiffness_damping: Parameter = constant(0.0, "stiffness_damping", "s", closed=True, per="", common=True)

    def __post_init__(self) -> None:
        """Checks every constant; raises InputError for a constant outside its physical range."""
        for name, quantity in self.quantities().items():
            quantity.check(getattr(self, name))

    @classmethod
    def quantities(cls) -> dict[str, Quantity]:
        """Its constants by name: those of the law first."""
        found = {each.name: each.metadata["quantity"] for each in fields(cls)}
        common = [each.name for each in fields(cls) if each.kw_only]
        return {name: found[name] for name in sorted(found, key=common.__contains__)}

    @property
    def constants(self) -> dict[str, Parameter]:
        """Their values."""
        return {name: getattr(self, name) for name in self.quantities()}

    @abstractmethod
    def moduli(self, constants: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """The law's moduli [Pa], each (1 or B, 1 or M), of constants of that shape."""


@dataclass(frozen=True)
class _Hookean(Material):
    """A material that is given by Young's modulus and Poisson's ratio."""

    rules: ClassVar[tuple[str, ...]] = ("shape", "volume")
    curvature: ClassVar[tuple[float, ...]] = (2.0, 1.0)

    youngs_modulus: Parameter = constant(264e3, "youngs_modulus", "Pa")  # E [Pa]
    poissons_ratio: Parameter = constant(0.499, "poissons_ratio", "", lower=-1.0, upper=0.5)  # nu, between -1 and 0.5

    @override
    def moduli(self, constants: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """The Lame constants mu and lambda."""
        e, nu = constants["youngs_modulus"], constants["poissons_ratio"]
        return e / (2.0 * (1.0 + nu)), e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


@dataclass(frozen=True)
class Corotated(_Hookean):
    """The material of projective dynamics: for small strains, linear elasticity with lambda / 3.

    It bends a little less stiffly than its nominal constants: nu 0.45 acts as 0.375, nu 0.499 as 0.497.
    """

    law = corotated


@dataclass(frozen=True)
class StableNeoHookean(_Hookean):
    """A neo-Hookean solid that stays finite where elements invert, and is linear elasticity for small strains."""

    law = stable_neo_hookean


@dataclass(frozen=True)
class MooneyRivlin(Material):
    """Rubber with two elastic constants and a bulk modulus; for small strains mu is 2 (c10 + c01)."""

    law = mooney_rivlin
    rules: ClassVar[tuple[str, ...]] = ("shape", "shape", "volume")
    curvature: ClassVar[tuple[float, ...]] = (4.0, 4.0, 1.0)

    c10: Parameter = constant(36e3, "c10", "Pa")  # of the first invariant [Pa]
    c01: Parameter = constant(8e3, "c01", "Pa", closed=True)  # of the second [Pa]
    bulk_modulus: Parameter = constant(44e6, "bulk_modulus", "Pa")  # [Pa]

    @override
    def moduli(self, constants: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """c10, c01 and lambda = K - 2/3 mu."""
        c10, c01 = constants["c10"], constants["c01"]
        return c10, c01, constants["bulk_modulus"] - 4.0 / 3.0 * (c10 + c01)


MATERIALS: dict[str, type[Material]] = {
    "corotated": Corotated,
    "stable_neo_hookean": StableNeoHookean,
    "mooney_rivlin": MooneyRivlin,
}


def make_material(model: str = "corotated", **constants: Any) -> Material:
    """The named material.

    Raises:
        InputError: an unknown name, a constant that the material does not have, or one out of range.
    """
    if model not in MATERIALS:
        raise InputError(f"material model is {model!r}: choose one of {', '.join(MATERIALS)}.")
    known = MATERIALS[model].quantities()
    for name in constants:
        if name not in known:
            raise InputError(f"{model} has no constant {name!r}: it has {', '.join(known)}.")
    return MATERIALS[model](**constants)
