"""Dimensions of a pneumatic arm."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from ...io.settings import Many, Positive, Settings, Some, setting
from .place import Nodes, Order


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
