"""Settings of a body (mesh, fixed vertices, actuators, loads) and of its simulator."""

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from ..io.settings import Many, Natural, NotNegative, Pair, Positive, Settings, Some, Vector, Word, setting

Divisions = Annotated[int, Field(ge=1, le=10_000)]
LengthUnit = Literal["m", "cm", "mm"]
Order = Literal[1, 2]
Nodes = Literal[8, 20, 27]
Integrator = Literal["implicit_euler", "bdf2", "midpoint"]
TimeStep = Annotated[float, Field(gt=0.0, le=10.0)]


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


class _Given(Settings):
    def arguments(self) -> dict[str, Any]:
        """Returns the keys that are not null, as arguments of a function."""
        return {key: value for key, value in dict(self).items() if value is not None}


class PlaceSettings(_Given):
    """Vertices on a plane, or between two planes."""

    x: float | Span | None = setting(None, "coordinate, or two between which the vertices lie", "m")
    y: float | Span | None = setting(None, "coordinate along y, or two", "m")
    z: float | Span | None = setting(None, "coordinate along z, or two", "m")
    tolerance: Positive | None = setting(None, "largest distance from the plane; null: 1e-9", "m")


class SymmetrySettings(_Given):
    """Symmetry planes: the mesh is one side of them, and its vertices in a plane only move within it."""

    x: float | None = setting(None, "of the plane normal to x; null: none", "m")
    y: float | None = setting(None, "of the plane normal to y", "m")
    z: float | None = setting(None, "of the plane normal to z", "m")
    tolerance: Positive = setting(1e-9, "largest distance of a vertex in a plane", "m")


class BoxSettings(_Given):
    """Cells with their centres in a box."""

    x: Span | None = setting(None, "lowest and highest x; null: any", "m")
    y: Span | None = setting(None, "lowest and highest y", "m")
    z: Span | None = setting(None, "lowest and highest z", "m")


class HexahedralBox(Settings):
    """A box of hexahedra."""

    kind: Literal["box_hexahedra"]
    size: Annotated[Many[Positive], Field(min_length=3, max_length=3)] = setting(description="of its edges", unit="m")
    divisions: Annotated[Many[Divisions], Field(min_length=3, max_length=3)] = setting(
        description="cells along each edge"
    )
    nodes: Nodes = setting(8, "nodes of a cell: 8, or quadratic with 20 or 27")


class TetrahedralBox(Settings):
    """A box of tetrahedra, six in each of its cells."""

    kind: Literal["box_tetrahedra"]
    size: Annotated[Many[Positive], Field(min_length=3, max_length=3)] = setting(description="of its edges", unit="m")
    divisions: Annotated[Many[Divisions], Field(min_length=3, max_length=3)] = setting(
        description="cells along each edge"
    )
    order: Order = setting(1, "2 adds edge midpoints, without which tetrahedra bend far too stiffly")


class BoxesMesh(Settings):
    """A body of axis-aligned boxes that touch or overlap, of hexahedra."""

    kind: Literal["boxes"]
    boxes: Some[Pair[Vector]] = setting(description="lowest and highest corner of each box", unit="m")
    size: Positive = setting(0.01, "longest edge of a cell", "m")
    nodes: Nodes = setting(8, "nodes of a cell")


class FileMesh(Settings):
    """A tetrahedral or hexahedral mesh from a file that meshio reads."""

    kind: Literal["file"]
    path: Word = setting(description="of the file")
    units: LengthUnit = setting("m", "of the file")
    order: Order = setting(1, "2 adds edge midpoints to linear tetrahedra")
    drop_unreferenced: bool = setting(False, "leave out vertices that belong to no cell")


class SurfaceMesh(Settings):
    """The interior of a closed surface of triangles, filled with tetrahedra; closed surfaces inside it are cavities."""

    kind: Literal["surface"]
    path: Word = setting(description="of an STL, OBJ or PLY file")
    units: LengthUnit = setting("mm", "of the file")
    size: Positive = setting(0.01, "length of the edges of tetrahedra", "m")
    order: Order = setting(2, "1: linear tetrahedra, which bend far too stiffly")


