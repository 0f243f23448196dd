"""Tetrahedra by gmsh (Geuzaine and Remacle 2009): the use of it, and the filling of closed surfaces."""

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ..io.errors import MeshError
from .mesh import FloatArray, IntArray, Mesh, quadratic
from .quality import cell_volumes
from .readers import LONGEST_DIAGONAL, METRES, SHORTEST_DIAGONAL

_TETRAHEDRON, _TRIANGLE = 4, 2  # gmsh's numbers of linear cells
_ANGLES = (40.0, 30.0, 20.0)  # degrees between two triangles from which on their common edge is kept, tried in turn
_VOLUME = 0.08  # by how much of itself that of the tetrahedra may differ from what the surface encloses
_REACH = 0.5  # of the size, by which the tetrahedra may reach less far than the surface


class _NoGmshError(MeshError):
    """Nothing can be meshed at all."""


def tetrahedra_by_gmsh(describe: Callable[[Any], None], size: float, what: str) -> Mesh:
    """The 4-node tetrahedra of a body, the same every time, numbered from the highest down.

    Args:
        describe: makes the body in the current model of the module gmsh that it is given.
        size: of their edges [m].
        what: the body, for messages.

    Raises:
        MeshError: gmsh is not installed, or it fails.
    """
    try:
        import gmsh
    except (ImportError, OSError) as error:  # OSError: a system library that gmsh needs is missing
        raise _NoGmshError(
            f"tetrahedra of {what} need gmsh, which cannot be imported ({error}): install it with pip install gmsh."
        ) from error
    if gmsh.isInitialized():
        raise _NoGmshError(f"gmsh is in use in this process: call gmsh.finalize() before {what} is meshed.")
    gmsh.initialize(interruptible=False)  # so that Ctrl-C stays Python's
    try:
        options = {"General.Terminal": 0.0, "General.NumThreads": 1.0}
        options |= {"Mesh.MeshSizeMax": size, "Mesh.MeshSizeMin": 0.5 * size}
        options |= {"Mesh.Algorithm3D": 1.0}  # Delaunay, the same mesh every time
        options |= {"Mesh.OptimizeThreshold": 0.6}  # of the quality below which tetrahedra are improved
        for option, value in options.items():
            gmsh.option.setNumber(option, value)
        describe(gmsh)
        gmsh.model.mesh.generate(3)
        tags, coordinates, _ = gmsh.model.mesh.getNodes()
        _, nodes = gmsh.model.mesh.getElementsByType(_TETRAHEDRON)
    except Exception as error:  # gmsh raises nothing more special
        raise MeshError(f"gmsh cannot mesh {what} ({error}): try another size.") from error
    finally:
        gmsh.finalize()
    if not len(nodes):
        raise MeshError(f"gmsh made no tetrahedra of {what}: try another size.")
    places = np.zeros(int(tags.max()) + 1, dtype=np.int64)
    places[tags.astype(np.int64)] = np.arange(len(tags))
    return _ordered(coordinates.reshape(-1, 3), places[nodes.astype(np.int64)].reshape(-1, 4))


def _ordered(points: FloatArray, cells: IntArray) -> Mesh:
    """The mesh of the vertices that cells use, numbered from the highest down, with cells in that order as well."""
    used = np.unique(cells)
    used = used[np.lexsort((points[used, 1], points[used, 0], -points[used, 2]))]
    number = np.empty(len(points), dtype=np.int64)
    number[used] = np.arange(len(used))
    renumbered = number[cells]
    return Mesh(points[used], renumbered[np.lexsort(np.sort(renumbered, axis=1).T[::-1])])


def fill_surface(path: str | os.PathLike[str], size: float, units: str = "m", order: int = 2) -> Mesh:
    """Fills a closed surface with tetrahedra; surfaces within it bound cavities, such as closed chambers.

    The surface is meshed anew with triangles of the size; edges at which it turns sharply are kept.

    Args:
        path: a file of triangles that trimesh reads, such as STL, OBJ or PLY.
        size: of the tetrahedra's edges [m].
        units: of the coordinates in the file: "m", "cm" or "mm".
        order: 2 for 10-node tetrahedra, 1 for 4-node ones, which bend far too stiffly.

    Raises:
        MeshError: a file that is missing or no surface; a surface that is open, or less than 1 mm or more than 10 m
            across; no gmsh, or one that fails; an argument out of range.
    """
    path = Path(path)
    if units not in METRES or order not in (1, 2):
        raise MeshError(f"a surface in {units} filled to order {order}: units are m, cm or mm, orders 1 or 2.")
    if not (math.isfinite(size) and size > 0.0):
        raise MeshError(f"the size of tetrahedra is {size}: it must be positive, in m.")
    vertices, shells = _read_shells(path)
    vertices = METRES[units] * vertices
    across = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not SHORTEST_DIAGONAL <= across <= LONGEST_DIAGONAL:
        raise MeshError(f"{path}: the surface is {across:.3g} m across in {units}: check the unit of its coordinates.")
    volumes = [_volume(vertices, shell) for shell in shells]
    outer = vertices[shells[int(np.argmax(volumes))]].reshape(-1, 3)
    for shell in shells:
        if (vertices[shell] < outer.min(axis=0)).any() or (vertices[shell] > outer.max(axis=0)).any():
            raise MeshError(
                f"{path} holds closed surfaces beside one another ({len(shells)} in all): export one body, whose other "
                "surfaces lie within it."
            )
    enclosed, reason = 2.0 * max(volumes) - sum(volumes), ""
    for angle in _ANGLES:
        try:
            mesh = tetrahedra_by_gmsh(_Remeshed(vertices, shells, angle), size, str(path))
        except MeshError as error:
            if isinstance(error, _NoGmshError):
                raise
            reason = str(error)
            continue
        made = float(cell_volumes(mesh).sum())
        reached, meant = (np.array([corners.min(axis=0), corners.max(axis=0)]) for corners in (mesh.vertices, vertices))
        if abs(made - enclosed) <= _VOLUME * enclosed and np.abs(reached - meant).max() <= _REACH * size:
            return quadratic(mesh) if order == 2 else mesh
        reason = (
            f"{path}: tetrahedra of {size:g} m fill {1e6 * made:.3g} of the {1e6 * enclosed:.3g} cm^3 that the surface "
            "encloses: take a smaller size."
        )
    raise MeshError(reason)


