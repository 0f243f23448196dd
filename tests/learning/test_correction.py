"""Roll-outs of a simulator or of a network in its place, of which some diverge, and equilibria under feedback."""

import numpy as np
import pytest
import torch

from warp_resphys import Body, Corotated, Inputs, Simulator, SolverSettings, State, box_hexahedra, select_vertices
from warp_resphys.io.errors import ConvergenceError
from warp_resphys.learning.residuals.correction import (
    DIVERGENCE_DISTANCE,
    CorrectedSimulator,
    LearnedPredictor,
    equilibrium_under_feedback,
    known_positions,
)
from warp_resphys.learning.residuals.networks import NextState, build_model
from warp_resphys.settings.learning import NetworkSettings
from warp_resphys.stepping.rollout import rollout

MESH = box_hexahedra((0.1, 0.03, 0.03), (2, 1, 1))
BODY, TIP = Body(MESH, fixed=select_vertices(MESH, x=0.0)), select_vertices(MESH, x=0.1)
SIMULATOR = Simulator(BODY, Corotated(215e3, 0.45))
REST = SIMULATOR.rest_positions
MODES, SAMPLES = 3, 60
ARCHITECTURE = {"blocks": 2, "layers": 1, "width": 8, "activation": "silu"}
SIZES = {"position_modes": MODES, "velocity_modes": MODES, "force_modes": MODES, **ARCHITECTURE}
NETWORKS = {kind: NetworkSettings(kind=kind, **SIZES) for kind in ("reduced", "nodal")}


