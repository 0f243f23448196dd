"""Safeguards: masks for indices, failures for results,
and derivatives that there are not must not pass in silence.
"""

import dataclasses
import re

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

from support.clamped import clamped
from support.refusals import refuses
from warp_resphys import (
    Contact,
    Corotated,
    HalfSpace,
    Inputs,
    Simulator,
    SolverSettings,
    State,
    Tendons,
    box_hexahedra,
)
from warp_resphys.core.dynamics import statics
from warp_resphys.core.energies.contact.barrier import barrier_pressure
from warp_resphys.core.fem.bodies import Body
from warp_resphys.core.linalg.choice import make_linear_solver
from warp_resphys.io.errors import ConvergenceError, DerivativeError, InputError

MESH = box_hexahedra((0.06, 0.03, 0.03), (2, 1, 1))
CLAMPED = clamped(MESH)
RUBBER = Corotated(264e3, 0.45)


def test_a_static_equilibrium_that_takes_long_shows_its_iterations(monkeypatch, capsys):
    """Iterations and residual, in the error output.

    The callback of the potential is that of before afterwards.
    """
    simulator = Simulator(CLAMPED, RUBBER)
    simulator.static_equilibrium()
    assert capsys.readouterr() == ("", "")
    monkeypatch.setattr(statics, "QUIET_SECONDS", 1e-9)
    simulator.static_equilibrium(batch=2)
    shown = capsys.readouterr().err
    assert re.search(
        r"^static equilibrium: iteration \d+ \(limit 100\), in \d s, residual \S+e-\d+$",
        shown,
        re.M,
    )
    assert simulator.workspace(2).parts[0][1].potential.on_direction() is None


@pytest.mark.parametrize("fixed", [MESH.vertices[:, 0] == 0.0, [0.7], "abc"])
def test_only_vertex_numbers_are_fixed(fixed):
    refuses(InputError, "fixed vertices must be vertex numbers", Body, MESH, fixed=fixed)


def test_statics_and_their_adjoints_never_return_a_failure():
    settings = SolverSettings(max_iterations=1, on_failure="count")
    with pytest.raises(ConvergenceError):
        Simulator(CLAMPED, RUBBER, solver=settings).static_equilibrium()
    sim = Simulator(Body(MESH, fixed=[0]), RUBBER, gravity=(0.0, 0.0, 0.0))
    force = torch.zeros(1, len(MESH.vertices), 3, dtype=torch.float64, requires_grad=True)
    state = sim.static_equilibrium(Inputs(force))
    refuses(ConvergenceError, "adjoint system is singular", state.q[0, -1, 2].backward)


