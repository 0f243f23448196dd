import math
from dataclasses import replace

import pytest
import torch

from warp_resphys.io.errors import InputError
from warp_resphys.io.safe_files import read_checkpoint, write_checkpoint
from warp_resphys.learning.residuals.networks import ResidualForce, build_model
from warp_resphys.learning.residuals.training import Samples, Trainer
from warp_resphys.settings.learning import NetworkSettings, TrainerSettings

NETWORK = NetworkSettings(kind="nodal", blocks=2, layers=1, width=16, activation="normalised_elu")
CONFIG = {"epochs": 6, "batch_size": 16, "learning_rate": 5e-3, "final_learning_rate": 1e-4, "gamma": 0.5}
CONFIG |= {"step_epochs": 2, "weight_decay": 1e-5, "noise": 0.01, "linear_noise": 0.01, "rollout_every": 2}


def samples(count, seed):
    """A force that depends on the state in part linearly."""
    random = torch.Generator().manual_seed(seed)
    q, v = (torch.randn(count, 4, 3, generator=random, dtype=torch.float64) for _ in range(2))
    return Samples(q, v, (0.5 * q - 0.2 * v.flip(1) + torch.sin(2.0 * q) * v,))


TRAIN, VALIDATION = samples(70, 1), samples(20, 2)


def rollout_error(model):
    """Depends on the weights, like the real one."""
    with torch.no_grad():
        return float((model(VALIDATION.q, VALIDATION.v) - VALIDATION.outputs[0]).abs().mean())


def trainer(seed=0, error=rollout_error, **settings):
    torch.manual_seed(seed)
    model = build_model(
        ResidualForce, NETWORK, torch.zeros(4, 3, dtype=torch.float64), TRAIN.q, TRAIN.v, TRAIN.outputs[0]
    )
    return Trainer(model, TRAIN, VALIDATION, error, TrainerSettings(**{**CONFIG, **settings}), seed)


def finish(trainer):
    while not trainer.finished:
        trainer.run_epoch()
    return trainer


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


class TestResume:
    @pytest.mark.parametrize(
        ("after", "settings"), [(3, {}), (2, {"schedule": "step", "selection": "validation_loss"})]
    )
    def test_a_snapshot_goes_on_exactly(self, after, settings, tmp_path):
        whole = finish(trainer(**settings))
        first = trainer(**settings)
        for _ in range(after):
            first.run_epoch()
        path = tmp_path / "training.safetensors"
        write_checkpoint(path, "training", *first.snapshot())
        second = trainer(seed=17, **settings)  # nothing of its own start may remain
        second.resume(*read_checkpoint(path, "training"))
        finish(second)
        assert same(second.model.state_dict(), whole.model.state_dict())
        assert same(second.use_best().state_dict(), whole.use_best().state_dict())
        assert second.history == whole.history
        assert (second.best_score, second.best_epoch) == (whole.best_score, whole.best_epoch)
        assert second.best_error == whole.best_error
        assert same(second.best, whole.best)


class TestSelection:
    @pytest.mark.parametrize(
        ("errors", "best"), [([math.inf, 5.0, math.inf], 1), ([2.0, 2.0, 2.0], 0), ([math.inf, 4.0, 3.0], 2)]
    )
    def test_the_smallest_roll_out_error_is_selected(self, errors, best):
        queue, weights = list(errors), []

        def error(model):
            weights.append({k: t.clone() for k, t in model.network.state_dict().items()})
            return queue.pop(0)

        run = finish(trainer(error=error))
        losses = [record["validation_loss"] for record in run.history]
        assert losses == sorted(losses, reverse=True)  # the last epoch has the best loss
        assert (run.best_error, run.best_epoch) == (errors[best], 2 * (best + 1))
        assert not same(weights[0], weights[2])
        assert same(dict(run.use_best().network.state_dict()), weights[best])
        assert not run.model.training

    @pytest.mark.parametrize("measured", [3.0, math.inf])
    def test_the_smallest_validation_loss_is_selected(self, monkeypatch, measured):
        losses, weights, asked = [5.0, 4.0, 2.0, 3.0, math.nan, 6.0], [], []
        run = trainer(selection="validation_loss", error=lambda model: asked.append(model) or measured)

        def validate():
            weights.append({k: t.clone() for k, t in run.model.network.state_dict().items()})
            return losses[len(weights) - 1]

        monkeypatch.setattr(run, "_validate", validate)
        finish(run)
        assert run.best_epoch == 3
        assert not same(weights[2], weights[-1])
        assert len(asked) == 3  # after epochs 2, 4 and 6
        assert math.isnan(run.best_error)  # of epoch 3, nothing is known yet
        assert same(dict(run.use_best().network.state_dict()), weights[2])
        assert (run.best_error, len(asked)) == (measured, 4)
        assert run.history[2]["rollout_error_mm"] == measured
        run.use_best()
        assert len(asked) == 4
        assert not run.model.training


