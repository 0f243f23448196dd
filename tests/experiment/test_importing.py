"""Recordings of a body, real or simulated, become markers in its frame.

What cannot is refused by file and marker.
"""

import copy
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from support.configured import check, settings
from support.refusals import refuses
from warp_resphys import DataFileError, InputError
from warp_resphys.data.recordings.recording import Recording
from warp_resphys.data.recordings.recording_files import read_recording, write_recording
from warp_resphys.data.trials import Trials
from warp_resphys.experiment.build import bound_markers, build_body
from warp_resphys.experiment.checks import check_run
from warp_resphys.experiment.files import DATASET, QUALITY, REGISTRATION, TRUTH
from warp_resphys.experiment.laboratory import laboratory_simulator, make_setup
from warp_resphys.experiment.recordings.importing import import_recordings, sessions_text
from warp_resphys.experiment.recordings.registered_trials import moves
from warp_resphys.experiment.splits import trials_of
from warp_resphys.io.resuming import StageContext, fingerprint, run_stages
from warp_resphys.io.safe_files import read_hdf5, read_json
from warp_resphys.io.settings import parse
from warp_resphys.learning.replay import Replay
from warp_resphys.learning.start import Start
from warp_resphys.learning.trial_batch import TrialBatch
from warp_resphys.pipeline import acquisition_stages
from warp_resphys.settings.run import RunSettings
from warp_resphys.settings.stage_keys import IMPORTED, PLAYED, StageSettings

ROOT = Path(__file__).parents[2]
TIPS, BASES = tuple(f"Tip - {i}" for i in (1, 2, 3)), tuple(f"Base - {i}" for i in (1, 2, 3))
RATE = 100.0
SMALL = [
    "laboratory.mesh.divisions=[6,2,2]",
    "laboratory.time_step=0.005",
    "laboratory.seconds=0.6",
    "data.seconds=0.5",
    "laboratory.train=[m0,m50]",
    "laboratory.validation=[]",
    "laboratory.test=[m90]",
]


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """A run of the first stages without recordings."""
    folder = tmp_path_factory.mktemp("laboratory")
    run = settings("experiment=beam_real", *SMALL)
    check_run(run)
    run_stages(acquisition_stages(run), folder)
    return folder, run


def true_markers(played, setup, dataset, times):
    """(R, T, M, 3) tracked markers in the frame of the body
    at times (R, T) since the release, as simulated [m].
    """
    simulator = laboratory_simulator(played, setup.gravity)
    read = bound_markers(played.binding, simulator.body.mesh, setup.tracked, TIPS).to(
        simulator.rest_positions
    )
    motions = TrialBatch.of(
        dataset, dataset.names, simulator.body, played.payload_at, simulator.time_step
    )
    motions = replace(motions, times=torch.as_tensor(times).clamp_min(0.0))
    start = Start(simulator.rest_state(len(times)), torch.zeros(len(times), dtype=torch.float64))
    with torch.no_grad():
        return Replay(simulator, read, motions)(start)[0].numpy()


def test_simulated_markers_come_back_within_noise(laboratory):
    folder, run = laboratory
    dataset = Trials.read(folder / DATASET)
    motions = TrialBatch.of(dataset, dataset.names, build_body(run), run.payload_at, run.time_step)
    bound = dataset.bound
    assert motions.names == ("m0", "m50", "m90")
    assert dataset.labels == TIPS
    assert dataset.begins == 3 * ("released",)
    assert dataset.inputs == dataset.channels == {}
    np.testing.assert_allclose(dataset.payload, [0.0, 0.05, 0.09])
    np.testing.assert_allclose(motions.inputs.attached_mass.sum(1), [0.0, 0.05, 0.09], atol=1e-12)
    played = StageSettings.reading(run, *PLAYED)
    setup = make_setup(played)
    released = np.array(list(read_json(folder / TRUTH)["released_s"].values()))
    results = (
        np.array([trial["release_frame"] for trial in read_json(folder / QUALITY).values()]) / RATE
    )
    times = motions.times.numpy() + (results - released)[:, None]
    true = true_markers(played, setup, dataset, times)
    # The nominal places turn the frame by a little; what has to come back is the motion in it.
    turn, _ = Rotation.align_vectors(bound - bound.mean(0), setup.tracked - setup.tracked.mean(0))
    assert np.degrees(turn.magnitude()) < 1.0
    moved = turn.apply((true - setup.tracked).reshape(-1, 3)).reshape(true.shape)
    off = (motions.observed.numpy() - bound - moved)[motions.seen.numpy()]
    assert float(motions.amplitude[2]) > 0.01
    assert np.sqrt(np.mean(off**2)) < 2.5 * run.laboratory.noise
    torch.testing.assert_close(
        motions.held, torch.as_tensor(bound).expand(3, -1, -1), rtol=0.0, atol=1e-12
    )
    registration = read_json(folder / REGISTRATION)["m50"]
    # Misplaced by 0.3 mm a coordinate, less what the motion takes up.
    assert 0.2 < registration["rms_mm"] < 0.6
    assert max(abs(x) for shift in registration["shift_mm"].values() for x in shift) < 0.1


