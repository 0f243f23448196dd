"""Packets of markers and commands, from a recording or over UDP; predictions, compared with the markers that come."""

import json
import socket
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Self
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..data.recordings.recording_files import read_recording
from ..data.registration import RigidTransform, register_markers
from ..data.rigid_bodies import as_markers, with_corners
from ..io.arrays import FloatArray
from ..io.errors import InputError, ResphysError, listed
from ..robot.robot import Robot
from ..stepping.state import State

_LARGEST: Final = 65_535  # bytes of a packet
_FIELDS: Final = ("time", "markers", "inputs", "plan")
_LONGEST: Final = 1000  # packets that wait for the registration
_KINDS: Final = 30  # of faults that are counted apart
_FIRST: Final = 20  # frames whose median is registered
REMEMBERED: Final = 400  # predictions
_ENOUGH: Final = 20  # predictions from which intervals are scaled
_NINETY: Final = 1.645  # half-width of an interval of 90 %, in deviations


@dataclass(frozen=True)
class Packet:
    """Markers and commands at a time.

    Attributes:
        time: [s].
        markers: positions (3,) [m] by name, NaN where a marker is not seen; empty without a frame.
        inputs: commands by name, in SI units.
        plan: times [s] and commands to come; None leaves the last plan.
    """

    time: float
    markers: Mapping[str, Any] = field(default_factory=dict)
    inputs: Mapping[str, Any] = field(default_factory=dict)
    plan: Sequence[tuple[float, Mapping[str, Any]]] | None = None

    @classmethod
    def of_text(cls, text: str | bytes) -> Self:
        """Reads a packet of JSON: ``{"time": 1.25, "markers": {"tip": [x, y, z]}, "inputs": {"pressure": [0, 1e4]}}``.

        `Twin.take` checks its commands.

        Raises:
            InputError: no JSON, no time, another field, or no positions.
        """
        try:
            content = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"a packet is no JSON ({str(error)[:80]}): docs/twin.md describes packets.") from None
        if not isinstance(content, dict) or not isinstance(content.get("time"), int | float):
            raise InputError("a packet has no time: add 'time' in seconds, on one clock for all packets.")
        for name in content:
            if name not in _FIELDS:
                raise InputError(f"a packet has the field {name!r}: it may have {listed(_FIELDS)}.")
        for name in _FIELDS[1:3]:
            if not isinstance(content.get(name, {}), dict):
                raise InputError(f"{name} of a packet is no object: give values by name.")
        plan = content.get("plan")
        try:
            plan = None if plan is None else [(entry["time"], {**entry["inputs"]}) for entry in plan]
        except (TypeError, KeyError):
            raise InputError("plan of a packet is no list of objects with 'time' and 'inputs'.") from None
        markers = {label: position_of(place, label) for label, place in content.get("markers", {}).items()}
        return cls(content["time"], markers, content.get("inputs", {}), plan)


def position_of(place: ArrayLike, label: str) -> NDArray[np.float64]:
    """Returns the position (3,) of a marker [m]; NaN where it is not seen.

    Raises:
        InputError: no position.
    """
    try:
        position = np.array([np.nan if x is None else float(x) for x in np.ravel(np.asarray(place, dtype=object))])
    except (TypeError, ValueError, OverflowError):
        position = np.empty(0)
    if place is not None and position.shape != (3,):
        raise InputError(f"a packet has {place!r} as the position of {label!r}: give x, y and z in m.")
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
        recording = with_corners(recording, {name: own.length for name, own in bodies if name in recording.labels})
    driven = [name for name in robot.inputs if name in robot.description.seen]
    commands: Iterator[Mapping[str, Any]] = iter([{}] * len(recording.positions))
    if recording.actuation is not None and driven:
        parts, width = robot.inputs[driven[0]].parts, recording.actuation.shape[1]
        if len(driven) > 1 or width != len(parts):
            raise InputError(f"{path} has {width} inputs, and {listed(driven)} of the robot has {len(parts)} parts.")
        commands = ({driven[0]: row} for row in recording.actuation)
    for time, frame, inputs in zip(recording.time, recording.positions, commands, strict=True):
        yield Packet(float(time), dict(zip(recording.labels, frame, strict=True)), inputs)


