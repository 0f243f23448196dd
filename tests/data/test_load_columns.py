"""Readings of force sensors in recordings: tables, archives and bags, their units, and new rates."""

from dataclasses import replace

import numpy as np
import pytest

from support.refusals import refuses
from warp_resphys import DataFileError, read_recording
from warp_resphys.data.recordings.processing import Release, resample, trim_to_release
from warp_resphys.data.recordings.recording_files import write_recording

TIMES = np.arange(21) / 50.0
FORCE = 0.3 + TIMES


def table(path, *headers, scale=1.0):
    """A table with a marker that moves, a tension, and columns of a force sensor."""
    heads = ["time [s]", "tip.x [mm]", "tip.y [mm]", "tip.z [mm]", "tendon [N]", *headers]
    rows = [
        [t, 100.0 * t, 0.0, 5.0, 2.0 * t, *(scale * (0.3 + t) * (1 + k) for k in range(len(headers)))] for t in TIMES
    ]
    path.write_text("\n".join(",".join(map(str, row)) for row in [heads, *rows]))
    return path


def test_columns_of_force_sensors_are_no_channels(tmp_path):
    recording = read_recording(table(tmp_path / "a.csv", "load.fz [mN]", "load.tx [N mm]", "base.FX [N]", scale=1e3))
    np.testing.assert_allclose(recording.actuation[:, 0], 2.0 * TIMES)
    assert recording.actuation.shape == (21, 1)
    assert [*recording.loads] == ["load", "base"]
    np.testing.assert_allclose(recording.loads["load"][:, [2, 3]], np.stack([FORCE, 2.0 * FORCE], 1))
    np.testing.assert_allclose(recording.loads["base"][:, 0], 3e3 * FORCE)
    assert np.isnan(recording.loads["load"][:, [0, 1, 4, 5]]).all()
    np.testing.assert_allclose(recording.positions[:, 0, 0], 0.1 * TIMES)


def test_a_column_in_another_unit_is_a_channel_and_two_of_one_name_are_refused(tmp_path):
    recording = read_recording(table(tmp_path / "a.csv", "left.fx [kPa]"))
    assert recording.actuation.shape == (21, 2)
    assert not recording.loads
    said = "two columns named 'load.fz': rename one of these sensors"
    refuses(DataFileError, said, read_recording, table(tmp_path / "b.csv", "load.fz [N]", "load.Fz [mN]"))


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("load.fz [N m]", r"load.fz of a force sensor has the unit 'N m': give one of N, mN, kN"),
        ("load.tx [N]", r"load.tx of a force sensor has the unit 'N': give one of N m, "),
        ("load.fz", r"has no unit: .* 'load.fz \[N\]'"),
    ],
)
def test_wrong_units_are_refused(tmp_path, header, said):
    refuses(DataFileError, said, read_recording, table(tmp_path / "a.csv", header))


def test_readings_follow_frames_and_rates(tmp_path):
    recording = read_recording(table(tmp_path / "a.csv", "load.fz [N]"))
    recording.loads["load"][7, 2] = np.nan
    faster = resample(recording, 100.0)
    new = np.arange(41) / 100.0
    known = np.abs(new - 0.14) > 0.019
    np.testing.assert_allclose(faster.loads["load"][known, 2], (0.3 + new)[known])
    assert np.isnan(faster.loads["load"][~known, 2]).all()
    trimmed = trim_to_release(recording, Release(9.5, (0, 5)), 0.1)
    np.testing.assert_allclose(trimmed.loads["load"][:, 2], FORCE[10:15])


@pytest.mark.parametrize("suffix", [".h5", ".npz"])
def test_archives_give_them_back(tmp_path, suffix):
    recording = read_recording(table(tmp_path / "a.csv", "load.fz [N]", "base.tx [N m]"))
    path = tmp_path / f"a{suffix}"
    arrays = {"positions": recording.positions, "rate_hz": 50.0, "labels": ["tip"], "sensors": [*recording.loads]}
    arrays["loads"] = np.stack([*recording.loads.values()], 1)
    if suffix == ".h5":
        write_recording(path, recording)
    else:
        np.savez(path, **arrays)
    again = read_recording(path)
    assert [*again.loads] == ["load", "base"]
    for name, readings in recording.loads.items():
        np.testing.assert_array_equal(again.loads[name], readings)
    np.savez(tmp_path / "b.npz", **{**arrays, "sensors": ["load"]})
    said = r"b.npz: loads has the shape \(21, 2, 6\), and sensors names 'load'"
    refuses(DataFileError, said, read_recording, tmp_path / "b.npz")
    few = replace(recording, loads={"load": np.zeros((3, 6))})
    np.savez(tmp_path / "c.npz", **{**arrays, "loads": few.loads["load"][:, None], "sensors": ["load"]})
    said = r"readings of 'load' have the shape \(3, 6\), not \(21, 6\)"
    refuses(DataFileError, said, read_recording, tmp_path / "c.npz")
