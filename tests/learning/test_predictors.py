"""A learned force that fades out beyond the range of its training."""

import math

import pytest
import torch

from warp_resphys import State
from warp_resphys.learning.residuals.correction import Learned, LearnedPredictor, Range
from warp_resphys.learning.residuals.networks import ResidualForce, build_model
from warp_resphys.settings.learning import NetworkSettings

SAMPLES, VERTICES = 30, 8
REDUCED = NetworkSettings(position_modes=3, velocity_modes=2, force_modes=4, layers=1, width=16)
BOX = Range(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0]), torch.tensor([2e-3, 0.1]))


def motion(modes, seed):
    """(S, N, 3) samples in a space of few modes, and the (M, 3 N) orthonormal modes."""
    random = torch.Generator().manual_seed(seed)
    basis = torch.linalg.qr(torch.randn(3 * VERTICES, modes, generator=random, dtype=torch.float64))[0].T
    return (torch.randn(SAMPLES, modes, generator=random, dtype=torch.float64) @ basis).view(SAMPLES, -1, 3), basis


@pytest.fixture
def trained():
    """A model of float64, states of its training, and modes of displacements and velocities."""
    torch.manual_seed(0)
    (u, by_u), (v, by_v), (force, _) = motion(3, 1), motion(2, 2), motion(4, 3)
    rest = torch.rand(VERTICES, 3, dtype=torch.float64)
    model = build_model(ResidualForce, REDUCED, rest, rest + u, v, force).double().eval()
    return model, rest + u, v, by_u, by_v


def across(basis, size):
    """A field (N, 3) without any part along modes, whose root mean square distance is `size`."""
    field = torch.randn(3 * VERTICES, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    field = field - basis.T @ (basis @ field)
    return (size * math.sqrt(VERTICES) * field / field.norm()).view(VERTICES, 3)


def test_the_distance_from_the_modes_is_that_of_what_they_cannot_represent(trained):
    model, q, v, by_u, by_v = trained
    torch.testing.assert_close(model.missed(q, v), torch.zeros(SAMPLES, 2, dtype=q.dtype), rtol=0.0, atol=1e-12)
    away = model.missed(q + across(by_u, 3e-3), v - across(by_v, 0.2))
    torch.testing.assert_close(away, q.new_tensor([[3e-3, 0.2]]).expand(SAMPLES, 2))


@pytest.mark.parametrize(
    ("inputs", "missed", "weight"),
    [
        ([0.0, 2.0], [0.0, 0.0], 1.0),
        ([1.4, 4.9], [2.4e-3, 0.12], 1.0),  # within the widened box, and 1.25 times the distances
        ([1.75, 2.0], [0.0, 0.0], 0.5),  # half a margin beyond it
        ([0.0, -1.5], [0.0, 0.0], 0.5),
        ([0.0, 6.1], [0.0, 0.0], 0.0),
        ([0.0, 2.0], [3.75e-3, 0.0], 0.5),  # 1.875 times
        ([1.75, 2.0], [0.0, 0.26], 0.0),
    ],
)
def test_the_weight_falls_from_one_within_to_zero_beyond(inputs, missed, weight):
    assert BOX.weight(torch.tensor([inputs]), torch.tensor([missed])).tolist() == pytest.approx([weight], abs=1e-5)


def test_a_predictor_scales_its_force(trained):
    model, q, v, by_u, _ = trained
    missed = model.missed(q + across(by_u, 1e-3), v)  # as if motions had been this far from the modes
    with torch.no_grad():
        guarded = Range.of(model.encode(q, v), missed)
        fading = LearnedPredictor(model, range_=guarded)
        constant = LearnedPredictor(model, range_=Range(guarded.low, guarded.high))
        for size, weight in ((0.0, 1.0), (1.2e-3, 1.0), (1.875e-3, 0.5), (2.6e-3, 0.0)):
            state = State(q[:5] + across(by_u, size), v[:5])
            torch.testing.assert_close(fading(state, 0), weight * constant(state, 0), atol=1e-9, rtol=1e-6)
        assert constant(state, 0).abs().max() > 1e-3
    assert fading.left_at.tolist() == [-1] * 5


def test_a_model_moves_to_a_device_with_its_range():
    learned = Learned(torch.nn.Linear(2, 1), BOX).to(torch.device("meta"))
    assert {x.device.type for x in (*learned.range_.edges, learned.range_.missed, *learned.network.parameters())} == {
        "meta"
    }
