"""Limbs that swim, seen by one camera: whatever carries them off, what pulls them is identified, and corrected."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from support.configured import check, composed, settings
from support.main_job import IN_RUN, run
from support.played_run import check_robots
from warp_resphys.data.marker_view import MarkerView
from warp_resphys.experiment.build import bound_markers, build_simulator
from warp_resphys.experiment.files import read_dataset
from warp_resphys.io.errors import InputError
from warp_resphys.stepping.inputs import Inputs

FACTOR = 1.3  # true over commanded contraction of the winch
STEPS = 16
TINY = [
    "experiment=starfish_limb",
    *("mesh.layers=6", "mesh.nodes=20", "fixed.z=[-0.03,0.03]", "tendons.routes.limbs.pieces=3"),
    *("data.folder=recordings", f"data.steps={STEPS}", "data.train_fraction=1.0", "data.rest_seconds=0.05"),
    *("identify.max_evaluations=6", "~identify.parameters"),
    "+identify.parameters={tendon_contraction_factor: {lower: 0.3, upper: 3.0, logarithmic: true}}",
    "identify.first_guess={}",
    *("trainer={epochs:4,rollout_every:2,batch_size:16}", "network={width:8}", "in_the_loop.epochs=1"),
    *("reconstruction.max_iterations=2", "parallel.processes=1"),
    *("hydra/job_logging=none", "hydra/hydra_logging=none", IN_RUN),
]
# where the markers of the second trial sit, with names of their own
ELSEWHERE = ([0.0, -0.0070, -0.060], [0.0, -0.0120, -0.036], [0.0, -0.0125, 0.040], [0.0, -0.0065, 0.057])
LATE = {"slow": 0, "fast": 2}  # frames that the winch's log is behind the camera
TRIALS = [
    "data.trials=null",
    "+data.trials={slow: {file: slow.csv, labels: [M1, M2, M3, M4]}, "
    "fast: {file: fast.csv, input_delay: -0.0333333333, labels: [N1, N2, N3, N4]}}",
    *(f"+markers.tracked.N{number}={place}" for number, place in enumerate(ELSEWHERE, 1)),
]
SPLIT = ["data.train=[slow]", "data.test=[fast]"]
NOISE = 0.02  # mm
HIDDEN = {"slow": [0], "fast": []}  # frames in which the second marker is, and with it the shape
PERIODS = {"slow": 16.0, "fast": 9.0}  # steps


def tracked(run, trial):
    """The places of the markers that a trial has, by name."""
    return {label: run.markers.tracked[label] for label in run.data.trials[trial].labels}


@pytest.fixture(scope="module")
def swum():
    """Commands (T,) of the winch and markers (T, 4, 3) in the frame of the body, by trial, both [m]."""
    run = settings(*TINY, *TRIALS, *SPLIT)
    simulator = build_simulator(run, run.simulation)
    markers = run.markers
    motions = {}
    for name, period in PERIODS.items():
        read = bound_markers(markers, simulator.body.mesh, [*tracked(run, name).values()], tuple(tracked(run, name)))
        steps = np.arange(STEPS + 4)
        commanded = 0.008 * np.sin(np.pi * np.clip(steps - 3, 0, None) / period) ** 2
        pulled = torch.as_tensor(FACTOR * commanded[1:, None, None])
        with torch.no_grad():
            motion = simulator.rollout(simulator.rest_state(), len(steps) - 1, Inputs(tendon_contraction=pulled))
        motions[name] = commanded, read(motion.q[:, 0]).numpy()
    return motions


def write(folder, motions):
    """Tables of a camera: two coordinates in mm of a body that drifts and turns, and a winch that is late to begin."""
    folder.mkdir()
    draw = np.random.default_rng(0)
    for name, (commanded, markers) in motions.items():
        frames = np.arange(len(commanded))
        angle, drift = 1.0 + 0.02 * frames, np.stack([0.3 - 0.002 * frames, 0.2 + 0.001 * frames], 1)
        x, y = markers[..., 0], -markers[..., 2]  # of the camera
        turned = np.exp(1j * angle)[:, None] * (x + 1j * y)
        turned = np.stack([turned.real, turned.imag], -1)
        seen = 1e3 * (turned + drift[:, None]) + NOISE * draw.normal(size=turned.shape)
        winch = np.where(frames < 2, np.nan, 1e3 * commanded[np.clip(frames - LATE[name], 0, None)])
        seen[HIDDEN[name], 1] = np.nan
        table = np.column_stack([1e3 * frames / 60.0, winch, seen.reshape(len(frames), -1)])
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header="as the camera has it", fmt="%.9f")


@pytest.mark.slow
def test_limbs_are_identified_by_their_shape(swum, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(Path("recordings"), swum)
    code, err = run(*TINY, *TRIALS, *SPLIT)
    assert (code, err[-500:] if code else "") == (0, "")
    wanted, dataset = settings(*TINY, *TRIALS, *SPLIT), read_dataset(Path("run/dataset.h5"))
    assert dataset.sets == ((4, 5, 6, 7), (0, 1, 2, 3))
    for name, (commanded, markers) in swum.items():
        pulled = dataset.inputs["tendon_contraction"][dataset.names.index(name), :, 0]
        np.testing.assert_allclose(pulled, commanded[1 : STEPS + 1], atol=1e-6)
        view = MarkerView.of([*tracked(wanted, name).values()], ["x", "z"], "own")
        shapes = view.of_arrays(markers[: STEPS + 1])
        columns = [dataset.labels.index(label) for label in tracked(wanted, name)]
        shapes[HIDDEN[name]] = np.nan
        np.testing.assert_allclose(dataset.observed[dataset.names.index(name)][:, columns], shapes, atol=3e-4)
        assert np.nanmax(np.abs(shapes - shapes[1])) > 3e-3
    factor = json.loads(Path("run/identification.json").read_text())["sysid"]["parameters"]["tendon_contraction_factor"]
    assert factor == pytest.approx(FACTOR, rel=0.03)
    metrics = json.loads(Path("run/metrics.json").read_text())
    errors = {name: summary["mean"] for name, summary in metrics["errors_mm"].items()}
    assert {label: value is None for label, value in metrics["per_marker"]["sysid"].items()} == dict.fromkeys(
        tracked(wanted, "fast"), False
    )
    drawn = {path.stem for path in Path("run/figures").glob("*.png")}
    assert {"markers", "motion"} <= drawn
    assert 3.0 * errors["sysid"] < errors["simulation"]
    assert errors["resphys"] < errors["sysid"] + 0.25 * NOISE  # nothing is left to learn
    check_robots("run")


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["markers.plane=[x,x]"], "markers.plane is .* twice"),
        (["data.trials.fast.labels=[N1,N2,N3,N4,M3]"], "'slow'"),
        (["data.trials.fast.labels=[N1,N2,N4]"], "markers.tracked"),
        (["data.axes=null"], "markers.plane"),
        (["data.base_motion=recorded"], "markers.frame"),
        (["identify.placement={markers: 0.001}"], "identify.placement"),
        (["markers.frame=body", "identify.placement={turn: 1.0}"], "identify.placement"),
        (["fixed.z=[0.02,-0.02]"], "fixed.z is .*two rising"),
        (["fixed.z=[0.2,0.3]"], r"no vertex lies within 1e-09 m of z = 0\.2 to 0\.3 m"),
    ],
)
def test_what_a_camera_cannot_tell_is_refused(overrides, said):
    with pytest.raises(InputError, match=said):
        check(composed(*TINY, *TRIALS, *SPLIT, *overrides))
