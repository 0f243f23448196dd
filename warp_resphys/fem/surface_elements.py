"""Integration on the faces of chambers, for the energies of pressure and of fibres."""

from collections.abc import Sequence

from ..mesh.chambers import Chamber
from ..mesh.elements import FACES, Rule, Shape


def face_rule(chambers: Sequence[Chamber], degree: int) -> tuple[Shape, Rule]:
    """Shape functions of the faces, and a rule exact for linear faces and for a polynomial degree on quadratic ones."""
    face = FACES[chambers[0].faces.shape[1]]
    return face.shape, face.rule(degree)
