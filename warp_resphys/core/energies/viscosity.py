r"""Viscosity of a solid over one implicit stage: Kelvin-Voigt,
and generalised Maxwell (Prony) branches.

Both are quadratic in the Green strain E(x) of the stage's solution, so that a step still minimises
one potential, with the additional density

    mu (c E - 2 W) : E + lambda / 2 (d tr E - 2 w) tr E .

Kelvin-Voigt viscosity of retardation times beta and beta_b of shear and bulk, mostly equal, has
c = beta / h_e, d = beta_b / h_e, W = c R with the reference strain R of the integrator's stage, and
w = d tr R.

Prony branches relax shear only: G(t) = mu (1 + sum_k g_k exp(-t / tau_k)), with the long-term
modulus mu; lambda stays elastic, as is usual for rubber. Branch k has the strain H_k that has not
relaxed yet:

    dH/dt = dE/dt - H / tau,     second Piola-Kirchhoff stress  2 mu g H .

For a constant strain rate during s seconds the exact, unconditionally stable solution is

    H(s) = exp(-s / tau) H(0) + gamma (E(s) - E(0)),     gamma = (1 - exp(-s / tau)) tau / s

(Taylor, Pister and Goudreau 1970; Simo and Hughes, Computational Inelasticity, 1998, section 10.3).
So a branch adds g gamma to c, and g (gamma E(0) - exp(-s / tau) H(0)) to W; the cost of a step does
not depend on their number.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import torch
import warp as wp
from typing_extensions import override

from ...kernels import elasticity as kernels
from ..stepping.adjoints import AdjointFunction, first_derivatives
from ..stepping.state import ImplicitStage
from .launcher import warp_view
from .term import Term

# (B, N, 3) positions to the Green strain (B, P, 3, 3)
Strain = Callable[[torch.Tensor], torch.Tensor]
StepValues = tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]
_KEPT = 3  # strains


@dataclass(frozen=True)
class Viscosity:
    """Viscous constants of a solid."""

    damping: torch.Tensor  # (1 or B, 2) retardation times beta of shear and bulk [s]
    damped: bool  # whether these may be non-zero
    ratio: torch.Tensor | None  # (1 or B, K) moduli of the Prony branches over mu, if any
    time: torch.Tensor | None  # (1 or B, K) their relaxation times [s]

    def step_values(
        self,
        strain: Strain,
        q: torch.Tensor,
        carried: torch.Tensor | None,
        stage: ImplicitStage,
        time_step: float,
    ) -> StepValues:
        """Returns c and d (B, 2), W (B, P, 3, 3) and w (B, P) of a step,
        the last two None without viscosity.

        Args:
            strain: strain function of the solid.
            q: (B, N, 3) positions at the start [m].
            carried: (B, K, P, 3, 3) strains H of the branches at the start; None: relaxed.
            stage: stage of the integrator.
            time_step: h [s].
        """
        batch = len(q)
        both = (self.damping / stage.step).expand(batch, 2)
        offset = dilation = None
        if self.damped:
            parts = [strain(x) if w == 1.0 else w * strain(x) for x, w in stage.strain_weights]
            reference = reduce(torch.add, parts)  # R
            offset = both[:, :1, None, None] * reference
            dilation = both[:, 1:] * reference.diagonal(dim1=-2, dim2=-1).sum(-1)
        if self.ratio is None or self.time is None:
            return both, offset, dilation
        decay, gamma = relaxation(self.time, stage.end * time_step)
        added, strained = (self.ratio * gamma).expand(batch, -1).sum(1), strain(q)
        factors = added[:, None, None, None].to(strained)
        offset = factors * strained if offset is None else torch.addcmul(offset, factors, strained)
        if carried is not None:
            shares = (self.ratio * decay).expand(batch, -1)[:, None].to(offset)  # (B, 1, K)
            flat = torch.baddbmm(
                offset.flatten(1)[:, None], shares, carried.flatten(2).to(offset), alpha=-1.0
            )
            offset = flat.view_as(offset)
        dilation = offset.new_zeros(offset.shape[:2]) if dilation is None else dilation
        return torch.stack([both[:, 0] + added, both[:, 1]], 1), offset, dilation

    def relax(
        self,
        strain: Strain,
        q: torch.Tensor,
        carried: torch.Tensor | None,
        end: torch.Tensor,
        seconds: float,
    ) -> torch.Tensor:
        """Returns the strains H (B, K, P, 3, 3) of the branches at the end of a motion.

        Args:
            strain: strain function of the solid.
            q: (B, N, 3) positions at the start [m].
            carried: (B, K, P, 3, 3) strains H at the start; None: relaxed.
            end: (B, N, 3) positions at the end [m].
            seconds: duration [s].
        """
        assert self.time is not None
        decay, gamma = (x[..., None, None, None] for x in relaxation(self.time, seconds))
        strained = (strain(end) - strain(q))[:, None].to(gamma.dtype)
        return (
            gamma * strained if carried is None else torch.addcmul(decay * carried, gamma, strained)
        )


def relaxation(time: torch.Tensor, seconds: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns exp(-s / tau) and gamma, (1 or B, K) each, for relaxation times tau [s]."""
    ratio = seconds / time
    return torch.exp(-ratio), -torch.expm1(-ratio) / ratio


