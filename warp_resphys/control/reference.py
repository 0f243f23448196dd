"""Paths that points of a robot are to follow: circles, figures of eight and letters, at a speed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from ..io.errors import InputError

FloatArray = NDArray[np.float64]

_SPACING: Final = 2000  # points of a path, between which it is straight
_CORNER: Final = 0.02  # of the length of a path, over which its corners are rounded
# The strokes of letters as one line each, on a grid of columns 0 to 4 and rows 0 to 6.
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
    """A curve in a plane that a point is to follow.

    Attributes:
        name: ``circle``, ``eight`` or a capital letter.
        size: of its larger side [m].
        centre: (3,) of its bounding box [m].
        right: (3,) the direction of its width.
        up: (3,) the direction of its height; made perpendicular.
    """

    name: str
    size: float
    centre: Sequence[float]
    right: Sequence[float] = (1.0, 0.0, 0.0)
    up: Sequence[float] = (0.0, 1.0, 0.0)

    @property
    def points(self) -> FloatArray:
        """(P, 3) of the curve, evenly spaced [m]; its corners are rounded.

        Raises:
            InputError: an unknown shape, a size that is not positive, or directions of no plane.
        """
        if not self.size > 0.0:
            raise InputError(f"the size of the path {self.name} is {self.size:g}: it must be positive, in m.")
        flat = _curve(self.name)
        low, high = flat.min(0), flat.max(0)
        flat = (flat - 0.5 * (low + high)) * (self.size / float((high - low).max()))
        first, second = np.asarray(self.right, dtype=np.float64), np.asarray(self.up, dtype=np.float64)
        if not np.linalg.norm(np.cross(first, second)) > 1e-9:
            raise InputError(f"the path {self.name} lies in no plane: give two directions that are not parallel.")
        first = first / np.linalg.norm(first)
        second = second - (second @ first) * first
        second /= np.linalg.norm(second)
        return np.asarray(np.asarray(self.centre) + flat[:, :1] * first + flat[:, 1:] * second)

    @property
    def length(self) -> float:
        """Of the curve [m]."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    def timed(self, seconds: float, time_step: float, lead: FloatArray | None = None) -> FloatArray:
        """(T + 1, 3) where the point is to be at the steps [m], beginning and ending at rest.

        Args:
            seconds: that the curve takes.
            time_step: h [s].
            lead: (3,) from where it goes to the curve's first point, in a quarter of that time [m]; none if left out.

        Raises:
            InputError: less than ten steps.
        """
        steps = round(seconds / time_step)
        if steps < 10:
            raise InputError(f"the path {self.name} is to take {seconds:g} s: that is less than ten steps.")
        curve = self.points
        at = _eased(np.arange(steps + 1) / steps) * (len(curve) - 1)
        found = np.stack([np.interp(at, np.arange(len(curve)), column) for column in curve.T], axis=1)
        if lead is None:
            return found
        before = max(steps // 4, 5)
        share = _smooth(np.arange(before) / before)[:, None]
        return np.concatenate([lead + share * (found[0] - lead), found])


def _curve(name: str) -> FloatArray:
    """(P, 2) of a shape of any size, evenly spaced."""
    angle = np.linspace(0.0, 2.0 * np.pi, _SPACING)
    if name == "circle":
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if name == "eight":  # Gerono's lemniscate
        return _even(np.stack([np.sin(2.0 * angle) / 2.0, np.cos(angle)], axis=1))
    if name not in _LETTERS:
        raise InputError(f"the path is {name!r}: choose circle, eight, or a capital letter.")
    corners = np.array([[float(x) for x in (at.split(",") if "," in at else at)] for at in _LETTERS[name].split()])
    straight = _even(corners)
    width = _CORNER * _SPACING / 2.0
    return _even(np.stack([gaussian_filter1d(column, width, mode="nearest") for column in straight.T], axis=1))


def _even(points: FloatArray) -> FloatArray:
    """The same curve with points at equal distances."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    wanted = np.linspace(0.0, along[-1], _SPACING)
    return np.stack([np.interp(wanted, along, column) for column in points.T], axis=1)


def _smooth(share: FloatArray) -> FloatArray:
    """From 0 to 1 without velocity or acceleration at the ends."""
    return np.asarray(share**3 * (10.0 - 15.0 * share + 6.0 * share**2))


def _eased(share: FloatArray, ends: float = 0.1) -> FloatArray:
    """From 0 to 1 at an even speed, but for the first and the last tenth, in which it grows and fades."""
    rate = np.minimum(_smooth(np.clip(share / ends, 0.0, 1.0)), _smooth(np.clip((1.0 - share) / ends, 0.0, 1.0)))
    gone = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]))])
    return np.asarray(gone / gone[-1])
