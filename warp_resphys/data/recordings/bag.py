"""Recordings in ROS 1 and 2 bags, also as single MCAP files,
read without ROS by the package rosbags.

Every topic has messages at its own times: those of its headers or, without headers, those at which
it was recorded, on the clock of the headers, which must be one for all topics, and run. Markers and
inputs are brought to common frames: markers by linear interpolation, rotations by the shortest
turn, and inputs keep their last value.

A source is a topic, with a member after # where a message has several: the child frame of a
transform (``/tf#tip``), the number of a point, a pose or a number in an array, from 1
(``/cloud#3``), or the quantity of a joint (``/joint_states#finger.effort``). Those of inputs have
their unit in brackets (``/pressure#1 [mbar]``).
"""

import logging
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ...io.arrays import FloatArray
from ...io.errors import DataFileError, InputError, ResphysError, did_you_mean
from ...settings.data_kinds import BagSettings
from ..base_motion import since_first
from .recording import SI_PER_ACTUATION_UNIT, Recording

log = logging.getLogger(__name__)

SUFFIXES: Final = (".bag", ".mcap", ".db3")
_SAME_CLOCK = 1.0  # s: topics whose delays differ by more have other clocks
_FROZEN = 5  # messages with one time, of a clock that stands still
_GAP = 2.5  # frames: a marker without messages for longer is not seen
_SOURCE = re.compile(r"(?P<topic>[^#\s]+)(?:#(?P<member>\S+))?(?:\s*\[(?P<unit>[^\]]+)\])?")
_CLOUD_TYPES = {7: "f4", 8: "f8"}  # of the fields of a PointCloud2
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a file, or the folder of a ROS 2 bag."""
    return path.suffix.lower() in SUFFIXES or (path / "metadata.yaml").is_file()


def topics_of(path: Path) -> str:
    """Returns the topics of a bag and the types of their messages, for a sentence.

    Raises errors as `read_bag`.
    """
    with _opened(path) as reader:
        return (
            ", ".join(sorted(f"{one.topic} ({one.msgtype})" for one in reader.connections))
            or "no topic"
        )


def read_bag(path: Path, bag: BagSettings) -> Recording:
    """Reads the named topics of a bag.

    Args:
        path: a ``.bag`` or ``.mcap`` file, or the folder of a ROS 2 bag.
        bag: which topics are markers, inputs and the base.

    Raises:
        DataFileError: The bag is missing or damaged, lacks a topic, or has messages of a type that
            cannot be read.
        InputError: rosbags is not installed, or a source is misspelt.
    """
    markers = [_Source(path, text, _pose) for text in bag.markers.values()]
    inputs = [_Source(path, text, _input) for text in bag.inputs]
    base = None if bag.base is None else _Source(path, bag.base, _pose)
    wrenches = {name: _Source(path, text, _wrench) for name, text in bag.loads.items()}
    if not markers:
        raise InputError("data.bag.markers is empty: name a topic for every marker.")
    factors = [source.factor for source in inputs]
    sources = [*markers, *inputs, *([] if base is None else [base]), *wrenches.values()]
    with _opened(path) as reader:
        there = {connection.topic for connection in reader.connections}
        for topic in sorted({source.topic for source in sources} - there):
            known = (
                did_you_mean(topic, sorted(there))
                or f"; it has {', '.join(sorted(there)) or 'none'}."
            )
            raise DataFileError(f"{path} has no topic {topic}{known}")
        wanted = {source.topic for source in sources}
        connections = [
            connection for connection in reader.connections if connection.topic in wanted
        ]
        for connection, received, data in reader.messages(connections=connections):
            message = reader.deserialize(data, connection.msgtype)
            for source in sources:
                if source.topic == connection.topic:
                    source.add(connection.msgtype, message, 1e-9 * received)
    for source in sources:
        if not source.values:
            named = "" if source.member is None else f" of {source.member}"
            raise DataFileError(
                f"{path}: {source.topic} has no message{named}; check what was recorded."
            )
    late = _late(path, sources)
    times, rate = _frames(path, [source.series(late)[0] for source in markers], bag.rate)
    moved = np.stack([_at_frames(*source.series(late), times, rate) for source in markers], 1)
    columns = []
    for source in inputs:
        stamps, values = source.series(late)
        columns.append(
            values[np.clip(np.searchsorted(stamps, times, side="right") - 1, 0, None), 0]
        )
    loads = {name: _between(*source.series(late), times, rate) for name, source in wrenches.items()}
    poses = None if base is None else _at_frames(*base.series(late), times, rate)
    return Recording(
        (*bag.markers,),
        moved[..., :3],
        rate,
        path,
        np.stack(columns, 1) * factors if columns else None,
        base=None if poses is None else since_first(poses[:, :3], poses[:, 3:], path),
        turns=moved[..., 3:] if np.isfinite(moved[..., 3:]).any() else None,
        loads=loads,
    )


def _late(path: Path, sources: "Sequence[_Source]") -> float:
    """Returns the clock of the bag less that of the headers [s].

    Raises:
        DataFileError: topics have headers of different clocks.
    """
    by_topic = {source.text: source.ahead() for source in sources}
    ahead = {topic: late for topic, late in by_topic.items() if len(late)}
    if not ahead:
        return 0.0
    first, *others = ahead
    for topic in others:
        apart = ahead[topic] - ahead[first]
        if np.abs(apart).max() > _SAME_CLOCK:
            raise DataFileError(
                f"{path}: the headers of {topic} are of another clock than those of {first}: "
                f"they differ by {apart[0]:.3g} s at the start and {apart[1]:.3g} s at the end; "
                "record both with one clock."
            )
    drift = float(np.ptp(next(iter(ahead.values()))))
    bare = [source.topic for source in sources if not np.isfinite(source.stamps).any()]
    if bare and drift > _SAME_CLOCK:
        raise DataFileError(
            f"{path}: {bare[0]} has no headers, and the clock of those of {first} drifts from "
            f"that of the bag by {drift:.3g} s: record both with one clock."
        )
    clocks = np.concatenate([np.subtract(source.received, source.stamps) for source in sources])
    return float(np.nanmedian(clocks))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Opens a bag.

    The errors of rosbags for damaged files, of many classes, become a DataFileError.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(
            "bags need a package that is not installed: pip install 'warp-resphys[bags]'."
        ) from None
    if not path.exists():
        raise DataFileError(
            f"Cannot read {path}: there is no such file or folder; check the path of the recording."
        )
    try:
        with TemporaryDirectory() as folder:
            file = Path(folder) / f"bag{path.suffix.lower()}"
            if path.is_file() and path.suffix != file.suffix:
                # Rosbags knows extensions in small letters only.
                file.symlink_to(path.absolute())
                path = file
            with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
                yield reader
    except ResphysError:
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        raise DataFileError(
            f"{path} is damaged, or no bag of ROS ({what}): record it with ROS again."
        ) from error


class _Source:
    """A topic, a member of its messages, and their times and values."""

    def __init__(
        self, path: Path, text: str, read: "Callable[[_Source, str, Any], Sequence[float] | None]"
    ) -> None:
        match = _SOURCE.fullmatch(text.strip())
        if match is None:
            raise InputError(
                f"data.bag names '{text}': write a topic, as /tip, /tf#tip or '/pressure#1 [mbar]'."
            )
        self.path, self._read = path, read
        self.text, self.topic = text, match["topic"]
        self.member, self.unit = match["member"], match["unit"] or "1"
        # s; stamps are NaN without a header
        self.stamps, self.received = list[float](), list[float]()
        self.values = list[Sequence[float]]()

    def add(self, kind: str, message: Any, received: float) -> None:
        """Adds a message of a type, unless it lacks the member."""
        value = self._read(self, kind, message)
        if value is None:
            return
        if hasattr(message, "transforms"):
            message = next(
                (tf for tf in message.transforms if tf.child_frame_id == self.member), message
            )
        header = getattr(message, "header", None)
        stamp = 0.0 if header is None else header.stamp.sec + 1e-9 * header.stamp.nanosec
        self.stamps.append(float(stamp or np.nan))
        self.received.append(received)
        self.values.append(value)

    def series(self, late: float) -> tuple[FloatArray, FloatArray]:
        """Times (n,) [s] that grow, and values (n, ...).

        ``late`` is the clock of the bag less that of the headers.
        """
        stamps, received = np.array(self.stamps), np.array(self.received)
        times, first = np.unique(
            np.where(np.isfinite(stamps), stamps, received - late), return_index=True
        )
        return times, np.array(self.values, dtype=np.float64)[first]

    def ahead(self) -> FloatArray:
        """Clock of the bag less that of the headers (2,) [s], in the first and last tenth.

        Empty without two headers.

        Raises:
            DataFileError: stamps stand still or fall back.
        """
        stamps, received = np.array(self.stamps), np.array(self.received)
        known = np.isfinite(stamps)
        stamps, received = stamps[known], received[known]
        if len(stamps) < 2:  # such as one that was sent before the recording
            return stamps[:0]
        _, counts = np.unique(stamps, return_counts=True)
        repeated = len(stamps) - len(counts)
        fallen = np.flatnonzero(np.diff(stamps) < -_SAME_CLOCK)
        if len(fallen) or 2 * repeated > len(stamps) or counts.max() >= _FROZEN:
            what = f"{repeated} of {len(stamps)} messages repeat the time of another"
            if len(fallen):
                what = (
                    f"the time falls by {stamps[fallen[0]] - stamps[fallen[0] + 1]:.3g} s at "
                    f"message {fallen[0] + 2}"
                )
            raise DataFileError(
                f"{self.path}: in the headers of {self.topic}, {what}: record it with a clock "
                "that runs, or without headers."
            )
        if repeated:
            log.warning(
                "%s: %d of %d messages of %s left out, which repeat the time of another.",
                self.path.name,
                repeated,
                len(stamps),
                self.topic,
            )
        late, tenth = received - stamps, max(len(stamps) // 10, 1)
        return np.array([np.median(late[:tenth]), np.median(late[-tenth:])])

    @property
    def number(self) -> int:
        """Number of the entry of its messages, from 1."""
        if self.member is None or not self.member.isdecimal() or int(self.member) < 1:
            raise InputError(
                f"data.bag names '{self.text}': "
                f"say which entry of its messages, as in {self.topic}#1."
            )
        return int(self.member)

    def entry(self, values: Sequence[Any]) -> Any:
        """Returns its entry of an array."""
        if self.number > len(values):
            raise DataFileError(
                f"{self.path}: a message of {self.topic} has {len(values)} entries, but "
                f"{self.text} is asked for."
            )
        return values[self.number - 1]

    @property
    def factor(self) -> float:
        """Factor of an input to SI units."""
        if self.unit not in SI_PER_ACTUATION_UNIT:
            units = ", ".join(SI_PER_ACTUATION_UNIT)
            raise InputError(
                f"data.bag.inputs has '{self.text}', whose unit is unknown: give one of {units}."
            )
        return SI_PER_ACTUATION_UNIT[self.unit]


def _pose(source: _Source, kind: str, message: Any) -> Sequence[float] | None:
    """Returns a place [m] and a quaternion, w first, NaN without a rotation.

    None without the member.
    """
    if kind in _IMAGES:
        raise DataFileError(
            f"{source.path}: {source.topic} has images: track the markers in them by another "
            "program, and give its table."
        )
    if kind == "tf2_msgs/msg/TFMessage":
        message = next(
            (tf for tf in message.transforms if tf.child_frame_id == source.member), None
        )
        if message is None:
            return None
    if hasattr(message, "transform"):
        return _rigid(message.transform.translation, message.transform.rotation)
    if kind == "sensor_msgs/msg/PointCloud2":
        return _point(source, message)
    if kind == "geometry_msgs/msg/PoseArray":
        message = source.entry(message.poses)
    for name in ("pose", "pose", "point", "vector"):  # with a covariance, a pose lies in a pose
        message = getattr(message, name, message)
    if hasattr(message, "position") and hasattr(message, "orientation"):
        return _rigid(message.position, message.orientation)
    if all(isinstance(getattr(message, axis, None), float) for axis in "xyz"):
        return (message.x, message.y, message.z, *[np.nan] * 4)
    raise DataFileError(
        f"{source.path}: {source.topic} has messages of the type {kind}, which hold no place: "
        "markers are poses, points, transforms, odometry, arrays of poses and clouds of points "
        "in a fixed order."
    )


def _point(source: _Source, message: Any) -> Sequence[float]:
    """Returns a point of a cloud, whose points must come in a fixed order, without a rotation."""
    if source.number > message.width * message.height:
        return (np.nan,) * 7
    fields = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= {*fields} or any(
        fields[axis].datatype not in _CLOUD_TYPES for axis in "xyz"
    ):
        raise DataFileError(
            f"{source.path}: the cloud {source.topic} has no x, y and z as floating-point numbers."
        )
    row, column = divmod(source.number - 1, message.width)
    first, data = row * message.row_step + column * message.point_step, bytes(message.data)
    types = [
        (">" if message.is_bigendian else "<") + _CLOUD_TYPES[fields[axis].datatype]
        for axis in "xyz"
    ]
    starts = [first + fields[axis].offset for axis in "xyz"]
    point = [
        float(np.frombuffer(data, kind, 1, at)[0]) for kind, at in zip(types, starts, strict=True)
    ]
    return (*point, *[np.nan] * 4)


def _rigid(place: Any, turn: Any) -> Sequence[float]:
    return place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z


def _input(source: _Source, kind: str, message: Any) -> Sequence[float] | None:
    """Returns an input in its own unit; None without the member."""
    if kind == "sensor_msgs/msg/JointState":
        joint, _, quantity = (source.member or "").rpartition(".")
        if quantity not in ("position", "velocity", "effort"):
            raise InputError(
                f"data.bag.inputs has '{source.text}': name the joint and its position, velocity "
                f"or effort, as in {source.topic}#finger.effort."
            )
        values = dict(zip(message.name, getattr(message, quantity), strict=False))
        return (float(values[joint]),) if joint in values else None
    if kind == "sensor_msgs/msg/FluidPressure":
        return (float(message.fluid_pressure),)
    data = getattr(message, "data", None)
    if isinstance(data, bool | int | float):
        return (float(data),)
    if data is not None and kind.endswith("MultiArray"):
        return (float(source.entry(data)),)
    raise DataFileError(
        f"{source.path}: {source.topic} has messages of the type {kind}, which hold no input: "
        "inputs are numbers and arrays of numbers (std_msgs), JointState and FluidPressure."
    )


def _wrench(source: _Source, kind: str, message: Any) -> Sequence[float]:
    """Returns force and moment [N, N m]."""
    wrench = getattr(message, "wrench", message)
    if not (hasattr(wrench, "force") and hasattr(wrench, "torque")):
        raise DataFileError(
            f"{source.path}: {source.topic} has messages of the type {kind}, which hold no "
            "force: readings of force sensors are Wrench and WrenchStamped."
        )
    return [float(getattr(part, axis)) for part in (wrench.force, wrench.torque) for axis in "xyz"]


def _between(times: FloatArray, values: FloatArray, frames: FloatArray, rate: float) -> FloatArray:
    """Values (T, C) at the frames, linear between messages,
    NaN before the first, after the last, and in gaps.
    """
    series = np.stack([np.interp(frames, times, column, np.nan, np.nan) for column in values.T], 1)
    after = np.searchsorted(times, frames).clip(1, max(len(times) - 1, 1))
    if len(times) > 1:
        series[(times[after] - times[after - 1] > _GAP / rate) & ~np.isin(frames, times)] = np.nan
    return series


def _frames(
    path: Path, times: Sequence[FloatArray], rate: float | None
) -> tuple[FloatArray, float]:
    """Times of the frames [s], while all markers have messages, and their rate [Hz]."""
    if rate is None:
        if len(times[0]) < 2:
            raise DataFileError(
                f"{path}: the first marker has a single message, "
                "which has no rate: set data.bag.rate."
            )
        rate = 1.0 / float(np.median(np.diff(times[0])))
        rate = round(rate) if abs(rate - round(rate)) < 5e-3 * rate else rate
    start, stop = max(stamps[0] for stamps in times), min(stamps[-1] for stamps in times)
    if stop - start < 1.0 / rate:
        raise DataFileError(
            f"{path}: its markers have no messages at the same time; "
            "check the clocks of their headers."
        )
    return start + np.arange(int((stop - start) * rate + 1e-6) + 1) / rate, float(rate)


def _at_frames(times: FloatArray, poses: FloatArray, frames: FloatArray, rate: float) -> FloatArray:
    """Poses (T, 7) at the frames, NaN in gaps.

    A rigid body was not seen in a message whose quaternion is zero or NaN, nor any marker in one
    without its place.
    """
    result = np.full((len(frames), 7), np.nan)
    turned = np.isfinite(poses[:, 3:]).all(1) & (np.linalg.norm(poses[:, 3:], axis=1) > 0.0)
    seen = np.isfinite(poses[:, :3]).all(1) & (turned | (not turned.any()))
    if not seen.any():
        return result
    times, poses = times[seen], poses[seen]
    after = (
        np.clip(np.searchsorted(times, frames), 1, len(times) - 1)
        if len(times) > 1
        else np.zeros(len(frames), int)
    )
    gap = times[after] - times[after - 1] if len(times) > 1 else np.full(len(frames), np.inf)
    known = (gap <= _GAP / rate) | np.isin(frames, times)
    for column in range(3):
        result[known, column] = np.interp(frames[known], times, poses[:, column])
    if turned.any() and len(times) > 1:
        turn = Slerp(times, Rotation.from_quat(poses[:, [4, 5, 6, 3]]))
        result[known, 3:] = turn(np.clip(frames[known], times[0], times[-1])).as_quat()[
            :, [3, 0, 1, 2]
        ]
    return result
