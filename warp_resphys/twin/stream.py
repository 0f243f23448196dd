"""Packets of markers and commands, from a recording or over UDP."""

import json
import socket
from bisect import insort
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Self
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.recordings.recording_files import read_recording
from ..data.registration import RigidTransform, register_markers
from ..data.rigid_bodies import with_corners
from ..io.arrays import FloatArray
from ..io.errors import InputError, ResphysError, listed
from ..robot.actuation import Given
from ..robot.robot import Robot

_LARGEST: Final = 65_535  # bytes of a packet
_FIELDS: Final = ("time", "markers", "inputs", "plan")
_LONGEST: Final = 1000  # packets that wait for the registration
ROUNDING: Final = 1e-3  # of times, in steps: clocks that count from 1970 resolve microseconds
_KINDS: Final = 30  # of faults that are counted apart
_FIRST: Final = 20  # frames whose median is registered


@dataclass(frozen=True)
class Packet:
    """Markers and commands at a time."""

    time: float  # [s]
    # positions (3,) [m] by name, NaN where a marker is not seen; empty without a frame
    markers: Mapping[str, ArrayLike] = field(default_factory=dict)
    inputs: Mapping[str, ArrayLike] = field(default_factory=dict)  # commands by name, in SI units
    # times [s] and commands to come; None leaves the last plan
    plan: Sequence[tuple[float, Mapping[str, ArrayLike]]] | None = None

    @classmethod
    def of_text(cls, text: str | bytes) -> Self:
        """Reads a packet of JSON: ``{"time": 1.25, "markers": {"tip": [x, y, z]}, "inputs":
        {"pressure": [0, 1e4]}}``.

        `Twin.take` checks its commands.

        Raises:
            InputError: no JSON, no time, another field, or no positions.
        """
        try:
            content = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"a packet is no JSON ({str(error)[:80]}): docs/twin.md describes packets."
            ) from None
        if not isinstance(content, dict) or not isinstance(content.get("time"), int | float):
            raise InputError(
                "a packet has no time: add 'time' in seconds, on one clock for all packets."
            )
        for name in content:
            if name not in _FIELDS:
                raise InputError(f"a packet has the field {name!r}: it may have {listed(_FIELDS)}.")
        for name in _FIELDS[1:3]:
            if not isinstance(content.get(name, {}), dict):
                raise InputError(f"{name} of a packet is no object: give values by name.")
        plan = content.get("plan")
        try:
            plan = (
                None if plan is None else [(entry["time"], {**entry["inputs"]}) for entry in plan]
            )
        except (TypeError, KeyError):
            raise InputError(
                "plan of a packet is no list of objects with 'time' and 'inputs'."
            ) from None
        markers = {
            label: position_of(place, label) for label, place in content.get("markers", {}).items()
        }
        return cls(content["time"], markers, content.get("inputs", {}), plan)


def position_of(place: ArrayLike, label: str) -> NDArray[np.float64]:
    """Returns the position (3,) of a marker [m]; NaN where it is not seen.

    Raises:
        InputError: no position.
    """
    try:
        position = np.array(
            [np.nan if x is None else float(x) for x in np.ravel(np.asarray(place, dtype=object))]
        )
    except (TypeError, ValueError, OverflowError):
        position = np.empty(0)
    if place is not None and position.shape != (3,):
        raise InputError(
            f"a packet has {place!r} as the position of {label!r}: give x, y and z in m."
        )
    return position if np.isfinite(position).all() and place is not None else np.full(3, np.nan)


