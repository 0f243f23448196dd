"""Kept factors: in single precision, rotated with the body,
and preconditioning adjoints of other states.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from support.clamped import clamped, noise
from warp_resphys import (
    Corotated,
    Inputs,
    Mesh,
    Rigid,
    Simulator,
    SolverSettings,
    State,
    Tendons,
    box_hexahedra,
)
from warp_resphys.core.dynamics import equilibrium, kept_factor
from warp_resphys.core.dynamics.kept_factor import Corotation
from warp_resphys.core.fem.coordinates import SymmetryPlane
from warp_resphys.core.linalg.pardiso import PardisoSolver, has_pardiso
from warp_resphys.core.mesh.boxes import box_tetrahedra

pytestmark = pytest.mark.skipif(
    not has_pardiso(), reason="needs the package mkl, which x86 processors alone have"
)

BOX = box_hexahedra((0.06, 0.04, 0.04), (4, 3, 3))
CAP = np.flatnonzero(BOX.vertices[BOX.cells].mean(1)[:, 0] > 0.045)
BODIES = {
    "hexahedra": clamped(BOX),
    "tetrahedra": clamped(box_tetrahedra((0.06, 0.04, 0.04), (4, 3, 3))),
    "rigid part": clamped(
        Mesh(BOX.vertices, BOX.cells, {"cap": CAP}), rigid={"cap": Rigid(density=1200.0)}
    ),
    "tendon": clamped(BOX, energies=[Tendons([[[0.0, 0.01, 0.04], [0.06, 0.01, 0.04]]], 400.0)]),
    "symmetry": clamped(BOX, symmetry=[SymmetryPlane((0.0, 1.0, 0.0), 0.0)]),
}


def simulator(kind, linear_solver, poissons_ratio=0.45, youngs_modulus=264e3, **options):
    solver = SolverSettings(linear_solver=linear_solver, **{"relative_tolerance": 1e-10, **options})
    return Simulator(
        BODIES[kind], Corotated(youngs_modulus, poissons_ratio, density=1070.0), solver=solver
    )


def turned(angle):
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def adjoints(sim, states, monkeypatch):
    """Adjoints of a random gradient at states, one after another,
    and the factors and iterations that they took.
    """
    counts = SimpleNamespace(factors=0, iterations=[])
    factor, iterate = PardisoSolver.direction_factor, kept_factor.conjugate_gradients

    def counted_factor(*arguments, **options):
        counts.factors += 1
        return factor(*arguments, **options)

    def counted(*arguments):
        result = iterate(*arguments)
        counts.iterations.append(result.iterations)
        return result

    monkeypatch.setattr(PardisoSolver, "direction_factor", counted_factor)
    monkeypatch.setattr(kept_factor, "conjugate_gradients", counted)
    own = sim.workspace(1)
    matrix = own.hessian(sim.settings.linear_solver)
    sim.step(sim.rest_state())  # sets the terms of a step
    counts.factors = 0
    right = noise(1, sim.body.n_vertices, 3, seed=1)
    out = []
    for q in states:
        own.potential.positions.copy_(q)
        out.append(equilibrium._adjoint_solution(own.potential, [matrix], right)[0])
    return out, counts


@pytest.mark.parametrize(
    ("kind", "youngs_modulus", "poissons_ratio"),
    [("hexahedra", 264e3, 0.499), ("tetrahedra", 2e9, 0.45), ("rigid part", 2e9, 0.499)],
)
def test_adjoints_by_a_factor_of_the_rest_state_are_those_of_a_factor_in_double(
    kind, youngs_modulus, poissons_ratio, monkeypatch
):
    both = []
    for name in ("pardiso", "banded"):
        sim = simulator(kind, name, poissons_ratio, youngs_modulus)
        rest = sim.rest_state()
        force = torch.zeros_like(rest.q)
        force[..., 2] = 2e-7 * youngs_modulus
        bent = sim.rollout(rest, 3, Inputs(external_force=force)).q[-1]
        assert float((bent - rest.q).abs().max()) > 1e-3
        solutions, counts = adjoints(sim, [rest.q, bent], monkeypatch)
        both.append(solutions[1])
        if name == "pardiso":
            assert counts.factors == 1
            assert counts.iterations[1] > counts.iterations[0] > 0
    torch.testing.assert_close(*both, rtol=0.0, atol=1e-9 * float(both[1].abs().max()))


def test_a_factor_rotates_with_the_body(monkeypatch):
    sim = simulator("tetrahedra", "pardiso")
    rest = sim.rest_state().q
    _, counts = adjoints(sim, [rest, rest @ turned(1.5).T, rest @ turned(-2.5)], monkeypatch)
    assert counts.factors == 1
    assert max(counts.iterations[1:]) <= counts.iterations[0] + 1


def test_rotations_are_those_of_the_body_since_the_factor_of_its_environment():
    sim = simulator("hexahedra", "pardiso")
    potential = sim.workspace(2).potential
    vertices = np.setdiff1d(np.arange(sim.body.n_vertices), sim.body.fixed_vertices)[::-1].copy()
    rest, corotation = sim.rest_state(2).q, Corotation(potential, vertices)
    stretched = rest * torch.tensor([1.2, 0.9, 1.0], dtype=torch.float64)
    potential.positions.copy_(stretched)
    corotation.record()
    potential.positions.copy_(stretched @ turned(0.7).T)
    corotation.record(torch.tensor([True, False]))
    potential.positions.copy_(stretched @ turned(2.0).T)
    corotation.update()
    vectors = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64).repeat(2, len(vertices), 1)
    expected = torch.stack([vectors[0] @ turned(1.3).T, vectors[1] @ turned(2.0).T])
    whole = vectors.clone()
    corotation.rotate(whole)
    torch.testing.assert_close(whole, expected)
    corotation.rotate_back(whole)
    torch.testing.assert_close(whole, vectors)


def test_vertices_in_symmetry_planes_and_inverted_ones_are_not_turned():
    sim = simulator("symmetry", "pardiso")
    potential, vertices = sim.workspace(1).potential, np.arange(sim.body.n_vertices)
    corotation, rest = Corotation(potential, vertices), sim.rest_state().q
    potential.positions.copy_(rest)
    corotation.record()
    potential.positions.copy_(rest @ turned(0.7).T)
    corotation.update()
    vectors = torch.ones_like(rest)
    corotation.rotate(vectors)
    moved = (vectors - 1.0).abs().amax(-1)[0] > 0.1
    assert (moved.numpy() == ((BOX.vertices[:, 1] > 1e-9) | (BOX.vertices[:, 0] < 1e-9))).all()
    potential.positions.copy_(-rest)
    corotation.update()
    corotation.rotate(vectors := torch.ones_like(rest))
    torch.testing.assert_close(vectors, torch.ones_like(rest))


def test_an_indefinite_hessian_is_solved_by_its_own_factor(monkeypatch):
    both = []
    for name in ("pardiso", "banded"):
        sim = simulator("hexahedra", name)
        flat = sim.rest_state().q * torch.tensor([0.2, 1.0, 1.0], dtype=torch.float64)
        solutions, _ = adjoints(sim, [flat], monkeypatch)
        both.append(solutions[0])
        hessian = sim.workspace(1).hessian(name)
        assert bool(hessian.linear.factor(hessian.assembly()).failed)
    torch.testing.assert_close(*both, rtol=0.0, atol=1e-9 * float(both[1].abs().max()))


@pytest.mark.parametrize(
    ("kind", "name", "poissons_ratio"),
    [
        ("tetrahedra", "quasi_newton", 0.499),
        ("hexahedra", "projective_dynamics", 0.45),
        ("rigid part", "newton", 0.45),
        ("symmetry", "quasi_newton", 0.45),
        ("tendon", "quasi_newton", 0.45),
    ],
)
def test_roll_outs_and_gradients_agree_with_those_of_the_banded_solver(kind, name, poissons_ratio):
    """A soft body that gravity bends by large rotations."""
    ends = []
    for linear_solver in ("pardiso", "banded"):
        sim = simulator(kind, linear_solver, poissons_ratio, youngs_modulus=1e4, name=name)
        rest = sim.rest_state()
        q = rest.q.clone().requires_grad_(True)
        inputs = (
            Inputs(tendon_tension=torch.tensor([[0.3]], dtype=torch.float64))
            if kind == "tendon"
            else Inputs()
        )
        end = sim.rollout(State(q, rest.v), 8, inputs)
        gradient = torch.autograd.grad(end.q[-1].square().sum() + end.v[-1].sum(), q)[0]
        ends.append((end.q[-1].detach(), gradient))
        assert float((ends[-1][0] - rest.q).abs().max()) > 0.01
    for a, b in zip(*ends, strict=True):
        torch.testing.assert_close(a, b, rtol=0.0, atol=1e-7 * float(b.abs().max()))


def test_a_gradient_has_the_size_of_its_loss():
    sim = simulator("tetrahedra", "pardiso")
    gradients = []
    for size in (1.0, 1e-32):
        q = sim.rest_state().q.clone().requires_grad_(True)
        end = sim.rollout(State(q, torch.zeros_like(q)), 2)
        gradients.append(torch.autograd.grad(size * end.q[-1].square().sum(), q)[0] / size)
    torch.testing.assert_close(*gradients, rtol=0.0, atol=1e-11 * float(gradients[0].abs().max()))
