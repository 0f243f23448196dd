"""A robot's simulator that follows the real robot as its markers come in, and looks ahead."""

from bisect import insort
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import ArrayLike

from ..core.stepping.rollout import rollout
from ..io.arrays import FloatArray
from ..io.errors import ConvergenceError, InputError
from ..robot.actuation import Given, InputReader
from ..robot.robot import Robot
from .belief import Belief, Correction
from .estimator import TwinEstimator
from .forecasts import REMEMBERED, Disagreement, Estimate, Forecast, Scores, mean_mm
from .full_estimator import FullEstimator
from .reduced_estimator import ReducedEstimator
from .stream import ROUNDING, CommandSeries, Faults, frame_of

Engine = Callable[[Robot, Mapping[str, Given], Mapping[str, float], float], TwinEstimator[Any]]
_ENGINES: Final[Mapping[str, Engine]] = {"full": FullEstimator, "reduced": ReducedEstimator}
_LONGEST_GAP: Final = 2.0  # without a packet, after which the twin starts again [s]
_STALE: Final = 10  # packets in order, all too old, after which the clock has been set back
_LATEST: Final = 1e12  # of times [s]
_FAR: Final = (
    10.0  # distance of the first markers that hints at another unit, over the size of the body
)


@dataclass
class _Interval:
    """Frames taken during a step, and the beliefs after it:
    as simulated, and as corrected by the frames.
    """

    frames: list[tuple[float, FloatArray]] = field(default_factory=list)
    predicted: Belief | None = None
    corrected: Belief | None = None
    corrections: list[Correction] = field(default_factory=list)
    before: float | None = None  # time of the last frame before this interval
    last: float | None = None  # time of the last frame until its end


