import csv
import os
import pickle

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.refusals import refuses
from warp_resphys.data.recordings.recording_files import read_recording, write_recording
from warp_resphys.data.registration import register_markers
from warp_resphys.io.errors import DataFileError, InputError
from warp_resphys.settings.data_kinds import TableSettings


@pytest.fixture
def positions():
    """(40, 3, 3) [m] of three markers 0.1 m apart that swing."""
    time = np.arange(40) / 100.0
    swing = 0.01 * np.sin(40.0 * time)[:, None, None] * np.array([0.0, 1.0, 0.3])
    return swing + np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.1, 1.1]])


def write_table(
    path, positions, *, stamps=None, first="time [s]", unit="mm", delimiter=",", extra=()
):
    """A plain table in millimetres; a NaN becomes an empty cell."""
    header = [
        first,
        *(f"{label}.{axis} [{unit}]" for label in "abc" for axis in "xyz"),
        *(name for name, _ in extra),
    ]
    stamps = np.arange(len(positions)) / 100.0 if stamps is None else stamps
    with open(path, "w", newline="") as file:
        writer = csv.writer(file, delimiter=delimiter)
        writer.writerow(header)
        for frame, stamp in enumerate(stamps):
            cells = [
                "" if np.isnan(value) else f"{1e3 * value:.6f}"
                for value in positions[frame].ravel()
            ]
            writer.writerow(
                [f"{stamp:.4f}", *cells, *(f"{column[frame]:g}" for _, column in extra)]
            )
    return path


def edit(path, line, change):
    lines = path.read_text().splitlines()
    lines[line - 1] = change(lines[line - 1])
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("delimiter", [",", "\t"])
def test_table(tmp_path, positions, delimiter):
    positions[7:9, 1] = np.nan
    pressure = np.linspace(0.0, 39.0, 40)
    path = write_table(
        tmp_path / "swing.csv", positions, delimiter=delimiter, extra=[("valve [mbar]", pressure)]
    )
    recording = read_recording(path)
    assert recording.labels == ("a", "b", "c")
    assert recording.rate == 100.0
    np.testing.assert_allclose(recording.positions, positions, atol=1e-9)
    np.testing.assert_allclose(recording.actuation, 100.0 * pressure[:, None])
    np.testing.assert_array_equal(np.argwhere(~recording.seen), [[7, 1], [8, 1]])


def test_a_table_without_a_header(tmp_path, positions):
    """As a log has it: no header, semicolons, columns of no interest,
    times in milliseconds, a tendon's length.
    """
    path, wound = tmp_path / "swing.csv", np.linspace(0.0, 3.9, 40)
    rows = [[1000.0 + 10.0 * k, 7.0, *(1e3 * positions[k].ravel()), wound[k]] for k in range(40)]
    path.write_text("a log\n" + "\n".join(";".join(f"{x:.6f}" for x in row) for row in rows) + "\n")
    axes = [f"{label}.{axis} [mm]" for label in "abc" for axis in "xyz"]
    recording = read_recording(
        path, table=TableSettings(columns=["time [ms]", None, *axes, "tendon [mm]"], header_lines=1)
    )
    assert (recording.labels, recording.rate, recording.start) == (("a", "b", "c"), 100.0, 1.0)
    np.testing.assert_allclose(recording.positions, positions, atol=1e-8)
    np.testing.assert_allclose(recording.actuation[:, 0], 1e-3 * wound, atol=1e-8)