def recorded_packets(robot: Robot, path: str | Path) -> Iterator[Packet]:
    """Returns the frames of a recording with its commands, in the order of time.

    Raises:
        DataFileError: the recording cannot be read (`read_recording`).
        InputError: it has commands of another number than the robot's one driven input.
    """
    markers, recording = robot.description.markers, read_recording(Path(path).expanduser())
    if markers is not None:
        bodies = markers.rigid_bodies.items()
        recording = with_corners(
            recording, {name: body.length for name, body in bodies if name in recording.labels}
        )
    driven = [name for name in robot.inputs if name in robot.description.seen]
    commands: Iterator[Mapping[str, ArrayLike]] = iter([{}] * len(recording.positions))
    if recording.actuation is not None and driven:
        parts, width = robot.inputs[driven[0]].parts, recording.actuation.shape[1]
        if len(driven) > 1 or width != len(parts):
            raise InputError(
                f"{path} has {width} inputs, and {listed(driven)} "
                f"of the robot has {len(parts)} parts."
            )
        commands = ({driven[0]: row} for row in recording.actuation)
    for time, frame, inputs in zip(recording.time, recording.positions, commands, strict=True):
        yield Packet(float(time), dict(zip(recording.labels, frame, strict=True)), inputs)


def frame_of(
    markers: Mapping[str, ArrayLike] | ArrayLike, numbers: Mapping[str, int], faults: "Faults"
) -> FloatArray:
    """Returns the positions (M, 3) of a frame [m], with NaN for markers that are not seen.

    Args:
        markers: positions by name, or (M, 3).
        numbers: of the M markers, by name.
        faults: counts names of other markers.

    Raises:
        InputError: no positions, or another number of markers.
    """
    shape = (len(numbers), 3)
    if isinstance(markers, Mapping):
        frame = np.full(shape, np.nan)
        for label, place in markers.items():
            if label in numbers:
                frame[numbers[label]] = position_of(place, label)
            else:
                faults.add(f"unknown marker {label!r}")
        return frame
    frame = np.asarray(markers, dtype=np.float64)
    if frame.shape != shape:
        raise InputError(
            f"a packet has markers of shape {frame.shape}: give {shape}, or positions by name."
        )
    return np.where(np.isfinite(frame).all(axis=1)[:, None], frame, np.nan)


class CommandSeries:
    """Commands by name, with the times from which they hold; of equal times, the later added ones.

    Args:
        first: commands that hold from the beginning.
        time_step: h [s].
    """

    def __init__(self, first: Mapping[str, Given], time_step: float) -> None:
        self._entries: list[tuple[float, Mapping[str, Given]]] = [(-np.inf, first)]
        self._rounding = ROUNDING * time_step

    def add(self, time: float, commands: Mapping[str, Given]) -> None:
        """Adds commands that hold from a time on [s]."""
        insort(self._entries, (time, commands), key=lambda entry: entry[0])

    def at(self, time: float, after: float | None = None) -> dict[str, Given]:
        """Returns commands that hold at a time [s], of those that were given after another one."""
        known = dict[str, Given]()
        for since, commands in self._entries:
            if since <= time + self._rounding and (after is None or since > after):
                known |= commands
        return known

    def drop_last(self, time: float) -> bool:
        """Removes the commands that were given last before a time.

        Returns whether there were any.
        """
        count = sum(since <= time + self._rounding for since, _ in self._entries)
        del self._entries[max(count - 1, 0) : count]
        return bool(count)

    def forget(self, oldest: float) -> None:
        """Removes commands that others had followed before a time [s]."""
        later = [entry for entry in self._entries if entry[0] > oldest]
        self._entries = [(-np.inf, self.at(oldest - self._rounding)), *later]


class Faults(Counter[str]):
    """Numbers of faults by their descriptions.

    Beyond 30 descriptions, the others count together.
    """

    def add(self, what: str) -> None:
        """Counts a fault."""
        self[what if what in self or len(self) < _KINDS else "other faults"] += 1


