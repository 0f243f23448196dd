"""Reading and writing of volume meshes and their named surfaces, with conversion to metres."""

import functools
import os
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from importlib import resources
from io import StringIO
from pathlib import Path

import numpy as np

from ...io.arrays import FloatArray, IntArray
from ...io.atomic import atomic_path
from ...io.decoding import MESH_READERS, Arrays, decode, mesh_arrays
from ...io.errors import DecodingError, MeshError, checks_types, warn
from .elements import ELEMENTS
from .volume_mesh import Mesh, boundary_faces, check_mesh, is_mirrored, quadratic

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}  # [m] length of one unit
SHORTEST_DIAGONAL, LONGEST_DIAGONAL = 1e-3, 10.0  # plausible diagonals of a body [m]

# Formats whose nodes have numbers. Files regularly have some without a volume cell: ends of curves,
# reference points.
_NUMBERED = (".msh", ".inp")
_CELL_TYPES = tuple(element.file_type for element in ELEMENTS.values())  # meshio's names
# Meshio's names of gmsh's group numbers.
_PHYSICAL, _GEOMETRICAL = "gmsh:physical", "gmsh:geometrical"


@checks_types
def read_mesh(
    path: str | os.PathLike[str], units: str = "m", order: int = 1, drop_unreferenced: bool = False
) -> Mesh:
    """Reads and checks a tetrahedral or hexahedral mesh of gmsh,
    Abaqus or any other format of meshio.

    Points, lines, surface cells and data fields of the file are ignored. Named volumes, that is
    gmsh's physical groups, the element sets of Abaqus or the cell sets of other formats, become the
    regions of the mesh. If all cells have a negative volume, the order of their nodes is reversed,
    with a warning.

    Args:
        path: The file; its extension determines the format.
        units: Unit of the coordinates in the file: "m", "cm" or "mm".
        order: 2 adds the edge midpoints to 4-node tetrahedra; 1 keeps the cells of the file.
        drop_unreferenced: Whether to drop vertices that belong to no volume cell, which are an
            error otherwise; in files of gmsh and Abaqus, they are always dropped.

    Returns:
        The mesh in metres. Vertices keep the file's order.

    Raises:
        MeshError: The file is missing or unreadable, has no volume cells or cells of several or
            unsupported kinds, fails `check_mesh`, is less than 1 mm or more than 10 m across; or an
            argument is unknown.
    """
    return _read(Path(path), units, order, drop_unreferenced)[0]


def read_vertices(path: str | os.PathLike[str], units: str = "m") -> FloatArray:
    """Reads all vertices of a mesh file, (N, 3) [m], including those without a volume cell.

    Raises:
        MeshError: As in `read_mesh`.
    """
    return np.asarray(
        _read(Path(path), units, order=1, drop_unreferenced=True)[1]["points"] * METRES[units]
    )


def read_surfaces(
    path: str | os.PathLike[str], units: str = "m", order: int = 1, drop_unreferenced: bool = False
) -> dict[str, IntArray]:
    """Reads the named surfaces of a mesh file: gmsh's physical groups,
    or the cell sets of other formats.

    Returns:
        (F, 3 | 4 | 6) faces by name, as from `boundary_faces` of the mesh that `read_mesh` returns
        for the same arguments; empty without named surfaces. Those between two parts of the body
        are left out, with a warning.

    Raises:
        MeshError: As in `read_mesh`, or some faces of a named surface are not on the boundary of
            the body.
    """
    mesh, content, places = _read(Path(path), units, order, drop_unreferenced)
    faces = boundary_faces(mesh)
    corners = mesh.element.face.corners
    face_of = {frozenset(face): number for number, face in enumerate(faces[:, :corners].tolist())}
    surfaces = {}
    for name in (key.removeprefix("surface/") for key in content if key.startswith("surface/")):
        nodes = content[f"surface/{name}"]
        numbers = [face_of.get(frozenset(places[face].tolist())) for face in nodes]
        missing = numbers.count(None)
        if missing == len(numbers):
            warn(
                f"{path}: the surface {name!r} is left out, "
                "as no face of it is on the body's boundary"
            )
            continue
        if missing:
            raise MeshError(
                f"{path}: {missing} of {len(numbers)} faces of the surface {name!r} are not on "
                "the body's boundary; name surfaces that bound the volume, and mesh them with it"
            )
        surfaces[name] = faces[np.unique(np.array(numbers, dtype=np.int64))]
    return surfaces