class Faults(Counter[str]):
    """Numbers of faults by their descriptions; beyond 30 descriptions, the others count together."""

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
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise InputError(f"{url} cannot be listened at ({error.strerror}): choose another port.") from None
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
    (`markers.reference`) where three of them are seen, else by all markers of the robot, which rests meanwhile.

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
                "twin.align is true, but the run's recordings are not in the frame of the body: send markers as its "
                "trials have them, and set twin.align to false."
            )
        self._residual = settings.largest_residual
        self._places = dict(zip(robot.labels, at_rest, strict=True)) | {
            label: np.asarray(place, dtype=np.float64) for label, place in settings.reference.items()
        }
        self._reference = tuple(settings.reference)
        self._waiting: list[Packet] = []
        self.transform: RigidTransform | None = None

    def moved(self, packet: Packet) -> list[Packet]:
        """Returns packets in the frame of the robot: none until enough have come, then those that waited, too.

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
            [[one.markers.get(label, [np.nan] * 3) for label in self._places] for one in self._waiting if one.markers],
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
                middle, nominal, labels, source="the first frames", largest_residual=self._residual, use=use
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


@dataclass(frozen=True)
class Forecast:
    """A robot in the T steps to come, under constant commands.

    Attributes:
        times: (T + 1,) from the last step on [s].
        markers: (T + 1, M, 3) [m].
        deviations: (M, 3) of the coordinates at the end [m], scaled by the errors of past predictions.
        state: at the end, one environment.
    """

    times: FloatArray
    markers: FloatArray
    deviations: FloatArray
    state: State


@dataclass(frozen=True)
class Disagreement:
    """Mean distances of markers from those measured later, over the last predictions; rigid bodies by position [mm].

    Attributes:
        predictions: their number.
        twin: of the predicted markers.
        held: of the markers as they were measured when the prediction was made.
        simulator: of the simulator that sees no markers, at the last frames.
        covered: share of the coordinates within 1.645 deviations, 90 % for right ones.
    """

    predictions: int
    twin: float
    held: float
    simulator: float
    covered: float

    @property
    def best(self) -> str:
        """The best of them: ``twin``, ``held`` or ``simulator``."""
        errors = {"twin": self.twin, "held": self.held, "simulator": self.simulator}
        return min(errors, key=lambda name: np.nan_to_num(errors[name], nan=np.inf))


def mean_mm(off: FloatArray, labels: Sequence[str]) -> float:
    """Mean length of the offsets (M, 3) [m] of markers and of the positions of rigid bodies [mm]; NaN without one."""
    distances = np.linalg.norm(as_markers(off, labels), axis=1)
    seen = np.isfinite(distances)
    return 1e3 * float(distances[seen].mean()) if seen.any() else float("nan")


class Scores:
    """Errors of the last predictions.

    Args:
        noise: standard deviation of a coordinate of a marker [m].
        labels: of the M markers; empty where every vertex is observed.
    """

    def __init__(self, noise: float, labels: Sequence[str]) -> None:
        self._noise, self._labels = noise, labels
        self._errors: deque[tuple[float, float, float]] = deque(maxlen=REMEMBERED)
        self._ratios: deque[FloatArray] = deque(maxlen=REMEMBERED)

    @property
    def scale(self) -> float:
        """Factor of the deviations of predictions by which past ones would have been right."""
        if len(self._ratios) < _ENOUGH:
            return 1.0
        return float(np.sqrt(np.mean(np.concatenate(list(self._ratios)) ** 2)))

    def add(self, forecast: Forecast, seen: FloatArray, time: float, frame: FloatArray) -> None:
        """Compares a forecast with the last frame in the step at its end.

        Args:
            forecast: with unscaled deviations.
            seen: markers (M, 3) as they were last seen when it was made [m].
            time: of the frame [s].
            frame: (M, 3) [m].
        """
        before, end = forecast.times[-2:]
        share = (end - time) / (end - before)
        off = frame - ((1.0 - share) * forecast.markers[-1] + share * forecast.markers[-2])
        usable = np.isfinite(off).all(axis=1) & np.isfinite(seen).all(axis=1)
        twin, held = (mean_mm(np.where(usable[:, None], x, np.nan), self._labels) for x in (off, frame - seen))
        if np.isnan(twin):
            return
        ratio = off[usable] / np.hypot(forecast.deviations[usable], self._noise)
        self._errors.append((twin, held, float((np.abs(ratio) < _NINETY * self.scale).mean())))
        self._ratios.append(ratio.ravel())

    def disagreement(self, simulator: float) -> Disagreement | None:
        """Returns mean errors, beside that of the simulator without markers [mm]; None without predictions."""
        if not self._errors:
            return None
        twin, held, covered = np.mean(self._errors, axis=0)
        return Disagreement(len(self._errors), float(twin), float(held), simulator, float(covered))
