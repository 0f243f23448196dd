"""Experiments with recordings that others have published,
read from the files as their owners left them.
"""

import numpy as np
import pytest
from scipy.signal import lfilter

from support.configured import settings
from warp_resphys.core.mesh.chambers import find_chambers
from warp_resphys.data.recordings.processing import valve_opening
from warp_resphys.data.trials import Trials
from warp_resphys.experiment.build import build_body
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


def test_each_chamber_of_the_real_arm_bends_it_away_from_its_side(imported):
    """Columns of pressures belong to the chambers, and recorded axes to those of the body,
    as the experiment says.
    """
    run, trials = imported("sopra_real")
    mesh = build_body(run).mesh
    seen = np.isfinite(trials.observed[:, 1:, 0]).all(-1)
    tips = trials.observed[:, 1:, 0][seen]  # (F, 3)
    assert tips.mean(0)[2] == pytest.approx(-0.25, abs=0.02)
    held = [
        lfilter([0.3], [1.0, -0.7], trials.inputs["pressure"], axis=1)[seen],
        np.ones((len(tips), 1)),
    ]
    bends = np.linalg.lstsq(np.concatenate(held, 1), tips[:, :2], rcond=None)[0]
    for chamber, bend in zip(find_chambers(mesh), bends, strict=False):
        side = (mesh.vertices[np.unique(chamber.faces)].mean(0) - mesh.vertices.mean(0))[:2]
        assert -bend @ side > 0.8 * np.linalg.norm(bend) * np.linalg.norm(side)
