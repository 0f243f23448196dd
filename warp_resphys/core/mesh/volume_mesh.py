"""Volume meshes: quadratic elements, boundaries and checks of a mesh.

Nodes are in VTK order. Lengths are in metres; `mesh.readers` converts other units.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from ...io.arrays import BoolArray, FloatArray, IntArray
from ...io.errors import MeshError, checks_types
from .elements import BY_NODES, ELEMENTS, FACES, Element
from .plotting import plot_parts

LARGEST_COORDINATE = 1e50  # in any unit; products of three coordinates must be finite
DEGENERATE_VOLUME = 1e-12  # smallest volume of a cell, over the cube of its longest edge
COINCIDENT_DISTANCE = 1e-9  # largest distance of coincident vertices, over the diagonal of the mesh


@dataclass(frozen=True, eq=False)
class Mesh:
    """Vertices, cells of one kind, and named regions of cells.

    The constructor checks shapes, dtypes and regions only; `check_mesh` checks the geometry.

    Raises:
        MeshError: An array has the wrong shape, the indices are not integers, or a region is empty
            or has a cell that the mesh does not have.
    """

    vertices: FloatArray  # (N, 3) [m] rest positions
    cells: IntArray  # (M, K) vertex indices in VTK's order, of one of `elements.ELEMENTS`
    regions: Mapping[str, IntArray] = field(default_factory=dict)  # (m,) sorted cells, by name

    def __post_init__(self) -> None:
        """Checks shapes and dtypes, and stores contiguous float64 and int64 arrays."""
        vertices, cells = np.asarray(self.vertices), np.asarray(self.cells)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "fiu":
            raise MeshError(
                f"vertices must be (N, 3) numbers, not {vertices.shape} of {vertices.dtype}"
            )
        if cells.ndim != 2 or cells.shape[1] not in BY_NODES or cells.dtype.kind not in "iu":
            nodes = " | ".join(map(str, sorted(BY_NODES)))
            raise MeshError(
                f"cells must be (M, {nodes}) integers, not {cells.shape} of {cells.dtype}"
            )
        object.__setattr__(self, "vertices", np.ascontiguousarray(vertices, dtype=np.float64))
        object.__setattr__(self, "cells", np.ascontiguousarray(cells, dtype=np.int64))
        regions = {name: np.unique(np.asarray(numbers)) for name, numbers in self.regions.items()}
        for name, numbers in regions.items():
            if (
                not len(numbers)
                or numbers.dtype.kind not in "iu"
                or numbers[0] < 0
                or numbers[-1] >= len(cells)
            ):
                raise MeshError(
                    f"the region {name!r} must be the numbers of one or more of the mesh's "
                    f"{len(cells)} cells; turn a mask into them with np.flatnonzero"
                )
        object.__setattr__(
            self, "regions", {name: numbers.astype(np.int64) for name, numbers in regions.items()}
        )

    @property
    def element(self) -> Element:
        """Kind of the cells."""
        return BY_NODES[self.cells.shape[1]]

    def region(self, name: str) -> IntArray:
        """Returns the cells of a region, (m,) sorted numbers.

        Raises:
            MeshError: The mesh has no region of that name.
        """
        if name not in self.regions:
            raise MeshError(
                f"the mesh has no region {name!r}; it has {', '.join(self.regions) or 'no regions'}"
            )
        return self.regions[name]

    @property
    def kind(self) -> str:
        """Name of the cells' kind, such as "hexahedron"."""
        return self.element.name

    def plot(
        self,
        positions: ArrayLike | None = None,
        screenshot: str | Path | None = None,
        plotter: Any = None,
        **options: Any,
    ) -> Any:
        """Draws the cells with pyvista, regions in colours:
        in a window or a notebook, or off screen into a PNG file.

        Args:
            positions: (N, 3) of the vertices [m]; at rest if omitted.
            screenshot: path of the file.
            plotter: A ``pyvista.Plotter`` to which the mesh is only added.
            options: Options of ``pyvista.Plotter.add_mesh``, such as ``color`` and ``opacity``.

        Returns:
            The plotter.

        Raises:
            MeshError: Positions of another shape.
        """
        points = self.vertices if positions is None else np.asarray(positions, dtype=np.float64)
        if points.shape != self.vertices.shape:
            raise MeshError(
                f"positions to draw have shape {points.shape}: give {self.vertices.shape}"
            )
        return plot_parts(
            [(points, self.cells, self.element, self.regions)], None, screenshot, plotter, **options
        )

    def __repr__(self) -> str:
        """Sizes and regions."""
        regions = f", regions {', '.join(self.regions)}" if self.regions else ""
        return f"Mesh({len(self.vertices)} vertices, {len(self.cells)} cells: {self.kind}{regions})"


