"""Rigid parts and glue, which make vertices of a body depend on others (`fem.coordinates`)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..io.errors import InputError


@dataclass(frozen=True)
class Rigid:
    """A nearly rigid region of a mesh, such as an end cap, a base plate or an insert.

    Raises:
        InputError: a stiffness that is not positive.
    """

    density: float | Sequence[float] | Any = 1200.0  # [kg/m^3], a number or (B, 1) values
    stiffness: float = 1e9  # kappa of the energy kappa V |F - R(F)|^2 [Pa]

    def __post_init__(self) -> None:
        """Checks the stiffness."""
        if not (np.isfinite(self.stiffness) and self.stiffness > 0.0):
            raise InputError(f"the stiffness of a rigid part is {self.stiffness:g}: it must be positive, in Pa.")


@dataclass(frozen=True)
class Glue:
    """Vertices glued to a region of the mesh whose cells need not match theirs."""

    vertices: ArrayLike  # (n,) glued vertices
    to: str  # region they are glued to
    tolerance: float = 1e-3  # largest distance from the region [m]; gaps are kept
