"""Roll-outs of which some environments diverge."""

import pytest
import torch

from warp_resphys import Body, Corotated, Simulator, SolverSettings, box_hexahedra, select_vertices
from warp_resphys.learning.rollout import Rollout


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_lost_environments_stand_at_rest_without_inputs(integrator):
    mesh = box_hexahedra((0.04, 0.02, 0.02), (2, 1, 1))
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0))
    settings = SolverSettings(on_failure="count", max_iterations=15)
    simulator = Simulator(body, Corotated(2e4, 0.3, prony=[(0.5, 0.1)]), integrator=integrator, solver=settings)

    def predict(state, step):
        force = torch.zeros_like(state.q)
        force[1] = torch.nan if step == 2 else 0.0
        if step == 3:  # which the solver cannot follow
            force[2] = 1e3 * torch.randn(force[2].shape, generator=torch.Generator().manual_seed(0), dtype=force.dtype)
        return force

    rollout, alone = Rollout(simulator, predict), Rollout(simulator)
    state, other = simulator.rest_state(3), simulator.rest_state(3)
    for _ in range(5):
        state, other = rollout.step(state), alone.step(other)
    assert rollout.lost(state).tolist() == [False, True, True]
    assert torch.equal(state.q[1:], simulator.rest_positions.expand(2, -1, -1))
    assert all(not bool(t[1:].any()) for name, t in state.tensors().items() if name not in ("q", "previous_q"))
    assert float(other.memory["viscous_strain"].abs().max()) > 1e-6
    for name, tensor in state.tensors().items():
        torch.testing.assert_close(tensor[0], other.tensors()[name][0], rtol=0.0, atol=1e-9)
