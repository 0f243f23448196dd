import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.command_line import refusal, settings_of
from support.sentences import offending
from warp_resphys.data.recordings.arrays import write_recording
from warp_resphys.data.recordings.processing import fill_gaps
from warp_resphys.data.recordings.recording import Recording
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.io.settings import parse
from warp_resphys.studies.recording_comparison import (
    ComparisonSettings,
    NominalMarker,
    NominalMarkers,
    Swing,
    compare_recording,
    follow_face,
    marker_error,
    measured_swing,
    simulate_swing,
)


def marker(name, position):
    return NominalMarker(name=name, position=position)


TIP = [marker("a", (0.1, 0.015, 0.036)), marker("b", (0.1, -0.006, 0.024)), marker("c", (0.1, 0.036, 0.006))]
BASE = [
    marker("d", (0.006, -0.01, -0.001)),
    marker("e", (0.006, 0.04, 0.0275)),
    marker("f", (0.006, 0.04, 0.0)),
]
ROTATION = Rotation.from_euler("xyz", [0.4, -1.5, 2.0])


def configured(*overrides):
    return settings_of(ComparisonSettings, "inspect_compare", *overrides)


def swing_of(recording, tip=TIP, largest_residual=1e-3, release_frame=None):
    """The measured swing, with the markers of this file."""
    settings = configured("registration.longest_gap=5", f"registration.largest_residual={largest_residual}")
    return measured_swing(
        recording,
        settings.changed(
            markers=NominalMarkers(tip=tip, base=BASE),
            recording=settings.recording.changed(release_frame=release_frame),
        ),
    )


def recorded(displacement, release):
    """A recording, in the laboratory's frame, of tip markers held still, then displaced (T, 3, 3) [m]."""
    tip = np.array([marker.position for marker in TIP])
    base = np.array([marker.position for marker in BASE])
    moved = np.concatenate([np.zeros((release, 3, 3)), displacement])
    positions = np.concatenate([tip + moved, np.broadcast_to(base, moved.shape)], axis=1)
    noise = np.random.default_rng(0).normal(scale=5e-6, size=positions.shape)
    in_laboratory = ROTATION.apply((positions + noise).reshape(-1, 3)).reshape(positions.shape) + [
        0.3,
        -0.2,
        1.0,
    ]
    return Recording(tuple("abcdef"), in_laboratory, 100.0, Path("swing.c3d"))


def falling(frames=300):
    time = np.arange(frames) / 100.0
    displacement = np.zeros((frames, 3, 3))
    displacement[:, :, 2] = (-6e-3 * (1 - np.exp(-2.5 * time) * np.cos(48.0 * time)))[:, None]
    displacement[:, 0, 0] = 1e-3 * time
    return displacement


def test_follow_face_turns_the_stems_with_it():
    face = np.array([[0.1, 0, 0], [0.1, 0.03, 0], [0.1, 0, 0.03], [0.1, 0.03, 0.03]])
    markers = np.array([[0.1, 0.015, 0.036], [0.13, 0.0, 0.0]])
    turn = Rotation.from_euler("y", 90, degrees=True)
    moved = turn.apply(face - [0.1, 0, 0]) + [0.1, 0, -0.02]
    displacement = follow_face(np.stack([face, moved]), face, markers)
    np.testing.assert_allclose(displacement[0], 0.0, atol=1e-15)
    np.testing.assert_allclose(displacement[1, 0], [0.036, 0.0, -0.036 - 0.02], atol=1e-15)
    np.testing.assert_allclose(displacement[1, 1], [-0.03, 0.0, -0.03 - 0.02], atol=1e-15)


def test_follow_face_ignores_how_the_face_deforms():
    face = np.array([[0.1, 0, 0], [0.1, 0.03, 0], [0.1, 0, 0.03], [0.1, 0.03, 0.03]])
    centre = face.mean(axis=0)
    swollen = centre + 1.1 * (face - centre) + [0.0, 0.0, -0.01]
    displacement = follow_face(swollen[None], face, np.array([[0.1, 0.015, 0.036]]))
    np.testing.assert_allclose(displacement, [[[0.0, 0.0, -0.01]]], atol=1e-15)


