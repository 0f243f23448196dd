"""Meshes of parametric pneumatic arms.

An arm is clamped at z = 0 and hangs along -z. `mesh_arm` fills it with hexahedra, or with
tetrahedra by gmsh.
"""

import cmath
import math
from collections.abc import Sequence
from itertools import pairwise
from math import pi
from typing import Any

import numpy as np

from ...io.arrays import IntArray
from ...io.errors import MeshError
from .arm_dimensions import ArmMesh
from .arm_section import SOLID, ComplexArray, Section
from .chambers import find_chambers
from .elements import BY_NODES
from .section_grids import section_grids, section_quadrilaterals
from .tetrahedra import tetrahedra_by_gmsh
from .volume_mesh import Mesh, boundary_faces, check_mesh

_SLENDER = 2.5  # default height of a layer of hexahedra over their size in the section
_MOST_CELLS = 2_000_000


def stations_of(arm: ArmMesh) -> list[float]:
    """Returns the heights of the ends of caps and chambers, from 0 at the base down to the tip [m].

    An even number.
    """
    parts = [arm.caps[0]]
    for chamber, cap in zip(arm.chamber_lengths, arm.caps[1:], strict=True):
        parts += [chamber, cap]
    return [0.0, *(-np.cumsum(parts)).tolist()]


def section_of(arm: ArmMesh, radius: float) -> Section:
    """Returns the unrotated cross-section with a given outline radius [m]."""
    core, bore = (
        None if size is None else size * radius / arm.radii[0] for size in (arm.core, arm.bore)
    )
    return Section(radius, arm.chambers, arm.profile, arm.outline, arm.wall, arm.web, core, bore)


def section_at(arm: ArmMesh, height: float) -> Section:
    """Returns the unrotated cross-section at a height [m],
    which is 0 at the base and negative below.
    """
    ends = np.array(stations_of(arm)[1:-1])
    return section_of(arm, float(np.interp(-height, -ends, np.repeat(arm.radii, 2)[1:-1])))


def mesh_arm(arm: ArmMesh) -> tuple[Mesh, dict[str, IntArray]]:
    """Meshes an arm with hexahedra, or with 4-node tetrahedra,
    to which `volume_mesh.quadratic` adds the midpoints.

    Hexahedra are blocks of quadrilaterals swept along the arm: every wall is at least one element
    thick, and the corners of the chambers are preserved. Curves are replaced by polygons of the
    same area, so that even coarse chambers have the correct volume; their corners lie outside the
    curves by up to a fifteenth of the radius.

    Returns:
        The mesh, with vertices numbered from the base to the tip, and its surfaces by name
        (`name_surfaces`).

    Raises:
        MeshError: chambers that do not fit, a size that would give millions of cells, hexahedra for
            rotated segments, or a missing or failing gmsh.
    """
    for radius in arm.radii:
        section_of(arm, radius).check()
    mesh = tetrahedra(arm) if arm.cells == "tetrahedra" else _hexahedra(arm)
    check_mesh(mesh)
    return mesh, name_surfaces(mesh)