class LinearSystem:
    """Displacements and velocities in a few modes, z' = A z: damped rotations that mix both."""

    def __init__(self):
        random = np.random.default_rng(0)
        shapes = np.linalg.qr(random.normal(size=(REST.numel(), 2 * MODES)))[0].T.reshape(2, MODES, *REST.shape)
        self.shapes = torch.tensor(shapes) * torch.tensor([1e-2, 1.0])[:, None, None, None]
        self.matrix = torch.tensor(0.98 * np.linalg.qr(random.normal(size=(2 * MODES, 2 * MODES)))[0])

    def state(self, z):
        """(S, N, 3) positions and velocities of (S, 2 MODES) coordinates."""
        parts = zip(z.split(MODES, dim=1), self.shapes, strict=True)
        u, v = (torch.einsum("sm,mnd->snd", part, shapes) for part, shapes in parts)
        return REST + u, v

    def samples(self, seed=1):
        z = torch.randn(SAMPLES, 2 * MODES, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        return z - z.mean(0), (z - z.mean(0)) @ self.matrix.mT


@pytest.fixture
def system():
    return LinearSystem()


def linear_model(system, kind):
    """Its linear part fitted, its network silent."""
    torch.manual_seed(0)
    now, following = (system.state(z) for z in system.samples())
    model = build_model(NextState, NETWORKS[kind], REST, *now)
    model.fit_linear(model.encode(*now), model.encode_outputs(following[0] - REST, following[1]), 1e-6)
    model.remainder.zero_()
    return model.eval()


@pytest.mark.parametrize("kind", NETWORKS)
def test_the_linear_part_alone_reproduces_a_linear_system(system, kind):
    model = linear_model(system, kind)
    z = torch.tensor([[1.0, -2.0, 0.5, 0.0, 1.5, -1.0], [0.0, 0.3, 0.0, -2.0, 0.0, 0.7]], dtype=torch.float64)
    start = State(*system.state(z))
    step = CorrectedSimulator(SIMULATOR, LearnedPredictor(model)).step
    with torch.no_grad():
        positions = torch.stack(rollout(step, start, range(30), known_positions), 1)
    for step in range(31):
        q, _ = system.state(z @ torch.linalg.matrix_power(system.matrix, step).mT)
        torch.testing.assert_close(positions[:, step], q, rtol=0.0, atol=1e-5 * float((start.q - REST).abs().max()))


@pytest.mark.parametrize(
    ("value", "left"), [(float("nan"), True), (1.01 * DIVERGENCE_DISTANCE, True), (0.99 * DIVERGENCE_DISTANCE, False)]
)
def test_a_diverged_roll_out_stays_lost_and_does_not_affect_others(value, left):
    """The second of three environments leaves at its third step, and would come back if it was asked."""
    calls = []

    def predict(state, step):
        assert step == len(calls)
        calls.append(state.q.clone())
        following = state.q + 1e-3
        if len(calls) == 3:
            following[1, -1, 0] = REST[-1, 0] + 0.1 * value
        return State(following, state.v + 0.5)

    start = SIMULATOR.rest_state(3)
    step = CorrectedSimulator(SIMULATOR, predict).step
    positions = torch.stack(rollout(step, start, range(6), known_positions), 1)
    lost = torch.isnan(positions).all((2, 3))
    assert lost.tolist() == [7 * [False], 3 * [False] + 4 * [left], 7 * [False]]
    for step in range(7):
        torch.testing.assert_close(positions[0, step], REST + 1e-3 * step)
    assert torch.equal(positions[0], positions[2])
    assert all(torch.equal(q[1], REST) == left for q in calls[3:])  # stands at rest from then on


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_lost_environments_stand_at_rest_without_inputs(integrator):
    settings = SolverSettings(on_failure="count", max_iterations=15)
    simulator = Simulator(BODY, Corotated(2e4, 0.3, prony=[(0.5, 0.1)]), integrator=integrator, solver=settings)

    def predict(state, step):
        force = torch.zeros_like(state.q)
        force[1] = torch.nan if step == 2 else 0.0
        if step == 3:  # which the solver cannot follow
            force[2] = 1e3 * torch.randn(force[2].shape, generator=torch.Generator().manual_seed(0), dtype=force.dtype)
        return force

    state, other = (
        rollout(CorrectedSimulator(simulator, force).step, simulator.rest_state(3), range(5), lambda now: now)[-1]
        for force in (predict, None)
    )
    assert state.lost.tolist() == [False, True, True]
    assert torch.equal(state.q[1:], simulator.rest_positions.expand(2, -1, -1))
    places = ("q", "previous_q", "memory.robot.lost")
    assert all(not bool(t[1:].any()) for name, t in state.tensors().items() if name not in places)
    assert float(other.memory["viscous_strain"].abs().max()) > 1e-6
    for name, tensor in state.tensors().items():
        torch.testing.assert_close(tensor[0], other.tensors()[name][0], rtol=0.0, atol=1e-9)


def at_rest(*stiffnesses):
    """The state of beams with springs (N/m) from their tips to the places of their tips at rest, and the force."""
    s = Simulator(BODY, Corotated(1e5, 0.4), solver=SolverSettings(name="newton", relative_tolerance=1e-12))
    k = torch.zeros(len(stiffnesses), len(MESH.vertices), 1, dtype=torch.float64)
    k[:, TIP] = torch.tensor(stiffnesses, dtype=torch.float64)[:, None, None]

    def force(state):
        return k * (s.rest_positions - state.q)

    guess = s.rest_state(len(stiffnesses))
    return s, equilibrium_under_feedback(s, Inputs(), s.prepare(), guess, force), force


@pytest.mark.parametrize("stiffnesses", [(0.0,), (0.0, 1.0, 30.0), (-0.5, 5.0)])
def test_the_force_and_the_weight_are_in_balance(stiffnesses):
    s, state, force = at_rest(*stiffnesses)
    again = s.static_equilibrium(Inputs(force(state)))
    torch.testing.assert_close(again.q, state.q, rtol=0.0, atol=1e-7)
    sags = -(state.q[:, TIP, 2] - s.rest_positions[TIP, 2]).mean(1)
    assert (sags > 0.0).all()
    assert (torch.diff(sags) < 0.0).all()  # A stiffer spring carries more.
    free = at_rest(0.0)[1].q
    if 0.0 in stiffnesses:
        torch.testing.assert_close(state.q[:1], free, rtol=0.0, atol=1e-9)


def test_a_force_that_turns_round_has_no_equilibrium():
    """It pushes the tip back over the height at which it rests without the force."""
    s, free, _ = at_rest(0.0)
    height = free.q[:, TIP, 2].mean()

    def force(state):
        push = torch.zeros_like(state.q)
        push[:, TIP, 2] = -0.02 * torch.sign(state.q[:, TIP, 2].mean() - height)
        return push

    with pytest.raises(ConvergenceError) as caught:
        equilibrium_under_feedback(s, Inputs(), s.prepare(), s.rest_state(), force)
    assert caught.value.report.tolist() == [False]
