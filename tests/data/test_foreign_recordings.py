"""C3D files, tables with names, dates and decimal commas, Vicon's export, and their conversion."""

import ezc3d
import numpy as np
import pytest

from support.command_line import outcome, refusal
from support.refusals import refuses
from warp_resphys import DataFileError, read_recording
from warp_resphys.io import decoding
from warp_resphys.settings.data_kinds import TableSettings

TIMES = 100.0 + np.arange(30) / 50.0
TIP = np.stack([0.02 * np.sin(5.0 * TIMES), 0.1 + 0.0 * TIMES, 0.01 * TIMES], -1)


def table(path, header, times, separator=","):
    """A table with the tip in millimetres and a pressure."""
    rows = [
        [time, *(f"{1e3 * x:.6f}" for x in tip), "12.5"]
        for time, tip in zip(times, TIP, strict=True)
    ]
    path.write_text("\n".join([*header, *(separator.join(map(str, row)) for row in rows)]))
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
        with pytest.raises(
            DataFileError,
            match=rf"a\.csv, line 5, column 1: '{wrong}' is no date and time as the oth",
        ):
            read_recording(path)
    with pytest.raises(
        DataFileError, match="gives its time in 'h': it must be in s, ms, us, ns or iso"
    ):
        read_recording(table(tmp_path / "a.csv", [HEADER.format(" [h]")], range(30)))


NAMES = {"t": "time [s]", "X (mm)": "tip.x [mm]", "Y (mm)": "tip.y [mm]", "Z (mm)": "tip.z [mm]"}


def test_columns_are_chosen_by_the_names_of_the_file(tmp_path):
    times = [f"{time - 100.0:.3f}" for time in TIMES]
    lines = ["recorded on a Monday", "t\tX (mm)\tY (mm)\tZ (mm)\tpump"]
    path = table(tmp_path / "a.tsv", lines, times, "\t")
    read = read_recording(
        path, table=TableSettings(names={**NAMES, "pump": "pump [kPa]"}, header_lines=1)
    )
    np.testing.assert_allclose(read.positions[:, 0], TIP, atol=1e-9)
    np.testing.assert_allclose(read.actuation, 12.5e3)
    assert read_recording(path, table=TableSettings(names=NAMES, header_lines=1)).actuation is None
    with pytest.raises(
        DataFileError,
        match=r"line 2: data\.table\.names has 'X', which 0 columns are named; it has 't'",
    ):
        read_recording(path, table=TableSettings(names={**NAMES, "X": "a.x"}, header_lines=1))


def test_recordings_are_converted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table(tmp_path / "arm.csv", [HEADER.format(" [s]")], [f"{time:.2f}" for time in TIMES])
    assert "seen" in outcome("convert", "arm.csv", "to=other").out
    arm = read_recording(tmp_path / "other/arm.h5")
    assert arm.labels == ("tip",)
    np.testing.assert_allclose(arm.positions[:, 0], TIP, atol=1e-9)
    assert "arm.csv" in refusal("convert", "arm.csv", "other/arm.h5")
    assert "nothing to convert" in refusal("convert")


def write_c3d(path, positions, labels, unit="mm", rate=200.0):
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    file["parameters"]["POINT"]["RATE"]["value"] = [rate]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(labels)
    file["data"]["points"] = np.concatenate(
        [positions.transpose(2, 1, 0), np.ones((1, positions.shape[1], len(positions)))]
    )
    file.write(str(path))
    return path


@pytest.fixture
def trajectory():
    generator = np.random.default_rng(3)
    return generator.normal(size=(40, 3, 3)).cumsum(axis=0)


