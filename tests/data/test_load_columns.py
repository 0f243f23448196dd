"""Readings of force sensors in recordings: tables, archives and bags,
their units, and new rates.
"""

from dataclasses import replace

import numpy as np
import pytest

from support.command_line import refusal
from support.refusals import refuses
from warp_resphys import DataFileError, read_recording
from warp_resphys.data.recordings.processing import Release, resample, trim_to_release
from warp_resphys.data.recordings.recording_files import write_recording
from warp_resphys.settings.data_kinds import TableSettings

TIMES = np.arange(21) / 50.0
FORCE = 0.3 + TIMES


def table(path, *headers, scale=1.0):
    """A table with a marker that moves, a tension, and columns of a force sensor."""
    heads = ["time [s]", "tip.x [mm]", "tip.y [mm]", "tip.z [mm]", "tendon [N]", *headers]
    rows = [
        [
            t,
            100.0 * t,
            0.0,
            5.0,
            2.0 * t,
            *(scale * (0.3 + t) * (1 + k) for k in range(len(headers))),
        ]
        for t in TIMES
    ]
    path.write_text("\n".join(",".join(map(str, row)) for row in [heads, *rows]))
    return path


def test_columns_of_force_sensors_are_no_channels(tmp_path):
    recording = read_recording(
        table(tmp_path / "a.csv", "load.fz [mN]", "load.tx [N mm]", "base.FX [N]", scale=1e3)
    )
    np.testing.assert_allclose(recording.actuation[:, 0], 2.0 * TIMES)
    assert recording.actuation.shape == (21, 1)
    assert [*recording.loads] == ["load", "base"]
    np.testing.assert_allclose(
        recording.loads["load"][:, [2, 3]], np.stack([FORCE, 2.0 * FORCE], 1)
    )
    np.testing.assert_allclose(recording.loads["base"][:, 0], 3e3 * FORCE)
    assert np.isnan(recording.loads["load"][:, [0, 1, 4, 5]]).all()
    np.testing.assert_allclose(recording.positions[:, 0, 0], 0.1 * TIMES)


def test_a_column_in_another_unit_is_a_channel_and_two_of_one_name_are_refused(tmp_path):
    recording = read_recording(table(tmp_path / "a.csv", "left.fx [kPa]"))
    assert recording.actuation.shape == (21, 2)
    assert not recording.loads
    said = "two columns named 'load.fz': rename one of these sensors"
    refuses(
        DataFileError,
        said,
        read_recording,
        table(tmp_path / "b.csv", "load.fz [N]", "load.Fz [mN]"),
    )


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


@pytest.mark.parametrize(
    ("header", "name", "axis", "factor"),
    [
        ("load_fz [N]", "load", 2, 1.0),
        ("load fz [N]", "load", 2, 1.0),
        ("load_Fz_N", "load", 2, 1.0),
        ("load.fz (N)", "load", 2, 1.0),
        ("load.fz (in mN)", "load", 2, 1e-3),
        ("Fz [N]", "load", 2, 1.0),
        ("Fz_N", "load", 2, 1.0),
        ("Force Y (N)", "load", 1, 1.0),
        ("ati/fx [N]", "ati", 0, 1.0),
        ("wrench.force.z [N]", "wrench", 2, 1.0),
        ("ft/wrench/torque/x [Nm]", "ft/wrench", 3, 1.0),
        ("load.fz [gf]", "load", 2, 9.80665e-3),
        ("load.fz [lbf]", "load", 2, 4.4482216),
        ("load.mx [Nm]", "load", 3, 1.0),
        ("Mz [N mm]", "load", 5, 1e-3),
        ("load.tx [N\u00b7m]", "load", 3, 1.0),
        ("load.tx [N*m]", "load", 3, 1.0),
        ("load.tx [N.m]", "load", 3, 1.0),
        ("load.tx [N-m]", "load", 3, 1.0),
        ("load.tx [in-lbf]", "load", 3, 0.11298483),
    ],
)
def test_names_and_units_of_loggers(tmp_path, header, name, axis, factor):
    recording = read_recording(table(tmp_path / "a.csv", header))
    assert recording.labels == ("tip",)
    assert recording.actuation.shape == (21, 1)
    assert [*recording.loads] == [name]
    np.testing.assert_allclose(recording.loads[name][:, axis], factor * FORCE)
    assert np.isfinite(recording.loads[name]).sum() == 21


