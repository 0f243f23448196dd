"""The second experiment through its command line: a small beam, a few steps and a few epochs."""

import contextlib
import json
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.configured import settings
from warp_resphys import box_hexahedra, cli
from warp_resphys.experiment.trials import split_of, trials_of
from warp_resphys.io.files import read_hdf5
from warp_resphys.learning.baselines import BASELINES

ANGLES = {"train": (40, 80, 120, 160), "validation": (100,), "test": (60, 140)}  # degrees
TINY = [
    "experiment=beam_twist",
    "mesh.divisions=[4,2,2]",
    "data.steps=12",
    *(f"data.angles_deg.{split}={list(angles)}".replace(" ", "") for split, angles in ANGLES.items()),
    "trainer.epochs=40",
    "trainer.rollout_every=10",
    "network.width=32",
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
    "hydra.run.dir=run",
]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    root = tmp_path_factory.mktemp("twist")
    with contextlib.chdir(root), pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["warp-resphys", *TINY])
        cli.main()
    return root / "run"


def test_files_and_metrics(finished):
    results = json.loads((finished / "metrics.json").read_text())
    assert [trial["name"] for trial in results["per_trajectory"]] == ["60°", "140°"]
    assert results["errors_mm"].keys() == {*BASELINES, "simulation", "reconstruction", "resphys", "simfree"}
    assert all(summary["trajectories"] == 2 for summary in results["errors_mm"].values())
    expected = {"dataset.h5", "reconstruction_resphys.h5", "resphys.safetensors", "simfree.safetensors", "rollouts.h5"}
    assert expected | {"errors.json", "times.json", "report.html"} <= {path.name for path in finished.iterdir()}
    page = (finished / "report.html").read_text()
    assert "Twisting beam" in page
    assert "4.362" in page  # published, beside ours


def test_the_correction_corrects(finished):
    results = json.loads((finished / "metrics.json").read_text())["errors_mm"]
    assert results["simulation"]["mean"] > 0.1
    assert results["resphys"]["mean"] < 0.1 * results["simulation"]["mean"]
    assert results["reconstruction"]["mean"] < 1e-3
    assert all(results[model]["diverged"] == 0 for model in ("simulation", "resphys", "reconstruction"))


def test_the_beam_is_let_go_from_cross_sections_turned_rigidly_by_the_configured_angles(finished):
    rest = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2)).vertices
    with read_hdf5(finished / "dataset.h5", "dataset") as file:
        names, q, v = list(file.attrs["names"]), file["observed"][:], file["velocity"][:]
    angles = [angle for split in ANGLES.values() for angle in split]
    assert names == [f"{angle}°" for angle in angles]
    assert not v[:, 0].any()
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


@pytest.mark.parametrize(
    ("limit", "picked"), [(1, [10]), (2, [10, 50]), (3, [10, 30, 50]), (5, [10, 20, 30, 40, 50]), (9, 5 * [0])]
)
def test_limits(limit, picked):
    row = [10, 20, 30, 40, 50]
    angles = f"data.angles_deg={{train: {row}, validation: [60], test: [70]}}"
    split = split_of(
        settings("experiment=beam_twist", angles, f"data.limit={{train: {limit}, validation: 1, test: 1}}")
    )
    assert split.train == tuple(f"{angle}°" for angle in (picked if limit <= len(row) else row))
