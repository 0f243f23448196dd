"""Checks that the robots of a run repeat its evaluation, loaded from the folder and from a file."""

from pathlib import Path

import numpy as np
import torch

import warp_resphys
from warp_resphys.io.safe_files import read_array, read_hdf5


def check_robots(folder, models=("simulation", "sysid", "simfree", "resphys"), tolerance=1e-8):
    """Compares every model's trials with rollouts.h5 [m], up to solver tolerances."""
    folder = Path(folder)
    with read_hdf5(folder / "rollouts.h5", "rollouts") as file:
        names = [str(name) for name in file.attrs["names"]]
        expected = {model: read_array(file, f"{model}_observed") for model in models}
    for model in models:
        robot = warp_resphys.load(folder, model)
        kept = robot.save(folder.parent / f"{model}.safetensors")
        for row, name in enumerate(names):
            trial = warp_resphys.recorded_trial(robot, name)
            with torch.no_grad():
                motion = trial.play(robot)
                again = trial.play(warp_resphys.load(kept))
            wanted = expected[model][row, : len(trial.times)]
            assert np.isfinite(wanted).all()
            # There is something to see.
            assert np.abs(wanted - wanted[:1]).max() > 1e3 * tolerance or len(wanted) == 1
            # A network's states feed on themselves.
            magnified = 100.0 if model == "simfree" else 1.0
            np.testing.assert_allclose(
                trial.shown(motion), wanted, atol=magnified * tolerance, err_msg=f"{model}, {name}"
            )
            assert torch.equal(motion.q, again.q)
