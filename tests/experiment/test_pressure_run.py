"""A small experiment with pressures through its command line:
its stages, its files and recordings that it refuses.

The report has tests of its own.
"""

import contextlib
import dataclasses
import shutil

import numpy as np
import pytest
import torch

import warp_resphys
from support.configured import check, composed, settings
from support.main_job import finish, without_reports
from support.segment_run import TRACKED, place_segment
from warp_resphys import ObservedMotions, ResphysError, pipeline
from warp_resphys.data.recordings.recording_files import read_recording, write_recording
from warp_resphys.data.trials import Trials
from warp_resphys.experiment import learning_stages
from warp_resphys.experiment.experiment import Experiment
from warp_resphys.experiment.recordings.importing import import_recordings
from warp_resphys.experiment.run_metrics import placement
from warp_resphys.io.resuming import StageContext, run_stages
from warp_resphys.io.safe_files import read_array, read_checkpoint, read_hdf5, read_json, write_json
from warp_resphys.io.settings import parse
from warp_resphys.learning.error_tables import ComparedModels
from warp_resphys.learning.residuals import fitting
from warp_resphys.learning.residuals.correction import force_frames
from warp_resphys.report.ranking import shown_metrics, unused
from warp_resphys.robot.description import finished_experiment
from warp_resphys.settings.stage_keys import StageSettings

COMMAND = (
    "experiment=tiny",
    TRACKED,
    "actuator={epochs: 1, gate: false, centres: 10, filters: [0.05]}",
)
STAGES = {
    "laboratory",
    "import",
    "identify",
    "reconstruct_resphys",
    "train_resphys",
    "train_simfree",
    "evaluate",
}
STAGES |= {"mesh_check", "report", "laboratory_scaled", "import_scaled", "train_actuator"}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A complete run, in one process, that was tested at a higher pressure later."""
    folder = tmp_path_factory.mktemp("driven")
    place_segment(folder)
    with without_reports(), contextlib.chdir(folder):
        finish(*COMMAND)
        before = {path: path.stat().st_mtime_ns for path in (folder / "run").rglob("*.h5")}
        finish(*COMMAND, "data.input_scales=[1.5]")
    changed = [path.name for path, at in before.items() if path.stat().st_mtime_ns != at]
    # Nothing but the new trials is simulated again, and nothing learned.
    assert changed == ["rollouts.h5"]
    return folder / "run"


def stage_of(finished, name, kind):
    """The settings of a stage, as its record has them."""
    return parse(kind, read_json(finished / "stages" / f"{name}.json")["settings"])


def motions(folder):
    """All trials, those at higher pressures last."""
    return Trials.read(folder / "dataset.h5").joined(Trials.read(folder / "dataset_scaled.h5"))


def test_every_stage_leaves_its_files_and_the_errors_are_those_of_the_roll_outs(finished):
    assert {path.stem for path in (finished / "stages").glob("*.json")} == STAGES
    assert not list(finished.glob("*_parts"))
    results = read_json(finished / "metrics.json")
    names, observed = (trials := motions(finished)).names, trials.observed
    with read_hdf5(finished / "rollouts.h5", "rollouts") as file:
        tested = [str(name) for name in file.attrs["names"]]
        markers = {model: read_array(file, f"{model}_observed") for model in results["errors_mm"]}
    assert [*names] == ["t000", "t001", "t002", "t003", "t003_x1.5"]
    assert tested == [*names[3:]]
    for model, x in markers.items():
        for row, factor in enumerate(("1", "1.5")):
            expected = 1e3 * np.linalg.norm(x[row] - observed[3 + row], axis=-1).mean()
            assert results["scales"][factor][model]["mean"] == pytest.approx(expected, rel=1e-9)
        first = 1e3 * np.linalg.norm(x[0, :7] - observed[3, :7], axis=-1).mean()
        assert results["horizons"]["0.06"][model]["mean"] == pytest.approx(first, rel=1e-9)
    checked = results["mesh_check"]  # whole trials are shorter than its half second
    assert checked["errors_mm"][0] == pytest.approx(
        results["scales"]["1"]["sysid"]["mean"], rel=1e-6
    )
    assert (checked["trials"], checked["model"]) == (["t003"], "sysid")
    assert checked["cells"][0] < checked["cells"][1]
    assert checked["moved_mm"] > abs(np.subtract(*checked["errors_mm"]))


def test_without_reconstruction_the_actuator_is_all_that_is_learned(finished, tmp_path):
    """Also where networks of an earlier run lie in the folder."""
    shutil.copytree(finished, tmp_path / "run")
    place_segment(tmp_path)
    with without_reports(), contextlib.chdir(tmp_path):
        finish(*COMMAND, "data.input_scales=[1.5]", "reconstruction=none")
    results, before = (
        read_json(folder / "metrics.json") for folder in (tmp_path / "run", finished)
    )
    assert before["errors_mm"].keys() - results["errors_mm"].keys() == {"simfree"}
    assert (
        results["errors_mm"]["resphys"]
        == results["errors_mm"]["actuator"]
        == before["errors_mm"]["actuator"]
    )
    assert results["networks"].keys() == {"actuator"}
    assert "reconstruction" not in results
    assert warp_resphys.load(tmp_path / "run").description.learned is None
    assert unused(results) == {}
    assert "resphys" not in shown_metrics(results)["errors_mm"]
    assert results["recommended"] != "resphys"


def test_a_run_from_before_the_choice_of_a_reconstruction_has_its_force(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    record = tmp_path / "run" / "stages" / "evaluate.json"
    content = read_json(record)
    content["settings"]["reads"].remove("reconstruction")
    del content["settings"]["reconstruction"]
    write_json(record, content)
    assert finished_experiment(tmp_path / "run").models == finished_experiment(finished).models
    assert warp_resphys.load(tmp_path / "run", "simfree").description.learned is not None


def test_recordings_are_seen_by_cameras_and_registered_back(finished):
    """The import undoes the cameras' frame to within the noise and the misplaced markers."""
    truth = read_json(finished / "truth.json")
    assert (truth["material"]["mass_damping"], truth["material"]["fibre_stiffness"]) == (0.5, 1e4)
    recording = read_recording(finished / "recordings" / "t000.h5")
    assert np.linalg.norm(recording.positions[0, 0] - truth["bound"]["T1"]) > 0.01
    trials = motions(finished)
    pressure = trials.inputs["pressure"]
    np.testing.assert_allclose(trials.bound, np.array(list(truth["bound"].values())), atol=1e-3)
    assert 0.0 < pressure[:4].max() <= 20e3
    np.testing.assert_allclose(pressure[4], 1.5 * pressure[3])
    np.testing.assert_allclose(pressure[0], recording.actuation[1:])


