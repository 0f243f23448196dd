"""Paths for a point of a robot: circles, figures of eight and letters, and their timing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from ..io.errors import InputError
from .polynomials import FloatArray

_SPACING: Final = 2000  # number of points of a path
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
    """A plane curve.

    Attributes:
        name: ``circle``, ``eight`` or a capital letter.
        size: of its larger side [m].
        centre: (3,) of its bounding box [m].
        right: (3,) the direction of its width.
        up: (3,) the direction of its height; made perpendicular to ``right``.
    """

    name: str
    size: float
    centre: Sequence[float]
    right: Sequence[float] = (1.0, 0.0, 0.0)
    up: Sequence[float] = (0.0, 1.0, 0.0)

    @property
    def points(self) -> FloatArray:
        """Evenly spaced points (P, 3) of the curve, with rounded corners [m].

        Raises:
            InputError: an unknown shape, a size that is not positive, or parallel directions.
        """
        if not self.size > 0.0:
            raise InputError(f"the size of the path {self.name} is {self.size:g}: it must be positive, in m.")
        flat = _curve(self.name)
        low, high = flat.min(0), flat.max(0)
        flat = (flat - 0.5 * (low + high)) * (self.size / float((high - low).max()))
        first, second = np.asarray(self.right, dtype=np.float64), np.asarray(self.up, dtype=np.float64)
        if not np.linalg.norm(np.cross(first, second)) > 1e-9:
            raise InputError(f"right and up of the path {self.name} are parallel: give two different directions.")
        first = first / np.linalg.norm(first)
        second = second - (second @ first) * first
        second /= np.linalg.norm(second)
        return np.asarray(np.asarray(self.centre) + flat[:, :1] * first + flat[:, 1:] * second)

    def timed(self, seconds: float, time_step: float, lead: FloatArray | None = None) -> FloatArray:
        """Positions of the point (T + 1, 3) at the time steps [m]; it starts and ends at rest.

        Args:
            seconds: duration of the curve.
            time_step: h [s].
            lead: (3,) point from which it first moves to the start of the curve, in a quarter of the duration [m].

        Raises:
            InputError: the duration is shorter than ten steps.
        """
        steps = round(seconds / time_step)
        if steps < 10:
            raise InputError(f"the path {self.name} takes {seconds:g} s: give at least ten steps of {time_step:g} s.")
        curve = self.points
        at = _eased(np.arange(steps + 1) / steps) * (len(curve) - 1)
        points = _interpolated(at, np.arange(len(curve)), curve)
        if lead is None:
            return points
        before = max(steps // 4, 5)
        share = _smooth(np.arange(before) / before)[:, None]
        return np.concatenate([lead + share * (points[0] - lead), points])


def _curve(name: str) -> FloatArray:
    """Evenly spaced points (P, 2) of a shape, in its own units."""
    angle = np.linspace(0.0, 2.0 * np.pi, _SPACING)
    if name == "circle":
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if name == "eight":  # Gerono's lemniscate
        return _even(np.stack([np.sin(2.0 * angle) / 2.0, np.cos(angle)], axis=1))
    if name not in _LETTERS:
        raise InputError(f"the path is {name!r}: choose circle, eight, or a capital letter.")
    corners = np.array([[float(x) for x in (at.split(",") if "," in at else at)] for at in _LETTERS[name].split()])
    straight = _even(corners)
    return _even(gaussian_filter1d(straight, _CORNER * _SPACING / 2.0, axis=0, mode="nearest"))


def _even(points: FloatArray) -> FloatArray:
    """Resamples a curve at equal distances."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return _interpolated(np.linspace(0.0, along[-1], _SPACING), along, points)


def _interpolated(at: FloatArray, knots: NDArray[Any], values: FloatArray) -> FloatArray:
    return np.stack([np.interp(at, knots, column) for column in values.T], axis=1)


def _smooth(share: FloatArray) -> FloatArray:
    """Smooth step from 0 to 1, with zero velocity and acceleration at both ends."""
    return np.asarray(share**3 * (10.0 - 15.0 * share + 6.0 * share**2))


def _eased(share: FloatArray) -> FloatArray:
    """Progress from 0 to 1 at constant speed, except that it accelerates and decelerates in the outer tenths."""
    rate = _smooth(np.clip(10.0 * np.minimum(share, 1.0 - share), 0.0, 1.0))
    gone = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]))])
    return np.asarray(gone / gone[-1])