class TestALogThatBeganBeforeItsWinch:
    """Missing first values equal the first known one, the recording ends with the last one.

    Notes are ignored.
    """

    COLUMNS = (
        "frame",
        *(f"{label}.{axis}" for label in "abc" for axis in "xyz"),
        "winch [mm]",
        "valve [Pa]",
    )
    TABLE = TableSettings(columns=COLUMNS, header_lines=1)
    GONE = float("nan")

    def write(self, path, positions, winch, valve, ends=",,"):
        rows = []
        for k in range(40):
            values = [*positions[k].ravel(), winch[k], valve[k]]
            rows.append(f"{k},{','.join(f'{x:.6f}' for x in values)}{ends}")
        path.write_text(
            "\n".join([",".join(self.COLUMNS) + ",,from left to right", *rows]).replace("nan", "")
        )
        return path

    def read(self, path):
        return read_recording(path, units="m", rate=100.0, table=self.TABLE)

    def test_channels_are_filled_separately(self, tmp_path, positions, caplog):
        pulled, valve = np.linspace(2.0, 3.5, 40), np.arange(40.0)
        winch = np.where((np.arange(40) < 5) | (np.arange(40) >= 35), np.nan, pulled)
        recording = self.read(self.write(tmp_path / "swing.csv", positions, winch, valve))
        assert recording.positions.shape == (35, 3, 3)
        np.testing.assert_allclose(
            recording.actuation[:, 0], 1e-3 * pulled[np.clip(np.arange(35), 5, None)], atol=1e-9
        )
        np.testing.assert_array_equal(recording.actuation[:, 1], valve[:35])  # as it was logged
        assert "in its first 5 frames" in caplog.text
        assert "its last 5, which are left out" in caplog.text

    def test_a_gap_an_infinity_and_a_channel_that_ends_at_once_are_refused(
        self, tmp_path, positions
    ):
        whole, numbers = np.linspace(2.0, 3.5, 40), np.arange(40)
        path = tmp_path / "swing.csv"
        for value in (np.nan, np.inf):
            with pytest.raises(DataFileError, match="line 22: an actuation is missing"):
                self.read(self.write(path, positions, np.where(numbers == 20, value, whole), whole))
        with pytest.raises(DataFileError, match="line 32"):
            self.read(self.write(path, positions, np.where(numbers >= 30, np.inf, whole), whole))
        with pytest.raises(DataFileError, match="line 2: an actuation is missing"):
            self.read(self.write(path, positions, np.full(40, np.nan), whole))
        with pytest.raises(DataFileError, match="has an actuation in 1 frames"):
            self.read(self.write(path, positions, np.where(numbers > 0, np.nan, whole), whole))

    def test_a_line_with_too_many_cells_is_named(self, tmp_path, positions):
        path = self.write(tmp_path / "swing.csv", positions, np.ones(40), np.ones(40))
        rows = path.read_text().split("\n")
        path.write_text("\n".join([*rows[:21], rows[21] + "9", *rows[22:]]))
        refuses(DataFileError, "line 22", self.read, path)


@pytest.mark.parametrize(
    ("columns", "lines", "message"),
    [
        (["a.x", "a.y"], 0, "data.table.columns"),
        (["a.x", "a.y", "a.z", "b.x"], 0, "marker b has no column 'b.y'"),
        (["a.x", "a.y", "a.z", "pull"], 0, "'pull'"),
        (["time", "frame", None, None], 0, "columns 1 and 2 both tell the time"),
        (["a.x", "a.y", "a.z", None], 99, "data.table.columns"),
    ],
)
def test_wrong_descriptions_of_tables(tmp_path, columns, lines, message):
    path = tmp_path / "swing.csv"
    np.savetxt(path, np.arange(40.0).reshape(10, 4), delimiter=",")
    with pytest.raises(DataFileError, match=message):
        read_recording(
            path, units="mm", rate=60.0, table=TableSettings(columns=columns, header_lines=lines)
        )
    with pytest.raises(DataFileError, match=r"data\.table"):
        read_recording(
            tmp_path / "swing.npz", table=TableSettings(columns=columns, header_lines=lines)
        )


def test_lines_that_were_not_recorded_are_occlusions(tmp_path, positions):
    stamps = np.delete(np.arange(40), [10, 11, 12]) / 120.0
    path = write_table(
        tmp_path / "swing.csv", np.delete(positions, [10, 11, 12], axis=0), stamps=stamps + 3.0
    )
    recording = read_recording(path)
    assert recording.rate == 120.0  # although times were rounded to 0.1 ms
    assert recording.start == pytest.approx(3.0)
    np.testing.assert_array_equal(np.flatnonzero(~recording.seen.any(axis=1)), [10, 11, 12])
    np.testing.assert_allclose(recording.positions[13:], positions[13:], atol=1e-9)


