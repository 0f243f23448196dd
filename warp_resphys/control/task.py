"""Paths for a point of a robot, circles, figures of eight and letters,
and the task to follow them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares

from ..io.arrays import FloatArray
from ..io.errors import InputError
from ..robot.robot import Robot
from ..settings.control import FigureSettings
from .linear_model import LinearModel
from .plan import Horizon, Planner, tracked_of
from .polynomials import around
from .reduced_model import ReducedModel
from .sampling import driven_input

_POINTS = 40  # number of points of a path whose reach is checked
_SPACING = 0.05  # between knots of the inputs of a plan [s]
_AHEAD = 0.3  # horizon of plans of whole motions [s]
_WEIGHT, _ITERATIONS = 1e-3, 3  # of these plans
_CHANGE = 1e-3  # of the inputs for derivatives of an equilibrium, as a share of their ranges
_LEAST_PIECES = 3  # of the inputs in a receding horizon
_RESOLUTION: Final = 2000  # number of points of a path
_CORNER: Final = 0.02  # length over which corners are rounded, as a share of the path
# Strokes of the letters, a polyline for each, on a grid of columns 0 to 4 and rows 0 to 6.
_LETTERS: Final[Mapping[str, str]] = {
    "A": "00 26 40 33 13",
    "B": "00 06 26 35 34 23 03 23 42 41 30 00",
    "C": "45 36 16 05 01 10 30 41",
    "D": "00 06 26 44 42 20 00",
    "E": "46 06 03 33 03 00 40",
    "F": "46 06 03 33 03 00",
    "G": "45 36 16 05 01 10 30 41 43 23",
    "H": "06 00 03 43 46 40",
    "I": "26 20",
    "J": "46 41 30 10 01",
    "K": "06 00 03 46 13 40",
    "L": "06 00 40",
    "M": "00 06 23 46 40",
    "N": "00 06 40 46",
    "O": "16 05 01 10 30 41 45 36 16",
    "P": "00 06 36 45 44 33 03",
    "Q": "2,2 3.5,0.5 4,1 4,5 3,6 1,6 0,5 0,1 1,0 3,0 3.5,0.5 4,0",
    "R": "00 06 36 45 44 33 03 40",
    "S": "45 36 16 05 04 13 33 42 41 30 10 01",
    "T": "06 46 26 20",
    "U": "06 01 10 30 41 46",
    "V": "06 20 46",
    "W": "06 10 23 30 46",
    "X": "06 40 23 00 46",
    "Y": "06 23 46 23 20",
    "Z": "06 46 00 40",
}


@dataclass(frozen=True)
class Path:
    """A plane curve."""

    name: str  # ``circle``, ``eight`` or a capital letter
    size: float  # of its larger side [m]
    centre: Sequence[float]  # (3,) of its bounding box [m]
    right: Sequence[float] = (1.0, 0.0, 0.0)  # (3,) the direction of its width
    up: Sequence[float] = (0.0, 1.0, 0.0)  # (3,) direction of its height, made perpendicular

    @property
    def points(self) -> FloatArray:
        """Evenly spaced points (P, 3) of the curve, with rounded corners [m].

        Raises:
            InputError: an unknown shape, a size that is not positive, or parallel directions.
        """
        if not self.size > 0.0:
            raise InputError(
                f"the size of the path {self.name} is {self.size:g}: it must be positive, in m."
            )
        flat = _curve(self.name)
        low, high = flat.min(0), flat.max(0)
        flat = (flat - 0.5 * (low + high)) * (self.size / float((high - low).max()))
        first = np.asarray(self.right, dtype=np.float64)
        second = np.asarray(self.up, dtype=np.float64)
        if not np.linalg.norm(np.cross(first, second)) > 1e-9:
            raise InputError(
                f"right and up of the path {self.name} are parallel: give two different directions."
            )
        first = first / np.linalg.norm(first)
        second = second - (second @ first) * first
        second /= np.linalg.norm(second)
        return np.asarray(np.asarray(self.centre) + flat[:, :1] * first + flat[:, 1:] * second)

    def timed(self, seconds: float, time_step: float, lead: FloatArray) -> FloatArray:
        """Reference (T, 3) of the point after each step [m]; it starts and ends at rest.

        Args:
            seconds: duration of the curve.
            time_step: h [s].
            lead: (3,) point from which it first moves to the start of the curve, in a quarter of
                the duration [m].

        Raises:
            InputError: the duration is shorter than ten steps.
        """
        steps = round(seconds / time_step)
        if steps < 10:
            raise InputError(
                f"the path {self.name} takes {seconds:g} s: "
                f"give at least ten steps of {time_step:g} s."
            )
        curve = self.points
        at = _eased(np.arange(steps + 1) / steps) * (len(curve) - 1)
        points = _interpolated(at, np.arange(len(curve)), curve)
        before = max(steps // 4, 5)
        share = _smooth(np.arange(1, before) / before)[:, None]
        return np.concatenate([lead + share * (points[0] - lead), points])


def _curve(name: str) -> FloatArray:
    """Evenly spaced points (P, 2) of a shape, in its own units."""
    angle = np.linspace(0.0, 2.0 * np.pi, _RESOLUTION)
    if name == "circle":
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if name == "eight":  # Gerono's lemniscate
        return _even(np.stack([np.sin(2.0 * angle) / 2.0, np.cos(angle)], axis=1))
    if name not in _LETTERS:
        raise InputError(f"the path is {name!r}: choose circle, eight, or a capital letter.")
    corners = [at.split(",") if "," in at else [*at] for at in _LETTERS[name].split()]
    straight = _even(np.array(corners, dtype=np.float64))
    return _even(gaussian_filter1d(straight, _CORNER * _RESOLUTION / 2.0, axis=0, mode="nearest"))


def _even(points: FloatArray) -> FloatArray:
    """Resamples a curve at equal distances."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return _interpolated(np.linspace(0.0, along[-1], _RESOLUTION), along, points)


