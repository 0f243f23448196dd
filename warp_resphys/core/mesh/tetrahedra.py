"""Tetrahedral meshes by gmsh (Geuzaine and Remacle 2009), and filling of closed surfaces."""

import math
import os
import signal
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ...io.arrays import FloatArray, IntArray
from ...io.errors import MeshError, naming
from ...io.progress import QUIET_SECONDS, Progress
from .quality import cell_volumes
from .readers import METRES, check_size
from .volume_mesh import Mesh, quadratic

_TETRAHEDRON, _TRIANGLE = 4, 2  # gmsh's numbers of linear cells
# Angles between triangles above which their edge is preserved, tried in turn [deg].
_ANGLES = (40.0, 30.0, 20.0)
_VOLUME = 0.08  # largest relative difference between the volumes of mesh and surface
# Largest difference between the bounding boxes of mesh and surface, over the cell size
_REACH = 0.5

SURFACE_SUFFIXES = (".stl", ".obj", ".ply")
_DIMENSIONS = ("edges", "surfaces", "volume")


class _NoGmshError(MeshError):
    """gmsh cannot be used."""


def tetrahedra_by_gmsh(describe: Callable[[Any], None], size: float, what: str) -> Mesh:
    """Returns a reproducible mesh of 4-node tetrahedra,
    with vertices numbered from the highest down.

    Args:
        describe: builds the body in the current model of the gmsh module that it is given.
        size: edge length [m].
        what: name of the body, for messages.

    Raises:
        MeshError: gmsh is missing or fails.
    """
    try:
        import gmsh
    except (ImportError, OSError) as error:  # OSError: a system library that gmsh needs is missing
        raise _NoGmshError(
            f"tetrahedra of {what} need gmsh, which cannot be imported ({error}): pip install "
            "'warp-resphys[mesh]'."
        ) from error
    if gmsh.isInitialized():
        raise _NoGmshError(
            f"gmsh is in use in this process: call gmsh.finalize() before {what} is meshed."
        )
    gmsh.initialize(interruptible=False)  # leaves Ctrl-C to Python
    try:
        options = {"General.Terminal": 0.0, "General.NumThreads": 1.0}
        options |= {"Mesh.MeshSizeMax": size, "Mesh.MeshSizeMin": 0.5 * size}
        options |= {"Mesh.Algorithm3D": 1.0}  # Delaunay, which is reproducible
        options |= {"Mesh.OptimizeThreshold": 0.6}  # quality below which tetrahedra are improved
        for option, value in options.items():
            gmsh.option.setNumber(option, value)
        with Progress(
            f"tetrahedra of {what}", len(_DIMENSIONS), "steps", after=QUIET_SECONDS
        ) as progress:
            describe(gmsh)
            for dimension, last in enumerate(_DIMENSIONS, start=1):
                gmsh.model.mesh.generate(dimension)
                progress.advance(meshed=last)
        tags, coordinates, _ = gmsh.model.mesh.getNodes()
        _, nodes = gmsh.model.mesh.getElementsByType(_TETRAHEDRON)
    except Exception as error:  # gmsh has no exception classes of its own
        raise MeshError(f"gmsh cannot mesh {what} ({error}): try another size.") from error
    finally:
        gmsh.finalize()
        if threading.current_thread() is threading.main_thread() and hasattr(signal, "SIGPIPE"):
            # gmsh's kernel of solids resets this signal to its default, by which a closed pipe ends
            # the process.
            signal.signal(signal.SIGPIPE, signal.getsignal(signal.SIGPIPE))
    if not len(nodes):
        raise MeshError(f"gmsh made no tetrahedra of {what}: try another size.")
    places = np.zeros(int(tags.max()) + 1, dtype=np.int64)
    places[tags.astype(np.int64)] = np.arange(len(tags))
    return _ordered(coordinates.reshape(-1, 3), places[nodes.astype(np.int64)].reshape(-1, 4))


def _ordered(points: FloatArray, cells: IntArray) -> Mesh:
    """A mesh of the used vertices, with vertices and cells ordered from the highest down."""
    used = np.unique(cells)
    used = used[np.lexsort((points[used, 1], points[used, 0], -points[used, 2]))]
    number = np.empty(len(points), dtype=np.int64)
    number[used] = np.arange(len(used))
    renumbered = number[cells]
    return Mesh(points[used], renumbered[np.lexsort(np.sort(renumbered, axis=1).T[::-1])])


