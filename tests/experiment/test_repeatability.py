"""The same settings and seed in two processes give the same metrics.json, but for times, memory and versions."""

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.main_job import run, without_reports

TESTS = Path(__file__).parents[1]
SMALL = {
    "beam_oscillation": [
        "data.weights_g.train=[50,90,130]",
        "data.weights_g.validation=[110]",
        "data.weights_g.test=[70,150]",
    ],
    "beam_twist": [
        "data.angles_deg.train=[30,100,180]",
        "data.angles_deg.validation=[60]",
        "data.angles_deg.test=[140]",
    ],
    "marker_ablation": ["ablation.counts=[1,4]", "ablation.draws=3", "ablation.processes=1"],
}
LEARNING = ["trainer.epochs=6", "trainer.rollout_every=2", "network.width=16", "timing=false"]
NOT_COMPARED = {"seconds", "seconds_per_test_trajectory", "peak_memory_gib", "versions"}


def numbers(data, place=""):
    """Every entry by where it stands."""
    if isinstance(data, dict):
        return {k: v for key, value in data.items() for k, v in numbers(value, f"{place}/{key}").items()}
    if isinstance(data, list):
        return {k: v for index, value in enumerate(data) for k, v in numbers(value, f"{place}/{index}").items()}
    return {place: data}


def argument_lists():
    """Arguments of the run of each experiment, in a folder of its name."""
    common = ["mesh.divisions=[4,2,2]", "data.steps=8", "hydra/job_logging=none", "hydra/hydra_logging=none"]
    for experiment, own in SMALL.items():
        learning = [] if experiment == "marker_ablation" else LEARNING
        yield [f"experiment={experiment}", *own, *learning, *common, f"hydra.run.dir={experiment}"]


def make_runs():
    """Makes all runs in the working directory, without their reports."""
    with without_reports():
        for arguments in argument_lists():
            code, err = run(*arguments)
            assert (code, err[-900:] if code else "") == (0, "")


def measured(folder):
    """metrics.json of a run, without what may differ."""
    results = json.loads((folder / "metrics.json").read_text())
    return numbers({key: value for key, value in results.items() if key not in NOT_COMPARED})


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """Folders of the runs in this process and in another one, of two threads and another order of sets."""
    here, there = (tmp_path_factory.mktemp(name) for name in ("here", "there"))
    with contextlib.chdir(here):
        make_runs()
    paths = os.pathsep.join([str(TESTS), str(TESTS / "experiment"), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONHASHSEED": "2", "OMP_NUM_THREADS": "2", "PYTHONPATH": paths}
    command = [sys.executable, "-c", f"import {Path(__file__).stem} as runs; runs.make_runs()"]
    subprocess.run(command, cwd=there, env=environment, check=True, capture_output=True, timeout=300)
    return here, there


@pytest.mark.slow
@pytest.mark.parametrize("experiment", SMALL)
def test_the_same_seed_gives_the_same_numbers(places, experiment):
    first, second = (measured(folder / experiment) for folder in places)
    assert sum(isinstance(value, float) for value in first.values()) >= 14
    assert second.keys() == first.keys()
    for key, value in first.items():
        wanted = pytest.approx(value, rel=1e-6, abs=0.0) if isinstance(value, float) else value
        assert second[key] == wanted, key
