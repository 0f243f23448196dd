"""Several processes that torchrun starts train one network together."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from main_job import IN_RUN, REPOSITORY, TINY, run


def torchrun(*arguments, command=()):
    """A finished run of the command by two processes of this machine."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    return subprocess.run(
        [*launcher, "-m", "warp_resphys.cli", *command, *TINY, *arguments],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"},
        text=True,
        capture_output=True,
        timeout=300,
        check=False,
    )


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
    ],
)
def test_one_sentence(folder, arguments, command, sentence):
    done = torchrun(*arguments, IN_RUN, command=command)
    assert done.returncode != 0
    assert f"error: {sentence}" in done.stderr