@pytest.mark.parametrize(
    ("unit", "size"), [("mm", 1e3), ("MM\0", 1e3), ("Meters", 1.0), (" metre ", 1.0), ("CM", 1e2)]
)
def test_read_c3d_converts_units_and_keeps_occlusions(tmp_path, trajectory, caplog, unit, size):
    trajectory[7:9, 1] = np.nan
    trajectory[3, 2] = 0.0
    labels = ["Arm:Tip", "Arm:Fuß", "*31"]
    path = write_c3d(tmp_path / "small.c3d", size * trajectory, labels, unit)
    recording = read_recording(path.rename(tmp_path / "SMALL.C3D"))
    assert recording.labels == ("Tip", "Fuß", "*31")
    assert recording.rate == 200.0
    trajectory[3, 2] = np.nan
    np.testing.assert_allclose(recording.positions, trajectory, rtol=1e-6, atol=1e-9)
    assert "1 position at exactly (0, 0, 0) read as occluded, of '*31'" in caplog.text


def test_c3d_files_with_more_than_255_markers_and_without_model_outputs(tmp_path):
    positions = np.random.default_rng(0).normal(size=(5, 600, 3))
    labels = [f"Tip {number}" for number in range(600)]
    file = read_recording(write_c3d(tmp_path / "many.c3d", positions, labels))
    assert file.labels == tuple(labels)
    np.testing.assert_allclose(file.positions, 1e-3 * positions, rtol=1e-6)
    other = ezc3d.c3d(str(tmp_path / "many.c3d"))
    other.add_parameter("POINT", "ANGLES", ["Tip 3", "Tip 599"])
    other.write(str(tmp_path / "angles.c3d"))
    assert read_recording(tmp_path / "angles.c3d").labels == tuple(labels[:3] + labels[4:599])


@pytest.mark.parametrize("content", ["this is no recording", ""])
def test_foreign_files(tmp_path, content):
    (tmp_path / "notes.c3d").write_text(content)
    refuses(DataFileError, "not a C3D file", read_recording, tmp_path / "notes.c3d")


def test_an_unknown_unit_and_the_byte_order_of_sgi_are_refused(tmp_path, trajectory):
    with pytest.raises(DataFileError, match="positions in 'inch'"):
        read_recording(write_c3d(tmp_path / "inch.c3d", trajectory, "abc", unit="inch"))
    content = bytearray(write_c3d(tmp_path / "a.c3d", trajectory, "abc").read_bytes())
    content[(content[0] - 1) * 512 + 3] = 86
    (tmp_path / "a.c3d").write_bytes(content)
    with pytest.raises(
        DataFileError,
        match=r"a\.c3d has the byte order of SGI \(MIPS\) computers, which is not read",
    ):
        read_recording(tmp_path / "a.c3d")


@pytest.mark.parametrize("part", [0.001, 0.3, 0.98])
def test_truncated_file(tmp_path, trajectory, part):
    content = write_c3d(tmp_path / "whole.c3d", np.tile(trajectory, (10, 1, 1)), "abc").read_bytes()
    cut = tmp_path / "cut.c3d"
    cut.write_bytes(content[: int(part * len(content))])
    refuses(DataFileError, "truncated", read_recording, cut)


@pytest.mark.parametrize(
    ("name", "after", "value", "limits", "message"),
    [
        ("CONTACT", 10, 0xFF, {}, "ezc3d ends with -11"),  # of -1 dimensions
        # -32768 values a frame
        ("RATIO", 10, 0x80, {"MEMORY": (1 << 29, 0)}, "it takes more than 512 MiB of memory"),
        ("CONTACT", 10, 0x7F, {"SECONDS": (1.0, 0.0)}, "takes more than 1 s"),  # of 127 dimensions
    ],
)
def test_a_changed_byte_that_crashes_the_decoder_or_makes_it_claim_memory_or_time(
    tmp_path, trajectory, monkeypatch, name, after, value, limits, message
):
    path = write_c3d(tmp_path / "whole.c3d", trajectory, "abc")
    content = bytearray(path.read_bytes())
    content[content.index(name.encode()) + after] = value
    path.write_bytes(content)
    for limit, given in limits.items():
        monkeypatch.setattr(decoding, limit, given)
    refuses(
        DataFileError, rf"whole\.c3d cannot be decoded \(.*{message}\): copy", read_recording, path
    )


