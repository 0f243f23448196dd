"""Pneumatic arms of tetrahedra by gmsh (Geuzaine and Remacle 2009) with the OpenCASCADE kernel."""

import cmath
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from .arm_geometry import ArmGeometry
from .arm_section import ComplexArray
from .mesh import Mesh
from .tetrahedra import tetrahedra_by_gmsh


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
