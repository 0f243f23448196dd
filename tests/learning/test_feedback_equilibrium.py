"""Equilibria under forces that depend on the state: a beam on springs, and a force that has no equilibrium."""

import pytest
import torch

from warp_resphys import Body, Corotated, Inputs, Simulator, SolverSettings, select_vertices
from warp_resphys.io.errors import ConvergenceError
from warp_resphys.learning.rollout import equilibrium_under_feedback
from warp_resphys.mesh.mesh import box_hexahedra

MESH = box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1))
TIP = select_vertices(MESH, x=0.06)


def at_rest(*stiffnesses):
    """The state of beams with springs (N/m) from their tips to the places of their tips at rest, and the force."""
    body = Body(MESH, fixed=select_vertices(MESH, x=0.0))
    s = Simulator(body, Corotated(1e5, 0.4), solver=SolverSettings("newton", 1e-12))
    k = torch.zeros(len(stiffnesses), len(MESH.vertices), 1, dtype=torch.float64)
    k[:, TIP] = torch.tensor(stiffnesses, dtype=torch.float64)[:, None, None]

    def force(state):
        return k * (s.rest_positions - state.q)

    guess = s.rest_state(len(stiffnesses))
    return s, equilibrium_under_feedback(s, Inputs(), s.prepare(), guess, force), force


@pytest.mark.parametrize("stiffnesses", [(0.0,), (0.0, 1.0, 30.0), (-0.5, 5.0)])
def test_the_force_and_the_weight_are_in_balance(stiffnesses):
    s, state, force = at_rest(*stiffnesses)
    again = s.static_equilibrium(Inputs(force(state)))
    torch.testing.assert_close(again.q, state.q, rtol=0.0, atol=1e-7)
    sags = -(state.q[:, TIP, 2] - s.rest_positions[TIP, 2]).mean(1)
    assert (sags > 0.0).all()
    assert (torch.diff(sags) < 0.0).all()  # A stiffer spring carries more.
    free = at_rest(0.0)[1].q
    if 0.0 in stiffnesses:
        torch.testing.assert_close(state.q[:1], free, rtol=0.0, atol=1e-9)


def test_a_force_that_turns_round_has_no_equilibrium():
    """It pushes the tip back over the height at which it rests without the force."""
    s, free, _ = at_rest(0.0)
    height = free.q[:, TIP, 2].mean()

    def force(state):
        push = torch.zeros_like(state.q)
        push[:, TIP, 2] = -0.02 * torch.sign(state.q[:, TIP, 2].mean() - height)
        return push

    with pytest.raises(ConvergenceError) as caught:
        equilibrium_under_feedback(s, Inputs(), s.prepare(), s.rest_state(), force)
    assert caught.value.report.tolist() == [False]
