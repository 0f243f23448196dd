"""Settings of meshes, and of places and cells on them."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from ..io.arrays import BoolArray, FloatArray
from ..io.settings import Many, Pair, Positive, Settings, Some, Vector, Word, setting

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


class ArmMesh(Settings):
    """A pneumatic arm of given dimensions, by default those of SoPrA (Toshimitsu et al. 2021).

    From base to tip, solid caps alternate with the chambers of a segment, beginning and ending with
    a cap. The arm tapers linearly along chambers; caps are cylinders.
    """

    kind: Literal["arm_generated"] = "arm_generated"
    size: Positive = setting(
        0.01,
        "size of the cells; of hexahedra, the average in the section, "
        "for walls, flat sides and arcs apart",
        "m",
    )
    cells: Literal["hexahedra", "tetrahedra"] = setting("hexahedra")
    layers: Positive | None = setting(None, "length along the arm; null: 2.5 times the size", "m")
    order: Order = setting(1, "2 adds edge midpoints to tetrahedra")
    nodes: Nodes = setting(
        8, "nodes of a hexahedron; thin walls of single cells bulge only with 20 or 27"
    )
    chamber_lengths: Some[Positive] = setting(
        (0.120, 0.120), "lengths of the chambers, one per segment", "m"
    )
    caps: Some[Positive] = setting(
        (0.010, 0.021, 0.005), "solid parts before, between and after the chambers", "m"
    )
    radii: Some[Positive] = setting(
        (0.0283923, 0.0212942, 0.0165622),
        "radii before the first chambers and after those of every segment",
        "m",
    )
    chambers: Annotated[int, Field(ge=2, le=8)] = setting(3, "chambers per segment")
    profile: Literal["half_disc", "disc", "sector", "wedge"] = setting(
        "half_disc",
        "section of a chamber: half_disc, with the flat side towards the axis; sector of an "
        "annulus; wedge: a sector with a flat inner side",
    )
    outline: Literal["lobed", "round"] = setting(
        "lobed", "lobed, parallel to each chamber, or round"
    )
    wall: Positive = setting(0.004, "thickness of the wall", "m")
    web: Positive = setting(0.004, "thickness between neighbouring chambers", "m")
    core: Positive | None = setting(
        None, "distance of the chambers from the axis at the base; null: the least", "m"
    )
    bore: Positive | None = setting(
        None,
        "distance of the sides of a hole from the axis, "
        "opposite the chambers of a wedge; null: no hole",
        "m",
    )
    rotations: Many[float] = setting(
        (),
        "rotations of the chambers, one per segment; for tetrahedra and a round outline",
        "degrees",
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        count = len(self.chamber_lengths)
        needed = {
            "caps": count + 1,
            "radii": count + 1,
            "rotations": count if self.rotations else 0,
        }
        for name, number in needed.items():
            found = len(getattr(self, name))
            if found != number:
                raise ValueError(
                    f"{name} has {found} numbers, but {count} chamber_lengths need {number}."
                )
        if self.outline == "lobed" and (self.profile in ("sector", "wedge") or any(self.rotations)):
            what = "rotations" if any(self.rotations) else f"{self.profile}s"
            raise ValueError(f"outline is lobed, which does not go with {what}: set it to round.")
        if self.cells == "tetrahedra" and self.layers is not None:
            raise ValueError("layers is for hexahedra: set it to null, or cells to hexahedra.")
        if self.cells == "tetrahedra" and (self.nodes != 8 or self.bore is not None):
            raise ValueError(
                "nodes and bore are for hexahedra: leave them out, or set cells to hexahedra."
            )
        if self.bore is not None and self.profile != "wedge":
            raise ValueError(
                f"bore is set, but profile is {self.profile}: set it to wedge, or bore to null."
            )
        if self.profile == "wedge" and self.chambers == 2:
            raise ValueError(
                "chambers is 2, but wedges have flat sides towards the axis: "
                "take three, or sectors."
            )
        return self


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
