"""Recordings in ROS bags, written by rosbags and read back."""

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from support.command_line import outcome
from support.refusals import refuses
from warp_resphys import DataFileError, InputError, read_recording
from warp_resphys.data.base_motion import since_first
from warp_resphys.settings.data_kinds import BagSettings

RATE, FRAMES = 50.0, 41
TIMES = np.arange(FRAMES) / RATE
MARKERS = {"tip": "/mocap/tip", "plate": "/tf#plate", "second": "/cloud#2"}
INPUTS = ["/pressure#2 [mbar]", "/joint_states#winch.position [mm]"]


def place(number, times):
    """(T, 3) [m]"""
    swing = 0.02 * np.sin(3.0 * np.asarray(times) + number)
    return np.stack([swing, 0.1 * number + 0.0 * swing, 0.2 + swing**2], -1)


def turn(times):
    return Rotation.from_rotvec(
        np.multiply.outer(0.5 * np.sin(2.0 * np.asarray(times)), [0.0, 0.0, 1.0])
    )


class Messages:
    """Messages of a type store, with the times of their headers."""

    def __init__(self, store):
        self.of = lambda name: store.types[name]

    def header(self, time):
        seconds, rest = divmod(round(1e9 * (time + 100.0)), 1_000_000_000)
        stamp = self.of("builtin_interfaces/msg/Time")(seconds, rest)
        more = {"seq": 0} if "seq" in self.of("std_msgs/msg/Header").__dataclass_fields__ else {}
        return self.of("std_msgs/msg/Header")(**more, stamp=stamp, frame_id="world")

    def point(self, at, kind="Point"):
        return self.of(f"geometry_msgs/msg/{kind}")(*map(float, at))

    def pose(self, at, rotation):
        quaternion = self.of("geometry_msgs/msg/Quaternion")(*rotation.as_quat())
        return self.of("geometry_msgs/msg/Pose")(self.point(at), quaternion)

    def stamped(self, time, at):
        return self.of("geometry_msgs/msg/PointStamped")(self.header(time), self.point(at))

    def transforms(self, time, at, rotation, child):
        quaternion = self.of("geometry_msgs/msg/Quaternion")(*rotation.as_quat())
        moved = self.of("geometry_msgs/msg/Transform")(self.point(at, "Vector3"), quaternion)
        one = self.of("geometry_msgs/msg/TransformStamped")(self.header(time), child, moved)
        return self.of("tf2_msgs/msg/TFMessage")([one])

    def cloud(self, time, points):
        field = self.of("sensor_msgs/msg/PointField")
        fields = [field(name, 4 * number, 7, 1) for number, name in enumerate("xyz")]
        data = np.frombuffer(np.ascontiguousarray(points, dtype="<f4").tobytes(), dtype=np.uint8)
        cloud = self.of("sensor_msgs/msg/PointCloud2")
        return cloud(
            self.header(time), 1, len(points), fields, False, 12, 12 * len(points), data, True
        )

    def joints(self, time, **positions):
        names, none = [*positions], np.zeros(0)
        values = np.array([*positions.values()], dtype=np.float64)
        return self.of("sensor_msgs/msg/JointState")(self.header(time), names, values, none, none)

    def wrench(self, time, force):
        parts = (
            self.of("geometry_msgs/msg/Vector3")(*map(float, part))
            for part in (force, (0.0, time, 0.0))
        )
        wrench = self.of("geometry_msgs/msg/Wrench")(*parts)
        return self.of("geometry_msgs/msg/WrenchStamped")(self.header(time), wrench)

    def numbers(self, values):
        layout = self.of("std_msgs/msg/MultiArrayLayout")([], 0)
        return self.of("std_msgs/msg/Float64MultiArray")(layout, np.array(values, dtype=np.float64))


def of_tip(source, *inputs):
    return BagSettings(markers={"tip": source}, inputs=inputs)


