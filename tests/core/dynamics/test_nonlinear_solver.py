"""The three nonlinear solvers: agreement, failures, batches, and their extrapolated starts."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.clamped import clamped, noise
from warp_resphys import (
    Body,
    Corotated,
    Inputs,
    Simulator,
    SolverSettings,
    State,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.dynamics.gradient_check import pose
from warp_resphys.core.dynamics.minimiser import Minimiser
from warp_resphys.core.dynamics.nonlinear_solver import SOLVERS
from warp_resphys.core.energies.catalogue import MATERIALS
from warp_resphys.core.energies.launcher import struct_of
from warp_resphys.io.errors import ConvergenceError, InputError
from warp_resphys.kernels import minimisation as kernels

MESH = box_hexahedra((0.06, 0.02, 0.02), (4, 2, 2))
BODY = clamped(MESH)
MATERIAL = Corotated(1e5, 0.45, density=1000.0, stiffness_damping=1e-3)


def simulator(name="quasi_newton", material=MATERIAL, device="cpu", **settings):
    chosen = SolverSettings(name=name, **({"relative_tolerance": 1e-9} | settings))
    return Simulator(BODY, material, solver=chosen, device=device)


@pytest.mark.parametrize(
    ("model", "start"), [("corotated", "twisted"), ("stable_neo_hookean", "bent")]
)
def test_all_solvers_find_the_same_trajectory(model, start, device):
    material = MATERIALS[model](**MATERIAL.values)
    results = {}
    for name in SOLVERS:
        s = simulator(name, material, device=device, max_iterations=5000)
        trajectory = s.rollout(pose(s, start, 2), 4)
        assert all(bool(r.converged.all()) for r in trajectory.reports)
        assert all(float(r.relative_residual.max()) <= 1e-9 for r in trajectory.reports)
        results[name] = trajectory.q
    for name in SOLVERS[1:]:
        torch.testing.assert_close(results[name], results[SOLVERS[0]], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "poissons_ratio"), [*zip(SOLVERS, (0.499, 0.499, 0.45), strict=True)]
)
def test_factors_in_single_precision_lead_to_the_same_residual(name, poissons_ratio, device):
    """And take hardly more iterations: 1e-8 is a hundredth
    of what float32 resolves of these forces.
    """
    material = replace(MATERIAL, poissons_ratio=poissons_ratio)
    results = {}
    for factors in ("double", "single"):
        s = simulator(
            name,
            material,
            device=device,
            relative_tolerance=1e-8,
            factors=factors,
            max_iterations=5000,
        )
        trajectory = s.rollout(pose(s, "bent", 2), 4)
        assert all(float(report.relative_residual.max()) <= 1e-8 for report in trajectory.reports)
        results[factors] = (
            trajectory.q,
            sum(int(report.iterations.sum()) for report in trajectory.reports),
        )
    torch.testing.assert_close(results["single"][0], results["double"][0], rtol=0.0, atol=1e-8)
    assert results["single"][0].dtype == torch.float64
    assert results["single"][1] <= 1.25 * results["double"][1]


def test_solver_finds_the_minimum_and_reports_it():
    s = simulator("newton", relative_tolerance=1e-10)
    state = pose(s, "twisted", 1)
    new = s.step(state)
    potential = s.workspace(1).potential
    potential.positions.copy_(new.q)
    energy, balance = potential.evaluate()
    residual = float(torch.linalg.vector_norm(potential.residual))
    scale = float(balance) + float(torch.linalg.vector_norm(potential.terms.force))
    assert residual / scale == pytest.approx(
        float(new.report.relative_residual), rel=1e-6, abs=1e-13
    )
    assert 2 <= int(new.report.iterations) <= 30
    potential.positions.copy_(new.q + 1e-5 * noise(*new.q.shape) * potential.free_mask[:, None])
    assert float(potential.evaluate()[0]) > float(energy)


@pytest.mark.parametrize("name", SOLVERS)
def test_failure_carries_the_last_positions_and_the_report(name):
    s = simulator(name, max_iterations=1)
    easy = s.rest_state(1)
    hard = pose(s, "twisted", 1)
    state = State(torch.cat([easy.q, hard.q]), torch.cat([easy.v, hard.v]))
    with pytest.raises(
        ConvergenceError, match=f"the {name} solver stopped after 1 iterations"
    ) as caught:
        s.step(state)
    error = caught.value
    assert error.positions.shape == (2, BODY.n_vertices, 3)
    assert bool(torch.isfinite(error.positions).all())
    assert not bool(error.report.converged[1])
    assert float(error.report.relative_residual[1]) > 1e-9
    assert "take a smaller time step" in str(error)


@pytest.fixture
def pulled_beam():
    """Simulators of the README's beam by settings, nearly incompressible,
    and its pose under a pull.
    """
    mesh = box_hexahedra((0.1, 0.03, 0.03), (10, 3, 3))
    body = clamped(mesh)

    def make(nu=0.499, **settings):
        return Simulator(body, Corotated(264e3, nu, density=1070.0), **settings)

    exact = make()
    load = torch.zeros_like(exact.rest_positions)[None]
    load[:, select_vertices(mesh, x=0.1), 2] = -0.05
    return make, exact.static_equilibrium(Inputs(load))


@pytest.mark.parametrize(("name", "tolerance"), [("quasi_newton", 1e-5), ("newton", 1e-8)])
def test_float32_converges_for_a_nearly_incompressible_solid(pulled_beam, name, tolerance, device):
    """To the resolution of its positions, about 4e-9 m:
    the volume term leaves float32 no digit of the residual.
    """
    make, held = pulled_beam
    reference = make(device=device).rollout(State(held.q.to(device), held.v.to(device)), 20)
    single = make(solver=name, relative_tolerance=tolerance, dtype=torch.float32, device=device)
    trajectory = single.rollout(State(single.tensor(held.q), single.tensor(held.v)), 20)
    assert all(bool(r.converged.all()) for r in trajectory.reports)
    assert max(float(r.relative_residual.max()) for r in trajectory.reports) <= tolerance
    assert trajectory.q.dtype == torch.float32
    torch.testing.assert_close(trajectory.q.double(), reference.q, rtol=0.0, atol=2e-8)


def test_float32_gradients_of_a_nearly_incompressible_solid(pulled_beam):
    make, held = pulled_beam
    gradients = []
    for dtype in (torch.float64, torch.float32):
        modulus = torch.tensor([264e3], dtype=dtype, requires_grad=True)
        q = held.q.to(dtype).requires_grad_()
        sim = make(dtype=dtype, relative_tolerance=1e-8)
        end = sim.rollout(
            State(q, torch.zeros_like(q)), 5, parameters={"youngs_modulus": modulus}
        ).q[-1]
        gradients.append(torch.autograd.grad(end[..., 2].square().sum(), (q, modulus)))
    for exact, single in zip(*gradients, strict=True):
        assert single.dtype == torch.float32
        assert float((single.double() - exact).norm()) < 3e-4 * float(exact.norm())


def test_a_slow_solver_is_not_taken_for_one_at_rounding(pulled_beam):
    """A kilometre from the origin rounding leaves residuals of 3e-7.

    Projective dynamics crawls long before that.
    """
    make, held = pulled_beam
    start = State(held.q + 1000.0, held.v)
    exact = make(0.495, solver="newton").step(start)
    state = make(0.495, solver="projective_dynamics").step(start)
    assert bool(state.converged)
    assert float(state.report.relative_residual) < 1.5e-6
    torch.testing.assert_close(state.q, exact.q, rtol=0.0, atol=2e-10)


@pytest.mark.parametrize(
    ("name", "linear_solver", "speed"),
    [
        ("quasi_newton", "banded", 1e80),
        ("newton", "tiled", 1e160),
        ("projective_dynamics", "dense", 1e160),
        ("quasi_newton", "sparse", 1e160),
    ],
)
def test_an_overflow_touches_neither_neighbours_nor_later_steps(name, linear_solver, speed, device):
    s = simulator(
        name, device=device, linear_solver=linear_solver, on_failure="count", max_iterations=500
    )
    calm = pose(s, "bent", 2)
    expected = [s.step(calm)]
    expected.append(s.step(expected[0]))
    wild = calm.v.clone()
    wild[0] += speed
    new = s.step(State(calm.q, wild))
    assert bool(new.converged[1])
    assert bool(torch.isfinite(new.q).all())
    torch.testing.assert_close(new.q[1], expected[0].q[1], rtol=0.0, atol=1e-9)
    state = State(torch.stack([calm.q[0], new.q[1]]), torch.stack([calm.v[0], new.v[1]]))
    for step in range(2):
        state = s.step(state)
        assert bool(state.converged.all())
        assert int(state.report.iterations.max()) <= 2 * max(
            int(own.report.iterations.max()) for own in expected
        )
        torch.testing.assert_close(state.q[0], expected[step].q[0], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "dtype", "offset"),
    [
        ("quasi_newton", torch.float32, 1.0),
        ("newton", torch.float64, 1.0),
        ("projective_dynamics", torch.float32, 0.0),
    ],
)
def test_a_body_on_which_nothing_acts_converges_at_once(name, dtype, offset):
    """Its residual is rounding, and so are the forces that it would be measured against."""
    s = Simulator(
        BODY,
        Corotated(264e3, 0.499, density=1070.0),
        gravity=(0.0, 0.0, 0.0),
        solver=name,
        dtype=dtype,
    )
    rest = s.rest_state(2)
    trajectory = s.rollout(State(rest.q + offset, rest.v), 3)
    assert max(int(report.iterations.max()) for report in trajectory.reports) <= 10
    moved = trajectory.q[-1] - offset - s.rest_positions
    assert float(moved.abs().max()) < 200 * torch.finfo(dtype).eps * (0.06 + offset)


def test_recovers_from_inverted_elements():
    s = simulator("newton", max_iterations=500)
    rest = s.rest_state(1)
    q = rest.q.clone()
    tip = torch.as_tensor(select_vertices(MESH, x=0.06))
    q[:, tip, 0] -= 0.02  # the last layer is 0.015 thick
    trajectory = s.rollout(State(q, rest.v), 40)
    spread = trajectory.q[-1, 0, tip, 0].mean() - trajectory.q[-1, 0, :, 0].min()
    assert float(spread) > 0.04


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"name": "gauss"}, "SolverSettings.name is 'gauss': it must be one of quasi_newton"),
        ({"relative_tolerance": 0.0}, "SolverSettings.relative_tolerance"),
        ({"relative_tolerance": float("nan")}, "SolverSettings.relative_tolerance is nan"),
        ({"absolute_tolerance": -1.0}, "SolverSettings.absolute_tolerance"),
        ({"max_iterations": 0}, "SolverSettings.max_iterations"),
        ({"memory": -1}, "SolverSettings.memory"),
        ({"on_failure": "ignore"}, "SolverSettings.on_failure"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        SolverSettings(**settings)


class DiagonalMetric:
    """A matrix of the global step that the test can invert: another one for each environment."""

    def __init__(self, inverse, vertex_at):
        self.inverse, self.vertex_at = inverse, vertex_at
        self.clamped = torch.ones(len(inverse), dtype=torch.bool)

    def refactor(self, clamp=None, active=None):
        """It is always the same."""

    def solve_in_place(self, right, needed):
        right.mul_(self.inverse)


def bfgs_inverse(inverse, pairs):
    """Nocedal and Wright (2006), equation 6.17, one pair after another,
    where the curvature is positive.
    """
    h, unit = torch.diag(inverse), torch.eye(len(inverse), dtype=torch.float64)
    for s, y in pairs:
        left = unit - torch.outer(s, y) / (s @ y)
        h = left @ h @ left.T + torch.outer(s, s) / (s @ y)
    return h


def test_directions_equal_the_bfgs_formula():
    """More pairs than memory, two environments with line searches of their own,
    vertices in another order.
    """
    s, memory = simulator(), 3
    potential, free = s.workspace(2).potential, BODY.n_vertices - len(BODY.fixed_vertices)
    s.step(pose(s, "bent", 2))  # sets the terms of a step
    generator = torch.Generator().manual_seed(0)
    vertex_at = np.setdiff1d(np.arange(BODY.n_vertices), BODY.fixed_vertices)[::-1].copy()
    inverse = 2e-3 * (1.0 + torch.rand(2, free, 3, generator=generator, dtype=torch.float64))
    metric = DiagonalMetric(inverse, vertex_at)
    limits = {"relative": 1e-12, "absolute": 1e-12, "epsilon": 2e-16}
    limits = struct_of(
        kernels.Tolerances, **limits, max_iterations=1000, refactor_after=kernels.NEVER
    )
    minimiser = Minimiser(potential, metric, torch.float64, memory, limits)
    start = s.rest_positions + 1e-3 * torch.randn(
        2, BODY.n_vertices, 3, generator=generator, dtype=torch.float64
    )
    start[:, s.fixed] = s.rest_positions[s.fixed]
    state = minimiser.begin(start)

    def now(b):
        return (
            field[b, vertex_at].flatten().clone()
            for field in (potential.positions, potential.residual)
        )

    pairs = ([], [])
    here = [tuple(now(b)) for b in range(2)]
    searches = 0
    minimiser.refactor(state)
    while min(map(len, pairs)) < 3 * memory:
        state = minimiser.advance(state)
        waits = minimiser._now.fields["phase"] != kernels.NEED_DIRECTION
        searches += int(waits.sum())
        for b in range(2):
            if waits[b]:
                continue
            x, g = now(b)
            expected = -bfgs_inverse(inverse[b].flatten(), pairs[b][-memory:]) @ here[b][1]
            moved = x - here[b][0]
            share = float(moved @ expected / (expected @ expected))
            torch.testing.assert_close(
                moved, share * expected, rtol=0.0, atol=1e-9 * float(moved.abs().max())
            )
            assert share > 0.0
            pairs[b].append((moved, g - here[b][1]))
            here[b] = (x, g)
    assert searches > 0


UNDAMPED = replace(MATERIAL, stiffness_damping=0.0)


def stepping(body=BODY, **options):
    settings = {"relative_tolerance": 1e-8} | options.pop("solver", {})
    return Simulator(body, UNDAMPED, solver=SolverSettings(**settings), **options)


def iterations(reports):
    return [report.iterations.tolist() for report in reports]


@pytest.mark.parametrize(("name", "degree"), [*zip(SOLVERS, (0, 1, 2), strict=True)])
def test_polynomial_forces_are_extrapolated(name, degree, device):
    """A free body under its weight and a multiple of it:
    how far a step is off inertia goes with the force.
    """
    s = stepping(Body(MESH), device=device, solver={"name": name})
    weight = s.prepare().mass[0, :, None] * torch.tensor(
        [0.0, 0.0, 9.8], dtype=torch.float64, device=device
    )
    growth = torch.arange(7, dtype=torch.float64, device=device) ** degree
    forces = (
        growth[:, None, None, None] * torch.tensor([[[1.0]], [[-2.0]]], device=device).double()
    ) * weight
    counts = iterations(s.rollout(s.rest_state(2), 7, Inputs(forces)).reports)
    assert min(counts[0]) > 0
    assert counts[degree + 2 :] == [[0, 0]] * (5 - degree)


@pytest.mark.parametrize(("integrator", "time_step"), [("implicit_euler", 0.01), ("bdf2", 0.0002)])
def test_it_saves_iterations_and_changes_no_state(integrator, time_step, device):
    options = {"integrator": integrator, "time_step": time_step, "solver": {"name": "newton"}}
    pair = [stepping(device=device, **options) for _ in range(2)]
    start, steps = pair[0].rest_state(2), 40
    followed = pair[0].rollout(start, steps)
    state, alone = start, []
    for k in range(steps):  # In turns, so that neither goes on where its own last step has led.
        state = pair[k % 2].step(state)
        alone.append(state.report)
    sums = [
        sum(sum(counts) for counts in iterations(reports)) for reports in (followed.reports, alone)
    ]
    assert sums[0] < (1.02 if time_step == 0.01 else 0.9) * sums[1]
    torch.testing.assert_close(followed.q[-1], state.q, rtol=0.0, atol=2e-9)


@pytest.mark.parametrize("name", SOLVERS)
def test_another_motion_begins_anew(name, device):
    """A roll-out finds, bit for bit, what that of a new simulator finds:
    neither guesses nor factors are left over.
    """
    s, fresh = (stepping(device=device, solver={"name": name}) for _ in range(2))
    s.rollout(pose(s, "bent", 2), 5)
    other = s.rest_state(2)
    torch.testing.assert_close(s.rollout(other, 5).q, fresh.rollout(other, 5).q, rtol=0.0, atol=0.0)


def test_a_failure_is_not_extrapolated(device):
    s = stepping(device=device, solver={"on_failure": "count", "max_iterations": 30})
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
