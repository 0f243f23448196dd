"""All checks of `warp-resphys check`, and experiments that finish on a GPU."""

import pytest

from support.command_line import outcome

SMALL = ["budget=quick", "trainer.epochs=1", "timing=false", "mesh_check=null"]
SMALL += ["data.limit={train: 2, validation: 1, test: 1}"]
SHORT = {
    "beam_oscillation": ["data.steps=20"],
    "beam_synthetic": ["data.seconds=0.3", "identify.max_evaluations=2"],
    "tendon_rod": [
        "data.steps=60",
        "data.horizons=[0.3, 0.6]",
        "identify.seconds=0.3",
        "identify.max_evaluations=2",
    ],
}


@pytest.mark.release
def test_every_check_passes(device, folder):
    ended = outcome("check", f"device={device}")
    assert ended.code == 0, ended.out + ended.err


@pytest.mark.parametrize("experiment", SHORT)
def test_an_experiment_finishes_on_a_gpu(experiment, device, folder):
    """Every stage once, on few trials; other tests run them on a CPU."""
    if device == "cpu":
        pytest.skip("other tests run experiments on a CPU: --device cuda")
    run = [
        f"experiment={experiment}",
        *SMALL,
        *SHORT[experiment],
        f"device={device}",
        "hydra.run.dir=run",
    ]
    ended = outcome("run", *run)
    assert ended.code == 0, ended.err
    assert (folder / "run" / "report.html").is_file()
