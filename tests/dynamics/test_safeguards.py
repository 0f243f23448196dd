"""What must never pass in silence: masks taken for indices, failures for results, settings that no longer hold."""

import dataclasses
import re

import numpy as np
import pytest
import torch

from support.clamped import clamped
from warp_resphys import Body, Corotated, Inputs, Simulator, SolverSettings, State, box_hexahedra
from warp_resphys.dynamics import statics
from warp_resphys.io.errors import ConvergenceError, InputError
from warp_resphys.linalg.choice import make_linear_solver

MESH = box_hexahedra((0.06, 0.03, 0.03), (2, 1, 1))
CLAMPED = clamped(MESH)
RUBBER = Corotated(264e3, 0.45)


def test_a_static_equilibrium_that_takes_long_shows_its_iterations(monkeypatch, capsys):
    """Iterations and residual, in the error output; the callback of the potential is that of before afterwards."""
    simulator = Simulator(CLAMPED, RUBBER)
    simulator.static_equilibrium()
    assert capsys.readouterr() == ("", "")
    monkeypatch.setattr(statics, "QUIET_SECONDS", 1e-9)
    simulator.static_equilibrium(batch=2)
    shown = capsys.readouterr().err
    assert re.search(r"^static equilibrium: iteration \d+ \(limit 100\), in \d s, residual \S+e-\d+$", shown, re.M)
    assert simulator.workspace(2).parts[0][1].potential.on_direction() is None


@pytest.mark.parametrize("fixed", [MESH.vertices[:, 0] == 0.0, [0.7], "abc"])
def test_only_vertex_numbers_are_fixed(fixed):
    with pytest.raises(InputError, match="fixed vertices must be vertex numbers"):
        Body(MESH, fixed=fixed)


def test_statics_never_return_a_failure():
    settings = SolverSettings(max_iterations=1, on_failure="count")
    with pytest.raises(ConvergenceError):
        Simulator(CLAMPED, RUBBER, solver=settings).static_equilibrium()


def test_an_equilibrium_that_is_far_is_reached_under_growing_loads():
    """Where all of them at once take too many iterations; with a gradient as if they had not."""
    body = clamped(box_hexahedra((0.12, 0.02, 0.02), (6, 2, 2)))
    results = []
    for most in (2000, 8):
        modulus = torch.full((1, 1), 5e4, dtype=torch.float64, requires_grad=True)
        simulator = Simulator(body, Corotated(5e4, 0.45), solver=SolverSettings(max_iterations=most))
        q = simulator.static_equilibrium(parameters={"youngs_modulus": modulus}).q
        q[..., 2].mean().backward()
        results.append((q.detach(), modulus.grad))
    assert float((results[0][0] - simulator.rest_positions).abs().max()) > 0.05
    torch.testing.assert_close(results[1], results[0], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("linear_solver", ["banded", "sparse"])
def test_a_singular_system_is_a_convergence_error_with_every_linear_solver(linear_solver):
    hinged = Body(MESH, fixed=[0])
    sim = Simulator(hinged, RUBBER, solver=SolverSettings(linear_solver=linear_solver, max_iterations=20))
    with pytest.raises(ConvergenceError):
        sim.static_equilibrium()


def test_a_singular_adjoint_is_an_error():
    sim = Simulator(Body(MESH, fixed=[0]), RUBBER, gravity=(0.0, 0.0, 0.0))
    force = torch.zeros(1, len(MESH.vertices), 3, dtype=torch.float64, requires_grad=True)
    state = sim.static_equilibrium(Inputs(force))
    with pytest.raises(ConvergenceError, match="adjoint system is singular"):
        state.q[0, -1, 2].backward()


def test_a_simulator_is_constant():
    sim = Simulator(CLAMPED, RUBBER)
    with pytest.raises(AttributeError, match="a simulator is constant"):
        sim.gravity = (0.0, 0.0, 0.0)
    assert dataclasses.replace(sim, gravity=(0.0, 0.0, 0.0)).prepare().gravity.abs().max() == 0.0


def test_states_of_another_type_are_refused():
    sim = Simulator(CLAMPED, RUBBER)
    state = sim.rest_state()
    with pytest.raises(InputError, match=r"state\.q"):
        sim.step(State(state.q.float(), state.v))
    with pytest.raises(InputError, match=r"state\.q"):
        sim.step(State(state.q.numpy(), state.v))
    with pytest.raises(InputError, match="steps is -3"):
        sim.rollout(state, -3)
    with pytest.raises(InputError, match="the inputs are a Tensor: give Inputs"):
        sim.step(state, torch.zeros_like(state.q))


def test_a_matrix_beyond_32_bit_addresses_is_refused():
    nodes = np.arange(20_000)
    with pytest.raises(InputError, match=r"choose solver.linear_solver=sparse"):
        make_linear_solver("dense", nodes, nodes, len(nodes), 3, torch.device("cpu"), torch.float64)
