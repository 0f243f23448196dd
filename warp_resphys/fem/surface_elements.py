"""Points on the surfaces of chambers, for the energies of pressure and of fibres."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.chambers import Chamber
from ..mesh.elements import FACES, Array, Rule, Shape
from .elements import Points


@dataclass(frozen=True)
class SurfacePoints(Points):
    """Points on the surfaces of chambers."""

    weights: Array  # (P,) of each point: one third of the quadrature weight for pressure, the area for fibres [m^2]
    chamber: NDArray[np.int64]  # (P,) number of its chamber


def face_rule(chambers: Sequence[Chamber], degree: int) -> tuple[Shape, Rule]:
    """Shape functions of the faces, and a rule exact for linear faces and for a polynomial degree on quadratic ones."""
    face = FACES[chambers[0].faces.shape[1]]
    return face.shape, face.rule(degree)


def owners(chambers: Sequence[Chamber], points: int) -> NDArray[np.int64]:
    """(P,) number of the chamber of each point, with so many points a face."""
    return np.repeat(np.arange(len(chambers)), [len(chamber.faces) * points for chamber in chambers])
