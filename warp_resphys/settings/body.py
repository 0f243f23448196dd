"""Settings of a body (material, parts, actuators, loads) and of its simulator."""

from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, ConfigDict, Field, model_validator
from typing_extensions import override

from ..core.dynamics.solver_settings import SolverSettings
from ..core.energies.route import Route
from ..core.energies.silicones import silicone_values
from ..core.fem.rigid_region import Rigid
from ..core.mesh.place import Direction, Place
from ..io.classes import ClassSettings, package_of
from ..io.settings import (
    Count,
    Many,
    NotNegative,
    Positive,
    Settings,
    Vector,
    Word,
    setting,
    without_null,
)
from .contact import ContactSettings, ObstacleSettings, SurfaceContactSettings
from .meshing import BoxSettings, MeshSettings, SymmetrySettings

Integrator = Literal["implicit_euler", "bdf2", "midpoint"]
TimeStep = Annotated[float, Field(gt=0.0, le=10.0)]
OwnEnergies = Annotated[
    dict[str, ClassSettings],
    BeforeValidator(without_null, json_schema_input_type=dict[str, ClassSettings | None]),
]


class PhysicsSettings(Settings):
    """Computation of masses and volumes."""

    mass: Literal["row_sum", "per_vertex"] = setting(
        "row_sum", "per_vertex: the mean element mass, as published"
    )
    volume_integration: Literal["centre", "full"] = setting(
        "centre", "integration of the volume term; full locks, as published"
    )


class _Parameters(Settings):
    """Parameters by name, in SI units, which `energies.materials` lists for each model."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float]

    @model_validator(mode="before")
    @classmethod
    def _of_other_package(cls, values: Any) -> Any:
        """Takes Hydra's ``_target_``, a class of another package,
        as the model, and the law of a silicone by name.
        """
        if not isinstance(values, dict):
            return values
        if values.get("_target_") is None:
            return silicone_values(values)
        if values.get("model") is not None:
            raise ValueError("model and _target_ are both given: set one of them to null.")
        return {key: value for key, value in values.items() if key != "_target_"} | {
            "model": values["_target_"]
        }

    @override
    def packages(self) -> dict[str, str]:
        model = str(dict(self)["model"])
        return (package_of(model) if "." in model else {}) | super().packages()

    @property
    def values(self) -> dict[str, float]:
        """Parameters by name, such as ``youngs_modulus`` [Pa]."""
        return dict(self.__pydantic_extra__)


def _without_default(schema: dict[str, Any]) -> None:
    """Takes the default out of a key's schema, so that it is not shown beside ``_target_``."""
    del schema["default"]


class RegionMaterialSettings(_Parameters):
    """The material of a region; parameters that are left out are those of the group around it."""

    model: Word | None = setting(
        None, "constitutive model; a different one has its own parameters alone"
    )


def _of_material(schema: dict[str, Any]) -> None:
    """Lets editors accept the parameters of any material, and the name of a silicone."""
    schema["additionalProperties"] = {"anyOf": [{"type": "number"}, {"type": "null"}]}
    schema["properties"]["name"] = {
        "type": "string",
        "description": "of the silicone, where the model is silicone",
    }


class MaterialSettings(_Parameters):
    """A material and its parameters, in SI units, as `energies.materials` lists them.

    Null takes one out.
    """

    model_config = ConfigDict(json_schema_extra=_of_material)

    model: Word = Field(
        "corotated",
        description="constitutive model, corotated by default; silicone: the law of a silicone "
        "of the package by its name; _target_ instead: a class of another package",
        json_schema_extra=_without_default,
    )
    regions: dict[str, RegionMaterialSettings] = setting(
        {}, "materials of regions of the mesh, by name"
    )

    @model_validator(mode="before")
    @classmethod
    def _without_null(cls, values: Any) -> Any:
        return without_null(values)

    @property
    def by_region(self) -> "dict[str, MaterialSettings]":
        """Materials by region; of an empty name where there is one for the whole body."""
        if not self.regions:
            return {"": self}
        common: dict[str, Any] = {"model": self.model, **self.values}
        return {
            name: MaterialSettings(
                **(common if region.model in (None, self.model) else {"model": region.model})
                | region.values
            )
            for name, region in self.regions.items()
        }

    @property
    def parameters(self) -> dict[str, float]:
        """Values by parameter of the simulator, such
        as ``tip_youngs_modulus`` for a region ``tip``.
        """
        found = dict[str, float]()
        for region, material in self.by_region.items():
            prefix = f"{region}_" if region else ""
            found |= {f"{prefix}{name}": value for name, value in material.values.items()}
        return found


