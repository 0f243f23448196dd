"""Problems of a step's force: their linearisation against a dense solve, and forces that are known."""

import pytest
import torch

from warp_resphys import Body, Corotated, Inputs, Simulator, SolverSettings, bind_markers, select_vertices
from warp_resphys.io.errors import InputError
from warp_resphys.learning.reconstruction_problems import (
    FullStateProblem,
    MarkerForceProblem,
    MarkerPositionProblem,
    Step,
)
from warp_resphys.linalg.least_squares import minimise
from warp_resphys.mesh.mesh import box_hexahedra

MESH = box_hexahedra((0.04, 0.02, 0.02), (2, 1, 1))
MARKERS = bind_markers(MESH, MESH.vertices[select_vertices(MESH, x=0.04)], list("abcd"))
GENERATOR = torch.Generator().manual_seed(0)


def step_of(weight, sparse):
    """A step that forces on two beams have led to another end, seen as whole states or markers."""
    body = Body(MESH, fixed=select_vertices(MESH, x=0.0))
    s = Simulator(body, Corotated(1e5, 0.4), solver=SolverSettings("newton", 1e-13))
    state = s.rest_state(2)
    force = 0.05 * torch.rand(state.q.shape, generator=GENERATOR, dtype=torch.float64)
    force[:, s.fixed] = 0.0
    end, _ = s.step(state, Inputs(force))
    constants, observation = s.prepare(), {"observation": MARKERS} if sparse else {}
    seen = MARKERS(end.q) if sparse else end.q
    return Step(s, constants, state, Inputs(), seen, weight, **observation), force, end


def test_a_gauss_newton_step_of_whole_states_solves_its_equations():
    step, _, _ = step_of(1e-5, False)
    problem = FullStateProblem(step)
    x = problem.start(None).x
    x = x + 1e-4 * step.linearise().hold(torch.rand(x.shape, generator=GENERATOR, dtype=torch.float64))
    x[:, step.simulator.fixed] = step.observed[:, step.simulator.fixed]
    free = torch.as_tensor([v for v in range(len(MESH.vertices)) if v not in step.simulator.fixed])
    h = torch.zeros(2, 3 * len(free), 3 * len(free), dtype=torch.float64)
    for column in range(3 * len(free)):
        moved = torch.zeros_like(x)
        moved[:, free[column // 3], column % 3] = 1e-7
        ahead, behind = (problem.evaluate(x + sign * moved).kept[0][:, free].flatten(1) for sign in (1.0, -1.0))
        h[:, :, column] = (ahead - behind) / 2e-7
    point = problem.evaluate(x)
    g, off = (field[:, free].flatten(1)[..., None] for field in (point.kept[0], x - step.observed))
    assert point.value == pytest.approx((off.square().sum((1, 2)) + 1e-5 * g.square().sum((1, 2))).numpy(), rel=1e-12)
    expected = torch.linalg.solve(torch.eye(h.shape[1]) + 1e-5 * h @ h, -off - 1e-5 * h @ g)
    move = problem.linearise(point)
    for damping in (0.0, 3.0):
        taken = (move(torch.full((2,), damping).double()) - x)[:, free].flatten(1)
        torch.testing.assert_close(taken, expected[..., 0] / (1.0 + damping), rtol=1e-4, atol=1e-9)


def test_without_regularisation_the_force_is_the_one_that_acted():
    step, force, end = step_of(0.0, False)
    problem = FullStateProblem(step)
    x, found = problem.solution(problem.start(None))
    torch.testing.assert_close(x, end.q, rtol=0.0, atol=1e-12)
    torch.testing.assert_close(found, force, rtol=0.0, atol=1e-8)
    step.observed[0, 3] = torch.nan
    with pytest.raises(InputError, match="not seen"):
        FullStateProblem(step)


def test_both_problems_of_markers_have_one_minimum():
    """The smallest force that brings the markers there, whether positions or forces are searched."""
    step, force, end = step_of(1e-9, True)
    results = {}
    for kind in (MarkerPositionProblem, MarkerForceProblem):
        problem = kind(step)
        options = {"tolerance": 1e-12, "max_iterations": 40}
        found = minimise(problem, problem.start(None), **options)
        results[kind] = problem.solution(found.point)
    for x, smallest in results.values():
        torch.testing.assert_close(MARKERS(x), MARKERS(end.q), rtol=0.0, atol=1e-6)
        assert (smallest.square().sum((1, 2)) < force.square().sum((1, 2))).all()
    (_, one), (_, other) = results.values()
    torch.testing.assert_close(one, other, rtol=0.0, atol=1e-5 * float(one.abs().max()))