@checks_types
def quadratic(mesh: Mesh, kind: str = "") -> Mesh:
    """Returns a mesh of quadratic elements from one of linear cells.

    The new nodes are numbered after the old ones.

    The default elements are 10-node tetrahedra and 27-node hexahedra.

    Raises:
        MeshError: The cells are not linear, or do not have the corners of the element.
    """
    element = ELEMENTS.get(
        kind or {"tetrahedron": "tetrahedron10", "hexahedron": "hexahedron27"}.get(mesh.kind, "")
    )
    if element is None or element.linear != mesh.kind:
        raise MeshError(
            f"the nodes of {kind or 'a quadratic element'} cannot be added to {mesh.kind} cells"
        )
    vertices, cells = [mesh.vertices], [mesh.cells]
    count = len(mesh.vertices)
    for size in dict.fromkeys(map(len, element.parents)):
        corners = np.array([parents for parents in element.parents if len(parents) == size])
        groups = np.sort(mesh.cells[:, corners].reshape(-1, size), axis=1)
        distinct, member = np.unique(groups, axis=0, return_inverse=True)
        vertices.append(mesh.vertices[distinct].mean(axis=1))
        cells.append(count + member.reshape(-1, len(corners)))
        count += len(distinct)
    return Mesh(np.concatenate(vertices), np.concatenate(cells, axis=1), mesh.regions)


def check_mesh(mesh: Mesh, cracks: bool = False) -> None:
    """Checks that a mesh is valid for finite elements.

    The Jacobian determinant of each cell must be positive at the quadrature points and at the
    nodes.

    Args:
        mesh: The mesh.
        cracks: Whether vertices may coincide, like those of glued parts.

    Raises:
        MeshError: The mesh is empty; a coordinate is not finite; an index is out of range; a vertex
            belongs to no cell; two vertices coincide; a cell has a vertex twice, or the vertices of
            another cell, or is flat, turned or folded.
    """
    vertices, cells = mesh.vertices, mesh.cells
    count = len(vertices)
    if count == 0 or len(cells) == 0:
        raise MeshError(f"the mesh is empty: it has {count} vertices and {len(cells)} cells")
    _refuse(
        np.any(~(np.abs(vertices) < LARGEST_COORDINATE), axis=1),
        "vertices",
        "have a NaN or infinite coordinate",
    )
    _refuse(
        np.any((cells < 0) | (cells >= count), axis=1),
        "cells",
        f"have indices outside 0 to {count - 1}",
    )
    unused = np.bincount(cells.ravel(), minlength=count) == 0
    _refuse(unused, "vertices", "belong to no cell; reading with drop_unreferenced leaves them out")
    if not cracks:
        offsets = vertices - vertices[0]
        most = np.nextafter(
            COINCIDENT_DISTANCE * float(np.linalg.norm(np.ptp(offsets, axis=0))), np.inf
        )
        _, nearest = cKDTree(offsets).query(offsets, k=2, distance_upper_bound=most)
        _refuse(
            np.asarray(nearest.min(axis=1) < np.arange(count)),
            "vertices",
            "lie on another one, a crack between cells; merge or glue them (gmsh: Coherence, "
            "Abaqus: one part)",
        )
    keys = np.sort(cells, axis=1)
    twice = (keys[:, 1:] == keys[:, :-1]).any(axis=1)
    _refuse(
        twice,
        "cells",
        "have a vertex twice, such as wedges written as hexahedra; mesh the body with tetrahedra",
    )
    ranks = np.lexsort(keys.T)
    repeated = np.zeros(len(cells), dtype=bool)
    repeated[ranks[1:]] = (keys[ranks[1:]] == keys[ranks[:-1]]).all(axis=1)
    _refuse(
        repeated,
        "cells",
        "have the vertices of an earlier one and would count twice; keep one of each",
    )
    volumes, smallest, largest = _normalised_volumes(mesh)
    _refuse(
        np.abs(volumes) < DEGENERATE_VOLUME,
        "cells",
        "are flat, or their nodes in another order; mesh anew",
    )
    order = mesh.element.mirrored.tolist()
    _refuse(
        largest < 0.0,
        "cells",
        f"are inverted: their nodes wind the other way; take them as cells[:, {order}]",
    )
    _refuse(
        smallest < DEGENERATE_VOLUME, "cells", "are folded; move their nodes or mesh the body anew"
    )


def is_mirrored(mesh: Mesh) -> bool:
    """Whether all cells have a negative volume, as in files that wind their nodes the other way.

    Indices must exist.
    """
    for cells in (mesh.cells[:1], mesh.cells):  # one cell decides for most meshes
        volumes = _normalised_volumes(Mesh(mesh.vertices, cells))[0]
        if not (volumes < DEGENERATE_VOLUME).all():
            return False
    return bool((volumes < -DEGENERATE_VOLUME).any())