@pytest.mark.parametrize(
    ("rate", "decimals"), [(30.0, 2), (59.94, 3), (119.88, 4), (120.0, 3), (240.0, 3), (300.0, 3)]
)
def test_rounded_times_give_the_rate_whatever_frames_are_missing(tmp_path, rate, decimals):
    frames = np.delete(np.arange(1500), [10, 300, 301, 302, *range(700, 800)])
    table = np.column_stack([np.round(frames / rate + 2.0, decimals), frames, frames, frames])
    np.savetxt(
        tmp_path / "swing.csv",
        table,
        "%.8g",
        ",",
        header="time [s],a.x [mm],a.y [mm],a.z [mm]",
        comments="",
    )
    recording = read_recording(tmp_path / "swing.csv")
    assert recording.rate == pytest.approx(rate, rel=2e-5)
    np.testing.assert_array_equal(np.flatnonzero(recording.seen[:, 0]), frames)


@pytest.mark.parametrize(
    ("line", "change", "message"),
    [
        (1, lambda line: "", "has no header that is known"),
        (1, lambda line: line.replace("time [s]", "time [min]"), "gives its time in 'min'"),
        (1, lambda line: line.replace("b.y", "b.w"), r"column 6 is named 'b\.w', which is neither"),
        (1, lambda line: line.replace("c.z", "c.y"), r"has two columns named 'c\.y'"),
        (1, lambda line: line.replace("c.z [mm]", "c.z [cm]"), "gives positions in 'cm', 'mm'"),
        (1, lambda line: line.replace("[mm]", "[inch]"), "gives positions in 'inch'"),
        (1, lambda line: line.replace("[mm]", ""), "does not say in which unit"),
        (5, lambda line: line.replace(",0.000000,", ",left,", 1), "'left'"),
        (6, lambda line: line.rpartition(",")[0], "line 6"),
        (7, lambda line: "0.0499" + line[6:], None),
        (7, lambda line: "0.0540" + line[6:], "line 7"),
        (8, lambda line: "0.0100" + line[6:], "line 8: the time or frame does not rise"),
        (8, lambda line: "1e308" + line[6:], "line 8"),
        # Not in cubic time.
        (1, lambda line: line.replace("b.y", "b" + 20_000 * " " + "y"), "column 6 is named"),
    ],
)
def test_errors_of_tables_name_line_and_column(tmp_path, positions, line, change, message):
    path = edit(write_table(tmp_path / "swing.csv", positions), line, change)
    if message is None:
        assert read_recording(path).rate == 100.0
        return
    refuses(DataFileError, rf"swing\.csv.*{message}", read_recording, path)


@pytest.mark.parametrize(
    "stamps", [np.arange(40) * 1e-310, [*np.arange(39) * 1e-310, 1e3], 1e11 + np.arange(40) * 1e-6]
)
def test_times_that_are_too_close_are_refused(tmp_path, positions, stamps):
    path = write_table(tmp_path / "swing.csv", positions)
    for line, stamp in enumerate(stamps, start=2):
        edit(path, line, lambda text, stamp=float(stamp): f"{stamp!r}{text[6:]}")
    refuses(
        DataFileError,
        r"a frame rate of inf|do not belong to one recording|does not rise",
        read_recording,
        path,
    )


def archive(path, positions, **changes):
    content = {
        "positions": positions,
        "labels": np.array(["a", "b", "c"]),
        "rate_hz": 100.0,
        **changes,
    }
    np.savez(path, **{name: value for name, value in content.items() if value is not None})
    return path