def test_forces_are_learned_as_they_are_in_the_rest_shape(finished, monkeypatch):
    stage = stage_of(finished, "train_resphys", StageSettings)
    assert stage.force_frame == "corotated"
    assert (
        read_checkpoint(finished / "resphys.safetensors", "residual force")[1]["force_frame"]
        == "corotated"
    )
    learned = {}
    for frame in ("corotated", "world"):

        def keep(network, train, *rest, frame=frame):
            learned[frame] = train

        monkeypatch.setattr(fitting, "Trainer", keep)
        experiment = Experiment(stage.model_copy(update={"force_frame": frame}), finished)
        assert (
            learning_stages.fitting_of(experiment, "resphys").trainer(stage.training)[1].force_frame
            == frame
        )
    turned, kept = (learned[frame] for frame in ("corotated", "world"))
    frames = force_frames(experiment.model_simulator("resphys"), "corotated")
    size = float(kept.outputs[0].abs().max())
    np.testing.assert_allclose(
        frames.to_world(turned.q, turned.v, turned.outputs[0]), kept.outputs[0], atol=1e-5 * size
    )
    assert float((turned.outputs[0] - kept.outputs[0]).abs().max()) > 1e-3 * size


class Recordings:
    """A folder with the recordings of the run, some of them changed."""

    def __init__(self, finished, folder):
        self.finished, self.folder = finished, folder
        self.write(lambda recording: recording)

    def write(self, change, *names):
        for name in names or ("t000", "t001", "t002", "t003"):
            recording = read_recording(self.finished / "recordings" / f"{name}.h5")
            write_recording(self.folder / f"{name}.h5", change(recording))

    def stages(self, *overrides):
        path = f"hydra.searchpath=[file://{self.finished.parent / 'configs'}]"
        split = ("data.train=[t000,t001]", "data.validation=[t002]", "data.test=[t003]")
        return pipeline.acquisition_stages(
            settings(path, *COMMAND, f"data.folder={self.folder}", *split, *overrides)
        )

    def imported(self, *overrides):
        """The dataset of their import."""
        (imports,) = [stage for stage in self.stages(*overrides) if stage.name == "import"]
        import_recordings(StageContext("import", self.folder, "", imports.settings))
        return Trials.read(self.folder / "dataset.h5")

    def refused(self):
        """The sentence with which they are refused, before the run or by its import."""
        with pytest.raises(ResphysError) as told:
            run_stages(self.stages(), self.folder / "run")
        return str(told.value)


