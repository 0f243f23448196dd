"""An elastic material whose energy is an input-convex neural network of invariants (`kernels.materials.neural`)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import torch
from torch.nn.functional import softplus
from typing_extensions import override

from ..io.errors import InputError
from ..kernels.materials import neural
from ..kernels.materials.neural import LENGTH, LENGTH_J, UNITS, WEIGHTS
from ..stepping.quantity import Parameter, Quantity
from .materials import Material, constant

ENERGY = 100e3 * LENGTH  # S [J/m^3]: with weights of one, moduli of the order of 100 kPa
_UNITS_SHARE = 0.1  # of initial weights: contribution of the units to mu and to viscosity at rest
_SHAPES = ((UNITS, 4), (UNITS, UNITS), (UNITS, 4), (UNITS,), (2,), (1,), (3, UNITS))
_SECOND_SHARE = 0.2  # of initial weights: contribution of the second invariant to the remaining mu

_WEIGHT = "weight_"  # of the names of single weights

Parts = tuple[torch.Tensor, ...]


def parts(values: torch.Tensor) -> Parts:
    """Splits values (..., W) into (R, r), C, (Q, q), u, k, kappa and (v, g, e) of `kernels.materials.neural`.

    The shapes are (..., U, 4), (..., U, U), (..., U, 4), (..., U), (..., 2), (..., 1) and (..., 3, U), for U units in
    each layer.
    """
    pieces = values.split([math.prod(shape) for shape in _SHAPES], -1)
    return tuple(piece.unflatten(-1, shape) for piece, shape in zip(pieces, _SHAPES, strict=True))


def _joined(own: Parts) -> torch.Tensor:
    return torch.cat([piece.flatten() for piece in own])


def _non_negative(like: torch.Tensor) -> torch.Tensor:
    """Marks the values (W,) that must not be negative."""
    first, coupling, second, output, direct, linear, rate = (
        torch.ones(shape, dtype=torch.bool, device=like.device) for shape in _SHAPES
    )
    first[:, 2:] = second[:, 2:] = rate[2] = False
    return _joined((first, coupling, second, output, direct, linear, rate))


def bounded(weights: torch.Tensor) -> torch.Tensor:
    """Returns the values (..., W) of the network: ln(1 + exp(w)) for those that must not be negative, else w."""
    return torch.where(_non_negative(weights), softplus(weights), weights)


def at_rest(values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns the network (...), its gradient (..., 3) and its second derivative by the third input (...), at rest."""
    first, coupling, second, output, direct, *_ = parts(values)
    h, y = first[..., 3], second[..., 3]
    root = (h.square() + 1.0).sqrt()
    slopes = (0.5 + 0.5 * h / root)[..., None] * first[..., :3]
    y = y + torch.einsum("...ki,...k->...i", coupling, 0.5 * (h + root))
    along = second[..., :3] + torch.einsum("...ki,...kc->...ic", coupling, slopes)
    outer = (y.square() + 1.0).sqrt()
    back = output * (0.5 + 0.5 * y / outer)
    value = (output * 0.5 * (y + outer)).sum(-1)
    gradient = torch.nn.functional.pad(direct, (0, 1)) + torch.einsum("...i,...ic->...c", back, along)
    through = torch.einsum("...ki,...i->...k", coupling, back)
    curvature = (0.5 * output / outer**3 * along[..., 2].square()).sum(-1)
    return value, gradient, curvature + (0.5 * through / root**3 * first[..., 2].square()).sum(-1)


def lame(values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the contributions (...) of the network to the Lame constants mu and lambda at small strains [Pa]."""
    _, gradient, curvature = at_rest(values)
    return 2.0 * ENERGY / LENGTH * (gradient[..., 0] + gradient[..., 1]), ENERGY / LENGTH_J**2 * curvature


def viscous_slope(linear: torch.Tensor, rate: torch.Tensor) -> torch.Tensor:
    """Returns phi'(0) (...) from kappa (..., 1) and v, g, e (..., 3, U): viscosity over that of Kelvin and Voigt."""
    v, g, e = rate.unbind(-2)
    return linear[..., 0] + 0.5 * (v * g * (0.5 + 0.5 * e / (e.square() + 1.0).sqrt())).sum(-1)


def initial_weights(shear_modulus: float, lame_lambda: float, seed: int = 0) -> torch.Tensor:
    """Returns random weights (W,) with a shear modulus mu at small strains, and at most mu and half of lambda.

    Most of mu is that of the terms that are linear in the invariants, so that the material is near `MooneyRivlin`; most
    of lambda is left to the terms at volume points, against locking. At small rates viscosity is that of Kelvin and
    Voigt.

    Args:
        shear_modulus: mu [Pa].
        lame_lambda: lambda of the whole material [Pa].
        seed: seed of the random numbers.
    """
    random = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=random, dtype=torch.float64)

    def rows() -> torch.Tensor:
        """Units that bend between rest and stretches of 1.5."""
        return torch.cat([uniform(0.1, 1.0, UNITS, 2), uniform(-1.0, 1.0, UNITS, 1), uniform(-2.0, 0.5, UNITS, 1)], 1)

    first, coupling, second, output = rows(), uniform(0.0, 2.0 / UNITS, UNITS, UNITS), rows(), uniform(0.1, 1.0, UNITS)
    direct, linear = (torch.zeros(n, dtype=torch.float64) for n in (2, 1))
    rate = torch.cat([uniform(0.1, 1.0, 2, UNITS), uniform(-2.0, 0.5, 1, UNITS)])
    rate[0] *= _UNITS_SHARE / viscous_slope(linear, rate)
    linear += 1.0 - _UNITS_SHARE
    viscous = linear, rate
    own, _ = lame(_joined((first, coupling, second, output, direct, *viscous)))
    output = output * (_UNITS_SHARE * shear_modulus / own)
    rest = (1.0 - _UNITS_SHARE) * shear_modulus * LENGTH / (2.0 * ENERGY)
    direct += rest * torch.tensor([1.0 - _SECOND_SHARE, _SECOND_SHARE], dtype=torch.float64)
    _, volume = lame(_joined((first, coupling, second, output, direct, *viscous)))
    smaller = (min(0.5 * lame_lambda, shear_modulus) / volume).sqrt().clamp_max(1.0)
    first[:, 2] *= smaller
    second[:, 2] *= smaller
    values = _joined((first, coupling, second, output, direct, *viscous))
    return torch.where(_non_negative(values), values + torch.log(-torch.expm1(-values)), values)


