"""Settings of tests of specimens, from which the law of a material is identified."""

from typing import Annotated, Final, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from ..io.settings import Natural, NotNegative, Pair, Positive, Settings, Word, setting
from .data_kinds import TableSettings
from .performed import WithoutMotion, rising

LARGEST_SIZE: Final = 1.0  # of a specimen [m]; larger ones are in mm


class SpecimenSettings(Settings):
    """Dimensions of a specimen, and how it is held."""

    length: Positive = setting(
        description="between the grips or plates, or the thickness under an indenter", unit="m"
    )
    width: Positive | None = setting(None, "width of its section; null: round", "m")
    thickness: Positive | None = setting(None, "thickness of its section", "m")
    diameter: Positive | None = setting(None, "diameter of a round section", "m")
    ends: Literal["free", "glued"] = setting(
        "free",
        "glued: ends that keep their section, which is simulated; "
        "free: homogeneous, in closed form",
    )
    indenter: Positive | None = setting(None, "radius of a spherical indenter", "m")
    cells: Natural = setting(2, "cells across its thinnest direction where it is simulated")

    @model_validator(mode="after")
    def _has_section(self) -> Self:
        box = (self.width is not None, self.thickness is not None)
        if box not in ((True, True), (False, False)) or box[0] == (self.diameter is not None):
            raise ValueError("diameter, or width and thickness: give one of them, in m.")
        for name in ("length", "width", "thickness", "diameter", "indenter"):
            size = getattr(self, name)
            if size is not None and size > LARGEST_SIZE:
                raise ValueError(
                    f"{name} is {size:g} m: sizes are in m, write {1e-3 * size:g} for {size:g} mm."
                )
        return self

    @property
    def is_simulated(self) -> bool:
        """Whether the specimen does not deform homogeneously."""
        return self.ends == "glued" or self.indenter is not None

    @property
    def section(self) -> tuple[float, ...]:
        """Width and thickness, or the diameter alone [m]."""
        return (
            (self.diameter,)
            if self.diameter is not None
            else (self.width or 0.0, self.thickness or 0.0)
        )


class MembraneSettings(Settings):
    """An inflated membrane; the head of its table has its thickness, cap and rings."""

    radius: Annotated[Positive, Field(le=LARGEST_SIZE)] = setting(
        description="of the disc within its clamp", unit="m"
    )
    ring_modulus: Positive = setting(1.0e6, "shear modulus of its stiff rings", "Pa")


class MaterialTestSettings(Settings):
    """A test of a specimen."""

    kind: Literal[
        "tension", "compression", "biaxial", "planar", "shear", "indentation", "bulge"
    ] = setting(description="kind of the test")
    file: Word | None = setting(
        None,
        "table in data.folder, or tables of one kind of test, "
        "as in membrane_*.csv; null: simulated",
    )
    specimen: SpecimenSettings | None = setting(None, "its dimensions; null for a membrane")
    membrane: MembraneSettings | None = setting(None, "the membrane of a bulge test")
    held_out: bool = setting(False, "the law is not identified from it, but predicts it")
    zero: NotNegative = setting(
        0.05,
        "standard deviation of the zero of the load cell, over the largest force in data.range",
    )
    toe: NotNegative = setting(
        0.0, "standard deviation of the strain at which the specimen becomes taut"
    )
    compliance: NotNegative = setting(
        0.0, "standard deviation of the compliance of the machine", "m/N"
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if (self.kind == "bulge") != (self.membrane is not None) or (self.membrane is None) == (
            self.specimen is None
        ):
            raise ValueError(
                "a bulge test has a membrane, all others have a specimen: give the one that fits."
            )
        if self.specimen is None:
            if self.file is None:
                raise ValueError(
                    "file is null, but bulge tests are not simulated: name a table in data.folder."
                )
            return self
        if (self.kind == "indentation") != (self.specimen.indenter is not None):
            raise ValueError(
                "kind is indentation if, and only if, "
                "specimen.indenter has a radius: change one of them."
            )
        if self.specimen.ends == "glued" and self.kind not in ("tension", "compression", "shear"):
            raise ValueError(f"a {self.kind} test has no glued ends: set specimen.ends to free.")
        return self


class SimulatedTests(Settings):
    """Simulated tests, in place of tables."""

    material: dict[str, float] = setting(
        description="parameters of the true law, as of ConvexMaterial"
    )
    samples: Natural = setting(200, "samples of a test")
    strain: Positive = setting(0.6, "largest strain")
    noise: NotNegative = setting(0.01, "standard deviation of the force, relative")
    compliance: NotNegative = setting(0.0, "true compliance of the machine", "m/N")
    cells: Natural = setting(3, "cells across the thinnest direction of simulated specimens")


class MaterialTestData(WithoutMotion):
    """Tests of specimens: tension, compression, shear, indentation, relaxation."""

    kind: Literal["material_tests"]
    folder: Word | None = setting(None, "folder of the tables")
    table: TableSettings | None = setting(None, "columns of tables without a header that is known")
    tests: Annotated[dict[str, MaterialTestSettings], Field(min_length=1)] = setting(
        description="tests by name"
    )
    range: Annotated[Pair[NotNegative], AfterValidator(rising)] | None = setting(
        None,
        "strains, or heights of a membrane over its radius, "
        "that the law is identified from; null: all",
    )
    scaled: bool = setting(
        False,
        "the law is law.file times one factor; false: "
        "its terms are fitted, and law.file is a prior",
    )
    simulated: SimulatedTests | None = setting(None, "simulates the tests where there is no folder")
    steps: None = setting(None, "null, as tables have all samples")
    limit: None = setting(None, "null, as all tests are used")

    @model_validator(mode="after")
    def _has_source(self) -> Self:
        if (self.folder is None) == (self.simulated is None):
            raise ValueError(
                "folder, or simulated: give one of them, "
                "the folder of the tables or simulated tests."
            )
        if self.folder is not None and (
            lost := [name for name, test in self.tests.items() if test.file is None]
        ):
            raise ValueError(f"tests.{lost[0]}.file is null: name its table in data.folder.")
        if self.folder is None and (
            read := [name for name, test in self.tests.items() if test.kind == "bulge"]
        ):
            raise ValueError(
                f"tests.{read[0]} is a bulge test, which is not simulated: give data.folder."
            )
        if not self.scaled and any(test.kind == "bulge" for test in self.tests.values()):
            raise ValueError(
                "bulge tests scale a law: set data.scaled=true, and law.file to the law."
            )
        if all(test.held_out for test in self.tests.values()):
            raise ValueError("all tests are held out: identify the law from one or more.")
        return self