def test_marker_error_compares_at_the_measured_times():
    fine = np.linspace(0.0, 2.0, 2001)
    coarse = np.arange(0.003, 2.0, 0.01)

    def swing(time, offset):
        wave = np.stack([np.sin(20.0 * time) + offset, np.zeros_like(time), np.cos(20.0 * time)], axis=-1)
        return Swing(time, wave[:, None])

    assert marker_error(swing(coarse, 0.3), swing(fine, 0.0), 1.0) == pytest.approx(0.3, abs=1e-6)
    late = swing(coarse, 0.0)
    late.displacement[late.time > 1.0] += 5.0
    assert marker_error(late, swing(fine, 0.0), 1.0) == pytest.approx(0.0, abs=1e-6)


def test_measured_swing_is_in_the_frame_of_the_body():
    displacement = falling()
    recording = recorded(displacement, release=60)
    recording.positions[150:153, 1] = np.nan
    swing = swing_of(recording)
    assert swing.release.frame == pytest.approx(60.0, abs=0.3)
    np.testing.assert_allclose(swing.rest_markers, [m.position for m in TIP], atol=2e-5)
    assert swing.registration_residual < 2e-5
    first = round(swing.time[0] * 100.0 + swing.release.frame) - 60
    np.testing.assert_allclose(swing.displacement, displacement[first:], atol=5e-4)
    unoccluded = np.r_[0:80, 100 : len(swing.time)]
    np.testing.assert_allclose(swing.displacement[unoccluded], displacement[first:][unoccluded], atol=6e-5)
    np.testing.assert_allclose(swing.deflection, displacement[first:, :, 2].mean(axis=1), atol=2e-4)


def test_a_known_release_is_taken_over_and_checked():
    recording = recorded(falling(), release=60)
    swing = swing_of(recording, release_frame=61.5)
    assert swing.time[0] == pytest.approx(0.005)
    np.testing.assert_allclose(swing.rest_markers, [m.position for m in TIP], atol=2e-5)
    with pytest.raises(InputError, match="release_frame is"):
        swing_of(recording, release_frame=900.0)


def test_markers_in_the_wrong_order_are_noticed():
    recording = recorded(falling(), release=60)
    swapped = [marker("b", TIP[0].position), marker("a", TIP[1].position), TIP[2]]
    with pytest.raises(DataFileError, match=r"mm \(root mean square\) off their nominal positions"):
        swing_of(recording, swapped, largest_residual=4e-3)