@pytest.mark.parametrize(
    ("header", "said"),
    [
        (
            "Fx",
            r"column Fx of a force sensor has no unit: "
            r".* 'load.fx \[N\]', or 'F.x \[mm\]' for a marker",
        ),
        ("Mx", r"column Mx of a force sensor has no unit: .* 'load.tx \[N m\]'"),
        ("load.fz [V]", r"has the unit 'V': give one of N, mN, kN, gf, kgf, lbf"),
        ("load.fz [g]", r"has the unit 'g': give one of N"),
        ("Force [N]", r"may be a reading of a force sensor or an input: write 'load.fz \[N\]'"),
        ("Force (in N)", r"may be a reading of a force sensor or an input"),
        ("Load cell 1 (N)", r"may be a reading of a force sensor or an input"),
        (
            "laser [mm]",
            r"is named 'laser', which is neither .* nor '<sensor>.fx \[N\]' .* 'tendon \[mm\]'",
        ),
        ("tip_u [mm]", r"is named 'tip_u', which is neither"),
    ],
)
def test_what_may_be_a_force_or_an_input_is_asked_about(tmp_path, header, said):
    refuses(DataFileError, said, read_recording, table(tmp_path / "a.csv", header))


def test_lengths_of_tendons_are_inputs(tmp_path):
    recording = read_recording(
        table(tmp_path / "a.csv", "tendon_1 [mm]", "winch (m)", "left cable_mm")
    )
    assert recording.labels == ("tip",)
    np.testing.assert_allclose(recording.actuation[:, 1:], np.outer(FORCE, [1e-3, 2.0, 3e-3]))


def test_forces_without_markers_are_a_recording(tmp_path):
    path = tmp_path / "blocked.csv"
    rows = [f"{t:.2f},{10.0 * t},{0.3 + t}" for t in TIMES]
    path.write_text("\n".join(["time [s],pressure [kPa],load.fz [N]", *rows]), encoding="utf-8")
    columns = TableSettings(columns=("time [s]", "pressure [kPa]", "load.fz [N]"), header_lines=1)
    for table in (None, columns):
        recording = read_recording(path, table=table)
        assert recording.positions.shape == (21, 0, 3)
        assert recording.rate == 50.0
        np.testing.assert_allclose(recording.actuation[:, 0], 1e4 * TIMES)
        np.testing.assert_allclose(recording.loads["load"][:, 2], FORCE)
    write_recording(tmp_path / "a.h5", recording)
    loads = recording.loads["load"][:, None]
    np.savez(tmp_path / "a.npz", rate_hz=50.0, loads=loads, sensors=["load"])
    for name in ("a.h5", "a.npz"):
        np.testing.assert_allclose(
            read_recording(tmp_path / name).loads["load"], recording.loads["load"]
        )
    pressure = tmp_path / "pressure.csv"
    pressure.write_text("time [s],pressure [kPa]\n0,1\n1,2\n2,3\n", encoding="utf-8")
    refuses(DataFileError, "no header that is known", read_recording, pressure)
    assert "has no markers, whose quality is examined, but force sensors alone ('load')" in refusal(
        "inspect", str(path)
    )


def test_a_distance_along_one_axis_is_no_marker(tmp_path):
    path = tmp_path / "laser.csv"
    path.write_text(
        "time [s],rod.x [mm],valve [kPa]\n" + "".join(f"{t},{t},1\n" for t in TIMES),
        encoding="utf-8",
    )
    said = (
        "marker rod has no column 'rod.y'; its single axis is a distance, "
        "as of a laser, .* give the others"
    )
    refuses(DataFileError, said, read_recording, path)


def test_words_beside_numbers_are_skipped_and_named(tmp_path, caplog):
    path = tmp_path / "a.csv"
    rows = "".join(f"run,{t},{10.0 * t},1,2\n" for t in TIMES)
    path.write_text("state,time [s],tip.x [mm],tip.y [mm],tip.z [mm]\n" + rows, encoding="utf-8")
    np.testing.assert_allclose(read_recording(path).positions[:, 0, 0], 1e-2 * TIMES)
    assert "columns of text are not read: 'state'" in caplog.text


def test_thousands_of_positions(tmp_path):
    path = tmp_path / "a.txt"
    rows = "".join(f"{t:.2f}\t{980.0 + 50.0 * t:,.0f}\t1\t2\n" for t in TIMES)
    path.write_text("time [s]\ttip.x [mm]\ttip.y [mm]\ttip.z [mm]\n" + rows, encoding="utf-8")
    np.testing.assert_allclose(
        read_recording(path).positions[:, 0, 0], 1e-3 * np.round(980.0 + 50.0 * TIMES)
    )


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
    arrays = {
        "positions": recording.positions,
        "rate_hz": 50.0,
        "labels": ["tip"],
        "sensors": [*recording.loads],
    }
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
    np.savez(
        tmp_path / "c.npz", **{**arrays, "loads": few.loads["load"][:, None], "sensors": ["load"]}
    )
    said = r"readings of 'load' have the shape \(3, 6\), not \(21, 6\)"
    refuses(DataFileError, said, read_recording, tmp_path / "c.npz")