class PartSettings(Settings):
    """A further mesh of the body, with cells of the same kind,
    which form a region with the name of the part.
    """

    mesh: MeshSettings
    shift: Vector = setting(
        (0.0, 0.0, 0.0), "displacement from the coordinates of its own mesh", "m"
    )


class GlueSettings(Settings):
    """Glue between regions whose cells do not match:
    vertices that follow another region, by `fem.bodies.Glue`.
    """

    region: Word = setting(description="region with the glued vertices")
    at: Place = setting(description="where the glued vertices of that region lie")
    to: Word = setting(description="region that they follow")
    tolerance: Positive = setting(1.0e-3, "largest distance from that region", "m")


class ChamberSettings(Settings):
    """Closed chambers of the mesh, and open faces, each with its own pressure."""

    count: Count = setting(0, "expected number of closed chambers of the mesh")
    axis: Direction = setting((0.0, 0.0, -1.0), "direction in which closed chambers are numbered")
    faces: dict[str, Place | Word] = setting(
        {},
        "open faces by name: those with all vertices at a place, "
        "or a named surface of the mesh file",
    )

    @model_validator(mode="after")
    def _presses(self) -> Self:
        if not self.count and not self.faces:
            raise ValueError(
                "count is 0, and faces has none: "
                "give the number of chambers, or faces under pressure."
            )
        return self


class FibreSettings(Settings):
    """Fibres wound around the chambers, or around the body."""

    around: Literal["chambers", "outside"] = setting(
        "chambers", "surface in which they lie; both need chambers"
    )
    angles: Many[float] = setting(
        description="angles from the circumference, one per family", unit="degrees"
    )
    toe: Positive = setting(1.0e-3, "strain over which fibres become taut")
    stiffness: NotNegative = setting(description="stiffness of a family, per length", unit="N/m")


class TendonSettings(Settings):
    """Tendons that pull on the body."""

    routes: dict[str, Route] = setting(description="routes by name")
    commanded: Literal["tension", "contraction"] = setting(description="input of the tendons")
    stiffness: NotNegative = setting(description="required for commanded contractions", unit="N/m")
    toe: Positive = setting(1.0e-4, "contraction over which a tendon becomes taut", "m")
    reach: Positive = setting(1.0e-3, "largest distance of a guide from the body", "m")
    friction: NotNegative | None = setting(None, "coefficient in the guides; null: none")
    bristle_length: Positive = setting(1.0e-4, "slide over which friction reverses", "m")

    @model_validator(mode="after")
    def _pulls(self) -> Self:
        if self.commanded == "contraction" and not self.stiffness > 0.0:
            raise ValueError(
                "stiffness is 0, but contractions are commanded, "
                "which act through it: set it, in N/m."
            )
        return self


class BundleSettings(Settings):
    """A muscle: its cells and its direction."""

    direction: Direction = setting(description="direction of the fibres")
    within: BoxSettings = setting(BoxSettings(), "cells with the muscle")


class MuscleSettings(Settings):
    """Contractile fibres in the body."""

    bundles: dict[str, BundleSettings] = setting(description="muscles by name")
    commanded: Literal["stress", "contraction"] | None = setting(
        None, "input of the muscles; null: passive fibres, which stiffen the body in tension"
    )
    stiffness: NotNegative = setting(
        description="required for commanded contractions and passive fibres", unit="Pa"
    )
    toe: Positive = setting(1.0e-3, "strain over which fibres become taut")

    @model_validator(mode="after")
    def _pulls(self) -> Self:
        if self.commanded != "stress" and not self.stiffness > 0.0:
            why = "contractions are commanded" if self.commanded else "nothing is commanded"
            raise ValueError(f"stiffness is 0, but {why}: set it, in Pa.")
        return self


