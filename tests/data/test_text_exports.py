"""Tables of six systems and of spreadsheets, in the encodings,
languages and versions that laboratories have.
"""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.command_line import outcome, refusal
from support.refusals import refuses
from warp_resphys import DataFileError, read_recording

FRAMES, TIME = np.arange(1, 31), np.arange(30) / 100.0
TIP = np.stack([100 + 9 * np.sin(9 * TIME), 0 * TIME + 2, 5 * TIME + 1], -1)  # [mm]
BASE = np.stack([0 * TIME - 40, 0 * TIME + 3, 0 * TIME + 1], -1)
TURN = Rotation.from_rotvec(np.linspace(0.1, 1.5, 30)[:, None] * [0.6, 0.1, 0.7])
UNSEEN = TIP * np.where(np.isin(FRAMES, (5, 6)), 0.0, 1.0)[:, None]


def rows(separator, *columns, decimal="."):
    lines = np.column_stack(columns).tolist()
    return (
        "\n".join(separator.join(f"{x:.8g}".replace(".", decimal) for x in line) for line in lines)
        + "\n"
    )


def qualisys(data, names, included="3D"):
    kind = "MARKER" if included == "3D" else "BODY"
    return (
        "NO_OF_FRAMES\t30\n"
        "FREQUENCY\t100\n"
        "DESCRIPTION\t--\n"
        "TIME_STAMP\t2026-03-04, 10:11:12.345\t123.4\n"
        "EVENT\tgo\t12\t0.12\n"
        f"DATA_INCLUDED\t{included}\n"
        f"{kind}_NAMES\tSpitze_Ä\tFuß\n"
        f"{names}{data}"
    )


def pose(place, turn, seen=1.0):
    """Columns of a rigid body of Qualisys: place, angles,
    residual, and the matrix by its columns.
    """
    entries = turn.as_matrix().swapaxes(1, 2).reshape(30, 9)
    return np.column_stack(
        [place, turn.as_euler("XYZ", degrees=True), 0.0 * TIME, entries]
    ) * np.reshape(seen, (-1, 1))