def boundary_faces(mesh: Mesh) -> IntArray:
    """Returns the faces of a single cell, ordered by cell.

    Returns:
        (F, n) vertex indices, such as (F, 4) for 8-node hexahedra: corners first, counter-clockwise
        seen from outside.
    """
    element = mesh.element
    faces = mesh.cells[:, element.faces].reshape(-1, element.faces.shape[1])
    keys = np.sort(faces[:, : element.face.corners], axis=1)
    _, key, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    return faces[count[key.ravel()] == 1]


def connected_parts(cells: IntArray) -> IntArray:
    """Returns the index (M,) of the connected component of each cell or face (M, K), from 0."""
    count = int(cells.max(initial=-1)) + 1
    ends = cells.ravel(), np.roll(cells, 1, axis=1).ravel()
    graph = scipy.sparse.coo_array((np.ones(cells.size, dtype=np.int8), ends), shape=(count, count))
    _, labels = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return np.unique(labels[cells[:, 0]], return_inverse=True)[1]


def boundary_triangles(mesh: Mesh) -> IntArray:
    """Returns the triangles of the boundary (T, 3),
    counter-clockwise seen from outside (`face_triangles`).
    """
    return face_triangles(boundary_faces(mesh))


def face_triangles(faces: IntArray) -> IntArray:
    """Returns the triangles (T, 3) of faces (F, n), face by face:
    one for 3 nodes, two for 4, four for 6, and so on.
    """
    return faces[:, FACES[faces.shape[1]].triangles].reshape(-1, 3)


def surface_vertices(mesh: Mesh) -> IntArray:
    """Returns the vertices on the boundary (S,), sorted."""
    return np.unique(boundary_faces(mesh))


def join(meshes: Mapping[str, Mesh]) -> Mesh:
    """Returns a mesh of several meshes, without shared vertices.

    Its regions are the meshes by name, and their regions as ``name_region``.

    Raises:
        MeshError: the meshes have different kinds of cells, or two regions have one name.
    """
    kinds = {mesh.kind for mesh in meshes.values()}
    if len(kinds) > 1:
        raise MeshError(
            f"meshes of {' and '.join(sorted(kinds))} cells cannot be joined: give "
            f"{' and '.join(meshes)} cells of one kind."
        )
    cells = []
    first, count = 0, 0
    regions: dict[str, IntArray] = {}
    for name, mesh in meshes.items():
        cells.append(mesh.cells + first)
        named = {name: np.arange(len(mesh.cells))} | {
            f"{name}_{region}": cells for region, cells in mesh.regions.items()
        }
        if twice := regions.keys() & named.keys():
            raise MeshError(
                f"two regions have the name {min(twice)!r}: rename a mesh or its region."
            )
        regions |= {region: count + cells for region, cells in named.items()}
        first, count = first + len(mesh.vertices), count + len(mesh.cells)
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes.values()]), np.concatenate(cells), regions
    )


def _normalised_volumes(mesh: Mesh) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns volumes, smallest and largest determinants of the cells, (M,) each,
    over the cube of the longest edge.

    Determinants are multiplied by the volume of the reference cell, so that both are equal for
    affine cells.
    """
    element = mesh.element
    points, weights = element.rule
    gradients = element.shape(np.concatenate([points, element.shape.nodes]))[1]
    offsets = mesh.vertices[mesh.cells] - mesh.vertices[mesh.cells[:, :1]]
    nodes = np.ascontiguousarray(np.moveaxis(offsets, 0, 2))  # (K, 3, M) [m]
    sides = nodes[element.edges[:, 0]] - nodes[element.edges[:, 1]]  # (E, 3, M) [m]
    longest = np.sqrt((sides**2).sum(axis=1).max(axis=0))
    nodes /= np.where(longest > 0, longest, 1.0)
    volumes = np.zeros(len(mesh.cells))
    smallest, largest = np.full(len(mesh.cells), np.inf), np.full(len(mesh.cells), -np.inf)
    for number, gradient in enumerate(gradients):
        jacobian = np.tensordot(gradient.T, nodes, axes=1)  # (3, 3, M), transposed
        determinants = (np.cross(jacobian[0], jacobian[1], axis=0) * jacobian[2]).sum(axis=0)
        if number < len(points):
            volumes += weights[number] * determinants
        smallest, largest = np.minimum(smallest, determinants), np.maximum(largest, determinants)
    return volumes, smallest * weights.sum(), largest * weights.sum()


def _refuse(broken: BoolArray, nouns: str, problem: str) -> None:
    """Raises MeshError with the first few indices and their number if any flag is set."""
    numbers = np.flatnonzero(broken)
    if len(numbers):
        first = ", ".join(map(str, numbers[:5])) + (", ..." if len(numbers) > 5 else "")
        raise MeshError(
            f"{len(numbers)} of {len(broken)} {nouns} ({first}; counted from 0) {problem}"
        )