def test_what_binds_markers_makes_recordings_anew_and_a_changed_one_is_imported_again(shelf):
    changes = ("markers.bind=patch", "markers.patch=0.05", "markers.largest_distance=0.03")
    made = [
        acquisition_stages(settings("experiment=beam_real", *SMALL, *changes[:count]))[0]
        for count in range(4)
    ]
    assert len({fingerprint(stage, {}) for stage in made}) == 4
    assert made[2].settings.binding.patch == 0.05
    before = fingerprint(acquisition_stages(parse(RunSettings, shelf.config))[0], {})
    assert fingerprint(acquisition_stages(parse(RunSettings, shelf.config))[0], {}) == before
    shelf.move("load52", "Tip - 1", 1e-6)
    assert fingerprint(acquisition_stages(parse(RunSettings, shelf.config))[0], {}) != before


def test_gravity_and_release_are_recovered(laboratory):
    folder, run = laboratory
    truth, quality = read_json(folder / TRUTH), read_json(folder / QUALITY)
    gravity = Trials.read(folder / DATASET).gravity
    true = np.array(truth["gravity"])
    lean = np.degrees(np.arccos(gravity @ true / np.linalg.norm(gravity) / np.linalg.norm(true)))
    assert lean < 0.5
    assert np.linalg.norm(gravity) == pytest.approx(9.80709)
    tilt = np.degrees(np.arccos(-true[2] / np.linalg.norm(true)))
    assert tilt == pytest.approx(run.laboratory.tilt)
    for name, at in truth["released_s"].items():
        assert quality[name]["release_frame"] == pytest.approx(RATE * at, abs=0.3)
        assert 40.0 < RATE * at < 41.0


def test_a_trial_does_not_depend_on_the_others(tmp_path, laboratory):
    folder, run = laboratory
    alone = run.changed(laboratory=run.laboratory.changed(train=["m90"], test=["m50"]))
    run_stages(acquisition_stages(alone)[:1], tmp_path)
    one, other = (read_recording(place / "recordings/m90.h5") for place in (folder, tmp_path))
    np.testing.assert_allclose(one.positions, other.positions, rtol=0.0, atol=1e-7)
    again = settings("experiment=beam_real", *SMALL, "seed=1")
    assert fingerprint(acquisition_stages(again)[0], {}) != fingerprint(
        acquisition_stages(run)[0], {}
    )
    one, other = (make_setup(StageSettings.reading(own, *PLAYED)) for own in (again, run))
    assert np.abs(one.frame.translation - other.frame.translation).min() > 1e-3


class Shelf:
    """Recordings in a folder, made of the simulated ones, and the configuration that names them."""

    def __init__(self, folder, laboratory):
        made, run = laboratory
        self.folder, self.config, self.learned = folder, run.plain(), None
        names = {"bare": "m0", "load52": "m50", "load101": "m90"}
        hung = self.config["laboratory"]["trials"]
        self.config["data"] |= {
            "folder": str(folder),
            "trials": {
                name: {"file": f"{name}.h5", "payload": hung[of]["payload"]}
                for name, of in names.items()
            },
        }
        self.recordings = {
            name: read_recording(made / f"recordings/{of}.h5") for name, of in names.items()
        }
        for name in names:
            self.write(name)

    def write(self, name, **changes):
        recording = self.recordings[name]
        fields = {
            "labels": recording.labels,
            "positions": recording.positions,
            "rate": recording.rate,
            **changes,
        }
        path = self.folder / f"{name}.h5"
        write_recording(path, Recording(source=path, **fields))

    def move(self, name, label, by, frames=slice(None)):
        recording = self.recordings[name]
        positions = recording.positions.copy()
        positions[frames, recording.labels.index(label)] += by
        self.write(name, positions=positions)

    def bring_in(self):
        run = parse(RunSettings, self.config)
        stage = StageSettings.reading(run, *IMPORTED, trials=trials_of(run), learned=self.learned)
        import_recordings(StageContext("import", self.folder, "", stage))
        with read_hdf5(self.folder / DATASET, "dataset") as file:
            return {name: file[name][()] for name in file} | dict(file.attrs)


