"""The main job, interrupted and killed: what it keeps, and how it goes on."""

import signal
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from support.main_job import IN_RUN, TINY, errors, run, same_errors
from warp_resphys.experiment.parts import PartRollout
from warp_resphys.io.files import read_hdf5
from warp_resphys.learning.reconstruction import LBFGSB
from warp_resphys.learning.training import EpochTrainer


class Interruption:
    """Sends a signal to this process at a chosen step or epoch, and counts the work done."""

    def __init__(self, monkeypatch):
        self.at, self.signal = None, signal.SIGINT
        self.done = Counter()
        arrays, run_epoch = PartRollout.arrays, EpochTrainer.run_epoch

        def interrupted_arrays(rollout, report):
            def counted(**shown):
                report(**shown)
                self.count(type(rollout).__name__)

            return arrays(rollout, counted)

        def interrupted_epoch(trainer):
            record = run_epoch(trainer)
            self.count("epochs")
            return record

        monkeypatch.setattr(PartRollout, "arrays", interrupted_arrays)
        monkeypatch.setattr(EpochTrainer, "run_epoch", interrupted_epoch)

    def count(self, kind):
        self.done[kind] += 1
        if self.at == (kind, self.done[kind]):
            signal.raise_signal(self.signal)


@pytest.mark.slow
@pytest.mark.usefixtures("no_report")
class TestInterruption:
    @pytest.fixture
    def interruption(self, monkeypatch):
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        yield Interruption(monkeypatch)
        signal.signal(signal.SIGINT, before)

    def test_ctrl_c_in_every_stage(self, folder, interruption):
        """The last time by SIGTERM, with which clusters end a process."""
        arguments = [*TINY, "integrator=bdf2"]
        assert run(*arguments, "hydra.run.dir=whole")[0] == 0
        whole = Counter(interruption.done)
        assert whole == {"_FreeMotion": 13, "_OfTrials": 13, "epochs": 80, "ModelRollout": 39}
        interruption.done.clear()
        cuts = {"_FreeMotion": ("simulate", 1), "_OfTrials": ("reconstruct_resphys", 7)}
        cuts |= {"epochs": ("train_resphys", 25), "ModelRollout": ("evaluate", 18)}
        for kind, (stage, at) in cuts.items():
            interruption.at, interruption.signal = (kind, at), signal.SIGTERM if stage == "evaluate" else signal.SIGINT
            code, err = run(*arguments, IN_RUN)
            assert code == 130
            assert f"interrupted in stage '{stage}'" in err
            assert "the same command resumes there" in err
            assert "Traceback" not in err
            assert not Path("run/metrics.json").exists()
            assert not list(Path("run").rglob("*.partial"))
        interruption.at = None
        assert run(*arguments, IN_RUN)[0] == 0
        repeated = interruption.done - whole
        assert repeated.pop("epochs", 0) <= 1  # the epoch that the signal fell into
        assert repeated == {"_FreeMotion": 1, "_OfTrials": 7, "ModelRollout": 18 - 13}  # the first model is kept
        same_errors(errors(), errors("whole"))
        assert not list(Path("run").glob("*_parts"))
        assert not list(Path("run").glob("train_*.safetensors"))

    def test_each_frame_starts_from_the_force_of_the_one_before(self, folder, monkeypatch):
        guesses, step = [], LBFGSB.step

        def recorded(self, state, observed, inputs=None, first_guess=None):
            guesses.append(first_guess)
            return step(self, state, observed, inputs, first_guess)

        monkeypatch.setattr(LBFGSB, "step", recorded)
        arguments = [*TINY, IN_RUN, "reconstruction=lbfgsb", "data.steps=4"]
        assert run(*arguments)[0] == 0
        with read_hdf5("run/reconstruction_resphys.h5", "reconstruction") as file:
            np.testing.assert_array_equal(np.stack(guesses, axis=1), file["force"][:, :-1])
