"""Training by L-BFGS: a loss whose minimum is known, and weights that are frozen."""

import torch

from warp_resphys.learning.full_batch import FullBatchTrainer
from warp_resphys.learning.networks import build_model
from warp_resphys.settings.learning import FullBatchSettings, NetworkSettings


class Distance(FullBatchTrainer):
    """The squared distance of the weights from given ones, each direction with its own curvature."""

    def _run_epoch(self):
        return {"train_loss": self._iterate()}

    def _backward(self):
        loss = sum(
            (scale * (w - 0.3)).square().sum() for scale, w in zip((1.0, 3.0, 10.0) * 9, self._weights, strict=False)
        )
        loss.backward()
        return float(loss.detach())


def test_it_finds_a_minimum_and_leaves_frozen_weights_alone():
    torch.manual_seed(0)
    q, v, force = torch.rand(3, 20, 4, 3, dtype=torch.float64)
    sizes = NetworkSettings(kind="nodal", blocks=1, layers=1, width=4)
    model = build_model(sizes, q[0], q, v, force)
    frozen, *others = model.network.parameters()
    frozen.requires_grad_(False)
    before = frozen.clone()
    trainer = Distance(model, lambda _: 0.0, FullBatchSettings(epochs=25, rollout_every=1, memory=10))
    while not trainer.finished:
        trainer.run_epoch()
    losses = [record["train_loss"] for record in trainer.state.history]
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] < 1e-9 * losses[0]
    for weight in others:
        torch.testing.assert_close(weight, torch.full_like(weight, 0.3), rtol=0.0, atol=1e-4)
    assert torch.equal(frozen, before)
