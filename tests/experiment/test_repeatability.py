"""The same settings and seed in two processes give the same metrics.json, but for times, memory and versions."""

import json
import os
import subprocess
import sys

import pytest

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
    "marker_ablation": ["ablation.counts=[1,4]", "ablation.draws=3"],
}
LEARNING = ["trainer.epochs=6", "trainer.rollout_every=2", "network.width=16"]
NOT_COMPARED = {"seconds", "seconds_per_test_trajectory", "peak_memory_gib", "versions"}


def numbers(data, place=""):
    """Every entry by where it stands."""
    if isinstance(data, dict):
        return {k: v for key, value in data.items() for k, v in numbers(value, f"{place}/{key}").items()}
    if isinstance(data, list):
        return {k: v for index, value in enumerate(data) for k, v in numbers(value, f"{place}/{index}").items()}
    return {place: data}


def measured(folder, experiment, threads):
    """metrics.json of a run in a process of its own, without what may differ."""
    learning = [] if experiment == "marker_ablation" else LEARNING
    command = [sys.executable, "-m", "warp_resphys.cli", f"experiment={experiment}", *SMALL[experiment], *learning]
    command += ["mesh.divisions=[4,2,2]", "data.steps=8", "hydra/job_logging=none", "hydra/hydra_logging=none"]
    environment = {**os.environ, "PYTHONHASHSEED": str(threads), "OMP_NUM_THREADS": str(threads)}
    folder.mkdir()
    subprocess.run(
        [*command, "hydra.run.dir=run"], cwd=folder, env=environment, check=True, capture_output=True, timeout=300
    )
    results = json.loads((folder / "run" / "metrics.json").read_text())
    return numbers({key: value for key, value in results.items() if key not in NOT_COMPARED})


@pytest.mark.parametrize("experiment", SMALL)
def test_the_same_seed_gives_the_same_numbers(tmp_path, experiment):
    first, second = (measured(tmp_path / str(threads), experiment, threads) for threads in (1, 2))
    assert sum(isinstance(value, float) for value in first.values()) >= 14
    assert second.keys() == first.keys()
    for key, value in first.items():
        wanted = pytest.approx(value, rel=1e-6, abs=0.0) if isinstance(value, float) else value
        assert second[key] == wanted, key
