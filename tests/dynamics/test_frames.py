"""Rotations around the vertices of a body, and forces that turn with them."""

import numpy as np
import pytest
import torch
from chambered import KINDS, chambered
from scipy.spatial.transform import Rotation

from warp_resphys import Body, Corotated, Simulator, box_hexahedra, select_vertices
from warp_resphys.dynamics.frames import VertexFrames
from warp_resphys.dynamics.inputs import Inputs
from warp_resphys.dynamics.integrator import State
from warp_resphys.learning.predictors import LearnedPredictor, Range


def deformed(body, stretch):
    """(1, N, 3) rest positions under an affine map."""
    return torch.as_tensor(body.mesh.vertices @ np.asarray(stretch).T)[None]


@pytest.mark.parametrize("kind", KINDS)
def test_an_affine_map_has_the_rotation_of_its_polar_decomposition_everywhere(kind):
    body = chambered(kind)
    turn = Rotation.from_euler("xyz", [170.0, 50.0, -80.0], degrees=True).as_matrix()
    stretch = np.array([[1.4, 0.2, 0.0], [0.2, 0.6, 0.1], [0.0, 0.1, 0.9]])
    q = deformed(body, turn @ stretch)
    frames = VertexFrames(body, 0.01, q)
    found = frames.rotations(q)
    np.testing.assert_allclose(found[0], np.broadcast_to(turn, found[0].shape), atol=1e-12)
    force = torch.randn(q.shape, dtype=q.dtype, generator=torch.Generator().manual_seed(0))
    v = 0.0 * q
    np.testing.assert_allclose(frames.to_world(q, v, force)[0].numpy(), force[0].numpy() @ turn.T, atol=1e-12)
    np.testing.assert_allclose(frames.to_rest(q, v, frames.to_world(q, v, force)), force, atol=1e-12)
    rest = deformed(body, np.eye(3))
    np.testing.assert_allclose(frames.to_world(rest, (q - rest) / 0.01, force), frames.to_world(q, v, force), atol=1e-9)


def test_a_twisted_beam_turns_from_slice_to_slice():
    body = Body(box_hexahedra((0.1, 0.02, 0.02), (20, 4, 4)))
    x = body.mesh.vertices - [0.0, 0.01, 0.01]
    angles = np.radians(900.0) * x[:, 0]  # 90 degrees at the end
    q = torch.as_tensor(Rotation.from_euler("x", angles[:, None]).apply(x))[None]
    found = VertexFrames(body, 0.01, q).rotations(q)[0].numpy()
    inside = (x[:, 0] > 0.01) & (x[:, 0] < 0.09)
    turned = Rotation.from_matrix(found[inside]).as_euler("xyz")[:, 0]
    np.testing.assert_allclose(turned, angles[inside], atol=np.radians(1.5))


def test_forces_that_press_from_the_sides_wring_a_beam_unless_they_turn_with_it():
    """Dead loads do work when the body twists under them; the same loads that turn with it do not."""
    mesh = box_hexahedra((0.1, 0.02, 0.02), (10, 2, 2))
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0))
    material = Corotated(youngs_modulus=1e5, poissons_ratio=0.4, density=1e3, mass_damping=5.0)
    simulator = Simulator(body, material, time_step=0.005, gravity=(0.0, 0.0, 0.0))
    frames = VertexFrames(body, simulator.time_step, simulator.rest_positions)
    centred = simulator.rest_positions - simulator.tensor([0.0, 0.01, 0.01])
    inward = -6.0 * centred * simulator.tensor([0.0, 1.0, 1.0])
    nudge = torch.linalg.cross(simulator.tensor([1.0, 0.0, 0.0]).expand_as(centred), centred)
    twists = {}
    for follows in (False, True):
        state = simulator.rest_state()
        with torch.no_grad():
            for k in range(120):
                force = frames.to_world(state.q, state.v, inward[None]) if follows else inward[None]
                state, _ = simulator.step(state, Inputs(force + (1e-2 * nudge if k < 5 else 0.0)))
        tip = select_vertices(mesh, x=0.1)
        turned = frames.rotations(state.q)[0, tip].numpy()
        twists[follows] = float(np.abs(Rotation.from_matrix(turned).as_euler("xyz", degrees=True)[:, 0]).mean())
    assert twists[False] > 30.0
    assert twists[True] < 2.0


class Constant:
    """A model that sees nothing and always predicts the same force."""

    def __init__(self, rest, force):
        self.rest, self.force = rest, force

    def encode(self, q, v, actuation):
        return q.new_zeros(len(q), 1)

    def decode(self, inputs, hidden):
        return [self.force.expand(len(inputs), -1, -1)], hidden


def test_what_a_model_predicts_turns_with_the_body_in_a_roll_out():
    body = chambered("hexahedron")
    rest = deformed(body, np.eye(3))
    force = torch.randn(rest.shape, dtype=rest.dtype, generator=torch.Generator().manual_seed(1))
    turn = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    q, nothing = deformed(body, turn), torch.zeros(1, 0)
    range_ = Range.of(torch.zeros(2, 1, dtype=rest.dtype))
    state, frames = State(q, 0.0 * q), VertexFrames(body, 0.01, q)
    kept = LearnedPredictor(Constant(rest[0], force), nothing, range_)(state, 0)
    turned = LearnedPredictor(Constant(rest[0], force), nothing, range_, frames)(state, 0)
    assert torch.equal(kept, force)
    np.testing.assert_allclose(turned[0].numpy(), force[0].numpy() @ turn.T, atol=1e-12)