def test_comparison_of_a_simulation_with_its_own_recording(tmp_path):
    """Release, registration, binding and estimators leave nothing of their own: the two swings are one."""
    path, folder = tmp_path / "swing.h5", tmp_path / "page"
    config = configured(f"recording.path={path}", "simulation.time_step=0.01", "comparison.tail_seconds=0.5")
    tip = np.array([marker.position for marker in TIP])
    truth = simulate_swing(config, tip, 2.2)
    recording = recorded(truth.displacement, release=50)
    labels = [marker.name for marker in (*config.markers.tip, *config.markers.base)]
    write_recording(path, Recording(tuple(labels), recording.positions, 100.0, path))
    folder.mkdir()
    result = compare_recording(config, folder)
    assert result["release_frame"] == pytest.approx(50.0, abs=0.3)
    difference = result["relative_difference"]
    assert difference["sag"] == pytest.approx(0.0, abs=2e-3)
    assert difference["period"] == pytest.approx(0.0, abs=2e-3)
    assert difference["decay_rate"] == pytest.approx(0.0, abs=2e-2)
    assert result["marker_error_mm"] < 0.4
    assert result["simulated"]["sag_mm"] == pytest.approx(-6.42, abs=0.03)
    written = json.loads((folder / "comparison.json").read_text())
    assert written["relative_difference"] == difference
    assert parse(ComparisonSettings, written["config"]) == config
    assert (folder / "comparison.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(folder.iterdir())) == 2


def test_a_recording_in_which_nothing_moves_or_with_pressures_is_refused(tmp_path):
    path = tmp_path / "swing.h5"
    config = configured(f"recording.path={path}", "recording.release_frame=50")
    labels = tuple(marker.name for marker in (*config.markers.tip, *config.markers.base))
    still = Recording(labels, recorded(np.zeros((200, 3, 3)), release=50).positions, 100.0, path)
    write_recording(path, still)
    with pytest.raises(DataFileError, match=r"swing\.h5: 'Tip - 1', .* never move by more than"):
        compare_recording(config, tmp_path)
    write_recording(path, dataclasses.replace(still, actuation=np.zeros((len(still.positions), 1))))
    with pytest.raises(DataFileError, match=r"swing\.h5 holds an actuation, 1 in each frame, which nothing here"):
        compare_recording(config, tmp_path)


@pytest.mark.parametrize(
    ("name", "file", "frames"),
    [("bare", "gravity", 13), ("load52", "load52", 23), ("load101", "load101", 30)],
)
def test_recordings(shared_data, tmp_path, name, file, frames):
    path = shared_data / "beam_mocap" / f"beam_{file}_V2_a.c3d"
    result = compare_recording(configured(f"recording={name}", f"recording.path={path}"), tmp_path)
    assert result["measured"]["period_s"] == pytest.approx(frames / 100.0, abs=0.003)
    assert abs(result["relative_difference"]["period"]) < 0.1
    assert abs(result["relative_difference"]["sag"]) < (0.05 if name == "bare" else 0.1)
    assert abs(result["relative_difference"]["decay_rate"]) < 0.15
    assert (tmp_path / "comparison.png").stat().st_size > 10_000


def test_hung_weight_lengthens_the_period():
    """An attached mass has inertia: a tenth of a kilogram more than doubles the period of the bare beam."""
    tip = np.array([TIP[0].position])
    settings = ["simulation.time_step=0.01", "material.mass_damping=0", "material.stiffness_damping=0.001"]
    turns = []
    for name in ("bare", "load101"):
        swing = simulate_swing(configured(f"recording={name}", *settings), tip, 0.3)
        turns.append(swing.time[np.argmin(swing.deflection)])
    assert turns[1] / turns[0] == pytest.approx(np.sqrt((102.0 + 23.7) / 23.7), rel=0.1)


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("recording.path=null", "recording.path"),
        ("recording.hung_weight=-1", "recording.hung_weight"),
        ("simulation.gravity=0", "simulation.gravity"),
        ("recording.release_frame=soon", "recording.release_frame"),
        ("material.density=heavy", "material.density"),
        ("+comparison.windows=1", "comparison.windows"),
    ],
)
def test_refused_settings(tmp_path, override, key):
    with pytest.raises(InputError) as refused:
        compare_recording(configured("recording.path=x.c3d", override), tmp_path)
    assert offending(str(refused.value)) == key
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_is_not_there(tmp_path):
    with pytest.raises(DataFileError, match=r"Cannot read absent\.c3d: No such file"):
        compare_recording(configured("recording.path=absent.c3d"), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_command_line_tells_what_is_wrong_in_one_sentence(folder):
    (folder / "notes.c3d").write_text("not a recording")
    assert refusal("inspect", "compare", "recording.path=notes.c3d") == (
        "error: notes.c3d is not a C3D file: give a motion-capture recording in C3D format.\n"
    )


def test_gaps_are_filled_before_anything_else():
    recording = recorded(falling(), release=60)
    recording.positions[100:120, 2] = np.nan
    with pytest.raises(DataFileError, match="marker c is occluded in frames 100 to 119"):
        swing_of(recording)
    assert np.isfinite(fill_gaps(recording, 20).positions).all()