class StrainTerm(Term):
    """A term of a solid, with the Green strain at its points."""

    @cached_property
    def strain(self) -> Strain:
        """Returns the Green strain (B, P, 3, 3) at positions (B, N, 3),
        by launches recorded at its first use.

        On a CPU, the last results serve again, and must not be changed in place: with branches of
        Prony, a step needs the strain at its end, where the next one begins, and BDF2 looks back by
        two steps.
        """
        launcher = self.launcher
        at, out = launcher.zeros(self.sets[0].n_vertices, 3), launcher.zeros(self.n_points, 3, 3)
        view = warp_view(at, wp.vec3d)
        commands = [
            launcher.record(
                kernels.strain,
                (launcher.batch, s.n_points),
                [s.points, view],
                [warp_view(out[:, s.in_energy], wp.mat33d)],
            )
            for s in self.sets
        ]
        recorded = launcher.capture(*commands)

        known = list[tuple[torch.Tensor, torch.Tensor]]()

        def strain(positions: torch.Tensor) -> torch.Tensor:
            at.copy_(positions)
            # A comparison waits for a GPU, and tensors of inference mode would have no gradient
            # later.
            keeps = at.device.type == "cpu" and not torch.is_inference_mode_enabled()
            for number, (place, strains) in enumerate(known if keeps else ()):
                if torch.equal(place, at):
                    known.append(known.pop(number))
                    return strains.detach()
            launcher.launch(recorded)
            if keeps:
                known[:] = [*known[1 - _KEPT :], (at.clone(), out.clone())]
                return known[-1][1].detach()
            return out.clone()

        return strain

    @cached_property
    def strain_adjoint(self) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
        """Returns the vector-Jacobian product (B, N, 3) of `strain`
        at positions with (B, P, 3, 3).
        """
        launcher = self.launcher
        at = launcher.zeros(self.sets[0].n_vertices, 3)
        out = launcher.zeros(self.sets[0].n_vertices, 3)
        along, stress = launcher.zeros(self.n_points, 3, 3), launcher.zeros(self.n_points, 3, 3)
        place, commands = warp_view(at, wp.vec3d), []
        for s in self.sets:
            direction, view = (
                warp_view(values[:, s.in_energy], wp.mat33d) for values in (along, stress)
            )
            inputs = [s.points, place, direction]
            commands.append(
                launcher.record(
                    kernels.strain_adjoint, (launcher.batch, s.n_points), inputs, [view]
                )
            )
            commands.append(launcher.gather(s, view, out))
        recorded = launcher.capture(*commands)

        def product(positions: torch.Tensor, adjoint: torch.Tensor) -> torch.Tensor:
            at.copy_(positions)
            along.copy_(adjoint)
            out.zero_()
            launcher.launch(recorded)
            return out.clone()

        return product


class GreenStrain(AdjointFunction):
    """Green strain E = (F^T F - I) / 2 at every point, from (B, N, 3) to (B, P, 3, 3)."""

    @override
    @staticmethod
    def forward(ctx: Any, term: StrainTerm, positions: torch.Tensor) -> torch.Tensor:
        ctx.term = term
        ctx.save_for_backward(positions)
        with term.launcher.lock:
            return term.strain(positions)

    @override
    @staticmethod
    @first_derivatives
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[None, torch.Tensor]:
        (positions,), term = ctx.saved_tensors, ctx.term
        with term.launcher.lock:
            return None, term.strain_adjoint(positions.to(gradient.dtype), gradient)
