"""Parametric pneumatic arms: segments in a row, each with closed chambers around the axis.

An arm is clamped at z = 0 and hangs along -z. `mesh_arm` fills it with hexahedra, which takes no other program, or with
tetrahedra, which gmsh makes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from math import isfinite, pi
from typing import Any

import numpy as np

from warp_resphys.arm_section import SOLID, Section, section_grids, section_points, section_quadrilaterals
from warp_resphys.chambers import find_chambers
from warp_resphys.errors import MeshError
from warp_resphys.mesh import IntArray, Mesh, boundary_faces, check_mesh

PROFILES = ("half_disc", "disc", "sector")
OUTLINES = ("lobed", "round")
CELLS = ("hexahedra", "tetrahedra")
MOST_CHAMBERS = 8  # in a segment
_SLENDER = 2.5  # height of a layer of hexahedra over their size in the section, where it is not given
_MOST_CELLS = 2_000_000


@dataclass(frozen=True)
class ArmGeometry:
    """Measures of a pneumatic arm; those of SoPrA (Toshimitsu et al. 2021) by default.

    From the base on, the arm is a cap, the chambers of a segment, a cap, and so on, and ends with a cap. It tapers
    evenly along chambers; caps are cylinders.

    Attributes:
        chamber_lengths: lengths of the chambers of each segment [m].
        caps: heights of the solid parts before, between and after the chambers [m]; one more than there are segments.
        radii: of the outline before the first chambers and after those of each segment [m]; one more than there are
            segments. It is where the outline is farthest from the axis.
        chambers: number of chambers of each segment, 2 to 8.
        profile: of a chamber: ``half_disc``, its flat side towards the axis; ``disc``; or ``sector`` of an annulus.
        outline: ``lobed``: around each chamber, at the distance of the wall; or ``round``: a circle.
        wall: between a chamber and the outline [m].
        web: between neighbouring chambers, where they are closest [m].
        core: between the axis and the chambers, at the base [m]; it shrinks with the radius. None: as little as the
            webs allow.
        rotations: of the chambers of each segment about the axis [degrees], counter-clockwise seen from the base;
            empty: all lie in line, the first towards +x.

    Raises:
        MeshError: a measure is not positive, numbers of measures do not fit, or the chambers do not.
    """

    chamber_lengths: Sequence[float] = (0.120, 0.120)
    caps: Sequence[float] = (0.010, 0.021, 0.005)
    radii: Sequence[float] = (0.0283923, 0.0212942, 0.0165622)
    chambers: int = 3
    profile: str = "half_disc"
    outline: str = "lobed"
    wall: float = 0.004
    web: float = 0.004
    core: float | None = None
    rotations: Sequence[float] = ()

    def __post_init__(self) -> None:
        """Check all measures, and store sequences as tuples."""
        for name in ("chamber_lengths", "caps", "radii", "rotations"):
            object.__setattr__(self, name, _numbers(name, getattr(self, name), positive=name != "rotations"))
        count = len(self.chamber_lengths)
        if not count:
            raise MeshError("the arm's chamber_lengths are empty: give one length for each segment.")
        for name in ("caps", "radii"):
            given = len(getattr(self, name))
            if given != count + 1:
                raise MeshError(f"the arm's {name} are {given} numbers, but {count} chamber_lengths need {count + 1}.")
        if self.rotations and len(self.rotations) != count:
            raise MeshError(f"the arm's rotations are {len(self.rotations)} numbers, but it has {count} segments.")
        for name in ("wall", "web", *(("core",) if self.core is not None else ())):
            _numbers(name, (getattr(self, name),))
        for name, known in (("profile", PROFILES), ("outline", OUTLINES)):
            if getattr(self, name) not in known:
                raise MeshError(f"the arm's {name} is {getattr(self, name)!r}: choose {', '.join(known)}.")
        if (
            isinstance(self.chambers, bool)
            or not isinstance(self.chambers, int)
            or not 2 <= self.chambers <= MOST_CHAMBERS
        ):
            raise MeshError(
                f"the arm's chambers are {self.chambers!r} a segment: choose a whole number, 2 to {MOST_CHAMBERS}."
            )
        if self.outline == "lobed" and (self.profile == "sector" or any(self.rotations)):
            what = "sectors" if self.profile == "sector" else "rotations"
            raise MeshError(f"a lobed outline does not go with {what}: set the arm's outline to round.")
        for radius in self.radii:
            self.section(radius).check()

    @property
    def length(self) -> float:
        """From the base to the tip [m]."""
        return float(sum(self.chamber_lengths) + sum(self.caps))

    @property
    def stations(self) -> tuple[float, ...]:
        """Heights where caps and chambers begin and end, from the base's 0 down to the tip [m]; an even number."""
        parts = [self.caps[0]]
        for chamber, cap in zip(self.chamber_lengths, self.caps[1:], strict=True):
            parts += [chamber, cap]
        return (0.0, *(-np.cumsum(parts)).tolist())

    def section(self, radius: float) -> Section:
        """The cross-section where the outline has a radius [m], not rotated."""
        core = None if self.core is None else self.core * radius / self.radii[0]
        return Section(radius, self.chambers, self.profile, self.outline, self.wall, self.web, core)

    def radius_at(self, height: float) -> float:
        """The radius of the outline at a height [m], 0 at the base and negative below it."""
        ends = np.array(self.stations[1:-1])
        return float(np.interp(-height, -ends, np.repeat(self.radii, 2)[1:-1]))


