"""What is to be followed, by what, within which limits: the group ``control`` of a configuration."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ..io.errors import InputError
from ..settings.control import FigureSettings, HorizonSettings, PlanSettings
from .controllers import Horizon
from .plan import Limits, Planner, Weights, tracked_of
from .reduced import ReducedModel
from .reference import Path

FloatArray = NDArray[np.float64]

_POINTS = 40  # of a path, that are to be in reach


@dataclass(frozen=True)
class Task:
    """See the module.

    Attributes:
        figures: that are followed.
        labels: of the M markers.
        time_step: h [s].
        parts: n inputs.
    """

    figures: FigureSettings
    labels: Sequence[str]
    time_step: float
    parts: int

    @cached_property
    def tracked(self) -> FloatArray:
        """(3, 3 M) from the markers to the point that is to follow, which is the mean of some."""
        return tracked_of(self.labels, self.figures.tracked)

    @property
    def limits(self) -> Limits:
        """Of the inputs."""
        limits = self.figures.limits
        return Limits(*(np.full(self.parts, each) for each in (limits.low, limits.high, limits.rate)))

    @property
    def paths(self) -> list[Path]:
        """The curves."""
        own = self.figures
        return [Path(name, size=own.size, centre=own.centre, right=own.right, up=own.up) for name in own.shapes]

    @property
    def motions(self) -> list[str]:
        """Their names: each curve at each speed, such as ``eight_4s``."""
        return motions_of(self.figures)

    def steps(self, seconds: float) -> int:
        """T of a motion whose curve takes so long."""
        return len(self.timed(self.paths[0], seconds, np.zeros(3)))

    def timed(self, path: Path, seconds: float, start: FloatArray) -> FloatArray:
        """(T, 3) where the point is to be after each step of a motion that begins at (3,) [m]."""
        return path.timed(seconds, self.time_step, lead=start)[1:]

    def planner(self, model: ReducedModel, seconds: float, plan: PlanSettings) -> Planner:
        """Of whole motions."""
        steps = self.steps(seconds)
        pieces = max(round(steps * self.time_step / plan.spacing), 1)
        weights = Weights(plan.effort, plan.change)
        return Planner(model, self.tracked, self.limits, steps, min(pieces, steps), weights, iterations=plan.iterations)

    def horizon(self, settings: HorizonSettings) -> Horizon:
        """Of receding plans."""
        steps = max(round(settings.seconds / self.time_step), 1)
        weights = Weights(settings.effort, settings.change)
        return Horizon(steps, min(settings.pieces, steps), weights, settings.iterations)

    def check_reach(self, model: ReducedModel, reach: float) -> None:
        """Sees to it that the robot can come to rest at every point of the paths.

        Args:
            model: of the robot.
            reach: distance that a point may be out of reach [m].

        Raises:
            InputError: it cannot; the nearest point that it reaches is named.
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
                wanted, reached = (_millimetres(each) for each in shown)
                raise InputError(
                    f"the path {path.name} leaves what the robot reaches: of {wanted} mm, the nearest point that it "
                    f"reaches is {reached} mm, {1e3 * worst:.1f} mm away: set control.centre, control.size or "
                    "control.limits.high, or allow for more by control.plan.reach."
                )

    def _nearest(
        self, model: ReducedModel, point: FloatArray, guess: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """(n,) shares of the inputs that bring the point nearest to another at rest, and (3,) where it is then [m]."""
        limits, best = self.limits, None

        def place(shares: FloatArray) -> tuple[FloatArray, FloatArray]:
            found, slopes = model.rest_observed(limits.low + limits.range * shares)
            return self.tracked @ found, self.tracked @ slopes * limits.range

        for begin in (np.full(self.parts, 0.4), *(() if guess is None else (np.clip(guess, 0.01, 0.99),))):
            found = least_squares(
                lambda x: 1e3 * (place(x)[0] - point), begin, lambda x: 1e3 * place(x)[1], (0.0, 1.0), xtol=1e-4
            )
            if best is None or found.cost < best.cost:
                best = found
        assert best is not None
        return best.x, place(best.x)[0]


def motions_of(figures: FigureSettings) -> list[str]:
    """The names of the motions that are asked for."""
    return [motion_name(shape, seconds) for seconds in figures.seconds for shape in figures.shapes]


def motion_name(shape: str, seconds: float) -> str:
    """That files and tables have."""
    return f"{shape}_{seconds:g}s"


def _millimetres(point: FloatArray) -> str:
    return "(" + ", ".join(f"{1e3 * each:.1f}" for each in point) + ")"
