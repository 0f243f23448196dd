"""The beam that the studies share: a box of any element along x, whose face at the smallest x is fixed."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import Strict

from ..fem.body import Body
from ..io.settings import Natural, Positive, Settings, Some, Vector, setting
from ..mesh.mesh import Mesh, box_hexahedra, box_tetrahedra, select_vertices

Element = Literal["hexahedron8", "hexahedron20", "hexahedron27", "tetrahedron4", "tetrahedron10"]
Divisions = Annotated[tuple[Natural, Natural, Natural], Strict(False)]  # of a box, along x, y and z


class BeamStudy(Settings):
    """Settings that all studies of beams share."""

    size: Vector = setting(unit="m")
    youngs_modulus: Positive = setting(unit="Pa")
    poissons_ratios: Some[float]
    repeats: Natural


def beam_mesh(element: Element, size: Sequence[float], divisions: Sequence[int]) -> Mesh:
    """A box of bricks, by their number along its axes; for tetrahedra, each brick is split into six."""
    if element.startswith("tetrahedron"):
        return box_tetrahedra(size, divisions, order=2 if element == "tetrahedron10" else 1)
    return box_hexahedra(size, divisions, nodes=int(element.removeprefix("hexahedron")))


def clamped(mesh: Mesh, **options: Any) -> Body:
    """A body with its vertices at the smallest x fixed."""
    return Body(mesh, fixed=select_vertices(mesh, x=float(mesh.vertices[:, 0].min())), **options)