def arm_geometry(config: Mapping[str, Any]) -> ArmGeometry:
    """The measures of an arm from a group that has the keys of `ArmGeometry`, and perhaps others.

    Raises:
        MeshError: measures of which no arm can be made.
    """
    return ArmGeometry(**{field.name: config[field.name] for field in fields(ArmGeometry)})


def mesh_arm(
    geometry: ArmGeometry, size: float, cells: str = "hexahedra", layers: float | None = None
) -> tuple[Mesh, dict[str, IntArray]]:
    """Meshes an arm.

    Hexahedra are blocks of quadrilaterals, swept along the arm: every wall is at least one element thick, and the
    corners of the chambers are kept. Polygons stand for the curves, of the same area, so that even coarse chambers have
    their volume; on coarse meshes their corners therefore lie outside the curves by up to a fifteenth of the radius.

    Args:
        geometry: the arm.
        size: of the elements [m]; for hexahedra, a length of the edges in the section that is aimed at on average,
            for walls, flat sides and arcs each.
        cells: "hexahedra" or "tetrahedra" (4-node; `mesh.quadratic` adds the midpoints).
        layers: height of the layers of hexahedra [m]; None: 2.5 times the size, as the arm is slender.

    Returns:
        The mesh, its vertices numbered from the base to the tip, and its surfaces by name, as from `name_surfaces`.

    Raises:
        MeshError: a size is not positive or would give millions of cells; rotated segments are to be meshed with
            hexahedra; there is no gmsh for tetrahedra, or it fails.
    """
    if cells not in CELLS:
        raise MeshError(f"the arm's cells are {cells!r}: choose {' or '.join(CELLS)}.")
    _numbers("size", (size,))
    if cells == "tetrahedra":
        if layers is not None:
            raise MeshError("layers are for arms of hexahedra: set them to null, or cells to hexahedra.")
        from warp_resphys.arm_tetrahedra import tetrahedra

        mesh = tetrahedra(geometry, size)
    else:
        _numbers("layers", (layers,) if layers is not None else ())
        mesh = _hexahedra(geometry, size, _SLENDER * size if layers is None else layers)
    check_mesh(mesh)
    return mesh, name_surfaces(mesh)


