"""Prony branches against closed forms, their gradients, and what becomes of them between steps."""

import cmath
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from warp_resphys import Body, Corotated, Simulator, SolverSettings, State, box_hexahedra, select_vertices
from warp_resphys.dynamics.modes import vibration_modes
from warp_resphys.energies.catalogue import make_material
from warp_resphys.io.errors import InputError
from warp_resphys.stepping.inputs import Inputs
from warp_resphys.stepping.integrators import INTEGRATORS
from warp_resphys.studies.gradient_check import POSES, check_gradients, pose

MESH = box_hexahedra((0.04, 0.02, 0.02), (2, 1, 1))
CLAMPED = Body(MESH, fixed=select_vertices(MESH, x=0.0))
TIP = select_vertices(MESH, x=0.04)
TIGHT = SolverSettings("newton", relative_tolerance=1e-11)
WEIGHTLESS = (0.0, 0.0, 0.0)
# Without lateral contraction lambda is zero: all of the stiffness relaxes.
ELASTIC = Corotated(2e4, 0.0, density=1000.0)
CREEPING = replace(ELASTIC, prony=[(0.5, 0.2)])
TWO_BRANCHES = Corotated(2e4, 0.45, density=1000.0, stiffness_damping=1e-3, prony=[(0.4, 0.02), (0.2, 0.3)])


def pull(newtons, batch=1):
    force = torch.zeros(batch, len(MESH.vertices), 3, dtype=torch.float64)
    force[:, TIP, 2] = newtons / len(TIP)
    return Inputs(force)


def sag(q):
    return q[..., TIP, 2].mean(-1) - float(np.mean(MESH.vertices[TIP, 2]))


def test_a_load_creeps_as_the_standard_linear_solid():
    """A step of load gives 1 - g / (1 + g) exp(-t / (tau (1 + g))) of what it gives in the end."""
    (ratio, time), h = CREEPING.prony[0], 0.01
    light = replace(CREEPING, density=1e-3)  # without inertia
    simulator = Simulator(CLAMPED, light, h, WEIGHTLESS, "bdf2", TIGHT)
    sags = sag(simulator.rollout(simulator.rest_state(), 60, pull(1e-4)).q[1:, 0])
    end = sag(simulator.static_equilibrium(pull(1e-4)).q[0])
    t = h * torch.arange(1, 61, dtype=torch.float64)
    expected = 1.0 - ratio / (1.0 + ratio) * torch.exp(-t / (time * (1.0 + ratio)))
    np.testing.assert_allclose(sags / end, expected, atol=1e-2)
    np.testing.assert_allclose((sags / end)[20:], expected[20:], atol=4e-3)
    assert float(sags[0] / end) < 0.7  # without creep it would be there at once


def test_a_small_vibration_has_the_complex_modulus():
    """Of omega^2 = omega_0^2 (1 + g i omega tau / (1 + i omega tau)), the root says period and decay."""
    h, (ratio, time) = 5e-4, (0.3, 0.01)
    elastic = Simulator(CLAMPED, ELASTIC, h, WEIGHTLESS, "midpoint", TIGHT)
    forces = vibration_modes(elastic, 1)[:, 0].view(-1, 3)  # the inertia of the slowest vibration
    mode = forces / elastic.prepare().mass[0, :, None]
    rest = elastic.rest_state()
    start = replace(rest, q=rest.q + 1e-5 * mode / mode.abs().max())

    def exponent(material, steps=400):
        """Frequency and decay, from the passages through zero and the peaks between."""
        moved = replace(elastic, material=material).rollout(start, steps).q[:, 0] - rest.q[0]
        q = (moved * forces).sum((1, 2)).numpy()
        crossings = np.flatnonzero(q[:-1] * q[1:] < 0)
        at = crossings + q[crossings] / (q[crossings] - q[crossings + 1])
        peaks = [np.abs(q[a:b]).max() for a, b in pairwise(crossings)]
        omega = math.pi / (h * np.diff(at).mean())
        decay = -np.polyfit(h * at[:-1], np.log(peaks), 1)[0]
        return omega, decay

    omega_0, lost = exponent(ELASTIC)
    assert lost < 0.1
    omega = complex(omega_0)
    for _ in range(100):
        omega = omega_0 * cmath.sqrt(1.0 + ratio * 1j * omega * time / (1.0 + 1j * omega * time))
    rate = exponent(replace(ELASTIC, prony=[(ratio, time)]))
    assert omega.imag > 3.0  # otherwise nothing is seen
    assert rate[0] == pytest.approx(omega.real, rel=5e-3)
    assert rate[1] == pytest.approx(omega.imag, rel=0.03)


