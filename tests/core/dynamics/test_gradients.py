"""Adjoint gradients against central differences in float64."""

import math
from dataclasses import replace

import pytest
import torch

from support.clamped import clamped, noise
from support.slopes import check_rows, check_slopes
from warp_resphys import (
    Corotated,
    Simulator,
    SolverSettings,
    StableNeoHookean,
    State,
    box_hexahedra,
    box_tetrahedra,
)
from warp_resphys.core.dynamics.gradient_check import (
    POSES,
    GradientRow,
    central_difference,
    check_gradients,
    pose,
)
from warp_resphys.core.dynamics.hessian import ExactHessian
from warp_resphys.core.stepping.inputs import Inputs
from warp_resphys.core.stepping.integrators import INTEGRATORS
from warp_resphys.core.stepping.quantity import Quantity

SIZE = (0.06, 0.02, 0.02)
MESHES = {
    "hexahedron": box_hexahedra(SIZE, (3, 1, 2)),
    "tetrahedron": box_tetrahedra(SIZE, (3, 1, 1)),
    "tetrahedron10": box_tetrahedra(SIZE, (2, 1, 1), order=2),
    "hexahedron27": box_hexahedra(SIZE, (1, 1, 1), nodes=27),
}
DAMPED = Corotated(264e3, 0.45, density=1070.0, mass_damping=0.5, stiffness_damping=2e-3)
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-12)
PER_ELEMENT = ("", ", each element", ", each environment")
KINDS = [
    *("q", "v", "external_force", "fixed_positions", "attached_mass"),
    *(
        f"{name}{kind}"
        for name in ("youngs_modulus", "poissons_ratio", "density")
        for kind in PER_ELEMENT
    ),
    "mass_damping, each environment",
    "stiffness_damping, each environment",
    "gravity, each environment",
]


def simulator(kind="hexahedron", material=DAMPED, body=None, **options):
    return Simulator(body or clamped(MESHES[kind]), material, **({"solver": TIGHT} | options))


@pytest.mark.parametrize(("pose_name", "poissons_ratio"), [("rest", 0.45), ("twisted", 0.499)])
def test_factors_in_single_precision_give_gradients_in_double(pose_name, poissons_ratio):
    material = replace(DAMPED, poissons_ratio=poissons_ratio)
    both = []
    for factors in ("single", "double"):
        sim = simulator(material=material, solver=TIGHT.changed(factors=factors))
        state = pose(sim, pose_name, 2)
        q = state.q.clone().requires_grad_(True)
        end = sim.rollout(State(q, state.v), 3)
        both.append(torch.autograd.grad((end.q[-1] ** 2).sum() + end.v[-1].sum(), q)[0])
    torch.testing.assert_close(both[0], both[1], rtol=0.0, atol=1e-9 * float(both[1].abs().max()))


def test_single_precision_needs_no_factor_in_double(monkeypatch):
    """Not even where inertia is so small that rounding leaves more than is aimed at."""
    tried = []
    refactor = ExactHessian.refactor_exact
    monkeypatch.setattr(
        ExactHessian, "refactor_exact", lambda self: (tried.append(self.exact), refactor(self))
    )
    sim = simulator(
        material=replace(DAMPED, poissons_ratio=0.499),
        time_step=1.0,
        solver=TIGHT.changed(factors="single"),
    )
    state = pose(sim, "bent", 2)
    q = state.q.clone().requires_grad_(True)
    torch.autograd.grad(sim.rollout(State(q, state.v), 2).q[-1].square().sum(), q)
    assert tried == [False, False]


def assert_equal(rows):
    assert [*check_rows(rows)] == KINDS
    assert all(row.adjoint != 0.0 for row in rows)


@pytest.mark.parametrize(
    ("kind", "start", "poissons_ratio"),
    [
        *(("hexahedron", start, nu) for start, nu in zip(POSES, (0.499, 0.499, 0.45), strict=True)),
        *((kind, "twisted", 0.499) for kind in [*MESHES][1:]),
    ],
)
def test_every_parameter_at_every_pose(kind, start, poissons_ratio, device):
    material = replace(DAMPED, poissons_ratio=poissons_ratio)
    assert_equal(check_gradients(simulator(kind, material, device=device), start, steps=2))


@pytest.mark.parametrize(
    ("integrator", "start"), [*zip([*INTEGRATORS][1:], ["bent", "twisted"], strict=True)]
)
def test_every_parameter_with_every_integrator(integrator, start):
    assert_equal(check_gradients(simulator(integrator=integrator), start, steps=3))


@pytest.mark.parametrize(
    "options",
    [
        {"material": StableNeoHookean(**DAMPED.values)},
        {"material": replace(DAMPED, poissons_ratio=-0.2)},
        {"solver": SolverSettings(name="quasi_newton", relative_tolerance=1e-12)},
        {"solver": SolverSettings(name="newton", relative_tolerance=1e-12, linear_solver="sparse")},
        {"body": clamped(MESHES["hexahedron"], mass="per_vertex", volume_integration="full")},
    ],
    ids=["stable_neo_hookean", "auxetic", "quasi_newton", "sparse", "integration"],
)
def test_every_parameter_with_other_options(options):
    assert_equal(check_gradients(simulator(**options), "bent", steps=2))


