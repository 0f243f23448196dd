"""A small main job by its command line: its settings, and the files of its run folder."""

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest

from support.command_line import outcome
from warp_resphys import pipeline
from warp_resphys.experiment import split_stages

REPOSITORY = Path(__file__).parents[2]
STAGES = [
    "simulate",
    "reconstruct_resphys",
    "train_resphys",
    "train_simfree",
    "evaluate",
    "time",
    "report",
]
LEARNED = ["train_resphys", "train_simfree", "evaluate", "time", "report"]
CORRECTED = ["reconstruct_resphys", "train_resphys", "evaluate", "time", "report"]
MODELS = ("simulation", "resphys", "reconstruction")
SMALL = ["mesh.divisions=[4,2,2]"]
SHORT = [  # without the law and the loads of another kind
    "~law",
    "~data.others",
    "timing=true",
    "data.steps=12",
    "data.weights_g.train=[50,90,130]",
    "data.weights_g.validation=[110]",
    "data.weights_g.test=[70,150]",
    "trainer.epochs=40",
    "trainer.rollout_every=10",
    "network.width=32",
]
TINY = [*SMALL, *SHORT]
IN_RUN = "hydra.run.dir=run"
DRIVEN = [  # a driven robot with a laboratory, in seconds
    *("data.sequences=5", "data.train=3", "data.validation=1", "data.test=1", "data.horizons=[]"),
    "data.rest_seconds=0.01",
    "data.cutoff=20.0",
    "parallel={processes:1,batch:3}",
    "timing=false",
    *("laboratory.sequences.rest=0.01", "laboratory.sequences.correlation_time=0.06"),
    "identify.trials=1",
    "identify.seconds=0.1",
    "identify.max_evaluations=3",
    "trainer={epochs:4,rollout_every:2,gate:false}",
    *("network={position_modes:2,velocity_modes:2,force_modes:2,width:8}", "trainer.batch_size=16"),
    "actuation.filter_time_constants=[0.1]",
]
ROD = ["mesh.layers=3", "mesh.nodes=20", "laboratory.mesh.layers=4", "laboratory.mesh.nodes=20"]
QUIET = ("hydra/job_logging=none", "hydra/hydra_logging=none")


@contextlib.contextmanager
def without_reports():
    """Replaces reports, which take most of a tiny run's time and have tests of their own."""
    places = {"make_report": split_stages, "make_folds_report": pipeline}
    with pytest.MonkeyPatch.context() as patch:
        for name, place in places.items():
            patch.setattr(
                place, name, lambda context: (context.run_dir / "report.html").write_text("-")
            )
        yield


def run(*arguments):
    """Runs the command without a log in this process; returns exit code and stderr."""
    return outcome(*arguments, *QUIET)[::2]


def finish(*arguments):
    """Runs the command in the folder `run`, which it returns."""
    code, err = run(*arguments, IN_RUN)
    assert (code, err[-900:] if code else "") == (0, "")
    return Path("run")


def run_without_report(place, *arguments):
    """Runs a command without its report, and returns its run folder."""
    with without_reports(), contextlib.chdir(place):
        return place / finish(*arguments)


def metrics(folder="run"):
    return json.loads((Path(folder) / "metrics.json").read_text())


def means(folder="run"):
    """Mean errors of all models [mm]."""
    return {model: summary["mean"] for model, summary in metrics(folder)["errors_mm"].items()}


def errors(folder="run"):
    """All errors of a run as one list [mm]."""
    content = metrics(folder)
    groups = [content["errors_mm"], content["errors_vs_reconstruction_mm"]]
    values = [
        group[model][key] for group in groups for model in sorted(group) for key in ("mean", "std")
    ]
    return values + [
        trial["errors_mm"][model] for trial in content["per_trajectory"] for model in MODELS
    ]


def same_errors(a, b):
    np.testing.assert_allclose(a, b, rtol=1e-6)


def files(folder="run"):
    """Times and contents of all files in the run folder, except Hydra's, by name."""
    root = Path(folder)
    paths = [
        p for p in root.rglob("*") if p.is_file() and ".hydra" not in p.parts and p.name != ".lock"
    ]
    return {str(p.relative_to(root)): (p.stat().st_mtime_ns, p.read_bytes()) for p in paths}
