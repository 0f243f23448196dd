"""Sliders of a material against closed forms, what they take and keep, and their gradients."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from scipy.integrate import trapezoid

from warp_resphys import (
    Body,
    ConvexMaterial,
    Corotated,
    Gent,
    Inputs,
    Mesh,
    MooneyRivlin,
    Simulator,
    SolverSettings,
    StableNeoHookean,
    State,
    bind_markers,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.dynamics.tape import record_rollout
from warp_resphys.energies.catalogue import make_material
from warp_resphys.energies.hysteresis import stuck_share
from warp_resphys.io.errors import InputError
from warp_resphys.learning.library import ObservedMotion, identify
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
    """(T,) shear stresses [Pa] after steps to shear angles (T,): the force that holds the end, over its area."""
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
    return trapezoid(stress[-2 * steps - 1 :], path[-2 * steps - 1 :])


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

    def test_several_loads_after_one_pose_are_what_they_are_alone(self):
        simulator = Simulator(CLAMPED, SLIDING, 0.01, WEIGHTLESS, solver=TIGHT)
        bent = simulator.static_equilibrium(pull(0.15))
        loads = [pull(0.05), pull(0.1)]
        both = Inputs(torch.cat([load.external_force.reshape(1, -1, 3) for load in loads]))
        together = simulator.static_equilibrium(both, after=bent)
        for row, load in enumerate(loads):
            alone = simulator.static_equilibrium(load, after=bent)
            torch.testing.assert_close(together.q[row], alone.q[0], rtol=0, atol=1e-8)

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


def test_a_slider_that_sticks_is_a_spring_for_every_integrator():
    stuck, spring = replace(ELASTIC, hysteresis=[(0.5, 10.0)]), replace(ELASTIC, prony=[(0.5, 1e12)])
    for integrator in INTEGRATORS:
        runs = [Simulator(CLAMPED, m, 0.005, integrator=integrator, solver=TIGHT) for m in (stuck, spring)]
        ends = [sim.rollout(sim.rest_state(), 10).q[-1] for sim in runs]
        torch.testing.assert_close(ends[0], ends[1], rtol=0.0, atol=1e-9)


def test_plastic_strain_turns_with_the_body():
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -1.0, 0.4], [1.0, 0.0, 0.2], [-0.4, -0.2, 0.0]]).double())
    gravity = torch.tensor([[0.0, 0.0, -9.8]], dtype=torch.float64)
    simulator = Simulator(Body(MESH), TWO_SLIDERS, 0.005, integrator="bdf2", solver=TIGHT)  # free to turn
    carried = simulator.rollout(pose(simulator, "bent", 1), 5, parameters={"gravity": gravity}).final
    turned = State.from_tensors({k: x if k.startswith("memory.") else x @ turn.T for k, x in carried.tensors().items()})
    first = simulator.rollout(carried, 5, parameters={"gravity": gravity})
    second = simulator.rollout(turned, 5, parameters={"gravity": gravity @ turn.T})
    torch.testing.assert_close(second.q[-1], first.q[-1] @ turn.T, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_roll_out_goes_on_from_its_last_state_and_a_batch_is_its_environments(integrator):
    simulator = Simulator(CLAMPED, TWO_SLIDERS, integrator=integrator, solver=TIGHT)
    forces = torch.cat([pull(0.2).external_force, pull(-0.1).external_force])
    whole = simulator.rollout(simulator.rest_state(2), 8, Inputs(forces))
    half = simulator.rollout(simulator.rest_state(2), 4, Inputs(forces)).final
    assert half.memory["plastic_strain"].shape[:2] == (2, 2)
    again = State.from_tensors({name: tensor.clone() for name, tensor in half.tensors().items()})
    torch.testing.assert_close(simulator.rollout(again, 4, Inputs(forces)).q[-1], whole.q[-1], rtol=0, atol=1e-11)
    forgotten = replace(again, memory={})
    assert float((simulator.rollout(forgotten, 4, Inputs(forces)).q[-1] - whole.q[-1]).abs().max()) > 1e-6
    alone = simulator.rollout(simulator.rest_state(), 8, Inputs(forces[1:])).q[-1, 0]
    torch.testing.assert_close(alone, whole.q[-1, 1], rtol=0.0, atol=1e-11)


def test_two_regions_of_one_material_are_one_solid():
    halves = [np.array([0]), np.array([1])]
    body = Body(Mesh(MESH.vertices, MESH.cells, dict(zip("ab", halves, strict=True))), fixed=CLAMPED.fixed_vertices)
    sims = [Simulator(body, m, solver=TIGHT) for m in (TWO_SLIDERS, {"a": TWO_SLIDERS, "b": TWO_SLIDERS})]
    one, two = (sim.rollout(sim.rest_state(), 6) for sim in sims)
    torch.testing.assert_close(one.q, two.q, rtol=0.0, atol=1e-12)
    joined = torch.cat([two.final.memory["a_plastic_strain"], two.final.memory["b_plastic_strain"]], 2)
    assert float((joined.norm() - one.final.memory["plastic_strain"].norm()).abs()) < 1e-9
    assert "b_hysteresis_strain_2" in sims[1].parameters


def test_single_precision_keeps_its_type():
    single = Simulator(CLAMPED, TWO_SLIDERS, dtype=torch.float32, solver=SolverSettings(relative_tolerance=1e-5))
    final = single.rollout(single.rest_state(), 3, Inputs(pull(0.2).external_force.float())).final
    assert final.memory["plastic_strain"].dtype == torch.float32
    double = Simulator(CLAMPED, TWO_SLIDERS, solver=TIGHT)
    exact = double.rollout(double.rest_state(), 3, pull(0.2)).final
    torch.testing.assert_close(
        final.memory["plastic_strain"].double(), exact.memory["plastic_strain"], rtol=0.0, atol=1e-5
    )


class TestGradients:
    """Adjoints against differences, over changes that are small beside the kinks where sliders begin to slide."""

    @pytest.mark.parametrize(("start", "poissons_ratio"), [*((name, 0.45) for name in POSES), ("twisted", 0.499)])
    @pytest.mark.parametrize("integrator", INTEGRATORS)
    def test_of_a_roll_out(self, start, poissons_ratio, integrator):
        material = replace(TWO_SLIDERS, mass_damping=0.5, poissons_ratio=poissons_ratio)
        simulator = Simulator(CLAMPED, material, integrator=integrator, solver=TIGHT)
        compared = check_gradients(simulator, start, change=1e-3, together=False)
        rows = {row.parameter: row for row in compared}
        assert {"hysteresis_ratio_2, each environment", "hysteresis_strain_1, each environment"} <= rows.keys()
        assert {name: row for name, row in rows.items() if not row.relative_error < 3e-6} == {}

    @pytest.mark.parametrize(
        "material",
        [
            StableNeoHookean(2e4, 0.45, density=1000.0, hysteresis=[(0.5, 0.01)]),
            MooneyRivlin(3e3, 1e3, 1e5, density=1000.0, hysteresis=[(0.5, 0.01)]),
            Gent(8e3, 30.0, 1e5, density=1000.0, hysteresis=[(0.5, 0.01)]),
            ConvexMaterial(c10=4e3, bulk_1=5e4, density=1000.0, hysteresis=[(4e3, 0.01)]),
        ],
        ids=lambda material: material.model,
    )
    def test_with_every_material(self, material):
        simulator = Simulator(CLAMPED, material, solver=TIGHT)
        rows = check_gradients(simulator, "bent", steps=2, batch=1, change=1e-3)
        own = {row.parameter: row.relative_error for row in rows if "hysteresis" in row.parameter}
        assert len(own) == 2
        assert max(own.values()) < 3e-6

    def test_by_the_memory_of_the_start(self):
        simulator = Simulator(CLAMPED, TWO_SLIDERS, solver=TIGHT)
        state = simulator.rollout(pose(simulator, "bent", 1), 2).final
        weights, noise = (normal(0, x.shape) for x in (state.q, state.memory["plastic_strain"]))
        direction = 1e-6 * (noise + noise.mT)

        def loss(strain):
            return (weights * simulator.rollout(replace(state, memory={"plastic_strain": strain}), 2).q[-1]).sum()

        carried = state.memory["plastic_strain"].clone().requires_grad_()
        (gradient,) = torch.autograd.grad(loss(carried), carried)
        with torch.no_grad():
            expected, _ = central_difference(lambda step: float(loss(carried + step * direction)))
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-5)

    @pytest.mark.parametrize("name", ["hysteresis_ratio_1", "hysteresis_strain_1", "youngs_modulus"])
    def test_of_poses_one_after_the_other(self, name):
        simulator = Simulator(CLAMPED, SLIDING, 0.01, solver=TIGHT)
        weights = normal(1, simulator.rest_state().q.shape)

        def loss(value):
            state = None
            for newtons in (0.1, -0.05, 0.0):
                state = simulator.static_equilibrium(pull(newtons), {name: value}, after=state)
            return (weights * simulator.step(state, pull(0.02), {name: value})[0].q).sum()

        value = torch.tensor([float(simulator.constants[name])], dtype=torch.float64, requires_grad=True)
        (gradient,) = torch.autograd.grad(loss(value), value)
        with torch.no_grad():
            expected, _ = central_difference(lambda x: float(loss(value * (1.0 + 1e-4 * x))))
        assert float(1e-4 * gradient * value.detach()) == pytest.approx(expected, rel=1e-5)
        assert abs(expected) > 1e-9

    def test_on_a_tape(self):
        simulator = Simulator(CLAMPED, TWO_SLIDERS, solver=TIGHT)
        start = pose(simulator, "bent", 1)
        weights = normal(2, (4, *start.q.shape))
        values = {"hysteresis_ratio_1": 0.5, "hysteresis_strain_2": 0.02}
        leaves = {name: torch.tensor([x], dtype=torch.float64, requires_grad=True) for name, x in values.items()}
        (weights * simulator.rollout(start, 3, parameters=leaves).q).sum().backward()
        arrays = {name: wp.array([x], dtype=wp.float64, requires_grad=True, device="cpu") for name, x in values.items()}
        q, v = (wp.array(x.numpy(), dtype=wp.vec3d, device="cpu") for x in (start.q, start.v))
        tape = wp.Tape()
        motion = record_rollout(tape, simulator, q, v, 3, parameters=arrays)
        tape.backward(grads={motion.q: wp.from_torch(weights, dtype=wp.vec3d)})
        for name, leaf in leaves.items():
            assert float(wp.to_torch(arrays[name].grad)) == pytest.approx(float(leaf.grad), rel=1e-9)


def normal(seed, shape):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_identification_recovers_the_slider_from_a_slow_cycle():
    """Markers of a beam that is bent back and forth, so slowly that a Prony branch could not explain the loop."""
    truth = replace(ELASTIC, poissons_ratio=0.3, stiffness_damping=5e-3, hysteresis=[(0.8, 0.01)])
    markers = bind_markers(MESH, np.array([[0.04, 0.01, 0.022], [0.02, 0.01, 0.022]]), ["tip", "middle"])
    phase = torch.linspace(0.0, 3.0 * math.pi, 37, dtype=torch.float64)[1:]
    inputs = Inputs(phase.sin()[:, None, None, None] * pull(0.1).external_force)
    laboratory, guess = (
        Simulator(CLAMPED, m, 0.05, WEIGHTLESS, relative_tolerance=1e-8)
        for m in (truth, replace(truth, hysteresis=[(0.3, 0.02)]))
    )
    observed = torch.stack([markers(q) for q in laboratory.rollout(laboratory.rest_state(), len(phase), inputs).q])
    motion = ObservedMotion(observed, laboratory.rest_state(), inputs, observation=markers)
    bounds = {"hysteresis_ratio_1": (0.05, 5.0), "hysteresis_strain_1": (1e-3, 0.2)}
    result = identify(guess, motion, {**bounds, "youngs_modulus": (1e4, 1e5)}, {"youngs_modulus": 3e4})
    assert result.parameters["hysteresis_ratio_1"] == pytest.approx(0.8, rel=1e-2)
    assert result.parameters["hysteresis_strain_1"] == pytest.approx(0.01, rel=1e-2)
    assert result.parameters["youngs_modulus"] == pytest.approx(2e4, rel=1e-2)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: replace(ELASTIC, hysteresis=[0.3]), "give a (ratio, strain) for each slider"),
        (lambda: replace(ELASTIC, hysteresis=[(0.3, 0.0)]), "hysteresis_strain_1 is"),
        (lambda: replace(ELASTIC, hysteresis=[(-0.1, 0.1)]), "hysteresis_ratio_1 is"),
        (lambda: make_material(hysteresis_ratio_1=0.1), "hysteresis has hysteresis_ratio_1: give each slider"),
    ],
)
def test_wrong_sliders_are_refused(make, said):
    with pytest.raises(InputError) as caught:
        make()
    assert said in str(caught.value)


def test_configured_sliders_are_those_of_the_material():
    made = make_material(hysteresis_ratio_1=0.2, hysteresis_strain_1=0.03, prony_ratio_1=0.1, prony_time_1=2.0)
    assert (list(made.hysteresis), list(made.prony)) == ([(0.2, 0.03)], [(0.1, 2.0)])
    law = make_material("law", hysteresis_modulus_1=5e3, hysteresis_strain_1=0.03)
    assert law.constants["hysteresis_modulus_1"] == 5e3
