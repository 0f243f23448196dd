"""A small experiment with pressures through its command line: its stages, its files and what it refuses.

The report has tests of its own.
"""

import contextlib
import dataclasses
import json
import re
import shutil
from functools import partial

import numpy as np
import pytest
import torch

from support.configured import check, composed, settings
from support.main_job import IN_RUN, run, without_reports
from support.segment_run import TRACKED, place_segment
from warp_resphys import pipeline
from warp_resphys.data.recordings.reading import read_recording, write_recording
from warp_resphys.experiment import learn, reconstruct
from warp_resphys.experiment.evaluate import summary
from warp_resphys.experiment.experiment import Experiment
from warp_resphys.experiment.files import Dataset
from warp_resphys.experiment.reconstruct import replayed_errors
from warp_resphys.experiment.recordings.importing import import_recordings
from warp_resphys.io.errors import InputError, ResphysError
from warp_resphys.io.files import read_array, read_checkpoint, read_hdf5
from warp_resphys.io.settings import parse
from warp_resphys.io.stages import StageContext, run_stages
from warp_resphys.settings.stages import EvaluateStage, ReconstructStage, TrainStage

QUIET = ["hydra/job_logging=none", "hydra/hydra_logging=none", IN_RUN]
COMMAND = ["experiment=tiny", TRACKED, *QUIET]
STAGES = [
    "laboratory",
    "import",
    "identify",
    "reconstruct_resphys",
    "train_resphys",
    "train_simfree",
    "evaluate",
    "report",
]
SCALED = ["laboratory_scaled", "import_scaled"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A complete run, in one process, that was tested at a higher pressure later."""
    folder = tmp_path_factory.mktemp("driven")
    place_segment(folder)
    with without_reports(), contextlib.chdir(folder):
        code, err = run(*COMMAND)
        assert (code, err[-500:] if code else "") == (0, "")
        before = {path: path.stat().st_mtime_ns for path in (folder / "run").rglob("*.h5")}
        code, err = run(*COMMAND, "data.input_scales=[1.5]")
    assert (code, err[-500:] if code else "") == (0, "")
    changed = [path.name for path, at in before.items() if path.stat().st_mtime_ns != at]
    assert changed == ["rollouts.h5"]  # Nothing but the new trials is simulated again, and nothing learned.
    return folder


def motions(folder):
    """Names, markers and pressures of all trials, those at higher pressures last."""
    results = []
    for name in ("dataset.h5", "dataset_scaled.h5"):
        with read_hdf5(folder / "run" / name, "dataset") as file:
            names = [str(name) for name in file.attrs["names"]]
            results.append((names, read_array(file, "observed"), read_array(file, "pressure")))
    (a, b) = results
    return a[0] + b[0], np.concatenate([a[1], b[1]]), np.concatenate([a[2], b[2]])


def metrics(folder):
    return json.loads((folder / "run" / "metrics.json").read_text())


def test_every_stage_leaves_its_files_and_the_errors_are_those_of_the_roll_outs(finished):
    assert sorted(path.stem for path in (finished / "run" / "stages").glob("*.json")) == sorted([*STAGES, *SCALED])
    assert not list((finished / "run").glob("*_parts"))
    results = metrics(finished)
    names, observed, _ = motions(finished)
    with read_hdf5(finished / "run" / "rollouts.h5", "rollouts") as file:
        tested = [str(name) for name in file.attrs["names"]]
        markers = {model: read_array(file, f"{model}_observed") for model in results["errors_mm"]}
    assert names == ["t000", "t001", "t002", "t003", "t003_x1.5"]
    assert tested == names[3:]
    for model, x in markers.items():
        for row, factor in enumerate(("1", "1.5")):
            expected = 1e3 * np.linalg.norm(x[row] - observed[3 + row], axis=-1).mean()
            assert results["scales"][factor][model]["mean"] == pytest.approx(expected, rel=1e-9)
        first = 1e3 * np.linalg.norm(x[0, :7] - observed[3, :7], axis=-1).mean()
        assert results["horizons"]["0.06"][model]["mean"] == pytest.approx(first, rel=1e-9)
    growth = results["horizons"]["0.12"]["sysid"]["mean"] / results["horizons"]["0.06"]["sysid"]["mean"] - 1.0
    assert results["growth"]["sysid"] == pytest.approx(growth)


def test_recordings_are_seen_by_cameras_and_registered_back(finished):
    """The import undoes the cameras' frame to within the noise and the misplaced markers."""
    truth = json.loads((finished / "run" / "truth.json").read_text())
    assert (truth["material"]["mass_damping"], truth["material"]["fibre_stiffness"]) == (0.5, 1e4)
    recording = read_recording(finished / "run" / "recordings" / "t000.h5")
    assert np.linalg.norm(recording.positions[0, 0] - truth["bound"]["T1"]) > 0.01
    _, _, pressure = motions(finished)
    with read_hdf5(finished / "run" / "dataset.h5", "dataset") as file:
        bound = read_array(file, "bound")
    np.testing.assert_allclose(bound, np.array(list(truth["bound"].values())), atol=1e-3)
    assert 0.0 < pressure[:4].max() <= 20e3
    np.testing.assert_allclose(pressure[4], 1.5 * pressure[3])
    np.testing.assert_allclose(pressure[0], recording.actuation[1:])


def test_the_reconstruction_reaches_the_smoothed_markers(finished):
    results = json.loads((finished / "run" / "reconstruction.json").read_text())["resphys"]
    assert results["mean_mm"] < 0.2
    with read_hdf5(finished / "run" / "reconstruction_resphys.h5", "reconstruction") as file:
        assert [str(name) for name in file.attrs["names"]] == ["t000", "t001", "t002"]
        assert read_array(file, "force").shape == (3, 13, read_array(file, "q").shape[2], 3)


def test_forces_that_do_not_hold_the_body_are_named(finished, monkeypatch, tmp_path, caplog):
    """Replayed forces lead to the reconstructed states; a replay that diverges from them is reported."""
    summary = json.loads((finished / "run" / "reconstruction.json").read_text())["resphys"]
    with read_hdf5(finished / "run" / "reconstruction_resphys.h5", "reconstruction") as file:
        states = {name: read_array(file, name)[2:] for name in ("q", "v", "force")}
    record = json.loads((finished / "run" / "stages" / "reconstruct_resphys.json").read_text())
    stage = parse(ReconstructStage, record["settings"])
    replay = partial(replayed_errors, stage, finished / "run", ("t002",))
    results = replay(states)
    assert results.mean() == pytest.approx(summary["replayed_mm"], rel=1e-3)
    assert results.mean() < 0.2
    assert replay({**states, "force": 0.0 * states["force"]}).mean() > 2.0 * results.mean()
    begun = {name: values[:, :7] for name, values in states.items()}  # as with train_fraction below one
    np.testing.assert_array_equal(replay(begun), results[:, :7])
    states["force"][0, 6:] = np.nan
    assert np.isfinite(replay(states)).sum() == 6
    for name in ("dataset.h5", "identification.json"):
        shutil.copy(finished / "run" / name, tmp_path)
    monkeypatch.setattr(reconstruct, "replayed_errors", lambda *rest: np.full(rest[3]["force"].shape[:2], np.inf))
    reconstruct.reconstruct(StageContext("reconstruct_resphys", tmp_path, "", stage))
    assert "replaying the forces gives a marker error of inf mm" in caplog.text
    assert json.loads((tmp_path / "reconstruction.json").read_text())["resphys"]["replayed_mm"] is None


def test_forces_are_learned_as_they_are_in_the_rest_shape(finished, monkeypatch):
    record = json.loads((finished / "run" / "stages" / "train_resphys.json").read_text())
    stage = parse(TrainStage, record["settings"])
    assert stage.force_frame == "corotated"
    assert read_checkpoint(finished / "run" / "resphys.safetensors", "residual force")[1]["force_frame"] == "corotated"
    learned = {}
    for frame in ("corotated", "world"):
        keep = lambda network, train, *rest, frame=frame: learned.update({frame: train})  # noqa: E731
        monkeypatch.setattr(learn, "Trainer", keep)
        experiment = Experiment(stage.changed(force_frame=frame), finished / "run")
        assert learn.Learning(experiment, "resphys").trainer(stage.training).learned.force_frame == frame
    turned, kept = (learned[frame] for frame in ("corotated", "world"))
    back = experiment.frames(experiment.model_simulator("resphys"), "corotated").to_world(
        turned.q, turned.v, turned.outputs[0]
    )
    size = float(kept.outputs[0].abs().max())
    np.testing.assert_allclose(back, kept.outputs[0], atol=1e-5 * size)
    assert float((turned.outputs[0] - kept.outputs[0]).abs().max()) > 1e-3 * size


def refused(finished, folder, *overrides):
    """The sentence with which recordings are refused, before the run or by its import."""
    path = f"hydra.searchpath=[file://{finished / 'configs'}]"
    wanted = settings(path, "experiment=tiny", TRACKED, *overrides)
    with pytest.raises(ResphysError) as told:
        run_stages(pipeline.acquisition_stages(wanted), folder / "run")
    return str(told.value)


def recorded(tmp_path, finished, change):
    """A folder with the recordings, the first of them changed."""
    for name in ("t000", "t001", "t002", "t003"):
        recording = read_recording(finished / "run" / "recordings" / f"{name}.h5")
        write_recording(tmp_path / f"{name}.h5", change(recording) if name == "t000" else recording)
    return [f"data.folder={tmp_path}", "data.train=[t000,t001]", "data.validation=[t002]", "data.test=[t003]"]


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        (["chambers.count=3"], "chambers.count"),
        (["data.test=[t777]"], "data.test names the trial 't777'"),
        (["data.folder=nowhere"], "nowhere is not a folder"),
        (["laboratory.sequences.rest=1.0"], "leave no time between two rests"),
        (["laboratory.material.stiffness=1.0"], "laboratory.material"),
        (["laboratory.fibres.angles=[90.0]"], "laboratory: fibre angles are"),
        (["simulation.youngs_modulus=264"], "is its unit millimetres"),
        (["+identify.parameters.attached_mass_factor={lower:0.5,upper:2.0}"], "'attached_mass_factor'"),
        (["data.folds=leave_one_out", "data.input_scales=[1.5]"], "data.input_scales"),
        (["data.horizons=[0.06,5.0]"], "data.horizons"),
        (["data.cutoff=80.0"], "data.cutoff"),
        (["data.input_scales=[1.5]", "data.folder=run/recordings", "data.test=[t003]"], "recordings have their own"),
        (["laboratory.time_step=0.003"], "the first must be a multiple of the second"),
        (["+identify.parameters.fibre_stiffness={lower:1.0,upper:2.0}"], "names 'fibre_stiffness': choose from"),
        (["laboratory.sequences.correlation=[[1.0],[0.0]]"], "correlation is "),
        (["+identify.first_guess.pressure=0.04"], "identify.first_guess"),
        (["reconstruction=lbfgsb", "+reconstruction.modes=4"], "reconstruction.method=lbfgsb has none"),
    ],
)
def test_bad_configurations_cost_one_sentence(finished, monkeypatch, overrides, key):
    monkeypatch.chdir(finished)
    path = f"hydra.searchpath=[file://{finished / 'configs'}]"
    with pytest.raises(ResphysError, match=re.escape(key)):
        check(composed(path, "experiment=tiny", TRACKED, *overrides))


