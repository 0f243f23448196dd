"""MCAP files of other recorders, tables with names, dates and decimal commas, Vicon's export, and their conversion."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.command_line import outcome, refusal
from support.mcaps import write_json, write_ros
from warp_resphys.data.recordings.bag import Bag
from warp_resphys.data.recordings.mcap_file import JsonMessage
from warp_resphys.data.recordings.reading import read_recording
from warp_resphys.data.recordings.text import Table
from warp_resphys.io.errors import DataFileError, InputError

TIMES = 100.0 + np.arange(30) / 50.0
TIP = np.stack([0.02 * np.sin(5.0 * TIMES), 0.1 + 0.0 * TIMES, 0.01 * TIMES], -1)
TURNS = Rotation.from_rotvec(np.multiply.outer(0.3 * np.sin(4.0 * TIMES), [0.0, 1.0, 0.0]))


@pytest.mark.parametrize("profile", ["ros2", ""])
def test_messages_of_ros_in_a_bare_file_are_read(tmp_path, profile):
    path = write_ros(tmp_path / "a.mcap", "/tip", TIMES, TIP, profile)
    read = read_recording(path, bag=Bag({"tip": "/tip"}))
    assert read.rate == 50.0
    np.testing.assert_allclose(read.positions[:, 0], TIP, atol=1e-9)


def robot(stamped=True):
    """Messages in JSON: places and pressures, and a pose as Foxglove names it, received 7 s late."""
    for time, tip, quaternion in zip(TIMES, TIP, TURNS.as_quat(), strict=True):
        stamp = {"sec": int(time), "nsec": round(1e9 * (time % 1.0))}
        state = {"tips": [{"x": 9, "y": 9, "z": 9}, dict(zip("xyz", tip, strict=True))], "list": [*tip]}
        head = {"header": {"stamp": stamp}} if stamped else {}
        yield "/robot", time + 7.0, {**head, "state": state, "pressures": [0, 1e3 * (time - 100.0)]}
        turn = dict(zip("xyzw", quaternion, strict=True))
        pose = {"position": dict(zip("xyz", tip + 0.1, strict=True)), "orientation": turn}
        yield "/plate", time + 7.0, {"timestamp": stamp, "frame_id": "world", "pose": pose}


def test_messages_in_json_are_read_by_paths_of_keys(tmp_path):
    path = write_json(tmp_path / "robot.mcap", robot())
    bag = Bag(
        {"tip": "/robot#state.tips.2", "same": "/robot#state.list", "plate": "/plate"}, ["/robot#pressures.2 [kPa]"]
    )
    read = read_recording(path, bag=bag)
    at = [read.labels.index(name) for name in ("tip", "same", "plate")]
    np.testing.assert_allclose(read.positions[:, at], np.stack([TIP, TIP, TIP + 0.1], 1), atol=1e-9)
    arm = read.positions[:, read.labels.index("plate +x")] - read.positions[:, at[2]]
    np.testing.assert_allclose(arm, TURNS.apply([0.05, 0.0, 0.0]), atol=1e-9)
    np.testing.assert_allclose(read.actuation[:, 0], 1e6 * (TIMES - 100.0), atol=1e-3)


@pytest.mark.parametrize("units", [1.0, 1e3, 1e6, 1e9], ids=["s", "ms", "us", "ns"])
def test_a_number_is_the_time_since_1970_in_its_unit(units, tmp_path):
    times = [JsonMessage("/robot", {"timestamp": moment * units}, tmp_path).stamp for moment in (1.7e9, 1.7e9 + 0.25)]
    np.testing.assert_allclose(times, [1.7e9, 1.7e9 + 0.25], rtol=0.0, atol=1e-6)
    text = {"timestamp": {"sec": "100", "nsec": "20000000"}}  # as protobuf writes whole numbers
    assert JsonMessage("/robot", text, tmp_path).stamp == pytest.approx(100.02)


def test_without_stamps_the_times_of_the_file_count(tmp_path):
    path = write_json(tmp_path / "robot.mcap", robot(stamped=False))
    read = read_recording(path, bag=Bag({"tip": "/robot#state.list"}))
    np.testing.assert_allclose(read.positions[:, 0], TIP, atol=1e-9)


@pytest.mark.parametrize(
    ("markers", "inputs", "message"),
    [
        ({"tip": "/robots"}, [], "robot.mcap has no topic /robots, did you mean '/robot'"),
        ({"tip": "/robot#state.tip"}, [], r"/robot has no message of state\.tip; check what was recorded"),
        ({"tip": "/robot#state"}, [], r"/robot#state holds no place: name the member with x, y and z, or with a list"),
        ({"tip": "/robot"}, [], r"/robot holds no place"),
        ({"tip": "/plate"}, ["/robot#pressures [kPa]"], r"/robot#pressures holds no number: name the member that does"),
    ],
)
def test_members_that_json_lacks_are_named(tmp_path, markers, inputs, message):
    path = write_json(tmp_path / "robot.mcap", robot())
    with pytest.raises(DataFileError, match=message):
        read_recording(path, bag=Bag(markers, inputs))


def test_other_files_are_refused(tmp_path):
    path = write_json(tmp_path / "a.mcap", robot(), encoding="protobuf")
    with pytest.raises(
        DataFileError, match="/plate has messages in protobuf: record it as JSON, or as messages of ROS 2"
    ):
        read_recording(path, bag=Bag({"plate": "/plate"}))
    with pytest.raises(InputError, match=r"name topics in data\.bag .* /plate \(test\.plate\), /robot \(test\.robot\)"):
        read_recording(path)
    for name, content in (("cut", path.read_bytes()[:200]), ("text", b"no recording"), ("empty", b"")):
        damaged = tmp_path / f"{name}.mcap"
        damaged.write_bytes(content)
        with pytest.raises(DataFileError, match=rf"{name}\.mcap is damaged, or no bag"):
            read_recording(damaged, bag=Bag({"plate": "/plate"}))


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
        (" [us]", [round(1e6 * time) for time in TIMES]),
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
    read = read_recording(path, table=Table(names={**NAMES, "pump": "pump [kPa]"}, header_lines=1))
    np.testing.assert_allclose(read.positions[:, 0], TIP, atol=1e-9)
    np.testing.assert_allclose(read.actuation, 12.5e3)
    assert read_recording(path, table=Table(names=NAMES, header_lines=1)).actuation is None
    with pytest.raises(
        DataFileError, match=r"line 2: data\.table\.names has 'X', which 0 columns are named; it has 't'"
    ):
        read_recording(path, table=Table(names={**NAMES, "X": "a.x"}, header_lines=1))


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
    write_json(tmp_path / "robot.mcap", robot())
    assert (
        "seen"
        in outcome(
            "convert",
            "robot.mcap",
            'recording.bag={markers: {tip: "/robot#state.list"}, inputs: ["/robot#pressures.2 [kPa]"]}',
        ).out
    )
    vicon(tmp_path / "arm.csv")
    assert "seen" in outcome("convert", "arm.csv", "to=other").out
    tip, arm = (read_recording(tmp_path / place) for place in ("recordings/robot.h5", "other/arm.h5"))
    np.testing.assert_allclose(tip.positions[:, 0], TIP, atol=1e-9)
    np.testing.assert_allclose(tip.actuation[:, 0], 1e6 * (TIMES - 100.0), atol=1e-3)
    assert arm.labels == ("Tip", "Base")
    assert "arm.csv" in refusal("convert", "arm.csv", "other/arm.h5")
    assert "nothing to convert" in refusal("convert")
