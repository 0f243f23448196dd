r"""Isotropic elastic materials and their constants.

Two energies share one interface; both split into a shape and a volume term that may be integrated differently:

=====================  ==================================================  ========================================
model                  shape term                                          volume term
=====================  ==================================================  ========================================
``corotated``          ``mu ||F - R(F)||^2``                               ``lambda / 2 ||F - D(F)||^2``
``stable_neo_hookean`` ``mu/2 (||F||^2 - 3) - mu (J - 1) + mu/2 (J-1)^2``  ``lambda / 2 (J - 1)^2``
=====================  ==================================================  ========================================

R is the rotation of the polar decomposition, D the nearest matrix of determinant one, J = det F. The first is that of
projective dynamics (Bouaziz et al. 2014; Du et al. 2021). Its volume term measures a distance, and a pure dilation
``F = (1 + e) I`` lies ``sqrt(3) e`` from the rotations but carries the trace ``3 e``: for small strains it is linear
elasticity with a third of the nominal lambda (`small_strain_poissons_ratio`). The second is that of Smith, de Goes and
Kim (2018) without its logarithm, with lambda shifted by mu so that small strains give exactly linear elasticity.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..io.errors import InputError
from ..kernels.elasticity import COROTATED, STABLE_NEO_HOOKEAN

Parameter = float | Sequence[float] | NDArray[np.float64] | torch.Tensor

MODELS = {"corotated": COROTATED, "stable_neo_hookean": STABLE_NEO_HOOKEAN}


@dataclass(frozen=True)
class Material:
    """Constants of an elastic material with Rayleigh damping.

    The elastic constants are numbers, (M,) tensors with a value for each element, (B, 1) tensors with a value for each
    environment of a batch, or (B, M) tensors; the damping constants are numbers or (B,) tensors. Tensors that require
    gradients receive them from every simulated quantity.

    Attributes:
        youngs_modulus: E [Pa].
        poissons_ratio: nu, between -1 and 0.5.
        density: rho [kg/m^3].
        model: ``corotated`` or ``stable_neo_hookean``.
        mass_damping: force -alpha M v [1/s].
        stiffness_damping: Kelvin-Voigt viscosity of retardation time beta [s]; for small strains the force -beta K v.
        fibre_stiffness: of the thread around the chambers, per distance of its turns [N/m] (`surface_elements.Fibres`):
            a number, (C,) values with one for each chamber, (B, 1), or (B, C).
    """

    youngs_modulus: Parameter = 264e3
    poissons_ratio: Parameter = 0.499
    density: Parameter = 1070.0
    model: str = "corotated"
    mass_damping: Parameter = 0.0
    stiffness_damping: Parameter = 0.0
    fibre_stiffness: Parameter = 0.0

    def __post_init__(self) -> None:
        """Checks every constant.

        Raises:
            InputError: a constant outside its physical range, or an unknown model.
        """
        if self.model not in MODELS:
            raise InputError(f"material model is {self.model!r}: choose one of {', '.join(MODELS)}.")
        _check("youngs_modulus", self.youngs_modulus, 0.0, np.inf, "positive, in pascals")
        _check("poissons_ratio", self.poissons_ratio, -1.0, 0.5, "greater than -1 and less than 0.5")
        _check("density", self.density, 0.0, np.inf, "positive, in kg/m^3")
        _check("mass_damping", self.mass_damping, -0.0, np.inf, "zero or more, in 1/s", closed=True)
        _check("stiffness_damping", self.stiffness_damping, -0.0, np.inf, "zero or more, in s", closed=True)
        _check("fibre_stiffness", self.fibre_stiffness, -0.0, np.inf, "zero or more, in N/m", closed=True)

    def lame(self, device: torch.device, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
        """Lame constants mu and lambda [Pa], each (1 or B, 1 or M)."""
        e = as_parameter(self.youngs_modulus, device, dtype)
        nu = as_parameter(self.poissons_ratio, device, dtype)
        return e / (2.0 * (1.0 + nu)), e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


def as_parameter(value: Parameter, device: torch.device, dtype: torch.dtype) -> torch.Tensor:
    """A number, (M,), (B, 1) or (B, M) value as a (1 or B, 1 or M) tensor; keeps the autograd graph."""
    tensor = torch.as_tensor(value, device=device, dtype=dtype)
    return tensor.reshape(1, -1) if tensor.ndim < 2 else tensor


def small_strain_poissons_ratio(poissons_ratio: float) -> float:
    """Poisson's ratio that the corotated model shows for small strains: linear elasticity with lambda / 3.

    It bends a little less stiffly than its nominal constants: nu 0.45 acts as 0.375, nu 0.499 as 0.497.
    """
    lame_over_mu = 2.0 * poissons_ratio / (1.0 - 2.0 * poissons_ratio) / 3.0
    return lame_over_mu / (2.0 * (lame_over_mu + 1.0))


def _check(name: str, value: Parameter, low: float, high: float, wanted: str, closed: bool = False) -> None:
    try:
        values = torch.as_tensor(value, dtype=torch.float64).detach().cpu()
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{name} is {value!r}: it must be {wanted}.") from None
    inside = (values >= low if closed else values > low) & (values < high) & torch.isfinite(values)
    if values.numel() == 0 or values.ndim > 2:
        raise InputError(f"{name} has shape {tuple(values.shape)}: give a number, (M,), (B, 1) or (B, M) values.")
    if not bool(inside.all()):
        wrong = values[~inside].flatten()[0].item()
        raise InputError(f"{name} is {wrong:g}: it must be {wanted}.")
