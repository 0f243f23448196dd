"""Materials that are one Warp function of F and their constants, against hand-written ones."""

from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch
import warp as wp

from warp_resphys import (
    Body,
    Simulator,
    SolverSettings,
    StableNeoHookean,
    box_hexahedra,
    box_tetrahedra,
    select_vertices,
)
from warp_resphys.energies.materials import DensityMaterial, constant
from warp_resphys.studies.gradient_check import pose

ONE, HALF, TWO = wp.constant(wp.float64(1.0)), wp.constant(wp.float64(0.5)), wp.constant(wp.float64(2.0))
TIGHT = SolverSettings("newton", relative_tolerance=1e-12)
MESHES = {
    "hexahedron": box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1)),
    "tetrahedron": box_tetrahedra((0.06, 0.02, 0.02), (2, 1, 1)),
}
DAMPED = {"stiffness_damping": 2e-3, "mass_damping": 0.5, "prony": [(0.3, 0.05)]}


@wp.func
def shape_energy(f: wp.mat33d, p: wp.vec2d) -> wp.float64:
    mu = p[0] / (TWO * (ONE + p[1]))
    change = wp.determinant(f) - ONE
    return mu * (HALF * (wp.ddot(f, f) - wp.float64(3.0)) - change + HALF * change * change)


@wp.func
def dilation_energy(f: wp.mat33d, p: wp.vec2d) -> wp.float64:
    change = wp.determinant(f) - ONE
    return HALF * p[0] * p[1] / ((ONE + p[1]) * (ONE - TWO * p[1])) * change * change


@dataclass(frozen=True)
class Described(DensityMaterial):
    """`StableNeoHookean`, nonlinear in Poisson's ratio."""

    energy_density: ClassVar = shape_energy
    volume_energy: ClassVar = dilation_energy

    youngs_modulus: float = constant(264e3, "youngs_modulus", "Pa")
    poissons_ratio: float = constant(0.499, "poissons_ratio", "", lower=-1.0, upper=0.5)

    def lame(self, constants):
        return StableNeoHookean().moduli(constants)


def responses(mesh, material, at):
    """Residual, tangents, clamped ones, and gradients by the constants of a step."""
    s = Simulator(Body(mesh, fixed=select_vertices(mesh, x=0.0)), material, solver=TIGHT)
    state = pose(s, at, 2)
    e, nu = (torch.full((2, 1), v, dtype=torch.float64).requires_grad_() for v in (1e5, material.poissons_ratio))
    parameters = {"youngs_modulus": e, "poissons_ratio": nu}
    here = s.linearise(state, parameters={name: value.detach() for name, value in parameters.items()})
    x = state.q + 2e-4 * torch.sin(1e4 * state.q)
    results = [here.residual(x)]
    here.update(x)
    potential = s.workspace(2).potential
    results += [blocks.clone() for blocks in potential.tangents]
    potential.update_tangent(torch.ones(2, dtype=torch.bool))
    results += [blocks.clone() for blocks in potential.tangents]
    end, _ = s.step(state, parameters=parameters)
    loss = (1e3 * torch.cos(torch.arange(3.0) + 1.0) * (end.q - state.q)).sum() + end.v.sum()
    return [*results, *torch.autograd.grad(loss, [e, nu])]


@pytest.mark.parametrize("poissons_ratio", [0.3, 0.499])
@pytest.mark.parametrize("at", ["rest", "bent"])
@pytest.mark.parametrize("kind", MESHES)
def test_a_described_material_is_the_hand_written_one(kind, at, poissons_ratio):
    results = [
        responses(MESHES[kind], replace(material, poissons_ratio=poissons_ratio), at)
        for material in (Described(1e5, **DAMPED), StableNeoHookean(1e5, **DAMPED))
    ]
    for number, (one, other) in enumerate(zip(*results, strict=True)):
        # A gradient's error is that of the tangent times the ratio of the largest and the smallest stiffness.
        relative = 1e-6 if number >= len(results[0]) - 2 else 2e-9
        torch.testing.assert_close(one, other, rtol=0.0, atol=relative * float(other.abs().max()))
