r"""Elastic materials, isotropic but for `convex_material.ConvexMaterial` with families of fibres.

==================  ==================================================  ==========================
material            shape terms                                         volume term
==================  ==================================================  ==========================
`Corotated`         ``mu ||F - R(F)||^2``                               ``lambda/2 ||F - D(F)||^2``
`StableNeoHookean`  ``mu/2 (||F||^2 - 3) - mu (J - 1) + mu/2 (J-1)^2``  ``lambda/2 (J - 1)^2``
`MooneyRivlin`      W_s (mu = 2 c10) ``+ c01 ((I2 - 3) - 4 (J-1))``     ``lambda/2 (J - 1)^2``
`Gent`              ``-J_m mu / 2 ln(1 - 2 W_s / (J_m mu))``            ``lambda/2 (J - 1)^2``
`ConvexMaterial`    powers of invariants, Ogden's terms, and fibres     powers of J - 1
==================  ==================================================  ==========================

R is the rotation of the polar decomposition, D the nearest matrix of determinant one, J = det F,
W_s the shape terms of `StableNeoHookean`. Sources are in ``kernels.materials``. Shape and volume
terms may be integrated at different points.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import chain
from typing import Any, ClassVar, Final

import torch
from typing_extensions import override

from ...io.errors import InputError
from ...kernels.laws import Law
from ...kernels.materials import corotated, gent, mooney_rivlin
from ...kernels.materials.density import density_law
from ..stepping.quantity import Parameter, Quantity, parameter, quantities_of

MASS_DAMPING: Final = "mass_damping"
# parameters of viscosity, whose names end so if they are those of a region
VISCOUS: Final = ("stiffness_damping", "shear_viscosity", "bulk_viscosity")
# Likewise, of relaxation, and of the times with their numbers.
PRONY_RATIOS: Final = ("prony_ratio", "prony_modulus")
PRONY_TIME: Final = "prony_time"
PRONY_TIME_QUANTITY = Quantity(PRONY_TIME, "s", 0.0)
_ITEMS: Final = {"prony": "branch", "fibres": "family"}  # of groups


@dataclass(frozen=True)
class Material(ABC):
    """An elastic material with Rayleigh damping and relaxation.

    Elastic parameters and density are numbers, (M,) tensors with one value per element, (B, 1)
    tensors with one value per environment, or (B, M) tensors; damping parameters are numbers or
    (B,) tensors. Every simulated quantity is differentiable by them.
    """

    model: ClassVar[str] = ""  # name in configurations, if it has one
    law: ClassVar[Law]  # energy of a point and its derivatives
    # integration of each modulus of the law: ``shape`` or ``volume`` rule, or ``mean`` over the
    # volume of a point
    rules: ClassVar[tuple[str, ...]]
    # upper bound of each modulus' contribution to the tangent's eigenvalues at small strains
    curvature: ClassVar[tuple[float, ...]]
    # parameters of each item of a field that is a sequence, such as a branch or a family of fibres,
    # by the field
    groups: ClassVar[Mapping[str, tuple[Quantity, ...]]] = {
        "prony": (Quantity("prony_ratio", "", 0.0, closed=True), PRONY_TIME_QUANTITY)
    }

    density: Parameter = parameter(1070.0, "density", "kg/m^3", per="element", kw_only=True)  # rho
    # alpha [1/s] of the force -alpha M v
    mass_damping: Parameter = parameter(0.0, MASS_DAMPING, "1/s", closed=True, kw_only=True)
    # Kelvin-Voigt retardation time beta [s]; at small strains the force -beta K v
    stiffness_damping: Parameter = parameter(
        0.0, "stiffness_damping", "s", closed=True, kw_only=True
    )
    # generalised Maxwell (Prony) branches: ratio of the shear modulus to the long-term modulus mu,
    # and relaxation time [s] (`energies.viscosity`)
    prony: Sequence[tuple[Parameter, Parameter]] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        """Raises InputError for a parameter outside its physical range."""
        for group, quantities in self.groups.items():
            items = getattr(self, group)
            if not all(
                isinstance(item, Sequence) and len(item) == len(quantities) for item in items
            ):
                names = ", ".join(q.name.partition("_")[2] for q in quantities)
                units = " and ".join(q.unit or "-" for q in quantities)
                raise InputError(
                    f"{group} is {items!r}: give a ({names}) for each {_ITEMS[group]}, {units}."
                )
        values = self.values
        for name, quantity in self.parameters.items():
            quantity.check(values[name])

    @classmethod
    def unnumbered(cls) -> dict[str, Quantity]:
        """Returns the parameters by name without those of groups, those of the law first."""
        known = quantities_of(cls)
        law = {
            f.name: replace(known[f.name], per="element")
            for f in fields(cls)
            if f.name in known and not f.kw_only
        }
        return {**law, **{name: quantity for name, quantity in known.items() if name not in law}}

    @property
    def numbered(self) -> dict[str, tuple[Quantity, Parameter]]:
        """Parameters of groups with their values: ``prony_ratio_1``, ``prony_time_1``, ..."""
        return {
            f"{q.name}_{k}": (replace(q, name=f"{q.name}_{k}"), value)
            for group, quantities in self.groups.items()
            for k, item in enumerate(getattr(self, group), 1)
            for q, value in zip(quantities, item, strict=True)
        }

    @property
    def parameters(self) -> dict[str, Quantity]:
        """Parameters by name, those of the law first."""
        return {
            **self.unnumbered(),
            **{name: quantity for name, (quantity, _) in self.numbered.items()},
        }

    @property
    def values(self) -> dict[str, Parameter]:
        """Values of the parameters by name."""
        known = {name: getattr(self, name) for name in self.unnumbered()}
        return {**known, **{name: value for name, (_, value) in self.numbered.items()}}

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> "Material":
        """Returns the material with some parameters by name, those of groups numbered from 1.

        Raises:
            InputError: an unknown parameter, a branch that is not whole, or a value out of range.
        """
        return cls(**cls._arguments(parameters))

    @classmethod
    def _arguments(cls, parameters: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the arguments of the class: parameters, and the items of groups."""
        known_quantities = cls.unnumbered()
        values, groups = dict(parameters), {}
        for group, quantities in cls.groups.items():
            names = {q.name for q in quantities}
            present = {name for name in parameters if re.sub(r"_[1-9]\d*$", "", name) in names}
            count = len({re.findall(r"\d+$", name)[-1] for name in present if name not in names})
            items = [[f"{q.name}_{k}" for q in quantities] for k in range(1, 1 + count)]
            if present != {*chain.from_iterable(items)}:
                raise InputError(
                    f"{group} has {', '.join(sorted(present))}: give each {_ITEMS[group]}, "
                    f"numbered from 1, its {' and its '.join(f'{q.name}_' for q in quantities)}."
                )
            groups[group] = [tuple(values.pop(name) for name in item) for item in items]
        for name in values:
            if name not in known_quantities:
                numbered = [f"{q.name}_1" for q in chain.from_iterable(cls.groups.values())]
                known = ", ".join((*known_quantities, *numbered, "..."))
                model = cls.model or cls.__name__
                raise InputError(f"{model} has no parameter {name!r}: it has {known}")
        return {**values, **groups}

    def group(
        self, name: str, parameters: Mapping[str, torch.Tensor]
    ) -> list[tuple[torch.Tensor, ...]]:
        """Returns the parameters of each item of a group."""
        items = range(1, 1 + len(getattr(self, name)))
        return [tuple(parameters[f"{q.name}_{k}"] for q in self.groups[name]) for k in items]

    def viscosity(
        self, parameters: Mapping[str, torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the Kelvin-Voigt retardation times of shear and bulk [s], (1 or B, 1) each."""
        return (parameters["stiffness_damping"],) * 2

    @abstractmethod
    def moduli(self, parameters: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Returns the law's moduli [Pa], (1 or B, 1 or M) each, from parameters of that shape."""


@dataclass(frozen=True)
class _Hookean(Material):
    """A material with Young's modulus and Poisson's ratio as parameters."""

    rules: ClassVar[tuple[str, ...]] = ("shape", "volume")
    curvature: ClassVar[tuple[float, ...]] = (2.0, 1.0)

    youngs_modulus: Parameter = parameter(264e3, "youngs_modulus", "Pa")  # E [Pa]
    poissons_ratio: Parameter = parameter(0.499, "poissons_ratio", "", lower=-1.0, upper=0.5)  # nu

    @override
    def moduli(self, parameters: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Returns the Lame constants mu and lambda."""
        e, nu = parameters["youngs_modulus"], parameters["poissons_ratio"]
        return e / (2.0 * (1.0 + nu)), e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


@dataclass(frozen=True)
class Corotated(_Hookean):
    """The material of projective dynamics: at small strains, linear elasticity with lambda / 3.

    The effective Poisson's ratio is lower than the nominal one: 0.375 for 0.45, 0.497 for 0.499.
    """

    model = "corotated"
    law = corotated.LAW


@dataclass(frozen=True)
class StableNeoHookean(_Hookean):
    """A neo-Hookean material, finite for inverted elements,
    and linear elasticity at small strains.
    """

    model = "stable_neo_hookean"
    law = mooney_rivlin.LAW
    rules: ClassVar[tuple[str, ...]] = ("shape", "shape", "volume")
    curvature: ClassVar[tuple[float, ...]] = (4.0, 4.0, 1.0)

    @override
    def moduli(self, parameters: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Returns c10, c01 = 0 and lambda."""
        mu, bulk = super().moduli(parameters)
        return 0.5 * mu, torch.zeros_like(mu), bulk


@dataclass(frozen=True)
class MooneyRivlin(Material):
    """Rubber with two elastic parameters and a bulk modulus.

    At small strains mu is 2 (c10 + c01).
    """

    model = "mooney_rivlin"
    law = mooney_rivlin.LAW
    rules: ClassVar[tuple[str, ...]] = ("shape", "shape", "volume")
    curvature: ClassVar[tuple[float, ...]] = (4.0, 4.0, 1.0)

    c10: Parameter = parameter(36e3, "c10", "Pa")  # coefficient of the first invariant [Pa]
    c01: Parameter = parameter(8e3, "c01", "Pa", closed=True)  # of the second invariant [Pa]
    bulk_modulus: Parameter = parameter(44e6, "bulk_modulus", "Pa")  # [Pa]

    @override
    def moduli(self, parameters: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Returns c10, c01 and lambda = K - 2/3 mu."""
        c10, c01 = parameters["c10"], parameters["c01"]
        return c10, c01, parameters["bulk_modulus"] - 4.0 / 3.0 * (c10 + c01)


@dataclass(frozen=True)
class DensityMaterial(Material):
    """A material given by Warp functions of F and its parameters, in their order [J/m^3].

    The functions may be nonlinear in the parameters. `volume_energy` is integrated at fewer points,
    against locking: the term that makes a material nearly incompressible belongs there.

    Attributes:
        energy_density: W(F: mat33d, p: a vector of float64).
        volume_energy: U, likewise; may be None.
    """

    energy_density: ClassVar[Any]
    volume_energy: ClassVar[Any] = None

    def __init_subclass__(cls, **more: Any) -> None:
        """Builds the law from the functions."""
        super().__init_subclass__(**more)
        cls.law = density_law(
            f"{cls.__module__}.{cls.__name__}",
            cls.energy_density,
            cls.volume_energy or cls.energy_density,
        )
        count = len(cls.law.lame) - 4
        cls.rules = ("shape", "volume", "shape", "volume", *("mean",) * count)
        cls.curvature = (0.0, 0.0, 2.0, 1.0, *(0.0,) * count)

    @abstractmethod
    def lame(self, parameters: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the Lame constants at small strains,
        mu and lambda [Pa], from parameters (1 or B, 1 or M).
        """

    @override
    def moduli(self, parameters: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Returns ones for both volumes, the Lame constants, and the parameters of functions."""
        moduli_of_law = [parameters[f.name] for f in fields(self) if f.metadata and not f.kw_only]
        volume = torch.ones_like(moduli_of_law[0])
        under_integrated = volume if self.volume_energy else torch.zeros_like(volume)
        return volume, under_integrated, *self.lame(parameters), *moduli_of_law


@dataclass(frozen=True)
class Gent(DensityMaterial):
    """Rubber that stiffens without bound as its chains approach their full length (Gent 1996).

    For a large limit J_m it is `StableNeoHookean`. Beyond 95 % of the limit the energy is continued
    as a parabola, so that iterates of a search may exceed the limit.
    """

    model = "gent"
    energy_density: ClassVar[Any] = gent.energy_density
    volume_energy: ClassVar[Any] = gent.volume_energy

    shear_modulus: Parameter = parameter(90e3, "shear_modulus", "Pa")  # mu [Pa]
    limit: Parameter = parameter(30.0, "limit", "")  # J_m, limit of I1 - 3
    bulk_modulus: Parameter = parameter(44e6, "bulk_modulus", "Pa")  # K [Pa]

    @override
    def lame(self, parameters: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns mu and K - 2/3 mu."""
        mu = parameters["shear_modulus"]
        return mu, parameters["bulk_modulus"] - 2.0 / 3.0 * mu
