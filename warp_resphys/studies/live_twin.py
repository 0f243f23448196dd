"""A twin in the viewer: a robot that follows another one, or a recording of it, in real time."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import numpy as np

from ..io.arrays import FloatArray
from ..io.errors import ConvergenceError, InputError, ResphysError, listed
from ..io.settings import Positive, Settings, setting
from ..robot.loading import recorded_trial, trial_names
from ..robot.robot import Robot
from ..twin.belief import JUMPS
from ..twin.forecasts import Estimate, Forecast
from ..twin.stream import Alignment, Listener, Packet, recorded_packets
from ..twin.twin import Twin

_REMEMBERED: Final = 2000  # computing times
_SHARE: Final = 4.0  # time between two predictions, over what one takes
_LOST: Final = 5  # jumps of the whole body that hint at another frame or unit
_ADVICE: Final = {
    "twin": "the twin is the best",
    "held": "the twin is no better than markers held: rely on these",
    "simulator": "the twin is no better: rely on the {}",
}
_BEHIND: Final = 1.0  # time since packets were last taken, after which the twin starts again [s]
_EVERY: Final = 0.1  # between predictions [s]


class TwinSettings(Settings):
    """The settings ``twin`` of the command ``view``, whose configuration explains them."""

    horizon: Positive = setting(unit="s")
    patience: Positive = setting(unit="s")
    align: bool
    refine: dict[str, Positive]
    noise: Positive = setting(unit="m")
    planned: bool
    engine: Literal["full", "reduced"]

    def twin(self, robot: Robot) -> Twin:
        """Returns a twin of a robot with these settings; raises the errors of `Twin`."""
        return Twin(robot, self.engine, self.refine, self.horizon, self.patience, self.noise)


def trial_packets(robot: Robot, name: str) -> Iterator[Packet]:
    """Returns the frames of a trial of the robot's run, with its commands.

    Raises:
        InputError: there is no such trial.
    """
    trial, names = recorded_trial(robot, name), robot.labels
    for moment, frame in zip(trial.times, trial.markers, strict=True):
        number = int(moment / robot.time_step + 1e-6)
        commands = {}
        for key, value in trial.inputs.items():
            series = np.asarray(value)
            commands[key] = (
                series[min(number, len(series) - 1)] if series.ndim == 3 else series
            ).ravel()
        labels = names or [f"vertex_{vertex}" for vertex in range(len(frame))]
        yield Packet(float(moment), dict(zip(labels, frame, strict=True)), commands)


def planned_packets(packets: Iterable[Packet]) -> Iterator[Packet]:
    """Returns packets of which the first has the commands of all as its plan."""
    known = list(packets)
    plan = [(packet.time, packet.inputs) for packet in known if packet.inputs]
    for number, packet in enumerate(known):
        yield packet if number else replace(packet, plan=plan)


class LiveTwin:
    """A twin that is stepped like `live.LiveRobot`, and shown in its place.

    Args:
        robot: with one environment.
        source: ``udp://HOST:PORT``, a trial of the robot's run, or a file of a recording.
        settings: of the twin.

    Attributes:
        time: of the last packet [s].
        seconds: computing times of the last packets [s].
        failure: why the twin ended; empty while it runs.
    """

    moved: ClassVar[Mapping[str, FloatArray]] = {}
    trial = None

    def __init__(self, robot: Robot, source: str, settings: TwinSettings) -> None:
        self.robot, self._settings = robot, settings
        self._source = source
        self._listener = Listener(source) if "://" in source else None
        self.seconds: deque[float] = deque(maxlen=_REMEMBERED)
        self.twin = settings.twin(robot)
        self.reset()

    @property
    def address(self) -> str:
        """URL at which packets are taken; empty for a recording."""
        return "" if self._listener is None else "udp://{}:{}".format(*self._listener.address)

    def reset(self) -> None:
        """Starts the recording again, or forgets what was estimated."""
        self.twin.reset()
        self._recorded = self._packets_of_recording()
        if self._recorded is not None and self._settings.planned:
            self._recorded = planned_packets(self._recorded)
        self._next = None if self._recorded is None else next(self._recorded, None)
        self._clock = 0.0 if self._next is None else self._next.time
        self._alignment: Alignment | None = None
        self._estimate: Estimate | None = None
        self._prediction: Forecast | None = None
        self._seen: Mapping[str, Any] = {}
        self._predicted_at, self._drained = -np.inf, time.perf_counter()
        self._spent, self.failure = 0.0, ""
        self.time, self.state = self._clock, object()

    def _packets_of_recording(self) -> Iterator[Packet] | None:
        if self._listener is not None:
            return None
        names = () if self.robot.folder is None else trial_names(self.robot)
        if self._source in names:
            return trial_packets(self.robot, self._source)
        if not Path(self._source).expanduser().exists():
            known = f", a trial of the run ({listed(names)})" if names else ""
            raise InputError(
                f"source is {self._source!r}: give udp://HOST:PORT{known}, "
                "or a file of a recording."
            )
        return recorded_packets(self.robot, self._source)

    # Views of the state

    @property
    def positions(self) -> FloatArray:
        """Estimated positions (N, 3) of the vertices [m]."""
        state = (
            self.robot.simulator.rest_positions
            if self._estimate is None
            else self._estimate.state.q[0]
        )
        return np.asarray(state.double().cpu().numpy())

    @property
    def target(self) -> FloatArray | None:
        """Predicted positions (N, 3) of the vertices [m]."""
        return (
            None if self._prediction is None else self._prediction.state.q[0].double().cpu().numpy()
        )

    @property
    def markers(self) -> FloatArray:
        """Estimated markers (M, 3) [m]; empty where every vertex is observed."""
        return (
            np.empty((0, 3))
            if self._estimate is None or not self.robot.labels
            else self._estimate.markers
        )

    @property
    def measured(self) -> FloatArray | None:
        """Markers (M, 3) of the last packet [m]; NaN for those that were not seen."""
        if not self._seen or not self.robot.labels:
            return None
        return np.array(
            [self._seen.get(label, [np.nan] * 3) for label in self.robot.labels], dtype=np.float64
        )

    @property
    def has_left(self) -> bool:
        """Whether the state is outside the training range of the learned force."""
        return self._estimate is not None and bool(self._estimate.state.left[0])

    @property
    def words(self) -> list[str]:
        """Lines of text on refined parameters, disagreement and faults of packets."""
        lines = [] if self._estimate is not None else ["Waiting for packets."]
        if self._estimate is not None:
            for name, (value, deviation) in self._estimate.parameters.items():
                lines.append(f"{name.replace('_', ' ')} {value:.4g} ± {deviation:.2g}")
        off = self.twin.disagreement
        if off is not None:
            lines.append(
                f"{self.twin.horizon:g} s ahead: {off.twin:.2f} mm off; markers held "
                f"{off.held:.2f} mm; {100 * off.covered:.0f} % in intervals of 90 %"
            )
            engine = self.twin.estimator.engine
            lines.append(
                f"{engine} without markers: {off.simulator:.2f} mm off; "
                f"{_ADVICE[off.best].format(engine)}"
            )
        if self.twin.counts.get(JUMPS, 0) > _LOST:
            lines.append(
                "Many jumps of the whole body: are packets in metres, in the robot's frame? "
                "(twin.align=true)"
            )
        faults = self.twin.counts | (self._listener.refused if self._listener is not None else {})
        return [*lines, *(f"{what}: {count} times" for what, count in faults.items())]

    # Time

    def step(self) -> bool:
        """Takes the packets of a time step; returns False where there are none."""
        if self.failure:
            return False
        began, taken = time.perf_counter(), 0
        for packet in self._due():
            taken += self._tried(self._take, packet)
        if taken and not self.failure and self._tried(self._estimated):
            self.seconds.append((time.perf_counter() - began) / taken)
            self._tried(self._predicted)
        self.state = object() if taken else self.state
        return bool(taken) or (self._next is not None and not self.failure)

    def _tried(self, task: Callable[..., None], *arguments: Any) -> bool:
        """Does a task.

        An error ends what plays a recording, and is counted for packets of others.
        """
        try:
            task(*arguments)
        except ResphysError as error:
            if self._listener is None:
                self.failure = f"Stopped: {error}"
            else:
                self._listener.refused.add(str(error))
            return False
        return True

    def _take(self, packet: Packet) -> None:
        packets = [packet]
        if self._settings.align:
            if self._alignment is None:
                at_rest = self.robot.observe(self.robot.settle(1, **packet.inputs))[0]
                self._alignment = Alignment(self.robot, at_rest.double().cpu().numpy())
            packets = self._alignment.moved(packet)
        for moved in packets:
            self.twin.take(moved.time, moved.markers or None, **moved.inputs)
            if moved.plan is not None:
                self.twin.plan(moved.plan)
            self._seen = moved.markers or self._seen

    def _estimated(self) -> None:
        self._estimate = self.twin.now if self.twin.has_begun else None
        self.time = self.time if self._estimate is None else self._estimate.time

    def _predicted(self) -> None:
        every = max(_EVERY, _SHARE * self._spent)
        if self._estimate is not None and not 0.0 <= self.time - self._predicted_at < every:
            began = time.perf_counter()
            self._prediction, self._predicted_at = None, self.time
            with suppress(ConvergenceError):  # The twin counts it.
                self._prediction = self.twin.ahead()
            self._spent = time.perf_counter() - began

    def _due(self) -> Iterator[Packet]:
        if self._listener is not None:
            packets, now = list(self._listener.packets()), time.perf_counter()
            if len(packets) > 1 and now - self._drained > _BEHIND:
                self.twin.restart("after it had fallen behind")
                latest = dict[str, Any]()
                for packet in packets:
                    latest |= packet.inputs
                plans = [packet.plan for packet in packets if packet.plan is not None]
                packets = [replace(packets[-1], inputs=latest, plan=plans[-1] if plans else None)]
            self._drained = now
            yield from packets
            return
        self._clock += self.robot.time_step
        assert self._recorded is not None
        while self._next is not None and self._next.time <= self._clock:
            yield self._next
            self._next = next(self._recorded, None)

    def close(self) -> None:
        """Frees the port."""
        if self._listener is not None:
            self._listener.close()
