"""Parts of work, which are kept whatever fails or is interrupted:
folds of a cross-validation, trials of a stage.
"""

import json
import os
from functools import partial
from pathlib import Path

import pytest

from warp_resphys.experiment import folds as module
from warp_resphys.experiment.folds import Fold, run_folds, workers_for
from warp_resphys.io.errors import ConvergenceError, InputError
from warp_resphys.io.fan_out import WorkerError, Workers
from warp_resphys.io.resuming import Stage, StageInterrupted
from warp_resphys.settings.run_keys import ParallelSettings


def write(context):
    """Notes the process and the number of the run, or fails as configured."""
    if context.settings["fails"]:
        raise ConvergenceError("the simulation fails.", None, None)
    path = context.run_dir / f"{context.name}.json"
    path.write_text(json.dumps({"process": os.getpid(), "name": context.settings["name"]}))


def stages(name, fails, workers):
    del workers
    first = Stage("first", write, ("first.json",), {"name": name, "fails": False})
    return [
        first,
        Stage("second", write, ("second.json",), {"name": name, "fails": fails}, ("first",)),
    ]


def made(folder, names="abcd", fails=""):
    return {n: Fold(n, Path(folder) / f"fold_{n}", partial(stages, n, n in fails)) for n in names}


def written(folder, name="second"):
    return {
        path.parent.name[-1]: json.loads(path.read_text())
        for path in Path(folder).glob(f"fold_*/{name}.json")
    }


@pytest.mark.parametrize("processes", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_every_fold_is_run_once(tmp_path, processes):
    run_folds(made(tmp_path), Workers(processes))
    results = written(tmp_path)
    assert {name: fold["name"] for name, fold in results.items()} == dict(
        zip("abcd", "abcd", strict=True)
    )
    others = {fold["process"] for fold in results.values()} - {os.getpid()}
    # One may do all while the other one still starts.
    assert len(others) in ((1, 2) if processes > 1 else (0,))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")}
    run_folds(made(tmp_path), Workers(processes))
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")} == before


def test_a_fold_that_fails_or_is_interrupted_is_named_and_what_is_done_is_kept(
    tmp_path, monkeypatch
):
    """The workers are replaced by this process."""

    def one_after_another(function, tasks, workers, folder, finished):
        for number, task in enumerate(tasks):
            function(task)
            finished(number)

    def interrupted(function, tasks, workers, folder, finished):
        function(tasks[0])
        finished(0)
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "fan_out", one_after_another)
    with pytest.raises(WorkerError, match=r"^fold b: the simulation fails"):
        run_folds(made(tmp_path, fails="b"), Workers(2))
    assert (written(tmp_path).keys(), written(tmp_path, "first").keys()) == ({"a"}, {"a", "b"})
    first = (tmp_path / "fold_b" / "first.json").stat().st_mtime_ns
    monkeypatch.setattr(module, "fan_out", interrupted)
    with pytest.raises(
        StageInterrupted, match=r"^interrupted before the folds c, d ended; .* the same command"
    ):
        run_folds(made(tmp_path), Workers(2))
    assert written(tmp_path).keys() == {"a", "b"}
    assert (tmp_path / "fold_b" / "first.json").stat().st_mtime_ns == first


def test_workers_of_clusters_are_counted():
    assert workers_for(ParallelSettings(), 3, "cpu") == Workers(3, None)
    assert workers_for(ParallelSettings(), None, "cpu").count >= 1
    with pytest.raises(InputError, match="workers of the Dask cluster"):
        workers_for(ParallelSettings(address="tcp://head:8786"), None, "cpu")