def _interpolated(at: FloatArray, knots: NDArray[Any], values: FloatArray) -> FloatArray:
    return np.stack([np.interp(at, knots, column) for column in values.T], axis=1)


def _smooth(share: FloatArray) -> FloatArray:
    """Smooth step from 0 to 1, with zero velocity and acceleration at both ends."""
    return np.asarray(share**3 * (10.0 - 15.0 * share + 6.0 * share**2))


def _eased(share: FloatArray) -> FloatArray:
    """Progress from 0 to 1 at constant speed, except
    that it accelerates and decelerates in the outer tenths.
    """
    rate = _smooth(np.clip(10.0 * np.minimum(share, 1.0 - share), 0.0, 1.0))
    gone = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]))])
    return np.asarray(gone / gone[-1])


class Task:
    """Figures that a point of a robot follows.

    Args:
        figures: settings of the figures.
        robot: whose markers and steps they have.

    Attributes:
        time_step: h [s].
        parts: number n of inputs.
    """

    def __init__(self, figures: FigureSettings, robot: Robot) -> None:
        self.figures = figures
        self._labels, self.time_step = robot.labels, robot.time_step
        self.parts = len(driven_input(robot).parts)

    @cached_property
    def tracked(self) -> FloatArray:
        """Matrix (3, 3 M) from the markers to the tracked point, a mean of some of them."""
        return tracked_of(self._labels, self.figures.tracked)

    @property
    def paths(self) -> list[Path]:
        """The curves, one for each shape."""
        shown = self.figures
        return [
            Path(name, size=shown.size, centre=shown.centre, right=shown.right, up=shown.up)
            for name in shown.shapes
        ]

    def steps(self, seconds: float) -> int:
        """Number T of steps of a motion whose curve takes so long."""
        return len(self.paths[0].timed(seconds, self.time_step, np.zeros(3)))

    def planner(
        self,
        model: ReducedModel | LinearModel,
        path: FloatArray,
        horizon: float = _AHEAD,
        weight: float = _WEIGHT,
        iterations: int = _ITERATIONS,
    ) -> Planner:
        """Returns a planner along a path (T, 3), by default of whole motions.

        Args:
            model: of the robot.
            path: reference after each step [m].
            horizon: of a plan [s].
            weight: of inputs and their changes.
            iterations: of Gauss-Newton.
        """
        steps = max(round(horizon / self.time_step), 1)
        pieces = min(max(round(steps * self.time_step / _SPACING), _LEAST_PIECES), steps)
        plan = Horizon(steps, pieces, weight, iterations)
        return Planner(model, self.tracked, self.figures.limits, path, plan)

    def check_reach(self, model: ReducedModel, reach: float) -> None:
        """Checks that the robot has an equilibrium at every point of the paths.

        Args:
            model: of the robot.
            reach: distance that a point may be out of reach [m].

        Raises:
            InputError: a point is out of reach; the error names the nearest reachable point.
        """
        for path in self.paths:
            curve = path.points
            worst, guess = 0.0, None
            shown = curve[0], curve[0]
            for point in curve[:: max(len(curve) // _POINTS, 1)]:
                guess, near = self._nearest(model, point, guess)
                distance = float(np.linalg.norm(near - point))
                if distance > worst:
                    worst, shown = distance, (point, near)
            if worst > reach:
                wanted, reached = map(_shown_mm, shown)
                raise InputError(
                    f"the robot cannot reach the path {path.name}: the reachable point nearest "
                    f"to {wanted} mm is {reached} mm, {1e3 * worst:.1f} mm away. Change "
                    "control.centre, control.size or control.limits.high, or allow this "
                    "distance by control.plan.reach."
                )

    def _nearest(
        self, model: ReducedModel, point: FloatArray, guess: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Inputs (n,) as shares whose equilibrium is nearest to a point,
        and its position (3,) there [m].
        """
        limits = self.figures.limits

        def places(shares: FloatArray) -> FloatArray:
            return model.rest_observed(limits.low + limits.range * shares) @ self.tracked.T

        def slopes(shares: FloatArray) -> FloatArray:
            moved = places(around(shares, _CHANGE))
            return 1e3 * (moved[1:] - moved[0]).T / _CHANGE

        starts = [np.full(self.parts, 0.4)] + (
            [] if guess is None else [np.clip(guess, 0.01, 0.99)]
        )
        searches = [
            least_squares(
                lambda x: 1e3 * (places(x[None])[0] - point), start, slopes, (0.0, 1.0), xtol=1e-4
            )
            for start in starts
        ]
        best = min(searches, key=lambda search: search.cost).x
        return best, places(best[None])[0]


def _shown_mm(point: FloatArray) -> str:
    """Returns the coordinates of a point [m] in millimetres, in brackets."""
    return "(" + ", ".join(f"{1e3 * x:.1f}" for x in point) + ")"


def motions_of(figures: FigureSettings, *durations: float) -> list[str]:
    """Returns the names of all motions, or of those of some durations:
    each curve at each speed, as ``eight_4s``.
    """
    return [
        f"{shape}_{seconds:g}s"
        for seconds in durations or figures.seconds
        for shape in figures.shapes
    ]