def test_bad_recordings_cost_one_sentence(finished, tmp_path):
    def with_pressures(values):
        return lambda recording: dataclasses.replace(recording, actuation=values(recording.actuation))

    def stilled(recording):
        noise = np.random.default_rng(0).normal(scale=3e-5, size=recording.positions.shape)
        return dataclasses.replace(recording, positions=recording.positions[:1] + noise)

    cases = {
        "three": (
            with_pressures(lambda p: np.concatenate([p, p[:, :1]], axis=1)),
            "t000.h5 has pressures of 3 chambers",
        ),
        "high": (with_pressures(lambda p: p + 3e4 * (np.arange(len(p)) > 5)[:, None]), "beyond data.input_limit"),
        "late": (with_pressures(lambda p: p + 1e3), "t000.h5 begins under pressure"),
        "none": (lambda recording: dataclasses.replace(recording, actuation=None), "no array 'actuation'"),
        "still": (stilled, "t000.h5: 'T1', 'T2', 'T3' never move by more than"),
    }
    for name, (change, message) in cases.items():
        (tmp_path / name).mkdir()
        assert message in refused(finished, tmp_path / name, *recorded(tmp_path / name, finished, change))


def test_pressures_in_another_unit_and_two_files_of_one_name_cost_one_sentence(finished, tmp_path):
    def in_kilopascal(recording):
        return dataclasses.replace(recording, actuation=1e-3 * recording.actuation)

    places = recorded(tmp_path, finished, in_kilopascal)
    for name in ("t001", "t002", "t003"):
        write_recording(tmp_path / f"{name}.h5", in_kilopascal(read_recording(tmp_path / f"{name}.h5")))
    assert "the pressures of all 4 recordings stay below" in refused(finished, tmp_path, *places)
    (tmp_path / "t001.csv").touch()
    assert "two recordings of one name, t001.csv and t001.h5" in refused(finished, tmp_path, *places)


