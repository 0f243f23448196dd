"""Pneumatic arms of tetrahedra, made by gmsh (Geuzaine and Remacle 2009) with the OpenCASCADE kernel."""

import cmath
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from ..io.errors import MeshError
from .arm_geometry import ArmGeometry
from .arm_section import ComplexArray
from .mesh import Mesh

_TETRAHEDRON = 4  # gmsh's number of the 4-node tetrahedron


def tetrahedra(geometry: ArmGeometry, size: float) -> Mesh:
    """Meshes an arm with 4-node tetrahedra of a size [m]: the body, lofted along caps and segments, less its chambers.

    Vertices are numbered from the base down.

    Raises:
        MeshError: there is no gmsh, or it fails.
    """
    try:
        import gmsh
    except (ImportError, OSError) as error:  # OSError: a system library that gmsh needs is missing
        raise MeshError(
            f"arms of tetrahedra need gmsh, which cannot be imported ({error}): install it with pip install gmsh, or "
            "mesh the arm with hexahedra."
        ) from error
    if gmsh.isInitialized():
        raise MeshError("gmsh is in use in this process: call gmsh.finalize() before an arm is meshed.")
    gmsh.initialize(interruptible=False)  # so that Ctrl-C stays Python's
    try:
        for option, value in (
            *(("General.Terminal", 0), ("General.NumThreads", 1)),
            *(("Mesh.MeshSizeMax", size), ("Mesh.MeshSizeMin", 0.5 * size)),
            ("Mesh.Algorithm3D", 1),  # Delaunay, the same mesh every time
            ("Mesh.OptimizeThreshold", 0.6),  # of the quality below which tetrahedra are improved
        ):
            gmsh.option.setNumber(option, value)
        _build(gmsh.model.occ, geometry, size)
        gmsh.model.mesh.generate(3)
        tags, coordinates, _ = gmsh.model.mesh.getNodes()
        _, nodes = gmsh.model.mesh.getElementsByType(_TETRAHEDRON)
    except Exception as error:  # gmsh raises nothing more special
        raise MeshError(f"gmsh cannot mesh this arm ({error}): try another size, or thicker walls.") from error
    finally:
        gmsh.finalize()
    if not len(nodes):
        raise MeshError("gmsh made no tetrahedra of this arm: try another size, or thicker walls.")
    places = np.zeros(int(tags.max()) + 1, dtype=np.int64)
    places[tags.astype(np.int64)] = np.arange(len(tags))
    return _ordered(coordinates.reshape(-1, 3), places[nodes.astype(np.int64)].reshape(-1, 4))


def _build(occ: Any, geometry: ArmGeometry, size: float) -> None:
    """Builds the body with its chambers cut out in the current model."""
    heights = geometry.stations
    divisions = geometry.section(0.5 * (geometry.radii[0] + geometry.radii[-1])).divisions(size)
    sections = [geometry.section(geometry.radius_at(height)) for height in heights]
    body, chambers = [], []
    for part, (top, bottom) in enumerate(pairwise(heights)):
        ends = [(sections[part], top), (sections[part + 1], bottom)]
        body.append(_loft(occ, [(each.body_polygon(divisions), height, 0.0) for each, height in ends]))
        if part % 2 == 1:
            rotation = math.radians(geometry.rotations[part // 2]) if geometry.rotations else 0.0
            for number in range(geometry.chambers):
                angle = rotation + 2.0 * math.pi * number / geometry.chambers
                chambers.append(_loft(occ, [(each.chamber_polygon(divisions), height, angle) for each, height in ends]))
    fused, _ = occ.fuse(body[:1], body[1:])
    occ.cut(fused, chambers)
    occ.synchronize()


def _loft(occ: Any, ends: Sequence[tuple[ComplexArray, float, float]]) -> tuple[int, int]:
    """A solid between two polygons, each with its height [m] and angle about the axis [rad]."""
    wires = []
    for polygon, height, angle in ends:
        tags = [occ.addPoint(point.real, point.imag, height) for point in polygon * cmath.exp(1j * angle)]
        wires.append(occ.addWire([occ.addLine(a, b) for a, b in zip(tags, tags[1:] + tags[:1], strict=True)]))
    ((dimension, tag),) = (each for each in occ.addThruSections(wires, makeSolid=True, makeRuled=True) if each[0] == 3)
    return dimension, tag


def _ordered(points: Any, cells: Any) -> Mesh:
    """The mesh of the vertices that cells use, numbered from the highest down, with cells in that order as well."""
    used = np.unique(cells)
    used = used[np.lexsort((points[used, 1], points[used, 0], -points[used, 2]))]
    number = np.empty(len(points), dtype=np.int64)
    number[used] = np.arange(len(used))
    renumbered = number[cells]
    return Mesh(points[used], renumbered[np.lexsort(np.sort(renumbered, axis=1).T[::-1])])