AXES = ["X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *(f"Rot[{entry}]" for entry in range(9))]
NAMES_3D = (
    "Frame\tTime\t"
    + "\t".join(f"{label} {axis}" for label in ("Spitze_Ä", "Fuß") for axis in "XYZ")
    + "\n"
)
NAMES_6D = (
    "Frame\tTime\t"
    + "\t".join(f"{label} {axis}" for label in ("Spitze_Ä", "Fuß") for axis in AXES)
    + "\n"
)
ANGLES_6D = "Frame\t" + "\t".join(AXES[:6] * 2) + "\n"
POSES = [pose(TIP, TURN), pose(BASE, Rotation.identity(30))]


def motive(kinds, axes, data, take="swing", order="Quaternion"):
    """A heading of Motive, by (kind, name, part) of each column."""
    lines = zip(("Type", "Name", ""), zip(*kinds, strict=True), strict=True)
    heads = [",".join(["", head, *cells]) for head, cells in lines]
    keys = (
        f"Format Version,1.25,Take Name,{take},Take Notes,,Capture Frame Rate,100.0,Export Frame "
        "Rate,100.0,"
    )
    keys += f"Rotation Type,{order},Length Units,Millimeters,Coordinate Space,Global\n\n"
    return keys + "\n".join([*heads, "Frame,Time (Seconds)," + axes]) + "\n" + data


MARKERS = [("Marker", name, "Position") for name in ("Spitze_Ä", "Fuß") for _ in "XYZ"]
BODY = [*[("Rigid Body", "plate", "Rotation")] * 3, *[("Rigid Body", "plate", "Position")] * 3]
SOLVED = [("Rigid Body Marker", "plate:Marker1", "Position")] * 3


def vicon(names, axes, units, data, section="Trajectories"):
    return f"{section}\n100\n,,{names}\nFrame,Sub Frame,{axes}\n,,{units}\n{data}\n"


def trajectories(*names):
    heads = [",".join([text] * len(names)) for text in ("X,Y,Z", "mm,mm,mm")]
    return vicon(
        ",,,".join(names), *heads, rows(",", FRAMES, 0 * TIME, *[TIP, BASE, BASE][: len(names)])
    )


def objects(
    numbers, axes="RX,RY,RZ,", units="rad,rad,rad,", name="Global Angle Tip:Tip", section="Objects"
):
    return vicon(
        name,
        f"{axes}TX,TY,TZ",
        f"{units}mm,mm,mm",
        rows(",", FRAMES, 0 * TIME, numbers, TIP),
        section,
    )


ROTVEC = TURN.as_rotvec()
DEVICES = "Devices\n1000\n,,Force\nFrame,Sub Frame,Fx\n,,N\n1,0,1\n1,1,2\n\n"
ENGLISH = "Time (s)\tTip X (mm)\tTip Y (mm)\tTip Z (mm)\n"
FILES = {  # text, encoding, labels, and whether the first one turns
    "qualisys 3D": (
        qualisys(rows("\t", FRAMES, TIME, TIP, BASE), NAMES_3D),
        "cp1252",
        "Spitze_Ä Fuß",
        False,
    ),
    "qualisys 3D, zeros": (
        qualisys(rows("\t", FRAMES, TIME, UNSEEN, BASE), NAMES_3D),
        "utf-8",
        "Spitze_Ä Fuß",
        False,
    ),
    "qualisys 3D, no frames": (
        qualisys(
            rows("\t", UNSEEN, BASE).replace("\n", "\t\n"), NAMES_3D.removeprefix("Frame\tTime\t")
        ),
        *("utf-8", "Spitze_Ä Fuß", False),
    ),
    "qualisys 3D, NULL": (
        qualisys(
            rows("\t", FRAMES, TIME, UNSEEN, BASE).replace("\t0\t0\t0\t", "\tNULL\tNULL\tNULL\t"),
            "",
        ),
        *("utf-8", "Spitze_Ä Fuß", False),
    ),
    "qualisys 3D, residuals": (
        qualisys(
            rows("\t", FRAMES, TIP, TIME, BASE, TIME),
            "Frame\tA X\tA Y\tA Z\tA Residual\tB X\tB Y\tB Z\tB Residual\n",
        ),
        *("utf-8", "Spitze_Ä Fuß", False),
    ),
    "qualisys 6D": (
        qualisys(rows("\t", FRAMES, TIME, *POSES), NAMES_6D, "6D"),
        "cp1252",
        "Spitze_Ä Fuß",
        True,
    ),
    "qualisys 6D, angles": (
        qualisys(
            rows("\t", FRAMES, TIP, TURN.as_euler("XYZ", degrees=True), *POSES[1].T[:6]),
            ANGLES_6D,
            "6D",
        ),
        *("utf-8", "Spitze_Ä Fuß", True),
    ),
    "qualisys 6D, no names": (
        qualisys(rows("\t", *POSES), "", "6D"),
        "utf-8",
        "Spitze_Ä Fuß",
        True,
    ),
    "qualisys 6D, commas": (
        qualisys(rows("\t", FRAMES, TIME, *POSES, decimal=","), NAMES_6D, "6D").replace("\t", ";"),
        *("cp1252", "Spitze_Ä Fuß", True),
    ),
    "qualisys 6D, zeros": (
        qualisys(
            rows("\t", FRAMES, TIME, pose(TIP, TURN, UNSEEN[:, 0] != 0.0), POSES[1]), NAMES_6D, "6D"
        ),
        *("utf-8", "Spitze_Ä Fuß", True),
    ),
    "motive": (
        motive(MARKERS, "X,Y,Z,X,Y,Z", rows(",", FRAMES, TIME, TIP, BASE), "Übung, schnell, 2"),
        *("cp1252", "Spitze_Ä Fuß", False),
    ),
    "motive, no rotation": (
        motive(
            [("Rigid Body", "plate", "Position")] * 2
            + [*MARKERS[:3], ("Marker", "Spitze_Ä", "Marker Quality")],
            "X,Y,X,Y,Z,",
            rows(",", FRAMES, TIME, TIP[:, :2], TIP, TIME),
        ),
        *("utf-8", "Spitze_Ä", False),
    ),
    "motive, angles": (
        motive(
            [*BODY, *SOLVED],
            "X,Y,Z,X,Y,Z,X,Y,Z",
            rows(",", FRAMES, TIME, TURN.as_euler("ZYX", degrees=True)[:, ::-1], TIP, TIP),
            '"swing, fast"',
            "ZYX",
        ),
        *("utf-8-sig", "plate", True),
    ),
    "motive, quaternions": (
        motive([BODY[0], *BODY], "X,Y,Z,W,X,Y,Z", rows(",", FRAMES, TIME, TURN.as_quat(), TIP)),
        *("utf-8", "plate", True),
    ),
    "motive, solved": (
        motive(SOLVED, "X,Y,Z", rows(",", FRAMES, TIME, TIP)),
        "utf-8",
        "plate:Marker1",
        False,
    ),
    "nexus": (trajectories("Arm:Tip", "Arm:Base", "*31"), "utf-8", "Tip Base *31", False),
    "nexus, devices": (DEVICES + trajectories("Arm:Tip", "Arm:Base"), "utf-8", "Tip Base", False),
    "nexus, a colon": (
        trajectories("Arm:Tip", "Arm:Base", "Unlabeled:u3"),
        "utf-8",
        "Tip Base Unlabeled:u3",
        False,
    ),
    "nexus, two subjects": (
        trajectories("Arm:Tip", "Post:Base", "*31"),
        "utf-8",
        "Arm:Tip Post:Base *31",
        False,
    ),
    "tracker": (objects(ROTVEC), "utf-8", "Tip", True),
    "tracker, degrees": (
        objects(np.degrees(ROTVEC), units="deg,deg,deg,", name="Tip"),
        "utf-16",
        "Tip",
        True,
    ),
    "tracker, quaternions": (objects(TURN.as_quat(), "RX,RY,RZ,RW,", ",,,,"), "utf-8", "Tip", True),
    "tracker, both": (
        objects(ROTVEC) + trajectories("Arm:Tip", "Arm:Base"),
        "utf-8",
        "Tip Arm:Tip Base",
        True,
    ),
    "tracker, both ways": (
        trajectories("Arm:Tip", "Arm:Base") + "\n" + objects(ROTVEC),
        "utf-8",
        "Tip Arm:Tip Base",
        True,
    ),
    "nexus, segments": (DEVICES + objects(ROTVEC, section="Segments"), "utf-8", "Tip", True),
    "excel": (ENGLISH + rows("\t", TIME, TIP, decimal=","), "utf-16", "Tip", False),
    "excel, little": (ENGLISH + rows("\t", TIME, TIP), "utf-16-le", "Tip", False),
    "excel, big": (ENGLISH + rows("\t", TIME, TIP), "utf-16-be", "Tip", False),
    "excel, german": (
        "sep=;\nZeit [s];Spitze_Ä_x [mm];Spitze_Ä_y [mm];Spitze_Ä_z [mm]\n"
        + rows(";", TIME, TIP, decimal=","),
        *("cp1252", "Spitze_Ä", False),
    ),
    "excel, two lines": (
        "Run 3\n\n,Tip,,,Base\nt,x,y,z,x,y,z\ns,mm,mm,mm,mm,mm,mm\n" + rows(",", TIME, TIP, BASE),
        *("utf-8", "Tip Base", False),
    ),
    "time of day": (
        "time,Tip.x [MM],Tip.y [Millimetres],Tip.z [mm]\n"
        + "\n".join(
            f"9:59:{59 + x:06.3f},{row}"
            for x, row in zip(TIME, rows(",", TIP).split(), strict=True)
        ),
        *("utf-8", "Tip", False),
    ),
}


@pytest.mark.filterwarnings("ignore:A text is not in UTF-8")
@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_an_export_is_read(tmp_path, caplog, name, end):
    text, encoding, labels, turns = FILES[name]
    path = tmp_path / "A.CSV"
    path.write_bytes(text.replace("\n", end).encode(encoding))
    read = read_recording(path)
    assert read.labels[: len(labels.split())] == tuple(labels.split())
    assert read.rate == 100.0
    zeros = "zeros" in name or "no frames" in name
    seen = UNSEEN[:, 0] != 0.0 if zeros or "NULL" in name else np.ones(30, bool)
    np.testing.assert_array_equal(read.seen[:, 0], seen)
    assert ("2 positions at exactly (0, 0, 0) read as occluded" in caplog.text) == zeros
    np.testing.assert_allclose(1e3 * read.positions[seen, 0], TIP[seen], atol=1e-5)
    if turns:
        first = read.labels.index(f"{read.labels[0]} +x")
        arms = 1e3 * (read.positions[:, first : first + 3] - read.positions[:, :1])
        np.testing.assert_allclose(
            arms[seen], 50.0 * TURN.as_matrix().swapaxes(1, 2)[seen], atol=1e-5
        )
    else:
        assert not any(label.endswith("+x") for label in read.labels)

    assert (
        "rigid bodies without a position and a quaternion are not read ('plate')" in caplog.text
    ) == (name == "motive, no rotation")


@pytest.mark.filterwarnings("ignore:A text is not in UTF-8")
@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "qualisys 3D",
            "FREQUENCY\t100",
            "FREQUENCY\tEXT",
            "does not say how many frames a second",
        ),
        ("qualisys 3D", "FREQUENCY\t100", "FREQUENCY", "does not say how many frames a second"),
        ("qualisys 3D", "_NAMES\tSpitze_Ä", "_NAMES", "numbers do not fit 1 markers"),
        ("qualisys 3D", "MARKER_NAMES", "NAMES", "has no MARKER_NAMES"),
        (
            "qualisys 3D, no frames",
            "FRAMES\t30",
            "FRAMES\t31",
            "has 30 of the 31 frames of its NO_OF_FRAMES, and no",
        ),
        ("qualisys 6D", "Fuß Rot[8]", "Fuß Rest", r"rigid body Fuß has no column 'Fuß\.rot\[8\]'"),
        ("qualisys 3D", "\n3\t", "\n2\t", r"line 11: the time or frame does not rise"),
        ("motive", "Millimeters", "Cubits", "gives positions in 'Cubits'"),
        ("motive", "Fuß", "Spitze_Ä", r"two columns named 'Spitze_Ä\.x'"),
        ("motive", "Marker", "Bone", "holds no markers"),
        ("motive", "Frame,Time", "Time", "has no line that begins with 'Frame'"),
        ("nexus", ",mm\n", ",m\n", "no markers in one unit and at one rate"),
        ("nexus", "Frame,Sub", "Sub", "has no whole section 'Trajectories'"),
        ("nexus", "Trajectories", "Joints", "has no markers in one unit"),
        ("tracker, both", "Trajectories\n100", "Trajectories\n50", "rates: '100.0', '50.0' Hz"),
    ],
)
def test_a_wrong_export_is_named(tmp_path, name, old, new, message):
    text, encoding, *_ = FILES[name]
    assert old in text
    (tmp_path / "a.csv").write_bytes(text.replace(old, new).encode(encoding))
    refuses(DataFileError, rf"a\.csv.*{message}", read_recording, tmp_path / "a.csv")