def test_another_method_of_reconstruction_is_taken_as_a_whole():
    for name in ("sopra", "segment_real", "beam_real"):
        chosen = composed(f"experiment={name}", "reconstruction=lbfgsb")["reconstruction"]
        assert (chosen["method"], chosen["regularisation"]) == ("lbfgsb", 1e-4)


def test_a_short_recording_is_named_and_its_rest_counts_as_not_seen(finished, monkeypatch, tmp_path, caplog):
    def shortened(recording):
        return dataclasses.replace(recording, positions=recording.positions[:9], actuation=recording.actuation[:9])

    monkeypatch.chdir(finished)
    path = f"hydra.searchpath=[file://{finished / 'configs'}]"
    wanted = settings(path, "experiment=tiny", TRACKED, *recorded(tmp_path, finished, shortened))
    stages = {stage.name: stage for stage in pipeline.acquisition_stages(wanted)}
    import_recordings(StageContext("import", tmp_path, "", stages["import"].settings))
    with read_hdf5(tmp_path / "dataset.h5", "dataset") as file:
        seen = np.isfinite(read_array(file, "observed")).all(axis=(2, 3))
    assert seen.sum(axis=1).tolist() == [9, 13, 13, 13]
    assert "t000.h5 ends after 8 of the 12 steps" in caplog.text


