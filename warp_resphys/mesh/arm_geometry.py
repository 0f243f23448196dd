"""Dimensions of pneumatic arms: segments in series, each with closed chambers around the axis."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np

from ..io.errors import MeshError
from .arm_section import Section

_PROFILES = ("half_disc", "disc", "sector")
_OUTLINES = ("lobed", "round")
_MOST_CHAMBERS = 8  # per segment


@dataclass(frozen=True)
class ArmGeometry:
    """Dimensions of a pneumatic arm; defaults are those of SoPrA (Toshimitsu et al. 2021).

    From base to tip, solid caps alternate with the chambers of a segment, beginning and ending with a cap. The arm
    tapers linearly along chambers; caps are cylinders.

    Raises:
        MeshError: a dimension that is not positive, sequences of inconsistent length, or chambers that do not fit.
    """

    chamber_lengths: Sequence[float] = (0.120, 0.120)  # length of the chambers of each segment [m]
    caps: Sequence[float] = (0.010, 0.021, 0.005)  # heights of the solid caps [m]; one more than segments
    # largest radius of the outline before the first chambers and after those of each segment [m]
    radii: Sequence[float] = (0.0283923, 0.0212942, 0.0165622)
    chambers: int = 3  # chambers per segment, 2 to 8
    profile: str = (
        "half_disc"  # of a chamber: half_disc, with the flat side towards the axis; disc; sector of an annulus
    )
    outline: str = "lobed"  # lobed, parallel to each chamber at the distance `wall`; or round, a circle
    wall: float = 0.004  # thickness between a chamber and the outline [m]
    web: float = 0.004  # smallest thickness between neighbouring chambers [m]
    core: float | None = (
        None  # distance of the chambers from the axis at the base [m], scales with the radius; None: min
    )
    # rotation of each segment's chambers about the axis [deg], counter-clockwise seen from the base; empty: none
    rotations: Sequence[float] = ()

    def __post_init__(self) -> None:
        """Checks all dimensions, and stores sequences as tuples."""
        for name in ("chamber_lengths", "caps", "radii", "rotations"):
            object.__setattr__(self, name, numbers(name, getattr(self, name), positive=name != "rotations"))
        count = len(self.chamber_lengths)
        if not count:
            raise MeshError("the arm's chamber_lengths are empty: give one length for each segment.")
        needed = {"caps": count + 1, "radii": count + 1, "rotations": count if self.rotations else 0}
        for name, number in needed.items():
            given = len(getattr(self, name))
            if given != number:
                raise MeshError(f"the arm's {name} are {given} numbers, but {count} chamber_lengths need {number}.")
        for name in ("wall", "web", "core"):
            numbers(name, (getattr(self, name),) if getattr(self, name) is not None else ())
        for name, choices in (("profile", _PROFILES), ("outline", _OUTLINES)):
            if getattr(self, name) not in choices:
                raise MeshError(f"the arm's {name} is {getattr(self, name)!r}: choose {', '.join(choices)}.")
        if type(self.chambers) is not int or not 2 <= self.chambers <= _MOST_CHAMBERS:
            raise MeshError(
                f"the arm's chambers are {self.chambers!r} a segment: choose a whole number, 2 to {_MOST_CHAMBERS}."
            )
        if self.outline == "lobed" and (self.profile == "sector" or any(self.rotations)):
            what = "sectors" if self.profile == "sector" else "rotations"
            raise MeshError(f"a lobed outline does not go with {what}: set the arm's outline to round.")
        for radius in self.radii:
            self.section(radius).check()

    @property
    def length(self) -> float:
        """Length from base to tip [m]."""
        return float(sum(self.chamber_lengths) + sum(self.caps))

    @property
    def stations(self) -> tuple[float, ...]:
        """Heights of the ends of caps and chambers, from 0 at the base down to the tip [m]; an even number."""
        parts = [self.caps[0]]
        for chamber, cap in zip(self.chamber_lengths, self.caps[1:], strict=True):
            parts += [chamber, cap]
        return (0.0, *(-np.cumsum(parts)).tolist())

    def section(self, radius: float) -> Section:
        """Returns the unrotated cross-section with a given outline radius [m]."""
        core = None if self.core is None else self.core * radius / self.radii[0]
        return Section(radius, self.chambers, self.profile, self.outline, self.wall, self.web, core)

    def radius_at(self, height: float) -> float:
        """Returns the radius of the outline at a height [m], which is 0 at the base and negative below."""
        ends = np.array(self.stations[1:-1])
        return float(np.interp(-height, -ends, np.repeat(self.radii, 2)[1:-1]))


def numbers(name: str, given: Sequence[Any], positive: bool = True) -> tuple[float, ...]:
    """Returns a dimension as a tuple, or raises MeshError for values that are not finite or not positive."""
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise MeshError(f"the arm's {name} are {given!r}: give a list of numbers.")
    for value in given:
        good = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
        if not good or (positive and value <= 0.0):
            unit = "a positive number, in metres" if positive else "a number, in degrees"
            raise MeshError(f"the arm's {name} has {value!r}: it must be {unit}.")
    return tuple(float(value) for value in given)
