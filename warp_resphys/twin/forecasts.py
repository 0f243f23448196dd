"""Estimates and predictions of a twin, which are compared with the markers that come."""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ..core.stepping.state import State
from ..data.rigid_bodies import as_markers
from ..io.arrays import FloatArray

REMEMBERED: Final = 400  # predictions
_ENOUGH: Final = 20  # predictions from which intervals are scaled
_NINETY: Final = 1.645  # half-width of an interval of 90 %, in deviations


@dataclass(frozen=True)
class Estimate:
    """A robot at the last step.

    Attributes:
        time: of the clock of the packets [s].
        state: of the robot, one environment; its reaction, if there is a simulator, is that of the
            step that predicted it, without the correction by markers.
        markers: (M, 3) [m].
        deviations: (M, 3) of their coordinates [m].
        parameters: refined values and their standard deviations, by name.
    """

    time: float
    state: State
    markers: FloatArray
    deviations: FloatArray
    parameters: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Forecast:
    """A robot in the T steps to come, under constant commands."""

    times: FloatArray  # (T + 1,) from the last step on [s]
    markers: FloatArray  # (T + 1, M, 3) [m]
    deviations: FloatArray  # (M, 3) of the end's coordinates [m], scaled by past errors
    state: State  # at the end, one environment


@dataclass(frozen=True)
class Disagreement:
    """Mean distances of markers from those measured later, over the last predictions.

    Rigid bodies by position [mm].

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
    """Mean length of the offsets (M, 3) [m] of markers and of the positions of rigid bodies [mm].

    NaN without one.
    """
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
        twin, held = (
            mean_mm(np.where(usable[:, None], x, np.nan), self._labels) for x in (off, frame - seen)
        )
        if np.isnan(twin):
            return
        ratio = off[usable] / np.hypot(forecast.deviations[usable], self._noise)
        self._errors.append((twin, held, float((np.abs(ratio) < _NINETY * self.scale).mean())))
        self._ratios.append(ratio.ravel())

    def disagreement(self, simulator: float) -> Disagreement | None:
        """Returns mean errors, beside that of the simulator without markers [mm].

        None without predictions.
        """
        if not self._errors:
            return None
        twin, held, covered = np.mean(self._errors, axis=0)
        return Disagreement(len(self._errors), float(twin), float(held), simulator, float(covered))