def write_mesh(
    path: str | os.PathLike[str], mesh: Mesh, surfaces: Mapping[str, IntArray] | None = None
) -> None:
    """Writes a mesh in metres.

    Only gmsh's format .msh keeps regions and named surfaces (F, 3 | 4 | 6 | 8 | 9).

    Raises:
        MeshError: The extension is unknown to meshio, or the format does not support such cells.
        DataFileError: The file cannot be written.
    """
    import meshio

    path = Path(path)
    kind = mesh.element.file_type
    blocks = [(kind, mesh.cells)]
    groups = [np.zeros(len(mesh.cells), dtype=np.int64)]
    fields = {}
    as_gmsh = path.suffix.lower() == ".msh"
    if as_gmsh:
        groups[0] += 1
        for number, (name, cells) in enumerate(mesh.regions.items(), start=2):
            fields[name] = np.array([number, 3])
            again = cells[groups[0][cells] > 1]  # gmsh repeats a cell for each of its groups
            if len(again):
                blocks.append((kind, mesh.cells[again]))
                groups.append(np.full(len(again), number))
            groups[0][np.setdiff1d(cells, again)] = number
        if (groups[0] == 1).any():
            fields["body"] = np.array([1, 3])
        for number, (name, faces) in enumerate(
            (surfaces or {}).items(), start=2 + len(mesh.regions)
        ):
            fields[name] = np.array([number, 2])
            blocks.append(
                (
                    {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"}[
                        faces.shape[1]
                    ],
                    faces,
                )
            )
            groups.append(np.full(len(faces), number))
    formats = ["gmsh"] if as_gmsh else meshio.extension_to_filetypes.get(path.suffix.lower(), [])
    if not formats:
        raise MeshError(
            f"{path}: meshio does not know the extension {path.suffix!r}; use .msh, .vtu or .vtk"
        )
    data = {_PHYSICAL: groups, _GEOMETRICAL: groups} if as_gmsh else {}
    content = meshio.Mesh(mesh.vertices, blocks, cell_data=data, field_data=fields)
    try:
        with atomic_path(path) as target, redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            if as_gmsh:  # 2.2 is the version of which meshio writes the names of groups
                meshio.write(target, content, file_format="gmsh22", binary=False, float_fmt=".12g")
            else:
                meshio.write(target, content, file_format=formats[0])
            # Some formats silently drop unsupported cells.
            _volume_cells(mesh_arrays(str(target), formats[0]))
    except (
        meshio.WriteError,
        meshio.ReadError,
        MeshError,
        DecodingError,
        KeyError,
        SystemExit,
    ) as error:
        raise MeshError(
            f"{path}: meshio cannot write such a file ({error}); use .msh, .vtu or .vtk"
        ) from error


def _read(
    path: Path, units: str, order: int, drop_unreferenced: bool
) -> tuple[Mesh, Arrays, IntArray]:
    """Returns the mesh, the file's content, and the index
    in the mesh of each vertex of the file, -1 if dropped.
    """
    if units not in METRES:
        raise MeshError(f"the units of a mesh file must be one of {', '.join(METRES)}, not {units}")
    if order not in (1, 2):
        raise MeshError(f"the order of a mesh must be 1 or 2, not {order}")
    if not path.is_file():
        raise MeshError(f"{path}: there is no such mesh file")
    content = _read_file(path)
    try:
        regions = {
            k.removeprefix("region/"): cells
            for k, cells in content.items()
            if k.startswith("region/")
        }
        mesh = Mesh(content["points"], _volume_cells(content).copy(), regions)
        places = np.arange(len(mesh.vertices))
        used = np.unique(mesh.cells)
        drops = drop_unreferenced or path.suffix.lower() in _NUMBERED
        if drops and used[0] >= 0 and used[-1] < len(places):  # others are refused below
            places[:] = -1
            places[used] = np.arange(len(used))
            mesh = Mesh(mesh.vertices[used], places[mesh.cells], regions)
        check_mesh(mesh)
        mesh = Mesh(mesh.vertices * METRES[units], mesh.cells, regions)
        check_size(mesh.vertices, units)
        return (
            quadratic(mesh) if order == 2 and mesh.kind == mesh.element.linear else mesh,
            content,
            places,
        )
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


