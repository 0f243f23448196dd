"""Pairs of vertices and triangles, and of edges, that may come near one another in a batch."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import torch
import warp as wp
from numpy.typing import NDArray

from ....io.errors import InputError
from ....kernels.contact import broad_phase, nearest_points
from ....kernels.modules import launch_stream, shareable
from ...mesh.volume_mesh import Mesh, boundary_triangles
from ..launcher import Launcher, struct_of, warp_view
from .obstacles import signed_distances

_FIRST_CAPACITY = 4096
_REBUILT = 100  # Uses of a hierarchy of boxes after which it is made anew.
_SPARE = 0.75  # radius around the middle of a way within which pairs are sought, over its length
# |a x b|^2 over |a|^2 |b|^2 at rest below which edges count as almost parallel (Li et al. 2020)
_PARALLEL = 1e-3


@dataclass(frozen=True)
class Surface:
    """The surface of bodies, as triangles.

    Attributes:
        vertices: (P,) vertices of the surface, in ascending order.
        triangles: (T, 3) their vertices, counter-clockwise seen from outside.
        edges: (E, 2) vertices of the edges.
        degree: (N,) triangles at every vertex.
        pieces: (N,) number of the piece that a vertex belongs to.
        rest: (N, 3) positions at rest [m].
        areas: (T,) areas of the triangles at rest [m^2].
        names: names of the regions of the mesh, in a scene of its bodies first.
        owners: (N,) number of the first of them that a vertex belongs to; -1 for none.
    """

    vertices: NDArray[np.int64]
    triangles: NDArray[np.int64]
    edges: NDArray[np.int64]
    degree: NDArray[np.int64]
    pieces: NDArray[np.int64]
    rest: NDArray[np.float64]
    areas: NDArray[np.float64]
    names: tuple[str, ...]
    owners: NDArray[np.int64]

    @classmethod
    def of(cls, mesh: Mesh) -> "Surface":
        """Returns the surface of a mesh."""
        triangles, x = boundary_triangles(mesh).astype(np.int64), mesh.vertices
        edges = np.unique(
            np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0
        )
        areas = 0.5 * np.linalg.norm(
            np.cross(
                x[triangles[:, 1]] - x[triangles[:, 0]], x[triangles[:, 2]] - x[triangles[:, 0]]
            ),
            axis=1,
        )
        cells = np.repeat(mesh.cells[:, :1], mesh.cells.shape[1], axis=1)
        graph = scipy.sparse.coo_array(
            (np.ones(cells.size), (cells.ravel(), mesh.cells.ravel())), (len(x), len(x))
        )
        _, pieces = scipy.sparse.csgraph.connected_components(graph, directed=False)
        degree, owners = np.bincount(triangles.ravel(), minlength=len(x)), np.full(len(x), -1)
        for number, region in reversed(list(enumerate(mesh.regions.values()))):
            owners[mesh.cells[region]] = number
        arrays = (np.unique(triangles), triangles, edges, degree, pieces.astype(np.int64), x, areas)
        return cls(*arrays, tuple(mesh.regions), owners)

    def within(self, first: int, count: int) -> "Surface":
        """Returns the surface with its body's vertices from `first` on among `count`."""
        after = count - first - len(self.rest)

        def pad(values: NDArray[Any]) -> NDArray[Any]:
            return np.pad(values, [(first, after), *[(0, 0)] * (values.ndim - 1)])

        fields: dict[str, Any] = {
            name: getattr(self, name) + first for name in ("vertices", "triangles", "edges")
        }
        fields |= {
            name: pad(getattr(self, name)) for name in ("degree", "pieces", "rest", "owners")
        }
        return replace(self, **fields)

    def words(self, vertex: int) -> str:
        """Returns a vertex in words: its number among all vertices,
        and the name of its body or region.
        """
        owner = int(self.owners[vertex])
        return f"vertex {vertex}" + (f" in {self.names[owner]!r}" if owner >= 0 else "")

    def vertex_areas(self) -> NDArray[np.float64]:
        """Returns the area (N,) of every vertex, a third of its triangles' [m^2]."""
        out = np.zeros(len(self.rest))
        np.add.at(out, self.triangles, self.areas[:, None] / 3.0)
        return out

    def edge_areas(self) -> NDArray[np.float64]:
        """Returns the area (E,) of every edge, a third of its triangles' [m^2]."""
        n = len(self.rest)
        sides = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
        place = np.searchsorted(self.edges @ [n, 1], sides @ [n, 1])
        out = np.zeros(len(self.edges))
        np.add.at(out, place, self.areas[:, None] / 3.0)
        return out