@pytest.fixture
def recordings(finished, tmp_path):
    return Recordings(finished, tmp_path)


def pressed(values):
    return lambda recording: dataclasses.replace(recording, actuation=values(recording.actuation))


def stilled(recording):
    noise = np.random.default_rng(0).normal(scale=3e-5, size=recording.positions.shape)
    return dataclasses.replace(recording, positions=recording.positions[:1] + noise)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            pressed(lambda p: np.concatenate([p, p[:, :1]], axis=1)),
            "t000.h5 has pressures of 3 chambers",
        ),
        (pressed(lambda p: p + 3e4 * (np.arange(len(p)) > 5)[:, None]), "beyond data.input_limit"),
        (pressed(lambda p: p + 1e3), "t000.h5 begins under pressure"),
        (pressed(lambda p: None), "no array 'actuation'"),
        (stilled, "t000.h5: 'T1', 'T2', 'T3' never move by more than"),
    ],
)
def test_bad_recordings_cost_one_sentence(recordings, change, message):
    recordings.write(change, "t000")
    assert message in recordings.refused()


def test_pressures_in_another_unit_and_two_files_of_one_name_cost_one_sentence(
    recordings, tmp_path
):
    recordings.write(pressed(lambda p: 1e-3 * p))
    assert "the pressures of all 4 recordings stay below" in recordings.refused()
    (tmp_path / "t001.csv").touch()
    assert "two recordings of one name, t001.csv and t001.h5" in recordings.refused()


def test_a_short_recording_is_named_and_its_rest_counts_as_not_seen(recordings, caplog):
    recordings.write(lambda recording: recording.frames(slice(9)), "t000")
    recordings.write(lambda recording: recording.frames(slice(11)), "t002")
    seen = np.isfinite(recordings.imported().observed).all(axis=(2, 3))
    assert seen.sum(axis=1).tolist() == [9, 13, 11, 13]
    said = (
        "shorter than the 12 steps of data.steps (t000.h5: 8, t002.h5: 10); "
        "missing frames are ignored"
    )
    assert [
        said in record.message for record in caplog.records if record.levelname == "WARNING"
    ] == [True]


def rested(recording, frames=150):
    """A recording that begins with more frames at rest."""
    positions = np.concatenate(
        [np.repeat(recording.positions[:1], frames, axis=0), recording.positions]
    )
    pressures = np.concatenate([np.zeros((frames, 2)), recording.actuation])
    return dataclasses.replace(recording, positions=positions, actuation=pressures)


def test_recordings_are_read_whole_without_a_number_of_steps_or_from_where_something_happens(
    recordings, caplog
):
    recordings.write(rested, "t000")
    whole = recordings.imported("data.steps=null")
    seen = np.isfinite(whole.observed).all(axis=(2, 3))
    assert seen.sum(axis=1).tolist() == [163, 13, 13, 13]
    np.testing.assert_array_equal(whole.inputs["pressure"][0, :149], 0.0)
    assert "shorter" not in caplog.text
    # More frames at rest at their start change nothing; without the lead, nothing happens in the
    # first steps.
    expected = recordings.imported("data.lead=0.02")
    recordings.write(rested, "t000", "t003")
    read = recordings.imported("data.lead=0.02")
    np.testing.assert_allclose(read.observed, expected.observed, atol=1e-9)
    np.testing.assert_allclose(read.inputs["pressure"], expected.inputs["pressure"])
    assert "t000.h5: 'T1', 'T2', 'T3' never move by more than" in recordings.refused()


def exchanged(recording, one="B1", other="B2"):
    """The recording with the labels of two markers on the clamp exchanged."""
    names = {one: other, other: one}
    return dataclasses.replace(
        recording, labels=tuple(names.get(label, label) for label in recording.labels)
    )


