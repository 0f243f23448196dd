"""Start of a step: extrapolated from the steps before, if it follows them."""

import pytest
import torch

from support.clamped import clamped
from warp_resphys import Body, Corotated, Simulator, SolverSettings, State, box_hexahedra
from warp_resphys.dynamics.nonlinear_solver import SOLVERS
from warp_resphys.stepping.inputs import Inputs
from warp_resphys.studies.gradient_check import pose

MESH = box_hexahedra((0.06, 0.02, 0.02), (4, 2, 2))
BODY = clamped(MESH)
MATERIAL = Corotated(1e5, 0.45, density=1000.0)


def simulator(body=BODY, **options):
    settings = {"relative_tolerance": 1e-8} | options.pop("solver", {})
    return Simulator(body, MATERIAL, solver=SolverSettings(**settings), **options)


def iterations(reports):
    return [report.iterations.tolist() for report in reports]


@pytest.mark.parametrize(("name", "degree"), [*zip(SOLVERS, (0, 1, 2), strict=True)])
def test_polynomial_forces_are_extrapolated(name, degree, device):
    """A free body under its weight and a multiple of it: how far a step is off inertia goes with the force."""
    s = simulator(Body(MESH), device=device, solver={"name": name})
    weight = s.prepare().mass[0, :, None] * torch.tensor([0.0, 0.0, 9.8], dtype=torch.float64, device=device)
    growth = torch.arange(7, dtype=torch.float64, device=device) ** degree
    forces = (growth[:, None, None, None] * torch.tensor([[[1.0]], [[-2.0]]], device=device).double()) * weight
    counts = iterations(s.rollout(s.rest_state(2), 7, Inputs(forces)).reports)
    assert min(counts[0]) > 0
    assert counts[degree + 2 :] == [[0, 0]] * (5 - degree)


@pytest.mark.parametrize(("integrator", "time_step"), [("implicit_euler", 0.01), ("bdf2", 0.0002)])
def test_it_saves_iterations_and_changes_no_state(integrator, time_step, device):
    options = {"integrator": integrator, "time_step": time_step, "solver": {"name": "newton"}}
    pair = [simulator(device=device, **options) for _ in range(2)]
    start, steps = pair[0].rest_state(2), 40
    followed = pair[0].rollout(start, steps)
    state, alone = start, []
    for k in range(steps):  # In turns, so that neither goes on where its own last step has led.
        state = pair[k % 2].step(state)
        alone.append(state.report)
    sums = [sum(sum(counts) for counts in iterations(reports)) for reports in (followed.reports, alone)]
    assert sums[0] < (1.02 if time_step == 0.01 else 0.9) * sums[1]
    torch.testing.assert_close(followed.q[-1], state.q, rtol=0.0, atol=2e-9)


@pytest.mark.parametrize("name", SOLVERS)
def test_another_motion_begins_anew(name, device):
    """A roll-out finds, bit for bit, what that of a new simulator finds: neither guesses nor factors are left over."""
    s, fresh = (simulator(device=device, solver={"name": name}) for _ in range(2))
    s.rollout(pose(s, "bent", 2), 5)
    other = s.rest_state(2)
    torch.testing.assert_close(s.rollout(other, 5).q, fresh.rollout(other, 5).q, rtol=0.0, atol=0.0)


def test_a_failure_is_not_extrapolated(device):
    s = simulator(device=device, solver={"on_failure": "count", "max_iterations": 30})
    state = s.rollout(pose(s, "bent", 2), 4).final
    state.v[0] += 1e4  # in place: the next step still follows
    failed = s.step(state)
    assert failed.converged.tolist() == [False, True]
    counts = s.workspace(2).minimiser("dynamics", s.settings)._now.corrections
    before = counts.tolist()
    assert min(before) == 3
    calm = State(pose(s, "bent", 2).q, torch.zeros_like(failed.v))
    failed.q.copy_(calm.q)
    failed.v.copy_(calm.v)
    assert bool(s.step(failed).converged.all())
    assert counts.tolist() == [1, 3]  # only the correction of the last step
