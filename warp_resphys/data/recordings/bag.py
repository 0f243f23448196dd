"""Recordings in ROS 1 and 2 bags, also as single MCAP files, read without ROS by the package rosbags.

Every topic has messages at its own times: those of its headers or, without headers, those at which it was recorded, on
the clock of the headers. Markers and inputs are brought to common frames: markers by linear interpolation, rotations by
the shortest turn, and inputs keep their last value.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ...io.errors import DataFileError, InputError, ResphysError, did_you_mean
from .recording import SI_PER_ACTUATION_UNIT, FloatArray, RawRecording

SUFFIXES: Final = (".bag", ".mcap", ".db3")
_GAP = 2.5  # frames: a marker without messages for longer is not seen
_SOURCE = re.compile(r"(?P<topic>[^#\s]+)(?:#(?P<member>\S+))?(?:\s*\[(?P<unit>[^\]]+)\])?")
_CLOUD_TYPES = {7: "f4", 8: "f8"}  # of the fields of a PointCloud2
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")


@dataclass(frozen=True)
class Bag:
    """Topics of a bag.

    A source is a topic, with a member after # where a message has several: the child frame of a transform
    (``/tf#tip``), the number of a point, a pose or a number in an array, from 1 (``/cloud#3``), or the quantity of a
    joint (``/joint_states#finger.effort``).

    Attributes:
        markers: sources by the name of the marker; those with a rotation are rigid bodies.
        inputs: sources of the channels of the actuation, with their unit in brackets (``/pressure#1 [mbar]``).
        base: source of the pose of the base, or None.
        rate: frames a second [Hz]; None for that of the first marker.
    """

    markers: Mapping[str, str]
    inputs: Sequence[str] = ()
    base: str | None = None
    rate: float | None = None


@dataclass(frozen=True)
class _Source:
    """A topic, and a member of its messages."""

    text: str
    topic: str
    member: str | None
    unit: str | None


@dataclass
class _Series:
    """Times and values of the messages of a source."""

    stamps: list[float] = field(default_factory=list)  # s, NaN without a header
    received: list[float] = field(default_factory=list)  # s
    values: list[Sequence[float]] = field(default_factory=list)

    def sorted(self, late: float) -> tuple[FloatArray, FloatArray]:
        """Times (n,) [s] that grow, and values (n, ...); ``late`` is the clock of the bag less that of the headers."""
        stamps, received = np.array(self.stamps), np.array(self.received)
        times, first = np.unique(np.where(np.isfinite(stamps), stamps, received - late), return_index=True)
        return times, np.array(self.values, dtype=np.float64)[first]


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a file, or the folder of a ROS 2 bag."""
    return path.suffix.lower() in SUFFIXES or (path / "metadata.yaml").is_file()


def read_raw_bag(path: Path, bag: Bag) -> RawRecording:
    """Reads the named topics of a bag.

    Args:
        path: a ``.bag`` or ``.mcap`` file, or the folder of a ROS 2 bag.
        bag: which topics are markers, inputs and the base.

    Raises:
        DataFileError: The bag is missing or damaged, lacks a topic, or has messages of a type that cannot be read.
        InputError: rosbags is not installed, or a source is misspelt.
    """
    markers = {name: _source(text) for name, text in bag.markers.items()}
    inputs, base = [_source(text) for text in bag.inputs], None if bag.base is None else _source(bag.base)
    if not markers:
        raise InputError("data.bag.markers is empty: name a topic for every marker.")
    factors = [_factor(source) for source in inputs]
    posed = [*markers.values(), *([] if base is None else [base])]
    series = {(source, _pose): _Series() for source in posed} | {(source, _number): _Series() for source in inputs}
    for kind, message, received, topic in _messages(path, {source.topic for source, _ in series}):
        for (source, read), own in series.items():
            if source.topic == topic and (value := read(kind, message, source, path)) is not None:
                own.stamps.append(_stamp_of(message, source))
                own.received.append(1e-9 * received)
                own.values.append(value)
    for (source, _), own in series.items():
        if not own.values:
            named = "" if source.member is None else f" of {source.member}"
            raise DataFileError(f"{path}: {source.topic} has no message{named}; check what was recorded.")
    clocks = np.concatenate([np.subtract(own.received, own.stamps) for own in series.values()])
    late = float(np.nanmedian(clocks)) if np.isfinite(clocks).any() else 0.0
    poses = {source: series[source, _pose].sorted(late) for source in posed}
    times, rate = _frames(path, [poses[source][0] for source in markers.values()], bag.rate)
    moved = np.stack([_at_frames(*poses[source], times, rate) for source in markers.values()], 1)
    held = [_held(*series[source, _number].sorted(late), times) for source in inputs]
    return RawRecording(
        moved[..., :3],
        [*markers],
        "m",
        rate,
        np.stack(held, 1) * factors if held else None,
        base=None if base is None else _at_frames(*poses[base], times, rate),
        turns=moved[..., 3:] if np.isfinite(moved[..., 3:]).any() else None,
    )


def _source(text: str) -> _Source:
    match = _SOURCE.fullmatch(text.strip())
    if match is None:
        raise InputError(f"data.bag names '{text}': write a topic, as /tip, /tf#tip or '/pressure#1 [mbar]'.")
    return _Source(text, match["topic"], match["member"], match["unit"])


def _factor(source: _Source) -> float:
    """Factor to SI units of an input."""
    unit = source.unit or "1"
    if unit not in SI_PER_ACTUATION_UNIT:
        units = ", ".join(SI_PER_ACTUATION_UNIT)
        raise InputError(f"data.bag.inputs has '{source.text}', whose unit is unknown: give one of {units}.")
    return SI_PER_ACTUATION_UNIT[unit]


def topics_of(path: Path) -> str:
    """Returns the topics of a bag and the types of their messages, for a sentence; raises errors as `read_raw_bag`."""
    with _opened(path) as reader:
        return ", ".join(sorted(f"{one.topic} ({one.msgtype})" for one in reader.connections)) or "no topic"


def _messages(path: Path, topics: set[str]) -> Iterator[tuple[str, Any, int, str]]:
    """Yields type, message, time at which it was recorded [ns], and topic."""
    with _opened(path) as reader:
        there = {connection.topic for connection in reader.connections}
        for topic in sorted(topics - there):
            known = did_you_mean(topic, sorted(there)) or f"; it has {', '.join(sorted(there)) or 'none'}."
            raise DataFileError(f"{path} has no topic {topic}{known}")
        connections = [connection for connection in reader.connections if connection.topic in topics]
        for connection, received, raw in reader.messages(connections=connections):
            yield connection.msgtype, reader.deserialize(raw, connection.msgtype), received, connection.topic


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Opens a bag; the errors of rosbags for damaged files, of many classes, become a DataFileError."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError("bags need a package that is not installed: pip install 'warp-resphys[bags]'.") from None
    if not path.exists():
        raise DataFileError(f"Cannot read {path}: there is no such file or folder; check the path of the recording.")
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield reader
    except ResphysError:
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        raise DataFileError(f"{path} is damaged, or no bag of ROS ({what}): record it with ROS again.") from error


def _stamp_of(message: Any, source: _Source) -> float:
    """Time of a message [s] by its header, NaN without one."""
    if hasattr(message, "transforms"):
        message = next((own for own in message.transforms if own.child_frame_id == source.member), message)
    header = getattr(message, "header", None)
    stamp = 0.0 if header is None else header.stamp.sec + 1e-9 * header.stamp.nanosec
    return float(stamp or np.nan)


def _pose(kind: str, message: Any, source: _Source, path: Path) -> Sequence[float] | None:
    """Place [m] and quaternion, w first, of a message, NaN without a rotation; None where it lacks the member."""
    if kind in _IMAGES:
        raise DataFileError(
            f"{path}: {source.topic} has images: track the markers in them by another program, and give its table."
        )
    if kind == "tf2_msgs/msg/TFMessage":
        own = next((own for own in message.transforms if own.child_frame_id == source.member), None)
        return None if own is None else _rigid(own.transform.translation, own.transform.rotation)
    if kind == "geometry_msgs/msg/TransformStamped":
        return _rigid(message.transform.translation, message.transform.rotation)
    if kind == "sensor_msgs/msg/PointCloud2":
        return _cloud(message, _number_of(source), path, source)
    if kind == "geometry_msgs/msg/PoseArray":
        pose = _entry(message.poses, source, path)
        return _rigid(pose.position, pose.orientation)
    for name in ("pose", "pose", "point", "vector"):  # with a covariance, a pose lies in a pose
        message = getattr(message, name, message)
    if hasattr(message, "position") and hasattr(message, "orientation"):
        return _rigid(message.position, message.orientation)
    if all(isinstance(getattr(message, axis, None), float) for axis in "xyz"):
        return (message.x, message.y, message.z, *[np.nan] * 4)
    raise DataFileError(
        f"{path}: {source.topic} has messages of the type {kind}, which hold no place: markers are poses, points, "
        "transforms, odometry, arrays of poses and clouds of points in a fixed order."
    )


def _rigid(place: Any, turn: Any) -> tuple[float, ...]:
    return place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z


def _number_of(source: _Source) -> int:
    if source.member is None or not source.member.isdecimal() or int(source.member) < 1:
        raise InputError(f"data.bag names '{source.text}': say which entry of its messages, as in {source.topic}#1.")
    return int(source.member)


def _entry(values: Sequence[Any], source: _Source, path: Path) -> Any:
    number = _number_of(source)
    if number > len(values):
        raise DataFileError(
            f"{path}: a message of {source.topic} has {len(values)} entries, but {source.text} is asked for."
        )
    return values[number - 1]


def _cloud(message: Any, number: int, path: Path, source: _Source) -> tuple[float, ...]:
    """A point of a cloud, whose points must come in a fixed order."""
    count = message.width * message.height
    if number > count:
        return (np.nan,) * 7
    fields = {own.name: own for own in message.fields}
    if not {"x", "y", "z"} <= {*fields} or any(fields[axis].datatype not in _CLOUD_TYPES for axis in "xyz"):
        raise DataFileError(f"{path}: the cloud {source.topic} has no x, y and z as floating-point numbers.")
    row, column = divmod(number - 1, message.width)
    first = row * message.row_step + column * message.point_step
    order = ">" if message.is_bigendian else "<"
    data = bytes(message.data)
    point = [
        float(np.frombuffer(data, order + _CLOUD_TYPES[own.datatype], 1, first + own.offset)[0])
        for own in (fields[axis] for axis in "xyz")
    ]
    return (*point, *[np.nan] * 4)


def _number(kind: str, message: Any, source: _Source, path: Path) -> Sequence[float] | None:
    """An input in a message, in its own unit."""
    if kind == "sensor_msgs/msg/JointState":
        joint, _, quantity = (source.member or "").rpartition(".")
        if quantity not in ("position", "velocity", "effort"):
            raise InputError(
                f"data.bag.inputs has '{source.text}': name the joint and its position, velocity or effort, as in "
                f"{source.topic}#finger.effort."
            )
        if joint not in message.name:
            return None
        values = getattr(message, quantity)
        place = list(message.name).index(joint)
        return (float(values[place]),) if place < len(values) else None
    if kind == "sensor_msgs/msg/FluidPressure":
        return (float(message.fluid_pressure),)
    data = getattr(message, "data", None)
    if isinstance(data, bool | int | float):
        return (float(data),)
    if data is not None and kind.endswith("MultiArray"):
        return (float(_entry(data, source, path)),)
    raise DataFileError(
        f"{path}: {source.topic} has messages of the type {kind}, which hold no input: inputs are numbers and arrays "
        "of numbers (std_msgs), JointState and FluidPressure."
    )


def _frames(path: Path, times: Sequence[FloatArray], rate: float | None) -> tuple[FloatArray, float]:
    """Times of the frames [s], while all markers have messages, and their rate [Hz]."""
    if rate is None:
        if len(times[0]) < 2:
            raise DataFileError(f"{path}: the first marker has a single message, which has no rate: set data.bag.rate.")
        rate = 1.0 / float(np.median(np.diff(times[0])))
        rate = round(rate) if abs(rate - round(rate)) < 5e-3 * rate else rate
    start, stop = max(own[0] for own in times), min(own[-1] for own in times)
    if stop - start < 1.0 / rate:
        raise DataFileError(
            f"{path}: its markers have no messages at the same time; check the clocks of their headers."
        )
    return start + np.arange(int((stop - start) * rate + 1e-6) + 1) / rate, float(rate)


def _at_frames(times: FloatArray, poses: FloatArray, frames: FloatArray, rate: float) -> FloatArray:
    """Poses (T, 7) at the frames, NaN in gaps.

    A rigid body was not seen in a message whose quaternion is zero or NaN, nor any marker in one without its place.
    """
    result = np.full((len(frames), 7), np.nan)
    turned = np.isfinite(poses[:, 3:]).all(1) & (np.linalg.norm(poses[:, 3:], axis=1) > 0.0)
    seen = np.isfinite(poses[:, :3]).all(1) & (turned | (not turned.any()))
    if not seen.any():
        return result
    times, poses = times[seen], poses[seen]
    after = np.clip(np.searchsorted(times, frames), 1, len(times) - 1) if len(times) > 1 else np.zeros(len(frames), int)
    gap = times[after] - times[after - 1] if len(times) > 1 else np.full(len(frames), np.inf)
    known = (gap <= _GAP / rate) | np.isin(frames, times)
    for column in range(3):
        result[known, column] = np.interp(frames[known], times, poses[:, column])
    if turned.any() and len(times) > 1:
        turn = Slerp(times, Rotation.from_quat(poses[:, [4, 5, 6, 3]]))
        result[known, 3:] = turn(np.clip(frames[known], times[0], times[-1])).as_quat()[:, [3, 0, 1, 2]]
    return result


def _held(times: FloatArray, values: FloatArray, frames: FloatArray) -> FloatArray:
    """The last values (T,) before or at the frames; before the first message, its value."""
    return np.asarray(values[np.clip(np.searchsorted(times, frames, side="right") - 1, 0, None), 0])