@pytest.fixture
def shelf(tmp_path, laboratory):
    return Shelf(tmp_path, laboratory)


def test_recordings_of_a_folder_give_what_the_run_folder_gave(shelf, laboratory):
    shelf.learned = ["bare", "load52"]
    results = shelf.bring_in()
    with read_hdf5(laboratory[0] / DATASET, "dataset") as file:
        np.testing.assert_array_equal(results["observed"], file["observed"][()])
        np.testing.assert_array_equal(results["bound"], file["bound"][()])
    assert list(results["names"]) == ["bare", "load52", "load101"]
    np.testing.assert_array_equal(results["payload"], [0.0, 0.05, 0.09])


def test_a_trial_that_is_tested_does_not_say_where_markers_sit(shelf):
    shelf.learned = ["bare"] + ["load52"]
    first = shelf.bring_in()["bound"]
    shelf.move("load101", "Tip - 2", [0.0, 0.001, 0.0])
    np.testing.assert_array_equal(shelf.bring_in()["bound"], first)
    shelf.move("load52", "Tip - 2", [0.0, 0.001, 0.0])
    assert np.abs(shelf.bring_in()["bound"] - first).max() > 2e-4


def test_a_trial_with_markers_of_its_own(shelf):
    """In one trial a marker sits elsewhere, and has another name:
    it is bound by that trial, and nowhere else there.
    """
    whole = shelf.bring_in()
    away = np.array([0.0, 0.003, 0.0])
    shelf.move("load101", "Tip - 2", away)
    tracked = shelf.config["markers"]["tracked"]
    tracked["Tip - 4"] = (np.array(tracked["Tip - 2"]) + away).tolist()
    for name, own in {"bare": "Tip - 2", "load52": "Tip - 2", "load101": "Tip - 4"}.items():
        shelf.config["data"]["trials"][name]["labels"] = ["Tip - 1", own, "Tip - 3", *BASES]
    check(shelf.config)
    wrong = copy.deepcopy(shelf.config)
    wrong["data"]["trials"]["load52"]["labels"] = ["a", "b", "c", *BASES]
    refuses(
        InputError, r"load52\.labels names 'a', .* none of which is in markers\.trac", check, wrong
    )
    shelf.learned = ["bare", "load52"]
    results = shelf.bring_in()
    assert list(results["labels"]) == [*TIPS, "Tip - 4"]
    np.testing.assert_array_equal(
        np.isfinite(results["held"]).all(2), [[1, 1, 1, 0], [1, 1, 1, 0], [1, 0, 1, 1]]
    )
    hidden = np.isnan(results["observed"]).all((1, 3))
    np.testing.assert_array_equal(hidden, ~np.isfinite(results["held"]).all(2))
    np.testing.assert_allclose(results["bound"][:3], whole["bound"], rtol=0.0, atol=2e-4)
    shelf.learned = ["bare", "load52", "load101"]
    mean = shelf.bring_in()["bound"]
    # That trial has a say where it is learned from, and none on markers that it does not have.
    assert np.abs(mean[[0, 2]] - results["bound"][[0, 2]]).max() > 1e-5
    np.testing.assert_array_equal(mean[[1, 3]], results["bound"][[1, 3]])
    # ``away`` is in the frame of the recording
    apart = np.linalg.norm(results["bound"][3] - results["bound"][1])
    assert apart == pytest.approx(np.linalg.norm(away), abs=2e-4)
    swing, same = (data["observed"][2] - data["held"][2] for data in (results, whole))
    np.testing.assert_allclose(swing[:, [0, 3, 2]], same, rtol=0.0, atol=5e-5)
    assert set(read_json(shelf.folder / REGISTRATION)["load101"]["shift_mm"]) == {
        "Tip - 1",
        "Tip - 3",
        "Tip - 4",
    }
    assert Trials.read(shelf.folder / DATASET).sets == ((0, 2, 3), (0, 1, 2))


