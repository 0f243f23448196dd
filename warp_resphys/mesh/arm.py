"""Meshes of parametric pneumatic arms.

An arm is clamped at z = 0 and hangs along -z. `mesh_arm` fills it with hexahedra, or with tetrahedra by gmsh.
"""

from math import pi

import numpy as np

from ..io.errors import MeshError
from .arm_geometry import ArmGeometry, numbers
from .arm_section import SOLID, section_grids, section_quadrilaterals
from .arm_tetrahedra import tetrahedra
from .chambers import find_chambers
from .mesh import IntArray, Mesh, boundary_faces, check_mesh

CELLS = ("hexahedra", "tetrahedra")
_SLENDER = 2.5  # default height of a layer of hexahedra over their size in the section
_MOST_CELLS = 2_000_000


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
        cells: "hexahedra" or "tetrahedra" (4-node; `mesh.quadratic` adds the midpoints).
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
        (F, 3 | 4 | 6) faces as from `mesh.boundary_faces`: ``base`` and ``tip`` in the planes of the highest and lowest
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
    inner = [own.ravel() for own in chambers.values()]
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