def fill_surface(
    path: str | os.PathLike[str], size: float, units: str = "m", order: int = 2
) -> Mesh:
    """Fills a closed surface with tetrahedra.

    Inner surfaces bound cavities, such as closed chambers.

    The surface is remeshed with triangles of the given size; sharp edges are preserved.

    Args:
        path: a triangle file that trimesh reads, such as STL, OBJ or PLY.
        size: edge length of the tetrahedra [m].
        units: unit of the coordinates in the file: "m", "cm" or "mm".
        order: 2 for 10-node tetrahedra, 1 for 4-node ones, which are far too stiff in bending.

    Raises:
        MeshError: a missing or invalid file; a surface that is open, or less than 1 mm or more than
            10 m across; a missing or failing gmsh; an argument out of range.
    """
    path = Path(path)
    if units not in METRES or order not in (1, 2):
        raise MeshError(
            f"a surface in {units} filled to order {order}: units are m, cm or mm, orders 1 or 2."
        )
    if not (math.isfinite(size) and size > 0.0):
        raise MeshError(f"the size of tetrahedra is {size}: it must be positive, in m.")
    vertices, shells = read_shells(path)
    vertices = METRES[units] * vertices
    with naming(f"{path}: "):
        check_size(vertices, units)
    volumes = [_volume(vertices, shell) for shell in shells]
    outer = vertices[shells[int(np.argmax(volumes))]].reshape(-1, 3)
    for shell in shells:
        if (vertices[shell] < outer.min(axis=0)).any() or (
            vertices[shell] > outer.max(axis=0)
        ).any():
            raise MeshError(
                f"{path} holds closed surfaces beside one another ({len(shells)} in all): export "
                "one body, whose other surfaces lie within it."
            )
    enclosed, reason = 2.0 * max(volumes) - sum(volumes), ""
    for angle in _ANGLES:
        try:
            mesh = tetrahedra_by_gmsh(partial(_remesh, vertices, shells, angle), size, str(path))
        except MeshError as error:
            if isinstance(error, _NoGmshError):
                raise
            reason = str(error)
            continue
        filled = float(cell_volumes(mesh).sum())
        box, surface_box = (
            np.array([x.min(axis=0), x.max(axis=0)]) for x in (mesh.vertices, vertices)
        )
        if (
            abs(filled - enclosed) <= _VOLUME * enclosed
            and np.abs(box - surface_box).max() <= _REACH * size
        ):
            return quadratic(mesh) if order == 2 else mesh
        reason = (
            f"{path}: tetrahedra of {size:g} m fill {1e6 * filled:.3g} of the "
            f"{1e6 * enclosed:.3g} cm^3 that the surface encloses: take a smaller size."
        )
    raise MeshError(reason)


def read_shells(path: Path) -> tuple[FloatArray, list[IntArray]]:
    """Returns vertices (V, 3), in the file's unit, and triangles (F, 3) of each closed surface."""
    import trimesh

    if not path.is_file():
        raise MeshError(f"{path}: there is no such file of a surface.")
    try:
        read = trimesh.load(str(path), force="mesh", process=True)
    except Exception as error:  # readers raise all kinds of errors on damaged files
        raise MeshError(
            f"{path} cannot be read as a surface ({error}): export it as STL, OBJ or PLY again."
        ) from error
    if not isinstance(read, trimesh.Trimesh) or not len(read.faces):
        raise MeshError(
            f"{path} holds no triangles: export the robot's surface as STL, OBJ or PLY."
        )
    read.merge_vertices(merge_tex=True, merge_norm=True)
    read.fix_normals(multibody=True)
    if not read.is_watertight:
        edges, counts = np.unique(np.sort(read.edges, axis=1), axis=0, return_counts=True)
        place = read.vertices[edges[counts != 2][0]].mean(axis=0)
        raise MeshError(
            f"{path}: {np.count_nonzero(counts != 2)} edges of its triangles do not have two of "
            f"them, the first at ({', '.join(f'{x:.4g}' for x in place)}): close the surface."
        )
    labels = trimesh.graph.connected_component_labels(
        read.face_adjacency, node_count=len(read.faces)
    )
    faces = np.asarray(read.faces, dtype=np.int64)
    return np.asarray(read.vertices, dtype=np.float64), [
        faces[labels == label] for label in range(labels.max() + 1)
    ]


def _volume(vertices: FloatArray, faces: IntArray) -> float:
    """Returns the volume enclosed by a closed surface of either orientation."""
    a, b, c = np.moveaxis(vertices[faces] - vertices[faces].mean(axis=(0, 1)), 1, 0)
    return abs(float(np.einsum("fi,fi->", a, np.cross(b, c)))) / 6.0


def _remesh(vertices: FloatArray, shells: Sequence[IntArray], angle: float, gmsh: Any) -> None:
    """Builds the body within closed surfaces for remeshing.

    Edges sharper than an angle [deg] are preserved.
    """
    model = gmsh.model
    for faces in shells:
        used = np.unique(faces)
        tag = model.addDiscreteEntity(2)
        model.mesh.addNodes(2, tag, used + 1, vertices[used].ravel())
        model.mesh.addElementsByType(tag, _TRIANGLE, [], faces.ravel() + 1)
    model.mesh.classifySurfaces(math.radians(angle), True, True, math.pi)
    model.mesh.createGeometry()
    # The outer one comes first.
    model.geo.addVolume([model.geo.addSurfaceLoop(loop) for loop in _loops(model)])
    model.geo.synchronize()


def _loops(model: Any) -> list[list[int]]:
    """Returns the patches of each closed surface of a model, the outer surface first."""
    patches = [tag for _, tag in model.getEntities(2)]
    curves = [
        [abs(tag) for _, tag in model.getBoundary([(2, patch)], oriented=False)]
        for patch in patches
    ]
    tags = [tag for tags_of_patch in curves for tag in tags_of_patch]
    rows = np.repeat(np.arange(len(patches)), [len(tags_of_patch) for tags_of_patch in curves])
    incidence = scipy.sparse.coo_matrix(
        (np.ones(len(rows)), (rows, tags)), (len(patches), max(tags, default=0) + 1)
    )
    count, labels = scipy.sparse.csgraph.connected_components(
        incidence @ incidence.T, directed=False
    )
    loops = [
        [patch for patch, label in zip(patches, labels, strict=True) if label == k]
        for k in range(count)
    ]

    def across(loop: list[int]) -> float:
        boxes = np.array([model.getBoundingBox(2, tag) for tag in loop])
        return float(np.linalg.norm(boxes[:, 3:].max(axis=0) - boxes[:, :3].min(axis=0)))

    return sorted(loops, key=across, reverse=True)
