"""The command `inspect`: tables and pictures of a mesh and of recordings."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import model_validator

from ..core.dynamics.mesh_error import NOTICED
from ..core.dynamics.simulator import Simulator
from ..core.energies.materials import Corotated
from ..core.fem.bodies import Body
from ..core.mesh.arm import name_surfaces
from ..core.mesh.arm_dimensions import ArmMesh
from ..core.mesh.chambers import find_chambers, open_cavities
from ..core.mesh.place import Place
from ..core.mesh.quality import cell_volumes, is_one_cell_thick, scaled_jacobian
from ..core.mesh.readers import read_mesh, read_surfaces, read_vertices, write_mesh
from ..core.mesh.selection import vertices_at
from ..core.mesh.tetrahedra import SURFACE_SUFFIXES
from ..core.mesh.volume_mesh import Mesh, boundary_triangles, connected_parts, quadratic
from ..data.recordings.bag import is_bag
from ..data.recordings.recording_files import READERS
from ..experiment.build import build_mesh
from ..io.arrays import FloatArray, IntArray
from ..io.errors import InputError, MeshError
from ..io.progress import aligned
from ..io.settings import Many, Positive, Word, setting
from ..report.body_picture import MeshSummary, mesh_picture
from ..settings.meshing import FileMesh, MeshSettings, SurfaceMesh
from .recording_quality import RecordingInspection, inspect_recording

_MOST_UNKNOWNS: Final = 40_000  # of quadratic cells, which are solved in some seconds
_SILICONE: Final = Corotated(1e5, 0.49)
_HELD: Final = 0.05  # of its length, at the end of a body without fixed vertices
_PERCENT: Final = 100.0
_MILLI: Final = 1e3
_CUBIC_CENTI: Final = 1e6


class Inspection(RecordingInspection):
    """The configuration ``inspect``, which explains its keys."""

    files: Many[Word]
    mesh: MeshSettings | None
    fixed: Place
    density: Positive = setting(unit="kg/m^3")
    picture: bool
    save: Word | None

    @model_validator(mode="before")
    @classmethod
    def _sort_files(cls, values: Any) -> Any:
        """Moves ``files`` to their keys: the first recording,
        others to compare it with, and a mesh or surface.
        """
        if not isinstance(values, Mapping) or not isinstance(values["mesh"], Mapping):
            return values
        files = values["files"] if isinstance(values["files"], list) else []
        recordings = [
            file
            for file in files
            if Path(str(file)).suffix.lower() in READERS or is_bag(Path(str(file)))
        ]
        meshes = [file for file in files if file not in recordings]
        if len(meshes) > 1:
            raise ValueError(f"{meshes[0]} and {meshes[1]} are two meshes: name one at a time.")
        mesh, changed = {**values["mesh"], **({"path": meshes[0]} if meshes else {})}, dict(values)
        if recordings:
            changed["recording"] = {**values["recording"], "path": recordings[0]}
            changed["compare_with"] = [*values["compare_with"], *recordings[1:]]
        if (
            mesh["kind"] == "file"
            and Path(str(mesh.get("path"))).suffix.lower() in SURFACE_SUFFIXES
        ):
            mesh = {
                key: value for key, value in mesh.items() if key in SurfaceMesh.model_fields
            } | {"kind": "surface"}
        if mesh.get("path") is None:
            # The key is there for every kind of mesh, but only some have files.
            mesh.pop("path", None)
        changed["mesh"] = None if mesh["kind"] == "file" and "path" not in mesh else mesh
        return changed


def inspect(settings: Inspection, folder: Path) -> None:
    """Prints tables.

    Writes quality.json and quality.png of a recording, mesh.png of a mesh, and the mesh.

    Raises:
        ResphysError: nothing was named, or it cannot be used.
    """
    if settings.mesh is None and settings.recording.path is None:
        raise InputError(
            "nothing to inspect: name a mesh or a recording, as in warp-resphys inspect FILE."
        )
    if settings.recording.path is not None:
        print(inspect_recording(settings, folder))
        print(f"Written: {folder / 'quality.json'}, {folder / 'quality.png'}")
    if settings.mesh is not None:
        picture = folder / "mesh.png" if settings.picture else None
        file = None if settings.save is None else folder / settings.save
        print(inspect_mesh(settings.mesh, settings.fixed, settings.density, picture, file))
        written = [str(path) for path in (file, picture) if path is not None]
        if written:
            print(f"Written: {', '.join(written)}")


def inspect_mesh(
    settings: MeshSettings, fixed: Place, density: float, picture: Path | None, file: Path | None
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
        path, units = settings.path, settings.units
        points = read_vertices(path, units)
        mesh = read_mesh(path, units, settings.order, drop_unreferenced=True)
        unused = len(points) - len(read_mesh(path, units, drop_unreferenced=True).vertices)
        rows.append(
            ("vertices in the file", f"{len(points):,} = {3 * len(points):,} degrees of freedom")
        )
        if unused:
            how = "left out of .msh and .inp, and elsewhere by drop_unreferenced"
            rows.append(("of these unused", f"{unused} belong to no cell: {how}"))
        surfaces = read_surfaces(path, units, settings.order, True)
    else:
        mesh = build_mesh(settings)
        points = mesh.vertices
    place = fixed if fixed.spans else None
    vertices = np.empty(0, dtype=np.int64) if place is None else vertices_at(mesh, place)
    summary = MeshSummary(mesh, vertices, find_chambers(mesh))
    rows += summary_rows(summary, density)
    if place is not None:
        rows.append(
            (
                "fixed",
                f"{place.holds(points).sum()} vertices at {place} m, {len(vertices)} of them used",
            )
        )
    if isinstance(settings, FileMesh):
        names = ", ".join(f"{name} ({len(faces)})" for name, faces in surfaces.items())
        rows.append(("surfaces with a name", names or "none"))
        names = ", ".join(f"{name} ({len(cells)})" for name, cells in mesh.regions.items())
        rows.append(("regions", names or "none"))
    rows.append(("open cavities", _cavities(mesh)))
    if not mesh.element.parents:
        rows.append(("quadratic cells", _quadratic_cells(mesh, place)))
        thin = [name for name, cells in mesh.regions.items() if is_one_cell_thick(mesh, cells)]
        if thin:
            rows.append(
                (
                    "one cell thick",
                    f"{', '.join(thin)}: if stiffer than the rest, take quadratic cells",
                )
            )
    if file is not None:
        if isinstance(settings, ArmMesh):
            if settings.order == 2 and settings.cells != "tetrahedra":
                raise MeshError(
                    "mesh.order is 2: choose 1, or 2 for tetrahedra with edge midpoints."
                )
            surfaces = name_surfaces(mesh)
        write_mesh(file, mesh, surfaces)
    if picture is not None:
        views = mesh_picture(summary)
        views.save(picture, views.draw())
    return aligned(rows, left=2)


def _quadratic_cells(mesh: Mesh, fixed: Place | None) -> str:
    """Returns how much quadratic cells change the deflection under the weight,
    across the longest side of a body.

    Args:
        mesh: of linear cells.
        fixed: where the body is held; None: at an end.
    """
    along, *across = np.argsort(-np.ptp(mesh.vertices, axis=0))
    end = mesh.vertices[:, along].min() + _HELD * np.ptp(mesh.vertices[:, along])
    base = mesh.vertices[:, along] <= end if fixed is None else fixed.holds(mesh.vertices)
    finer, work = quadratic(mesh), []
    if finer.vertices.size > _MOST_UNKNOWNS:
        return f"not compared: they have {finer.vertices.size:,} degrees of freedom"
    connected = connected_parts(mesh.cells)
    pieces = [np.unique(mesh.cells[connected == number]) for number in np.unique(connected)]
    if base.all() or not all(_spans_area(mesh.vertices[piece[base[piece]]]) for piece in pieces):
        return "not compared: a piece is not held, or all of it"
    # Nodes between held vertices are held, too.
    between = (
        quadratic(
            Mesh(np.repeat(base[:, None], 3, axis=1).astype(np.float64), mesh.cells)
        ).vertices[:, 0]
        == 1.0
    )
    for compared, still in ((mesh, base), (finer, between)):
        simulator = Simulator(Body(compared, fixed=np.flatnonzero(still)), _SILICONE)
        step = simulator.linearise_equilibrium()
        step.factorise(simulator.rest_positions[None])
        masses = simulator.prepare().load_mass[0]
        pulls = masses[:, None, None] * simulator.tensor(np.eye(3)[:, across])  # (N, 3, 2)
        moved = step.solve(pulls.flatten(0, 1)[None])[0].unflatten(0, (-1, 3))
        work.append((pulls * moved).sum((0, 1)).numpy())
    change = float(max(work[1] / work[0] - 1.0, key=abs))
    where = f"at the lower end along {'xyz'[along]}" if fixed is None else f"at {fixed} m"
    return (
        f"sag {_PERCENT * abs(change):.0f} % {'more' if change > 0.0 else 'less'} under their "
        f"weight, held {where}{': these cells are too coarse' if abs(change) > NOTICED else ''}"
    )


def _spans_area(points: FloatArray) -> bool:
    """Whether three points of (n, 3) are not in a line,
    by which a body that is held there cannot turn.
    """
    return len(points) > 2 and bool(np.linalg.svd(points - points.mean(axis=0))[1][1] > 1e-9)


def _cavities(mesh: Mesh) -> str:
    """Describes open cavities: area and centre of their openings."""
    places = [
        f"{1e4 * cavity.area:.1f} cm2 around ({_millimetres(cavity.centre)}) mm"
        for cavity in open_cavities(mesh)
    ]
    if not places:
        return "none"
    return (
        f"{'; '.join(places)}: pressure needs a closed chamber, "
        "or faces with held edges (chambers.faces)"
    )


def _millimetres(point: FloatArray) -> str:
    return ", ".join(f"{_MILLI * x:.1f}" for x in point)


def summary_rows(summary: MeshSummary, density: float) -> list[tuple[str, str]]:
    """Rows of a table: sizes, mass, quality and chambers of a mesh."""
    mesh, (width, depth, height) = summary.mesh, _MILLI * np.ptp(summary.mesh.vertices, axis=0)
    volume = float(cell_volumes(mesh).sum())
    body, boundary = (
        connected_parts(cells).max() + 1 for cells in (mesh.cells, boundary_triangles(mesh))
    )
    rows = [
        ("vertices", f"{len(mesh.vertices):,} = {mesh.vertices.size:,} degrees of freedom"),
        ("cells", f"{len(mesh.cells):,} of kind {mesh.kind}"),
        (
            "bounding box",
            f"{width:.1f} x {depth:.1f} x {height:.1f} mm from "
            f"({_millimetres(mesh.vertices.min(axis=0))}) mm",
        ),
        ("volume", f"{_CUBIC_CENTI * volume:.1f} cm3"),
        ("mass", f"{1e3 * volume * density:.1f} g at {density:g} kg/m3"),
        ("smallest scaled Jacobian", f"{scaled_jacobian(mesh).min():.3f} (1 is ideal, 0 is flat)"),
        ("pieces", f"{body} of the body, {boundary} of its boundary"),
    ]
    for chamber in summary.chambers:
        centre = _millimetres(mesh.vertices[chamber.vertices].mean(axis=0))
        inside = _CUBIC_CENTI * summary.chamber_volume(chamber)
        rows.append(
            (chamber.name, f"{len(chamber.faces)} faces, {inside:.2f} cm3, centre ({centre}) mm")
        )
    if not summary.chambers:
        rows.append(("chambers", "none is closed"))
    return rows
