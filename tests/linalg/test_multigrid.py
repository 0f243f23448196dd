"""Multigrid on the Hessians of beams, against direct solves."""

import numpy as np
import pytest
import torch

from warp_resphys.dynamics.assembly import HessianAssembly
from warp_resphys.dynamics.nonlinear_solver import SolverSettings
from warp_resphys.dynamics.simulator import Simulator
from warp_resphys.energies.catalogue import make_material
from warp_resphys.energies.contact import Contact
from warp_resphys.energies.obstacles import HalfSpace
from warp_resphys.fem.body import Body
from warp_resphys.linalg import multigrid
from warp_resphys.linalg.multigrid import MultigridSolver
from warp_resphys.mesh.mesh import box_hexahedra, box_tetrahedra, select_vertices
from warp_resphys.stepping.inputs import Inputs
from warp_resphys.stepping.state import State

SIZE = (0.1, 0.03, 0.03)
pytestmark = pytest.mark.numerics


@pytest.fixture(autouse=True)
def several_levels(monkeypatch):
    monkeypatch.setattr(multigrid, "_COARSEST", 40)


def beam(refinement=1, quadratic=False, poissons_ratio=0.45, fixed=True, **options):
    if quadratic:
        mesh = box_tetrahedra(SIZE, (5 * refinement, 2 * refinement, 2 * refinement), 2)
    else:
        mesh = box_hexahedra(SIZE, (10 * refinement, 3 * refinement, 3 * refinement))
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0) if fixed else [])
    material = make_material("corotated", youngs_modulus=2.15e5, poissons_ratio=poissons_ratio, density=1070.0)
    return Simulator(body, material, 0.01, **options)


def system(simulator, stretch=1.0, device="cpu"):
    """The solver of a step's Hessian where the body is stretched at constant volume, and its values."""
    simulator.step(simulator.rest_state())
    workspace = simulator.workspace(1)
    potential, pattern = workspace.potential, workspace.pattern
    potential.positions.copy_(simulator.rest_positions * simulator.tensor([stretch, stretch**-0.5, stretch**-0.5]))
    solver = MultigridSolver(
        pattern.rows, pattern.cols, len(pattern.free), 3, torch.device(device), torch.float64, pattern.positions
    )
    potential.update_tangent()
    return solver, HessianAssembly(potential, solver, pattern)().clone()


def diagonal_of(solver):
    row, column, place = solver.both_triangles
    return torch.as_tensor(place[row == column])


def dense(solver, values):
    return solver.matrix(values[0]).toarray()


@pytest.mark.parametrize(("quadratic", "poissons_ratio"), [(False, 0.499), (True, 0.45)])
def test_solutions_and_directions(quadratic, poissons_ratio):
    solver, values = system(beam(1, quadratic, poissons_ratio), 1.02)
    matrix = dense(solver, values)
    factor = solver.factor(values)
    assert not factor.failed.any()
    right = np.random.default_rng(0).normal(size=(1, solver.n, 3))
    expected = np.linalg.solve(matrix, right)
    solution = factor.solve(torch.as_tensor(right)).numpy()
    np.testing.assert_allclose(solution, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    direction = torch.as_tensor(right[:, :, 0].copy())
    factor.solve_in_place(direction)
    error, exact = direction[0].numpy() - expected[0, :, 0], expected[0, :, 0]
    assert error @ matrix @ error < 0.03**2 * (exact @ matrix @ exact)
    assert direction[0].numpy() @ right[0, :, 0] > 0.0


def test_the_cycle_is_symmetric_and_positive_definite():
    solver, values = system(beam(poissons_ratio=0.499))
    cycle = solver.factor(values).factors[0].cycle
    assert cycle._levels
    operator = cycle.apply(torch.eye(solver.n, dtype=torch.float64)).numpy()
    np.testing.assert_allclose(operator, operator.T, rtol=0, atol=1e-10 * np.abs(operator).max())
    assert np.linalg.eigvalsh(0.5 * (operator + operator.T))[0] > 0.0


def test_no_eigenvalue_exceeds_what_the_smoother_is_made_for():
    """Also where few vertices are stiff: the tip is pressed against a floor."""
    mesh = box_hexahedra((0.1, 0.03, 0.03), (9, 3, 3))
    slope = HalfSpace(position=(0.0, 0.0, -2e-3), axis=(-0.019, 0.0, 1.0))  # 0.1 mm below the tip
    floor = Contact({"floor": slope}, stiffness=1e5)
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0), energies=[floor])
    simulator = Simulator(body, make_material("corotated", youngs_modulus=2.15e5, poissons_ratio=0.45, density=1070.0))
    solver, values = system(simulator)
    for level in solver.factor(values).factors[0].cycle._levels:
        root = torch.block_diag(*torch.linalg.cholesky(level.inverse)).numpy()
        largest = np.linalg.eigvalsh(root.T @ level.matrix.to_dense().numpy() @ root)[-1]
        assert 0.8 * level.largest < largest < level.largest