def test_a_branch_much_shorter_than_a_step_is_kelvin_voigt_viscosity():
    ratio, time = 50.0, 1e-4
    state = pose(Simulator(CLAMPED, ELASTIC), "bent", 1)
    maxwell, kelvin = replace(ELASTIC, prony=[(ratio, time)]), replace(ELASTIC, stiffness_damping=ratio * time)
    positions = [Simulator(CLAMPED, m, solver=TIGHT).rollout(state, 5).q[-1] for m in (maxwell, kelvin, ELASTIC)]
    torch.testing.assert_close(positions[0], positions[1], rtol=0.0, atol=1e-9)
    assert float((positions[1] - positions[2]).abs().max()) > 1e-4


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
def test_the_order_of_an_integrator_is_kept(integrator):
    ends = []
    damped = replace(TWO_BRANCHES, poissons_ratio=0.3, stiffness_damping=3e-3)  # fast vibrations die out
    for steps in (32, 64, 128):
        simulator = Simulator(CLAMPED, damped, 0.04 / steps, integrator=integrator, solver=TIGHT)
        state = simulator.rest_state()
        x = state.q[..., :1] / 0.04
        state = replace(state, v=1.5 * torch.cat([0 * x, x**2, -0.5 * x**2], dim=-1))
        ends.append(simulator.rollout(state, steps).q[-1])
    coarse, fine = ((ends[i] - ends[i + 1]).abs().max() for i in (0, 1))
    assert float(torch.log2(coarse / fine)) == pytest.approx(2.0, abs=0.3)


def test_the_state_of_the_branches_turns_with_the_body():
    """A turned body under turned gravity moves as the other one does, whatever it still carries."""
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -1.0, 0.4], [1.0, 0.0, 0.2], [-0.4, -0.2, 0.0]]).double())
    gravity = torch.tensor([[0.0, 0.0, -9.8]], dtype=torch.float64)
    simulator = Simulator(Body(MESH), TWO_BRANCHES, 0.005, integrator="bdf2", solver=TIGHT)  # free to turn
    carried = simulator.rollout(pose(simulator, "bent", 1), 5, parameters={"gravity": gravity}).final
    turned = State.from_tensors({k: x if k.startswith("memory.") else x @ turn.T for k, x in carried.tensors().items()})
    first = simulator.rollout(carried, 5, parameters={"gravity": gravity})
    second = simulator.rollout(turned, 5, parameters={"gravity": gravity @ turn.T})
    torch.testing.assert_close(second.q[-1], first.q[-1] @ turn.T, rtol=0.0, atol=1e-10)


def test_a_roll_out_goes_on_from_its_last_state():
    simulator = Simulator(CLAMPED, TWO_BRANCHES, integrator="bdf2", solver=TIGHT)
    whole = simulator.rollout(simulator.rest_state(2), 8, pull(0.2, 2))
    half = simulator.rollout(simulator.rest_state(2), 4, pull(0.2, 2)).final
    assert half.memory["viscous_strain"].shape[:2] == (2, 2)
    again = State.from_tensors({name: tensor.clone() for name, tensor in half.tensors().items()})
    torch.testing.assert_close(simulator.rollout(again, 4, pull(0.2, 2)).q[-1], whole.q[-1], rtol=0.0, atol=1e-11)
    relaxed = replace(again, memory={})
    assert float((simulator.rollout(relaxed, 4, pull(0.2, 2)).q[-1] - whole.q[-1]).abs().max()) > 1e-5


def test_poses_know_nothing_of_branches_and_branches_that_do_nothing_cost_nothing():
    absent, idle = ELASTIC, replace(ELASTIC, prony=[(0.0, 0.1)])
    poses = [Simulator(CLAMPED, m, solver=TIGHT).static_equilibrium(pull(0.2)).q for m in (CREEPING, absent)]
    torch.testing.assert_close(*poses, rtol=0.0, atol=1e-12)
    runs = [Simulator(CLAMPED, m).rollout(Simulator(CLAMPED, m).rest_state(), 3).final for m in (idle, absent)]
    assert torch.equal(runs[0].q, runs[1].q)
    assert not runs[0].memory


@pytest.mark.parametrize(("start", "integrator"), [*zip(POSES, INTEGRATORS, strict=True)])
def test_gradients(start, integrator):
    simulator = Simulator(CLAMPED, replace(TWO_BRANCHES, mass_damping=0.5), integrator=integrator, solver=TIGHT)
    rows = {row.parameter: row for row in check_gradients(simulator, start)}
    assert "prony_time_2, each environment" in rows
    assert {name: row.relative_error for name, row in rows.items() if not row.relative_error < 1e-6} == {}


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
        (lambda: replace(ELASTIC, prony=[(-0.1, 1.0)]), "prony_ratio_1 is"),
        (lambda: make_material(prony_ratio_1=0.1), "prony has prony_ratio_1: give each branch"),
        (lambda: make_material(prony=3), "has no constant 'prony'"),
    ],
)
def test_wrong_branches_are_refused(make, said):
    with pytest.raises(InputError) as caught:
        make()
    assert said in str(caught.value)
