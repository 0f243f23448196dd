"""A material whose energy is a network, in a simulator."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

from warp_resphys import Body, MooneyRivlin, Simulator, SolverSettings, box_hexahedra, select_vertices
from warp_resphys.dynamics.tape import record_rollout
from warp_resphys.energies.neural import ENERGY, NeuralMaterial, initial_weights, parts
from warp_resphys.io.errors import InputError
from warp_resphys.kernels.materials.neural import LENGTH
from warp_resphys.learning.parameters import identifiable_parameters
from warp_resphys.studies.gradient_check import POSES, central_difference, check_gradients

BEAM = box_hexahedra((0.06, 0.03, 0.03), (2, 1, 1))
BODY = Body(BEAM, fixed=select_vertices(BEAM, x=0.0))
TIGHT = SolverSettings("newton", relative_tolerance=1e-12)
MU, LAMBDA = 40e3, 1e6
VISCOUS = {"stiffness_damping": 5e-3, "prony": [(0.3, 0.02)]}
OTHER = initial_weights(60e3, LAMBDA, seed=1)


def simulator(material=None, **more):
    own = material or NeuralMaterial.from_lame(MU, LAMBDA, **VISCOUS)
    return Simulator(BODY, own, solver=TIGHT, integrator="bdf2", **more)


def test_without_units_it_is_mooney_rivlin_rubber_with_kelvin_voigt_viscosity():
    c10, c01, bulk = 18e3, 4e3, 2e6
    weights = OTHER.clone()
    *_, output, direct, linear, rate = parts(weights)
    for own, value in ((output, 0.0), (rate[0], 0.0), (direct[0], c10 * LENGTH / ENERGY), (linear, 1.0)):
        own.fill_(math.log(math.expm1(value)) if value else -100.0)
    direct[1] = math.log(math.expm1(c01 * LENGTH / ENERGY))
    g2 = 0.5 * (bulk - 4.0 / 3.0 * (c10 + c01))
    pair = NeuralMaterial(weights, g2, **VISCOUS), MooneyRivlin(c10, c01, bulk, **VISCOUS)
    runs = [sim.rollout(sim.rest_state(), 10).q for sim in map(simulator, pair)]
    torch.testing.assert_close(runs[0], runs[1], rtol=0.0, atol=1e-10)
    assert (runs[0][-1] - runs[0][0]).abs().max() > 1e-3


def test_a_step_minimises_its_energy():
    """The residual is the derivative of the energy, with rates at which viscosity is not linear."""
    sim = simulator()
    start = sim.rest_state()
    start.v[:, :, 2] = 10.0 * sim.rest_positions[:, 0]
    sim.step(start)
    potential = sim.workspace(1).potential
    solution = potential.positions.clone()
    move = potential.restrict(torch.randn(solution.shape, generator=torch.Generator().manual_seed(0)).double())

    def energy(x):
        potential.positions.copy_(solution + 1e-3 * move + 1e-4 * x * move)
        return float(potential.evaluate()[0])

    slope, uncertainty = central_difference(energy)
    energy(0.0)
    assert slope == pytest.approx(float(1e-4 * (potential.residual * move).sum()), rel=1e-6)
    assert uncertainty < 1e-7 * slope


@pytest.mark.parametrize("pose", POSES)
def test_gradients_by_the_weights_equal_differences(pose):
    material = replace(simulator().materials[""], bulk_2=1e9, mass_damping=0.5)
    rows = {row.parameter: row for row in check_gradients(simulator(material), pose)}
    assert {"weights, each environment", "bulk_1, each element", "bulk_2"} <= rows.keys()
    # Rounding limits differences of the smaller gradients.
    errors = {name: row.relative_error for name, row in rows.items() if abs(row.adjoint) > 1e-6}
    assert {name: error for name, error in errors.items() if not error < 1e-6} == {}
    assert {"weights, each environment", "prony_time_1, each environment"} <= errors.keys()


def test_weights_of_each_environment_equal_single_runs():
    sim = simulator()
    own = torch.stack([torch.as_tensor(sim.constants["weights"]), OTHER]).requires_grad_(True)
    loss = sim.rollout(sim.rest_state(2), 4, parameters={"weights": own}).q.square().sum()
    (together,) = torch.autograd.grad(loss, own)
    ends, slopes = [], []
    for weights in own.detach().requires_grad_(True):
        q = sim.rollout(sim.rest_state(), 4, parameters={"weights": weights}).q
        ends.append(q.square().sum())
        slopes.append(torch.autograd.grad(ends[-1], weights)[0])
    torch.testing.assert_close(loss, sum(ends), rtol=1e-12, atol=0.0)
    torch.testing.assert_close(together, torch.stack(slopes), rtol=1e-7, atol=1e-7 * float(together.abs().max()))


def test_the_tape_has_the_same_gradients():
    sim = simulator()
    weights = OTHER.clone().requires_grad_(True)
    q = sim.rollout(sim.rest_state(), 3, parameters={"weights": weights}).q
    (expected,) = torch.autograd.grad(q[-1].sum(), weights)
    state, own = sim.rest_state(), wp.array(OTHER.numpy(), dtype=wp.float64, device="cpu", requires_grad=True)
    start = [wp.from_torch(values.contiguous(), dtype=wp.vec3d) for values in (state.q, state.v)]
    tape = wp.Tape()
    recorded = record_rollout(tape, sim, *start, 3, parameters={"weights": own})
    end = np.zeros((*recorded.q.shape, 3))
    end[-1] = 1.0
    tape.backward(grads={recorded.q: wp.array(end, dtype=wp.vec3d, device="cpu")})
    np.testing.assert_allclose(own.grad.numpy(), expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: NeuralMaterial(torch.zeros(3)), r"weights has shape \(3,\)"),
        (lambda: NeuralMaterial(math.nan * OTHER), "weights is nan"),
        (lambda: NeuralMaterial(bulk_1=-1.0), "bulk_1"),
        (lambda: simulator().prepare({"weights": torch.ones(2, 3)}), r"weights has shape \(2, 3\)"),
    ],
)
def test_invalid_constants_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_single_numbers_are_identified_not_weights():
    names = identifiable_parameters(simulator())
    assert "bulk_1" in names
    assert "weights" not in names