def test_the_registration_of_every_trial_is_said_and_markers_that_it_leaves_out_are_warned_of(
    recordings, caplog
):
    caplog.set_level("INFO")
    recordings.imported()
    fits = read_json(recordings.folder / "registration.json")
    lines = [
        f"import: {name} is registered to {fit['rms_mm']:.2f} mm" for name, fit in fits.items()
    ]
    assert [record.message for record in caplog.records if "registered" in record.message] == lines
    assert [record for record in caplog.records if record.levelname == "WARNING"] == []
    recordings.write(exchanged)
    recordings.imported()
    (warning,) = [record.message for record in caplog.records if record.levelname == "WARNING"]
    fits = read_json(recordings.folder / "registration.json")
    assert [fit["outliers"] for fit in fits.values()] == 4 * [["B1", "B2"]]
    away = [max(fit["residual_mm"][label] for fit in fits.values()) for label in ("B1", "B2")]
    assert min(away) > 30.0
    assert warning.startswith(
        "import: the registration of t000, t001, t002, t003 leaves out "
        f"B1 ({away[0]:.1f} mm), B2 ({away[1]:.1f} mm) from the nominal position: check names"
    )
    assert placement(fits, {})["left_out_mm"] == dict(zip(("B1", "B2"), away, strict=True))


def test_constant_inputs_are_pulses(recordings):
    pulse = "t000: {file: t000.h5, inputs: [1.0e4, 0], onset: 0.025, until: 0.06}"
    others = ", ".join(f"{name}: {name}.h5" for name in ("t001", "t002", "t003"))
    trials = f"+data.trials={{{pulse}, {others}}}"
    pressure = recordings.imported(trials).inputs["pressure"][0]
    np.testing.assert_allclose(
        pressure[:, 0], 1e4 * np.array([0, 0, 0.5, 1, 1, 1, 0, 0, 0, 0, 0, 0]), atol=1e-6
    )
    np.testing.assert_array_equal(pressure[:, 1], 0.0)
    with pytest.raises(ResphysError, match=r"t000.until is 0.02: it must be above onset, 0.025 s"):
        recordings.stages(trials, "data.trials.t000.until=0.02")
    with pytest.raises(
        ResphysError, match=r"t000.inputs is null: onset and until are of constant inputs"
    ):
        recordings.stages(trials, "data.trials.t000.inputs=null")


def test_a_robot_has_the_learned_actuator_as_evaluated_from_a_file_and_on_another_mesh(
    finished, tmp_path
):
    robot = warp_resphys.load(finished, "actuator")
    trial = warp_resphys.recorded_trial(robot, "t003")
    shown = trial.shown(trial.play(robot))
    with read_hdf5(finished / "rollouts.h5", "rollouts") as file:
        expected, below = (
            read_array(file, f"{model}_observed")[0] for model in ("actuator", "sysid")
        )
    np.testing.assert_allclose(shown, expected, atol=1e-7)
    assert np.abs(expected - below).max() > 1e-5
    again = warp_resphys.load(robot.save(tmp_path / "robot.safetensors"))
    np.testing.assert_allclose(trial.shown(trial.play(again)), shown, atol=1e-9)
    other = robot.on(robot.description.mesh)
    pressed = {"pressure": [5e3, 0.0]}
    torch.testing.assert_close(
        other.settle(**pressed).q, robot.settle(**pressed).q, rtol=0.0, atol=1e-8
    )
    assert (
        other.settle(**pressed).q - robot.on(robot.description.mesh, chambers=None).settle().q
    ).abs().max() > 1e-6


@pytest.mark.parametrize(
    "overrides",
    [
        ["experiment=sopra_extrapolation", "budget=quick"],
        ["experiment=sopra_overpressure", "budget=quick"],
        ["in_the_loop={epochs:5}", "parallel.batch=null", "range_guard=false", "timing=true"],
        ["data.begins=static"],
        [
            "data.payload_at={z: -0.276, tolerance: 1e-6}",
            "+laboratory.trials.t000={payload: 0.02, begins: static}",
        ],
    ],
)
def test_what_the_pipeline_has_for_others_goes_with_pressures(overrides):
    check(composed("experiment=sopra", *overrides))