def name_surfaces(mesh: Mesh) -> dict[str, IntArray]:
    """The surfaces of an arm that hangs along -z.

    Args:
        mesh: the arm.

    Returns:
        (F, 3 | 4 | 6) faces as `mesh.boundary_faces` gives them: ``base`` and ``tip`` on the planes of the highest and
        the lowest vertices, ``chamber_1`` and so on as `chambers.find_chambers` numbers them, ``outside``, the rest.
    """
    faces = boundary_faces(mesh)
    heights = mesh.vertices[:, 2]
    tolerance = 1e-9 * float(np.ptp(heights))
    surfaces = {
        "base": np.all(heights[faces] > heights.max() - tolerance, axis=1),
        "tip": np.all(heights[faces] < heights.min() + tolerance, axis=1),
    }
    chambers = {chamber.name: chamber.faces for chamber in find_chambers(mesh)}
    inner = np.concatenate([np.unique(each) for each in chambers.values()]) if chambers else np.empty(0, dtype=np.int64)
    outside = ~(surfaces["base"] | surfaces["tip"] | np.isin(faces[:, 0], inner))
    return {**{name: faces[chosen] for name, chosen in surfaces.items()}, "outside": faces[outside], **chambers}


def _hexahedra(geometry: ArmGeometry, size: float, layer: float) -> Mesh:
    """Sweeps the section along the arm; quadrilaterals in a chamber are left out between its ends."""
    if len({angle % (360.0 / geometry.chambers) for angle in geometry.rotations}) > 1:
        raise MeshError(
            "segments that are rotated against each other cannot be swept: set the arm's cells to tetrahedra."
        )
    middle = geometry.section(0.5 * (geometry.radii[0] + geometry.radii[-1]))
    divisions = middle.divisions(size)
    stations = np.array(geometry.stations)
    counts = np.maximum(1, np.round(-np.diff(stations) / layer).astype(int))
    if len(list(middle.blocks())) * int(counts.sum()) * max(divisions.values()) ** 2 > _MOST_CELLS:
        raise MeshError(
            f"with size {size:g} m, the arm would have more than {_MOST_CELLS} cells: enlarge size or layers."
        )
    grids, chamber = section_grids(middle, divisions)
    place, quads = section_quadrilaterals(grids)
    solid = np.concatenate([each for each, number in zip(quads, chamber, strict=True) if number == SOLID])
    full = np.concatenate(quads)
    turn = np.exp(1j * pi / 180.0 * (geometry.rotations[0] if geometry.rotations else 0.0))
    heights = np.concatenate(
        [[0.0], *(np.linspace(a, b, n + 1)[1:] for a, b, n in zip(stations, stations[1:], counts, strict=False))]
    )
    vertices = np.empty((len(heights), len(place), 3))
    for level, height in enumerate(heights):
        section = geometry.section(geometry.radius_at(float(height)))
        points = turn * section_points(section_grids(section, divisions)[0])[place]
        vertices[level] = np.stack([points.real, points.imag, np.full(len(points), height)], axis=1)
    cells = []
    for level, part in enumerate(np.repeat(np.arange(len(counts)), counts)):
        upper = len(place) * level + (full if part % 2 == 0 else solid)  # caps and chambers take turns
        cells.append(np.concatenate([upper + len(place), upper], axis=1))
    used, numbered = np.unique(np.concatenate(cells), return_inverse=True)
    return Mesh(vertices.reshape(-1, 3)[used], numbered.reshape(-1, 8))


def _numbers(name: str, given: Sequence[Any], positive: bool = True) -> tuple[float, ...]:
    """The numbers as a tuple; MeshError where one is no finite number, or not positive."""
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise MeshError(f"the arm's {name} are {given!r}: give a list of numbers.")
    for value in given:
        good = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
        if not good or (positive and value <= 0.0):
            unit = "a positive number, in metres" if positive else "a number, in degrees"
            raise MeshError(f"the arm's {name} has {value!r}: it must be {unit}.")
    return tuple(float(value) for value in given)
