"""Settings of meshes, and of places and cells on them."""

from typing import Annotated, Literal

from pydantic import Field

from ..core.mesh.arm_dimensions import ArmMesh
from ..core.mesh.place import Curve, Divisions, LengthUnit, Nodes, Order, Span
from ..io.settings import Many, Pair, Positive, Settings, Some, Vector, Word, setting


class SymmetrySettings(Settings):
    """Symmetry planes: the mesh is one side of them,
    and its vertices in a plane only move within it.
    """

    x: float | None = setting(None, "position of the plane normal to x; null: none", "m")
    y: float | None = setting(None, "position of the plane normal to y", "m")
    z: float | None = setting(None, "position of the plane normal to z", "m")
    tolerance: Positive = setting(1e-9, "largest distance of a vertex in a plane", "m")


class BoxSettings(Settings):
    """Cells with their centres in a box."""

    x: Span | None = setting(None, "lowest and highest x; null: any", "m")
    y: Span | None = setting(None, "lowest and highest y", "m")
    z: Span | None = setting(None, "lowest and highest z", "m")


class _Box(Settings):
    size: Annotated[Many[Positive], Field(min_length=3, max_length=3)] = setting(
        description="lengths of its edges", unit="m"
    )
    divisions: Annotated[Many[Divisions], Field(min_length=3, max_length=3)] = setting(
        description="cells along each edge"
    )


class HexahedralBox(_Box):
    """A box of hexahedra."""

    kind: Literal["box_hexahedra"]
    nodes: Nodes = setting(8, "nodes of a cell: 8, or quadratic with 20 or 27")


class TetrahedralBox(_Box):
    """A box of tetrahedra, six in each of its cells."""

    kind: Literal["box_tetrahedra"]
    order: Order = setting(1, "2: with edge midpoints; linear tetrahedra bend far too stiffly")


class BoxesMesh(Settings):
    """A body of axis-aligned boxes that touch or overlap, of hexahedra."""

    kind: Literal["boxes"]
    boxes: Some[Pair[Vector]] = setting(
        description="lowest and highest corner of each box", unit="m"
    )
    size: Positive = setting(0.01, "longest edge of a cell", "m")
    nodes: Nodes = setting(8, "nodes of a cell")


class FileMesh(Settings):
    """A tetrahedral or hexahedral mesh from a file of gmsh, of Abaqus or in a format of meshio."""

    kind: Literal["file"]
    path: Word = setting(description="path of the file")
    units: LengthUnit = setting("m", "unit of the file")
    order: Order = setting(1, "2 adds edge midpoints to linear tetrahedra")
    drop_unreferenced: bool = setting(False, "leave out vertices that belong to no cell")


class SurfaceMesh(Settings):
    """The interior of a closed surface of triangles, filled with tetrahedra.

    Closed surfaces inside it are cavities.
    """

    kind: Literal["surface"]
    path: Word = setting(description="path of an STL, OBJ or PLY file")
    units: LengthUnit = setting("mm", "unit of the file")
    size: Positive = setting(0.01, "length of the edges of tetrahedra", "m")
    order: Order = setting(2, "1: linear tetrahedra, which bend far too stiffly")


class RodMesh(Settings):
    """A round or elliptic rod of hexahedra."""

    kind: Literal["rod"]
    centreline: Curve = setting(description="points of its axis", unit="m")
    radii: Positive | Some[Annotated[Many[float], Field(min_length=2, max_length=3)]] = setting(
        description="one radius, or arc lengths with the radius there; two radii for an ellipse: "
        "along x, y or z, whichever is most perpendicular "
        "to the rod at its start, and across it",
        unit="m",
    )
    layers: Divisions = setting(10, "cells along the axis")
    core: Divisions = setting(1, "cells along a side of the core of the cross-section")
    rings: Divisions = setting(1, "rings of cells around the core")
    nodes: Nodes = setting(27, "nodes of a cell")
    grading: Annotated[float, Field(ge=0.0, le=1.0)] = setting(
        0.0, "0: layers of equal length; 1: lengths in proportion to the radius"
    )


class ShippedArm(Settings):
    """One of the arms with six chambers of the package."""

    kind: Literal["arm"]
    name: Word = setting(description="name of the arm, such as arm_hexahedra_1400")


MeshSettings = Annotated[
    HexahedralBox
    | TetrahedralBox
    | BoxesMesh
    | FileMesh
    | SurfaceMesh
    | RodMesh
    | ShippedArm
    | ArmMesh,
    Field(discriminator="kind"),
]