class MediumSettings(Settings):
    """A fluid around the body."""

    density: NotNegative = setting(description="density of the fluid", unit="kg/m^3")
    linear: NotNegative = setting(0.0, "viscous drag of the surface", "N s/m^3")
    normal: NotNegative = setting(0.0, "coefficient of the drag normal to the surface")
    tangential: NotNegative = setting(0.0, "coefficient of the drag along the surface")
    layer: NotNegative = setting(0.0, "thickness of the fluid that moves with the surface", "m")
    buoyancy: bool = setting(True, "whether the fluid carries the body")


class BodySettings(Settings):
    """Settings of a body."""

    mesh: MeshSettings
    physics: PhysicsSettings = PhysicsSettings()
    parts: dict[str, PartSettings] = setting(
        {}, "further meshes; the cells of the first one are the region 'body'"
    )
    glued: Many[GlueSettings] = setting((), "glue between meshes that do not match")
    regions: dict[str, BoxSettings] = setting(
        {}, "cells by region, beside the regions of a mesh file"
    )
    rigid: dict[str, Rigid] = setting({}, "rigid regions")
    fixed: Place | None = setting(
        description="fixed vertices; null: none, of a body that lies on obstacles"
    )
    symmetry: SymmetrySettings | None = setting(None, "symmetry planes that cut the body")
    chambers: ChamberSettings | None = setting(None, "chambers and open faces under pressure")
    fibres: FibreSettings | None = setting(None, "fibres around the chambers, or around the body")
    tendons: TendonSettings | None = setting(None, "tendons that pull")
    muscles: MuscleSettings | None = setting(None, "contractile fibres")
    medium: MediumSettings | None = setting(None, "fluid around the body")
    obstacles: dict[str, ObstacleSettings] = setting(
        {}, "rigid obstacles that the body touches, by name"
    )
    contact: ContactSettings = setting(ContactSettings(), "contact with the obstacles")
    energies: OwnEnergies = setting(
        {}, "energies and actuators of other packages, by name, with their arguments; null: none"
    )
    self_contact: SurfaceContactSettings | None = setting(
        None,
        "contact of the body with itself and of its parts with one another; null: they pass "
        "through one another",
    )

    @model_validator(mode="after")
    def _touches(self) -> Self:
        if not self.obstacles and self.contact != ContactSettings():
            raise ValueError(
                "contact is set, but obstacles has none: name an obstacle, or leave contact out."
            )
        if self.fixed is None and not self.obstacles and self.symmetry is None:
            raise ValueError(
                "fixed is null, and obstacles has none that the body lies on: name fixed vertices."
            )
        return self

    @property
    def meshes(self) -> tuple[MeshSettings, ...]:
        """The mesh and those of the parts."""
        return (self.mesh, *(part.mesh for part in self.parts.values()))


class SteppedSettings(BodySettings):
    """A body and its time integration."""

    time_step: TimeStep = setting(0.01, "time step of the simulator", "s")
    integrator: Integrator = setting("implicit_euler", "time integrator")


class TargetSettings(SteppedSettings):
    """The simulation that stands in for the real body."""

    # `run.filled` moves parameters that stand directly in ``target`` into its material.
    model_config = ConfigDict(
        json_schema_extra={
            "additionalProperties": {
                "anyOf": [{"type": "number"}, {"type": "string"}, {"type": "null"}]
            }
        }
    )

    material: MaterialSettings = setting(description="material of its body")


class SimulatorSettings(SteppedSettings):
    """Settings of a simulator, without the material."""

    gravity: Vector = setting((0.0, 0.0, -9.80709), "acceleration of gravity", "m/s^2")
    solver: SolverSettings = SolverSettings()
    device: Word = setting("auto", "cpu, cuda or auto, which uses CUDA for training if available")