def test_numpy_archive(tmp_path, positions):
    pressure = np.ones((40, 2))
    more = {
        "units": "mm",
        "actuation": pressure,
        "actuation_units": "kPa",
        "rest": 1e3 * positions[0],
    }
    path = archive(tmp_path / "swing.npz", 1e3 * positions, **more)
    recording = read_recording(path)
    np.testing.assert_allclose(recording.positions, positions)
    np.testing.assert_allclose(recording.actuation, 1e3 * pressure)
    np.testing.assert_allclose(recording.rest, positions[0])
    picked = recording.select(["c", "a"])
    np.testing.assert_array_equal(picked.rest, recording.rest[[2, 0]])
    np.testing.assert_array_equal(picked.positions, recording.positions[:, [2, 0]])
    named = read_recording(archive(tmp_path / "plain.npz", positions, labels=None))
    assert named.labels == ("marker 1", "marker 2", "marker 3")
    assert read_recording(path, labels=["x", "y", "z"]).labels == ("x", "y", "z")
    assert read_recording(path, labels=["*", "", "*"]).labels == ("* #1", "marker 2", "* #2")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rate_hz": None}, "does not say how many frames a second"),
        ({"rate_hz": -1.0}, "frame rate of -1"),
        ({"positions": None}, "has no array 'positions'"),
        (
            {"positions": np.zeros((40, 9))},
            r"positions must be \(frames, markers, 3\), not \(40, 9\)",
        ),
        ({"positions": np.full((40, 3, 3), np.nan)}, "no marker is seen in any frame"),
        ({"labels": np.array(["a", "b"])}, "has 3 markers and 2 labels"),
        ({"units": "ft"}, "gives positions in 'ft'"),
        (
            {"units": "cm", "positions": np.random.default_rng(0).normal(size=(40, 3, 3)) * 1e5},
            "markers span .* set units to it",
        ),
        (
            {"positions": np.random.default_rng(0).normal(size=(40, 3, 3)) * 1e-6},
            "all markers lie within",
        ),
        (
            {"actuation": np.zeros((39, 2))},
            r"actuation has the shape \(39, 2\).* each of the 40 frames",
        ),
        ({"actuation": np.full((40, 2), np.nan)}, "an actuation is NaN"),
        (
            {"base": np.ones((40, 6))},
            r"base has the shape \(40, 6\); it needs a place and a quaternion",
        ),
        (
            {"actuation": np.zeros((40, 2)), "actuation_units": "psi"},
            "gives its actuation in 'psi'",
        ),
        ({"rest": np.zeros((2, 3))}, r"rest has the shape \(2, 3\)"),
        ({"start": np.inf}, "its first frame is at inf s"),
        ({"rate_hz": np.full(40, 100.0)}, r"'rate_hz' has the shape \(40,\)"),
        (
            {"actuation": np.full((40, 2), 1e308), "actuation_units": "bar"},
            "an actuation is NaN or infinite",
        ),
    ],
)
def test_wrong_archives(tmp_path, positions, changes, message):
    with pytest.raises(DataFileError, match=rf"swing\.npz.*{message}"):
        read_recording(archive(tmp_path / "swing.npz", **{"positions": positions, **changes}))


def test_arrays_larger_than_any_recording_are_not_read(tmp_path, positions, monkeypatch):
    monkeypatch.setattr("warp_resphys.io.safe_files.LARGEST_ARRAYS", 10 << 20)
    zeros = np.zeros((200_000, 3, 3))  # 14 MB, of which little is left in the file
    np.savez_compressed(tmp_path / "swing.npz", positions=zeros, rate_hz=100.0)
    assert (tmp_path / "swing.npz").stat().st_size < 1 << 20
    refuses(
        DataFileError,
        r"swing\.npz .* \(its arrays are larger than",
        read_recording,
        tmp_path / "swing.npz",
    )
    with h5py.File(tmp_path / "swing.h5", "w") as file:
        # Nothing of it in the file.
        file.create_dataset("positions", (1 << 40, 3, 3), "f8", chunks=(64, 3, 3))
    with pytest.raises(
        DataFileError, match=r"swing\.h5 is damaged \(it takes more than 2048 MiB of memory\)"
    ):
        read_recording(tmp_path / "swing.h5")