class RodMesh(Settings):
    """A round or elliptic rod of hexahedra."""

    kind: Literal["rod"]
    centreline: Curve = setting(description="points of its axis", unit="m")
    radii: Positive | Some[Annotated[Many[float], Field(min_length=2, max_length=3)]] = setting(
        description="one radius, or arc lengths with the radius there, linear in between; two radii for an ellipse: "
        "along the axis that is most perpendicular to the rod at its start (the first of x, y and z), and across it",
        unit="m",
    )
    layers: Divisions = setting(10, "cells along the axis")
    core: Divisions = setting(1, "cells along a side of the core of the cross-section")
    rings: Divisions = setting(1, "rings of cells around the core")
    nodes: Nodes = setting(27, "nodes of a cell")
    grading: Annotated[float, Field(ge=0.0, le=1.0)] = setting(
        0.0, "from 0, layers of equal length, to 1, layers with lengths proportional to the radius"
    )


class ShippedArm(Settings):
    """One of the arms with six chambers of the package."""

    kind: Literal["arm"]
    name: Word = setting(description="of the arm, such as arm_hexahedra_1400")


class GeneratedArm(Settings):
    """A pneumatic arm of given dimensions, by default those of SoPrA."""

    kind: Literal["arm_generated"]
    size: Positive = setting(0.01, "of the cells", "m")
    cells: Word = setting("hexahedra", "hexahedra or tetrahedra")
    layers: Positive | None = setting(None, "length of hexahedra along the arm; null: 2.5 times the size", "m")
    order: Order = setting(1, "2 adds edge midpoints to tetrahedra")
    chamber_lengths: Some[Positive] = setting((0.120, 0.120), "of the chambers of each segment", "m")
    caps: Some[Positive] = setting((0.010, 0.021, 0.005), "solid parts before, between and after the chambers", "m")
    radii: Some[Positive] = setting(
        (0.0283923, 0.0212942, 0.0165622), "before the first chambers and after those of each segment", "m"
    )
    chambers: Natural = setting(3, "of each segment")
    profile: Word = setting("half_disc", "half_disc, disc or sector")
    outline: Word = setting("lobed", "lobed, around the chambers, or round")
    wall: Positive = setting(0.004, "thickness of the wall", "m")
    web: Positive = setting(0.004, "thickness between neighbouring chambers", "m")
    core: Positive | None = setting(
        None, "distance of the chambers from the axis, at the base; null: the least for the webs", "m"
    )
    rotations: Many[float] = setting(
        (), "of the chambers of each segment about the axis; for tetrahedra and a round outline", "degrees"
    )


MeshSettings = Annotated[
    HexahedralBox | TetrahedralBox | BoxesMesh | FileMesh | SurfaceMesh | RodMesh | ShippedArm | GeneratedArm,
    Field(discriminator="kind"),
]


class MeshGroup(Settings):
    """A mesh alone."""

    mesh: MeshSettings


class PhysicsSettings(Settings):
    """Computation of masses and volumes."""

    mass: Literal["row_sum", "per_vertex"] = setting(
        "row_sum", "per_vertex: every vertex has the mean element mass, as in the published code"
    )
    volume_integration: Literal["centre", "full"] = setting(
        "centre", "volumetric integration of an element: centre, against locking, or full, as in the published code"
    )


