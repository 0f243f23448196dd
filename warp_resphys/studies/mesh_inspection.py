"""What there is to know about a mesh before it is simulated, and the commands that say it and make an arm."""

from pathlib import Path
from typing import Final

import numpy as np

from ..experiment.build import build_mesh
from ..io.errors import MeshError
from ..io.settings import parse
from ..mesh.arm import mesh_arm, name_surfaces
from ..mesh.arm_geometry import arm_geometry
from ..mesh.cavities import MOST_TRIANGLES, open_cavities
from ..mesh.chambers import find_chambers
from ..mesh.mesh import FloatArray, Mesh, Place, boundary_triangles, connected_parts, quadratic, select_vertices
from ..mesh.quality import scaled_jacobian
from ..mesh.readers import read_mesh, read_surfaces, read_vertices, write_mesh
from ..report.body_picture import MeshSummary, draw_mesh
from ..settings.body import FileMesh, GeneratedArm, MeshGroup
from .command import aligned
from .inspection import Arm, Inspection

_MILLI: Final = 1e3
_CUBIC_CENTI: Final = 1e6


def make_arm(arm: Arm, folder: Path) -> str:
    """Generates an arm, writes the mesh and a picture, and returns a table.

    Raises:
        ResphysError: A setting of the wrong kind, or an arm that cannot be made.
    """
    settings = parse(GeneratedArm, arm.mesh, "mesh").plain()
    if settings["order"] not in (1, 2) or (settings["order"] == 2 and settings["cells"] != "tetrahedra"):
        raise MeshError(f"mesh.order is {settings['order']!r}: choose 1, or 2 for tetrahedra with edge midpoints.")
    mesh, surfaces = mesh_arm(arm_geometry(settings), settings["size"], settings["cells"], settings["layers"])
    if settings["order"] == 2:
        mesh = quadratic(mesh)
        surfaces = name_surfaces(mesh)
    write_mesh(folder / arm.file, mesh, surfaces)
    summary = MeshSummary(mesh, arm.density, np.unique(surfaces["base"]), find_chambers(mesh))
    if arm.picture:
        draw_mesh(folder / "arm.png", summary)
    return aligned([*summary_rows(summary), ("clamped at the base", f"{len(summary.fixed)} vertices")], left=2)


def inspect_mesh(settings: Inspection, folder: Path) -> str:
    """Returns a table of what is in a mesh, and draws it.

    Raises:
        ResphysError: A setting of the wrong kind, a file that cannot be read, or a mesh that cannot be simulated.
    """
    rows: list[tuple[str, str]] = []
    read = settings.mesh["kind"] == "file"
    if read:
        own = parse(FileMesh, settings.mesh, "mesh")
        path, units, order = own.path, own.units, own.order
        points = read_vertices(path, units)
        mesh = read_mesh(path, units, order, drop_unreferenced=True)
        unused = len(points) - len(read_mesh(path, units, drop_unreferenced=True).vertices)
        rows.append(("vertices in the file", f"{len(points):,} = {3 * len(points):,} degrees of freedom"))
        if unused:
            rows.append(("of these unused", f"{unused} belong to no cell; drop_unreferenced leaves them out"))
        surfaces = read_surfaces(path, units, order, True)
        names = ", ".join(f"{name} ({len(faces)})" for name, faces in surfaces.items())
    else:
        given = {key: each for key, each in settings.mesh.items() if (key, each) != ("path", None)}
        mesh = build_mesh(parse(MeshGroup, {"mesh": given}).mesh)
        points = mesh.vertices
    chosen = {axis: at for axis, at in settings.fixed.items() if at is not None and axis != "tolerance"}
    place = Place(**settings.fixed) if chosen else None
    fixed = np.empty(0, dtype=np.int64) if place is None else select_vertices(mesh, **settings.fixed)
    summary = MeshSummary(mesh, settings.density, fixed, find_chambers(mesh))
    rows += summary_rows(summary)
    if place is not None:
        rows.append(("fixed", f"{place.holds(points).sum()} vertices at {place} m, {len(fixed)} of them used"))
    if read:
        rows.append(("surfaces with a name", names or "none"))
    rows.append(("open cavities", _cavities(mesh)))
    if settings.picture:
        draw_mesh(folder / "mesh.png", summary)
    return aligned(rows, left=2)


def _cavities(mesh: Mesh) -> str:
    """What there is to say of cavities that are open."""
    found = open_cavities(mesh)
    if found is None:
        return f"not looked for on a boundary of more than {MOST_TRIANGLES:,} triangles"
    places = [f"{1e4 * cavity.area:.1f} cm2 around ({_millimetres(cavity.centre)}) mm" for cavity in found]
    return f"{'; '.join(places)}: pressure needs a closed chamber" if places else "none"


def _millimetres(point: FloatArray) -> str:
    return ", ".join(f"{_MILLI * x:.1f}" for x in point)


def summary_rows(summary: MeshSummary) -> list[tuple[str, str]]:
    """Names and values of a table."""
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