class Payload:
    """Runs a command when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


def test_objects_in_an_archive_are_refused_and_not_run(tmp_path, positions):
    path = archive(
        tmp_path / "swing.npz",
        positions,
        labels=np.array([Payload(tmp_path / "ran")], dtype=object),
    )
    refuses(DataFileError, "Python objects", read_recording, path)
    (tmp_path / "bare.npz").write_bytes(pickle.dumps(Payload(tmp_path / "ran")))
    refuses(DataFileError, "Python objects", read_recording, tmp_path / "bare.npz")
    assert not (tmp_path / "ran").exists()


def test_damaged_and_foreign_files(tmp_path, positions):
    whole = archive(tmp_path / "swing.npz", positions).read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    refuses(
        DataFileError,
        r"cut\.npz is not a NumPy file of plain arrays",
        read_recording,
        tmp_path / "cut.npz",
    )
    np.save(tmp_path / "single.npy", positions)
    (tmp_path / "single.npy").rename(tmp_path / "single.npz")
    refuses(DataFileError, "is a single array", read_recording, tmp_path / "single.npz")
    for name in ("absent.npz", "absent.csv", "absent.c3d", "absent.h5"):
        refuses(DataFileError, r"No such file|does not exist", read_recording, tmp_path / name)
    (tmp_path / "empty.csv").touch()
    refuses(DataFileError, "has no header that is known", read_recording, tmp_path / "empty.csv")
    refuses(
        DataFileError, "is no recording that can be read", read_recording, tmp_path / "swing.mat"
    )


def test_arguments_are_checked(tmp_path, positions):
    path = archive(tmp_path / "swing.npz", positions)
    for given, message in (
        ({"units": "inch"}, "units is 'inch'"),
        ({"rate": 0.0}, r"rate is 0\.0"),
        ({"labels": ["a"]}, "labels has 1 names; .* has 3 markers"),
    ):
        refuses(InputError, message, read_recording, path, **given)


def test_hdf5_gives_back_what_was_written(tmp_path, positions):
    positions[3, 1] = np.nan
    base = np.random.default_rng(0).standard_normal((40, 7))
    more = {"actuation": np.ones((40, 2)), "rest": positions[0], "base": base}
    source = archive(tmp_path / "swing.npz", positions, start=0.003, **more)
    before = read_recording(source)
    write_recording(tmp_path / "new" / "swing.h5", before, {"weight_kg": 0.05})
    after = read_recording(tmp_path / "new" / "swing.h5")
    for name in ("positions", "actuation", "rest"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert before.base is not None
    np.testing.assert_allclose(after.base, before.base, atol=1e-12)
    np.testing.assert_array_equal(before.base[0], 0.0)
    assert (after.labels, after.rate, after.start) == (before.labels, before.rate, 0.003)
    with h5py.File(tmp_path / "new" / "swing.h5") as file:
        assert file.attrs["weight_kg"] == 0.05
        assert file["positions"].attrs["units"] == "m"


def plate(count=20):
    """(T, 3) and (T, 4) a rigid body that moves and turns,
    and the points on its axes (T, 3, 3), in m.
    """
    turn = Rotation.from_rotvec(np.linspace(0.0, 2.5, count)[:, None] * [0.6, 0.0, 0.8])
    place = np.linspace([0.0, 0.0, 0.0], [0.1, -0.05, 0.02], count)
    arms = place[:, None] + 0.05 * np.stack([turn.apply(axis) for axis in np.eye(3)], axis=1)
    return place, turn.as_quat()[:, [3, 0, 1, 2]], arms


def test_a_rigid_body_is_four_markers(tmp_path, positions):
    place, quaternion, arms = plate()
    path = tmp_path / "swing.npz"
    turns = np.stack([np.full((20, 4), np.nan), -quaternion], axis=1)  # of either sign
    turns[3] = np.nan  # the place alone was seen
    both = np.stack([positions[:20, 0], place], axis=1)
    np.savez(path, positions=both, quaternions=turns, labels=["a", "plate"], rate_hz=100.0)
    recording = read_recording(path)
    assert recording.labels == ("a", "plate", "plate +x", "plate +y", "plate +z")
    np.testing.assert_allclose(recording.positions[:, 1], place, atol=1e-8)
    seen = np.arange(20) != 3
    np.testing.assert_allclose(recording.positions[seen, 2:], arms[seen], atol=1e-8)
    assert not recording.seen[3, 2:].any()
    nominal = np.concatenate([[[0.0, 0.0, 0.0]], 0.05 * np.eye(3)])
    names = recording.labels[1:]
    fitted = register_markers(recording.positions[10, 1:], nominal, names, source=path)
    assert fitted.rms < 1e-7  # one rigid body registers