def test_recordings_that_begin_with_the_release_of_a_deformed_body(shelf):
    """As the published ones do: a loaded beam at rest, whose weight is cut off."""
    whole = shelf.bring_in()
    for name, recording in shelf.recordings.items():
        shelf.write(
            name,
            positions=recording.positions[44:],
            rest=np.median(recording.positions[:40], axis=0),
        )
    shelf.config["data"] |= {"begins": "released", "rest": "file", "seconds": 0.4}
    shelf.config["release"]["sideways"] = 0.0
    results = shelf.bring_in()
    np.testing.assert_allclose(results["bound"], whole["bound"], rtol=0.0, atol=2e-5)
    np.testing.assert_allclose(results["held"], results["observed"][:, 0], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(
        results["times"], np.broadcast_to(np.arange(41) / RATE, (3, 41)), atol=1e-9
    )
    np.testing.assert_allclose(
        results["observed"][2], whole["observed"][2, 3:44], rtol=0.0, atol=5e-5
    )
    assert np.linalg.norm(results["held"] - results["bound"], axis=2).min() > 5e-4
    rest = np.median(shelf.recordings["load52"].positions[:40], axis=0)
    shelf.write("load52", positions=still(shelf, 5e-5), rest=rest)
    refuse(
        shelf,
        r"load52\.h5: 'Tip - 1', .* never move by more than 0\.\d\d mm "
        r"in the 0\.41 s that are read",
    )


def refuse(shelf, message, error=DataFileError):
    refuses(error, message, shelf.bring_in)


def hide(label, frames):
    return lambda shelf: shelf.move("load52", label, np.nan, frames)


def give(**arrays):
    return lambda shelf: shelf.write("load52", **arrays)


def still(shelf, noise):
    """(100, 6, 3) markers that do not move but by noise [m]."""
    rest = np.median(shelf.recordings["load52"].positions[:40], axis=0)
    return rest + np.random.default_rng(0).normal(scale=noise, size=(100, 6, 3))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            give(labels=("Tip 1", *TIPS[1:], *BASES)),
            " has no marker named 'Tip - 1'; it has 'Tip 1', 'Tip - 2'.*set the marker names",
        ),
        (hide("Tip - 2", slice(None)), ".*Tip - 2.* seen"),
        (hide("Base - 3", slice(None)), ".*Base - 3.* seen"),
        (hide("Tip - 2", slice(None, 45)), "'Tip - 2' cannot be seen while the body is held"),
        (
            hide("Tip - 2", slice(41, None)),
            r"'Tip - 2' cannot be seen in the 0\.5 s after the release",
        ),
        (
            lambda shelf: shelf.move("load52", "Base - 3", [0.002, 0.0, 0.0]),
            r"base marker Base - \d moved by \d\.\d\d mm against .* since .*bare\.h5",
        ),
        (
            lambda shelf: shelf.write("load52", positions=still(shelf, 1e-5)),
            "never moves by more than",
        ),
        (
            give(actuation=np.zeros((101, 2))),
            "holds an actuation, 2 in each frame, which nothing here uses",
        ),
        (give(rate=25.0), "has 25 frames per second, too few .* record at least 40"),
        (
            lambda shelf: (
                shelf.config["data"].update(rest="file"),
                shelf.config["release"].update(sideways=0.0),
            ),
            r"has no array 'rest' .* or set data\.rest to held",
        ),
    ],
)
def test_a_recording_that_cannot_be_used_is_named(shelf, wrong, message):
    wrong(shelf)
    refuse(shelf, rf"(load52|bare)\.h5.*{message}")


def test_a_missing_file_is_named(shelf):
    (shelf.folder / "load52.h5").unlink()
    refuse(shelf, r"load52\.h5 does not exist")
    with pytest.raises(
        DataFileError, match=r"cannot read .*load52\.h5 .*data\.trials\.load52\.file"
    ):
        acquisition_stages(parse(RunSettings, shelf.config))


