"""Places on a body, and kinds of numbers that describe a mesh."""

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from ...io.arrays import BoolArray, FloatArray
from ...io.settings import Many, Pair, Positive, Settings, Vector, setting

Divisions = Annotated[int, Field(ge=1, le=10_000)]
LengthUnit = Literal["m", "cm", "mm"]
Order = Literal[1, 2]
Nodes = Literal[8, 20, 27]
_NEAR = 1e-9  # default of `Place.tolerance` [m]


def _nonzero(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(vector):
        raise ValueError("it must be three numbers, not all zero.")
    return vector


def _rising(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise ValueError("it must be two rising numbers, in m.")
    return pair


Direction = Annotated[Vector, AfterValidator(_nonzero)]
Span = Annotated[Pair[float], AfterValidator(_rising)]
Curve = Annotated[Many[Vector], Field(min_length=2)]


class Place(Settings):
    """Vertices on a plane, or between two planes."""

    x: float | Span | None = setting(None, "coordinate, or two between which the vertices lie", "m")
    y: float | Span | None = setting(None, "coordinate along y, or two", "m")
    z: float | Span | None = setting(None, "coordinate along z, or two", "m")
    tolerance: Positive | None = setting(None, "largest distance from the plane; null: 1e-9", "m")

    @property
    def spans(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest coordinate along the axes that are given [m]."""
        coordinates = {"x": self.x, "y": self.y, "z": self.z}
        return {
            axis: at if isinstance(at, tuple) else (at, at)
            for axis, at in coordinates.items()
            if at is not None
        }

    @property
    def nearness(self) -> float:
        """Largest distance from the plane [m]."""
        return _NEAR if self.tolerance is None else self.tolerance

    def holds(self, points: FloatArray) -> BoolArray:
        """Returns (N,) whether points (N, 3) [m] lie in the place."""
        inside = np.ones(len(points), dtype=bool)
        for axis, (first, last) in self.spans.items():
            along = points[:, "xyz".index(axis)]
            inside &= (along >= first - self.nearness) & (along <= last + self.nearness)
        return inside

    def __str__(self) -> str:
        return ", ".join(
            f"{axis} = {first:g}" + (f" to {last:g}" if last > first else "")
            for axis, (first, last) in self.spans.items()
        )