def test_an_equilibrium_that_is_far_is_reached_under_growing_loads():
    """Where all of them at once take too many iterations; with a gradient as if they had not."""
    body = clamped(box_hexahedra((0.12, 0.02, 0.02), (6, 2, 2)))
    results = []
    for most in (2000, 8):
        modulus = torch.full((1, 1), 5e4, dtype=torch.float64, requires_grad=True)
        simulator = Simulator(
            body, Corotated(5e4, 0.45), solver=SolverSettings(max_iterations=most)
        )
        q = simulator.static_equilibrium(parameters={"youngs_modulus": modulus}).q
        q[..., 2].mean().backward()
        results.append((q.detach(), modulus.grad))
    assert float((results[0][0] - simulator.rest_positions).abs().max()) > 0.05
    torch.testing.assert_close(results[1], results[0], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("linear_solver", ["banded", "sparse"])
def test_a_singular_system_is_a_convergence_error_with_every_linear_solver(linear_solver):
    hinged = Body(MESH, fixed=[0])
    sim = Simulator(
        hinged, RUBBER, solver=SolverSettings(linear_solver=linear_solver, max_iterations=20)
    )
    with pytest.raises(ConvergenceError):
        sim.static_equilibrium()


def test_a_simulator_is_constant_and_states_of_another_type_are_refused():
    sim = Simulator(CLAMPED, RUBBER)
    with pytest.raises(AttributeError, match="a simulator is constant"):
        sim.gravity = (0.0, 0.0, 0.0)
    assert dataclasses.replace(sim, gravity=(0.0, 0.0, 0.0)).prepare().gravity.abs().max() == 0.0
    sim = Simulator(CLAMPED, RUBBER)
    state = sim.rest_state()
    refuses(InputError, r"state\.q", sim.step, State(state.q.float(), state.v))
    refuses(InputError, r"state\.q", sim.step, State(state.q.numpy(), state.v))
    refuses(InputError, "steps is -3", sim.rollout, state, -3)
    refuses(
        InputError,
        "the inputs are a Tensor: give Inputs",
        sim.step,
        state,
        torch.zeros_like(state.q),
    )


def test_a_matrix_beyond_32_bit_addresses_is_refused():
    nodes = np.arange(20_000)
    with pytest.raises(InputError, match=r"choose solver.linear_solver=sparse"):
        make_linear_solver("dense", nodes, nodes, len(nodes), 3, torch.device("cpu"), torch.float64)


BEAM = box_hexahedra((0.1, 0.02, 0.02), (4, 1, 1))
ONE = torch.ones(1, dtype=torch.float64)
FLOOR = Contact({"floor": HalfSpace(position=(0.0, 0.0, -0.001))}, distance=0.002, friction=0.3)
TENDON = Tendons([np.linspace([0.0, 0.01, 0.02], [0.1, 0.01, 0.02], 5)], friction=0.2)


def simulator(*energies):
    return Simulator(
        clamped(BEAM, energies=energies), Corotated(100e3, 0.4, stiffness_damping=1e-3)
    )


def of_modulus(sim, scale):
    return (
        sim.rollout(sim.rest_state(), 3, parameters={"youngs_modulus": 1e5 * scale})
        .q[-1, ..., 2]
        .mean()
    )


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
    (
        (TENDON,),
        lambda sim, scale: sim.step(
            sim.rest_state(), Inputs(tendon_tension=0.3 * scale[None])
        ).q.sum(),
    ),
]


@pytest.mark.parametrize(("energies", "function"), CASES)
def test_second_derivatives_are_refused(energies, function):
    """Losses that are linear in the solution are refused, too:
    their gradient does not depend on an incoming one.
    """
    sim = simulator(*energies)
    loss = lambda scale: function(sim, scale)  # noqa: E731
    scale = ONE.clone().requires_grad_()
    (expected,) = torch.autograd.grad(loss(scale), scale)
    for leaves in ({"inputs": scale}, {}):
        (slope,) = torch.autograd.grad(loss(scale), scale, create_graph=True)
        torch.testing.assert_close(slope, expected, rtol=1e-9, atol=0.0)
        with pytest.raises(
            DerivativeError, match="second derivatives of a simulation are not available"
        ):
            torch.autograd.backward(slope, **leaves)
    for second in (
        torch.autograd.functional.hessian,
        torch.autograd.functional.hvp,
        torch.autograd.functional.jvp,
    ):
        with pytest.raises(DerivativeError):
            second(loss, ONE) if second is torch.autograd.functional.hessian else second(
                loss, ONE, ONE
            )


@pytest.mark.parametrize("transform", ["hessian", "jacrev", "jacfwd", "grad", "vmap"])
@pytest.mark.parametrize("function", [of_modulus, of_equilibrium, of_state])
def test_transforms_are_refused(transform, function):
    sim = simulator()
    with pytest.raises(DerivativeError, match=r"torch\.func and batched gradients"):
        getattr(torch.func, transform)(lambda scale: function(sim, scale))(ONE)


def test_batched_gradients_forward_mode_and_two_derivatives_of_the_barrier_are_refused():
    sim = simulator()

    def heights(scale):
        parameters = {"youngs_modulus": 1e5 * scale}
        return sim.rollout(sim.rest_state(), 2, parameters=parameters).q[-1, 0, -3:]

    alone = torch.autograd.functional.jacobian(heights, ONE)
    assert bool((alone != 0.0).any())
    with pytest.raises(DerivativeError, match="vectorize"):
        torch.autograd.functional.jacobian(heights, ONE, vectorize=True)
    for function in (of_modulus, of_state):
        with (
            forward_ad.dual_level(),
            pytest.raises(DerivativeError, match="forward-mode derivatives"),
        ):
            function(sim, forward_ad.make_dual(ONE, ONE))
    d = torch.tensor([0.3], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(barrier_pressure(d, 1.0).sum(), d, create_graph=True)
    with pytest.raises(DerivativeError):
        torch.autograd.grad(slope.sum(), d)
