"""A recurrent predictor learns a dependence on the past, with its hidden state in the roll-out."""

import pytest
import torch

from warp_resphys import InputError, State
from warp_resphys.learning.residuals.correction import LearnedPredictor
from warp_resphys.learning.residuals.networks import ResidualForce, build_model
from warp_resphys.learning.residuals.training import Samples, SequenceTrainer
from warp_resphys.settings.learning import NetworkSettings, TrainerSettings

MODES = {"position_modes": 1, "velocity_modes": 0, "force_modes": 1}
NETWORK = NetworkSettings(**MODES, layers=1, width=16, activation="silu", recurrent=8)
TRAINER = {"epochs": 150, "batch_size": 8, "learning_rate": 1e-2, "final_learning_rate": 1e-4, "noise": 0.0}
TRAINER |= {"selection": "validation_loss", "rollout_every": 1000, "sequence": 10}
TRIALS, STEPS, LAG = 6, 40, 8.0
REST = torch.zeros(2, 3, dtype=torch.float64)


def series(seed):
    """Inputs that jump, and a force that follows them with a lag: the input alone does not tell it."""
    random = torch.Generator().manual_seed(seed)
    levels = torch.rand(TRIALS, 4, generator=random, dtype=torch.float64)
    inputs = levels.repeat_interleave(STEPS // 4, 1)  # (R, K)
    force, behind = [], torch.zeros(TRIALS, dtype=torch.float64)
    for k in range(STEPS):
        behind = behind + (inputs[:, k] - behind) / LAG
        force.append(behind)
    shape = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    q = 1e-3 * inputs.flatten()[:, None, None] * shape
    f = torch.stack(force, 1).flatten()[:, None, None] * shape
    return Samples(q, torch.zeros_like(q), (f,), None, (STEPS,) * TRIALS)


@pytest.fixture(scope="module")
def model():
    """A trained network, and motions that it has not seen."""
    torch.manual_seed(0)
    train, held_out = series(1), series(2)
    model = build_model(ResidualForce, NETWORK, REST, train.q, train.v, train.outputs[0])
    trainer = SequenceTrainer(model, train, held_out, lambda _: 0.0, TrainerSettings(**TRAINER), 0)
    while not trainer.finished:
        trainer.run_epoch()
    return trainer.use_best(), held_out


def rolled_out(model, samples):
    """(R, K) the first component of the predicted force, and of the true one, in closed loop."""
    q = samples.q.unflatten(0, (TRIALS, STEPS))
    predict = LearnedPredictor(model)
    with torch.no_grad():
        forces = [predict(State(q[:, k], torch.zeros_like(q[:, k])), k) for k in range(STEPS)]
    return torch.stack(forces, 1)[:, :, 0, 0], samples.outputs[0].unflatten(0, (TRIALS, STEPS))[:, :, 0, 0]


def test_a_recurrent_network_learns_a_lag(model):
    result, true = rolled_out(*model)
    present = model[1].q[:, 0, 0].view(TRIALS, STEPS) * 1e3
    ratio = ((result - true).square().mean() / (present - true).square().mean()).sqrt()
    assert float(ratio) < 0.3


def test_every_environment_has_its_hidden_state(model):
    """Trials have the same roll-outs alone and in a batch, all from no hidden state."""
    learned, samples = model
    together, _ = rolled_out(learned, samples)
    q = samples.q.unflatten(0, (TRIALS, STEPS))[3:4]
    for _ in range(2):
        predict = LearnedPredictor(learned)
        with torch.no_grad():
            alone = [predict(State(q[:, k], torch.zeros_like(q[:, k])), k)[0, 0, 0] for k in range(STEPS)]
        torch.testing.assert_close(torch.stack(alone), together[3])
    assert predict.hidden.shape == (1, 8)


def test_a_hidden_state_of_another_size_is_refused(model):
    inputs = torch.zeros(3, 1)
    for wrong in (torch.zeros(3, 7), torch.zeros(2, 8)):
        with pytest.raises(InputError, match=r"the hidden state is \(.*\): it must be \(3, 8\), or None to begin"):
            model[0].standardised(inputs, wrong)