def test_a_base_that_moved_as_a_whole_is_named(shelf):
    shelf.write("load101", positions=shelf.recordings["load101"].positions + [0.02, 0.0, 0.0])
    refuse(
        shelf, r"load101\.h5: base marker Base - \d stands 20\.\d\d mm from its place in .*bare\.h5"
    )
    shelf.config["markers"]["largest_shift"] = None
    shelf.bring_in()
    shelf.move("load101", "Base - 3", [0.002, 0.0, 0.0])
    refuse(shelf, r"load101\.h5: base marker Base - \d moved by \d\.\d\d mm")
    shelf.config["data"]["trials"]["load101"]["session"] = "friday"
    assert shelf.bring_in()["names"].tolist() == [*shelf.recordings]


def test_chosen_markers_register(shelf):
    shelf.config["markers"]["reference"] = {
        "Base - 1": shelf.config["markers"]["reference"]["Base - 1"]
    }
    whole = shelf.bring_in()
    for name in shelf.recordings:
        shelf.move(name, "Tip - 3", [0.0, 0.0, 0.012])
    refuse(
        shelf, r"bare\.h5: the markers at rest do not fit .* 4\.0 mm: 'Tip - 3' is \d+\.\d mm off"
    )
    shelf.config["markers"]["register_with"] = ["Base - 1", "Tip - 1", "Tip - 2"]
    off = np.linalg.norm(shelf.bring_in()["bound"] - whole["bound"], axis=1)
    assert off[:2].max() < 2e-3
    assert off[2] == pytest.approx(0.012, abs=2e-3)
    shelf.config["markers"]["register_with"] = ["Base - 1", "Base - 2"]
    refuses(
        InputError,
        "register_with names 'Base - 2', which is in neither tracked nor reference",
        shelf.bring_in,
    )


def test_a_wrong_vertical_and_a_body_that_is_too_short_are_noticed(shelf):
    shelf.config["data"]["up"] = "-x"
    refuse(
        shelf,
        r"bare\.h5: with data\.up .* degrees from the configured one: set data\.up",
        InputError,
    )
    shelf.config["data"]["up"] = "x"
    shelf.config["mesh"]["size"] = [0.06, 0.03, 0.03]
    shelf.config["data"]["payload_at"] = {"x": 0.06}
    shelf.config["markers"] |= {"bind": "normal", "bind_to": None}
    refuse(shelf, r"Marker 'Tip - \d' is \d\d\.\d mm from the surface", InputError)


TUTORIAL = ROOT / "docs" / "bring_your_robot.md"


def test_the_tutorial(shared_data, tmp_path, monkeypatch):
    """Its mesh, its configuration and its output, on the recordings that it was written with."""
    blocks = re.findall(
        r"```(\w*)\n(.*?)```", TUTORIAL.read_text(encoding="utf-8"), flags=re.DOTALL
    )
    (mesh,), (written,) = (
        [text for kind, text in blocks if kind == wanted] for wanted in ("python", "yaml")
    )
    (log,) = [text.splitlines() for _, text in blocks if text.startswith("import: ")]
    monkeypatch.chdir(tmp_path)
    exec(compile(mesh, TUTORIAL.name, "exec"), {})
    (tmp_path / "recordings").symlink_to(shared_data / "beam_mocap")
    place = tmp_path / "configs" / "experiment" / "my_robot.yaml"
    place.parent.mkdir(parents=True)
    place.write_text(written)
    assert len(written.splitlines()) < 36
    run = settings(f"hydra.searchpath=[file://{tmp_path}/configs]", "experiment=my_robot")
    check_run(run)
    run_stages(acquisition_stages(run), tmp_path)
    quality, registration = read_json(tmp_path / QUALITY), read_json(tmp_path / REGISTRATION)
    for line, (name, trial) in zip(log, quality.items(), strict=True):
        rms = registration[name]["rms_mm"]
        assert (
            line
            == f"import: {name} is released in frame {trial['release_frame']:.1f}, registered to "
            f"{rms:.2f} mm"
        )