def test_a_wrong_derivative_shows_in_all_rows_of_its_shape(monkeypatch):
    """Here that by density, a thousandth too large."""
    varied = Quantity.varied

    def wrong(self, value, x):
        return varied(self, value, x + (1e-3 * (x - x.detach()) if self.name == "density" else 0.0))

    monkeypatch.setattr(Quantity, "varied", wrong)
    for row in check_gradients(simulator(), "bent", steps=2):
        assert row.relative_error > 4e-4, row.parameter


@pytest.mark.parametrize(("scale", "rounding"), [(1.0, 0.0), (3.0, 1e-12), (3.0, 1e-9)])
def test_a_difference_is_as_good_as_rounding_allows_and_says_how_good(scale, rounding):
    """A function whose values are off at random by a given amount,
    with a pole near the first step.
    """
    random = torch.Generator().manual_seed(0)

    def function(step):
        return math.exp(scale * step) / (3.5 + scale * step) + rounding * float(
            torch.randn(1, generator=random)
        )

    exact = scale * (1.0 / 3.5 - 1.0 / 3.5**2)
    numerical, uncertainty = central_difference(function)
    assert abs(numerical - exact) < max(1e-8 * exact, 20.0 * rounding)
    assert uncertainty < max(1e-8 * exact, 20.0 * rounding)


def test_a_difference_passes_over_a_kink_within_long_steps_and_doubts_one_within_all_of_them():
    assert central_difference(lambda step: abs(step + 0.1) + 0.3 * step)[0] == pytest.approx(
        1.3, rel=1e-12
    )
    assert central_difference(lambda step: abs(step + 1e-3) + 0.3 * step)[1] > 1e-3
    assert central_difference(lambda step: math.nan)[1] == math.inf


def test_poissons_ratio_of_zero_has_a_derivative():
    """lambda vanishes there, its derivative does not."""
    s = simulator()
    state = pose(s, "bent", 1)
    weights = noise(*state.q.shape)

    def loss(given):
        return (weights * s.rollout(state, 2, parameters=given).q[-1]).sum()

    check_slopes(
        loss, {"poissons_ratio": torch.zeros(1, dtype=torch.float64)}, {"poissons_ratio": 1e-3}
    )


@pytest.mark.parametrize("kind", ["hexahedron", "tetrahedron10"])
def test_static_equilibrium(kind):
    s = simulator(kind)
    b, n, d = 2, s.body.n_vertices, len(s.fixed)
    weights, elements = noise(b, n, 3), len(s.body.mesh.cells)
    force = 1e-2 * noise(b, n, 3, seed=1)
    fixed = s.rest_positions[s.fixed] + 1e-3 * noise(b, d, 3, seed=2)

    ones = torch.ones(elements, dtype=torch.float64)
    constants = {
        "youngs_modulus": 264e3 * ones,
        "poissons_ratio": 0.45 * ones[:1],
        "density": 1070.0 * ones,
    }

    def loss(given):
        acting = Inputs(given["force"], given["fixed"])
        return (
            weights * s.static_equilibrium(acting, {name: given[name] for name in constants}).q
        ).sum()

    sizes = {
        "force": 1e-3,
        "fixed": 1e-5,
        "youngs_modulus": 2e3,
        "poissons_ratio": 1e-4,
        "density": 10.0,
    }
    check_slopes(loss, {"force": force, "fixed": fixed, **constants}, sizes)


def test_fixed_velocities_and_positions_of_fixed_vertices_have_no_hidden_influence():
    """Forces on fixed vertices change nothing.

    Where they stand at the start matters when nothing moves them.
    """
    s = simulator()
    state = pose(s, "bent", 1)
    q, force = state.q.clone().requires_grad_(True), torch.zeros_like(state.q).requires_grad_(True)
    final = s.rollout(State(q, state.v), 2, Inputs(force)).final
    gradients = torch.autograd.grad(final.q.sum(), (q, force))
    assert float(gradients[0][:, s.fixed].abs().max()) > 0.1
    assert float(gradients[1][:, s.fixed].abs().max()) == 0.0


@pytest.mark.parametrize(
    ("adjoint", "difference", "error"),
    [
        (2.0, 1.0, 0.5),
        (0.0, 1e-9, 1.0),
        (0.0, 0.0, math.inf),  # vanishing in both tells nothing
        (math.nan, 1.0, math.inf),
        (math.inf, math.inf, math.inf),
    ],
)
def test_a_row_that_compares_nothing_is_an_infinite_error(adjoint, difference, error):
    assert GradientRow("", adjoint, difference).relative_error == error