class Twin:
    """A robot that follows a real one by its markers, and looks ahead.

    Packets may come late: all steps since are computed again, so that the estimate is the one of
    packets in order. Corrections excite vibrations that the midpoint rule would keep, so that BDF2
    steps in its place.

    Args:
        robot: as `warp_resphys.load` returns it.
        engine: ``full``, its simulator, or ``reduced``, its reduced model.
        refine: standard deviations of parameters that are refined on the way, by name, in their
            units.
        horizon: of `ahead` [s].
        patience: how late a packet may come [s].
        noise: standard deviation of a coordinate of a marker [m].
        inputs: commands before the first packet, as for `Robot.step`.

    Raises:
        InputError: no robot; an unknown engine, input or parameter; a value that is not positive; a
            network in place of the simulator; or a robot that cannot be reduced.
        ConvergenceError: there is no equilibrium.
    """

    def __init__(
        self,
        robot: Robot,
        engine: str = "full",
        refine: Mapping[str, float] | None = None,
        horizon: float = 0.2,
        patience: float = 0.3,
        noise: float = 2e-4,
        **inputs: Given,
    ) -> None:
        if not isinstance(robot, Robot):
            raise InputError(
                f"robot is {robot!r}: give the robot of a run, as warp_resphys.load returns it."
            )
        if engine not in _ENGINES:
            raise InputError(f"engine is {engine!r}: choose {' or '.join(_ENGINES)}.")
        for name, value in (("horizon", horizon), ("patience", patience)):
            if not 0.0 < value < np.inf:
                raise InputError(f"{name} is {value:g}: give seconds, more than zero.")
        robot = robot.integrated_by("bdf2") if robot.simulator.integrator == "midpoint" else robot
        estimator = _ENGINES[engine](robot, inputs, refine or {}, noise)
        self.estimator = estimator
        self.horizon, self.patience = horizon, patience
        self.labels, self._h = estimator.labels, estimator.time_step
        self._keep = int(np.ceil(patience / self._h)) + 1
        names = self.labels or [f"vertex_{number}" for number in range(estimator.count)]
        self._numbers = {label: number for number, label in enumerate(names)}
        self._reader = InputReader(estimator.robot.inputs, estimator.robot.simulator)
        self.reset()

    def reset(self) -> None:
        """Forgets all packets."""
        self._scores = Scores(self.estimator.noise, self.labels)
        # Predictions that have not come to their end, with unscaled deviations, and markers seen
        # when they were made.
        self._pending: list[tuple[Forecast, FloatArray]] = []
        self._free: deque[float] = deque(maxlen=REMEMBERED)
        self._counts = Faults()
        self._commands, self._planned = (
            CommandSeries(self.estimator.inputs, self._h),
            CommandSeries({}, self._h),
        )
        self._latest = -np.inf  # time of the newest packet
        self._steps: dict[int, _Interval] = {}
        self._refined: FloatArray | None = None
        self._stale = 0
        # Last steps that were simulated, and corrected, with all packets.
        self._simulated, self._done = 0, -1
        self._again = self._framed = False
        self._origin = np.nan  # time of the first packet

    def __repr__(self) -> str:
        """Returns a short description: robot, kind of simulator,
        steps, and times of predictions and packets.
        """
        about, engine = self.estimator.robot.description, self.estimator.engine
        return (
            f"Twin of {about.name}, {about.model}, by its {engine}: steps of {1e3 * self._h:g} "
            f"ms, predictions {self.horizon:g} s ahead, "
            f"{f'last packet at {self._latest:g} s' if self.has_begun else 'no packet yet'}"
        )

    def _start(self, time: float, commands: dict[str, Given], frame: FloatArray | None) -> None:
        belief = self.estimator.begin(commands, self._refined)
        if frame is not None:
            self._check_unit(frame, belief)
        for interval in self._steps.values():
            self._forget(interval)
        self._latest = self._origin = time
        self._newest = self._stale = 0
        self._again = self._framed = False
        self._commands = CommandSeries(commands, self._h)
        self._steps = {0: _Interval(predicted=belief)}
        self._simulated, self._done = 0, -1
        self._pending = []

    # Packets

    def take(
        self,
        time: float,
        markers: Mapping[str, ArrayLike] | ArrayLike | None = None,
        /,
        **inputs: Given,
    ) -> bool:
        """Takes a packet: markers seen, and commands that hold from then on.

        Args:
            time: when they were seen or commanded, on one clock for all packets [s].
            markers: positions [m] by name, or (M, 3) in the order of `labels` with NaN for those
                that were not seen.
            inputs: by name, as for `Robot.step`; those that are not given stay.

        Returns:
            Whether it came in time. The markers of a packet older than `patience` are left out, and
            its commands hold from the oldest step that is still known.

        Raises:
            InputError: no time, or an unknown input or values that it cannot have; the packet is
                left out.
        """
        commands = self._read(time, inputs)
        for fault in self.estimator.faults(commands):
            self._counts.add(fault)
        frame = None if markers is None else frame_of(markers, self._numbers, self._counts)
        if not self.has_begun or self._is_other_clock(time):
            self._start(time, {**self._commands.at(np.inf), **commands}, frame)
            commands = {}
        elif frame is not None and not self._framed:
            self._check_unit(
                frame,
                next(one.predicted for one in self._steps.values() if one.predicted is not None),
            )
        self._framed = self._framed or frame is not None
        number = int(np.ceil((time - self._origin) / self._h - ROUNDING))
        oldest = max(self._newest - self._keep + 1, 0)
        too_late = number < oldest
        if commands:
            self._commands.add(time, commands)
            changed = max(number, oldest)
            self._simulated, self._done = min(self._simulated, changed), min(self._done, changed)
        if too_late:
            self._counts.add("packets too late")
            return False
        for new in range(self._newest + 1, number + 1):
            self._steps[new] = _Interval()
        if number < self._newest:
            self._counts.add("packets out of order")
        self._newest, self._latest = max(self._newest, number), max(self._latest, time)
        if frame is not None:
            insort(self._steps[number].frames, (time, frame), key=lambda entry: entry[0])
            self._done = min(self._done, number - 1)
            self._simulated = min(self._simulated, number)
        return True

    def plan(self, commands: Iterable[tuple[float, Mapping[str, Given]]]) -> None:
        """Announces commands, for predictions only: what acts is what packets say.

        It replaces the last plan.

        Args:
            commands: times on the clock of the packets [s], and commands by name that will hold
                from then on.

        Raises:
            InputError: no time, or an unknown input or values that it cannot have; the last plan
                stays.
        """
        planned = CommandSeries({}, self._h)
        for at, values in commands:
            planned.add(at, self._read(at, values))
        self._planned = planned

    def _read(self, time: float, inputs: Mapping[str, Given]) -> dict[str, Given]:
        if not isinstance(time, Real) or not abs(time) < _LATEST:
            raise InputError(f"a packet has the time {time}: give seconds.")
        return {name: self._reader.read(name, value, 1) for name, value in inputs.items()}

    def restart(self, why: str) -> None:
        """Starts again with the next packet, from rest and with the refined parameters.

        `counts` has the reason.
        """
        if self.has_begun:
            self._counts.add(f"starts {why}")
            self._again = True

    def _belief_at(self, number: int) -> Belief:
        belief = self._steps[number].corrected
        assert belief is not None
        return belief

    def _is_other_clock(self, time: float) -> bool:
        """Whether the twin starts again: after a gap,
        or where the clock of the packets was set back.
        """
        if self._again:
            return True
        now = self._origin + self._newest * self._h
        if time > now + _LONGEST_GAP:
            self._counts.add("starts after a gap")
            return True
        self._stale = self._stale + 1 if time < now - self.patience - self._h else 0
        if self._stale >= _STALE:
            self._counts.add("starts with an earlier clock")
            self._planned = CommandSeries({}, self._h)
            return True
        return False

    def _check_unit(self, frame: FloatArray, belief: Belief) -> None:
        off = np.linalg.norm(frame - self.estimator.markers(belief)[0], axis=1)
        if np.isfinite(off).any() and np.nanmedian(off) > _FAR * self.estimator.size:
            raise InputError(
                f"the first markers are {np.nanmedian(off):.3g} m from the robot: give positions "
                "in metres, in the frame of the run's recordings."
            )

    # Estimates

    def _update(self) -> int:
        """Computes what packets have changed; returns the number of the last step."""
        if not self.has_begun:
            raise InputError("the twin has seen no packet: give it one by take().")
        with torch.no_grad():
            for number in range(self._done + 1, self._newest + 1):
                interval = self._steps[number]
                if number > self._simulated:
                    interval.predicted = self._advanced(self._belief_at(number - 1), number)
                    self._simulated = number
                self._corrected(interval, number)
                self._done = number
        self._refined = self._belief_at(self._newest).parameters
        pending, self._pending = self._pending, []
        for forecast, seen in pending:
            number = round((forecast.times[-1] - self._origin) / self._h)
            if number in self._steps and self._steps[number].frames:
                time, frame = self._steps[number].frames[-1]
                self._scores.add(forecast, seen, time, frame)
            elif number > self._newest - self._keep:  # A frame may still come.
                self._pending.append((forecast, seen))
        for number in [number for number in self._steps if number <= self._newest - self._keep]:
            self._forget(self._steps.pop(number))
        self._commands.forget(self._origin + min(self._steps) * self._h)
        return self._newest

    def _advanced(self, belief: Belief, number: int) -> Belief:
        start = self._origin + (number - 1) * self._h
        while True:
            commands = self._commands.at(start)
            try:
                return self.estimator.advance(belief, commands)
            except ConvergenceError:
                self._counts.add(
                    "failed steps, after which the state was that of the simulator without markers"
                )
                return self._without_markers(belief, commands)
            except InputError as error:
                # Such as a base that moves too fast: what was commanded last is forgotten.
                if not self._commands.drop_last(start):
                    raise
                self._counts.add(f"a command was left out: {error}")

    def _without_markers(self, belief: Belief, commands: dict[str, Given]) -> Belief:
        """A step from the state of the simulator without markers.

        At rest, if that fails as well.
        """
        try:
            return self.estimator.advance(
                self.estimator.without_markers(belief), commands, renew=False
            )
        except ConvergenceError:
            return self.estimator.begin(commands, belief.parameters)

    def _corrected(self, interval: _Interval, number: int) -> None:
        belief, interval.corrections = interval.predicted, []
        assert belief is not None
        end = self._origin + number * self._h
        interval.before = (
            self._steps[number - 1].last if number - 1 in self._steps else interval.before
        )
        last = interval.before
        for time, frame in interval.frames:
            passed = self._h if last is None else time - last
            belief, correction = self.estimator.correct(belief, frame, max(end - time, 0.0), passed)
            interval.corrections.append(correction)
            last = time
        interval.corrected, interval.last = belief, last

    def _forget(self, interval: _Interval) -> None:
        """Counts what happened in a step that no packet can change any more."""
        for correction in interval.corrections:
            for fault in correction.faults(self.labels):
                self._counts.add(fault)
            free = mean_mm(correction.free, self.labels)
            if np.isfinite(free):
                self._free.append(free)

    @property
    def has_begun(self) -> bool:
        """Whether there was a packet."""
        return not np.isnan(self._origin)

    @property
    def now(self) -> Estimate:
        """The robot after the last packet.

        Raises:
            InputError: there was no packet.
        """
        belief = self._belief_at(self._update())
        markers, deviations = self.estimator.markers(belief)
        return Estimate(
            self._origin + self._newest * self._h,
            self.estimator.robot_state(belief),
            markers,
            deviations,
            self.estimator.refined(belief),
        )

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of faults of packets and of restarts, by their descriptions."""
        if not self.has_begun:
            return {}
        self._update()
        counts = self._counts.copy()
        for interval in self._steps.values():
            for correction in interval.corrections:
                for fault in correction.faults(self.labels):
                    counts.add(fault)
        return dict(counts)

    def ahead(self, seconds: float | None = None, **inputs: Given) -> Forecast:
        """Simulates what comes, under the last commands and those of the `plan`, or under others.

        Predictions without other commands are compared with the markers that come (`disagreement`).

        Args:
            seconds: `horizon` if omitted.
            inputs: commands that differ.

        Raises:
            InputError: an invalid input; or there was no packet.
            ConvergenceError: a step failed.
        """
        if seconds is not None and not 0.0 < seconds < np.inf:
            raise InputError(
                f"seconds is {seconds}: give the length of the prediction, more than zero."
            )
        belief = self._belief_at(self._update())
        commands, now = self._commands.at(np.inf), self._origin + self._newest * self._h
        steps = max(
            int(np.ceil((self.horizon if seconds is None else seconds) / self._h - ROUNDING)), 1
        )

        def advance(before: Belief, number: int) -> Belief:
            planned = self._planned.at(now + number * self._h, after=self._latest)
            try:
                return self.estimator.advance(
                    before, {**commands, **planned, **inputs}, renew=False
                )
            except (ConvergenceError, InputError):
                self._counts.add("predictions that failed")
                raise

        with torch.no_grad():
            beliefs = rollout(advance, belief, range(steps), lambda reached: reached)
        markers, state = [self.estimator.markers(reached)[0] for reached in beliefs], beliefs[-1]
        times = now + self._h * np.arange(steps + 1, dtype=np.float64)
        deviations = self.estimator.markers(state)[1]
        prediction = Forecast(
            times,
            np.stack(markers),
            self._scores.scale * deviations,
            self.estimator.robot_state(state),
        )
        seen = self._last_seen()
        if not inputs and seconds is None and seen is not None:
            self._pending.append((replace(prediction, deviations=deviations), seen))
        return prediction

    def _last_seen(self) -> FloatArray | None:
        """Markers (M, 3) as they were last seen [m], NaN where not for `patience`."""
        frames = []
        for number in sorted(self._steps):
            frames += [frame for _, frame in self._steps[number].frames]
        if not frames:
            return None
        seen = frames[0].copy()
        for frame in frames[1:]:
            seen = np.where(np.isnan(frame), seen, frame)
        return seen

    # Disagreement

    @property
    def disagreement(self) -> Disagreement | None:
        """Errors of the last predictions; None before one has come to its end."""
        if not self.has_begun:
            return None
        self._update()
        return self._scores.disagreement(float(np.mean(self._free)) if self._free else float("nan"))
