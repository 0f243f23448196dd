"""Sliders of a material against closed forms, what they take and keep, and their gradients."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from warp_resphys import Body, Corotated, Inputs, Simulator, SolverSettings, State, box_hexahedra, select_vertices
from warp_resphys.energies.catalogue import make_material
from warp_resphys.energies.hysteresis import stuck_share
from warp_resphys.io.errors import InputError
from warp_resphys.stepping.integrators import INTEGRATORS
from warp_resphys.studies.gradient_check import POSES, central_difference, check_gradients, pose

SIZE = (0.04, 0.02, 0.02)  # m
MESH = box_hexahedra(SIZE, (2, 1, 1))
TIP = select_vertices(MESH, x=SIZE[0])
CLAMPED = Body(MESH, fixed=select_vertices(MESH, x=0.0))
TIGHT = SolverSettings("newton", relative_tolerance=1e-11)
WEIGHTLESS = (0.0, 0.0, 0.0)
ELASTIC = Corotated(2e4, 0.0, density=1000.0)
MU = 1e4  # Pa, the shear modulus
SLIDING = replace(ELASTIC, hysteresis=[(0.5, 0.02)])
TWO_SLIDERS = Corotated(2e4, 0.45, density=1000.0, stiffness_damping=1e-3, hysteresis=[(0.4, 0.005), (0.2, 0.03)])
AMPLITUDE = 0.05  # of gamma / sqrt(2)


def sheared(gammas, material, step=0.01):
    """(T,) shear stresses [Pa] at the end of steps to shear angles (T,): the forces that hold the end, over its area."""
    simulator = Simulator(CLAMPED, material, step, WEIGHTLESS, solver=TIGHT)
    rest, state, forces = simulator.rest_positions, simulator.rest_state(), []
    for gamma in gammas:
        x = rest.clone()
        x[:, 1] += gamma * rest[:, 0]
        residual = simulator.linearise(replace(state, v=torch.zeros_like(state.v))).residual(x[None])[0]
        inertia = simulator.prepare().mass[0, :, None] * (x - state.q[0]) / step**2
        forces.append(float((residual - inertia)[TIP, 1].sum()))
        state = simulator.remember(state, x[None], simulator.prepare())
    return np.array(forces) / (SIZE[1] * SIZE[2])


def cycle(steps, peak):
    """Shear angles of a cycle after a first rise to the peak."""
    up, down = np.linspace(-peak, peak, steps + 1)[1:], np.linspace(peak, -peak, steps + 1)[1:]
    return np.concatenate([np.linspace(0.0, peak, steps // 2 + 1)[1:], down, up])


def loss(gammas, material, steps, **options):
    """Energy [J/m^3] that the last cycle takes, with its trapezoids."""
    path = np.asarray(gammas)
    stress = sheared(path, material, **options) - sheared(path, ELASTIC, **options)
    return np.trapezoid(stress[-2 * steps - 1 :], path[-2 * steps - 1 :])


def closed_form(gammas, ratio, limit):
    """(T,) shear stresses [Pa] of a slider, by its definition in one dimension, with dE = dgamma [[0, 1], [1, 0]] / 2.

    The part gamma^2 / 2 of the Green strain is left out.
    """
    plastic, stresses, most = 0.0, [], math.sqrt(2.0) * limit
    for gamma in gammas:
        plastic = gamma - float(np.clip(gamma - plastic, -most, most))
        stresses.append(ratio * MU * (gamma - plastic))
    return np.array(stresses)


class TestALoop:
    RATIO, LIMIT, PEAK, STEPS = 0.5, 2e-4, 5e-4, 40

    def material(self, **changes):
        return replace(ELASTIC, hysteresis=[(self.RATIO, self.LIMIT)], **changes)

    def test_it_follows_the_elastic_perfectly_plastic_slider(self):
        path = cycle(self.STEPS, self.PEAK)
        stress = sheared(path, self.material()) - sheared(path, ELASTIC)
        expected = closed_form(path, self.RATIO, self.LIMIT)
        np.testing.assert_allclose(stress, expected, atol=2e-3 * expected.max())

    @pytest.mark.parametrize("step", [1e-3, 1.0, 1e3])
    def test_it_takes_the_energy_of_the_closed_form_at_any_speed(self, step):
        """4 yield stresses times what the amplitude exceeds the yield shear by."""
        yield_shear = math.sqrt(2.0) * self.LIMIT
        expected = 4.0 * self.RATIO * MU * yield_shear * (self.PEAK - yield_shear)
        taken = loss(cycle(self.STEPS, self.PEAK), self.material(), self.STEPS, step=step)
        assert taken == pytest.approx(expected, rel=0.02)  # a trapezoid at each of the corners is as large

    def test_the_loop_of_a_prony_branch_vanishes_in_a_slow_cycle(self):
        """The contrast: at small rates it takes 2 pi g mu omega tau a^2 / 2 or so, in proportion to the rate."""
        branch = replace(ELASTIC, prony=[(self.RATIO, 0.01)])
        path = cycle(self.STEPS, self.PEAK)
        fast, slow, slower = (loss(path, branch, self.STEPS, step=h) for h in (0.01, 1.0, 100.0))
        assert fast > 50.0 * slow > 0.0
        assert slower == pytest.approx(0.01 * slow, rel=0.05)

    def test_it_takes_nothing_below_the_yield_strain(self):
        taken = loss(cycle(self.STEPS, 0.9 * math.sqrt(2.0) * self.LIMIT), self.material(), self.STEPS)
        assert abs(taken) < 1e-9 * self.RATIO * MU * self.LIMIT**2
        large = replace(ELASTIC, hysteresis=[(self.RATIO, 1.0)])
        stiffer = Corotated((1.0 + self.RATIO) * 2e4, 0.0, density=1000.0)
        np.testing.assert_allclose(sheared([1e-5], large), sheared([1e-5], stiffer), rtol=1e-4)


def test_friction_takes_energy_on_any_path():
    """Work of an implicit step is at least the change of the energy stored, whatever the path of strain."""
    generator = torch.Generator().manual_seed(0)
    limit = torch.tensor([[0.01, 0.03]], dtype=torch.float64)
    strain = torch.zeros(200, 3, 3, dtype=torch.float64)
    for t in range(1, 200):
        noise = 0.01 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
        strain[t] = strain[t - 1] + noise + noise.mT
    plastic = torch.zeros(1, 2, 1, 3, 3, dtype=torch.float64)
    stored, lost = torch.zeros(2, dtype=torch.float64), []
    for t in range(1, 200):
        trial = strain[t] - plastic
        share = stuck_share(trial, limit)
        plastic = plastic + (1.0 - share) * trial
        elastic = (strain[t] - plastic)[0, :, 0]
        assert bool((elastic.flatten(1).norm(dim=1) <= limit[0] * (1.0 + 1e-12)).all())
        work = 2.0 * (elastic * (strain[t] - strain[t - 1])).sum((1, 2))
        lost.append(work - (elastic.square().sum((1, 2)) - stored))
        stored = elastic.square().sum((1, 2))
    assert float(torch.stack(lost).min()) > -1e-15
    assert float(torch.stack(lost).sum(0).min()) > 1e-4


def pull(newtons, batch=1):
    force = torch.zeros(batch, len(MESH.vertices), 3, dtype=torch.float64)
    force[:, TIP, 2] = newtons / len(TIP)
    return Inputs(force)


def sag(q):
    return q[..., TIP, 2].mean(-1) - float(np.mean(MESH.vertices[TIP, 2]))


class TestPoses:
    """Static equilibria, which depend on the poses before."""

    def test_a_body_that_was_bent_keeps_a_deflection(self):
        simulator = Simulator(CLAMPED, SLIDING, 0.01, WEIGHTLESS, solver=TIGHT)
        bent = simulator.static_equilibrium(pull(0.1))
        left = float(sag(simulator.static_equilibrium(after=bent).q)[0])
        assert 0.05 * float(sag(bent.q)[0]) < left < float(sag(bent.q)[0])
        assert float(sag(simulator.static_equilibrium().q)[0]) == pytest.approx(0.0, abs=1e-12)

    def test_a_motion_comes_to_rest_in_the_pose_that_friction_leaves(self):
        """A slow roll-out of the loads ends in the poses, and a body that is let go ends away from its rest shape."""
        damped = replace(SLIDING, stiffness_damping=0.01)
        simulator = Simulator(CLAMPED, damped, 0.02, WEIGHTLESS, solver=TIGHT)
        ramp = torch.cat([torch.linspace(0.0, 1.0, 51)[1:], torch.linspace(1.0, 0.0, 51)[1:], torch.zeros(60)])
        inputs = Inputs(ramp.double()[:, None, None, None] * pull(0.1).external_force)
        moved = simulator.rollout(simulator.rest_state(), 160, inputs)
        bent = simulator.static_equilibrium(pull(0.1))
        left = simulator.static_equilibrium(after=bent)
        assert float(sag(moved.q[50])) == pytest.approx(float(sag(bent.q)), rel=0.03)
        assert float(sag(moved.q[-1])) == pytest.approx(float(sag(left.q)), rel=0.05)
        assert float((moved.q[-1] - moved.q[-2]).abs().max()) < 1e-8

    def test_the_order_of_poses_counts(self):
        simulator = Simulator(CLAMPED, SLIDING, 0.01, WEIGHTLESS, solver=TIGHT)
        first = simulator.static_equilibrium(pull(0.05))
        large = simulator.static_equilibrium(pull(0.15), after=first)
        again = simulator.static_equilibrium(pull(0.05), after=large)
        assert float(sag(again.q)) > 1.1 * float(sag(first.q))
        # The same load again changes nothing.
        torch.testing.assert_close(simulator.static_equilibrium(pull(0.05), after=again).q, again.q, rtol=0, atol=1e-9)

    def test_a_state_without_memory_was_strained_in_proportion(self):
        """A pose that a motion begins from is in equilibrium in its first step, with or without its memory."""
        simulator = Simulator(CLAMPED, SLIDING, 0.01, WEIGHTLESS, solver=TIGHT)
        bent = simulator.static_equilibrium(pull(0.1))
        assert bent.memory["plastic_strain"].shape[:2] == (1, 1)
        for start in (bent, replace(bent, memory={})):
            after, _ = simulator.step(start, pull(0.1))
            torch.testing.assert_close(after.q, bent.q, rtol=0.0, atol=1e-9)
            torch.testing.assert_close(
                after.memory["plastic_strain"], bent.memory["plastic_strain"], rtol=0.0, atol=1e-8
            )


@pytest.mark.parametrize("solver", ["newton", "quasi_newton"])
def test_implicit_euler_never_gains_energy(solver):
    """Kinetic, elastic and stored energy, of a body that is let go."""
    settings = SolverSettings(solver, relative_tolerance=1e-10)
    material = replace(SLIDING, hysteresis=[(0.5, 0.02), (0.5, 0.002)])
    simulator, free = (Simulator(CLAMPED, m, 0.005, WEIGHTLESS, solver=settings) for m in (material, ELASTIC))
    states = [pose(simulator, "bent", 1)]
    for _ in range(60):
        states.append(simulator.step(states[-1])[0])
    mass, weights = simulator.prepare().mass[0], simulator.prepare().values["slider_modulus"][0]
    term = simulator.workspace(1).potential.energies[1]
    energies = []
    for state in states[1:]:
        elastic = elastic_energy(free, state.q)
        strain = term.strain(state.q)[:, None] - state.memory["plastic_strain"]
        stored = 0.5 * (weights * strain.square().sum((-2, -1))).sum()
        energies.append(float(0.5 * (mass * state.v[0].square().sum(-1)).sum() + elastic + stored))
    energies = np.array(energies)
    assert np.diff(energies).max() < 1e-9 * energies[0]
    assert energies[-1] < 0.5 * energies[0]


def elastic_energy(simulator, q):
    """Energy [J] of a body without memory: inertia of none, at its positions."""
    slow = replace(simulator, time_step=1e6)
    slow.linearise(State(q, torch.zeros_like(q))).residual(q)
    return float(slow.workspace(1).potential.energy)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("start", POSES)
def test_gradients(start, integrator):
    simulator = Simulator(CLAMPED, replace(TWO_SLIDERS, mass_damping=0.5), integrator=integrator, solver=TIGHT)
    rows = {row.parameter: row for row in check_gradients(simulator, start)}
    assert {"hysteresis_ratio_2, each environment", "hysteresis_strain_1, each environment"} <= rows.keys()
    assert {name: row for name, row in rows.items() if not row.relative_error < 1e-6} == {}