def test_the_configuration_of_recordings_with_pressures_is_accepted(tmp_path):
    for pressure in (50, 100, 125, 175, 200, 250, 275, 325, 350, 400):
        (tmp_path / f"segment_{pressure:03d}.h5").touch()
    check(composed("experiment=segment_real", f"data.folder={tmp_path}"))
    for name in ("sopra", "segment_real", "beam_real"):
        chosen = composed(f"experiment={name}", "reconstruction=lbfgsb")["reconstruction"]
        # a method is taken as a whole
        assert (chosen["method"], chosen["regularisation"]) == ("lbfgsb", 1e-4)


def test_a_diverged_roll_out_and_one_that_left_the_range_are_reported():
    observed = np.zeros((2, 5, 1, 3))
    good, lost = observed + np.array([3e-3, 0.0, 4e-3]), observed.copy()
    lost[1, 3:] = np.nan
    left = {"resphys": np.array([-1, 3])}
    about = (
        np.tile(0.01 * np.arange(5), (2, 1)),
        observed,
        observed[:, 0],
        np.zeros(2),
        np.zeros(3),
        0.01,
    )
    pressed = {"pressure": np.array([[1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 0.0, 0.0]])[..., None]}
    more = {"bound": np.zeros((1, 3)), "inputs": pressed}
    motions = ObservedMotions(Trials(("a", "b"), ("m",), ("rest", "rest"), *about, **more))
    markers = {"sysid": good, "resphys": lost}
    results = ComparedModels(
        motions, (), {"1": ("a", "b")}, markers, left, horizons=(0.02, 0.04)
    ).errors()
    assert results["errors_mm"]["sysid"]["mean"] == pytest.approx(5.0)
    assert results["errors_mm"]["resphys"]["diverged"] == 1
    assert results["range"]["resphys"] == {"left": 1, "first_s": {"b": pytest.approx(0.03)}}
    assert results["horizons"]["0.04"]["sysid"]["mean"] == pytest.approx(5.0)
    rise, release = (results["phases"][phase] for phase in ("rise", "release"))
    assert rise["sysid"]["mean"] == release["sysid"]["mean"] == pytest.approx(5.0)
    assert (rise["resphys"]["mean"], rise["resphys"]["trajectories"]) == (0.0, 2)
    assert (release["resphys"]["diverged"], release["resphys"]["trajectories"]) == (1, 1)


def test_the_spread_of_predicted_markers_is_that_of_draws_of_the_parameters(finished):
    """The stored variance beside roll-outs with parameters
    that are drawn from a narrowed posterior.
    """
    experiment = Experiment(stage_of(finished, "evaluate", StageSettings), finished)
    identified = experiment.identified("sysid")
    names, uncertainty = [*identified.parameters], identified.uncertainty
    deviation = 1e-3 * np.array([uncertainty.deviation[name] for name in names])
    covariance = np.array(uncertainty.correlation) * np.outer(deviation, deviation)
    # Variances of uniform distributions.
    ranges = np.diag([12.0 / uncertainty.ranges[name] ** 2 for name in names])
    covariance = 1e-6 * np.linalg.inv(np.linalg.inv(1e6 * covariance) + ranges)
    means = [*identified.parameters.values()]
    drawn = np.random.default_rng(0).multivariate_normal(means, covariance, 400)
    replay = experiment.motions.replay(
        experiment.model_simulator("sysid"), ["t003"], experiment.identified("sysid")
    )
    sets = {name: torch.from_numpy(drawn[:, column].copy()) for column, name in enumerate(names)}
    points = replay.varied(experiment.motions.start(replay, experiment.identified("sysid")), sets)[
        0
    ][:, 0].numpy()
    with read_hdf5(finished / "rollouts.h5", "rollouts") as file:
        stored = read_array(file, "sysid_spread")[0]
        corrected = [read_array(file, f"{model}_spread")[0] for model in ("actuator", "resphys")]
    np.testing.assert_array_equal(corrected, [stored, stored])  # of the simulator that they correct
    expected = 1e6 * points.var(0).mean(-1)
    assert stored.shape == expected.shape
    np.testing.assert_allclose(stored[-4:], expected[-4:], rtol=0.25)
    assert stored[-1].max() > 3.0 * stored[0].max()  # It grows with the motion.
    intervals = read_json(finished / "errors.json")["intervals"]["models"]
    assert {"without_spread", "by_trial", "variance"} <= intervals["sysid"].keys()
    assert "without_spread" not in intervals["interpolation"]
