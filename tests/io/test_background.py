"""A stage in a second process: its outputs, log and memory, failures and interruptions."""

import logging
import os
import signal
import time

import pytest

from warp_resphys.io.background import BackgroundProcess
from warp_resphys.io.errors import InputError
from warp_resphys.io.fan_out import WorkerError, WorkerFaultError
from warp_resphys.io.files import read_json, write_json
from warp_resphys.io.memory import peak_memory_gib
from warp_resphys.io.progress import Progress
from warp_resphys.io.stages import Stage, StageInterrupted, run_stages

log = logging.getLogger(__name__)
ORDER = ["generate", "reconstruct", "train", "evaluate"]


def wait_until(condition, seconds=100.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def work(context):
    write_json(context.run_dir / f"{context.name}.json", {"process": os.getpid(), **context.settings})


def while_training(context):
    """The stage that runs here: it waits until training has begun, and does as its settings say."""
    wait_until((context.run_dir / "begun").exists)
    if context.settings.get("fails"):
        raise InputError("no forces")
    if context.settings.get("interrupted"):
        raise KeyboardInterrupt
    if context.settings.get("waits"):
        wait_until((context.run_dir / "train.json").exists)
    work(context)


def training(context):
    """The stage in the second process: it does as its settings say, and goes on from its checkpoint."""
    (context.run_dir / "begun").touch()
    log.warning("a warning with 100 %")
    with Progress("training", 3, "epochs") as progress:
        progress.advance(3)
    match context.settings["does"]:
        case "fails":
            raise InputError("no samples")
        case "errs":
            raise ZeroDivisionError
        case "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        case "is long" if not (context.run_dir / "checkpoint").exists():
            try:
                Destroyed()
                wait_until(lambda: False)
            finally:
                (context.run_dir / "checkpoint").touch()
    work(context)


class Destroyed:
    """An object into whose destructor the first interruption falls, where it is lost."""

    def __del__(self):
        wait_until(lambda: False)


def is_worth_it(context):
    return context.settings.get("worth", True)


@pytest.fixture
def run(tmp_path):
    """Runs the stages, training beside reconstruction, and returns the number of the process of each."""

    def run_with(background=True, reconstruct=None, **train):
        settings = {"generate": {}, "reconstruct": reconstruct or {}, "train": {"does": "ends", **train}}
        stages = [
            Stage("generate", work, ("generate.json",), {}),
            Stage("reconstruct", while_training, ("reconstruct.json",), settings["reconstruct"], ("generate",)),
            Stage("train", training, ("train.json",), settings["train"], ("generate",), is_worth_it),
            Stage("evaluate", work, ("evaluate.json",), {}, ("reconstruct", "train")),
        ]
        (tmp_path / "begun").unlink(missing_ok=True)
        if not background or not train.get("worth", True):
            (tmp_path / "begun").touch()
        seconds = run_stages(stages, tmp_path, background=BackgroundProcess() if background else None)
        assert [*seconds] == ORDER
        assert not [*tmp_path.glob(".background_*")]
        return {name: read_json(tmp_path / f"{name}.json")["process"] for name in ORDER}

    return run_with


def finished(tmp_path):
    return {path.stem for path in (tmp_path / "stages").glob("*.json") if ".interrupted" not in path.name}


def test_it_runs_at_the_same_time_and_its_lines_are_repeated(run, tmp_path, caplog, capsys):
    """Reconstruction waits for the output of training. A repetition runs nothing, another setting training alone."""
    caplog.set_level(logging.INFO)
    own = os.getpid()
    processes = run(reconstruct={"waits": True})
    assert processes["train"] != own
    assert {processes[name] for name in ORDER if name != "train"} == {own}
    lines = [(record.levelname, record.getMessage()) for record in caplog.records]
    assert lines.count(("WARNING", "a warning with 100 %")) == 1
    assert lines.count(("INFO", "train: started")) == 1
    assert sum(text.startswith("train: done in ") for _, text in lines) == 1
    assert "training: 3/3 epochs" in capsys.readouterr().err
    record = read_json(tmp_path / "stages" / "train.json")
    assert record["peak_memory_gib"] > peak_memory_gib()  # of both processes
    assert run(reconstruct={"waits": True}) == processes
    assert run(reconstruct={"waits": True}, seed=1)["train"] == own  # Nothing else has to run.


@pytest.mark.parametrize("how", [{"background": False}, {"worth": False}])
def test_without_a_second_process_it_runs_here(run, how):
    assert set(run(**how).values()) == {os.getpid()}


@pytest.mark.parametrize(
    ("does", "error", "message"),
    [
        ("fails", WorkerError, r"^train: no samples$"),
        ("errs", WorkerFaultError, "train failed in its process:\n(.|\n)*ZeroDivisionError"),
        ("dies", WorkerError, r"^train: its process was killed, .* with parallel.background=false\.$"),
    ],
)
def test_a_failure_ends_the_run_and_keeps_the_other_stages(run, tmp_path, does, error, message):
    with pytest.raises(error, match=message):
        run(does=does)
    assert finished(tmp_path) == {"generate", "reconstruct"}
    kept = read_json(tmp_path / "reconstruct.json")
    run()
    assert read_json(tmp_path / "reconstruct.json") == kept


def test_ctrl_c_interrupts_both_and_both_resume(run, tmp_path):
    """Training writes its checkpoint, from which it goes on; the message names both stages."""
    with pytest.raises(
        StageInterrupted,
        match=r"^interrupted in stages 'reconstruct' and 'train' \(finished and kept: generate; checkpoints of "
        r"'reconstruct' and 'train' are kept\); the same command resumes there$",
    ):
        run(reconstruct={"interrupted": True}, does="is long")
    assert (tmp_path / "checkpoint").exists()
    assert finished(tmp_path) == {"generate"}
    interrupted = read_json(tmp_path / "stages" / "train.interrupted.json")
    assert run(does="is long")["train"] != os.getpid()
    assert read_json(tmp_path / "stages" / "train.json")["seconds"] > interrupted["seconds"]


def test_a_failure_here_interrupts_it(run, tmp_path):
    with pytest.raises(InputError, match=r"^no forces$"):
        run(reconstruct={"fails": True}, does="is long")
    assert (tmp_path / "checkpoint").exists()
    assert finished(tmp_path) == {"generate"}


def test_ctrl_c_while_it_is_waited_for(run, tmp_path, monkeypatch):
    """Reconstruction is finished and kept."""
    result = BackgroundProcess.result

    def interrupted(self):
        monkeypatch.setattr(BackgroundProcess, "result", result)
        raise KeyboardInterrupt

    monkeypatch.setattr(BackgroundProcess, "result", interrupted)
    with pytest.raises(StageInterrupted, match=r"^interrupted in stage 'train' \(finished and kept: generate, recon"):
        run(does="is long")
    assert (tmp_path / "checkpoint").exists()
    assert finished(tmp_path) == {"generate", "reconstruct"}