def written(path, kind="sqlite3", left_out=(), late=0.0, clock=None):
    """A bag with two markers, a rigid body, two inputs and an image topic.

    ``clock`` changes times of /joint_states.
    """
    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    if kind == "bag":  # not among the types of ROS 1 that rosbags brings
        store.register(
            get_types_from_msg(
                "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"
            )
        )
    make = Messages(store)
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = Writer1(path) if kind == "bag" else Writer2(path, version=9, storage_plugin=plugin)
    serialize = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
    with writer:
        topics = {}

        def write(topic, message, time):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            writer.write(
                topics[topic],
                round(1e9 * (time + 100.0 + late)),
                serialize(message, message.__msgtype__),
            )

        for number, time in enumerate(TIMES):
            if number not in left_out:
                write("/mocap/tip", make.stamped(time, place(0, time)), time)
            other = time + 0.3 / RATE  # Devices have their own times.
            write("/tf", make.transforms(other, place(1, other), turn(other), "plate"), other)
            write("/tf", make.transforms(other, place(5, other), turn(0.0), "other"), other)
            write("/cloud", make.cloud(time, [place(3, time), place(2, time)]), time)
            write("/wrench", make.wrench(other, (other, 0.0, 2.0 * other)), other)
            if number % 10 == 0:
                write("/pressure", make.numbers([0.0, number]), time)
                stamp = time if clock is None else clock(number, time)
                write("/joint_states", make.joints(stamp, arm=9.0, winch=0.5 * number), time)
    return path


@pytest.mark.parametrize(
    ("kind", "late", "file"), [("sqlite3", 0.0, ""), ("mcap", 30.0, "trial.mcap"), ("bag", 0.0, "")]
)
def test_topics_are_brought_to_common_frames(kind, late, file, tmp_path):
    """Also where the clock of the computer that recorded is not
    that of the headers, which numbers lack.
    """
    path = written(tmp_path / ("trial.bag" if kind == "bag" else "trial"), kind, late=late)
    read = read_recording(path / file, bag=BagSettings(markers=MARKERS, inputs=INPUTS))
    assert read.rate == RATE
    assert read.labels == ("tip", "plate", "second", "plate +x", "plate +y", "plate +z")
    # From the first message of the rigid body on.
    times = 0.3 / RATE + np.arange(len(read.positions)) / RATE
    assert len(times) == FRAMES - 1
    for column, number in enumerate(range(3)):
        np.testing.assert_allclose(read.positions[:, column], place(number, times), atol=2e-5)
    arm = place(1, times) + 0.05 * turn(times).as_matrix()[:, :, 0]
    np.testing.assert_allclose(read.positions[:, 3], arm, atol=2e-5)
    last = 10 * (np.floor(times * RATE / 10 + 1e-9))
    np.testing.assert_allclose(read.actuation, np.stack([1e2 * last, 0.5e-3 * last], 1))


def test_a_bag_is_converted(folder):
    written(folder / "trial", "mcap")
    assert (
        "seen"
        in outcome("convert", "trial/trial.mcap", "recording.bag={markers: {tip: /mocap/tip}}").out
    )
    tip = read_recording(folder / "recordings" / "trial.h5")
    np.testing.assert_allclose(tip.positions[:, 0], place(0, TIMES), atol=2e-5)


