"""What is to be followed, by what, within which limits: the group ``control`` of a configuration."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ..io.errors import InputError
from .controllers import Horizon
from .estimate import Noise
from .plan import Limits, Planner, Weights, tracked_of
from .reduced import ReducedModel
from .reference import Path
from .sampling import Sampling

FloatArray = NDArray[np.float64]

_POINTS = 40  # of a path, that are to be in reach


@dataclass(frozen=True)
class Task:
    """See the module.

    Attributes:
        settings: the group ``control``.
        labels: of the M markers.
        time_step: h [s].
        parts: n inputs.
    """

    settings: Mapping[str, Any]
    labels: Sequence[str]
    time_step: float
    parts: int

    @cached_property
    def tracked(self) -> FloatArray:
        """(3, 3 M) from the markers to the point that is to follow, which is the mean of some."""
        return tracked_of(self.labels, self.settings["tracked"])

    @property
    def limits(self) -> Limits:
        """Of the inputs."""
        return Limits(*(np.full(self.parts, float(self.settings["limits"][key])) for key in ("low", "high", "rate")))

    @property
    def paths(self) -> list[Path]:
        """The curves."""
        places = {key: self.settings[key] for key in ("size", "centre", "right", "up")}
        return [Path(name, **places) for name in self.settings["shapes"]]

    @property
    def motions(self) -> list[str]:
        """Their names: each curve at each speed, such as ``eight_4s``."""
        return motions_of(self.settings)

    def steps(self, seconds: float) -> int:
        """T of a motion whose curve takes so long."""
        return len(self.timed(self.paths[0], seconds, np.zeros(3)))

    def timed(self, path: Path, seconds: float, start: FloatArray) -> FloatArray:
        """(T, 3) where the point is to be after each step of a motion that begins at (3,) [m]."""
        return path.timed(seconds, self.time_step, lead=start)[1:]

    def planner(self, model: ReducedModel, seconds: float) -> Planner:
        """Of whole motions."""
        known, steps = self.settings["plan"], self.steps(seconds)
        pieces = max(round(steps * self.time_step / known["spacing"]), 1)
        weights = Weights(known["effort"], known["change"])
        return Planner(
            model, self.tracked, self.limits, steps, min(pieces, steps), weights, iterations=known["iterations"]
        )

    @property
    def horizon(self) -> Horizon:
        """Of receding plans."""
        known = self.settings["horizon"]
        steps = max(round(known["seconds"] / self.time_step), 1)
        weights = Weights(known["effort"], known["change"])
        return Horizon(steps, min(known["pieces"], steps), weights, known["iterations"])

    @property
    def noise(self) -> Noise:
        """What the estimator is to expect."""
        return Noise(**self.settings["estimate"])

    def sampling(self, seed: int) -> Sampling:
        """For reduced models."""
        known = self.settings["reduction"]
        return Sampling(**{**known, "modes": tuple(known["modes"])}, seed=seed)

    def check_reach(self, model: ReducedModel) -> None:
        """Sees to it that the robot can come to rest at every point of the paths.

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
            if worst > self.settings["plan"]["reach"]:
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


def motions_of(control: Mapping[str, Any]) -> list[str]:
    """The names of the motions that the group ``control`` asks for."""
    return [motion_name(shape, seconds) for seconds in control["seconds"] for shape in control["shapes"]]


def motion_name(shape: str, seconds: float) -> str:
    """That files and tables have."""
    return f"{shape}_{seconds:g}s"


def _millimetres(point: FloatArray) -> str:
    return "(" + ", ".join(f"{1e3 * each:.1f}" for each in point) + ")"
