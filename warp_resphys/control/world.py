"""Interface of simulated bodies that are commanded and observed step by step."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..report.obstacles import ObstacleSurface

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


class World(ABC):
    """B bodies that take commands and have markers.

    Attributes:
        count: B.
        time_step: h [s].
        input: name of the commanded input.
        parts: number n of its values.
        noise: standard deviation of observed markers [m]; None if the caller chooses it.
        travel: (3,) way by which commands may move a body as a whole [m].
    """

    count: int
    time_step: float
    input: str
    parts: int
    noise: float | None = None
    travel: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @abstractmethod
    def begin(self, chosen: BoolArray) -> None:
        """Brings the chosen bodies (B,) back to rest without inputs."""

    @abstractmethod
    def step(self, commands: FloatArray) -> BoolArray:
        """Makes one time step under commands (B, n); returns which bodies (B,) have failed since `begin`."""

    @abstractmethod
    def markers(self) -> FloatArray:
        """Markers (B, M, 3), without noise [m]."""

    def vary(self, random: Sequence[np.random.Generator]) -> None:
        """Draws new parameters, by a generator for each body; all bodies `begin` afterwards."""
        del random

    def bodies(self) -> tuple[IntArray, FloatArray]:
        """Surface triangles (S, 3) and vertices (B, N, 3) [m]; empty if the body is known by its markers only."""
        return np.zeros((0, 3), dtype=np.int64), np.zeros((self.count, 0, 3))

    def obstacles(self) -> ObstacleSurface:
        """Surfaces of the obstacles that the bodies touch."""
        return ObstacleSurface()
