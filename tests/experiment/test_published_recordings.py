"""Experiments with recordings that others have published, read from the files as their owners left them."""

import numpy as np
import pytest

from support.configured import settings
from warp_resphys.data.recordings.processing import valve_opening
from warp_resphys.data.trials import Trials
from warp_resphys.experiment.files import DATASET
from warp_resphys.experiment.recordings.reader import Reader
from warp_resphys.experiment.splits import all_trials
from warp_resphys.io.resuming import run_stages
from warp_resphys.pipeline import acquisition_stages


@pytest.fixture
def imported(shared_data, tmp_path):
    def read(name):
        run = settings(f"experiment={name}", f"data.folder={shared_data / name}")
        run_stages(acquisition_stages(run), tmp_path)
        return run, Trials.read(tmp_path / DATASET)

    return read


def test_the_segment_is_inflated_when_its_markers_say_so_and_emptied_again(imported, tmp_path):
    run, trials = imported("segment_sessions")
    reader = Reader(run, [*all_trials(run).values()], tmp_path)
    for trial, recording in zip(reader.trials, reader.read(reader.trials), strict=True):
        assert trial.onset == pytest.approx(valve_opening(recording, reader.tracked), abs=2e-3)
    travelled = 1e3 * np.linalg.norm(trials.observed - trials.held[:, None], axis=-1).mean(2)
    for row, name in enumerate(trials.names):
        pressed = trials.inputs["pressure"][row, :, 0] > 0.0
        largest = travelled[row].argmax()
        assert trials.inputs["pressure"][row].max() == 100.0 * float(name.removeprefix("mbar_"))
        assert pressed[largest - 1]
        assert not pressed[-100:].any()
        assert travelled[row, -100:].max() < 0.1 * travelled[row].max()
    assert travelled.shape[1] == 600  # all frames