class _Hierarchy:
    """A hierarchy of boxes.

    Args:
        arrays: lower and upper corners, and environments, of the boxes.
    """

    def __init__(self, arrays: list[Any]) -> None:
        self.arrays, self._uses = arrays, 0

    def fitted(self) -> Any:
        """Returns the hierarchy after a change of the boxes."""
        if self._uses == 0:
            low, high, group = self.arrays
            self._tree = wp.Bvh(low, high, groups=group)
        elif self._uses % _REBUILT == 0:
            self._tree.rebuild()
        else:
            self._tree.refit()
        self._uses += 1
        return self._tree


class PairList:
    """Pairs of a batch that may come within reach, with positions and radii for which that holds.

    Args:
        launcher: launcher of the potential.
        surface: the surface.
        reach: distance within which pairs count [m].

    Attributes:
        count: number of pairs C.
        version: number of lists so far.
        pairs: the pairs, a ``kernels.contact.nearest_points.Pairs``.
        environment: (C,) environments of the pairs.
        nodes: (C, 4) vertices.
        kind: (C,) kind.
        vertex_array: (P,) vertices of the surface, a Warp array.
        start: (B P + 1) first entry of every vertex of the surface in `incident`.
        incident: pair 4 + number of the vertex in it (``kernels.contact.surface_pairs.gather``).
    """

    def __init__(self, launcher: Launcher, surface: Surface, reach: float) -> None:
        self._launcher = launcher
        self.surface, self.reach = surface, reach
        device, n = launcher.device, len(surface.rest)

        def tensor(values: Any, dtype: torch.dtype = torch.int64) -> torch.Tensor:
            return torch.as_tensor(values, device=device, dtype=dtype)

        self.vertices = tensor(surface.vertices)
        self._triangles, self._edges = tensor(surface.triangles), tensor(surface.edges)
        self._pieces = tensor(surface.pieces)
        pieces = self._pieces[self.vertices]
        # Weights of the mean over every piece, and in the last row over all.
        self._means = torch.zeros(
            int(surface.pieces.max()) + 2, n, device=device, dtype=torch.float64
        )
        self._means[pieces, self.vertices] = (
            1.0 / torch.bincount(pieces, minlength=len(self._means))[pieces].double()
        )
        self._means[-1, self.vertices] = 1.0 / len(pieces)
        self._degree = tensor(surface.degree, torch.float64)
        # Both surfaces in contact have vertices, for half of its area, and edges, for an eighth.
        self._vertex_area = tensor(0.5 * surface.vertex_areas(), torch.float64)
        self._edge_area = tensor(0.125 * surface.edge_areas(), torch.float64)
        self._rest = tensor(surface.rest, torch.float64)
        self._triangle_array, self._edge_array = (
            launcher.upload(part.astype(np.int32), int)
            for part in (surface.triangles, surface.edges)
        )
        self._piece_array = launcher.upload(surface.pieces.astype(np.int32), int)
        self.vertex_array = launcher.upload(surface.vertices.astype(np.int32), int)
        self._local = torch.full((n,), -1, device=device)
        self._local[self.vertices] = torch.arange(len(self.vertices), device=device)
        extent = np.ptp(surface.rest[surface.vertices], axis=0)
        self.longest_way = 0.1 * float(np.linalg.norm(extent))  # of a vertex at a time [m]
        self._least_radius = 0.5 * reach
        self._capacity = _FIRST_CAPACITY
        self.version = self.count = 0
        self._origin: torch.Tensor | None = None
        self._hierarchies: dict[int, _Hierarchy] = {}
        self._outer = self._inner = launcher.zeros(n)

    def covers(self, positions: torch.Tensor) -> bool:
        """Returns whether the list holds all pairs of positions (B, N, 3) that are within reach."""
        if self._origin is None:
            return False
        way, relative = self._ways(positions - self._origin)
        inside = (relative <= self._inner) & (way <= self._outer)
        return bool(inside[:, self.vertices].all())

    def lengths(self, ways: torch.Tensor) -> torch.Tensor:
        """Returns the lengths (B, P) of ways (B, N, 3), relative to their mean [m]."""
        return self._ways(ways)[0][:, self.vertices]

    def _ways(self, ways: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns lengths (B, N) of ways (B, N, 3) relative to the mean of all,
        and to that of their piece [m].
        """
        mean = torch.einsum("cn,bnk->bck", self._means, ways)
        return (ways - mean[:, -1:]).norm(dim=-1), (ways - mean[:, self._pieces]).norm(dim=-1)

    def find(self, origin: torch.Tensor, ways: torch.Tensor) -> None:
        """Makes the list for positions (B, N, 3) and ways (B, N, 3) from there,
        around the middle of these [m].
        """
        launcher, surface = self._launcher, self.surface
        outer, inner = (_SPARE * size + self._least_radius for size in self._ways(ways))
        self._origin = origin + 0.5 * ways
        self._outer, self._inner = outer, inner
        motion = struct_of(
            broad_phase.Sweep,
            origin=self._origin,
            outer=outer,
            inner=inner,
            piece=self._piece_array,
            reach=self.reach,
        )
        size = len(surface.vertices) * len(surface.triangles)
        total, vertices = size + len(surface.edges) ** 2, self.vertex_array.reshape((-1, 1))
        faces, edges = self._triangle_array, self._edge_array
        searches = (  # by `kernels.contact.nearest_points.VERTEX_TRIANGLE` and `EDGE_EDGE`
            (self._hierarchy(motion, faces), vertices, faces, 0),
            (self._hierarchy(motion, edges), edges, edges, size),
        )
        while True:
            count = torch.zeros(1, device=launcher.device, dtype=torch.int32)
            keys = torch.zeros(self._capacity, device=launcher.device, dtype=torch.int64)
            pair_keys = struct_of(broad_phase.PairKeys, count=count, keys=keys)
            for kind, (tree, first, second, offset) in enumerate(searches):
                inputs = [kind, tree.id, motion, first, second, wp.int64(offset), wp.int64(total)]
                launcher.run(
                    broad_phase.close_pairs, (launcher.batch, first.shape[0]), inputs, [pair_keys]
                )
            needed = int(count)
            if needed <= self._capacity:
                break
            self._capacity = 2 * needed  # The list is made again.
        self._set(keys[:needed].sort().values, size, total)

    def _hierarchy(self, motion: Any, nodes: Any) -> Any:
        """Boxes of triangles or edges of all environments, valid until they are sought again.

        Bodies keep together, so that a hierarchy serves for many positions.
        """
        launcher, device = self._launcher, str(self._launcher.device)
        size, used = launcher.batch * nodes.shape[0], self._hierarchies.get(nodes.ptr)
        if used is None:
            with shareable():
                arrays = [
                    wp.empty(size, dtype=kind, device=device) for kind in (wp.vec3, wp.vec3, int)
                ]
            used = self._hierarchies[nodes.ptr] = _Hierarchy(arrays)
        launcher.run(
            broad_phase.boxes, (launcher.batch, nodes.shape[0]), [motion, nodes], used.arrays
        )
        with shareable(), wp.ScopedStream(launch_stream(launcher.device)):
            return used.fitted()

    def _set(self, keys: torch.Tensor, size: int, total: int) -> None:
        """Decodes the keys of pairs in ascending order."""
        environment, key = keys // total, keys % total
        vertex = key < size
        v, t = key // len(self._triangles), key % len(self._triangles)
        e, f = (key - size) // len(self._edges), (key - size) % len(self._edges)
        v, e = v.clamp_max(len(self.vertices) - 1), e.clamp_min(0)
        first = torch.cat([self.vertices[v, None], self._triangles[t]], 1)
        second = torch.cat([self._edges[e], self._edges[f]], 1)
        self.nodes = torch.where(vertex[:, None], first, second)
        self.environment, self.kind = environment, (~vertex).int()
        self.area = torch.where(
            vertex, self._vertex_area[first[:, 0]], self._edge_area[e] + self._edge_area[f]
        )
        self.degree = self._degree[self.nodes]
        a, b = (self._rest[self.nodes[:, k + 1]] - self._rest[self.nodes[:, k]] for k in (0, 2))
        self.parallel = _PARALLEL * a.square().sum(1) * b.square().sum(1)
        self.start, self.incident = self.incidence(self.environment, self.nodes)
        self.count, self.version = len(keys), self.version + 1
        whole = {"environment": self.environment, "kind": self.kind, "nodes": self.nodes}
        whole = {name: value.to(torch.int32).contiguous() for name, value in whole.items()}
        self.pairs = struct_of(
            nearest_points.Pairs,
            **whole,
            area=self.area,
            degree=self.degree,
            parallel=self.parallel,
        )

    def incidence(
        self, environment: torch.Tensor, nodes: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns `start` and `incident` of pairs (C,) and (C, 4)."""
        size = len(self.vertices)
        row = (environment[:, None] * size + self._local[nodes]).ravel()
        order = row.argsort(stable=True)
        ends = torch.arange(self._launcher.batch * size + 1, device=row.device)
        return torch.searchsorted(row[order], ends).to(torch.int32), order.to(torch.int32)

    def distances(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns the distances (C,) of the pairs at positions (B, N, 3) [m]."""
        launcher, kept = self._launcher, positions.contiguous()
        out = torch.zeros(self.count, device=launcher.device, dtype=torch.float64)
        if self.count:
            inputs = [self.pairs, warp_view(kept, wp.vec3d)]
            launcher.run(
                nearest_points.distances, (self.count,), inputs, [warp_view(out, wp.float64)]
            )
        return out

    def check_apart(self, positions: torch.Tensor, when: str, advice: str) -> None:
        """Raises InputError where surfaces cross at positions (B, N, 3),
        or a body is within another one.

        Args:
            positions: of the vertices [m].
            when: these positions, in words; braces stand for the environment.
            advice: what to do.
        """
        count, edge = self.crossings(positions)
        if bool(count.any()):
            b = int(count.argmax())
            crossing = self.crossing(positions[b], int(edge[b]))
            raise InputError(f"surfaces cross {when.format(b)}: {crossing}; {advice}.")
        enclosed = self.enclosed(positions)
        if bool((enclosed >= 0).any()):
            b = int(enclosed[:, 0].argmax())
            inside, outer = map(self.surface.words, enclosed[b].tolist())
            raise InputError(
                f"a body with {inside} is within that with {outer} {when.format(b)}: {advice}."
            )

    def crossing(self, positions: torch.Tensor, edge: int) -> str:
        """Returns in words what an edge that passes through a triangle shows
        at positions (N, 3) [m].
        """
        start, end = positions[self._edges[edge]]
        a, b, c = positions[self._triangles].unbind(1)
        normal = torch.linalg.cross(b - a, c - a)
        below, above = (((x - a) * normal).sum(-1) for x in (start, end))
        at = start + (below / (below - above))[:, None] * (end - start)
        sides = [
            (torch.linalg.cross(q - p, at - p) * normal).sum(-1)
            for p, q in ((a, b), (b, c), (c, a))
        ]
        through = (torch.stack(sides) >= 0.0).all(0) & (below * above <= 0.0)
        through &= ~torch.isin(self._triangles, self._edges[edge]).any(1)
        vertex = int(self._edges[edge, 0])
        other = int(self._triangles[int(through.int().argmax()), 0])
        words = (
            f"an edge at {self.surface.words(vertex)} passes through a triangle at "
            f"{self.surface.words(other)}"
        )
        depth, deepest = 0.0, -1
        pieces = self._pieces[[vertex, other]].tolist()
        for one, two in (pieces, pieces[::-1]) if pieces[0] != pieces[1] else ():
            vertices = self.vertices[self._pieces[self.vertices] == one]
            far = -self._distances(positions, two, vertices)
            if far.max() > depth:
                depth, deepest = float(far.max()), int(vertices[int(far.argmax())])
        if deepest >= 0:
            words += f"; deepest is {self.surface.words(deepest)}, by {1e3 * depth:.3g} mm"
        return words

    def _distances(
        self, positions: torch.Tensor, piece: int, vertices: torch.Tensor
    ) -> NDArray[np.float64]:
        """Returns the distances (V,) of vertices (V,) from a piece,
        negative within it, at positions (N, 3) [m].
        """
        triangles = self._triangles[self._pieces[self._triangles[:, 0]] == piece]
        x = positions.cpu()
        return signed_distances(x, triangles.cpu(), x[vertices.cpu()])

    def enclosed(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns (B, 2) a vertex of a piece within another one, and a vertex of that.

        -1 where there is none.

        Surfaces must not cross.
        """
        out = torch.full((len(positions), 2), -1, device=positions.device)
        pieces = self._pieces[self.vertices].unique()
        of = [positions[:, self.vertices[self._pieces[self.vertices] == piece]] for piece in pieces]
        # (B, pieces, 3)
        low, high = torch.stack([x.amin(1) for x in of], 1), torch.stack([x.amax(1) for x in of], 1)
        contained = (low[:, :, None] > low[:, None]).all(-1) & (
            high[:, :, None] < high[:, None]
        ).all(-1)
        for b, one, two in contained.nonzero().tolist():
            vertices = [
                self.vertices[self._pieces[self.vertices] == pieces[piece]][:1]
                for piece in (one, two)
            ]
            if self._distances(positions[b], int(pieces[two]), vertices[0])[0] < 0.0:
                out[b] = torch.cat(vertices)
        return out

    def crossings(self, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the number (B,) of edges that pass through a triangle,
        and the first of them (B,).
        """
        launcher = self._launcher
        motion = struct_of(
            broad_phase.Sweep,
            origin=positions.contiguous(),
            outer=launcher.zeros(positions.shape[1]),
        )
        hierarchy = self._hierarchy(motion, self._triangle_array)
        count, edge = (
            torch.full((launcher.batch,), k, device=launcher.device, dtype=torch.int32)
            for k in (0, 2**31 - 1)
        )
        inputs = [hierarchy.id, motion, self._edge_array, self._triangle_array]
        outputs = [warp_view(count, wp.int32), warp_view(edge, wp.int32)]
        launcher.run(
            broad_phase.crossings, (launcher.batch, len(self.surface.edges)), inputs, outputs
        )
        return count, edge
