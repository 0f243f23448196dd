"""The second experiment: a beam that is let go from a twisted pose, and the trials that a budget picks."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.configured import settings
from warp_resphys import box_hexahedra
from warp_resphys.experiment.files import read_dataset
from warp_resphys.experiment.simulate import simulate
from warp_resphys.experiment.trials import split_of, trials_of
from warp_resphys.io.stages import StageContext
from warp_resphys.pipeline import acquisition_stages

ANGLES = {"train": (40, 80, 120, 160), "validation": (100,), "test": (60, 140)}  # degrees
TINY = [
    "experiment=beam_twist",
    "mesh.divisions=[4,2,2]",
    "data.steps=12",
    *(f"data.angles_deg.{split}={list(angles)}".replace(" ", "") for split, angles in ANGLES.items()),
]


def test_the_beam_is_let_go_from_cross_sections_turned_rigidly_by_the_configured_angles(tmp_path):
    rest = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2)).vertices
    (stage,) = acquisition_stages(settings(*TINY))
    simulate(StageContext("simulate", tmp_path, "fingerprint", stage.settings))
    dataset = read_dataset(Path(tmp_path) / "dataset.h5")
    q = dataset.observed
    angles = [angle for split in ANGLES.values() for angle in split]
    assert list(dataset.names) == [f"{angle}°" for angle in angles]
    assert not dataset.velocity[:, 0].any()
    centre = np.array([0.0, 0.015, 0.015])
    for angle, start in zip(angles, q[:, 0], strict=True):
        for x in np.unique(rest[:, 0]):
            section = rest[:, 0] == x
            turn = Rotation.from_rotvec([angle * x / 0.1, 0.0, 0.0], degrees=True)  # right-handed about x
            np.testing.assert_allclose(start[section], centre + turn.apply(rest[section] - centre), atol=1e-15)
    clamp = rest[:, 0] == 0.0
    np.testing.assert_array_equal(q[:, :, clamp], np.broadcast_to(rest[clamp], q[:, :, clamp].shape))
    assert np.abs(q[:, -1] - q[:, 0]).max((1, 2)).min() > 1e-3  # every beam swings back


@pytest.mark.parametrize(
    ("experiment", "unit", "factor"),
    [("beam_twist", "°", np.pi / 180.0), ("beam_oscillation", " g", 1e-3)],
)
def test_the_quick_budget_picks_evenly(experiment, unit, factor):
    runs = [settings(f"experiment={experiment}", f"budget={budget}") for budget in ("full", "quick")]
    full, quick = (run.data for run in runs)
    assert full.limit is None
    assert quick.amounts == full.amounts
    assert quick.steps < full.steps
    whole, split = map(split_of, runs)
    amounts = {trial.name: trial.amount for trial in trials_of(runs[1])}
    assert tuple(amounts) == split.names
    for name, limit in dict(quick.limit).items():
        row, picked = [f"{x:g}{unit}" for x in getattr(full.amounts, name)], list(getattr(split, name))
        assert list(getattr(whole, name)) == row
        places = [row.index(name) for name in picked]
        assert len(picked) == limit < len(row)
        if limit > 1:
            assert (places[0], places[-1]) == (0, len(row) - 1)
            assert np.ptp(np.diff(places)) <= 1  # strides differ by one at most
            assert np.diff(places).min() >= 1
        chosen = np.array([getattr(full.amounts, name)[place] for place in places])
        np.testing.assert_allclose([amounts[name] for name in picked], factor * chosen)