def moving(*starts, jumps=()):
    """A recording (120, M, 3) at 100 Hz of markers that move
    by 2 mm from their frames on, and of jumps [m].

    A marker of whom the start is None rests. A jump is a marker, its first and last frame, and its
    size.
    """
    positions = np.random.default_rng(0).normal(scale=2e-5, size=(120, len(starts), 3))
    for marker, start in enumerate(starts):
        if start is not None:
            positions[start:, marker, 0] += np.minimum(2e-3, 4e-4 * np.arange(1, 121 - start))
    for marker, first, last, size in jumps:
        positions[first:last, marker, 1] += size
    return Recording(tuple("ABC"[: len(starts)]), positions, 100.0, Path("swing.csv"))


@pytest.mark.parametrize(
    ("recording", "onset"),
    [
        (moving(60, 60, 60), 60),
        (moving(60, 60, 60, jumps=[(1, 7, 8, 3.4e-4)]), 60),  # of one marker in one frame
        (moving(60, 60, 60, jumps=[(1, 7, 120, 3.4e-4)]), 60),  # of one marker, which stays there
        (moving(60, 60, 60, jumps=[(0, 7, 9, 1e-2), (1, 7, 9, 1e-2)]), 60),  # of two, for a moment
        (moving(60, 60, None), 60),
        (moving(60, 64, 64), 64),  # two of them have to move
        (moving(None, None, 60, jumps=[(2, 7, 8, 3.4e-4)]), 60),  # the only one that ever moves
        (moving(60, jumps=[(0, 7, 8, 3.4e-4)]), 60),
    ],
)
def test_a_motion_begins_where_several_markers_leave_their_places_for_good(recording, onset):
    left = moves(recording, 5)
    assert np.argmax(left) == pytest.approx(onset, abs=1)
    assert not left[: onset - 1].any()
    assert left[onset + 5 :].all()


def test_a_body_that_rests_does_not_move_and_hidden_markers_are_no_motion():
    assert not moves(moving(None, None), 5).any()
    positions = moving(60, 60).positions.copy()
    positions[20:30, 0] = np.nan
    hidden = Recording(("A", "B"), positions, 100.0, Path("swing.csv"))
    assert np.argmax(moves(hidden, 5)) == pytest.approx(60, abs=1)


def test_the_onset_of_the_inflated_segment_is_that_of_its_pressure(shared_data):
    """Not a jump of one marker by 0.34 mm, half a second before."""
    recording = read_recording(shared_data / "segment_sessions" / "100mbar_V3.c3d").select(TIPS)
    assert np.argmax(moves(recording, 5)) / recording.rate == pytest.approx(0.58, abs=0.03)


@pytest.mark.parametrize(("ratio", "count"), [(0.25, 24), (1.0, 6)])
def test_inputs_keep_their_time_at_steps_of_another_length(ratio, count):
    """What a simulator with smaller steps is driven by lasts as long as it did,
    and so does the motion of a base.
    """
    base = np.zeros((1, 7, 6))
    base[0, :, 1] = 1e-3 * np.arange(7.0)
    times, seen, weight = np.zeros((1, 7)), np.zeros((1, 7, 1, 3)), np.zeros(1)
    inputs = {"pressure": np.arange(6.0)[None, :, None]}
    words = (("a",), ("m",), ("rest",))
    dataset = Trials(
        *words, times, seen, seen[:, 0], weight, np.zeros(3), 0.01, inputs=inputs, base=base
    )
    body = build_body(settings("experiment=beam_real"))
    given = dataset.acting(["a"], body, None, 0.01 * ratio)[0].fields
    times = 0.01 * ratio * (np.arange(count) + 1.0)
    np.testing.assert_allclose(
        given["pressure"][:, 0, 0], ((times - 0.005 * ratio) / 0.01).astype(int)
    )
    moved = given["fixed_positions"][:, 0] - torch.from_numpy(
        body.mesh.vertices[body.fixed_vertices]
    )
    expected = np.broadcast_to(0.1 * times[:, None], moved.shape[:2])
    np.testing.assert_allclose(moved[..., 1].numpy(), expected, atol=1e-15)


def test_recordings_of_different_rates_look_like_sessions():
    rates = {"a": 200.0, "b": 240.0, "c": 199.9}
    said = sessions_text(rates, [None, None, None])
    assert "(200 Hz: a, c; 240 Hz: b)" in said
    assert "data.trials.NAME.session" in said
    assert sessions_text(rates, [None, "monday", None]) == sessions_text({"a": 200.0}, [None]) == ""
