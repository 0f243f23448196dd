r"""Viscosity of a solid over one implicit stage: Kelvin-Voigt, and generalised Maxwell (Prony) branches.

Both are quadratic in the Green strain E(x) of the stage's solution: a step keeps one potential, with the density

    mu (c E - 2 W) : E + lambda / 2 (d tr E - 2 w) tr E .

Kelvin-Voigt viscosity of retardation time beta has c = d = beta / h_e, W = c R with the strain R that the integrator's
stage starts from, and w = d tr R.

Branch k relaxes shear: G(t) = mu (1 + sum_k g_k exp(-t / tau_k)), mu being the modulus that is left after a long time,
and lambda stays elastic, as is usual for rubber. It carries the strain H_k, its share of what has not relaxed yet:

    dH/dt = dE/dt - H / tau,     second Piola-Kirchhoff stress  2 mu g H .

For a strain that changes evenly during s seconds that is solved exactly, and unconditionally stably, by

    H(s) = exp(-s / tau) H(0) + gamma (E(s) - E(0)),     gamma = (1 - exp(-s / tau)) tau / s

(Taylor, Pister and Goudreau 1970; Simo and Hughes, Computational Inelasticity, 1998, section 10.3). So a branch adds
g gamma to c, and g (gamma E(0) - exp(-s / tau) H(0)) to W: however many there are, a step costs the same.
"""

from typing import Any

import torch

from ..energies.solid import GreenStrain, SolidTerm
from ..io.errors import InputError
from .constants import Constants
from .inputs import check_tensor
from .integrator import ImplicitStage, State


def viscous_values(
    solid: SolidTerm, constants: Constants, state: State, stage: ImplicitStage, time_step: float
) -> dict[str, torch.Tensor | None]:
    """What the solid's term needs of a step from a state; see the module.

    Args:
        solid: of the state's batch.
        constants: with the damping and the branches.
        state: where the step starts.
        stage: of the integrator.
        time_step: h [s].
    """
    batch = state.batch
    c = d = (constants.stiffness_damping / stage.step).expand(batch)
    offset = dilation = None
    if constants.damped:
        offset = _times(d, sum(w * GreenStrain.apply(solid, q) for q, w in stage.strain_weights))
        dilation = offset.diagonal(dim1=-2, dim2=-1).sum(-1)
    if constants.relaxes:
        decay, gamma = _relaxation(constants, stage.end * time_step)
        added = (constants.prony_ratio * gamma).expand(batch, -1).sum(1)
        carried = _times(added, GreenStrain.apply(solid, state.q))
        if state.overstrain is not None:
            shares = (constants.prony_ratio * decay).expand(batch, -1)
            carried = carried - torch.einsum("bk,bkpij->bpij", shares, state.overstrain)
        c, offset = c + added, carried if offset is None else offset + carried
        dilation = carried.new_zeros(carried.shape[:2]) if dilation is None else dilation
    viscosity = torch.stack([c, d], 1) if constants.relaxes else d[:, None].expand(batch, 2)
    return {"viscosity": viscosity, "strain_offset": offset, "dilation_offset": dilation}


def without_viscosity(batch: int, like: torch.Tensor) -> dict[str, torch.Tensor | None]:
    """What the solid's term needs where nothing moves."""
    return {"viscosity": like.new_zeros(batch, 2), "strain_offset": None, "dilation_offset": None}


def relaxed(solid: SolidTerm, constants: Constants, state: State, q: torch.Tensor, seconds: float) -> torch.Tensor:
    """(B, K, P, 3, 3) the strains H that the branches carry after a motion.

    Args:
        solid: of the batch.
        constants: with the branches.
        state: at its beginning.
        q: (B, N, 3) positions at its end [m].
        seconds: how long it took [s].
    """
    decay, gamma = (each[..., None, None, None] for each in _relaxation(constants, seconds))
    strained = gamma * (GreenStrain.apply(solid, q) - GreenStrain.apply(solid, state.q))[:, None].to(gamma.dtype)
    return strained if state.overstrain is None else strained + decay * state.overstrain


def check_overstrain(overstrain: Any, shape: tuple[int, ...], like: torch.Tensor) -> None:
    """Refuses strains of branches that a state cannot have.

    Raises:
        InputError: another shape, type or device, or values that are not finite.
    """
    if isinstance(overstrain, torch.Tensor) and tuple(overstrain.shape) == shape:
        check_tensor("state.overstrain", overstrain, shape, "strains", "branch", like)
    else:
        found = tuple(overstrain.shape) if isinstance(overstrain, torch.Tensor) else type(overstrain).__name__
        raise InputError(
            f"state.overstrain is {found}, not (environments, Prony branches, points, 3, 3) = {shape}: take the state "
            "from a simulator of this body and material, or leave it out for relaxed branches."
        )


def _relaxation(constants: Constants, seconds: float) -> tuple[torch.Tensor, torch.Tensor]:
    """(1 or B, K) exp(-s / tau) and gamma."""
    ratio = seconds / constants.prony_time
    return torch.exp(-ratio), -torch.expm1(-ratio) / ratio


def _times(values: torch.Tensor, tensors: torch.Tensor) -> torch.Tensor:
    """(B,) values times (B, P, 3, 3) tensors."""
    return values[:, None, None, None] * tensors