def test_the_configurations_of_every_experiment_with_pressures_are_accepted(tmp_path):
    for name in ("sopra_extrapolation", "sopra_overpressure"):
        check(composed(f"experiment={name}", "budget=quick"))
    for pressure in (50, 100, 125, 175, 200, 250, 275, 325, 350, 400):
        (tmp_path / f"segment_{pressure:03d}.h5").touch()
    check(composed("experiment=segment_real", f"data.folder={tmp_path}"))


@pytest.mark.parametrize(
    "overrides",
    [
        ["+in_the_loop=windows", "parallel.batch=null", "range_guard=false", "timing=true"],
        ["data.begins=static"],
        ["data.payload_at={z: -0.276, tolerance: 1e-6}", "+laboratory.trials.t000={payload: 0.02, begins: static}"],
    ],
)
def test_what_the_pipeline_has_for_others_goes_with_pressures(overrides):
    check(composed("experiment=sopra", *overrides))


@pytest.mark.parametrize("word", ["rise", "slew", "slope_3", "dead_band"])
def test_a_response_before_its_command_or_backwards_is_refused(word):
    wanted = f"+identify.parameters.pressure_{word}={{lower: -0.1, upper: 0.1}}"
    with pytest.raises(InputError, match=rf"identify\.parameters\.pressure_{word}\.lower is -0\.1: .* not negative"):
        check(composed("experiment=sopra", wanted))