def test_an_indefinite_matrix_is_reported_or_solved_all_the_same():
    solver, values = system(beam())
    matrix = dense(solver, values)
    shift = 0.5 * (np.linalg.eigvalsh(matrix)[2] + np.linalg.eigvalsh(matrix)[3])
    diagonal = diagonal_of(solver)
    values[:, diagonal] -= shift
    right = torch.ones(1, solver.n, 1, dtype=torch.float64)
    expected = np.linalg.solve(dense(solver, values), right.numpy())
    factor = solver.factor(values)
    assert factor.failed.all()
    solution = solver.pivoted(values, factor).solve(right)
    np.testing.assert_allclose(solution, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_a_cycle_serves_later_matrices_until_it_is_stale():
    """And a matrix that turns out to be indefinite only then is solved exactly, and never goes uphill."""
    solver, values = system(beam())
    right = torch.as_tensor(np.random.default_rng(2).normal(size=(1, solver.n, 1)))
    first = solver.factor(values)
    first.solve(right)
    near = solver.factor(1.1 * values)
    assert near.factors[0].cycle is first.factors[0].cycle
    np.testing.assert_allclose(1.1 * near.solve(right), first.solve(right), rtol=0, atol=1e-9)
    diagonal = diagonal_of(solver)
    bent = values.clone()
    bent[:, diagonal] -= 1.02 * float(np.linalg.eigvalsh(dense(solver, values))[0])
    indefinite = solver.factor(bent)
    expected = np.linalg.solve(dense(solver, bent), right.numpy())
    np.testing.assert_allclose(indefinite.solve(right), expected, rtol=0, atol=1e-7 * np.abs(expected).max())
    direction = right[:, :, 0].clone()
    indefinite.solve_in_place(direction)
    assert float((direction * right[:, :, 0]).sum()) > 0.0
    stiffer = values.clone()
    stiffer[:, diagonal] *= torch.as_tensor(10.0 ** np.random.default_rng(3).uniform(0, 4, size=len(diagonal)))
    later = solver.factor(stiffer)
    later.solve(right)
    assert later.factors[0].cycle.stale
    assert solver.factor(stiffer).factors[0].cycle is not first.factors[0].cycle


@pytest.mark.parametrize("name", ["quasi_newton", pytest.param("projective_dynamics", marks=pytest.mark.slow)])
def test_steps_and_gradients_are_those_of_a_direct_solver(name):
    ends = []
    for linear_solver in ("banded", "multigrid"):
        settings = SolverSettings(name, relative_tolerance=1e-9, linear_solver=linear_solver, max_iterations=20_000)
        simulator = beam(solver=settings)
        state = simulator.rest_state(2)
        q = state.q.clone().requires_grad_(True)
        force = simulator.tensor(np.array([0.0, 1.0])[:, None, None] * [0.0, 1e-3, 0.0])
        end = simulator.rollout(State(q, state.v), 3, Inputs(force.expand_as(q))).q[-1]
        ends.append((end.detach(), torch.autograd.grad(end.square().sum(), q)[0]))
    (q, gradient), (other_q, other_gradient) = ends
    np.testing.assert_allclose(q, other_q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(gradient, other_gradient, rtol=0, atol=1e-7 * float(gradient.abs().max()))