def test_uneven_times_are_sampled_again(tmp_path, caplog):
    """Positions are linear between lines, inputs hold,
    a long gap is an occlusion, and a last line may be cut off.
    """
    lines = [
        "t, X, Y, Z, p",
        *(f"{t}, {20.0 * t}, 0, 0, {p}" for t, p in ((5.0, 1), (5.03, 2), (5.11, 3), (5.13, 4))),
    ]
    lines += [f"{t}, {20.0 * t}, 0, 0, 5" for t in (5.45, 5.5)]
    path = tmp_path / "loop.csv"
    path.write_text("\n".join([*lines, "5.55, 11.1, 0"]))
    names = {"t": "time [s]", "X": "a.x [mm]", "Y": "a.y [mm]", "Z": "a.z [mm]", "p": "p [kPa]"}
    read = read_recording(path, table=TableSettings(names=names, rate=20.0))
    times = 5.0 + 0.05 * np.arange(11)
    expected = np.where((times > 5.14) & (times < 5.44), np.nan, 0.02 * times)
    np.testing.assert_allclose(read.positions[:, 0, 0], expected, rtol=1e-12)
    np.testing.assert_allclose(
        read.actuation[:, 0], 1e3 * np.array([1, 2, 2, 4, 4, 4, 4, 4, 4, 5, 5])
    )
    assert (read.rate, read.start) == (20.0, 5.0)
    assert "loop.csv: the last line, 8, is cut off, and left out." in caplog.text
    path.write_text("\n".join(lines))
    refuses(
        DataFileError,
        "the frames are not evenly spaced",
        read_recording,
        path,
        table=TableSettings(names=names),
    )
    path.write_text("\n".join([*lines[:3], lines[1], *lines[3:]]))
    sampled = TableSettings(names=names, rate=20.0)
    refuses(
        DataFileError,
        "line 4: the time or frame does not rise",
        read_recording,
        path,
        table=sampled,
    )


def test_unseen_cells_of_uneven_times_stay_where_they_are(tmp_path):
    """Each coordinate is linear between the lines that have it,
    and inputs hold where a line has none.
    """
    rows = [
        (0.0, 0.0, 1),
        (0.03, "", 2),
        (0.05, 50.0, ""),
        (0.11, "", ""),
        (0.15, "", 3),
        (0.2, 200.0, 4),
    ]
    path = tmp_path / "loop.csv"
    path.write_text("\n".join(["t, X, Y, Z, p", *(f"{t}, {x}, 0, 0, {p}" for t, x, p in rows)]))
    names = {"t": "time [s]", "X": "a.x [mm]", "Y": "a.y [mm]", "Z": "a.z [mm]", "p": "p [kPa]"}
    read = read_recording(path, table=TableSettings(names=names, rate=20.0))
    np.testing.assert_allclose(read.positions[:, 0, 0], [0.0, 0.05, 0.1, 0.15, 0.2], atol=1e-12)
    np.testing.assert_allclose(read.actuation[:, 0], [1e3, 2e3, 2e3, 3e3, 4e3])
    few = TableSettings(names=names, rate=1.0)
    refuses(
        DataFileError,
        "has less than two frames at 1 Hz: raise data.table.rate",
        read_recording,
        path,
        table=few,
    )
    path.write_text(
        "\n".join(["t, X, Y, Z, p", *(f"{t}, 0, 0, 0, 1" for t in (0, 0.05, 0.1, 1732886400.0))])
    )
    foreign = "line 5: from the line before on, time or frame passes from 0.1 to"
    refuses(
        DataFileError, foreign, read_recording, path, table=TableSettings(names=names, rate=20.0)
    )