def test_a_diverged_roll_out_and_one_that_left_the_range_are_reported(tmp_path):
    observed = np.zeros((2, 5, 1, 3))
    good, lost = observed + np.array([3e-3, 0.0, 4e-3]), observed.copy()
    lost[1, 3:] = np.nan
    left = {"resphys": np.array([-1, 3])}
    markers = {"sysid": good, "resphys": lost}
    own = {"horizons": (0.02, 0.04), "split": {"train": [], "validation": [], "test": ["a", "b"]}}
    own |= {"files": {}, "shared": ".", "acquired": "", "groups": {"1": ["a", "b"]}, "calibration": []}
    stage = EvaluateStage.of(settings("experiment=sopra"), **own)
    experiment = Experiment(stage, tmp_path)
    times = np.tile(0.01 * np.arange(5), (2, 1))
    about = (times, observed, observed[:, 0], np.zeros(2), np.zeros(3), 0.01)
    experiment.__dict__["dataset"] = Dataset(("a", "b"), ("m",), ("rest", "rest"), *about, bound=np.zeros((1, 3)))
    results = summary(StageContext("evaluate", tmp_path, "", stage), experiment, {"1": ("a", "b")}, markers, left)
    assert results["errors_mm"]["sysid"]["mean"] == pytest.approx(5.0)
    assert results["errors_mm"]["resphys"]["diverged"] == 1
    assert results["range"]["resphys"] == {"left": 1, "first_s": {"b": pytest.approx(0.03)}}
    assert results["growth"]["sysid"] == pytest.approx(0.0)


def test_the_spread_of_predicted_markers_is_that_of_draws_of_the_parameters(finished):
    """The stored variance beside roll-outs with parameters that are drawn from a narrowed posterior."""
    record = json.loads((finished / "run" / "stages" / "evaluate.json").read_text())
    experiment = Experiment(parse(EvaluateStage, record["settings"]), finished / "run")
    identified = experiment.identification("sysid")
    names, uncertainty = [*identified["parameters"]], identified["uncertainty"]
    deviation = 1e-3 * np.array([uncertainty["deviation"][name] for name in names])
    covariance = np.array(uncertainty["correlation"]) * np.outer(deviation, deviation)
    ranges = np.diag([12.0 / uncertainty["ranges"][name] ** 2 for name in names])  # variances of uniform distributions
    covariance = 1e-6 * np.linalg.inv(np.linalg.inv(1e6 * covariance) + ranges)
    means = [identified["parameters"][name] for name in names]
    drawn = np.random.default_rng(0).multivariate_normal(means, covariance, 400)
    replay = experiment.replay(experiment.model_simulator("sysid"), ["t003"], "sysid")
    sets = {name: torch.from_numpy(drawn[:, column].copy()) for column, name in enumerate(names)}
    points = replay.varied(experiment.start(replay, "sysid"), sets)[:, 0].numpy()
    with read_hdf5(finished / "run" / "rollouts.h5", "rollouts") as file:
        stored = read_array(file, "sysid_spread")[0]
        np.testing.assert_array_equal(read_array(file, "resphys_spread")[0], stored)
    expected = 1e6 * points.var(0).mean(-1)
    assert stored.shape == expected.shape
    np.testing.assert_allclose(stored[-4:], expected[-4:], rtol=0.25)
    assert stored[-1].max() > 3.0 * stored[0].max()  # It grows with the motion.
    intervals = json.loads((finished / "run" / "errors.json").read_text())["intervals"]["models"]
    assert {"without_spread", "by_trial", "by_amplitude", "variance"} <= intervals["sysid"].keys()
    assert "without_spread" not in intervals["interpolation"]
