"""Meshes of parametric pneumatic arms.

An arm is clamped at z = 0 and hangs along -z. `mesh_arm` fills it with hexahedra, or with tetrahedra by gmsh.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import isfinite, pi
from typing import Any

import numpy as np

from ..io.arrays import IntArray
from ..io.errors import MeshError
from .arm_section import SOLID, ComplexArray, Section, section_grids, section_quadrilaterals
from .chambers import find_chambers
from .tetrahedra import tetrahedra_by_gmsh
from .volume_mesh import Mesh, boundary_faces, check_mesh

_PROFILES = ("half_disc", "disc", "sector")
_OUTLINES = ("lobed", "round")
_MOST_CHAMBERS = 8  # per segment
CELLS = ("hexahedra", "tetrahedra")
_SLENDER = 2.5  # default height of a layer of hexahedra over their size in the section
_MOST_CELLS = 2_000_000


@dataclass(frozen=True)
class ArmGeometry:
    """Dimensions of a pneumatic arm; defaults are those of SoPrA (Toshimitsu et al. 2021).

    From base to tip, solid caps alternate with the chambers of a segment, beginning and ending with a cap. The arm
    tapers linearly along chambers; caps are cylinders.

    Raises:
        MeshError: a dimension that is not positive, sequences of inconsistent length, or chambers that do not fit.
    """

    chamber_lengths: Sequence[float] = (0.120, 0.120)  # length of the chambers of each segment [m]
    caps: Sequence[float] = (0.010, 0.021, 0.005)  # heights of the solid caps [m]; one more than segments
    # largest radius of the outline before the first chambers and after those of each segment [m]
    radii: Sequence[float] = (0.0283923, 0.0212942, 0.0165622)
    chambers: int = 3  # chambers per segment, 2 to 8
    profile: str = (
        "half_disc"  # of a chamber: half_disc, with the flat side towards the axis; disc; sector of an annulus
    )
    outline: str = "lobed"  # lobed, parallel to each chamber at the distance `wall`; or round, a circle
    wall: float = 0.004  # thickness between a chamber and the outline [m]
    web: float = 0.004  # smallest thickness between neighbouring chambers [m]
    core: float | None = (
        None  # distance of the chambers from the axis at the base [m], scales with the radius; None: min
    )
    # rotation of each segment's chambers about the axis [deg], counter-clockwise seen from the base; empty: none
    rotations: Sequence[float] = ()

    def __post_init__(self) -> None:
        """Checks all dimensions, and stores sequences as tuples."""
        for name in ("chamber_lengths", "caps", "radii", "rotations"):
            object.__setattr__(self, name, numbers(name, getattr(self, name), positive=name != "rotations"))
        count = len(self.chamber_lengths)
        if not count:
            raise MeshError("the arm's chamber_lengths are empty: give one length for each segment.")
        needed = {"caps": count + 1, "radii": count + 1, "rotations": count if self.rotations else 0}
        for name, number in needed.items():
            given = len(getattr(self, name))
            if given != number:
                raise MeshError(f"the arm's {name} are {given} numbers, but {count} chamber_lengths need {number}.")
        for name in ("wall", "web", "core"):
            numbers(name, (getattr(self, name),) if getattr(self, name) is not None else ())
        for name, choices in (("profile", _PROFILES), ("outline", _OUTLINES)):
            if getattr(self, name) not in choices:
                raise MeshError(f"the arm's {name} is {getattr(self, name)!r}: choose {', '.join(choices)}.")
        if type(self.chambers) is not int or not 2 <= self.chambers <= _MOST_CHAMBERS:
            raise MeshError(
                f"the arm's chambers are {self.chambers!r} a segment: choose a whole number, 2 to {_MOST_CHAMBERS}."
            )
        if self.outline == "lobed" and (self.profile == "sector" or any(self.rotations)):
            what = "sectors" if self.profile == "sector" else "rotations"
            raise MeshError(f"a lobed outline does not go with {what}: set the arm's outline to round.")
        for radius in self.radii:
            self.section(radius).check()

    @property
    def length(self) -> float:
        """Length from base to tip [m]."""
        return float(sum(self.chamber_lengths) + sum(self.caps))

    @property
    def stations(self) -> tuple[float, ...]:
        """Heights of the ends of caps and chambers, from 0 at the base down to the tip [m]; an even number."""
        parts = [self.caps[0]]
        for chamber, cap in zip(self.chamber_lengths, self.caps[1:], strict=True):
            parts += [chamber, cap]
        return (0.0, *(-np.cumsum(parts)).tolist())

    def section(self, radius: float) -> Section:
        """Returns the unrotated cross-section with a given outline radius [m]."""
        core = None if self.core is None else self.core * radius / self.radii[0]
        return Section(radius, self.chambers, self.profile, self.outline, self.wall, self.web, core)

    def radius_at(self, height: float) -> float:
        """Returns the radius of the outline at a height [m], which is 0 at the base and negative below."""
        ends = np.array(self.stations[1:-1])
        return float(np.interp(-height, -ends, np.repeat(self.radii, 2)[1:-1]))


def numbers(name: str, given: Sequence[Any], positive: bool = True) -> tuple[float, ...]:
    """Returns a dimension as a tuple, or raises MeshError for values that are not finite or not positive."""
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise MeshError(f"the arm's {name} are {given!r}: give a list of numbers.")
    for value in given:
        good = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
        if not good or (positive and value <= 0.0):
            unit = "a positive number, in metres" if positive else "a number, in degrees"
            raise MeshError(f"the arm's {name} has {value!r}: it must be {unit}.")
    return tuple(float(value) for value in given)


def mesh_arm(
    geometry: ArmGeometry, size: float, cells: str = "hexahedra", layers: float | None = None
) -> tuple[Mesh, dict[str, IntArray]]:
    """Meshes an arm.

    Hexahedra are blocks of quadrilaterals swept along the arm: every wall is at least one element thick, and the
    corners of the chambers are preserved. Curves are replaced by polygons of the same area, so that even coarse
    chambers have the correct volume; their corners lie outside the curves by up to a fifteenth of the radius.

    Args:
        geometry: the arm.
        size: element size [m]; for hexahedra, the average edge length in the section, for walls, flat sides and arcs
            separately.
        cells: "hexahedra" or "tetrahedra" (4-node; `volume_mesh.quadratic` adds the midpoints).
        layers: height of the layers of hexahedra [m]; None: 2.5 times the size.

    Returns:
        The mesh, with vertices numbered from the base to the tip, and its surfaces by name (`name_surfaces`).

    Raises:
        MeshError: a size that is not positive or would give millions of cells; hexahedra for rotated segments; a
            missing or failing gmsh.
    """
    if cells not in CELLS:
        raise MeshError(f"the arm's cells are {cells!r}: choose {' or '.join(CELLS)}.")
    numbers("size", (size,))
    if cells == "tetrahedra":
        if layers is not None:
            raise MeshError("layers are for arms of hexahedra: set them to null, or cells to hexahedra.")
        mesh = tetrahedra(geometry, size)
    else:
        numbers("layers", (layers,) if layers is not None else ())
        mesh = _hexahedra(geometry, size, _SLENDER * size if layers is None else layers)
    check_mesh(mesh)
    return mesh, name_surfaces(mesh)


def name_surfaces(mesh: Mesh) -> dict[str, IntArray]:
    """Returns the surfaces of an arm that hangs along -z, by name.

    Returns:
        (F, 3 | 4 | 6) faces as from `boundary_faces`: ``base`` and ``tip`` in the planes of the highest and lowest
        vertices, ``chamber_1`` and so on as from `chambers.find_chambers`, and ``outside``, the rest.
    """
    faces = boundary_faces(mesh)
    heights = mesh.vertices[:, 2]
    tolerance = 1e-9 * float(np.ptp(heights))
    surfaces = {
        "base": np.all(heights[faces] > heights.max() - tolerance, axis=1),
        "tip": np.all(heights[faces] < heights.min() + tolerance, axis=1),
    }
    chambers = {chamber.name: chamber.faces for chamber in find_chambers(mesh)}
    inner = [faces.ravel() for faces in chambers.values()]
    outside = ~(surfaces["base"] | surfaces["tip"] | np.isin(faces[:, 0], np.concatenate([*inner, faces[:0, 0]])))
    return {**{name: faces[chosen] for name, chosen in surfaces.items()}, "outside": faces[outside], **chambers}


def _hexahedra(geometry: ArmGeometry, size: float, layer: float) -> Mesh:
    """Sweeps the section along the arm, without the quadrilaterals inside chambers."""
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
    solid = np.concatenate([block for block, number in zip(quads, chamber, strict=True) if number == SOLID])
    full = np.concatenate(quads)
    turn = np.exp(1j * pi / 180.0 * (geometry.rotations[0] if geometry.rotations else 0.0))
    heights = np.concatenate(
        [[0.0], *(np.linspace(a, b, n + 1)[1:] for a, b, n in zip(stations, stations[1:], counts, strict=False))]
    )
    vertices = np.empty((len(heights), len(place), 3))
    for level, height in enumerate(heights):
        section = geometry.section(geometry.radius_at(float(height)))
        points = turn * np.concatenate([grid.ravel() for grid in section_grids(section, divisions)[0]])[place]
        vertices[level] = np.stack([points.real, points.imag, np.full(len(points), height)], axis=1)
    cells = []
    for level, part in enumerate(np.repeat(np.arange(len(counts)), counts)):
        upper = len(place) * level + (full if part % 2 == 0 else solid)  # caps and chambers alternate
        cells.append(np.concatenate([upper + len(place), upper], axis=1))
    used, numbered = np.unique(np.concatenate(cells), return_inverse=True)
    return Mesh(vertices.reshape(-1, 3)[used], numbered.reshape(-1, 8))


def tetrahedra(geometry: ArmGeometry, size: float) -> Mesh:
    """Returns an arm of 4-node tetrahedra of a given size [m], with vertices numbered from the base down.

    Raises:
        MeshError: gmsh is missing or fails.
    """
    return tetrahedra_by_gmsh(lambda gmsh: _build(gmsh.model.occ, geometry, size), size, "an arm")


def _build(occ: Any, geometry: ArmGeometry, size: float) -> None:
    """Builds the body, lofted along caps and segments, with the chambers cut out."""
    heights = geometry.stations
    divisions = geometry.section(0.5 * (geometry.radii[0] + geometry.radii[-1])).divisions(size)
    sections = [geometry.section(geometry.radius_at(height)) for height in heights]
    body, chambers = [], []
    for part, (top, bottom) in enumerate(pairwise(heights)):
        ends = [(sections[part], top), (sections[part + 1], bottom)]
        body.append(_loft(occ, [(section.body_polygon(divisions), height, 0.0) for section, height in ends]))
        if part % 2 == 1:
            rotation = math.radians(geometry.rotations[part // 2]) if geometry.rotations else 0.0
            for number in range(geometry.chambers):
                angle = rotation + 2.0 * math.pi * number / geometry.chambers
                chambers.append(_loft(occ, [(s.chamber_polygon(divisions), height, angle) for s, height in ends]))
    fused, _ = occ.fuse(body[:1], body[1:])
    occ.cut(fused, chambers)
    occ.synchronize()


def _loft(occ: Any, ends: Sequence[tuple[ComplexArray, float, float]]) -> tuple[int, int]:
    """Returns a solid between two polygons with given heights [m] and angles about the axis [rad]."""
    wires = []
    for polygon, height, angle in ends:
        tags = [occ.addPoint(point.real, point.imag, height) for point in polygon * cmath.exp(1j * angle)]
        wires.append(occ.addWire([occ.addLine(a, b) for a, b in zip(tags, tags[1:] + tags[:1], strict=True)]))
    ((dimension, tag),) = (e for e in occ.addThruSections(wires, makeSolid=True, makeRuled=True) if e[0] == 3)
    return dimension, tag
