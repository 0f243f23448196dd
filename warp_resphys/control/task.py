"""The tracking task of the configuration group ``control``: paths, tracked point, limits of the inputs."""

from functools import cached_property

import numpy as np
from scipy.optimize import least_squares

from ..io.errors import InputError
from ..robot.robot import Robot
from ..settings.control import FigureSettings
from .baselines import LinearModel
from .plan import Planner, tracked_of
from .polynomials import FloatArray, around
from .reduced import ReducedModel
from .reference import Path
from .sampling import driven_input

_POINTS = 40  # number of points of a path whose reach is checked
_SPACING = 0.05  # between knots of the inputs of a plan [s]
_AHEAD, _WEIGHT, _ITERATIONS = 0.3, 1e-3, 3  # of plans of whole motions: horizon [s], weight, and iterations
_CHANGE = 1e-3  # of the inputs for derivatives of an equilibrium, as a share of their ranges
_LEAST_PIECES = 3  # of the inputs in a receding horizon


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
        self.figures, self._labels, self.time_step = figures, robot.labels, robot.time_step
        self.parts = len(driven_input(robot).parts)

    @cached_property
    def tracked(self) -> FloatArray:
        """Matrix (3, 3 M) from the markers to the tracked point, a mean of some of them."""
        return tracked_of(self._labels, self.figures.tracked)

    @property
    def paths(self) -> list[Path]:
        """The curves, one for each shape."""
        own = self.figures
        return [Path(name, size=own.size, centre=own.centre, right=own.right, up=own.up) for name in own.shapes]

    def steps(self, seconds: float) -> int:
        """Number T of steps of a motion whose curve takes so long."""
        return len(self.timed(self.paths[0], seconds, np.zeros(3)))

    def timed(self, path: Path, seconds: float, start: FloatArray) -> FloatArray:
        """Reference (T, 3) after each step of a motion from a start (3,) [m]."""
        return path.timed(seconds, self.time_step, lead=start)[1:]

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
        return Planner(model, self.tracked, self.figures.limits, path, steps, pieces, weight, iterations)

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
            worst, shown, guess = 0.0, (curve[0], curve[0]), None
            for point in curve[:: max(len(curve) // _POINTS, 1)]:
                guess, near = self._nearest(model, point, guess)
                distance = float(np.linalg.norm(near - point))
                if distance > worst:
                    worst, shown = distance, (point, near)
            if worst > reach:
                wanted, reached = ("(" + ", ".join(f"{1e3 * x:.1f}" for x in point) + ")" for point in shown)
                raise InputError(
                    f"the robot cannot reach the path {path.name}: the reachable point nearest to {wanted} mm is "
                    f"{reached} mm, {1e3 * worst:.1f} mm away. Change control.centre, control.size or "
                    "control.limits.high, or allow this distance by control.plan.reach."
                )

    def _nearest(
        self, model: ReducedModel, point: FloatArray, guess: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Inputs (n,) as shares whose equilibrium is nearest to a point, and its position (3,) there [m]."""
        limits = self.figures.limits

        def places(shares: FloatArray) -> FloatArray:
            return model.rest_observed(limits.low + limits.range * shares) @ self.tracked.T

        def slopes(shares: FloatArray) -> FloatArray:
            moved = places(around(shares, _CHANGE))
            return 1e3 * (moved[1:] - moved[0]).T / _CHANGE

        starts = [np.full(self.parts, 0.4)] + ([] if guess is None else [np.clip(guess, 0.01, 0.99)])
        searches = [
            least_squares(lambda x: 1e3 * (places(x[None])[0] - point), start, slopes, (0.0, 1.0), xtol=1e-4)
            for start in starts
        ]
        best = min(searches, key=lambda search: search.cost).x
        return best, places(best[None])[0]


def motions_of(figures: FigureSettings) -> list[str]:
    """Returns the names of all motions: each curve at each speed, such as ``eight_4s``."""
    return [motion_name(shape, seconds) for seconds in figures.seconds for shape in figures.shapes]


def motion_name(shape: str, seconds: float) -> str:
    """Returns the name of a motion in files and tables."""
    return f"{shape}_{seconds:g}s"
