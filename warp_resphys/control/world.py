"""Bodies that are commanded and seen step by step, whatever simulates them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


class World(ABC):
    """B bodies that take commands and show markers.

    Attributes:
        count: B.
        time_step: h [s].
        input: name of the commanded input.
        parts: n of its values.
        noise: standard deviation of the markers that cameras see [m]; None where that is the caller's choice.
    """

    count: int
    time_step: float
    input: str
    parts: int
    noise: float | None = None

    @abstractmethod
    def begin(self, chosen: BoolArray) -> None:
        """Brings the chosen bodies (B,) back to rest without inputs."""

    @abstractmethod
    def step(self, commands: FloatArray) -> BoolArray:
        """Makes one time step under commands (B, n); returns which bodies (B,) have failed since they began."""

    @abstractmethod
    def markers(self) -> FloatArray:
        """(B, M, 3) positions of the markers, without noise [m]."""

    def vary(self, random: Sequence[np.random.Generator]) -> None:
        """Draws new parameters, by a generator for each body; all bodies `begin` afterwards."""
        del random

    def bodies(self) -> tuple[IntArray, FloatArray]:
        """(S, 3) surface triangles of a body, and (B, N, 3) vertices [m]; empty where only markers are known."""
        return np.zeros((0, 3), dtype=np.int64), np.zeros((self.count, 0, 3))