def _read_file(path: Path) -> Arrays:
    """Returns the arrays of a file (`decoding.mesh_arrays`).

    Only the package's own files are read in this process.
    """
    try:
        if path.parent.resolve() == Path(str(resources.files("warp_resphys") / "meshes")).resolve():
            return mesh_arrays(str(path))
        stat = path.stat()
        return _decoded(path.absolute(), stat.st_ino, stat.st_size, stat.st_mtime_ns)
    except DecodingError as error:
        if path.suffix.lower() in MESH_READERS:
            raise MeshError(f"{path}: {error}") from error
        raise MeshError(
            f"{path}: meshio cannot read this file ({error}); is it whole, and of its "
            "extension's format?"
        ) from error


@functools.lru_cache(maxsize=2)
def _decoded(path: Path, *_: int) -> Arrays:
    """Returns the arrays of a file, cached by its state:
    an experiment reads its mesh a dozen times, 0.3 s each.
    """
    arrays = decode("meshio", path)
    for element in ELEMENTS.values():
        cells = arrays.get(f"solid/{element.file_type}", np.empty((0, 0)))
        is_whole = cells.shape[1] == element.nodes and 0 <= cells.min() <= cells.max() < len(
            arrays["points"]
        )
        if is_whole and is_mirrored(Mesh(arrays["points"], cells)):
            warn(
                f"{path}: all {len(cells)} cells have a negative volume, so the order of their "
                "nodes is reversed"
            )
            arrays[f"solid/{element.file_type}"] = cells[:, element.mirrored]
    return arrays


def _volume_cells(arrays: Arrays) -> IntArray:
    """Returns the volume cells of a file (M, K).

    Raises MeshError unless there is exactly one supported kind.
    """
    solids = {
        name.removeprefix("solid/"): cells
        for name, cells in arrays.items()
        if name.startswith("solid/")
    }
    if not solids:
        if not len(arrays["types"]):
            raise MeshError("the file has no cells; save a mesh of the volume")
        others = ", ".join(sorted({*arrays["types"].tolist()}))
        raise MeshError(
            f"the file has no tetrahedra or hexahedra (only: {others}): mesh the inside of an "
            "STL, OBJ or PLY file by mesh=surface mesh.path=FILE"
        )
    if len(solids) > 1 or not solids.keys() <= {*_CELL_TYPES}:
        supported = f"{', '.join(_CELL_TYPES[:-1])} or {_CELL_TYPES[-1]}"
        raise MeshError(
            f"the file has {' and '.join(sorted(solids))} cells; all must be {supported}, and of "
            "one kind: mesh the body with tetrahedra alone"
        )
    (cells,) = solids.values()
    return cells


def check_size(vertices: FloatArray, units: str) -> None:
    """Raises MeshError if the size of the bounding box
    of vertices (N, 3) [m] suggests wrong units.
    """
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not SHORTEST_DIAGONAL <= diagonal <= LONGEST_DIAGONAL:
        others = " or ".join(f"units={unit}" for unit in METRES if unit != units)
        raise MeshError(
            f"read with units={units}, the diagonal of the bounding box is {diagonal:g} m, outside "
            f"{SHORTEST_DIAGONAL:g} to {LONGEST_DIAGONAL:g} m; did you mean {others}?"
        )