def test_a_pose_is_the_motion_of_the_base(tmp_path):
    path = written(tmp_path / "trial")
    read = read_recording(path, bag=BagSettings(markers={"tip": "/mocap/tip"}, base="/tf#plate"))
    times = np.maximum(TIMES, 0.3 / RATE)  # before its first message, the base is where that has it
    quaternions = turn(times).as_quat()[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(
        read.base, since_first(place(1, times), quaternions, path), atol=2e-4
    )


def test_wrenches_are_readings_of_force_sensors(tmp_path):
    bag = BagSettings(markers={"tip": "/mocap/tip"}, loads={"load": "/wrench"})
    readings = read_recording(written(tmp_path / "trial"), bag=bag).loads["load"]
    assert np.isnan(readings[0]).all()  # before its first message
    expected = np.stack([TIMES, 0.0 * TIMES, 2.0 * TIMES, 0.0 * TIMES, TIMES, 0.0 * TIMES], 1)
    np.testing.assert_allclose(readings[1:], expected[1:], atol=1e-8)


@pytest.mark.parametrize(
    ("clock", "said"),
    [
        (
            lambda number, time: 1.0,
            "in the headers of /joint_states, 4 of 5 messages repeat the time of another",
        ),
        (
            lambda number, time: time - 50.0 * (number > 15),
            "the time falls by 49.8 s at message 3: record it with a clock",
        ),
        (
            lambda number, time: time + 40.0,
            "/joint_states#winch.* are of another clock than those of /mocap/tip: they differ by "
            "-40 s at the start",
        ),
        (lambda number, time: 5.0 * time, "another clock .* at the start and -3.2 s at the end"),
    ],
)
def test_clocks_that_stand_still_fall_or_differ(tmp_path, clock, said):
    bag = of_tip("/mocap/tip", "/joint_states#winch.position [mm]")
    refuses(DataFileError, said, read_recording, written(tmp_path / "trial", clock=clock), bag=bag)


def test_a_message_that_comes_twice_is_left_out_and_counted(tmp_path, caplog):
    path = written(tmp_path / "trial", clock=lambda number, time: time - 0.2 * (number == 20))
    read = read_recording(path, bag=of_tip("/mocap/tip", "/joint_states#winch.position [mm]"))
    np.testing.assert_allclose(
        read.actuation[:, 0], 0.5e-3 * np.repeat([0, 10, 10, 30, 40], [10, 10, 10, 10, 1])
    )
    assert (
        "trial: 1 of 5 messages of /joint_states left out, which repeat the time of another"
        in caplog.text
    )


def test_a_gap_is_not_bridged(tmp_path):
    read = read_recording(
        written(tmp_path / "trial", left_out=range(10, 15)), bag=of_tip("/mocap/tip")
    )
    np.testing.assert_array_equal(np.flatnonzero(~read.seen[:, 0]), range(10, 15))
    single = read_recording(written(tmp_path / "other", left_out=[10]), bag=of_tip("/mocap/tip"))
    assert single.seen.all()
    np.testing.assert_allclose(single.positions[:, 0], place(0, TIMES), atol=4e-5)


@pytest.mark.parametrize(
    ("bag", "error", "words"),
    [
        (of_tip("/mocap/tup"), DataFileError, "no topic /mocap/tup, did you mean '/mocap/tip'"),
        (of_tip("/tf#tip"), DataFileError, "/tf has no message of tip"),
        (
            BagSettings(markers={"tip": "/mocap/tip"}, loads={"load": "/tf"}),
            DataFileError,
            "/tf has messages of the type tf2_msgs/msg/TFMessage, which hold no force",
        ),
        (of_tip("/pressure#1"), DataFileError, "which hold no place"),
        (of_tip("/cloud"), InputError, "say which entry"),
        (of_tip("/mocap/tip", "/pressure#3 [mbar]"), DataFileError, "has 2 entries"),
        (of_tip("/mocap/tip", "/pressure#1 [psi]"), InputError, "whose unit is unknown"),
        (
            of_tip("/mocap/tip", "/joint_states#winch"),
            InputError,
            "name the joint and its position",
        ),
        (of_tip("mocap tip"), InputError, "write a topic"),
        (BagSettings(markers={}), InputError, "data.bag.markers is empty"),
        (None, InputError, "name topics in data.bag .* /pressure .std_msgs/msg/Float64MultiArray"),
    ],
)
def test_what_cannot_be_read_is_said(bag, error, words, tmp_path):
    with pytest.raises(error, match=words):
        read_recording(written(tmp_path / "trial"), bag=bag)


def test_files_that_are_no_bags_are_said(tmp_path):
    with pytest.raises(DataFileError, match="there is no such file or folder"):
        read_recording(tmp_path / "trial.bag", bag=BagSettings(markers=MARKERS))
    whole = (written(tmp_path / "trial", "mcap") / "trial.mcap").read_bytes()
    contents = {
        "a.bag": b"#ROSBAG V2.0\n" + bytes(100),
        "cut.mcap": whole[:200],
        "text.mcap": b"none",
        "empty.mcap": b"",
    }
    contents["other.mcap"] = whole.replace(b"ros2", b"json", 1)  # the profile of another recorder
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(
            DataFileError,
            match=rf"{name} is damaged, or no bag of ROS .*: record it with ROS again",
        ):
            read_recording(tmp_path / name, bag=BagSettings(markers=MARKERS))