class _Constants(Settings):
    """Constants by name, in SI units, which `energies.materials` lists for each model."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float]

    @property
    def constants(self) -> dict[str, float]:
        """Constants by name, such as ``youngs_modulus`` [Pa]."""
        return dict(self.__pydantic_extra__)


class RegionMaterialSettings(_Constants):
    """The material of a region; constants that are left out are those of the group around it."""

    model: Word | None = setting(None, "constitutive model; a different one has its own constants alone")


class MaterialSettings(_Constants):
    """A material and its constants, in SI units, which `energies.materials` lists for each model."""

    model: Word = setting("corotated", "constitutive model")
    regions: dict[str, RegionMaterialSettings] = setting({}, "materials of regions of the mesh, by name")

    @property
    def by_region(self) -> "dict[str, MaterialSettings]":
        """Materials by region; of an empty name where there is one for the whole body."""
        if not self.regions:
            return {"": self}
        common: dict[str, Any] = {"model": self.model, **self.constants}
        return {
            name: MaterialSettings(
                **(common if region.model in (None, self.model) else {"model": region.model}) | region.constants
            )
            for name, region in self.regions.items()
        }

    @property
    def parameters(self) -> dict[str, float]:
        """Constants by parameter of the simulator, such as ``tip_youngs_modulus`` for a region ``tip``."""
        return {
            f"{region}_{name}" if region else name: value
            for region, material in self.by_region.items()
            for name, value in material.constants.items()
        }


class RigidSettings(Settings):
    """A rigid region, such as an end cap or an insert, by `fem.rigid.Rigid`."""

    density: Positive = setting(1200.0, unit="kg/m^3")
    stiffness: Positive = setting(1.0e9, "of the energy that penalises deformation", "Pa")


class PartSettings(Settings):
    """A further mesh of the body, with cells of the same kind, which form a region with the name of the part."""

    mesh: MeshSettings
    shift: Vector = setting((0.0, 0.0, 0.0), "from the coordinates of its own mesh", "m")


class GlueSettings(Settings):
    """Glue between regions whose cells do not match: vertices that follow another region, by `fem.rigid.Glue`."""

    region: Word = setting(description="region with the glued vertices")
    at: PlaceSettings = setting(description="where the glued vertices of that region lie")
    to: Word = setting(description="region that they follow")
    tolerance: Positive = setting(1.0e-3, "largest distance from that region", "m")


class ChamberSettings(Settings):
    """Closed chambers of the mesh, each with its own pressure."""

    count: Natural = setting(description="expected number of chambers of the mesh")
    axis: Direction = setting(description="along which chambers are numbered")


class FibreSettings(Settings):
    """Fibres wound around the chambers."""

    angles: Many[float] = setting(description="from the circumference, one for each family", unit="degrees")
    toe: Positive = setting(1.0e-3, "strain over which fibres become taut")
    stiffness: NotNegative = setting(description="of a family, per length", unit="N/m")


class RouteSettings(Settings):
    """The route of a tendon."""

    guides: Curve = setting(description="points through which it runs", unit="m")
    pieces: Divisions = setting(1, "pieces into which each straight part is divided")
    offsets: Annotated[Many[Direction | Curve], Field(max_length=2)] = setting(
        (), "directions of an identified offset of the route: three numbers each, or three for each guide"
    )


class TendonSettings(Settings):
    """Tendons that pull on the body."""

    routes: dict[str, RouteSettings] = setting(description="routes by name")
    commanded: Literal["tension", "contraction"] = setting(description="input of the tendons")
    stiffness: NotNegative = setting(description="required for commanded contractions", unit="N/m")
    toe: Positive = setting(1.0e-4, "contraction over which a tendon becomes taut", "m")
    reach: Positive = setting(1.0e-3, "largest distance of a guide from the body", "m")

    @model_validator(mode="after")
    def _pulls(self) -> Self:
        if self.commanded == "contraction" and not self.stiffness > 0.0:
            raise ValueError("stiffness is 0, but contractions are commanded, which act through it: set it, in N/m.")
        for name, route in self.routes.items():
            for offset in route.offsets:
                if isinstance(offset[0], tuple) and len(offset) != len(route.guides):
                    raise ValueError(
                        f"routes.{name}.offsets has a direction for {len(offset)} guides: give three numbers, or three "
                        f"for each of its {len(route.guides)} guides."
                    )
        return self


class BundleSettings(Settings):
    """A muscle: its cells and its direction."""

    direction: Direction = setting(description="of the fibres")
    within: BoxSettings = setting(BoxSettings(), "cells with the muscle")


class MuscleSettings(Settings):
    """Contractile fibres in the body."""

    bundles: dict[str, BundleSettings] = setting(description="muscles by name")
    commanded: Literal["stress", "contraction"] | None = setting(description="input of the muscles")
    stiffness: NotNegative = setting(description="required for commanded contractions", unit="Pa")
    toe: Positive = setting(1.0e-3, "strain over which fibres become taut")

    @model_validator(mode="after")
    def _pulls(self) -> Self:
        if self.commanded != "stress" and not self.stiffness > 0.0:
            why = "contractions are commanded" if self.commanded else "nothing is commanded"
            raise ValueError(f"stiffness is 0, but {why}: set it, in Pa.")
        return self


class MediumSettings(Settings):
    """A fluid around the body."""

    density: NotNegative = setting(description="of the fluid", unit="kg/m^3")
    linear: NotNegative = setting(0.0, "viscous drag of the surface", "N s/m^3")
    normal: NotNegative = setting(0.0, "coefficient of the drag normal to the surface")
    tangential: NotNegative = setting(0.0, "coefficient of the drag along the surface")
    layer: NotNegative = setting(0.0, "thickness of the fluid that moves with the surface", "m")
    buoyancy: bool = setting(True, "whether the fluid carries the body")


class StringSettings(Settings):
    """A string on which payloads hang."""

    length: Positive = setting(description="without a payload", unit="m")
    compliance: NotNegative = setting(0.0, "elongation by force", "m/N")
    toe: Positive = setting(1.0e-5, "elongation over which it becomes taut", "m")


class SolveSettings(Settings):
    """Settings of the solver of a step, `dynamics.nonlinear_solver`."""

    name: Literal["quasi_newton", "newton", "projective_dynamics"] = setting("quasi_newton", "method")
    relative_tolerance: Annotated[float, Field(gt=0.0, le=0.1)] = setting(
        1.0e-8, "residual at which a step is solved, over the forces in equilibrium"
    )
    absolute_tolerance: NotNegative = setting(1.0e-12, "residual at which a step is always solved", "N")
    max_iterations: Natural = setting(500, "after which a step fails")
    memory: Natural = setting(12, "pairs that L-BFGS keeps")
    refactor_after: Natural = setting(
        4, "iterations of a step above which quasi_newton refactorises an environment before the next step"
    )
    linear_solver: Literal["auto", "banded", "bordered", "tiled", "dense", "sparse", "multigrid"] = setting(
        "auto", "for Newton's equation; banded and bordered run on the CPU alone"
    )
    factors: Literal["double", "single"] = setting(
        "double", "precision of factors and L-BFGS pairs; residuals, states and gradients stay accurate"
    )
    on_failure: Literal["raise", "count"] = setting("raise", "effect of a failed step; count continues")


class BodySettings(Settings):
    """Settings of a body."""

    mesh: MeshSettings
    physics: PhysicsSettings = PhysicsSettings()
    parts: dict[str, PartSettings] = setting({}, "further meshes; the cells of the first one are the region 'body'")
    glued: Many[GlueSettings] = setting((), "glue between meshes that do not match")
    regions: dict[str, BoxSettings] = setting({}, "cells by region, beside the regions of a mesh file")
    rigid: dict[str, RigidSettings] = setting({}, "rigid regions")
    fixed: PlaceSettings = setting(description="fixed vertices")
    symmetry: SymmetrySettings | None = setting(None, "symmetry planes that cut the body")
    chambers: ChamberSettings | None = setting(None, "chambers under pressure")
    fibres: FibreSettings | None = setting(None, "fibres around the chambers")
    tendons: TendonSettings | None = setting(None, "tendons that pull")
    muscles: MuscleSettings | None = setting(None, "contractile fibres")
    medium: MediumSettings | None = setting(None, "fluid around the body")
    payload_string: StringSettings | None = setting(
        None, "string on which payloads hang; null: they are attached to the body"
    )


class SimulatorSettings(BodySettings):
    """Settings of a simulator, without the material."""

    gravity: Vector = setting((0.0, 0.0, -9.80709), unit="m/s^2")
    time_step: TimeStep = setting(0.01, "of the simulator", "s")
    integrator: Integrator = setting("implicit_euler", "time integrator")
    solver: SolveSettings = SolveSettings()
    device: Word = setting("auto", "cpu, cuda or auto, which uses CUDA for training if available")
    dtype: Literal["float64", "float32"] = setting("float64", "of the simulation; experiments need float64")
    coupling: Literal["implicit", "explicit"] = setting(
        "implicit", "pressure acts on the chambers at the end of a step (implicit) or at its start (explicit)"
    )


class SimulationSettings(SimulatorSettings):
    """A simulator and the material of its body; the other keys of a run's configuration are ignored."""

    model_config = ConfigDict(extra="ignore")

    simulation: MaterialSettings