def name_surfaces(mesh: Mesh) -> dict[str, IntArray]:
    """Returns the surfaces of an arm that hangs along -z, by name.

    Returns:
        (F, 3 | 4 | 6) faces as from `boundary_faces`: ``base`` and ``tip`` in the planes of the
        highest and lowest vertices, ``chamber_1`` and so on as from `chambers.find_chambers`, and
        ``outside``, the rest.
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
    outside = ~(
        surfaces["base"]
        | surfaces["tip"]
        | np.isin(faces[:, 0], np.concatenate([*inner, faces[:0, 0]]))
    )
    return {
        **{name: faces[chosen] for name, chosen in surfaces.items()},
        "outside": faces[outside],
        **chambers,
    }


def _hexahedra(arm: ArmMesh) -> Mesh:
    """Sweeps the section along the arm, without the quadrilaterals inside chambers."""
    if len({angle % (360.0 / arm.chambers) for angle in arm.rotations}) > 1:
        raise MeshError(
            "segments that are rotated against each other cannot be swept: "
            "set the arm's cells to tetrahedra."
        )
    size, layer = arm.size, _SLENDER * arm.size if arm.layers is None else arm.layers
    middle = section_of(arm, 0.5 * (arm.radii[0] + arm.radii[-1]))
    order, cells_along = 1 if arm.nodes == 8 else 2, middle.divisions(size)
    divisions = {edge: order * number for edge, number in cells_along.items()}
    stations = np.array(stations_of(arm))
    counts = np.maximum(1, np.round(-np.diff(stations) / layer).astype(int))
    if (
        len(list(middle.blocks())) * int(counts.sum()) * max(cells_along.values()) ** 2
        > _MOST_CELLS
    ):
        raise MeshError(
            f"with size {size:g} m, the arm would have more than {_MOST_CELLS} cells: "
            "enlarge size or layers."
        )
    grids, chamber = section_grids(middle, divisions, order)
    place, quads = section_quadrilaterals(grids, order)
    solid = np.concatenate(
        [block for block, number in zip(quads, chamber, strict=True) if number == SOLID]
    )
    full = np.concatenate(quads)
    turn = np.exp(1j * pi / 180.0 * (arm.rotations[0] if arm.rotations else 0.0))
    heights = np.concatenate(
        [
            [0.0],
            *(
                np.linspace(a, b, order * n + 1)[1:]
                for a, b, n in zip(stations, stations[1:], counts, strict=False)
            ),
        ]
    )
    vertices = np.empty((len(heights), len(place), 3))
    for level, height in enumerate(heights):
        section = section_at(arm, float(height))
        points = (
            turn
            * np.concatenate(
                [grid.ravel() for grid in section_grids(section, divisions, order)[0]]
            )[place]
        )
        vertices[level] = np.stack([points.real, points.imag, np.full(len(points), height)], axis=1)
    x, y, z = np.round((BY_NODES[arm.nodes].shape.nodes.T + 1.0) / 2.0 * order).astype(np.int64)
    cells = []
    for layer, part in enumerate(np.repeat(np.arange(len(counts)), counts)):
        quad = full if part % 2 == 0 else solid  # caps and chambers alternate
        cells.append(len(place) * (order * (layer + 1) - z) + quad[:, x, y])
    used, numbered = np.unique(np.concatenate(cells), return_inverse=True)
    return Mesh(vertices.reshape(-1, 3)[used], numbered.reshape(-1, arm.nodes))


def tetrahedra(arm: ArmMesh) -> Mesh:
    """Returns an arm of 4-node tetrahedra, with vertices numbered from the base down.

    Raises:
        MeshError: gmsh is missing or fails.
    """
    return tetrahedra_by_gmsh(lambda gmsh: _build(gmsh.model.occ, arm), arm.size, "an arm")


def _build(occ: Any, arm: ArmMesh) -> None:
    """Builds the body, lofted along caps and segments, with the chambers cut out."""
    heights = stations_of(arm)
    divisions = section_of(arm, 0.5 * (arm.radii[0] + arm.radii[-1])).divisions(arm.size)
    sections = [section_at(arm, height) for height in heights]
    body, chambers = [], []
    for part, (top, bottom) in enumerate(pairwise(heights)):
        ends = [(sections[part], top), (sections[part + 1], bottom)]
        body.append(
            _loft(occ, [(section.body_polygon(divisions), height, 0.0) for section, height in ends])
        )
        if part % 2 == 1:
            rotation = math.radians(arm.rotations[part // 2]) if arm.rotations else 0.0
            for number in range(arm.chambers):
                angle = rotation + 2.0 * math.pi * number / arm.chambers
                chambers.append(
                    _loft(
                        occ, [(s.chamber_polygon(divisions), height, angle) for s, height in ends]
                    )
                )
    fused, _ = occ.fuse(body[:1], body[1:])
    occ.cut(fused, chambers)
    occ.synchronize()


def _loft(occ: Any, ends: Sequence[tuple[ComplexArray, float, float]]) -> tuple[int, int]:
    """A solid between two polygons with given heights [m] and angles about the axis [rad]."""
    wires = []
    for polygon, height, angle in ends:
        tags = [
            occ.addPoint(point.real, point.imag, height)
            for point in polygon * cmath.exp(1j * angle)
        ]
        wires.append(
            occ.addWire([occ.addLine(a, b) for a, b in zip(tags, tags[1:] + tags[:1], strict=True)])
        )
    ((dimension, tag),) = (
        e for e in occ.addThruSections(wires, makeSolid=True, makeRuled=True) if e[0] == 3
    )
    return dimension, tag
