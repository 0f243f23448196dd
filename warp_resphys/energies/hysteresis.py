r"""Hysteresis of a solid: rate-independent friction within the material, such as that of filled silicones.

Sliders stand in parallel to the elastic solid (Iwan 1967). A slider is a spring in series with a frictional element:
with the Green strain E, its plastic strain E_p, its ratio g to the shear modulus mu, and its yield strain e,

    S = 2 mu g (E - E_p),     |E - E_p| <= e,     dE_p/dt along E - E_p, and only where |E - E_p| = e,

with Frobenius norms and the second Piola-Kirchhoff stress S: it is elastic-perfectly plastic. An implicit step from the
plastic strain E_p0 minimises the energy stored plus the work of friction,

    min over E_p of  mu g |E - E_p|^2 + 2 mu g e |E_p - E_p0|  =  mu g phi(|A|^2),     A = E - E_p0,
    phi(s) = s where sqrt(s) <= e (the slider sticks), and 2 e sqrt(s) - e^2 beyond (it slides),

which is the radial return E_p = E - min(1, e / |A|) A (Simo and Hughes, Computational Inelasticity, 1998, chapter 3).
It is exact where the strain changes in proportion, and depends on no time step. The function of A is convex with a
continuous first derivative, so that a step has a potential, and friction takes energy in every implicit step. The
second derivative jumps where a slider begins to slide: there, derivatives are those of one side. (Dahl's exponential
has no potential for tensors; several sliders approach it, or any other curve of loading.)

A cycle of amplitude a > e along one direction of strain takes 8 mu g e (a - e) per volume. |E| is 1.22 times the small
elongation of an incompressible bar, and 0.71 times a small shear angle. Like a Prony branch, a slider acts on the whole
strain, and its modulus is no part of the volume term.

``tests/dynamics/test_material_memory.py`` has closed forms, dissipation and gradients.

W. D. Iwan: On a class of models for the yielding behavior of continuous and composite systems. Journal of Applied
Mechanics 34, 612-617, 1967.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import torch
import warp as wp
from typing_extensions import override

from ..fem.integration_points import Points
from ..kernels import plastic_sliders as kernels
from ..mesh.volume_mesh import Mesh
from .base import BoundEnergy, Energy, EnergySite, EnergyStep, Memory
from .launcher import Launcher, warp_view
from .solid import PointModuli, Solid
from .term import PointSet, Slope
from .viscosity import GreenStrain, StrainTerm

PLASTIC_STRAIN: Final = "plastic_strain"


@dataclass(frozen=True)
class Hysteresis(Energy):
    """The sliders of a solid, whose constants are those of its material.

    Values of a step are ``slider_modulus`` (B, P), mu times the points' volumes [J]; ``sliders`` (B, K, 2), ratio and
    yield strain; and ``plastic_strain`` (B, K, P, 3, 3) at its start, which is the memory. Without memory, the strain
    has grown from zero in proportion.

    Args:
        solid: a solid whose material has sliders.
    """

    solid: Solid

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return ()

    @override
    def points(self, mesh: Mesh) -> tuple[Points, ...]:
        return self.solid.points(mesh)

    @override
    def term(self, launcher: Launcher, sets: Sequence[PointSet]) -> "HysteresisTerm":
        return HysteresisTerm(launcher, sets, len(self.solid.material.hysteresis))

    @override
    def bind(self, site: EnergySite) -> "BoundHysteresis":
        return BoundHysteresis(self, site)


class BoundHysteresis(BoundEnergy):
    """The sliders of a solid in a simulator."""

    rate_independent = True

    def __init__(self, hysteresis: Hysteresis, site: EnergySite) -> None:
        super().__init__(hysteresis, site)
        solid = hysteresis.solid
        self._material, self._moduli = solid.material, PointModuli(solid, site)
        law, like = solid.material.law, site.rest_positions
        self._shear = like.new_tensor([shear for shear, _ in law.lame])  # (T,) contribution of each modulus to mu
        points = sum(s.n_points for s in solid.discretisation.point_sets)
        self._shape = (len(solid.material.hysteresis), points, 3, 3)
        self.memory = (Memory(PLASTIC_STRAIN, "strain", self._shape, "slider"),)

    @override
    def prepare(self, parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor | None]:
        sliders = [torch.cat(torch.broadcast_tensors(*s), 1) for s in self._material.group("hysteresis", parameters)]
        together = torch.stack(torch.broadcast_tensors(*sliders), 1)
        return {"slider_modulus": self._moduli(parameters) @ self._shear, "sliders": together}

    @override
    def begin_step(self, step: EnergyStep) -> dict[str, torch.Tensor | None]:
        return {PLASTIC_STRAIN: self._plastic(step)}

    @override
    def end_step(self, step: EnergyStep, x: torch.Tensor, q: torch.Tensor) -> dict[str, torch.Tensor]:
        return {PLASTIC_STRAIN: self._slid(step, q, self._plastic(step))}

    def _plastic(self, step: EnergyStep) -> torch.Tensor:
        """Returns the plastic strains (B, K, P, 3, 3) at the start of a step."""
        carried = step.state.memory.get(PLASTIC_STRAIN)
        if carried is None:
            untouched = step.state.q.new_zeros(step.state.batch, *self._shape)
            carried = self._slid(step, step.state.q, untouched)
        return carried

    def _slid(self, step: EnergyStep, q: torch.Tensor, plastic: torch.Tensor) -> torch.Tensor:
        """Returns the plastic strains (B, K, P, 3, 3) at positions (B, N, 3) from those before."""
        strain = partial(GreenStrain.apply, step.term)
        trial = strain(q)[:, None].to(plastic.dtype) - plastic
        square = trial.square().sum((-2, -1), keepdim=True)
        limits = step.value("sliders")[..., 1, None, None, None]
        slides = square > limits.square()
        stuck = torch.where(slides, limits / torch.where(slides, square, 1.0).sqrt(), 1.0)  # min(1, e / |A|)
        return plastic + (1.0 - stuck) * trial


class HysteresisTerm(StrainTerm):
    """Kernels of K sliders at every point of a solid."""

    _kernels = kernels

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], sliders: int) -> None:
        points = sum(s.n_points for s in sets)
        shapes = {"slider_modulus": (points,), "sliders": (sliders, 2), PLASTIC_STRAIN: (sliders, points, 3, 3)}
        super().__init__(launcher, sets, shapes)
        self._sliders = sliders

    @override
    def _arguments(self, s: PointSet, positions: Any) -> list[Any]:
        modulus, plastic = self.values["slider_modulus"][:, s.in_energy], self.values[PLASTIC_STRAIN][:, :, s.in_energy]
        views = [warp_view(modulus, wp.float64), self.view("sliders", wp.vec2d), warp_view(plastic, wp.mat33d)]
        return [s.points, *views, positions]

    @override
    def curvature(self) -> torch.Tensor:
        return 2.0 * self.values["slider_modulus"] * self.values["sliders"][..., 0].sum(1, keepdim=True)

    @override
    def _slopes(self) -> list[Slope]:
        k, n = self._sliders, self.n_points
        plastic = Slope(PLASTIC_STRAIN, (k, n, 3, 3), wp.mat33d, axis=1)
        return [Slope("slider_modulus", (n,)), Slope("sliders", (k, n, 2), wp.vec2d, axis=1), plastic]