@dataclass(frozen=True)
class NeuralMaterial(Material):
    """Rubber whose polyconvex energy is a network of a few hundred weights, beside two terms of the volume.

    The network is that of ``kernels.materials.neural``, convex and without stress at rest for any real weights:
    `bounded` makes those positive that must be. All elements share the weights. Its viscosity depends on the rate: the
    network gives phi of |A|, where A is the retardation time `stiffness_damping` times the rate of strain, plus the
    strains in the Prony branches, if there are any; without either there is no viscosity. The viscosity of volume
    changes is that of Kelvin and Voigt.
    """

    model = "neural_law"
    law = neural
    rules: ClassVar[tuple[str, ...]] = ("shape", "shape", "shape", "volume", "volume")
    curvature: ClassVar[tuple[float, ...]] = (0.0, 2.0, 1.0, 2.0, 0.0)

    # (W,) or (B, W), with one set of weights for each environment
    weights: Parameter = field(
        default_factory=lambda: initial_weights(88e3, 44e6),
        metadata={"quantity": Quantity("weights", "", shape=(WEIGHTS,))},
    )
    bulk_1: Parameter = constant(22e6, "bulk_1", "Pa", closed=True)  # g_2, of j^2 [Pa]
    bulk_2: Parameter = constant(0.0, "bulk_2", "Pa", closed=True)  # g_4, of j^4 [Pa]

    @classmethod
    def from_lame(cls, shear_modulus: float, lame_lambda: float, seed: int = 0, **constants: Any) -> Self:
        """Returns a material of random weights that has the given Lame constants at small strains.

        Args:
            shear_modulus: mu [Pa].
            lame_lambda: lambda [Pa].
            seed: seed of the weights.
            constants: other constants, such as `density`.
        """
        weights = initial_weights(shear_modulus, lame_lambda, seed)
        volume = float(lame(bounded(weights))[1])
        return cls(weights, 0.5 * (lame_lambda - volume), **constants)

    @override
    @classmethod
    def from_constants(cls, constants: Mapping[str, Any]) -> "Material":
        """Returns the material with some constants by name, the weights as ``weight_1``, ``weight_2``, ...

        Raises:
            InputError: an unknown constant, some but not all weights, or a value out of range.
        """
        names = [f"{_WEIGHT}{k}" for k in range(1, 1 + WEIGHTS)]
        given = {name: value for name, value in constants.items() if name.startswith(_WEIGHT)}
        if not given:
            return super().from_constants(constants)
        if given.keys() != {*names}:
            raise InputError(f"neural_law has {len(given)} weights: give weight_1 to weight_{WEIGHTS}, or none.")
        weights = torch.tensor([float(given[name]) for name in names], dtype=torch.float64)
        others = {name: value for name, value in constants.items() if name not in given}
        return cls(**cls._arguments(others), weights=weights)

    @override
    def moduli(self, constants: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Returns S, the contributions of the network to mu and lambda at small strains, g_2 and g_4."""
        mu, volume = (value[..., None] for value in lame(bounded(constants["weights"])))
        return torch.full_like(mu, ENERGY), mu, volume, constants["bulk_1"], constants["bulk_2"]

    @override
    def shared(self, constants: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Returns the values of the network, and the constants that are subtracted: N(0), n and M(0)."""
        values = bounded(constants["weights"])
        value, gradient, _ = at_rest(values)
        v, _, e = parts(values)[-1].unbind(-2)
        dissipated = (0.5 * v * (e + (e.square() + 1.0).sqrt())).sum(-1)
        return torch.cat([values, value[..., None], gradient[..., 2:], dissipated[..., None]], -1)


def weight_constants(weights: torch.Tensor) -> dict[str, float]:
    """Returns weights (W,) as constants by name, for `NeuralMaterial.from_constants`."""
    return {f"{_WEIGHT}{k}": value for k, value in enumerate(weights.tolist(), 1)}
