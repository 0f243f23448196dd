"""MCAP files that rosbags does not read: messages in JSON, and ROS 2 messages of other recorders than ROS.

`McapFile` has the interface of the readers of rosbags. A member of a message in JSON is a path of its keys, with
numbers from 1 for the entries of lists: ``/robot#state.tips.2``.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import numpy as np

from ...io.errors import DataFileError

_PLACES: Final = ("pose", "point", "position", "vector", "translation")
_TURNS: Final = ("orientation", "rotation", "quaternion")
_NUMBERS: Final = ("data", "value", "fluid_pressure")


class Connection(NamedTuple):
    """A topic and the type of its messages."""

    topic: str
    msgtype: str


@dataclass(frozen=True)
class JsonMessage:
    """A message in JSON.

    Attributes:
        topic: its topic.
        content: objects and lists.
        path: of the file.
    """

    topic: str
    content: Any
    path: Path

    @property
    def stamp(self) -> float:
        """Time of its header or its timestamp [s], NaN without one; a number is in s, or since 1970 in ms, us or ns."""
        header = self.content if isinstance(self.content, dict) else {}
        given = header.get("header", header)
        stamp = next((given[key] for key in ("stamp", "timestamp") if key in given), None) if given else None
        if isinstance(stamp, dict):
            rest = next((stamp[key] for key in ("nanosec", "nsec", "nanos", "nsecs") if key in stamp), 0)
            return float(next((stamp[key] for key in ("sec", "seconds", "secs") if key in stamp), 0)) + 1e-9 * float(
                rest
            )
        if not isinstance(stamp, int | float):
            return np.nan
        # Times since 1970 beyond the year 5000 in one unit are in the next smaller one.
        return stamp / next((units for units in (1.0, 1e3, 1e6) if abs(stamp) < 1e11 * units), 1e9)

    def member(self, name: str | None) -> Any:
        """Returns the part of the message at a path of keys; None where it lacks that.

        Args:
            name: such as ``state.tips.2``; None for the whole message.
        """
        part = self.content
        for key in name.split(".") if name else ():
            if isinstance(part, dict):
                part = part.get(key)
            elif isinstance(part, list):
                part = part[int(key) - 1] if key.isdecimal() and 0 < int(key) <= len(part) else None
            else:
                return None
        return part

    def pose(self, member: str | None) -> Sequence[float] | None:
        """Returns place [m] and quaternion, w first, NaN without one; None where the message lacks the member.

        Raises:
            DataFileError: the member holds no place.
        """
        part = self.member(member)
        if part is None:
            return None
        place, turn = part, None
        for _ in _PLACES:  # with a covariance, a pose lies in a pose
            turn = next((place[key] for key in _TURNS if isinstance(place, dict) and key in place), turn)
            below = next((place[key] for key in _PLACES if isinstance(place, dict) and key in place), None)
            if below is None:
                break
            place = below
        numbers = _numbers(place, "xyz")
        if numbers is None:
            raise DataFileError(
                f"{self.path}: {self._named(member)} holds no place: name the member with x, y and z, or with a list "
                f"of three numbers, as in {self.topic}#pose.position."
            )
        return numbers + ((_numbers(turn, "wxyz") if isinstance(turn, dict) else None) or [np.nan] * 4)

    def number(self, member: str | None) -> Sequence[float] | None:
        """Returns a number; None where the message lacks the member.

        Raises:
            DataFileError: the member holds no number.
        """
        part = self.member(member)
        if isinstance(part, dict):
            part = next((part[key] for key in _NUMBERS if key in part), part)
        if part is None:
            return None
        if isinstance(part, bool | int | float):
            return (float(part),)
        raise DataFileError(
            f"{self.path}: {self._named(member)} holds no number: name the member that does, as in "
            f"{self.topic}#pressures.1."
        )

    def _named(self, member: str | None) -> str:
        return self.topic if member is None else f"{self.topic}#{member}"


def _numbers(part: Any, keys: str) -> list[float] | None:
    """Returns the numbers of an object with some keys, or of a list; None for anything else."""
    values = [part.get(key) for key in keys] if isinstance(part, dict) else part
    if not isinstance(values, list) or len(values) != len(keys):
        return None
    if not all(value is None or (isinstance(value, int | float) and not isinstance(value, bool)) for value in values):
        return None
    known = isinstance(part, list) or any(key in part for key in keys)
    return [np.nan if value is None else float(value) for value in values] if known else None


class McapFile:
    """An MCAP file with messages in JSON or of ROS 2.

    Args:
        path: of the file.
        types: type store of rosbags, for messages of ROS 2.

    Raises:
        ImportError: mcap is not installed.
    """

    def __init__(self, path: Path, types: Any) -> None:
        self._path, self._types = path, types
        self._encodings: dict[str, tuple[str, Any]] = {}

    def __enter__(self) -> Self:
        """Opens the file."""
        from mcap.reader import make_reader

        self._file = self._path.open("rb")
        self._reader = make_reader(self._file)
        summary = self._reader.get_summary()
        channels = [] if summary is None else [*summary.channels.values()]
        schemas = {} if summary is None else summary.schemas
        self.connections = []
        for channel in sorted(channels, key=lambda own: str(own.topic)):
            schema = schemas.get(channel.schema_id)
            name = channel.message_encoding if schema is None else schema.name
            self.connections.append(Connection(channel.topic, name))
            self._encodings[channel.topic] = channel.message_encoding, schema
        return self

    def __exit__(self, *error: object) -> None:
        """Closes the file."""
        self._file.close()

    def messages(self, connections: Sequence[Connection]) -> Iterator[tuple[Connection, int, tuple[str, bytes]]]:
        """Yields topic, time at which it was recorded [ns], and content, in the order of the times.

        Raises:
            DataFileError: messages of an encoding that cannot be read.
        """
        asked = {connection.topic: connection for connection in connections}
        for topic in asked:
            encoding, schema = self._encodings[topic]
            if encoding == "cdr" and schema is not None and schema.encoding == "ros2msg":
                self._register(schema)
            elif encoding != "json":
                raise DataFileError(
                    f"{self._path}: {topic} has messages in {encoding or 'no known encoding'}: record it as JSON, or "
                    "as messages of ROS 2."
                )
        for _, channel, message in self._reader.iter_messages(topics=[*asked]) if asked else ():
            yield asked[channel.topic], message.log_time, (channel.topic, message.data)

    def _register(self, schema: Any) -> None:
        """Adds the types of a schema of ROS 2 that the type store lacks."""
        from rosbags.typesys import get_types_from_msg

        types = get_types_from_msg(schema.data.decode(), schema.name)
        self._types.register({name: own for name, own in types.items() if name not in self._types.types})

    def deserialize(self, raw: tuple[str, bytes], kind: str) -> Any:
        """Returns a message of ROS 2 or in JSON."""
        topic, data = raw
        if self._encodings[topic][0] == "cdr":
            return self._types.deserialize_cdr(data, kind)
        return JsonMessage(topic, json.loads(data), self._path)


def is_foreign(path: Path) -> bool:
    """Whether a file is an MCAP file that was not recorded by ROS 2.

    Raises:
        ImportError: mcap is not installed.
    """
    if path.suffix.lower() != ".mcap" or not path.is_file():
        return False
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return bool(make_reader(file).get_header().profile != "ros2")