@pytest.mark.parametrize("names", ["", NAMES_3D])
def test_the_frames_of_an_export_are_counted(tmp_path, names):
    lines = qualisys(rows("\t", FRAMES, TIME, TIP, BASE), names).split("\n")
    kept = [
        line for number, line in enumerate(lines, start=31 - len(lines)) if number not in (0, 6, 7)
    ]
    (tmp_path / "a.tsv").write_text("\n".join(kept))
    read = read_recording(tmp_path / "a.tsv")
    np.testing.assert_array_equal(np.flatnonzero(~read.seen.any(axis=1)), [5, 6])
    np.testing.assert_allclose(
        1e3 * read.positions[[0, 4, 7, 28], 0], TIP[[1, 5, 8, 29]], atol=1e-5
    )
    assert read.start == pytest.approx(0.01)


PLANAR = np.column_stack([TIP[:, :2], 0 * TIME])
BARE = {  # of tables without units, or without a rate
    "t,x1,y1,z1,x2,y2,z2": (rows(",", TIME, TIP, BASE), TIP, ("1", "2")),
    "pt1_X,pt1_Y,pt1_Z,pt2_X,pt2_Y,pt2_Z": (rows(",", TIP, BASE), TIP, ("pt1", "pt2")),
    "mass_A\nt\tx\ty": (rows("\t", TIME, TIP[:, :2]), PLANAR, ("mass_A",)),
    "# t x y z": (rows(" ", TIME, TIP), TIP, ("marker 1",)),
    '"Time (ms)","Ball/X","Ball/Y"': (
        "\n".join(
            f'"{x}","{y}","{z}"'.replace(".", ",")
            for x, y, z in np.column_stack([1e3 * TIME, TIP[:, :2]])
        ),
        *(PLANAR, ("Ball",)),
    ),
}


