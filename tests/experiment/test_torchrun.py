"""Several processes that torchrun starts train one network together."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from main_job import IN_RUN, REPOSITORY, TINY, run


def torchrun(*arguments, command=(), settings=TINY):
    """A finished run of the command by two processes of this machine."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    return subprocess.run(
        [*launcher, "-m", "warp_resphys.cli", *command, *settings, *arguments],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"},
        text=True,
        capture_output=True,
        timeout=300,
        check=False,
    )


_GRADIENTS = """
import json
import torch
from test_training import trainer
from warp_resphys.io.team import agreed, is_first, joined
with joined(torch.device("cpu")):
    told = agreed({"weights": torch.arange(3.0)} if is_first() else None)
    assert told["weights"].tolist() == [0.0, 1.0, 2.0]
    one = trainer(batch_size=3, noise=0.1)
    found, step = [], one._optimiser.step
    def recorded():
        found.append(torch.cat([p.grad.flatten() for p in one.model.network.parameters()]).tolist())
        step()
    one._optimiser.step = recorded
    record = one.run_epoch()
    if is_first():
        print(json.dumps([record["train_loss"], found]))
"""


def test_gradients_of_shares_add_up(folder):
    """Those of each batch of an epoch, the last of which is one sample: a share of it is empty."""
    Path("gradients.py").write_text(_GRADIENTS)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "tests/learning")])}
    found = []
    for start in ([], ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]):
        command = [sys.executable, *start, "gradients.py"]
        done = subprocess.run(command, env=environment, text=True, capture_output=True, timeout=200, check=False)
        assert done.returncode == 0, done.stderr
        found.append(json.loads(done.stdout.splitlines()[-1]))
    (loss, one), (also, two) = found
    assert also == pytest.approx(loss, rel=1e-4)
    one, two = np.array(one), np.array(two)
    assert one.shape == two.shape
    assert len(one) == 24
    np.testing.assert_allclose(two[0], one[0], rtol=0.0, atol=1e-5 * np.abs(one[0]).max())
    np.testing.assert_allclose(two[-1], one[-1], rtol=0.0, atol=1e-2 * np.abs(one[-1]).max())


@pytest.mark.parametrize("kind", ["feed_forward", "recurrent"])
def test_it_is_the_training_of_one_process(folder, kind):
    """Gradients of two shares of a batch add up to those of the batch: the same losses but for rounding."""
    more = ["trainer.epochs=6", "trainer.rollout_every=3", "timing=false"]
    more += ["network=recurrent", "trainer=sequences", "trainer.sequence=4"] if kind == "recurrent" else []
    found = {}
    for count in (1, 2):
        where = f"hydra.run.dir=run_{count}"
        if count == 1:
            assert run(*TINY, *more, where)[0] == 0
        else:
            done = torchrun(*more, where)
            assert done.returncode == 0, done.stderr
            assert done.stdout.count("Error of the vertices") == 1
        names = ("resphys", "simfree")
        found[count] = [
            json.loads(Path(f"run_{count}", f"training_{name}.json").read_text())["epochs"] for name in names
        ]
    for one, two in zip(*found.values(), strict=True):
        for key in ("train_loss", "validation_loss"):
            losses = [[epoch[key] for epoch in each] for each in (one, two)]
            np.testing.assert_allclose(losses[1], losses[0], rtol=1e-3)
            np.testing.assert_allclose(losses[1][0], losses[0][0], rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "command", "sentence"),
    [
        ([], ["tune"], "torchrun is for runs: start warp-resphys tune without it."),
        (["trainer.epochs=0"], [], "trainer.epochs is 0"),
        (["experiment=marker_ablation"], [], "torchrun is for one training"),
    ],
)
def test_one_sentence(folder, arguments, command, sentence):
    own = arguments and arguments[0].startswith("experiment")
    done = torchrun(*arguments, IN_RUN, command=command, settings=[] if own else TINY)
    assert done.returncode != 0
    assert done.stderr.count(f"error: {sentence}") == 1
