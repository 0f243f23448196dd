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
from .base import Adjoint, BoundEnergy, Energy, EnergySite, EnergyStep, Memory, PointSet, Values, value_of
from .launcher import Launcher, warp_view
from .solid import PointModuli, Solid
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
        self._shear = like.new_tensor([shear for shear, _ in law.LAME])  # (T,) contribution of each modulus to mu
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
        limits = step.constants.value("sliders")[..., 1, None, None, None]
        slides = square > limits.square()
        stuck = torch.where(slides, limits / torch.where(slides, square, 1.0).sqrt(), 1.0)  # min(1, e / |A|)
        return plastic + (1.0 - stuck) * trial


class HysteresisTerm(StrainTerm):
    """Kernels of K sliders at every point of a solid."""

    _kernels = kernels

    def __init__(self, launcher: Launcher, sets: Sequence[PointSet], sliders: int) -> None:
        super().__init__(launcher, sets)
        self._sliders = sliders

    @property
    @override
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        k, points = self._sliders, self.n_points
        return {"slider_modulus": (points,), "sliders": (k, 2), PLASTIC_STRAIN: (k, points, 3, 3)}

    @override
    def _arguments(self, s: PointSet, values: Values, positions: Any) -> list[Any]:
        modulus, sliders, plastic = (value_of(values, name) for name in self.shapes)
        views = [
            warp_view(modulus[:, s.own], wp.float64),
            warp_view(sliders, wp.vec2d),
            warp_view(plastic[:, :, s.own], wp.mat33d),
        ]
        return [s.points, *views, positions]

    @override
    def curvature(self, values: Values) -> torch.Tensor:
        return 2.0 * value_of(values, "slider_modulus") * value_of(values, "sliders")[..., 0].sum(1, keepdim=True)

    @override
    def adjoint(self, values: Values, positions: torch.Tensor, direction: torch.Tensor) -> Adjoint:
        own, shapes = self.launcher, {**self.shapes, "sliders": (self._sliders, self.n_points, 2)}
        out = {name: own.zeros(*shape) for name, shape in shapes.items()}
        fields, commands = [warp_view(field, wp.vec3d) for field in (positions, direction)], []
        for s in self.sets:
            inputs = [*self._arguments(s, values, fields[0]), fields[1]]
            outputs = [
                warp_view(out["slider_modulus"][:, s.own], wp.float64),
                warp_view(out["sliders"][:, :, s.own], wp.vec2d),
                warp_view(out[PLASTIC_STRAIN][:, :, s.own], wp.mat33d),
            ]
            commands.append(own.record(kernels.adjoint, (own.batch, s.n_points), inputs, outputs))

        def differentiate() -> dict[str, torch.Tensor]:
            own.launch(*commands)
            return {name: slope.sum(2) if name == "sliders" else slope.clone() for name, slope in out.items()}

        return differentiate
