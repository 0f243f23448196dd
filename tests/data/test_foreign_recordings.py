"""Tables with names, dates and decimal commas, Vicon's export, and their conversion."""

import numpy as np
import pytest

from support.bags import write_points
from support.command_line import outcome, refusal
from warp_resphys.data.recordings.reading import read_recording
from warp_resphys.io.errors import DataFileError
from warp_resphys.settings.trials import TableSettings

TIMES = 100.0 + np.arange(30) / 50.0
TIP = np.stack([0.02 * np.sin(5.0 * TIMES), 0.1 + 0.0 * TIMES, 0.01 * TIMES], -1)


def table(path, header, times, separator=",", decimal="."):
    """A table with the tip in millimetres and a pressure."""
    rows = [[time, *(f"{1e3 * x:.6f}" for x in tip), "12.5"] for time, tip in zip(times, TIP, strict=True)]
    rows = [[str(cell).replace(".", decimal) for cell in row] for row in rows]
    path.write_text("\n".join([*header, *(separator.join(row) for row in rows)]))
    return path


HEADER = "time{},tip.x [mm],tip.y [mm],tip.z [mm],valve [mbar]"


@pytest.mark.parametrize(
    ("unit", "times"),
    [
        (" [ms]", [f"{1e3 * (time - 100.0):.3f}" for time in TIMES]),
        (" [ns]", [round(1e9 * time) for time in TIMES - 100.0]),
        (" [iso]", [f"2026-02-28T23:59:59.{round(1e3 * (time - 100.0)):03d}" for time in TIMES]),
        ("", [f"2026-02-28T23:59:59.{round(1e3 * (time - 100.0)):03d}Z" for time in TIMES]),
    ],
)
def test_times_of_any_unit_are_read(tmp_path, unit, times):
    read = read_recording(table(tmp_path / "a.csv", [HEADER.format(unit)], times))
    assert read.rate == 50.0
    np.testing.assert_allclose(read.positions[:, 0], TIP, atol=1e-9)
    np.testing.assert_allclose(read.actuation, 1250.0)


def test_dates_that_do_not_fit_are_named(tmp_path):
    times = [f"2026-02-28T23:59:59.{20 * n:03d}" for n in range(30)]
    for wrong in ("2026-02-28T23:59:59.060Z", "3"):
        path = table(tmp_path / "a.csv", [HEADER.format("")], [*times[:3], wrong, *times[4:]])
        with pytest.raises(DataFileError, match=rf"a\.csv, line 5, column 1: '{wrong}' is no date and time as the oth"):
            read_recording(path)
    with pytest.raises(DataFileError, match="gives its time in 'h': it must be in s, ms, us, ns or iso"):
        read_recording(table(tmp_path / "a.csv", [HEADER.format(" [h]")], range(30)))


def test_decimal_commas_between_semicolons_are_read(tmp_path):
    header = HEADER.format(" [s]").replace(",", ";")
    times = [f"{time - 100.0:.3f}" for time in TIMES]
    read = read_recording(table(tmp_path / "a.csv", [header], times, ";", ","))
    np.testing.assert_allclose(read.positions[:, 0], TIP, atol=1e-9)


NAMES = {"t": "time [s]", "X (mm)": "tip.x [mm]", "Y (mm)": "tip.y [mm]", "Z (mm)": "tip.z [mm]"}


def test_columns_are_chosen_by_the_names_of_the_file(tmp_path):
    times = [f"{time - 100.0:.3f}" for time in TIMES]
    lines = ["recorded on a Monday", "t\tX (mm)\tY (mm)\tZ (mm)\tpump"]
    path = table(tmp_path / "a.tsv", lines, times, "\t")
    read = read_recording(path, table=TableSettings(names={**NAMES, "pump": "pump [kPa]"}, header_lines=1))
    np.testing.assert_allclose(read.positions[:, 0], TIP, atol=1e-9)
    np.testing.assert_allclose(read.actuation, 12.5e3)
    assert read_recording(path, table=TableSettings(names=NAMES, header_lines=1)).actuation is None
    with pytest.raises(
        DataFileError, match=r"line 2: data\.table\.names has 'X', which 0 columns are named; it has 't'"
    ):
        read_recording(path, table=TableSettings(names={**NAMES, "X": "a.x"}, header_lines=1))


def vicon(path, cut=0, subject="Arm:"):
    """Vicon's export, with analogue devices before the trajectories, and a marker that is not seen in a frame."""
    lines = ["Devices", "1000", ",,Force,", "Frame,Sub Frame,Fx,Fy", ",,N,N", "1,0,1,2", "1,1,1,2", ""]
    lines += [
        "Trajectories",
        "50",
        f",,{subject}Tip,,,{subject}Base,,",
        "Frame,Sub Frame,X,Y,Z,X,Y,Z",
        ",,mm,mm,mm,mm,mm,mm",
    ]
    for frame, tip in enumerate(TIP, 1):
        lines.append(
            ",".join([str(frame), "0", *(f"{1e3 * x:.6f}" for x in tip), *(["", "", ""] if frame == 4 else "123")])
        )
    path.write_text("\n".join(lines[: len(lines) - cut]) + "\n")
    return path


def test_trajectories_of_vicon_are_read(tmp_path):
    read = read_recording(vicon(tmp_path / "a.csv"))
    assert (read.labels, read.rate) == (("Tip", "Base"), 50.0)
    np.testing.assert_allclose(read.positions[:, 0], TIP, atol=1e-9)
    np.testing.assert_allclose(read.positions[0, 1], [1e-3, 2e-3, 3e-3])
    assert np.flatnonzero(~read.seen[:, 1]).tolist() == [3]
    with pytest.raises(DataFileError, match="no whole section 'Trajectories': export it from Vicon Nexus"):
        read_recording(vicon(tmp_path / "a.csv", cut=33))


def test_recordings_are_converted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_points(tmp_path / "swing", {"/tip": TIP}, 50.0)
    assert "seen" in outcome("convert", "swing/swing.mcap", "recording.bag={markers: {tip: /tip}}").out
    vicon(tmp_path / "arm.csv")
    assert "seen" in outcome("convert", "arm.csv", "to=other").out
    tip, arm = (read_recording(tmp_path / place) for place in ("recordings/swing.h5", "other/arm.h5"))
    np.testing.assert_allclose(tip.positions[:, 0], TIP, atol=1e-9)
    assert arm.labels == ("Tip", "Base")
    assert "arm.csv" in refusal("convert", "arm.csv", "other/arm.h5")
    assert "nothing to convert" in refusal("convert")
