"""The main job with a network that is trained in a second process."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from support.configured import settings
from support.main_job import IN_RUN, TINY, errors, metrics, ran, run
from support.main_job import files as files_of
from warp_resphys import pipeline
from warp_resphys.experiment import learn
from warp_resphys.experiment.models import kind_of
from warp_resphys.io.background import BackgroundProcess
from warp_resphys.io.files import read_checkpoint
from warp_resphys.io.machine import available_cores
from warp_resphys.pipeline import background_of

LONG = "simfree.trainer.epochs=1000000"


def lines(folder):
    """Files with the lines of a second process."""
    return Path(folder).glob(".background_*/lines")


@pytest.fixture
def started(monkeypatch):
    """Two free cores and no training that is too short; the names of the stages that start in a second process."""
    names, start = [], BackgroundProcess.start

    def recorded(self, stage, context):
        names.append(stage.name)
        start(self, stage, context)

    monkeypatch.setattr(BackgroundProcess, "start", recorded)
    monkeypatch.setattr(pipeline, "available_cores", lambda: 2)
    monkeypatch.setattr(learn, "_LEAST_SAMPLES", 0)
    return names


@pytest.mark.usefixtures("no_report")
@pytest.mark.skipif(torch.cuda.is_available(), reason="networks are trained on the GPU, one after the other")
def test_the_same_networks_and_errors_as_in_turn(finished, folder, started):
    """A changed setting of the force trains it alone, with nothing beside it."""
    assert run(*TINY, IN_RUN)[0] == 0
    assert started == ["train_simfree"]
    np.testing.assert_array_equal(errors(), errors(finished[0]))
    assert [*metrics()["seconds"]] == [*metrics(finished[0])["seconds"]]
    for model in ("simfree", "resphys"):
        places = (Path("run"), finished[0])
        own, expected = (read_checkpoint(place / f"{model}.safetensors", kind_of(model)[1])[0] for place in places)
        assert own.keys() == expected.keys()
        assert all(torch.equal(own[name], expected[name]) for name in own)
    before = files_of()
    assert run(*TINY, IN_RUN, "trainer.epochs=20", "simfree.trainer.epochs=40")[0] == 0
    assert "train_simfree" not in ran(before)
    assert started == ["train_simfree"]


@pytest.mark.usefixtures("no_report")
def test_a_failure_is_one_sentence_and_keeps_the_reconstruction(folder, started):
    code, err = run(*TINY, IN_RUN, "device=cpu", "simfree.network.position_modes=500")
    assert started == ["train_simfree"]
    assert code == 2
    (sentence,) = [line for line in err.splitlines() if line.startswith("error: ")]
    assert sentence.startswith("error: train_simfree: 500 modes were asked for")
    assert "Traceback" not in err
    before = files_of()
    assert "stages/reconstruct_resphys.json" in before
    assert run(*TINY, IN_RUN, "device=cpu")[0] == 0
    assert "reconstruct_resphys" not in ran(before)


def second_process_has_started():
    return any("started" in path.read_text() for path in lines("run"))


def check_both_ended(code, err):
    assert code == 130, err
    assert "'train_simfree'" in err
    assert "Traceback" not in err, err
    assert json.loads(Path("run/stages/train_simfree.interrupted.json").read_text())["seconds"] > 0.0
    assert not [*Path("run").glob(".background_*")]


@pytest.mark.skipif(available_cores() < 2, reason="a second process needs a second core")
def test_an_interruption_of_a_real_process_ends_both(folder):
    program = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    program += "from warp_resphys.cli import main\nmain()"
    command = [sys.executable, "-c", program, *TINY, IN_RUN, "device=cpu", LONG]
    child = subprocess.Popen(command, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    while child.poll() is None and not second_process_has_started():
        time.sleep(0.05)
    child.send_signal(signal.SIGINT)
    err = child.communicate(timeout=100)[1]
    check_both_ended(child.returncode, err)


def test_the_end_that_a_cluster_asks_for_ends_both(folder, started):
    ended = threading.Event()

    def end():
        while not ended.wait(0.05):
            if second_process_has_started():
                os.kill(os.getpid(), signal.SIGTERM)
                return

    thread = threading.Thread(target=end)
    thread.start()
    try:
        code, err = run(*TINY, IN_RUN, "device=cpu", LONG)
    finally:
        ended.set()
        thread.join()
    check_both_ended(code, err)


def test_where_there_is_none(monkeypatch):
    """Workers that use all cores leave none free; a short training is not worth a process."""
    monkeypatch.setattr(pipeline, "available_cores", lambda: 2)
    own = settings()
    assert (background_of(own) is None) == torch.cuda.is_available()
    assert background_of(settings("parallel.background=false")) is None
    assert background_of(settings("parallel.processes=2")) is None
    monkeypatch.setattr(pipeline, "available_cores", lambda: 1)
    assert background_of(own) is None
