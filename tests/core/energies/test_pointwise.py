"""Energies that are one Warp function, against hand-written kernels,
eigenvalues and differences.
"""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pytest
import torch
import warp as wp

from support.clamped import clamped, noise
from warp_resphys import (
    Corotated,
    Inputs,
    Muscles,
    Simulator,
    SolverSettings,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.dynamics.gradient_check import pose
from warp_resphys.core.energies.pointwise import PointwiseEnergy, at_vertices, between
from warp_resphys.core.stepping.quantity import Quantity, parameter
from warp_resphys.energies import Muscle
from warp_resphys.io.errors import InputError

MESH = box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1))
CLAMP, TIP = select_vertices(MESH, x=0.0), select_vertices(MESH, x=0.06)
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-12)
MATERIAL = Corotated(1e5, 0.45, mass_damping=0.5, stiffness_damping=2e-3)
FIBRES = Muscles([Muscle(range(2), (1.0, 0.0, 0.2))], stiffness=4e4)
VALUES = {"muscle_stress": 2e4, "muscle_contraction": 0.5}  # where no fibre is near its toe


@wp.func
def fibre(x: wp.vec3d, v: wp.vec3d) -> wp.float64:
    """That of `Muscles` beyond the toe; the values are stiffness, stress and contraction."""
    length = wp.length(x)
    force = length - wp.float64(1.0) + v[2] - wp.float64(0.5e-3)
    return v[1] * length + v[0] * (wp.float64(0.5) * force * force + wp.float64(0.025e-6))


@dataclass(frozen=True)
class Fibre(PointwiseEnergy):
    inputs: ClassVar = (Quantity("muscle_stress", "Pa"), Quantity("muscle_contraction", ""))
    density: ClassVar = fibre
    muscle_stiffness: float = parameter(4e4, "muscle_stiffness", "Pa")

    def points(self, mesh):
        return FIBRES.points(mesh)


@wp.func
def spring(x: wp.vec3d, v: wp.vec2d) -> wp.float64:
    longer = wp.length(x) - v[1]
    return wp.float64(0.5) * v[0] * longer * longer


@dataclass(frozen=True)
class Spring(PointwiseEnergy):
    """Springs between vertices, pair after pair with values of its own."""

    density: ClassVar = spring
    size: ClassVar[float] = 0.05
    pairs: list = field(default_factory=lambda: [[CLAMP[0], TIP[3]], [CLAMP[1], TIP[2]]])
    stiffness: float = parameter(50.0, "spring_stiffness", "N/m", per="spring")
    length: float = parameter(0.05, "spring_length", "m", per="spring")

    @property
    def count(self):
        return len(self.pairs)

    def points(self, mesh):
        return (between(self.pairs, np.arange(self.count)),)


@wp.func
def polynomial(x: wp.vec3d, v: wp.vec3d) -> wp.float64:
    height = x[2]
    return height * (v[0] + height * (v[1] + height * v[2]))


@dataclass(frozen=True)
class Hills(PointwiseEnergy):
    """A potential of the height of the tip, by an array of coefficients."""

    density: ClassVar = polynomial
    size: ClassVar[float] = 0.02
    coefficients: tuple = parameter((0.1, 2.0, 30.0), "coefficients", "J", -np.inf, shape=(3,))

    def points(self, mesh):
        return (at_vertices(TIP),)


def simulator(energy):
    return Simulator(clamped(MESH, energies=[energy]), MATERIAL, solver=TIGHT)


def acting():
    return Inputs(
        **{name: torch.full((2, 1), value, dtype=torch.float64) for name, value in VALUES.items()}
    )


@pytest.mark.parametrize("at", ["rest", "bent"])
def test_stress_tangent_and_adjoint_equal_hand_written_kernels(at):
    results = []
    for energy in (FIBRES, Fibre()):
        s = simulator(energy)
        state = pose(s, at, 2)
        stiffness = torch.full((2, 1), 4e4, dtype=torch.float64, requires_grad=True)
        inputs = Inputs(
            **{name: value.requires_grad_() for name, value in acting().actuation.items()}
        )
        here = s.linearise(state, acting())
        x = state.q + 1e-3 * noise(*state.q.shape)
        residual = here.residual(x)
        here.update(x)
        product = here.product(torch.sin(50.0 * x))
        end = s.step(state, inputs, {"muscle_stiffness": stiffness})
        leaves = [*inputs.actuation.values(), stiffness]
        results.append(
            [
                residual,
                product,
                *torch.autograd.grad((end.q**2).sum() + end.q[..., 2].sum(), leaves),
            ]
        )
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=2e-9, atol=1e-9 * float(other.abs().max()))


def test_a_clamped_tangent_has_no_negative_eigenvalue():
    """Springs that push have a negative stiffness across.

    The clamped one is what is left without it.
    """
    s = simulator(Spring(length=0.2))
    s.linearise(s.rest_state(2))
    p = s.workspace(2).potential
    p.positions.copy_(s.rest_positions)
    p.update_tangent()
    exact = p.tangents[-1].clone()
    p.update_tangent(torch.tensor([True, False]))
    values, vectors = torch.linalg.eigh(exact[0, :, 0])
    assert float(values.min()) < -1.0
    expected = vectors @ torch.diag_embed(values.clamp_min(0.0)) @ vectors.mT
    torch.testing.assert_close(
        p.tangents[-1][0, :, 0], expected, rtol=0.0, atol=1e-9 * float(values.max())
    )
    torch.testing.assert_close(p.tangents[-1][1], exact[1])


def test_a_parameter_may_be_an_array():
    s, weights = simulator(Hills()), torch.tensor([1.0, -2.0, 0.5]).double()

    def loss(coefficients):
        end = s.rollout(s.rest_state(2), 2, parameters={"coefficients": coefficients}).q[-1]
        return 1e3 * (end[0] * weights).sum() + 2e3 * (end[1] * weights).sum()

    for values in (
        torch.tensor([0.1, 2.0, 30.0]),
        torch.tensor([[0.1, 2.0, 30.0], [0.3, 1.0, -20.0]]),
    ):
        given = values.double().requires_grad_()
        (gradient,) = torch.autograd.grad(loss(given), given)
        assert gradient.shape == given.shape
        step = 1e-3 * torch.ones_like(given).detach() * torch.tensor([1.0, 10.0, 100.0])
        with torch.no_grad():
            difference = (loss(given + step) - loss(given - step)) / 2.0
        torch.testing.assert_close((gradient * step).sum(), difference, rtol=1e-6, atol=0.0)
    with pytest.raises(InputError, match="coefficients has shape"):
        s.prepare({"coefficients": torch.zeros(4)})