@pytest.mark.parametrize("head", BARE)
def test_a_table_of_a_tracking_program_needs_its_unit_and_rate(tmp_path, head):
    data, expected, labels = BARE[head]
    path = tmp_path / "points.csv"
    path.write_text(f"{head}\n{data}")
    rate = None if "t" in re.split(r"\W", head.lower()) or "Time" in head else 100.0
    lacks = "" if rate is None else " and does not say how many frames a second it has"
    with pytest.raises(
        DataFileError,
        match=rf"in which unit its positions are{lacks}: set units to m, cm or mm \(data",
    ):
        read_recording(path)
    read = read_recording(path, units="MM", rate=rate)
    assert (read.labels, read.rate) == (labels, 100.0)
    np.testing.assert_allclose(1e3 * read.positions[:, 0], expected, atol=1e-5)


def test_the_encoding_is_said_once_a_command_and_a_refusal_shows_what_to_write(
    tmp_path, monkeypatch, recwarn
):
    monkeypatch.chdir(tmp_path)
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_bytes(
            f"t,Tür.x [mm],Tür.y [mm],Tür.z [mm]\n{rows(',', TIME, TIP)}".encode("cp1252")
        )
    done = outcome("convert", "a.csv", "b.csv")
    assert done.out.count("Tür") == 2
    (warning,) = recwarn
    assert str(warning.message).startswith(
        "A text is not in UTF-8 and was read as Windows-1252: check names with acc"
    )
    (tmp_path / "log.csv").write_text(rows(",", TIME, TIP))
    sentence = refusal("inspect", "log.csv")
    assert "has no header that is known" in sentence
    table = re.search(r"recording\.table=\S+: \[.*\]\}", sentence)[0].replace(
        '"tip.y [mm]"', '"tip.z [mm]"'
    )
    assert (
        "30 frames, 0.30 s at 100 Hz"
        in outcome("inspect", "log.csv", table.replace("null", '"tip.y [mm]"')).out
    )


def test_a_time_in_an_unknown_unit_is_not_taken_for_seconds_and_words_are_not_read(tmp_path):
    path, data = tmp_path / "a.csv", rows(",", 10.0 * FRAMES, TIP).replace("\n", ",ok\n")
    path.write_text(f"Time,Tip/X,Tip/Y,Tip/Z,remark\n{data}")
    with pytest.raises(
        DataFileError,
        match=r"in which unit its time is, which rises by more than 1 a line: write 'time",
    ):
        read_recording(path, units="mm")
    path.write_text(f"Time (msec),Tip/X,Tip/Y,Tip/Z,remark\n{data}")
    assert read_recording(path, units="mm").rate == 100.0


def test_files_that_are_no_text_are_refused(tmp_path):
    path = tmp_path / "a.csv"
    for content in (bytes(range(256)), b"PK\3\4\0\0" * 9, b"\xff\xfea", bytes(100)):
        path.write_bytes(content)
        refuses(DataFileError, r"a\.csv is not a text file: export it", read_recording, path)
