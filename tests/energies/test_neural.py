"""A material whose energy is a network, in a simulator."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

from warp_resphys import Body, Simulator, SolverSettings, StableNeoHookean, box_hexahedra, select_vertices
from warp_resphys.dynamics.tape import record_rollout
from warp_resphys.energies.neural import NeuralMaterial, initial_weights
from warp_resphys.io.errors import InputError
from warp_resphys.learning.parameters import identifiable_parameters
from warp_resphys.studies.gradient_check import POSES, check_gradients

BEAM = box_hexahedra((0.06, 0.03, 0.03), (2, 1, 1))
BODY = Body(BEAM, fixed=select_vertices(BEAM, x=0.0))
TIGHT = SolverSettings("newton", relative_tolerance=1e-12)
MU, LAMBDA = 40e3, 1e6
OTHER = initial_weights(60e3, LAMBDA, seed=1)


def simulator(material=None, **more):
    own = material or NeuralMaterial.from_lame(MU, LAMBDA, stiffness_damping=1e-3, prony=[(0.3, 0.02)])
    return Simulator(BODY, own, solver=TIGHT, integrator="bdf2", **more)


def test_small_motions_are_those_of_its_lame_constants():
    e, nu = MU * (3.0 * LAMBDA + 2.0 * MU) / (LAMBDA + MU), 0.5 * LAMBDA / (LAMBDA + MU)
    pair = NeuralMaterial.from_lame(MU, LAMBDA), StableNeoHookean(e, nu)
    ends = []
    body = replace(BODY, volume_integration="full")  # Else the volume of the network is integrated at other points.
    for material in pair:
        sim = replace(simulator(material, gravity=(0.0, 0.0, 1e-4)), body=body)
        ends.append(sim.rollout(sim.rest_state(), 5).q[-1] - sim.rest_positions)
    torch.testing.assert_close(*ends, rtol=0.0, atol=1e-4 * float(ends[1].abs().max()))


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
