"""Relaxation branches of a material against closed forms,
what they keep, their strain and gradients.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.clamped import clamped, noise
from support.slopes import check_rows, check_slopes
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
from warp_resphys.core.dynamics.gradient_check import POSES, check_gradients, pose
from warp_resphys.core.energies.catalogue import make_material
from warp_resphys.core.energies.viscosity import GreenStrain, StrainTerm
from warp_resphys.core.stepping.integrators import INTEGRATORS
from warp_resphys.io.errors import InputError

SIZE = (0.04, 0.02, 0.02)  # m
MESH = box_hexahedra(SIZE, (2, 1, 1))
TIP = select_vertices(MESH, x=SIZE[0])
CLAMPED = clamped(MESH)
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-11)
WEIGHTLESS = (0.0, 0.0, 0.0)
# Without lateral contraction: lambda is zero, all stiffness relaxes.
ELASTIC = Corotated(2e4, 0.0, density=1000.0)
CREEPING = replace(ELASTIC, prony=[(0.5, 0.2)])
TWO_BRANCHES = Corotated(
    2e4, 0.45, density=1000.0, stiffness_damping=1e-3, prony=[(0.4, 0.02), (0.2, 0.3)]
)


def pull(newtons, batch=1):
    force = torch.zeros(batch, len(MESH.vertices), 3, dtype=torch.float64)
    force[:, TIP, 2] = newtons / len(TIP)
    return Inputs(force)


def sag(q):
    return q[..., TIP, 2].mean(-1) - float(np.mean(MESH.vertices[TIP, 2]))


def test_a_roll_out_goes_on_from_its_last_state_and_a_batch_is_its_environments():
    simulator = Simulator(CLAMPED, TWO_BRANCHES, integrator="bdf2", solver=TIGHT)
    forces = torch.cat([pull(0.2).external_force, pull(-0.1).external_force])
    whole = simulator.rollout(simulator.rest_state(2), 8, Inputs(forces))
    half = simulator.rollout(simulator.rest_state(2), 4, Inputs(forces)).final
    assert half.memory["viscous_strain"].shape[:2] == (2, 2)
    again = State.from_tensors({name: tensor.clone() for name, tensor in half.tensors().items()})
    torch.testing.assert_close(
        simulator.rollout(again, 4, Inputs(forces)).q[-1], whole.q[-1], rtol=0, atol=1e-11
    )
    forgotten = replace(again, memory={})
    assert (
        float((simulator.rollout(forgotten, 4, Inputs(forces)).q[-1] - whole.q[-1]).abs().max())
        > 1e-6
    )
    alone = simulator.rollout(simulator.rest_state(), 8, Inputs(forces[1:])).q[-1, 0]
    torch.testing.assert_close(alone, whole.q[-1, 1], rtol=0.0, atol=1e-11)


@pytest.mark.parametrize(("start", "integrator"), [*zip(POSES, INTEGRATORS, strict=True)])
def test_gradients_of_a_roll_out(start, integrator):
    simulator = Simulator(
        CLAMPED, replace(TWO_BRANCHES, mass_damping=0.5), integrator=integrator, solver=TIGHT
    )
    check_rows(check_gradients(simulator, start), "prony_time_2, each environment")


def test_gradients_by_the_memory_of_the_start():
    simulator = Simulator(CLAMPED, TWO_BRANCHES, solver=TIGHT)
    state = simulator.rollout(pose(simulator, "bent", 1), 2).final
    weights = noise(*state.q.shape)

    def loss(given):
        memory = {"viscous_strain": 0.5 * (given["strain"] + given["strain"].mT)}
        return (weights * simulator.rollout(replace(state, memory=memory), 2).q[-1]).sum()

    check_slopes(loss, {"strain": state.memory["viscous_strain"]}, {"strain": 1e-4})


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_load_creeps_as_the_standard_linear_solid(integrator):
    """A step of load gives 1 - g / (1 + g) exp(-t / (tau (1 + g))) of what it gives in the end.

    Means of two steps are compared, about which the midpoint rule goes to and fro.
    """
    (ratio, time), h = CREEPING.prony[0], 0.01
    light = replace(CREEPING, density=1e-3)  # without inertia
    simulator = Simulator(CLAMPED, light, h, WEIGHTLESS, integrator, TIGHT)
    sags = sag(simulator.rollout(simulator.rest_state(), 60, pull(1e-4)).q[1:, 0])
    end = sag(simulator.static_equilibrium(pull(1e-4)).q[0])
    t = h * torch.arange(1, 61, dtype=torch.float64)
    expected = 1.0 - ratio / (1.0 + ratio) * torch.exp(-t / (time * (1.0 + ratio)))
    shares, expected = (0.5 * (s[1:] + s[:-1]) for s in (sags / end, expected))
    np.testing.assert_allclose(shares, expected, atol=1e-2)
    np.testing.assert_allclose(shares[20:], expected[20:], atol=4e-3)
    assert float(shares[0]) < 0.7  # without creep it would be there at once


def test_a_branch_much_shorter_than_a_step_is_kelvin_voigt_viscosity():
    ratio, time = 50.0, 1e-4
    state = pose(Simulator(CLAMPED, ELASTIC), "bent", 1)
    maxwell = replace(ELASTIC, prony=[(ratio, time)])
    kelvin = replace(ELASTIC, stiffness_damping=ratio * time)
    positions = [
        Simulator(CLAMPED, m, solver=TIGHT).rollout(state, 5).q[-1]
        for m in (maxwell, kelvin, ELASTIC)
    ]
    torch.testing.assert_close(positions[0], positions[1], rtol=0.0, atol=1e-9)
    assert float((positions[1] - positions[2]).abs().max()) > 1e-4


def test_the_state_of_the_branches_turns_with_the_body():
    """A turned body under turned gravity moves as the other one does, whatever it still carries."""
    turn = torch.linalg.matrix_exp(
        torch.tensor([[0.0, -1.0, 0.4], [1.0, 0.0, 0.2], [-0.4, -0.2, 0.0]]).double()
    )
    gravity = torch.tensor([[0.0, 0.0, -9.8]], dtype=torch.float64)
    # Free to turn.
    simulator = Simulator(Body(MESH), TWO_BRANCHES, 0.005, integrator="bdf2", solver=TIGHT)
    carried = simulator.rollout(
        pose(simulator, "bent", 1), 5, parameters={"gravity": gravity}
    ).final
    turned = State.from_tensors(
        {k: x if k.startswith("memory.") else x @ turn.T for k, x in carried.tensors().items()}
    )
    first = simulator.rollout(carried, 5, parameters={"gravity": gravity})
    second = simulator.rollout(turned, 5, parameters={"gravity": gravity @ turn.T})
    torch.testing.assert_close(second.q[-1], first.q[-1] @ turn.T, rtol=0.0, atol=1e-10)


def test_poses_know_nothing_of_branches_and_branches_that_do_nothing_cost_nothing():
    absent, idle = ELASTIC, replace(ELASTIC, prony=[(0.0, 0.1)])
    poses = [
        Simulator(CLAMPED, m, solver=TIGHT).static_equilibrium(pull(0.2)).q
        for m in (CREEPING, absent)
    ]
    torch.testing.assert_close(*poses, rtol=0.0, atol=1e-12)
    runs = [
        Simulator(CLAMPED, m).rollout(Simulator(CLAMPED, m).rest_state(), 3).final
        for m in (idle, absent)
    ]
    assert torch.equal(runs[0].q, runs[1].q)
    assert not runs[0].memory


def test_branches_without_modulus_have_a_gradient():
    """Where identification begins: nothing relaxes yet, but it would pay."""
    simulator = Simulator(CLAMPED, replace(TWO_BRANCHES, stiffness_damping=0.0), solver=TIGHT)

    def loss(ratio):
        parameters = {"prony_ratio_1": ratio, "prony_ratio_2": 0.0 * ratio}
        return sag(simulator.rollout(simulator.rest_state(), 4, pull(0.2), parameters).q[-1])[0]

    zero = torch.zeros(1, 1, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(zero), zero)
    step = torch.full((1, 1), 1e-5, dtype=torch.float64)
    with torch.no_grad():
        expected = (4.0 * loss(step) - loss(2.0 * step) - 3.0 * loss(0.0 * step)) / 2e-5
    assert float(gradient) == pytest.approx(float(expected), rel=1e-4)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: replace(ELASTIC, prony=[0.3]), "give a (ratio, time) for each branch"),
        (lambda: replace(ELASTIC, prony=[(0.3, 0.0)]), "prony_time_1 is"),
        (lambda: make_material(prony_ratio_1=0.1), "prony has prony_ratio_1: give each branch"),
        (lambda: make_material(prony=3), "has no parameter 'prony'"),
    ],
)
def test_wrong_branches_are_refused(make, said):
    with pytest.raises(InputError) as caught:
        make()
    assert said in str(caught.value)


@pytest.fixture
def term():
    simulator = Simulator(Body(MESH), replace(ELASTIC, stiffness_damping=0.01))
    (solid,) = (t for t in simulator.workspace(1).potential.energies if isinstance(t, StrainTerm))
    return solid


def stretched(factor):
    return torch.as_tensor(MESH.vertices * np.array([factor, 1.0, 1.0]))[None]


def strained(factor):
    return 0.5 * (factor**2 - 1.0)


def test_a_stretched_bar_has_its_strain_however_often_it_is_asked_for(term):
    one, two = stretched(1.1), stretched(1.2)
    for q, factor in (
        (one, 1.1),
        (two, 1.2),
        (one, 1.1),
        (stretched(1.3), 1.3),
        (two, 1.2),
        (one, 1.1),
    ):
        strain = GreenStrain.apply(term, q)
        np.testing.assert_allclose(strain[..., 0, 0], strained(factor), rtol=1e-12)
        assert float(strain[..., 1:, :].abs().max()) < 1e-12


@pytest.mark.parametrize(
    "change",
    [lambda q: q.mul_(2.0), lambda q: q.numpy().__imul__(2.0), lambda q: q.data.mul_(2.0)],
    ids=["in place", "numpy", "data"],
)
@pytest.mark.parametrize("inference", [False, True])
def test_positions_that_changed_have_another_strain(term, change, inference):
    with torch.inference_mode(inference):
        q = stretched(1.1)
        GreenStrain.apply(term, q)
        change(q)
        np.testing.assert_allclose(GreenStrain.apply(term, q)[..., 0, 0], strained(2.2), rtol=1e-12)


def test_strains_of_inference_mode_do_not_reach_gradients(term):
    q = stretched(1.1)
    with torch.inference_mode():
        GreenStrain.apply(term, q)
    (gradient,) = torch.autograd.grad(GreenStrain.apply(term, q.requires_grad_()).square().sum(), q)
    assert float(gradient.abs().max()) > 0.0
