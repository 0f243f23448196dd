"""Derivatives that a simulation does not have are refused, where torch would return zeros or its own riddles."""

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

from support.clamped import clamped
from warp_resphys import Contact, Corotated, HalfSpace, Inputs, Simulator, State, Tendons, box_hexahedra
from warp_resphys.energies.contact.barrier import barrier_pressure
from warp_resphys.io.errors import DerivativeError

MESH = box_hexahedra((0.1, 0.02, 0.02), (4, 1, 1))
ONE = torch.ones(1, dtype=torch.float64)
FLOOR = Contact({"floor": HalfSpace(position=(0.0, 0.0, -0.001))}, distance=0.002, friction=0.3)
TENDON = Tendons([np.linspace([0.0, 0.01, 0.02], [0.1, 0.01, 0.02], 5)], friction=0.2)


def simulator(*energies):
    return Simulator(clamped(MESH, energies=energies), Corotated(100e3, 0.4, stiffness_damping=1e-3))


def of_modulus(sim, scale):
    return sim.rollout(sim.rest_state(), 3, parameters={"youngs_modulus": 1e5 * scale}).q[-1, ..., 2].mean()


def of_equilibrium(sim, scale):
    return sim.static_equilibrium(parameters={"youngs_modulus": 1e5 * scale}).q[..., 2].mean()


def of_state(sim, shift):
    rest = sim.rest_state()
    return sim.step(State(rest.q + 1e-4 * shift, rest.v + shift)).v.sum()


def of_clamp(sim, shift):
    held = sim.rest_positions[sim.fixed][None] + 1e-4 * shift
    return sim.step(sim.rest_state(), Inputs(fixed_positions=held)).q.sum()


CASES = [
    ((), of_modulus),
    ((), of_equilibrium),
    ((), of_state),
    ((), of_clamp),
    ((), lambda sim, scale: 0.0 * of_modulus(sim, scale)),
    ((FLOOR,), of_modulus),
    ((FLOOR,), of_state),
    ((TENDON,), lambda sim, scale: sim.step(sim.rest_state(), Inputs(tendon_tension=0.3 * scale[None])).q.sum()),
]


@pytest.mark.parametrize(("energies", "function"), CASES)
def test_second_derivatives_are_refused(energies, function):
    """Of losses that are linear in the solution, too, whose gradient does not depend on an incoming one."""
    sim = simulator(*energies)
    loss = lambda scale: function(sim, scale)  # noqa: E731
    scale = ONE.clone().requires_grad_()
    (expected,) = torch.autograd.grad(loss(scale), scale)
    for leaves in ({"inputs": scale}, {}):
        (slope,) = torch.autograd.grad(loss(scale), scale, create_graph=True)
        torch.testing.assert_close(slope, expected, rtol=1e-9, atol=0.0)
        with pytest.raises(DerivativeError, match="second derivatives of a simulation are not available"):
            torch.autograd.backward(slope, **leaves)
    for second in (torch.autograd.functional.hessian, torch.autograd.functional.hvp, torch.autograd.functional.jvp):
        with pytest.raises(DerivativeError):
            second(loss, ONE) if second is torch.autograd.functional.hessian else second(loss, ONE, ONE)


@pytest.mark.parametrize("transform", ["hessian", "jacrev", "jacfwd", "grad", "vmap"])
@pytest.mark.parametrize("function", [of_modulus, of_equilibrium, of_state])
def test_transforms_are_refused(transform, function):
    sim = simulator()
    with pytest.raises(DerivativeError, match=r"torch\.func and batched gradients"):
        getattr(torch.func, transform)(lambda scale: function(sim, scale))(ONE)


def test_batched_gradients_and_forward_mode_are_refused():
    sim = simulator()
    heights = lambda scale: sim.rollout(sim.rest_state(), 2, parameters={"youngs_modulus": 1e5 * scale}).q[-1, 0, -3:]  # noqa: E731
    alone = torch.autograd.functional.jacobian(heights, ONE)
    assert bool((alone != 0.0).any())
    with pytest.raises(DerivativeError, match="vectorize"):
        torch.autograd.functional.jacobian(heights, ONE, vectorize=True)
    for function in (of_modulus, of_state):
        with forward_ad.dual_level(), pytest.raises(DerivativeError, match="forward-mode derivatives"):
            function(sim, forward_ad.make_dual(ONE, ONE))


def test_the_pressure_of_the_barrier_has_one_derivative():
    d = torch.tensor([0.3], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(barrier_pressure(d, 1.0).sum(), d, create_graph=True)
    with pytest.raises(DerivativeError):
        torch.autograd.grad(slope.sum(), d)