class Listener:
    """Receives packets of JSON over UDP, without waiting.

    Args:
        url: such as ``udp://127.0.0.1:9000``; port 0 is any.

    Attributes:
        address: host and port that it listens at.
        refused: faults of packets that were left out.

    Raises:
        InputError: another URL, or a port that cannot be used.
    """

    def __init__(self, url: str) -> None:
        self.refused = Faults()
        try:
            parts = urlsplit(url)
            host, port = parts.hostname, parts.port
        except ValueError:
            host = port = None
        if host is None or port is None or parts.scheme != "udp":
            raise InputError(f"source is {url!r}: give udp://HOST:PORT, as udp://127.0.0.1:9000.")
        self._socket = socket.socket(
            socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM
        )
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise InputError(
                f"{url} cannot be listened at ({error.strerror}): choose another port."
            ) from None
        self.address: tuple[str, int] = self._socket.getsockname()[:2]

    def packets(self) -> Iterator[Packet]:
        """Returns the packets that have arrived; wrong ones are counted in `refused`."""
        while True:
            try:
                text = self._socket.recv(_LARGEST)
            except (BlockingIOError, InterruptedError):
                return
            try:
                yield Packet.of_text(text)
            except InputError as error:
                self.refused.add(str(error))

    def close(self) -> None:
        """Frees the port."""
        self._socket.close()


class Alignment:
    """Moves packets from the frame of cameras to that of the robot.

    The first frames are registered, as an import does it: by the markers on what holds the robot
    (`markers.reference`) where three of them are seen, else by all markers of the robot, which
    rests meanwhile.

    Args:
        robot: whose markers they are.
        at_rest: (M, 3) markers of the robot at rest under the first commands [m].

    Raises:
        InputError: every vertex is observed, or the markers have a frame of their own.
    """

    def __init__(self, robot: Robot, at_rest: NDArray[np.float64]) -> None:
        settings = robot.description.markers
        if settings is None or settings.frame == "own" or settings.plane is not None:
            raise InputError(
                "twin.align is true, but the run's recordings are not in the frame of the body: "
                "send markers as its trials have them, and set twin.align to false."
            )
        self._residual = settings.largest_residual
        self._places = dict(zip(robot.labels, at_rest, strict=True)) | {
            label: np.asarray(place, dtype=np.float64)
            for label, place in settings.reference.items()
        }
        self._reference = tuple(settings.reference)
        self._waiting: list[Packet] = []
        self.transform: RigidTransform | None = None

    def moved(self, packet: Packet) -> list[Packet]:
        """Returns packets in the frame of the robot:
        none until enough have come, then those that waited, too.

        Raises:
            ResphysError: the markers cannot be registered.
        """
        if self.transform is None:
            self._waiting = [*self._waiting[-_LONGEST:], packet]
            if sum(bool(waiting.markers) for waiting in self._waiting) < _FIRST:
                return []
            self._register()
            waiting, self._waiting = self._waiting, []
            return [self._applied(one) for one in waiting]
        return [self._applied(packet)]

    def _register(self) -> None:
        seen = np.array(
            [
                [one.markers.get(label, [np.nan] * 3) for label in self._places]
                for one in self._waiting
                if one.markers
            ],
            dtype=np.float64,
        )
        lost = np.asarray(np.isnan(seen).any(axis=-1).all(axis=0))
        middle = np.full(seen.shape[1:], np.nan)
        middle[~lost] = np.nanmedian(seen[:, ~lost], axis=0)
        labels = [*self._places]
        known = [label for label in self._reference if not lost[labels.index(label)]]
        use = known if len(known) >= 3 else None
        nominal = np.stack([*self._places.values()])
        try:
            registration = register_markers(
                middle,
                nominal,
                labels,
                source="the first frames",
                largest_residual=self._residual,
                use=use,
            )
        except ResphysError:
            self._waiting = []
            raise
        self.transform = registration.transform

    def _applied(self, packet: Packet) -> Packet:
        assert self.transform is not None
        places = {
            label: self.transform.apply(np.asarray(place, dtype=np.float64)[None])[0]
            for label, place in packet.markers.items()
            if label not in self._reference
        }
        return replace(packet, markers=places)
