"""Folds of a cross-validation in several processes: each once, whatever fails or is interrupted."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from warp_resphys.experiment.folds import Fold, run_folds
from warp_resphys.io.errors import ConvergenceError
from warp_resphys.io.fan_out import WorkerError, Workers
from warp_resphys.io.stages import Stage, StageInterrupted


def write(context):
    """Notes the process and the number of the run; fails or waits as configured."""
    if context.settings["fails"]:
        raise ConvergenceError("the simulation fails.", None, None)
    time.sleep(context.settings["seconds"])
    path = context.run_dir / f"{context.name}.json"
    path.write_text(json.dumps({"process": os.getpid(), "name": context.settings["name"]}))


def stages(name, fails, seconds, workers):
    del workers
    settings = {"name": name, "fails": False, "seconds": seconds}
    first = Stage("first", write, ("first.json",), settings)
    return [first, Stage("second", write, ("second.json",), {**settings, "fails": fails}, ("first",))]


def folds(folder, names="abcd", fails="", seconds=0.0):
    return {n: Fold(n, Path(folder) / f"fold_{n}", partial(stages, n, n in fails, seconds)) for n in names}


def written(folder, name="second"):
    return {path.parent.name[-1]: json.loads(path.read_text()) for path in Path(folder).glob(f"fold_*/{name}.json")}


@pytest.mark.parametrize("processes", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_every_fold_is_run_once(tmp_path, processes):
    run_folds(folds(tmp_path), Workers(processes))
    results = written(tmp_path)
    assert {name: fold["name"] for name, fold in results.items()} == dict(zip("abcd", "abcd", strict=True))
    others = {fold["process"] for fold in results.values()} - {os.getpid()}
    assert len(others) in ((1, 2) if processes > 1 else (0,))  # One may do all while the other one still starts.
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")}
    run_folds(folds(tmp_path), Workers(processes))
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")} == before


def killed_once(context):
    mark = context.run_dir / "killed"
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    write(context)


def deadly(name, workers):
    first, second = stages(name, False, 0.0, workers)
    return [first, Stage("second", killed_once, second.outputs, second.settings, second.upstream)]


@pytest.mark.slow
def test_a_fold_whose_worker_is_killed_goes_on_in_another(tmp_path, caplog):
    run_folds({**folds(tmp_path, "abc"), "d": Fold("d", tmp_path / "fold_d", partial(deadly, "d"))}, Workers(2))
    assert written(tmp_path).keys() == set("abcd")
    assert written(tmp_path, "first")["d"]["process"] != written(tmp_path)["d"]["process"]
    assert "a worker process was lost" in caplog.text


@pytest.mark.slow
def test_a_fold_that_fails_is_named_and_the_others_are_kept(tmp_path):
    with pytest.raises(WorkerError, match=r"^fold d: the simulation fails"):
        run_folds(folds(tmp_path, fails="d"), Workers(2))
    assert "d" not in written(tmp_path)
    before = written(tmp_path)
    assert "d" in (first := written(tmp_path, "first"))
    run_folds(folds(tmp_path), Workers(1))
    assert written(tmp_path).items() >= before.items()
    assert written(tmp_path, "first").items() >= first.items()
    assert written(tmp_path).keys() == set("abcd")


@pytest.mark.slow
def test_ctrl_c_says_what_was_on_and_the_rest_is_kept(tmp_path, monkeypatch):
    program = f"""if __name__ == "__main__":
    import signal
    signal.signal(signal.SIGINT, signal.default_int_handler)  # Who runs the tests may ignore it.
    from test_folds import Workers, folds, run_folds
    run_folds(folds({str(tmp_path)!r}, "abcd", seconds=1.0), Workers(2))
"""
    script = tmp_path / "program.py"
    script.write_text(program)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    process = subprocess.Popen([sys.executable, str(script)], stderr=subprocess.PIPE, text=True, env=environment)
    start = time.monotonic()
    while (
        not [*tmp_path.glob("fold_*/stages/first.json")] and process.poll() is None and time.monotonic() - start < 300.0
    ):
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=200.0)
    assert process.returncode != 0
    assert f"{StageInterrupted.__name__}: interrupted before the folds " in said
    assert "the same command resumes there" in said
    done = {path.parents[1].name[-1] for path in tmp_path.glob("fold_*/stages/first.json")}
    kept = {name: fold["process"] for name, fold in written(tmp_path, "first").items() if name in done}
    assert kept
    monkeypatch.setattr(time, "sleep", lambda _: None)
    run_folds(folds(tmp_path, "abcd", seconds=1.0), Workers(1))
    after = written(tmp_path, "first")
    assert {name: after[name]["process"] for name in kept} == kept
    assert written(tmp_path).keys() == set("abcd")