def _read_shells(path: Path) -> tuple[FloatArray, list[IntArray]]:
    """Vertices (V, 3), in the file's unit, and the triangles (F, 3) of each closed surface."""
    import trimesh

    if not path.is_file():
        raise MeshError(f"{path}: there is no such file of a surface.")
    try:
        read = trimesh.load(str(path), force="mesh", process=True)
    except Exception as error:  # whatever a damaged file makes of a reader
        raise MeshError(f"{path} cannot be read as a surface ({error}): export it as STL, OBJ or PLY again.") from error
    if not isinstance(read, trimesh.Trimesh) or not len(read.faces):
        raise MeshError(f"{path} holds no triangles: export the robot's surface as STL, OBJ or PLY.")
    read.merge_vertices(merge_tex=True, merge_norm=True)
    read.fix_normals(multibody=True)
    if not read.is_watertight:
        edges, counts = np.unique(np.sort(read.edges, axis=1), axis=0, return_counts=True)
        place = read.vertices[edges[counts != 2][0]].mean(axis=0)
        raise MeshError(
            f"{path}: {np.count_nonzero(counts != 2)} edges of its triangles do not have two of them, the first at "
            f"({', '.join(f'{x:.4g}' for x in place)}): close the surface."
        )
    labels = trimesh.graph.connected_component_labels(read.face_adjacency, node_count=len(read.faces))
    faces = np.asarray(read.faces, dtype=np.int64)
    return np.asarray(read.vertices, dtype=np.float64), [faces[labels == label] for label in range(labels.max() + 1)]


def _volume(vertices: FloatArray, faces: IntArray) -> float:
    """What a closed surface encloses, whether its triangles turn outwards or inwards."""
    a, b, c = np.moveaxis(vertices[faces] - vertices[faces].mean(axis=(0, 1)), 1, 0)
    return abs(float(np.einsum("fi,fi->", a, np.cross(b, c)))) / 6.0


class _Remeshed:
    """The body within closed surfaces, for gmsh to mesh anew: edges that turn by more than an angle [deg] are kept."""

    def __init__(self, vertices: FloatArray, shells: Sequence[IntArray], angle: float) -> None:
        self._vertices, self._shells, self._angle = vertices, shells, angle

    def __call__(self, gmsh: Any) -> None:
        model = gmsh.model
        for faces in self._shells:
            used = np.unique(faces)
            tag = model.addDiscreteEntity(2)
            model.mesh.addNodes(2, tag, used + 1, self._vertices[used].ravel())
            model.mesh.addElementsByType(tag, _TRIANGLE, [], faces.ravel() + 1)
        model.mesh.classifySurfaces(math.radians(self._angle), True, True, math.pi)
        model.mesh.createGeometry()
        model.geo.addVolume([model.geo.addSurfaceLoop(loop) for loop in _loops(model)])  # the first one is outside
        model.geo.synchronize()


def _loops(model: Any) -> list[list[int]]:
    """The patches of each closed surface of a model, that around the others first."""
    patches = [tag for _, tag in model.getEntities(2)]
    curves = [[abs(tag) for _, tag in model.getBoundary([(2, patch)], oriented=False)] for patch in patches]
    width = max((tag for boundary in curves for tag in boundary), default=0) + 1
    rows = np.repeat(np.arange(len(patches)), [len(boundary) for boundary in curves])
    has = scipy.sparse.coo_matrix(
        (np.ones(len(rows)), (rows, [tag for boundary in curves for tag in boundary])), (len(patches), width)
    )
    count, labels = scipy.sparse.csgraph.connected_components(has @ has.T, directed=False)
    loops = [
        [patch for patch, label in zip(patches, labels, strict=True) if label == number] for number in range(count)
    ]

    def across(loop: list[int]) -> float:
        boxes = np.array([model.getBoundingBox(2, tag) for tag in loop])
        return float(np.linalg.norm(boxes[:, 3:].max(axis=0) - boxes[:, :3].min(axis=0)))

    return sorted(loops, key=across, reverse=True)
