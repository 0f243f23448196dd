"""Properties of a mesh as a table and a picture; a generated arm as a file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from ..experiment.build import build_mesh
from ..io.errors import MeshError
from ..mesh.arm import name_surfaces
from ..mesh.cavities import open_cavities
from ..mesh.chambers import find_chambers
from ..mesh.mesh import FloatArray, IntArray, Mesh, Place, boundary_triangles, connected_parts, select_vertices
from ..mesh.quality import scaled_jacobian
from ..mesh.readers import read_mesh, read_surfaces, read_vertices, write_mesh
from ..report.body_picture import MeshSummary, draw_mesh
from ..settings.mesh import FileMesh, GeneratedArm, MeshSettings, PlaceSettings
from .tables import aligned

_MILLI: Final = 1e3
_CUBIC_CENTI: Final = 1e6


def inspect_mesh(
    settings: MeshSettings, fixed: PlaceSettings, density: float, picture: Path | None, file: Path | None
) -> str:
    """Returns a table of a mesh, draws it, and writes it with the names of its surfaces.

    Args:
        settings: the group ``mesh``.
        fixed: vertices that are counted and drawn; nothing for none.
        density: for the mass [kg/m^3].
        picture: PNG file; None draws nothing.
        file: of the mesh; None writes nothing.

    Raises:
        ResphysError: a file that cannot be read or written, or a mesh that cannot be simulated.
    """
    rows: list[tuple[str, str]] = []
    surfaces: Mapping[str, IntArray] = {}
    if isinstance(settings, FileMesh):
        path, units, order = settings.path, settings.units, settings.order
        points = read_vertices(path, units)
        mesh = read_mesh(path, units, order, drop_unreferenced=True)
        unused = len(points) - len(read_mesh(path, units, drop_unreferenced=True).vertices)
        rows.append(("vertices in the file", f"{len(points):,} = {3 * len(points):,} degrees of freedom"))
        if unused:
            rows.append(("of these unused", f"{unused} belong to no cell; drop_unreferenced leaves them out"))
        surfaces = read_surfaces(path, units, order, True)
    else:
        mesh = build_mesh(settings)
        points = mesh.vertices
    where = fixed.arguments()
    place = Place(**where) if where.keys() & {"x", "y", "z"} else None
    vertices = np.empty(0, dtype=np.int64) if place is None else select_vertices(mesh, **where)
    summary = MeshSummary(mesh, density, vertices, find_chambers(mesh))
    rows += summary_rows(summary)
    if place is not None:
        rows.append(("fixed", f"{place.holds(points).sum()} vertices at {place} m, {len(vertices)} of them used"))
    if isinstance(settings, FileMesh):
        names = ", ".join(f"{name} ({len(faces)})" for name, faces in surfaces.items())
        rows.append(("surfaces with a name", names or "none"))
    rows.append(("open cavities", _cavities(mesh)))
    if file is not None:
        if isinstance(settings, GeneratedArm):
            if settings.order == 2 and settings.cells != "tetrahedra":
                raise MeshError("mesh.order is 2: choose 1, or 2 for tetrahedra with edge midpoints.")
            surfaces = name_surfaces(mesh)
        write_mesh(file, mesh, surfaces)
    if picture is not None:
        draw_mesh(picture, summary)
    return aligned(rows, left=2)


def _cavities(mesh: Mesh) -> str:
    """Describes open cavities: area and centre of their openings."""
    places = [
        f"{1e4 * cavity.area:.1f} cm2 around ({_millimetres(cavity.centre)}) mm" for cavity in open_cavities(mesh)
    ]
    return f"{'; '.join(places)}: pressure needs a closed chamber" if places else "none"


def _millimetres(point: FloatArray) -> str:
    return ", ".join(f"{_MILLI * x:.1f}" for x in point)


def summary_rows(summary: MeshSummary) -> list[tuple[str, str]]:
    """Rows of a table: sizes, mass, quality and chambers of a mesh."""
    mesh, (width, depth, height) = summary.mesh, _MILLI * np.ptp(summary.mesh.vertices, axis=0)
    body, boundary = (connected_parts(cells).max() + 1 for cells in (mesh.cells, boundary_triangles(mesh)))
    rows = [
        ("vertices", f"{len(mesh.vertices):,} = {mesh.vertices.size:,} degrees of freedom"),
        ("cells", f"{len(mesh.cells):,} of kind {mesh.kind}"),
        (
            "bounding box",
            f"{width:.1f} x {depth:.1f} x {height:.1f} mm from ({_millimetres(mesh.vertices.min(axis=0))}) mm",
        ),
        ("volume", f"{_CUBIC_CENTI * summary.volume:.1f} cm3"),
        ("mass", f"{1e3 * summary.volume * summary.density:.1f} g at {summary.density:g} kg/m3"),
        ("smallest scaled Jacobian", f"{scaled_jacobian(mesh).min():.3f} (1 is ideal, 0 is flat)"),
        ("pieces", f"{body} of the body, {boundary} of its boundary"),
    ]
    for chamber in summary.chambers:
        centre = _millimetres(mesh.vertices[chamber.vertices].mean(axis=0))
        volume = _CUBIC_CENTI * summary.chamber_volume(chamber)
        rows.append((chamber.name, f"{len(chamber.faces)} faces, {volume:.2f} cm3, centre ({centre}) mm"))
    if not summary.chambers:
        rows.append(("chambers", "none is closed"))
    return rows
