"""The data-driven baseline: a network that predicts the next state, and its roll-out without a simulator."""

import numpy as np
import pytest
import torch

from warp_resphys import Body, Corotated, Simulator, State, box_hexahedra, select_vertices
from warp_resphys.learning.networks import NextState, build_model
from warp_resphys.learning.rollout import DIVERGENCE_DISTANCE, LearnedPredictor, Rollout, closed_loop
from warp_resphys.settings.learning import NetworkSettings

MESH = box_hexahedra((0.1, 0.03, 0.03), (2, 1, 1))
SIMULATOR = Simulator(Body(MESH, fixed=select_vertices(MESH, x=0.0)), Corotated(215e3, 0.45))
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
    positions = closed_loop(Rollout(SIMULATOR, LearnedPredictor(model)), start, 30)
    for step in range(31):
        q, _ = system.state(z @ torch.linalg.matrix_power(system.matrix, step).mT)
        torch.testing.assert_close(positions[:, step], q, rtol=0.0, atol=1e-5 * float((start.q - REST).abs().max()))


@pytest.mark.parametrize("value", [float("nan"), 1.01 * DIVERGENCE_DISTANCE])
def test_a_diverged_roll_out_stays_lost_and_does_not_affect_others(value):
    """The second of three environments leaves at its third step, and would come back if it was asked."""
    calls = []

    def predict(state, step):
        assert step == len(calls)
        calls.append(state.q.clone())
        following = state.q + 1e-3
        if len(calls) == 3:
            following[1, -1, 0] = REST[-1, 0] + 0.1 * value
        return State(following, state.v + 0.5)

    rollout = Rollout(SIMULATOR, predict)
    start = SIMULATOR.rest_state(3)
    positions = closed_loop(rollout, start, 6)
    lost = torch.isnan(positions).all((2, 3))
    assert lost.tolist() == [7 * [False], 3 * [False] + 4 * [True], 7 * [False]]
    for step in range(7):
        torch.testing.assert_close(positions[0, step], REST + 1e-3 * step)
    assert torch.equal(positions[0], positions[2])
    assert all(torch.equal(q[1], REST) for q in calls[3:])  # stands at rest from then on


def test_positions_below_the_limit_have_not_diverged():
    far = REST.expand(1, -1, -1) + 0.99 * DIVERGENCE_DISTANCE * 0.1
    rollout = Rollout(SIMULATOR, lambda state, step: State(far, state.v))
    positions = closed_loop(rollout, SIMULATOR.rest_state(1), 2)
    assert torch.equal(positions[:, 1], far)
