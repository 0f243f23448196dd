"""The same settings and seed in two processes give the same metrics.json, but for times, memory and versions."""

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.main_job import IN_RUN, run, without_reports

TESTS = Path(__file__).parents[1]
ARGUMENTS = [
    *("mesh.divisions=[4,2,2]", "data.steps=8", "data.weights_g.train=[50,90,130]", "data.weights_g.validation=[110]"),
    *("data.weights_g.test=[70,150]", "trainer.epochs=6", "trainer.rollout_every=2", "network.width=16"),
    *("timing=false", "hydra/job_logging=none", "hydra/hydra_logging=none", IN_RUN),
]
NOT_COMPARED = {"seconds", "seconds_per_test_trajectory", "peak_memory_gib", "versions"}


def numbers(data, place=""):
    """Every entry by where it stands."""
    if isinstance(data, dict):
        return {k: v for key, value in data.items() for k, v in numbers(value, f"{place}/{key}").items()}
    if isinstance(data, list):
        return {k: v for index, value in enumerate(data) for k, v in numbers(value, f"{place}/{index}").items()}
    return {place: data}


def make_run():
    """Makes the run in the working directory, without its report."""
    with without_reports():
        code, err = run(*ARGUMENTS)
    assert (code, err[-900:] if code else "") == (0, "")


def measured(folder):
    """metrics.json of a run, without what may differ."""
    results = json.loads((folder / "metrics.json").read_text())
    return numbers({key: value for key, value in results.items() if key not in NOT_COMPARED})


@pytest.mark.slow
def test_the_same_seed_gives_the_same_numbers(tmp_path):
    """Also in a process of two threads and another order of sets."""
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    with contextlib.chdir(here):
        make_run()
    paths = os.pathsep.join([str(TESTS), str(TESTS / "experiment"), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONHASHSEED": "2", "OMP_NUM_THREADS": "2", "PYTHONPATH": paths}
    command = [sys.executable, "-c", f"import {Path(__file__).stem} as runs; runs.make_run()"]
    subprocess.run(command, cwd=there, env=environment, check=True, capture_output=True, timeout=300)
    first, second = (measured(folder / "run") for folder in (here, there))
    assert sum(isinstance(value, float) for value in first.values()) >= 14
    assert second.keys() == first.keys()
    for key, value in first.items():
        wanted = pytest.approx(value, rel=1e-6, abs=0.0) if isinstance(value, float) else value
        assert second[key] == wanted, key