class TestLearning:
    def test_losses_fall_below_the_remainder_of_the_linear_part(self):
        run = finish(trainer(epochs=100, batch_size=8, noise=0.0))
        linear = float(run.model.remainder) ** 2
        assert 0.1 < linear < 1.0
        assert run.history[-1]["train_loss"] < 0.5 * linear

    def test_losses_are_mean_squared_errors_of_the_standardised_force(self):
        run = finish(trainer(epochs=1))
        with torch.no_grad():
            wanted = run.model.coders[0].encode(VALIDATION.outputs[0])
            result = run.model.coders[0].encode(run.model(VALIDATION.q, VALIDATION.v))
        expected = float((result - wanted).square().mean())
        assert run.history[0]["validation_loss"] == pytest.approx(expected, rel=1e-5)

    def test_cosine_schedule(self):
        rates = [r["learning_rate"] for r in finish(trainer(epochs=5)).history]
        assert (rates[0], rates[-1]) == (5e-3, pytest.approx(1e-4))
        assert rates[2] == pytest.approx((5e-3 + 1e-4) / 2)
        assert rates == sorted(rates, reverse=True)

    def test_step_schedule(self):
        rates = [r["learning_rate"] for r in finish(trainer(schedule="step")).history]
        assert rates == [5e-3, 5e-3, 2.5e-3, 2.5e-3, 1.25e-3, 1.25e-3]


@pytest.mark.parametrize("name", ["training", "validation"])
def test_empty_split(name):
    nothing = torch.zeros(0, 4, 3)
    empty = Samples(nothing, nothing, (nothing,))
    splits = {"training": TRAIN, "validation": VALIDATION, name: replace(empty)}
    model = trainer().model
    with pytest.raises(InputError, match=f"the {name} split is empty"):
        Trainer(model, splits["training"], splits["validation"], rollout_error, TrainerSettings(**CONFIG), 0)


@pytest.mark.parametrize(("exponent", "smallest"), [(0.0, 1.0), (1.0, 0.1)])
def test_outputs_are_weighted_by_their_deviation(exponent, smallest):
    """With the power one, the validation loss is the squared error of the forces themselves, in units of theirs."""
    forces = TRAIN.outputs[0] * torch.tensor([1.0, 1.0, 1.0, 0.1])[:, None]
    torch.manual_seed(0)
    model = build_model(ResidualForce, NETWORK, torch.zeros(4, 3, dtype=torch.float64), TRAIN.q, TRAIN.v, forces)
    data = [replace(samples, outputs=(forces[: len(samples.q)],)) for samples in (TRAIN, VALIDATION)]
    run = Trainer(model, *data, rollout_error, TrainerSettings(**{**CONFIG, "scale_weight": exponent}), 0)
    loss = run.run_epoch()["validation_loss"]
    (coder,) = model.coders
    with torch.no_grad():
        error = model(VALIDATION.q, VALIDATION.v) - data[1].outputs[0]
    weighed = error.flatten(1) if exponent else error.flatten(1) / coder.scale
    unit = coder.scale.square().mean() if exponent else 1.0
    assert loss == pytest.approx(float(weighed.square().mean() / unit), rel=1e-4)
    assert float(coder.scale.min() / coder.scale.max()) ** exponent == pytest.approx(smallest, rel=0.5)
